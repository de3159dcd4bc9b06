"""The kinds of signals by name, as setup files have them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from quell import checks
from quell.signals.excitation import PRBS, BandLimitedNoise, Multisine
from quell.signals.moves import LimitedMove
from quell.signals.shapes import (
    Chirp,
    Constant,
    Ramp,
    Repeated,
    Samples,
    Signal,
    Sinusoid,
    SmoothMove,
    Step,
    Trapezoid,
)

KINDS: Mapping[str, type[Signal]] = {
    "constant": Constant,
    "step": Step,
    "ramp": Ramp,
    "sinusoid": Sinusoid,
    "chirp": Chirp,
    "prbs": PRBS,
    "multisine": Multisine,
    "trapezoid": Trapezoid,
    "move": SmoothMove,
    "smooth-move": SmoothMove,  # the same, by the name of the class
    "limited-move": LimitedMove,
    "samples": Samples,
    "repeated": Repeated,
    "noise": BandLimitedNoise,
}
"""The signals that setup files can have, by their ``kind``."""


def make(kind: str, **parameters: Any) -> Signal:
    """Return a signal from the name of its kind and its parameters.

    Raises
    ------
    ValueError
        for an unknown kind or parameter; the message lists the known ones.
    """
    cls = KINDS[checks.one_of("signal", kind, tuple(KINDS))]
    known = tuple(f.name for f in fields(cls))
    for name in parameters:
        checks.one_of(f"parameter of signal {kind!r}", name, known)
    try:
        return cls(**parameters)
    except TypeError as error:
        raise ValueError(f"signal {kind!r}: {str(error).split('() ')[-1]}") from None
