"""``identify_b0``: b0, lag and delay of a plant from a record of its running loop."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
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
from quell.identification.given_records import resolution_of
from quell.identification.loop_search import (
    fits,
    gain,
    is_usable,
    mixture,
    physical,
    total_delay,
    visible_up_to,
    weighted,
)
from quell.identification.running_loop import Inputs, LoopFit
from quell.identification.validation import residuals
from quell.parallel import one_blas_thread
from quell.types import Matrix, Vector

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
