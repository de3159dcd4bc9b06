"""Hostile programs around exported controllers: all functions, any order, any bits, sanitizers.

    python benchmarks/hostile_exports.py [--calls 1e7] [--rows TEXT] [--part I/N] [--results FILE]

For every row of ``exported.py``, in double and in single precision, a program is written that calls
all functions of the controller in an order drawn by chance. Numbers are random bits (so NaN,
infinities, denormal numbers), limits of the type, absurd and good values; between them are times of
a good loop with a simple plant, so that observers settle, learners learn and guards decide. gcc
compiles program and controller with its sanitizers of addresses and of undefined behaviour, also of
conversions to integers, and the first report ends the row; ``--sanitizer memory`` has clang look
for what is read before it is set. After each call u is looked at: that of
the call if it returns one, else that of a step of a copy of the state. It must be a number within
the limits in use. Memory images are saved and loaded between them: whole, cut, damaged, and with
any numbers behind a right check, also the largest in a row; one that is refused must change
nothing. Bits are compared to find NaN, which no option of a compiler can change.

10^7 calls of all rows take some hours of a core: ``--results`` names a file to which each row is
added when it is ready, and whose rows are not run again; ``--part I/N`` takes each N-th row.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path
from typing import Any

from measured import check_present, options_of, parser_of, part_of, write

import quell as ql
from quell.controllers import in_single_precision
from quell.export import CSource
from quell.export.controller_source import limits_path
from quell.export.proof import CALLS, RETURN_U, narrower_limits

FLAGS = ("-std=c99", "-O2", "-g1", "-ffp-contract=off")
SANITIZERS = {
    "address": (
        *("gcc", "-fsanitize=address,undefined", "-fsanitize=float-cast-overflow,bounds-strict"),
        "-fno-sanitize-recover=all",
    ),
    "memory": ("clang", "-fsanitize=memory"),
    "none": ("gcc",),
}
# How often each function is called, of a million calls. ``start`` takes thousands of steps.
SHARES = {"applied": 60_000, "track": 80_000, "hand_over": 20_000, "start": 200, "reset": 200,
          "retune": 1000, "status": 5000, "get_estimate": 20_000, "stopping_point": 20_000,
          "step_counts": 150_000, "save": 3000, "load": 3000, "set_held": 20_000}  # fmt: skip
HEADS = ("controller", "precision", "functions", "calls", "reports", "u not finite",
         "u beyond limits", "time [s]")  # fmt: skip

_HELPERS = r"""
static uint64_t seed = SEED;

static uint64_t bits(void)
{
    seed ^= seed << 13;
    seed ^= seed >> 7;
    seed ^= seed << 17;
    return seed;
}

static double share(void) { return (double)(bits() >> 11) / 9007199254740992.0; }

static int mood; /* what numbers are like for some time: 0 is a good loop */
static double spread; /* of their sizes [decades] */
static double plant, slope; /* of the loop: position and its change in a sample */

static REAL any_bits(void)
{
    const uint64_t drawn = bits();
    REAL value;
    memcpy(&value, &drawn, sizeof value);
    return value;
}

static REAL hostile(void)
{
    static const REAL special[] = {
        (REAL)0.0, (REAL)-0.0, (REAL)1.0, (REAL)NAN, (REAL)INFINITY, (REAL)-INFINITY, REAL_MAX,
        -REAL_MAX, REAL_MIN, (REAL)1e12, (REAL)-1.0001e12, (REAL)1e30, (REAL)-1e30,
        (REAL)2147483648.0, (REAL)-2147483649.0, (REAL)4294967296.0, (REAL)1e-30, (REAL)0.5 };
    switch (mood == 5 ? (int)(bits() % 4) + 1 : mood) {
    case 1:
        return any_bits();
    case 2:
        return special[bits() % (sizeof special / sizeof special[0])];
    case 3: { /* all sizes */
        const REAL size = (REAL)pow(10.0, (share() - 0.5) * spread);
        return bits() & 1 ? size : -size;
    }
    case 4: { /* the number before, a little changed */
        static REAL last = (REAL)1.0;
        last = last * (REAL)(1.0 + 0.2 * (share() - 0.48));
        if (!(fabs((double)last) < 1e30 && fabs((double)last) > 1e-30))
            last = (REAL)1.0;
        return last;
    }
    case 6: { /* the largest that can be, and none */
        static const REAL ends[] = { LARGEST, -LARGEST, (REAL)NAN };
        return ends[bits() % 3];
    }
    default:
        return (REAL)(8.0 * (share() - 0.5));
    }
}

static void change_mood(void)
{
    static const double spreads[] = { DIGITS, 0.4 * DIGITS, 0.1 * DIGITS, 4.0 };
    mood = (int)(bits() % 7);
    spread = spreads[bits() % 4];
}

