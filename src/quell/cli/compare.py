"""``quell compare``."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from quell.cli.exit_codes import ExitCode, exit_if_diverged
from quell.cli.options import OUTPUTS, Outputs, Trust, Whole, WholeOrNone, refuse
from quell.cli.output import (
    COMPILING,
    Console,
    check_outputs,
    print_line,
    progress_bar,
    table,
    write_results,
)
from quell.cli.report import COLUMNS
from quell.files import nonfinite_to_none

if TYPE_CHECKING:
    from quell.analysis import Certificate
    from quell.controllers import Controller
    from quell.experiments.compare import Benchmark, Comparison, Entry
    from quell.experiments.over_seeds import SeedComparison
    from quell.setup import Setup
    from quell.tuning import Constraints

# Key, heading, unit, factor and most decimals.
_COLUMNS = (
    ("overshoot", "over-\nshoot", "%", 100.0, 2),
    ("settling_time", "settling", "s", 1.0, 2),
    ("disturbance_peak", "peak", "y-unit", 1.0, 4),
    ("rms", "RMS", "y-unit", 1.0, 4),
    ("control_variation", "vari-\nation", "u-unit", 1.0, 2),
)
_GAINS = (("m_s", "M_s", 3), ("m_t", "M_t", 3), ("m_ks", "M_ks", 1), ("k_i", "k_i", 3))
# Characters of a number, so that the table fits into a terminal of 80 columns.
_WIDTH = 6


def as_json(
    result: Comparison,
    stable: Mapping[str, bool | None],
    gains: Mapping[str, Any],
    entries: Mapping[str, Entry],
    bounds: Constraints | None,
) -> dict[str, Any]:
    """Return scores, gains and what was tuned, for a JSON file."""
    results = result.to_json()
    for name, scores in results["controllers"].items():
        scores["stable"] = stable[name]
        if gains[name] is not None:
            scores |= nonfinite_to_none(asdict(gains[name]))  # k_i with two integrators
        if name in entries:
            scores |= {"structure": entries[name].structure, "values": dict(entries[name].values)}
    if bounds is not None:
        results["constraints"] = {key: getattr(bounds, key) for key in ("m_s", "m_t", "m_ks")}
    missing = {name: entry.reason for name, entry in entries.items() if entry.controller is None}
    return results | ({"not_possible": missing} if missing else {})


def print_scores(
    console: Console,
    title: str,
    result: Comparison,
    stable: Mapping[str, bool | None],
) -> None:
    """Print a row for each run, with the units of the plant that are known."""
    signals = next(iter(result.runs.values())).signals
    units = [signals.unit(unit) for _, _, unit, _, _ in _COLUMNS]
    headings = [
        heading if unit.endswith("-unit") else f"{heading}\n[{unit}]"
        for (_, heading, *_), unit in zip(_COLUMNS, units, strict=True)
    ]
    rows = table(title, "controller", *headings, padding=(0, 1, 0, 0), pad_edge=False)
    rows.add_column("status")
    for name, score in result.scores.items():
        cells = [
            "–" if (value := score[key]) is None else _short(factor * value, decimals)
            for key, _, _, factor, decimals in _COLUMNS
        ]
        run = result.runs[name]
        status = (run.status.name or "OK").lower().replace("_", " ").replace("|", ", ")
        if run.diverged:
            status = f"[red]diverged {run.ended:.0f} s[/]"
        elif run.lost:
            status = "[red]ran away[/]"
        elif stable[name] is False:
            status = "[red]unstable[/]"
        rows.add_row(name, *cells, status)
    console.print(rows)


def print_effort(console: Console, result: Comparison) -> None:
    """Print the integral of u², energy and peak power of each run, or why there is no power."""
    unit = next(iter(result.runs.values())).signals.unit("u-unit² s")
    headings = ["∫u² dt" + ("" if "u-unit" in unit else f" [{unit}]")]
    keys = ["control_energy"]
    if not result.no_power:
        keys += ["energy", "peak_power"]
        headings += ["energy [J]", "peak power [W]"]
    rows = table("What u costs, over the whole run", "controller", *headings)
    for name, score in result.scores.items():
        values = [score[key] for key in keys]
        rows.add_row(name, *("–" if value is None else f"{value:.4g}" for value in values))
    console.print(rows)
    text = "Energy: what u puts in, without what it takes back; power: u times the flow."
    if result.no_power:
        text = f"Energy and peak power: none, {result.no_power}."
    print_line(console, text)


def print_two_mass(console: Console, settings: Benchmark) -> None:
    """Print what the scores of the benchmark are."""
    from quell.experiments.compare import BAND, END, FORCE, FORCE_AT

    limit = "u not limited" if settings.u_max == inf else f"|u| up to {settings.u_max:g} N"
    console.print(
        f"Unit step from rest, judged until {FORCE_AT:g} s (settling ±{100.0 * BAND:g} %); "
        f"{FORCE:g} N on m2 from then on (peak). RMS and variation: all {END:g} s. "
        f"dt = {settings.dt:g} s, {limit}. –: y does not come to rest there, or diverged before. "
        "Variation of u without its first jump. "
        "Unstable: the linear loop has a growing pole, perhaps a slow one.",
        soft_wrap=True,
    )


def print_gains(
    console: Console,
    gains: Mapping[str, Any],
    entries: Mapping[str, Entry],
    bounds: Constraints | None,
) -> None:
    """Print what the loops were tuned for, and who rejects loads best."""
    shown = {name: found for name, found in gains.items() if found is not None}
    headings = [heading for _, heading, _ in _GAINS]
    rows = table("Largest gains and integral gain of the linear loops", "controller", *headings)
    for name, found in shown.items():
        rows.add_row(name, *(f"{getattr(found, key):.4g}" for key, _, _ in _GAINS))
    if shown:
        console.print(rows)
        best = max(shown, key=lambda name: float(shown[name].k_i))
        ours = [n for n in shown if n in entries]
        text = f"Largest k_i: {best}"
        if ours:
            first = max(ours, key=lambda name: float(shown[name].k_i))
            text += f"; of the tuned ones {first}"
        console.print(text + ".", highlight=False)
    if bounds is not None:
        text = f"Tuned for the largest k_i (PID: the least ∫|y| after a load) under {bounds}."
        console.print(text, soft_wrap=True, highlight=False)
    for name, entry in entries.items():
        if entry.controller is None:
            console.print(f"{name}: {entry.reason}", soft_wrap=True, highlight=False)


def _short(value: float, decimals: int) -> str:
    """Return a number with at most ``decimals`` decimals in few characters; large ones as 4.9e4."""
    for count in range(decimals, -1, -1):
        text = f"{value:.{count}f}"
        if len(text) <= _WIDTH:
            return text
    digits, _, power = f"{value:.1e}".partition("e")
    return f"{digits}e{int(power)}"


def compare(
    setups: list[Path] | None = None,
    *,
    controllers: str | None = None,
    m1: float = 1.0,
    m2: float = 1.0,
    k: float = 1.0,
    dt: float = 1e-3,
    u_max: float = inf,
    seed: Whole = 0,
    m_s: float | None = None,
    m_t: float | None = None,
    m_ks: float | None = None,
    load_at: float | None = None,
    seeds: WholeOrNone = None,
    criterion: str | None = None,
    trust: Trust = False,
    outputs: Outputs = OUTPUTS,
) -> None:
    """Compare controllers: by published rules, tuned under the same constraints, or of setups.

    Without a setup: on two masses and a spring, designed for m1 = m2 = k = 1, with a step, a force
    on the load, and noise. Tuned controllers have the best load rejection (largest integral gain)
    that M_s, M_t and M_ks of mf-eso allow. With a setup: its own controller, and tuned ones for its
    plant, in its scenario. With several setups, of one axis or of the same [[axis]]: their
    controllers on the plant and in the scenario of the first, over seeds of its noise, with
    intervals; a verdict that the seeds do not allow is a line that begins with NOT. If a run
    diverges the exit code is 4.

    Parameters
    ----------
    setups
        Setup files in TOML: none, one of one axis, or several.
    controllers
        Names of controllers, with commas between; by default all. Without a setup zv+, zvd+,
        mzv+ or ei+ before a name that is not tuned shapes its reference, as in zv+lqg.
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
    m_s
        With a setup: largest |S| of tuned loops; by default that of its own controller.
    m_t
        With a setup: largest |T| of tuned loops; by default that of its own controller.
    m_ks
        With a setup: largest gain from y to u of tuned loops; by default that of its own
        controller.
    load_at
        With a setup: time from which on a disturbance is scored [s]; by default the first time at
        which one of the scenario's begins.
    seeds
        With several setups: number of seeds; by default 10, or one if nothing in the scenario is
        random.
    criterion
        With several setups: what is to be low: rms, iae or peak_error of the error r − y; by
        default rms.
    """
    of_benchmark = {"m1": m1, "m2": m2, "k": k, "dt": dt, "u_max": u_max, "seed": seed}
    of_setup = {"m_s": m_s, "m_t": m_t, "m_ks": m_ks, "load_at": load_at}
    of_several = {"seeds": seeds, "criterion": criterion}
    if setups:
        _only_for("is in the setup itself", **of_benchmark)
    if not setups or len(setups) == 1:
        _only_for("is for a comparison of several setups; give two or more", **of_several)
    if setups and len(setups) > 1:
        rule = "is for one setup, whose plant controllers are tuned for; give one"
        _only_for(rule, controllers=controllers, **of_setup)
        _compare_setups(setups, seeds, criterion or "rms", trust, outputs)
        return
    if setups:
        given = _one_setup(setups[0], trust)
        _compare_setup(setups[0].stem, given, controllers, (m_s, m_t, m_ks), load_at, outputs)
        return
    _only_for("is for a comparison of a setup; give one", **of_setup)
    from quell.experiments import compare as experiment
    from quell.experiments.compare import STRUCTURES
    from quell.plants import two_mass_spring

    settings = experiment.Benchmark(m1=m1, m2=m2, k=k, dt=dt, u_max=u_max, seed=seed)
    names = _names(controllers, (*experiment.NAMES, *STRUCTURES))
    fixed = [name for name in names if name not in STRUCTURES]
    designs = {name: experiment.controller(name, dt, u_max) for name in fixed}
    outputs = check_outputs(outputs, ["compare"])
    console = Console()
    to_tune = [name for name in names if name in STRUCTURES]
    entries: dict[str, Entry] = {}
    bounds = None
    with progress_bar(console, COMPILING) as report:
        if to_tune:
            entries, bounds = experiment.tuned_controllers(to_tune, dt, u_max, report)
        more = {name: e.controller for name, e in entries.items() if e.controller is not None}
        result = experiment.two_mass(settings, fixed, partial(report, COMPILING), more)
    designs |= more
    plant = two_mass_spring(m1, m2, k)
    gains = {name: experiment.sensitivities(plant, design) for name, design in designs.items()}
    stable = {name: _is_stable(design, plant) for name, design in designs.items()}
    proofs = {name: _certificate(d, settings) for name, d in designs.items() if _is_guarded(d)}
    title = f"Designed for m1 = m2 = k = 1, run on {m1:g}, {m2:g}, {k:g}"
    print_scores(console, title, result, stable)
    print_two_mass(console, settings)
    print_effort(console, result)
    print_gains(console, gains, entries, bounds)
    for name, proof in proofs.items():
        console.print(f"{name}: {proof}", soft_wrap=True, highlight=False)
    paths = experiment.save(result, outputs.figures, outputs.overwrite) if outputs.figures else []
    about = {"m1": m1, "m2": m2, "k": k, "dt": dt, "seed": seed}
    limit = {} if u_max == inf else {"u_max": u_max}
    results = as_json(result, stable, gains, entries, bounds)
    for name, proof in proofs.items():
        shown = proof if isinstance(proof, str) else proof.to_json()
        results["controllers"][name]["certificate"] = shown
    write_results(console, {"settings": about | limit, **results}, outputs, paths)
    exit_if_diverged(result.runs.values())


def _one_setup(path: Path, trust: bool) -> Setup:
    """Read a setup of one axis, whose controller is compared with tuned ones."""
    from quell.setup import SetupError, made, read
    from quell.setup.description import is_of_axes

    name, data = read(path)
    if is_of_axes(data):
        rule = (
            "NOT for a setup of several axes alone: structures are tuned for one axis; give two "
            "setups or more, quell compare a.toml b.toml, or tune it by quell tune"
        )
        raise SetupError([f"{name}: {rule}"])
    return made(name, data, trust)


# ---- Several setups, over seeds ----


def _compare_setups(
    paths: Sequence[Path], seeds: int | None, criterion: str, trust: bool, outputs: Outputs
) -> None:
    from quell.experiments import over_seeds as experiment
    from quell.setup import SetupError, made, read

    stems = [path.stem for path in paths]
    names = stems if len(set(stems)) == len(stems) else [str(path) for path in paths]
    if len(set(names)) < len(names):
        raise ValueError(f"setups: {', '.join(names)}: must be different files")
    figure = f"{stems[0]}-compare"
    setups = {}
    for key, path in zip(names, paths, strict=True):
        name, data = read(path)
        setups[key] = made(name, data, trust)
    outputs = check_outputs(outputs, [figure])
    console = Console()
    first = next(iter(setups.values()))
    with progress_bar(console, COMPILING) as report:
        progress = partial(report, COMPILING)
        how: dict[str, Any] = {"seeds": seeds, "criterion": criterion, "progress": progress}
        try:
            found = experiment.of_setups(setups, **how)
        except ValueError as error:
            if isinstance(error, SetupError):
                raise
            raise SetupError([f"{first.file}: {error}"]) from None
    print_over_seeds(console, first.title, found)
    paths_of_figure = []
    if outputs.figures:
        paths_of_figure = experiment.save(found, outputs.figures, outputs.overwrite, figure)
    about = {"setups": {name: setup.as_json() for name, setup in setups.items()}}
    write_results(console, found.to_json() | about, outputs, paths_of_figure)
    if found.diverged.any():
        sys.exit(ExitCode.DIVERGED)


def print_over_seeds(console: Console, title: str, found: SeedComparison) -> None:
    """Print for each window which is best for each axis, all other measures, and the verdicts."""
    from quell.experiments.over_seeds import ALL_AXES, CRITERIA

    count = len(found.seeds)
    what = CRITERIA[found.criterion]
    of_seeds = "one run each" if count == 1 else f"mean of {count} seeds ± half its 95 % interval"
    per_window = len(found.verdicts) // len(found.windows)
    print_line(console, f"{title}: {of_seeds}")
    for k, (start, stop) in enumerate(found.windows):
        where = f"{what}, {start:g} … {stop:g} s"
        rows = table(where, "", *found.names, padding=(0, 1, 0, 0), pad_edge=False)
        rows.add_column("best")
        for verdict in found.verdicts[k * per_window : (k + 1) * per_window]:
            axis = verdict.axis
            if axis == ALL_AXES:
                label = f"all, of {found.names[0]}"
                cells = [_with_reach(*found.ratio(name, k)) for name in found.names]
            else:
                i = found.axes.index(axis)
                unit = found.units[i] if found.units else ""
                unit = f"{unit} s".strip() if found.criterion == "iae" else unit
                label = f"{axis} [{unit}]" if unit else axis or "y"
                cells = [
                    _with_reach(*found.mean(found.criterion, name, k, i)) for name in found.names
                ]
            rows.add_row(escape(label), *cells, escape(verdict.best or "NOT decided"))
        console.print(rows)
        _print_means(console, found, k)
    for line in found.describe().splitlines():
        print_line(console, line)


def _print_means(console: Console, found: SeedComparison, window: int) -> None:
    """Print the mean of each measure that any axis and setup has."""
    from math import isfinite

    parts = [
        (f"{axis} {name}".strip(), name, i)
        for i, axis in enumerate(found.axes)
        for name in found.names
    ]
    means = {
        label: {
            each.key: value
            for each in COLUMNS
            if isfinite(value := found.mean(each.key, name, window, i)[0])
        }
        for label, name, i in parts
    }
    columns = [each for each in COLUMNS if any(each.key in row for row in means.values())]
    headings = [column.heading for column in columns]
    rows = table("All measures, means", "", *headings, padding=(0, 1, 0, 0), pad_edge=False)
    for label, row in means.items():
        rows.add_row(escape(label), *(column.cell(row) for column in columns))
    console.print(rows)
    energy = {label: found.mean("control_energy", name, window, i)[0] for label, name, i in parts}
    if known := {label: each for label, each in energy.items() if isfinite(each)}:
        said = ", ".join(f"{label} {each:.4g}" for label, each in known.items())
        print_line(console, f"∫u² dt, means: {said}")
    if any(len(row) < len(columns) for row in means.values()):
        print_line(console, "–: not in all runs: no step, not settled, or diverged.")
    if len(found.axes) > 1:
        print_line(console, "u of an axis is its v = B0 u, with one B0 for all.")


def _with_reach(value: float, half: float) -> str:
    """Return a number with half of its interval; a dash for none."""
    from math import isfinite

    if not isfinite(value):
        return "–"
    return f"{value:.3g} ± {half:.2g}" if isfinite(half) and half > 0.0 else f"{value:.4g}"


# ---- One setup, with tuned controllers ----


def _compare_setup(
    stem: str,
    given: Setup,
    controllers: str | None,
    limits: tuple[float | None, float | None, float | None],
    load_at: float | None,
    outputs: Outputs,
) -> None:
    from quell.experiments import compare as experiment
    from quell.experiments.compare import STRUCTURES
    from quell.setup import SetupError

    names = _names(controllers, ("setup", *STRUCTURES))
    if not set(names) & set(STRUCTURES):
        bounds = dict(zip(("m_s", "m_t", "m_ks"), limits, strict=True))
        unused = {name: (value, None) for name, value in bounds.items()}
        refuse(unused, "is a bound of tuned controllers, and none of them is compared")
    outputs = check_outputs(outputs, [f"{stem}-compare"])
    console = Console()
    with progress_bar(console, COMPILING) as report:
        try:
            run = experiment.of_setup(given, names, limits, load_at, report)
        except ValueError as error:
            if isinstance(error, SetupError):
                raise
            raise SetupError([f"{given.file}: {error}"]) from None
    plant = run.linear
    gains = {name: experiment.sensitivities(plant, d) for name, d in run.controllers.items()}
    stable = {name: _is_stable(d, plant) for name, d in run.controllers.items()}
    title = f"{given.title}: {run.plant}, dt = {run.dt:g} s"
    print_scores(console, title, run.result, stable)
    scored = "" if run.load_at is None else f"; the disturbance is scored from {run.load_at:g} s on"
    console.print(
        f"In the units of the setup{scored}. –: not settled, no step, or diverged before."
    )
    print_effort(console, run.result)
    print_gains(console, gains, run.entries, run.constraints)
    for note in run.notes:
        print_line(console, note)
    paths = []
    if outputs.figures:
        name = f"{stem}-compare"
        paths = experiment.save(run.result, outputs.figures, outputs.overwrite, name)
    results = as_json(run.result, stable, gains, run.entries, run.constraints)
    about = {"setup": given.as_json(), "load_at": run.load_at, "notes": list(run.notes)}
    write_results(console, {**about, **results}, outputs, paths)
    exit_if_diverged(run.result.runs.values())


def _only_for(rule: str, **options: Any) -> None:
    """Refuse options that another kind of comparison has, unless they have their defaults."""
    import inspect

    defaults = inspect.signature(compare).parameters
    for name, value in options.items():
        if value != defaults[name].default:
            raise ValueError(f"--{name.replace('_', '-')} = {value!r}: {rule}")


def _names(given: str | None, known: tuple[str, ...]) -> list[str]:
    if given is None:
        return list(known)
    names = list(dict.fromkeys(name.strip() for name in given.split(",") if name.strip()))
    if not names:
        raise ValueError(
            f"controllers = {given!r}: must be names with commas, of {', '.join(known)}"
        )
    return names


def _is_guarded(controller: Controller) -> bool:
    from quell.controllers.prefilters import without_prefilters

    return getattr(without_prefilters(controller), "guard", None) is not None


def _is_stable(controller: Controller, plant: Any) -> bool | None:
    """Return whether the loop is stable; None for a controller that learns, as it is not linear."""
    from quell.analysis import analyse
    from quell.controllers.prefilters import without_prefilters

    inner = without_prefilters(controller)
    return None if inner.features else bool(analyse(plant, inner).stable)


def _certificate(controller: Controller, settings: Benchmark) -> Certificate | str:
    """Return what is proved of a guarded learner on the real plant, or why nothing is."""
    from quell.analysis import certify
    from quell.plants import two_mass_spring

    try:
        return certify(two_mass_spring(settings.m1, settings.m2, settings.k), controller)
    except ValueError as error:
        return f"no certificate: {error}"
