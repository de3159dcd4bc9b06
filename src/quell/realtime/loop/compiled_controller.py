"""A compiled controller for a loop that is Python: where the device is, the controller need not be.

The loop's functions on a controller, called on ``BoundControl``, call the compiled ones on what is in it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from quell.controllers import base
from quell.kernels.dispatch import compiled, dispatcher_for
from quell.kernels.user_types import explain_compile_errors
from quell.types import Vector


class BoundControl(NamedTuple):
    """Parameters of a controller that is to be stepped compiled, from Python; ``bound`` makes it."""

    design: Any
    control: Any
    set_reference_derivatives: Any
    set_applied_control: Any
    bumpless_transfer: Any
    write_row: Any


@compiled
def _control(design: Any, state: Any, r: float, y: float) -> float:
    return base.control(design, state, r, y)


@compiled
def _set_reference_derivatives(design: Any, state: Any, derivatives: Vector) -> None:
    base.set_reference_derivatives(design, state, derivatives)


@compiled
def _set_applied_control(design: Any, state: Any, u: float) -> None:
    base.set_applied_control(design, state, u)


@compiled
def _bumpless_transfer(design: Any, state: Any) -> None:
    base.bumpless_transfer(design, state)


@compiled
def _write_row(design: Any, state: Any, row: Vector) -> None:
    base.write_row(design, state, row)


def bound(design: Any) -> BoundControl:
    """Return a controller's parameters with its compiled functions."""
    return BoundControl(
        design,
        *(
            dispatcher_for(entry, design)
            for entry in (
                _control,
                _set_reference_derivatives,
                _set_applied_control,
                _bumpless_transfer,
                _write_row,
            )
        ),
    )


def warm(controller: BoundControl, state: Any, derivatives: Vector, row: Vector) -> None:
    """Compile everything, or load it, by a sample on a ``state`` that is for nothing else."""
    with explain_compile_errors(controller.design):
        base.control(controller, state, 0.0, 0.0)
        base.set_reference_derivatives(controller, state, derivatives)
        base.set_applied_control(controller, state, 0.0)
        base.bumpless_transfer(controller, state)
        base.write_row(controller, state, row)


@base.control.register(BoundControl)
def _bound_control(controller: BoundControl, state: Any, r: float, y: float) -> float:
    return float(controller.control(controller.design, state, float(r), float(y)))


@base.set_reference_derivatives.register(BoundControl)
def _bound_heed(controller: BoundControl, state: Any, derivatives: Vector) -> None:
    controller.set_reference_derivatives(controller.design, state, derivatives)


@base.set_applied_control.register(BoundControl)
def _bound_set_applied_control(controller: BoundControl, state: Any, u: float) -> None:
    controller.set_applied_control(controller.design, state, float(u))


@base.bumpless_transfer.register(BoundControl)
def _bound_bumpless_transfer(controller: BoundControl, state: Any) -> None:
    controller.bumpless_transfer(controller.design, state)


@base.write_row.register(BoundControl)
def _bound_write_row(controller: BoundControl, state: Any, row: Vector) -> None:
    controller.write_row(controller.design, state, row)
