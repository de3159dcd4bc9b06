"""Hostile programs around exported axes: all functions, any order, any bits, sanitizers.

    python benchmarks/hostile_axes.py [--calls 1e6] [--rows TEXT] [--precision P] [--results FILE]

As ``hostile_exports.py`` does for one u and one y, for the rows of ``exported_axes.py`` and for
state feedback: a program calls all functions of the controller in an order drawn by chance, with
random bits, absurd and good values in any of the arrays, compiled with the sanitizers of addresses
and of undefined behaviour.
After each call all u are looked at: they must be numbers within the limits in use. A memory image
that is refused must change nothing.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import hostile_exports
from hostile_exports import SANITIZERS, SHARES, run, words_of_type
from measured import check_present, options_of, parser_of, write
from rich.console import Console
from rich.table import Table

from quell.export import CSource, TranslationError, c_source

HEADS = ("axes", "precision", "functions", "calls", "reports", "u not finite", "u beyond limits",
         "time [s]")  # fmt: skip
_CHECKS = r"""
enum { N = REFERENCES, P = MEASUREMENTS, M = UPPER_ACTUATORS };
static REAL r[N], y[P], r1[N], r2[N], r3[N], given[M], u[M];

static void draw_all(void)
{
    for (int i = 0; i < P; i++)
        y[i] = measurement();
    for (int i = 0; i < N; i++) {
        r[i] = reference();
        r1[i] = hostile();
        r2[i] = hostile();
        r3[i] = hostile();
    }
    for (int k = 0; k < M; k++)
        given[k] = hostile();
}

static void check(const NAME_state *state)
{
    for (int k = 0; k < M; k++) {
        note_real(u[k]);
        not_finite += !finite_bits(u[k]);
        beyond += u[k] < state->parameters->limits.low[k]
            || u[k] > state->parameters->limits.high[k];
    }
    note((uint64_t)NAME_status(state));
}

static void check_copy(const NAME_state *state)
{
    NAME_state copy = *state;
    draw_all();
    NAME_step(&copy, r, yFURTHER, u);
    check(&copy);
}
"""
_MAIN = r"""
int main(int count, char **arguments)
{
    static NAME_state controller;
    static NAME_parameters narrower; /* with other limits */
    NAME_state *const state = &controller;
    const unsigned long calls = count > 1 ? (unsigned long)atof(arguments[1]) : 1000000UL;

    narrower = NAME_default_parameters;
    for (int k = 0; k < M; k++)
        narrower.limits.high[k] = narrower.limits.high[k] < 1 ? 0 : 1;
    NAME_init(state);
    for (unsigned long k = 0; k < calls; k++) {
        if (bits() % (mood ? 2000 : 20000) == 0)
            change_mood();
        const uint32_t draw = (uint32_t)(bits() % 1000000);
        draw_all();
CASES        {
            NAME_step(state, r, yFURTHER, u);
            check(state);
            advance(u[0]);
        }
    }
    printf("%lu %lu %016llx\n", not_finite, beyond, (unsigned long long)trace);
    return not_finite || beyond ? 2 : 0;
}
"""
_CALLS = {
    "applied": ("applied(state, given);",),
    "track": ("track(state, r, y, givenFURTHER);",),
    "hand_over": ("hand_over(state);",),
    "start": ("start(state, y, given, r);",),
    "reset": ("reset(state);",),
    "set_held": ("set_held(state, (int)(bits() % 6) - 1, bits() % 4 == 0);",),
    "retune": ("retune(state, bits() & 1 ? &narrower : &NAME_default_parameters);",),
}


def hostile_program(source: CSource, seed: int) -> str:
    """Return the program for exported axes."""
    known, at = [], 0
    for operation, part in SHARES.items():
        if operation not in source.operations:
            continue
        at += part
        lines = [f"NAME_{line}" for line in _CALLS.get(operation, ())]
        if operation == "get_estimate":
            lines = ["const NAME_estimate known = NAME_get_estimate(state);"]
            lines += [
                f"note_real((REAL)known.{channel}{f'[{i}]' if width > 1 else ''});"
                for channel, width in source.channels
                for i in range(width)
            ]
        elif operation == "save":
            lines = ["NAME_save(state, image);", "note(image[sizeof image - 8]);"]
        elif operation == "load":
            lines = ["load(state);", "check_copy(state);"]
        elif operation == "status":
            lines = ["note((uint64_t)NAME_status(state));"]
        else:
            lines.append("check_copy(state);")
        body = "\n".join(f"            {line}" for line in lines)
        known.append(f"        if (draw < {at}) {{\n{body}\n        }} else\n")
    missing = set(source.operations) - {*SHARES, "init", "step"}
    if missing:
        raise ValueError(f"the program does not call {sorted(missing)}")
    helpers = hostile_exports._HELPERS.partition("static void check(")[0]
    text = helpers + _CHECKS + hostile_exports._IMAGES + _MAIN.replace("CASES", "".join(known))
    words = words_of_type(source, seed)
    words["FURTHER"] = "".join(f", {each}" for each in source.further)
    words["REFERENCES"], words["MEASUREMENTS"] = map(str, (source.sizes or (1, 1))[:2])
    for word, value in {"UPPER": source.name.upper(), **words}.items():
        text = text.replace(word, value)
    headers = ("float.h", "math.h", "stdint.h", "stdio.h", "stdlib.h", "string.h")
    includes = "".join(f"#include <{each}>\n" for each in headers)
    return f'#include "{source.name}.h"\n\n{includes}{text}'


def row_of(name: str, axes: Any, precision: str, options: argparse.Namespace) -> list[str]:
    """Return a row of the table."""
    begin = time.monotonic()
    try:
        source = c_source(axes, "robot", precision=precision)
    except TranslationError as error:
        return [name, precision, "refused", "", "0", "0", "0", str(error)[24:80]]
    with tempfile.TemporaryDirectory() as place:
        program = hostile_program(source, options.seed)
        made = hostile_exports.compiled(Path(place), source, program, options.sanitizer)
        found = run(made, options.calls)
    seconds = f"{time.monotonic() - begin:.0f}"
    return [name, precision, f"{len(source.operations)}", f"{options.calls:g}", *found, seconds]


def main() -> None:
    """Run the rows and print a table."""
    from exported import counted, earlier_rows, ready_row
    from exported_axes import cases, feedback

    parser = parser_of(__doc__)
    parser.add_argument("--calls", type=float, default=1e6, help="calls of each row")
    parser.add_argument("--rows", default="", help="axes whose name has this text")
    parser.add_argument("--precision", choices=("double", "single"), help="one precision only")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sanitizer", choices=tuple(SANITIZERS), default="address")
    parser.add_argument("--results", type=Path, help="file of rows that are ready")
    options = options_of(parser, calls=2000, rows="no learner", precision="double")
    check_present(options, tools=[SANITIZERS[options.sanitizer][0]])
    warnings.simplefilter("ignore")
    console, known, bad = Console(width=160), earlier_rows(options.results), 0
    table, rows = Table(*HEADS), []
    for name, axes in (cases() | feedback()).items():
        for precision in [options.precision] if options.precision else ["double", "single"]:
            if options.rows in name:
                make = partial(row_of, name, axes, precision, options)
                cells = ready_row(known, (name, precision), make, options.results)
                bad += cells[4:7] != ["0", "0", "0"]
                console.print(" | ".join(cells), highlight=False)
                table.add_row(*cells)
                rows.append(cells)
    console.print(table)
    print(f"{bad} rows have a report or a bad u" if bad else "no report, no bad u")
    write(options, {"bad rows": bad, **counted(HEADS, rows)})
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
