"""Step records: how often the stated intervals hold, and whether the set for tuning has the plant.

    python benchmarks/step_records.py [--draws N] [--seed S] [--json FILE] [--verbose]
    python benchmarks/step_records.py --set [--tune STRUCTURE] [--draws N] [--seed S]

Each draw is the record of one step from rest: a plant of order 1, 2 or 3 (lags, at order 3 also an
oscillating pair), with or without a dead time of up to 40 samples, of either sign of the gain, 1, 5
or 50 samples of rest before the step, and noise of 0.1, 0.5 or 2 % of the motion, rounded to steps
of the same size in half of the draws. The record lasts for 3 to 8 times the sum of the lags and the
dead time. It is identified with the order that the plant has and a delay that is searched; a record
is *right* if the true gain is within the stated 95 % interval, *not decided* if a line begins with
NOT, and *wrong* otherwise. With ``--set`` the model is chosen as ``quell tune`` does it, from order
4 on, and the true plant is *inside* the set of plants for tuning if its gain, and its size and
phase at twelve frequencies up to three times its second pole, are within the range of those of the
set, to 0.1 % and half a degree. With ``--tune`` a controller of a structure is tuned for the set
and put around the true plant: whether the loop is stable, and its M_s over the one promised.
"""

from __future__ import annotations

import itertools
import time
from typing import Any, NamedTuple

import numpy as np
from measured import options_of, parser_of, write
from scipy import signal

import quell as ql
from quell.identification import not_told_apart
from quell.tuning.plants import identified_plants
from quell.types import Vector

RESTS, NOISES = (1, 5, 50), (0.001, 0.005, 0.02)


class Step(NamedTuple):
    """A record and its plant."""

    u: Vector
    y: Vector
    dt: float
    num: Vector
    den: Vector
    delay: float
    text: str

    @property
    def gain(self) -> float:
        """The plant's gain."""
        return float(self.num[-1] / self.den[-1])


def drawn(seed: int, rest: int, noise: float, order: int, late: bool) -> Step:
    """Return a record of one step."""
    rng = np.random.default_rng([seed, rest, order, int(late), round(1e4 * noise)])
    dt = float(np.exp(rng.uniform(np.log(1e-3), np.log(5.0))))
    count = int(rng.integers(300, 1200))
    gain = float(np.exp(rng.uniform(-3.0, 3.0)) * rng.choice([-1.0, 1.0]))
    shares = np.sort(rng.dirichlet(np.full(order, 1.5)))[::-1]
    dead = int(rng.integers(2, 41)) if late else 0
    lengths = float(rng.uniform(3.0, 8.0))
    total = max((count - rest) / lengths - dead, 20.0) * dt
    lags = np.maximum(shares * total, 2.0 * dt)
    den = np.ones(1)
    if order == 3 and rng.random() < 0.3:
        zeta = float(rng.uniform(0.2, 0.7))
        den = np.polymul(
            [lags[1] * lags[2], 2.0 * zeta * np.sqrt(lags[1] * lags[2]), 1.0], [lags[0], 1.0]
        )
    else:
        for lag in lags:
            den = np.polymul(den, [lag, 1.0])
    num = np.array([gain]) / den[0]
    den = den / den[0]
    amount = float(rng.choice([0.5, 5.0, 50.0]))
    u = np.where(np.arange(count) >= rest, amount, 0.0) + float(rng.choice([0.0, 2.0]))
    A, B, C, _, _ = signal.cont2discrete(signal.tf2ss(num, den), dt)
    moved = np.concatenate([np.zeros(dead), u - u[0]])[:count]
    y = signal.dlsim((A, B, C, np.zeros((1, 1)), dt), moved)[1][:, 0]
    size = noise * abs(gain) * amount
    y = y + size * rng.standard_normal(count) + float(rng.uniform(-2.0, 2.0)) * abs(gain) * amount
    rounded = rng.random() < 0.5
    if rounded:
        y = np.round(y / size) * size
    text = f"order {order} rest {rest:2} noise {100 * noise:.1f} % dead {dead:2}"
    text += " rounded" if rounded else ""
    return Step(u, y, dt, num, den, dead * dt, text)


