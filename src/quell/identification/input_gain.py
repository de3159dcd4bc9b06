"""``identify_b0``: b0, lag and delay of a plant from a record of its running loop.

Averages over the fits of several forms: means, physical units, the visible frequencies.

The search for a plant behind a lag and a delay: starts, and the forms of the model.

Each form, with or without lag, delay and drifting load, is fitted from several starts: the
denominators of ``initial_estimate`` and that of a chain of integrators, a grid of delays or lags,
and of a few bandwidths of the predictor. Forms with a drifting load are left out if the output
error alone is white. Those with a load that forgets start at the ones whose load does not. In a
loop the plant may be unstable, so unstable denominators are among the starts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.identification.bandwidth import (
    Candidate,
    Reach,
    SimpleController,
    bandwidth,
    near,
    pid_of_margin,
)
from quell.identification.delays import delayed
from quell.identification.identify import resolution_of
from quell.identification.model import Structure, autocorrelation, linear_columns, nonzero_lengths
from quell.identification.running_loop import (
    Form,
    Inputs,
    LoopFit,
    fit,
    is_exact,
    is_unstable,
    placed,
    power,
    responses,
)
from quell.identification.starts import equation, filtered_estimates
from quell.identification.validation import residuals
from quell.parallel import one_blas_thread
from quell.types import Matrix, Vector

# ---- Averages over the fits of several forms ----

# Least ratio of the power that u causes in y to that of noise, by frequency, that shows the plant.
_VISIBLE = 1.0
# Parts of the record over which spectra are averaged: chosen by hand.
_SEGMENTS = 16


def _places(one: LoopFit) -> list[int]:
    """Return the places of a, b, τ and T in the covariance of a fit; −1 for what it has not.

    Of several b it is the first.
    """
    form = one.form
    first = form.times.start
    lag, delay = first if form.lag else -1, form.size - 1 if form.delay else -1
    return [*range(form.order), form.size, lag, delay]


def physical(one: LoopFit, unit: float, dt: float) -> tuple[Vector, Matrix]:
    """Return the units of a (ascending), b, τ, T, and their covariance with a descending."""
    n = one.form.order
    scale = np.concatenate([dt ** (np.arange(float(n)) - n), [unit, dt, dt]])
    places = _places(one)
    known = np.array([place >= 0 for place in places])
    covariance = one.covariance[np.ix_(places, places)] * np.outer(known, known)
    order = np.r_[np.arange(n)[::-1], n : n + 3]
    return scale, (covariance * np.outer(scale, scale))[np.ix_(order, order)]


def gain(one: LoopFit) -> tuple[float, float]:
    """Return b and its deviation, in units of a sample."""
    place = one.form.size
    return float(one.beta[0]), math.sqrt(max(float(one.covariance[place, place]), 0.0))


def gains(one: LoopFit) -> tuple[Vector, Matrix]:
    """Return all b (m,) and their covariance, in units of a sample."""
    places = one.form.gains_of_u
    return one.beta[: one.form.actuators], one.covariance[places, places]


def total_delay(one: LoopFit) -> tuple[float, float]:
    """Return τ + T and its deviation [samples]."""
    if one.form.share is not None:
        place = one.form.times.start
        return float(one.phi[place]), math.sqrt(max(float(one.covariance[place, place]), 0.0))
    places = [place for place in _places(one)[-2:] if place >= 0]
    variance = float(np.sum(one.covariance[np.ix_(places, places)]))
    total = one.form.lag_of(one.phi) + one.form.delay_of(one.phi)
    return total, math.sqrt(max(variance, 0.0))


def mixture(estimates: list[tuple[float, float]], weights: Vector) -> tuple[float, float]:
    """Return mean and deviation of the mixture of values with deviations."""
    values, spreads = np.array(estimates).T
    mean = float(weights @ values)
    return mean, math.sqrt(float(weights @ (spreads**2 + (values - mean) ** 2)))


def visible_up_to(best: LoopFit, u: Matrix, dt: float) -> float:
    """Return the frequency up to which u moves y by more than the noise does [rad/s].

    It compares the spectrum of u behind the plant with that of the error behind the noise's model,
    whose gains hold for an unstable plant, too.
    """
    from scipy.signal import welch

    length = min(max(64, u.shape[0] // _SEGMENTS), best.error.size)
    frequency, moving = welch(u @ best.beta[: best.form.actuators], nperseg=length)
    _, disturbing = welch(best.error, nperseg=length)
    omega = 2.0 * math.pi * frequency[1:]
    of_u, of_error = responses(best.form, best.phi, best.error.size, omega)
    with np.errstate(all="ignore"):
        moved = of_u**2 * moving[1:]
        seen = np.flatnonzero(moved > _VISIBLE * of_error**2 * disturbing[1:])
    return float(omega[seen[-1]]) / dt if seen.size else 0.0


# ---- The search for a plant behind a lag and a delay ----

# Bandwidths of the predictor [1/sample], number of delays and lags, number of denominators, and the
# shares of a lag in the sum of lag and delay, of the starts. Chosen by hand, so that the trial of
# benchmarks/running_loop.py finds the same minimum as a start at the true plant.
_RATES, _GRID, _DENOMINATORS, _SHARES = (0.01, 0.05, 0.2), 6, 3, (0.2, 0.5, 0.8)
# Difference in AIC up to which a division of lag and delay is open, as in the mean of models; the
# difference in b, in its deviations, from which on it matters; the shares of the lag that count.
_OPEN, _SAME, _DIVISIONS = 20.0, 0.5, (0.2, 0.4, 0.6, 0.8)
# Rates at which loads forget, of the starts [1/sample].
_FORGETTING = (0.001, 0.01, 0.1)
# Poles of the filters that give unstable denominators [1/sample] and their number, and the number
# of these denominators that are tried.
_FILTERS, _UNSTABLE = (0.003, 0.5, 6), 2
# Lags of the test of whiteness, and its level: as in ``best_start``.
_LAGS, _LEVEL = 50, 1e-3


def fits(order: int, most: float, u: Inputs, y: Vector) -> list[LoopFit]:
    """Return the fits of all forms, for delays and lags of up to ``most`` samples at the start.

    u may begin before y; see ``running_loop``.
    """
    plant = Form(order, False, False, False, actuators=u.u.shape[1], couplings=couplings(order, u))
    a = _denominators(plant, most, u, y)
    found = _family(plant, [], [*a], most, u, y)
    best = min(found, key=lambda one: one.aic)
    if not (is_exact(best, y) or _white(best, y)):
        a = [best.phi[:order], *a]
        placed_ones = [placed(one, rate) for one, rate in product(a, _RATES)]
        drifting = _family(plant, found, placed_ones, most, u, y)
        found += drifting + [_forgetting(one, u, y) for one in drifting]
    return found + _divided(found, u, y)


def _divided(found: list[LoopFit], u: Inputs, y: Vector) -> list[LoopFit]:
    """Return fits with given shares of the lag in the sum of lag and delay, if data leave it open.

    How the sum is divided moves b. Where a lag alone or a delay alone fits nearly as well, neither
    its own deviation nor that of the fit of both, to first order, holds b's: the mean over shares
    that are spread evenly does.
    """
    form = min(found, key=lambda one: one.aic).form
    alike = [one for one in found if one.form[3:5] == form[3:5]]
    both = next(one for one in alike if one.form.lag and one.form.delay)
    ends = [one for one in alike if one.form.lag != one.form.delay]
    near = [gains(one) for one in (both, *ends) if one.aic <= both.aic + _OPEN]
    values = np.array([value for value, _ in near])
    deviations = np.sqrt(np.maximum([np.diag(covariance) for _, covariance in near], 0.0))
    if np.all(np.ptp(values, axis=0) <= _SAME * np.min(deviations, axis=0)):
        return []  # also if only the fit of both is near
    # A gain of u_l of one fit may have no stable predictor with the lag of another.
    of_lag = both.form.gains.stop - 1
    tried = []
    for one in (both, *ends):
        total = float(np.sum(one.phi[one.form.times]))
        phi = np.append(one.phi[: one.form.times.start], total)
        if both.form.drift and not one.form.lag:
            phi = np.insert(phi, of_lag, 0.0)
        tried.append(phi)
        if both.form.drift and one.form.lag:
            tried.append(np.where(np.arange(phi.size) == of_lag, 0.0, phi))

    def at(share: float) -> LoopFit:
        form = both.form._replace(share=share)
        return fit(form, min(tried, key=lambda phi: power(form, phi, u, y)), u, y)

    return [at(share) for share in _DIVISIONS]


def couplings(order: int, u: Inputs) -> tuple[tuple[int, int], ...]:
    """Return number and derivative of the y of other axes, those below the order."""
    return tuple(product(range(u.others.shape[1]), range(order)))


def _late(u: Inputs, y: Vector, delay: int) -> Matrix:
    """Return u later by some samples, y of the other axes, and a constant (N, all)."""
    late = [delayed(each, delay)[each.size - y.size :] for each in u.u.T]
    return np.column_stack([*late, u.others, np.ones(y.size)])


def _denominators(plant: Form, most: float, u: Inputs, y: Vector) -> list[Vector]:
    order = plant.order
    degrees = (0,) * plant.actuators + (order - 1,) * u.others.shape[1] + (0,)
    structure = Structure(order, 0, degrees)
    v = _late(u, y, round(0.25 * most))
    estimates = filtered_estimates(structure, v, y)[:_DENOMINATORS]
    found = [structure.denominator(theta) for theta in estimates if np.all(np.isfinite(theta))]
    return [np.zeros(order), *found, *_unstable(structure, most, u, y)]


def _unstable(structure: Structure, most: float, u: Inputs, y: Vector) -> list[Vector]:
    """Return the best unstable denominators by least squares on filtered signals.

    ``filtered_estimates`` mirrors unstable poles into the left half plane: in an open loop the
    noise is their reason. In a loop the plant may have them.
    """
    n, many = structure.order, u.u.shape[1]
    form = Form(n, False, True, False, actuators=many, couplings=couplings(n, u))
    found = []
    for rate in np.geomspace(*_FILTERS):
        prefilter: Vector = np.poly(np.full(n, -rate)).real[:0:-1].astype(np.float64)
        for delay in (0, round(0.25 * most)):
            v = _late(u, y, delay)
            target, regressors = equation(
                structure, prefilter, linear_columns(structure, prefilter, v), y
            )
            size = nonzero_lengths(regressors)
            theta = np.linalg.lstsq(regressors / size, target, rcond=1e-14)[0] / size
            phi = np.append(structure.denominator(theta), float(delay))
            if is_unstable(form, phi, y.size):
                found.append((power(form, phi, u, y), phi[:-1]))
    return [a for _, a in sorted(found, key=lambda one: one[0])[:_UNSTABLE]]


def _family(
    plant: Form, steady: list[LoopFit], starts: list[Vector], most: float, u: Inputs, y: Vector
) -> list[LoopFit]:
    """Return the fits with neither, one and both of lag and delay.

    They have a load that drifts if the fits without loads, ``steady``, are given; each form then
    starts at its own of these, too.
    """
    drift, order = bool(steady), plant.order

    def best(lag: bool, delay: bool, tried: list[Vector]) -> LoopFit:
        form = plant._replace(lag=lag, delay=delay, drift=drift)
        for one in steady:
            if one.form[1:3] == form[1:3]:
                gains = [placed(one.phi[:order], rate)[order:] for rate in _RATES]
                zero = np.zeros(int(lag))
                times = one.phi[one.form.times]
                tried = tried + [np.hstack([one.phi[:order], each, zero, times]) for each in gains]
        return fit(form, min(tried, key=lambda phi: power(form, phi, u, y)), u, y)

    times = np.geomspace(0.5, max(most, 1.0), _GRID)
    late = best(False, True, [np.append(phi, T) for phi in starts for T in (0.0, *times)])
    shared = late.phi[:-1]
    # A lag has a gain of its own where loads drift.
    behind = np.append(shared, np.zeros(int(drift)))
    slow = best(True, False, [np.append(behind, tau) for tau in (*times, max(late.phi[-1], 0.1))])
    plain = best(False, False, [shared, *starts])
    found = ((behind, late.phi[-1]), (slow.phi[:-1], slow.phi[-1]))
    parts = [(*one, share) for one in found for share in _SHARES]
    both = [np.append(phi, [share * T + 0.1, (1.0 - share) * T]) for phi, T, share in parts]
    return [plain, late, slow, best(True, True, both)]


def _forgetting(one: LoopFit, u: Inputs, y: Vector) -> LoopFit:
    """Return the fit of the same form with a load that forgets."""
    form, place = one.form._replace(forgets=True), one.form.gains.stop
    tried = [np.insert(one.phi, place, rate) for rate in _FORGETTING]
    return fit(form, min(tried, key=lambda phi: power(form, phi, u, y)), u, y)


def _white(found: LoopFit, y: Vector) -> bool:
    """Return whether the error passes the test of whiteness of ``residuals``."""
    from scipy.stats import chi2

    lags = min(_LAGS, y.size // 4)
    correlation = autocorrelation(found.error, lags)
    return float(y.size * np.sum(correlation[1:] ** 2)) <= float(chi2.isf(_LEVEL, lags))


# ---- b0, lag and delay of a plant from a record of its running loop ----

# Least number of samples for each parameter, as in ``identify``.
_SAMPLES_PER_PARAMETER = 10
# Longest delay and lag at the start by default [samples], and as a share of the record.
_MOST_DELAY, _MOST_SHARE = 20, 0.05
# Factor of the delays in a second search, where the first one ends nowhere: by hand.
_LONGER = 5.0
# A relative deviation from here on says nothing for a design: its 95 % interval is ±30 %, as far as
# b0 may be off with little loss (Herbst, *Electronics* 2, 2013, sec. 3).
_POOR = 0.15
# Deviations within which the interval of 95 % lies, and within which a lag or delay may be zero
# (99.7 %).
_WITHIN_95, _WITHIN_99 = 1.96, 3.0
# Deviations by which a gain must differ from zero for its u to count as recorded: noise is beyond
# them in one of 16 000 cases.
UNSEEN = 4.0
# Longest delay of a loop that is analysed [samples], as in ``quell.plants.linear``.
_MOST_SAMPLES = 200
# Least motion of u and y, and the inverse of their largest size: their squares are numbers then.
_LEAST_SIZE = 1e-100
# Share of the largest difference of AIC whose model still has a weight: exp(−20/2) = 5e-5.
_MOST_DIFFERENCE = 20.0
# Numbers of the result in JSON.
_IN_JSON = (
    *("order", "b0", "b0_std", "lag", "lag_std", "delay", "delay_std", "total_delay"),
    *("total_delay_std", "dt", "samples", "noise", "omega_max", "white", "independent"),
    *("converged", "white_in_motion", "rejected", "refusal"),
)
# Counts of an encoder in a sample from which on rounding is white (Widrow & Kollár, *Quantization
# Noise*, 2008, ch. 20), and such samples that the test needs for each of its lags: by hand.
_MOVING, _MOVING_PER_LAG = 2.0, 4
# Error relative to y's n-th difference, what u moves in a sample, that is rounding of a simulation.
_EXACT = 1e-4
# Difference of N log Σ e² from which on two fits do not have the same error: as ``_STALLED``.
_SAME_ERROR = 0.1


# What to do, and what a plant of another form may be.
_EXCITE = "record a reference or a u that moves faster and farther, or for a longer time"
_OTHER_FORM = (
    "the plant is of this form: it may have a resonance, as of a flexible coupling, friction, play "
    "or zeros; look for it with quell identify --order 4 --zeros 2 or --friction, and tune for "
    "that plant, or record a motion that is slower than a resonance and faster than friction"
)


class Bandwidth(NamedTuple):
    """The largest omega_c that keeps a phase margin."""

    omega_c: float  #: [rad/s]
    std: float  #: its standard deviation [rad/s]; NaN if the margin is lost within that of b0
    ratio: float  #: omega_o over omega_c


class MarginError(ValueError):
    """No omega_c keeps the phase margin that was asked for, or the record does not show one."""

    def __init__(self, message: str, best: Reach | None = None) -> None:
        super().__init__(message)
        stable = best is not None and not math.isnan(best.omega_c)
        #: the best phase margin [degrees], its omega_c [rad/s] and omega_o/omega_c; None for none
        self.phase_margin = best.phase if best is not None and stable else None
        self.omega_c = best.omega_c if best is not None and stable else None
        self.ratio = best.ratio if best is not None and stable else None


@dataclass(frozen=True, eq=False)
class InputGain:
    """The gain of a plant ``y^(n) = f + b0 u`` with its deviation, its lag and its delay.

    ``str()`` gives the report; ``omega_c`` the bandwidth that keeps a phase margin.
    """

    order: int  #: n
    b0: float  #: [y-unit/u-unit/s^n]
    b0_std: float  #: its standard deviation
    den: Vector  #: ``s^n + a_{n−1} s^(n−1) + … + a_0``, descending
    lag: float  #: time constant of the actuator [s]; 0.0 if the best model has none
    lag_std: float  #: its standard deviation [s]; 0.0 if the best model has none
    delay: float  #: delay of u [s]; 0.0 if the best model has none
    delay_std: float  #: its standard deviation [s]; 0.0 if the best model has none
    total_delay: float  #: lag and delay together [s], which is known better than its parts
    total_delay_std: float  #: its standard deviation [s]
    dt: float  #: sample time of the record [s]
    samples: int  #: number of samples of the record
    noise: float  #: root mean square of the error of the prediction one sample ahead [y-unit]
    omega_max: float  #: frequency up to which the record shows the plant [rad/s]
    white: bool  #: whether the error of the prediction is white, at 99 %
    independent: bool  #: whether it is independent of the u before, at 99 %
    converged: bool  #: whether the search ended at a minimum
    covariance: Matrix  #: of ``den`` without its 1, b0, lag and delay, of the best model
    #: whether the error is white where y moves by two counts of its rounding or more in a sample;
    #: ``white`` if y is not rounded. A rounded y at rest has an error that is not white
    white_in_motion: bool = True

    @property
    def interval(self) -> tuple[float, float]:
        """Interval in which b0 lies with a probability of 95 %, unless the form is ``rejected``."""
        half = _WITHIN_95 * self.b0_std
        return self.b0 - half, self.b0 + half

    @property
    def is_poor(self) -> bool:
        """Whether the excitation is too poor: the interval of b0 is wider than ±30 %."""
        return not self.b0_std < _POOR * abs(self.b0)

    @property
    def rejected(self) -> bool:
        """Whether the record rejects the form of the plant, so that b0 and deviations do not hold.

        The error depends on past u, or is not white (``white_in_motion``), or the search did not
        converge.
        """
        return not (self.independent and self.white_in_motion and self.converged)

    @property
    def refusal(self) -> str:
        """Why ``omega_c`` is not computed, and what to do; empty if it is."""
        if self.is_poor:
            return f"omega_c not computed, as b0 is not known; {_EXCITE}"
        if self.rejected:
            return f"omega_c not computed, as the record does not show that {_OTHER_FORM}"
        if self.omega_max == 0.0:
            return (
                "omega_c not computed, as at no frequency u moves y by more than noise does; "
                f"{_EXCITE}"
            )
        return ""

    @property
    def shortcomings(self) -> tuple[str, ...]:
        """Reasons not to rely on the result; empty for a good one."""
        found = []
        if self.is_poor:
            low, high = self.interval
            asked = ""
            if not abs(self.b0) > UNSEEN * self.b0_std:
                asked = "; this u moves y by no more than noise does: is it u that was recorded?"
            found.append(
                f"the excitation is too poor: b0 may be anything from {low:.4g} to {high:.4g}; "
                f"{_EXCITE}{asked}"
            )
        if not self.converged:
            found.append("the search did not converge; record longer, or check the order")
        if not self.independent:
            found.append(
                "the error depends on past u, so the plant is not of this form (order, a "
                "resonance, zeros, friction, limits that the recorded u does not have): the "
                "deviations are too small"
            )
        elif not self.white_in_motion:
            found.append(
                "the error is not white, so plant or load are not of this form (a resonance, "
                "friction): the deviations are too small"
            )
        elif not self.white:
            found.append(
                "the error is not white, as that of the rounding of y at rest: the deviations may "
                "be too small"
            )
        return tuple(found)

    def omega_c(self, phase_margin: float = 60.0, ratio: float | None = None) -> Bandwidth:
        """Return the largest omega_c that keeps a phase margin, its deviation, and the ratio.

        It is that of the exactly sampled loop of the fitted plant, with lag and delay, and an ADRC
        with a model-free ESO and this b0. The deviation follows from those of all parameters, to
        first order. omega_o is at most half of the sample rate 1/dt.

        Parameters
        ----------
        phase_margin
            [degrees], above 0 and below 90.
        ratio
            omega_o over omega_c. By default nine ratios from 3 to 100 are tried; of those whose
            omega_c is at least 0.9 times the largest, the least is taken: it has the least noise in
            u. With ``y'' = b u`` a ratio of 5 has 41° at most, and 60° need one of 30 or more.

        Raises
        ------
        MarginError
            (a ``ValueError``) for a plant with which no omega_c keeps the margin; it has the best
            one. Also for a record that does not show one (``refusal``).
        ValueError
            for an argument out of range, or a b0 of zero.
        """
        margin, ratio = asked_margin(phase_margin, ratio)
        if self.b0 == 0.0:
            raise ValueError("b0 is zero: there is no loop; record u and y while u moves y")
        if self.refusal:
            raise MarginError(self.refusal)
        asked = f"{margin:g}° of phase margin"
        if self.delay > _MOST_SAMPLES * self.dt:
            rule = f"the delay of {self.delay:.4g} s is longer than {_MOST_SAMPLES} samples"
            raise MarginError(f"omega_c for {asked} is not computed: {rule}")
        at, loops = self._loops()
        with one_blas_thread():
            found = bandwidth(loops(at), margin, ratio)
            if not found.keeps:
                other = None if ratio is None else bandwidth(loops(at), margin)
                raise MarginError(_not_reached(asked, found, ratio, other), found)
            slope = np.zeros(at.size)
            for i, spread in enumerate(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).tolist()):
                for step in (spread, -spread) if spread > 0.0 else ():
                    changed = loops(at + step * np.eye(at.size)[i])
                    moved = near(changed, margin, found.omega_c, found.ratio)
                    slope[i] = (moved - found.omega_c) / step
                    if not math.isnan(moved):
                        break
        variance = float(slope @ self.covariance @ slope)
        std = math.sqrt(variance) if variance >= 0.0 else math.nan
        return Bandwidth(found.omega_c, std, found.ratio)

    def _loops(self) -> tuple[Vector, Callable[[Vector], Candidate]]:
        """Return a, b, lag and delay, and the loops of a plant with such values."""
        n = self.order

        def loops(values: Vector) -> Candidate:
            # The gain that the observer assumes stays b0 where the plant's gain changes.
            den, times = np.append(1.0, values[:n]), np.maximum(values[n + 1 :], 0.0).tolist()
            return Candidate(float(values[n]), den, *times, b0=self.b0, dt=self.dt)

        return np.concatenate([self.den[1:], [self.b0, self.lag, self.delay]]), loops

    def beside(self, found: Bandwidth, phase_margin: float = 60.0) -> SimpleController | None:
        """Return the PI or PID controller (this for order 2) that keeps the same phase margin.

        Of PI controllers, and PID with ``T_i = 4 T_d``, it is the one with the largest k_i. None
        for a larger order, and where none keeps the margin.

        Parameters
        ----------
        found
            result of ``omega_c``.
        phase_margin
            that of ``omega_c`` [degrees].
        """
        margin, _ = asked_margin(phase_margin, None)
        at, loops = self._loops()
        with one_blas_thread():
            reach = Reach(found.omega_c, found.ratio, margin, True)
            return pid_of_margin(loops(at), margin, reach)

    def describe(self) -> str:
        """Return the report as text."""
        low, high = self.interval
        unit = f"y-unit/u-unit/s^{self.order}" if self.order > 1 else "y-unit/u-unit/s"
        holds = f"95 %: {low:.5g} to {high:.5g}"
        if self.rejected:
            holds = "a deviation within this form only, which the record rejects"
        shown = f"the record shows the plant up to {self.omega_max:.4g} rad/s"
        if self.omega_max == 0.0:
            shown = "at no frequency u moves y by more than noise does"
        lines = [
            f"b0 = {self.b0:.5g} ± {self.b0_std:.2g} {unit}, {holds}",
            time_line("actuator's lag", self.lag, self.lag_std),
            time_line("delay", self.delay, self.delay_std),
            f"both together {seconds_text(self.total_delay, self.total_delay_std)}",
            f"{shown}; error of the prediction: RMS {self.noise:.3g}",
            *(f"NOT: {text}" for text in self.shortcomings),
        ]
        return "\n".join(lines)

    __str__ = describe

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON; None for numbers that are not finite."""
        from quell.files import nonfinite_to_none

        value = {name: getattr(self, name) for name in _IN_JSON}
        value |= {"interval_95": None if self.rejected else self.interval}
        value |= {"den": self.den.tolist()}
        value |= {"shortcomings": self.shortcomings}
        return dict(nonfinite_to_none(value))


