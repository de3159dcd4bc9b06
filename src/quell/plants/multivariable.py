"""Plants with several control signals u (m,) and several outputs y (p,).

A linear one is sampled exactly, ``x⁺ = Φ x + Γ u + Γ_w w``, ``y = C x``; a nonlinear one,
``x' = f(t, x, u, w)``, ``y = h(x)``, is solved by Runge-Kutta of order 4 with a fixed sub-step. u
and w are held over a sample. Both have the interface of ``plants.base`` with ``advance`` for a
vector u, and ``measure_all`` in the place of ``measure``.

Encoders and delays stand at single channels: ``encoded_outputs`` quantizes each y,
``y_i = q_i floor(y_i/q_i + 1/2)``, and ``delayed_inputs`` keeps the last values of each u in the
state, newest first, channel after channel.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types as nb_types

from quell import checks
from quell.checks import Described
from quell.kernels import user_functions
from quell.kernels.frozen import kept_code
from quell.kernels.sized import Buffer, Size
from quell.kernels.user_functions import (
    POINTER,
    Shapes,
    as_array,
    call,
    count_of,
    reader,
    shapes_of,
)
from quell.lti.models import zero_order_hold
from quell.plants.base import (
    Plant,
    PlantWrapper,
    advance,
    all_signals,
    as_input,
    begin_run,
    check_plant,
    check_run,
    measure_all,
)
from quell.plants.linear import DelayedPlantModel, EncodedPlantModel, quantized
from quell.plants.nonlinear import (
    EquationPlant,
    derivatives,
    runge_kutta,
    value_or_nan,
)
from quell.types import Matrix, Vector

# ---- Linear plants ----


class MultivariableLinear(NamedTuple):
    """A sampled linear plant with several signals."""

    transition: Matrix  # Φ (n, n)
    input: Matrix  # Γ (n, m)
    disturbance: Matrix  # Γ_w (n, q)
    output: Matrix  # C (p, n)


as_input.register(MultivariableLinear)(all_signals)


@measure_all.register(MultivariableLinear)
def _measure_linear(plant: MultivariableLinear, x: Vector, y: Vector) -> None:
    outputs, size = plant.output.shape
    for i in range(outputs):
        total = 0.0
        for j in range(size):
            total += plant.output[i, j] * x[j]
        y[i] = total


@advance.register(MultivariableLinear)
def _advance_linear(
    plant: MultivariableLinear, x: Vector, scratch: Vector, t: float, u: Any, w: Vector
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


@dataclass(frozen=True, eq=False, repr=False)
class MultivariableLinearPlant(Described):
    """A linear plant ``x' = A x + B u + E w``, ``y = C x`` with several inputs and outputs.

    Parameters
    ----------
    A
        (n, n).
    B
        (n, m): a column for each control signal.
    C
        (p, n): a row for each measured output.
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
    >>> gantry = MultivariableLinearPlant(
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
        A, B, C = (checks.matrix(name, getattr(self, name)) for name in "ABC")
        n = A.shape[0]
        E = B if self.E is None else checks.matrix("E", self.E)
        rules = (
            ("A", A, (n, n), "square: a row and a column for each state"),
            ("B", B, (n, B.shape[1]), "a row for each state, a column for each control signal"),
            ("C", C, (C.shape[0], n), "a row for each output, a column for each state"),
            ("E", E, (n, E.shape[1]), "a row for each state, a column for each disturbance"),
        )
        for name, value, shape, rule in rules:
            if value.shape != shape:
                raise ValueError(
                    f"{name} has shape {value.shape}, A {A.shape}: {name} must be {shape}, {rule}"
                )
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, model: Any, *, name: str = "linear plant") -> MultivariableLinearPlant:
        """Return the plant that ``model`` describes.

        Parameters
        ----------
        model
            matrices ``(A, B, C)`` or ``(A, B, E, C)``; a continuous-time ``control.StateSpace`` or
            ``scipy.signal.StateSpace``, with D = 0, or anything else with A, B and C; such a plant,
            which is returned as it is.
        name
            for tables and plots.
        """
        if isinstance(model, cls):
            return model
        if getattr(model, "dt", None):
            raise ValueError(f"model is of discrete time, dt = {model.dt!r}: give it in continuous")
        if isinstance(model, tuple | list) and len(model) in (3, 4):
            A, B, *between, C = model
            return cls(A, B, C, between[0] if between else None, name)
        if all(hasattr(model, part) for part in "ABC"):
            if np.any(np.asarray(getattr(model, "D", 0.0))):
                raise ValueError("model has D other than zero: y must not follow u at once")
            return cls(model.A, model.B, model.C, getattr(model, "E", None), name=name)
        raise ValueError(
            f"model = {model!r:.60}: must be (A, B, C), (A, B, E, C), or a state-space system with "
            "A, B and C; of transfer functions make a state-space system by python-control first"
        )

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

    def sampled(self, dt: float, interpret: bool = False) -> MultivariableLinear:
        """Return the plant sampled at ``dt`` [s] with zero-order hold on u and w."""
        inputs = [self.B, self.E]
        phi, (gamma, gamma_w) = zero_order_hold(self.A, inputs, checks.positive("dt", dt, "s"))
        if not all(np.isfinite(part).all() for part in (phi, gamma, gamma_w)):
            raise ValueError(
                f"dt = {dt!r} s: {self.name} can't be sampled with it, exp(A dt) is beyond all "
                "numbers; check the units of dt and of the plant"
            )
        return MultivariableLinear(phi, gamma, gamma_w, self.C)


