"""Loops of many controllers with a set of plants: responses in frequency and in time.

The loops of many controllers with a set of plants: responses, stability, peaks.

All plants of a set are sampled with the controller's dt, dead time and lag included, and have their
responses at the same frequencies. The responses are exact (``analysis.frequency_response``). The
grid only brackets: ``peaks`` finds the largest values between its points.

The linear law of a controller in closed form, quick enough for each step of a search.

``quell.analysis`` measures the same matrices on the controller's own kernel, for any form of
observer; here they are derived, for the forms that the structures of tuning make. Without learner,
guard and nonlinear parts the state of an ADRC is the observer's prediction z⁻, its input the error
``e = y − z⁻_1``. With the correction ``z = J z⁻ + H e`` and the estimates ``x̂ = T z⁻ + D e``::

    z⁻⁺ = F z + Γ u = F J z⁻ + F H e + Γ u
    u   = ( k_1 r + k_2 r' + … + r^(m) + (a − k)·x̂_{1…n} − Δf̂ ) / b0        (``controllers/law.py``)

For an ESO (``observers/forms.py``) ``F = Φ``, ``H = L`` and ``J = I``; in the predictor form the
estimates are z⁻ itself. In a cascade of p levels (``observers/forms.py``) each level corrects the
next one. The terms with r', r'', … are left out: they change no pole.

Responses of linear loops over time, for objectives and limits of u that are about them.

The closed loop of a sampled plant and a law is linear, so every response is the convolution of a
pulse response with the input. The pulse response ``D, C B, C A B, …`` is one product: of the rows
``C A^i``, i < b, and the columns ``A^(b j) B``. Each set doubles with each squaring of A, which is
kept less the unit matrix.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from functools import cached_property, singledispatch
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.analysis.loop import closed_loop, closed_loop_matrix, law_matrix
from quell.analysis.margins import (
    Complex,
    Response,
    ResponseSet,
    eigenvalues,
    frequencies,
    in_s_plane,
)
from quell.controllers.base import Controller
from quell.controllers.baselines.adaptive_notch import AdaptiveNotch
from quell.controllers.compensated import CompensatedDesign
from quell.controllers.law import AdrcDesign, LinearFeedback, ModelFeedforward, reference_part
from quell.controllers.linear import LinearDesign, LinearLaw
from quell.controllers.schedule import NoSchedule
from quell.guard import UnguardedDesign
from quell.learners.base import NoLearnerDesign
from quell.lti.models import System
from quell.observers.forms import CascadeModel, DelayedModel, EsoModel, without_delay
from quell.plants.linear import SampledPlant
from quell.tuning.structures.base import Structure
from quell.types import DesignWarning, Matrix, Vector

# ---- The loops of many controllers with a set of plants ----

# The lowest frequency of the grid, in units of the phase crossover; a pole below a tenth of it
# counts as an integrator.
_BOTTOM = 1e-4
# With integral action |L| is large at the lowest frequency, if that is below the loop's dynamics.
_LEAST_BOTTOM = 3.0
# Points per decade of the grid. With a dead time responses have a peak in each turn of its phase:
# the grid has an even part with so many radians between points, up to where the plant's gain has
# fallen to this share of that at the crossover. Beyond, the loop's gain is too small for peaks.
_POINTS_PER_DECADE, _TURN, _FALLEN = 24, 0.5, 0.02
NARROW = 0.1
"""Poles with less damping have peaks beside them that may lie between points of the grid."""
# Splines whose weights are found together, to bound their memory.
_UNITS = 64
# Half the sampling rate itself is a pole of Tustin's rule.
_BELOW_HALF = 1.0 - 1e-6
# Points between the neighbours of a maximum, and how often they are placed anew: an interval of
# 0.1 shrinks to 1e-5.
_ZOOM, _ZOOMS = 17, 3


class Peak(NamedTuple):
    """A local maximum over frequency."""

    value: float
    omega: float
    plant: int


class PlantSet:
    """Sampled plants with factors of their gain, on a common grid of frequencies.

    Attributes
    ----------
    plants, factors
        the plants (J,) and the factors of their gain (J,).
    omega : array
        the grid (G,) [rad/s].
    P : array
        the responses (J, G).
    crossover : float
        frequency at which the first plant's phase lag is half a turn, or its scale [rad/s].
    """

    def __init__(self, plants: Sequence[SampledPlant], factors: Vector, dt: float) -> None:
        self.plants, self.factors, self.dt = tuple(plants), factors, dt
        distinct = {id(plant): plant for plant in plants}
        self._responses = {
            key: Response(System(plant.N, plant.B, plant.C, 0.0)) for key, plant in distinct.items()
        }
        self._set = ResponseSet([*self._responses.values()])
        places = {key: i for i, key in enumerate(self._responses)}
        self._of_set = np.array([places[id(plant)] for plant in self.plants])
        self._poles = {key: eigenvalues(plant.N) for key, plant in distinct.items()}
        self.crossover = self._crossover()
        self.omega = self._grid()
        self.P = self.responses(self.omega)
        self._open = [self._open_poles(self._poles[id(plant)]) for plant in self.plants]
        #: modes of the plants for a bound of the damping, as ``requirements.counted`` finds them
        self.modes: dict[float, list[tuple[Complex, int]]] = {}

    def responses(self, omega: Vector) -> Complex:
        """Return P (J, k)."""
        rows, count = np.arange(len(self._responses)), omega.size
        found = self._set(np.tile(omega, rows.size), np.repeat(rows, count), self.dt)
        return found.reshape(-1, count)[self._of_set] * self.factors[:, None]

    def responses_of(self, omega: Vector, members: NDArray[np.intp]) -> Complex:
        """Return P (k,) at frequencies (k,), each of the plant with that number."""
        return self._set(omega, self._of_set[members], self.dt) * self.factors[members]

    @cached_property
    def resonant(self) -> bool:
        """Whether a plant has poles with so little damping that peaks beside them are narrow."""
        found = [self.s_poles(plant) for plant in self.plants]
        return any(np.any((s.imag > 0.0) & (-s.real < NARROW * s.imag)) for s in found)

    @cached_property
    def spline_weights(self) -> Vector:
        """Weights (G,) of values on the grid in the integral over log ω of their cubic spline."""
        from scipy.interpolate import CubicSpline

        x, units = np.log(self.omega), np.eye(self.omega.size)
        parts = np.array_split(units, -(-self.omega.size // _UNITS))
        found = [CubicSpline(x, part, axis=1).integrate(x[0], x[-1]) for part in parts]
        return np.concatenate(found)

    def scaled(self) -> list[SampledPlant]:
        """Return the plants with the factors of their gain."""
        return self._scaled

    @cached_property
    def _scaled(self) -> list[SampledPlant]:
        return [
            plant if factor == 1.0 else plant._replace(B=plant.B * factor, E=plant.E * factor)
            for plant, factor in zip(self.plants, self.factors.tolist(), strict=True)
        ]

    def s_poles(self, plant: SampledPlant) -> Complex:
        """Return the poles of a plant of the set [rad/s], but for those at z = 0."""
        poles = in_s_plane(self._poles[id(plant)], self.dt)
        return poles[np.isfinite(poles)]

    def _crossover(self) -> float:
        top = math.pi / self.dt
        first = self.plants[0]
        sizes = np.abs(self.s_poles(first))
        sizes = sizes[(sizes > 1e-7 * top) & (sizes < top)]
        low = 1e-2 * float(np.min(sizes, initial=1e-2 * top))
        omega = np.geomspace(low, top * _BELOW_HALF, 600)
        response = self._responses[id(first)](omega, self.dt)
        phase = np.unwrap(np.angle(response))
        phase += -2.0 * np.pi * np.round((phase[0] + 0.5 * np.pi) / (2.0 * np.pi))
        late = np.flatnonzero(phase <= -np.pi)
        if late.size and late[0] > 0:
            return float(omega[late[0]])
        return float(np.exp(np.mean(np.log(sizes)))) if sizes.size else 0.1 * top

    def _grid(self) -> Vector:
        top = math.pi / self.dt * _BELOW_HALF
        bottom = min(_BOTTOM * self.crossover, 0.01 * top)
        count = math.ceil(_POINTS_PER_DECADE * math.log10(top / bottom)) + 1
        parts = [np.geomspace(bottom, top, count)]
        longest = max(dead_samples(plant) for plant in self.plants) * self.dt
        if longest > 0.0:
            end = self._end_of_peaks(top)
            parts.append(np.arange(1.0, end * longest / _TURN) * (_TURN / longest))
        for plant in self.plants:
            poles = self.s_poles(plant)
            poles = poles[poles.imag > 0.0]
            resonant = poles[-poles.real < 0.5 * poles.imag]
            if resonant.size:
                near = frequencies(resonant, self.dt)
                parts.append(near[_beside(near, resonant)])
        grid = np.unique(np.concatenate(parts))
        return grid[(grid >= bottom) & (grid <= top)]

    def _end_of_peaks(self, top: float) -> float:
        """Return the frequency above which all plants' gain is small [rad/s]."""
        omega = np.geomspace(self.crossover, top, 100)
        gain = np.abs(self.responses(omega))
        large = np.flatnonzero(np.any(gain > _FALLEN * gain[:, :1], axis=0))
        return float(omega[large[-1]])

    def _open_poles(self, shifted: Complex) -> tuple[float, float, Vector]:
        """Return unstable poles, integrators, and the frequencies of undamped ones [rad/s]."""
        s = in_s_plane(shifted, self.dt)
        s = s[np.isfinite(s)]
        zero = np.abs(s) < 0.1 * float(self.omega[0])
        undamped = ~zero & (np.abs(s.real) <= 1e-6 * np.abs(s.imag))
        unstable = ~zero & ~undamped & (s.real > 0.0)
        on_axis = s[undamped & (s.imag > 0.0)].imag
        return float(np.sum(unstable)), float(np.sum(zero)), np.sort(on_axis)

    # ---- loops

    def unstable_loops(
        self, C: Complex, controller: Vector, at_one: int = 1, on_circle: Matrix | None = None
    ) -> Matrix:
        """Return the number (m, J) of unstable closed-loop poles, by the argument principle.

        ``1 + L`` is the closed loop's polynomial over the open loop's. Over the upper half circle
        each root inside adds π to the argument of a polynomial, one outside nothing, one at z = 1
        π/2. So the argument of 1 + L grows by ``π (open unstable + open at one / 2 − closed
        unstable)``. A pole on the circle counts as inside: at it the argument falls by π.

        Parameters
        ----------
        C
            responses (m, G) of controllers with ``at_one`` poles at z = 1, on the grid.
        controller
            their numbers of unstable poles (m,).
        on_circle
            frequencies (m, k) at which they have poles on the unit circle [rad/s].
        """
        count = len(self.plants)
        columns = [self._unstable(j, C, controller, at_one, on_circle) for j in range(count)]
        return np.stack(columns, axis=1)

    def _unstable(
        self, j: int, C: Complex, controller: Vector, at_one: int, on_circle: Matrix | None
    ) -> Vector:
        """Return the number (m,) of unstable poles with the j-th plant."""
        unstable, integrators, on_axis = self._open[j]
        steps = np.diff(np.angle(1.0 + self.P[j] * C), axis=1)
        # Whole turns that bring each step to −π up to π; a remainder takes ten times as long.
        turns = np.count_nonzero(steps < -np.pi, axis=1)
        turns -= np.count_nonzero(steps >= np.pi, axis=1)
        at = np.searchsorted(self.omega, on_axis) - 1
        at = at[(at >= 0) & (at < steps.shape[1])]
        across = np.remainder(steps[:, at] + np.pi, 2.0 * np.pi) - np.pi
        turns -= np.count_nonzero(across > 0.0, axis=1)
        for omega in () if on_circle is None else on_circle.T:
            turns -= _across(steps, np.searchsorted(self.omega, omega) - 1)
        expected = unstable + controller + 0.5 * (integrators + at_one)
        count = np.round(expected - np.sum(steps, axis=1) / np.pi - 2.0 * turns)
        # A loop whose crossover lies below the grid: its slow poles do not show.
        count[np.abs(self.P[j, 0] * C[:, 0]) < _LEAST_BOTTOM] = np.inf
        return np.abs(count)

    def stable_rows(
        self, C: Complex, controller: Vector, at_one: int = 1, on_circle: Matrix | None = None
    ) -> NDArray[np.intp]:
        """Return which controllers stabilise all plants; arguments are those of unstable_loops.

        One that does not stabilise a plant is not tried with the next ones.
        """
        rows = np.arange(C.shape[0])
        for j in range(len(self.plants)):
            poles = None if on_circle is None else on_circle[rows]
            rows = rows[self._unstable(j, C[rows], controller[rows], at_one, poles) < 0.5]
        return rows


