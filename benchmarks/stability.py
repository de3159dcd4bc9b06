"""Stability of exported loops: enclosures beside 50 digits, bounds of rounding beside long runs.

    python benchmarks/stability.py [--count 100] [--seed 1] [--samples 100000]

Draws linear loops (ADRC in three forms of its observer, with and without a model, PID, LQG; lags
and integrators, order 1 to 3, delays; both precisions; stable and not) and encloses their spectral
radius with the numbers of the C code. Beside it are the eigenvalues of the same loop by mpmath with
50 digits, which samples the plant in its own way. Then the kernel runs, in its precision, in a loop
beside the law in extended precision: the largest difference of u over its bound. A radius outside
of its enclosure, one wider than 1e-6, or a difference beyond its bound ends the script with 1.
"""

from __future__ import annotations

import sys
import warnings
from fractions import Fraction
from typing import Any

import mpmath
import numpy as np
from measured import options_of, parser_of, write

import quell as ql
from quell.controllers import in_single_precision
from quell.export import ExactLaw, exact_law, stability

_WIDEST = 1e-6


def drawn(rng: np.random.Generator) -> tuple[Any, Any, float, str]:
    """Return a drawn controller, plant without its delay, the delay, and the precision."""
    dt = float(10.0 ** rng.uniform(-4.0, -1.5))
    speed = float(rng.uniform(0.02, 0.1)) / dt
    gain, ratio = float(10.0 ** rng.uniform(-2.0, 3.0)), float(rng.uniform(0.3, 2.0))
    order = int(rng.integers(1, 4))
    poles = [float(rng.uniform(0.0, 0.5)) * speed * (rng.random() < 0.6) for _ in range(order)]
    plant = ql.plants.LinearPlant.of(([gain], np.poly([-each for each in poles]).tolist()))
    delay = float(rng.uniform(0.0, 2.5)) * dt * (rng.random() < 0.3)
    omega_o = float(rng.uniform(2.0, 6.0)) * speed
    kind = int(rng.integers(0, 5))
    if kind <= 1:
        form = str(rng.choice(["current", "predictor", "reduced"]))
        observer = ql.ESO.model_free(order, gain * ratio, omega_o, dt, form=form)
        controller: Any = ql.ADRC(observer, omega_c=speed)
    elif kind == 2:
        observer = ql.ESO.model_based(plant, omega_o=omega_o, dt=dt)
        controller = ql.ADRC(observer, omega_c=speed)
    elif kind == 3:
        k = speed**order / gain * ratio
        options = {"kp": k, "ki": 0.1 * k * speed, "kd": 2.0 * k / speed * (order > 1)}
        controller = ql.baselines.PID(**options, tf=0.1 / speed, dt=dt)
    else:
        controller = ql.baselines.LQG(plant, omega_c=speed, omega_o=omega_o, dt=dt)
    return controller, plant, delay, str(rng.choice(["double", "single"]))


def _mp(number: Any) -> Any:
    number = Fraction(float(number)) if isinstance(number, float) else Fraction(number)
    return mpmath.mpf(number.numerator) / number.denominator


