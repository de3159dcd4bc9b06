"""Replay of a recorded run through another controller: its estimates and the u it wishes.

The controller gets the recorded reference and measurements, sample by sample, and the recorded u as
the applied one. So its observer and its learner run on what really happened. Its own u is recorded
as ``u_wished`` but never acts: how *the loop* would have behaved is a question for ``simulate``.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.base import (
    Controller,
    bumpless_transfer,
    check_controller,
    control,
    set_applied_control,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.kernels.dispatch import call_specialised, compiled
from quell.kernels.user_types import explain_compile_errors
from quell.realtime.loop.modes import Mode
from quell.records.channels import signals_of_loop
from quell.records.trajectory import Trajectory
from quell.types import Matrix, Status, Vector

_RECORDED = ("r", "y", "y_measured", "u")
_NO_DERIVATIVES = np.zeros(0)


def replay(run: Trajectory, controller: Controller, *, u_before: float | None = None) -> Trajectory:
    """Let a controller follow a recorded run.

    It starts with nothing learned, on a state of its own, as in ``simulate``. The controller that
    made the run gives the recorded estimates again, to rounding. Skipped deadlines are samples
    without measurement, as they were on the rig, whose loop passes on ``Safety.hold`` of them at
    once at most: if it skipped more, the run ended, and its last estimates differ. Derivatives of
    the reference are not recorded: a controller with feedforward gets none, which changes
    ``u_wished`` only.

    Parameters
    ----------
    run
        a run with all its samples: recorded on a rig (``load``, or ``RigRun.record``), or from
        ``simulate`` with ``record_every=1``.
    controller
        any controller with the run's sample time.
    u_before
        control signal under which the plant rested before the first sample [u-unit]. The controller
        then starts as by ``controller.start(y, u_before)``; by default as by its first sample.

    Returns
    -------
    Trajectory
        ``r``, ``y``, ``y_measured``, ``u`` of the run; ``u_wished``; the controller's channels.

    Raises
    ------
    ValueError
        for a run without r, y, y_measured or u, with samples left out, without measurements, or
        with another sample time; for ``u_before`` with a controller that can't start under load.
    """
    check_controller(controller)
    if not isinstance(run, Trajectory):
        raise ValueError(
            f"run = {run!r}: must be a Trajectory, for example quell.realtime.load('run.mcap')"
        )
    recorded = np.column_stack([run[name] for name in _RECORDED])
    u = recorded[:, 3]
    if run.every != 1:
        raise ValueError(
            f"run has every {run.every}th sample: a replay needs all; record with record_every=1"
        )
    if run.dt != controller.dt:
        raise ValueError(
            f"controller has dt = {controller.dt!r} s: must have that of the run, {run.dt!r} s"
        )
    if not np.all(np.isfinite(u)):
        time = run.t[np.argmin(np.isfinite(u))]
        raise ValueError(f"run has no finite u at {time:.6g} s: the applied u must be known")
    measured = np.flatnonzero(np.isfinite(recorded[:, 2]))
    if measured.size == 0:
        raise ValueError("run has no finite y_measured: there is nothing to observe")
    design, state = controller.parameters, controller.initial_state()
    if u_before is not None:
        r, _, y, _ = recorded[measured[0]].tolist()
        design, state = _started(controller, y, checks.finite("u_before", u_before), r)
    channels = (*((name, 1) for name in _RECORDED), ("u_wished", 1), *controller.channels)
    log = np.empty((len(run), sum(width for _, width in channels)))
    log[:, : len(_RECORDED)] = recorded
    began = int(np.argmax(run["mode"] == Mode.RUN)) if "mode" in run.names else 0
    with np.errstate(over="ignore", invalid="ignore"), explain_compile_errors(design):
        status = call_specialised(_follow, design, state, _NO_DERIVATIVES, began, log)
    return Trajectory(
        log=log,
        channels=channels,
        dt=run.dt,
        status=Status(int(status)),
        ended=(len(run) - 1) * run.dt,
        plant=run.plant,
        features=controller.features,
        signals=signals_of_loop(run.signals, controller),
        u_limits=run.u_limits,
        final_state=state,
    )


def _started(controller: Any, y: float, u: float, r: float) -> tuple[Any, Any]:
    """Return parameters and initial state for a plant that rests at ``y`` under ``u``."""
    if not hasattr(controller, "start"):
        kind = type(controller).__name__
        raise ValueError(f"u_before = {u!r}: {kind} has no start under load; leave it out")
    follower = copy.copy(controller)
    follower.reset()
    follower.start(y, u, r if math.isfinite(r) else None)
    return follower.parameters, follower._state


@compiled
def _follow(design: Any, state: Any, derivatives: Vector, began: int, log: Matrix) -> int:
    """Run the controller on the first columns of ``log``, write the others; return status flags.

    From sample ``began`` on the controller was in control.
    """
    status = 0
    for k in range(log.shape[0]):
        if k == began and k > 0:
            bumpless_transfer(design, state)
        set_reference_derivatives(design, state, derivatives)
        wished = control(design, state, log[k, 0], log[k, 2])
        status |= status_flags(design, state)
        log[k, 4] = wished
        write_row(design, state, log[k, 5:])
        if log[k, 3] != wished:
            set_applied_control(design, state, log[k, 3])
    return status
