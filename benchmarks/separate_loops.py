"""Machines with coupled axes, a guarded loop for each alone, with b0 from 0.3 to 1.5 of the gain.

    python benchmarks/separate_loops.py [--machines 20] [--seed 1] [--seconds 60] [--kind arms]

What ``coupled_arms.py`` asks of two-link arms, for

* *arms* with three rigid joints (``ql.plants.arm``), with and without gravity, and motors of 0.3 to
  3 times the inertia of the links (without motors the eigenvalues of the coupled gains are from 0.1
  to 7, and none of 24 arms has a margin of 0.1);
* *gantries*: two axes whose inertias are coupled, a constant M with drag;
* *craft*: the attitude of a quadrotor (``ql.plants.quadrotor_attitude``), whose rotors lag.

Each axis has an ADRC of order 2 with ``feedforward=True`` for the chain of integrators, and B0 is
the diagonal part of the machine's gains (of a craft its B0), times a share for each axis. All axes
follow sinusoids, and a sinusoidal load acts at each. A machine counts if the modulus margin of its
loop without learner, linearised at three points of the motion, is at least 0.1. The figure of a
machine is the RMS error of y against r with learner and guard over that without learner, from 2 s
on, for the axis that loses more.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from coupled_arms import LEARNERS, LEAST_MARGIN, row_of
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.analysis import analyse
from quell.experiments.stress.adversaries import log_uniform
from quell.parallel import in_parallel
from quell.types import Matrix, Vector

DT, NOISE, JUDGED_AT = 2e-3, 2e-5, 2.0
KINDS = ("arms", "gantries", "craft")


class Machine(NamedTuple):
    """A machine, its loops, and what it does."""

    plant: Any
    B0: Matrix
    omega_c: float  # of each axis [rad/s]; omega_o is five times that
    middle: Vector  # of the reference of each axis
    amplitudes: Vector
    frequencies: Vector  # [rad/s]
    loads: Vector  # amplitudes of the disturbances
    most: float  # largest control signal


def draw(kind: str, seed: int) -> Machine:
    """Return a machine."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    n = 2 if kind == "gantries" else 3

    def each(low: float, high: float) -> Vector:
        return rng.uniform(low, high, n)

    shares = np.array([log_uniform(rng, 0.3, 1.5)] * n)
    if rng.random() < 0.5:  # each axis has an error of its own
        shares = np.array([log_uniform(rng, 0.3, 1.5) for _ in range(n)])
    frequencies = np.array([log_uniform(rng, 0.5, 3.0) for _ in range(n)])
    if kind == "arms":
        gravity = 9.81 * float(rng.integers(2))
        links = tuple(each(0.2, 0.5)), tuple(each(0.5, 2.0))
        middle = np.append(0.0, rng.uniform(0.3, 1.5, 2))
        motors = np.diag(ql.plants.arm(*links).mass_matrix(middle)) * each(0.3, 3.0)
        arm = ql.plants.arm(*links, gravity=gravity, motor_inertia=tuple(motors))
        gains = np.diag(np.linalg.inv(arm.mass_matrix(middle)))
        return Machine(
            arm, np.diag(shares * gains), 10.0, middle, each(0.2, 0.6), frequencies, np.zeros(n),
            400.0,
        )  # fmt: skip
    if kind == "gantries":
        masses, share = each(1.0, 5.0), rng.uniform(0.1, 0.7)
        M = np.diag(masses) + share * math.sqrt(masses.prod()) * (1.0 - np.eye(2))
        inverse, drag = np.linalg.inv(M), np.diag(each(0.5, 5.0))
        A = np.block([[np.zeros((2, 2)), np.eye(2)], [np.zeros((2, 2)), -inverse @ drag]])
        B = np.vstack([np.zeros((2, 2)), inverse])
        plant = ql.plants.LinearPlant(A, B, np.eye(2, 4))
        return Machine(
            plant, np.diag(shares * np.diag(inverse)), 10.0, np.zeros(n), each(0.1, 0.5),
            frequencies, masses * each(0.5, 3.0), 400.0,
        )  # fmt: skip
    inertia = rng.uniform(0.008, 0.02, 3)
    craft = ql.plants.quadrotor_attitude(tuple(inertia), motor_lag=float(rng.uniform(0.005, 0.02)))
    return Machine(
        craft, shares[:, None] * craft.B0, 6.0, np.zeros(n), each(0.1, 0.4), frequencies,
        inertia * each(0.5, 3.0), 20.0,
    )  # fmt: skip


