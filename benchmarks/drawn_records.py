"""Drawn records of eight kinds of plant: usable, wrong without NOT, refused; and what tune makes.

Plants: ovens of one lag and of two, tanks (two lags), heat exchangers (three lags), converters (an
LC filter), rigid servos (position), and flexible ones, measured at the motor and at the load. u
is steps, a PRBS, a chirp, a relay in the loop, or a proportional loop with a reference that steps.
On y are white noise of 0.03 to 1 % of its range, and, of a quarter each, a drift of the size of the
noise, and rounding to a step of 0.1 to 0.5 %, of a position a hundredth of these; a tenth is
clipped at the top; u is late by 0 to 10 samples, and y has an offset. Each record is taken
as ``quell tune RECORD`` takes it, without options (``record_model``).

It is *usable* if its gain and each pole are within 3 half widths or 5 % of the truth; otherwise
*wrong without NOT*, *said* (a line with NOT), or *refused*. Of the wrong ones those are *named*
where another model is right, from which the report says that the record does not tell the chosen
one (``quell tune`` tunes for both). Beside
it a least-squares fit of the true form is made, from parameters that are off by up to a third, with
the delay and the clipped samples known: where that has gain and poles within 5 %, the record has an
answer.

With ``--tune`` a controller is tuned for each, with the limits of u alone, and its M_s on the true
plant is found. With ``--axes`` only flexible axes with the encoder at the motor are drawn, and
``quell identify`` without options is to find the resonance within 1 %.
"""

from __future__ import annotations

import time
import warnings
from typing import Any, NamedTuple

import numpy as np
from measured import parser_of, write
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter, tf2ss

import quell as ql
from quell.identification import Measured
from quell.signals import PRBS
from quell.tuning.plants import record_model, with_known_noise

SAMPLES = 3000
KINDS = (
    *("oven", "oven of two lags", "tanks", "heat exchanger"),
    *("converter", "rigid servo", "at the motor", "at the load"),
)
INPUTS = ("steps", "prbs", "chirp", "relay", "loop")


class Record(NamedTuple):
    """A record and the plant behind it."""

    kind: str
    how: str
    u: Any
    y: Any
    clipped: Any  # samples at the top, as the clipping knows them
    dt: float
    num: Any
    den: Any
    late: int  # [samples]


def plant(rng: np.random.Generator, kind: str) -> tuple[Any, Any, float, float]:
    """Return numerator, denominator, sample time and the slowest time that matters."""
    if kind in ("converter", "rigid servo", "at the motor", "at the load"):
        if kind == "converter":
            w, z = 2.0 * np.pi * 10.0 ** rng.uniform(2.5, 3.2), 10.0 ** rng.uniform(-1.3, -0.2)
            return np.array([24.0 * w * w]), np.array([1.0, 2.0 * z * w, w * w]), 2e-5, 5.0 / w
        pole = rng.uniform(2.0, 10.0)
        num, den = np.array([10.0 ** rng.uniform(2.0, 4.0)]), np.array([1.0, pole, 0.0])
        if kind != "rigid servo":
            fixed = 2.0 * np.pi * rng.uniform(15.0, 60.0)
            w, z = fixed * rng.uniform(1.15, 1.8), 10.0 ** rng.uniform(-2.3, -1.3)
            den = np.polymul(den, [1.0 / w**2, 2.0 * z / w, 1.0])
            if kind == "at the motor":
                num = num * np.array([1.0 / fixed**2, 1.6 * z / fixed, 1.0])
        return num, den, 1e-3, 0.3
    slow = 10.0 ** rng.uniform(1.3, 2.0)
    counts = {"oven": 1, "oven of two lags": 2, "tanks": 2, "heat exchanger": 3}
    den = np.ones(1)
    for k in range(counts[kind]):
        den = np.polymul(den, [slow * rng.uniform(0.15, 0.5) ** k, 1.0])
    return np.array([rng.uniform(0.2, 4.0)]), den, 1.0, 3.0 * slow


