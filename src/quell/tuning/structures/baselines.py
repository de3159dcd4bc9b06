"""PI, PID, cascaded P-PI, LQG and the adaptive notch as structures: references of tunings.

PI and PID controllers with their filters, as the references of every tuning.

The response is exact for the sampled controller, because Tustin's rule maps each frequency to one:
``C(s)`` at ``s = 2j tan(ω dt/2)/dt`` (Franklin, Powell & Workman, *Digital Control of Dynamic
Systems*, 1998, section 6.1). The integral gain k_i is that of C(s).

Cascaded position and speed loops with notch filters, as the reference of flexible axes.

``controllers/baselines/pid.py`` has the equations. There is a notch for each resonance of the
plant, two at most, with its own place, depth and width. The response is exact for the sampled
controller, as that of the PID structures.

LQG with its two bandwidths and the nominal gain, as a reference that knows the whole plant.

The weights follow from the bandwidths (``controllers/baselines/state_feedback.py``), for a plant
of ``g`` times the real gain. Scaling the nominal plant by g scales the weights so that the
controller is that of g = 1 over g: the factor does for LQG what b0 does for ADRC.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from quell.analysis.loop import law_matrix
from quell.analysis.margins import Complex, Response, eigenvalues
from quell.controllers.baselines.adaptive_notch import AdaptiveNotch
from quell.controllers.baselines.pid import PID, PPI, Notch
from quell.controllers.baselines.state_feedback import LQG
from quell.controllers.feedforward import Feedforward
from quell.lti.models import System
from quell.plants.linear import LinearPlant
from quell.tuning.structures.base import Model, Parameter, resonances
from quell.types import Matrix, Vector

# ---- PI and PID controllers with their filters, as the references of every tuning ----

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
        return self.model.sign * (kp + ki / s + kd * s) / (1.0 + f1 * s + f2 * s**2)

    def integral_gain(self, values: Matrix) -> Vector:
        """Return K/T_i."""
        return values[:, 0] / values[:, 1]

    def unstable_poles(self, values: Matrix) -> Vector:
        """Return zeros: filters are stable."""
        return np.zeros(values.shape[0])

    def on_circle(self, values: Matrix) -> Matrix:
        """Return none: integrators are the only poles there."""
        return np.zeros((values.shape[0], 0))

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


# ---- Cascaded position and speed loops with notch filters, as the reference of flexible axes ----

# Notches lie below this share of half the sampling rate. Drives have two to four filters; a third
# resonance is hardly ever below the limit.
_BELOW, _MOST = 0.95, 2
# Bounds of depth and width of a notch, and of its place in units of the resonance: drives have
# notches of −40 dB at most.
_DEPTH, _WIDTH, _PLACE = (0.01, 0.999), (0.05, 6.0), (0.2, 5.0)
# Bounds of times in units of the time of one radian at the plant's phase crossover.
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
        return C

    def integral_gain(self, values: Matrix) -> Vector:
        """Return K_p K_v/T_n."""
        return values[:, 0] * values[:, 1] / values[:, 2]

    def unstable_poles(self, values: Matrix) -> Vector:
        """Return zeros: filters are stable."""
        return np.zeros(values.shape[0])

    def on_circle(self, values: Matrix) -> Matrix:
        """Return none: integrators are the only poles there."""
        return np.zeros((values.shape[0], 0))

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


# ---- LQG with its two bandwidths and the nominal gain ----

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

    def _made(self, *shape: float) -> _Law:
        dt, omega_c = self.model.dt, shape[0]
        law = self._controller(self.plant, *shape).law
        N = law_matrix(law)
        response = Response(System(N, law.B_y + law.B_u * law.D_y, -law.C, -law.D_y))
        low = _LOW * omega_c
        gain = float(np.real(1j * low * response([low], dt)[0]))
        unstable = int(np.sum(np.abs(1.0 + eigenvalues(N)) > _RUNS_AWAY))
        return _Law(response, abs(gain), unstable)

    def _laws(self, values: Matrix) -> list[_Law]:
        return [self._law(*map(float, row[1:])) for row in values]

    def _controller(self, plant: LinearPlant, *shape: float, **limits: Any) -> Any:
        omega_c, omega_o = shape
        return LQG(plant, omega_c, omega_o, self.model.dt, **limits)

    def grid(self) -> tuple[Matrix, float]:
        """Return none."""
        return np.zeros((0, len(self.parameters))), 0.0

    def beside(self, values: Vector) -> Matrix:
        """Return none."""
        return np.zeros((0, values.size))

    def response(self, values: Matrix, omega: Vector) -> Complex:
        """Return C_y (m, k)."""
        rows = [law.response(omega, self.model.dt) for law in self._laws(values)]
        return np.array(rows) / values[:, :1]

    def integral_gain(self, values: Matrix) -> Vector:
        """Return k_i (m,)."""
        return np.array([law.integral_gain for law in self._laws(values)]) / values[:, 0]

    def unstable_poles(self, values: Matrix) -> Vector:
        """Return the number of unstable poles of C_y (m,)."""
        return np.array([float(law.unstable) for law in self._laws(values)])

    def on_circle(self, values: Matrix) -> Matrix:
        """Return none: integrators are the only poles there."""
        return np.zeros((values.shape[0], 0))

    def rules(self, values: Matrix) -> Matrix:
        """Return no constraints: the bandwidths' bounds are all."""
        return np.zeros((values.shape[0], 0))

    def controller(self, values: Vector, **limits: Any) -> Any:
        """Return the controller."""
        factor, *shape = map(float, values)
        plant = LinearPlant(self.plant.A, factor * self.plant.B, self.plant.C)
        return self._controller(plant, *shape, **limits)

    def feedforward(self, of_model: Feedforward) -> dict[str, Any]:
        """Return none: the observer's state does not follow a reference."""
        return {}

    def tables(self, values: Vector) -> dict[str, dict[str, Any]]:
        """Return the table of the controller, with its own model of the plant."""
        factor, omega_c, omega_o = map(float, values[:3])
        parts = (self.plant.A, factor * self.plant.B, self.plant.C)
        plant = dict(zip("ABC", (part.tolist() for part in parts), strict=True))
        model = {"kind": "linear"} | plant
        table = {"kind": "lqg", "omega_c": omega_c, "omega_o": omega_o, "plant": model}
        return {"controller": table}


