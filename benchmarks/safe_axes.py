"""Safe sets of coupled axes under hostile references, f, noise and B0: who leaves a band.

    python benchmarks/safe_axes.py [--setups 150] [--runs 10] [--seed 1] [--only TEXT]

Each row is a structure: orders, number of actuators, what happens at the limits. Each setup draws
B0, bandwidths, α, bands of y and of its rate, bounds of f' and noise, errors of each entry of B0,
springs between the axes, and limits of the actuators, of magnitude and in half of the setups of
rate, that are 0.5 to 3 times what all bands at once can ask for. Each run draws what the axes are
asked for (square waves, sinusoids, random, full force towards the border that is nearer), far more
than the actuators have, and f' of each axis, at its bound (square waves, random, always towards the
nearer border). The plant is integrated exactly, with four points in each sample.

A run counts as outside if y, or y', of an axis leaves its band by more than the docstring of
``quell.controllers.safe_set`` states and no sample was ``UNSAFE``. *apart* repeats a part of the
runs with the safe sets alone, each for its own v, without the actuators in common: how many of them
leave a band while the same run with both together is safe.
"""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table
from scipy.linalg import expm

import quell as ql
from quell.controllers.base import status_flags
from quell.controllers.safe_axes import NoSafeAxes, NoSafeAxesMemory
from quell.controllers.several import control_all
from quell.kernels import dispatch
from quell.kernels.dispatch import compiled

DT, SUBSTEPS, SAMPLES = 1e-3, 4, 2500
UNSAFE = int(ql.Status.UNSAFE)


class Structure(NamedTuple):
    """What is compiled for."""

    orders: tuple[int, ...]
    actuators: int
    saturation: Any


STRUCTURES = {
    "2 axes of order 2, each": Structure((2, 2), 2, "each"),
    "3 axes of orders 2, 1 and 2, direction": Structure((2, 1, 2), 3, "direction"),
    "2 axes of orders 2 and 3, 3 actuators, priority": Structure((2, 3), 3, ["axis2", "axis1"]),
    "3 axes of order 2, 4 actuators, each": Structure((2, 2, 2), 4, "each"),
}


@compiled
def play(
    design: Any, state: Any, steps: Any, B: Any, first: Any, asked: Any, rates: Any, most_f: Any,
    noise: Any, kinds: Any, random: Any, periods: Any, settled: Any, x: Any, following: Any,
    reached: Any, fastest: Any, r: Any, y: Any, u: Any, v: Any, f: Any, change: Any,
) -> int:  # fmt: skip
    """Write the largest |y| and |y'| of each axis; return how many samples were unsafe.

    ``steps`` are the matrices of a sub-step from (x, v, f, f') to x (N, N + 3 n); ``first`` has the
    place of y_i in x; the arrays from ``x`` on are room to calculate.
    """
    n, size, m = f.size, x.size, u.size
    unsafe = 0
    for k in range(random.shape[2]):
        for i in range(n):
            at = x[first[i]]
            towards = math.copysign(1.0, at)
            error = 2.0 * random[2, i, k] - 1.0 if k % 2 else towards
            y[i] = at + noise[i] * error
            wave = math.sin(2.0 * math.pi * k / periods[0, i])
            if kinds[0, i] == 0:
                r[i] = math.copysign(asked[i], wave)
            elif kinds[0, i] == 1:
                r[i] = asked[i] * wave
            elif kinds[0, i] == 2:
                r[i] = asked[i] * (2.0 * random[0, i, k] - 1.0)
            else:
                r[i] = asked[i] * towards
            turn = int(k / periods[1, i])
            if kinds[1, i] == 0:
                change[i] = math.copysign(rates[i], math.sin(2.0 * math.pi * k / periods[1, i]))
            elif kinds[1, i] == 1:
                change[i] = math.copysign(rates[i], random[1, i, k] - 0.5)
            else:
                change[i] = rates[i] * (towards if turn % 2 else -towards)
            if abs(f[i] + change[i] * DT) > most_f[i]:
                change[i] = 0.0
        control_all(design, state, r, y, u)
        unsafe += int(status_flags(design, state)) & UNSAFE != 0
        for i in range(n):
            v[i] = 0.0
            for j in range(m):
                v[i] += B[i, j] * u[j]
        for _ in range(SUBSTEPS):
            for i in range(size):
                total = 0.0
                for j in range(size):
                    total += steps[i, j] * x[j]
                for j in range(n):
                    total += steps[i, size + j] * v[j] + steps[i, size + n + j] * f[j]
                    total += steps[i, size + 2 * n + j] * change[j]
                following[i] = total
            for i in range(n):
                f[i] += change[i] * DT / SUBSTEPS
            for i in range(size):
                x[i] = following[i]
            if k > settled[0]:
                for i in range(n):
                    reached[i] = max(reached[i], abs(x[first[i]]))
                    if first[i] + 1 < size:
                        fastest[i] = max(fastest[i], abs(x[first[i] + 1]))
    return unsafe


