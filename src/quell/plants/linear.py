"""Linear plants, sampled exactly; any plant behind a delay or an encoder.

Linear plants, sampled exactly.

The plant as the controller sees it: zero-order hold, dead time and actuator lag included.

Matrices are kept as ``A − I``: a double integrator sampled at 1 ms differs from the unit matrix in
the sixth digit, and all slow dynamics are in that difference.

A plant with an input delay.

``x' = f(x, u(t − τ), w)`` with ``τ = d dt + l``, ``0 ≤ l < dt``. The state is that of the plant,
followed by the last d values of u, d + 1 with a part l of a sample, newest first. The record shows
this state, and a start from rest sets it to zero.

With a part of a sample the plant sees ``u_(k−d−1)`` for the first l of each sample and ``u_(k−d)``
for the rest: two exact steps of a linear plant.

A plant behind a lag of its actuator.

A plant whose output is quantized by an encoder with a finite number of counts a turn.

``y = q floor(y_plant/q + 1/2)`` with ``q = turn/counts``. The counter is zeroed half-way between
two edges, so its error is at most q/2 in both directions. Only the output is quantized, not the
state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.checks import Described
from quell.hints import explained
from quell.kernels.dispatch import kernel
from quell.kernels.sized import Size
from quell.lti.models import (
    TransferFunction,
    check_matrices,
    leading_gain,
    read_model,
    several_matrices,
    to_state_space,
    zero_order_hold,
)
from quell.plants.base import (
    Plant,
    PlantWrapper,
    advance,
    all_signals,
    as_input,
    begin_run,
    check_one_input,
    check_plant,
    check_run,
    labelled,
    measure,
    measure_all,
    signals_of,
)
from quell.types import Matrix, Vector

# ---- Linear plants, sampled exactly ----


class LinearModel(NamedTuple):
    """A sampled linear plant: ``x⁺ = Φ x + Γ u + Γ_w w``, ``y = C x``."""

    transition: Matrix  # Φ (n, n)
    input: Vector  # Γ (n,)
    disturbance: Matrix  # Γ_w (n, m)
    output: Vector  # C (n,)


@measure.register(LinearModel)
def _measure(plant: LinearModel, x: Vector) -> float:
    y = 0.0
    for i in range(plant.output.size):
        y += plant.output[i] * x[i]
    return y


@advance.register(LinearModel)
def _advance(plant: LinearModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector) -> None:
    # The sizes of a model's arrays are known to the compiler, those of x and w are not.
    size, inputs = plant.disturbance.shape
    for i in range(size):
        total = 0.0
        for j in range(inputs):
            total += plant.disturbance[i, j] * w[j]
        for j in range(size):
            total += plant.transition[i, j] * x[j]
        scratch[i] = total + plant.input[i] * u  # u last: it is calculated meanwhile
    for i in range(size):
        x[i] = scratch[i]


class LinearModelOfMany(NamedTuple):
    """A sampled linear plant with several signals."""

    transition: Matrix  # Φ (n, n)
    input: Matrix  # Γ (n, m)
    disturbance: Matrix  # Γ_w (n, q)
    output: Matrix  # C (p, n)


as_input.register(LinearModelOfMany)(all_signals)


@measure_all.register(LinearModelOfMany)
def _measure_many(plant: LinearModelOfMany, x: Vector, y: Vector) -> None:
    outputs, size = plant.output.shape
    for i in range(outputs):
        total = 0.0
        for j in range(size):
            total += plant.output[i, j] * x[j]
        y[i] = total


@advance.register(LinearModelOfMany)
def _advance_many(
    plant: LinearModelOfMany, x: Vector, scratch: Vector, t: float, u: Any, w: Vector
) -> None:
    size, inputs = plant.input.shape
    for i in range(size):
        total = 0.0
        for j in range(plant.disturbance.shape[1]):
            total += plant.disturbance[i, j] * w[j]
        for j in range(size):
            total += plant.transition[i, j] * x[j]
        for j in range(inputs):
            total += plant.input[i, j] * u[j]
        scratch[i] = total
    for i in range(size):
        x[i] = scratch[i]


@explained("quell.plants.LinearPlant(A, B, C), or LinearPlant.of((num, den))")
@dataclass(frozen=True, eq=False, repr=False)
class LinearPlant(Described):
    """A linear plant ``x' = A x + B u + E w``, ``y = C x`` with any number of inputs and outputs.

    Parameters
    ----------
    A
        (n, n).
    B
        (n, m): a column for each control signal; (n,) for one.
    C
        (p, n): a row for each measured output; (n,) for one.
    E
        (n, q): a column for each disturbance; by default each enters where a control signal does.
    name
        for tables and plots.

    Raises
    ------
    ValueError
        if shapes do not fit, with both shapes, or an entry is not finite.

    Examples
    --------
    >>> gantry = LinearPlant(
    ...     A=[[0, 1, 0, 0], [0, -2, 0, 0], [0, 0, 0, 1], [0, 0, 0, -3]],
    ...     B=[[0, 0], [5, 0.5], [0, 0], [0.4, 6]],
    ...     C=[[1, 0, 0, 0], [0, 0, 1, 0]],
    ... )
    >>> gantry.order, gantry.inputs, gantry.outputs, gantry.disturbances
    (4, 2, 2, 2)
    """

    A: Any
    B: Any
    C: Any
    E: Any = None
    name: str = "linear plant"
    compiled = True

    def __post_init__(self) -> None:
        A, B, C = check_matrices(self.A, self.B, self.C, several=True)
        E = B if self.E is None else checks.matrix("E", self.E, A.shape[0])
        for name, value in (("A", A), ("B", B), ("C", C), ("E", E)):
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, model: Any, E: Any = None, *, name: str = "linear plant") -> LinearPlant:
        """Return the plant that ``model`` describes, of any kind that functions of quell accept.

        Parameters
        ----------
        model
            one of

            * matrices ``(A, B, C)``, or ``(A, B, E, C)`` as in the paper's eq. (1), in a tuple or a
              list; B, E and C may be vectors,
            * a transfer function ``(numerator, denominator)``, sequences in descending powers of s,
            * ``(a, b)`` with a number b: ``y^(n) = −a_0 y − … − a_{n−1} y^(n−1) + b u``,
            * a continuous-time ``control.StateSpace`` with D = 0, or a
              ``control.TransferFunction`` of one input and output,
            * the same of scipy.signal: ``StateSpace``, ``TransferFunction``, ``ZerosPolesGain``,
            * a ``LinearPlant``, which is returned as it is, or anything else with A, B and C.
        E
            input of the disturbance: a column (n,) or (n, 1), or the index of one of the plant's
            own disturbance inputs. By default a plant keeps its own, and in other models the
            disturbance enters where u does.
        name
            for tables and plots.

        Returns
        -------
        LinearPlant
            with the model's own states. For a transfer function
            ``(c_{n−1} s^(n−1) + … + c_0)/(s^n + a_{n−1} s^(n−1) + … + a_0)`` the states
            [y-unit/s^(i−1)] are y and its derivatives without zeros, and ``x_1 = y``,
            ``x_{i+1} = x_i' + a_{n−i} y − c_{n−i} u`` with zeros.

        Raises
        ------
        ValueError
            if shapes do not fit, an entry is not finite, y follows u at once, the model is of
            discrete time, or it is no linear model.

        Examples
        --------
        >>> motor = LinearPlant.of(([50.0], [1.0, 22.0, 40.0, 0.0]))
        >>> motor.order, motor.B[:, 0].tolist()
        (3, [0.0, 0.0, 50.0])
        """
        if isinstance(model, cls) and E is None:
            return model
        if (parts := several_matrices(model, E)) is not None:
            return cls(*parts, name=name)
        found = read_model(model, E)
        if isinstance(found, TransferFunction):
            found = to_state_space(found)
        column = getattr(model, "E", None) if found.E is None else found.E[:, None]
        return cls(found.A, found.B, found.C, column, name=name)

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @property
    def inputs(self) -> int:
        """Number of control signals."""
        return int(self.B.shape[1])

    @property
    def outputs(self) -> int:
        """Number of measured outputs."""
        return int(self.C.shape[0])

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs."""
        return int(self.E.shape[1])

    def sampled(self, dt: float, interpret: bool = False) -> Any:
        """Return the plant sampled at ``dt`` [s] with zero-order hold on u and w."""
        return _model_of(*self.sampled_matrices(dt))

    def sampled_matrices(self, dt: float) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """Return A, B, C and E of the plant sampled at ``dt`` [s], as ``sampled``."""
        phi, gamma, gamma_w = _held(self.A, self.B, self.E, dt)
        if not all(np.isfinite(part).all() for part in (phi, gamma, gamma_w)):
            raise ValueError(
                f"dt = {dt!r} s: {self.name} can't be sampled with it, exp(A dt) is beyond all "
                "numbers; check the units of dt and of the plant"
            )
        return phi, gamma, self.C, gamma_w


