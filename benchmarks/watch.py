"""``quell watch`` on simulated machines: false alarms in months, and the delay of true ones.

    python benchmarks/watch.py                 # 1000 months, half an hour
    python benchmarks/watch.py --months 50     # a look
    python benchmarks/watch.py --axes          # two coupled axes only

Two machines at 1 kHz under an ADRC: a *servo* (``dc_motor``: 2e-4 kg m², encoder of 8192 counts,
Coulomb friction) and an *axis* (two inertias of 2e-4 kg m² with a coupling, measured at the drive).
A window is a minute of drawn moves and loads, with drawn noise, a friction that differs by 5 %
from window to window and a torque constant that differs by 0.3 %. 150 windows of each healthy
machine are simulated. A month is 720 windows, one each hour, drawn from these; each month has a
``Watch`` of its own, from the first window on.

A change comes after a month: windows are then drawn from 60 of a changed machine. The delay is the
number of windows from the change to the first alarm.

*Two coupled axes* are inertias of 2e-4 kg m² that both motors move, under ``Axes``; viscous
friction differs by 5 % from window to window. A motor loses torque, or an axis gets more friction:
which axes alarm within 60 windows, and whether a line says that they changed together.

*Day and night* are months in which friction follows the time of day by ±15 %, so that windows are
not exchangeable: what the watch then says.
"""

from __future__ import annotations

import math
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from measured import options_of, parser_of, write

import quell as ql
from quell.monitoring import Machine, Signals, Watch, features_of

DT, WINDOW, HOURS = 1e-3, 60.0, 720
J = 2e-4
AXES = ("x", "y")
Pool = list[dict[str, float]]


def moves(rng: np.random.Generator, t: Any) -> Any:
    """Return a reference of one move a second, with the least jerk."""
    r, position = np.zeros(t.size), 0.0
    for begin in np.arange(0.0, t[-1], 1.0):
        k, goal = int(begin / DT), rng.uniform(-3.0, 3.0)
        s = np.clip((t[k:] - t[k]) / rng.uniform(0.3, 0.8), 0.0, 1.0)
        r[k:] = position + (goal - position) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        position = goal
    return r


def window(
    plant: Any, b0: float, limit: float, noise: float, rng: np.random.Generator, seconds: float
) -> Any:
    """Return the numbers of a window of a machine."""
    t = np.arange(round(seconds / DT) + 1) * DT
    times = np.arange(0.0, seconds + 1.0, 0.5)
    load = np.interp(t, times, 0.003 * rng.normal(size=times.size))
    scenario = ql.Scenario(
        ql.signals.Samples(t, moves(rng, t)),
        seconds,
        (ql.signals.Samples(t, load),),
        noise=ql.signals.BandLimitedNoise(noise**2 * DT, DT),
        seed=int(rng.integers(2**31)),
    )
    observer = ql.ESO.model_free(order=2, b0=b0, omega_o=150.0, dt=DT)
    run = ql.simulate(plant, ql.ADRC(observer, omega_c=25.0, u_min=-limit, u_max=limit), scenario)
    signals = Signals(run["u"], run["y_measured"], run["r"], run["f_hat"], {}, DT)
    return features_of(signals, order=2)


def servo(
    rng: np.random.Generator, seconds: float, magnet: float = 1.0, friction: float = 1.0
) -> Any:
    """Return a window of the servo; ``magnet`` and ``friction`` are factors."""
    plant = ql.plants.dc_motor(
        torque_constant=0.05 * magnet * (1.0 + 0.003 * rng.normal()),
        coulomb=0.01 * friction * (1.0 + 0.05 * rng.normal()),
    )
    return window(plant, 0.05 / (0.5 * J), 24.0, 1e-4, rng, seconds)


def axis(
    rng: np.random.Generator, seconds: float, stiffness: float = 1.0, friction: float = 1.0
) -> Any:
    """Return a window of the axis; ``stiffness`` and ``friction`` are factors."""
    ground = [1e-3 * friction * (1.0 + 0.05 * rng.normal()), 5e-4]
    plant = ql.plants.n_mass([J, J], [4.0 * stiffness], [5e-4], ground=ground, sensor=1)
    return window(plant, 1.0 / (2.0 * J), 2.0, 2e-5, rng, seconds)


GAINS = np.array([[1.0, 0.3], [0.2, 1.0]]) * 0.05 / J


