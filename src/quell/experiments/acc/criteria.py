"""When a plant of the ACC benchmark fails, and how sure a share of failures is."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.experiments.acc.controllers import MOST_U
from quell.types import Matrix, Vector

SETTLED_AT, MOST_Y = 15.0, 0.1
DURATION = 30.0
# A control signal that lies on its limit is not beyond it.
_ROUNDING = 1e-9


class Judged(NamedTuple):
    """What a sample of plants made of one controller; each array (count,)."""

    late_peak: Vector
    """Largest ``|y|`` from 15 s on [m]; infinite where the loop is unstable."""
    most_u: Vector
    """Largest ``|u|`` [N]."""

    @property
    def fails(self) -> NDArray[np.bool_]:
        """Which plants fail, strictly read: unstable, ``|y| > 0.1`` at any time from 15 s on, or ``|u| > 0.5`` at any time."""
        held = (self.late_peak <= MOST_Y) & (self.most_u <= MOST_U + _ROUNDING)
        return ~held  # what is no number fails

    def to_json(self) -> dict[str, Any]:
        """Return the failure rate, its interval and why plants fail, for ``json.dump``."""
        failures, count = int(np.sum(self.fails)), self.fails.size
        return {
            "failure_rate": failures / count,
            "ci95": list(interval(failures, count)),
            "late": int(np.sum(~(self.late_peak <= MOST_Y))),
            "beyond_u": int(np.sum(~(self.most_u <= MOST_U + _ROUNDING))),
        }


def judge(t: Vector, y: Matrix, u: Matrix, unstable: NDArray[np.bool_]) -> Judged:
    """Judge records ``y`` and ``u``, (count, samples), at the times ``t``; where a run ended early they are not numbers.

    ``unstable`` (count,) tells which loops have a pole that grows, be it so slowly that the records do not show it.
    """
    late = np.max(np.abs(y[:, t >= SETTLED_AT - 1e-9]), axis=1)
    return Judged(
        np.where(np.isnan(late) | unstable, np.inf, late),
        np.max(np.abs(np.nan_to_num(u, nan=0.0)), axis=1),
    )


def interval(failures: int, count: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a failure probability (Clopper & Pearson 1934: never too narrow)."""
    from scipy.stats import binomtest

    found = binomtest(failures, count).proportion_ci(0.95, method="exact")
    return float(found.low), float(found.high)