def sampled_together(plants: Sequence[LinearPlant], dt: float) -> list[Any]:
    """Return the models of plants sampled at ``dt`` [s], each as its ``sampled`` returns it.

    Plants of the same shapes are sampled in one call, which takes a fifth of the time of as many.
    """
    alike: dict[Any, list[int]] = {}
    for i, plant in enumerate(plants):
        alike.setdefault((plant.A.shape, plant.B.shape, plant.C.shape, plant.E.shape), []).append(i)
    models: list[Any] = [None] * len(plants)
    for places in alike.values():
        A, B, E = (np.array([getattr(plants[i], part) for i in places]) for part in "ABE")
        phi, gamma, gamma_w = _held(A, B, E, dt)
        finite = all(np.isfinite(part).all() for part in (phi, gamma, gamma_w))
        for at, i in enumerate(places):
            found = (phi[at], gamma[at], plants[i].C, gamma_w[at])
            # Where one of them can't be sampled, each is by itself: that one says so.
            models[i] = _model_of(*found) if finite else plants[i].sampled(dt)
    return models


def _held(A: Any, B: Any, E: Any, dt: float) -> tuple[Any, Any, Any]:
    """Return Φ, Γ and Γ_w of a model or of a stack of them, not finite where they overflow."""
    with np.errstate(all="ignore"):
        phi, (gamma, gamma_w) = zero_order_hold(A, [B, E], checks.positive("dt", dt, "s"))
    return phi, gamma, gamma_w


