"""Single precision beside double: the noise that it adds to u, and long runs.

    python benchmarks/single_precision.py                    # the table: a minute
    python benchmarks/single_precision.py --samples 1e8      # and long runs: 5 min

The table has the RMS difference of u between the two precisions, relative to the RMS of u, for the
controller as it is with its parameters rounded (*straight*), and in delta form with compensated
sums (``observers/delta.py``), beside what METHOD, the note on which this package rests, measured
for the delta form; *y* is the RMS difference of y relative to the RMS of the control error. The
step of u from sample to sample shows what the measurement noise does to u.

Long runs follow a sinusoid (*in motion*) or rest, with a load and noise, an order 4 observer,
``Kalman`` and ``Guard``. Of each tenth the RMS error stands beside that of double precision, and
the final covariance shows whether the learner still learns.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.controllers.single import SinglePrecision
from quell.controllers.single.single import SingleDesign
from quell.kernels.single import in_single

CHAIN = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0], [[0.0], [1.0]])
TWO_MASS = ql.plants.two_mass_spring()
LOAD = ql.signals.Sinusoid(omega=0.1 * math.pi)


class Straight(SinglePrecision):
    """A controller with rounded parameters, without delta form."""

    def _update_parameters(self) -> None:
        self.parameters = SingleDesign(in_single(self.controller.parameters))

    def initial_state(self) -> Any:
        """Return the rounded state."""
        return in_single(self.controller.initial_state())


class Case(NamedTuple):
    """A row of the table."""

    name: str
    published: float  # METHOD, section 11, last column
    plant: Any
    controller: Any
    scenario: ql.Scenario
    after: float  # u is compared from this time on [s]


def noise(deviation: float, dt: float) -> ql.signals.Signal:
    """Return white noise of a standard deviation in each sample."""
    return ql.signals.BandLimitedNoise(deviation**2 * dt, dt)


def learning(dt: float, learner: Any = None) -> ql.ADRC:
    """Return the two-mass controller that learns."""
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=dt)
    return ql.ADRC(observer, 1.0, learner=learner or ql.learners.Kalman(), guard=ql.Guard())


def cases() -> Iterator[Case]:
    """Yield the rows of METHOD's table, the last one for each noise."""
    for omega_o, dt, published in ((50.0, 1e-3, 8e-6), (100.0, 1e-4, 6e-5)):
        controller = ql.ADRC(ql.ESO.model_free(2, 1.0, omega_o, dt), omega_o / 10.0)
        scenario = ql.Scenario(
            reference=ql.signals.Sinusoid(),
            disturbances=(ql.signals.Step(at=5.0),),
            noise=noise(1e-4, dt),
            duration=20.0,
        )
        name = f"order 2, ω_o = {omega_o:g}, {1e3 * dt:g} ms"
        yield Case(name, published, CHAIN, controller, scenario, 0.0)
    for deviation, offset, dt, published in (
        (1e-4, 0.0, 1e-3, 7e-5),
        (1e-6, 0.0, 1e-3, 1e-4),
        (1e-4, 10.0, 1e-3, 1.1e-3),
        (1e-6, 10.0, 1e-3, 1.1e-3),
        (1e-4, 0.0, 1e-4, 8e-5),
        (1e-6, 0.0, 1e-4, 8e-5),
    ):
        scenario = ql.Scenario(
            reference=ql.signals.Sinusoid() + offset,
            disturbances=(0.0, LOAD),
            noise=noise(deviation, dt),
            duration=200.0,
            x0=(offset, offset, 0.0, 0.0),
        )
        place = f", y around {offset:g}" if offset else ""
        name = f"two-mass, {1e3 * dt:g} ms, noise {deviation:g}{place}"
        yield Case(name, published, TWO_MASS, learning(dt), scenario, 50.0)


def rms(values: Any) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def show_table(console: Console) -> None:
    """Print the differences between the precisions."""
    table = Table("", "straight", "single", "METHOD", "y", "step of u", title="RMS, relative")
    for case in cases():
        arguments = case.plant, case.controller, case.scenario
        double, single = (
            ql.simulate(*arguments, precision=precision) for precision in ("double", "single")
        )
        straight = ql.simulate(case.plant, Straight(case.controller), case.scenario)
        part = double.t >= case.after
        u, error = double["u"][part], (double["r"] - double["y"])[part]
        numbers = (
            *(rms(run["u"][part] - u) / rms(u) for run in (straight, single)),
            case.published,
            rms((single["y"] - double["y"])[part]) / rms(error),
            rms(np.diff(u)) / rms(u),
        )
        table.add_row(case.name, *(f"{number:.1e}" for number in numbers))
    console.print(table)


def show_long_runs(console: Console, samples: int, dt: float = 1e-3) -> None:
    """Print the errors of both precisions in each tenth of a long run."""
    table = Table("run", "s", "status", *(f"{i + 1}/10" for i in range(10)), "authority", "trace P")
    for name, reference in (("motion", ql.signals.Sinusoid()), ("rest", ql.signals.Constant(0.0))):
        scenario = ql.Scenario(
            reference=reference,
            disturbances=(0.0, LOAD),
            noise=noise(1e-4, dt),
            duration=samples * dt,
        )
        for precision in ("double", "single"):
            start = time.perf_counter()
            run = ql.simulate(
                *(TWO_MASS, learning(dt), scenario),
                precision=precision,
                record_every=max(samples // 100_000, 1),
            )
            wall = time.perf_counter() - start
            errors = [rms(part) for part in np.array_split(run["r"] - run["y"], 10)]
            finite = "" if np.all(np.isfinite(run.log)) else ", not finite"
            table.add_row(
                f"{name}, {precision}",
                f"{wall:.0f}",
                f"{int(run.status)}{finite}",
                *(f"{error:.3g}" for error in errors),
                f"{np.mean(run['authority'][-1000:]):.2f}",
                f"{np.trace(run.final_state.learner.covariance):.4g}",
            )
    console.print(table)


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=float, default=0.0, help="length of the long runs")
    arguments = parser.parse_args()
    console = Console(width=160)
    show_table(console)
    if arguments.samples:
        show_long_runs(console, int(arguments.samples))


if __name__ == "__main__":
    main()
