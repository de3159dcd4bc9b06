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
Economic Studies* 47, 1980). A pair of poles with little damping, found in the spectra of ε and u
(``vector_fitting``), is one of them, so that a resonance does not stay unsaid; as it is the best of
many frequencies, the limit is larger. The test also shows an order that is too low in the record of
one step, where the correlation with u does not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quell.identification.frequency_starts import continuous, moving_part
from quell.identification.model import (
    chains,
    correlation,
    free_run,
    nonzero_lengths,
    output_gradient,
)
from quell.identification.output_error import noise_model
from quell.identification.search import Fit
from quell.identification.vector_fitting import Spectra, pair_beside
from quell.types import Matrix, Vector

# Rounds that adapt the start and the signs of friction to each other: chosen by hand, not tuned.
_ROUNDS = 6
# Poles of the test for one more pole, and the probability that it fails by chance: by hand.
_EXTRA_POLES, _SELDOM = 4, 1e-3
# Fewest samples in which a pair of poles is looked for.
_LEAST_OF_PAIR = 200
# Where that is looked at: up to this phase, and at most to this frequency [rad/sample].
_LAST_PHASE, _FASTEST_CROSSOVER, _POINTS = -math.radians(200.0), 0.6, 80
# Share of the error's power that the u of the same sample explains where y is early: by hand.
_MOST_EARLY = 0.2
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


class OneMorePole(NamedTuple):
    """The test for one more pole: whether the response to u is of the model's form."""

    statistic: float  #: χ²
    limit: float  #: that it exceeds by chance in one of a thousand records
    #: largest change of G, as a share of it, that the further response stands for, up to the
    #: fastest crossover that a loop may have, with two deviations; infinite where it is not known
    misfit: float
    omega: float  #: where that is [rad/sample]


def one_more_pole(near: Linearised) -> OneMorePole:
    """Return the test for one more pole, and how much of G it is about."""
    from scipy.stats import chi2

    fit, structure = near.fit, near.fit.structure
    u_late = fit.inputs(near.u)[:, 0]
    a = structure.denominator(fit.estimate.theta)
    poles = np.abs(np.roots(np.append(1.0, a[::-1])))
    slow, fast = np.clip([np.min(poles), np.max(poles)], 3.0 / near.u.size, 1.0)
    rates = np.geomspace(slow / 3.0, min(3.0 * fast, 2.0), _EXTRA_POLES)
    columns = []
    for rate in rates.tolist():
        wider = np.convolve(np.append(a, 1.0), [rate, 1.0])[:-1]
        columns.append(_response(fit, wider, u_late - u_late[0]))
    limit = float(chi2.isf(_SELDOM, _EXTRA_POLES))
    found = _explained_by(near, np.column_stack(columns))
    if found is None:
        return OneMorePole(0.0, limit, math.inf, math.nan)
    pair = _pair_in(near, u_late)
    if pair is not None:
        bank = chains(pair, (u_late - u_late[0])[:, None])[:, :, 0]
        both = _explained_by(near, np.column_stack([*columns, bank]))
        # The pair is the best of as many frequencies as there are lines.
        more = float(chi2.isf(_SELDOM, 2)) + 2.0 * math.log(near.u.size)
        if both is not None and both.statistic > found.statistic + more:
            found, limit = both, limit + more
        else:
            pair = None
    if found.statistic <= limit:
        return OneMorePole(found.statistic, limit, 0.0, math.nan)
    longest = max(place.stop - place.start for place in structure.records(near.u.size))
    return OneMorePole(found.statistic, limit, *_misfit(fit, found, rates, pair, longest))


def _pair_in(near: Linearised, u: Vector) -> Vector | None:
    """Return a (2,) of a pair of poles with little damping that the error shows of u, else None."""
    structure = near.fit.structure
    if structure.samples or structure.friction or u.size < _LEAST_OF_PAIR:
        return None
    part = moving_part(u)
    upper, _ = pair_beside(Spectra.of(u[part], near.error[part]), np.zeros(0, dtype=complex))
    poles = continuous(np.array([upper, upper.conjugate()]))
    return np.asarray(np.poly(poles).real[:0:-1], dtype=np.float64)


