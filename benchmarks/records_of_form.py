"""Records of motors and ovens of the fitted form: lines with NOT, and how far the gain is off.

Motors: an inertia of 5e-5 to 1e-3 kg m² with viscous friction, an encoder of 4096 to 2^20 counts,
1 ms, a chirp or steps of the torque. Ovens: one lag, steps of the power, a drift of 0.1 °C and a
display of 0.1 °C, 1 s. u is late by up to two samples of a motor and ten of an oven, parts of a
sample included; the plant is solved in ten steps a sample. Each is identified with its own order
and a delay that is searched.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from measured import parser_of, write
from scipy.signal import cont2discrete, lfilter

import quell as ql

SAMPLES, STEPS = 4000, 10


def answer(num: Any, den: Any, dt: float, u: Any, late: float) -> Any:
    """Return y for a held u that is late, from rest under its first value."""
    b, a, _ = cont2discrete((num, den), dt / STEPS)
    fine, count = np.repeat(u - u[0], STEPS), round(late / dt * STEPS)
    return lfilter(b.ravel(), a, np.append(np.zeros(count), fine)[: fine.size])[::STEPS]


def motor(rng: np.random.Generator) -> tuple[Any, Any, float, int, float]:
    """Return u, y, dt, order and gain."""
    dt, inertia = 1e-3, 10.0 ** rng.uniform(-4.3, -3.0)
    pole, torque = rng.uniform(0.3, 10.0), inertia * rng.uniform(20.0, 200.0)
    t = np.arange(SAMPLES) * dt
    u = torque * np.sin(2.0 * np.pi * (t + 14.5 / t[-1] * t**2))
    if rng.random() < 0.5:
        u = torque * np.repeat(rng.choice([-1.0, 1.0], SAMPLES // 20), 20)
    y = answer([1.0 / inertia], [1.0, pole, 0.0], dt, u, dt * rng.uniform(0.0, 2.0))
    count = 2.0 * np.pi / rng.choice([4096.0, 2.0**17, 2.0**20])
    y = count * np.round((y + rng.uniform(0.0, 1.0) * count * rng.standard_normal(y.size)) / count)
    return u, y, dt, 2, 1.0 / inertia / pole


def oven(rng: np.random.Generator) -> tuple[Any, Any, float, int, float]:
    """Return u, y, dt, order and gain."""
    dt, gain, lag = 1.0, rng.uniform(0.3, 3.0), 10.0 ** rng.uniform(1.8, 2.9)
    u = np.repeat(rng.uniform(10.0, 80.0, SAMPLES // 400), 400)
    u[:60] = 20.0
    drift = lfilter([1.0], [1.0, -0.999], 0.1 * np.sqrt(0.002) * rng.standard_normal(SAMPLES))
    y = 20.0 + answer([gain / lag], [1.0, 1.0 / lag], dt, u, rng.uniform(0.0, 10.0))
    y += drift + 0.05 * rng.standard_normal(SAMPLES)
    return u, 0.1 * np.round(y / 0.1), dt, 1, gain


def main() -> None:
    """Print a line for each kind."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=100, help="records of each kind")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    figures = {}
    for name, draw in (("motors", motor), ("ovens", oven)):
        nots, wrong, off = 0, 0, []
        for i in range(2 if given.quick else given.count):
            u, y, dt, order, gain = draw(np.random.default_rng([given.seed, i]))
            found = ql.identify(u, y, dt, order=order, delay=None)
            nots += bool(found.shortcomings)
            off.append(abs(found.gain / gain - 1.0))
            low, high = found.gain_interval
            far = off[-1] > max(0.05, 1.5 * (high - low) / abs(gain))
            wrong += far and not found.shortcomings
        figures[name] = {
            "records": len(off),
            "with NOT": nots,
            "gain off by over 5 % and 3 half widths, without NOT": int(wrong),
            "gain off by, median [%]": 100.0 * float(np.median(off)),
            "gain off by, largest [%]": 100.0 * float(np.max(off)),
        }
        print(name, figures[name])
    write(given, figures)


if __name__ == "__main__":
    main()
