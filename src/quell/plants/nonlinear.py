"""Nonlinear plants: the differential equation of the user, and friction at the input.

Machine code of a user's differential equation whose parameters are numbers by name.

The numbers are an array beside the addresses of the code: other numbers need no other code.

The equation of a nonlinear plant in a sample: Runge-Kutta over the user's function.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types as nb_types

from quell import checks
from quell.checks import Described
from quell.kernels import user_functions
from quell.kernels.dispatch import generic
from quell.kernels.frozen import frozen, kept_code
from quell.kernels.sized import Buffer
from quell.kernels.user_functions import (
    POINTER,
    Shapes,
    as_array,
    call,
    checked_value,
    count_of,
    evaluate,
    named_parameters,
    reader,
    set_origin,
    shapes_of,
)
from quell.plants.base import (
    advance,
    all_signals,
    as_input,
    labelled,
    measure,
    measure_all,
    signals_of,
)
from quell.types import Matrix, Vector, warn

# ---- Machine code of a user's differential equation whose parameters are numbers by name ----

_RATE_SIGNATURE = nb_types.void(
    nb_types.float64, POINTER, nb_types.float64, POINTER, POINTER, POINTER
)
_OUTPUT_SIGNATURE = nb_types.float64(POINTER, POINTER)
# Pairs of functions whose code is kept, for plants that are made again with other numbers. Chosen
# by hand: more than the plants of a study.
_KEPT = 32


def checked_parameters(
    given: Mapping[str, Any], f: Callable[..., Any], output: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what f and the output take after (t, x, u, w) and (x), in their order.

    Raises
    ------
    ValueError
        for a name that neither takes, a missing one, or a value that is no finite number and no
        vector or matrix of them.
    """
    if not isinstance(given, Mapping):
        raise ValueError(f"parameters = {given!r:.60}: must be numbers or arrays by name")
    taken = named_parameters(f, 4), named_parameters(output, 1) if callable(output) else {}
    known = list(dict.fromkeys([*taken[0], *taken[1]]))
    for name in given:
        if name not in known:
            hint = checks.nearest(str(name), known) if known else "f takes (t, x, u, w) only"
            raise ValueError(f"parameters[{name!r}]: is no argument of f or output; {hint}")
    found = []
    for names in taken:
        values = {}
        for name, default in names.items():
            value = given.get(name, default)
            if value is inspect.Parameter.empty:
                raise ValueError(f"parameters: {name} is missing, f or output takes it")
            values[name] = checked_value(f"parameters[{name!r}]", value)
        found.append(values)
    return found[0], found[1]


def bound(function: Callable[..., Any], values: Mapping[str, Any]) -> Callable[..., Any]:
    """Return a function with its numbers given, for Python."""
    return partial(function, **values) if values else function


@lru_cache(maxsize=_KEPT)
def row_output(row: tuple[float, ...]) -> Callable[[Vector], float]:
    """Return the function ``C x`` of a row C."""

    def linear(x: Vector) -> float:
        y = 0.0
        for i in range(len(row)):
            y += row[i] * x[i]
        return y

    return linear


@kept_code(_KEPT)
def machine_code(
    rate_of: Callable[..., Any],
    output_of: Callable[..., Any],
    sizes: tuple[int, int],
    shapes: tuple[Shapes, Shapes],
) -> tuple[Any, Any]:
    """Return the compiled f and output, which take a pointer to all numbers as well.

    Parameters
    ----------
    rate_of, output_of
        the user's functions.
    sizes
        numbers of states and of disturbances.
    shapes
        of the parameters of f and of the output, which follow each other in the array.

    Raises
    ------
    NotCompilableError
        if Numba can't compile a function.
    """
    n, m = sizes
    own, more = (reader(*each) for each in zip(shapes, (0, count_of(shapes[0])), strict=True))
    f = user_functions.jit_user_function(rate_of)
    h = user_functions.jit_user_function(output_of)

    def rate(t, px, u, pw, pp, pdx):  # type: ignore[no-untyped-def]
        dx = numba.carray(pdx, (n,))
        derivatives = f(t, numba.carray(px, (n,)), u, numba.carray(pw, (m,)), *own(pp))
        for i in range(n):
            dx[i] = derivatives[i]

    def output(px, pp):  # type: ignore[no-untyped-def]
        return h(numba.carray(px, (n,)), *more(pp))

    compile_cfunc = user_functions.compile_cfunc
    code = compile_cfunc(_RATE_SIGNATURE, rate), compile_cfunc(_OUTPUT_SIGNATURE, output)
    set_origin(code[0].address, rate_of, numbers=(0, shapes[0]))
    set_origin(code[1].address, output_of, numbers=(count_of(shapes[0]), shapes[1]))
    return code


