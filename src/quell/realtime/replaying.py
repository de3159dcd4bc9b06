"""Replay of a recorded run through another controller: its estimates and the u it wishes.

The controller gets the recorded reference and measurements, sample by sample, and the recorded u as
the applied one. So its observer and its learner run on what really happened. Its own u is recorded
as ``u_wished`` but never acts: how *the loop* would have behaved is a question for ``simulate``.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.axes import Axes
from quell.controllers.base import bumpless_transfer, check_controller, status_flags, write_row
from quell.controllers.several import control_all, inputs_of, set_applied_controls, write_applied
from quell.kernels.dispatch import call_specialised, compiled, explain_compile_errors, kernel
from quell.realtime.channels import ChannelInputs, channel_inputs, checked_channels, pass_channels
from quell.realtime.devices import SignalCounts, counts_text
from quell.realtime.recordings import check_one, in_column
from quell.realtime.safety import check_takes_reference, default_hold
from quell.realtime.supervisor import Mode
from quell.records.record import signals_of_loop
from quell.records.trajectory import Trajectory
from quell.types import Matrix, Status, Vector

_RECORDED = ("r", "y", "y_measured", "u")
_NO_DERIVATIVES = np.zeros(0)


def replay(run: Any, controller: Any, *, u_before: Any = None, channels: Sequence[str] = ()) -> Any:
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
        any controller with the run's sample time; ``quell.Axes`` for a run of several axes.
    u_before
        control signal under which the plant rested before the first sample [u-unit]; of several
        axes one for each actuator. The controller
        then starts as by ``controller.start(y, u_before)``; by default as by its first sample.
    channels
        names of the device's channels in the run, as for ``run_rig``; a missing ``held`` keeps its
        state as long as by the default of ``Safety.hold_time``.

    Returns
    -------
    Trajectory
        ``r``, ``y``, ``y_measured``, ``u`` of the run; ``u_wished``; the controller's channels.

    Raises
    ------
    ValueError
        for a controller that takes u_0 in the place of a reference; for a run without r, y,
        y_measured or u, with samples left out, without measurements, with another sample time or
        other numbers of signals, with axes of other names or in another order; for ``u_before``
        with a controller that can't start under load; for a schedule without its signals, and
        channels that the run does not have.
    """
    axes = controller if isinstance(controller, Axes) else None
    check_controller(controller, several=axes is not None)
    check_takes_reference(controller)
    if not isinstance(run, Trajectory):
        raise ValueError(
            f"run = {run!r}: must be a Trajectory, for example quell.realtime.load('run.mcap')"
        )
    recording: Any = run
    _check_axes_of(run, axes)
    parts = [run[name].reshape(len(run), -1) for name in _RECORDED]
    recorded, places = np.column_stack(parts), np.cumsum([0, *(p.shape[1] for p in parts)])
    u = parts[3]
    if run.every != 1:
        raise ValueError(
            f"run has every {run.every}th sample: a replay needs all; record with record_every=1"
        )
    if run.dt != controller.dt:
        raise ValueError(
            f"controller has dt = {controller.dt!r} s: must have that of the run, {run.dt!r} s"
        )
    if not np.all(np.isfinite(u)):
        time = run.t[np.argmin(np.isfinite(u).all(axis=1))]
        raise ValueError(f"run has no finite u at {time:.6g} s: the applied u must be known")
    measured = np.flatnonzero(np.isfinite(parts[2]).all(axis=1))
    if measured.size == 0:
        raise ValueError("run has no finite y_measured: there is nothing to observe")
    names = checked_channels(controller, channels)
    absent = [name for name in names if name not in run.names]
    if absent:
        raise ValueError(f"channels: the run has no {', '.join(absent)}; it has {run.names}")
    given = np.zeros((len(run), len(names)))
    for i, name in enumerate(names):
        given[:, i] = run[name]
    inputs = channel_inputs(controller, names)
    hold = default_hold(controller.dt)
    design, state = controller.parameters, controller.initial_state()
    if u_before is not None:
        first = [part[measured[0]] for part in parts]
        if axes is None:
            given_u: Any = checks.finite("u_before", u_before)
            design, state = _started(controller, float(first[2][0]), given_u, float(first[0][0]))
        else:
            given_u = checks.vector("u_before", u_before, axes.inputs)
            design, state = _started(controller, first[2], given_u, first[0])
    widths = [part.shape[1] for part in parts]
    columns = (*zip(_RECORDED, widths, strict=True), ("u_wished", widths[3]), *controller.channels)
    log = np.empty((len(run), sum(width for _, width in columns)))
    log[:, : recorded.shape[1]] = recorded
    began = int(np.argmax(run["mode"] == Mode.RUN)) if "mode" in run.names else 0
    with np.errstate(over="ignore", invalid="ignore"), explain_compile_errors(design):
        wished = np.zeros(inputs_of(controller))
        status = call_specialised(
            _follow, design, state, places, began, log, wished, inputs, given, hold
        )
    common: dict[str, Any] = {
        "log": log,
        "channels": columns,
        "dt": run.dt,
        "status": Status(int(status)),
        "ended": (len(run) - 1) * run.dt,
        "plant": run.plant,
        "features": controller.features,
        "final_state": state,
    }
    if axes is None:
        signals = signals_of_loop(run.signals, controller)
        limits = {"signals": signals, "u_limits": recording.u_limits}
        return Trajectory(**(common | limits))
    features = tuple(axis.features for axis in axes.axes)
    named = {"axis_names": axes.names, "axis_features": features, "signals": run.signals}
    return Trajectory(**(common | named))


