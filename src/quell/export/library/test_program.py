"""The C program that compares a controller with golden vectors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quell.export.c_files import CSource
from quell.export.library.loop import BLOCK, c_code
from quell.export.library.templates import filled
from quell.export.library.vectors import Action, Vectors
from quell.export.translate.literals import Literals

# The largest differences of 16 controllers on emulated Cortex-M processors with newlib and FMA were
# 25 ulp without a learner that acts, and 1930 ulp with one, whose loop enlarges them.
_TOLERANCE, _TOLERANCE_LEARNING = 64.0, 4096.0
TOLERANCE_REASON = """With -ffp-contract=off the difference is
zero, but for functions such as sin that differ between C libraries; with FMA it is some ulps,
and more where a learner acts in a loop."""

# What the program does before the step in a sample of each kind; NAME is the controller's.
_CODE = {
    Action.APPLIED: ("NAME_applied(state, now->given);",),
    Action.TRACK: ("return NAME_track(state, now->r, now->y, now->givenDERIVATIVES);",),
    Action.HAND_OVER: ("NAME_hand_over(state);",),
    Action.LIMIT: (
        "*limited = NAME_default_parameters;",
        "limited->PATH.high = LIMIT;",
        "NAME_retune(state, limited);",
    ),
    Action.FREE: ("NAME_retune(state, &NAME_default_parameters);",),
    Action.RESET: ("NAME_reset(state);",),
    Action.START: ("NAME_start(state, now->y, now->given, now->r);",),
    Action.LEARN: ("return play_loop(state);",),
}


def test_program(source: CSource, vectors: Vectors) -> str:
    """Return the text of ``test_NAME.c``."""
    single = source.precision == "single"
    write = Literals(single).write_real
    # In each step the derivatives of the reference are half the reference.
    derivatives = f", {write(0.5)} * now->r" * source.derivatives
    used = [action for action in Action if any(row.action == action for row in vectors.rows)]
    limits = Action.LIMIT in used
    cases: list[str] = []
    for action in used:
        lines = _CODE.get(action, ())
        if lines:
            cases.append(f"    case {action.name}:")
            cases += [f"        {line.strip()}" for line in lines]
            cases += [] if lines[-1].startswith("return") else ["        break;"]
    text = "\n".join(cases).replace("NAME", source.name).replace("PATH", vectors.limit_path)
    text = text.replace("DERIVATIVES", derivatives)
    limit = write(vectors.limit) if limits else ""
    rows = (
        f"    {{{row.action.name}, {write(row.r)}, {write(row.y)}, {write(row.given)}, "
        f"{write(row.u)}, {row.status}}},"
        for row in vectors.rows
    )
    parameters = f"{source.name}_parameters"
    blocks = sum(row.action is Action.LEARN for row in vectors.rows)
    return filled("test.c", {
        "name": source.name,
        "precision": source.precision,
        "real": source.real,
        "epsilon": "FLT_EPSILON" if single else "DBL_EPSILON",
        "scale": repr(vectors.scale),
        "digits": 9 if single else 17,
        "actions": ", ".join(action.name for action in used),
        "rows": "\n".join(rows),
        "expected": "\n".join(_expected(source, vectors)),
        "found": ",\n        ".join(f"(real)estimate.{place}" for place, *_ in _places(source)),
        "cases": text.replace("LIMIT;", f"{limit};"),
        "limited_parameter": f", {parameters} *limited" if limits else "",
        "limited_variable": f"    static {parameters} limited;\n" if limits else "",
        "limited_argument": ", &limited" if limits else "",
        "derivatives": derivatives,
        "loop": c_code(vectors.plant, write, "real", source) if vectors.plant else "",
        "samples": f"count + {blocks * (BLOCK - 1)}" if blocks else "count",
        "tolerance": repr(_TOLERANCE_LEARNING if vectors.plant else _TOLERANCE),
        "tolerance_reason": TOLERANCE_REASON.replace("\n", "\n * "),
    })  # fmt: skip


def _places(source: CSource) -> Iterator[tuple[str, int, slice]]:
    """Yield the members of the estimate that are compared, their place, and their channel's."""
    at = 0
    for channel, width in source.channels:
        if channel != "status":
            for i in range(width):
                yield f"{channel}[{i}]" if width > 1 else channel, at + i, slice(at, at + width)
        at += width


def _expected(source: CSource, vectors: Vectors) -> Iterator[str]:
    """Yield the lines of the estimate: name, value, and the largest size in its channel."""
    write = Literals(source.precision == "single").write_real
    row = vectors.estimate
    for place, at, part in _places(source):
        size = float(np.max(np.abs(np.where(np.isfinite(row[part]), row[part], 0.0))))
        yield f'    {{"{place}", {write(row[at])}, {size!r}}},'