def judged(step: Step, order: int) -> dict[str, Any]:
    """Return how identification does on a record."""
    begin = time.perf_counter()
    found = ql.identify(step.u, step.y, step.dt, order, delay=None)
    low, high = found.gain_interval
    report = str(found)
    return {
        "text": step.text,
        "said_not": "NOT" in report,
        "covered": bool(low <= step.gain <= high),
        "wrong_sign": bool(found.gain * step.gain < 0.0),
        "gain": found.gain / step.gain,
        "width": (high - low) / abs(found.gain) if np.isfinite(high - low) else None,
        "delay_covered": bool(
            found.delay_interval[0] - 1e-9 <= step.delay <= found.delay_interval[1] + 1e-9
        ),
        "delay": (found.delay - step.delay) / step.dt,
        "seconds": time.perf_counter() - begin,
        "z": _z(found, step),
        "undecided": found.undecided,
        "rest": (found.rest, found.rest_probability),
        "white": found.residuals.white,
    }


def judged_set(step: Step, structure: str | None) -> dict[str, Any]:
    """Return how the set of plants does that ``quell tune`` uses, and a controller tuned for it."""
    begin = time.perf_counter()
    result: dict[str, Any] = {"text": step.text, "refused": "", "inside": None, "gain_inside": None}
    result |= {"stable": None, "M_s": None}
    try:
        found, *others = not_told_apart(ql.identify(step.u, step.y, step.dt, 4, delay=None), None)
        if found.faults:
            raise ValueError(found.faults[0])
        plants, delays = identified_plants(found, others)
    except ValueError as error:
        return result | {"refused": str(error)[:80], "seconds": time.perf_counter() - begin}
    result["seconds"] = time.perf_counter() - begin
    poles = np.sort(np.abs(np.roots(step.den)))
    omega = np.append(1e-6 * poles[0], np.geomspace(poles[0] / 5.0, 3.0 * poles[:2][-1], 12))

    def response(num: Vector, den: Vector, delay: float) -> Any:
        s = 1j * omega
        return np.polyval(num, s) / np.polyval(den, s) * np.exp(-s * delay)

    true = response(step.num, step.den, step.delay)
    ratios = np.array([response(*plant, T) for plant, T in zip(plants, delays, strict=True)]) / true
    size, phase = np.abs(ratios), np.angle(ratios, deg=True)
    # How far the true plant is outside the range of the set, at the worst of the frequencies.
    off_size = max(float(np.max(size.min(axis=0))), 1.0 / float(np.min(size.max(axis=0))), 1.0)
    off_phase = max(float(np.max(phase.min(axis=0))), -float(np.min(phase.max(axis=0))), 0.0)
    result["inside"] = off_size <= 1.001 and off_phase <= 0.5
    result["off"] = (off_size, off_phase)
    result["gain_inside"] = bool(size[:, 0].min() <= 1.0 <= size[:, 0].max())
    if structure is not None:
        try:
            tuned = ql.tune(plants, step.dt, delay=delays, structure=structure, compare=())
        except ValueError as error:
            return result | {"refused": str(error)[:80]}
        plant = (step.num, step.den)
        loop = ql.analysis.analyse(plant, tuned.controller, delay=step.delay)
        result["stable"] = bool(loop.stable)
        if loop.stable:
            result["M_s"] = 1.0 / loop.margins.modulus / tuned.constraints.m_s
    return result


def _z(found: Any, step: Step) -> float:
    """Return the error of the slowest pole in its standard deviations."""
    true = np.roots(step.den)
    true = true[np.argmin(np.abs(true))]
    pole = min(found.poles, key=lambda one: abs(one.value))
    return float(abs(pole.value - true) / max(pole.deviation, 1e-300))


