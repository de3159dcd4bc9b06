"""A compiled controller for a loop that is Python: where the device is, the controller need not be.

The loop's functions on a controller, called on ``BoundControl``, call the compiled ones on what is in it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from quell.controllers import base
from quell.kernels.dispatch import compiled, compiling, for_types
from quell.types import Vector


class BoundControl(NamedTuple):
    """Parameters of a controller that is to be stepped compiled, from Python; ``bound`` makes it."""

    design: Any
    control: Any
    set_reference_derivatives: Any
    applied: Any
    take_over: Any
    report: Any


@compiled
def _control(design: Any, state: Any, r: float, y: float) -> float:
    return base.control(design, state, r, y)


@compiled
def _set_reference_derivatives(design: Any, state: Any, derivatives: Vector) -> None:
    base.set_reference_derivatives(design, state, derivatives)


@compiled
def _applied(design: Any, state: Any, u: float) -> None:
    base.applied(design, state, u)


@compiled
def _take_over(design: Any, state: Any) -> None:
    base.take_over(design, state)


@compiled
def _report(design: Any, state: Any, row: Vector) -> None:
    base.report(design, state, row)


def bound(design: Any) -> BoundControl:
    """Return a controller's parameters with its compiled functions."""
    return BoundControl(
        design,
        *(
            for_types(entry, design)
            for entry in (_control, _set_reference_derivatives, _applied, _take_over, _report)
        ),
    )


def warm(controller: BoundControl, state: Any, derivatives: Vector, row: Vector) -> None:
    """Compile everything, or load it, by a sample on a ``state`` that is for nothing else."""
    with compiling(controller.design):
        base.control(controller, state, 0.0, 0.0)
        base.set_reference_derivatives(controller, state, derivatives)
        base.applied(controller, state, 0.0)
        base.take_over(controller, state)
        base.report(controller, state, row)


@base.control.register(BoundControl)
def _bound_control(controller: BoundControl, state: Any, r: float, y: float) -> float:
    return float(controller.control(controller.design, state, float(r), float(y)))


@base.set_reference_derivatives.register(BoundControl)
def _bound_heed(controller: BoundControl, state: Any, derivatives: Vector) -> None:
    controller.set_reference_derivatives(controller.design, state, derivatives)


@base.applied.register(BoundControl)
def _bound_applied(controller: BoundControl, state: Any, u: float) -> None:
    controller.applied(controller.design, state, float(u))


@base.take_over.register(BoundControl)
def _bound_take_over(controller: BoundControl, state: Any) -> None:
    controller.take_over(controller.design, state)


@base.report.register(BoundControl)
def _bound_report(controller: BoundControl, state: Any, row: Vector) -> None:
    controller.report(controller.design, state, row)