def gantry(
    rng: np.random.Generator, seconds: float, torque: float = 1.0, friction: float = 1.0
) -> Any:
    """Return a window of two coupled axes; the factors are of motor 0 and of the first axis."""
    torques = GAINS * [torque * (1.0 + 0.003 * rng.normal()), 1.0 + 0.003 * rng.normal()]
    slowing = -25.0 * np.array([friction, 1.0]) * (1.0 + 0.05 * rng.normal(size=2))
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1, 1], A[3, 3] = slowing
    B, E = np.zeros((4, 2)), np.zeros((4, 2))
    B[[1, 3]], E[1, 0], E[3, 1] = torques, 1.0 / J, 1.0 / J
    plant = ql.plants.LinearPlant(A, B, [[1, 0, 0, 0], [0, 0, 1, 0]], E=E)
    t = np.arange(round(seconds / DT) + 1) * DT
    times = np.arange(0.0, seconds + 1.0, 0.5)
    loads = [np.interp(t, times, 0.003 * rng.normal(size=times.size)) for _ in range(2)]
    noise = ql.signals.BandLimitedNoise(1e-8 * DT, DT)
    scenario = ql.Scenario(
        tuple(ql.signals.Samples(t, moves(rng, t)) for _ in range(2)),
        seconds,
        tuple(ql.signals.Samples(t, load) for load in loads),
        noise=(noise, noise),
        seed=int(rng.integers(2**31)),
    )
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=150.0, dt=DT)
    both = {name: ql.ADRC(observer, omega_c=25.0) for name in AXES}
    run = ql.simulate(plant, ql.Axes(both, GAINS, u_min=-24.0, u_max=24.0), scenario)
    found: dict[str, float] = {}
    for name in AXES:
        one = run.axis(name)
        own = Signals(one["u"], one["y_measured"], one["r"], one["f_hat"], {}, DT)
        found |= {f"{name}: {key}": value for key, value in features_of(own, order=2).items()}
    return found


def coupled(healthy: Pool, changed: Pool, runs: int, seed: int) -> Counter[str]:
    """Return how often which axes alarmed within 60 windows of a change, and what was said."""
    rng, found = np.random.default_rng(seed), Counter[str]()
    for _ in range(runs):
        machine = Machine(window=WINDOW)
        machine.watch, machine.axes = Watch(tuple(healthy[0])), AXES
        for k in rng.integers(len(healthy), size=HOURS):
            machine.watch.update(healthy[k])
        if machine.watch.alarms:
            continue  # a false one
        for k in rng.integers(len(changed), size=60):
            machine.watch.update(changed[k])
        axes = sorted({alarm.feature.partition(": ")[0] for alarm in machine.watch.alarms})
        said = "said" if "NOT decided which" in machine.describe() else "not said"
        found[f"{' and '.join(axes) or 'none'}, together {said}"] += 1
    return found


def axes_part(months: int, given: Any) -> dict[str, Any]:
    """Print and return what the watch says of two coupled axes."""
    runs, seed = given.runs, given.seed
    healthy = pool(gantry, given.windows, seed + 5, given.window)
    found = false_alarms(healthy, months, seed + 15)
    print(f"gantry: {found['any']} of {months} healthy months with a false alarm", flush=True)
    figures: dict[str, Any] = {"months": months, "with a false alarm": found["any"]}
    for i, (what, change) in enumerate(
        (("motor 0 −15 % of torque", {"torque": 0.85}), ("friction of x +50 %", {"friction": 1.5}))
    ):
        changed = pool(gantry, given.changed, seed + 150 + i, given.window, **change)
        delay, first = delays(healthy, changed, runs, seed + 250 + i)
        if not delay:
            sys.exit(f"{what}: each month had a false alarm before the change")
        median, most = np.quantile(delay, [0.5, 0.9])
        text = f"{median:.0f} windows to the alarm (90 %: {most:.0f})"
        print(f"gantry: {what}: {text}, {first.most_common(3)}")
        said = dict(coupled(healthy, changed, runs, seed + 350 + i))
        print(f"    {said}", flush=True)
        figures[what] = {"median": median, "90 %": most, "axes": said}
    return figures


def pool(make: Callable[..., Any], count: int, seed: int, seconds: float, **change: float) -> Pool:
    """Return the numbers of some windows of so many seconds."""
    rng = np.random.default_rng(seed)
    return [make(rng, seconds, **change) for _ in range(count)]


def false_alarms(healthy: Pool, months: int, seed: int) -> Counter[str]:
    """Return in how many months a feature raised an alarm, and any of them did."""
    rng, found = np.random.default_rng(seed), Counter[str]()
    for _ in range(months):
        watch = Watch(tuple(healthy[0]))
        for k in rng.integers(len(healthy), size=HOURS):
            watch.update(healthy[k])
        found.update(alarm.feature for alarm in watch.alarms)
        found["any"] += bool(watch.alarms)
    return found


