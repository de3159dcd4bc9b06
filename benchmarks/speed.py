"""Speed of quell, as ratios to references timed in the same run.

    python benchmarks/speed.py [--part c|algorithm-1|call|python-control] [--quick] [--json FILE]

The ratios use the best of several interleaved trials, because times on a shared machine vary. The
references are the same loops in C (``reference.c``, which must give the same trajectory), pyadrc on
the same second-order loop, and python-control on the same two-mass loop. ``learners.py`` measures
the learners.
"""

from __future__ import annotations

import importlib.util
import tempfile
import timeit
from functools import partial
from pathlib import Path

import numpy as np
from c_reference import best, c_reference, row, show
from measured import check_present, not_run, options_of, parser_of, write

import quell as ql
from quell.experiments import two_mass_spring as study

SAMPLES = round(study.END / study.Settings().dt) + 1


def each(*runs: float) -> str:
    """Return the time per sample as text, for the given times of a run of the study [s]."""
    return " / ".join(f"{run / SAMPLES * 1e9:.0f}" for run in runs) + " ns a sample"


def against_c(rows: list[dict[str, object]], trials: int) -> None:
    """Time the whole closed loop of order 4 under the study's load, with and without learner."""
    for learner, name in (("no learner", study.MF), ("Kalman learner", study.L)):
        settings, plant = study.Settings(), ql.plants.two_mass_spring()
        controller, scenario = study.controllers(settings)[name], study.scenario(settings)
        with tempfile.TemporaryDirectory() as folder:
            reference = c_reference(Path(folder), settings, learns=name == study.L)
            log, run = reference(True), ql.simulate(plant, controller, scenario)
            apart = max(np.max(np.abs(run[of] - log[:, at])) for of, at in (("y", 1), ("u", 3)))
            assert apart < 1e-6, f"quell and C differ by {apart}"
            c_all, ours_all, c_bare, ours_bare = best(
                partial(reference, True),
                partial(ql.simulate, plant, controller, scenario),
                partial(reference, False),
                partial(ql.simulate, plant, controller, scenario, record_every=SAMPLES),
                trials=trials,
            )
        for label, c, ours, bar in (
            ("every sample recorded", c_all, ours_all, "≤ 1.4"),
            ("nothing recorded", c_bare, ours_bare, "≤ 1.25"),
        ):
            rows.append(
                row(
                    f"closed loop, {learner}, {label}: quell / C",
                    ours / c,
                    bar if name == study.L else "",
                    f"{each(ours, c)}, apart by {apart:.0e}",
                    apart=apart,
                )
            )


def algorithm_1(rows: list[dict[str, object]], trials: int) -> None:
    """Time Algorithm 1 with a small and a large batch."""
    settings, plant = study.Settings(), ql.plants.two_mass_spring()
    scenario = study.scenario(settings)
    small, large = (
        study.controller(settings, learner=ql.learners.BatchGradient(rate=1e-5 / n, batch=n))
        for n in (10, 10_000)
    )
    few, many = best(
        lambda: ql.simulate(plant, small, scenario),
        lambda: ql.simulate(plant, large, scenario),
        trials=trials,
    )
    rows.append(
        row("Algorithm 1: batch of 10 000 / batch of 10", many / few, "≤ 1.3", each(many, few))
    )


