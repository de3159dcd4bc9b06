"""Recipes that make objects, stored results, and what is different.

A case is data: a *recipe* is a table with the key ``make``, whose other keys are the arguments, in
which other recipes may stand. ``MAKERS`` has what a name stands for: where a class gets another
name, one line here changes and the cases stay.

The file of a part has the reasons for which it was written, and its cases, each on a line: its
recipe, and what it gave (``stored``). Logs are compared by every bit. A log is stored as a hash of
each of its channels and of each quarter of its samples, so that a difference says where it is, and
with some numbers, so that it says how large it is. Where a ``why`` stands in a case its bits follow
from more than quell (a library of linear algebra, the processor's functions): the numbers are
compared instead, within ``CLOSE``.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import math
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial, reduce
from itertools import pairwise
from operator import add
from pathlib import Path
from typing import Any

import numpy as np
import scipy

import quell as ql
from quell import controllers, features, learners, plants, signals
from quell.controllers import baselines
from quell.controllers.single import in_single_precision
from quell.files import written_atomically
from quell.plants.registry import identified

from .functions import FUNCTIONS, Leaky, RunningMean

DATA = Path(__file__).parent / "data"
CLOSE = 1e-9
"""Largest difference of numbers, relative to the largest one of their channel."""

# ---- Recipes ----


def _public(folder: Any, prefix: str) -> dict[str, Callable[..., Any]]:
    return {prefix + name: getattr(folder, name) for name in folder.__all__}


MAKERS: dict[str, Callable[..., Any]] = {
    **_public(plants, "plants."),
    **_public(signals, "signals."),
    **_public(features, "features."),
    **_public(learners, "learners."),
    **_public(baselines, ""),
    **_public(controllers, ""),
    "ADRC.from_pid": ql.ADRC.from_pid,
    "Constraints": ql.tuning.Constraints,
    "ESO.cascade": ql.ESO.cascade,
    "ESO.kalman": ql.ESO.kalman,
    "ESO.model_based": ql.ESO.model_based,
    "ESO.model_free": ql.ESO.model_free,
    "ESO.nonlinear": ql.ESO.nonlinear,
    "ESO.state_space": ql.ESO.state_space,
    "Feedforward.of": ql.Feedforward.of,
    "Feedforward.rigid": ql.Feedforward.rigid,
    "Guard": ql.Guard,
    "LinearController.of": controllers.LinearController.from_transfer_function,
    "LinearPlant.of": plants.LinearPlant.of,
    "Notch": baselines.Notch.at,
    "PID.simc": baselines.PID.simc,
    "PID.simc_double_integrator": baselines.PID.simc_double_integrator,
    "Scenario": lambda **parts: with_rounded_signals(ql.Scenario(**parts)),
    "identified": identified,
    "model of a user": Leaky,
    "model in Python": RunningMean,
    "mass matrix of": lambda plant: plant.inertia,
    "single": in_single_precision,
    "sum": lambda of: reduce(add, of),
    "switch": lambda first, until, then: first.until(until, then=then),
    "tuple": lambda of: tuple(of),
    "function": lambda name, **bound: (
        partial(FUNCTIONS[name], **bound) if bound else FUNCTIONS[name]
    ),
}
"""What a name in a recipe stands for."""


def made(recipe: Any) -> Any:
    """Return the object that a recipe describes; anything else is itself."""
    if isinstance(recipe, Mapping):
        parts = {key: made(value) for key, value in recipe.items() if key != "make"}
        return MAKERS[recipe["make"]](**parts) if "make" in recipe else parts
    if isinstance(recipe, list):
        return [made(part) for part in recipe]
    return recipe


# ---- Designs without their last bits ----
#
# What a design computes by LAPACK, and a signal by the vector units of the processor, differs from
# machine to machine in its last bits. So parameters are rounded before a run: what the kernels do
# with them is compared by every bit, and what a design does by ``_DIGITS``.

_DIGITS = 10
# Below this share of the largest entry of an array a number is a rounding error.
_NOTHING = 1e-14


def _rounded_number(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _rounded_array(values: np.ndarray) -> np.ndarray:
    largest = np.max(np.abs(values), initial=0.0, where=np.isfinite(values))
    numbers = [
        _rounded_number(value) if not abs(value) < _NOTHING * largest else 0.0
        for value in values.ravel().tolist()
    ]
    return np.array(numbers, dtype=values.dtype).reshape(values.shape)


def rounded(value: Any, in_place: bool = False) -> Any:
    """Return parameters, or with ``in_place`` a state, whose numbers are rounded."""
    if isinstance(value, tuple):
        parts = [rounded(part, in_place) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if isinstance(value, np.ndarray) and value.dtype == np.float64:
        new = _rounded_array(value)
        if not in_place:
            return new
        value[...] = new
    if isinstance(value, float) and not in_place:
        return _rounded_number(value)
    return value


class Rounded(signals.Signal):
    """A signal whose values are rounded."""

    def __init__(self, signal: Any) -> None:
        object.__setattr__(self, "signal", signal)

    def evaluate(self, t: Any) -> Any:
        """Return the rounded values."""
        values = np.asarray(self.signal(t))
        return np.array([_rounded_number(v) for v in values.ravel().tolist()]).reshape(values.shape)

    def derivative(self) -> Rounded:
        """Return the derivative, rounded."""
        return Rounded(self.signal.derivative())

    def seeded(self, seed: int) -> Rounded:
        """Return the signal with seeded noise."""
        return Rounded(self.signal.seeded(seed))


def with_rounded_signals(scenario: Any) -> Any:
    """Return a scenario whose signals are rounded, but for the noise."""

    def all_of(given: Any) -> Any:
        if isinstance(given, list | tuple):
            return tuple(Rounded(signals.as_signal(each)) for each in given)
        return Rounded(signals.as_signal(given))

    names = ("reference", "disturbances", "schedule")
    return replace(scenario, **{name: all_of(getattr(scenario, name)) for name in names})


def with_rounded_design(part: Any) -> Any:
    """Return a plant or a controller that runs with rounded numbers."""
    if hasattr(part, "sampled"):
        sampled = part.sampled
        object.__setattr__(part, "sampled", lambda *given: rounded(sampled(*given)))
    else:
        initial_state = part.initial_state
        part.initial_state = lambda: _state_rounded(initial_state())
        part.parameters = rounded(part.parameters)
        part._use_state(part.initial_state())
    return part


def _state_rounded(state: Any) -> Any:
    rounded(state, in_place=True)
    return state


# ---- Files of a part ----


def file_of(part: str) -> Path:
    """Return the file of a part."""
    return DATA / f"{part}.json"


@cache
def read(part: str) -> dict[str, Any]:
    """Return the content of a part's file."""
    content: dict[str, Any] = json.loads(file_of(part).read_text())
    return content


