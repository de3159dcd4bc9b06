"""A tuned controller as a setup file in TOML."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from quell.plants.delay import delayed
from quell.plants.linear import LinearPlant
from quell.types import Matrix

# A comment may have none of them, and a tab is of no use there.
_CONTROL = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")


def toml_text(tables: Mapping[str, Any], comment: str = "") -> str:
    """Return a TOML file with top-level keys and tables; ``comment`` lines stand first.

    Numbers are written in full precision. Tables within tables are written inline.
    """
    lines = [f"# {_CONTROL.sub(' ', line)}" for line in comment.splitlines()]
    plain = {key: value for key, value in tables.items() if not isinstance(value, Mapping)}
    listed = {
        key: value
        for key, value in plain.items()
        if isinstance(value, list | tuple)
        and value
        and all(isinstance(each, Mapping) for each in value)
    }
    lines += [f"{_key(key)} = {_value(value)}" for key, value in plain.items() if key not in listed]
    for key, value in tables.items():
        if isinstance(value, Mapping):
            lines += ["", f"[{_key(key)}]"]
            lines += [f"{_key(name)} = {_value(part)}" for name, part in value.items()]
    for key, entries in listed.items():
        for entry in entries:
            lines += ["", f"[[{_key(key)}]]"]
            lines += [f"{_key(name)} = {_value(part)}" for name, part in entry.items()]
    return "\n".join(lines).strip() + "\n"


def _key(name: str) -> str:
    bare = name.isascii() and re.fullmatch(r"[\w-]+", name) is not None
    return name if bare else _text(name)


def _text(value: str) -> str:
    # TOML has the escapes of JSON; it wants them for DEL, too, and halves of surrogate pairs are no
    # text in UTF-8.
    valid = value.encode("utf-8", "replace").decode("utf-8")
    return json.dumps(valid, ensure_ascii=False).replace("\x7f", "\\u007F")


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _text(value)
    if value is None:
        return '"none"'
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple | np.ndarray):
        return "[" + ", ".join(_value(part) for part in value) + "]"
    if isinstance(value, int | np.integer):
        return str(int(value))
    return repr(float(value))


def plant_table(
    linear: LinearPlant, actuator_lag: float, delay: float, dt: float
) -> tuple[dict[str, Any], int]:
    """Return the table of a linear plant behind a lag and a delay [s] of u, sampled at ``dt`` [s].

    Beside it, how many states lag and delay append, which are u at rest.
    """
    if actuator_lag > 0.0:
        n = linear.order
        A = np.block([[linear.A, linear.B], [np.zeros((1, n)), np.full((1, 1), -1 / actuator_lag)]])
        B = np.append(np.zeros(n), 1.0 / actuator_lag)
        E = np.vstack([linear.E, np.zeros((1, linear.disturbances))])
        linear = LinearPlant(A, B, np.append(linear.C[0], 0.0), E)
    table: dict[str, Any] = {
        "kind": "linear",
        "A": _rows(linear.A),
        "B": linear.B[:, 0].tolist(),
        "C": linear.C[0].tolist(),
        "E": _rows(linear.E),
    }
    appended = int(actuator_lag > 0.0)
    if delay == 0.0:
        return table, appended
    appended += delayed(linear, delay, dt).order - linear.order
    return {"kind": "delayed", "plant": table, "delay": delay}, appended


def _rows(matrix: Matrix) -> list[list[float]]:
    found: list[list[float]] = matrix.tolist()
    return found