def _across(steps: Matrix, at: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return 1 for each row (m,) whose step number ``at`` would rise at a pole, where it falls."""
    rows = np.arange(at.size)
    inside = (at >= 0) & (at < steps.shape[1])
    step = steps[rows, np.clip(at, 0, steps.shape[1] - 1)]
    return (inside & (np.remainder(step + np.pi, 2.0 * np.pi) > np.pi)).astype(np.intp)


def peaks(
    function: Callable[[Vector, NDArray[np.intp]], NDArray[np.float64]],
    omega: Vector,
    values: Matrix,
    least: float,
) -> list[Peak]:
    """Return the local maxima (refined between grid points) above ``least``.

    ``function`` returns values (k,) at frequencies (k,) of the plants with numbers (k,);
    ``values`` (J, G) are those at ``omega``.
    """
    found = []
    padded = np.pad(values, ((0, 0), (1, 1)), constant_values=-np.inf)
    middle = padded[:, 1:-1]
    is_peak = (middle >= padded[:, :-2]) & (middle >= padded[:, 2:]) & (middle > least)
    plants, places = np.nonzero(is_peak)
    if plants.size == 0:
        return []
    x = np.log(omega)
    low, high = x[np.maximum(places - 1, 0)], x[np.minimum(places + 1, x.size - 1)]
    best, at = values[plants, places].copy(), x[places].copy()
    share = np.linspace(0.0, 1.0, _ZOOM)
    rows = np.arange(plants.size)
    for _ in range(_ZOOMS):
        points = low[:, None] + (high - low)[:, None] * share
        members = np.repeat(plants, _ZOOM)
        own = function(np.exp(points.ravel()), members).reshape(plants.size, _ZOOM)
        top = np.argmax(own, axis=1)
        better = own[rows, top] > best
        best = np.where(better, own[rows, top], best)
        at = np.where(better, points[rows, top], at)
        width = (high - low) / (_ZOOM - 1)
        low, high = np.maximum(at - width, low), np.minimum(at + width, high)
    for value, place, plant in zip(best, at, plants, strict=True):
        found.append(Peak(float(value), math.exp(place), int(plant)))
    return found


def dead_samples(plant: SampledPlant) -> int:
    """Return the number of samples that a plant's control signal waits."""
    return int(np.count_nonzero(np.diag(plant.N) == -1.0))


def _beside(omega: Vector, poles: Complex) -> NDArray[np.bool_]:
    """Return which frequencies lie within a fifth of a resonance."""
    distance = np.abs(omega[:, None] / poles.imag[None, :] - 1.0)
    return np.any(distance < 0.2, axis=1)


# ---- The linear law of a controller in closed form, quick enough for each step of a search ----


def law_of(controller: Controller) -> LinearLaw:
    """Return the law of a linear controller, driven by y and by the applied u without delay.

    Raises ``ValueError`` for a controller that is not linear.
    """
    if isinstance(controller, AdaptiveNotch):
        return controller.law
    law = _law(controller.parameters)
    if law is None:
        raise ValueError(f"controller = {controller!r}: must be linear")
    return law


class Prediction(NamedTuple):
    """The matrices above for an observer of s states and N estimates."""

    F: Matrix  # (s, s)
    input: Vector  # Γ (s,)
    J: Matrix  # (s, s)
    H: Vector  # (s,)
    T: Matrix  # (N, s)
    D: Vector  # (N,)


@singledispatch
def _prediction(model: Any) -> Prediction | None:
    """Return the matrices of a linear observer without delay; None for another one."""
    return None


@_prediction.register
def _of_eso(model: EsoModel) -> Prediction:
    size = model.gain.size
    unit, L = np.eye(size), model.gain
    D = np.zeros(size) if model.predictor else L
    return Prediction(model.transition, model.input, unit, L, unit, D)


@_prediction.register
def _of_cascade(model: CascadeModel) -> Prediction:
    levels, size = model.gains.shape
    states, n = levels * size, model.at_f
    F, J, H = np.zeros((states, states)), np.eye(states), np.zeros(states)
    error, error_e = np.zeros(states), 1.0  # of a level, from z⁻ and from e
    for level in range(levels):
        own = slice(level * size, (level + 1) * size)
        F[own, own] = model.transition
        for before in range(level):
            F[own, before * size + n] = model.feed
        J[own] += np.outer(model.gains[level], error)
        H[own] = model.gains[level] * error_e
        error, error_e = J[level * size].copy(), H[level * size]  # less the next level's z⁻_1
        error[(level + 1) * size % states] -= 1.0
    last = np.zeros((size, states))
    last[:, states - size :] = np.eye(size)
    for i in range(n, size):
        last[i, i::size] = 1.0  # Δf̂ and its derivatives are sums over the levels
    return Prediction(F, np.tile(model.input, levels), J, H, last @ J, last @ H)


@singledispatch
def _law(parameters: Any) -> LinearLaw | None:
    """Return the law of a controller with ``parameters``; None if it has none."""
    return None


@_law.register
def _of_linear_controller(design: LinearDesign) -> LinearLaw:
    return design.law


@_law.register
def _of_adrc(design: AdrcDesign) -> LinearLaw | None:
    kinds = tuple(map(type, (design.learner, design.guard, design.feedback)))
    found = _prediction(without_delay(design.eso))
    if isinstance(design.feedforward, ModelFeedforward):
        return None  # it acts on the observer with derivatives of r, and friction is not linear
    if found is None or kinds != (NoLearnerDesign, UnguardedDesign, LinearFeedback):
        return None
    if not isinstance(design.schedule, NoSchedule):
        return None  # analyse(plant, controller.at(…)) is for one point
    order = design.law.size
    gains = np.zeros(found.D.size)
    gains[: order + 1] = np.append(design.cancel - design.law, -design.cancel_f) / design.b0
    law = LinearLaw(
        A=found.F @ found.J,
        B_r=np.zeros(found.H.size),
        B_y=found.F @ found.H,
        B_u=found.input,
        C=gains @ found.T,
        D_r=reference_part(design.feedforward, design.law, 1.0, np.zeros(0)) / design.b0,
        D_y=float(gains @ found.D),
    )
    first = np.eye(law.C.size)[0]  # e = y − z⁻_1
    law = law._replace(A=law.A - np.outer(law.B_y, first), C=law.C - law.D_y * first)
    return _delayed(law, design.eso.samples) if isinstance(design.eso, DelayedModel) else law


@_law.register
def _of_both(design: CompensatedDesign) -> LinearLaw | None:
    first, then = _law(design.controller), _law(design.compensator)
    if first is None or then is None:
        return None
    # The controller is told ``u_0 + u − u_wished = u − C x − D_y y`` of the compensator's x.
    m, k = first.C.size, then.C.size
    A = np.zeros((m + k, m + k))
    A[:m, :m], A[:m, m:] = first.A, -np.outer(first.B_u, then.C)
    A[m:, :m], A[m:, m:] = np.outer(then.B_r, first.C), then.A
    return LinearLaw(
        A=A,
        B_r=np.append(first.B_r, then.B_r * first.D_r),
        B_y=np.append(first.B_y - first.B_u * then.D_y, then.B_y + then.B_r * first.D_y),
        B_u=np.append(first.B_u, then.B_u),
        C=np.append(then.D_r * first.C, then.C),
        D_r=then.D_r * first.D_r,
        D_y=then.D_y + then.D_r * first.D_y,
    )


def _delayed(law: LinearLaw, samples: int) -> LinearLaw:
    """Return the law with u acting on its state ``samples`` later, as further states."""
    m = law.C.size
    A = np.zeros((m + samples, m + samples))
    A[:m, :m], A[:m, -1] = law.A, law.B_u
    A[m + 1 :, m:-1] = np.eye(samples - 1)
    B_u = np.zeros(m + samples)
    B_u[m] = 1.0
    none = np.zeros(samples)
    B_r, B_y = np.append(law.B_r, none), np.append(law.B_y, none)
    return LinearLaw(A, B_r, B_y, B_u, np.append(law.C, none), law.D_r, law.D_y)


# ---- Responses of linear loops over time, for objectives and limits of u that are about them ----

# Controllers whose responses are kept: those of one difference quotient, and some more; fewer of
# long responses, so that all have at most so many numbers for each plant.
_KEPT, _KEPT_SAMPLES = 64, 3_200_000
# Responses to steps last so many radians of the plant's phase crossover. Of longer ones than so
# many samples every second is calculated, or every fourth …, which leaves 650 points per radian.
_LASTS, _ALL_SAMPLES = 150.0, 200_000
# Samples of a response to any reference, each of which counts.
_MOST_SAMPLES = 2_000_000
# Beyond, a response is that of an unstable loop: it would overflow.
_DIVERGED = 1e100


class Inputs(NamedTuple):
    """Inputs of a loop: the reference and the load at the plant's input, sample by sample.

    With the feedforward of a model the loop is that of the errors ``y − r`` and ``u − u_ff``
    (``controllers/feedforward.py``): the law sees ``y − r`` with a reference of zero, and the
    plant has u_ff besides what the law gives.
    """

    r: Vector  # (k,) [y-unit]
    d: Vector  # (k,) [u-unit]
    u_ff: Vector | None = None  # (k,) [u-unit]
    # Samples from one of the k to the next, a power of two; more than one for constant inputs only.
    distance: int = 1
    load: float = 1.0  # step of the load whose ∫|y| is an objective, until y is at rest [u-unit]

    def of_loop(self) -> tuple[tuple[str, Vector], ...]:
        """Return the inputs of the linear loop by their names in ``closed_loop``."""
        if self.u_ff is None:
            return ("r", self.r), ("d", self.d)
        return ("n", -self.r), ("d", self.d + self.u_ff)


def load_step(plants: PlantSet, size: float = 1.0, duration: float | None = None) -> Inputs:
    """Return a step of the load, by default for 150 radians of the plants' crossover.

    The samples of a long one are at a distance.
    """
    last = _LASTS / plants.crossover if duration is None else duration
    count, distance = max(round(last / plants.dt), 10), 1
    while count > _ALL_SAMPLES * distance:
        distance *= 2
    count = -(-count // distance)
    return Inputs(np.zeros(count), np.full(count, size), None, distance, size)


def reference_step(plants: PlantSet) -> Inputs:
    """Return a unit step of the reference, as long as ``load_step``."""
    load = load_step(plants)
    return Inputs(np.ones(load.r.size), np.zeros(load.r.size), distance=load.distance)


def samples_of(duration: float, dt: float) -> int:
    """Return the number of samples of a reference.

    Raises ``ValueError`` for more than can be calculated, each of which would count.
    """
    count = max(round(duration / dt), 10)
    if count > _MOST_SAMPLES:
        raise ValueError(
            f"duration = {duration:g} s has {count} samples of dt = {dt:g} s: a response to a "
            f"reference has at most {_MOST_SAMPLES}; give a shorter duration, or a larger dt"
        )
    return count


class SetResponses:
    """The responses of plants of a set, kept for the last controllers that were asked for.

    ``members`` are the numbers of these plants, all by default.
    """

    def __init__(
        self, plants: PlantSet, inputs: Inputs, members: Sequence[int] | None = None
    ) -> None:
        self.plants, self.inputs = plants, inputs
        scaled = plants.scaled()
        self._scaled = scaled if members is None else [scaled[i] for i in members]
        self._known: dict[tuple[int, bytes, str], list[Vector]] = {}

    def of(self, structure: Structure, values: Vector, target: str = "y") -> list[Vector]:
        """Return y or u with the controller of values (p,), one array (k,) for each plant."""
        key = id(structure), values.tobytes(), target
        if key not in self._known:
            law = law_at(structure, values, reference=bool(np.any(self.inputs.r)))
            if len(self._known) >= min(_KEPT, max(_KEPT_SAMPLES // self.inputs.r.size, 4)):
                self._known.clear()
            self._known[key] = [response(p, law, self.inputs, target) for p in self._scaled]
        return self._known[key]

    def areas(self, structure: Structure, values: Vector) -> Vector:
        """Return the integral of ``|y|`` after the step of the load, of each plant.

        It lasts until y is at rest, whatever the samples of the inputs are: bounds of noise may
        make a loop far slower than its plant.
        """
        law, size = law_at(structure, values), self.plants.dt * abs(self.inputs.load)
        inner, none = law_matrix(law), np.zeros(law.C.size)
        areas = np.empty(len(self._scaled))
        for j, plant in enumerate(self._scaled):
            whole = closed_loop_matrix(plant.N, plant.B, plant.C, law, inner)
            loop = System(whole, np.append(plant.B, none), np.append(plant.C, none), 0.0)
            areas[j] = size * area_until_rest(loop)
        return areas


def law_at(structure: Structure, values: Vector, reference: bool = False) -> LinearLaw:
    """Return the law of a structure with values (p,); without B_r and D_r where it is quicker."""
    made = None if reference else getattr(structure, "law", None)
    if made is not None:
        law, samples = made(values)
        return _delayed(law, samples) if samples else law
    with warnings.catch_warnings():
        # Of controllers on the way of a search; the result's own is made with warnings.
        warnings.simplefilter("ignore", DesignWarning)
        return law_of(structure.controller(values))


def response(plant: SampledPlant, law: LinearLaw, inputs: Inputs, target: str = "y") -> Vector:
    """Return y or u (k,) of a loop from rest; infinite for an unstable one that overflows."""
    size = inputs.r.size
    total = np.zeros(size)
    if target == "u" and inputs.u_ff is not None:
        total += inputs.u_ff
    for source, given in inputs.of_loop():
        if np.any(given):
            loop = at_distance(closed_loop(plant, law, source, target), inputs.distance)
            pulse = pulse_in_blocks(loop, size)
            if not np.max(np.abs(pulse)) < _DIVERGED:
                return np.full(size, np.inf)
            total += _convolved(pulse, given)
    return total


def at_distance(system: System, distance: int) -> System:
    """Return the system of each ``distance``-th sample, a power of two, of an input held so long.

    Its first output is that of the first sample.
    """
    N, B, C, D = System.balanced(*system)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(distance.bit_length() - 1):
            N, B = 2.0 * N + N @ N, 2.0 * B + N @ B
    return System(N, B, C, D)


def _convolved(one: Vector, other: Vector) -> Vector:
    """Return the first terms of the convolution of two vectors of the same length."""
    found: Vector
    if np.ptp(other) == 0.0:
        found = other[0] * np.cumsum(one)
        return found
    length = 1 << (2 * one.size - 1).bit_length()
    product = np.fft.rfft(one, length) * np.fft.rfft(other, length)
    found = np.fft.irfft(product, length)[: one.size]
    return found


def pulse_in_blocks(system: System, size: int) -> Vector:
    """Return ``D, C B, C A B, …`` (size,)."""
    return _pulse(System.balanced(*system), size)


def _pulse(system: System, size: int) -> Vector:
    """Return the pulse response of a balanced system; rows and columns are found by doubling."""
    N, B, C, D = system
    length = 1 << (max(size - 1, 1).bit_length() + 1) // 2
    count = -(-(size - 1) // length)
    rows, columns = C[None, :], B[:, None]
    with np.errstate(over="ignore", invalid="ignore"):
        while rows.shape[0] < length:
            rows = np.concatenate([rows, rows + rows @ N])
            N = 2.0 * N + N @ N
        while columns.shape[1] < count:
            columns = np.hstack([columns, columns + N @ columns])
            N = 2.0 * N + N @ N
        parts = columns[:, :count].T @ rows.T
    found = np.empty(count * length + 1)
    found[0], found[1:] = D, parts.ravel()
    return found[:size]


# Samples of a response one by one; then so many with each distance, which doubles. The distance is
# below 1/20 000 of the time that has passed, so that only modes are left that are far slower, or
# whose damping is below 1e-3.
_ONE_BY_ONE, _OF_A_DISTANCE = 50_000, 10_000
# Where the response to a step ends, in time constants of the slowest pole: what is left is a share
# of e⁻²⁰ of y. And the limits of that pole in the z-plane, beyond which it is rounding.
_TIME_CONSTANTS, _FASTEST, _SLOWEST = 20.0, 1e-9, 1.0 - 1e-12
# A last value that makes more than this share of the sum is not rounding: y does not come back.
_LAST_VALUE = 0.5


def area_of_step(system: System, samples: int) -> float:
    """Return the sum of ``|y|`` over ``samples`` after a unit step of the input.

    All of the first 50 000 count; later ones at distances that double, so that a slow loop with
    fast samples takes as long as any other.
    """
    return _area(System.balanced(*system), samples)


def _area(system: System, samples: int) -> float:
    """Return the area of the step response of a balanced system."""
    first = min(samples, _ONE_BY_ONE)
    total = float(np.sum(np.abs(np.cumsum(_pulse(system, first)))))
    if first == samples:
        return total
    N, B, C, D = system
    n = B.size
    # The step is a state that stays at 1.
    N = np.block([[N, B[:, None]], [np.zeros((1, n + 1))]])
    C, x = np.append(C, D), np.eye(n + 1)[n]
    x = np.linalg.matrix_power(N + np.eye(n + 1), first) @ x
    passed, distance = first, 1
    while passed < samples:
        N, distance = 2.0 * N + N @ N, 2 * distance
        count = min(-(-(samples - passed) // distance), _OF_A_DISTANCE)
        y = np.abs(pulse_in_blocks(System(N, x, C, 0.0), count + 2)[1:])
        # Less what a sum at this distance has more than one of all samples, as of a trapezium.
        total += float(distance * np.sum(y[:-1]) - 0.5 * (distance - 1) * (y[0] - y[-1]))
        x = np.linalg.matrix_power(N + np.eye(n + 1), count) @ x
        passed += count * distance
    return total


def area_until_rest(system: System) -> float:
    """Return the sum of ``|y|`` of a system that comes to rest at 0 after a unit step; else inf."""
    system = System.balanced(*system)
    pole = float(np.max(np.abs(1.0 + np.linalg.eigvals(system.N)), initial=0.0))
    if pole >= 1.0:
        return math.inf
    pole = min(max(pole, _FASTEST), _SLOWEST)
    count = math.ceil(_TIME_CONSTANTS / -math.log(pole)) + 1
    area = _area(system, count)
    N, B, C, D = system
    last = D - float(C @ np.linalg.solve(N, B))
    return math.inf if abs(last) * count > _LAST_VALUE * area else area