# ---- Nonlinear plants ----


class CompiledMultivariable(NamedTuple):
    """A nonlinear plant with several signals and compiled functions, given by address."""

    rate: int
    output: int
    step: float  # length of a sub-step [s]
    substeps: int
    parameters: Buffer  # those of the rate, then those of the output


class PythonMultivariable(NamedTuple):
    """A nonlinear plant with several signals whose functions only Python can run."""

    rate: Callable[..., Any]
    output: Callable[..., Any]
    step: float
    substeps: int


as_input.register(CompiledMultivariable)(all_signals)
as_input.register(PythonMultivariable)(all_signals)


advance.register(CompiledMultivariable)(runge_kutta)
advance.register(PythonMultivariable)(runge_kutta)


@derivatives.register(CompiledMultivariable)
def _derivatives_compiled(
    plant: CompiledMultivariable, t: float, x: Vector, u: Any, w: Vector, dx: Vector
) -> None:
    call(plant.rate, t, x, u, w, plant.parameters, dx)


@measure_all.register(CompiledMultivariable)
def _measure_compiled(plant: CompiledMultivariable, x: Vector, y: Vector) -> None:
    call(plant.output, x, plant.parameters, y)


@derivatives.register(PythonMultivariable)
def _derivatives_python(
    plant: PythonMultivariable, t: float, x: Vector, u: Any, w: Vector, dx: Vector
) -> None:
    dx[:] = value_or_nan(plant.rate, t, x, u, w)


@measure_all.register(PythonMultivariable)
def _measure_python(plant: PythonMultivariable, x: Vector, y: Vector) -> None:
    y[:] = value_or_nan(plant.output, x)


_RATE_SIGNATURE = nb_types.void(nb_types.float64, POINTER, POINTER, POINTER, POINTER, POINTER)
_OUTPUT_SIGNATURE = nb_types.void(POINTER, POINTER, POINTER)
# Pairs of functions whose code is kept, as for plants with one input. Chosen by hand.
_KEPT = 32


class _Sizes(NamedTuple):
    """Numbers of states, control signals, outputs and disturbances, and shapes of parameters."""

    n: int
    m: int
    p: int
    q: int
    own: Shapes  # of the parameters of f
    more: Shapes  # of those of the output


@kept_code(_KEPT)
def _machine_code(
    rate_of: Callable[..., Any], output_of: Callable[..., Any], sizes: _Sizes
) -> tuple[Any, Any]:
    """Return the compiled f and output; raise ``NotCompilableError`` if Numba can't."""
    n, m, p, q, of_rate, of_output = sizes
    own, more = reader(of_rate), reader(of_output, count_of(of_rate))
    f = user_functions.jit_user_function(rate_of)
    h = user_functions.jit_user_function(output_of)

    def rate(t, px, pu, pw, pp, pdx):  # type: ignore[no-untyped-def]
        dx = numba.carray(pdx, (n,))
        signals = (numba.carray(px, (n,)), numba.carray(pu, (m,)), numba.carray(pw, (q,)))
        found = f(t, signals[0], signals[1], signals[2], *own(pp))
        for i in range(n):
            dx[i] = found[i]

    def output(px, pp, py):  # type: ignore[no-untyped-def]
        y = numba.carray(py, (p,))
        found = h(numba.carray(px, (n,)), *more(pp))
        for i in range(p):
            y[i] = found[i]

    compile_cfunc = user_functions.compile_cfunc
    return (
        compile_cfunc(_RATE_SIGNATURE, rate),
        compile_cfunc(_OUTPUT_SIGNATURE, output),
    )


