"""References, disturbances and noise as functions of time.

A signal is an immutable object called with an array of times [s]; it returns an array of values. It
has no state: the same times give the same bits, in any order and in blocks of any size. Signals
add, subtract and scale::

    reference   = Sinusoid(amplitude=1.0, omega=1.0).until(110.0, then=Step(at=110.0))
    disturbance = 0.5 * Step(at=2.0) + BandLimitedNoise(power=1e-6, sample_time=0.01)

May import ``types``, ``checks`` and ``kernels``.
"""

from __future__ import annotations

from quell.lazy import imported_on_use, public_names
from quell.signals.excitation import PRBS, BandLimitedNoise, Multisine
from quell.signals.moves import LimitedMove
from quell.signals.registry import KINDS, make
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

__getattr__ = imported_on_use(__name__, {})

__dir__ = public_names(__name__)
