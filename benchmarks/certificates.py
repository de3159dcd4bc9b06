"""How conservative the certificate of a guarded loop is: the bound over the worst that was found.

Random linear loops of orders 1 to 4 (``quell.experiments.stress.loops``: stable, unstable,
lagged, delayed, two masses; modulus margin 0.35 and more). κ is 1.2, or 0.9/Γ where that is less.
In place of guard and learner stands whatever a guard with this bound could let pass: any e_L with
``|e_L| ≤ κ e``, where e is the largest |q| so far. The linear loop is that of the certificate,
which tests compare with quell's own loop sample for sample.

Worst e_L are searched for each loop and load, for q and for y apart: signs of the pulse response
backwards, in stages of several lengths, which is the worst for one instant; and feedback
``e_L = κ e sign(c·x)`` of the whole state of the loop, with c from the cross-entropy method.

- *ramp*: a load that grows steadily, so that q_0 becomes constant
- *step* of the load; *sine* with 0.1 to 3 times omega_c

Printed are the bound of the theorem over the largest |q| found, and the same for |y − y_0|, both
with the largest |q_0| of that run: 1 if the bound is attained.

python benchmarks/certificates.py [--loops 60] [--seed 1]
python benchmarks/certificates.py --honest 100
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from numba import njit
from rich.console import Console
from rich.table import Table
from spender import pulse_response

from quell.analysis import certify
from quell.experiments.stress.loops import draw_loop
from quell.experiments.stress.study import draw_loops, errors
from quell.guard import Guard
from quell.guard.guard import plain_loop, state_path
from quell.learners import Harmonic
from quell.lti.models import System
from quell.parallel import in_parallel
from quell.plants.linear import sampled_plant

FAMILIES = ("stable", "unstable", "lagged", "delayed", "two masses")
LOADS = ("ramp", "step", "sine")
DURATION = 40.0  # of a run in 1/omega_c
GENERATIONS, POPULATION, ELITE = 8, 40, 6


@njit(cache=True)
def largest(A, B, C_q, C_y, q_0, signs, feedback, kappa):
    """Return max |q| and max |y − y_0| under e_L = κ e s, with s from a table or a feedback."""
    n = B.size
    x, after = np.zeros(n), np.zeros(n)
    e = most_y = 0.0
    for k in range(q_0.size):
        q, y, push = q_0[k], 0.0, 0.0
        for i in range(n):
            q += C_q[i] * x[i]
            y += C_y[i] * x[i]
            push += feedback[i] * x[i]
        e, most_y = max(e, abs(q)), max(most_y, abs(y))
        push += feedback[n] * q
        s = signs[k] if signs.size > 0 else np.sign(push)
        for i in range(n):
            total = B[i] * kappa * e * s
            for j in range(n):
                total += A[i, j] * x[j]
            after[i] = total
        x, after = after, x
    return e, most_y


def staged(h: Any, samples: int, stage: int, sign: float, turn: float) -> Any:
    """Return the signs that are worst at the end of each stage; ``turn`` after each."""
    found = np.zeros(samples)
    backwards = np.sign(h[:stage][::-1])
    for i, start in enumerate(range(0, samples, stage)):
        part = backwards[: samples - start]
        found[start : start + part.size] = sign * turn**i * part
    return found


@njit(cache=True)
def driven(A, B, C, w):
    """Return the output of a system for the input w."""
    x, found = np.zeros(B.size), np.zeros(w.size)
    for k in range(w.size):
        found[k] = np.dot(C, x)
        x = A @ x + B * w[k]
    return found


class Attacked:
    """The loop of a certificate, as a system with the input e_L and the outputs q and y."""

    def __init__(self, loop: Any) -> None:
        controller = loop.controller(learner=Harmonic(), guard=Guard())
        observer, law = controller.observer, controller.parameters.law
        delay = loop.plant.delay * loop.dt
        self.gains = certify(loop.plant.linear, controller, delay=delay)
        self.kappa = min(1.2, 0.9 / self.gains.gain)
        plant = sampled_plant(loop.plant.linear, loop.dt, delay)
        to_error, to_output = plain_loop(plant, observer, law)
        path = state_path(observer, law)
        N, self.B, self.C_q, _ = path.then(to_error)
        self.C_y = path.then(to_output).C
        self.A = N + np.eye(self.B.size)
        self.own = path.B.size  # states of the path stand before those of the loop
        self.into = np.zeros(self.B.size)  # from the load to the state
        self.into[self.own : self.own + plant.B.size] = plant.E[:, 0]
        self.samples, self.dt = round(DURATION / loop.dt), loop.dt

    def alone(self, load: str, rng: Any) -> Any:
        """Return q_0 (samples,) under a load."""
        t = self.dt * np.arange(self.samples)
        omega = np.exp(rng.uniform(np.log(0.1), np.log(3.0)))
        w = {"ramp": t, "step": np.ones(t.size), "sine": np.sin(omega * t)}[load]
        q_0 = driven(self.A, self.into, self.C_q, w)
        return q_0 / np.max(np.abs(q_0))

    def run(self, q_0: Any, signs: Any = None, feedback: Any = None) -> tuple[float, float]:
        """Return max |q| and max |y − y_0| under signs or a feedback."""
        signs = np.zeros(0) if signs is None else signs
        feedback = np.zeros(self.B.size + 1) if feedback is None else feedback
        found = largest(self.A, self.B, self.C_q, self.C_y, q_0, signs, feedback, self.kappa)
        return float(found[0]), float(found[1])

    def worst(self, q_0: Any, rng: Any) -> tuple[float, float]:
        """Return the largest max |q| and max |y − y_0| that the searches find."""
        best = [1.0, 0.0]
        for row, C in ((0, self.C_q), (1, self.C_y)):
            system = System(self.A - np.eye(self.B.size), self.B, C, 0.0)
            h = pulse_response(system, self.samples + 1)[1:]
            for share in (0.05, 0.1, 0.2, 0.5, 1.0):
                for sign in (1.0, -1.0):
                    for turn in (1.0, -1.0):
                        stage = max(round(share * self.samples), 2)
                        signs = staged(h, self.samples, stage, sign, turn)
                        best[row] = max(best[row], self.run(q_0, signs)[row])
            best[row] = max(best[row], self._by_feedback(q_0, row, rng))
        return best[0], best[1]

    def _by_feedback(self, q_0: Any, row: int, rng: Any) -> float:
        """Search for the worst feedback by the cross-entropy method; its scale does not matter."""
        # In units in which a steady e_L of 1 moves every state by about 1.
        size = np.zeros(self.B.size)
        x = np.zeros(self.B.size)
        for k in range(self.samples):
            x = self.A @ x + self.B * (1.0 if (k // 200) % 2 else -1.0)
            size = np.maximum(size, np.abs(x))
        scale = np.append(1.0 / np.maximum(size, 1e-300), 1.0)
        mean, spread, best = np.zeros(scale.size), np.ones(scale.size), 0.0
        for _ in range(GENERATIONS):
            points = mean + spread * rng.normal(size=(POPULATION, scale.size))
            scores = np.array([self.run(q_0, feedback=point * scale)[row] for point in points])
            elite = points[np.argsort(-scores)[:ELITE]]
            mean, spread = elite.mean(axis=0), elite.std(axis=0) + 0.02
            best = max(best, float(scores.max()))
        return best


def main() -> None:
    """Print bound over worst, by load and by order."""
    parser = parser_of(__doc__)
    parser.add_argument("--loops", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--honest", type=int, help="only what certificates cost, in so many loops")
    options = options_of(parser, loops=1, honest=1)
    figures: dict[str, Any] = {}
    if options.honest:
        figures["honest"] = honest(options.honest)
        if not options.quick:
            write(options, figures)
            return
    rng = np.random.default_rng(options.seed)
    rows = []
    while len({row[0] for row in rows}) < options.loops:
        family = FAMILIES[len({row[0] for row in rows}) % len(FAMILIES)]
        loop = draw_loop(rng, family)
        if loop.margin < 0.35 or loop.omega_o * loop.dt < 0.04 or loop.plant.delay > 30:
            continue
        attacked = Attacked(loop)
        growth = 1.0 / (1.0 - attacked.kappa * attacked.gains.gain)
        for load in LOADS:
            q, y = attacked.worst(attacked.alone(load, rng), rng)
            bound_y = attacked.gains.output_gain * attacked.kappa * growth
            rows.append(
                (loop.seed, loop.order, load, attacked.kappa, growth, growth / q, bound_y / y)
            )
    figures["bound over worst"] = show(rows)
    write(options, figures)


def honest(count: int) -> dict[str, Any]:
    """Print what a certificate costs an honest learner in random two-mass loops; return it."""
    loops = draw_loops(count, np.random.default_rng(21))
    plain = np.array(in_parallel([partial(errors, loop, None, None) for loop in loops]))
    table = Table(title=f"Harmonic() in {count} two-mass loops, RMS errors over MF-ESO's")
    for heading in ("guard", "κ: least, median", "run: median, most", "load: median, 99 %, most"):
        table.add_column(heading)
    table.add_column("late: median")
    figures: dict[str, Any] = {}
    certified = [Guard(certified_for=loop.plant) for loop in loops]
    for name, guards in (
        ("none", [None] * count),
        ("Guard()", [Guard()] * count),
        ("certified_for=plant", certified),
    ):
        pairs = list(zip(loops, guards, strict=True))
        runs = in_parallel([partial(errors, loop, Harmonic(), guard) for loop, guard in pairs])
        ratios = np.array(runs) / plain
        kappas = [
            np.inf if guard is None else loop.controller(Harmonic(), guard).parameters.guard.bound
            for loop, guard in pairs
        ]
        run, load, late = ratios.T
        table.add_row(
            name,
            f"{np.min(kappas):.2f}, {np.median(kappas):.2f}",
            f"{np.nanmedian(run):.3f}, {np.nanmax(run):.3f}",
            f"{np.nanmedian(load):.3f}, {np.nanquantile(load, 0.99):.3f}, {np.nanmax(load):.3f}",
            f"{np.nanmedian(late):.4f}",
        )
        figures[name] = {
            "kappa": "without a guard there is none"
            if guards[0] is None
            else {"least": np.min(kappas), "median": np.median(kappas)},
            "run": {"median": np.nanmedian(run), "largest": np.nanmax(run)},
            "load": {
                "median": np.nanmedian(load),
                "99 %": np.nanquantile(load, 0.99),
                "largest": np.nanmax(load),
            },
            "late": {"median": np.nanmedian(late)},
        }
    Console(width=110).print(table)
    return {"loops": count} | figures


def show(rows: list[Any]) -> dict[str, Any]:
    """Print the table, and return it."""
    figures: dict[str, Any] = {}
    table = Table(title="Bound over worst found")
    for heading in ("", "loops", "κ", "bound on q", "q: median, least, most", "y: the same"):
        table.add_column(heading)
    parts = [("all", rows)]
    parts += [(load, [row for row in rows if row[2] == load]) for load in LOADS]
    parts += [
        (f"order {n}, ramp", [r for r in rows if r[1:3] == (n, "ramp")]) for n in (1, 2, 3, 4)
    ]
    for name, part in parts:
        values = np.array([row[3:] for row in part])
        if values.size == 0:
            continue
        median, least, most = np.median(values, axis=0), values.min(axis=0), values.max(axis=0)
        table.add_row(
            name,
            str(len({row[0] for row in part})),
            f"{median[0]:.2f}",
            f"{median[1]:.2f}",
            f"{median[2]:.2f}, {least[2]:.3f}, {most[2]:.2f}",
            f"{median[3]:.2f}, {least[3]:.3f}, {most[3]:.2f}",
        )
        figures[name] = {"loops": len({row[0] for row in part}), "bound on q": median[1]}
        for label, i in (("q", 2), ("y", 3)):
            spread = {"median": median[i], "least": least[i], "largest": most[i]}
            figures[name][label] = spread
    Console(width=110).print(table)
    return figures


if __name__ == "__main__":
    main()
