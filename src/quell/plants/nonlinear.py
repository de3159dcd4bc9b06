"""Nonlinear plants given by the user's own differential equation."""

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
from quell.kernels.dispatch import generic, kernel
from quell.kernels.function_pointers import (
    POINTER,
    NotCompilableError,
    call,
    compile_cfunc,
    evaluate,
    jit_user_function,
)
from quell.plants.base import advance, measure
from quell.types import Vector

_RATE_SIGNATURE = nb_types.void(nb_types.float64, POINTER, nb_types.float64, POINTER, POINTER)
_OUTPUT_SIGNATURE = nb_types.float64(POINTER)


class CompiledNonlinear(NamedTuple):
    """A nonlinear plant whose functions are compiled; they are given by address, so that the driver is compiled once for all."""

    rate: int
    output: int
    step: float
    """Length of a sub-step [s]."""
    substeps: int


class PythonNonlinear(NamedTuple):
    """A nonlinear plant whose functions only Python can run."""

    rate: Callable[..., Any]
    output: Callable[..., Any]
    step: float
    substeps: int


@generic
def derivatives(plant: Any, t: float, x: Vector, u: float, w: Vector, dx: Vector) -> None:
    """Write the derivatives of the state into ``dx`` (n,)."""
    raise TypeError


@kernel
def _runge_kutta(plant: Any, x: Vector, scratch: Vector, t: float, u: float, w: Vector) -> None:
    """Classical Runge-Kutta, ``substeps`` times (Hairer, Nørsett & Wanner, *Solving ODEs I*, table II.1.2)."""
    n = x.size
    k1, k2, k3 = scratch[:n], scratch[n : 2 * n], scratch[2 * n : 3 * n]
    k4, at = scratch[3 * n : 4 * n], scratch[4 * n : 5 * n]
    h = plant.step
    for i in range(plant.substeps):
        now = t + i * h
        derivatives(plant, now, x, u, w, k1)
        for j in range(n):
            at[j] = x[j] + 0.5 * h * k1[j]
        derivatives(plant, now + 0.5 * h, at, u, w, k2)
        for j in range(n):
            at[j] = x[j] + 0.5 * h * k2[j]
        derivatives(plant, now + 0.5 * h, at, u, w, k3)
        for j in range(n):
            at[j] = x[j] + h * k3[j]
        derivatives(plant, now + h, at, u, w, k4)
        for j in range(n):
            x[j] += h / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j])


@measure.register(CompiledNonlinear)
def _measure(plant: CompiledNonlinear, x: Vector) -> float:
    return evaluate(plant.output, x)


@advance.register(CompiledNonlinear)
def _advance(
    plant: CompiledNonlinear, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    _runge_kutta(plant, x, scratch, t, u, w)


@derivatives.register(CompiledNonlinear)
def _derivatives(
    plant: CompiledNonlinear, t: float, x: Vector, u: float, w: Vector, dx: Vector
) -> None:
    call(plant.rate, t, x, u, w, dx)


@measure.register(PythonNonlinear)
def _measure_python(plant: PythonNonlinear, x: Vector) -> float:
    try:
        return float(plant.output(x))
    except Exception as error:
        if not _out_of_range(error):
            raise
        return float("nan")


@advance.register(PythonNonlinear)
def _advance_python(
    plant: PythonNonlinear, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    _runge_kutta(plant, x, scratch, t, u, w)


@derivatives.register(PythonNonlinear)
def _derivatives_python(
    plant: PythonNonlinear, t: float, x: Vector, u: float, w: Vector, dx: Vector
) -> None:
    try:
        dx[:] = plant.rate(t, x, u, w)
    except Exception as error:
        if not _out_of_range(error):
            raise
        dx[:] = np.nan  # as the compiled function has it; the run ends as diverged


@dataclass(frozen=True, eq=False)
class NonlinearPlant:
    """``x' = f(t, x, u, w)`` with a function of the user's own, solved by Runge-Kutta of order 4 with a fixed sub-step.

    Parameters
    ----------
    f
        ``f(t, x, u, w)`` returns the n derivatives as a tuple, list or array; t [s], x (n,), u a number, w (m,). It is compiled by
        Numba where that is possible; where not, it runs as Python, about a hundred times slower, and a warning says why.
    order
        number of states n.
    output
        what y is: a function ``h(x)``, or the row C of ``y = C x``; the first state by default.
    disturbances
        number m of disturbance inputs.
    substeps
        Runge-Kutta steps in a sample; u and w hold over the sample.
    name
        for tables and plots.

    Raises
    ------
    ValueError
        where ``f`` does not return n numbers, or ``output`` fits neither form.

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
        returned = _tried("f(0.0, zeros, 0.0, zeros)", self.f, 0.0, np.zeros(n), 0.0, np.zeros(m))
        if returned is not None and np.shape(returned) != (n,):
            raise ValueError(
                f"f returns shape {np.shape(returned)}: must return the {n} derivatives of the state"
            )
        if not callable(self.output):
            checks.vector("output", self._row, n)
        elif np.shape(_tried("output(zeros)", self.output, np.zeros(n))) != ():
            raise ValueError("output(x) must return one number")

    @property
    def _row(self) -> Any:
        return np.eye(self.order)[0] if self.output is None else self.output

    @cached_property
    def _measured(self) -> Callable[..., Any]:
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
        """The two functions compiled, or None where they can't be; they are kept as long as their addresses are."""
        n, m = self.order, self.disturbances

        def rate(t, px, u, pw, pdx):  # type: ignore[no-untyped-def]
            dx = numba.carray(pdx, (n,))
            derivatives = f(t, numba.carray(px, (n,)), u, numba.carray(pw, (m,)))
            for i in range(n):
                dx[i] = derivatives[i]

        def output(px):  # type: ignore[no-untyped-def]
            return h(numba.carray(px, (n,)))

        try:
            f, h = jit_user_function(self.f), jit_user_function(self._measured)
            return compile_cfunc(_RATE_SIGNATURE, rate), compile_cfunc(_OUTPUT_SIGNATURE, output)
        except NotCompilableError as error:
            self._warn(str(error))
            return None

    def _warn(self, reason: str) -> None:
        warnings.warn(
            f"{self.name}: f or output can't be compiled and runs as Python, which is slow ({reason})",
            stacklevel=4,
        )

    @property
    def compiled(self) -> bool:
        """Whether Numba could compile the functions."""
        return self._machine_code is not None

    def sampled(self, dt: float, interpret: bool = False) -> CompiledNonlinear | PythonNonlinear:
        """Return the plant for the driver, at the sample time ``dt`` [s]; with ``interpret``, so that Python runs the functions."""
        step = checks.positive("dt", dt, "s") / self.substeps
        if interpret or self._machine_code is None:
            return PythonNonlinear(self.f, self._measured, step, self.substeps)
        rate, output = self._machine_code
        return CompiledNonlinear(rate.address, output.address, step, self.substeps)


def _tried(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return what a user's function returns; None where the origin is no place for it."""
    try:
        return function(*arguments)
    except Exception as error:
        if _out_of_range(error):
            return None
        raise ValueError(
            f"{what} fails with {type(error).__name__}: {error}; "
            "f takes (t, x, u, w), output takes (x), with arrays x and w of the plant's sizes"
        ) from error


def _out_of_range(error: Exception) -> bool:
    """Tell whether a function was asked for something that is no number there, such as exp(1000.0)."""
    return isinstance(error, ArithmeticError) or "math domain" in str(error)
