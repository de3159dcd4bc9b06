"""A control loop: device, controller, supervisor and reference, compiled before the first cycle."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.controllers.base import Controller
from quell.kernels.dispatch import dispatcher_for, interpreted
from quell.kernels.user_types import explain_compile_errors
from quell.realtime.devices.base import Device, PythonHandle, handle_of
from quell.realtime.loop.compiled_controller import compile_controller
from quell.realtime.loop.cycle import CycleLog, CycleTimes, cycle_times, run_cycles
from quell.realtime.loop.modes import Mode
from quell.realtime.loop.reference import ReferenceSamples
from quell.realtime.loop.supervisor import FLUSH, Rules, SupervisorState, initial_state
from quell.realtime.system.histogram import Histogram, Timing, empty_counts
from quell.realtime.telemetry.channels import row_channels
from quell.realtime.telemetry.ring import Ring
from quell.records.channels import columns_of


@dataclass(frozen=True, eq=False)
class ControlLoop:
    """Arguments of ``run_cycles``, and the way to call it; ``of`` makes and compiles one."""

    handle: Any
    clock: Any
    design: Any
    state: Any
    rules: Rules
    supervisor: SupervisorState
    reference: ReferenceSamples
    times: CycleTimes
    log: CycleLog
    interpreted: bool
    """Whether the loop runs as plain Python."""

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
        """Return the compiled loop of a device and a controller that has learned nothing yet.

        If the device needs Python, the loop is interpreted and only the controller is compiled;
        ``interpret`` makes both plain Python, to debug.
        """
        handle = handle_of(device)
        needs_python = isinstance(handle, PythonHandle)
        design, state = controller.parameters, controller.initial_state()
        channels = row_channels(controller.channels)
        row = np.zeros(sum(width for _, width in channels))
        known = {name for name, width in channels if width}
        f_learned, f_residual = (
            columns_of(channels, name).start if {"f_learned", "f_residual"} <= known else -1
            for name in ("f_learned", "f_residual")
        )
        loop = cls(
            handle=handle,
            clock=clock,
            design=design,
            state=state,
            rules=rules,
            supervisor=initial_state(),
            reference=reference,
            times=cycle_times(controller.dt, getattr(device, "paced", False)),
            log=CycleLog(ring, row, f_learned, f_residual, empty_counts(), empty_counts()),
            interpreted=interpret or needs_python,
        )
        # Compile by a run that is finished before it begins, or by a step after the end of a run.
        over = copy.deepcopy(loop.supervisor)
        over.memory[0].mode, over.memory[0].samples = Mode.STOPPED, FLUSH + 1
        if needs_python and not interpret:
            spare = controller.initial_state(), rules, over, reference, loop.log
            return replace(loop, design=compile_controller(design, *spare))
        replace(loop, supervisor=over).run()
        return loop

    @property
    def requests(self) -> NDArray[np.int64]:
        """The ``Request`` to the loop (1,), which another thread may write."""
        return self.supervisor.requests

    @property
    def timing(self) -> Timing:
        """Punctuality so far."""
        return Timing(Histogram.of(self.log.lateness), Histogram.of(self.log.step_time))

    def run(self) -> None:
        """Run all cycles."""
        entry = (
            interpreted(run_cycles)
            if self.interpreted
            else dispatcher_for(run_cycles, self.handle, self.clock, self.design)
        )
        arguments = list(vars(self).values())[:-1]  # all fields but ``interpreted``, in order
        with (
            np.errstate(over="ignore", invalid="ignore"),
            explain_compile_errors(self.handle, self.design),
        ):
            entry(*arguments)
