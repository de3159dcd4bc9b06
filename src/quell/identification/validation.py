"""How well a model explains a record: simulation, prediction, and what is left.

The fit is ``100 (1 − |y − ŷ| / |y − mean(y)|)`` in % (NRMSE). A simulation knows u and where the record begins, nothing else; friction
comes from its own speed. A prediction k samples ahead knows y up to now: to the simulation is added what its own errors say of the error
k samples later, a linear predictor of n + 1 terms found by least squares on the samples of the fit (Ljung 1999, sec. 3.2: an output-error
model has no noise model of its own, so it gets the simplest).

What is left, ε, is judged by the two tests of Ljung 1999, sec. 16.6. *Whiteness*: ``ζ = N Σ_{τ=1}^{M} (R_ε(τ)/R_ε(0))²`` is χ² with M
degrees of freedom where ε is white. *Independence of u*: where ε does not depend on past u, ``√N R_εu(τ)`` is normal with variance ``Σ_k
R_ε(k) R_u(k)``. The first says whether the noise is understood, which an output-error model does not claim; the second whether the plant
is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.identification.friction import free_run
from quell.identification.sampling import chains
from quell.identification.search import Fit
from quell.identification.structure import lengths
from quell.types import Matrix, Vector

_ROUNDS = 6


class Residuals(NamedTuple):
    """The tests of what the simulation leaves."""

    rms: float
    """root mean square [y-unit]."""
    lags: int
    """M, how many lags the tests look at."""
    autocorrelation: Vector
    """R_ε(τ)/R_ε(0) for τ = 0 … M (M + 1,)."""
    whiteness: float
    """ζ."""
    whiteness_limit: float
    """what 99 % of white sequences stay below."""
    cross_correlation: Vector
    """between ε and u, both of variance 1, for ε later than u by τ = −M … M samples (2 M + 1,)."""
    cross_limit: float
    """what 99 % of them stay within, where ε does not depend on u."""

    @property
    def white(self) -> bool:
        """Whether ε passes for white, at 99 %."""
        return self.whiteness <= self.whiteness_limit

    @property
    def independent(self) -> bool:
        """Whether no more than 1 % of the correlations with past u (τ ≥ 0), but at least one, lie outside of the limit."""
        outside = np.abs(self.cross_correlation[self.lags :]) > self.cross_limit
        return bool(np.count_nonzero(outside) <= max(1, round(0.01 * outside.size)))


def nrmse(y: Vector, predicted: Vector) -> float:
    """Return the fit in %; 100 is perfect, 0 no better than the mean."""
    return float(100.0 * (1.0 - np.linalg.norm(y - predicted) / np.linalg.norm(y - np.mean(y))))


def simulated(fit: Fit, v: Matrix, y: Vector | None = None) -> Vector:
    """Return the simulated output for the inputs ``v``, of which that of friction, if there is one, is taken from the model's own speed.

    With ``y`` it starts where ``y`` says, by least squares: a simulation has to be told n numbers, like any other. Without it starts as
    the samples that the model was fitted to.
    """
    structure, theta = fit.structure, fit.found.theta
    if y is None:
        return _kept(free_run(structure, theta, v, own_friction=True)[0])
    theta = theta.copy()
    theta[-structure.order :] = 0.0
    free = chains(structure.denominator(theta), np.zeros((y.size, 0)))[:, :, 0]
    size = lengths(free)
    predicted = _kept(free_run(structure, theta, v)[0])
    # With friction the start decides on the sign of the speed, and that on the start.
    for _ in range(_ROUNDS if structure.rubbing else 1):
        theta[-structure.order :] += (
            np.linalg.lstsq(free / size, y - predicted, rcond=1e-12)[0] / size
        )
        predicted = _kept(free_run(structure, theta, v, own_friction=True)[0])
    return predicted


def _kept(predicted: Vector) -> Vector:
    """Return a simulated output, or say that there is none."""
    if not np.all(np.isfinite(predicted)):
        raise ValueError(
            "order: the model that was found runs away when it is simulated; lower the order, or give integrators"
        )
    return predicted


class Predictor(NamedTuple):
    """Of the error of a simulation, ``horizon`` samples ahead, from its values now and at multiples of ``horizon`` before."""

    horizon: int
    weights: Vector

    @classmethod
    def fitted(cls, error: Vector, horizon: int, terms: int) -> Predictor:
        """Return the predictor of least squares."""
        past, ahead = cls._parts(error, horizon, terms)
        return cls(
            horizon, np.asarray(np.linalg.lstsq(past, ahead, rcond=1e-12)[0], dtype=np.float64)
        )

    def fit_percent(self, y: Vector, error: Vector) -> float:
        """Return the fit of what is predicted of ``y`` whose simulation has this error."""
        past, ahead = self._parts(error, self.horizon, self.weights.size)
        later = y[y.size - ahead.size :]
        return nrmse(later, later - (ahead - past @ self.weights))

    @staticmethod
    def _parts(error: Vector, horizon: int, terms: int) -> tuple[Matrix, Vector]:
        first = horizon * terms
        past = [
            error[first - (j + 1) * horizon : error.size - (j + 1) * horizon] for j in range(terms)
        ]
        return np.column_stack(past), error[first:]


def residuals(error: Vector, u: Vector, lags: int) -> Residuals:
    """Return the tests of the errors of a simulation (N,) with the input ``u`` (N,)."""
    from scipy.stats import chi2, norm

    e, v = error - np.mean(error), u - np.mean(u)
    count = e.size
    re, ru, cross = (_correlation(*pair, lags) for pair in ((e, e), (v, v), (e, v)))
    # Without any error there is nothing to correlate.
    power = re[lags] or 1.0
    auto = re[lags:] / power
    scale = float(np.sqrt(power * ru[lags]))
    # Correlations beyond the lags looked at count as none.
    variance = max(float(np.sum(re * ru)), 0.0) / scale**2
    return Residuals(
        rms=float(np.sqrt(np.mean(error**2))),
        lags=lags,
        autocorrelation=auto,
        whiteness=float(count * np.sum(auto[1:] ** 2)),
        whiteness_limit=float(chi2.ppf(0.99, lags)),
        cross_correlation=cross / scale,
        cross_limit=float(norm.ppf(0.995) * np.sqrt(variance / count)),
    )


def _correlation(a: Vector, b: Vector, lags: int) -> Vector:
    """Return ``mean(a[k + τ] b[k])`` for τ = −lags … lags."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(a.size + lags, real=True)
    found = irfft(rfft(a, size) * np.conj(rfft(b, size)), size) / a.size
    return np.concatenate([found[size - lags :], found[: lags + 1]])
