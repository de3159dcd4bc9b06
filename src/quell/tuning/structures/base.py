"""The interface of structures: families of controllers with free parameters.

All parameters are searched as logarithms. The first one is a gain: the whole controller is
multiplied by its inverse or by itself (``gain_power``), while the others, the *shape*, stay. The
response of many parameter vectors at many frequencies is one call, without controllers being built.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from quell.analysis.margins import Complex
from quell.controllers.base import Controller
from quell.controllers.feedforward import Feedforward
from quell.plants.linear import LinearPlant
from quell.tuning.constraints import Constraints, LoadSpectrum
from quell.types import Matrix, Vector

RESONANT = 0.5
"""A pair of poles with less damping is a resonance."""


class Parameter(NamedTuple):
    """A free number of a structure, positive; ``low`` and ``high`` bound it."""

    name: str
    unit: str
    low: float
    high: float


class Model(NamedTuple):
    """Properties of the loop that a structure is made for."""

    plant: Any  # nominal linear plant, as given; None for plants known by their response only
    delay: float  # dead time of the nominal plant [s]
    dt: float  # sample time [s]
    sign: float  # sign of the gain that integral action needs, +1 or −1
    degree: int  # relative degree
    b: float  # |gain| from u to y^(degree)
    omega: float  # frequency at which the plant's phase lag is that of two integrators [rad/s]
    gain: float  # |P| around it
    constraints: Constraints
    load: LoadSpectrum | None = None  # the spectrum of the load, where it is the objective
    frequencies: tuple[float, ...] = ()  # known ones of the load [rad/s]


class Structure(Protocol):
    """A family of controllers of one form."""

    name: str
    parameters: tuple[Parameter, ...]
    gain_sign: float  # sign of the first parameter where it is printed, +1 or −1
    gain_power: int  # 1 if C_y is proportional to the first parameter, −1 if to its inverse
    integrators: int  # number of poles of C_y at z = 1
    may_swing: bool  # whether a second slow pole can make k_i large, so that this must be bounded

    def shapes(self) -> Matrix:
        """Return values (k, p) of the parameters to start from; their first one is replaced."""
        ...

    def grid(self) -> tuple[Matrix, float]:
        """Return further values (k, p) on a grid, often none, and its spacing in the logarithms.

        Of values that are neighbours there only the best one is a start.
        """
        ...

    def beside(self, values: Vector) -> Matrix:
        """Return values (k, p) near an optimum where another one may be; often none."""
        ...

    def response(self, values: Matrix, omega: Vector) -> Complex:
        """Return C_y (m, k), from −y to u, for values (m, p) at frequencies (k,) [rad/s].

        A complex frequency −j s gives the transfer function at s.
        """
        ...

    def integral_gain(self, values: Matrix) -> Vector:
        """Return the integral gains k_i (m,) [u-unit/(y-unit s)]; infinite with two integrators."""
        ...

    def unstable_poles(self, values: Matrix) -> Vector:
        """Return the number (m,) of poles of C_y outside of the unit circle."""
        ...

    def on_circle(self, values: Matrix) -> Matrix:
        """Return the frequencies (m, k) at which C_y has poles on the unit circle [rad/s]."""
        ...

    def rules(self, values: Matrix) -> Matrix:
        """Return further constraints (m, k), which must not be negative."""
        ...

    def controller(self, values: Vector, **options: Any) -> Controller:
        """Return the controller with values (p,); ``options``: limits of u, ``feedforward``."""
        ...

    def feedforward(self, of_model: Feedforward) -> dict[str, Any]:
        """Return the options of ``controller`` for a feedforward; none where it has no such."""
        ...

    def tables(self, values: Vector) -> dict[str, dict[str, Any]]:
        """Return the tables of a setup file that describe the controller."""
        ...


def resonances(model: Model, damping: float = RESONANT) -> list[float]:
    """Return the frequencies of the plant's pairs of poles with less damping [rad/s].

    The lowest is the first. A plant of which no model is known has none.
    """
    if model.plant is None:
        return []
    poles = np.linalg.eigvals(LinearPlant.of(model.plant).A)
    size = np.abs(poles)
    found = size[(poles.imag > 0.0) & (-poles.real < damping * size)]
    # Integrators of a chain are pairs near zero, to rounding.
    kept = found[found > 1e-6 * np.max(size, initial=0.0)]
    return sorted(kept.tolist())


def named(structure: Structure, values: Vector) -> dict[str, float]:
    """Return values (p,) by the names of the structure's parameters."""
    names = [parameter.name for parameter in structure.parameters]
    return dict(zip(names, map(float, values), strict=True))


def vector(structure: Structure, values: Mapping[str, float]) -> Vector:
    """Return values by name in the order of the structure's parameters (p,)."""
    return np.array([values[parameter.name] for parameter in structure.parameters])