def controller(machine: Machine, learner: Any, guard: ql.Guard | None) -> ql.Axes:
    """Return the loops of the axes."""
    observer = ql.ESO.model_free(2, 1.0, 5.0 * machine.omega_c, DT)
    axis = ql.ADRC(observer, machine.omega_c, learner=learner, guard=guard, feedforward=True)
    count = machine.middle.size
    return ql.Axes([axis] * count, machine.B0, u_min=-machine.most, u_max=machine.most)


def state_at(machine: Machine, y: Vector) -> Vector:
    """Return the state at rest with these outputs, which are the first states of all machines."""
    return np.append(y, np.zeros(machine.plant.order - y.size))


def margin(machine: Machine) -> float:
    """Return the least modulus margin without learner over the motion; 0 if it is unstable."""
    loops, found = controller(machine, None, None), []
    for share in (-1.0, 0.0, 1.0):
        y = machine.middle + share * machine.amplitudes
        point = None
        if not isinstance(machine.plant, ql.plants.LinearPlant):
            point = state_at(machine, y), np.zeros(machine.plant.inputs)
        loop = analyse(machine.plant, loops, point)
        found.append(1.0 / loop.m_s("outputs").value if loop.stable else 0.0)
    return min(found)


def errors(
    machine: Machine, learner: Any, guard: ql.Guard | None, seconds: float, seed: int, quick: bool
) -> Vector:
    """Return the RMS errors of the axes; infinite if the machine is lost."""
    reference = [
        ql.signals.Step(float(middle)) + ql.signals.Sinusoid(float(size), omega=float(omega))
        for middle, size, omega in zip(
            machine.middle, machine.amplitudes, machine.frequencies, strict=True
        )
    ]
    loads = [ql.signals.Sinusoid(float(size), omega=1.7) for size in machine.loads]
    count = machine.middle.size
    scenario = ql.Scenario(
        reference, seconds, loads,
        [ql.signals.BandLimitedNoise(power=NOISE**2 * DT, sample_time=DT)] * count,
        x0=state_at(machine, machine.middle), seed=seed,
    )  # fmt: skip
    run = ql.simulate(machine.plant, controller(machine, learner, guard), scenario, interpret=quick)
    if run.lost:
        return np.full(count, math.inf)
    error = (run["y"] - run["r"])[round(min(JUDGED_AT, 0.5 * seconds) / DT) :]
    found: Vector = np.sqrt(np.mean(error**2, axis=0))
    return found


def judge(kind: str, seed: int, seconds: float, quick: bool) -> dict[str, float] | None:
    """Return the worse axis' ratio with each learner; None if it is lost or rings without."""
    machine = draw(kind, seed)
    least = margin(machine)
    if least < LEAST_MARGIN and not quick:
        return None
    plain = errors(machine, None, None, seconds, seed, quick)
    if not np.isfinite(plain.max()):
        return None
    found = {
        name: float((errors(machine, each, ql.Guard(), seconds, seed, quick) / plain).max())
        for name, each in LEARNERS.items()
    }
    return found | {"margin": least, "seed": seed}


def main() -> None:
    """Run the trial and print its figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--machines", type=int, default=20, help="drawn of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--kind", choices=KINDS, help="only this one")
    options = options_of(parser, machines=1, seconds=0.1)
    console, figures = Console(), {"drawn": options.machines}
    for kind in [options.kind] if options.kind else KINDS:
        work = partial(judge, kind, seconds=options.seconds, quick=options.quick)
        seeds = [1000 * options.seed + i for i in range(options.machines)]
        results = [work(s) for s in seeds] if options.quick else in_parallel(
            [partial(work, seed) for seed in seeds]
        )  # fmt: skip
        counted = [each for each in results if each is not None]
        if not counted:
            console.print(f"{kind}: none of {options.machines} counts")
            continue
        figures[kind] = {"counted": len(counted)} | {n: row_of(counted, n) for n in LEARNERS}
        heads = ("learner", "counted", "median", "worst", "above 1.1", "mean log")
        table = Table(*heads, title=f"{kind}: over no learner")
        for name in LEARNERS:
            row = (f"{each:.4g}" for each in figures[kind][name].values())
            table.add_row(name, str(len(counted)), *row)
        console.print(table)
        worst = sorted(((e[n], n, e) for e in counted for n in LEARNERS), key=lambda row: -row[0])
        for value, name, each in worst[:3]:
            console.print(f"{value:.3g}: {name}, seed {each['seed']}, margin {each['margin']:.2f}")
    write(options, figures)


if __name__ == "__main__":
    main()