def _check_axes_of(run: Any, axes: Axes | None) -> None:
    """Raise a ``ValueError`` unless a run has as many signals as the controller."""
    if axes is None and run.axis_names:
        check_one(run, "run")
    outputs, inputs = (1, 1) if axes is None else (axes.outputs, axes.inputs)
    found = {name: run[name].reshape(len(run), -1).shape[1] for name in _RECORDED}
    if (found["y"], found["u"]) != (outputs, inputs):
        theirs, ours = SignalCounts(found["y"], found["u"]), SignalCounts(outputs, inputs)
        raise ValueError(
            f"run has {counts_text(theirs)}, the controller {counts_text(ours)}: must be as many; "
            "take the setup with which it was recorded, or one with as many [[axis]]"
        )
    if axes is not None:
        check_same_names("axes", run.axis_names, axes.names)
    for name in ("r", "y_measured"):
        if found[name] != outputs:
            raise ValueError(
                f"run has {found[name]} columns of {name} and {outputs} of y: must be as many"
            )


def check_same_names(what: str, theirs: Sequence[str], ours: Sequence[str]) -> None:
    """Raise a ``ValueError`` unless names of a run are the controller's; unknown ones are.

    A name is compared as it stands in a column of a CSV file, which may be all that is known of it.
    """
    known = all(theirs) and all(ours) and len(theirs) > 0 and len(ours) > 0
    if known and [*map(in_column, theirs)] != [*map(in_column, ours)]:
        raise ValueError(
            f"run has {', '.join(theirs)}, the controller {', '.join(ours)}: must be the same "
            f"{what} in the same order; take the setup with which it was recorded"
        )


def _started(controller: Any, y: Any, u: Any, r: Any) -> tuple[Any, Any]:
    """Return parameters and initial state for a plant that rests at ``y`` under ``u``."""
    if not hasattr(controller, "start"):
        kind = type(controller).__name__
        raise ValueError(f"u_before = {u!r}: {kind} has no start under load; leave it out")
    follower = copy.copy(controller)
    follower.reset()
    follower.start(y, u, r if np.all(np.isfinite(r)) else None)
    return follower.parameters, follower._state


@kernel
def _give_channels(
    inputs: ChannelInputs, given: Matrix, k: int, design: Any, state: Any, hold: int
) -> None:
    """Hand the device's channels of sample k over to a controller."""
    for i in range(inputs.values.size):
        inputs.values[i] = given[k, i]
    pass_channels(inputs, design, state, hold)


@compiled
def _follow(
    design: Any,
    state: Any,
    places: NDArray[np.int64],
    began: int,
    log: Matrix,
    wished: Vector,
    inputs: ChannelInputs,
    given: Matrix,
    hold: int,
) -> int:
    """Run the controller on the first columns of ``log``, write the others; return status flags.

    From sample ``began`` on the controller was in control. ``places`` are the first columns of r,
    y, y_measured, u and u_wished, and ``given`` are the device's channels.
    """
    status, count = 0, wished.size
    for k in range(log.shape[0]):
        if k == began and k > 0:
            bumpless_transfer(design, state)
        _give_channels(inputs, given, k, design, state, hold)
        u = log[k, places[3] : places[3] + count]
        r = log[k, places[0] : places[1]]
        control_all(design, state, r, log[k, places[2] : places[3]], wished)
        status |= status_flags(design, state)
        different = False
        for c in range(count):
            log[k, places[4] + c] = wished[c]
            different |= u[c] != wished[c]
        own = log[k, places[4] + count :]
        write_row(design, state, own)
        write_applied(design, state, u, own)
        if different:
            set_applied_controls(design, state, u)
    return status
