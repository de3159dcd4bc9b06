"""What holds for every function that draws: it takes axes, returns them, and pyplot can save it."""

from __future__ import annotations

import importlib
import io
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql
from quell import analysis
from quell.commissioning import Verification
from quell.experiments import acc, compare, over_seeds, stress, torsional, two_mass_spring
from quell.experiments.acc import study as acc_figures
from quell.experiments.acc.loops import Judged
from quell.experiments.torsional import FRICTION, LINEAR
from quell.experiments.torsional import NAMES as TORSIONAL
from quell.realtime.system import Histogram, Timing, count_duration, empty_counts
from quell.sweeping import sweep

plt = importlib.import_module("matplotlib.pyplot")

DT = 0.05
LAG = ql.plants.LinearPlant([[-1.0]], [1.0], [1.0])
ROOT = Path(str(ql.__file__)).parent


class Case(NamedTuple):
    """A function that draws, and the number of its axes."""

    draw: Callable[..., Any]
    axes: int


def adrc(omega_o: float = 5.0, learner: Any = None) -> ql.ADRC:
    """Return a controller of the lag."""
    observer = ql.ESO.model_free(order=1, b0=1.0, omega_o=omega_o, dt=DT)
    return ql.ADRC(observer, omega_c=1.0, learner=learner, guard=learner and ql.Guard())


def manual() -> ql.controllers.LinearController:
    """Return u = r."""
    law = ql.controllers.LinearLaw(np.zeros((0, 0)), *[np.zeros(0)] * 4, 1.0, 0.0)
    return ql.controllers.LinearController(law, DT)


def built(b: float, omega_o: float) -> Any:
    """Return the parts of a run of the sweep."""
    return ql.plants.LinearPlant([[-1.0]], [b], [1.0]), adrc(omega_o), ql.Scenario(1.0, 1.0)


