"""The result of an identification: report, plots, plants."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from quell.identification.frequencies import FrequencyResponse, frequency_response, hold_of
from quell.identification.model import (
    WITHIN_95,
    Root,
)
from quell.identification.output_error import noise_model
from quell.identification.saturation import standing
from quell.identification.starts import SURE
from quell.identification.validation import Residuals
from quell.lti.canonical import format_roots
from quell.plants.base import labelled
from quell.plants.friction import with_friction_and_delay
from quell.plants.linear import LinearPlant
from quell.quantities import UNKNOWN, Quantity, Signals
from quell.records.notebook import InNotebook
from quell.records.plotting import draw_line, given_axes
from quell.types import Matrix, Vector

# ---- The parts of the plot of an identification ----

_ROWS = ("gain output", "gain output", "phase error", "phase auto", "coherence cross")
_NAMES = ("gain", "phase", "coherence", "output", "error", "auto", "cross")
# Least coherence of the empirical points that are drawn; below it, noise exceeds the response.
_COHERENT = 0.5
# Quantile of the normal distribution: 99 % of values lie within this many standard deviations.
_WITHIN_99 = 2.576


def seven_axes(axes: Any) -> list[Any]:
    """Return seven matplotlib axes, those of a new figure by default."""
    if axes is None:
        import matplotlib.pyplot as plt

        figure = plt.figure(figsize=(10.0, 7.5), layout="constrained")
        rows: list[Any] = [row.split() for row in _ROWS]
        mosaic = figure.subplot_mosaic(rows)
        axes = [mosaic[name] for name in _NAMES]
    axes = list(np.ravel(axes))
    if len(axes) != len(_NAMES):
        raise ValueError(f"axes: must be {len(_NAMES)} matplotlib axes, got {len(axes)}")
    return axes


def draw_bode(
    axes: list[Any],
    measured: FrequencyResponse,
    response: Callable[[Any], Any],
    signals: Signals,
) -> None:
    """Draw gain, phase and coherence of the empirical response, and the model's response.

    The record of a step soon after the start has no empirical response, as u rests in all segments.
    """
    gain, phase, coherence = axes
    if measured.omega.size == 0:
        for each in axes:
            each.text(0.5, 0.5, "u moves too little", ha="center", transform=each.transAxes)
        return
    good = measured.coherence > _COHERENT
    omega = np.geomspace(measured.omega[0], measured.omega[-1], 2000)
    model = response(omega)
    dots = {"color": "0.6", "linestyle": "none", "marker": ".", "markersize": 3.0}
    points, size = measured.omega[good], np.abs(measured.response[good])
    gain.loglog(points, size, label="empirical", **dots)
    gain.loglog(omega, np.abs(model), color="C0", label="model")
    degrees = np.degrees(np.unwrap(np.angle(model)))
    # Of the measured phases, the one within half a turn of the model's.
    near = np.interp(measured.omega, omega, degrees)
    angle = near + np.degrees(np.angle(measured.response * np.exp(-1j * np.radians(near))))
    phase.semilogx(points, angle[good], **dots)
    phase.semilogx(omega, degrees, color="C0")
    coherence.semilogx(measured.omega, measured.coherence, color="0.4", linewidth=0.8)
    coherence.set_ylim(0.0, 1.05)
    unit = signals.unit("y-unit/u-unit") if signals.y.unit and signals.u.unit else ""
    size_of_G = Quantity("|G|", unit).label("")
    for ax, label in ((gain, size_of_G), (phase, "phase of G [°]"), (coherence, "coherence")):
        ax.set(ylabel=label, xlim=(omega[0], omega[-1]))
    if points.size:
        largest = max(np.max(size), np.max(np.abs(model[omega >= points[0]])))
        gain.set_ylim(0.3 * np.min(size), 3.0 * largest)
        lowest = min(np.min(angle[good]), np.min(degrees[omega <= points[-1]]))
        phase.set_ylim(lowest - 30.0, np.max(angle[good]) + 30.0)
    gain.legend(fontsize="small")
    coherence.set_xlabel("ω [rad/s]")


def draw_output(
    axes: list[Any],
    t: Vector,
    y: Vector,
    simulated: Vector,
    split: int,
    fits: dict[str, float],
    quantity: Quantity,
) -> None:
    """Draw output and error; the samples from ``split`` on were held out."""
    output, error = axes
    draw_line(output, t, y, color="0.6", linewidth=2.5, label="measured")
    for part, color, label, fit in (
        (slice(0, split), "C0", "simulated", "estimation"),
        (slice(split, t.size), "C1", "held out", "held out"),
    ):
        if part.start < t.size:
            label = f"{label}, {fits[fit]:.2f} %"
            draw_line(output, t[part], simulated[part], color=color, linewidth=1.0, label=label)
            draw_line(error, t[part], (y - simulated)[part], color=color, linewidth=0.8)
    output.set_ylabel(quantity.label("output"))
    output.legend(fontsize="small")
    error.set(xlabel="time [s]", ylabel=Quantity("error", quantity.unit).label(""))
    error.sharex(output)


def draw_tests(axes: list[Any], residuals: Residuals, samples: int) -> None:
    """Draw the correlations of the residuals, of ``samples`` samples, with their limits."""
    lags = residuals.lags
    auto, cross = axes
    for ax, first, values, limit, label in (
        (auto, 0, residuals.autocorrelation, _WITHIN_99 / math.sqrt(samples), "of the error"),
        (cross, -lags, residuals.cross_correlation, residuals.cross_limit, "with u"),
    ):
        ax.axhspan(-limit, limit, color="C2", alpha=0.2, label="99 %")
        ax.vlines(np.arange(first, lags + 1), 0.0, values, color="0.3", linewidth=1.0)
        ax.axhline(0.0, color="0.3", linewidth=0.8)
        ax.set_ylabel(f"correlation\n{label}" if ax is auto else label)
    auto.legend(fontsize="small", loc="upper right")
    cross.set_xlabel("error later than u by [samples]")


# ---- The result of an identification ----

NOTHING_HELD_OUT = (
    "nothing is held out: at the end of the record u does not move, or at other frequencies than "
    "before"
)
"""The line of a report where by default no samples are held out."""

# Width of the smooth sign of the speed, relative to the RMS speed in the record: by hand, so that
# creeping within it is far slower than motion.
_FRICTION_WIDTH = 0.02
# A pole and a zero within three standard deviations may be equal (99.7 %).
_DEVIATIONS = 3.0
# A gain whose 95 % interval is wider than this share of it is not decided: then it may be half or
# twice of what it is, beyond what a design allows for.
_WIDE = 1.0
# Largest change of G, as a share of it, that costs no margin to speak of: by hand. At a crossover
# with |L| = 1 it takes as much of the modulus margin at most, which is 0.63 for M_s = 1.6.
_NO_MATTER = 0.1
# Share of the error that a gain which depends on u explains, from which on that is the reason.
_BENT = 0.5
# A fit below it explains nothing that could be used [%]: chosen by hand.
_NOTHING = 10.0
# From here down a start at rest that was given is contradicted: three standard deviations.
_CONTRADICTED = 0.003


@dataclass(frozen=True, eq=False)
class Identified(InNotebook):
    """A transfer function found in a record, with measures of its quality.

    ``str()`` gives the whole report; ``plant`` is the model for ``ESO.model_based``.
    """

    num: Vector  #: numerator, descending powers of s
    den: Vector  #: denominator, descending powers of s; the first is 1
    covariance: Matrix  #: of the fitted coefficients, ``den`` before ``num``, ascending powers
    poles: tuple[Root, ...]
    zeros: tuple[Root, ...]
    integrators: int  #: number of poles that were set to s = 0
    delay: float  #: delay of u [s]
    bias: float  #: constant force on the plant [u-unit]; NaN if a constant u has no effect on it
    friction: float | None  #: Coulomb friction, the |u| for slow motion [u-unit]; None: not fitted
    friction_std: float  #: its standard deviation [u-unit]; NaN: not fitted
    #: 95 % interval of ``gain``; infinite at an end that the record does not tell
    gain_interval: tuple[float, float]
    delay_interval: tuple[float, float]  #: 95 % interval of the delay [s], if it was searched
    #: covariance of the delay with the coefficients in ``covariance``, then its variance [s²]
    delay_covariance: Vector
    delays_searched: tuple[float, float]  #: range in which the delay was searched [s]
    rest: bool  #: whether the model starts at rest
    rest_given: bool  #: whether the start at rest was given, not assumed
    rest_probability: float  #: of a start at rest, from the record alone; NaN if not assumed
    samples: tuple[int, ...]  #: number of samples of each record, if there are several
    dt: float  #: sample time of the record [s]
    horizon: int  #: number of samples that the predictions in ``fits`` look ahead
    #: NRMSE in %: ``"estimation"``, ``"held out"`` and ``"validation"``, as far as there are such
    #: samples, also with ``", predicted"``
    fits: dict[str, float]
    residuals: Residuals  #: tests of the error, on the last of the samples in ``fits``
    one_more_pole: float  #: χ² of a further response to u in the error of the fit
    one_more_pole_limit: float  #: limit that it exceeds by chance in one of a thousand records
    #: largest share of G by which that changes G up to the fastest crossover of a loop
    misfit: float
    misfit_omega: float  #: where that is [rad/s]; NaN: nowhere
    early: int  #: number of samples by which y is early against u; 0 if it is not
    before: bool  #: whether the first samples show that u was another one before the record
    #: share of the error's power that a gain which depends on u explains; 0 if not looked for
    curvature: float
    resolution: float  #: step that y is rounded to, 0.0 if it is not rounded [y-unit]
    held_from: int  #: index of the first held-out sample; N if none was held out
    u: Vector
    y: Vector
    simulated: Vector  #: the model's output (N,) [y-unit]; it starts again at the held-out samples
    reference: Vector | None
    converged: bool  #: whether the search ended at a minimum that a second start or tests confirm
    method: str
    signals: Signals = UNKNOWN  #: names and units of u and y
    #: number of first samples that were left out, as u before the record was another one, or y
    #: stands at a limit in them
    left_out: int = 0
    #: number of samples in which y stands at a limit; they are bounded by it, and ``y`` has there
    #: what the model says, where that is beyond the limit
    at_limits: int = 0

    @property
    def gain(self) -> float:
        """Gain ``lim s^q G(s)`` at s = 0, with q integrators [y-unit/u-unit/s^q]."""
        constant = self.den[self.den.size - 1 - self.integrators]
        return float(self.num[-1] / constant) if constant else math.inf

    @cached_property
    def noise_std(self) -> float:
        """Standard deviation of the part of y that its past does not tell [y-unit].

        The model's error is ``e = w/C(q)`` with white w, and this is the deviation of w: noise of y
        and its rounding in each sample. What a slow load adds to y from one sample to the next is
        in it, too, so it is an upper limit.
        """
        error = (self.y - self.simulated)[: self.held_from]
        _, variance = noise_model(error - np.mean(error))
        return math.sqrt(variance)

    @property
    def records(self) -> tuple[Any, Any]:
        """U and y as ``identify`` got them: arrays, or lists of arrays of several records."""
        if not self.samples:
            return self.u, self.y
        edges = np.cumsum(self.samples)[:-1]
        return np.split(self.u, edges), np.split(self.y, edges)

    @property
    def parameters(self) -> int:
        """Number of fitted parameters, those of the start of each record and the delay included."""
        order, records = self.den.size - 1, max(len(self.samples), 1)
        rubbing = 0 if self.friction is None else max(order - 1, 1)
        searched = self.delays_searched[0] < self.delays_searched[1]
        start = 1 if self.rest else order + 1
        return order - self.integrators + self.num.size + rubbing + searched + start * records

    @property
    def explained(self) -> bool:
        """True if the error has no further response to u, by the test for one more pole."""
        return self.one_more_pole <= self.one_more_pole_limit

    @property
    def rubs(self) -> bool:
        """Whether there is Coulomb friction that acts against motion, beyond chance.

        One that would drive the plant, or may be none, hides what else a record shows.
        """
        return self.friction is not None and self.friction > WITHIN_95 * self.friction_std

    @property
    def bends(self) -> bool:
        """Whether a gain that depends on u or its sign explains most of the error."""
        return self.curvature > _BENT

    @property
    def _form(self) -> str:
        """What the test for one more pole found, as text."""
        test = f"one more pole: {self.one_more_pole:.3g}, limit {self.one_more_pole_limit:.3g}"
        if not self.misfit < 1.0:
            return f"G may be off by more than itself ({test})"
        where = f"at {self.misfit_omega:.3g} rad/s"
        return f"G may be off by {100.0 * self.misfit:.2g} % {where} ({test})"

    @property
    def _gain_text(self) -> str:
        low, high = self.gain_interval
        return (
            f"it is {self.gain:.4g}, 95 %: {low:.4g} to {high:.4g}; record more rest before the "
            "first step, more steps, or a longer time"
        )

    @property
    def _gain_is_wide(self) -> bool:
        low, high = self.gain_interval
        return not high - low <= _WIDE * abs(self.gain)

    @property
    def _input_is_certain(self) -> bool:
        """Whether the effect of u on the highest derivative is certain, whatever the gain is."""
        return bool(_WIDE * abs(self.num[0]) > 2.0 * WITHIN_95 * np.sqrt(self.covariance[-1, -1]))

    @property
    def undecided(self) -> tuple[str, ...]:
        """Things that the record does not decide, each with what to do."""
        found, (low, high) = [], self.gain_interval
        if low <= 0.0 <= high and low < high and not self._input_is_certain:
            found.append(f"the record does not decide the sign of the gain: {self._gain_text}")
        elif self._gain_is_wide and not self._input_is_certain:
            found.append(f"the record does not decide the size of the gain: {self._gain_text}")
        if self.rest and not self.rest_given and self.rest_probability < SURE:
            found.append(
                "the record does not decide whether the plant was at rest before it, on which the "
                f"gain depends (probability {self.rest_probability:.2g}): if it was, give "
                "rest=True (--rest); if not, record more rest before the first step"
            )
        shortest, longest = self.delays_searched
        if shortest < longest <= self.delay + 0.5 * self.dt:
            found.append(
                f"the record does not decide the delay: {self.delay:.4g} s is the longest one that "
                "was searched; search longer ones (delay, --max-delay), or record longer"
            )
        return tuple(found)

    @cached_property
    def plant(self) -> LinearPlant:
        """The transfer function as a plant, without delay, bias and friction.

        Raises
        ------
        ValueError
            for a model with direct feedthrough.
        """
        return fitted_plant(self.num, self.den, "identified plant", self.signals)

    @property
    def shortcomings(self) -> tuple[str, ...]:
        """Reasons not to rely on the model, each with what to do; empty for a good one.

        They are the ``faults``, what is ``undecided``, a u that explains nothing, a record for
        validation of which the model is worse than the mean, a response to u that the model does
        not explain, and a start not at rest although ``rest`` says so.
        """
        found = [*self.faults, *self.undecided]
        fit = self.fits.get("held out", self.fits["estimation"])
        if fit < _NOTHING:
            found.append(
                f"u explains hardly anything of y (fit {percent(fit, 1)} %); check that they "
                "belong to each other, which is which, the order and the delay"
            )
        other = self.fits.get("validation", 100.0)
        if other < 0.0:
            found.append(
                "on the record for validation the model is worse than the mean of its y (fit "
                f"{percent(other, 1)} %); check that both are of one plant, in one unit and at one "
                "operating point, and that columns and signs are the same"
            )
        if self._gain_is_wide and self._input_is_certain:
            found.append(
                "the record does not decide the size of the gain, as the slowest pole may be at "
                f"s = 0: {self._gain_text}; if the plant integrates, set integrators"
            )
        found += [self.early_text] * bool(self.early)
        if self.before:
            found.append(
                "u was another one before the record, which acts in its first samples "
                f"({self.delay:.4g} s of delay); cut the record, so that it begins later than its "
                "first move of u"
            )
        if self.bends:
            found.append(
                "the gain depends on the operating point or on the sign of u: the response to u² "
                f"and |u| explains {100.0 * self.curvature:.0f} % of the error of a linear model; "
                "set friction, or identify in a narrow range of u, or at each operating point, for "
                "a schedule ([tune.schedule])"
            )
        elif not self.explained and self.misfit > _NO_MATTER:
            found.append(
                f"the response to u is not of this form: {self._form}; at a crossover there that "
                "takes as much of the modulus margin, 0.63 at M_s = 1.6; use a higher order, "
                "zeros, friction, or another delay"
            )
        if self.rest and self.rest_probability < _CONTRADICTED:
            found.append(
                "the first samples contradict the start at rest "
                f"(probability {self.rest_probability:.2g}); leave rest=True (--rest) out"
            )
        return tuple(found)

    @property
    def early_text(self) -> str:
        """That y is ``early`` against u, and what to do; only where it is."""
        count = f"{self.early} sample{'s' * (self.early > 1)}"
        return (
            f"y follows the u of {'the same' if self.early == 1 else 'the next'} sample, on "
            f"which it can't depend: it is early by {count}, as where u is stored beside the y "
            f"that came after it; leave out the first {count} of u and the last of y, or, if u "
            "acts on y at once, as on an acceleration, give as many zeros as poles"
        )

    @property
    def fails(self) -> bool:
        """Whether the model is worse than the mean of y on samples that were not fitted."""
        return any(self.fits.get(name, 0.0) < 0.0 for name in ("held out", "validation"))

    @property
    def faults(self) -> tuple[str, ...]:
        """Faults that the fit does not show: poles that are unstable, too fast, or cancelled."""
        fastest = math.pi / self.dt
        poles, zeros = (
            [root for root in roots if root.value.imag >= 0.0] for roots in (self.poles, self.zeros)
        )
        remedy = "if the plant is stable, use a lower order or set integrators"
        unstable = (pole for pole in poles if pole.value.real > 0.0)
        found = [f"the pole at {_format(pole)} is unstable; {remedy}" for pole in unstable]
        for kind, roots in (("pole", poles), ("zero", zeros)):
            limit = f"faster than samples show, {fastest:.4g} rad/s; use fewer {kind}s"
            fast = (root for root in roots if root.omega > fastest)
            found += [f"the {kind} at {_format(root)} is {limit}" for root in fast]
        for zero in zeros:
            near = [
                pole
                for pole in poles
                if abs(pole.value - zero.value) <= _DEVIATIONS * (pole.deviation + zero.deviation)
            ]
            if near:
                # A zero cancels one pole only, and this one no other zero.
                cancelled = min(near, key=lambda pole: abs(pole.value - zero.value))
                poles.remove(cancelled)
                found.append(
                    f"the pole at {_format(cancelled)} nearly equals a zero; use one pole and one "
                    "zero less"
                )
        return tuple(dict.fromkeys(found))

    @property
    def t(self) -> Vector:
        """Times of the samples [s]."""
        return np.arange(float(self.y.size)) * self.dt

    def response(self, omega: Any) -> Any:
        """Return the frequency response at ``omega`` [rad/s], with the delay and the hold of u.

        This is the response of the samples in a record with held u. Images of the hold, which
        matter near half the sampling rate, are left out.
        """
        s = 1j * np.asarray(omega, dtype=np.float64)
        # What acts at once is not delayed by the hold.
        direct = self.num[0] if self.num.size == self.den.size else 0.0
        rest = np.polyval(self.num, s) / np.polyval(self.den, s) - direct
        return (rest * hold_of(s, self.dt) + direct) * np.exp(-s * self.delay)

    def empirical(self, segments: int = 8) -> FrequencyResponse:
        """Return the frequency response of the record itself; see ``frequency_response``."""
        r = self.reference
        return frequency_response(self.u, self.y, self.dt, reference=r, segments=segments)

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw Bode plot, coherence, output, error, and the tests of the error; return the axes.

        Parameters
        ----------
        axes, ax
            seven matplotlib axes: gain, phase, coherence, output, error, autocorrelation,
            cross-correlation; those of a new figure by default.
        """
        axes, split = seven_axes(given_axes(axes, ax)), self.held_from
        signals = self.signals
        draw_bode(axes[:3], self.empirical(), self.response, signals)
        draw_output(axes[3:5], self.t, self.y, self.simulated, split, self.fits, signals.y)
        draw_tests(axes[5:], self.residuals, (self.y.size - split) or self.y.size)
        for each in axes:
            each.grid(alpha=0.3)
        return axes

    def describe(self) -> str:
        """Return the report as text."""
        delay = f" · exp(−{self.delay:g} s)" if self.delay else ""
        lines = [
            f"G(s) = ({polynomial_text(self.num)}) / ({polynomial_text(self.den)}){delay}",
            f"{self.method}{'' if self.converged else '; the search did NOT converge'}",
            "",
            "pole [rad/s]                  ± real      ± imag     |p|       damping",
            *(describe_root(root) for root in self.poles),
        ]
        if self.zeros:
            lines += ["zero [rad/s]", *(describe_root(root) for root in self.zeros)]
        low, high = self.gain_interval
        lines += [
            "",
            f"gain {self.gain:.5g}, 95 %: {low:.5g} to {high:.5g}{gain_of_s(self.integrators)}",
        ]
        low, high = self.delay_interval
        if low < high:
            lines += [f"delay {self.delay:.4g} s, 95 %: {low:.4g} to {high:.4g} s"]
        if self.rest:
            how = "given" if self.rest_given else "assumed"
            lines += [f"start at rest: {how} (probability {self.rest_probability:.3g})"]
        if self.left_out:
            lines += [
                f"the first {self.left_out} samples are left out: u was another one before, or y "
                "stands at a limit there"
            ]
        if self.at_limits:
            share = 100.0 * self.at_limits / self.y.size
            lines += [
                f"y stands at a limit in {self.at_limits} samples ({share:.2g} %), as of a "
                "saturated sensor: there it is bounded by it, not fitted"
            ]
        stands = standing(self.u, 0.0).samples
        if stands:
            share = 100.0 * stands / self.u.size
            lines += [
                f"u stands at a limit in {stands} samples ({share:.2g} %), as of a saturated "
                "actuator: the model holds if this u is what acts, not what was asked for"
            ]
        lines += [f"constant force {self.bias:.4g} (in units of u)"]
        if self.friction is not None:
            lines += [
                f"Coulomb friction {self.friction:.4g} ± {self.friction_std:.2g} (in units of u)"
            ]
        lines += [f"fit, {name}: {percent(value)} %" for name, value in self.fits.items()]
        tests, rounding = self.residuals, ""
        if self.resolution:
            factor = tests.rms / self.resolution * math.sqrt(12.0)
            rounding = f" ({factor:.3g} times that of rounding to {self.resolution:.3g})"
        lines += [
            f"error of the simulation: RMS {tests.rms:.3g}{rounding}",
            f"white: {'yes' if tests.white else 'no'} (zeta = {tests.whiteness:.3g}, "
            f"limit {tests.whiteness_limit:.3g}, {tests.lags} lags)",
            f"independent of past u: {'yes' if tests.independent else 'no'} "
            f"(largest correlation {_largest_correlation(tests):.3g}, "
            f"limit {tests.cross_limit:.3g})",
        ]
        if not self.explained and self.misfit <= _NO_MATTER:
            lines += [f"form of the response to u: {self._form}, which costs no margin"]
        lines += [f"NOT: {text}" for text in self.shortcomings]
        return "\n".join(lines)

    __str__ = describe

    def _draw_small(self, figure: Any) -> None:
        axes, y = figure.subplots(2, 1, sharex=True), self.signals.y
        draw_output(axes, self.t, self.y, self.simulated, self.held_from, self.fits, y)

    def __repr__(self) -> str:
        fit = self.fits.get("held out", self.fits["estimation"])
        poles = format_roots(np.array([pole.value for pole in self.poles]))
        order = self.den.size - 1
        return f"Identified(order={order}, poles {poles} rad/s, fit {percent(fit, 2)} %)"

    @property
    def friction_width(self) -> float | None:
        """Speed around which the sign of the friction is smooth in simulations [y-unit/s].

        None for a model without friction, or whose speed jumps with u.
        """
        order = self.den.size - 1
        if not self.friction or self.friction < 0.0 or (order > 1 and self.num.size >= order):
            return None
        y = self.simulated[: self.held_from]
        speed = y if order == 1 else np.diff(y) / self.dt
        return _FRICTION_WIDTH * float(np.sqrt(np.mean(speed**2))) or None

    def to_json(self) -> dict[str, Any]:
        """Return the results without the record, for JSON; None for numbers that are not finite."""
        from quell.files import nonfinite_to_none

        tests = self.residuals
        value = {
            "num": self.num.tolist(),
            "den": self.den.tolist(),
            "poles": [_root_json(root) for root in self.poles],
            "zeros": [_root_json(root) for root in self.zeros],
            "integrators": self.integrators,
            "delay": self.delay,
            "gain": self.gain,
            "gain_interval": list(self.gain_interval),
            "delay_interval": list(self.delay_interval),
            "rest": self.rest,
            "rest_given": self.rest_given,
            "rest_probability": self.rest_probability,
            "one_more_pole": self.one_more_pole,
            "one_more_pole_limit": self.one_more_pole_limit,
            "misfit": self.misfit,
            "misfit_omega": self.misfit_omega,
            "bias": self.bias,
            "friction": self.friction,
            "friction_std": self.friction_std,
            "friction_width": self.friction_width,
            "dt": self.dt,
            "early": self.early,
            "curvature": self.curvature,
            "before": self.before,
            "left_out": self.left_out,
            "at_limits": self.at_limits,
            "samples": self.y.size,
            "held_from": self.held_from,
            "horizon": self.horizon,
            "fits": self.fits,
            "residuals": {
                "rms": tests.rms,
                "lags": tests.lags,
                "whiteness": tests.whiteness,
                "whiteness_limit": tests.whiteness_limit,
                "white": tests.white,
                "independent_of_u": tests.independent,
                "largest_cross_correlation": _largest_correlation(tests),
                "cross_limit": tests.cross_limit,
            },
            "resolution": self.resolution,
            "shortcomings": self.shortcomings,
            "converged": self.converged,
            "method": self.method,
        }
        return dict(nonfinite_to_none(value))


