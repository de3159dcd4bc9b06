"""The result of an identification."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from quell.identification import plots
from quell.identification.experiment.frequency_response import FrequencyResponse, frequency_response
from quell.identification.model.roots import WITHIN_95, Root
from quell.identification.search.at_rest import SURE
from quell.identification.search.output_error import noise_model
from quell.identification.validation import Residuals
from quell.lti.canonical import format_roots
from quell.plants.labelled import labelled
from quell.plants.linear import LinearPlant
from quell.quantities import UNKNOWN, Signals
from quell.records.plotting import given_axes
from quell.types import Matrix, Vector

# Width of the smooth sign of the speed, relative to the RMS speed in the record: by hand, so that
# creeping within it is far slower than motion.
_FRICTION_WIDTH = 0.02
# A pole and a zero within three standard deviations may be equal (99.7 %).
_DEVIATIONS = 3.0
# A gain whose 95 % interval is wider than this share of it is not decided: then it may be half or
# twice of what it is, beyond what a design allows for.
_WIDE = 1.0
# A fit below it explains nothing that could be used [%]: chosen by hand.
_NOTHING = 10.0
# From here down a start at rest that was given is contradicted: three standard deviations.
_CONTRADICTED = 0.003


@dataclass(frozen=True, eq=False)
class Identified:
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
    one_more_pole: (
        float  #: χ² of a further response to u in the error of the fit; see ``validation``
    )
    one_more_pole_limit: float  #: limit that it exceeds by chance in one of a thousand records
    resolution: float  #: step that y is rounded to, 0.0 if it is not rounded [y-unit]
    held_from: int  #: index of the first held-out sample; N if none was held out
    u: Vector
    y: Vector
    simulated: Vector  #: the model's output (N,) [y-unit]; it starts again at the held-out samples
    reference: Vector | None
    converged: bool  #: whether the search ended at a minimum that a second start or tests confirm
    method: str
    signals: Signals = UNKNOWN  #: names and units of u and y

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
        if self.num.size == self.den.size:
            raise ValueError(
                f"zeros = {self.num.size - 1}: the model has direct feedthrough, u acts on y at "
                "once; observers and simulated loops need a plant without it. Identify with fewer "
                "zeros, or use num, den and response"
            )
        plant = LinearPlant.of((self.num, self.den), name="identified plant")
        return labelled(plant, self.signals.y, self.signals.u)

    @property
    def shortcomings(self) -> tuple[str, ...]:
        """Reasons not to rely on the model, each with what to do; empty for a good one.

        They are the ``faults``, what is ``undecided``, a u that explains nothing, a response to u
        that the model does not explain, and a start not at rest although ``rest`` says so.
        """
        found = [*self.faults, *self.undecided]
        fit = self.fits.get("held out", self.fits["estimation"])
        if fit < _NOTHING:
            found.append(
                f"u explains hardly anything of y (fit {percent(fit, 1)} %); check that they "
                "belong to each other, which is which, the order and the delay"
            )
        if self._gain_is_wide and self._input_is_certain:
            found.append(
                "the record does not decide the size of the gain, as the slowest pole may be at "
                f"s = 0: {self._gain_text}; if the plant integrates, set integrators"
            )
        if not self.explained:
            found.append(
                f"the response to u is not of this form (one more pole: {self.one_more_pole:.3g}, "
                f"limit {self.one_more_pole_limit:.3g}), so gain and poles may be farther from the "
                "plant's than their deviations say; use a higher order, zeros, friction, or "
                "another delay"
            )
        if self.rest and self.rest_probability < _CONTRADICTED:
            found.append(
                "the first samples contradict the start at rest "
                f"(probability {self.rest_probability:.2g}); leave rest=True (--rest) out"
            )
        return tuple(found)

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
        hold = np.exp(-0.5 * s * self.dt) * np.sinc(s.imag * self.dt / (2.0 * np.pi))
        # What acts at once is not delayed by the hold.
        direct = self.num[0] if self.num.size == self.den.size else 0.0
        rest = np.polyval(self.num, s) / np.polyval(self.den, s) - direct
        return (rest * hold + direct) * np.exp(-s * self.delay)

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
        axes, split = plots.seven_axes(given_axes(axes, ax)), self.held_from
        signals = self.signals
        plots.draw_bode(axes[:3], self.empirical(), self.response, signals)
        plots.draw_output(axes[3:5], self.t, self.y, self.simulated, split, self.fits, signals.y)
        plots.draw_tests(axes[5:], self.residuals, (self.y.size - split) or self.y.size)
        for each in axes:
            each.grid(alpha=0.3)
        return axes

    def describe(self) -> str:
        """Return the report as text."""
        delay = f" · exp(−{self.delay:g} s)" if self.delay else ""
        lines = [
            f"G(s) = ({_polynomial(self.num)}) / ({_polynomial(self.den)}){delay}",
            f"{self.method}{'' if self.converged else '; the search did NOT converge'}",
            "",
            "pole [rad/s]                  ± real      ± imag     |p|       damping",
            *(_row(root) for root in self.poles),
        ]
        if self.zeros:
            lines += ["zero [rad/s]", *(_row(root) for root in self.zeros)]
        low, high = self.gain_interval
        lines += ["", f"gain {self.gain:.5g}, 95 %: {low:.5g} to {high:.5g}{_of(self.integrators)}"]
        low, high = self.delay_interval
        if low < high:
            lines += [f"delay {self.delay:.4g} s, 95 %: {low:.4g} to {high:.4g} s"]
        if self.rest:
            how = "given" if self.rest_given else "assumed"
            lines += [f"start at rest: {how} (probability {self.rest_probability:.3g})"]
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
            *(f"NOT: {text}" for text in self.shortcomings),
        ]
        return "\n".join(lines)

    __str__ = describe

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
            "bias": self.bias,
            "friction": self.friction,
            "friction_std": self.friction_std,
            "friction_width": self.friction_width,
            "dt": self.dt,
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


def _of(integrators: int) -> str:
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


def _row(root: Root) -> str:
    value = f"{root.value.real:.6g}" + (f"{root.value.imag:+.6g}j" if root.value.imag else "")
    damping = "" if math.isnan(root.damping) else f"{root.damping:.4f}"
    return f"{value:<28}  {root.real_std:<10.2g}{root.imag_std:<10.2g} {root.omega:<9.5g} {damping}"


def _polynomial(coefficients: Vector) -> str:
    """Return a polynomial in s as text, from its coefficients in descending powers."""
    terms = []
    for i, value in enumerate(coefficients.tolist()):
        power = coefficients.size - 1 - i
        if value:
            symbol = "" if power == 0 else ("s" if power == 1 else f"s^{power}")
            number = f"{value:.6g}" if value != 1.0 or not symbol else ""
            terms.append(f"{number} {symbol}".strip())
    return " + ".join(terms).replace("+ -", "− ") or "0"
