"""A recorded run through another observer or learner: what it would have known, and what it would have done.

The controller sees the recorded reference and measurements, sample by sample, and is told of the recorded u as the one that was applied, as
in manual operation (``ADRC.track``). So its observer and its learner run on what really happened, and what it would have applied is
recorded as ``u_wished``. (Its u never acts: whether *the loop* would have been a better one is for ``simulate`` to say.)
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.adrc import ADRC
from quell.controllers.base import control, flags, heed, report
from quell.controllers.law import MANUAL, MANUAL_U, WISHED
from quell.controllers.prefilter import Prefiltered
from quell.dispatch import compiled, compiling, for_types
from quell.trajectory import Trajectory
from quell.types import Matrix, Status, Vector

_TOLD = (("r", 1), ("y", 1), ("y_measured", 1), ("u", 1), ("u_wished", 1))
_NO_DERIVATIVES = np.zeros(0)


def replay(run: Trajectory, controller: ADRC | Prefiltered, *, u_before: float | None = None) -> Trajectory:
    """Let a controller follow a recorded run.

    It starts with nothing learned, on a state of its own, as in ``simulate``. Derivatives of the reference are not recorded: a controller
    with feedforward is given none, which shows in ``u_wished`` alone. Through the controller that made the run, its estimates come out
    again, to rounding.

    Parameters
    ----------
    run
        every sample of it: recorded on a rig (``load``), or from ``simulate`` with ``record_every=1``.
    controller
        an ``ADRC``, alone or behind a prefilter, of the run's sample time.
    u_before
        control signal under which the plant rested before the first sample [u-unit], where the controller is to know: it then starts as by
        ``controller.start(y, u_before)``, else as by its first sample.

    Returns
    -------
    Trajectory
        ``r``, ``y``, ``y_measured`` and ``u`` of the run, ``u_wished``, and what the controller reports.

    Raises
    ------
    ValueError
        for a run that lacks r, y, y_measured or u or does not have all samples, one without a single measurement, another sample time,
        and a controller that is no ADRC.
    """
    follower = _fresh(controller)
    r, y, measured, u = (np.ascontiguousarray(run[name]) for name in ("r", "y", "y_measured", "u"))
    if run.every != 1:
        raise ValueError(f"run has every {run.every}th sample: a replay needs all of them; record with record_every=1")
    if run.dt != controller.dt:
        raise ValueError(f"controller has dt = {controller.dt!r} s: must have that of the run, {run.dt!r} s")
    if not np.all(np.isfinite(u)):
        raise ValueError(f"run has no finite u at {run.t[np.argmin(np.isfinite(u))]:.6g} s: what was applied must be known")
    good = np.flatnonzero(np.isfinite(measured))
    if good.size == 0:
        raise ValueError("run has no finite y_measured: there is nothing to observe")
    if u_before is not None:
        first = good[0]
        follower.start(float(measured[first]), checks.finite("u_before", u_before), float(r[first]) if np.isfinite(r[first]) else None)
    channels = (*_TOLD, *follower.channels)
    log = np.empty((len(run), sum(width for _, width in channels)))
    design, state = follower.parameters, follower._state
    with np.errstate(over="ignore", invalid="ignore"), compiling(design):
        status = for_types(_follow, design)(design, state, follower._law._state.loop, _NO_DERIVATIVES, r, y, measured, u, log)
    return Trajectory(
        log=log,
        channels=channels,
        dt=run.dt,
        status=Status(int(status)),
        ended=(len(run) - 1) * run.dt,
        plant=run.plant,
        features=follower.features,
        final_state=state,
    )


def _fresh(controller: Any) -> Any:
    """Return a copy of a controller, in the state before the first sample."""
    try:
        controller._law  # noqa: B018  # one that is no ADRC at heart says so here
    except AttributeError:
        raise ValueError(f"controller = {controller!r}: must be an ADRC, alone or behind a prefilter: others can't be told of u") from None
    follower = copy.copy(controller)
    follower.reset()
    return follower


@compiled
def _follow(
    design: Any, state: Any, loop: Vector, derivatives: Vector, r: Vector, y: Vector, measured: Vector, u: Vector, log: Matrix
) -> int:
    """Take all samples in manual operation and log them; ``loop`` is the ADRC's share of ``state``. Return all status flags seen."""
    status = 0
    loop[MANUAL] = 1.0
    for k in range(r.size):
        loop[MANUAL_U] = u[k]
        heed(design, state, derivatives)
        control(design, state, r[k], measured[k])
        status |= flags(design, state)
        log[k, 0] = r[k]
        log[k, 1] = y[k]
        log[k, 2] = measured[k]
        log[k, 3] = u[k]
        log[k, 4] = loop[WISHED]
        report(design, state, log[k, 5:])
    loop[MANUAL] = 0.0
    return status
