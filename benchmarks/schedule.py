"""A rotary axis whose inertia changes by a factor of 10: gains that follow it, or one ADRC.

    python benchmarks/schedule.py [--online | --loads] [--quick] [--json FILE]

The inertia is 2e-4 … 2e-3 kg m² over an extension e from 0 to 1, ``J = 2e-4 + 1.8e-3 e²``, with
``d(J y')/dt = u + d − c y'``, 0.5 ms, u a sample late, a 20-bit encoder, |u| ≤ 2 Nm.
Tables of five points are tuned by ``tune_schedule``, once of b0 alone and once of b0 and the
bandwidths. Judged are other extensions than those of the tables, in a simulation of the nonlinear
plant with its encoder:

* the integral of |r − y| after a step of the load at a fixed extension, over that of an ADRC that
  is tuned for this very plant, and M_s there (bars: 1.15 and 1.8),
* the same while e moves over its whole range in 2 s, 0.2 s and 50 ms under a load, with steps of
  the reference, over that of one ADRC tuned for all inertias at once, beside that of the ADRC tuned
  for the largest one, and over that of the slowest move,
* the largest change of u in a sample [Nm] when the signal, not the machine, jumps over half of the
  range, at rest under a load of 0.3 Nm and in the middle of a move. Without the conversion of f̂ it
  would be the load times what b0 changes by.

With ``--online`` instead: an ``OnlineGain`` before and after the inertia doubles, with other seeds
than those it was made with, under steps of the load at random and point-to-point moves. "wrong" is
an estimate that passes its test and is more than 4 of its deviations off. Before that, what the
coefficients of u of two learners make of b/b0.

With ``--loads`` instead: the table of b0 beside a learner behind a guard, on the same axis with a
load that repeats, while e goes to and fro all the time, J by a factor of 10 in half a period of
2 s or 0.5 s. "cogging" is 0.1 Nm sin(16 y) at about 5 rad/s, for ``Harmonic``, "gravity" is 0.3 Nm
sin(y) along a sinusoid of about 1 rad, for ``Kalman``. All amplitudes, speeds and phases are drawn;
the learners have the options that they have by default, but for ``state=False``, as y grows without
end. All controllers feed r'' forward. The RMS of r − y in the second half of 16 s is that of the
table alone, of one ADRC tuned for all inertias with the same learner and guard, and of the table
with them. "friction" is the axis without any load on the sinusoid: for the table, the one ADRC with
a model's feedforward (the inertia at its b0, and the friction), and the table with it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from measured import options_of, parser_of, write

import quell as ql
from quell.kernels import dispatch

DT, LATE, STEP = 5e-4, 5e-4, 2.0 * np.pi / 2**20
POINTS = (0.0, 0.25, 0.5, 0.75, 1.0)
JUDGED = (0.06, 0.17, 0.31, 0.44, 0.57, 0.69, 0.83, 0.94)
VISCOUS = (2e-4, 2e-3)  # [N m s/rad]
# Extension at the start, and duration of the move [s]; the slowest one first.
MOVES = [(start, duration) for start in (0.0, 1.0) for duration in (2.0, 0.2, 0.05)]
HOW: dict[str, Any] = {"constraints": ql.tuning.Constraints(resolution=STEP), "delay": LATE}
HOW |= {"u_min": -2.0, "u_max": 2.0}


def inertia(extension: Any) -> Any:
    """Return J [kg m²]."""
    return 2e-4 + 1.8e-3 * extension**2


def linear(viscous: float) -> Callable[[float], ql.plants.LinearPlant]:
    """Return the plant at a fixed extension as a function of it."""

    def plant(extension: float) -> ql.plants.LinearPlant:
        J = inertia(extension)
        return ql.plants.LinearPlant([[0.0, 1.0], [0.0, -viscous / J]], [0.0, 1.0 / J], [1.0, 0.0])

    return plant


def machine(viscous: float) -> Any:
    """Return the plant with the disturbances load, J and dJ/dt."""

    def f(t: float, x: Any, u: float, w: Any) -> Any:
        J = w[1] + 1e-12
        return x[1], (u + w[0] - (viscous + w[2]) * x[1]) / J

    axis = ql.plants.NonlinearPlant(f, order=2, disturbances=3, substeps=2, name="axis")
    return ql.plants.delayed(ql.plants.encoded(axis, 2**20), LATE, DT)


def motion(start: float, duration: float, at: float = 0.5) -> tuple[Any, Any, Any]:
    """Return e, J and dJ/dt of a move of the extension from ``start`` to 1 − start."""
    t = np.arange(0.0, 3.0, DT)
    s = np.clip((t - at) / duration, 0.0, 1.0) if duration else (t >= at).astype(float)
    e = start + (1.0 - 2.0 * start) * s * s * (3.0 - 2.0 * s)
    J = inertia(e)
    return tuple(ql.signals.Samples(t, v) for v in (e, J, np.gradient(J, DT)))


def iae(run: ql.Trajectory, start: float = 0.0) -> float:
    """Return the integral of |r − y| from ``start`` on; infinite if the run diverged."""
    if run.status & ql.Status.DIVERGED:
        return float("inf")
    error = np.abs(run["r"] - run["y"])
    return float(np.sum(error[run.t >= start]) * DT)


def fixed(plant: Any, controller: Any, extension: float) -> float:
    """Return the integral of |y| after a step of the load at a fixed extension."""
    w = (ql.signals.Step(at=0.1, height=0.3), inertia(extension), 0.0)
    follows = (extension,) if getattr(controller, "external_signals", 0) else ()
    return iae(ql.simulate(plant, controller, ql.Scenario(0.0, 1.1, w, schedule=follows)))


def moving(plant: Any, controller: Any, start: float, duration: float) -> float:
    """Return the integral of |r − y| over a move of the extension, with steps of r and the load."""
    e, J, rate = motion(start, duration)
    load = ql.signals.Step(at=0.1, height=0.3) + ql.signals.Step(at=0.5 + duration / 2, height=-0.6)
    r = ql.signals.Step(at=0.5 + duration / 3, height=0.05)
    follows = (e,) if getattr(controller, "external_signals", 0) else ()
    return iae(
        ql.simulate(plant, controller, ql.Scenario(r, 2.9, (load, J, rate), schedule=follows)), 0.45
    )


def jump(plant: Any, controller: Any, is_moving: bool) -> float:
    """Return the largest change of u in a sample after a jump of the signal [Nm]."""
    e = ql.signals.Step(at=0.5, height=0.5)
    w = (ql.signals.Step(at=0.1, height=0.3), inertia(0.25), 0.0)
    r = ql.signals.Ramp(slope=2.0) if is_moving else 0.0
    run = ql.simulate(plant, controller, ql.Scenario(r, 0.6, w, schedule=(e,)))
    change, k = np.abs(np.diff(run["u"])), round(0.5 / DT)
    return float(np.max(change[k - 1 : k + 8]))


def online(seed: int, load: float, period: float, distance: float, duration: float) -> list[Any]:
    """Return b̂, σ and whether b0 follows before and after a doubling of the inertia; and b."""
    random = np.random.default_rng(seed)
    J = float(10 ** random.uniform(-3.5, -3.0))
    times = np.arange(0.0, 80.0, period)
    loads = ql.signals.Samples(times, random.uniform(-load, load, times.size), hold="previous")
    there = ql.signals.SmoothMove(distance=distance, duration=duration)
    back = ql.signals.SmoothMove(start=2.5 * duration, distance=distance, duration=duration)
    r = ql.signals.Repeated(there - 1.0 * back, 5.0 * duration)
    observer = ql.ESO.model_free(2, b0=1.0 / J, omega_o=400.0, dt=DT)
    law = ql.ADRC(observer, 60.0, schedule=ql.OnlineGain(0.4 / J, 2.5 / J), u_min=-2.0, u_max=2.0)
    w = (loads, ql.signals.Constant(J) + ql.signals.Step(at=30.0, height=J), 0.0)
    rows = []
    for end, b in ((29.9, 1.0 / J), (79.9, 0.5 / J)):
        run = ql.simulate(machine(2e-3), law, ql.Scenario(r, end, w))
        rows.append((law.schedule.read(run.final_state.schedule), b))
    return rows


def show_online(seeds: range) -> dict[str, Any]:
    """Print how often b0 follows a doubled inertia, stays, or is wrong, for loads and moves."""
    found = {}
    for load, period in ((0.0, 1.0), (0.02, 0.05), (0.05, 0.31), (0.3, 1.3)):
        for distance, duration in ((1.0, 0.2), (1.0, 1.0)):
            counts = {"follows": 0, "partly": 0, "stays": 0, "wrong": 0}
            for seed in seeds:
                for known, b in online(seed, load, period, distance, duration):
                    error = abs(known.b0 / b - 1.0)
                    if known.is_excited and abs(known.estimate - b) > 4.0 * known.deviation:
                        counts["wrong"] += 1
                    elif error < 0.1:
                        counts["follows"] += 1
                    else:
                        counts["partly" if known.is_excited else "stays"] += 1
            name = f"loads to {load:g} Nm, {distance:g} rad in {duration:g} s"
            found[name] = counts
            print(f"  online b0: {name}: {counts}")
    return found


def show_learners() -> dict[str, Any]:
    """Print what the coefficient of u of learners, which loads bias, makes of b/b0."""
    J, found = 6e-4, {}
    t = np.arange(0.0, 40.0, DT)
    true = np.where(t < 10.0, 1.0, np.where(t < 25.0, 2.0, 0.55))
    times = np.arange(0.0, 40.0, 1.3)
    loads = np.random.default_rng(3).uniform(-0.3, 0.3, times.size)
    load = ql.signals.Samples(times, loads, hold="previous")
    move = ql.signals.SmoothMove(distance=1.0, duration=0.2)
    back = ql.signals.SmoothMove(start=0.5, distance=1.0, duration=0.2)
    scenario = ql.Scenario(
        ql.signals.Repeated(move - 1.0 * back, 1.0),
        39.0,
        (load, ql.signals.Samples(t, J * true), 0.0),
    )
    observer = ql.ESO.model_free(2, b0=1.0 / J, omega_o=400.0, dt=DT, delay=LATE)
    parts = ql.features
    learners = {
        "Kalman(u=True)": ql.learners.Kalman(u=True),
        "RLS": ql.learners.RLS(parts.State() + parts.Bias() + parts.Input()),
    }
    for name, learner in learners.items():
        law = ql.ADRC(observer, 60.0, learner=learner, u_min=-2.0, u_max=2.0)
        run = ql.simulate(machine(2e-3), law, scenario)
        ends = [round(at / DT) for at in (9.9, 24.9, 38.0)]
        found[name] = [1.0 + float(run["theta"][k, -1]) / observer.b0 for k in ends]
        figures = ", ".join(f"{value:.2f}" for value in found[name])
        print(f"  {name}: b/b0 {figures}; true: 1, 0.5, 1.82")
    return found


def loaded() -> Any:
    """Return the axis with the disturbances load, J, dJ/dt, cogging and gravity."""

    def f(t: float, x: Any, u: float, w: Any) -> Any:
        J = w[1] + 1e-12
        d = w[0] - w[3] * np.sin(16.0 * x[0]) - w[4] * np.sin(x[0])
        return x[1], (u + d - (VISCOUS[1] + w[2]) * x[1]) / J

    axis = ql.plants.NonlinearPlant(f, order=2, disturbances=5, substeps=2, name="axis")
    return ql.plants.delayed(ql.plants.encoded(axis, 2**20), LATE, DT)


def with_load(load: str, period: float, seed: int) -> Any:
    """Return a scenario, and the signal that its schedules follow."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, 16.0 + DT, DT)
    e = 0.5 - 0.5 * np.cos(2.0 * np.pi * t / period + random.uniform(0.0, 2.0 * np.pi))
    J = inertia(e)
    extension, of_J, rate = (ql.signals.Samples(t, v) for v in (e, J, np.gradient(J, DT)))
    size, speed = random.uniform(0.7, 1.3, 2)
    if load == "cogging":
        r: Any = ql.signals.Ramp(slope=5.0 * speed)
        w = (0.0, of_J, rate, 0.1 * size, 0.0)
    else:
        r = ql.signals.Sinusoid(amplitude=size, omega=4.0 * speed)
        w = (0.0, of_J, rate, 0.0, 0.3 * size if load == "gravity" else 0.0)
    return r, w, extension


