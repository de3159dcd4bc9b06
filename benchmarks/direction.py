"""Trial of the checks of y by random loops: honest ones, and the same kind with b0 of a wrong sign.

    python benchmarks/direction.py                       # 3000 loops, two minutes
    python benchmarks/direction.py --loops 300 --seed 7

Plants of order 1 to 4 (integrators, damped, springs, a zero in the right half plane, the torsional
testbed with friction and encoder), some delayed, some read by an encoder; ``b0`` wrong by up to a
factor 2; ADRC with and without learner and guard; references that step, move, oscillate or stay;
loads of 5 to 90 % of u's limit that step, grow or oscillate, at any time; noise. Three questions:

* does ``quell.realtime.supervisor`` end a run of an honest loop that is stable;
* how often, and how soon, does it end a run with the wrong sign;
* how far does y of a stable loop leave the range of its reference, in units of that range plus the
  reach of u: ``quell.realtime.supervisor`` allows ten.
"""

from __future__ import annotations

import math
import warnings
from typing import Any, NamedTuple

import numpy as np
from measured import options_of, parser_of, write

import quell as ql
from quell.kernels import dispatch
from quell.kernels.dispatch import call_specialised, compiled
from quell.realtime import Safety
from quell.realtime.supervisor import ARMED, initial_state, runs_away

KINDS = ("integrators", "damped", "spring", "zero on the right", "torsional")
LOADS = ("none", "step", "ramp", "sine")
REFERENCES = ("step", "move", "trapezoid", "sine", "constant")


class Loop(NamedTuple):
    """The result of one loop."""

    kind: str
    load: str
    reference: str
    wrong: bool
    stable: bool
    ended: float  # time of the trip times omega_c, NaN if there was none
    beyond: float  # how far y left the range of the reference, in units of range plus reach


