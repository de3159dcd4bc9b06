"""Checks of the records that ``identify`` gets, and what their samples show at once."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell import checks
from quell.types import Vector


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


def delay_range(delay: Any, dt: float) -> tuple[int, int]:
    """Return the least and the largest delay [samples]."""
    if np.ndim(delay) == 0:
        samples = checks.samples("delay", delay, dt)
        return samples, samples
    ends = checks.vector("delay", delay, 2).tolist()
    low, high = (checks.samples("delay", value, dt) for value in ends)
    if low > high:
        raise ValueError(f"delay = {delay!r}: the smallest comes first")
    return low, high


def first_held_out(
    u: Vector, y: Vector, order: int, held_out: float, least: int, least_held: int
) -> int:
    """Return the index of the first held-out sample, with at least ``least`` samples before it."""
    share = checks.non_negative("held_out", held_out)
    if share > 0.9:
        raise ValueError(
            f"held_out = {held_out!r}: must be from 0 to 0.9, "
            "the share of the record that is not used for the fit"
        )
    held = int(share * u.size)
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
            raise ValueError(f"{name} is {value[0]:g} {place}: must move")
        if held and np.ptp(value[held_from:]) == 0.0:
            raise ValueError(
                f"held_out = {held_out!r}: {name} is {value[-1]:g} all through these samples, must "
                "move; hold fewer out, or none, or cut the record where it rests"
            )
    return held_from
