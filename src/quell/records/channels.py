"""The channels of a record: names, columns, descriptions and units."""

from __future__ import annotations

from typing import Any

from quell.quantities import UNKNOWN, Signals
from quell.types import Channels

# Channels that are vectors even if their width is one.
_VECTORS = ("w", "x", "x_hat", "f_derivatives", "theta")
# Description and unit.
_DESCRIPTIONS = {
    "r": ("reference", "y-unit"),
    "r_shaped": ("reference behind the prefilter", "y-unit"),
    "y": ("output", "y-unit"),
    "y_measured": ("output as measured, with noise", "y-unit"),
    "u": ("control signal as applied", "u-unit"),
    "u_wished": ("control signal before limits", "u-unit"),
    "w": ("disturbances", "w-unit"),
    "x": ("state of the plant", "state-unit"),
    "x_hat": ("estimated output and its derivatives", "y-unit/s^i"),
    "f_residual": ("residual total disturbance estimated by the observer", "y-unit/s^n"),
    "f_derivatives": ("estimated derivatives of f, from the first on", "y-unit/s^(n+i)"),
    "u_feedforward": ("feedforward of the model", "u-unit"),
    "f_learned": ("total disturbance fed forward by the learner", "y-unit/s^n"),
    "f_hat": ("estimated total disturbance", "y-unit/s^n"),
    "authority": ("share of its output that the guard lets the learner have", "1"),
    "error_plain": ("RMS of what an ESO without learner would have missed of f", "y-unit/s^n"),
    "error_learned": (
        "RMS of what would be missed with the learner at full authority",
        "y-unit/s^n",
    ),
    "reason": ("why the authority is what it is (quell.guard.Reason)", "1"),
    "status": ("status flags of the step", "1"),
    "theta": ("coefficients of the learner", "y-unit/s^n per feature-unit"),
    "k": ("index of the deadline", "1"),
    "lateness": ("wake-up behind the deadline", "s"),
    "step_time": ("from the wake-up until u was written", "s"),
    "mode": ("state of the supervisor", "1"),
    "events": ("events of the cycle (quell.realtime.telemetry.channels.Event)", "1"),
}


# The words of descriptions that a signal's name stands for.
_NAMED = {
    "y": "output",
    "y_measured": "output",
    "u": "control signal",
    "u_wished": "control signal",
}


def describe(name: str, signals: Signals = UNKNOWN) -> tuple[str, str]:
    """Return a channel's description and unit, those of the plant's ``signals`` if known."""
    text, unit = _DESCRIPTIONS.get(name, (name, "1"))
    if name in _NAMED:
        known = signals.y if name.startswith("y") else signals.u
        text = text.replace(_NAMED[name], known.name or _NAMED[name])
    elif name == "w" and any(each.name for each in signals.w):
        text = f"{text}: {', '.join(map(str, signals.w))}"
    return text, signals.unit(unit)


def units_of(name: str, width: int, signals: Signals = UNKNOWN) -> list[str]:
    """Return the unit of each entry of a channel with ``width`` entries."""
    if name == "x_hat" and signals.y.unit:
        return [signals.derivative(i) for i in range(width)]
    if name == "w" and len(signals.w) == width:
        return [each.unit or "w-unit" for each in signals.w]
    return [describe(name, signals)[1]] * width


def signals_of_loop(signals: Signals, controller: Any) -> Signals:
    """Return the plant's signals with the unit of the controller's f, if it has an observer."""
    while controller is not None:
        observer = getattr(controller, "observer", None)
        if observer is not None:
            return signals.with_f(getattr(observer, "f_degree", None))
        controller = getattr(controller, "controller", None)
    return signals


def is_vector(name: str, width: int) -> bool:
    """Return whether a channel has an axis for its entries, be it of length 1."""
    return width > 1 or name in _VECTORS


def readable_names(channels: Channels) -> tuple[str, ...]:
    """Return the names of the channels that have columns, and ``f_hat`` if it can be computed."""
    recorded = tuple(name for name, width in channels if width)
    return (*recorded, "f_hat") if {"f_learned", "f_residual"} <= set(recorded) else recorded


def columns_of(channels: Channels, name: str) -> slice:
    """Return the columns of a channel in a log."""
    start = 0
    for channel, width in channels:
        if channel == name:
            return slice(start, start + width)
        start += width
    raise KeyError(name)