static REAL reference(void)
{
    return mood == 0 ? (REAL)(bits() % 512 ? 0.5 : 4.0 * (share() - 0.5)) : hostile();
}

static REAL measurement(void)
{
    if (mood == 0)
        return (REAL)(plant + 1e-3 * (share() - 0.5));
    return bits() % 8 ? hostile() : (REAL)plant;
}

static void advance(REAL u) /* a plant of order 2 with damping under a sinusoidal load */
{
    static double time;
    time += SAMPLE_TIME;
    slope += SAMPLE_TIME * (1.5 * (double)u + sin(0.8 * time) - slope);
    plant += SAMPLE_TIME * slope;
    if (!(fabs(plant) < 1e6))
        plant = slope = 0.0;
}

static unsigned long not_finite, beyond;
static uint64_t trace = UINT64_C(0xcbf29ce484222325); /* of all results, by FNV-1a */

static void note(uint64_t value)
{
    trace = (trace ^ value) * UINT64_C(0x100000001b3);
}

static int finite_bits(REAL u)
{
    BITS pattern;
    memcpy(&pattern, &u, sizeof pattern);
    return (pattern & EXPONENT) != EXPONENT;
}

static void note_real(REAL value)
{
    BITS pattern = 0;
    if (value == value) /* the sign of a NaN is the compiler's */
        memcpy(&pattern, &value, sizeof pattern);
    note(pattern);
}

static void check(const NAME_state *state, REAL u)
{
    note_real(u);
    note((uint64_t)NAME_status(state));
    not_finite += !finite_bits(u);
    LIMITS_CHECK
}

static void check_copy(const NAME_state *state)
{
    NAME_state copy = *state;
    const REAL r = reference(), y = measurement();
    note((uint64_t)NAME_status(state));
    check(&copy, NAME_step(&copy, r, yHOSTILE_DERIVATIVES));
}
"""

_IMAGES = r"""
static unsigned char image[MEMORY_SIZE], before[MEMORY_SIZE];

static void put_check(void) /* for images that pass, whatever is in them */
{
    uint64_t found = UINT64_C(14695981039346656037);
    for (int at = 0; at < (int)sizeof image - 8; at += 4) {
        uint64_t word = 0;
        for (int i = 3; i >= 0; i--)
            word = word << 8 | image[at + i];
        found = (found ^ word) * UINT64_C(1099511628211);
    }
    for (int i = 0; i < 8; i++)
        image[sizeof image - 8 + i] = (unsigned char)(found >> (8 * i));
}

