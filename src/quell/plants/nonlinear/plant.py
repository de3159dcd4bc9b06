"""Nonlinear plants, given by the differential equation of the user."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numba.core import types as nb_types

from quell import checks
from quell.described import Described
from quell.kernels import function_pointers, validation
from quell.kernels.function_pointers import POINTER
from quell.plants.labelled import labelled, signals_of
from quell.plants.nonlinear import equations
from quell.plants.nonlinear.kernels import (
    CompiledNonlinear,
    CompiledParametric,
    PythonNonlinear,
    value_or_nan,
)
from quell.types import Matrix
from quell.warn import warn

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


@dataclass(frozen=True, eq=False, repr=False)
class NonlinearPlant(Described):
    """A plant ``x' = f(t, x, u, w, …)``, solved by Runge-Kutta of order 4 with a fixed sub-step.

    Parameters
    ----------
    f
        ``f(t, x, u, w)`` returns the n derivatives as a tuple, list or array; t [s], x (n,), u a
        number, w (m,). Numba compiles it if it can; else it runs as Python, about a hundred times
        slower, and a warning says why. Further arguments are parameters.
    order
        number of states n.
    output
        the output y: a function ``h(x)``, or the row C of ``y = C x``; the first state by default.
        It may take parameters, too.
    disturbances
        number m of disturbance inputs.
    substeps
        Runge-Kutta steps in a sample; u and w are held over the sample. By default one, or so many
        that ``h |λ| <= 1`` for each eigenvalue λ of the plant linearised at rest (x, u, w and t
        zero): stiff friction, for example, needs them. ``simulate`` checks the integration along
        the run and reports ``Status.POORLY_INTEGRATED`` if there are too few.
    name
        for tables and plots.
    parameters
        numbers by name that f and output take as further arguments; ``with_parameters`` changes
        them, and compiles nothing.
    operating_point
        state and control signal (x, u) about which designs and ``analyse`` take the plant as
        linear. By default x and u are zero if that is a state of rest.

    Raises
    ------
    ValueError
        if ``f`` does not return n numbers, or ``output`` is neither a row nor a function that
        returns a number.

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
    """

    f: Callable[..., Any]
    order: int
    output: Any = None
    disturbances: int = 1
    substeps: int | None = None
    name: str = "nonlinear plant"
    parameters: Mapping[str, float] | None = None
    operating_point: Any = None

    def __post_init__(self) -> None:
        n = checks.whole("order", self.order, 1)
        m = checks.whole("disturbances", self.disturbances, 0)
        checks.optional(checks.whole, "substeps", self.substeps, 1)
        if not callable(self.f):
            raise ValueError(f"f = {self.f!r}: must be a function f(t, x, u, w)")
        rule = (
            "f takes (t, x, u, w) and the names in parameters, output takes (x), with arrays x and "
            "w of the plant's sizes"
        )
        if self.parameters is not None:
            own, more = self._numbers
            object.__setattr__(self, "parameters", {**own, **more})
        if self.operating_point is not None:
            x, u = checked_point(self.operating_point)
            checks.vector("operating_point[0]", x, n)
            checks.finite("operating_point[1]", u)
        returned = validation.attempt_kernel(
            "f(0.0, zeros, 0.0, zeros)", rule, self._rate, 0.0, np.zeros(n), 0.0, np.zeros(m)
        )
        if returned is not validation.UNKNOWN and np.shape(returned) != (n,):
            raise ValueError(
                f"f returns shape {np.shape(returned)}: must return the {n} derivatives of x"
            )
        if not callable(self.output):
            checks.vector("output", self._row, n)
        elif np.shape(
            validation.attempt_kernel("output(zeros)", rule, self._measured, np.zeros(n))
        ):
            raise ValueError("output(x) must return one number")

    def with_parameters(self, **values: float) -> NonlinearPlant:
        """Return the plant with other numbers for some parameters; nothing is compiled again."""
        made = replace(self, parameters={**(self.parameters or {}), **values})
        signals = signals_of(self)
        return labelled(made, *signals[:3]) if signals.known else made

    @property
    def _numbers(self) -> tuple[dict[str, float], dict[str, float]]:
        """The numbers that f and the output take, in their order."""
        if self.parameters is None:
            return {}, {}
        return equations.checked_parameters(self.parameters, self.f, self.output)

    @cached_property
    def _rate(self) -> Callable[..., Any]:
        """The function f(t, x, u, w), with the parameters in it."""
        return equations.bound(self.f, self._numbers[0])

    @cached_property
    def _measured(self) -> Callable[..., Any]:
        """The function h(x), with the parameters in it."""
        return equations.bound(self._output_function, self._numbers[1])

    @property
    def _row(self) -> Any:
        return np.eye(self.order)[0] if self.output is None else self.output

    @cached_property
    def _output_function(self) -> Callable[..., Any]:
        if callable(self.output):
            return self.output
        return equations.row_output(tuple(np.asarray(self._row, dtype=float).tolist()))

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
            if self.parameters is not None:
                own, more = self._numbers
                both, counts = (self.f, self._output_function), (len(own), len(more))
                return equations.machine_code(*both, (n, m), counts)
            f = function_pointers.jit_user_function(self.f)
            h = function_pointers.jit_user_function(self._output_function)
            compile_cfunc = function_pointers.compile_cfunc
            return compile_cfunc(_RATE_SIGNATURE, rate), compile_cfunc(_OUTPUT_SIGNATURE, output)
        except function_pointers.NotCompilableError as error:
            warn(
                f"{self.name}: f or output can't be compiled and runs as Python, which is slow "
                f"({error})",
                UserWarning,
            )
            return None

    @property
    def compiled(self) -> bool:
        """Whether Numba could compile the functions."""
        return self._machine_code is not None

    def sampled(self, dt: float, interpret: bool = False) -> Any:
        """Return the parameters for a sample time ``dt`` [s]; see ``Plant.sampled``."""
        checks.positive("dt", dt, "s")
        substeps = self._chosen_substeps(dt) if self.substeps is None else self.substeps
        step = dt / substeps
        if interpret or self._machine_code is None:
            return PythonNonlinear(self._rate, self._measured, step, substeps)
        rate, output = self._machine_code
        set_origin = function_pointers.set_origin
        if self.parameters is None:
            set_origin(rate.address, self.f)
            set_origin(output.address, self._output_function)
            return CompiledNonlinear(rate.address, output.address, step, substeps)
        own, more = (len(each) for each in self._numbers)
        set_origin(rate.address, self.f, numbers=(0, own))
        set_origin(output.address, self._output_function, numbers=(own, more))
        numbers = equations.as_array(*self._numbers)
        return CompiledParametric(rate.address, output.address, step, substeps, numbers)

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
                ends = [value_or_nan(self._rate, 0.0, x, 0.0, w) for x in (shift, -shift)]
                slopes[:, j] = (np.asarray(ends[0]) - np.asarray(ends[1])) / (2.0 * by)
        return slopes


def checked_point(given: Any) -> tuple[Any, float]:
    """Return the state and the control signal of an operating point."""
    try:
        x, u = given
    except (TypeError, ValueError):
        raise ValueError(
            f"operating_point = {given!r}: must be a state and a control signal, (x, u)"
        ) from None
    return x, u