def cases_of(part: str) -> list[dict[str, Any]]:
    """Return the cases of a part."""
    cases: list[dict[str, Any]] = read(part)["cases"]
    return cases


def write(part: str, content: Mapping[str, Any]) -> None:
    """Write a part's file, a line for each reason and for each case."""
    lines = {
        key: ",\n".join(json.dumps(each, ensure_ascii=False, sort_keys=False) for each in value)
        for key, value in content.items()
    }
    text = ",\n".join(f'"{key}": [\n{value}\n]' for key, value in lines.items())
    with written_atomically(file_of(part), overwrite=True) as path:
        path.write_text(f"{{\n{text}\n}}\n")
    read.cache_clear()


def reason_of(names: Sequence[str], reason: str) -> dict[str, Any]:
    """Return the entry for results that are written now."""
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "names": list(names),
        "reason": reason,
        "with": f"Python {platform.python_version()}, NumPy {np.__version__}, SciPy "
        f"{scipy.__version__}, {platform.machine()}",
    }


# ---- A log, stored and compared ----

_QUARTERS, _POINTS = 4, 8


def _bytes(values: Any) -> bytes:
    """Return the bits of numbers, little-endian; one pattern of bits for all NaN."""
    numbers = np.array(values, dtype="<f8")
    numbers[np.isnan(numbers)] = np.nan
    return numbers.tobytes()


def _digest(content: bytes, size: int = 16) -> str:
    return hashlib.sha256(content).hexdigest()[:size]


def _shown(values: Any) -> list[Any]:
    """Return numbers as they stand in a file: rounded, and a text for what is not finite."""
    return [
        float(f"{value:.12g}") if math.isfinite(value) else str(value)
        for value in np.ravel(values).tolist()
    ]