@lru_cache(maxsize=_KEPT)
def _rows_output(rows: tuple[tuple[float, ...], ...]) -> Callable[[Vector], Any]:
    """Return the function ``C x`` of a matrix C."""
    C = np.array(rows)

    def linear(x: Vector) -> Vector:
        y = np.zeros(C.shape[0])
        for i in range(C.shape[0]):
            for j in range(C.shape[1]):
                y[i] += C[i, j] * x[j]
        return y

    return linear


@dataclass(frozen=True, eq=False, repr=False)
class MultivariableNonlinearPlant(EquationPlant):
    """A plant ``x' = f(t, x, u, w, …)``, ``y = h(x, …)`` with several inputs and outputs.

    Parameters
    ----------
    f
        ``f(t, x, u, w)`` returns the n derivatives as a tuple, list or array; t [s], x (n,), u (m,)
        and w (q,) are arrays. Numba compiles it if it can; else it runs as Python, about a hundred
        times slower, and a warning says why. Further arguments are parameters.
    order
        number of states n.
    inputs
        number m of control signals.
    output
        a function ``h(x)`` that returns the p outputs, or the matrix C (p, n) of ``y = C x``. It
        may take parameters, too.
    disturbances
        number q of disturbance inputs.
    substeps
        Runge-Kutta steps in a sample; by default one, or so many that ``h |λ| <= 1`` for each
        eigenvalue λ of the plant linearised at rest.
    name
        for tables and plots.
    parameters
        numbers, vectors and matrices by name that f and output take as further arguments;
        ``with_parameters`` changes them, and compiles nothing for the same shapes.

    Raises
    ------
    ValueError
        if ``f`` does not return n numbers, or ``output`` not a vector of numbers.

    Examples
    --------
    >>> def tanks(t, x, u, w):
    ...     return u[0] - 0.2 * x[0], u[1] + 0.2 * x[0] - 0.1 * x[1]
    >>> plant = MultivariableNonlinearPlant(tanks, order=2, inputs=2, output=[[1, 0], [0, 1]])
    >>> plant.outputs
    2
    """

    f: Callable[..., Any]
    order: int
    inputs: int
    output: Any
    disturbances: int = 1
    substeps: int | None = None
    name: str = "nonlinear plant"
    parameters: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        n = checks.whole("order", self.order, 1)
        m = checks.whole("inputs", self.inputs, 1)
        q = checks.whole("disturbances", self.disturbances, 0)
        checks.optional(checks.whole, "substeps", self.substeps, 1)
        if not callable(self.f):
            raise ValueError(f"f = {self.f!r}: must be a function f(t, x, u, w)")
        if not callable(self.output):
            rows = checks.matrix("output", self.output)
            if rows.shape[1] != n:
                raise ValueError(
                    f"output has shape {rows.shape}: must have a row for each output and a column "
                    f"for each of the {n} states"
                )
        if self.parameters is not None:
            own, more = self._numbers
            object.__setattr__(self, "parameters", {**own, **more})
        rule = (
            "f takes (t, x, u, w) and the names in parameters, output takes (x), with arrays x, u "
            "and w of the plant's sizes"
        )
        returned = user_functions.attempt_kernel(
            "f(0.0, zeros, zeros, zeros)", rule,
            self._rate, 0.0, np.zeros(n), np.zeros(m), np.zeros(q),
        )  # fmt: skip
        if returned is not user_functions.UNKNOWN and np.shape(returned) != (n,):
            raise ValueError(
                f"f returns shape {np.shape(returned)}: must return the {n} derivatives of x"
            )
        found = user_functions.attempt_kernel("output(zeros)", rule, self._measured, np.zeros(n))
        if found is user_functions.UNKNOWN:
            found = self._measured(user_functions.sample_values(n))
        if np.ndim(found) != 1:
            raise ValueError(
                f"output(x) returns shape {np.shape(found)}: must return the outputs as a vector"
            )
        object.__setattr__(self, "_outputs", len(found))

    def with_parameters(self, **values: Any) -> MultivariableNonlinearPlant:
        """Return the plant with other values of some parameters; nothing is compiled again."""
        return replace(self, parameters={**(self.parameters or {}), **values})

    @property
    def outputs(self) -> int:
        """Number of measured outputs."""
        return int(self._outputs)  # type: ignore[attr-defined]

    @cached_property
    def _output_function(self) -> Callable[..., Any]:
        if callable(self.output):
            return self.output
        return _rows_output(tuple(map(tuple, np.asarray(self.output, dtype=float).tolist())))

    @property
    def _no_control(self) -> Vector:
        return np.zeros(self.inputs)

    def _machine_code_of_both(self) -> tuple[Any, Any]:
        own, more = map(shapes_of, self._numbers)
        sizes = _Sizes(self.order, self.inputs, self.outputs, self.disturbances, own, more)
        return _machine_code(self.f, self._output_function, sizes)

    def sampled(self, dt: float, interpret: bool = False) -> Any:
        """Return the parameters for a sample time ``dt`` [s]; see ``Plant.sampled``."""
        step, substeps = self._step(dt)
        code = self._code(interpret)
        if code is None:
            return PythonMultivariable(self._rate, self._measured, step, substeps)
        rate, output = code
        numbers = as_array(*self._numbers)
        return CompiledMultivariable(rate.address, output.address, step, substeps, numbers)


