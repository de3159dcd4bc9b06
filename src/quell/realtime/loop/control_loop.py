"""A control loop: device, controller, supervisor and reference, compiled before the first cycle."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quell.controllers.base import Controller
from quell.kernels.dispatch import interpreted, specialised
from quell.kernels.user_types import explain_compile_errors
from quell.realtime.devices.base import Device, PythonHandle, handle_of
from quell.realtime.loop.compiled_controller import compiled_controller
from quell.realtime.loop.cycle import (
    CycleLog,
    SupervisedController,
    control_step,
    run_cycles,
)
from quell.realtime.loop.modes import Mode
from quell.realtime.loop.reference import ReferenceSamples
from quell.realtime.loop.state import Rules, initial_state
from quell.realtime.loop.supervisor import FLUSH
from quell.realtime.loop.ticks import follow_ticks
from quell.realtime.system.histogram import Histogram, Timing, empty_counts
from quell.realtime.telemetry.channels import row_channels
from quell.realtime.telemetry.ring import Ring
from quell.records.channels import columns_of


@dataclass(frozen=True, eq=False)
class ControlLoop:
    """A supervised controller around a device; ``of`` makes and compiles one.

    If the device needs Python, the loop is interpreted and only its control step is compiled;
    ``interpret`` makes both plain Python, to debug.
    """

    handle: Any
    clock: Any
    period: float  # sample time [ns]
    controller: SupervisedController
    paced: bool  # whether the device's ticks pace the loop, and not the loop's own deadlines
    interpret: bool = False

    @classmethod
    def of(
        cls,
        device: Device,
        controller: Controller,
        reference: ReferenceSamples,
        rules: Rules,
        clock: Any,
        ring: Ring,
        *,
        interpret: bool = False,
    ) -> ControlLoop:
        """Return the compiled loop of a device and a controller that has learned nothing yet."""
        channels = row_channels(controller.channels)
        row = np.zeros(sum(width for _, width in channels))
        known = {name for name, width in channels if width}
        f_learned, f_residual = (
            columns_of(channels, name).start if {"f_learned", "f_residual"} <= known else -1
            for name in ("f_learned", "f_residual")
        )
        supervised = SupervisedController(
            design=controller.parameters,
            state=controller.initial_state(),
            rules=rules,
            supervisor=initial_state(),
            reference=reference,
            log=CycleLog(ring, row, f_learned, f_residual, empty_counts(), empty_counts()),
        )
        handle = handle_of(device)
        paced = getattr(device, "paced", False) and not isinstance(handle, PythonHandle)
        loop = cls(handle, clock, controller.dt * 1e9, supervised, paced, interpret)
        loop._compile()
        return loop

    @property
    def interpreted(self) -> bool:
        """Whether the loop runs as plain Python."""
        return self.interpret or isinstance(self.handle, PythonHandle)

    @property
    def timing(self) -> Timing:
        """Punctuality so far."""
        log = self.controller.log
        return Timing(Histogram.of(log.lateness), Histogram.of(log.step_time))

    def run(self) -> None:
        """Run all cycles."""
        controller: Any = self.controller
        entry: Any = follow_ticks if self.paced else run_cycles
        if self.interpreted:
            entry = interpreted(entry)
            controller = controller if self.interpret else compiled_controller(controller)
        else:
            entry = specialised(entry, self.handle, self.clock, self.period, controller)
        with np.errstate(over="ignore", invalid="ignore"):
            entry(self.handle, self.clock, self.period, controller)

    def _compile(self) -> None:
        """Compile by a run that is finished before it begins, or by a step after its end."""
        finished = copy.deepcopy(self.controller.supervisor)
        finished.memory[0].mode, finished.memory[0].samples = Mode.STOPPED, FLUSH + 1
        state = copy.deepcopy(self.controller.state)
        over = self.controller._replace(supervisor=finished, state=state)
        with explain_compile_errors(self.handle, self.controller.design):
            replace(self, controller=over).run()
            if self.interpreted and not self.interpret:
                control_step(compiled_controller(over), 0, 0, 0.0)