def points(samples: int, count: int) -> list[int]:
    """Return the samples whose numbers are stored: the last ones of equal parts."""
    return [max(samples * (i + 1) // count - 1, 0) for i in range(count)]


def numbers_at(log: Mapping[str, Any], count: int, names: Sequence[str]) -> dict[str, list[Any]]:
    """Return some channels of a log (samples, width) at some samples."""
    at = points(len(next(iter(log.values()))), count)
    return {name: _shown(np.atleast_1d(log[name])[at]) for name in names if name in log}


def outcome_of(log: Mapping[str, Any], status: int, numbers: bool = False) -> dict[str, Any]:
    """Return what is stored of a log: channels by name, each (samples,) or (samples, width).

    With ``numbers`` all channels have some, else only y and u.
    """
    samples = len(next(iter(log.values())))
    bounds = [samples * i // _QUARTERS for i in range(_QUARTERS + 1)]
    names = sorted(log)
    quarters = [
        _digest(b"".join(_bytes(log[name][first:last]) for name in names))
        for first, last in pairwise(bounds)
    ]
    return {
        "samples": samples,
        "status": status,
        "quarters": quarters,
        "channels": {name: _digest(_bytes(log[name]), 8) for name in names},
        "numbers": numbers_at(log, _POINTS, names if numbers else ("y", "u")),
    }


def differences(stored: Mapping[str, Any], now: Mapping[str, Any], why: str = "") -> list[str]:
    """Return what two outcomes of a log do not have in common; ``why`` numbers are compared."""
    found = [
        f"{key} is {now[key]}, was {stored[key]}"
        for key in ("samples", "status")
        if now[key] != stored[key]
    ]
    farthest = distance(stored["numbers"], now["numbers"])
    if why:
        if farthest > CLOSE:
            found.append(f"numbers differ by {farthest:.2g}, relative to the largest")
        return found
    if now["quarters"] != stored["quarters"]:
        equal = [a == b for a, b in zip(stored["quarters"], now["quarters"], strict=True)]
        before, channels = stored["channels"], now["channels"]
        changed = [name for name in before if channels.get(name, before[name]) != before[name]]
        new = [f"{name} is new" for name in channels if name not in before]
        gone = [f"{name} is missing" for name in before if name not in channels]
        first = equal.index(False)
        found.append(
            f"bits differ from quarter {first + 1} of {_QUARTERS} on (sample "
            f"{stored['samples'] * first // _QUARTERS}), in {', '.join(changed + new + gone)}; "
            f"y and u by {farthest:.2g} relative to the largest"
        )
    return found


def distance(stored: Mapping[str, Any], now: Mapping[str, Any]) -> float:
    """Return the largest difference of numbers of channels, relative to the largest of each."""
    largest = 0.0
    for name, values in stored.items():
        a, b = (np.array([float(v) for v in each]) for each in (values, now.get(name, ())))
        if a.shape != b.shape:
            return math.inf
        unequal = ~((a == b) | (np.isnan(a) & np.isnan(b)))
        if not np.any(unequal):
            continue
        if not np.all(np.isfinite(a[unequal]) & np.isfinite(b[unequal])):
            return math.inf
        scale = np.max(np.abs(a[np.isfinite(a)]), initial=0.0) or 1.0
        largest = max(largest, float(np.max(np.abs(a - b)[unequal])) / scale)
    return largest


# ---- Results that are trees: numbers within a tolerance, all else equal ----


def tree_differences(
    stored: Any, now: Any, tolerance: float, floor: float = 1e-12, path: str = ""
) -> Iterator[str]:
    """Yield where two trees of tables, lists, texts and numbers differ."""
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in (stored, now))
    if isinstance(stored, dict) and isinstance(now, dict):
        for key in [*stored, *(key for key in now if key not in stored)]:
            where = f"{path}.{key}" if path else str(key)
            if key not in now or key not in stored:
                yield f"{where} is {'missing' if key not in now else 'new'}"
            else:
                yield from tree_differences(stored[key], now[key], tolerance, floor, where)
    elif isinstance(stored, list) and isinstance(now, list) and len(stored) == len(now):
        for i, (a, b) in enumerate(zip(stored, now, strict=True)):
            yield from tree_differences(a, b, tolerance, floor, f"{path}[{i}]")
    elif numbers and math.isclose(stored, now, rel_tol=tolerance, abs_tol=floor):
        return
    elif stored != now:
        yield f"{path} is {now!r:.120}, was {stored!r:.120}"
