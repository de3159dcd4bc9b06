"""The failure criterion of the ACC benchmark."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.experiments.acc.controllers import MOST_U
from quell.sweeping.shares import share_interval as interval
from quell.types import Matrix, Vector

SETTLED_AT, MOST_Y = 15.0, 0.1
"""Time from which on y must stay small [s], and its limit [m] (Rocchetta et al., DSCC 2019)."""
DURATION = 30.0
"""Duration of a run [s]: theirs is 25 s; chosen longer, so that slowly growing loops show."""
# Relative to 0.5 N: a control signal on its limit is not beyond it, whatever the rounding.
_ROUNDING = 1e-9


class Judged(NamedTuple):
    """Runs of one controller on a sample of plants; each array (count,)."""

    late_peak: Vector  #: largest ``|y|`` from 15 s on [m]; infinite for an unstable loop
    most_u: Vector  #: largest ``|u|`` [N]

    @property
    def fails(self) -> NDArray[np.bool_]:
        """True if a plant fails: unstable, ``|y| > 0.1`` from 15 s on, ``|u| > 0.5``, or NaN."""
        return ~((self.late_peak <= MOST_Y) & (self.most_u <= MOST_U + _ROUNDING))

    def to_json(self) -> dict[str, Any]:
        """Return the failure rate, its interval and the reasons, for ``json.dump``."""
        failures, count = int(np.sum(self.fails)), self.fails.size
        return {
            "failure_rate": failures / count,
            "ci95": list(interval(failures, count)),
            "late": int(np.sum(~(self.late_peak <= MOST_Y))),
            "beyond_u": int(np.sum(~(self.most_u <= MOST_U + _ROUNDING))),
        }


def judge(t: Vector, y: Matrix, u: Matrix, unstable: NDArray[np.bool_]) -> Judged:
    """Judge records ``y`` and ``u`` (count, samples) at the times ``t``, NaN after an early end.

    ``unstable`` (count,) marks loops with an unstable pole, which may be too slow to show in the
    records.
    """
    late = np.max(np.abs(y[:, t >= SETTLED_AT - 1e-9]), axis=1)
    most_u = np.max(np.abs(np.nan_to_num(u, nan=0.0)), axis=1)
    return Judged(np.where(np.isnan(late) | unstable, np.inf, late), most_u)