static void load(NAME_state *state)
{
    const int kind = (int)(bits() % 4), numbers = ((int)sizeof image - 40) / (int)sizeof(REAL);
    size_t length = sizeof image;
    if (bits() & 1)
        NAME_save(state, image);
    put_check();
    if (kind == 1) { /* damaged: refused, with nothing changed */
        image[bits() % sizeof image] ^= (unsigned char)(1 + bits() % 255);
    } else if (kind == 2) { /* cut */
        length = bits() % sizeof image;
    } else if (kind == 3) { /* other numbers, with a check that is right */
        const bool in_row = bits() & 1; /* the largest, whose sums are no number */
        const uint64_t count = (uint64_t)numbers, first = bits() % count;
        for (uint64_t i = bits() % 8 + 1; i > 0; i--) {
            const REAL x = in_row ? (bits() & 1 ? REAL_MAX : -REAL_MAX)
                : bits() & 1 ? hostile() : (REAL)((int)(bits() % 2048) - 1024);
            const uint64_t at = (in_row ? first + i : bits()) % count;
            memcpy(image + 32 + sizeof x * at, &x, sizeof x);
        }
        put_check();
    }
    NAME_state copy = *state;
    const bool loaded = NAME_load(state, image, length, bits() & 1);
    not_finite += loaded && (kind == 1 || kind == 2);
    if (!loaded) {
        NAME_save(&copy, before);
        NAME_save(state, image);
        not_finite += memcmp(before, image, sizeof image) != 0;
    }
    note(loaded);
}
"""

_MAIN = r"""
int main(int count, char **arguments)
{
    static NAME_state controller;
    static NAME_parameters narrower, other; /* with another limit; with another law */
    NAME_state *const state = &controller;
    const unsigned long calls = count > 1 ? (unsigned long)atof(arguments[1]) : 1000000UL;

    narrower = NAME_default_parameters;
    NARROWER
    other = NAME_default_parameters;
    OTHER
    NAME_init(state);
    for (unsigned long k = 0; k < calls; k++) {
        if (bits() % (mood ? 2000 : 20000) == 0)
            change_mood();
        const uint32_t draw = (uint32_t)(bits() % 1000000);
        REAL u;
CASES        {
            u = NAME_step(state, reference(), measurement()DERIVATIVES);
            check(state, u);
            advance(u);
        }
    }
    printf("%lu %lu %016llx\n", not_finite, beyond, (unsigned long long)trace);
    return not_finite || beyond ? 2 : 0;
}
"""


def words_of_type(source: CSource, seed: int) -> dict[str, str]:
    """Return what stands for the words of the program that depend on name and precision."""
    name, single = source.name, source.precision == "single"
    return {
        "NAME": name,
        "REAL_MAX": "FLT_MAX" if single else "DBL_MAX",
        "REAL_MIN": "FLT_MIN" if single else "DBL_MIN",
        "REAL": source.real,
        "BITS": "uint32_t" if single else "uint64_t",
        "EXPONENT": "0x7f800000u" if single else "UINT64_C(0x7ff0000000000000)",
        "LARGEST": "1e12f" if single else "1e60",
        "DIGITS": "60.0" if single else "300.0",
        "MEMORY_SIZE": f"{name.upper()}_MEMORY_SIZE",
        "SAMPLE_TIME": f"{name.upper()}_SAMPLE_TIME",
        "SEED": f"UINT64_C({0x9E3779B97F4A7C15 + seed})",
    }


def hostile_program(controller: Any, source: CSource, seed: int = 1) -> str:
    """Return a program in C that calls all functions of an exported controller by chance.

    It takes the number of calls as its argument, prints how often u was no number and how often it
    was beyond its limits, and a hash of all u and flags. It ends with 0 if both numbers are 0.
    """
    name, path = source.name, limits_path(controller)
    drawn = ", hostile()" * source.derivatives
    unknown = set(source.operations) - {*CALLS, "init", "retune"}
    if unknown:
        raise ValueError(f"the program does not know {sorted(unknown)}")
    given = {
        "step_counts": "(int32_t)bits(), (int32_t)bits()DERIVATIVES",
        "applied": "hostile()",
        "track": "reference(), measurement(), hostile()DERIVATIVES",
        "start": "measurement(), hostile(), reference()",
        "set_held": "bits() % 4 == 0",
    }
    cases, at = [], 0
    for operation, part in SHARES.items():
        if operation not in source.operations:
            continue
        at += part
        arguments = f", {given[operation]}" if operation in given else ""
        call = f"{name}_{operation}(state{arguments.replace('DERIVATIVES', drawn)});"
        if operation == "retune":
            chosen = f"bits() & 1 ? &narrower : bits() & 1 ? &other : &{name}_default_parameters"
            call = f"{name}_retune(state, {chosen});"
        lines = [call]
        if operation in RETURN_U:
            if operation == "step_counts":  # the position of a good loop is no count by chance
                step = f"{name}_step(state, reference(), measurement(){drawn})"
                call = f"mood ? {call[:-1]} : {step};"
            lines = [f"u = {call}", "check(state, u);"]
        elif operation == "get_estimate":
            channels = [
                f"known.{channel}{f'[{i}]' if width > 1 else ''}"
                for channel, width in source.channels
                for i in range(width)
            ]
            lines = [f"const {name}_estimate known = {call}"]
            lines += [f"note_real((REAL){each});" for each in channels]
        elif operation == "stopping_point":
            lines = [f"note_real({call[:-1]});"]
        elif operation == "save":
            lines = [f"{name}_save(state, image);", "note(image[sizeof image - 8]);"]
        elif operation == "load":
            lines = ["load(state);", "check_copy(state);"]
        elif operation == "status":
            lines = [f"note((uint64_t){call[:-1]});"]
        else:
            lines.append("check_copy(state);")
        body = "\n".join(f"            {line}" for line in lines)
        cases.append(f"        if (draw < {at}) {{\n{body}\n        }} else\n")
    missing = set(source.operations) - {*SHARES, "init", "step"}
    if missing:
        raise ValueError(f"the program does not call {sorted(missing)}")
    narrower = narrower_limits(controller, path, source.precision)
    inside = path.removesuffix("limits")
    others = [
        f"other.{inside}{member} {change};"
        for member, change, field in (
            ("b0", "*= (REAL)1.25", r"\bb0;"),
            ("cancel[0]", "+= (REAL)0.5", r"\bcancel\["),
            ("cancel[1]", "-= (REAL)0.25", r"\bcancel\[[2-9]"),
        )
        if path and re.search(field, source.header)
    ]
    words = {
        "OTHER": "\n    ".join(others),
        **words_of_type(source, seed),
        "LIMITS_CHECK": f"beyond += u < state->parameters->{path}.low || "
        f"u > state->parameters->{path}.high;" if path else "(void)beyond;",
        "NARROWER": "".join(f"narrower.{path}.high = {limit};" for _, limit in narrower),
        "HOSTILE_DERIVATIVES": drawn,
        "DERIVATIVES": drawn,
    }  # fmt: skip
    text = _HELPERS + _IMAGES + _MAIN.replace("CASES", "".join(cases))
    for word, value in words.items():
        text = text.replace(word, value)
    headers = ("float.h", "math.h", "stdint.h", "stdio.h", "stdlib.h", "string.h")
    includes = "".join(f"#include <{each}>\n" for each in headers)
    return f'#include "{name}.h"\n\n{includes}{text}'


def exported_source(controller: Any, single: bool) -> tuple[Any, CSource]:
    """Return a controller in a precision and its code, with counts where these are possible."""
    shown = in_single_precision(controller) if single else controller
    try:
        return shown, ql.export.c_source(shown, "servo", resolution=1e-4)
    except ValueError:  # it needs the position itself
        return shown, ql.export.c_source(shown, "servo")


def built(
    folder: Path, controller: Any, source: CSource, seed: int = 1, sanitizer: str = "address"
) -> Path:
    """Compile the hostile program of a controller with a sanitizer; return the program."""
    return compiled(folder, source, hostile_program(controller, source, seed), sanitizer)


def compiled(folder: Path, source: CSource, program: str, sanitizer: str) -> Path:
    """Compile a program around exported code with a sanitizer; return the program."""
    (folder / f"{source.name}.h").write_text(source.header, encoding="utf-8")
    (folder / f"{source.name}.c").write_text(source.source, encoding="utf-8")
    (folder / "hostile.c").write_text(program, encoding="utf-8")
    command = [
        *SANITIZERS[sanitizer],
        *FLAGS,
        "hostile.c",
        f"{source.name}.c",
        "-o",
        "hostile",
        "-lm",
    ]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr[:2000])
    return folder / "hostile"


def run(program: Path, calls: float, longest: float = 7200.0) -> tuple[str, str, str]:
    """Run a hostile program; return reports, u that are not finite, and u beyond the limits."""
    return traced(program, calls, longest)[:3]


def traced(program: Path, calls: float, longest: float = 7200.0) -> tuple[str, str, str, str]:
    """Return the results of ``run``, and the hash of all u and flags."""
    done = subprocess.run(
        [program, f"{calls:.0f}"], capture_output=True, text=True, check=False, timeout=longest
    )
    if done.returncode in (0, 2) and done.stdout:
        not_finite, beyond, trace = done.stdout.split()
        return "0", not_finite, beyond, trace
    said = done.stderr.splitlines()
    lines = [line for line in said if "rror" in line or "WARNING" in line] or ["no output"]
    return f"1: {lines[0][-120:]}", "", "", ""


def row_of(name: str, controller: Any, precision: str, options: argparse.Namespace) -> list[str]:
    """Return a row of the table."""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as place:
        try:
            shown, source = exported_source(controller, precision == "single")
            program = built(Path(place), shown, source, options.seed, options.sanitizer)
            found = run(program, options.calls)
        except ValueError as error:  # in Python
            return [name, precision, "refused", "", "", "", "", str(error)[:60]]
    seconds = f"{time.monotonic() - begin:.0f}"
    return [name, precision, f"{len(source.operations)}", f"{options.calls:g}", *found, seconds]


def is_good(cells: list[str]) -> bool:
    """Return whether a row has no report and no bad u."""
    return cells[2] == "refused" or cells[4:7] == ["0", "0", "0"]


def main() -> None:
    """Run the rows and print a table."""
    from exported import cases, chosen_rows, counted, shown_rows

    parser = parser_of(__doc__)
    parser.add_argument("--calls", type=float, default=1e7, help="calls of each row")
    parser.add_argument("--rows", default="", help="controllers whose name has this text")
    parser.add_argument("--precision", choices=("double", "single"), help="one precision only")
    parser.add_argument("--part", type=part_of, default="1/1", help="K/N: each N-th row from K on")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sanitizer", choices=tuple(SANITIZERS), default="address")
    parser.add_argument("--results", type=Path, help="file of rows that are ready")
    options = options_of(parser, calls=2000, rows="PPI", precision="double")
    check_present(options, tools=[SANITIZERS[options.sanitizer][0]])
    warnings.simplefilter("ignore")
    rows = chosen_rows(cases(), options.rows, options.part, options.precision)
    done = shown_rows(rows, HEADS, partial(row_of, options=options), options.results)
    bad = sum(not is_good(cells) for cells in done)
    print(f"{bad} rows have a report or a bad u" if bad else "no report, no bad u")
    write(options, {"bad rows": bad, **counted(HEADS, done)})
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
