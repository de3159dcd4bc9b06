"""A compiled control step in an interpreted loop, for devices that need Python."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from quell.kernels.dispatch import compiled, specialised
from quell.realtime.loop.cycle import CycleLog, SupervisedController, control_step
from quell.realtime.loop.state import SupervisorState


class CompiledController(NamedTuple):
    """A supervised controller for ``run_cycles``, with its compiled control step."""

    supervisor: SupervisorState
    log: CycleLog
    controller: SupervisedController
    step: Callable[[SupervisedController, int, int, float], float]


@compiled
def _step(controller: SupervisedController, k: int, left_out: int, y: float) -> float:
    return control_step(controller, k, left_out, y)


@control_step.register(CompiledController)
def _call_step(controller: CompiledController, k: int, left_out: int, y: float) -> float:
    return float(controller.step(controller.controller, k, left_out, y))


def compiled_controller(controller: SupervisedController) -> CompiledController:
    """Return the controller with its compiled control step."""
    step = specialised(_step, controller, 0, 0, 0.0)
    return CompiledController(controller.supervisor, controller.log, controller, step)
