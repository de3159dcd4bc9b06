"""The files of a proof: a program that does everything, a contract, and a script."""

from __future__ import annotations

import math
import shlex
from importlib import resources
from typing import Any

from quell.export.c_files import CSource
from quell.export.inspection import at_path, limits_path, parameters_of
from quell.export.translate.literals import Literals

FOLDER = "proof"
"""The folder of these files."""
PROPERTIES = "properties.csv"
"""The file with all that Frama-C has looked at."""

# One set of intervals at each place of the code, and short loops pass by pass: so arrays that they
# fill are known to be filled. Level 1 took four times as long and proved no more. Results that are
# infinite or no number are no alarm by themselves.
_OPTIONS = (
    *("-eva", "-eva-precision", "0", "-eva-auto-loop-unroll", "64"),
    *("-warn-special-float", "none", "-machdep", "gcc_x86_64"),
)

CALLS = {
    "step": "any_real, any_realDERIVATIVES",
    "step_counts": "any_count, any_countDERIVATIVES",
    "applied": "any_real",
    "track": "any_real, any_real, any_realDERIVATIVES",
    "hand_over": "",
    "start": "any_real, any_real, any_real",
    "reset": "",
    "status": "",
    "get_estimate": "",
    "stopping_point": "",
}
"""Arguments of the functions, each call with other numbers; without ``init`` and ``retune``."""
RETURN_U = {"step": "REAL r, REAL y", "step_counts": "int32_t r, int32_t count",
             "track": "REAL r, REAL y, REAL u"}  # fmt: skip
"""Functions that return u, and their arguments but for derivatives of the reference."""


def frama_c_options(name: str) -> tuple[str, ...]:
    """Return the arguments of frama-c, in the folder of the proof."""
    sources = (f"../src/{name}.c", f"{name}_proof.c")
    return (*_OPTIONS, "-cpp-extra-args=-I../src", *sources, "-then", "-report-csv", PROPERTIES)


def proof_files(controller: Any, source: CSource) -> dict[str, str]:
    """Return the text of the files of a proof by path.

    Raises
    ------
    ValueError
        for a controller that calls functions of the user in C: nothing is known of them.
    """
    if source.externals:
        names = ", ".join(source.externals)
        raise ValueError(
            f"proof = True: the controller calls {names}, which is in C and which the proof can't "
            "see; leave the proof out, or the c_function: then its translation is proved, too"
        )
    name, path = source.name, limits_path(controller)
    options = shlex.join(frama_c_options(name))
    script = (resources.files(__package__) / "templates" / "prove.sh").read_text("utf-8")
    return {
        f"{FOLDER}/{name}_contract.h": _contract(source, path),
        f"{FOLDER}/{name}_proof.c": _program(controller, source, path),
        f"{FOLDER}/prove.sh": script.replace("@name@", name).replace("@options@", options),
    }


def _contract(source: CSource, path: str) -> str:
    """Return the declarations of the functions that return u, with what they promise."""
    name, upper = source.name, source.name.upper()
    more = "".join(f", {source.real} r{i + 1}" for i in range(source.derivatives))
    limits = f"state->parameters->{path}"
    promises = ["ensures a_number: \\is_finite(\\result);"]
    if path:
        promises.append(f"ensures within_limits: {limits}.low <= \\result <= {limits}.high;")
    lines = [
        f"/* What {name} promises, in ACSL: u is a number within the limits, for any arguments.",
        " *",
        " * A program with this header in place of the other one can be checked against it. */",
        f"#ifndef {upper}_CONTRACT_H",
        f"#define {upper}_CONTRACT_H",
        "",
        f'#include "{name}.h"',
    ]
    for operation, given in RETURN_U.items():
        if operation in source.operations:
            arguments = f"{name}_state *state, {given}{more}".replace("REAL", source.real)
            lines += [
                "",
                "/*@ requires a_state: \\valid(state) && \\valid_read(state->parameters);",
                *(f"    {each}" for each in promises),
                "*/",
                f"{source.real} {name}_{operation}({arguments});",
            ]
    return "\n".join([*lines, "", "#endif", ""])


def _program(controller: Any, source: CSource, path: str) -> str:
    """Return the program that calls all functions in any order, with any numbers."""
    name, real = source.name, source.real
    more = ", any_real" * source.derivatives
    cases: list[str] = []
    for i, (operation, given) in enumerate(CALLS.items()):
        if operation in source.operations:
            arguments = "".join(f", {each}" for each in [given] if each)
            call = f"{name}_{operation}(state{arguments.replace('DERIVATIVES', more)});"
            cases += [f"        case {i}:", f"            {call}", "            break;"]
    counts = "step_counts" in source.operations
    narrower = narrower_limit(controller, path, source.precision == "single")
    retuning = [
        f"    narrower = {name}_default_parameters;",
        *([f"    narrower.{path}.high = {narrower};"] if narrower else []),
        "    while (any_int) {",
        f"        {name}_retune(&controller, &narrower);",
        "        operate(&controller);",
        f"        {name}_retune(&controller, &{name}_default_parameters);",
        "        operate(&controller);",
        "    }",
    ]
    return "\n".join([
        f"/* All that a program can do with {name}: every function, in any order, for ever, with",
        " * any numbers, also infinities and NaN. Each read of a volatile variable is another. */",
        f'#include "{name}_contract.h"',
        "",
        f"static volatile {real} any_real;",
        "static volatile int any_int;",
        *(["static volatile int32_t any_count;"] if counts else []),
        f"static {name}_state controller;",
        f"static {name}_parameters narrower;",
        "",
        f"static void operate({name}_state *state)",
        "{",
        "    while (any_int) {",
        "        switch (any_int) {",
        *cases,
        "        default:",
        "            break;",
        "        }",
        "    }",
        "}",
        "",
        "int main(void)",
        "{",
        f"    {name}_init(&controller);",
        "    operate(&controller);",
        *retuning,
        "    return 0;",
        "}",
        "",
    ])  # fmt: skip


def narrower_limit(controller: Any, path: str, single: bool) -> str:
    """Return an upper limit below that of the controller, as C code; nothing without limits."""
    if not path:
        return ""
    limits = at_path(parameters_of(controller), path)
    low, high = float(limits.low), float(limits.high)
    write = Literals(single).write_real
    if math.isfinite(low) and math.isfinite(high):
        return write(0.5 * low + 0.5 * high)
    if math.isfinite(low):
        return write(low + 1.0 + abs(low))
    return write(high - 1.0 - abs(high) if math.isfinite(high) else 1.0)
