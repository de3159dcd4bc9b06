"""``quell run``."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from quell.cli.exit_codes import exit_if_diverged
from quell.cli.options import RUN_OUTPUTS, RunOutputs, Switch, Trust, options_of, refuse
from quell.cli.output import (
    COMPILING,
    Console,
    check_outputs,
    progress_bar,
    write_record,
    write_results,
)
from quell.cli.report import print_metrics, print_outcome, save_run_figure, windowed_metrics


def run(
    setup: Path | None = None,
    *,
    example: Switch = False,
    trust: Trust = False,
    outputs: RunOutputs = RUN_OUTPUTS,
) -> None:
    """Simulate the plant, controller and scenario of a setup file.

    If the run diverges the exit code is 4; the part before that is recorded and drawn.

    Parameters
    ----------
    setup
        The file, in TOML; docs/setup has all keys.
    example
        Print such a file, and do no more.
    """
    from quell.setup import EXAMPLES, SetupError, load
    from quell.simulation import simulate

    if example:
        unused = {"setup": (setup, None)} | options_of(outputs, RUN_OUTPUTS)
        refuse(unused, "has no effect beside --example, which only prints a file")
        print((EXAMPLES / "two_mass.toml").read_text(encoding="utf-8"), end="")
        return
    if setup is None:
        raise ValueError("setup: missing; must be a TOML file, and quell run --example prints one")
    given = load(setup, trust)
    plant, scenario = given.needed("plant"), given.needed("scenario")
    late = [
        f"{given.file}: metrics[{i}].start = {window['start']:g}: "
        f"must be less than the scenario's duration, {scenario.duration:g} s"
        for i, window in enumerate(given.windows)
        if window.get("start", 0.0) >= scenario.duration
    ]
    if late:
        raise SetupError(late)
    outputs = check_outputs(outputs, [setup.stem])
    console = Console()
    with progress_bar(console, COMPILING) as report:
        progress = partial(report, COMPILING)
        try:
            result = simulate(plant, given.controller, scenario, progress=progress)
        except ValueError as error:
            raise SetupError([f"{given.file}: {error}"]) from None
    scores = windowed_metrics(result, given)
    print_metrics(
        console, f"{given.title}: {result.plant}, dt = {result.dt:g} s", scores, result.signals
    )
    learned = print_outcome(console, result)
    paths = save_run_figure(result, given.title, outputs, setup.stem)
    write_record(console, result, outputs, "Record")
    results = {
        "title": given.title,
        "plant": result.plant,
        "dt": result.dt,
        "status": result.status.name or "OK",
        "diverged": result.diverged,
        "metrics": scores,
        "learned": learned,
        "setup": given.as_json(),
    }
    write_results(console, results, outputs, paths)
    exit_if_diverged([result])