_RATE_SIGNATURE_OF_MANY = nb_types.void(
    nb_types.float64, POINTER, POINTER, POINTER, POINTER, POINTER
)
_OUTPUT_SIGNATURE_OF_MANY = nb_types.void(POINTER, POINTER, POINTER)


def _first(u: Vector) -> float:
    return u[0]


def _all(u: Vector) -> Vector:
    return u


class _Sizes(NamedTuple):
    """Numbers of states, control signals, outputs and disturbances, and shapes of parameters."""

    n: int
    m: int
    p: int
    q: int
    own: Shapes  # of the parameters of f
    more: Shapes  # of those of the output


@kept_code(_KEPT)
def _machine_code_of_many(
    rate_of: Callable[..., Any], output_of: Callable[..., Any], sizes: _Sizes
) -> tuple[Any, Any]:
    """Return the compiled f and output; raise ``NotCompilableError`` if Numba can't."""
    n, m, p, q, of_rate, of_output = sizes
    own, more = reader(of_rate), reader(of_output, count_of(of_rate))
    f = user_functions.jit_user_function(rate_of)
    h = user_functions.jit_user_function(output_of)
    taken = user_functions.jit_user_function(_first if m == 1 else _all)

    def rate(t, px, pu, pw, pp, pdx):  # type: ignore[no-untyped-def]
        dx = numba.carray(pdx, (n,))
        u = taken(numba.carray(pu, (m,)))
        found = f(t, numba.carray(px, (n,)), u, numba.carray(pw, (q,)), *own(pp))
        for i in range(n):
            dx[i] = found[i]

    def output(px, pp, py):  # type: ignore[no-untyped-def]
        y = numba.carray(py, (p,))
        found = h(numba.carray(px, (n,)), *more(pp))
        for i in range(p):
            y[i] = found[i]

    compile_cfunc = user_functions.compile_cfunc
    return (
        compile_cfunc(_RATE_SIGNATURE_OF_MANY, rate),
        compile_cfunc(_OUTPUT_SIGNATURE_OF_MANY, output),
    )


@lru_cache(maxsize=_KEPT)
def rows_output(rows: tuple[tuple[float, ...], ...]) -> Callable[[Vector], Any]:
    """Return the function ``C x`` of a matrix C."""
    C = np.array(rows)

    def linear(x: Vector) -> Vector:
        y = np.zeros(C.shape[0])
        for i in range(C.shape[0]):
            for j in range(C.shape[1]):
                y[i] += C[i, j] * x[j]
        return y

    return linear


# ---- The equation of a nonlinear plant in a sample ----


class CompiledNonlinear(NamedTuple):
    """A nonlinear plant with compiled functions.

    They are given by address, so one compiled driver serves all of them.
    """

    rate: int
    output: int
    step: float  # length of a sub-step [s]
    substeps: int


class CompiledParametric(NamedTuple):
    """A nonlinear plant with compiled functions that take an array of parameters, too."""

    rate: int
    output: int
    step: float  # length of a sub-step [s]
    substeps: int
    parameters: Vector  # those of the rate, then those of the output


class PythonNonlinear(NamedTuple):
    """A nonlinear plant whose functions only Python can run; fields as ``CompiledNonlinear``."""

    rate: Callable[..., Any]
    output: Callable[..., Any]
    step: float
    substeps: int


class CompiledOfMany(NamedTuple):
    """A nonlinear plant with several signals and compiled functions, given by address."""

    rate: int
    output: int
    step: float  # length of a sub-step [s]
    substeps: int
    parameters: Buffer  # those of the rate, then those of the output


class PythonOfMany(NamedTuple):
    """A nonlinear plant with several signals whose functions only Python can run."""

    rate: Callable[..., Any]
    output: Callable[..., Any]
    step: float
    substeps: int


@generic
def derivatives(plant: Any, t: float, x: Vector, u: Any, w: Vector, dx: Vector) -> None:
    """Write the derivatives of the state into ``dx`` (n,); u is as ``advance`` takes it."""
    raise TypeError


