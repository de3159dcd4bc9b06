"""A compiled control step in an interpreted loop, for devices that need Python."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from quell.kernels.dispatch import compiled, dispatcher_for
from quell.kernels.user_types import explain_compile_errors
from quell.realtime.loop.cycle import CycleLog, control_step
from quell.realtime.loop.reference import ReferenceSamples
from quell.realtime.loop.supervisor import Rules, SupervisorState


class CompiledController(NamedTuple):
    """Parameters of a controller, and the compiled control step on them."""

    design: Any
    step: Callable[..., float]


@compiled
def _step(
    design: Any,
    state: Any,
    rules: Rules,
    supervisor: SupervisorState,
    reference: ReferenceSamples,
    log: CycleLog,
    k: int,
    left_out: int,
    y: float,
) -> float:
    return control_step(design, state, rules, supervisor, reference, log, k, left_out, y)


def compile_controller(
    design: Any,
    state: Any,
    rules: Rules,
    supervisor: SupervisorState,
    reference: ReferenceSamples,
    log: CycleLog,
) -> CompiledController:
    """Return a controller with a compiled step; it is compiled, or loaded, by one sample."""
    controller = CompiledController(design, dispatcher_for(_step, design))
    with explain_compile_errors(design):
        control_step(controller, state, rules, supervisor, reference, log, 0, 0, 0.0)
    return controller


@control_step.register(CompiledController)
def _call_step(controller: CompiledController, *arguments: Any) -> float:
    return float(controller.step(controller.design, *arguments))
