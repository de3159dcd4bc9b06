"""``quell replay``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from quell.cli.options import RUN_OUTPUTS, MaxSize, RunOutputs, Trust
from quell.cli.output import (
    Console,
    check_outputs,
    number,
    print_line,
    table,
    write_record,
    write_results,
)
from quell.cli.report import print_outcome, save_run_figure
from quell.reading import MAX_SIZE

if TYPE_CHECKING:
    from quell.records.trajectory import Trajectory

_HEADINGS = ("RMS of f̂", "RMS of residual", "learned share\n[%]", "RMS of x̂1 − y")
_FACTORS = (1.0, 1.0, 100.0, 1.0)


def replay(
    record: Path,
    setup: Path | None = None,
    *,
    max_size: MaxSize = MAX_SIZE,
    trust: Trust = False,
    outputs: RunOutputs = RUN_OUTPUTS,
) -> None:
    """Run a setup's observer and learner on a recorded run, and compare the estimates.

    Parameters
    ----------
    record
        File that `quell run-rig` recorded, ending in .mcap or .csv.
    setup
        The file of the controller, in TOML, with the record's sample time; by default that of
        `quell run-rig`.
    """
    from quell.controllers import ADRC
    from quell.realtime import load as load_record
    from quell.realtime import replay as replay_record
    from quell.records import metrics
    from quell.setup import EXAMPLES, load
    from quell.setup.errors import with_path

    given = load(setup or EXAMPLES / "torsional_rig.toml", trust)
    name = f"{record.stem}-replayed"
    outputs = check_outputs(outputs, [name])
    recorded = load_record(record, max_size)
    try:  # replay refuses a controller that is no ADRC
        replayed = replay_record(recorded, cast(ADRC, given.controller))
    except ValueError as error:
        raise with_path(given.file, "", error, ()) from None
    console = Console()
    part = _controlled(recorded)
    scores = {"recorded": _scores(recorded, part), "replayed": _scores(replayed, part)}
    rows = table(f"{record.name} through {given.title}", "", *_HEADINGS)
    for name, values in scores.items():
        pairs = zip(values.values(), _FACTORS, strict=True)
        rows.add_row(name, *(number(value, ".4g", factor) for value, factor in pairs))
    console.print(rows)
    _print_gaps(console, recorded)
    difference = metrics.rms((replayed["u_wished"] - replayed["u"])[part])
    console.print(
        f"Wished u less applied u, RMS: {difference:.4g}. Judged: the {part.stop - part.start} "
        "samples under control."
    )
    learned = print_outcome(console, replayed)
    paths = save_run_figure(replayed, given.title, outputs, name, _draw_wished)
    write_record(console, replayed, outputs, "Replay")
    results = {
        "record": str(record),
        "title": given.title,
        "dt": recorded.dt,
        "scores": scores,
        "u_wished_rms": difference,
        "learned": learned,
        "setup": given.as_json(),
    }
    write_results(console, results, outputs, paths)


def _controlled(run: Trajectory) -> slice:
    """Return the samples in which the loop ran; all of a record without modes."""
    from quell.realtime.loop.modes import Mode

    if "mode" not in run.names or Mode.RUN not in run["mode"]:
        return slice(0, len(run))
    running = (run["mode"] == Mode.RUN).nonzero()[0]
    return slice(int(running[0]), int(running[-1]) + 1)


def _scores(run: Trajectory, part: slice) -> dict[str, float | None]:
    """Return the RMS of the estimate of f, of the observer's part of it, and of the innovation."""
    from quell.records import metrics

    def rms(name: str) -> float | None:
        return metrics.rms(run[name][part]) if name in run.names else None

    f, residual = rms("f_hat"), rms("f_residual")
    known = "x_hat" in run.names
    return {
        "f": f,
        "residual": residual,
        "share_learned": 1.0 - (residual or 0.0) / f if f else None,
        "innovation": metrics.rms(run["x_hat"][part, 0] - run["y"][part]) if known else None,
    }


def _print_gaps(console: Console, recorded: Trajectory) -> None:
    from quell.realtime.telemetry.channels import Event

    if "events" not in recorded.names:
        return
    gaps = (recorded["events"].astype(int) & Event.GAP).nonzero()[0]
    if gaps.size:
        first = f"the first at {recorded.t[gaps[0]]:.3f} s"
        skipped = f"{gaps.size} of {len(recorded)} samples were skipped by the loop, {first}"
        meaning = "to the replay, as to the loop, they are samples without a measurement."
        print_line(console, f"{skipped}: {meaning}")


def _draw_wished(run: Trajectory, axes: Any) -> None:
    from quell.records.plotting import draw_line

    draw_line(axes[1], run.t, run["u_wished"], label="u wished", color="C3", linewidth=0.8)
    axes[1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize="small", frameon=False)
