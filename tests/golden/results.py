"""Results of tuning, identification and the command line, as trees of numbers and texts.

Of what is computed the numbers that a user reads are stored, and the lines that begin with NOT:
these are verdicts, which stay as they are. Long lists, such as simulated outputs, are left out.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import random
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from quell import identification, tuning
from quell.files import nonfinite_to_none

from .corpus import made
from .loops import inputs

_LONGEST = 16

CALLS: dict[str, Callable[..., Any]] = {
    "tune": tuning.tune,
    "tune_axes": lambda plant, axes, **given: tuning.tune(plant, controller=axes, **given),
    "tune_compensator": tuning.tune_compensator,
    "tune_schedule": tuning.tune_schedule,
    "identify": identification.identify,
    "identify_b0": identification.identify_b0,
    "identify_b0_by": identification.identify_b0_by,
    "identify_b0_matrix": identification.identify_b0_matrix,
    "frequency_response": lambda **given: identification.frequency_response(**given)._asdict(),
    "excitation": identification.excitation,
}
"""What a case of ``tuned`` or ``identified`` calls."""


def short(value: Any) -> Any:
    """Return a tree of numbers and texts, of ten digits, without long lists."""
    if hasattr(value, "to_json"):
        return short(value.to_json())
    if isinstance(value, Mapping):
        return {str(key): short(part) for key, part in value.items()}
    if hasattr(value, "_asdict"):
        return short(value._asdict())
    if isinstance(value, complex):
        return [short(value.real), short(value.imag)]
    if isinstance(value, np.ndarray) and value.ndim == 1 and len(value) > _LONGEST:
        return {"entries": len(value), "some": [short(v) for v in value[:: len(value) // 5]]}
    if isinstance(value, list | tuple | np.ndarray):
        if len(value) > _LONGEST:
            return f"{len(value)} entries"
        return [short(part) for part in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        number = nonfinite_to_none(value)
        return number if number is None else float(f"{number:.10g}")
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def verdicts(text: str) -> list[str]:
    """Return the lines that begin with NOT, with single spaces."""
    lines = [" ".join(line.split()) for line in text.splitlines()]
    return [line for line in lines if line.startswith("NOT")]


# ---- Tuning and identification ----


def _selected(tree: Any, paths: list[str]) -> Any:
    """Return some branches of a tree, by their paths."""
    found = {}
    for path in paths:
        part = tree
        for key in path.split("."):
            part = part[int(key)] if isinstance(part, list) else (part or {}).get(key)
        found[path] = part
    return found


def tune_case(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the result of a tuning: its numbers and its verdicts."""
    arguments = made(case["arguments"])
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            found = CALLS[case["call"]](**arguments)
        except ValueError as error:
            return {"refused": str(error)}
    tree = short(found)
    if "keys" in case:
        tree = _selected(tree, case["keys"])
    texts = sorted({" ".join(str(each.message).split()) for each in warned})
    return {"result": tree, "nots": verdicts(str(found)), "warnings": texts}


def record_of(
    num: Any,
    den: Any,
    dt: float,
    samples: int,
    noise: float = 0.0,
    seed: int = 1,
    delay: int = 0,
    friction: float = 0.0,
    hold: int = 5,
) -> tuple[np.ndarray, np.ndarray]:
    """Return u and y of a plant under random steps, sampled exactly but for the friction."""
    A, B, C, _, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(num, den), dt)
    draw = random.Random(seed)
    x, u, y, level = np.zeros((A.shape[0], 1)), np.zeros(samples), np.zeros(samples), 0.0
    for k in range(samples):
        if k % hold == 0:
            level = draw.choice([-1.0, 1.0])
        u[k] = level
        late = u[k - delay] if k >= delay else 0.0
        y[k] = (C @ x).item() + noise * draw.gauss(0.0, 1.0)
        push = late - friction * np.sign(x[0, 0]) if friction else late
        x = A @ x + B * push
    return u, y


def identify_case(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the result of an identification of a made record."""
    arguments, dt = made(case["arguments"]), case["arguments"].get("dt")
    if "record" in case:
        record = dict(case["record"])
        mixed, plants = record.pop("mixed", None), record.pop("plants", None)
        if plants is None:
            arguments["u"], arguments["y"] = record_of(dt=dt, **record)
        else:
            pairs = [
                record_of(dt=dt, **{**record, **each, "seed": i + 1})
                for i, each in enumerate(plants)
            ]
            arguments["u"] = np.stack([u for u, _ in pairs], axis=1)
            arguments["y"] = np.stack([y for _, y in pairs], axis=1) @ np.array(mixed)
    if "signal" in case:
        arguments["signal"] = inputs(len(arguments["u"]), 1, case["signal"])[:, 0]
    return tune_case({**case, "arguments": arguments}, folder)


# ---- The command line ----


def _write_record(path: Path, columns: list[str], record: Mapping[str, Any]) -> None:
    """Write a made record as CSV; its reference, if it has that column, is zero."""
    u, y = record_of(**record)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for k in range(len(u)):
            row = [f"{k * record['dt']:.9g}", f"{u[k]:.9g}", f"{y[k]:.9g}"]
            writer.writerow([*row, *["0"] * (len(columns) - 3)])


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    before, columns = Path.cwd(), os.environ.get("COLUMNS")
    os.chdir(folder)
    os.environ["COLUMNS"] = "100"
    try:
        yield
    finally:
        os.chdir(before)
        os.environ.pop("COLUMNS")
        if columns is not None:
            os.environ["COLUMNS"] = columns


def command(*arguments: str) -> tuple[int, str, str]:
    """Run the command in this process; return exit code, output and errors."""
    from quell.cli import app as cli

    out, err, whole, code = io.StringIO(), io.StringIO(), cli.app, 0
    before = sys.argv
    try:
        cli.app = lambda: whole([*arguments])  # type: ignore[assignment]
        sys.argv = ["quell", *arguments]
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            cli.main()
    except SystemExit as ended:
        code = int(ended.code or 0)
    finally:
        cli.app, sys.argv = whole, before
    return code, out.getvalue(), err.getvalue()


def command_case(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return what some commands do, one after another in a folder: codes, verdicts, results."""
    for name, content in case.get("files", {}).items():
        if isinstance(content, str):
            (folder / name).write_text(content, encoding="utf-8")
        else:
            columns = content.get("columns", ["t", "u", "y"])
            parts = {key: value for key, value in content.items() if key != "columns"}
            _write_record(folder / name, columns, parts)
    found: dict[str, Any] = {}
    with _inside(folder):
        for line in case["commands"]:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                code, out, err = command(*line)
            errors = [each for each in err.splitlines() if each.startswith("quell: ")]
            found[" ".join(line)] = {
                "code": code,
                "nots": verdicts(out),
                "errors": [each for each in errors if "compil" not in each and code],
            }
    for name in case.get("results", ()):
        tree = short(json.loads((folder / name).read_text()))
        found[name] = _selected(tree, case["keys"]) if "keys" in case else tree
    made_files = {
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()
    }
    found["files"] = sorted(made_files - set(case.get("files", {})) - {"run.nc"})
    return found