def main() -> None:
    """Print shares of right, undecided and wrong results."""
    parser = parser_of(__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--set", action="store_true")
    parser.add_argument("--tune", help="structure, for example bandwidths")
    parser.add_argument("--orders", type=int, nargs="+", choices=(1, 2, 3), default=[1, 2, 3])
    parser.add_argument("--noises", type=float, nargs="+", default=NOISES)
    parser.add_argument("--late", type=int, nargs="+", choices=(0, 1), default=[0, 1])
    parser.add_argument("--rests", type=int, nargs="+", default=RESTS, help="samples of rest")
    args = options_of(parser, orders=[1], noises=[0.005], rests=[5], late=[1])
    cases = list(itertools.product(args.orders, map(bool, args.late), args.rests, args.noises))
    each = max(args.draws // len(cases), 1)
    results = []
    for order, late, rest, noise in cases:
        for i in range(each):
            seed = 1000 * args.seed + i
            step = drawn(seed, rest, noise, order, late)
            result = judged_set(step, args.tune) if args.set else judged(step, order)
            result |= {"order": order, "rest_samples": rest, "late": late, "noise": noise}
            results.append(result | {"seed": seed})
            wrong = result["inside"] is False if args.set else _is_wrong(result)
            if args.verbose and wrong:
                print(results[-1])
    write(args, _summary_of_sets(results) if args.set else _summary(results))


def _is_wrong(result: dict[str, Any]) -> bool:
    return not result["covered"] and not result["said_not"]


def _summary_of_sets(results: list[dict[str, Any]]) -> dict[str, Any]:
    used = [one for one in results if not one["refused"]]
    print(f"{len(results)} records, {len(results) - len(used)} refused:")
    figures: dict[str, Any] = {"records": len(results), "refused": len(results) - len(used)}
    for reason in sorted({one["refused"] for one in results if one["refused"]}):
        print(f"  {sum(one['refused'] == reason for one in results)} × {reason}")
    for name in ("inside", "gain_inside", "stable"):
        values = [one[name] for one in used if one[name] is not None]
        if values:
            print(f"{name}: {np.mean(values):.1%} of {len(values)}")
            figures[name] = {"share [%]": 100.0 * np.mean(values), "of": len(values)}
    off = np.array([one["off"] for one in used if one["inside"] is not None])
    if off.size:
        size, phase = np.quantile(off, 0.95, axis=0)
        print(f"outside by at most a factor of {size:.3f} in 95 %, by {phase:.2f} degrees in 95 %")
        near = np.mean((off[:, 0] <= 1.02) & (off[:, 1] <= 2.0))
        print(f"within 2 % and 2 degrees: {near:.1%}")
        figures |= {"size, 95 %": size, "phase, 95 % [deg]": phase, "near [%]": 100.0 * near}
    ratios = [one["M_s"] for one in used if one["M_s"] is not None]
    if ratios:
        within = np.mean(np.array(ratios) <= 1.2)
        print(f"M_s over the promised one: at most 1.2 in {within:.1%}, largest {max(ratios):.3f}")
        figures |= {"M_s within 1.2 [%]": 100.0 * within, "M_s, largest": max(ratios)}
    figures["seconds of a record"] = np.mean([one["seconds"] for one in results])
    print(f"{figures['seconds of a record']:.2f} s of identification a record")
    return figures


def _summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    figures: dict[str, Any] = {}
    for name in ("all", "order", "late", "rest_samples", "noise"):
        for value in sorted({one.get(name) for one in results}, key=str):
            part = [one for one in results if one.get(name) == value]
            told = [one for one in part if not one["said_not"]]
            widths = [one["width"] for one in told if one["width"] is not None]
            row = {
                "records": len(part),
                "NOT [%]": 100.0 * (1.0 - len(told) / len(part)),
                "gain covered [%]": 100.0 * np.mean([one["covered"] for one in told]),
                "sign wrong without NOT": sum(one["wrong_sign"] for one in told),
                "median width": np.median(widths) if widths else np.nan,
                "delay covered [%]": 100.0 * np.mean([one["delay_covered"] for one in told]),
                "slow pole within 2 [%]": 100.0 * np.mean([one["z"] < 2.0 for one in told]),
                "seconds": np.mean([one["seconds"] for one in part]),
            }
            print(f"{name} {value}: " + ", ".join(f"{key} {row[key]:.4g}" for key in row))
            figures[f"{name} {value}"] = {
                key: each if np.isfinite(each) else "nothing is told" for key, each in row.items()
            }
    return figures


if __name__ == "__main__":
    main()