class Draw:
    """Random choices."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)

    def between(self, low: float, high: float) -> float:
        """Return a number, uniform in its logarithm."""
        return float(np.exp(self.random.uniform(np.log(low), np.log(high))))

    def uniform(self, low: float, high: float) -> float:
        """Return a number."""
        return float(self.random.uniform(low, high))

    def one_of(self, values: tuple[str, ...]) -> str:
        """Return one of some names."""
        return str(self.random.choice(values))


def plant(draw: Draw, kind: str, order: int, omega_c: float, b: float) -> ql.plants.LinearPlant:
    """Return a linear plant with the gain b at high frequencies."""
    den = np.ones(1)
    for _ in range(order):
        den = np.polymul(
            den, [1.0, 0.0 if kind == "integrators" else omega_c * draw.between(0.05, 2)]
        )
    if kind == "spring" and order > 1:
        omega, zeta = omega_c * draw.between(0.3, 5.0), draw.between(0.02, 0.7)
        rest = [1.0, omega_c * draw.between(0.05, 2.0)]
        den = np.polymul([1.0, 2.0 * zeta * omega, omega**2], [1.0, *np.zeros(order - 2)])
        den = np.polymul(den[: order - 1 + 1], rest) if order > 2 else den
        den = den[: order + 1]
    num = [b]
    if kind == "zero on the right" and order > 1:
        num = [-b / (omega_c * draw.between(1.2, 10.0)), b]
    return ql.plants.LinearPlant.of((num, den))


def signal(draw: Draw, kind: str, size: float, omega_c: float) -> Any:
    """Return a reference."""
    start = draw.uniform(0.0, 2.0) / omega_c
    if kind == "sine":
        return ql.signals.Sinusoid(size, omega_c * draw.uniform(0.05, 1.5))
    if kind == "move":
        return ql.signals.SmoothMove(size, draw.uniform(0.2, 10.0) / omega_c, start=start)
    if kind == "trapezoid":
        time = draw.uniform(1.0, 10.0) / omega_c
        return ql.signals.Trapezoid(size, time, time * draw.uniform(0.1, 0.5), start)
    return size if kind == "step" else 0.0


def load(draw: Draw, kind: str, size: float, omega_c: float, dt: float) -> Any:
    """Return a load in units of u."""
    start = max(draw.uniform(0.0, 8.0) / omega_c, dt)
    if kind == "step":
        return ql.signals.Step(size, start)
    if kind == "ramp":
        return ql.signals.SmoothMove(size, draw.uniform(1.0, 10.0) / omega_c, start=start)
    return ql.signals.Sinusoid(size, omega_c * draw.between(0.05, 3.0)) if kind == "sine" else 0.0


@compiled
def first_trip(rules: Any, state: Any, y: Any, u: Any, r: Any) -> int:
    """Return the sample in which the check would end the run, −1 for none."""
    signals = state.signals
    watch = signals.watched[0]
    watch.y_began, watch.watching = y[0], ARMED
    for k in range(y.size):
        watch.y, signals.r[0] = y[k], r[k]
        signals.v[0] = rules.b0[0] * u[k - 1] if k > 0 else 0.0
        if runs_away(rules, signals, 0):
            return k
    return -1


def trial(draw: Draw, wrong: bool) -> Loop:
    """Simulate a random loop and judge it."""
    kind, order = draw.one_of(KINDS), int(draw.random.integers(1, 5))
    omega_c, b = draw.between(0.3, 60.0), draw.between(0.1, 100.0)
    if kind == "torsional":
        order, omega_c, b = 4, draw.between(8.0, 30.0), 5.5e4
    b0 = b * draw.between(0.5, 2.0)
    omega_o = omega_c * draw.between(2.5, 10.0)
    dt = 0.2 / omega_o * draw.between(0.2, 1.0)
    size = draw.between(0.1, 10.0) if kind == "torsional" else draw.between(0.01, 100.0)
    u_max = size * omega_c**order / b0 * draw.between(0.05, 20.0)
    if kind == "torsional":
        u_max = min(u_max, 5.0)
    reach = b0 * u_max / omega_c**order
    options: dict[str, Any] = {}
    if draw.uniform(0.0, 1.0) < 0.4:
        options = {"learner": ql.learners.Kalman(), "guard": ql.Guard()}
    observer = ql.ESO.model_free(order=order, b0=-b0 if wrong else b0, omega_o=omega_o, dt=dt)
    controller = ql.ADRC(observer, omega_c, u_min=-u_max, u_max=u_max, **options)
    noise = float(draw.random.choice([0.0, 1e-4, 1e-3])) * min(size, reach)
    if kind == "torsional":
        model: Any = ql.plants.torsional()
        noise = 0.0
    else:
        model = plant(draw, kind, order, omega_c, b)
        if draw.uniform(0.0, 1.0) < 0.2:
            model = ql.plants.delayed(model, 2 * dt, dt)
        elif draw.uniform(0.0, 1.0) < 0.25:
            counts = 2.0 * math.pi / (min(size, reach) * draw.between(1e-4, 1e-2))
            model = ql.plants.encoded(model, max(int(counts), 1))
    loading, moving = draw.one_of(LOADS), draw.one_of(REFERENCES)
    power = u_max * draw.uniform(0.05, 0.9) * float(draw.random.choice([-1.0, 1.0]))
    scenario = ql.Scenario(
        signal(draw, moving, size, omega_c),
        draw.uniform(15.0, 40.0) / omega_c,
        (load(draw, loading, power, omega_c, dt),) if kind != "torsional" else (),
        ql.signals.BandLimitedNoise(noise**2 * dt, dt) if noise else 0.0,
        seed=int(draw.random.integers(1 << 30)),
    )
    loading = "none" if kind == "torsional" else loading
    run = ql.simulate(model, controller, scenario, limit=1e15)
    y, u, r = (np.ascontiguousarray(run[name]) for name in ("y_measured", "u", "r"))
    rules, state = Safety().rules(controller, scenario).limits, initial_state()
    rest = y[0] + noise * draw.random.standard_normal(20)  # y in START
    watch = state.signals.watched[0]
    watch.y_rest_low, watch.y_rest_high = np.min(rest), np.max(rest)
    k = call_specialised(first_trip, rules, state, y, u, r)
    low, high = min(0.0, float(np.min(r))), max(0.0, float(np.max(r)))
    beyond = max(low - np.min(y), np.max(y) - high, 0.0) / (high - low + rules.reach[0])
    last = np.abs(r - y)[-y.size // 4 :]
    stable = not run.diverged and float(np.max(last)) < 0.5 * max(high - low, rules.reach[0])
    ended = k * dt * omega_c if k >= 0 else math.nan
    return Loop(kind, loading, moving, wrong, stable, ended, float(beyond))


def main() -> None:
    """Run the loops and print the answers."""
    parser = parser_of(__doc__)
    parser.add_argument("--loops", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    options = options_of(parser, loops=9)
    dispatch.interpret_all = options.quick  # few loops are quicker so than to compile
    warnings.simplefilter("ignore", ql.DesignWarning)
    draw = Draw(options.seed)
    loops = [trial(draw, wrong=i % 3 == 2) for i in range(options.loops)]
    write(options, print_table(loops))


def print_table(loops: list[Loop]) -> dict[str, Any]:
    """Print counts, times and distances; return them."""
    print(f"{'loops':<38} {'number':>6} {'ended':>6} {'omega_c t: median':>18} {'90 %':>6}")
    honest = [one for one in loops if not one.wrong]
    stable = [one for one in honest if one.stable]
    wrong = [one for one in loops if one.wrong]
    moving = [one for one in wrong if one.reference != "constant"]
    rows = {
        "honest, stable, without load": [one for one in stable if one.load == "none"],
        "honest, stable, with load": [one for one in stable if one.load != "none"],
        "honest, not stable": [one for one in honest if not one.stable],
        "wrong sign, reference moves": moving,
        "wrong sign, it moves, without load": [one for one in moving if one.load == "none"],
        "wrong sign, reference constant": [one for one in wrong if one.reference == "constant"],
    }
    rows |= {
        f"wrong sign, it moves, {kind}": [o for o in moving if o.kind == kind] for kind in KINDS
    }
    figures: dict[str, Any] = {}
    for name, group in rows.items():
        times = [one.ended for one in group if not math.isnan(one.ended)]
        median, most = np.quantile(times, [0.5, 0.9]) if times else (math.nan, math.nan)
        print(f"{name:<38} {len(group):>6} {len(times):>6} {median:>18.1f} {most:>6.1f}")
        ended = {"median": median, "90 %": most} if times else "none was ended"
        figures[name] = {"loops": len(group), "ended": len(times), "omega_c t": ended}
    far = sorted(one.beyond for one in stable)
    print(
        f"y of stable loops beyond the reference, in units of range plus reach: 99 % below "
        f"{np.quantile(far, 0.99):.2f}, largest {far[-1]:.2f}"
    )
    late = [o for o in wrong if math.isnan(o.ended) and o.beyond > 10.0]
    print(f"wrong sign, not ended by the first motion, but by the bounds of y: {len(late)}")
    return figures | {
        "y of stable loops beyond the reference": {
            "99 %": np.quantile(far, 0.99), "largest": far[-1],
        },
        "wrong sign, ended by the bounds of y": len(late),
    }  # fmt: skip


if __name__ == "__main__":
    main()
