"""References, disturbances and noise as functions of time.

A signal is an immutable object called with an array of times [s]; it returns an array of values. It
has no state: the same times give the same bits, in any order and in blocks of any size. Signals
add, subtract and scale::

    reference   = Sinusoid(amplitude=1.0, omega=1.0).until(110.0, then=Step(at=110.0))
    disturbance = 0.5 * Step(at=2.0) + BandLimitedNoise(power=1e-6, sample_time=0.01)

May import ``types``, ``checks`` and ``kernels``.
"""

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
    Scaled,
    Signal,
    Sinusoid,
    SmoothMove,
    Step,
    Sum,
    Switched,
    Trapezoid,
    as_signal,
    seeded_apart,
)

__all__ = [
    "KINDS", "PRBS", "BandLimitedNoise", "Chirp", "Constant", "LimitedMove", "Multisine", "Ramp",
    "Repeated", "Samples", "Scaled", "Signal", "Sinusoid", "SmoothMove", "Step", "Sum", "Switched",
    "Trapezoid", "as_signal", "make", "seeded_apart",
]  # fmt: skip

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
