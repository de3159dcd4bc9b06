"""b0 from records of running loops: errors, and how often the stated interval holds the true b0.

    python benchmarks/running_loop.py [--draws N] [--seed S] [--snr DB] [--json FILE]
    python benchmarks/running_loop.py --controller adrc       N draws with ADRC, pid or unknown
    python benchmarks/running_loop.py --plants unstable       or integrating, resonant, negative

Each draw has a plant of order 1 or 2 (integrating, damped or oscillating) behind a lag, a delay of
eighths of a sample, both or neither; an ADRC whose b0 is wrong by up to a factor of 1.6, or a PID;
a logarithmic chirp of 20 s as reference, or added to u; white noise in y, alone or with a load that
drifts (a random walk, or one that forgets in 0.2 to 2 s) and has half of the power. The noise's
power in y is that of y divided by the given ratio. The unknown controller is one of them whose u is
rounded to a fiftieth of its largest value, and limited at the 95 % quantile of its size: no linear
model says how u depends on r and y. The loop is simulated apart from the package's own models: by
scipy at eight steps per sample.

With ``--plants`` the plant is of one kind, under an ADRC: unstable (s − p and s² − p², or with a
further stable pole), integrating (one or two integrators), resonant (damping 0.01 to 0.1), or any
of these with a negative gain. Orders are 1 and 2; or as given by ``--orders``, with further stable
poles. The record has 1500 to 12000 samples; r or u is moved by a chirp, random steps or sines; the
noise, with or without a load as above, is 1e-4 to 1e-2 of y; the load acts in front of the lag, as
above, or behind it.
"""

from __future__ import annotations

import itertools
import time
import warnings
from typing import Any, NamedTuple

import numpy as np
from measured import options_of, parser_of, write
from scipy import signal

import quell as ql
from quell.controllers.baselines import PID
from quell.identification import identify_b0
from quell.types import Vector

DURATION, STEPS = 20.0, 8
KINDS = ("unstable", "integrating", "resonant")


class Loop(NamedTuple):
    """A plant and its controller."""

    den: Vector
    b: float
    lag: float  # [s]
    delay: float  # [s]
    dt: float
    omega: float  # speed of the loop [rad/s]
    controller: Any
    text: str


class Unknown(NamedTuple):
    """A controller whose u is rounded and limited."""

    controller: Any
    step_size: float
    most: float

    def reset(self) -> None:
        """Reset the controller."""
        self.controller.reset()

    def step(self, r: float, y: float) -> float:
        """Return u."""
        u = round(self.controller.step(r, y) / self.step_size) * self.step_size
        return float(min(max(u, -self.most), self.most))


def drawn_loop(rng: np.random.Generator) -> Loop:
    """Return a stable loop with a phase margin of at least 25 degrees."""
    while True:
        order, dt = int(rng.integers(1, 3)), float(rng.choice([0.001, 0.002, 0.005, 0.01]))
        omega = float(np.exp(rng.uniform(np.log(0.008), np.log(0.03)))) / dt
        kind = rng.choice(["integrating", "damped", "oscillating"])
        slow = omega * float(rng.uniform(0.05, 0.6))
        if order == 1:
            den, kind = np.array([1.0, 0.0 if kind == "integrating" else slow]), "lag"
        elif kind == "integrating":
            den = np.array([1.0, slow, 0.0])
        else:
            damping = 1.0 if kind == "damped" else float(rng.uniform(0.05, 0.4))
            den = np.array([1.0, 2.0 * damping * slow, slow**2])
        b = float(np.exp(rng.uniform(-3.0, 6.0))) * float(rng.choice([-1.0, 1.0]))
        lag = float(rng.choice([0.0, rng.uniform(0.5, 8.0)])) * dt
        delay = float(rng.choice([0.0, rng.integers(1, 6 * STEPS) / STEPS])) * dt
        wrong = float(np.exp(rng.uniform(np.log(0.625), np.log(1.6))))
        if rng.random() < 0.6:
            observer = ql.ESO.model_free(order, wrong * b, 4.0 * omega, dt)
            controller: Any = ql.ADRC(observer, omega_c=omega)
        else:
            k = wrong * omega**order / b
            terms = {"ki": 0.3 * omega * k, "kd": 1.4 * k / omega if order == 2 else 0.0}
            tf = 0.1 / omega if order == 2 else 0.0
            controller = PID(k * (1.4 if order == 1 else 1.0), tf=tf, dt=dt, **terms)
        loop = ql.analysis.analyse(([b], den), controller, delay=delay, actuator_lag=lag)
        if loop.stable and loop.margins.phase > 25.0:
            name = type(controller).__name__
            text = f"{name:4} order {order} {kind:11} lag {lag / dt:4.1f} delay {delay / dt:5.2f}"
            return Loop(den, b, lag, delay, dt, omega, controller, text)


