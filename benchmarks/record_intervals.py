"""Records with much motion: how often poles, gain, delay and friction are in their 95 % intervals.

    python benchmarks/record_intervals.py [--kinds KIND ...] [--draws N] [--seed S] [--verbose]

Kinds of records: ``steps`` (several steps to drawn levels), ``prbs``, ``closed`` (a PI controller
with a reference of steps; u is its output) and ``friction`` (an axis with Coulomb friction that
sticks, torque steps of both signs, speed or position measured). The plants have order 1 to 3 (real
poles; a pair of damping 0.1 to 0.7 in a third of those of order 2 or 3), half of them a dead time
of up to 20 samples, either sign of the gain, and the noise is 0.2, 1 or 5 % of the standard
deviation of the motion (a fifth of it with friction), white, or in half of the draws coloured
(AR(1) with 0.9). The order is given and the delay is searched. Plants of the kinds without friction
are computed by scipy with held inputs; the axis exactly, from one moment of standstill to the next.

For each kind: the share of records with a line that begins with NOT, and among the others the
shares of quantities that are within their 95 % intervals (±1.96 of the stated deviation).
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
from measured import options_of, parser_of, write
from scipy import signal

import quell as ql
from quell.types import Vector

KINDS = ("steps", "prbs", "closed", "friction")
NOISES = (0.002, 0.01, 0.05)


class Drawn(NamedTuple):
    """A record and its plant."""

    u: Vector
    y: Vector
    dt: float
    poles: Vector
    gain: float
    delay: float
    integrators: int
    friction: float | None
    text: str


def drawn_poles(rng: np.random.Generator, order: int, slowest: float, fastest: float) -> Vector:
    """Return stable poles that differ by 20 % or more [rad/s]."""
    while True:
        size = np.sort(np.exp(rng.uniform(np.log(slowest), np.log(fastest), order)))
        if np.all(size[1:] > 1.2 * size[:-1]):
            break
    poles = -size.astype(complex)
    if order > 1 and rng.random() < 1.0 / 3.0:
        zeta = rng.uniform(0.1, 0.7)
        poles[-2:] = size[-2] * np.array([1, -1]) * 1j * np.sqrt(1.0 - zeta**2) - zeta * size[-2]
    return poles


def noisy(rng: np.random.Generator, y: Vector, noise: float, coloured: bool) -> Vector:
    """Return y with noise of a share of its standard deviation."""
    error = rng.standard_normal(y.size)
    if coloured:
        error = signal.lfilter([np.sqrt(1.0 - 0.9**2)], [1.0, -0.9], error)
    return np.asarray(y + noise * np.std(y) * error)


def levels(rng: np.random.Generator, count: int, hold: int, binary: bool) -> Vector:
    """Return an input of held levels, from rest."""
    values = rng.uniform(-1.0, 1.0, count // hold + 2)
    if binary:
        values = np.sign(values)
    return np.append(np.zeros(5), np.repeat(values, hold))[:count]


def drawn_linear(rng: np.random.Generator, kind: str) -> Drawn:
    """Return a record of a plant without friction."""
    order, count = int(rng.integers(1, 4)), int(rng.integers(1000, 4000))
    dt = float(np.exp(rng.uniform(np.log(1e-3), np.log(5.0))))
    slowest, fastest = 40.0 / count / dt, 0.5 / dt
    poles = drawn_poles(rng, order, slowest, fastest)
    gain = float(np.exp(rng.uniform(-3.0, 3.0)) * rng.choice([-1.0, 1.0]))
    dead = int(rng.integers(1, 21)) if rng.random() < 0.5 else 0
    noise, coloured = float(rng.choice(NOISES)), bool(rng.random() < 0.5)
    den = np.real(np.poly(poles))
    A, B, C, _, _ = signal.cont2discrete(signal.tf2ss([gain * den[-1]], den), dt)
    amount = float(rng.choice([0.5, 5.0, 50.0]))
    lag = np.sum(1.0 / np.abs(poles)) / dt + dead
    if kind == "closed":
        u, y = closed_loop(rng, (A, B, C), gain, dead, lag, count, noise, amount)
    else:
        hold = max(int((2.0 if kind == "steps" else 0.7) * lag), 1)
        u = amount * levels(rng, count, hold, kind == "prbs")
        moved = np.append(np.zeros(dead), u)[:count]
        y = signal.dlsim((A, B, C, np.zeros((1, 1)), dt), moved)[1][:, 0]
        y = noisy(rng, y, noise, coloured)
    shown = " ".join(f"{p * dt:.3g}" for p in poles)
    text = f"{kind} order {order} n {count} noise {noise} dead {dead} {'AR' if coloured else ''}"
    return Drawn(u, y, dt, poles, gain, dead * dt, 0, None, f"{text} p dt {shown}")


def closed_loop(
    rng: np.random.Generator, plant: Any, gain: float, dead: int, lag: float, count: int,
    noise: float, amount: float,
) -> tuple[Vector, Vector]:  # fmt: skip
    """Return u and y of a PI loop (by Skogestad's rule) whose controller sees the noise."""
    A, B, C = plant
    T, wait = lag, dead + 0.3 * lag
    kp, ki = T / (gain * 2.0 * wait), 1.0 / (gain * 2.0 * wait)
    r = gain * amount * levels(rng, count, max(int(3.0 * lag), 1), False)
    size = noise * abs(gain) * amount
    x, integral, late = np.zeros(A.shape[0]), 0.0, [0.0] * (dead + 1)
    u, y = np.zeros(count), np.zeros(count)
    for k in range(count):
        y[k] = (C @ x)[0] + size * rng.standard_normal()
        error = r[k] - y[k]
        u[k] = kp * error + ki * integral
        integral += error
        late.append(u[k])
        x = A @ x + B[:, 0] * late[-1 - dead]
    return u, y


def drawn_axis(rng: np.random.Generator) -> Drawn:
    """Return a record of an axis with Coulomb friction: dv/dt = b (u − F sgn v) − v/T, sticking."""
    count = int(rng.integers(2000, 4000))
    dt = float(np.exp(rng.uniform(np.log(1e-4), np.log(1e-2))))
    T = float(rng.uniform(30.0, 200.0)) * dt
    gain = float(np.exp(rng.uniform(-3.0, 6.0)) * rng.choice([-1.0, 1.0]))
    amount = float(rng.choice([0.5, 5.0]))
    friction = float(rng.uniform(0.05, 0.4)) * amount
    u = amount * levels(rng, count, max(int(T / dt), 1), False)
    dead = int(rng.integers(1, 6)) if rng.random() < 0.5 else 0
    late = np.append(np.zeros(dead), u)[:count]
    held, v, y = abs(gain) * friction, 0.0, 0.0
    speed, position = np.zeros(count), np.zeros(count)
    for k in range(count):
        speed[k], position[k] = v, y
        force, left = gain * late[k], dt
        while left > 0.0 and (v != 0.0 or abs(force) > held):
            end = force - held * (np.sign(v) if v != 0.0 else np.sign(force))
            for_stop = T * np.log(1.0 - v / end) if v * end < 0.0 else np.inf
            step = min(left, for_stop)
            after = end + (v - end) * np.exp(-step / T) if step < for_stop else 0.0
            y, v, left = y + end * step + (v - after) * T, after, left - step
    of_speed = bool(rng.random() < 0.5)
    noise, coloured = float(rng.choice(NOISES)) / 5.0, bool(rng.random() < 0.5)
    clean = speed if of_speed else position
    poles = np.array([-1.0 / T]) if of_speed else np.array([0.0, -1.0 / T])
    text = f"friction of {'speed' if of_speed else 'position'} n {count} noise {noise}"
    text += f" T/dt {T / dt:.0f} dead {dead}"
    text += f" F {friction / amount:.2f} {'AR' if coloured else ''}"
    y = noisy(rng, clean, noise, coloured)
    return Drawn(u, y, dt, poles, gain, dead * dt, 0 if of_speed else 1, friction, text)


def judged(one: Drawn) -> dict[str, Any]:
    """Return which quantities of a record are within their intervals."""
    begin = time.perf_counter()
    settings: dict[str, Any] = {"delay": None}
    if one.friction is not None:
        settings |= {"friction": True, "integrators": one.integrators}
    found = ql.identify(one.u, one.y, one.dt, one.poles.size, **settings)
    result: dict[str, Any] = {"seconds": time.perf_counter() - begin, "text": one.text}
    result["said_not"] = "NOT" in str(found)
    result["not"] = [line for line in str(found).splitlines() if "NOT" in line]
    inside = []
    left = [pole for pole in found.poles if not (one.integrators and pole.value == 0.0)]
    for true in one.poles[one.poles != 0.0]:
        if true.imag < 0.0:
            continue
        pole = min(left, key=lambda each: abs(each.value - true))
        left.remove(pole)
        away = pole.value - true
        inside.append(abs(away.real) <= 1.96 * pole.real_std)
        if true.imag:
            inside.append(abs(away.imag) <= 1.96 * pole.imag_std)
    result["poles"] = inside
    low, high = found.gain_interval
    result["gain"] = [bool(low <= one.gain <= high)]
    low, high = found.delay_interval
    result["delay"] = [bool(low - 1e-9 <= one.delay <= high + 1e-9)]
    result["delay error"] = (found.delay - one.delay) / one.dt
    result["delay width"] = (high - low) / one.dt
    if one.friction is not None:
        away = found.friction - one.friction
        result["friction"] = [bool(abs(away) <= 1.96 * found.friction_std)]
        result["friction z"] = away / found.friction_std
    return result


def main() -> None:
    """Print the shares by kind."""
    parser = parser_of(__doc__)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--draws", type=int, default=200, help="of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--verbose", action="store_true")
    args = options_of(parser, draws=1, kinds=("steps", "friction"))
    figures: dict[str, Any] = {}
    for kind in args.kinds:
        results = []
        for i in range(args.draws):
            rng = np.random.default_rng([args.seed, i, KINDS.index(kind)])
            one = drawn_axis(rng) if kind == "friction" else drawn_linear(rng, kind)
            result = judged(one)
            results.append(result)
            if args.verbose:
                print(i, result, flush=True)
        told = [one for one in results if not one["said_not"]]
        shares = {
            name: [value for one in told for value in one.get(name, [])]
            for name in ("poles", "gain", "delay", "friction")
        }
        text = ", ".join(f"{k} {np.mean(v):.1%} of {len(v)}" for k, v in shares.items() if v)
        seconds = np.mean([one["seconds"] for one in results])
        figures[kind] = {
            "records": len(results),
            "NOT [%]": 100.0 * (1.0 - len(told) / len(results)),
            "inside [%]": {k: 100.0 * np.mean(v) if v else "none" for k, v in shares.items()},
            "of": {k: len(v) for k, v in shares.items()},
            "seconds of a record": seconds,
        }
        print(
            f"{kind}: {len(results)} records, NOT {1.0 - len(told) / len(results):.1%}; "
            f"inside: {text}; {seconds:.2f} s a record",
            flush=True,
        )
    write(args, figures)


if __name__ == "__main__":
    main()