def delays(healthy: Pool, changed: Pool, runs: int, seed: int) -> tuple[list[int], Counter[str]]:
    """Return the delays of the first alarms [windows], ``HOURS`` for none, and their features."""
    rng, found, first = np.random.default_rng(seed), [], Counter[str]()
    for _ in range(runs):
        watch = Watch(tuple(healthy[0]))
        for k in rng.integers(len(healthy), size=HOURS):
            watch.update(healthy[k])
        if watch.alarms:
            continue  # a false one
        delay = HOURS
        for i, k in enumerate(rng.integers(len(changed), size=HOURS), start=1):
            if alarms := watch.update(changed[k]):
                delay, _ = i, first.update(alarm.feature for alarm in alarms)
                break
        found.append(delay)
    return found, first


def day_and_night(months: int, seed: int, windows: int, seconds: float) -> tuple[int, int]:
    """Return in how many months there was an alarm, and in how many a line said why."""
    rng = np.random.default_rng(seed)
    by_hour = [
        pool(
            servo,
            windows,
            seed + hour,
            seconds,
            friction=1.0 + 0.15 * math.sin(math.tau * hour / 24),
        )
        for hour in range(24)
    ]
    alarms = told = 0
    for _ in range(months):
        watch = Watch(tuple(by_hour[0][0]))
        for hour in range(HOURS):
            watch.update(by_hour[hour % 24][rng.integers(windows)])
        alarms += bool(watch.alarms)
        told += "NOT exchangeable" in watch.describe()
    return alarms, told


def main() -> None:
    """Print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--months", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--axes", action="store_true", help="two coupled axes only")
    parser.add_argument("--windows", type=int, default=150, help="of a healthy machine")
    parser.add_argument("--changed", type=int, default=60, help="windows of a changed machine")
    parser.add_argument("--hourly", type=int, default=12, help="windows of an hour of the day")
    parser.add_argument("--window", type=float, default=WINDOW, help="length of a window [s]")
    given = options_of(parser, months=2, runs=2, windows=10, changed=2, hourly=1, window=3.0)
    warnings.simplefilter("ignore")
    began = time.perf_counter()
    figures: dict[str, Any] = {"gantry": axes_part(max(given.months // 10, 2), given)}
    if given.axes:
        write(given, figures)
        return
    healthy = {
        make: pool(make, given.windows, given.seed + i, given.window)
        for i, make in enumerate((servo, axis))
    }
    for i, (make, windows) in enumerate(healthy.items()):
        months = given.months // 2 if i else given.months - given.months // 2
        found = false_alarms(windows, months, given.seed + 10 + i)
        print(f"{make.__name__}: {found['any']} of {months} healthy months with a false alarm")
        print(f"    by feature: {dict(found)}", flush=True)
        figures[make.__name__] = {"months": months, "with a false alarm": found["any"]}
    changes: tuple[tuple[Callable[..., Any], str, dict[str, float]], ...] = (
        (axis, "stiffness -20 %", {"stiffness": 0.8}),
        (axis, "stiffness -10 %", {"stiffness": 0.9}),
        (servo, "friction +50 %", {"friction": 1.5}),
        (servo, "friction +20 %", {"friction": 1.2}),
        (servo, "torque constant -15 %", {"magnet": 0.85}),
        (servo, "torque constant -5 %", {"magnet": 0.95}),
    )
    print(f"{'change':32}{'median':>8}{'90 %':>8}{'missed':>8}   windows; first feature")
    for i, (make, what, change) in enumerate(changes):
        changed = pool(make, given.changed, given.seed + 100 + i, given.window, **change)
        found_delays, first = delays(healthy[make], changed, given.runs, given.seed + 200 + i)
        if not found_delays:
            sys.exit(f"{make.__name__}: each month had a false alarm before the change")
        median, most = np.quantile(found_delays, [0.5, 0.9])
        missed = sum(delay == HOURS for delay in found_delays)
        name = f"{make.__name__}: {what}"
        print(f"{name:32}{median:8.0f}{most:8.0f}{missed:8d}   {first.most_common(3)}", flush=True)
        figures[name] = {"median": median, "90 %": most, "missed": missed}
    months = max(given.months // 50, 2)
    alarms, told = day_and_night(months, given.seed + 300, given.hourly, given.window)
    figures["day and night"] = {"months": months, "with an alarm": alarms, "told": told}
    print(
        f"day and night, friction ±15 %: {alarms} of {months} months with an "
        f"alarm; in {told} a line says that neighbouring windows are correlated"
    )
    write(given, figures)
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
