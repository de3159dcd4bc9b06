"""Sample time of a record from its column of times, and hints where its unit looks wrong."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from quell.types import Vector
from quell.warn import warn

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units of times, in seconds."""

# Times may be off the grid by this share of a sample: chosen by hand, so that rounded times pass
# and a gap does not.
_JITTER = 0.2
# Up to here a number of steps is exact in a float.
_MOST_STEPS = 2.0**53
# As seconds since 1970 a time beyond it [s] is after the year 2286; in ms it is in 1970.
_LATEST = 1e10
# Shorter sample times than that of common converters, 1 MHz, are hardly meant [s]: chosen by hand.
_SHORTEST = 1e-6
# A column of times: t or time, perhaps with a unit, as in "t [ms]", "time_ms", "Time (s)".
_TIME = re.compile(r"(?:t|time)(?:[\s_/\[(]+([a-zµμ]+)[\])]?)?", re.IGNORECASE)
_NAMES = {"s": "s", "sec": "s", "seconds": "s", "ms": "ms", "msec": "ms", "milliseconds": "ms"} | {
    **dict.fromkeys(("us", "µs", "μs", "usec", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nanoseconds"), "ns"),
}


def sample_time(where: str, t: Vector, lines: Vector, unit: str | None) -> float:
    """Return the sample time [s] of the times ``t`` in a unit; None is s, if it can be.

    Raises
    ------
    ValueError
        if the times are not evenly spaced; it names the line.
    """
    if unit is None:
        _warn_of_another_unit(where, t)
    t = t * UNITS[unit or "s"]
    with np.errstate(over="ignore"):  # a damaged file may hold any numbers
        dt = float(np.median(np.diff(t)))
        if not dt > 0.0 or not (t[-1] - t[0]) / dt < _MOST_STEPS:
            raise ValueError(f"{where}: t must rise evenly, half of its steps do not")
    dt = float(t[-1] - t[0]) / max(round((t[-1] - t[0]) / dt), 1)
    off = np.abs(np.diff(t) - dt)
    worst = int(np.argmax(off))
    if off[worst] > _JITTER * dt or round((t[-1] - t[0]) / dt) != t.size - 1:
        raise ValueError(
            f"{where}, line {lines[worst + 1]:.0f}: t rises by {t[worst + 1] - t[worst]:.6g} s "
            f"where samples are {dt:.6g} s apart: must be evenly sampled; interpolate, or cut the "
            "record at the gap"
        )
    # With few digits in the times, the sample time is more exact than they are.
    rounded = float(f"{dt:.6g}")
    return rounded if abs(rounded - dt) * t.size < _JITTER * dt else dt


def check_unit(where: str, name: str, unit: str | None) -> None:
    """Check that times are in seconds by the column's ``name``, or their unit is given."""
    named = _unit_in(name)
    if unit is None and named not in (None, "s"):
        raise ValueError(
            f"{where}: column {name!r} is not in seconds by its name; "
            f"give time_unit = {named!r} (--time-unit {named})"
        )


def warn_of_another_step(
    where: str, header: Sequence[str], rows: Sequence[Sequence[str]], dt: float
) -> None:
    """Warn if a file has times, and they rise by another step than ``dt`` [s]."""
    for place, name in enumerate(header):
        if not _TIME.fullmatch(name):
            continue
        try:
            t = [float(row[place]) for row in rows]
        except (ValueError, IndexError):  # dates, for instance
            return
        step = float(np.median(np.diff(t))) * UNITS[_unit_in(name) or "s"]
        if step > 0.0 and abs(step - dt) > _JITTER * dt:
            warn(
                f"{where}: dt = {dt:g} s is given, but column {name!r} rises by {step:g}: is dt in "
                "seconds? Leave it out to take the times of the file.",
                UserWarning,
            )
        return


def _unit_in(name: str) -> str | None:
    """Return the unit in the name of a column of times, None if it has none that is known."""
    found = _TIME.fullmatch(name.strip())
    return _NAMES.get(found[1].lower()) if found and found[1] else None


def _warn_of_another_unit(where: str, t: Vector) -> None:
    """Warn if times are hardly seconds."""
    step = float(np.median(np.diff(t)))
    if not step > 0.0:
        return
    hint = "if they are milliseconds, give time_unit = 'ms' (--time-unit ms)"
    if abs(t[0]) > _LATEST:
        reason = f"begin at {t[0]:.6g}, which as seconds since 1970 is after the year 2286"
    elif step >= 1.0 and np.all(t == np.rint(t)):
        reason = f"are whole numbers, {step:g} apart, and are read as seconds"
        hint += "; if they count samples, give the sample time dt in place of the column"
    elif step < _SHORTEST:
        reason = f"rise by {step:g} and are read as seconds, more than a million samples per second"
        hint = "if they are in another unit, give time_unit (--time-unit), 's' if they are seconds"
    else:
        return
    warn(f"{where}: the times {reason}: {hint}", UserWarning)
