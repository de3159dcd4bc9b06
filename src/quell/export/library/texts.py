"""The files around an exported controller: project files, description and example."""

from __future__ import annotations

from typing import Any

from quell.export.c_files import CSource
from quell.export.inspection import in_double_precision, limits_path
from quell.export.library.templates import filled
from quell.export.library.test_program import TOLERANCE_REASON, test_program
from quell.export.library.vectors import Vectors

# Calls of the functions, and when they belong there; s is &state.
_OPERATIONS = {
    "init": ("init(s)", "once, before all others"),
    "start": ("start(s, y, u, r)", "the plant rests at y under u; long: before the timer starts"),
    "step": ("step(s, r, yDERIVATIVES)", "each sample; returns u"),
    "step_counts": (
        "step_counts(s, r, countDERIVATIVES)",
        "instead of the step, with r and y as encoder counts; without rounding of the position",
    ),
    "applied": ("applied(s, u)", "after the step, if another u was applied"),
    "track": ("track(s, r, y, uDERIVATIVES)", "instead of the step in manual operation, under u"),
    "hand_over": (
        "hand_over(s)",
        "once, before the first step after manual operation; false before the first sample",
    ),
    "retune": ("retune(s, &parameters)", "between two samples: other parameters, without a jump"),
    "reset": ("reset(s)", "from rest at the next sample; what was learned is kept"),
    "stopping_point": (
        "stopping_point(s)",
        "after the step: where the move can stop soonest; as r of the next steps it stops there",
    ),
    "status": ("status(s)", "after the step: flags, see the enum in the header"),
    "get_estimate": ("get_estimate(s)", "after the step: what the controller knows, for telemetry"),
}
_RETUNING = """## Other limits

Parameters are constants. To change a limit while running, change a copy:

```c
static NAME_parameters derated;

derated = NAME_default_parameters;
derated.PATH.high = ONE;
NAME_retune(&state, &derated); /* the copy must stay in memory, unchanged while it is in use */
```
"""
_EXTERNALS = """## Your functions

The controller calls functions that you have to link: FUNCTIONS. `src/NAME.c` declares them.

"""
_DOUBLE = """- `double` must have 8 bytes; where it has 4 (AVR) the file refuses to compile. A
  processor without a unit for double (Cortex-M4F) needs about twenty times as long as for single
  precision.

"""

_ONE_WORD = (
    "volatile float reference; "
    "/* the main loop writes it; one word, so that no half of it is read */"
)
_FED_FORWARD = """The controller feeds PRIMES of the reference forward, so they are arguments of
`NAME_step`. They belong to the same move as r: take all of them from one formula (`next_reference`
below), never from differences of r. At rest they are zero.
"""
_MOVES = """`r` is a target: the controller moves its reference there within limits of speed,
acceleration and jerk, as quickly as they allow; a law with feedforward has the derivatives of the
move. A new target may come in any sample, also during a move. `r_shaped` of `NAME_get_estimate` is
the reference; it equals `r` when the move has ended. To stop as soon as the limits allow, call
`NAME_stopping_point` once and hand its number over as `r` from the next step on. Other limits act
at once, by `NAME_retune`: `prefilter.v_max`, `prefilter.a_max` and `prefilter.j_max` of the
parameters, all above zero.

"""


def library_files(controller: Any, source: CSource, vectors: Vectors) -> dict[str, str]:
    """Return the text of all files of the library by path.

    Parameters
    ----------
    controller
        the exported controller.
    source
        its C code.
    vectors
        a run of it.
    """
    name, single = source.name, source.precision == "single"
    one = "1.0f" if single else "1.0"
    given = "".join(f", r{i + 1}" for i in range(source.derivatives))
    rows = (
        f"| `{name}_{call.replace('DERIVATIVES', given)}` | {when} |"
        for operation, (call, when) in _OPERATIONS.items()
        if operation in source.operations
    )
    path = limits_path(controller)
    retuning = _RETUNING.replace("PATH", path).replace("ONE", one) if path else ""
    functions = ", ".join(f"`{each}`" for each in source.externals)
    externals = _EXTERNALS.replace("FUNCTIONS", functions) if functions else ""
    values = {
        "name": name,
        "NAME": name.upper(),
        "title": f"Controller {type(in_double_precision(controller)).__name__}",
        "precision": source.precision,
        "real": source.real,
        "one": one,
        "zero": "0.0f" if single else "0.0",
        "dt": repr(float(controller.dt)),
        **_reference_texts(source),
        "operations": "\n".join(rows),
        "fast_math": ", and so do the compensated sums" if single else "",
        "double": "" if single else _DOUBLE,
        "retuning": retuning.replace("NAME", name),
        "externals": externals.replace("NAME", name),
        "external_note": " # and your functions" if functions else "",
        "link": " YOUR_FILES" if functions else "",
        "tolerance_reason": TOLERANCE_REASON,
    }
    texts = ("CMakeLists.txt", "library.json", "library.properties", "README.md")
    return {
        f"src/{name}.h": source.header,
        f"src/{name}.c": source.source,
        f"test_{name}.c": test_program(source, vectors),
        f"examples/{name}/{name}.ino": filled("example.ino", values),
        **{each: filled(each, values) for each in texts},
    }


def _reference_texts(source: CSource) -> dict[str, str]:
    """Return the parts of the examples that make the reference of a sample."""
    count, real = source.derivatives, source.real
    zero = "0.0f" if source.precision == "single" else "0.0"
    if not count:
        moves = "stopping_point" in source.operations
        target = " /* target of the moves */" if moves else ""
        return {
            "about_reference": _MOVES.replace("NAME", source.name) if moves else "",
            "declared_reference": _ONE_WORD,
            "defined_reference": f"static {real} reference = {zero};{target}",
            "next_reference": "",
            "reference": "reference",
            "derivatives": "",
        }
    primes = ", ".join("r" + "'" * (i + 1) for i in range(count))
    about = _FED_FORWARD.replace("NAME", source.name).replace("PRIMES", primes)
    names = f"{real} r[{count + 1}]"
    return {
        "about_reference": about,
        "declared_reference": f"extern void next_reference({names}); /* r, {primes} */",
        "defined_reference": (
            f"/* Set r, {primes} of a sample: replace it by your move, with its derivatives. */\n"
            f"static void next_reference({names})\n{{\n"
            f"    for (int i = 0; i <= {count}; i++)\n        r[i] = {zero};\n}}"
        ),
        "next_reference": f"    {names};\n\n    next_reference(r);\n",
        "reference": "r[0]",
        "derivatives": "".join(f", r[{i + 1}]" for i in range(count)),
    }
