"""The interface of controllers of several signals, as ``controllers.base`` has it for one."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell.controllers.base import control, set_applied_control
from quell.controllers.stateful import PackedController, unpacked
from quell.kernels import dispatch
from quell.kernels.dispatch import (
    compiled_call,
    dispatcher_for,
    explain_compile_errors,
    generic,
    generic_with_default,
)
from quell.types import Vector


@generic_with_default
def control_all(controller: Any, state: Any, r: Vector, y: Vector, u: Vector) -> None:
    """Take one sample: write the control signals ``u`` (m,) for references and measurements.

    A controller of one of each has ``control`` instead.
    """
    u[0] = control(controller, state, r[0], y[0])


@generic_with_default
def set_applied_controls(controller: Any, state: Any, u: Vector) -> None:
    """Replace the control signals of the last sample by the applied ``u`` (m,)."""
    set_applied_control(controller, state, u[0])


@generic_with_default
def motion_by(controller: Any, state: Any, b0: Vector, u: Vector, v: Vector) -> None:
    """Write v (n,), what control signals ``u`` (m,) do to each axis: by default ``b0 u``."""
    v[0] = b0[0] * u[0]


@generic_with_default
def write_applied(controller: Any, state: Any, u: Vector, row: Vector) -> None:
    """Correct what ``write_row`` has written for the control signals ``u`` (m,) that are applied.

    By default no channel has them.
    """


def inputs_of(controller: Any) -> int:
    """Return the number of control signals of a controller."""
    return int(getattr(controller, "inputs", 1))


def outputs_of(controller: Any) -> int:
    """Return the number of measurements of a controller."""
    return int(getattr(controller, "outputs", 1))


def references_of(controller: Any) -> int:
    """Return the number of references of a controller."""
    return int(getattr(controller, "references", outputs_of(controller)))


def axes_of(controller: Any) -> dict[str, Any]:
    """Return the controllers of the axes by their names; of one axis the controller, as ``""``."""
    if not hasattr(controller, "inputs"):
        return {"": controller}
    return dict(zip(controller.names, controller.axes, strict=True))


@generic
def start_all(controller: Any, state: Any, samples: Any, y: Vector, u: Vector, r: Vector) -> None:
    """Start at a machine that rests at y under u: the next sample continues from there.

    r are the references of the next sample. What was learned is kept. The observer of each axis
    takes as many ``samples`` (n,) as it needs to settle.
    """
    raise TypeError


@generic
def tell_applied(controller: Any, state: Any) -> None:
    """Tell observers that the control signals in the state were applied."""
    raise TypeError


@compiled_call
def step_all(packed: Any) -> None:
    """Take one sample with the references and measurements that are in the state."""
    design, state = unpacked(packed)
    control_all(design, state, state.r_given, state.y_given, state.u)


def _step_as_python(packed: Any) -> None:
    design, state = packed.arrays
    with np.errstate(all="ignore"):  # compiled code does not warn
        control_all(design, state, state.r_given, state.y_given, state.u)


def prepared_step(design: Any, state: Any) -> tuple[PackedController, Any]:
    """Return a packed controller of several signals, and the compiled function that steps it."""
    packed = PackedController(design, state)
    if dispatch.interpret_all:
        return packed, _step_as_python
    with explain_compile_errors(design):
        return packed, dispatcher_for(step_all, design).compile((packed.type,))


def take_signals(state: Any, r: Any, y: Any) -> None:
    """Write references and measurements of a call from Python into the state.

    Raises ``TypeError`` or ``ValueError`` unless there is a number for each: NumPy would give one
    number to all.
    """
    if len(r) != state.r_given.size or len(y) != state.y_given.size:
        raise ValueError
    state.r_given[:], state.y_given[:] = r, y
