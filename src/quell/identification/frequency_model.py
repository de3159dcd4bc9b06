"""The model of a table of frequencies: report, plot, plant."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.files import nonfinite_to_none
from quell.identification.frequencies import hold_of
from quell.identification.model import WITHIN_95, Root
from quell.identification.result import (
    describe_root,
    fitted_plant,
    gain_of_s,
    polynomial_text,
)
from quell.plants.linear import LinearPlant
from quell.quantities import UNKNOWN, Signals
from quell.records.plotting import draw_line, given_axes, grid_of_axes, new_figure
from quell.types import Matrix, Vector

Complex = NDArray[Any]

MOST_ORDER = 8
OUTSIDE = 3.0
"""Poles and zeros this much slower or faster than a table are not shown by it. Chosen by hand."""
DEVIATIONS = 3.0
"""A pole and a zero within so many deviations may be equal."""
POOR = 0.3
"""Relative error of a fit that explains the table poorly. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class FrequencyModel:
    """A transfer function found in a table of frequencies, with measures of its quality."""

    num: Vector  #: numerator, descending powers of s
    den: Vector  #: denominator, descending powers of s; the first is 1
    covariance: Matrix  #: of the fitted coefficients, ``den`` before ``num``, ascending powers
    poles: tuple[Root, ...]
    zeros: tuple[Root, ...]
    integrators: int  #: number of poles at s = 0
    delay: float  #: [s]
    delay_covariance: Vector  #: of the delay with ``covariance``, then its variance [s²]
    gain_interval: tuple[float, float]  #: 95 % interval of ``gain``
    error: float  #: RMS of the relative error of G
    omega: Vector  #: frequencies of the table [rad/s]
    response: Complex  #: G of the table [y-unit/u-unit]
    dt: float | None  #: time for which u was held [s]; None: not known
    known: bool  #: whether there are points enough for deviations
    converged: bool  #: whether the search ended at a minimum
    signals: Signals = UNKNOWN  #: names and units of u and y

    @property
    def gain(self) -> float:
        """Gain ``lim s^q G(s)`` at s = 0, with q integrators [y-unit/u-unit/s^q]."""
        return float(self.num[-1] / self.den[self.den.size - 1 - self.integrators])

    @property
    def delay_interval(self) -> tuple[float, float]:
        """95 % interval of the delay [s]."""
        half = WITHIN_95 * math.sqrt(max(float(self.delay_covariance[-1]), 0.0))
        return max(self.delay - half, 0.0), self.delay + half

    @cached_property
    def plant(self) -> LinearPlant:
        """The transfer function as a plant, without delay.

        Raises
        ------
        ValueError
            for a model with direct feedthrough.
        """
        name = "plant of a table of frequencies"
        return fitted_plant(self.num, self.den, name, self.signals)

    def response_at(self, omega: Any) -> Any:
        """Return the model's response at ``omega`` [rad/s], with delay and hold."""
        s = 1j * np.asarray(omega, dtype=np.float64)
        G = np.polyval(self.num, s) / np.polyval(self.den, s) * np.exp(-s * self.delay)
        return G * hold_of(s, self.dt)

    @property
    def undecided(self) -> tuple[str, ...]:
        """What the table does not decide, each with what to do."""
        if not self.known:
            return (
                f"the table has {self.omega.size} frequencies for {self._parameters} numbers: "
                "their deviations are not known; measure more frequencies",
            )
        low, high = self.gain_interval
        # An integrator or a slow pole leaves the gain at s = 0 open, but not where the loop works.
        if not math.isfinite(high - low) and self.is_poor:
            return ("the table does not decide the gain; begin it lower",)
        return ()

    @property
    def faults(self) -> tuple[str, ...]:
        """Faults that the fit does not show: poles that are unstable, outside, or cancelled."""
        return tuple(_faults(self.poles, self.zeros, self.omega))

    @property
    def is_poor(self) -> bool:
        """Whether the error of G is above 30 % (RMS)."""
        return self.error > POOR

    @property
    def shortcomings(self) -> tuple[str, ...]:
        """Reasons not to rely on the model, each with what to do; empty for a good one."""
        found = [*self.faults, *self.undecided]
        if self.is_poor:
            found.append(
                f"the model is off by {100.0 * self.error:.3g} % (RMS): no order up to "
                f"{MOST_ORDER} explains the table; leave out frequencies with little coherence, "
                "or give a band with fewer modes"
            )
        return tuple(found)

    @property
    def _parameters(self) -> int:
        return self.den.size - 1 - self.integrators + self.num.size + bool(self.delay)

    def describe(self) -> str:
        """Return the report as text; lines that begin with NOT say what not to rely on."""
        low, high = self.gain_interval
        delay = f" · exp(−{self.delay:g} s)" if self.delay else ""
        lines = [
            f"G(s) = ({polynomial_text(self.num)}) / ({polynomial_text(self.den)}){delay}",
            f"least error of ln G{'' if self.converged else '; the search did NOT converge'}",
            "",
            "pole [rad/s]                  ± real      ± imag     |p|       damping",
            *(describe_root(root) for root in self.poles),
        ]
        if self.zeros:
            lines += ["zero [rad/s]", *(describe_root(root) for root in self.zeros)]
        of = gain_of_s(self.integrators)
        lines += ["", f"gain {self.gain:.5g}, 95 %: {low:.5g} to {high:.5g}{of}"]
        if self.delay:
            low, high = self.delay_interval
            lines += [f"delay {self.delay:.4g} s, 95 %: {low:.4g} to {high:.4g} s"]
        lines += [f"error of G: {100.0 * self.error:.3g} % (RMS)"]
        lines += [f"NOT: {text}" for text in self.shortcomings]
        return "\n".join(lines)

    __str__ = describe

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw size and phase of table and model, and the relative error; return the axes.

        ``axes`` are three matplotlib axes, those of a new figure by default.
        """
        figure = partial(new_figure, 8.0, 6.0)
        axes = np.ravel(grid_of_axes(given_axes(axes, ax), figure, 3, sharex="all"))
        omega = np.geomspace(self.omega[0], self.omega[-1], 2000)
        model, near = self.response_at(omega), self.response_at(self.omega)
        hertz = 2.0 * math.pi
        dots = {"color": "0.6", "marker": ".", "markersize": 4.0, "linestyle": "none"}
        degrees = np.degrees(np.unwrap(np.angle(model)))
        at = np.interp(self.omega, omega, degrees)
        measured = at + np.degrees(np.angle(self.response * np.exp(-1j * np.radians(at))))
        draw_line(axes[0], self.omega / hertz, np.abs(self.response), label="table", **dots)
        draw_line(axes[0], omega / hertz, np.abs(model), color="C0", label="model")
        draw_line(axes[1], self.omega / hertz, measured, **dots)
        draw_line(axes[1], omega / hertz, degrees, color="C0")
        error = 100.0 * np.abs(near / self.response - 1.0)
        draw_line(axes[2], self.omega / hertz, error, color="C0", linewidth=0.8)
        axes[0].set(xscale="log", yscale="log", ylabel="|G|")
        axes[0].legend(fontsize="small")
        axes[1].set_ylabel("phase of G [°]")
        axes[2].set(ylabel="error [%]", xlabel="frequency [Hz]", yscale="log")
        for each in axes:
            each.grid(alpha=0.3)
        return axes

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON; None for numbers that are not finite."""
        value = {
            "num": self.num.tolist(),
            "den": self.den.tolist(),
            "poles": [_root_json(root) for root in self.poles],
            "zeros": [_root_json(root) for root in self.zeros],
            "integrators": self.integrators,
            "delay": self.delay,
            "delay_interval": list(self.delay_interval),
            "gain": self.gain,
            "gain_interval": list(self.gain_interval),
            "error": self.error,
            "frequencies": self.omega.size,
            "held_for": self.dt,
            "shortcomings": self.shortcomings,
            "converged": self.converged,
        }
        return dict(nonfinite_to_none(value))


def _root_json(root: Root) -> dict[str, float]:
    names = ("real_std", "imag_std", "omega", "damping")
    place = {"real": root.value.real, "imag": root.value.imag}
    return place | {name: getattr(root, name) for name in names}


def _faults(poles: tuple[Root, ...], zeros: tuple[Root, ...], omega: Vector) -> list[str]:
    found = []
    for pole in poles:
        text = describe_root(pole).split("  ")[0]
        if pole.value.imag < 0.0 or not pole.value:
            continue
        if pole.value.real > 0.0:
            found.append(
                f"the pole at {text} rad/s is unstable; if the plant is stable, give a "
                "lower order, or leave out frequencies with little coherence"
            )
        if pole.omega > OUTSIDE * omega[-1]:
            found.append(
                f"the pole at {text} rad/s is faster than the table shows, "
                f"{omega[-1]:.4g} rad/s; give a lower order"
            )
        for zero in zeros:
            if abs(pole.value - zero.value) <= DEVIATIONS * (pole.deviation + zero.deviation):
                found.append(
                    f"the pole at {text} rad/s nearly equals a zero; give one pole and "
                    "one zero less"
                )
                break
    return found