def _model_of(phi: Matrix, gamma: Matrix, C: Matrix, gamma_w: Matrix) -> Any:
    if max(gamma.shape[1], C.shape[0]) > 1:
        return LinearModelOfMany(phi, gamma, gamma_w, C)
    return LinearModel(phi, gamma[:, 0].copy(), gamma_w, C[0].copy())


# ---- The plant as the controller sees it ----

# Limit on the states that a dead time adds; eigenvalues cost its cube. Chosen by hand.
_MOST_SAMPLES = 200


class SampledPlant(NamedTuple):
    """``x⁺ − x = N x + B u + E w``, ``y = C x``."""

    N: Matrix  # A − I (n, n)
    B: Vector  # (n,)
    E: Matrix  # (n, m)
    C: Vector  # (n,)
    b: dict[int, float]  # gain from u to y^(k), by k, for the first derivative that u reaches


def sampled_plant(
    plant: Any, dt: float, delay: float = 0.0, actuator_lag: float = 0.0
) -> SampledPlant:
    """Sample a linear plant exactly; see ``analyse`` for the parameters.

    A system of python-control or scipy.signal may be sampled already, with the same dt. Raises
    ``ValueError`` for another object, direct feedthrough, or a dead time of more than 200 samples.
    """
    delay = checks.non_negative("delay", delay, "s")
    actuator_lag = checks.non_negative("actuator_lag", actuator_lag, "s")
    if getattr(plant, "dt", None):
        if actuator_lag > 0.0 or not math.isclose(delay / dt, round(delay / dt), abs_tol=1e-9):
            raise ValueError(
                f"delay = {delay!r} s, actuator_lag = {actuator_lag!r} s: a sampled plant takes "
                "whole samples of delay and no lag; give it in continuous time"
            )
        model = read_model(plant, dt=dt)
        model = to_state_space(model) if isinstance(model, TransferFunction) else model
        N, B = model.A - np.eye(model.C.size), model.B[:, None]
        return _delayed(N, B, np.zeros_like(B), model.C, B, round(delay / dt), {})
    check_one_input(plant, "quell.analysis.analyse")
    linear: Any = LinearPlant.of(plant)
    first = leading_gain(linear.A, linear.B, linear.C)
    gains = {} if first is None else {first[1]: first[0]}
    if actuator_lag > 0.0:
        linear = lagged(linear, actuator_lag)
    A, B, C, E = linear.A, linear.B, linear.C[0], linear.E
    if delay > _MOST_SAMPLES * dt:
        limit = f"{_MOST_SAMPLES} samples of {dt!r} s"
        raise ValueError(f"delay = {delay!r} s: must be at most {limit}")
    samples = math.floor(delay / dt * (1.0 + 1e-12))
    late = max(delay - samples * dt, 0.0)
    if late < 1e-12 * dt:  # a whole number of samples, to rounding
        late = 0.0
    identity = np.eye(A.shape[0])
    _, (whole, gamma_w) = zero_order_hold(A, [identity, E], dt)
    # The first part of each sample still sees the control signal before.
    _, (rest,) = zero_order_hold(A, [identity], dt - late)
    before = (whole - rest) @ B
    return _delayed(A @ whole, rest @ B, before, C, gamma_w, samples, gains)


