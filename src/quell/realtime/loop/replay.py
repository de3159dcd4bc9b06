"""A recorded run through another observer or learner: what it would have known, and what it would have done.

The controller sees the recorded reference and measurements, sample by sample, and is told that the recorded u was applied, whatever it
wished. So its observer and its learner run on what really happened; what it would have applied is recorded as ``u_wished``. (Its u never
acts: whether *the loop* would have been a better one is for ``simulate`` to say.)
"""

from __future__ import annotations

import copy
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
from quell.kernels.dispatch import compiled, dispatcher_for
from quell.kernels.user_types import explain_compile_errors
from quell.realtime.loop.modes import Mode
from quell.records.trajectory import Trajectory
from quell.types import Matrix, Status, Vector

_TOLD = (("r", 1), ("y", 1), ("y_measured", 1), ("u", 1), ("u_wished", 1))
_NO_DERIVATIVES = np.zeros(0)


def replay(run: Trajectory, controller: Controller, *, u_before: float | None = None) -> Trajectory:
    """Let a controller follow a recorded run.

    It starts with nothing learned, on a state of its own, as in ``simulate``. Through the controller that made the run, its estimates come
    out again, to rounding. Deadlines that were skipped are samples without measurement, as they were to the controller on the rig, which
    was told of ``Safety.hold`` of them at once, no more: where it skipped more the run ended, and its last estimates differ. Derivatives
    of the reference are not recorded: a controller with feedforward is given none, which shows in ``u_wished`` alone.

    Parameters
    ----------
    run
        every sample of it: recorded on a rig (``load``, or ``RigRun.record``), or from ``simulate`` with ``record_every=1``.
    controller
        any controller of the run's sample time.
    u_before
        control signal under which the plant rested before the first sample [u-unit], where an ADRC is to know: it then starts as by
        ``controller.start(y, u_before)``, else as by its first sample.

    Returns
    -------
    Trajectory
        ``r``, ``y``, ``y_measured`` and ``u`` of the run, ``u_wished``, and what the controller reports.

    Raises
    ------
    ValueError
        for what is no Trajectory, a run that lacks r, y, y_measured or u or does not have all samples, one without a single measurement,
        another sample time, and ``u_before`` for a controller that is no ADRC.
    """
    check_controller(controller)
    if not isinstance(run, Trajectory):
        raise ValueError(
            f"run = {run!r}: must be a Trajectory, for example quell.realtime.load('run.mcap')"
        )
    r, y, measured, u = (np.ascontiguousarray(run[name]) for name in ("r", "y", "y_measured", "u"))
    if run.every != 1:
        raise ValueError(
            f"run has every {run.every}th sample: a replay needs all of them; record with record_every=1"
        )
    if run.dt != controller.dt:
        raise ValueError(
            f"controller has dt = {controller.dt!r} s: must have that of the run, {run.dt!r} s"
        )
    if not np.all(np.isfinite(u)):
        raise ValueError(
            f"run has no finite u at {run.t[np.argmin(np.isfinite(u))]:.6g} s: what was applied must be known"
        )
    good = np.flatnonzero(np.isfinite(measured))
    if good.size == 0:
        raise ValueError("run has no finite y_measured: there is nothing to observe")
    design, state = controller.parameters, controller.initial_state()
    if u_before is not None:
        first = good[0]
        design, state = _started(
            controller, measured[first], checks.finite("u_before", u_before), r[first]
        )
    channels = (*_TOLD, *controller.channels)
    log = np.empty((len(run), sum(width for _, width in channels)))
    began = int(np.argmax(run["mode"] == Mode.RUN)) if "mode" in run.names else 0
    with np.errstate(over="ignore", invalid="ignore"), explain_compile_errors(design):
        status = dispatcher_for(_follow, design)(
            design, state, _NO_DERIVATIVES, r, y, measured, u, began, log
        )
    return Trajectory(
        log=log,
        channels=channels,
        dt=run.dt,
        status=Status(int(status)),
        ended=(len(run) - 1) * run.dt,
        plant=run.plant,
        features=controller.features,
        final_state=state,
    )


def _started(controller: Any, y: float, u: float, r: float) -> tuple[Any, Any]:
    """Return parameters and state of a controller, nothing learned, that starts where the plant rests at ``y`` under ``u``."""
    if not hasattr(controller, "start"):
        raise ValueError(
            f"u_before = {u!r}: only an ADRC starts under load; leave it out for a {type(controller).__name__}"
        )
    follower = copy.copy(controller)
    follower.reset()
    follower.start(float(y), u, float(r) if np.isfinite(r) else None)
    return follower.parameters, follower._state


@compiled
def _follow(
    design: Any,
    state: Any,
    derivatives: Vector,
    r: Vector,
    y: Vector,
    measured: Vector,
    u: Vector,
    began: int,
    log: Matrix,
) -> int:
    """Take all samples as the loop does, log them, and return all status flags seen; from ``began`` on the controller had its say."""
    status = 0
    for k in range(r.size):
        if k == began and k > 0:
            bumpless_transfer(design, state)
        set_reference_derivatives(design, state, derivatives)
        wished = control(design, state, r[k], measured[k])
        status |= status_flags(design, state)
        log[k, 0] = r[k]
        log[k, 1] = y[k]
        log[k, 2] = measured[k]
        log[k, 3] = u[k]
        log[k, 4] = wished
        write_row(design, state, log[k, 5:])
        if u[k] != wished:
            set_applied_control(design, state, u[k])
    return status