def show_loads(seeds: range) -> dict[str, Any]:
    """Print the RMS error under loads that repeat while the inertia moves."""
    at, plant, found = linear(VISCOUS[1]), loaded(), dict[str, Any]()
    table = ql.tune_schedule(at, DT, points=POINTS, tables="b0", between=0, **HOW).design.controller
    how: dict[str, Any] = {"structure": "bandwidths", "order": 2, "compare": (), **HOW}
    one = ql.tune([at(e) for e in POINTS], DT, **how).controller
    learning = {"guard": ql.Guard()}
    harmonic = {"learner": ql.learners.Harmonic(state=False), **learning}
    kalman = {"learner": ql.learners.Kalman(), **learning}

    def modelled(base: Any) -> dict[str, Any]:
        model = ql.Feedforward.rigid(1.0 / base.observer.b0, viscous=VISCOUS[1])
        return {"feedforward": model}

    for load, parts, name in (
        ("cogging", (harmonic, harmonic), "learner"),
        ("gravity", (kalman, kalman), "learner"),
        ("friction", (modelled(one), modelled(table)), "model"),
    ):
        rows = {
            "table": (table, {}),
            f"one b0, {name}": (one, parts[0]),
            f"table, {name}": (table, parts[1]),
        }
        for period in (2.0, 0.5):
            errors = {}
            for row, (base, with_it) in rows.items():
                options: dict[str, Any] = {"feedforward": True, "u_min": -2.0, "u_max": 2.0}
                law = ql.ADRC(
                    base.observer, base.omega_c, schedule=base.schedule, **(options | with_it)
                )
                errors[row] = []
                for seed in seeds:
                    r, w, extension = with_load(load, period, seed)
                    follows = (extension,) if law.external_signals else ()
                    run = ql.simulate(plant, law, ql.Scenario(r, 16.0, w, schedule=follows))
                    late = (run["r"] - run["y"])[run.t > 8.0]
                    errors[row].append(float(np.sqrt(np.mean(late**2))))
            found[f"{load}, {period:g} s"] = errors
            print(f"  {load}, J to and fro in {period:g} s: RMS of r - y [rad], median (largest)")
            for row, each in errors.items():
                print(f"    {row}: {np.median(each):.2g} ({max(each):.2g})")
    return found