class Setup(NamedTuple):
    """A drawn setup."""

    axes: ql.Axes
    steps: Any
    error: Any  # relative, of the entries of B0
    width: Any
    speed: Any
    rates: Any
    most_f: Any
    noise: Any
    asked: Any
    permitted: Any
    settled: float


def drawn(structure: Structure, random: np.random.Generator) -> Setup | None:
    """Return a setup; None if a band is too narrow for what is not known."""
    orders, m = np.array(structure.orders), structure.actuators
    n, size = orders.size, int(np.sum(orders))
    units = 10.0 ** random.uniform(-2.0, 2.0, m)  # of the actuators
    width = 10.0 ** random.uniform(-3.0, 1.0, n)
    omega_o = random.uniform(100.0, 350.0, n)
    alpha = omega_o * random.uniform(0.04, 0.15, n)
    speed = np.where(orders > 1, 0.5 * alpha * width, math.inf)
    force = alpha**orders * width
    B0 = np.eye(n, m) + random.uniform(-0.5, 0.5, (n, m))
    if np.linalg.cond(B0) > 8.0:
        return None
    B0 = B0 * force[:, None] / units
    # Springs between axes whose rates are bounded: their share of f' is, too.
    springs = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            if i != j and orders[j] > 1:
                springs[i, j] = 0.02 * random.uniform(-1.0, 1.0) * force[i] / width[j]
    own = force * alpha * random.uniform(0.0, 0.05, n)
    coupled = np.abs(springs) @ np.where(orders > 1, speed, 0.0)
    noise = width * 10.0 ** random.uniform(-8.0, -5.5, n)
    wrong = float(random.choice([0.0, 0.01]))
    needed = np.abs(np.linalg.pinv(B0)) @ (np.where(orders > 2, 6.0, 2.0) * force)
    high = needed * random.uniform(0.5, 3.0, m)
    largest = np.abs(B0) @ high
    parts = []
    for i in range(n):
        observer = ql.ESO.model_free(int(orders[i]), 1.0, float(omega_o[i]), DT)
        more = {"gain_error": wrong, "largest_u": float(largest[i])} if wrong else {}
        safe = ql.SafeSet(
            -width[i], width[i], -speed[i], speed[i], float(alpha[i]), own[i] + coupled[i],
            noise[i], **more,
        )  # fmt: skip
        parts.append((observer, safe))
    quick = float(random.choice([math.inf, 1.0]))
    rate = [float(each) for each in quick * high * 50.0] if quick < math.inf else math.inf
    try:
        each = [
            ql.ADRC(observer, 0.2 * float(observer.omega_o), safe_set=safe)
            for observer, safe in parts
        ]
        axes = ql.Axes(
            each, B0, u_min=-high, u_max=high, rate_limit=rate,
            saturation=structure.saturation,
        )  # fmt: skip
    except ValueError as error:
        if "must be above" not in str(error):
            raise
        return None
    A = np.zeros((size + 3 * n, size + 3 * n))
    first = np.append(0, np.cumsum(orders)[:-1])
    for i, (place, order) in enumerate(zip(first, orders, strict=True)):
        for j in range(order - 1):
            A[place + j, place + j + 1] = 1.0
        last = place + order - 1
        A[last, first] = springs[i]
        A[last, size + i] = A[last, size + n + i] = 1.0
        A[size + n + i, size + 2 * n + i] = 1.0
    steps = np.ascontiguousarray(expm(A * DT / SUBSTEPS)[:size])
    curve = np.where(orders == 1, (own + coupled) * DT**3, 0.0)
    return Setup(
        axes, steps, wrong * random.choice([-1.0, 1.0], B0.shape), width, speed, own, 0.5 * force,
        noise, 40.0 * width, width * (1.0 + (alpha * DT) ** 2 * (orders > 2)) + curve,
        float(round(40.0 / (np.min(omega_o) * DT))),
    )  # fmt: skip