# ---- Encoders and delays of single channels ----


class MultivariableWrapper(PlantWrapper):
    """The properties that a wrapper takes over from the plant with several signals inside."""

    plant: Any

    @property
    def inputs(self) -> int:
        """Number of control signals."""
        return int(self.plant.inputs)

    @property
    def outputs(self) -> int:
        """Number of measured outputs."""
        return int(self.plant.outputs)


class EncodedOutputsModel(NamedTuple):
    """A sampled plant with encoders."""

    inner: Any
    resolution: Vector  # q (p,) [y-unit]; zero for an output without encoder


as_input.register(EncodedOutputsModel)(all_signals)


@measure_all.register(EncodedOutputsModel)
def _measure_encoders(plant: EncodedOutputsModel, x: Vector, y: Vector) -> None:
    measure_all(plant.inner, x, y)
    for i in range(plant.resolution.size):
        if plant.resolution[i] > 0.0:
            y[i] = quantized(y[i], plant.resolution[i])


# They pass everything else on, as an encoder of one output does.
advance.register(EncodedOutputsModel)(advance.implementations[EncodedPlantModel])
begin_run.register(EncodedOutputsModel)(begin_run.implementations[EncodedPlantModel])
check_run.register(EncodedOutputsModel)(check_run.implementations[EncodedPlantModel])


@dataclass(frozen=True, eq=False, repr=False)
class EncodedOutputs(MultivariableWrapper):
    """A plant whose outputs are read by encoders; make it with ``encoded_outputs``."""

    plant: Any
    resolution: tuple[float, ...]  #: step of each output, zero without encoder [y-unit]

    @property
    def name(self) -> str:
        """Name for tables and plots."""
        return f"{self.plant.name}, encoded"

    def sampled(self, dt: float, interpret: bool = False) -> EncodedOutputsModel:
        """Return the parameters for a sample time ``dt`` [s]."""
        return EncodedOutputsModel(self.plant.sampled(dt, interpret), np.array(self.resolution))


def encoded_outputs(plant: Any, resolution: float | Sequence[float]) -> EncodedOutputs:
    """Return a plant with several outputs, each read by an encoder.

    Parameters
    ----------
    plant
        a plant with several outputs.
    resolution
        step of y that one count is, ``turn/counts`` [y-unit]: one for all outputs, or one for each,
        zero for an output without encoder.

    Raises
    ------
    ValueError
        for a negative step, or another number of them than the plant has outputs.
    """
    check_several(plant)
    count = plant.outputs
    steps = np.full(count, resolution) if np.ndim(resolution) == 0 else resolution
    values = checks.vector("resolution", steps, count)
    if np.any(values < 0.0):
        raise ValueError(f"resolution = {resolution!r}: must not be negative")
    return EncodedOutputs(plant, tuple(values.tolist()))


class DelayedInputsModel(NamedTuple):
    """A sampled plant whose control signals arrive late by whole samples."""

    inner: Any
    size: Size  # number of states of the plant
    waiting: Any  # samples of each control signal (m,), integers


