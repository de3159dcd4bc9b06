"""Arms whose joints have controllers of their own, with b0 from 0.3 to 1.5 of the gain.

    python benchmarks/coupled_arms.py [--arms 200] [--seed 1] [--seconds 60] [--no-guard]

A rigid two-link arm (``experiments.stress.axes``) moves fast; each joint has an ADRC of order 2
with ``feedforward=True`` (omega_c = 10, omega_o = 50 rad/s, dt = 2 ms, limits of the torque) for
the chain of integrators, which takes all of the coupling for a disturbance, and whose b0 is 0.3 to
1.5 times the gain (M⁻¹)_ii of its joint. Where b0 is less than half of it, a learner that feeds
forward all that it explains closes a loop whose gain is above one, (b/b0 − 1).

Without learner the loop of such an arm is, at a fixed q and without gravity, that of one joint
with b/b0 = λ for each eigenvalue λ of ``M⁻¹ diag(1/b0)``. An arm counts if the modulus margin of
these loops is at least 0.1 over the whole motion: many draws are unstable in a part of the motion,
and no guard can hold a loop that rings without learner; they are listed apart. The figure of an arm
is the RMS error of y against r with learner and guard over that without learner, from 2 s on, for
the joint that loses more.
"""

from __future__ import annotations

import math
from functools import cache, partial
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table as Rows

import quell as ql
from quell.analysis import analyse
from quell.experiments.stress.adversaries import log_uniform
from quell.experiments.stress.axes import Arm
from quell.experiments.stress.loops import Table
from quell.kernels import dispatch
from quell.parallel import in_parallel
from quell.types import Vector

DT, OMEGA_C, OMEGA_O, NOISE, LIMIT = 2e-3, 10.0, 50.0, 2e-5, 20.0
JUDGED_AT = 2.0  # start of what is judged [s]
LEAST_MARGIN = 0.1  # modulus margin without learner of an arm that counts
MOST = 1.1  # bar
LEARNERS: dict[str, Any] = {
    "Kalman": ql.learners.Kalman(),
    "Harmonic": ql.learners.Harmonic(),
    "RLS": ql.learners.RLS(),
}


def draw(seed: int) -> tuple[Arm, Vector]:
    """Return an arm and b0/b of its joints."""
    rng = np.random.default_rng(seed)

    def two(low: float, high: float) -> tuple[float, float]:
        return float(rng.uniform(low, high)), float(rng.uniform(low, high))

    first = log_uniform(rng, 0.5, 4.0)
    arm = Arm(
        lengths=two(0.3, 0.6),
        masses=two(0.5, 2.0),
        gravity=9.81 * float(rng.integers(2)),
        elbow=float(rng.uniform(0.2 * math.pi, 0.8 * math.pi)),
        amplitudes=two(0.2, 1.0),
        frequencies=(first, first if rng.random() < 0.3 else log_uniform(rng, 0.5, 4.0)),
        too_small=1.0,
        margin=0.0,
        seed=seed,
    )
    shares = np.array([log_uniform(rng, 0.3, 1.5)] * 2)
    if rng.random() < 0.5:  # each joint has an error of its own
        shares[1] = log_uniform(rng, 0.3, 1.5)
    return arm, shares


def controller(arm: Arm, shares: Vector, learner: Any, guard: ql.Guard | None) -> ql.Axes:
    """Return the controllers of the joints."""
    most = 3.0 * (float(np.diag(arm.inertia(arm.elbow)).max()) * 16.0 + 2.0 * 9.81 * 1.2)
    gains = shares * np.diag(np.linalg.inv(arm.inertia(arm.elbow)))
    joints = [
        ql.ADRC(
            ql.ESO.model_free(2, float(b0), OMEGA_O, DT), OMEGA_C, learner=learner, guard=guard,
            feedforward=True,
        )
        for b0 in gains
    ]  # fmt: skip
    return ql.Axes(joints, u_min=-most, u_max=most)