def drawn_den(rng: np.random.Generator, kind: str, order: int, omega: float) -> tuple[Vector, str]:
    """Return a denominator of the kind, for a loop of a speed ``omega``, and what it is."""
    pole = omega * float(np.exp(rng.uniform(np.log(0.02), np.log(0.6))))
    if kind == "unstable":
        second = -pole if rng.random() < 0.5 else -omega * float(rng.uniform(0.05, 1.0))
        roots, text = [pole, second][:order], f"+{pole:.3g} rad/s"
    elif kind == "integrating":
        roots, text = [0.0, 0.0 if rng.random() < 0.5 else -pole][:order], "integrating"
    else:
        speed, damping = omega * float(rng.uniform(0.2, 1.5)), float(rng.uniform(0.01, 0.1))
        one = speed * complex(-damping, np.sqrt(1.0 - damping**2))
        roots, text = [one, one.conjugate()], f"damping {damping:.3f}"
    roots += [-omega * float(rng.uniform(0.05, 1.0)) for _ in range(order - len(roots))]
    return np.poly(roots).real, text


def drawn_special(rng: np.random.Generator, plants: str, orders: tuple[int, ...]) -> Loop:
    """Return a stable loop of ADRC and a plant of the kind, with at least 25 degrees."""
    while True:
        kind = str(rng.choice(KINDS)) if plants == "negative" else plants
        order, dt = int(rng.choice(orders)), float(rng.choice([0.001, 0.002, 0.005, 0.01]))
        order = max(order, 2) if kind == "resonant" else order
        omega = float(np.exp(rng.uniform(np.log(0.008), np.log(0.08)))) / dt
        den, text = drawn_den(rng, kind, order, omega)
        sign = -1.0 if plants == "negative" else float(rng.choice([-1.0, 1.0]))
        b = float(np.exp(rng.uniform(-3.0, 6.0))) * sign
        lag = float(rng.choice([0.0, rng.uniform(0.5, 5.0)])) * dt
        delay = float(rng.choice([0.0, rng.integers(1, 4 * STEPS) / STEPS])) * dt
        wrong = float(np.exp(rng.uniform(np.log(0.625), np.log(1.6))))
        observer = ql.ESO.model_free(order, wrong * b, 4.0 * omega, dt)
        controller = ql.ADRC(observer, omega_c=omega)
        loop = ql.analysis.analyse(([b], den), controller, delay=delay, actuator_lag=lag)
        if loop.stable and loop.margins.phase > 25.0:
            text = f"order {order} {text} lag {lag / dt:.1f} delay {delay / dt:.2f}"
            return Loop(den, b, lag, delay, dt, omega, controller, f"ADRC {kind} {text}")


