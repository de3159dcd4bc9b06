"""Single precision beside double: the noise that it adds to u, and long runs.

    python benchmarks/single_precision.py                    # the table: a minute
    python benchmarks/single_precision.py --samples 1e8      # and long runs: 5 min

The table has the RMS difference of u between the two precisions, relative to the RMS of u, for the
controller as it is with its parameters and averages in single precision (*straight*), and with the
observer in delta form and compensated sums (``observers/forms.py``), beside what the prototype of
this form reached (``prototype``); *y* is the RMS difference of y relative to the RMS of the control
error. The step of u from sample to sample shows what the measurement noise does to u. The two-mass
rows are the paper's scenario with other noise.

Long runs follow a sinusoid (*in motion*) or rest, with a load and noise, an order 4 observer,
``Kalman`` and ``Guard``. Of each tenth the RMS error stands beside that of double precision, and
the final covariance shows whether the learner still learns.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.controllers.single import SingleDesign, SinglePrecision
from quell.experiments import two_mass_spring as study
from quell.kernels.single import in_single

CHAIN = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0], [[0.0], [1.0]])
TWO_MASS = ql.plants.two_mass_spring()
HOLD = 0.01  # [s], as in the paper
LOAD = ql.signals.Sinusoid(omega=0.1 * math.pi)


class Straight(SinglePrecision):
    """A controller with rounded parameters, without delta form."""

    def _update_parameters(self) -> None:
        self.parameters = SingleDesign(in_single(self.controller.parameters))

    def initial_state(self) -> Any:
        """Return the state with the observer's own length."""
        return super().initial_state()._replace(z=np.zeros(self.controller.observer.states, "f4"))


class Case(NamedTuple):
    """A row of the table."""

    name: str
    published: float  # reached by the prototype; NaN if not measured
    plant: Any
    controller: Any
    scenario: ql.Scenario


def noise(deviation: float, time: float) -> ql.signals.Signal:
    """Return white noise of a standard deviation, whose values are held for a time [s]."""
    return ql.signals.BandLimitedNoise(deviation**2 * time, time)


def learning(dt: float) -> ql.ADRC:
    """Return the two-mass controller that learns."""
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=dt)
    return ql.ADRC(observer, 1.0, learner=ql.learners.Kalman(), guard=ql.Guard())


def cases() -> Iterator[Case]:
    """Yield the rows of the table."""
    for omega_o, dt, published in ((50.0, 1e-3, 8e-6), (100.0, 1e-4, 6e-5)):
        controller = ql.ADRC(ql.ESO.model_free(2, 1.0, omega_o, dt), omega_o / 10.0)
        scenario = ql.Scenario(
            reference=ql.signals.Sinusoid(),
            disturbances=(ql.signals.Step(at=5.0),),
            noise=noise(1e-4, dt),
            duration=20.0,
        )
        name = f"order 2, ω_o = {omega_o:g}, {1e3 * dt:g} ms"
        yield Case(name, published, CHAIN, controller, scenario)
    for deviation, offset, dt, published in (
        (1e-4, 0.0, 1e-3, 7e-5),
        (1e-6, 0.0, 1e-3, 1e-4),
        (1e-4, 10.0, 1e-3, 1.1e-3),
        (1e-6, 10.0, 1e-3, math.nan),
        (1e-4, 0.0, 1e-4, 8e-5),  # with one of the two; it is not known with which
        (1e-6, 0.0, 1e-4, 8e-5),
    ):
        usual = study.scenario(study.Settings(dt=dt))
        scenario = dataclasses.replace(
            usual,
            reference=usual.reference + offset,
            noise=noise(deviation, HOLD),
            x0=(offset, offset, 0.0, 0.0),
        )
        place = f", y around {offset:g}" if offset else ""
        name = f"two-mass, {1e3 * dt:g} ms, noise {deviation:g}{place}"
        yield Case(name, published, TWO_MASS, learning(dt), scenario)


def rms(values: Any) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def show_table(console: Console, only: str) -> dict[str, Any]:
    """Print and return the differences between the precisions."""
    table = Table("", "straight", "single", "prototype", "y", "step of u", title="RMS, relative")
    found: dict[str, Any] = {}
    for case in cases():
        if only not in case.name:
            continue
        arguments = case.plant, case.controller, case.scenario
        double, single = (
            ql.simulate(*arguments, precision=precision) for precision in ("double", "single")
        )
        straight = ql.simulate(case.plant, Straight(case.controller), case.scenario)
        u, error = double["u"], double["r"] - double["y"]
        numbers = (
            *(rms(run["u"] - u) / rms(u) for run in (straight, single)),
            case.published,
            rms(single["y"] - double["y"]) / rms(error),
            rms(np.diff(u)) / rms(u),
        )
        table.add_row(case.name, *(f"{number:.1e}" for number in numbers))
        names = ("straight", "single", "prototype", "y", "step of u")
        found[case.name] = {
            name: number if math.isfinite(number) else "not measured"
            for name, number in zip(names, numbers, strict=True)
        }
    console.print(table)
    return found


def show_long_runs(console: Console, samples: int, dt: float = 1e-3) -> dict[str, Any]:
    """Print and return the errors of both precisions in each tenth of a long run."""
    table = Table("run", "s", "status", *(f"{i + 1}/10" for i in range(10)), "authority", "trace P")
    found: dict[str, Any] = {}
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
            authority = float(np.mean(run["authority"][-1000:]))
            trace = float(np.trace(run.final_state.learner.covariance))
            found[f"{name}, {precision}"] = {
                "samples": samples,
                "seconds": wall,
                "status": int(run.status),
                "rms of each tenth": errors,
                "authority": authority,
                "trace of P": trace,
            }
            table.add_row(
                f"{name}, {precision}",
                f"{wall:.0f}",
                f"{int(run.status)}{finite}",
                *(f"{error:.3g}" for error in errors),
                f"{authority:.2f}",
                f"{trace:.4g}",
            )
    console.print(table)
    return found


def main() -> None:
    """Run what the command line asks for."""
    parser = parser_of(__doc__)
    parser.add_argument("--samples", type=float, default=0.0, help="length of the long runs")
    parser.add_argument("--only", default="", help="rows whose name contains this")
    arguments = options_of(parser, only="two-mass, 1 ms, noise 0.0001", samples=1e4)
    console = Console(width=160)
    figures: dict[str, Any] = {"table": show_table(console, arguments.only)}
    if arguments.samples:
        figures["long runs"] = show_long_runs(console, int(arguments.samples))
    write(arguments, figures)


if __name__ == "__main__":
    main()