def radius_in_digits(law: ExactLaw, plant: Any, dt: float, delay: float) -> Any:
    """Return the spectral radius of a loop by mpmath; columns are samples from unit vectors."""
    n, k = plant.order, len(law.A)
    samples = int(delay // dt)
    late = Fraction(delay - samples * dt) if delay else Fraction(0)
    A = mpmath.matrix([[_mp(float(each)) for each in row] for row in plant.A])
    B = [_mp(float(each)) for each in plant.B[:, 0]]
    C = [_mp(float(each)) for each in plant.C[0]]

    def moved(x: list[Any], u: Any, time: Any) -> list[Any]:
        """Return the state after a time under a constant u, by the exponential of both."""
        whole = mpmath.matrix(n + 1, n + 1)
        for i in range(n):
            for j in range(n):
                whole[i, j] = A[i, j] * _mp(time)
            whole[i, n] = B[i] * _mp(time)
        return list(mpmath.expm(whole, method="taylor") * mpmath.matrix([*x, u]))[:n]

    depth = samples + (late > 0)
    size = n + depth + k
    matrix = mpmath.matrix(size, size)
    for j in range(size):
        unit = [mpmath.mpf(int(i == j)) for i in range(size)]
        x, past, xi = unit[:n], unit[n : n + depth], unit[n + depth :]
        y = sum(c * each for c, each in zip(C, x, strict=True))
        u = _mp(law.D[0, 1]) * y + sum(_mp(law.C[0, i]) * xi[i] for i in range(k))
        known = [u, *past]
        if late > 0:
            x = moved(x, known[samples + 1], late)
        x = moved(x, known[samples], Fraction(dt) - late)
        following = [
            _mp(law.B[i, 1]) * y + sum(_mp(law.A[i, c]) * xi[c] for c in range(k)) for i in range(k)
        ]
        for i, value in enumerate([*x, *known[:depth], *following]):
            matrix[i, j] = value
    values = mpmath.eig(matrix, left=False, right=False)
    return max(abs(each) for each in values)


def _extended(part: Any) -> Any:
    """Return fractions as numbers of extended precision, by two doubles."""
    array = np.array(part, dtype=object)
    first = np.array([float(each) for each in array.ravel()])
    rest = [
        float(each - Fraction(float(one))) for each, one in zip(array.ravel(), first, strict=True)
    ]
    return (first.astype(np.longdouble) + np.array(rest)).reshape(array.shape)


def largest_difference(
    controller: Any, law: ExactLaw, plant: Any, precision: str, samples: int, seed: int
) -> float:
    """Return the largest difference of u between the kernel and the law, |r| ≤ 1."""
    A, B, C, D = (_extended(part) for part in law[:4])
    phi, gamma, H, _ = (
        np.asarray(part, np.longdouble) for part in plant.sampled_matrices(controller.dt)
    )
    kernel = in_single_precision(controller) if precision == "single" else controller
    rng, r, worst = np.random.default_rng(seed), 0.0, 0.0
    x, other = np.zeros(plant.order, np.longdouble), np.zeros(plant.order, np.longdouble)
    xi = np.zeros(len(law.A), np.longdouble)
    kernel.step(0.0, 0.0)
    for k in range(samples):
        if k % 400 == 0:
            r = float(rng.uniform(-1.0, 1.0))
        u = np.longdouble(kernel.step(r, float(H[0] @ x)))
        given = np.array([r, H[0] @ other])
        exact = (C @ xi + D @ given)[0]
        xi = A @ xi + B @ given
        x, other = phi @ x + gamma[:, 0] * u, phi @ other + gamma[:, 0] * exact
        worst = max(worst, float(abs(u - exact)))
    return worst


def main() -> None:
    """Draw loops, and compare."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--samples", type=int, default=20_000, help="of a run with rounding")
    options = options_of(parser, count=4, samples=500)
    warnings.simplefilter("ignore")
    mpmath.mp.dps = 50
    rng = np.random.default_rng(options.seed)
    outside, widest, ratios, stable = 0, 0.0, [], 0
    for i in range(options.count):
        controller, plant, delay, precision = drawn(rng)
        dt = float(controller.dt)
        law = exact_law(controller, precision)
        late = ql.plants.delayed(plant, delay, dt) if delay else plant
        found = stability(controller, late, precision=precision)
        low, high = found.radius
        radius = radius_in_digits(law, plant, dt, delay)
        outside += not low <= radius <= high
        widest, stable = max(widest, high - low), stable + bool(found.stable)
        line = f"{i:3d} {type(controller).__name__:5s} {precision:6s} {mpmath.nstr(radius, 15):18s}"
        if found.stable and not delay:
            seen = largest_difference(controller, law, plant, precision, options.samples, i)
            ratios.append(seen / found.rounding[0])
            line += f" rounding {seen:.2g}, bound {found.rounding[0]:.2g}"
        print(line)
    print(
        f"\n{options.count} loops, {stable} stable: {outside} outside, width at most {widest:.1g}"
    )
    print(f"rounding over its bound: at most {max(ratios):.2g}, median {np.median(ratios):.2g}")
    write(options, {
        "loops": options.count, "stable": stable, "outside": outside, "width": widest,
        "largest rounding over bound": max(ratios), "median": float(np.median(ratios)),
    })  # fmt: skip
    sys.exit(1 if outside or widest > _WIDEST or max(ratios) > 1.0 else 0)


if __name__ == "__main__":
    main()
