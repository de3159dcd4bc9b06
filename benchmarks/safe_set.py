"""A safe set under hostile u_0, disturbance, noise and gain: how far y and y' leave the bands.

    python benchmarks/safe_set.py [--setups 1000] [--runs 100] [--seed 1]

Each setup draws order (1, 2, 3), bandwidths, α, bands, bounds of f' and noise, and an error of b0;
each run draws u_0 (square waves, sinusoids, random, full force towards the border that is nearer)
and f' (square waves, random, and always towards the nearer border), at their bounds. The plant is
integrated exactly, with four points in each sample. What counts as a violation is y, or y', beyond
its band by more than the module's docstring states. ``margin 0`` repeats the runs with δ = 0: what
the margin is for.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table
from scipy.linalg import expm

import quell as ql
from quell.controllers.base import control
from quell.kernels import dispatch
from quell.kernels.dispatch import compiled

SUBSTEPS = 4


@compiled
def play(
    design: Any, state: Any, gain: float, steps: Any, kinds: Any, rates: Any, random: Any,
    noise: float, b0: float, x: Any, following: Any,
) -> tuple[float, float, int]:  # fmt: skip
    """Return the largest |y| and |y'| of a run, and how often a limit of u was in the way.

    ``steps`` are the matrices of a sub-step from (x, u, f, f') to x (n, n + 3); ``rates`` has the
    size of u_0, the bound of f', dt, the largest |f| and the samples in which the observer settles.
    ``x`` and ``following`` are zeros (n,).
    """
    n = steps.shape[0]
    f, u = 0.0, 0.0
    most, fastest, unsafe = 0.0, 0.0, 0
    period_u, period_f = 3 + int(200 * random[0, 0]), 3 + int(300 * random[1, 0])
    for k in range(random.shape[1]):
        measured = x[0] + noise * (2.0 * random[2, k] - 1.0 if k % 2 else math.copysign(1.0, x[0]))
        towards = math.copysign(1.0, x[0])
        if kinds[0] == 0:
            wish = math.copysign(1.0, math.sin(2.0 * math.pi * k / period_u))
        elif kinds[0] == 1:
            wish = math.sin(2.0 * math.pi * k / period_u)
        elif kinds[0] == 2:
            wish = 2.0 * random[0, k] - 1.0
        else:
            wish = towards
        u = control(design, state, wish * rates[0] * math.copysign(1.0, b0), measured)
        unsafe += int(state.loop[0].status) & 4096 != 0
        if kinds[1] == 0:
            change = math.copysign(1.0, math.sin(2.0 * math.pi * k / period_f))
        elif kinds[1] == 1:
            change = math.copysign(1.0, random[1, k] - 0.5)
        else:
            change = towards if (k // period_f) % 2 else -towards
        if abs(f + change * rates[1] * rates[2]) > rates[3]:
            change = 0.0
        for _ in range(4):
            for i in range(n):
                total = steps[i, n] * gain * u + steps[i, n + 1] * f
                total += steps[i, n + 2] * change * rates[1]
                for j in range(n):
                    total += steps[i, j] * x[j]
                following[i] = total
            f += 0.25 * change * rates[1] * rates[2]
            for i in range(n):
                x[i] = following[i]
            if k > rates[4]:
                most = max(most, abs(x[0]))
                fastest = max(fastest, abs(x[1]) if n > 1 else 0.0)
    return most, fastest, unsafe


def substep(n: int, a: Any, dt: float) -> Any:
    """Return the matrices of a quarter of a sample."""
    A = np.zeros((n + 3, n + 3))
    A[: n - 1, 1:n] = np.eye(n - 1)
    A[n - 1, :n] = -a
    A[n - 1, n] = A[n - 1, n + 1] = 1.0
    A[n + 1, n + 2] = 1.0
    return np.ascontiguousarray(expm(A * dt / SUBSTEPS)[:n])


def drawn(random: np.random.Generator) -> dict[str, Any]:
    """Return a setup."""
    n = int(random.integers(1, 4))
    dt = 10.0 ** random.uniform(-4.0, -1.0)
    omega_o = random.uniform(0.02, 0.4) / dt
    alpha = omega_o * random.uniform(0.03, 0.3)
    width = 10.0 ** random.uniform(-4.0, 2.0)
    f_size = alpha**n * width
    f_rate = f_size * alpha * random.uniform(0.0, 0.3)
    a = np.zeros(n)
    if random.random() < 0.3:
        a = f_size / width * alpha ** -np.arange(n) * random.uniform(-0.5, 1.0, n)
    return {
        "n": n,
        "dt": dt,
        "omega_o": omega_o,
        "alpha": alpha,
        "width": width,
        "f_size": f_size,
        "f_rate": f_rate,
        "a": a,
        "b0": float(random.choice([-1, 1]) * 10.0 ** random.uniform(-3, 4)),
        "noise": width * random.choice([0.0, 10.0 ** random.uniform(-8.0, -5.0)]),
        "gain_error": float(random.choice([0.0, 0.05])),
        "rate": bool(random.random() < 0.4 and n > 1),
    }


def controller_of(setup: dict[str, Any]) -> Any:
    """Return the compensator with the safe set of a setup; None if the band is too narrow."""
    dt, b0, width = (setup[name] for name in ("dt", "b0", "width"))
    model = ql.ESO.model_based((setup["a"].tolist(), b0), setup["omega_o"], dt)
    reach = 40.0 * setup["f_size"] / abs(b0)
    limit = 0.5 * setup["alpha"] * width if setup["rate"] else math.inf
    safe = ql.SafeSet(
        -width, width, -limit, limit, setup["alpha"], setup["f_rate"], setup["noise"],
        setup["gain_error"],
    )  # fmt: skip
    try:
        return ql.Compensator(model, u_min=-reach, u_max=reach, safe_set=safe)
    except ValueError as error:
        if "must be above" not in str(error):
            raise
        return None


def without_margin(design: Any) -> Any:
    """Return parameters with δ = 0."""
    safe = design.safe_set
    bands = {name: getattr(safe, name)._replace(margin=0.0) for name in ("position", "rate")}
    return design._replace(safe_set=safe._replace(**bands))


def main() -> None:
    """Run the trial and print a table by order."""
    parser = parser_of(__doc__)
    parser.add_argument("--setups", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    given = options_of(parser, setups=3, runs=1)
    dispatch.interpret_all |= given.quick  # to compile the loop for each setup takes minutes
    played = play.plain if dispatch.interpret_all else play
    random, began = np.random.default_rng(given.seed), time.perf_counter()
    rows: dict[tuple[int, str], list[float]] = {}
    narrow = 0
    for _ in range(given.setups):
        setup = drawn(random)
        controller = controller_of(setup)
        if controller is None:
            narrow += 1
            continue
        n, dt, width = setup["n"], setup["dt"], setup["width"]
        steps = substep(n, setup["a"], dt)
        lags = round(40.0 / (setup["omega_o"] * dt))
        designs = {"δ": controller.parameters, "0": without_margin(controller.parameters)}
        for margin, design in designs.items():
            for run in range(given.runs if margin == "δ" else max(given.runs // 10, 1)):
                source = np.random.default_rng([given.seed, run])
                noises = source.random((3, 2000 + lags))
                kinds = source.integers([4, 3])
                error = setup["gain_error"] * source.choice([-1.0, 1.0])
                sizes = np.array([
                    30.0 * setup["f_size"] / abs(setup["b0"]), setup["f_rate"], dt,
                    3.0 * setup["f_size"], lags,
                ])  # fmt: skip
                most, fastest, unsafe = played(
                    design, controller.initial_state(), setup["b0"] * (1.0 + error), steps, kinds,
                    sizes, noises, setup["noise"], setup["b0"],
                    np.zeros(n), np.zeros(n),
                )  # fmt: skip
                curve = setup["f_rate"] * dt**3 if n == 1 else 0.0
                permitted = width * (1.0 + (setup["alpha"] * dt) ** 2 * (n > 2)) + curve
                late = most / permitted
                quick = fastest / (0.5 * setup["alpha"] * width) if setup["rate"] else 0.0
                row = rows.setdefault((n, margin), [0, 0, 0.0, 0, 0.0])
                row[0] += 1
                row[1] += late > 1.0 + 1e-9 and not unsafe
                row[2] = max(row[2], late) if not unsafe else row[2]
                row[3] += unsafe > 0
                row[4] = max(row[4], quick) if not unsafe else row[4]
    table = Table(
        "order", "margin", "runs", "outside", "max |y|/y_max", "limits of u in the way",
        "max |y'|/rate_max", title=f"{given.setups} setups, {narrow} with a band that is refused",
    )  # fmt: skip
    figures: dict[str, Any] = {"setups": given.setups, "refused": narrow}
    for (n, margin), row in sorted(rows.items()):
        names = ("runs", "outside", "most of the band", "limits in the way", "most of the rate")
        figures[f"order {n}, margin {margin}"] = dict(zip(names, map(float, row), strict=True))
        table.add_row(
            str(n), margin, f"{row[0]:.0f}", f"{row[1]:.0f}", f"{row[2]:.6f}", f"{row[3]:.0f}",
            f"{row[4]:.4f}",
        )  # fmt: skip
    Console(width=110).print(table)
    of_margin = [row for (_, margin), row in rows.items() if margin == "δ"]
    figures["runs with margin"] = sum(row[0] for row in of_margin)
    figures["of these outside"] = sum(row[1] for row in of_margin)
    write(given, figures)
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
