"""Cascaded position and speed loops with notch filters, as the reference of flexible axes.

``controllers/baselines/p_pi.py`` has the equations. There is a notch for each resonance of the
plant, two at most, with its own place, depth and width. The response is exact for the sampled
controller, as that of ``pid.py``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from quell.analysis.frequency_response import Complex
from quell.controllers.adrc.feedforward import Feedforward
from quell.controllers.baselines.notch import Notch
from quell.controllers.baselines.p_pi import PPI
from quell.tuning.structures.base import Model, Parameter, resonances
from quell.types import Matrix, Vector

# Notches lie below this share of half the sampling rate. Drives have two to four filters; a third
# resonance is hardly ever below the limit.
_BELOW, _MOST = 0.95, 2
# Bounds of depth and width of a notch, and of its place in units of the resonance: drives have
# notches of −40 dB at most.
_DEPTH, _WIDTH, _PLACE = (0.01, 0.999), (0.05, 6.0), (0.2, 5.0)
# Bounds of times in units of the time of one radian at the plant's phase crossover.
_TIMES = (1e-4, 1e4)
# Values to start from: K_v and T_f in units of that radian, T_n K_v, depth and width of notches.
_KV_STARTS, _TN_STARTS, _TF_STARTS = (0.01, 0.03, 0.1, 0.3, 1.0), (0.5, 2.0, 8.0), (0.01, 0.3, 2.8)
_NOTCH_STARTS = ((0.9, 0.3), (0.12, 0.5), (0.15, 2.0), (0.4, 1.5))


class CascadeStructure:
    """P position and PI speed control with a notch for each resonance."""

    name = "p-pi-notch"
    gain_power = 1
    integrators = 1
    may_swing = False

    def __init__(self, model: Model) -> None:
        self.model = model
        self.gain_sign = model.sign
        unit, dt = 1.0 / model.omega, model.dt
        self._shortest = dt / model.constraints.omega_o_dt
        K = unit / model.gain
        top = _BELOW * math.pi / dt
        self._centres = [w for w in resonances(model) if w < top][:_MOST]
        self.parameters: tuple[Parameter, ...] = (
            Parameter("K_p", "u-unit/(y-unit/s)", 1e-8 * K, 1e8 * K),
            Parameter("K_v", "1/s", _TIMES[0] / unit, _TIMES[1] / unit),
            Parameter("T_n", "s", _TIMES[0] * unit, _TIMES[1] * unit),
            Parameter("T_f", "s", self._shortest, max(10.0 * unit, 20.0 * dt)),
        )
        for i, omega in enumerate(self._centres, 1):
            low, high = _PLACE[0] * omega, min(_PLACE[1] * omega, top)
            self.parameters += (
                Parameter(f"f_n{i}", "Hz", low / math.tau, high / math.tau),
                Parameter(f"depth_n{i}", "", *_DEPTH),
                Parameter(f"width_n{i}", "", *_WIDTH),
            )

    def shapes(self) -> Matrix:
        """Return gains and times in wide ranges, with the same notch at all resonances."""
        return self._rows([[shape] * len(self._centres) for shape in _NOTCH_STARTS])

    def grid(self) -> tuple[Matrix, float]:
        """Return the same with notches from none to wide ones in all combinations."""
        if not self._centres:
            return np.zeros((0, len(self.parameters))), 0.0
        return self._rows(itertools.product(_NOTCH_STARTS, repeat=len(self._centres))), 0.0

    def _rows(self, notches: Iterable[Sequence[tuple[float, float]]]) -> Matrix:
        """Return values with the depth and width of the notch at each resonance."""
        unit, rows = 1.0 / self.model.omega, []
        for shapes in notches:
            filters: list[float] = []
            for omega, shape in zip(self._centres, shapes, strict=True):
                filters += [omega / math.tau, *shape]
            for kv, tn, tf in itertools.product(_KV_STARTS, _TN_STARTS, _TF_STARTS):
                times = [kv / unit, tn * unit / kv, max(tf * unit, 1.05 * self._shortest)]
                rows.append([1.0, *times, *filters])
        return np.array(rows)

    def beside(self, values: Vector) -> Matrix:
        """Return none."""
        return np.zeros((0, values.size))

    def response(self, values: Matrix, omega: Vector) -> Complex:
        """Return C_y (m, k)."""
        dt = self.model.dt
        s = 2j / dt * np.tan(0.5 * dt * omega)[None, :]
        kp, kv, tn, tf = (values[:, i, None] for i in range(4))
        C = self.model.sign * kp * (1.0 + 1.0 / (tn * s)) * (kv + s / (1.0 + tf * s))
        for i in range(4, values.shape[1], 3):
            centre, depth, width = (values[:, i + j, None] for j in range(3))
            w = 2.0 / dt * np.tan(0.5 * dt * math.tau * centre)
            C = C * (s**2 + depth * width * w * s + w**2) / (s**2 + width * w * s + w**2)
        found: Complex = C
        return found

    def integral_gain(self, values: Matrix) -> Vector:
        """Return K_p K_v/T_n."""
        found: Vector = values[:, 0] * values[:, 1] / values[:, 2]
        return found

    def unstable_poles(self, values: Matrix) -> Vector:
        """Return zeros: filters are stable."""
        return np.zeros(values.shape[0])

    def rules(self, values: Matrix) -> Matrix:
        """Return nothing: the bounds of the parameters say all."""
        return np.zeros((values.shape[0], 0))

    def feedforward(self, of_model: Feedforward) -> dict[str, Any]:
        """Return the inertia and the viscous friction: of ``r''`` and ``r'``; it has no more."""
        _, viscous, inertia = of_model.series(2).tolist()
        return {"inertia": inertia, "viscous": viscous}

    def _arguments(self, values: Vector) -> dict[str, Any]:
        kp, kv, tn, tf = map(float, values[:4])
        return {"kv": kv, "kp": self.model.sign * kp, "tn": tn, "tf": tf}

    def _notches(self, values: Vector) -> list[dict[str, float]]:
        rows = values[4:].reshape(-1, 3).tolist()
        return [{"omega": math.tau * f, "depth": d, "width": w} for f, d, w in rows]

    def controller(self, values: Vector, **options: Any) -> PPI:
        """Return the controller."""
        notches = [Notch.at(**each) for each in self._notches(values)]
        name = "P-PI + notch" if notches else "P-PI"
        arguments = self._arguments(values) | {"name": name} | options
        return PPI(dt=self.model.dt, notches=notches, **arguments)

    def tables(self, values: Vector) -> dict[str, dict[str, Any]]:
        """Return the table of the controller."""
        table = {"kind": "p-pi"} | self._arguments(values)
        notches = self._notches(values)
        return {"controller": table | ({"notches": notches} if notches else {})}
