"""``quell run``: simulate what a setup file describes, print, draw, write."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from quell.cli.output import check_places, progress_bar, write_results
from quell.cli.report import figure_of, judge, print_judgement, print_outcome
from quell.setup import SetupError, load
from quell.simulation.simulate import simulate


def run_setup(
    *, path: Path, json_file: Path | None, figures: Path | None, save: Path | None
) -> None:
    """Run it, print its metrics, write what was asked for.

    Raises
    ------
    ValueError
        for a mistake in the file, with a line for each, or a place that can't be written to.
    """
    setup = load(path)
    plant, scenario = setup.needed("plant"), setup.needed("scenario")
    late = [
        (i, window["start"])
        for i, window in enumerate(setup.windows)
        if window.get("start", 0.0) >= scenario.duration
    ]
    if late:
        rule = f"must be less than the scenario's duration, {scenario.duration:g} s"
        raise SetupError(
            [f"{setup.file}: metrics[{i}].start = {start:g}: {rule}" for i, start in late]
        )
    check_places(json_file, figures, save)
    console = Console()
    with progress_bar(
        console, what := "simulating (the first run compiles for some seconds)"
    ) as progress:
        try:
            run = simulate(plant, setup.controller, scenario, progress=partial(progress, what))
        except ValueError as error:
            raise SetupError([f"{setup.file}: {error}"]) from None
    scores = judge(run, setup)
    print_judgement(console, f"{setup.title}: {run.plant}, dt = {run.dt:g} s", scores)
    learned = print_outcome(console, run)
    paths = figure_of(run, setup.title, figures, path.stem) if figures is not None else []
    if save is not None:
        run.save(save)
        console.print(f"Record: {escape(str(save))}", soft_wrap=True)
    about = {
        "title": setup.title,
        "plant": run.plant,
        "dt": run.dt,
        "status": run.status.name or "OK",
        "diverged": run.diverged,
    }
    write_results(
        console,
        {**about, "metrics": scores, "learned": learned, "setup": setup.as_json()},
        json_file,
        paths,
        figures,
    )