def identify_b0(
    u: Any, y: Any, dt: float, order: int, *, max_delay: float | None = None
) -> InputGain:
    """Find b0, the actuator's lag and the delay in a record of a running loop.

    The plant is ``y^(n) + a_{n−1} y^(n−1) + … + a_0 y = b0 u_l + load``, where u_l is u behind a
    lag and a delay, under a drifting load and noise in y (``quell.identification.running_loop``
    has the equations). The controller need not be known: the prediction-error method is consistent
    in a loop of any controller, as long as u is what reached the plant, and it does not need a
    stable plant: an unstable one is predicted, not simulated. All twelve forms of the model, with
    or without lag and delay, under no load, one that drifts or one that forgets, are fitted; b0 is
    their mean with weights like Akaike's, and its deviation that of the mixture of their
    distributions (Burnham & Anderson, *Model Selection and Multimodel Inference*, 2nd ed. 2002,
    sec. 6.7)::

        w_i ∝ exp(−AIC_i/2 + t_i),    b0 = Σ w_i b_i,    std² = Σ w_i (var_i + (b_i − b0)²)

    t_i is the number of parameters of the lag and the delay. They do not count against a form: one
    without either often fits as well, with a gain that is off by several of its own deviations.
    Where the record leaves open how lag and delay divide their sum, and this moves b0, fits with
    given divisions belong to the mean, too.

    The first samples of y, up to one more than the longest delay at the start, are left out: they
    depend on u before the record.

    Parameters
    ----------
    u
        input of the plant as it was applied, behind limits (N,) [u-unit]; held between samples.
    y
        measured output (N,) [y-unit], each at the time when its u began to act.
    dt
        sample time [s].
    order
        n, the order of the plant for ADRC, 1 to 4: u acts on the n-th derivative of y. With a lag,
        order 1 is not distinguished from order 2 by the record: give that of the controller.
    max_delay
        longest delay or lag to start the search at [s]; by default 20 samples, and 100 where no
        model of this form holds with these; at most a twentieth of the record.

    Raises
    ------
    ValueError
        for an argument out of range, a record that is too short or constant, or a plant for which
        no model was found.

    Examples
    --------
    >>> import numpy as np
    >>> import quell as ql
    >>> t = np.arange(2000) * 0.01
    >>> r = np.sin(0.3 * t**1.7)
    >>> observer = ql.ESO.model_free(order=1, b0=2.0, omega_o=20.0, dt=0.01)
    >>> controller, y, u = ql.ADRC(observer, omega_c=4.0), np.zeros(t.size), np.zeros(t.size)
    >>> for k in range(t.size - 1):
    ...     u[k] = controller.step(r[k], y[k])
    ...     y[k + 1] = np.exp(-0.01) * y[k] + 3.0 * (1.0 - np.exp(-0.01)) * u[k]
    >>> round(ql.identification.identify_b0(u[:-1], y[:-1], 0.01, order=1).b0, 4)
    3.0
    """
    u, y = checks.vector("u", u), checks.vector("y", y)
    checks.vector("y", y, u.size)
    dt, order = checks.positive("dt", dt, "s"), checks.whole("order", order, 1, 4)
    least = least_samples(order)
    if u.size < least:
        rule = f"must have at least {least} for order {order}; record longer"
        raise ValueError(f"u has {u.size} samples: {rule}")
    for name, value in (("u", u), ("y", y)):
        check_motion(name, value)
    most = longest_delay(max_delay, u.size, dt)
    found = _found(u, y, dt, order, most)
    longer = min(_LONGER * most, _MOST_SHARE * u.size)
    if max_delay is None and found.rejected and longer > most:
        # A delay beyond those that the search starts at looks like another form.
        other = _found(u, y, dt, order, longer)
        found = found if other.rejected else other
    return found