as_input.register(DelayedInputsModel)(all_signals)


@measure_all.register(DelayedInputsModel)
def _measure_late(plant: DelayedInputsModel, x: Vector, y: Vector) -> None:
    measure_all(plant.inner, x[: plant.size], y)


@advance.register(DelayedInputsModel)
def _advance_late(
    plant: DelayedInputsModel, x: Vector, scratch: Vector, t: float, u: Any, w: Vector
) -> None:
    inputs = plant.waiting.size
    arriving = x[x.size - inputs :]  # room for the u that acts now
    first = plant.size
    for i in range(inputs):
        length = plant.waiting[i]
        arriving[i] = u[i] if length == 0 else x[first + length - 1]
        for j in range(length - 1, 0, -1):
            x[first + j] = x[first + j - 1]
        if length > 0:
            x[first] = u[i]
        first += length
    advance(plant.inner, x[: plant.size], scratch, t, arriving, w)


begin_run.register(DelayedInputsModel)(begin_run.implementations[DelayedPlantModel])
check_run.register(DelayedInputsModel)(check_run.implementations[DelayedPlantModel])


@dataclass(frozen=True, eq=False, repr=False)
class DelayedInputs(MultivariableWrapper):
    """A plant that its control signals reach late; make it with ``delayed_inputs``."""

    plant: Any
    samples: tuple[int, ...]
    dt: float

    @property
    def order(self) -> int:
        """Number of states, with the control signals on their way and those that act."""
        return int(self.plant.order) + sum(self.samples) + self.inputs

    @property
    def name(self) -> str:
        """Name for tables and plots."""
        return f"{self.plant.name}, inputs late"

    def sampled(self, dt: float, interpret: bool = False) -> DelayedInputsModel:
        """Return the parameters for the sample time ``dt`` [s] of the delays."""
        if abs(dt - self.dt) > 1e-9 * self.dt:
            raise ValueError(
                f"dt = {dt!r} s: this delayed plant was made for {self.dt!r} s; make another one"
            )
        waiting = np.array(self.samples, dtype=np.int64)
        return DelayedInputsModel(self.plant.sampled(dt, interpret), self.plant.order, waiting)


def delayed_inputs(plant: Any, delay: float | Sequence[float], dt: float) -> DelayedInputs:
    """Return a plant with several inputs, each of which reaches it late.

    Parameters
    ----------
    plant
        a plant with several inputs.
    delay
        whole samples of ``dt`` [s]: one for all inputs, or one for each.
    dt
        sample time of the later runs [s].

    Raises
    ------
    ValueError
        for a delay that is no whole number of samples, or another number of them than the plant has
        inputs.
    """
    check_several(plant)
    dt, count = checks.positive("dt", dt, "s"), plant.inputs
    given = np.full(count, delay) if np.ndim(delay) == 0 else delay
    values = checks.vector("delay", given, count).tolist()
    samples = tuple(
        checks.samples(f"delay[{i}]", value, dt) if value else 0 for i, value in enumerate(values)
    )
    return DelayedInputs(plant, samples, dt)


def check_several(value: Any, name: str = "plant") -> None:
    """Raise a ``ValueError`` if a value is not a plant with vectors u and y."""
    check_plant(value, name)
    if not hasattr(value, "inputs"):
        raise ValueError(
            f"{name} = {getattr(value, 'name', value)!r}: has one control signal and one output; "
            "must be a plant with several, for example quell.plants.MultivariableLinearPlant"
        )


def is_several(plant: Plant) -> bool:
    """Return whether u and y of a plant are vectors."""
    return hasattr(plant, "inputs")


class ChannelNames(NamedTuple):
    """Names that a plant's signals have where it comes from, in a file for instance; for errors."""

    u: tuple[str, ...] = ()
    y: tuple[str, ...] = ()
    w: tuple[str, ...] = ()


def named(plant: Any, channel: str) -> str:
    """Return the names of the channel ``u``, ``y`` or ``w`` of a plant, `` (a, b)``, or no text.

    They are found behind delays and encoders, too.
    """
    while isinstance(plant, PlantWrapper):
        plant = plant.plant
    names = getattr(getattr(plant, "channel_names", ChannelNames()), channel)
    return f" ({', '.join(names)})" if names else ""
