"""Modes from free swings: frequencies within 0.5 %, and how often the intervals hold the truth.

Draws swings of 1 to 3 modes about an offset: damping from 0.002 to 0.2, frequencies that differ by
15 % at least and by a factor of 4 at most, amplitudes within a factor of 5, white noise of 0.0003
to 0.02 of the largest, 300 to 8000 samples. The number of modes is not given.
"""

from __future__ import annotations

import numpy as np
from measured import parser_of, write

from quell.identification import free_swing


def drawn(rng: np.random.Generator) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """Return y, dt, the undamped frequencies [rad/s] and the damping of the modes."""
    dt, count = 10.0 ** rng.uniform(-4.0, -2.0), int(rng.integers(1, 4))
    first = rng.uniform(0.005, 0.05) / dt
    found = [first]
    while len(found) < count:
        other = first * rng.uniform(0.3, 4.0)
        if all(abs(other / one - 1.0) > 0.15 for one in found) and other * dt < 0.2:
            found.append(other)
    zeta = 10.0 ** rng.uniform(np.log10(0.002), np.log10(0.2), count)
    omega = 2.0 * np.pi * np.array(found)
    samples = int(np.clip(4.0 / np.min(zeta * omega) / dt, 300, 8000))
    t, y = np.arange(samples) * dt, np.full(samples, rng.uniform(-5.0, 5.0))
    sizes, phases = 10.0 ** rng.uniform(-0.7, 0.0, count), rng.uniform(0.0, 6.0, count)
    for a, z, w, phase in zip(sizes, zeta, omega, phases, strict=True):
        y += a * np.exp(-z * w * t) * np.cos(w * np.sqrt(1.0 - z**2) * t + phase)
    return y + 10.0 ** rng.uniform(-3.5, -1.7) * rng.standard_normal(samples), dt, omega, zeta


def main() -> None:
    """Print the counts."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    near, hold, other = [], [], 0
    swings = 5 if given.quick else given.count
    for i in range(swings):
        y, dt, omega, zeta = drawn(np.random.default_rng([given.seed, i]))
        modes = free_swing(y, dt).modes
        other += len(modes) != omega.size
        for w, z in zip(omega, zeta, strict=True):
            mode = min(modes, key=lambda one: abs(one.omega / w - 1.0))
            near.append(abs(mode.omega / w - 1.0) < 0.005)
            (low, high), (least, most) = mode.omega_interval, mode.damping_interval
            hold.append((low <= w <= high, least <= z <= most))
    share = 100.0 * np.mean(hold, axis=0)
    figures = {
        "swings": swings,
        "modes": len(near),
        "frequency within 0.5 % [%]": 100.0 * float(np.mean(near)),
        "interval holds the frequency [%]": float(share[0]),
        "interval holds the damping [%]": float(share[1]),
        "another number of modes": other,
    }
    print(figures)
    write(given, figures)


if __name__ == "__main__":
    main()