def _found(u: Vector, y: Vector, dt: float, order: int, most: float) -> InputGain:
    """Return the result of searches that start at delays up to ``most`` samples."""
    scale_u, scale_y = float(np.std(u)), float(np.std(y))
    before = samples_before(most, u.size)
    with one_blas_thread():
        moved = y[before:] / scale_y
        found = fits(order, most, Inputs.of(u / scale_u, moved), moved)
    usable = [one for one in found if is_usable(one)]
    if not usable:
        raise ValueError(
            f"order = {order}: no model was found; check the order, and that u belongs to y"
        )
    return _result(usable, u, y[before:], dt, scale_u, scale_y)


def check_motion(name: str, value: Vector) -> None:
    """Raise ``ValueError`` for a signal of a record that does not move, or whose size is absurd."""
    if np.ptp(value) == 0.0:
        raise ValueError(f"{name} is {value[0]:g} all through: must move")
    size = float(np.max(np.abs(value)))
    if size > 1.0 / _LEAST_SIZE or float(np.ptp(value)) < _LEAST_SIZE:
        rule = f"must move by at least {_LEAST_SIZE:g} and stay below {1.0 / _LEAST_SIZE:g}"
        remedy = "check its unit, and that the loop is stable"
        raise ValueError(f"{name} has values up to {size:.3g}: {rule}; {remedy}")