def studies() -> dict[str, Case]:
    """Return the figures of the experiments, of results made from one run."""
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=5.0, dt=DT)
    law = ql.ADRC(observer, 0.5, learner=ql.learners.RLS(ql.features.State()))
    scenario = ql.Scenario(ql.signals.Sinusoid(omega=0.2), duration=180.0)
    run = ql.simulate(ql.plants.two_mass_spring(), law, scenario)
    names = [*two_mass_spring.controllers(two_mass_spring.Settings()), "MF-ESO", "MB-ESO", "L-ESO"]
    names += ["L-ESO (Algorithm 1)"]
    trial = two_mass_spring.Trial(1, 0.1, 10.0, True, 0.1)
    scores: Any = {name: {"disturbance_peak": 0.1} for name in names}
    two = two_mass_spring.Result(
        two_mass_spring.Settings(), dict.fromkeys(names, run), scores, (), (trial,)
    )
    outcome = torsional.Outcome(dict.fromkeys(TORSIONAL, run), {}, {}, ())
    case = torsional.Case(20.0, 90.0, {FRICTION: outcome, LINEAR: outcome})
    disks = torsional.Result(torsional.Settings(), (case,))
    judged = Judged(np.array([0.05, 1.0]), np.array([0.1, 0.1]))
    springs = {spring: {"MF-ESO": judged} for spring in acc.SPRINGS}
    masses = acc.Result(acc.generated(2), "drawn", springs, {}, 1.0, 1.0)
    loop = stress.draw_loops(1, np.random.default_rng(0))[0]
    ratios = stress.Errors(1.0, 0.9, 0.8), stress.Errors(1.0, 1.0, 1.0)
    one = stress.Outcome("honest", loop, "rls", *ratios)
    trial_of_guard = stress.Result({}, [one])
    rates = {spring: {"MF-ESO": [(0.1, 0.0, 0.2)] * 7} for spring in acc.SPRINGS}

    def spread(ax: Any = None) -> Any:
        return acc_figures._spread(rates, ax)

    found = {"stress": Case(lambda ax=None: stress.draw(trial_of_guard, ax=ax), 2)}
    for name, axes in (("position", 3), ("control", 12), ("learning", 3), ("algorithm-1", 2)):
        found[name] = Case(lambda ax=None, n=name: two_mass_spring.draw(two, n, ax=ax), axes)
    for name, axes in (("position", 3), ("control", 2), ("learning", 2)):
        name = f"torsional-{name}"
        found[name] = Case(lambda ax=None, n=name: torsional.draw(disks, n, ax=ax), axes)
    found["acc-failures"] = Case(lambda ax=None: acc.draw(masses, "acc-failures", ax=ax), 1)
    return found | {"acc-spread": Case(spread, 2)}


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Case]:
    """Every figure, of small results."""
    scenario = ql.Scenario(ql.signals.Sinusoid(), duration=5.0)
    features = ql.features.State() + ql.features.Bias()
    run = ql.simulate(LAG, adrc(learner=ql.learners.RLS(features)), scenario)
    plain = ql.simulate(LAG, adrc(), scenario)
    batch = ql.simulate(LAG, adrc(), [scenario] * 2)
    loop = analysis.analyse(LAG, adrc())
    swept = sweep(
        built,
        {"b": [0.8, 1.2], "omega_o": [3.0, 5.0]},
        folder=tmp_path_factory.mktemp("sweep") / "s",
        metrics=["iae"],
    )
    tuned = ql.tune(LAG, DT, structure="pi", compare=())
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], 80), 5)
    samples = ql.signals.Samples(np.arange(u.size) * DT, u)
    measured = ql.simulate(LAG, manual(), ql.Scenario(samples, duration=u.size * DT))
    model = ql.identify(measured["u"], measured["y"], DT, order=1)
    counts = empty_counts()
    for duration in (1_000, 2_000, 50_000):
        count_duration(counts, duration)
    histogram = Histogram.of(counts)
    measured: Any = SimpleNamespace(trajectory=plain)
    step = Verification(measured, plain, 1.0, 1.0, plain["y"], plain["u"])
    compared = compare.compare(LAG, {"ADRC": adrc()}, scenario)
    omegas = [4.0, 8.0]
    pid = ql.baselines.PID(4.0, 1.0, 3.0, tf=0.05, dt=0.01)
    add_on = ql.tuning.tune_compensator(([1.0], [1.0, 1.0, 0.0]), pid, speeds=(1.0, 1.0))
    axes = ql.Axes([adrc(), adrc()])
    lags = ql.plants.LinearPlant(-np.eye(2), np.eye(2), np.eye(2))
    coupled = ql.tune(lags, controller=axes)
    machine = ql.simulate(lags, axes, ql.Scenario((1.0, 0.5), duration=1.0))
    short = ql.Scenario((1.0, 0.5), duration=0.2)
    machines = ql.simulate([lags] * 2, axes, short)
    seeded = over_seeds.over_seeds(lags, {"a": axes, "b": axes}, short)
    points = {at: ql.plants.LinearPlant.of(([at], [1.0, 1.0])) for at in (1.0, 2.0)}
    schedule = ql.tune_schedule(points, DT)
    t = np.arange(120) * DT
    swing = ql.identification.free_swing(np.exp(-t) * np.cos(30.0 * t), DT, 1)
    rng = np.random.default_rng(0)
    u = rng.standard_normal(600)
    y = np.convolve(u, np.exp(-0.1 * np.arange(80)))[:600]
    response = ql.identification.frequency_response(u, y, DT)
    omega = np.geomspace(1.0, 60.0, 40)
    G = 1.0 / (1.0 + 0.02j * omega - (omega / 20.0) ** 2)
    G = G * (1.0 + 1e-3 * (rng.standard_normal(40) + 1j * rng.standard_normal(40)))
    table = ql.identification.identify_frequencies(omega, G, 2, 0, integrators=0, delay=0.0)
    spectrum = ql.identification.modes_of_spectrum(omega, np.abs(G) ** 2, 1)
    plots = {
        "Trajectory": Case(run.plot, 5),
        "axes": Case(machine.plot, 7),
        "tuned schedule": Case(schedule.plot, 3),
        "tuned axes": Case(coupled.plot, 2),
        "BatchTrajectory": Case(batch.plot, 2),
        "batch of axes": Case(machines.plot, 4),
        "Tuned": Case(tuned.plot, 4),
        "tuned compensator": Case(add_on.plot, 1),
        "Identified": Case(model.plot, 7),
        "free swing": Case(swing.plot, 2),
        "frequency response": Case(response.plot, 3),
        "frequency model": Case(table.plot, 3),
        "modes of a spectrum": Case(spectrum.plot, 1),
        "Verification": Case(step.plot, 2),
        "Sweep": Case(lambda ax=None: swept.plot("b", ax=ax), 2),
        "Sweep in lines": Case(lambda ax=None: swept.plot("b", by="omega_o", ax=ax), 2),
        "Histogram": Case(histogram.plot, 1),
        "Timing": Case(Timing(histogram, histogram).plot, 1),
        "compare": Case(lambda ax=None: compare.draw(compared, ax=ax), 2),
        "over seeds": Case(lambda ax=None: over_seeds.draw(seeded, ax=ax), 2),
        "bode": Case(lambda ax=None: analysis.plot_bode(loop, ax=ax), 2),
        "gang": Case(lambda ax=None: analysis.plot_gang_of_four(loop, ax=ax), 4),
        "nyquist": Case(lambda ax=None: analysis.plot_nyquist(loop, ax=ax), 1),
        "locus": Case(lambda ax=None: analysis.plot_root_locus(LAG, adrc, omegas, ax=ax), 1),
        "over time": Case(
            lambda ax=None: analysis.plot_margins_over_time([0.0, 1.0], [loop] * 2, ax=ax), 3
        ),
        "over omega_o": Case(
            lambda ax=None: analysis.plot_margins_against_omega_o(LAG, adrc, omegas, ax=ax), 4
        ),
    }
    return plots | studies()