@advance.register(CompiledNonlinear)
@advance.register(CompiledParametric)
@advance.register(CompiledOfMany)
@advance.register(PythonNonlinear)
@advance.register(PythonOfMany)
def runge_kutta(plant: Any, x: Vector, scratch: Vector, t: float, u: Any, w: Vector) -> None:
    """Take ``substeps`` classical Runge-Kutta steps.

    Hairer, Nørsett & Wanner, *Solving Ordinary Differential Equations I*, table II.1.2.
    """
    n = x.size
    k1, k2, k3 = scratch[:n], scratch[n : 2 * n], scratch[2 * n : 3 * n]
    k4, inner = scratch[3 * n : 4 * n], scratch[4 * n : 5 * n]
    h = plant.step
    for i in range(plant.substeps):
        now = t + i * h
        derivatives(plant, now, x, u, w, k1)
        for j in range(n):
            inner[j] = x[j] + 0.5 * h * k1[j]
        derivatives(plant, now + 0.5 * h, inner, u, w, k2)
        for j in range(n):
            inner[j] = x[j] + 0.5 * h * k2[j]
        derivatives(plant, now + 0.5 * h, inner, u, w, k3)
        for j in range(n):
            inner[j] = x[j] + h * k3[j]
        derivatives(plant, now + h, inner, u, w, k4)
        for j in range(n):
            x[j] += h / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j])


@measure.register(CompiledNonlinear)
def _measure(plant: CompiledNonlinear, x: Vector) -> float:
    return evaluate(plant.output, x)


@derivatives.register(CompiledNonlinear)
def _derivatives(
    plant: CompiledNonlinear, t: float, x: Vector, u: float, w: Vector, dx: Vector
) -> None:
    call(plant.rate, t, x, u, w, dx)


@measure.register(CompiledParametric)
def _measure_parametric(plant: CompiledParametric, x: Vector) -> float:
    return evaluate(plant.output, x, plant.parameters)


@derivatives.register(CompiledParametric)
@derivatives.register(CompiledOfMany)
def _derivatives_parametric(
    plant: CompiledParametric | CompiledOfMany, t: float, x: Vector, u: Any, w: Vector, dx: Vector
) -> None:
    call(plant.rate, t, x, u, w, plant.parameters, dx)


@measure.register(PythonNonlinear)
def _measure_python(plant: PythonNonlinear, x: Vector) -> float:
    return float(value_or_nan(plant.output, x))


@derivatives.register(PythonNonlinear)
@derivatives.register(PythonOfMany)
def _derivatives_python(
    plant: PythonNonlinear | PythonOfMany, t: float, x: Vector, u: Any, w: Vector, dx: Vector
) -> None:
    dx[:] = value_or_nan(plant.rate, t, x, u, w)


as_input.register(CompiledOfMany)(all_signals)
as_input.register(PythonOfMany)(all_signals)


@measure_all.register(CompiledOfMany)
def _measure_many(plant: CompiledOfMany, x: Vector, y: Vector) -> None:
    call(plant.output, x, plant.parameters, y)


@measure_all.register(PythonOfMany)
def _measure_python_many(plant: PythonOfMany, x: Vector, y: Vector) -> None:
    y[:] = value_or_nan(plant.output, x)