def longest_delay(max_delay: float | None, samples: int, dt: float) -> float:
    """Return the longest delay to start the search at [samples]."""
    if max_delay is None:
        return min(float(_MOST_DELAY), _MOST_SHARE * samples)
    most = checks.non_negative("max_delay", max_delay, "s") / dt
    if most > 0.25 * samples:
        raise ValueError(f"max_delay = {max_delay!r} s: must be at most a quarter of the record")
    return most


def samples_before(most: float, samples: int) -> int:
    """Return how many samples of y are left out at the begin: u before the record reaches them."""
    return math.ceil(min(most, _MOST_SHARE * samples)) + 1


def least_samples(order: int) -> int:
    """Return how many samples a record needs for a plant of an order."""
    return _SAMPLES_PER_PARAMETER * (3 * order + 6)


def is_usable(one: LoopFit) -> bool:
    """Return whether a fit has a model."""
    return bool(np.isfinite(one.aic) and np.all(np.isfinite(one.covariance)))


def weighted(found: list[LoopFit]) -> tuple[LoopFit, list[LoopFit], Vector]:
    """Return the best fit, those that count beside it, and their weights in the mean."""
    # What there is besides b0 is that of a model with free times.
    best = min((one for one in found if one.form.share is None), key=lambda one: one.aic)
    near = [one for one in found if one.aic - best.aic <= _MOST_DIFFERENCE]
    scores = np.array([one.aic - 2.0 * one.form.of_times for one in near])
    weights = np.exp(-0.5 * (scores - np.min(scores)))
    return best, near, weights / np.sum(weights)