def run(setup: Setup, design: Any, state: Any, seed: Any) -> tuple[bool, int, float, float]:
    """Return whether a band was left, the unsafe samples, and the largest shares of the bands."""
    source, n = np.random.default_rng(seed), setup.width.size
    orders = [axis.observer.order for axis in setup.axes.axes]
    first = np.append(0, np.cumsum(orders)[:-1])
    size, m = int(np.sum(orders)), setup.axes.inputs
    reached, fastest = np.zeros(n), np.zeros(n)
    room = [np.zeros(each) for each in (n, n, m, n, n, n)]
    unsafe = (play.plain if dispatch.interpret_all else play)(
        design, state, setup.steps, setup.axes.first_gain * (1.0 + setup.error), first, setup.asked,
        setup.rates, setup.most_f, setup.noise,
        np.stack([source.integers(0, 4, n), source.integers(0, 3, n)]),
        source.random((3, n, SAMPLES)), source.uniform(20.0, 800.0, (2, n)),
        np.array([setup.settled]), np.zeros(size), np.zeros(size), reached, fastest, *room,
    )  # fmt: skip
    most = float(np.max(reached / setup.permitted))
    quick = float(np.max(fastest / setup.speed))
    return max(most, quick) > 1.0 + 1e-9, unsafe, most, quick


def main() -> None:
    """Run the rows and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--setups", type=int, default=150)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="rows whose name has this text")
    given = options_of(parser, setups=2, runs=1, only="2 axes of order 2, each")
    dispatch.interpret_all |= given.quick  # to compile the loop for each setup takes minutes
    figures: dict[str, Any] = {}
    began = time.perf_counter()
    table = Table(
        "structure", "runs", "UNSAFE", "outside", "max |y|/y_max", "max |y'|/rate_max",
        "apart: runs", "outside", "up to",
    )  # fmt: skip
    for number, (name, structure) in enumerate(STRUCTURES.items()):
        if given.only not in name:
            continue
        random = np.random.default_rng([given.seed, number])
        total, unsafe, outside, most, quick = 0, 0, 0, 0.0, 0.0
        alone, left, far = 0, 0, 0.0
        for at in range(given.setups):
            setup = drawn(structure, random)
            if setup is None:
                continue
            design = setup.axes.parameters
            apart = design._replace(safe=NoSafeAxes())
            for k in range(given.runs):
                seed = [given.seed, number, at, k]
                state = setup.axes.initial_state()
                is_outside, bad, y, rate = run(setup, design, state, seed)
                total += 1
                if bad:
                    unsafe += 1
                    continue
                outside += is_outside
                most, quick = max(most, y), max(quick, rate)
                if k < max(given.runs // 5, 1):
                    state = setup.axes.initial_state()._replace(safe=NoSafeAxesMemory(np.zeros(0)))
                    is_outside, _, y, rate = run(setup, apart, state, seed)
                    alone, left, far = alone + 1, left + is_outside, max(far, y, rate)
        cells = (
            name, str(total), str(unsafe), str(outside), f"{most:.6f}", f"{quick:.6f}",
            str(alone), str(left), f"{far:.2f}",
        )  # fmt: skip
        print(" | ".join(cells), flush=True)
        figures[name] = {
            "runs": total, "UNSAFE": unsafe, "outside": outside, "most of the band": most,
            "most of the rate": quick, "apart: runs": alone, "apart: outside": left,
            "apart: most": far,
        }  # fmt: skip
        table.add_row(*cells)
    Console(width=150).print(table)
    write(given, figures)
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
