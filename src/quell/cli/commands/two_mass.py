"""``quell reproduce two-mass``: run, print, write."""

from __future__ import annotations

from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from quell import plants
from quell.cli.output import check_places, compile_loops, progress_bar, write_results
from quell.experiments.two_mass_spring import figures as two_mass_figures
from quell.experiments.two_mass_spring import setup as two_mass_spring
from quell.experiments.two_mass_spring import study as two_mass_study
from quell.experiments.two_mass_spring.setup import Settings
from quell.experiments.two_mass_spring.study import Result

_COLUMNS = (
    ("overshoot", "overshoot\n[‰]", 1e3, ".2f"),
    ("settling_time", "settling\n[s]", 1.0, ".2f"),
    ("disturbance_peak", "peak\n[m]", 1.0, ".4f"),
    ("disturbance_rms", "RMS\n[m]", 1.0, ".4f"),
    ("control_variation", "variation\n[N]", 1.0, ".1f"),
)


def reproduce_two_mass(
    *,
    dt: float,
    seed: int,
    omega_o: float,
    reset: bool,
    json_file: Path | None,
    figures: Path | None,
) -> None:
    """Run the study, print its two tables, write what was asked for.

    Raises
    ------
    ValueError
        for settings out of range, or a place that can't be written to.
    """
    settings = Settings(dt=dt, seed=seed, omega_o=omega_o, reset=reset)
    # What can't be designed or written is said before the work is done.
    try:
        two_mass_spring.controllers(settings)
    except ValueError as error:
        raise ValueError(f"{error} (the study goes up to 3 times omega_o)") from None
    check_places(json_file, figures)
    console = Console()
    loops = [
        (plants.two_mass_spring(), candidate)
        for candidate in two_mass_spring.controllers(settings).values()
    ]
    compile_loops(console, loops)
    with progress_bar(console, width=15) as progress:
        result = two_mass_study.run(settings, progress)
        paths = two_mass_figures.save(result, figures, progress) if figures is not None else []
    _print(console, result)
    write_results(console, result.to_json(), json_file, paths, figures)


def _print(console: Console, result: Result) -> None:
    settings = result.settings
    claims = Table(
        title="What the paper claims in section IV, and what is measured here",
        title_justify="left",
        box=SIMPLE_HEAD,
    )
    claims.add_column("claim")
    for heading in ("paper", "holds when", "measured", "holds"):
        claims.add_column(heading, justify="right", no_wrap=True)
    for claim in result.claims:
        paper = claim.paper if isinstance(claim.paper, str) else f"{claim.paper:g}"
        measured = "not reached" if claim.measured is None else _short(claim.measured)
        name = f"{claim.claim} [{claim.unit}]" if claim.unit else claim.claim
        claims.add_row(
            escape(name),
            paper,
            claim.rule,
            measured,
            "[green]yes[/]" if claim.holds else "[red]no[/]",
        )
    console.print(claims)
    console.print("docs/theory explains each no.\n")
    reset = "with" if settings.reset else "without"
    about = f"dt = {settings.dt:g} s, seed {settings.seed}, omega_o = {settings.omega_o:g} rad/s, {reset} reset"
    scores = Table(title=f"All controllers ({about})", title_justify="left", box=SIMPLE_HEAD)
    scores.add_column("controller", no_wrap=True)
    for _, heading, _, _ in _COLUMNS:
        scores.add_column(escape(heading), justify="right")
    for name, score in result.scores.items():
        values = [(score[key], factor, form) for key, _, factor, form in _COLUMNS]
        scores.add_row(
            name,
            *(
                "–" if value is None else format(factor * value, form)
                for value, factor, form in values
            ),
        )
    console.print(scores)
    console.print(
        "Overshoot, settling (±0.2 %) and variation: step, 110–150 s. Peak and RMS of y − 1: force on m2, 170–250 s.\n"
    )
    for name, run in result.runs.items():
        if run.diverged:
            console.print(f"{name}: {run.message}")


def _short(value: float) -> str:
    return f"{value:.4f}" if abs(value) < 10.0 else f"{value:.2f}"