def fitted_plant(num: Vector, den: Vector, name: str, signals: Signals) -> LinearPlant:
    """Return a fitted transfer function as a plant; a ``ValueError`` refuses direct feedthrough."""
    if num.size == den.size:
        raise ValueError(
            f"zeros = {num.size - 1}: the model has direct feedthrough, u acts on y at once; "
            "observers and simulated loops need a plant without it. Identify with fewer zeros, or "
            "use num, den and response"
        )
    plant = LinearPlant.of((num, den), name=name)
    return labelled(plant, signals.y, signals.u)


def gain_of_s(integrators: int) -> str:
    """Return what a gain with integrators is the gain of."""
    return f" (of s^{integrators} G)" if integrators > 1 else (" (of s G)" if integrators else "")


def _largest_correlation(tests: Residuals) -> float:
    """Return the largest correlation of the error with past u."""
    return float(np.max(np.abs(tests.cross_correlation[tests.lags :])))


def _root_json(root: Root) -> dict[str, float]:
    return {
        "real": root.value.real,
        "imag": root.value.imag,
        "real_std": root.real_std,
        "imag_std": root.imag_std,
        "omega": root.omega,
        "damping": root.damping,
    }


def percent(fit: float, digits: int = 3) -> str:
    """Return a fit as text; the fit of an unstable model is a large negative number."""
    return f"{fit:.{digits}f}" if fit > -1e4 else f"{fit:.3g}"


