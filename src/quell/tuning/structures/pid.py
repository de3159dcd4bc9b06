"""PI and PID controllers with their filters, as the references of every tuning.

The response is exact for the sampled controller, because Tustin's rule maps each frequency to one:
``C(s)`` at ``s = 2j tan(ω dt/2)/dt`` (Franklin, Powell & Workman, *Digital Control of Dynamic
Systems*, 1998, section 6.1). The integral gain k_i is that of C(s).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quell.analysis.frequency_response import Complex
from quell.controllers.adrc.feedforward import Feedforward
from quell.controllers.baselines.pid import PID
from quell.tuning.structures.base import Model, Parameter
from quell.types import Matrix, Vector

# T_d over T_i of a PID controller that is hardly more than a PI controller.
_LITTLE = 0.03
# Bounds of the times, in units of the time of one radian at the plant's phase crossover.
_TIMES = (1e-4, 1e4)
# Filter and integral times to start from where only a slow filter stabilises, in the same units:
# two masses with a spring under SIMC have 2.8 and 34.
_PHASE_STABILISING, _SLOW = 2.8, (34.0, 120.0, 400.0)


class FilteredPID:
    """``u = K (1 + 1/(T_i s) + T_d s) / F(s) · (r − y)``, with F of first or second order.

    A PI controller has ``F = 1 + T_f s`` or none, a PID controller ``F = 1 + T_f s + (T_f s)²/2``
    (Åström & Hägglund, *Advanced PID Control*, ISA 2006, section 3.3). With ``ratio``, T_f is
    ``T_d/ratio`` and no parameter.
    """

    gain_power = 1
    integrators = 1
    may_swing = False

    def __init__(
        self, model: Model, *, derivative: bool, filtered: bool, ratio: float = 0.0
    ) -> None:
        self.name = ("pid" if derivative else "pi") + ("" if filtered else "-unfiltered")
        self.model, self.derivative, self.filtered = model, derivative, filtered
        self.ratio = ratio
        self.gain_sign = model.sign
        unit, dt = 1.0 / model.omega, model.dt
        times = (_TIMES[0] * unit, _TIMES[1] * unit)
        # The poles of F are at √2/T_f with a derivative, at 1/T_f without.
        self._shortest = (math.sqrt(2.0) if derivative else 1.0) * dt / model.constraints.omega_o_dt
        K = 1.0 / model.gain
        self.parameters = (
            Parameter("K", "u-unit/y-unit", 1e-8 * K, 1e8 * K),
            Parameter("T_i", "s", *times),
            *([Parameter("T_d", "s", *self._derivative_times(times))] if derivative else []),
            *([Parameter("T_f", "s", self._shortest, max(10.0 * unit, 20.0 * dt))] * filtered),
        )

    def _derivative_times(self, times: tuple[float, float]) -> tuple[float, float]:
        low = max(times[0], self.ratio * self._shortest)
        return low, max(times[1], 100.0 * low)

    def shapes(self) -> Matrix:
        """Return times around those of common rules, with slow to fast filters."""
        unit, rows = 1.0 / self.model.omega, []
        for Ti in (0.6, 1.5, 4.0, 12.0, 60.0):
            for ratio in (0.1, 0.25, 0.5) if self.derivative else (0.0,):
                for tf in (0.02, 0.1, 0.4) if self.filtered else (0.0,):
                    Tf = max(tf * unit * min(Ti, 2.0), 1.05 * self._shortest)
                    row = [1.0, Ti * unit]
                    T_d = max(ratio * Ti * unit, 1.05 * self.ratio * self._shortest)
                    row += [T_d] if self.derivative else []
                    rows.append(row + ([Tf] if self.filtered else []))
        if self.derivative and self.filtered:
            # A filter below an undamped resonance lags there by more than the derivative leads.
            slow = max(_PHASE_STABILISING * unit, 1.05 * self._shortest)
            rows += [
                [1.0, Ti * unit, share * Ti * unit, slow] for Ti in _SLOW for share in (0.1, 0.25)
            ]
        return np.array(rows)

    def from_other(self, other: FilteredPID, values: Vector) -> Vector | None:
        """Return values that are close to a controller of another kind of this class."""
        if other is self or (other.derivative and not self.derivative):
            return None
        row = [float(values[0]), float(values[1])]
        if self.derivative:
            row.append(float(values[2]) if other.derivative else _LITTLE * float(values[1]))
        if self.filtered:
            row.append(float(values[-1]) if other.filtered else self._shortest)
        return np.array(row)

    def parts(self, values: Matrix) -> tuple[Vector, ...]:
        """Return k_p, k_i, k_d, f_1, f_2, each (m,)."""
        K, Ti = values[:, 0], values[:, 1]
        kd, f1, f2 = np.zeros_like(K), np.zeros_like(K), np.zeros_like(K)
        if self.derivative:
            kd = K * values[:, 2]
        if self.filtered and self.derivative:
            f1, f2 = values[:, 3], 0.5 * values[:, 3] ** 2
        elif self.derivative and self.ratio:
            f1 = values[:, 2] / self.ratio
            f2 = 0.5 * f1**2
        elif self.filtered:
            f1 = values[:, 2]
        return K, K / Ti, kd, f1, f2

    def grid(self) -> tuple[Matrix, float]:
        """Return none."""
        return np.zeros((0, len(self.parameters))), 0.0

    def beside(self, values: Vector) -> Matrix:
        """Return none."""
        return np.zeros((0, values.size))

    def response(self, values: Matrix, omega: Vector) -> Complex:
        """Return C_y (m, k)."""
        kp, ki, kd, f1, f2 = (part[:, None] for part in self.parts(values))
        # At half the sampling rate s is infinite: the frequencies of the search stay just below.
        s = 2j / self.model.dt * np.tan(0.5 * self.model.dt * omega)[None, :]
        found: Complex = self.model.sign * (kp + ki / s + kd * s) / (1.0 + f1 * s + f2 * s**2)
        return found

    def integral_gain(self, values: Matrix) -> Vector:
        """Return K/T_i."""
        found: Vector = values[:, 0] / values[:, 1]
        return found

    def unstable_poles(self, values: Matrix) -> Vector:
        """Return zeros: filters are stable."""
        return np.zeros(values.shape[0])

    def rules(self, values: Matrix) -> Matrix:
        """Return nothing: the bounds of T_f say all."""
        return np.zeros((values.shape[0], 0))

    def _arguments(self, values: Vector) -> dict[str, Any]:
        kp, ki, kd, f1, f2 = (float(part[0]) for part in self.parts(values[None, :]))
        sign = self.model.sign
        arguments: dict[str, Any] = {"kp": sign * kp, "ki": sign * ki}
        if self.derivative:
            arguments["kd"] = sign * kd
        if self.filtered or self.ratio:
            arguments["tf"] = (f1, f2)
        return arguments

    def controller(self, values: Vector, **limits: Any) -> PID:
        """Return the PID controller."""
        name = "PID" if self.derivative else "PI"
        return PID(**self._arguments(values), dt=self.model.dt, name=name, **limits)

    def feedforward(self, of_model: Feedforward) -> dict[str, Any]:
        """Return none: a PID controller has no model."""
        return {}

    def tables(self, values: Vector) -> dict[str, dict[str, Any]]:
        """Return the table of the controller."""
        arguments = self._arguments(values)
        if "tf" in arguments:
            arguments["tf"] = list(arguments["tf"])
        name = {} if self.derivative else {"name": "PI"}
        return {"controller": {"kind": "pid"} | arguments | name}
