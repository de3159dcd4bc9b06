"""Cost of the learners and of the guard.

    python benchmarks/learners.py [--quick] [--json FILE]

The first 60 s of the study's two-mass loop at 1 ms, without recording, as ratios of the best of
several interleaved trials. The reference is the same loop with the Kalman learner in C
(``reference.c``), timed among them. A *loop sample* is plant and controller; a *step* is the
controller alone, called from compiled code with r and y from a table; ``controller.step`` is called
from Python.
"""

from __future__ import annotations

import copy
import dataclasses
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from c_reference import best, c_reference, row, show
from measured import check_present, options_of, parser_of, write

import quell as ql
from quell.controllers.base import control
from quell.experiments import two_mass_spring as study
from quell.features import RBF, Bias, Input, RandomFourier, State
from quell.kernels.dispatch import call_specialised, compiled
from quell.learners.online import infer, learn

DURATION = 60.0
SETTINGS = study.Settings()
SAMPLES = round(DURATION / SETTINGS.dt) + 1
PLANT = ql.plants.two_mass_spring()
SCENARIO = dataclasses.replace(study.scenario(SETTINGS), duration=DURATION, rest_at=())


class LmsDesign(NamedTuple):
    """Parameters of a user-defined model."""

    width: int
    rate: float


class LmsMemory(NamedTuple):
    """State of a user-defined model."""

    theta: Any


class Lms:
    """A linear model, learned by normalised gradient descent."""

    def design(self, features: int, dt: float) -> LmsDesign:
        """Return the parameters."""
        return LmsDesign(features, 2.0 * dt)

    def memory(self, parameters: LmsDesign) -> LmsMemory:
        """Return the state."""
        return LmsMemory(np.zeros(parameters.width))


@infer.register(LmsDesign)
def _infer(model: LmsDesign, memory: LmsMemory, features: Any) -> float:
    total = 0.0
    for i in range(model.width):
        total += memory.theta[i] * features[i]
    return total


@learn.register(LmsDesign)
def _learn(model: LmsDesign, memory: LmsMemory, features: Any, target: float) -> None:
    error, power = target - infer(model, memory, features), 1.0
    for i in range(model.width):
        power += features[i] * features[i]
    for i in range(model.width):
        memory.theta[i] += model.rate * error * features[i] / power


class PythonLms:
    """The same model as a Python object."""

    def __init__(self) -> None:
        self.theta = np.zeros(4)

    def learn(self, features: np.ndarray, targets: np.ndarray) -> None:
        """Take a gradient step for each pair."""
        for phi, target in zip(features, targets, strict=True):
            self.theta += 2e-3 * (target - self.theta @ phi) * phi / (1.0 + phi @ phi)

    def predict(self, features: np.ndarray) -> float:
        """Return θ·φ."""
        return float(self.theta @ features)


LEARNERS: dict[str, Any] = {
    "none": ql.learners.NoLearner(),
    "BatchGradient (Algorithm 1)": ql.learners.BatchGradient(
        rate=study.gradient_rate(SETTINGS), batch=study.GRADIENT_BATCH
    ),
    "NLMS": ql.learners.NLMS(),
    "RLS": ql.learners.RLS(),
    "Kalman": ql.learners.Kalman(),
    "Kalman with u": ql.learners.Kalman(u=True),
    "Harmonic": ql.learners.Harmonic(),
    "Harmonic, two": ql.learners.Harmonic(count=2),
    "RLS, 25 radial features": ql.learners.RLS(RBF(25)),
    "NLMS, 50 random features": ql.learners.NLMS(features=RandomFourier(50)),
    "MLP": ql.learners.MLP(),
    "GaussianProcess": ql.learners.GaussianProcess(),
    "a model of one's own": ql.learners.Online(Lms(), State() + Bias() + Input()),
    "PythonModel, every 10 samples": ql.learners.PythonModel(PythonLms(), period=10),
}
GUARDED = ("Kalman", "Harmonic")


def law(learner: Any, guard: ql.Guard | None = None) -> ql.ADRC:
    """Return the study's controller with the given learner."""
    return ql.ADRC(
        study.controller(SETTINGS).observer, SETTINGS.omega_c, learner=learner, guard=guard
    )


def with_one_tap(controller: ql.ADRC) -> ql.ADRC:
    """Return a copy with a single lag in place of each exact filter, except in the guard."""
    other, parameters = copy.copy(controller), controller.parameters
    exact = parameters.lag
    rise = exact.rise / exact.taps.size
    one = exact._replace(pole=1.0 - rise, rise=rise, taps=np.ones(1))
    other.parameters = parameters._replace(lag=one, learner=parameters.learner._replace(lag=one))
    return other


