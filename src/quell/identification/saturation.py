"""A y or u that stands at an extreme: a sensor or an actuator at its limit.

A signal at its limit has the same largest (or least) value in many samples, and comes there while
it moves fast. A signal that settles at its largest value comes there slowly, and one that has
levels, as steps or a PRBS, has few values: both are none.

Samples of y at a limit y_max say only that y was y_max or more. They are bounded, not fitted, by
the likelihood of censored data (Tobin, *Econometrica* 26, 1958) in its limit of small noise::

    min  Σ_free (y − ŷ)² + Σ_limit max(y_max − ŷ, 0)²

A sample at a limit counts where the model is inside it, and those that count are found by rounds:
a search begins with ``max(ŷ, y_max)`` in their place, with the ŷ of the model before, and ends with
the samples that count alone. Deviations and tests are of these, too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.types import Vector

# Samples at a limit at least, times as many as at a value below it, and values of a signal that has
# no levels. All chosen by hand.
_FEWEST, _PILED, _VALUES = 10, 4.0, 20
# Share of a rest at the begin in which u is looked at, and how often it moves through its range
# in a rest at begin or end that is none. By hand.
_FIRST, _SWINGS = 0.8, 1.0
# Share of the third differences that turn their sign, from which a signal has noise: of noise alone
# 0.8 of them do, of a smooth signal few. By hand.
_NOISY = 0.5
# Steps of rounding by which a y leaves a limit at once. By hand.
_LEAVES = 2.5
# Share of the samples beyond which too little is left.
_MOST = 0.9


class Standing(NamedTuple):
    """Where a signal stands at its limits."""

    upper: NDArray[np.bool_]  # (N,)
    lower: NDArray[np.bool_]

    @property
    def samples(self) -> int:
        """Number of samples at a limit."""
        return int(np.sum(self.upper) + np.sum(self.lower))

    @property
    def is_usable(self) -> bool:
        """Whether some samples are at a limit, and enough are not."""
        return 0 < self.samples <= _MOST * self.upper.size

    @property
    def free(self) -> NDArray[np.bool_]:
        """Where the signal is at no limit (N,)."""
        return ~(self.upper | self.lower)

    @property
    def longest_free(self) -> slice:
        """The longest part without a sample at a limit."""
        edges = np.flatnonzero(np.diff(np.concatenate([[False], self.free, [False]])))
        i = int(np.argmax(edges[1::2] - edges[::2]))
        return slice(int(edges[2 * i]), int(edges[2 * i + 1]))

    def bounded(self, y: Vector, model: Vector) -> Vector:
        """Return y with the model in place of a limit that it is beyond."""
        found = np.where(self.upper, np.maximum(y, model), y)
        return np.where(self.lower, np.minimum(y, model), found)


def standing(x: Vector, resolution: float, u: Vector | None = None) -> Standing:
    """Return where a signal stands at its limits; ``resolution`` is the step it is rounded to.

    A y that does not answer a ``u`` that moves stands at its limit, at begin and end, too, and so
    does one that is constant there while u moves, and noisy elsewhere: noise does not rest.
    """
    none = np.zeros(x.size, dtype=bool)
    if np.unique(x).size <= _VALUES:
        return Standing(none, none)
    # A value that is held for some samples is no limit. What stands at its extremes for most of
    # them says nothing about the values between.
    between = x[(np.min(x) < x) & (x < np.max(x))]
    if resolution == 0.0 and np.median(np.abs(np.diff(between))) == 0.0:
        return Standing(none, none)
    return Standing(_at_top(x, resolution, u), _at_top(-x, resolution, u))


def _at_top(x: Vector, resolution: float, u: Vector | None) -> NDArray[np.bool_]:
    """Return where a signal stands at its largest value; nowhere if it does not."""
    top, span = float(np.max(x)), float(np.ptp(x))
    same = max(0.25 * resolution, 1e-9 * span)
    every, nowhere = x >= top - same, np.zeros(x.size, dtype=bool)
    at = every.copy()
    # A plant that rests at the begin or the end of a record may stand at an extreme, too.
    away = np.flatnonzero(~at)
    if away.size:
        if u is not None:
            # A delay may be as long as the rest of the first part. A rounded y may move within a
            # step: it stands at a limit only if it leaves it by several steps at once.
            ends = u[: int(_FIRST * away[0])], u[away[-1] + 1 :]
            moved = max(
                float(np.sum(np.abs(np.diff(part)))) if top - x[k] > _LEAVES * resolution else 0.0
                for part, k in zip(ends, (away[0], away[-1]), strict=True)
            )
            unanswered = moved > _SWINGS * float(np.ptp(u))
            still = moved > 0.0 and resolution == 0.0 and _is_noisy(x[~at])
            if (unanswered or still) and np.sum(every) >= _FEWEST:
                return every
        at[: away[0]] = at[away[-1] :] = False
    count = int(np.sum(at))
    if count < _FEWEST:
        return nowhere
    width = resolution or 1e-3 * span
    # Samples at the values below, per value: a sine's crest has as many as its top.
    near, far = (
        float(np.sum((x < top - (a - 0.5) * width) & (x >= top - (b + 0.5) * width))) / (b + 1 - a)
        for a, b in ((1, 2), (3, 8))
    )
    if resolution and near > 2.0 * far + 2.0:  # what settles is there longer and longer
        return nowhere
    starts = np.flatnonzero(at[1:] & ~at[:-1]) + 1
    if count <= _PILED * near or not starts.size:
        return nowhere
    # The steps to the limit: what settles has small ones.
    steps = [float(max(x[k] - x[k - 1], x[k - 1] - x[k - 2])) for k in starts if k > 1]
    typical = 0.5 * float(np.median(np.abs(np.diff(x[~at]))))
    fast = bool(steps) and (resolution > 0.0 or float(np.median(steps)) > typical)
    return every if fast else nowhere


def _is_noisy(x: Vector) -> bool:
    """Return whether a signal has noise: its differences turn their sign again and again."""
    turns = np.diff(x, 3)
    return bool(np.mean(turns[1:] * turns[:-1] < 0.0) > _NOISY) if turns.size > _FEWEST else False
