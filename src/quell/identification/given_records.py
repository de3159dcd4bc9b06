"""The records that ``identify`` gets: their checks, and what their samples show at once."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import numpy as np

from quell import checks
from quell.types import Vector

# Share of a record that is held out, and longest delay at first [samples], by default: by hand.
_HELD_OUT, MOST_DELAY = 0.3, 20
IF_NEEDED: Literal["if needed"] = "if needed"
"""The delay that is searched where the model without it has shortcomings."""
# Held-out samples that have a spectrum, and the power of u before them, relative to that in them,
# which is none. By hand.
_LEAST_SPECTRUM, _MISSING = 64, 0.01
# Relative error of a range of delays by the rounding of the sample time.
ROUNDED = 1e-9


def other_record(u: Any, y: Any, least: int) -> tuple[Vector, Vector]:
    """Return the checked record for validation."""
    u, y = checks.vector("validation u", u), checks.vector("validation y", y)
    checks.vector("validation y", y, u.size)
    if u.size < least:
        raise ValueError(f"validation: has {u.size} samples, must have at least {least}")
    if np.ptp(y) == 0.0:
        raise ValueError(f"validation: y is {y[0]:g} all through: must move")
    return u, y


def resolution_of(y: Vector) -> float:
    """Return the step that y is rounded to, 0.0 if it is not rounded."""
    steps = np.abs(np.diff(y))
    steps = steps[steps > 1e-9 * np.max(np.abs(y))]
    if steps.size == 0:
        return 0.0
    # The mean of the smallest steps, as the last digits in a file are rounded.
    step = float(np.mean(steps[steps < 1.5 * np.min(steps)]))
    counts = steps[steps < 50.0 * step] / step
    # Without rounding the smallest difference is unrelated to the others. Thresholds are chosen by
    # hand.
    rounded = counts.size > 0.01 * y.size and np.all(np.abs(counts - np.round(counts)) < 0.1)
    return step if rounded else 0.0


class Records(NamedTuple):
    """One record, or several one after the other."""

    u: Vector
    y: Vector
    samples: tuple[int, ...]  # number of samples of each record, if there are several


def given_records(u: Any, y: Any) -> Records:
    """Return the checked record, or the records of two lists."""
    if not _is_list_of_records(u) and not _is_list_of_records(y):
        u, y = checks.vector("u", u), checks.vector("y", y)
        checks.vector("y", y, u.size)
        return Records(u, y, ())
    if not (_is_list_of_records(u) and _is_list_of_records(y)) or len(u) != len(y):
        raise ValueError(
            "u, y: must both be arrays, or lists of as many arrays, one for each record"
        )
    parts = []
    for i, (one, other) in enumerate(zip(u, y, strict=True)):
        first = checks.vector(f"u[{i}]", one)
        parts.append((first, checks.vector(f"y[{i}]", other, first.size)))
    samples = tuple(part.size for part, _ in parts)
    joined = [np.concatenate(signals) for signals in zip(*parts, strict=True)]
    return Records(joined[0], joined[1], samples if len(samples) > 1 else ())


def _is_list_of_records(value: Any) -> bool:
    return isinstance(value, list | tuple) and bool(value) and np.ndim(value[0]) == 1


def delay_range(delay: Any, dt: float, size: int) -> tuple[float, float]:
    """Return the least and the largest delay [samples]; None is the default for ``size`` samples.

    An end of a range that is no whole number of samples is the next one inside the range.
    """
    if delay is None:
        return 0, max(min(MOST_DELAY, size // 4), 0)
    if isinstance(delay, str):
        raise ValueError(
            f"delay = {delay!r}: must be a number of seconds, two of them to search between, None "
            f'to search, or "{IF_NEEDED}"'
        )
    if np.ndim(delay) == 0:
        samples = checks.non_negative("delay", delay, "s") / dt
        samples = round(samples) if abs(samples - round(samples)) <= ROUNDED else samples
        return samples, samples
    low, high = checks.vector("delay", delay, 2).tolist()
    if not 0.0 <= low <= high:
        raise ValueError(f"delay = {delay!r}: must be from 0 on, and the smallest comes first")
    first = math.ceil(low / dt * (1.0 - ROUNDED))
    return first, max(math.floor(high / dt * (1.0 + ROUNDED)), first)


def first_held_out(
    records: Records, order: int, held_out: float | None, least: int, least_held: int
) -> int:
    """Return the index of the first held-out sample, with at least ``least`` samples before it."""
    u, y = records.u, records.y
    share = _HELD_OUT if held_out is None else checks.non_negative("held_out", held_out)
    if share > 0.9:
        raise ValueError(
            f"held_out = {held_out!r}: must be from 0 to 0.9, "
            "the share of the record that is not used for the fit"
        )
    if records.samples and held_out:
        raise ValueError(
            f"held_out = {held_out!r}: goes with one record; of several give one as validation"
        )
    held = 0 if records.samples else int(share * u.size)
    if held_out is None and held:
        stands = np.ptp(y[-held:]) == 0.0  # as of a saturated sensor
        held *= not (stands or _rests_at_end(u, held) or _moves_otherwise(u, held))
    held_from = u.size - held
    if held_from < least:
        raise ValueError(
            f"u has {u.size} samples, {held_from} of them for the fit: "
            f"must have at least {least} for order {order}; record longer"
        )
    if 0 < held < least_held:
        raise ValueError(
            f"held_out = {held_out!r}: of {u.size} samples these are {held}, must be at least "
            f"{least_held} to be judged on; record longer, lower horizon, or hold none out"
        )
    for name, value in (("u", u), ("y", y)):
        if np.ptp(value[:held_from]) == 0.0:
            place = "all through the samples for the fit"
            ringing = "; of a y that rings meanwhile free_swing finds the modes" * (name == "u")
            raise ValueError(f"{name} is {value[0]:g} {place}: must move{ringing}")
        if held and np.ptp(value[held_from:]) == 0.0:
            raise ValueError(
                f"held_out = {held_out!r}: {name} is {value[-1]:g} all through these samples, must "
                "move; hold fewer out, or none, or cut the record where it rests"
            )
    return held_from


def _rests_at_end(u: Vector, held: int) -> bool:
    """Return whether u moves in one of fit and held-out samples alone."""
    return bool(np.ptp(u[-held:]) == 0.0 or np.ptp(u[:-held]) == 0.0)


def _moves_otherwise(u: Vector, held: int) -> bool:
    """Return whether the frequencies of u in held-out samples are not in those for the fit.

    So it is at the end of a chirp: what the fit has not seen says nothing about it.
    """
    from scipy.signal import welch

    if held < _LEAST_SPECTRUM:
        return False
    before, held_out = (
        welch(part - np.mean(part), nperseg=held)[1] for part in (u[:-held], u[-held:])
    )
    missing = before < _MISSING * held_out
    return bool(np.sum(held_out[missing]) > 0.5 * np.sum(held_out))
