"""FMUs of every controller and plant of the contract tests, against the interpreted kernels.

    python benchmarks/fmus.py [--part all|axes] [--samples 1000] [--most 3]

Each controller becomes an FMU, which FMPy validates and runs with a sine as reference, noise, and
NaN now and then; its u is compared with that of ``step``, interpreted. Each plant becomes an FMU
that is a plant again by ``quell.plants.FMU``, in a loop with a controller; y is compared with that
of the plant itself. An arm in C (``tests/fmu_plant.c``) is the plant of two axes, beside
``quell.plants.arm``. At last the time of a sample in which ``simulate`` calls an FMU is measured,
of one signal and of two axes. ``--part axes`` does only what is about axes, ``--most`` takes so
many controllers and plants.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from measured import check_present, options_of, parser_of, write

import quell as ql
from quell.export import TranslationError, fmu
from quell.kernels import dispatch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from fmpy.validation import validate_fmu

from tests.contracts.examples import LEARNERS, OBSERVERS, PLANTS
from tests.contracts.test_controllers import CONTROLLERS
from tests.fmus import Driven, contents, packed

DT = 0.01


def controllers() -> dict[str, Any]:
    """Return those of the contract tests, and an ADRC with each learner and each observer."""
    found = dict(CONTROLLERS)
    for name, learner in LEARNERS.items():
        observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=DT)
        limits = {"u_min": -8.0, "u_max": 8.0}
        law = ql.ADRC(observer, omega_c=3.0, learner=learner, guard=ql.Guard(), **limits)
        found[f"learner: {name}"] = law
    for name, observer in OBSERVERS.items():
        found[f"observer: {name}"] = ql.ADRC(observer, omega_c=2.0, u_min=-8.0, u_max=8.0)
    return found


def deviation(law: Any, running: Driven, samples: int) -> float:
    """Return the largest difference of u, relative to the largest of 1 and u."""
    rng, worst = np.random.default_rng(0), 0.0
    count = sum(name.startswith("r_derivative") for name in running.references)
    for k in range(samples):
        r, y = math.sin(0.05 * k), 0.8 * math.sin(0.05 * k - 0.2) + 0.01 * rng.normal()
        y = math.nan if k % 101 == 100 else y
        more = {f"r_derivative[{i + 1}]": 0.1 * i for i in range(count)}
        u = law.step(r, y, *more.values()) if more else law.step(r, y)
        worst = max(worst, abs(running.step(law.dt, r=r, y=y, **more) - u) / max(1.0, abs(u)))
    return worst


def plant_deviation(plant: Any, path: Path, samples: int) -> float:
    """Return the largest difference of y between a plant and its FMU in a loop, relative to y."""
    law = ql.ADRC(ql.ESO.model_free(order=2, b0=5.0, omega_o=20.0, dt=DT), omega_c=2.0)
    w = [f"w[{i + 1}]" for i in range(plant.disturbances)]
    scenario = ql.Scenario(0.5, samples * DT, disturbances=[0.1] * len(w))
    runs = [ql.simulate(p, law, scenario)["y"] for p in (plant, ql.plants.FMU(path, w=w))]
    length = min(map(len, runs))
    y = runs[0][:length]
    scale = max(1.0, float(np.max(np.abs(y))))
    return float(np.max(np.abs(runs[1][:length] - y))) / scale


def sample_time(path: Path, seconds: float) -> float:
    """Return the processor time of a sample of a compiled loop that calls an FMU [s]."""
    law = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=DT), omega_c=3.0)
    plant, scenario = ql.plants.FMU(path, w=["w[1]"]), ql.Scenario(1.0, seconds)
    ql.simulate(plant, law, ql.Scenario(1.0, 1.0))
    times = []
    for _ in range(5):  # the machine may be busy with other things
        begin = time.process_time()
        samples = len(ql.simulate(plant, law, scenario).t)
        times.append((time.process_time() - begin) / samples)
    return min(times)


def axes_of_arm(path: Path, duration: float) -> tuple[float, float, float]:
    """Return the largest difference of y of an arm and its FMU, and times of a sample of both."""
    joints = [
        ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3), omega_c=8.0)
        for _ in range(2)
    ]
    own = ql.plants.arm(substeps=1)
    law = ql.Axes(joints, M=own.mass_matrix([0.0, 0.5]), u_min=-40.0, u_max=40.0)
    packed(path, contents(3, "arm"))
    other = ql.plants.MultivariableFMU(
        path, u=["tau[1]", "tau[2]"], w=["push[1]", "push[2]"], states=["v[1]", "v[2]"]
    )
    sines = (ql.signals.Sinusoid(0.5, 2.0), ql.signals.Sinusoid(0.8, 3.0))
    scenario = ql.Scenario(sines, duration, disturbances=(0.5, 0.2))
    runs, times = [], []
    for plant in (own, other):
        ql.simulate(plant, law, ql.Scenario(0.0, 0.1))
        found = []
        for _ in range(5):
            begin = time.process_time()
            run = ql.simulate(plant, law, scenario)
            found.append((time.process_time() - begin) / len(run))
        times.append(min(found))
        runs.append(run["y"])
    return float(np.max(np.abs(runs[0] - runs[1]))), *times


def main() -> None:
    """Run the trial."""
    parser = parser_of(__doc__)
    parser.add_argument("--part", choices=("all", "axes"), default="all")
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=20.0, help="run of the arm")
    parser.add_argument("--most", type=int, help="controllers, and plants")
    options = options_of(parser, samples=50, seconds=0.5, most=1)
    check_present(options, tools=["gcc"])
    warnings.simplefilter("ignore")
    invalid = 0
    found: dict[str, Any] = {"controllers": {}, "refused": [], "plants": {}}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        dispatch.interpret_all = True
        both = options.part == "all"
        for i, (label, law) in enumerate(
            list(controllers().items())[: options.most] if both else ()
        ):
            path = folder / f"c{i}.fmu"
            try:
                fmu(law, path)
            except TranslationError:
                found["refused"].append(label)
                continue
            problems = validate_fmu(str(path))
            running = Driven(path, folder / f"c{i}").begin()
            worst = deviation(law, running, options.samples)
            running.free()
            found["controllers"][label] = worst
            invalid += bool(problems)
            print(f"{label:45} {worst:8.1e} {' '.join(problems)}")
        for i, (label, plant) in enumerate(list(PLANTS.items())[: options.most] if both else ()):
            path = folder / f"p{i}.fmu"
            fmu(plant, path, dt=DT)
            worst = plant_deviation(plant, path, options.samples)
            found["plants"][label] = worst
            print(f"plant: {label:38} {worst:8.1e} {' '.join(validate_fmu(str(path)))}")
        # A short run is quicker interpreted than to compile.
        dispatch.interpret_all = options.quick
        fmu(ql.plants.LinearPlant.of(([1.0], [1.0, 0.0, 0.0])), folder / "mass.fmu", dt=DT)
        found["sample_time"] = sample_time(folder / "mass.fmu", 10.0 * options.seconds)
        found["axes"] = axes_of_arm(folder / "arm.fmu", options.seconds)
    if both:
        print(f"refused: {', '.join(found['refused'])}")
        for kind in ("controllers", "plants"):
            worst = max(found[kind].values())
            print(f"{len(found[kind])} {kind}: largest deviation {worst:.1e}")
    worst, own, other = found["axes"]
    print(f"an arm of two axes over {options.seconds:g} s: largest deviation {worst:.1e}")
    print(f"a sample of simulate with an FMU: {1e6 * found['sample_time']:.1f} µs; of two axes "
          f"{1e6 * other:.1f} µs, with a plant of quell {1e6 * own:.1f} µs")  # fmt: skip
    figures = {
        "sample with an FMU [us]": 1e6 * found["sample_time"],
        "axes": {
            "deviation of the arm [rad]": worst,
            "sample with an FMU [us]": 1e6 * other,
            "sample with a plant of quell [us]": 1e6 * own,
        },
    }
    if both:
        figures |= {"invalid": invalid, "refused": found["refused"]}
        for kind in ("controllers", "plants"):
            figures[kind] = {
                "number": len(found[kind]),
                "largest deviation": max(found[kind].values()),
            }
    write(options, figures)


if __name__ == "__main__":
    main()
