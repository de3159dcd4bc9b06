"""Test of controllers with hostile samples: limits hold, and the loop recovers afterwards.

    python benchmarks/hostile_steps.py                    # 30 configurations, 10⁶ samples each
    python benchmarks/hostile_steps.py --steps 50000 --only MLP
    python benchmarks/hostile_steps.py --minutes 10       # at most so long; the rest is left out

Each configuration runs rounds of hostile samples: references, measurements and derivatives that are
not finite, of any size from denormal to 1e300, of alternating sign, held, exploding, or good ones
with single outliers; between them calls of ``applied``, ``retune``, ``start``, ``track`` and
``hand_over`` with such values. Learners run with and without a guard. It checks:

* u is finite and within its limits in every sample;
* *recovery*: after each round the plant starts from rest and is measured well, follows a sinusoid
  and bears a load. From 8000 to 10 000 samples later, the RMS error is at most 1.5 times that of a
  new controller plus 0.1 % of the reference's amplitude.

Observers have omega_o dt = 0.2 here, that of order 8 has 0.05; one that was thrown by a factor s
returns within ``ln s / (omega_o dt)`` samples and some lags.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from hostile_configurations import DT, HIGH, LOW, configurations
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell import learners
from quell.controllers.base import control, set_reference_derivatives
from quell.kernels.dispatch import compiled, dispatcher_for, interpreted
from quell.plants.base import advance, measure
from quell.types import Matrix, Vector

ROUND = 50_000  # hostile samples before each recovery
BLOCK = 1000  # samples between calls other than ``step``
GOOD = 10_000  # samples of a recovery; the last fifth counts
WORSE, TOLERANCE = 1.5, 1e-3
DERIVATIVES = 3  # offered in each sample; a controller takes those that it uses


@compiled
def lie(
    design: Any, state: Any, r: Vector, y: Vector, derivatives: Matrix, low: float, high: float
) -> int:
    """Take ``r.size`` samples; return the number of bad values of u."""
    bad = 0
    for k in range(r.size):
        set_reference_derivatives(design, state, derivatives[k])
        if not low <= control(design, state, r[k], y[k]) <= high:
            bad += 1
    return bad


@compiled
def tell_the_truth(
    plant: Any,
    x: Vector,
    scratch: Vector,
    design: Any,
    state: Any,
    r: Vector,
    derivatives: Matrix,
    w: Matrix,
    noise: Vector,
    error: Vector,
    low: float,
    high: float,
) -> int:
    """Close the loop around the plant; write ``y − r``; return the number of bad values of u."""
    bad = 0
    for k in range(r.size):
        y = measure(plant, x)
        error[k] = y - r[k]
        set_reference_derivatives(design, state, derivatives[k])
        u = control(design, state, r[k], y + noise[k])
        if not low <= u <= high:
            bad += 1
            u = 0.0
        advance(plant, x, scratch, 0.0, u, w[k])
    return bad


def sizes(rng: np.random.Generator, count: int, most: float) -> Vector:
    """Return numbers of either sign, of all sizes up to ``10^most``."""
    numbers: Vector = rng.choice([-1.0, 1.0], count) * 10.0 ** rng.uniform(-most, most, count)
    return numbers


def hostile(rng: np.random.Generator, count: int) -> Vector:
    """Return a hostile signal, in pieces of one kind each."""
    pieces: list[Vector] = []
    while sum(piece.size for piece in pieces) < count:
        n = int(10.0 ** rng.uniform(0.0, 3.3))
        most = float(rng.choice([1.0, 3.0, 6.0, 12.0, 20.0, 60.0, 300.0]))
        calm = np.sin(0.01 * rng.uniform(0.0, 30.0) * np.arange(n))
        kind = rng.integers(9)
        if kind == 0:
            piece = sizes(rng, n, most)
        elif kind == 1:
            piece = np.full(n, sizes(rng, 1, most)[0])
        elif kind == 2:
            piece = sizes(rng, 1, most)[0] * (-1.0) ** np.arange(n)
        elif kind == 3:
            piece = rng.choice([math.nan, math.inf, -math.inf], n)
        elif kind == 4:
            piece = 5e-324 * rng.integers(-(10**9), 10**9, n).astype(float)
        elif kind == 5:
            piece = 10.0 ** rng.uniform(-3.0, 3.0) * np.cumsum(rng.normal(size=n))
        elif kind == 6:
            piece = np.exp(np.minimum(rng.uniform(0.0, 0.2) * np.arange(n), 690.0))
        elif kind == 7:
            piece = np.where(rng.random(n) < 0.3, math.nan, calm)
        else:
            piece = np.where(rng.random(n) < 1e-2, sizes(rng, n, most), calm)
        pieces.append(piece)
    return np.concatenate(pieces)[:count]


def one_size(rng: np.random.Generator, count: int, size: float) -> Vector:
    """Return noise of one size, with good samples first."""
    return np.where(np.arange(count) < count // 2, 1.0, size) * rng.normal(size=count)


def call_something(rng: np.random.Generator, controller: Any) -> None:
    """Call one of the methods that a running controller has, with hostile numbers."""
    value = float(sizes(rng, 1, float(rng.choice([1.0, 6.0, 20.0, 60.0])))[0])
    kind = rng.integers(5)
    if kind == 0:
        controller.applied(value)
    if not isinstance(controller, ql.ADRC):
        return
    if kind == 1:
        controller.retune(omega_c=float(rng.uniform(1.0, 5.0)))
    elif kind == 2:
        controller.start(value, float(rng.uniform(LOW, HIGH)), float(sizes(rng, 1, 6.0)[0]))
    elif kind == 3:
        y, u = float(sizes(rng, 1, 20.0)[0]), float(sizes(rng, 1, 20.0)[0])
        for _ in range(5):
            controller.track(value, y, u)
        controller.hand_over()
    elif kind == 4 and isinstance(controller.learner, learners.base.NoLearner):
        # The same observer again: gains are designed anew, the state is converted.
        controller.retune(observer=controller.observer)


class Trial:
    """A controller with its plant, and a new controller's error for comparison."""

    def __init__(
        self,
        make: Callable[[], Any],
        plant: Any,
        interpret: bool = False,
        hostile: int = ROUND,
        good: int = GOOD,
    ) -> None:
        self.plant, self.hostile, self.good = plant, hostile, good
        self.controller = make()
        self.omega_c = getattr(self.controller, "omega_c", 0.0)
        self.model = plant.sampled(DT)
        limits = self.controller.limits
        finite = np.finfo(float).max
        self.limits = max(limits.low, -finite), min(limits.high, finite)
        design = self.controller.parameters
        self.lie, self.tell_the_truth = (
            interpreted(entry) if interpret else dispatcher_for(entry, design)
            for entry in (lie, tell_the_truth)
        )
        self.fresh = self.good_samples(make(), np.random.default_rng(1))[0]

    def hostile_samples(self, rng: np.random.Generator, count: int, level: float | None) -> int:
        """Take hostile samples; return the number of bad values of u."""
        bad = 0
        # Drawing signals takes longer than the steps: pieces of one signal, in another order.
        pool = hostile(rng, 20 * BLOCK)

        def piece(n: int) -> Vector:
            first = int(rng.integers(pool.size - n))
            return pool[first : first + n].copy()

        for first in range(0, count, BLOCK):
            n = min(BLOCK, count - first)
            if level is None:
                r, y = piece(n), piece(n)
                call_something(rng, self.controller)
            else:
                r, y = np.zeros(n), one_size(rng, n, level)
            derivatives = np.column_stack([piece(n) for _ in range(DERIVATIVES)])
            design, state = self.controller.parameters, self.controller._state
            bad += self.lie(design, state, r, y, np.ascontiguousarray(derivatives), *self.limits)
        if isinstance(self.controller, ql.ADRC):
            self.controller.retune(omega_c=self.omega_c)
        return bad

    def good_samples(self, controller: Any, rng: np.random.Generator) -> tuple[float, int]:
        """Return the RMS error of the loop at the end, and the number of bad values of u."""
        t, omega = DT * np.arange(self.good), 0.5
        r = np.sin(omega * t)
        derivatives = np.column_stack([omega * np.cos(omega * t), -(omega**2) * r, -(omega**3) * r])
        w = np.zeros((t.size, self.plant.disturbances))
        if w.shape[1]:
            w[:, 0] = 1.0 + np.sin(1.3 * t)
        x, error = np.zeros(self.plant.order), np.zeros(t.size)
        bad = self.tell_the_truth(
            *(self.model, x, np.zeros(6 * x.size), controller.parameters, controller._state),
            *(r, derivatives, w, 1e-5 * rng.normal(size=t.size), error, *self.limits),
        )
        return float(np.sqrt(np.mean(error[t.size * 4 // 5 :] ** 2))), bad

    def rounds(self, seed: int) -> Iterator[tuple[int, float]]:
        """Yield the bad values of u of each round, and the error over a new controller's."""
        rng = np.random.default_rng(seed)
        for number in itertools.count():
            level = None if number % 2 == 0 else 10.0 ** rng.uniform(0.0, 60.0)
            bad = self.hostile_samples(rng, self.hostile, level)
            error, more = self.good_samples(self.controller, rng)
            allowed = WORSE * self.fresh + TOLERANCE
            yield bad + more, error / allowed if math.isfinite(error) else math.inf


def main() -> None:
    """Run the configurations and print a table."""
    parser = parser_of(__doc__)
    parser.add_argument("--steps", type=int, default=1_000_000, help="hostile samples for each")
    parser.add_argument("--minutes", type=float, default=math.inf, help="longest run time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="part of a configuration's name")
    parser.add_argument("--first", type=int, default=0, help="number of the first configuration")
    parser.add_argument("--count", type=int, default=1000, help="number of configurations")
    arguments = options_of(parser, steps=1, count=3)
    # A short round is quicker interpreted than to compile.
    sizes = {"interpret": True, "hostile": 500, "good": 500} if arguments.quick else {}
    end = time.monotonic() + 60.0 * arguments.minutes
    table = Table("configuration", "samples", "u bad", "recovered", "worst error / allowed")
    results = []
    np.seterr(all="ignore")
    chosen = itertools.islice(
        configurations().items(), arguments.first, arguments.first + arguments.count
    )
    for name, (make, plant) in chosen:
        if arguments.only not in name or time.monotonic() > end:
            continue
        count = max(arguments.steps // ROUND, 1)
        found = list(itertools.islice(Trial(make, plant, **sizes).rounds(arguments.seed), count))
        bad, worst = sum(bad for bad, _ in found), max(error for _, error in found)
        recovered = sum(error <= 1.0 for _, error in found)
        results.append(
            {
                "configuration": name,
                "samples": count * sizes.get("hostile", ROUND),
                "bad": bad,
                "rounds": count,
                "recovered": recovered,
                "worst": worst if math.isfinite(worst) else "the loop was lost",
            }
        )
        cells = f"{results[-1]['samples']:g}", f"{bad}", f"{recovered} of {count}", f"{worst:.3g}"
        table.add_row(name, *cells)
        print(name, *cells, flush=True)
    Console().print(table)
    figures = {
        "configurations": len(results),
        **{name: sum(row[name] for row in results) for name in ("rounds", "recovered", "bad")},
    }
    write(arguments, figures | {"rows": results})


if __name__ == "__main__":
    main()