def drawn_axes(returned: Any) -> list[Any]:
    """Return the axes that a function returned as a list."""
    return list(np.ravel(np.asarray(returned, dtype=object)))


@pytest.mark.trial
def test_every_figure_takes_and_returns_axes_and_pyplot_saves_it(cases: dict[str, Case]) -> None:
    """A new figure is pyplot's current one; given axes come back; another number is an error."""
    for name, (draw, count) in cases.items():
        plt.close("all")
        new = drawn_axes(draw())
        assert len(new) == count, name
        assert all(each.figure is plt.gcf() for each in new), name
        if name == "Trajectory":  # the others take time, and are figures of pyplot all the same
            plt.savefig(io.BytesIO(), dpi=10)
        given = plt.figure().subplots(1, count, squeeze=False)[0]
        back = drawn_axes(draw(ax=given if count > 1 else given[0]))
        assert back == list(given), name
        assert all(each.has_data() for each in given), name
        if count > 1:
            with pytest.raises(ValueError, match="axes"):
                draw(ax=plt.figure().subplots(1, 1 if name.startswith("Sweep") else count + 3))
    plt.close("all")


_DRAWS = re.compile(r"^ *def (plot(?:_\w+)?|draw)\(", re.MULTILINE)
# Files of functions that draw, and those that are drawn above.
_PUBLIC = {
    "tuning/schedules.py plot": "tuned schedule",
    "records/trajectory.py plot": "Trajectory",  # and BatchTrajectory, of one axis and of several
    "tuning/tuned.py plot": "Tuned",
    "tuning/interaction.py plot": "tuned axes",
    "tuning/compensator.py plot": "tuned compensator",
    "identification/result.py plot": "Identified",
    "identification/swings.py plot": "free swing",
    "identification/frequencies.py plot": "frequency response",
    "identification/frequency_model.py plot": "frequency model",
    "identification/spectra.py plot": "modes of a spectrum",
    "commissioning.py plot": "Verification",
    "sweeping/sweep.py plot": "Sweep",
    "realtime/system.py plot": "Timing",
    "experiments/compare.py draw": "compare",
    "experiments/over_seeds.py draw": "over seeds",
    "experiments/stress/figures.py draw": "stress",
    "experiments/two_mass_spring.py draw": "position",
    "experiments/torsional.py draw": "torsional-position",
    "experiments/acc/study.py draw": "acc-failures",
    "analysis/plots.py plot_bode": "bode",
    "analysis/plots.py plot_gang_of_four": "gang",
    "analysis/plots.py plot_margins_over_time": "over time",
    "analysis/plots.py plot_margins_against_omega_o": "over omega_o",
    "analysis/plots.py plot_nyquist": "nyquist",
    "analysis/plots.py plot_root_locus": "locus",
}
# What those call, and what is no figure.
_INSIDE = {
    "records/plotting.py plot_run",
    "records/plotting.py plot_batch",
    "records/plotting.py plot_batch_of_axes",
    "records/plotting.py plot_axes",
    "sweeping/sweep.py plot_over",
    "tuning/report.py draw",
    "envs/loops.py draw",  # draws random numbers
}


@pytest.mark.trial
def test_no_function_that_draws_is_forgotten(cases: dict[str, Case]) -> None:
    """All public functions ``plot``, ``plot_…`` and ``draw`` of the package are in the list."""
    found = set()
    for path in ROOT.rglob("*.py"):
        file = path.relative_to(ROOT).as_posix()
        if file.startswith("studio/"):
            continue
        text = path.read_text(encoding="utf-8")
        found |= {f"{file} {name}" for name in _DRAWS.findall(text)}
    assert found == {*_PUBLIC, *_INSIDE}
    assert set(_PUBLIC.values()) <= set(cases)


def test_the_style_for_papers_fits_a_column_and_embeds_truetype() -> None:
    """3.5 or 7.16 inches; without it matplotlib's own width."""
    for columns, width in ((1, 3.5), (2, 7.16)):
        with plt.rc_context(ql.style(columns)):
            figure = plt.figure()
            figure.subplots().set_xlabel("time [s]")
            written = io.BytesIO()
            figure.savefig(written, format="pdf")
        assert figure.get_figwidth() == width
        assert b"/Subtype /Type3" not in written.getvalue()
    with pytest.raises(ValueError, match="columns"):
        ql.style(3)
    plt.close("all")
