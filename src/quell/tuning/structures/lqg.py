"""LQG with its two bandwidths and the nominal gain, as a reference that knows the whole plant.

The weights follow from the bandwidths (``baselines/lqg.py``), for a plant of ``g`` times the real
gain. Scaling the nominal plant by g scales the weights so that the controller is that of g = 1 over
g: the factor does for LQG what b0 does for ADRC.
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from quell.analysis.frequency_response import Complex, Response
from quell.analysis.pure_delays import eigenvalues
from quell.analysis.subsystems import law_matrix
from quell.controllers.adrc.feedforward import Feedforward
from quell.controllers.baselines.lqg import LQG
from quell.lti.system import System
from quell.plants.linear import LinearPlant
from quell.tuning.structures.base import Model, Parameter
from quell.types import Matrix, Vector

# Bounds of the bandwidths in units of the plant's phase crossover, and of the factor of the gain.
# Chosen by hand, far beyond useful ones.
_BANDWIDTHS, _FACTORS = (1e-3, 1e3), (1e-6, 1e6)
# Bandwidths to start from: of the feedback in units of the crossover, of the filter in units of
# that of the feedback.
_FEEDBACK_STARTS = (0.05, 0.2, 0.5, 1.0, 2.0)
_FILTER_STARTS = (0.5, 2.0, 6.0, 20.0)
# A pole of the controller beyond is unstable; its integrator, to rounding, is not.
_RUNS_AWAY = 1.0 + 1e-7
# Frequency at which k_i is read, in units of the feedback's bandwidth: its error is the square.
_LOW = 1e-3


class _Law(NamedTuple):
    """The controller for the plant's own gain."""

    response: Response
    integral_gain: float
    unstable: int


class LqgStructure:
    """An LQG controller by bandwidths, for a plant of a factor times the real gain."""

    name = "lqg"
    gain_sign = 1.0  # a factor of the plant's own gain
    gain_power = -1
    integrators = 1
    may_swing = False

    def __init__(self, model: Model) -> None:
        self.model, self.plant = model, LinearPlant.of(model.plant)
        fastest = min(_BANDWIDTHS[1] * model.omega, model.constraints.omega_o_dt / model.dt)
        bounds = (min(_BANDWIDTHS[0] * model.omega, 0.1 * fastest), fastest)
        self.parameters: tuple[Parameter, ...] = (
            Parameter("b_factor", "", *_FACTORS),
            Parameter("omega_c", "rad/s", *bounds),
            Parameter("omega_o", "rad/s", *bounds),
        )
        # Differences need neighbours of the present values only.
        self._law = lru_cache(maxsize=256)(self._made)

    def shapes(self) -> Matrix:
        """Return bandwidths in wide ranges."""
        low, high = self.parameters[1].low, 0.9 * self.parameters[1].high
        pairs = itertools.product(_FEEDBACK_STARTS, _FILTER_STARTS)
        rows = [
            (1.0, law * self.model.omega, law * ratio * self.model.omega) for law, ratio in pairs
        ]
        return np.unique(np.clip(np.array(rows), (1.0, low, low), (1.0, high, high)), axis=0)

    def _made(self, omega_c: float, omega_o: float) -> _Law:
        dt = self.model.dt
        law = LQG(self.plant, omega_c, omega_o, dt).law
        N = law_matrix(law)
        response = Response(System(N, law.B_y + law.B_u * law.D_y, -law.C, -law.D_y))
        low = _LOW * omega_c
        gain = float(np.real(1j * low * response([low], dt)[0]))
        unstable = int(np.sum(np.abs(1.0 + eigenvalues(N)) > _RUNS_AWAY))
        return _Law(response, abs(gain), unstable)

    def _laws(self, values: Matrix) -> list[_Law]:
        return [self._law(float(row[1]), float(row[2])) for row in values]

    def grid(self) -> tuple[Matrix, float]:
        """Return none."""
        return np.zeros((0, len(self.parameters))), 0.0

    def beside(self, values: Vector) -> Matrix:
        """Return none."""
        return np.zeros((0, values.size))

    def response(self, values: Matrix, omega: Vector) -> Complex:
        """Return C_y (m, k)."""
        rows = [law.response(omega, self.model.dt) for law in self._laws(values)]
        found: Complex = np.array(rows) / values[:, :1]
        return found

    def integral_gain(self, values: Matrix) -> Vector:
        """Return k_i (m,)."""
        found: Vector = np.array([law.integral_gain for law in self._laws(values)]) / values[:, 0]
        return found

    def unstable_poles(self, values: Matrix) -> Vector:
        """Return the number of unstable poles of C_y (m,)."""
        return np.array([float(law.unstable) for law in self._laws(values)])

    def rules(self, values: Matrix) -> Matrix:
        """Return no constraints: the bandwidths' bounds are all."""
        return np.zeros((values.shape[0], 0))

    def controller(self, values: Vector, **limits: Any) -> LQG:
        """Return the controller."""
        factor, omega_c, omega_o = map(float, values)
        plant = LinearPlant(self.plant.A, factor * self.plant.B, self.plant.C)
        return LQG(plant, omega_c, omega_o, self.model.dt, **limits)

    def feedforward(self, of_model: Feedforward) -> dict[str, Any]:
        """Return none: the observer's state does not follow a reference."""
        return {}

    def tables(self, values: Vector) -> dict[str, dict[str, Any]]:
        """Return the table of the controller, with its own model of the plant."""
        factor, omega_c, omega_o = map(float, values)
        parts = (self.plant.A, factor * self.plant.B, self.plant.C)
        plant = dict(zip("ABC", (part.tolist() for part in parts), strict=True))
        model = {"kind": "linear"} | plant
        table = {"kind": "lqg", "omega_c": omega_c, "omega_o": omega_o, "plant": model}
        return {"controller": table}
