"""Nonlinear plants, given by the differential equation of the user."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numba
import numpy as np
from numba.core import types as nb_types

from quell import checks
from quell.kernels import function_pointers, validation
from quell.kernels.dispatch import generic
from quell.kernels.function_pointers import POINTER, call, evaluate
from quell.plants.base import advance, measure
from quell.types import Vector

_RATE_SIGNATURE = nb_types.void(nb_types.float64, POINTER, nb_types.float64, POINTER, POINTER)
_OUTPUT_SIGNATURE = nb_types.float64(POINTER)


class CompiledNonlinear(NamedTuple):
    """A nonlinear plant with compiled functions.

    They are given by address, so one compiled driver serves all of them.
    """

    rate: int
    output: int
    step: float  # length of a sub-step [s]
    substeps: int


class PythonNonlinear(NamedTuple):
    """A nonlinear plant whose functions only Python can run; fields as ``CompiledNonlinear``."""

    rate: Callable[..., Any]
    output: Callable[..., Any]
    step: float
    substeps: int


@generic
def derivatives(plant: Any, t: float, x: Vector, u: float, w: Vector, dx: Vector) -> None:
    """Write the derivatives of the state into ``dx`` (n,)."""
    raise TypeError


@advance.register(CompiledNonlinear)
@advance.register(PythonNonlinear)
def _runge_kutta(plant: Any, x: Vector, scratch: Vector, t: float, u: float, w: Vector) -> None:
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


@measure.register(PythonNonlinear)
def _measure_python(plant: PythonNonlinear, x: Vector) -> float:
    return float(_value_or_nan(plant.output, x))


@derivatives.register(PythonNonlinear)
def _derivatives_python(
    plant: PythonNonlinear, t: float, x: Vector, u: float, w: Vector, dx: Vector
) -> None:
    dx[:] = _value_or_nan(plant.rate, t, x, u, w)


def _value_or_nan(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the function's value, or NaN as compiled code does, for example for log(-1.0).

    A run with NaN ends as diverged.
    """
    try:
        return function(*arguments)
    except Exception as error:
        if isinstance(error, ArithmeticError) or "math domain" in str(error):
            return np.nan
        raise


@dataclass(frozen=True, eq=False)
class NonlinearPlant:
    """A plant ``x' = f(t, x, u, w)``, solved by Runge-Kutta of order 4 with a fixed sub-step.

    Parameters
    ----------
    f
        ``f(t, x, u, w)`` returns the n derivatives as a tuple, list or array; t [s], x (n,), u a
        number, w (m,). Numba compiles it if it can; else it runs as Python, about a hundred times
        slower, and a warning says why.
    order
        number of states n.
    output
        the output y: a function ``h(x)``, or the row C of ``y = C x``; the first state by default.
    disturbances
        number m of disturbance inputs.
    substeps
        Runge-Kutta steps in a sample; u and w are held over the sample.
    name
        for tables and plots.

    Raises
    ------
    ValueError
        if ``f`` does not return n numbers, or ``output`` is neither a row nor a function that
        returns a number.

    Examples
    --------
    >>> import math
    >>> pendulum = NonlinearPlant(lambda t, x, u, w: (x[1], u - 9.81 * math.sin(x[0])), order=2)
    """

    f: Callable[..., Any]
    order: int
    output: Any = None
    disturbances: int = 1
    substeps: int = 1
    name: str = "nonlinear plant"

    def __post_init__(self) -> None:
        n = checks.whole("order", self.order, 1)
        m = checks.whole("disturbances", self.disturbances, 0)
        checks.whole("substeps", self.substeps, 1)
        if not callable(self.f):
            raise ValueError(f"f = {self.f!r}: must be a function f(t, x, u, w)")
        rule = "f takes (t, x, u, w), output takes (x), with arrays x and w of the plant's sizes"
        returned = validation.attempt_kernel(
            "f(0.0, zeros, 0.0, zeros)", rule, self.f, 0.0, np.zeros(n), 0.0, np.zeros(m)
        )
        if returned is not validation.UNKNOWN and np.shape(returned) != (n,):
            raise ValueError(
                f"f returns shape {np.shape(returned)}: must return the {n} derivatives of x"
            )
        if not callable(self.output):
            checks.vector("output", self._row, n)
        elif np.shape(validation.attempt_kernel("output(zeros)", rule, self.output, np.zeros(n))):
            raise ValueError("output(x) must return one number")

    @property
    def _row(self) -> Any:
        return np.eye(self.order)[0] if self.output is None else self.output

    @cached_property
    def _output_function(self) -> Callable[..., Any]:
        if callable(self.output):
            return self.output
        row = tuple(np.asarray(self._row, dtype=float).tolist())

        def linear(x: Vector) -> float:
            y = 0.0
            for i in range(len(row)):
                y += row[i] * x[i]
            return y

        return linear

    @cached_property
    def _machine_code(self) -> tuple[Any, Any] | None:
        """The two compiled functions, kept as long as their addresses; None if Numba can't."""
        n, m = self.order, self.disturbances

        def rate(t, px, u, pw, pdx):  # type: ignore[no-untyped-def]
            dx = numba.carray(pdx, (n,))
            derivatives = f(t, numba.carray(px, (n,)), u, numba.carray(pw, (m,)))
            for i in range(n):
                dx[i] = derivatives[i]

        def output(px):  # type: ignore[no-untyped-def]
            return h(numba.carray(px, (n,)))

        try:
            f = function_pointers.jit_user_function(self.f)
            h = function_pointers.jit_user_function(self._output_function)
            compile_cfunc = function_pointers.compile_cfunc
            return compile_cfunc(_RATE_SIGNATURE, rate), compile_cfunc(_OUTPUT_SIGNATURE, output)
        except function_pointers.NotCompilableError as error:
            warnings.warn(
                f"{self.name}: f or output can't be compiled and runs as Python, which is slow "
                f"({error})",
                stacklevel=3,
            )
            return None

    @property
    def compiled(self) -> bool:
        """Whether Numba could compile the functions."""
        return self._machine_code is not None

    def sampled(self, dt: float, interpret: bool = False) -> CompiledNonlinear | PythonNonlinear:
        """Return the parameters for a sample time ``dt`` [s]; see ``Plant.sampled``."""
        step = checks.positive("dt", dt, "s") / self.substeps
        if interpret or self._machine_code is None:
            return PythonNonlinear(self.f, self._output_function, step, self.substeps)
        rate, output = self._machine_code
        return CompiledNonlinear(rate.address, output.address, step, self.substeps)
