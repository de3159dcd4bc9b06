"""``quell compare``."""

from __future__ import annotations

from functools import partial
from math import inf
from typing import TYPE_CHECKING

from rich.console import Console

from quell.cli.exit_codes import exit_if_diverged
from quell.cli.options import OUTPUTS, Outputs, Whole
from quell.cli.output import COMPILING, check_outputs, progress_bar, table, write_results

if TYPE_CHECKING:
    from quell.analysis import Certificate
    from quell.controllers import Controller
    from quell.experiments.compare import Benchmark, Comparison

# Key, heading, factor and most decimals.
_COLUMNS = (
    ("overshoot", "over-\nshoot\n[%]", 100.0, 2),
    ("settling_time", "settling\n[s]", 1.0, 2),
    ("disturbance_peak", "peak\n[m]", 1.0, 4),
    ("rms", "RMS\n[m]", 1.0, 4),
    ("control_variation", "vari-\nation\n[N]", 1.0, 2),
)
# Characters of a number, so that the table fits into a terminal of 80 columns.
_WIDTH = 6


def compare(
    *,
    controllers: str = "mf-eso,mb-eso,l-eso,guarded-l-eso,pid,pi-notch,lqg,resonance-ratio",
    m1: float = 1.0,
    m2: float = 1.0,
    k: float = 1.0,
    dt: float = 1e-3,
    u_max: float = inf,
    seed: Whole = 0,
    outputs: Outputs = OUTPUTS,
) -> None:
    """Compare controllers on two masses and a spring: a step, a force on the load, noise.

    All are designed for m1 = m2 = k = 1. If a run diverges the exit code is 4.

    Parameters
    ----------
    controllers
        Names of controllers, with commas between; zv+ or zvd+ before a name shapes its reference,
        as in zv+lqg.
    m1
        Mass that is pushed, as it really is [kg].
    m2
        Mass that is measured [kg].
    k
        Stiffness of the spring [N/m].
    dt
        Sample time [s].
    u_max
        Limit of the control force, either way [N].
    seed
        Seed of the measurement noise.
    """
    from quell.controllers.prefilters.prefilter import without_prefilters
    from quell.experiments.compare import benchmark, figures

    settings = benchmark.Benchmark(m1=m1, m2=m2, k=k, dt=dt, u_max=u_max, seed=seed)
    names = list(dict.fromkeys(name.strip() for name in controllers.split(",") if name.strip()))
    if not names:
        known = ", ".join(benchmark.NAMES)
        raise ValueError(f"controllers = {controllers!r}: must be names with commas, of {known}")
    designs = {name: benchmark.controller(name, dt, u_max) for name in names}
    stable = {name: _is_stable(design, settings) for name, design in designs.items()}
    proofs = {
        name: _certificate(design, settings)
        for name, design in designs.items()
        if getattr(without_prefilters(design), "guard", None) is not None
    }
    outputs = check_outputs(outputs, ["compare"])
    console = Console()
    with progress_bar(console, COMPILING) as report:
        result = benchmark.two_mass(settings, names, partial(report, COMPILING))
    _print(console, result, settings, stable)
    for name, proof in proofs.items():
        console.print(f"{name}: {proof}", soft_wrap=True, highlight=False)
    paths = figures.save(result, outputs.figures, outputs.overwrite) if outputs.figures else []
    about = {"m1": m1, "m2": m2, "k": k, "dt": dt, "seed": seed}
    limit = {} if u_max == inf else {"u_max": u_max}
    results = result.to_json()
    for name, scores in results["controllers"].items():
        scores["stable"] = stable[name]
        if name in proofs:
            proof = proofs[name]
            scores["certificate"] = proof if isinstance(proof, str) else proof.to_json()
    write_results(console, {"settings": about | limit, **results}, outputs, paths)
    exit_if_diverged(result.runs.values())


def _is_stable(controller: Controller, settings: Benchmark) -> bool | None:
    """Return whether the loop is stable; None for a controller that learns, as it is not linear."""
    from quell.analysis import analyse
    from quell.controllers.prefilters.prefilter import without_prefilters
    from quell.plants import two_mass_spring

    inner = without_prefilters(controller)
    if inner.features:
        return None
    return bool(analyse(two_mass_spring(settings.m1, settings.m2, settings.k), inner).stable)


def _certificate(controller: Controller, settings: Benchmark) -> Certificate | str:
    """Return what is proved of a guarded learner on the real plant, or why nothing is."""
    from quell.analysis import certify
    from quell.plants import two_mass_spring

    try:
        return certify(two_mass_spring(settings.m1, settings.m2, settings.k), controller)
    except ValueError as error:
        return f"no certificate: {error}"


def _print(
    console: Console, result: Comparison, settings: Benchmark, stable: dict[str, bool | None]
) -> None:
    from quell.experiments.compare import BAND, END, FORCE, FORCE_AT

    title = f"Designed for m1 = m2 = k = 1, run on {settings.m1:g}, {settings.m2:g}, {settings.k:g}"
    headings = [heading for _, heading, _, _ in _COLUMNS]
    rows = table(title, "controller", *headings, padding=(0, 1, 0, 0), pad_edge=False)
    rows.add_column("status")
    for name, score in result.scores.items():
        cells = [
            "–" if (value := score[key]) is None else _short(factor * value, decimals)
            for key, _, factor, decimals in _COLUMNS
        ]
        run = result.runs[name]
        status = (run.status.name or "OK").lower().replace("_", " ").replace("|", ", ")
        if run.diverged:
            status = f"[red]diverged {run.ended:.0f} s[/]"
        elif stable[name] is False:
            status = "[red]unstable[/]"
        rows.add_row(name, *cells, status)
    console.print(rows)
    limit = "u not limited" if settings.u_max == inf else f"|u| up to {settings.u_max:g} N"
    console.print(
        f"Unit step from rest, judged until {FORCE_AT:g} s (settling ±{100.0 * BAND:g} %); "
        f"{FORCE:g} N on m2 from then on (peak). RMS and variation: all {END:g} s. "
        f"dt = {settings.dt:g} s, {limit}. –: not settled, or diverged before. "
        "Variation of u without its first jump. "
        "Unstable: the linear loop has a growing pole, perhaps a slow one.",
        soft_wrap=True,
    )


def _short(value: float, decimals: int) -> str:
    """Return a number with at most ``decimals`` decimals in few characters; large ones as 4.9e4."""
    for count in range(decimals, -1, -1):
        text = f"{value:.{count}f}"
        if len(text) <= _WIDTH:
            return text
    digits, _, power = f"{value:.1e}".partition("e")
    return f"{digits}e{int(power)}"
