"""Checks of a trial's records and of the rig's log, independently of the supervisor."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from quell.realtime import Safety, load
from quell.realtime.rig import LIVE, LOG
from quell.realtime.supervisor import FLUSH, Cause, Mode

DT, WATCHDOG, LIMIT = 1e-3, 20, 5.0
SAFETY = Safety(hold_time=0.005, ramp_time=0.05, settle_time=0.05, most_error=3.0)
HOLD, RAMP = 5, 50  # the same in samples
DELAY = 10  # largest delay that the relay adds [samples]
LATEST = DELAY + HOLD  # delay of a command, with the samples until the loop hears nothing


def judged(
    folder: Path, log: np.ndarray, *, loop_killed: bool, rig_killed: bool, disk_full: bool
) -> dict[str, Any]:
    """Return the errors found and how the trial ended."""
    wrong = judge_wire(log, rig_killed)
    found: dict[str, Any] = {"ended": "it was killed", "wrong": wrong}
    files = [folder / "run.csv", folder / "run.mcap"]
    if disk_full:
        files = [folder.parent / "full" / path.name for path in files]
    if loop_killed:
        found["lost"] = [judge_loss(path, log, wrong) for path in files]
    elif (folder / "error.txt").exists():
        raised = (folder / "error.txt").read_text(encoding="utf-8")
        if disk_full and "can't be written (No space left" in raised:
            found["ended"] = "refused: no space"
        elif "no device answers" in raised:  # within three seconds, on a busy machine
            found["ended"] = "no device answered"
        else:
            wrong.append(f"the loop raised {raised}")
    else:
        told = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        found["ended"] = (
            Cause(told["changes"][-2][2]).name
            if len(told["changes"]) > 1
            else Cause(told["changes"][-1][2]).name
        )
        if told["completed"] and not np.isfinite(log[:, LOG.index("command")]).any():
            wrong.append("no command arrived")
        if disk_full:
            judge_full_disk(files, told, wrong)
        else:
            for path in files:
                judge_record(path, told, wrong)
    return found


def judge_full_disk(files: list[Path], told: dict[str, Any], wrong: list[str]) -> None:
    """Check that the loop went on to its end, told of lost rows, and left readable files."""
    if not told["completed"] and not told["blamed_on_machine"]:
        wrong.append(f"a full disk ended the run: {told['verdict']}")
    for path in files:
        rows = 0
        try:
            if path.stat().st_size > 0:  # otherwise there was no room for the first line
                rows = np.count_nonzero(load(path)["events"].astype(int) < 1 << 16)
        except ValueError as error:
            if "has no row" not in str(error):
                wrong.append(f"{path.name} cannot be read: {error}")
        if rows < told["tally"]["cycles"] and not any(path.name in n for n in told["notes"]):
            wrong.append(f"{path.name} has {rows} rows, and the run does not say so")


def judge_wire(log: np.ndarray, rig_killed: bool) -> list[str]:
    """Return the errors in the rig's log."""
    wrong: list[str] = []
    state, u, command = (log[:, LOG.index(name)] for name in ("state", "u", "command"))
    came = command[np.isfinite(command)]
    if np.any(np.abs(came) > LIMIT) or np.any(np.abs(u) > LIMIT) or not np.all(np.isfinite(u)):
        wrong.append(
            f"u of {max(np.max(np.abs(came), initial=0.0), np.max(np.abs(u))):g} on the wire"
        )
    if np.any(u[state != LIVE] != 0.0):
        wrong.append("u was not zero without a live session")
    silent = 0
    for k in range(log.shape[0]):
        silent = 0 if np.isfinite(command[k]) else silent + 1
        if silent >= WATCHDOG and u[k] != 0.0:
            wrong.append(f"u = {u[k]:g} after {silent} ticks without a command")
            break
    if not rig_killed and (log.shape[0] == 0 or u[-1] != 0.0 or state[-1] == LIVE):
        wrong.append("u did not end at zero")
    session = log[:, LOG.index("session")]
    if any(
        np.any(np.diff(state[(session == one) & (state >= LIVE)]) < 0) for one in np.unique(session)
    ):
        wrong.append("a tripped session became live again")
    return wrong


def judge_loss(path: Path, log: np.ndarray, wrong: list[str]) -> float:
    """Return the time that is missing at the end of a killed loop's record [s]."""
    arrived = np.flatnonzero(np.isfinite(log[:, LOG.index("command")]))
    if arrived.size == 0:  # killed before the first command
        return math.nan
    commands = int(arrived[-1] - arrived[0])
    try:
        last = load(path)["k"][-1]
    except ValueError as error:
        if "has no row" not in str(error):
            wrong.append(f"{path.name} cannot be read: {error}")
            return math.nan
        last = -1.0  # killed before the first row was written: the whole record is lost
    lost = (commands - last) * DT
    if lost > 1.0:
        wrong.append(f"{path.name} lacks the last {lost:.2f} s")
    return float(lost)


def judge_record(path: Path, told: dict[str, Any], wrong: list[str]) -> None:
    """Check a complete record against the rules, independently of the supervisor."""
    record = load(path)
    mode, u, good = record["mode"].astype(int), record["u"], np.isfinite(record["y_measured"])
    if np.any(np.abs(u) > LIMIT) or not np.all(np.isfinite(u)):
        wrong.append(f"{path.name}: u beyond its limits")
    if mode[-1] != Mode.STOPPED or u[-1] != 0.0:
        wrong.append(f"{path.name}: u did not end at zero")
    if (
        len(record) - np.count_nonzero(record["events"].astype(int) >> 16 & 1)
        != told["tally"]["cycles"]
    ):
        wrong.append(
            f"{path.name}: {told['tally']['cycles']} cycles, {len(record)} rows with gaps filled"
        )
    blind = 0
    for k in range(len(record)):
        blind = 0 if good[k] else blind + 1
        if blind > HOLD + 1 and mode[k] < Mode.RAMP and not record["events"][k] >= 1 << 16:
            wrong.append(f"{path.name}: {blind} samples without a measurement, and no ramp")
            break
    down = np.flatnonzero(mode >= Mode.RAMP)
    if down.size == 0:
        wrong.append(f"{path.name}: its end is missing")
        return
    if np.any(np.diff(mode[down]) < 0) or np.any(mode[down[0] :] < Mode.RAMP):
        wrong.append(f"{path.name}: the run continued after the ramp began")
    cycles = np.cumsum(1 - (record["events"][down].astype(int) >> 16 & 1))  # gaps are none
    if cycles[-1] > RAMP + FLUSH + 1:
        wrong.append(f"{path.name}: the loop took {down.size} samples to stop")
    # The record has the u that acted, where the device has told it: that of a command before the
    # ramp, as long as one may take and then stand (until the watchdog trips), and after that of the
    # ramp.
    allowed = LIMIT * np.clip(1.0 - (cycles - 1 - LATEST - WATCHDOG) / RAMP, 0.0, 1.0)
    if np.any(np.abs(u[down]) > allowed + 1e-12):
        wrong.append(f"{path.name}: |u| is not ramped to zero")
