"""The equation of a nonlinear plant in a sample: Runge-Kutta over the user's function."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from quell.kernels.dispatch import generic
from quell.kernels.function_pointers import call, evaluate
from quell.plants.base import advance, measure
from quell.types import Vector


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


@generic
def derivatives(plant: Any, t: float, x: Vector, u: float, w: Vector, dx: Vector) -> None:
    """Write the derivatives of the state into ``dx`` (n,)."""
    raise TypeError


@advance.register(CompiledNonlinear)
@advance.register(CompiledParametric)
@advance.register(PythonNonlinear)
def runge_kutta(plant: Any, x: Vector, scratch: Vector, t: float, u: float, w: Vector) -> None:
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
def _derivatives_parametric(
    plant: CompiledParametric, t: float, x: Vector, u: float, w: Vector, dx: Vector
) -> None:
    call(plant.rate, t, x, u, w, plant.parameters, dx)


@measure.register(PythonNonlinear)
def _measure_python(plant: PythonNonlinear, x: Vector) -> float:
    return float(value_or_nan(plant.output, x))


@derivatives.register(PythonNonlinear)
def _derivatives_python(
    plant: PythonNonlinear, t: float, x: Vector, u: float, w: Vector, dx: Vector
) -> None:
    dx[:] = value_or_nan(plant.rate, t, x, u, w)


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