def drawn(rng: np.random.Generator, kind: str, how: str) -> Record:
    """Return a record."""
    num, den, dt, slow = plant(rng, kind)
    late = int(rng.integers(0, 11 if dt == 1.0 else 3))
    t, hold = np.arange(SAMPLES) * dt, max(int(slow / dt), 1)
    roots = np.abs(np.roots(den))
    fast = min(1.5 * float(np.max(roots)), 0.3 * np.pi / dt)
    low, high = (0.0, 100.0) if dt == 1.0 else (-1.0, 1.0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    u = np.full(SAMPLES, middle)
    if how == "steps":
        levels = rng.uniform(low, high, SAMPLES // hold + 1)
        u[20:] = np.repeat(levels, hold)[: SAMPLES - 20]
    elif how == "prbs":
        every = max(int(0.8 / fast / dt), 1)
        u = middle + half * PRBS(1.0, 11, every * dt, seed=int(rng.integers(1, 900)))(t)
    elif how == "chirp":
        first = 2.0 * np.pi / (SAMPLES * dt) * 2.0
        u = middle + half * np.sin(
            first * t[-1] / np.log(fast / first) * ((fast / first) ** (t / t[-1]) - 1.0)
        )
    # One step of the plant for a held u, as a state space.
    A, B, C, _, _ = cont2discrete(tf2ss(num, den), dt)
    x, before, clean = np.zeros(A.shape[0]), [0.0] * late, np.zeros(SAMPLES)
    size = float(np.abs(np.polyval(num, 1j * fast / 2) / np.polyval(den, 1j * fast / 2)))
    fine = 1e-2 if den[-1] == 0.0 else 1.0  # an encoder has finer steps
    noise, state = fine * 10.0 ** rng.uniform(-3.5, -2.0), 1.0
    wide = half * float(np.abs(np.polyval(num, 1j / slow) / np.polyval(den, 1j / slow)))
    reference = wide * np.repeat(rng.uniform(-0.5, 0.5, SAMPLES // hold + 1), hold)
    gain = 0.15 / size
    for k in range(SAMPLES):
        clean[k] = float(C[0] @ x)
        seen = clean[k] + noise * wide * rng.standard_normal()
        if how == "relay":
            state = -1.0 if seen > 0.02 * wide else (1.0 if seen < -0.02 * wide else state)
            u[k] = middle + half * state * (0.6 + 0.4 * (k // 500 % 2))
        elif how == "loop":
            u[k] = np.clip(middle + gain * (reference[k] - seen), low, high)
        before.append(u[k] - middle)
        x = A @ x + B[:, 0] * before.pop(0)
    span = float(np.ptp(clean)) or 1.0
    y = clean + noise * span * rng.standard_normal(SAMPLES)
    if rng.random() < 0.25:
        walk = lfilter([1.0], [1.0, -0.999], rng.standard_normal(SAMPLES))
        y += noise * span * walk / np.std(walk)
    clipped = np.zeros(SAMPLES, dtype=bool)
    if rng.random() < 0.1:
        top = float(np.min(y) + rng.uniform(0.7, 0.9) * np.ptp(y))
        clipped, y = y > top, np.minimum(y, top)
    if rng.random() < 0.25:
        step = fine * 10.0 ** rng.uniform(-3.0, -2.3) * span
        y = step * np.round(y / step)
    return Record(kind, how, u, y + rng.uniform(-1.0, 1.0) * span, clipped, dt, num, den, late)


def own_fit(rng: np.random.Generator, one: Record) -> bool:
    """Return whether a fit of the true form has gain and poles within 5 %."""
    q = int(one.den[-1] == 0.0)
    roots = np.roots(one.den)
    zeros = np.roots(one.num)
    upper = [r for r in (*roots, *zeros) if r.imag > 0.0 or (r.imag == 0.0 and r != 0.0)]
    gain = one.num[-1] / one.den[-1 - q]
    start = np.log([abs(gain), *(abs(r) for r in upper)])
    ratios = [-r.real / abs(r) for r in upper if r.imag > 0.0]
    u = one.u - (50.0 if one.dt == 1.0 else 0.0)
    u = np.append(np.zeros(one.late), u)[:SAMPLES]
    kept = ~one.clipped
    count = sum(1 for r in roots if r.imag >= 0.0 and r != 0.0)

    def of(theta: Any) -> tuple[Any, Any]:
        values, more = np.exp(theta[: start.size]), list(theta[start.size :])
        parts = [np.ones(1), np.ones(1)]
        for i, root in enumerate(upper):
            w = values[1 + i]
            part = [1.0 / w, 1.0] if root.imag == 0.0 else [1.0 / w**2, 2.0 * more.pop(0) / w, 1.0]
            parts[int(i >= count)] = np.polymul(parts[int(i >= count)], part)
        return values[0] * parts[1], np.append(parts[0], np.zeros(q))

    def error(theta: Any) -> Any:
        try:
            b, a, _ = cont2discrete(of(theta), one.dt)
        except (ValueError, np.linalg.LinAlgError):
            return np.full(int(np.sum(kept)), 1e6)
        away = one.y - lfilter(b.ravel(), a, u)
        away = away[kept]
        return np.nan_to_num(away - np.mean(away), nan=1e6, posinf=1e6, neginf=-1e6)

    first = np.concatenate([start + rng.uniform(-0.3, 0.3, start.size), ratios])
    done = least_squares(error, first, x_scale="jac", max_nfev=60)
    found = np.exp(done.x[: 1 + count])
    return bool(np.all(np.abs(found / np.exp(start[: 1 + count]) - 1.0) < 0.05))


def judged(one: Record, model: Any) -> bool:
    """Return whether gain and poles are within 3 half widths or 5 % of the truth."""
    q = int(one.den[-1] == 0.0)
    gain = one.num[-1] / one.den[-1 - q]
    low, high = model.gain_interval
    away = abs(model.gain - gain) <= max(1.5 * (high - low), 0.05 * abs(gain))
    if model.integrators != q or not away:
        return False
    for value in np.roots(one.den):
        if value == 0.0:
            continue
        near = min(model.poles, key=lambda pole: abs(pole.value - value))
        if abs(near.value - value) > max(3.0 * 1.96 * near.deviation, 0.05 * abs(value)):
            return False
    return True


def tuned(one: Record, found: Any) -> float | str:
    """Return M_s on the true plant, infinite if the loop is unstable; why there is none."""
    low, high = (0.0, 100.0) if one.dt == 1.0 else (-1.0, 1.0)
    try:
        plants, delays = found.plants
        limits = {"u_min": low, "u_max": high}
        bounds = with_known_noise(ql.tuning.Constraints(), found.model, (low, high))
        done = ql.tune(plants, one.dt, delay=delays, constraints=bounds, **limits)
    except ValueError as error:
        return str(error)
    loop = ql.analysis.analyse((one.num, one.den), done.controller, delay=one.late * one.dt)
    return 1.0 / loop.margins.modulus if loop.stable else float("inf")


def resonances(given: Any) -> dict[str, float]:
    """Return how often the resonance of a flexible axis is found within 1 %."""
    near, unsaid, clipped = 0, 0, 0
    count = 2 if given.quick else given.count
    for i in range(count):
        rng = np.random.default_rng([given.seed, i, 7])
        one = drawn(rng, "at the motor", ("prbs", "chirp", "steps")[i % 3])
        true = max(abs(value) for value in np.roots(one.den))
        model = ql.identify(one.u, one.y, one.dt)
        found = any(abs(pole.omega / true - 1.0) < 0.01 for pole in model.poles)
        near, clipped = near + found, clipped + bool(np.any(one.clipped))
        if not found:
            unsaid += not model.shortcomings
            print(i, one.how, f"{true:.2f}", model, flush=True)
    return {
        "axes": float(count),
        "resonance within 1 %": float(near),
        "not found, without NOT": float(unsaid),
        "records that are clipped": float(clipped),
    }


def main() -> None:
    """Print a line for each record that is not usable, and the counts."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--tune", action="store_true", help="tune a controller for each, too")
    parser.add_argument("--axes", action="store_true", help="flexible axes alone: the resonance")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    if given.axes:
        figures = resonances(given)
        print(figures)
        write(given, figures)
        return
    results: list[tuple[Record, str, bool, bool]] = []
    margins: list[float | str] = []
    named: list[bool] = []
    for i in range(2 if given.quick else given.count):
        rng = np.random.default_rng([given.seed, i])
        kind = KINDS[i % len(KINDS)]
        one = drawn(rng, kind, INPUTS[i // len(KINDS) % len(INPUTS)])
        answer, began, said = own_fit(rng, one), time.process_time(), False
        try:
            found = record_model(Measured(one.u, one.y, one.dt, None))
        except ValueError as error:
            outcome, why, found = "refused", str(error), None
        else:
            said = bool(found.model.shortcomings)
            why = "; ".join(found.model.shortcomings)
            if found.refusal:
                outcome = "refused"
            elif judged(one, found.model):
                outcome = "usable"
            else:
                outcome = "said" if said or not found.model.converged else "wrong"
                named.append(
                    outcome == "wrong" and any(judged(one, other) for other in found.others)
                )
        results.append((one, outcome, answer, said))
        if outcome != "usable":
            model = "" if found is None else repr(found.model)
            true = ", ".join(f"{value:.4g}" for value in np.roots(one.den))
            print(
                f"{i} {kind}, {one.how}: {outcome} (own fit {answer}); poles {true}; {model} "
                f"{why[:110]}; {time.process_time() - began:.0f} s",
                flush=True,
            )
        if given.tune:
            none: Any = "refused"
            margins.append(none if found is None or outcome == "refused" else tuned(one, found))
            print(f"{i} {kind}: M_s {margins[-1]}", flush=True)
    total = len(results)
    answers = [outcome for _, outcome, answer, _ in results if answer]
    simple = [said for one, _, _, said in results if one.kind in ("oven", "rigid servo")]
    figures = {
        "records": total,
        **{
            name: sum(outcome == name for _, outcome, _, _ in results)
            for name in ("usable", "wrong", "said", "refused")
        },
        "of the wrong ones named": sum(named),
        "usable [%]": 100.0 * sum(outcome == "usable" for _, outcome, _, _ in results) / total,
        "own fit succeeds": len(answers),
        "usable of these [%]": 100.0 * answers.count("usable") / max(len(answers), 1),
        "ovens and rigid servos": len(simple),
        "of these with NOT": sum(simple),
    }
    if given.tune:
        known = [value for value in margins if isinstance(value, float)]
        figures |= {
            "tuned": len(known),
            "M_s of 2 at most": sum(value <= 2.0 for value in known),
            "M_s above 2.5 or unstable": sum(value > 2.5 for value in known),
            "no controller": len(margins) - len(known),
        }
    print(figures)
    write(given, figures)


if __name__ == "__main__":
    main()