def _result(
    found: list[LoopFit], u: Vector, y: Vector, dt: float, scale_u: float, scale_y: float
) -> InputGain:
    """Return the mean of the models, and what the best of them has besides b0."""
    best, near, weights = weighted(found)
    form, n = best.form, best.form.order
    unit = scale_y / scale_u / dt**n
    b0, b0_std = mixture([gain(one) for one in near], weights)
    total, total_std = mixture([total_delay(one) for one in near], weights)
    scale, covariance = physical(best, unit, dt)
    spreads = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    lags = min(50, y.size // 4)
    # In a loop u depends on the error of its own sample: only u before it counts.
    tests = residuals(best.error[1:], u[u.size - y.size : -1], lags)
    noise = scale_y * float(np.sqrt(np.mean(best.error**2)))
    # The rounding of a simulation is neither white nor independent, and of no matter.
    exact = noise <= _EXACT * float(np.std(np.diff(y, n)))
    moving = np.abs(np.diff(y)) >= _MOVING * resolution_of(y)
    white = exact or tests.white
    in_motion = white or bool(np.any(~moving) and white_where(best.error[1:], moving, lags))
    return InputGain(
        order=n,
        b0=unit * b0,
        b0_std=unit * b0_std,
        den=np.append(1.0, (best.phi[:n] * scale[:n])[::-1]),
        lag=form.lag_of(best.phi) * dt,
        lag_std=spreads[n + 1],
        delay=form.delay_of(best.phi) * dt,
        delay_std=spreads[n + 2],
        total_delay=total * dt,
        total_delay_std=total_std * dt,
        dt=dt,
        samples=u.size,
        noise=noise,
        omega_max=visible_up_to(best, u[:, None] / scale_u, dt),
        white=white,
        independent=exact or tests.independent,
        converged=exact or _confirmed(best, found),
        covariance=covariance,
        white_in_motion=in_motion,
    )


def white_where(error: Vector, where: Any, lags: int) -> bool:
    """Return whether an error is white in some samples, at 99 %, however its size changes.

    The sum over lags of ``(Σ e_k e_{k−τ})²/Σ (e_k e_{k−τ})²``, over pairs of such samples, is χ².
    """
    from scipy.stats import chi2

    if np.sum(where) < _MOVING_PER_LAG * lags:
        return False
    e, statistic = np.where(where, error, 0.0), 0.0
    for lag in range(1, lags + 1):
        products = e[lag:] * e[:-lag]
        statistic += float(np.sum(products)) ** 2 / (float(products @ products) or 1.0)
    return statistic <= float(chi2.ppf(0.99, lags))


def _confirmed(best: LoopFit, found: list[LoopFit]) -> bool:
    """Return whether the search converged, or that of a wider form did, at the same error.

    Rounding of an error that is small beside y can stop a search at its minimum.
    """
    flags, size = best.form[1:5], best.error.size
    power = float(best.error @ best.error)

    def is_the_same(one: LoopFit) -> bool:
        wider = all(wide >= own for wide, own in zip(one.form[1:5], flags, strict=True))
        more = float(one.error @ one.error) - power
        return wider and one.form.share is None and size * abs(more) <= _SAME_ERROR * power

    return best.converged or any(one.converged and is_the_same(one) for one in found)


def asked_margin(phase_margin: Any, ratio: Any = None) -> tuple[float, float | None]:
    """Return the checked phase margin [degrees] and ratio of omega_o to omega_c.

    Raises ``ValueError`` for one that is out of range.
    """
    margin = checks.positive("phase_margin", phase_margin, "degrees")
    if margin >= 90.0:
        raise ValueError(f"phase_margin = {phase_margin!r}: must be below 90 degrees")
    return margin, None if ratio is None else checks.positive("ratio", ratio)


def _not_reached(asked: str, best: Reach, ratio: float | None, other: Reach | None) -> str:
    """Return why no omega_c keeps the margin, and what to do."""
    which = "from 3 to 100 omega_c" if ratio is None else f"of {ratio:.3g} omega_c"
    text = f"no omega_c keeps {asked} with an omega_o {which}"
    if math.isnan(best.omega_c):
        text += ": no such loop of this plant, its lag and delay is stable"
    else:
        text += (
            f": the best is {best.phase:.3g}° with omega_c = {best.omega_c:.4g} rad/s and omega_o ="
            f" {best.ratio:.3g} omega_c"
        )
    if other is not None and other.keeps:
        return text + (
            f"; omega_o = {other.ratio:.3g} omega_c keeps it with omega_c = {other.omega_c:.4g} "
            "rad/s"
        )
    return text + "; ask for less, or sample faster and make the delay or the lag shorter"


def time_line(name: str, value: float, spread: float) -> str:
    """Return a lag or a delay with its deviation as text."""
    if value == 0.0:
        return f"{name}: none is visible"
    text = f"{name} {seconds_text(value, spread)}"
    return text if value > _WITHIN_99 * spread else f"{text}: hardly visible"


def seconds_text(value: float, spread: float) -> str:
    """Return a time and its deviation [s] in one unit, the value as exact as its deviation."""
    factor, unit = (1.0, "s") if value >= 1.0 else (1e3, "ms")
    value, spread = factor * value, factor * spread
    digits = 4
    if 0.0 < spread < value:  # the second digit of the deviation is the last one
        digits = max(4, math.ceil(math.log10(value / spread)) + 2)
    return f"{value:.{min(digits, 6)}g} ± {spread:.2g} {unit}"