def _delayed(
    N: Matrix, now: Matrix, before: Matrix, C: Vector, E: Matrix, samples: int, b: dict[int, float]
) -> SampledPlant:
    """Append the control signals that have not arrived yet as states, the newest last."""
    n, waiting = N.shape[0], samples + bool(np.any(before))
    A, B = np.zeros((n + waiting, n + waiting)), np.zeros(n + waiting)
    A[:n, :n] = N
    for i in range(waiting):
        A[n + i, n + i] = -1.0
        if i + 1 < waiting:
            A[n + i, n + i + 1] = 1.0
    if waiting:
        B[-1] = 1.0
    if waiting > samples:
        A[:n, n] = before[:, 0]
    # The state from which ``now`` arrives; without one, u itself.
    at = n + waiting - samples
    if samples:
        A[:n, at] = now[:, 0]
    else:
        B[:n] = now[:, 0]
    E = np.vstack([E, np.zeros((waiting, E.shape[1]))])
    return SampledPlant(A, B, E, np.append(C, np.zeros(waiting)), b)


# ---- A plant with an input delay ----

# Part of a sample that is rounding. Chosen by hand, as in ``checks.samples``.
_ROUNDING = 1e-6


class DelayedPlantModel(NamedTuple):
    """A sampled plant with a delay of at least one sample."""

    inner: Any  # parameters of the plant without delay
    size: Size  # number of its states


@measure.register(DelayedPlantModel)
def _measure_delay(plant: DelayedPlantModel, x: Vector) -> float:
    return measure(plant.inner, x[: plant.size])


