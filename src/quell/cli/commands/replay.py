"""``quell replay``: a recorded run through a setup's controller, offline."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from quell.cli.output import check_places, write_results
from quell.cli.report import figure_of, print_outcome
from quell.controllers import ADRC
from quell.realtime.loop.modes import Mode
from quell.realtime.loop.replay import replay
from quell.realtime.telemetry.channels import Event
from quell.realtime.telemetry.load import load as load_record
from quell.records import metrics
from quell.records.plotting import draw
from quell.records.trajectory import Trajectory
from quell.setup import EXAMPLES, load
from quell.setup.errors import refused


def run_replay(
    *,
    record: Path,
    path: Path | None,
    json_file: Path | None,
    figures: Path | None,
    save: Path | None,
) -> None:
    """Replay it, print what differs, write what was asked for.

    Raises
    ------
    ValueError
        for a record or a setup that can't be read, or that do not fit together.
    """
    setup = load(EXAMPLES / "torsional_rig.toml" if path is None else path)
    check_places(json_file, figures, save)
    recorded = load_record(record)
    try:
        told = replay(
            recorded, cast(ADRC, setup.controller)
        )  # what else it may be, replay itself says no to
    except ValueError as error:
        raise refused(setup.file, "", error, ()) from None
    console = Console()
    part = _controlled(recorded)
    scores = {name: _score(run, part) for name, run in (("recorded", recorded), ("replayed", told))}
    _print(console, f"{record.name} through {setup.title}", scores)
    gaps = (
        np.flatnonzero(recorded["events"].astype(np.int64) & Event.GAP)
        if "events" in recorded.names
        else np.zeros(0)
    )
    if gaps.size:
        first = recorded.t[gaps[0]]
        console.print(
            f"{gaps.size} of {len(recorded)} samples were skipped by the loop, the first at {first:.3f} s: to the replay, as to the loop, "
            "they are samples without a measurement.",
            soft_wrap=True,
        )
    differs = metrics.rms((told["u_wished"] - told["u"])[part])
    console.print(
        f"Wished u less applied u, RMS: {differs:.4g}. Judged: the {part.stop - part.start} samples under control."
    )
    learned = print_outcome(console, told)
    paths = (
        figure_of(told, setup.title, figures, f"{record.stem}-replayed", _wished)
        if figures is not None
        else []
    )
    if save is not None:
        told.save(save)
        console.print(f"Replay: {escape(str(save))}", soft_wrap=True)
    about = {"record": str(record), "title": setup.title, "dt": recorded.dt}
    found = {
        "scores": scores,
        "u_wished_rms": differs,
        "learned": learned,
        "setup": setup.as_json(),
    }
    write_results(console, about | found, json_file, paths, figures)


def _controlled(run: Trajectory) -> slice:
    """Return the samples from the first to the last in which the loop ran; all of a record without modes."""
    if "mode" not in run.names or not np.any(run["mode"] == Mode.RUN):
        return slice(0, len(run))
    running = np.flatnonzero(run["mode"] == Mode.RUN)
    return slice(int(running[0]), int(running[-1]) + 1)


def _score(run: Trajectory, part: slice) -> dict[str, float | None]:
    """Return the RMS of what is estimated of f, of what is left of it to the observer, and of x̂_1 less y."""
    found: dict[str, float | None] = {}
    for key, name in (("f", "f_hat"), ("residual", "f_residual")):
        known = name in run.names
        found[key] = metrics.rms(run[name][part]) if known else None
    found["share_learned"] = (
        None if not found["f"] else 1.0 - (found["residual"] or 0.0) / found["f"]
    )
    found["innovation"] = (
        metrics.rms(run["x_hat"][part, 0] - run["y"][part]) if "x_hat" in run.names else None
    )
    return found


def _print(console: Console, title: str, scores: dict[str, dict[str, float | None]]) -> None:
    table = Table(title=escape(title), title_justify="left", box=SIMPLE_HEAD)
    table.add_column("")
    for heading in ("RMS of f̂", "RMS of residual", "learned share\n[%]", "RMS of x̂1 − y"):
        table.add_column(escape(heading), justify="right", no_wrap=True)
    for name, score in scores.items():
        factors = (1.0, 1.0, 100.0, 1.0)
        cells = [
            "–" if value is None else f"{factor * value:.4g}"
            for value, factor in zip(score.values(), factors, strict=True)
        ]
        table.add_row(name, *cells)
    console.print(table)


def _wished(run: Trajectory, axes: Any) -> None:
    draw(axes[1], run.t, run["u_wished"], label="u wished", color="C3", linewidth=0.8)
    axes[1].legend(loc="upper right", fontsize="small")