def _misfit(
    fit: Fit, found: _Explained, rates: Vector, pair: Vector | None, count: int
) -> tuple[float, float]:
    """Return the largest change of G as a share of it, with two deviations, and where it is.

    With the coefficients c of the further poles λ and the changes of A, B and D_u beside them::

        ΔG/G = Σ c jω/(jω + λ) + (ΔB/A − B ΔA/A² + ΔD_u)/G

    from the slow end of a record of ``count`` samples up to where the phase of G, with delay and
    hold, is −200°: a loop with lead may have its crossover there.
    """
    structure, theta = fit.structure, fit.estimate.theta
    omega = np.geomspace(2.0 * np.pi / count, _FASTEST_CROSSOVER, _POINTS)
    s, n = 1j * omega, structure.order
    powers = s[:, None] ** np.arange(n + 1)
    A = powers @ np.append(structure.denominator(theta), 1.0)
    B = powers[:, :n] @ structure.numerators(theta)[0]
    G = B / A + structure.feedthrough(theta)
    row = np.zeros((omega.size, theta.size + rates.size + 2 * (pair is not None)), dtype=complex)
    free, degree = structure.free, structure.degrees[0]
    row[:, :free] = -powers[:, structure.integrators : n] * (B / A**2 / G)[:, None]
    row[:, free : free + degree + 1] = powers[:, : degree + 1] / (A * G)[:, None]
    if structure.direct:
        row[:, structure.common - 1] = 1.0 / G
    last = theta.size + rates.size
    row[:, theta.size : last] = s[:, None] / (s[:, None] + rates)
    if pair is not None:
        swing = G * (s**2 + pair[1] * s + pair[0])
        row[:, last:] = np.column_stack([1.0 / swing, s / swing])
    phase = np.unwrap(np.angle(G)) - omega * (fit.delay + 0.5)
    # A negative gain turns by half a turn, and integrators of the model by a quarter each.
    turned = phase - phase[0] - 0.5 * np.pi * structure.integrators
    inside = np.cumprod(turned >= _LAST_PHASE).astype(bool)
    inside[0] = True
    change = row[inside] @ found.coefficients
    spread = np.einsum("ij,jk,ik->i", row[inside].conj(), found.covariance, row[inside]).real
    size = np.abs(change) + 2.0 * np.sqrt(np.maximum(spread, 0.0))
    if not np.all(np.isfinite(size)):
        return math.inf, math.nan
    at = int(np.argmax(size))
    return float(size[at]), float(omega[at])


def _response(fit: Fit, a: Vector, u: Vector) -> Vector:
    """Return the response ``B/A`` to ``u`` (N,) from zero states, with the model's own B."""
    structure = fit.structure
    b = structure.numerators(fit.estimate.theta)[0]
    first = a.size - b.size  # one more pole, and so the next derivative
    parts = []
    for place in structure.records(u.size):
        bank = chains(a, u[place, None])[:, :, 0]
        parts.append(bank[:, first : first + b.size] @ b)
    return np.concatenate(parts)


class Linearised(NamedTuple):
    """A fit near its parameters: what all tests of its error begin with."""

    fit: Fit
    u: Vector
    error: Vector  # (N,)
    psi: Matrix  # derivatives of the output by θ (N, size)
    c: Vector  # of the model of the noise
    variance: float

    @classmethod
    def of(cls, fit: Fit, u: Vector, y: Vector) -> Linearised:
        """Return it for the record of the fit."""
        structure, theta = fit.structure, fit.estimate.theta
        v = free_run(structure, theta, fit.inputs(u), own_friction=True)[1]
        predicted, psi = output_gradient(structure, theta, v)
        error = y - predicted
        return cls(fit, u, error, psi, *noise_model(error[fit.fitted]))


class _Explained(NamedTuple):
    """What further columns explain of the error of a fit."""

    statistic: float  # χ²
    coefficients: Vector  # of the derivatives by θ, then of the columns
    extra: Vector  # the coefficients of the columns
    power: float  # of the whitened error that is left
    columns: Matrix  # whitened, of length 1 before that
    length: Vector

    @property
    def covariance(self) -> Matrix:
        """That of the coefficients."""
        half = np.linalg.pinv(self.columns, rcond=1e-9) / self.length[:, None]
        return self.power * half @ half.T


