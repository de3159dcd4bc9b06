"""The largest controller bandwidth with which a loop keeps a phase margin."""

from __future__ import annotations

import math
import warnings

import numpy as np

from quell.analysis.loop import analyse
from quell.controllers.adrc.adrc import ADRC
from quell.observers.eso import ESO
from quell.types import DesignWarning, Vector

# Range of omega_c relative to 1/dt: omega_o is 0.5/dt at most, below the limit of 1/dt that designs
# warn of; and trials for each factor of ten. Chosen by hand.
_LOWEST, _MOST_OBSERVER, _PER_DECADE = 1e-4, 0.5, 12
# Relative error of the result.
_TOLERANCE = 1e-4


def bandwidth(
    b: float,
    den: Vector,
    lag: float,
    delay: float,
    *,
    b0: float,
    dt: float,
    margin: float,
    ratio: float,
) -> float:
    """Return the largest omega_c [rad/s] with which ADRC keeps the phase margin, NaN for none.

    The loop is that of the sampled plant ``b/den`` behind a lag and a delay [s], and of ADRC with a
    model-free ESO of ``omega_o = ratio omega_c``.

    Parameters
    ----------
    b
        gain of the plant.
    den
        its denominator of degree n, the first coefficient 1.
    lag, delay
        time constant of the lag, and the delay [s].
    b0
        gain that the ESO assumes.
    dt
        sample time [s].
    margin
        phase margin [degrees].
    ratio
        omega_o over omega_c.
    """
    from scipy.optimize import brentq

    def excess(log_omega_c: float) -> float:
        """Return the phase margin less the one wanted, −180 for an unstable loop."""
        omega_c = math.exp(log_omega_c)
        observer = ESO.model_free(den.size - 1, b0, ratio * omega_c, dt)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DesignWarning)
            loop = analyse(plant, ADRC(observer, omega_c), delay=delay, actuator_lag=lag)
        return loop.margins.phase - margin if loop.stable else -180.0

    plant = np.array([b]), den
    low, high = math.log(_LOWEST / dt), math.log(_MOST_OBSERVER / (ratio * dt))
    grid = np.linspace(low, high, round((high - low) / math.log(10.0) * _PER_DECADE) + 1)
    above = math.nan
    for point in grid[::-1].tolist():
        value = excess(point)
        if value >= 0.0:
            if math.isnan(above):
                return math.exp(point)
            return math.exp(brentq(excess, point, above, xtol=_TOLERANCE))
        above = point
    return math.nan