def errors(
    arm: Arm, shares: Vector, learner: Any, guard: ql.Guard | None, seconds: float, interpret: bool
) -> Vector:
    """Return the RMS errors of the joints [rad]; infinite if the arm is lost."""
    middle, motion = (0.0, arm.elbow), zip(arm.amplitudes, arm.frequencies, strict=True)
    moves = [ql.signals.Sinusoid(size, omega) for size, omega in motion]
    reference = [ql.signals.Step(at) + move for at, move in zip(middle, moves, strict=True)]
    rates = np.array(arm.amplitudes) * np.array(arm.frequencies)
    count = round(seconds / DT)
    noise = NOISE * np.random.default_rng([arm.seed, 1]).standard_normal((count, 2))
    scenario = ql.Scenario(
        reference, (count - 1) * DT, noise=[Table(each, DT) for each in noise.T],
        x0=[*middle, *rates],
    )  # fmt: skip
    loops = controller(arm, shares, learner, guard)
    run = ql.simulate(arm.plant, loops, scenario, limit=LIMIT, interpret=interpret)
    if run.diverged:
        return np.full(2, np.inf)
    error = (run["y"] - run["r"])[round(min(JUDGED_AT, 0.5 * seconds) / DT) :]
    found: Vector = np.sqrt(np.mean(error**2, axis=0))
    return found


def margin(arm: Arm, shares: Vector) -> float:
    """Return the least modulus margin over the motion."""
    b0 = shares * np.diag(np.linalg.inv(arm.inertia(arm.elbow)))
    angles = arm.elbow + arm.amplitudes[1] * np.linspace(-1.0, 1.0, 21)
    found = [np.linalg.solve(arm.inertia(q), np.diag(1.0 / b0)) for q in angles]
    gains = np.real(np.linalg.eigvals(np.array(found)))
    return min(_margin(round(float(each), 2)) for each in (gains.min(), gains.max()))


@cache
def _margin(gain: float) -> float:
    """Return the modulus margin of a joint with b/b0 = ``gain``; 0 if it is unstable."""
    controller = ql.ADRC(ql.ESO.model_free(2, 1.0, OMEGA_O, DT), OMEGA_C)
    found = analyse(ql.plants.LinearPlant.of(([gain], [1.0, 0.0, 0.0])), controller)
    return float(found.margins.modulus) if found.stable else 0.0


def judge(seed: int, seconds: float, guarded: bool, interpret: bool) -> dict[str, float] | None:
    """Return the worse joint's ratio with each learner; None if it is lost without."""
    arm, shares = draw(seed)
    plain = errors(arm, shares, None, None, seconds, interpret)
    if not np.isfinite(plain.max()):
        return None
    guard = ql.Guard() if guarded else None
    found = {
        name: float((errors(arm, shares, each, guard, seconds, interpret) / plain).max())
        for name, each in LEARNERS.items()
    }
    known = {"share1": float(shares[0]), "share2": float(shares[1])}
    return found | known | {"margin": margin(arm, shares)}


def row_of(results: list[dict[str, float]], name: str) -> dict[str, float]:
    """Return median, worst, number above 1.1 and mean logarithm of the ratios."""
    values = np.minimum([each[name] for each in results], 1e6)
    return {
        "median": float(np.median(values)),
        "worst": float(values.max()),
        "above": int((values > MOST).sum()),
        "log": float(np.log(values).mean()),
    }


def main() -> None:
    """Run the trial and print its figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--arms", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--no-guard", action="store_true", help="the learners without guard")
    options = options_of(parser, arms=1, seconds=0.3)
    console = Console()
    seeds = [1000 * options.seed + i for i in range(options.arms)]
    work = partial(
        judge, seconds=options.seconds, guarded=not options.no_guard, interpret=options.quick
    )
    if options.quick:
        with dispatch.as_python():
            results = [work(seed) for seed in seeds]
    else:
        results = in_parallel([partial(work, seed) for seed in seeds])
    found = [each | {"seed": s} for s, each in zip(seeds, results, strict=True) if each is not None]
    counted = [each for each in found if each["margin"] >= LEAST_MARGIN] or found
    apart = [each for each in found if each["margin"] < LEAST_MARGIN]
    figures: dict[str, Any] = {"drawn": options.arms, "counted": len(counted)}
    for title, group in (("arms that count", counted), ("margin below 0.1", apart)):
        if not group:
            continue
        figures[title] = {name: row_of(group, name) for name in LEARNERS}
        heads = ("learner", "arms", "median", "worst", f"above {MOST}", "mean log")
        table = Rows(*heads, title=f"{title}: over no learner")
        for name, row in figures[title].items():
            table.add_row(name, str(len(group)), *(f"{each:.4g}" for each in row.values()))
        console.print(table)
        worst = sorted(((e[n], n, e) for e in group for n in LEARNERS), key=lambda row: -row[0])
        for value, name, each in worst[:6]:
            console.print(
                f"{value:.3g}: {name}, seed {each['seed']}, b0/b {each['share1']:.2f}, "
                f"{each['share2']:.2f}, margin {each['margin']:.2f}"
            )
    write(options, figures)


if __name__ == "__main__":
    main()
