"""A plant that is held and released, and what its detection costs where nothing is held.

    python benchmarks/held_plant.py [--setups 200] [--seed 1] [--part releases|alarms|learners]

``releases`` draws machines (a servo of 2e-4 kg m² with a 20-bit encoder, a lifting axis under its
weight, a slow process with noise, a chain of order 3), bandwidths, steps and errors of b0. y is
held for 0.1 to 5 s (the process in its own time): from the start, before the step, in the middle of
the move, or at an end stop in its way; and released at any moment between two samples. The
overshoot is that after the release in % of the step, less that of the same run without a hold.

``alarms`` runs the same machines free, under load steps, ramps and sinusoids, dry friction that
sticks, moves that saturate, coarse encoders, noise, a lag of the actuator: RMS error with
``HeldPlant()`` over that without. ``learners`` has the same for learners, with and without guard,
on the twin of EMPS (benchmarks/stiction.py) and the torsional testbed, and the overshoot of a
servo with learners.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import stiction
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.controllers.base import control
from quell.kernels import dispatch
from quell.kernels.dispatch import compiled

# Sub-steps of a sample, in which friction may stick.
SUBSTEPS = 8
HELD = int(ql.Status.HELD)
NOTHING, BY_HAND, SIGNAL, NEVER = 0, 1, 2, 3


@compiled
def play(
    design: Any, state: Any, mode: int, plant: Any, times: Any, r: Any, load: Any, noise: Any,
    x: Any, y_out: Any, u_out: Any, flags: Any,
) -> None:  # fmt: skip
    """Run a loop; write y, u and the flag of a held plant.

    ``plant`` has b, dt, the resolution, Coulomb and static friction in units of y^(n), the time
    constant of the actuator, the u of manual operation, the end stop and the sub-step of the
    release; ``times`` the first sample of the hold and the first after the release. Friction acts
    on plants of order 2.
    """
    n = x.size
    b, dt, count, coulomb, static, lag, hand, stop, part = plant
    h = dt / 8.0
    acting = 0.0
    for k in range(r.size):
        held = times[0] <= k < times[1]
        y = x[0] + noise[k]
        if count > 0.0:
            y = count * math.floor(y / count + 0.5)
        loop = state.loop[0]
        if mode == 1:
            loop.manual, loop.u_manual = 1.0 if held else 0.0, hand
            if k == times[1]:
                loop.bumpless = 1.0
        elif mode == 2:
            loop.held = 1.0 if held else 0.0
        u = control(design, state, r[k], y)
        for sub in range(8):
            if k == times[1] - 1 and sub >= part:
                held = False
            acting = u if lag <= 0.0 else acting + (u - acting) * (1.0 - math.exp(-h / lag))
            if held:
                for i in range(1, n):
                    x[i] = 0.0
                if n == 1:
                    continue
            force = b * acting + load[k]
            if static > 0.0 and n == 2:
                most = static if x[1] == 0.0 else coulomb
                if x[1] == 0.0 and abs(force) <= most:
                    continue
                direction = math.copysign(1.0, x[1] if x[1] != 0.0 else force)
                before = x[1]
                force -= direction * coulomb
                if before != 0.0 and (before + h * force) * before < 0.0:
                    x[0] += 0.5 * h * before
                    x[1] = 0.0
                    continue
            if held:
                continue
            for i in range(n):
                total, power = 0.0, 1.0
                for j in range(i, n):
                    total += power * x[j]
                    power *= h / (j - i + 1)
                x[i] = total + power * force
            free = k >= times[1] or (k == times[1] - 1 and sub >= part)
            if not free and x[0] > stop:
                x[0] = stop
                for i in range(1, n):
                    x[i] = 0.0
        y_out[k], u_out[k] = x[0], u
        flags[k] = int(loop.status) & HELD


def machine(kind: str, random: np.random.Generator) -> dict[str, Any]:
    """Return a machine with a loop."""
    if kind == "servo":
        found = {
            "n": 2, "b0": 1.0 / 2e-4, "dt": random.choice([0.25e-3, 0.5e-3, 1e-3]), "u": 3.5,
            "low": -3.5, "count": math.tau / 2**20, "noise": 0.0, "load": 0.0,
            "omega_c": random.uniform(20.0, 80.0), "step": 10.0 ** random.uniform(-0.5, 1.0),
        }  # fmt: skip
    elif kind == "lift":
        found = {
            "n": 2, "b0": 1.0 / 50.0, "dt": 1e-3, "u": 1000.0, "low": -1000.0, "count": 1e-6,
            "noise": 0.0, "load": -9.81, "omega_c": random.uniform(4.0, 15.0),
            "step": random.uniform(0.1, 1.0),
        }  # fmt: skip
    elif kind == "process":
        found = {
            "n": 1, "b0": 0.02, "dt": 1.0, "u": 100.0, "low": 0.0, "count": 0.0,
            "noise": random.choice([0.0, 0.01, 0.05]), "load": -0.02 * random.uniform(10.0, 40.0),
            "omega_c": random.uniform(0.01, 0.05), "step": random.uniform(5.0, 20.0),
        }  # fmt: skip
    else:
        found = {
            "n": 3, "b0": 2e5, "dt": 0.5e-3, "u": 10.0, "low": -10.0, "count": math.tau / 2**20,
            "noise": 0.0, "load": 0.0, "omega_c": random.uniform(20.0, 40.0),
            "step": random.uniform(0.5, 5.0),
        }  # fmt: skip
    ratio = random.uniform(3.0, 6.0)
    found["omega_o"] = min(ratio * found["omega_c"], 0.4 / found["dt"])
    return found


def controller_of(m: dict[str, Any], held: Any) -> Any:
    """Return the loop of a machine."""
    observer = ql.ESO.model_free(order=m["n"], b0=m["b0"], omega_o=m["omega_o"], dt=m["dt"])
    return ql.ADRC(observer, m["omega_c"], u_min=m["low"], u_max=m["u"], held=held)


def run(
    m: dict[str, Any], held: Any, mode: int, times: tuple[int, int], r: Any, load: Any, noise: Any,
    gain: float = 1.0, stop: float = math.inf, friction: tuple[float, float] = (0.0, 0.0),
    lag: float = 0.0, part: int = 8,
) -> Any:  # fmt: skip
    """Return y, u and flags of a run from rest under the load, which the controller knows."""
    controller = controller_of(m, held)
    b = m["b0"] * gain
    hand = -load[0] / b
    controller.start(0.0, hand)
    x, y, u, flags = np.zeros(m["n"]), *np.zeros((3, r.size))
    plant = np.array([b, m["dt"], m["count"], *friction, lag, hand, stop, part])
    design, state = controller.parameters, controller._state
    play(design, state, mode, plant, np.array(times), r, load, noise, x, y, u, flags)
    return y, u, flags


def releases(given: Any) -> dict[str, Any]:
    """Print the overshoot after a release; return it."""
    figures: dict[str, Any] = {}
    rows: dict[tuple[str, str], list[list[float]]] = {}
    random = np.random.default_rng(given.seed)
    held = ql.HeldPlant()
    for number in range(given.setups):
        kind = ("servo", "lift", "process", "chain of order 3")[number % 4]
        m = machine(kind, random)
        case = str(random.choice(["from the start", "before the step", "in mid-move", "end stop"]))
        unit = 1.0 if kind != "process" else 0.3 / m["omega_c"]
        hold = round(10.0 ** random.uniform(-1.0, math.log10(5.0)) * unit / m["dt"])
        begin = round(5.0 / m["omega_c"] / m["dt"]) + 20
        rest = round(30.0 / m["omega_c"] / m["dt"])
        gain = float(random.choice([0.5, 1.0, 1.0, 2.0]))
        size = begin + hold + 2 * rest
        r = np.where(np.arange(size) >= begin, m["step"], 0.0)
        load = np.full(size, m["load"])
        noise = m["noise"] * random.standard_normal(size)
        quiet = run(m, None, NOTHING, (-1, -1), r, load, noise, gain)[0]
        stop = math.inf
        if case == "from the start":
            times = (0, begin + hold)
        elif case == "before the step":
            times = (begin - 5, begin + hold)
        else:
            share = random.uniform(0.1, 0.7)
            first = int(np.argmax(quiet > share * m["step"]))
            times = (first, first + hold)
            if case == "end stop":
                stop = share * m["step"]
        part = int(random.integers(1, SUBSTEPS + 1))
        found = []
        for each, mode in ((None, NOTHING), (held, NOTHING), (None, SIGNAL), (None, BY_HAND)):
            # An end stop holds nothing but what runs into it; the machine knows of it all the same.
            known = mode != NOTHING or case != "end stop"
            moments = times if known else (size, times[1])
            y = run(m, each, mode, moments, r, load, noise, gain, stop, part=part)[0]
            found.append(100.0 * max(np.max(y) / m["step"] - 1.0, 0.0))
        own = 100.0 * max(np.max(quiet) / m["step"] - 1.0, 0.0)
        more = [max(each - own, 0.0) for each in found]
        if given.verbose:
            print(number, kind, case, f"b/b0 = {gain}, {hold * m['dt']:.2f} s", np.round(more, 2))
        rows.setdefault((kind, case), []).append(more)
        rows.setdefault(("all", f"b = {gain} b0"), []).append(more)
        if hold * m["dt"] / unit > 2.0:
            rows.setdefault(("all", f"2 s or more, b = {gain} b0"), []).append(more)
    names = ("nothing", "HeldPlant()", "set_held", "by hand")
    title = "overshoot by the hold, %: median, 90 %, largest; share above 0.5 %"
    table = Table("machine", "hold", "runs", *names, title=title)
    for (kind, case), values in sorted(rows.items()):
        spreads = [spread(column) for column in zip(*values, strict=True)]
        columns = ("{:.2f} {:.2f} {:.2f}; {:.0%}".format(*each.values()) for each in spreads)
        table.add_row(kind, case, str(len(values)), *columns)
        row = {"runs": len(values), **dict(zip(names, spreads, strict=True))}
        figures[f"{kind}, {case}"] = row
    Console(width=150).print(table)
    return figures


def spread(values: Any) -> dict[str, float]:
    """Return median, 90 % and largest [%], and the share above 0.5."""
    a = np.array(values)
    sizes = {"median": np.median(a), "90 %": np.quantile(a, 0.9), "largest": np.max(a)}
    return sizes | {"share above 0.5 %": np.mean(a > 0.5)}


def disturbed(m: dict[str, Any], case: str, random: np.random.Generator) -> dict[str, Any]:
    """Return reference, load, friction … of a run without a hold."""
    size = round(200.0 / m["omega_c"] / m["dt"])
    k = np.arange(size)
    t = k * m["dt"] * m["omega_c"]  # in time constants of the loop
    reach = m["b0"] * min(m["u"] - m["load"] / -m["b0"], m["u"])  # of u, beside the load
    r = np.where(t >= 10.0, m["step"], 0.0)
    change = 0.3 * reach * random.uniform(-1.0, 1.0)
    more = np.zeros(size)
    found: dict[str, Any] = {}
    if case == "load steps":
        more = change * np.floor(t / 25.0) % 2
    elif case == "load ramps":
        more = change * np.abs((t / random.uniform(10.0, 100.0)) % 2.0 - 1.0)
        r = 0.0 * r
    elif case == "sinusoid":
        more = change * np.sin(random.uniform(0.05, 2.0) * t)
    elif case == "friction" or case == "slow sinusoid, friction":
        level = 0.2 * reach * random.uniform(0.1, 1.0)
        found["friction"] = (level, level * random.uniform(1.0, 1.6))
        slow = np.sin(random.uniform(0.05, 0.5) * t)
        r = m["step"] * (np.floor(t / 20.0) % 2 if case == "friction" else slow)
    elif case == "moves that saturate":
        r = 10.0 * m["step"] * (np.floor(t / 60.0) % 2)
    elif case == "coarse encoder":
        found["count"] = m["step"] / 2.0 ** random.integers(4, 10)
        more = change * np.sin(random.uniform(0.05, 2.0) * t)
    elif case == "noise":
        found["noise"] = m["step"] * 10.0 ** random.uniform(-4.0, -2.0)
        more = change * np.floor(t / 25.0) % 2
    elif case == "lag of the actuator":
        found["lag"] = random.uniform(0.05, 0.2) / m["omega_c"]
    elif case == "slow moves":
        r = m["step"] * np.sin(random.uniform(0.01, 0.1) * t)
    return {"r": r, "load": m["load"] + more, **found}


CASES = (
    "load steps", "load ramps", "sinusoid", "friction", "slow sinusoid, friction",
    "moves that saturate", "coarse encoder", "noise", "lag of the actuator", "slow moves",
)  # fmt: skip


def alarms(given: Any) -> dict[str, Any]:
    """Print what the detection costs where nothing is held; return it."""
    figures: dict[str, Any] = {}
    random = np.random.default_rng(given.seed + 1000)
    rows: dict[str, list[tuple[float, float]]] = {}
    for number in range(given.setups):
        m = machine(("servo", "lift", "process", "chain of order 3")[number % 4], random)
        case = CASES[(number // 4) % len(CASES)]
        if "friction" in case and m["n"] != 2:
            continue
        d = disturbed(m, case, random)
        m |= {name: d.pop(name) for name in ("count", "noise") if name in d}
        r, load, gain = d.pop("r"), d.pop("load"), float(random.choice([0.7, 1.0, 1.0, 1.4]))
        noise = m["noise"] * random.standard_normal(r.size)
        runs = [
            run(m, each, NOTHING, (-1, -1), r, load, noise, gain, **d)
            for each in (None, ql.HeldPlant())
        ]
        errors = [float(np.sqrt(np.mean((r - y) ** 2))) for y, _, _ in runs]
        ratio, flagged = errors[1] / errors[0], float(np.mean(runs[1][2] > 0))
        rows.setdefault(case, []).append((ratio, flagged))
        if given.verbose:
            print(number, case, m["n"], f"{ratio:.4f} {flagged:.3f}")
    names = ("RMS error over that without: least, median, largest", "above 1.02", "below 0.98")
    table = Table("case", "runs", *names, "samples with HELD", title="free plants")
    for case, values in rows.items():
        ratios, shares = np.array(values).T
        text = f"{np.min(ratios):.3f} {np.median(ratios):.3f} {np.max(ratios):.3f}"
        counts = (str(int(np.sum(beyond))) for beyond in (ratios > 1.02, ratios < 0.98))
        table.add_row(case, str(len(values)), text, *counts, f"{np.mean(shares):.1%}")
        figures[case] = {
            "runs": len(values),
            "RMS over that without": {
                "least": np.min(ratios), "median": np.median(ratios), "largest": np.max(ratios),
            },
            "above 1.02": np.sum(ratios > 1.02),
            "below 0.98": np.sum(ratios < 0.98),
            "share of samples with HELD": np.mean(shares),
        }  # fmt: skip
    Console(width=140).print(table)
    return figures


def learners(given: Any) -> dict[str, Any]:
    """Print the cost with learners where plants stick, and the overshoot of a servo with them."""
    title = "free plants that stick: RMS error over that without HeldPlant()"
    table = Table("plant", "reference", "learner", "guard", "ratio", title=title)
    figures: dict[str, Any] = {}
    seconds = 0.2 if given.quick else stiction.SECONDS
    dispatch.interpret_all = given.quick  # short runs are quicker so than to compile
    for twin in stiction.TWINS:
        *_, size, speed = stiction.TWINS[twin]
        found = stiction.learners(speed)
        for label in ("none",) if given.quick else ("none", "Kalman", "RLS, tanh"):
            for guard in (None, ql.Guard()) if label != "none" else (None,):
                for name, reference in stiction.references(size, seconds).items():
                    plain, detecting = (
                        stiction.error(twin, found[label], guard, reference, held, seconds)
                        for held in (None, ql.HeldPlant())
                    )
                    ratio = detecting / plain
                    table.add_row(twin, name, label, str(guard is not None), f"{ratio:.4f}")
                    figures[f"{twin}, {name}, {of(label, guard)}"] = ratio
    Console(width=140).print(table)
    title = "a servo after 2 s, with a load: overshoot in %; RMS error of later moves over by hand"
    names = ("nothing", "HeldPlant()", "set_held", "by hand", "never held")
    table = Table("learner", "guard", *names, title=title)
    kinds = {
        "none": None,
        "Kalman": ql.learners.Kalman(),
        "Kalman(u=True)": ql.learners.Kalman(u=True, gain_interval=(0.5, 2.0)),
        "RLS": ql.learners.RLS(),
        "NLMS": ql.learners.NLMS(),
    }
    ways = ((None, NOTHING), (ql.HeldPlant(), NOTHING), (None, SIGNAL), (None, BY_HAND))
    dispatch.interpret_all = False
    for label, learner in list(kinds.items())[: 1 if given.quick else None]:
        for guard in (None, ql.Guard()) if learner is not None else (None,):
            cells = [_held_servo(learner, guard, *way) for way in (*ways, (None, NEVER))]
            texts = (f"{over:.2f}; {rms / cells[3][1]:.3f}" for over, rms in cells)
            table.add_row(label, str(guard is not None), *texts)
            figures[f"servo, {of(label, guard)}"] = {
                name: {"overshoot [%]": over, "RMS over by hand": rms / cells[3][1]}
                for name, (over, rms) in zip(names, cells, strict=True)
            }
    Console(width=140).print(table)
    return figures


def of(label: str, guard: Any) -> str:
    """Return the name of a learner with or without guard."""
    return label if guard is None else f"{label}, guarded"


def _held_servo(learner: Any, guard: Any, held: Any, mode: int) -> tuple[float, float]:
    """Return overshoot [%] and RMS error after the release of a servo with viscous friction."""
    dt, omega_c = 0.5e-3, 60.0
    observer = ql.ESO.model_free(order=2, b0=5000.0, omega_o=300.0, dt=dt)
    parts = {"learner": learner, "guard": guard, "held": held}
    controller = ql.ADRC(observer, omega_c, u_min=-3.5, u_max=3.5, **parts)
    size = round(12.0 / dt)
    t = dt * np.arange(size)
    r = np.where(t < 5.0, np.sin(6.0 * t) + np.sin(13.0 * t), 1.0)
    r = np.where(t >= 8.5, 1.0 + np.sin(6.0 * (t - 8.5)), r)
    times = np.array([round(4.999 / dt), round(7.0 / dt)]) if mode != NEVER else np.array([-1, -1])
    r[(t >= 4.5) & (t < 5.0)] = 0.0
    load = 500.0 * np.sin(2.0 * t)
    x, y, u, flags = np.zeros(2), *np.zeros((3, size))
    plant = np.array([5000.0, dt, math.tau / 2**20, 0.0, 0.0, 0.0, 0.0, math.inf, 8])
    design, state, quiet = controller.parameters, controller._state, np.zeros(size)
    play(design, state, mode % NEVER, plant, times, r, load, quiet, x, y, u, flags)
    top = float(np.max(y[(t >= 7.0) & (t < 8.5)]))
    return 100.0 * max(top - 1.0, 0.0), float(np.sqrt(np.mean((r - y)[t > 8.5] ** 2)))


def main() -> None:
    """Run the parts."""
    parser = parser_of(__doc__)
    parser.add_argument("--setups", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", choices=["releases", "alarms", "learners"])
    parser.add_argument("--verbose", action="store_true")
    given = options_of(parser, setups=1)
    began = time.perf_counter()
    figures = {}
    for name, part in {"releases": releases, "alarms": alarms, "learners": learners}.items():
        if given.part in (None, name):
            figures[name] = part(given)
    print(f"{time.perf_counter() - began:.0f} s")
    write(given, figures)


if __name__ == "__main__":
    main()