def loop(controller: ql.ADRC) -> Any:
    """Return a function that runs the closed loop."""
    return lambda: ql.simulate(PLANT, controller, SCENARIO, record_every=SAMPLES)


@compiled
def steps(design: Any, state: Any, r: Any, y: Any) -> float:
    """Run the controller on all samples of a table; return the last u."""
    u = 0.0
    for k in range(r.size):
        u = control(design, state, r[k], y[k])
    return u


def stepping(controller: ql.ADRC, r: np.ndarray, y: np.ndarray) -> Any:
    """Return a function that runs the controller alone."""
    return lambda: call_specialised(steps, controller.parameters, controller.initial_state(), r, y)


def nanoseconds(*runs: float, of: str) -> str:
    """Return the time per sample as text, for the given times of a run [s]."""
    return " / ".join(f"{run / SAMPLES * 1e9:.0f}" for run in runs) + f" ns a {of}"


def learners(rows: list[dict[str, object]], only: list[str], trials: int) -> None:
    """Time the loop with each learner and the loop in C."""
    with tempfile.TemporaryDirectory() as folder:
        reference = c_reference(Path(folder), SETTINGS, DURATION)
        laws = {name: law(learner) for name, learner in LEARNERS.items() if name in only}
        for controller in laws.values():
            loop(controller)()  # compiles
        c, *ours = best(lambda: reference(False), *map(loop, laws.values()), trials=trials)
    for name, took in zip(laws, ours, strict=True):
        bar = "≤ 2" if name == "Kalman" else ""
        rows.append(
            row(
                f"closed loop, {name} / C with Kalman",
                took / c,
                bar,
                nanoseconds(took, c, of="loop sample"),
            )
        )


def guard(rows: list[dict[str, object]], only: list[str], trials: int) -> None:
    """Time the guard and the exact lag filter, in the loop and alone."""
    run = ql.simulate(PLANT, law(LEARNERS["Kalman"]), SCENARIO)
    r, y = run["r"].copy(), run["y_measured"].copy()
    for name in (each for each in GUARDED if each in only):
        plain, guarded = law(LEARNERS[name]), law(LEARNERS[name], ql.Guard())
        candidates = [guarded, plain, with_one_tap(plain)]
        for what, made in (("loop sample", loop), ("step", lambda c: stepping(c, r, y))):
            runs = [made(candidate) for candidate in candidates]
            for run in runs:
                run()  # compiles
            both, learner, bare = best(*runs, trials=3 * trials)
            for label, one, other, bar in (
                ("with guard / without", both, learner, "≤ 1.4"),
                ("exact lag filter / one tap", learner, bare, ""),
                ("guard and exact lag filter / neither", both, bare, ""),
            ):
                rows.append(
                    row(
                        f"{what}, {name}: {label}",
                        one / other,
                        bar,
                        nanoseconds(one, other, of=what),
                    )
                )


def from_python(rows: list[dict[str, object]], only: list[str], trials: int) -> None:
    """Time ``controller.step`` with and without guard."""
    run = ql.simulate(PLANT, law(LEARNERS["Kalman"]), SCENARIO)
    r, y = run["r"].tolist(), run["y_measured"].tolist()

    def stepping_from_python(controller: ql.ADRC) -> Any:
        def call() -> None:
            controller.reset()
            for now, measured in zip(r, y, strict=True):
                controller.step(now, measured)

        controller.prepare()
        return call

    for name in (each for each in GUARDED if each in only):
        both, learner = best(
            *(stepping_from_python(law(LEARNERS[name], guard)) for guard in (ql.Guard(), None)),
            trials=trials,
        )
        times = nanoseconds(both, learner, of="controller.step")
        rows.append(
            row(f"controller.step, {name}: with guard / without", both / learner, "≤ 1.4", times)
        )


def main() -> None:
    """Run all benchmarks and print one table."""
    parser = parser_of(__doc__)
    parser.add_argument("--trials", type=int, default=11, help="of which the best counts")
    parser.add_argument("--only", nargs="+", choices=LEARNERS, default=[*LEARNERS])
    options = options_of(parser, trials=1, only=["none", "Kalman"])
    check_present(options, ["gcc"])
    rows: list[dict[str, object]] = []
    for measure in (learners, guard, from_python):
        measure(rows, options.only, options.trials)
    write(options, show(rows))


if __name__ == "__main__":
    main()