def _format(root: Root) -> str:
    return f"{format_roots(np.array([root.value]))} rad/s"


def describe_root(root: Root) -> str:
    """Return a root with its deviations as a row of text."""
    value = f"{root.value.real:.6g}" + (f"{root.value.imag:+.6g}j" if root.value.imag else "")
    damping = "" if math.isnan(root.damping) else f"{root.damping:.4f}"
    return f"{value:<28}  {root.real_std:<10.2g}{root.imag_std:<10.2g} {root.omega:<9.5g} {damping}"


def polynomial_text(coefficients: Vector) -> str:
    """Return a polynomial in s as text, from its coefficients in descending powers."""
    terms = []
    for i, value in enumerate(coefficients.tolist()):
        power = coefficients.size - 1 - i
        if value:
            symbol = "" if power == 0 else ("s" if power == 1 else f"s^{power}")
            number = f"{value:.6g}" if value != 1.0 or not symbol else ""
            terms.append(f"{number} {symbol}".strip())
    return " + ".join(terms).replace("+ -", "− ") or "0"


# ---- The identified plant with its Coulomb friction and delay, for simulations ----


def simulated_plant(found: Identified) -> Any:
    """Return the plant of a model for ``simulate``, with its friction and its delay.

    Friction acts against u, ``u − F tanh(y'/v)``, with v a fiftieth of the RMS speed in the record;
    that of the model acts on driven and measured side, here all of it on the side of u. The
    constant force is left out. Without friction it is the linear plant.

    Parameters
    ----------
    found
        result of ``identify``.

    Raises
    ------
    ValueError
        for direct feedthrough.
    """
    friction = found.friction, found.friction_width
    return with_friction_and_delay(
        found.plant, found.num, found.den, *friction, found.delay, found.dt
    )