def one_call(rows: list[dict[str, object]], trials: int) -> None:
    """Time ``step`` from Python and pyadrc's ``StateSpace``, after checking that both agree."""
    import pyadrc

    observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=0.01)
    ours = ql.ADRC(observer, omega_c=4.0, u_min=-3.0, u_max=3.0)
    theirs = pyadrc.StateSpace(order=2, delta=0.01, b0=2.0, w_cl=4.0, k_eso=5.0, m_lim=(-3.0, 3.0))
    y = speed = before = 0.0
    for _ in range(2000):
        u, other = ours.step(1.0, y), float(theirs(y, before, 1.0))
        assert abs(u - other) < 1e-9, (u, other)
        y, speed, before = y + 0.01 * speed, speed + 0.01 * (2.0 * u - 0.5 * speed), u
    learned = ql.ADRC(
        ql.ESO.model_free(4, 1.0, 10.0, 1e-3), omega_c=1.0, learner=ql.learners.Kalman()
    )
    learned.prepare()
    calls = 20_000
    empty, plain, kalman, peer = (
        took / calls
        for took in best(
            lambda: timeit.timeit(lambda: None, number=calls),
            lambda: timeit.timeit(lambda: ours.step(1.0, 0.5), number=calls),
            lambda: timeit.timeit(lambda: learned.step(1.0, 0.5), number=calls),
            lambda: timeit.timeit(lambda: theirs(0.5, 0.1, 1.0), number=calls // 10),
            trials=min(trials, 9),
        )
    )
    peer = 10 * peer - empty
    plain, kalman = plain - empty, kalman - empty
    for label, took, bar in (
        ("order 2, no learner", plain, "≤ 0.25"),
        ("order 4, Kalman learner", kalman, "≤ 0.35"),
    ):
        rows.append(
            row(f"step() from Python, {label}: µs", took * 1e6, bar, f"{took * 1e9:.0f} ns")
        )
    times = f"{peer * 1e9:.0f} / {plain * 1e9:.0f} ns, same outputs"
    rows.append(row("one call, second order: pyadrc / quell", peer / plain, "> 1", times))


def against_python_control(rows: list[dict[str, object]], trials: int) -> None:
    """Time MF-ESO and python-control's ``input_output_response``, and check that both agree."""
    import control as ct

    settings, plant = study.Settings(), ql.plants.two_mass_spring()
    law, samples = study.controllers(settings)[study.MF], 2001
    design, sampled = law.parameters, plant.sampled(settings.dt)
    gains = np.append(design.law, 1.0)

    def update(t: float, z: np.ndarray, inputs: np.ndarray, params: object) -> np.ndarray:
        corrected = z + design.eso.gain * (inputs[1] - z[0])
        return design.eso.transition @ corrected + design.eso.input * output(t, z, inputs, params)

    def output(t: float, z: np.ndarray, inputs: np.ndarray, params: object) -> float:
        corrected = z + design.eso.gain * (inputs[1] - z[0])
        return design.law[0] * inputs[0] - gains @ corrected

    eso = ct.nlsys(
        update, output, inputs=["r", "y"], outputs=["u"], states=5, dt=settings.dt, name="eso"
    )
    matrices = (sampled.transition, sampled.input[:, None], sampled.output[None, :], 0.0)
    masses = ct.ss(*matrices, settings.dt, inputs=["u"], outputs=["y"], name="masses")
    loop = ct.interconnect([masses, eso], inputs=["r"], outputs=["y"])
    t = np.arange(samples) * settings.dt
    scenario = ql.Scenario(reference=1.0, duration=t[-1])
    apart = np.max(
        np.abs(
            ct.input_output_response(loop, t, np.ones(samples)).outputs
            - ql.simulate(plant, law, scenario)["y"]
        )
    )
    assert apart < 1e-9, f"quell and python-control differ by {apart}"
    few = min(trials, 3)
    (theirs,) = best(lambda: ct.input_output_response(loop, t, np.ones(samples)), trials=few)
    longer = ql.Scenario(reference=1.0, duration=100.0)
    (ours,) = best(lambda: ql.simulate(plant, law, longer), trials=trials)
    ours /= 100_001
    theirs /= samples
    times = f"{theirs * 1e6:.0f} µs / {ours * 1e9:.0f} ns a sample, apart by {apart:.0e}"
    rows.append(
        row("two-mass loop, MF-ESO: python-control / quell", theirs / ours, "≥ 2000", times)
    )


PARTS = {
    "c": against_c,
    "algorithm-1": algorithm_1,
    "call": one_call,
    "python-control": against_python_control,
}


def main() -> None:
    """Run the benchmarks and print one table."""
    parser = parser_of(__doc__)
    parser.add_argument("--part", choices=PARTS, action="append")
    parser.add_argument("--trials", type=int, default=15, help="of which the best counts")
    options = options_of(parser, trials=1)
    check_present(options, ["gcc"])
    parts = options.part or list(PARTS)
    needed = {"call": "pyadrc", "python-control": "control"}
    for module in (needed[part] for part in parts if part in needed):
        if importlib.util.find_spec(module) is None:
            not_run(options, f"no package {module} here")
    rows: list[dict[str, object]] = []
    for part in parts:
        PARTS[part](rows, options.trials)
    write(options, show(rows))


if __name__ == "__main__":
    main()