@advance.register(DelayedPlantModel)
def _advance_delay(
    plant: DelayedPlantModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    last = x.size - 1
    arriving = x[last]
    for i in range(last, plant.size, -1):
        x[i] = x[i - 1]
    x[plant.size] = u
    advance(plant.inner, x[: plant.size], scratch, t, arriving, w)


@begin_run.register(DelayedPlantModel)
def _begin_run(plant: DelayedPlantModel, x: Vector, scratch: Vector) -> None:
    begin_run(plant.inner, x[: plant.size], scratch)


@check_run.register(DelayedPlantModel)
def _check_run(plant: DelayedPlantModel, scratch: Vector) -> None:
    check_run(plant.inner, scratch)


class PartlyDelayedModel(NamedTuple):
    """A sampled plant with a delay that has a part of a sample."""

    first: Any  # parameters for the part of a sample in which the older u still acts
    rest: Any  # for the rest of it
    late: float  # length of that part [s]
    size: Size  # number of states of the plant without delay


@measure.register(PartlyDelayedModel)
def _measure_partly(plant: PartlyDelayedModel, x: Vector) -> float:
    return measure(plant.first, x[: plant.size])


@advance.register(PartlyDelayedModel)
def _advance_partly(
    plant: PartlyDelayedModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    last = x.size - 1
    older, newer = x[last], u
    if last > plant.size:
        newer = x[last - 1]
    for i in range(last, plant.size, -1):
        x[i] = x[i - 1]
    x[plant.size] = u
    advance(plant.first, x[: plant.size], scratch, t, older, w)
    advance(plant.rest, x[: plant.size], scratch, t + plant.late, newer, w)


@dataclass(frozen=True, eq=False, repr=False)
class DelayedPlant(PlantWrapper):
    """A plant that u reaches ``samples`` samples of ``dt`` [s] and ``late`` [s] late.

    Make it with ``delayed``.
    """

    plant: Plant
    samples: int
    dt: float
    late: float = 0.0

    @property
    def delay(self) -> float:
        """The whole delay [s]."""
        return self.samples * self.dt + self.late

    @property
    def name(self) -> str:
        """Name for tables and plots."""
        return f"{self.plant.name}, {self.delay:g} s late"

    @property
    def order(self) -> int:
        """Number of states, including the delayed values of u."""
        return self.plant.order + self.samples + (self.late > 0.0)

    def sampled(self, dt: float, interpret: bool = False) -> DelayedPlantModel | PartlyDelayedModel:
        """Return the parameters for the sample time ``dt`` [s] of the delay."""
        if abs(dt - self.dt) > 1e-9 * self.dt:
            raise ValueError(
                f"dt = {dt!r} s: this delayed plant was made for {self.dt!r} s; make another one"
            )
        if self.late > 0.0:
            first, rest = (
                self.plant.sampled(part, interpret) for part in (self.late, dt - self.late)
            )
            return PartlyDelayedModel(first, rest, self.late, self.plant.order)
        return DelayedPlantModel(self.plant.sampled(dt, interpret), self.plant.order)


@explained("quell.plants.delayed(plant, 0.01, dt=1e-3)")
def delayed(plant: Plant, delay: float, dt: float) -> DelayedPlant:
    """Return a plant that u reaches ``delay`` seconds late.

    Parameters
    ----------
    plant
        any plant.
    delay
        [s]. That of a linear plant may have a part of a sample, which is exact for a u that is held
        for a sample; other plants are solved in whole samples and take whole numbers of them.
    dt
        sample time of the later runs [s]; it decides how many values of u are stored.

    Raises
    ------
    ValueError
        if the delay is not positive, or for a plant that is not linear no whole number of samples;
        or if ``plant`` is not a plant.

    Examples
    --------
    >>> import quell as ql
    >>> late = ql.plants.delayed(ql.plants.two_mass_spring(), delay=0.02, dt=0.01)
    >>> late.order
    6
    """
    check_plant(plant)
    check_one_input(plant, "quell.plants.delayed_inputs")
    delay, dt = checks.positive("delay", delay, "s"), checks.positive("dt", dt, "s")
    if type(plant) is not LinearPlant:
        rule = ", for a plant that is not linear; or take a smaller dt"
        return DelayedPlant(plant, checks.samples("delay", delay, dt, rule), dt)
    samples = round(delay / dt)
    if abs(delay / dt - samples) <= _ROUNDING:
        return DelayedPlant(plant, samples, dt) if samples else DelayedPlant(plant, 0, dt, delay)
    samples = math.floor(delay / dt)
    return DelayedPlant(plant, samples, dt, delay - samples * dt)


# ---- A plant behind a lag of its actuator ----


class LaggedPlantModel(NamedTuple):
    """A sampled plant behind a lag; the last state is what the actuator gives."""

    inner: Any  # parameters of the plant without lag
    rest: float  # e^(−dt/T): the share of its distance from u that is left after a sample
    mean: float  # the mean of that share over a sample


@measure.register(LaggedPlantModel)
def _measure_lag(plant: LaggedPlantModel, x: Vector) -> float:
    return measure(plant.inner, x[: x.size - 1])


@advance.register(LaggedPlantModel)
def _advance_lag(
    plant: LaggedPlantModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    last = x.size - 1
    away = x[last] - u
    x[last] = u + plant.rest * away
    advance(plant.inner, x[:last], scratch, t, u + plant.mean * away, w)


@begin_run.register(LaggedPlantModel)
def _begin_run_lag(plant: LaggedPlantModel, x: Vector, scratch: Vector) -> None:
    begin_run(plant.inner, x[: x.size - 1], scratch)


@check_run.register(LaggedPlantModel)
def _check_run_lag(plant: LaggedPlantModel, scratch: Vector) -> None:
    check_run(plant.inner, scratch)


@dataclass(frozen=True, eq=False, repr=False)
class LaggedPlant(PlantWrapper):
    """A plant that is not linear behind a lag ``1/(lag s + 1)`` of its actuator.

    Make it with ``lagged``. The plant gets the mean of what the actuator gives in a sample.
    """

    plant: Plant
    lag: float  #: [s]

    @property
    def name(self) -> str:
        """Name for tables and plots."""
        return f"{self.plant.name}, actuator lag {self.lag:g} s"

    @property
    def order(self) -> int:
        """Number of states, with that of the actuator."""
        return self.plant.order + 1

    def sampled(self, dt: float, interpret: bool = False) -> LaggedPlantModel:
        """Return the parameters for a sample time ``dt`` [s]."""
        rate = checks.positive("dt", dt, "s") / self.lag
        mean = -math.expm1(-rate) / rate
        return LaggedPlantModel(self.plant.sampled(dt, interpret), math.exp(-rate), mean)


def lagged(plant: Plant, lag: float) -> Plant:
    """Return a plant behind a lag ``1/(lag s + 1)`` of its actuator, whose state comes last.

    Parameters
    ----------
    plant
        any plant. Of a linear one the result is linear, and sampled exactly; another one gets the
        mean of what the actuator gives in each sample. A delay of u stays outside of the lag: its
        states are the last ones.
    lag
        time constant [s].

    Raises
    ------
    ValueError
        if the lag is not positive, or ``plant`` is no plant.

    Examples
    --------
    >>> late = lagged(LinearPlant.of(([1.0], [1.0, 0.0])), lag=0.1)
    >>> late.A.tolist(), late.B[:, 0].tolist()
    ([[0.0, 1.0], [0.0, -10.0]], [0.0, 10.0])
    """
    check_plant(plant)
    check_one_input(plant, "a lag in A and B of a LinearPlant")
    lag = checks.positive("lag", lag, "s")
    if isinstance(plant, DelayedPlant | EncodedPlant):
        return replace(plant, plant=lagged(plant.plant, lag))
    if not isinstance(plant, LinearPlant):
        return LaggedPlant(plant, lag)
    n = plant.order
    A = np.block([[plant.A, plant.B], [np.zeros((1, n)), np.full((1, 1), -1.0 / lag)]])
    E = np.vstack([plant.E, np.zeros((1, plant.disturbances))])
    B, C = np.append(np.zeros(n), 1.0 / lag), np.append(plant.C[0], 0.0)
    found = LinearPlant(A, B, C, E, name=f"{plant.name}, actuator lag {lag:g} s")
    known = signals_of(plant)
    return labelled(found, known.y, known.u) if known.known else found


# ---- A plant whose output is quantized by an encoder with a finite number of counts a turn ----


class EncodedPlantModel(NamedTuple):
    """A sampled plant with an encoder."""

    inner: Any  # parameters of the plant without encoder
    resolution: float  # q [y-unit]


@kernel
def quantized(value: float, resolution: float) -> float:
    """Return the multiple of ``resolution`` nearest to ``value``."""
    return resolution * np.floor(value / resolution + 0.5)


@measure.register(EncodedPlantModel)
def _measure_encoder(plant: EncodedPlantModel, x: Vector) -> float:
    return quantized(measure(plant.inner, x), plant.resolution)


@advance.register(EncodedPlantModel)
def _advance_encoder(
    plant: EncodedPlantModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    advance(plant.inner, x, scratch, t, u, w)


@begin_run.register(EncodedPlantModel)
def _begin_run_encoder(plant: EncodedPlantModel, x: Vector, scratch: Vector) -> None:
    begin_run(plant.inner, x, scratch)


@check_run.register(EncodedPlantModel)
def _check_run_encoder(plant: EncodedPlantModel, scratch: Vector) -> None:
    check_run(plant.inner, scratch)


@dataclass(frozen=True, eq=False, repr=False)
class EncodedPlant(PlantWrapper):
    """A plant whose output is read by an encoder of ``counts`` a turn.

    Make it with ``encoded``.
    """

    plant: Plant
    counts: int
    turn: float = math.tau  #: y of one turn [y-unit]

    @property
    def resolution(self) -> float:
        """Step of y that one count is [y-unit]."""
        return self.turn / self.counts

    @property
    def name(self) -> str:
        """Name for tables and plots."""
        return f"{self.plant.name}, {self.counts} counts a turn"

    def sampled(self, dt: float, interpret: bool = False) -> EncodedPlantModel:
        """Return the parameters for a sample time ``dt`` [s]."""
        return EncodedPlantModel(self.plant.sampled(dt, interpret), self.resolution)


def encoded(plant: Plant, counts: int, turn: float = math.tau) -> EncodedPlant:
    """Return a plant whose output y, an angle or a position, is read by an encoder.

    Parameters
    ----------
    plant
        any plant.
    counts
        counts of the encoder a turn, with all four edges of its two channels.
    turn
        y of one turn [y-unit]: 2π rad by default, 360 for degrees, the pitch of a screw [mm].

    Raises
    ------
    ValueError
        if ``counts`` is no whole number above zero, ``turn`` is not positive, or ``plant`` is not a
        plant.

    Examples
    --------
    >>> import quell as ql
    >>> seen = ql.plants.encoded(ql.plants.torsional_identified(), counts=16_000)
    >>> round(seen.resolution, 7)
    0.0003927
    """
    check_plant(plant)
    check_one_input(plant, "quell.plants.encoded_outputs")
    counts = checks.whole("counts", counts, 1)
    return EncodedPlant(plant, counts, checks.positive("turn", turn, "y-unit"))