def value_or_nan(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the function's value, or NaN as compiled code does, for example for log(-1.0).

    A run with NaN ends as diverged.
    """
    try:
        return function(*arguments)
    except Exception as error:
        if isinstance(error, ArithmeticError) or "math domain" in str(error):
            return np.nan
        raise


def refined(model: Any, factor: int) -> Any:
    """Return a sampled nonlinear plant with ``factor`` times as many sub-steps."""
    return model._replace(step=model.step / factor, substeps=model.substeps * factor)


# ---- Nonlinear plants, given by the differential equation of the user ----

# Largest h |λ| of a sub-step h, λ an eigenvalue of the linearised plant. The error of a sub-step is
# then below (h λ)^5 / 120 = 0.8 % of that mode; Runge-Kutta of order 4 is stable up to 2.8 (Hairer
# & Wanner, *Solving Ordinary Differential Equations II*, IV.2).
_LARGEST_STEP = 1.0
# Most sub-steps that are chosen: with more, the fast part of the plant is better left out of f.
_MOST_SUBSTEPS = 1000
# Differences for the linearisation at rest. Where the slope grows as the difference shrinks, f has
# a jump, for example sign(v): no number of sub-steps resolves it, and none is chosen for it.
_DIFFERENCE, _SMALL_DIFFERENCE, _JUMP = 1e-6, 1e-8, 10.0

_RATE_SIGNATURE_PLANT = nb_types.void(nb_types.float64, POINTER, nb_types.float64, POINTER, POINTER)
_OUTPUT_SIGNATURE_PLANT = nb_types.float64(POINTER)


@dataclass(frozen=True, eq=False, repr=False)
class NonlinearPlant(Described):
    """A plant ``x' = f(t, x, u, w, …)``, solved by Runge-Kutta of order 4 with a fixed sub-step.

    Parameters
    ----------
    f
        ``f(t, x, u, w)`` returns the n derivatives as a tuple, list or array; t [s], x (n,), u a
        number, of several inputs an array (m,), w (q,). Numba compiles it if it can; else it runs
        as Python, about a hundred times slower, and a warning says why. Further arguments are
        parameters.
    order
        number of states n.
    output
        the output y: a function ``h(x)`` that returns a number or several, or C of ``y = C x``, a
        row or a matrix (p, n); the first state by default. It may take parameters, too.
    disturbances
        number q of disturbance inputs.
    substeps
        Runge-Kutta steps in a sample; u and w are held over the sample. By default one, or so many
        that ``h |λ| <= 1`` for each eigenvalue λ of the plant linearised at rest (x, u, w and t
        zero): stiff friction, for example, needs them. ``simulate`` checks the integration along
        the run and reports ``Status.POORLY_INTEGRATED`` if there are too few.
    name
        for tables and plots.
    parameters
        numbers, vectors and matrices by name that f and output take as further arguments;
        ``with_parameters`` changes them, and compiles nothing for the same shapes.
    operating_point
        state and control signal (x, u) about which designs and ``analyse`` take the plant as
        linear. By default x and u are zero if that is a state of rest.
    inputs
        number m of control signals.

    Raises
    ------
    ValueError
        if ``f`` does not return n numbers, or ``output`` is neither a row or matrix nor a function
        that returns numbers.

    Examples
    --------
    >>> import math
    >>> pendulum = NonlinearPlant(lambda t, x, u, w: (x[1], u - 9.81 * math.sin(x[0])), order=2)

    With parameters:

    >>> def swing(t, x, u, w, m, length):
    ...     return x[1], u / (m * length**2) - 9.81 / length * math.sin(x[0])
    >>> pendulum = NonlinearPlant(swing, order=2, parameters={"m": 1.0, "length": 0.5})
    >>> pendulum.with_parameters(m=2.0).parameters
    {'m': 2.0, 'length': 0.5}

    With several signals:

    >>> def tanks(t, x, u, w):
    ...     return u[0] - 0.2 * x[0], u[1] + 0.2 * x[0] - 0.1 * x[1]
    >>> NonlinearPlant(tanks, order=2, inputs=2, output=[[1, 0], [0, 1]]).outputs
    2
    """

    f: Callable[..., Any]
    order: int
    output: Any = None
    disturbances: int = 1
    substeps: int | None = None
    name: str = "nonlinear plant"
    parameters: Mapping[str, Any] | None = None
    operating_point: Any = None
    inputs: int = 1

    def __post_init__(self) -> None:
        n = checks.whole("order", self.order, 1)
        q = checks.whole("disturbances", self.disturbances, 0)
        checks.whole("inputs", self.inputs, 1)
        checks.optional(checks.whole, "substeps", self.substeps, 1)
        if not callable(self.f):
            raise ValueError(f"f = {self.f!r}: must be a function f(t, x, u, w)")
        rule = (
            "f takes (t, x, u, w) and the names in parameters, output takes (x), with arrays x and "
            "w of the plant's sizes, and u a number or, with inputs=m, an array"
        )
        if self.parameters is not None:
            own, more = self._numbers
            object.__setattr__(self, "parameters", {**own, **more})
        if self.operating_point is not None:
            x, u = checked_point(self.operating_point)
            checks.vector("operating_point[0]", x, n)
            if self.inputs == 1:
                checks.finite("operating_point[1]", u)
            else:
                checks.vector("operating_point[1]", u, self.inputs)
        u0, tried = self.no_control, "0.0" if self.inputs == 1 else "zeros"
        returned = user_functions.attempt_kernel(
            f"f(0.0, zeros, {tried}, zeros)", rule, self._rate, 0.0, np.zeros(n), u0, np.zeros(q)
        )
        if returned is not user_functions.UNKNOWN and np.shape(returned) != (n,):
            raise ValueError(
                f"f returns shape {np.shape(returned)}: must return the {n} derivatives of x"
            )
        if callable(self.output):
            found = self._output_at_rest(rule)
            if found is None:
                raise ValueError("output(x) returns None: must return one number, or a vector")
            shape = np.shape(found)
            if len(shape) > 1:
                raise ValueError(
                    f"output(x) returns shape {shape}: must return one number, or a vector"
                )
        elif np.ndim(self._row) == 2:
            rows = checks.matrix("output", self._row)
            if rows.shape[1] != n:
                raise ValueError(
                    f"output has shape {rows.shape}: must have a row for each output and a column "
                    f"for each of the {n} states"
                )
            shape = (rows.shape[0],)
        else:
            checks.vector("output", self._row, n)
            shape = ()
        object.__setattr__(self, "_output_shape", shape)

    def _output_at_rest(self, rule: str) -> Any:
        """Return what ``output`` returns for a state of zeros, or a near one."""
        n = self.order
        found = user_functions.attempt_kernel("output(zeros)", rule, self._measured, np.zeros(n))
        if found is not user_functions.UNKNOWN:
            return found
        return self._measured(user_functions.sample_values(n))

    @property
    def outputs(self) -> int:
        """Number of measured outputs."""
        shape: tuple[int, ...] = self._output_shape  # type: ignore[attr-defined]
        return shape[0] if shape else 1

    @property
    def _has_vectors(self) -> bool:
        """Whether its u or its y are arrays."""
        return self.inputs > 1 or self._output_shape != ()  # type: ignore[attr-defined]

    @property
    def no_control(self) -> Any:
        """The control signal at rest, as f takes it."""
        return 0.0 if self.inputs == 1 else np.zeros(self.inputs)

    def with_parameters(self, **values: Any) -> NonlinearPlant:
        """Return the plant with other values of some parameters; nothing is compiled again."""
        made = replace(self, parameters={**(self.parameters or {}), **values})
        signals = signals_of(self)
        return labelled(made, *signals[:3]) if signals.known else made

    @property
    def _row(self) -> Any:
        return np.eye(self.order)[0] if self.output is None else self.output

    @cached_property
    def _output_function(self) -> Callable[..., Any]:
        if callable(self.output):
            return self.output
        if np.ndim(self._row) == 2:
            return rows_output(tuple(map(tuple, np.asarray(self._row, dtype=float).tolist())))
        return row_output(tuple(np.asarray(self._row, dtype=float).tolist()))

    def _machine_code_of_both(self) -> tuple[Any, Any]:
        n, m = self.order, self.disturbances
        if self._has_vectors:
            own, more = map(shapes_of, self._numbers)
            sizes = _Sizes(n, self.inputs, self.outputs, m, own, more)
            return _machine_code_of_many(self.f, self._output_function, sizes)

        def rate(t, px, u, pw, pdx):  # type: ignore[no-untyped-def]
            dx = numba.carray(pdx, (n,))
            derivatives = f(t, numba.carray(px, (n,)), u, numba.carray(pw, (m,)))
            for i in range(n):
                dx[i] = derivatives[i]

        def output(px):  # type: ignore[no-untyped-def]
            return h(numba.carray(px, (n,)))

        if self.parameters is not None:
            own, more = map(shapes_of, self._numbers)
            return machine_code(self.f, self._output_function, (n, m), (own, more))
        f = user_functions.jit_user_function(self.f)
        h = user_functions.jit_user_function(self._output_function)
        compile_cfunc = user_functions.compile_cfunc
        code = (
            compile_cfunc(_RATE_SIGNATURE_PLANT, rate),
            compile_cfunc(_OUTPUT_SIGNATURE_PLANT, output),
        )
        set_origin(code[0].address, self.f)
        set_origin(code[1].address, self._output_function)
        return code

    def sampled(self, dt: float, interpret: bool = False) -> Any:
        """Return the parameters for a sample time ``dt`` [s]; see ``Plant.sampled``."""
        step, substeps = self._step(dt)
        code = self._code(interpret)
        if code is None and self._has_vectors:
            rate_of: Any = self._rate if self.inputs > 1 else _taking_one(self._rate)
            return PythonOfMany(rate_of, self._measured, step, substeps)
        if code is None:
            return PythonNonlinear(self._rate, self._measured, step, substeps)
        rate, output = code
        if self._has_vectors:
            numbers = as_array(*self._numbers)
            return CompiledOfMany(rate.address, output.address, step, substeps, numbers)
        if self.parameters is None:
            return CompiledNonlinear(rate.address, output.address, step, substeps)
        numbers = as_array(*self._numbers)
        return CompiledParametric(rate.address, output.address, step, substeps, numbers)

    @property
    def _numbers(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The numbers and arrays that f and the output take, in their order."""
        if self.parameters is None:
            return {}, {}
        return checked_parameters(self.parameters, self.f, self.output)

    @cached_property
    def _rate(self) -> Callable[..., Any]:
        """The function f(t, x, u, w), with the parameters in it."""
        frozen(self.f)  # compiles helpers again whose globals have changed
        return bound(self.f, self._numbers[0])

    @cached_property
    def _measured(self) -> Callable[..., Any]:
        """The function h(x), with the parameters in it."""
        frozen(self._output_function)
        return bound(self._output_function, self._numbers[1])

    @cached_property
    def _codes(self) -> dict[Any, tuple[Any, Any] | None]:
        """Compiled functions by what is frozen in them, kept as long as their addresses."""
        return {}

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what is computed when it is needed: the code is of this process only."""
        of_class = partial(getattr, type(self))
        return {
            name: value
            for name, value in vars(self).items()
            if not isinstance(of_class(name, None), cached_property)
        }

    def _code(self, interpret: bool = False) -> tuple[Any, Any] | None:
        """Return the two compiled functions; None if they run as Python."""
        key = frozen(self.f), frozen(self._output_function)
        if interpret:
            return None
        if key in self._codes:
            return self._codes[key]
        try:
            made = self._machine_code_of_both()
        except user_functions.NotCompilableError as error:
            warn(
                f"{self.name}: f or output can't be compiled and runs as Python, which is slow "
                f"({error})",
                UserWarning,
            )
            made = None
        return self._codes.setdefault(key, made)  # of two threads both use the first one's

    @property
    def compiled(self) -> bool:
        """Whether Numba could compile the functions."""
        return self._code() is not None

    def _step(self, dt: float) -> tuple[float, int]:
        """Return length and number of the sub-steps in a sample."""
        checks.positive("dt", dt, "s")
        substeps = self._chosen_substeps(dt) if self.substeps is None else self.substeps
        return dt / substeps, substeps

    def _chosen_substeps(self, dt: float) -> int:
        """Return the number of sub-steps for which ``h |λ|`` is small enough at rest."""
        wanted = dt * self._largest_eigenvalue / _LARGEST_STEP
        if wanted <= _MOST_SUBSTEPS:
            return max(math.ceil(wanted), 1)
        warn(
            f"{self.name}: stiff, it has an eigenvalue of {self._largest_eigenvalue:.3g} 1/s at "
            f"rest and would need {wanted:.3g} sub-steps in dt = {dt!r} s; it gets "
            f"{_MOST_SUBSTEPS}: leave its fastest part out of f, or give substeps"
        )
        return _MOST_SUBSTEPS

    @cached_property
    def _largest_eigenvalue(self) -> float:
        """Largest magnitude of the eigenvalues at rest [1/s]; zero if f has a jump there."""
        slopes = [self._slopes_at_rest(by) for by in (_DIFFERENCE, _SMALL_DIFFERENCE)]
        if not np.all(np.isfinite(slopes)):
            return 0.0
        largest, of_smaller = (float(np.max(np.abs(np.linalg.eigvals(m)))) for m in slopes)
        return largest if of_smaller <= _JUMP * largest else 0.0

    def _slopes_at_rest(self, by: float) -> Matrix:
        """Return the derivatives of f by x (n, n) at rest, from central differences ``by``."""
        n, w = self.order, np.zeros(self.disturbances)
        slopes = np.full((n, n), np.nan)
        with np.errstate(all="ignore"):
            for j, shift in enumerate(by * np.eye(n)):
                ends = [
                    value_or_nan(self._rate, 0.0, x, self.no_control, w) for x in (shift, -shift)
                ]
                slopes[:, j] = (np.asarray(ends[0]) - np.asarray(ends[1])) / (2.0 * by)
        return slopes


def _taking_one(rate: Callable[..., Any]) -> Callable[..., Any]:
    """Return f of one control signal that takes it in an array."""
    return lambda t, x, u, w: rate(t, x, u[0], w)


def checked_point(given: Any) -> tuple[Any, float]:
    """Return the state and the control signal of an operating point."""
    try:
        x, u = given
    except (TypeError, ValueError):
        raise ValueError(
            f"operating_point = {given!r}: must be a state and a control signal, (x, u)"
        ) from None
    return x, u