def main() -> None:
    """Print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--online", action="store_true", help="only the trial of OnlineGain")
    parser.add_argument("--loads", action="store_true", help="only the trial of loads that repeat")
    parser.add_argument("--points", nargs="+", type=float, default=POINTS)
    parser.add_argument("--judged", nargs="+", type=float, default=JUDGED, help="extensions")
    parser.add_argument("--moves", type=int, default=len(MOVES), help="how many of the moves")
    parser.add_argument("--viscous", nargs="+", type=float, default=VISCOUS, help="[N m s]")
    parser.add_argument("--tables", nargs="+", choices=("b0", "all"), default=["b0", "all"])
    arguments = options_of(
        parser, points=[0.0, 1.0], judged=[0.44], moves=1, viscous=[2e-3], tables=["b0"]
    )
    dispatch.interpret_all |= arguments.quick  # the plant is a user's: compiled in each process
    results: dict[str, Any] = {}
    if arguments.online:
        results["learners"] = show_learners()
        results["online"] = show_online(range(100, 108))
    if arguments.loads:
        results["loads"] = show_loads(range(100, 108))
    for viscous in () if arguments.online or arguments.loads else arguments.viscous:
        at, plant = linear(viscous), machine(viscous)
        scheduled: dict[str, Any] = {}
        print(f"viscous friction {viscous:g} N m s/rad")
        for tables in arguments.tables:
            tuned = ql.tune_schedule(
                at, DT, points=arguments.points, tables=tables, between=0, **HOW
            )
            scheduled[tables] = tuned.design.controller
        how: dict[str, Any] = {"structure": "bandwidths", "order": 2, "compare": (), **HOW}
        one = ql.tune([at(e) for e in arguments.points], DT, **how).controller
        heavy = ql.tune(at(1.0), DT, **how).controller
        rows = []
        for e in arguments.judged:
            own = fixed(plant, ql.tune(at(e), DT, **how).controller, e)
            row = {"e": e, "J": inertia(e), "one": fixed(plant, one, e) / own}
            for tables, controller in scheduled.items():
                margins = ql.analysis.analyse(at(e), controller.at(e), delay=LATE).margins
                row[f"iae_{tables}"] = fixed(plant, controller, e) / own
                row[f"m_s_{tables}"] = 1.0 / margins.modulus
            rows.append(row)
            print("  " + ", ".join(f"{name} {value:.4g}" for name, value in row.items()))
        for tables in scheduled:
            worst = (
                max(row[f"iae_{tables}"] for row in rows),
                max(row[f"m_s_{tables}"] for row in rows),
            )
            kept = worst[0] <= 1.15 and worst[1] <= 1.8
            print(
                f"  tables {tables}: IAE {worst[0]:.3f} <= 1.15, M_s {worst[1]:.3f} <= 1.8: {kept}"
            )
        moves, slow = [], dict[str, float]()
        for start, duration in MOVES[: arguments.moves]:
            found = {name: moving(plant, c, start, duration) for name, c in scheduled.items()}
            found |= {"one": moving(plant, one, start, duration)}
            found |= {"heavy": moving(plant, heavy, start, duration)}
            row = {"start": start, "duration": duration}
            row |= {f"{k}/one": v / found["one"] for k, v in found.items() if k != "one"}
            slow = {**found} if duration == 2.0 else slow
            row |= {f"{k}/{k} in 2 s": found[k] / slow[k] for k in scheduled}
            moves.append(row)
            print("  " + ", ".join(f"{name} {value:.4g}" for name, value in row.items()))
        jumps = {
            f"{tables}, {'in motion' if is_moving else 'at rest'}": jump(plant, c, is_moving)
            for tables, c in scheduled.items()
            for is_moving in (False, True)
        }
        of_b0 = scheduled[arguments.tables[0]].schedule.b0
        before, after = np.interp((0.0, 0.5), arguments.points, of_b0)
        without = 0.3 * (before / after - 1.0)
        print(
            f"  change of u at a jump of the signal [Nm]: {jumps}; without conversion {without:.3g}"
        )
        results[f"{viscous:g}"] = {"fixed": rows, "moves": moves, "jumps": jumps}
        results[f"{viscous:g}"]["jump without conversion"] = without
    write(arguments, results)


if __name__ == "__main__":
    main()