# ---- The same with oscillators in the filter, whose frequencies are found and followed ----

# Bounds of the oscillators' bandwidth, and values to start from, in units of their frequency.
_OF_OSCILLATORS, _OSCILLATOR_STARTS = (1e-3, 1.0), (0.02, 0.1)
# Frequencies are followed within this factor of the lowest and of the highest.
_AROUND = 2.0


class NotchStructure(LqgStructure):
    """An ``AdaptiveNotch`` by bandwidths; its law is that at the frequencies it starts with."""

    name = "adaptive-notch"

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        frequencies = model.frequencies
        if not frequencies and model.load is not None:
            share = np.cumsum(model.load.power) / np.sum(model.load.power)
            frequencies = (float(model.load.omega[np.searchsorted(share, 0.5)]),)
        if not frequencies:
            raise ValueError(
                "its margins are those with oscillators at frequencies: give frequencies, or an "
                "objective LoadSpectrum"
            )
        self.frequencies = frequencies
        middle = math.exp(float(np.mean(np.log(frequencies))))
        low, high = (share * middle for share in _OF_OSCILLATORS)
        self.parameters += (Parameter("bandwidth", "rad/s", low, high),)
        self._starts = [share * middle for share in _OSCILLATOR_STARTS]

    def shapes(self) -> Matrix:
        """Return bandwidths in wide ranges, each with slow and with quick oscillators."""
        rows = super().shapes()
        return np.vstack([np.column_stack([rows, np.full(len(rows), b)]) for b in self._starts])

    def on_circle(self, values: Matrix) -> Matrix:
        """Return the frequencies of the oscillators (m, k) [rad/s]."""
        return np.tile(np.array(self.frequencies), (len(values), 1))

    def _options(self, bandwidth: float) -> dict[str, Any]:
        low, high = min(self.frequencies) / _AROUND, max(self.frequencies) * _AROUND
        band = (low, min(high, 0.9 * math.pi / self.model.dt))
        options = {"bandwidth": bandwidth, "count": len(self.frequencies), "band": band}
        return options | {"frequencies": self.frequencies}

    def _controller(self, plant: LinearPlant, *shape: float, **limits: Any) -> Any:
        omega_c, omega_o, bandwidth = shape
        options = self._options(bandwidth) | limits
        return AdaptiveNotch(plant, omega_c, omega_o, self.model.dt, **options)

    def tables(self, values: Vector) -> dict[str, dict[str, Any]]:
        """Return the table of the controller, with its own model of the plant."""
        own = self._options(float(values[3]))
        own |= {"band": list(own["band"]), "frequencies": list(own["frequencies"])}
        return {"controller": super().tables(values)["controller"] | {"kind": self.name} | own}
