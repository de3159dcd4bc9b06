"""``quell compare``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quell.cli.exit_codes import exit_if_diverged
from quell.cli.options import OUTPUTS, Outputs, Trust, Whole, refuse
from quell.cli.output import (
    COMPILING,
    Console,
    check_outputs,
    print_line,
    progress_bar,
    table,
    write_results,
)
from quell.files import nonfinite_to_none

if TYPE_CHECKING:
    from quell.analysis import Certificate
    from quell.controllers import Controller
    from quell.experiments.compare import Benchmark, Comparison, Entry
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
        elif stable[name] is False:
            status = "[red]unstable[/]"
        rows.add_row(name, *cells, status)
    console.print(rows)


def print_two_mass(console: Console, settings: Benchmark) -> None:
    """Print what the scores of the benchmark are."""
    from quell.experiments.compare import BAND, END, FORCE, FORCE_AT

    limit = "u not limited" if settings.u_max == inf else f"|u| up to {settings.u_max:g} N"
    console.print(
        f"Unit step from rest, judged until {FORCE_AT:g} s (settling ±{100.0 * BAND:g} %); "
        f"{FORCE:g} N on m2 from then on (peak). RMS and variation: all {END:g} s. "
        f"dt = {settings.dt:g} s, {limit}. –: not settled, or diverged before. "
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
    setup: Path | None = None,
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
    trust: Trust = False,
    outputs: Outputs = OUTPUTS,
) -> None:
    """Compare controllers: by published rules, and tuned under the same constraints.

    Without a setup: on two masses and a spring, designed for m1 = m2 = k = 1, with a step, a force
    on the load, and noise. Tuned controllers have the best load rejection (largest integral gain)
    that M_s, M_t and M_ks of mf-eso allow. With a setup: its own controller, and tuned ones for its
    plant, in its scenario. If a run diverges the exit code is 4.

    Parameters
    ----------
    setup
        A setup file in TOML.
    controllers
        Names of controllers, with commas between; by default all. Without a setup zv+ or zvd+
        before a name that is not tuned shapes its reference, as in zv+lqg.
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
    """
    if setup is not None:
        from quell.setup import load

        _only_for(setup=False, m1=m1, m2=m2, k=k, dt=dt, u_max=u_max, seed=seed)
        given = load(setup, trust)
        _compare_setup(setup.stem, given, controllers, (m_s, m_t, m_ks), load_at, outputs)
        return
    _only_for(setup=True, m_s=m_s, m_t=m_t, m_ks=m_ks, load_at=load_at)
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


def _only_for(*, setup: bool, **options: Any) -> None:
    """Refuse options that the other kind of comparison has, unless they have their defaults."""
    import inspect

    defaults = inspect.signature(compare).parameters
    for name, value in options.items():
        if value != defaults[name].default:
            rule = "is for a comparison of a setup; give one" if setup else "is in the setup itself"
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
