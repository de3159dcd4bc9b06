"""Nonlinear plants, given by the differential equation of the user."""

from __future__ import annotations

import math
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
from quell.types import DesignWarning, Matrix, Vector

# Largest h |λ| of a sub-step h, λ an eigenvalue of the linearised plant. The error of a sub-step is
# then below (h λ)^5 / 120 = 0.8 % of that mode; Runge-Kutta of order 4 is stable up to 2.8 (Hairer
# & Wanner, *Solving Ordinary Differential Equations II*, IV.2).
_LARGEST_STEP = 1.0
# Most sub-steps that are chosen: with more, the fast part of the plant is better left out of f.
_MOST_SUBSTEPS = 1000
# Differences for the linearisation at rest. Where the slope grows as the difference shrinks, f has
# a jump, for example sign(v): no number of sub-steps resolves it, and none is chosen for it.
_DIFFERENCE, _SMALL_DIFFERENCE, _JUMP = 1e-6, 1e-8, 10.0

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
        Runge-Kutta steps in a sample; u and w are held over the sample. By default one, or so many
        that ``h |λ| <= 1`` for each eigenvalue λ of the plant linearised at rest (x, u, w and t
        zero): stiff friction, for example, needs them. ``simulate`` checks the integration along
        the run and reports ``Status.POORLY_INTEGRATED`` if there are too few.
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
    substeps: int | None = None
    name: str = "nonlinear plant"

    def __post_init__(self) -> None:
        n = checks.whole("order", self.order, 1)
        m = checks.whole("disturbances", self.disturbances, 0)
        checks.optional(checks.whole, "substeps", self.substeps, 1)
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
        checks.positive("dt", dt, "s")
        substeps = self._chosen_substeps(dt) if self.substeps is None else self.substeps
        step = dt / substeps
        if interpret or self._machine_code is None:
            return PythonNonlinear(self.f, self._output_function, step, substeps)
        rate, output = self._machine_code
        function_pointers.set_origin(rate.address, self.f)
        function_pointers.set_origin(output.address, self._output_function)
        return CompiledNonlinear(rate.address, output.address, step, substeps)

    def _chosen_substeps(self, dt: float) -> int:
        """Return the number of sub-steps for which ``h |λ|`` is small enough at rest."""
        wanted = dt * self._largest_eigenvalue / _LARGEST_STEP
        if wanted <= _MOST_SUBSTEPS:
            return max(math.ceil(wanted), 1)
        warnings.warn(
            f"{self.name}: stiff, it has an eigenvalue of {self._largest_eigenvalue:.3g} 1/s at "
            f"rest and would need {wanted:.3g} sub-steps in dt = {dt!r} s; it gets "
            f"{_MOST_SUBSTEPS}: leave its fastest part out of f, or give substeps",
            DesignWarning,
            stacklevel=3,
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
                ends = [_value_or_nan(self.f, 0.0, x, 0.0, w) for x in (shift, -shift)]
                slopes[:, j] = (np.asarray(ends[0]) - np.asarray(ends[1])) / (2.0 * by)
        return slopes


def refined(model: Any, factor: int) -> Any:
    """Return a sampled nonlinear plant with ``factor`` times as many sub-steps."""
    return model._replace(step=model.step / factor, substeps=model.substeps * factor)
