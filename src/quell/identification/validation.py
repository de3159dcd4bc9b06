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

*One more pole*: a pole λ in the model changes its output by ``−p/(p + λ) ŷ_u``, ŷ_u being the
response to u. For some λ, slower and faster than the poles of the model, these changes are
regressed on ε together with the derivatives ψ of the output by θ, all of them whitened by the model
of the noise of ``output_error``. The reduction of ``Σ w²/σ_w²`` that they bring is χ² with as many
degrees of freedom if ε has nothing of u (Lagrange-multiplier test; Breusch & Pagan, *Review of
Economic Studies* 47, 1980). It also shows an order that is too low in the record of one step, where
the correlation with u does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.identification.model.correlation import correlation
from quell.identification.model.sampling import chains
from quell.identification.model.structure import free_run, gradient, nonzero_lengths
from quell.identification.search.output_error import noise_model
from quell.identification.search.search import Fit
from quell.types import Matrix, Vector

# Rounds that adapt the start and the signs of friction to each other: chosen by hand, not tuned.
_ROUNDS = 6
# Poles of the test for one more pole, and the probability that it fails by chance: by hand.
_EXTRA_POLES, _SELDOM = 4, 1e-3
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
    structure = structure.single()
    theta = theta[: structure.size].copy()
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


def one_more_pole(fit: Fit, u: Vector, y: Vector) -> tuple[float, float]:
    """Return the statistic of the test for one more pole, and its limit at 99.9 %."""
    from scipy.signal import lfilter
    from scipy.stats import chi2

    structure, theta = fit.structure, fit.estimate.theta
    v = free_run(structure, theta, fit.inputs(u), own_friction=True)[1]
    predicted, psi = gradient(structure, theta, v)
    alone = np.zeros_like(v)
    alone[:, 0] = v[:, 0] - v[0, 0]
    a = structure.denominator(theta)
    poles = np.abs(np.roots(np.append(1.0, a[::-1])))
    slow, fast = np.clip([np.min(poles), np.max(poles)], 3.0 / y.size, 1.0)
    b = structure.numerators(theta)[0]
    columns = []
    for rate in np.geomspace(slow / 3.0, min(3.0 * fast, 2.0), _EXTRA_POLES).tolist():
        wider = np.convolve(np.append(a, 1.0), [rate, 1.0])[:-1]
        parts = []
        for place in structure.records(y.size):
            bank = chains(wider, alone[place, :1])[:, :, 0]
            parts.append(bank[:, 1 : b.size + 1] @ b)
        columns.append(np.concatenate(parts))
    c, variance = noise_model(y - predicted)
    known = psi / nonzero_lengths(psi)
    extra = np.column_stack(columns)
    extra /= nonzero_lengths(extra)
    whitened = lfilter(c, [1.0], np.column_stack([known, extra, y - predicted]), axis=0)
    if not np.all(np.isfinite(whitened)) or not variance > 0.0:
        return 0.0, float(chi2.isf(_SELDOM, _EXTRA_POLES))
    error = whitened[:, -1]
    left = [
        float(np.sum((error - part @ np.linalg.lstsq(part, error, rcond=1e-9)[0]) ** 2))
        for part in (whitened[:, : known.shape[1]], whitened[:, :-1])
    ]
    statistic = (left[0] - left[1]) / (left[1] / max(y.size - whitened.shape[1] + 1, 1))
    return statistic, float(chi2.isf(_SELDOM, _EXTRA_POLES))


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
    # Nor is there one with a u that does not move.
    scale = float(np.sqrt(power * ru[lags])) or 1.0
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
