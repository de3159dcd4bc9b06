"""A compiled controller in an interpreted loop, for devices that need Python.

For parameters of type ``CompiledController`` the functions on controllers call the compiled ones.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from quell.controllers import base
from quell.kernels.dispatch import compiled, dispatcher_for
from quell.kernels.user_types import explain_compile_errors
from quell.types import Vector


class CompiledController(NamedTuple):
    """Parameters of a controller, and the compiled functions on them."""

    design: Any
    control: Callable[..., float]
    set_reference_derivatives: Callable[..., None]
    set_applied_control: Callable[..., None]
    bumpless_transfer: Callable[..., None]
    write_row: Callable[..., None]


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


def compile_controller(
    design: Any, state: Any, derivatives: Vector, row: Vector
) -> CompiledController:
    """Return the compiled functions of a controller with the parameters ``design``, ready for use.

    They are compiled, or loaded from disk, by a sample on ``state``, ``derivatives`` and ``row``,
    which are overwritten.
    """
    entries = (
        _control,
        _set_reference_derivatives,
        _set_applied_control,
        _bumpless_transfer,
        _write_row,
    )
    controller = CompiledController(design, *(dispatcher_for(entry, design) for entry in entries))
    with explain_compile_errors(design):
        base.control(controller, state, 0.0, 0.0)
        base.set_reference_derivatives(controller, state, derivatives)
        base.set_applied_control(controller, state, 0.0)
        base.bumpless_transfer(controller, state)
        base.write_row(controller, state, row)
    return controller


@base.control.register(CompiledController)
def _call_control(controller: CompiledController, state: Any, r: float, y: float) -> float:
    return float(controller.control(controller.design, state, float(r), float(y)))


@base.set_reference_derivatives.register(CompiledController)
def _call_derivatives(controller: CompiledController, state: Any, derivatives: Vector) -> None:
    controller.set_reference_derivatives(controller.design, state, derivatives)


@base.set_applied_control.register(CompiledController)
def _call_applied(controller: CompiledController, state: Any, u: float) -> None:
    controller.set_applied_control(controller.design, state, float(u))


@base.bumpless_transfer.register(CompiledController)
def _call_transfer(controller: CompiledController, state: Any) -> None:
    controller.bumpless_transfer(controller.design, state)


@base.write_row.register(CompiledController)
def _call_write_row(controller: CompiledController, state: Any, row: Vector) -> None:
    controller.write_row(controller.design, state, row)
