"""Quality of a model on a record: fits of simulation and prediction, and tests of the error.

The fit is ``100 (1 − |y − ŷ| / |y − mean(y)|)`` in % (NRMSE). A simulation knows u and the state at
the start; friction follows from its own speed. A prediction k samples ahead also knows y up to now:
it adds to the simulation a linear prediction of its error from n + 1 earlier errors, fitted by
least squares on the samples for the fit (an output-error model has no noise model of its own, so it
gets the simplest; Ljung 1999, sec. 3.2).

The error ε of the simulation is tested as in Ljung 1999, sec. 16.6. *Whiteness*: ``ζ = N
Σ_{τ=1}^{M} (R_ε(τ)/R_ε(0))²`` is χ² with M degrees of freedom for white ε. *Independence of u*: if
ε does not depend on past u, ``√N R_εu(τ)`` is normal with variance ``Σ_k R_ε(k) R_u(k)``. All M + 1
of them are within a limit with the probability 1 − α if each exceeds it with the probability
``α/(M + 1)`` at most (Bonferroni), however they depend on each other. The first
tests a model of the noise, which an output-error model does not have; the second tests the model of
the plant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.identification.model.correlation import correlation
from quell.identification.model.sampling import chains
from quell.identification.model.structure import free_run, nonzero_lengths
from quell.identification.search.search import Fit
from quell.types import Matrix, Vector

# Rounds that adapt the start and the signs of friction to each other: chosen by hand, not tuned.
_ROUNDS = 6
# Relative singular value that counts as zero.
_RANK = 1e-12


class Residuals(NamedTuple):
    """Tests of the error ε of a simulation."""

    rms: float  #: root mean square [y-unit]
    lags: int  #: M, the number of lags in the tests
    autocorrelation: Vector  #: R_ε(τ)/R_ε(0) for τ = 0 … M (M + 1,)
    whiteness: float  #: ζ
    whiteness_limit: float  #: limit that ζ of a white sequence exceeds with 1 % probability
    #: correlation of ε and u, of variance 1, for ε later by τ = −M … M samples (2 M + 1,)
    cross_correlation: Vector
    #: limit that the largest of those for τ ≥ 0 exceeds with 1 % probability if ε does not depend
    #: on u
    cross_limit: float

    @property
    def white(self) -> bool:
        """True if ε passes the test of whiteness, at 99 %."""
        return self.whiteness <= self.whiteness_limit

    @property
    def independent(self) -> bool:
        """True if no correlation with past u exceeds the limit, at 99 % for all together."""
        return bool(np.max(np.abs(self.cross_correlation[self.lags :])) <= self.cross_limit)


def nrmse(y: Vector, predicted: Vector) -> float:
    """Return the fit in %; 100 is perfect, 0 no better than the mean."""
    return float(100.0 * (1.0 - np.linalg.norm(y - predicted) / np.linalg.norm(y - np.mean(y))))


def simulate_fit(fit: Fit, v: Matrix, y: Vector | None = None) -> Vector:
    """Return the simulated output for inputs ``v``, with friction from the model's own speeds.

    With ``y`` the initial state is fitted to ``y`` by least squares, n numbers; without, it is that
    of the samples for the fit.
    """
    structure, theta = fit.structure, fit.estimate.theta
    if y is None:
        return _finite(free_run(structure, theta, v, own_friction=True)[0])
    theta = theta.copy()
    theta[-structure.order :] = 0.0
    free = chains(structure.denominator(theta), np.zeros((y.size, 0)))[:, :, 0]
    size = nonzero_lengths(_finite(free))
    predicted = _finite(free_run(structure, theta, v)[0])
    # With friction the start decides the sign of the speed, and the sign the start.
    for _ in range(_ROUNDS if structure.friction else 1):
        change = np.linalg.lstsq(free / size, y - predicted, rcond=_RANK)[0]
        theta[-structure.order :] += change / size
        predicted = _finite(free_run(structure, theta, v, own_friction=True)[0])
    return predicted


def _finite(predicted: Matrix) -> Matrix:
    """Return a simulated output, or the outputs from several states, if they are finite."""
    if not np.all(np.isfinite(predicted)):
        raise ValueError("order: the fitted model is unstable; lower the order, or set integrators")
    return predicted


def fit_predictor(error: Vector, horizon: int, terms: int) -> Vector:
    """Return weights that predict a simulation's error, ``horizon`` samples ahead."""
    past, ahead = _error_history(error, horizon, terms)
    return np.asarray(np.linalg.lstsq(past, ahead, rcond=_RANK)[0])


def prediction_fit(y: Vector, error: Vector, horizon: int, weights: Vector) -> float:
    """Return the fit [%] of the prediction of ``y``, whose simulation has this error."""
    past, ahead = _error_history(error, horizon, weights.size)
    later = y[y.size - ahead.size :]
    return nrmse(later, later - (ahead - past @ weights))


def _error_history(error: Vector, horizon: int, terms: int) -> tuple[Matrix, Vector]:
    """Return past errors, at multiples of ``horizon`` before (samples, terms), and the errors."""
    first = horizon * terms
    past = [error[first - j : error.size - j] for j in range(horizon, first + 1, horizon)]
    return np.column_stack(past), error[first:]


def residuals(error: Vector, u: Vector, lags: int) -> Residuals:
    """Return the tests of the error (N,) of a simulation with the input ``u`` (N,)."""
    from scipy.stats import chi2, norm

    e, v = error - np.mean(error), u - np.mean(u)
    count = e.size
    re, ru, cross = (correlation(*pair, lags) for pair in ((e, e), (v, v), (e, v)))
    # Without any error there is no correlation.
    power = re[lags] or 1.0
    auto = re[lags:] / power
    scale = float(np.sqrt(power * ru[lags]))
    # Correlations at greater lags count as zero.
    variance = max(float(np.sum(re * ru)), 0.0) / scale**2
    return Residuals(
        rms=float(np.sqrt(np.mean(error**2))),
        lags=lags,
        autocorrelation=auto,
        whiteness=float(count * np.sum(auto[1:] ** 2)),
        whiteness_limit=float(chi2.ppf(0.99, lags)),
        cross_correlation=cross / scale,
        cross_limit=float(norm.isf(0.005 / (lags + 1)) * np.sqrt(variance / count)),
    )