def _explained_by(near: Linearised, extra: Matrix) -> _Explained | None:
    """Return what further columns (N, k) explain beside the derivatives of the output by θ.

    All of them are whitened by the model of the noise. None without any error, or if not finite.
    """
    from scipy.signal import lfilter

    columns, known = np.column_stack([near.psi, extra]), near.psi.shape[1]
    length = nonzero_lengths(columns)
    scaled = np.column_stack([columns / length, near.error])[near.fit.fitted]
    whitened = lfilter(near.c, [1.0], scaled, axis=0)
    if not np.all(np.isfinite(whitened)) or not near.variance > 0.0:
        return None
    target, columns = whitened[:, -1], whitened[:, :-1]
    found = [np.linalg.lstsq(part, target, rcond=1e-9)[0] for part in (columns[:, :known], columns)]
    left = [float(np.sum((target - whitened[:, : one.size] @ one) ** 2)) for one in found]
    power = left[1] / max(target.size - whitened.shape[1] + 1, 1)
    coefficients, statistic = found[1] / length, (left[0] - left[1]) / power
    return _Explained(statistic, coefficients, coefficients[known:], power, columns, length)


def early_samples(near: Linearised) -> int:
    """Return by how many samples y is early against u in a record, 0 to 2; 0 as far as it is not.

    Where u acts from its own sample on, y of that sample can't depend on it. If it does, and with
    the sign of the plant, the record has y too early: a logger has stored u beside the y that came
    after it. A controller that answers noise in y at once gives the other sign.
    """
    from scipy.stats import chi2

    fit, structure, u = near.fit, near.fit.structure, near.u
    if fit.delay > 0 or structure.direct or structure.friction:
        return 0
    sign = float(structure.numerators(fit.estimate.theta)[0, structure.degrees[0]])
    same, found, share = u - u[0], 0, 0.0
    columns = [same, np.append(same[1:], same[-1])]
    for early in (1, 2):
        by = _explained_by(near, np.column_stack(columns[:early]))
        if by is None:
            break
        now = by.statistic / (by.statistic + u.size)
        certain = by.statistic > chi2.isf(_SELDOM, early) and by.extra[early - 1] * sign > 0.0
        if not certain or now - share < _MOST_EARLY * (1.0 - share):
            break
        found, share = early, now
    return found


def before_the_record(near: Linearised) -> bool:
    """Return whether another u before a record than its first one explains its first samples.

    The u that acts in the samples of the delay is not in the record.
    """
    from scipy.stats import chi2

    fit = near.fit
    if fit.delay == 0 or fit.structure.friction:
        return False
    pulse = np.zeros(near.u.size)
    for place in fit.structure.records(near.u.size):
        pulse[place.start : place.start + math.ceil(fit.delay)] = 1.0
    a = fit.structure.denominator(fit.estimate.theta)
    column = _response(fit, a, pulse)[:, None]
    found = _explained_by(near, column)
    return found is not None and bool(found.statistic > chi2.isf(_SELDOM, 1))


def curvature(near: Linearised) -> float:
    """Return the share of the error's power that a gain explains which depends on u or its sign.

    It is the response of the model to (u − mean)², and to |u| where u has both signs (a Hammerstein
    model; Narendra & Gallman, *IEEE Trans. Automatic Control* 11, 1966); zero where chance may be
    the reason.
    """
    from scipy.stats import chi2

    fit, error = near.fit, near.error[near.fit.fitted]
    u_late, a = fit.inputs(near.u)[:, 0], fit.structure.denominator(fit.estimate.theta)
    bent = [(u_late - np.mean(u_late)) ** 2]
    bent += [np.abs(u_late)] if np.min(u_late) < 0.0 < np.max(u_late) else []
    extra = np.column_stack([_response(fit, a, each - each[0]) for each in bent])
    found = _explained_by(near, extra)
    if found is None or not found.statistic > chi2.isf(_SELDOM, extra.shape[1]):
        return 0.0
    left = []
    for columns in (near.psi, np.column_stack([near.psi, extra])):
        scaled = (columns / nonzero_lengths(columns))[fit.fitted]
        rest = error - scaled @ np.linalg.lstsq(scaled, error, rcond=1e-9)[0]
        left.append(float(rest @ rest))
    return 1.0 - left[1] / left[0] if left[0] > 0.0 else 0.0


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
