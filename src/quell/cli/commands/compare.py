"""``quell compare``."""

from __future__ import annotations

from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quell.cli.commands.compare_report import (
    as_json,
    print_gains,
    print_scores,
    print_two_mass,
)
from quell.cli.exit_codes import exit_if_diverged
from quell.cli.options import OUTPUTS, Outputs, Trust, Whole, refuse
from quell.cli.output import (
    COMPILING,
    Console,
    check_outputs,
    print_line,
    progress_bar,
    write_results,
)

if TYPE_CHECKING:
    from quell.analysis import Certificate
    from quell.controllers import Controller
    from quell.experiments.compare import Benchmark, Entry
    from quell.setup import Setup


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
    from quell.experiments.compare import STRUCTURES, benchmark, figures, sensitivities
    from quell.plants import two_mass_spring

    settings = benchmark.Benchmark(m1=m1, m2=m2, k=k, dt=dt, u_max=u_max, seed=seed)
    names = _names(controllers, (*benchmark.NAMES, *STRUCTURES))
    fixed = [name for name in names if name not in STRUCTURES]
    designs = {name: benchmark.controller(name, dt, u_max) for name in fixed}
    outputs = check_outputs(outputs, ["compare"])
    console = Console()
    to_tune = [name for name in names if name in STRUCTURES]
    entries: dict[str, Entry] = {}
    bounds = None
    with progress_bar(console, COMPILING) as report:
        if to_tune:
            entries, bounds = benchmark.tuned_controllers(to_tune, dt, u_max, report)
        more = {name: e.controller for name, e in entries.items() if e.controller is not None}
        result = benchmark.two_mass(settings, fixed, partial(report, COMPILING), more)
    designs |= more
    plant = two_mass_spring(m1, m2, k)
    gains = {name: sensitivities(plant, design) for name, design in designs.items()}
    stable = {name: _is_stable(design, plant) for name, design in designs.items()}
    proofs = {name: _certificate(d, settings) for name, d in designs.items() if _is_guarded(d)}
    title = f"Designed for m1 = m2 = k = 1, run on {m1:g}, {m2:g}, {k:g}"
    print_scores(console, title, result, stable)
    print_two_mass(console, settings)
    print_gains(console, gains, entries, bounds)
    for name, proof in proofs.items():
        console.print(f"{name}: {proof}", soft_wrap=True, highlight=False)
    paths = figures.save(result, outputs.figures, outputs.overwrite) if outputs.figures else []
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
    from quell.experiments.compare import STRUCTURES, figures, of_setup
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
            run = of_setup(given, names, limits, load_at, report)
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
        paths = figures.save(run.result, outputs.figures, outputs.overwrite, name)
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
    from quell.controllers.prefilters.prefilter import without_prefilters

    return getattr(without_prefilters(controller), "guard", None) is not None


def _is_stable(controller: Controller, plant: Any) -> bool | None:
    """Return whether the loop is stable; None for a controller that learns, as it is not linear."""
    from quell.analysis import analyse
    from quell.controllers.prefilters.prefilter import without_prefilters

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
