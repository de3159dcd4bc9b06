"""ADRC by bandwidths, with poles of its own, at half gain, of reduced order, with a model.

The poles of the law and of the observer are each one number, the bandwidth, or *freed*: a factor
``s² + 2 ζ ω s + ω²`` for each two of them, real or complex, and a real pole if their number is odd.
A freed ADRC of order 1 has the feedback of a PI controller with a filter of first order, one of
order 2 that of a PID controller with a filter of second order (``baselines/equivalent.py``), as
long as the loop with its own nominal plant is stable; ``equivalent.py`` finds these as starts.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.analysis.frequency_response import Complex
from quell.controllers.adrc.adrc import ADRC
from quell.controllers.adrc.feedforward import Feedforward
from quell.lti.canonical import Canonical, canonical
from quell.lti.reduction import Reduced, without_far_zeros
from quell.observers.eso import ESO
from quell.plants.linear import LinearPlant
from quell.tuning.structures import sampled_adrc
from quell.tuning.structures.base import Model, Parameter, resonances
from quell.types import Matrix, Vector

# Bounds of a pole in units of the plant's phase crossover, and of the damping of a pair. The law's
# poles are those of the ideal response to the reference: with a damping of 0.6 it overshoots by
# 9 %. The observer's poles show in no response to the reference, but while u is at a limit; the
# equivalents of PID controllers with slow filters have them hardly damped.
_SLOWEST = 1e-3
_DAMPING = {"c": (0.6, 20.0), "o": (0.03, 20.0)}
# Bandwidths to start from: of the law in units of the plant's phase crossover, and of the observer
# in units of the law's.
_LAW_STARTS = (0.02, 0.07, 0.2, 0.5, 1.2, 3.0)
_OBSERVER_STARTS = (0.3, 1.0, 3.0, 10.0, 30.0)
# With more extended states one slower than the law is often the best under bounds of M_s.
_SLOW_OBSERVER = 0.1
# Damping of the observer's pair at a resonance of the plant, and of the law's, to start from.
_RESONANCE_STARTS, _MOVED = (0.1, 0.4), 0.7
# With a model there are many valleys, also with an observer far slower than a quick law: a grid of
# bandwidths from this share of the crossover to this one of the fastest, with so many for each.
_FROM, _TO, _COUNT = 0.03, 0.98, 9
# k_i is infinite where a second pole comes to z = 1. Beside it, on the side of positive k_i, may be
# the best optimum: the law's bandwidths in units of that of an optimum, the observer's that are
# searched, and their distance from there, as a share.
_LAWS, _LOWEST_OBSERVER, _OBSERVERS, _OFF = (0.5, 1.0, 2.0), 1e-3, 300, 0.1


@dataclass(frozen=True)
class Form:
    """Which kind of ADRC a structure has."""

    freed: bool = False
    reduced: bool = False
    half_observer: bool = False
    half_law: bool = False
    based: bool = False
    knows_delay: bool = False
    extended: int = 1  # number of extended states, and of integrators


class _Designed(NamedTuple):
    """Designs for values (m, p): one for neighbouring rows that differ in b0 only."""

    designs: sampled_adrc.Designs
    of_row: NDArray[np.intp]  # number of the design of each row (m,)


class AdrcStructure:
    """An ADRC of one form and order."""

    gain_power = -1

    def __init__(
        self, model: Model, name: str, order: int, form: Form, reduced: Reduced | None = None
    ) -> None:
        self.name, self.form = name, form
        # The design model of a form with a model; all else is about the plant itself.
        self.reduced = reduced
        if reduced is not None and str(reduced):
            own = canonical(reduced.plant)
            model = model._replace(plant=reduced.plant, degree=own.degree, b=abs(own.b))
        self.model = model
        self.gain_sign = model.sign
        # With s^(n+1) A + b0 B = p_law p_observer the poles of 1/A are as fast as the loop's. With
        # a model, D s A + b0 N B has A less the model's own poles: it may have a slow one.
        self.may_swing = form.based and form.extended == 1
        self.integrators = form.extended
        self.plant: Canonical = (
            canonical(model.plant) if form.based else canonical((np.zeros(order), 1.0))
        )
        if form.based and self.plant.unstable_zeros.size:
            raise ValueError("the plant has zeros outside of the left half plane, which it inverts")
        self.order, self.degree = self.plant.a.size, self.plant.degree
        self._last: tuple[bytes, Any] = b"", None
        self._chain = sampled_adrc.sampled_chain(self.plant, model.dt, form.extended)
        self._delay = round(model.delay / model.dt) if form.knows_delay else 0
        self._fastest = model.constraints.omega_o_dt / model.dt
        self._damping = dict(_DAMPING)
        least = model.constraints.damping
        if least is not None and not resonances(model, least):
            low, high = _DAMPING["o"]
            self._damping["o"] = (max(low, least), high)
        self._observed = self.order + form.extended - form.reduced
        unit = model.gain * model.omega**self.degree
        self.parameters = (
            Parameter("b0", f"y-unit/u-unit/s^{self.degree}", 1e-10 * unit, 1e10 * unit),
            *self._pole_parameters("c", self.degree),
            *self._pole_parameters("o", self._observed),
        )

    def _pole_parameters(self, which: str, count: int) -> list[Parameter]:
        bounds = (min(_SLOWEST * self.model.omega, 0.1 * self._fastest), self._fastest)
        if not self.form.freed:
            return [Parameter(f"omega_{which}", "rad/s", *bounds)]
        found = []
        for i in range(count // 2):
            found.append(Parameter(f"omega_{which}{i + 1}", "rad/s", *bounds))
            found.append(Parameter(f"damping_{which}{i + 1}", "", *self._damping[which]))
        if count % 2:
            found.append(Parameter(f"pole_{which}", "rad/s", *bounds))
        return found

    # ---- poles from the parameters

    def _columns(self) -> int:
        return 1 + (self.degree if self.form.freed else 1)

    def poles(self, values: Matrix) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the poles of the law (m, r) and of the observer (m, N) [rad/s]."""
        split = self._columns()
        parts = ((values[:, 1:split], self.degree), (values[:, split:], self._observed))
        law, observer = (self._roots(part, count) for part, count in parts)
        return law, observer

    def _roots(self, values: Matrix, count: int) -> NDArray[np.complex128]:
        if not self.form.freed:
            return np.repeat(-values[:, :1].astype(complex), count, axis=1)
        columns = []
        for i in range(count // 2):
            omega, damping = values[:, 2 * i], values[:, 2 * i + 1].astype(complex)
            root = np.sqrt(damping**2 - 1.0)
            columns += [-omega * (damping - root), -omega * (damping + root)]
        if count % 2:
            columns.append(-values[:, count - 1].astype(complex))
        return np.stack(columns, axis=1)

    def rows_of(self, b0: float, law: Any, observer: Any) -> Vector | None:
        """Return the values with these poles; None if they cannot be put into pairs."""
        row = [b0]
        for poles in (law, observer):
            factors = _factors(np.asarray(poles, dtype=complex))
            if factors is None:
                return None
            row += factors
        return np.array(row)

    def from_other(self, other: AdrcStructure, values: Vector) -> Vector | None:
        """Return the values with the poles of another form of the same order, if there are any."""
        same = (other.degree, other.order, other.form.based, other.form.extended)
        own = (self.degree, self.order, self.form.based, self.form.extended)
        if other is self or same != own:
            return None
        law, observer = (poles[0] for poles in other.poles(values[None, :]))
        if not self.form.freed:
            sizes = [float(np.exp(np.mean(np.log(np.abs(poles))))) for poles in (law, observer)]
            return np.array([float(values[0]), *sizes])
        if observer.size != self._observed:
            return None
        return self.rows_of(float(values[0]), law, observer)

    # ---- the structure

    def shapes(self) -> Matrix:
        """Return bandwidths in wide ranges; freed poles start in one place, or in two."""
        omega, rows = self.model.omega, []
        b0 = self.model.b if self.degree == self.model.degree else 1.0
        ratios = (
            _OBSERVER_STARTS if self.form.extended == 1 else (_SLOW_OBSERVER, *_OBSERVER_STARTS)
        )
        for law, ratio in itertools.product(_LAW_STARTS, ratios):
            pair = (law * omega, law * ratio * omega)
            if max(pair) > 0.999 * self._fastest:
                pair = (min(pair[0], 0.9 * self._fastest), 0.99 * self._fastest)
            if not self.form.freed:
                rows.append(np.array([b0, *pair]))
                continue
            counts = (self.degree, self._observed)
            poles = [np.full(n, -p) for n, p in zip(counts, pair, strict=True)]
            found = self.rows_of(b0, *poles)
            if found is not None:
                rows.append(found)
        return np.array(rows)

    def _around_resonance(self, shape: Vector) -> list[Vector]:
        """Return values with a pair of the observer's poles where the plant resonates.

        An observer leaves a resonance where it is, and damps it. Where the law moves it, too, it
        has poles there as well.
        """
        roots = np.roots(np.append(1.0, self.plant.a[::-1]))
        size = np.abs(roots)
        resonant = size[(roots.imag > 0.0) & (-roots.real < 0.5 * size) & (size < self._fastest)]
        resonant = resonant[resonant > 1e-6 * np.max(size, initial=0.0)]
        law, observer = (poles[0] for poles in self.poles(shape[None, :]))
        b0, found = float(shape[0]), []
        for omega, damping in itertools.product(resonant.tolist(), _RESONANCE_STARTS):
            seen = np.concatenate([observer[2:], _pair(omega, damping)])
            found.append(self.rows_of(b0, law, seen))
            if self.degree > 2:
                moved = np.concatenate([law[2:], _pair(omega, _MOVED)])
                found.append(self.rows_of(b0, moved, seen))
        return [row for row in found if row is not None]

    def grid(self) -> tuple[Matrix, float]:
        """Return pairs of bandwidths, the law's and the observer's, for structures with a model.

        With freed poles they are those around the plant's resonances, without a spacing.
        """
        if not self.form.based:
            return np.zeros((0, len(self.parameters))), 0.0
        if self.form.freed:
            around = [row for shape in self.shapes() for row in self._around_resonance(shape)]
            return np.array(around).reshape(-1, len(self.parameters)), 0.0
        low = max(_FROM * self.model.omega, self.parameters[1].low)
        each = np.geomspace(min(low, 0.1 * self._fastest), _TO * self._fastest, _COUNT)
        rows = np.array([[self.model.b, *pair] for pair in itertools.product(each, each)])
        return rows, float(np.log(each[1] / each[0]))

    def beside(self, values: Vector) -> Matrix:
        """Return values beside the bandwidths of the observer at which k_i is infinite."""
        found: list[list[float]] = []
        if not self.form.based or self.form.freed:
            return np.zeros((0, len(self.parameters)))
        b0, law = values[:2].tolist()
        observers = np.geomspace(
            min(max(_LOWEST_OBSERVER * law, self.parameters[2].low), 0.1 * self._fastest),
            _TO * self._fastest,
            _OBSERVERS,
        )
        for omega_c in (min(factor * law, _TO * self._fastest) for factor in _LAWS):
            tried = np.column_stack([np.broadcast_to((b0, omega_c), (_OBSERVERS, 2)), observers])
            with np.errstate(divide="ignore"):
                inverse = 1.0 / self.integral_gain(tried)
            for i in np.flatnonzero(np.signbit(inverse[1:]) != np.signbit(inverse[:-1])):
                share = inverse[i] / (inverse[i] - inverse[i + 1])
                infinite = observers[i] * (observers[i + 1] / observers[i]) ** share
                beside = 1.0 + _OFF if inverse[i + 1] > 0.0 else 1.0 / (1.0 + _OFF)
                found.append([b0, omega_c, float(infinite * beside)])
        return np.array(found).reshape(-1, 3)

    def _designs(self, values: Matrix) -> _Designed:
        key = values.tobytes()
        if key != self._last[0]:  # response and integral gain are asked for in turn
            self._last = key, self._made(values)
        return self._last[1]

    def _made(self, values: Matrix) -> _Designed:
        law, observer = self.poles(values)
        gains = sampled_adrc.coefficients(law) * (0.5 if self.form.half_law else 1.0)
        is_new = np.ones(len(values), dtype=bool)
        is_new[1:] = np.any(values[1:, 1:] != values[:-1, 1:], axis=1)
        found = sampled_adrc.designs(
            self._chain,
            gains,
            observer,
            np.flatnonzero(is_new),
            reduced=self.form.reduced,
            half_gain=self.form.half_observer,
            delay=self._delay,
        )
        return _Designed(found, np.cumsum(is_new) - 1)

    def response(self, values: Matrix, omega: Vector) -> Complex:
        """Return C_y (m, k)."""
        found, of_row = self._designs(values)
        factor = self.model.sign * found.factor[of_row] / values[:, 0]
        response: Complex = factor[:, None] * sampled_adrc.feedback(found, omega)[of_row]
        return response

    def integral_gain(self, values: Matrix) -> Vector:
        """Return k_i (m,)."""
        found, of_row = self._designs(values)
        gain: Vector = (found.integral_gain * found.factor)[of_row] / values[:, 0]
        return gain

    def unstable_poles(self, values: Matrix) -> Vector:
        """Return how many poles of C_y are unstable (m,)."""
        found, of_row = self._designs(values)
        return sampled_adrc.unstable_poles(found)[of_row]

    def rules(self, values: Matrix) -> Matrix:
        """Return ``1 − 2 ζ ω/R + (ω/R)²`` of each pair: negative if one real pole is beyond R.

        The bounds of the parameters keep ω below R.
        """
        columns, split = [], self._columns()
        if self.form.freed:
            for first, count in ((1, self.degree), (split, self._observed)):
                for i in range(count // 2):
                    share = values[:, first + 2 * i] / self._fastest
                    damping = values[:, first + 2 * i + 1]
                    columns.append(1.0 - 2.0 * damping * share + share**2)
        return np.stack(columns, axis=1) if columns else np.zeros((values.shape[0], 0))

    # ---- what comes of it

    def _patterns(self, values: Vector) -> tuple[float, float, Any, Any]:
        """Return omega_c, omega_o and the patterns of poles in units of them."""
        law, observer = (poles[0] for poles in self.poles(values[None, :]))
        if not self.form.freed:
            return float(-law[0].real), float(-observer[0].real), None, None
        omega_c, omega_o = (float(np.exp(np.mean(np.log(np.abs(p))))) for p in (law, observer))
        return omega_c, omega_o, _pattern(law / omega_c), _pattern(observer / omega_o)

    def controller(self, values: Vector, **options: Any) -> ADRC:
        """Return the controller."""
        omega_c, omega_o, law, observer = self._patterns(values)
        b0, dt = self.model.sign * float(values[0]), self.model.dt
        form: dict[str, Any] = {
            "form": "reduced" if self.form.reduced else "current",
            "half_gain": self.form.half_observer,
            "delay": self._delay * dt,
            "poles": observer,
            "disturbance_order": self.form.extended,
        }
        if self.form.based:
            form |= {"far": math.inf}
            eso = ESO.model_based(self.model.plant, omega_o, dt, b0=b0, **form)
        else:
            eso = ESO.model_free(self.order, b0, omega_o, dt, **form)
        return ADRC(eso, omega_c, half_gain=self.form.half_law, law_poles=law, **options)

    def feedforward(self, of_model: Feedforward) -> dict[str, Any]:
        """Return the feedforward as it is."""
        return {"feedforward": of_model}

    def tables(self, values: Vector) -> dict[str, dict[str, Any]]:
        """Return the tables of observer and controller."""
        omega_c, omega_o, law, poles = self._patterns(values)
        b0 = self.model.sign * float(values[0])
        observer: dict[str, Any] = {"kind": "model-based" if self.form.based else "model-free"}
        if not self.form.based:
            observer["order"] = self.order
        observer |= {"b0": b0, "omega_o": omega_o}
        if self.reduced is not None and str(self.reduced):
            num, den = (np.asarray(part).tolist() for part in self.model.plant)
            observer["plant"] = {"kind": "linear", "num": num, "den": den}
        elif self.form.based:  # the plant of the file may be late, or not linear
            linear = LinearPlant.of(self.model.plant)
            parts = zip("ABC", (linear.A, linear.B, linear.C), strict=True)
            observer["plant"] = {"kind": "linear"} | {key: part.tolist() for key, part in parts}
            if without_far_zeros(self.model.plant, omega_o).zeros.size:
                observer["far"] = math.inf
        if poles is not None:
            observer["poles"] = _listed(poles)
        if self.form.reduced:
            observer["form"] = "reduced"
        if self.form.half_observer:
            observer["half_gain"] = True
        if self.form.extended > 1:
            observer["disturbance_order"] = self.form.extended
        if self._delay:
            observer["delay"] = self._delay * self.model.dt
        controller: dict[str, Any] = {"kind": "adrc", "omega_c": omega_c}
        if law is not None:
            controller["law_poles"] = _listed(law)
        if self.form.half_law:
            controller["half_gain"] = True
        return {"observer": observer, "controller": controller}


def _pair(omega: float, damping: float) -> NDArray[np.complex128]:
    """Return two conjugate poles."""
    root = 1j * np.sqrt(1.0 - damping**2)
    return np.array([-omega * (damping - root), -omega * (damping + root)])


def _pattern(poles: NDArray[np.complex128]) -> tuple[Any, ...]:
    """Return poles as numbers, and pairs (real, imaginary) for two conjugate ones."""
    real = [float(p.real) for p in poles if p.imag == 0.0]
    pairs = [(float(p.real), float(p.imag)) for p in poles if p.imag > 0.0]
    return (*real, *pairs)


def _listed(pattern: tuple[Any, ...]) -> list[Any]:
    return [list(entry) if isinstance(entry, tuple) else entry for entry in pattern]


def _factors(poles: NDArray[np.complex128]) -> list[float] | None:
    """Return (ω, ζ) of pairs of poles, and the size of a single one; None for unstable ones."""
    if not np.all(poles.real < 0.0):
        return None
    tiny = 1e-9 * np.abs(poles)
    pairs = list(poles[poles.imag > tiny])
    real = sorted(-poles.real[np.abs(poles.imag) <= tiny])
    found: list[float] = []
    for p in pairs:
        found += [float(abs(p)), float(-p.real / abs(p))]
    # Of real poles the fastest ones form pairs; a single one is the slowest.
    single = [real.pop(0)] if len(real) % 2 else []
    while real:
        slow, fast = real.pop(0), real.pop(0)
        omega = float(np.sqrt(slow * fast))
        found += [omega, 0.5 * float(slow + fast) / omega]
    return found + [float(p) for p in single]
