"""What an identification returns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from quell.identification.frequency_response import FrequencyResponse, frequency_response
from quell.identification.validation import Residuals
from quell.lti.canonical import format_roots
from quell.plants.linear import LinearPlant
from quell.types import Matrix, Vector

_DEVIATIONS = 3.0


class Root(NamedTuple):
    """A pole or a zero; of a conjugate pair both are listed."""

    value: complex
    """[rad/s]."""
    real_std: float
    """standard deviation of the real part [rad/s]; 0 for one that was set."""
    imag_std: float
    """of the imaginary part [rad/s]."""

    @property
    def omega(self) -> float:
        """Its size [rad/s]."""
        return abs(self.value)

    @property
    def deviation(self) -> float:
        """Standard deviation of the distance to where it really is [rad/s]."""
        return math.hypot(self.real_std, self.imag_std)

    @property
    def damping(self) -> float:
        """Damping ratio; 1 for real ones in the left half plane, NaN at s = 0."""
        return -self.value.real / abs(self.value) if self.value else math.nan


@dataclass(frozen=True, eq=False)
class Identified:
    """A transfer function found in a record, with what it is worth.

    ``str()`` of it is the whole report; ``plant`` goes into ``ESO.model_based`` and everywhere else.
    """

    num: Vector
    """Numerator, descending powers of s."""
    den: Vector
    """Denominator, descending powers of s; the first is 1."""
    covariance: Matrix
    """of all coefficients that were fitted, those of ``den`` in ascending powers first, then those of ``num`` (parameters, parameters)."""
    poles: tuple[Root, ...]
    zeros: tuple[Root, ...]
    integrators: int
    """How many poles were set to s = 0."""
    delay: float
    """How late u is [s]."""
    bias: float
    """A constant force on the plant, in units of u; NaN where the plant does not let a constant u through."""
    friction: float | None
    """Coulomb friction, in units of u: what |u| has to overcome in slow motion; None where it was not asked for."""
    dt: float
    """Sample time of the record [s]."""
    horizon: int
    """How many samples ahead ``predicted`` is."""
    fits: dict[str, float]
    """NRMSE in %: ``"estimation"`` and ``"held out"`` for the simulation, ``"estimation, predicted"`` and ``"held out, predicted"``."""
    residuals: Residuals
    """The tests, on held-out samples where there are some."""
    resolution: float
    """The step of y, 0.0 where it has none [y-unit]."""
    held_from: int
    """The first of the samples that were held out; their number where none were."""
    u: Vector
    y: Vector
    simulated: Vector
    """The model's output (N,): from the start of the record, and begun anew with the samples held out [y-unit]."""
    reference: Vector | None
    converged: bool
    method: str

    @cached_property
    def plant(self) -> LinearPlant:
        """The transfer function as a plant, without delay, bias and friction."""
        return LinearPlant.of((self.num, self.den), name="identified plant")

    @property
    def shortcomings(self) -> tuple[str, ...]:
        """What speaks against the model, whatever its fit: poles that run away, that no sample shows, or that a zero cancels."""
        seen = math.pi / self.dt
        poles, zeros = (
            [root for root in roots if root.value.imag >= 0.0] for roots in (self.poles, self.zeros)
        )
        found = [
            f"the pole at {_named(pole)} runs away; if the plant does not, take a lower order or set integrators"
            for pole in poles
            if pole.value.real > 0.0
        ]
        for what, roots in (("pole", poles), ("zero", zeros)):
            fast = [root for root in roots if root.omega > seen]
            found += [
                f"the {what} at {_named(root)} is faster than samples show, {seen:.4g} rad/s; take fewer {what}s"
                for root in fast
            ]
        for zero in zeros:
            cancelled = [
                pole
                for pole in poles
                if abs(pole.value - zero.value) <= _DEVIATIONS * (pole.deviation + zero.deviation)
            ]
            found += [
                f"the pole at {_named(pole)} can't be told from a zero; take one of each less"
                for pole in cancelled[:1]
            ]
        return tuple(found)

    @property
    def t(self) -> Vector:
        """Times of the samples [s]."""
        return np.arange(float(self.y.size)) * self.dt

    def response(self, omega: Any) -> Any:
        """Return the model's frequency response at ``omega`` [rad/s], delay and the hold of u included.

        It is that of the samples: what is measured at ``omega`` in a record whose u is held. Towards half the sampling rate images of the
        hold matter, which are left out here.
        """
        s = 1j * np.asarray(omega, dtype=np.float64)
        hold = np.exp(-0.5 * s * self.dt) * np.sinc(s.imag * self.dt / (2.0 * np.pi))
        return np.polyval(self.num, s) / np.polyval(self.den, s) * hold * np.exp(-s * self.delay)

    def empirical(self, segments: int = 8) -> FrequencyResponse:
        """Return the frequency response of the record itself; see ``frequency_response``."""
        return frequency_response(
            self.u, self.y, self.dt, reference=self.reference, segments=segments
        )

    def plot(self, axes: Any = None) -> Any:
        """Draw the Bode plot against the empirical response, coherence, output and error, and the tests of residuals; return the axes.

        Parameters
        ----------
        axes
            seven matplotlib axes to draw into: gain, phase, coherence, output, error, autocorrelation, cross-correlation; a new figure by
            default.
        """
        from quell.identification.plots import plot_identified

        return plot_identified(self, axes)

    def describe(self) -> str:
        """Return the report as text."""
        lines = [
            f"G(s) = ({_spelled(self.num)}) / ({_spelled(self.den)})"
            + (f" · exp(−{self.delay:g} s)" if self.delay else ""),
            f"{self.method}{'' if self.converged else '; the search did NOT come to rest'}",
            "",
            "pole [rad/s]                  ± real      ± imag     |p|       damping",
            *(_row(root) for root in self.poles),
        ]
        if self.zeros:
            lines += ["zero [rad/s]", *(_row(root) for root in self.zeros)]
        lines += ["", f"constant force {self.bias:.4g} (in units of u)"]
        if self.friction is not None:
            lines += [f"Coulomb friction {self.friction:.4g} (in units of u)"]
        lines += [f"fit, {name}: {percent(value)} %" for name, value in self.fits.items()]
        left = self.residuals
        quantum = (
            f" ({left.rms / self.resolution * math.sqrt(12.0):.3g} times that of rounding to {self.resolution:.3g})"
            if self.resolution
            else ""
        )
        lines += [
            f"error of the simulation: RMS {left.rms:.3g}{quantum}",
            f"white: {'yes' if left.white else 'no'} (zeta = {left.whiteness:.3g}, limit {left.whiteness_limit:.3g}, {left.lags} lags)",
            f"independent of past u: {'yes' if left.independent else 'no'} "
            f"(largest correlation {np.max(np.abs(left.cross_correlation[left.lags :])):.3g}, limit {left.cross_limit:.3g})",
            *(f"NOT: {text}" for text in self.shortcomings),
        ]
        return "\n".join(lines)

    __str__ = describe

    def __repr__(self) -> str:
        fit = self.fits.get("held out", self.fits["estimation"])
        return f"Identified(order={self.den.size - 1}, poles {format_roots(np.array([p.value for p in self.poles]))} rad/s, fit {percent(fit, 2)} %)"

    def to_json(self) -> dict[str, Any]:
        """Return the results for ``quell.files.write_json``: no records, and None for what is not finite."""
        from quell.files import nonfinite_to_none

        left = self.residuals
        value = {
            "num": self.num.tolist(),
            "den": self.den.tolist(),
            **{
                name: [_root_json(root) for root in getattr(self, name)]
                for name in ("poles", "zeros")
            },
            "integrators": self.integrators,
            "delay": self.delay,
            "bias": self.bias,
            "friction": self.friction,
            "dt": self.dt,
            "samples": self.y.size,
            "held_from": self.held_from,
            "horizon": self.horizon,
            "fits": self.fits,
            "residuals": {
                "rms": left.rms,
                "lags": left.lags,
                "whiteness": left.whiteness,
                "whiteness_limit": left.whiteness_limit,
                "white": left.white,
                "independent_of_u": left.independent,
                "largest_cross_correlation": float(
                    np.max(np.abs(left.cross_correlation[left.lags :]))
                ),
                "cross_limit": left.cross_limit,
            },
            "resolution": self.resolution,
            "shortcomings": self.shortcomings,
            "converged": self.converged,
            "method": self.method,
        }
        found: dict[str, Any] = nonfinite_to_none(value)
        return found


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
    """Return a fit as text; that of a model which runs away is a large negative number."""
    return f"{fit:.{digits}f}" if fit > -1e4 else f"{fit:.3g}"


def _named(root: Root) -> str:
    return f"{format_roots(np.array([root.value]))} rad/s"


def _row(root: Root) -> str:
    value = f"{root.value.real:.6g}" + (f"{root.value.imag:+.6g}j" if root.value.imag else "")
    damping = "" if math.isnan(root.damping) else f"{root.damping:.4f}"
    return f"{value:<28}  {root.real_std:<10.2g}{root.imag_std:<10.2g} {root.omega:<9.5g} {damping}"


def _spelled(coefficients: Vector) -> str:
    """Return a polynomial in s as text."""
    terms = []
    for power, value in zip(
        range(coefficients.size - 1, -1, -1), coefficients.tolist(), strict=True
    ):
        if value:
            symbol = "" if power == 0 else ("s" if power == 1 else f"s^{power}")
            number = f"{value:.6g}" if value != 1.0 or not symbol else ""
            terms.append(f"{number} {symbol}".strip())
    return " + ".join(terms).replace("+ -", "− ") or "0"
