"""The kinds of signals by name, as setup files have them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from quell import checks
from quell.signals import shapes
from quell.signals.excitation import PRBS, BandLimitedNoise, Multisine
from quell.signals.moves import LimitedMove

KINDS: Mapping[str, type[shapes.Signal]] = {
    "constant": shapes.Constant,
    "step": shapes.Step,
    "ramp": shapes.Ramp,
    "sinusoid": shapes.Sinusoid,
    "chirp": shapes.Chirp,
    "prbs": PRBS,
    "multisine": Multisine,
    "trapezoid": shapes.Trapezoid,
    "move": shapes.SmoothMove,
    "smooth-move": shapes.SmoothMove,  # the same, by the name of the class
    "limited-move": LimitedMove,
    "samples": shapes.Samples,
    "repeated": shapes.Repeated,
    "noise": BandLimitedNoise,
}
"""The signals that setup files can have, by their ``kind``."""


def make(kind: str, **parameters: Any) -> shapes.Signal:
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