def motion(rng: np.random.Generator, t: Vector, omega: float) -> tuple[Vector, str]:
    """Return a reference, or what is added to u, that moves up to the loop's speed."""
    kind = str(rng.choice(["chirp", "steps", "sines"]))
    if kind == "steps":
        length = max(1, round(float(rng.uniform(2.0, 8.0)) / omega / (t[1] - t[0])))
        return np.repeat(rng.uniform(-1.0, 1.0, t.size // length + 1), length)[: t.size], kind
    ends = np.array([0.1, rng.uniform(1.5, 4.0)]) * omega
    if kind == "chirp":
        hertz, end = ends / (2.0 * np.pi), float(t[-1])
        return signal.chirp(t, hertz[0], end, hertz[1], method="logarithmic", phi=-90.0), kind
    speeds = np.exp(rng.uniform(*np.log(ends), 5))
    return np.sum(np.sin(np.outer(t, speeds)) / 5.0, axis=1), kind


def simulated(
    loop: Loop, r: Vector, added: Vector, noise: Vector, load: Vector, inside: bool = False
) -> tuple[Vector, Vector]:
    """Return u and y without its noise; the controller measures both together.

    The load acts on the plant with ``inside``, else in front of the lag.
    """
    den = np.polymul(loop.den, [loop.lag, 1.0]) if loop.lag else loop.den
    A, B, C, _ = signal.tf2ss([loop.b], den)
    if inside:  # the lag's inverse in front of it: C (s I − A)⁻¹ A B = s C (s I − A)⁻¹ B
        B = np.hstack([B, B + loop.lag * A @ B])
    system = signal.cont2discrete((A, B, C, np.zeros((1, B.shape[1]))), loop.dt / STEPS)
    A, B, C = system[0], system[1][:, 0], system[2][0]
    loads = [system[1][:, -1]]
    whole, part = divmod(round(loop.delay / loop.dt * STEPS), STEPS)
    powers, sums = [np.eye(B.size)], [np.zeros(B.size)]
    for _ in range(STEPS):
        sums.append(A @ sums[-1] + B)
        powers.append(A @ powers[-1])
        loads.append(A @ loads[-1])
    old, new = powers[STEPS - part] @ sums[part], sums[STEPS - part]
    x, u, y = np.zeros(B.size), np.zeros(r.size + whole + 1), np.zeros(r.size)
    of_load = np.sum(loads[:-1], axis=0)
    at = whole + 1  # u has zeros before the record
    loop.controller.reset()
    step = loop.controller.step
    for k in range(r.size):
        y[k] = C @ x
        u[k + at] = step(r[k], y[k] + noise[k]) + added[k]
        x = powers[STEPS] @ x + new * u[k + at - whole] + old * u[k + at - whole - 1]
        x = x + of_load * load[k]
    return u[at:], y


def drawn_record(seed: int, snr: float, unknown: bool = False) -> tuple[Loop, Vector, Vector, str]:
    """Return a loop, u, the measured y, and what was drawn."""
    rng = np.random.default_rng(seed)
    loop = drawn_loop(rng)
    t = np.arange(round(DURATION / loop.dt)) * loop.dt
    ends = np.array([0.1, rng.uniform(1.5, 4.0)]) * loop.omega / (2.0 * np.pi)
    chirp = signal.chirp(t, ends[0], DURATION, ends[1], method="logarithmic", phi=-90.0)
    zero, at_u = np.zeros(t.size), rng.random() < 0.3
    parts = (zero, chirp) if at_u else (chirp, zero)
    u, clean = simulated(loop, *parts, zero, zero)
    if unknown:
        own = np.abs(u - parts[1])
        other = Unknown(loop.controller, float(np.max(own)) / 50.0, float(np.quantile(own, 0.95)))
        loop = loop._replace(controller=other, text="other" + loop.text[4:])
        _, clean = simulated(loop, *parts, zero, zero)
    u, y, text = disturbed(rng, loop, parts, clean, 10.0 ** (-snr / 20.0))
    where = "u" if at_u else "r"
    return loop, u, y, f"{loop.text} {1e3 * loop.dt:3.0f} ms, chirp in {where}, {text}"


def drawn_special_record(
    seed: int, plants: str, orders: tuple[int, ...]
) -> tuple[Loop, Vector, Vector, str]:
    """Return a loop of ADRC and a plant of the kind, u, the measured y, and what was drawn."""
    rng = np.random.default_rng(seed)
    loop = drawn_special(rng, plants, orders)
    t = np.arange(round(float(np.exp(rng.uniform(*np.log([1500.0, 12000.0])))))) * loop.dt
    moved, how = motion(rng, t, loop.omega)
    zero, at_u = np.zeros(t.size), rng.random() < 0.3
    parts = (zero, moved) if at_u else (moved, zero)
    _, clean = simulated(loop, *parts, zero, zero)
    ratio = float(np.exp(rng.uniform(np.log(1e-4), np.log(1e-2))))
    u, y, text = disturbed(rng, loop, parts, clean, ratio, inside=bool(rng.random() < 0.5))
    where = f"{t.size} of {1e3 * loop.dt:.0f} ms, {how} in {'u' if at_u else 'r'}"
    return loop, u, y, f"{loop.text} {where}, {ratio:.1e} {text}"


def disturbed(
    rng: np.random.Generator,
    loop: Loop,
    parts: tuple[Vector, Vector],
    clean: Vector,
    ratio: float,
    inside: bool = False,
) -> tuple[Vector, Vector, str]:
    """Return u and the measured y with noise of ``ratio`` of y, or half of it from a load."""
    zero = np.zeros(clean.size)
    share = float(rng.choice([0.0, 0.5]))
    target = ratio * float(np.std(clean))
    noise = np.sqrt(1.0 - share) * target * rng.standard_normal(clean.size)
    load, text = zero, "noise"
    if share:
        memory = float(rng.choice([np.inf, rng.uniform(0.2, 2.0)]))
        pole = np.exp(-loop.dt / memory)
        load = signal.lfilter([1.0], [1.0, -pole], rng.standard_normal(clean.size))
        _, moved = simulated(loop, zero, zero, zero, load, inside)
        load *= np.sqrt(share) * target / np.std(moved)
        text = f"load {memory:4.2f} s{' inside' * inside}"
    u, y = simulated(loop, *parts, noise, load, inside)
    return u, y + noise, text


def main() -> None:
    """Run the draws; print those that are far off, and the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, default=40000, help="seed of the first draw")
    parser.add_argument("--snr", type=float, default=30.0, help="signal-to-noise ratio of y [dB]")
    parser.add_argument("--controller", choices=("adrc", "pid", "unknown"))
    parser.add_argument("--plants", choices=(*KINDS, "negative"))
    parser.add_argument("--orders", type=int, nargs="+", default=[1, 2], help="with --plants")
    arguments = options_of(parser, draws=1, controller="adrc")
    warnings.simplefilter("ignore", ql.DesignWarning)
    rows: list[dict[str, Any]] = []
    kind = {"adrc": "ADRC", "pid": "PID", "unknown": "other", None: ""}[arguments.controller]
    for seed in itertools.count(arguments.seed):
        if len(rows) == arguments.draws:
            break
        if arguments.plants:
            orders = tuple(arguments.orders)
            loop, u, y, text = drawn_special_record(seed, arguments.plants, orders)
        else:
            drawn = drawn_loop(np.random.default_rng(seed)).text
            if kind in ("ADRC", "PID") and not drawn.startswith(kind):
                continue
            loop, u, y, text = drawn_record(seed, arguments.snr, kind == "other")
        began = time.process_time()
        try:
            found = identify_b0(u, y, loop.dt, loop.den.size - 1)
        except ValueError as error:
            print(f"{seed} {text}: refused, {error}")
            rows.append({"seed": seed, "text": text, "refused": str(error)})
            continue
        taken = time.process_time() - began
        low, high = found.interval
        row = {
            "seed": seed,
            "text": text,
            "error": found.b0 / loop.b - 1.0,
            "std": found.b0_std / abs(loop.b),
            "covered": low <= loop.b <= high,
            "total": loop.lag + loop.delay,
            "total_error": found.total_delay - loop.lag - loop.delay,
            "total_std": found.total_delay_std,
            "dt": loop.dt,
            "good": not found.shortcomings,
            "seconds": taken,
        }
        rows.append(row)
        if not row["covered"] or abs(row["error"]) > 0.05:
            said = "; ".join(found.shortcomings)
            print(f"{seed} {text}: b0 off by {row['error']:+.2%} ± {row['std']:.2%} {said}")
    refused = [row for row in rows if "refused" in row]
    rows = [row for row in rows if "refused" not in row]
    print(f"refused: {len(refused)}")
    figures: dict[str, Any] = {"refused": len(refused)}
    for name, part in (
        ("all", rows),
        ("noise alone", [row for row in rows if row["text"].endswith("noise")]),
        ("with a load", [row for row in rows if not row["text"].endswith("noise")]),
        ("ADRC", [row for row in rows if row["text"].startswith("ADRC")]),
        ("PID", [row for row in rows if row["text"].startswith("PID")]),
        ("unknown", [row for row in rows if row["text"].startswith("other")]),
        ("order 1", [row for row in rows if "order 1" in row["text"]]),
        ("order 2", [row for row in rows if "order 2" in row["text"]]),
        ("order 3", [row for row in rows if "order 3" in row["text"]]),
        ("order 4", [row for row in rows if "order 4" in row["text"]]),
    ):
        if not part:
            continue
        off = np.abs([row["error"] for row in part])
        delays = np.abs([row["total_error"] / row["dt"] for row in part])
        figures[name] = {
            "draws": len(part),
            "within 5 % [%]": 100.0 * np.mean(off <= 0.05),
            "covered [%]": 100.0 * np.mean([row["covered"] for row in part]),
            "b0 off, median [%]": 100.0 * np.median(off),
            "b0 off, 90 % [%]": 100.0 * np.quantile(off, 0.9),
            "lag and delay off [samples]": np.median(delays),
            "no reservation [%]": 100.0 * np.mean([row["good"] for row in part]),
            "cpu": np.median([row["seconds"] for row in part]),
        }
        print(
            f"{name:12} {len(part):4} draws: within 5 % {np.mean(off <= 0.05):6.1%}, covered "
            f"{np.mean([row['covered'] for row in part]):6.1%}; b0 off by {np.median(off):.2%} "
            f"(median), {np.quantile(off, 0.9):.2%} (90 %); lag and delay off by "
            f"{np.median(delays):.2f} samples; no reservation "
            f"{np.mean([row['good'] for row in part]):.0%}; "
            f"CPU {np.median([row['seconds'] for row in part]):.1f} s"
        )
    write(arguments, figures | {"rows": rows + refused})


if __name__ == "__main__":
    main()
