"""What a second encoder, at the load, brings to an axis that has one at the motor.

    python benchmarks/second_encoder.py [--part linear|play|missing|all] [--draws 40] [--seed 2]

A motor of 1.2e-4 kg m² and a load of 0.8e-4 kg m² behind a coupling of 60 N m/rad (138 Hz with
both free), encoders of 2²⁰ counts, torque within ±1.3 N m, 4 kHz. The law is that of
``quell.controllers.state_feedback`` on the estimates of ``ESO.state_space``: ``u = U r + Γ d̂ −
K (x̂ − X r − Π d̂)``; what is controlled is the load.

``linear``: the plant is as the observer knows it, and a torque steps on the load. For each density
of the disturbance: the load's largest deviation, the RMS of u due to both encoders' quantisation,
and M_s of the loop that is opened at u.

``play``: the coupling has play (a dead zone of ±p/2), motor and load have dry friction that sticks,
and the load torque is a step and a sinusoid while the axis makes moves. Designs: an encoder at the
motor and a disturbance at the motor (what a drive has), or on the load; an encoder at the load;
both encoders, with both disturbances too: the torque of a coupling with play is a pair of these.
Of each design omega_c and the drift are the best of a grid by the mean error of 10 draws (seed 1),
among those with M_s <= 2 of the linear loop and a u that is calm at rest; then they are judged on
other draws (``--seed``).

``missing``: samples of the load's encoder do not arrive, one by one or in bursts of 5 ms; the error
of the estimated angle of the load, for each way to choose the gain.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

from quell.controllers import quadratic_feedback, regulator
from quell.kernels import dispatch
from quell.kernels.dispatch import compiled, kernel
from quell.lti.models import zero_order_hold
from quell.observers import ESO, MultivariableESO
from quell.observers.multivariable_forms import begin_signals, observe_signals

JM, JL, K, DAMPING, DT = 1.2e-4, 0.8e-4, 60.0, 0.005, 0.25e-3
LIMIT, COUNT, SUBSTEPS = 1.3, math.tau / 2**20, 20
A = np.array(
    [
        [0.0, 1.0, 0.0, 0.0],
        [-K / JM, -DAMPING / JM, K / JM, DAMPING / JM],
        [0.0, 0.0, 0.0, 1.0],
        [K / JL, DAMPING / JL, -K / JL, -DAMPING / JL],
    ]
)
AT_MOTOR, AT_LOAD = (
    np.array([[0.0], [1 / JM], [0.0], [0.0]]),
    np.array([[0.0], [0.0], [0.0], [1 / JL]]),
)
ANGLES = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
BOTH = np.hstack([AT_MOTOR, AT_LOAD])

# Encoders that are read (of the motor, of the load), and inputs of the disturbances.
DESIGNS = {
    "motor's encoder, d at the motor": ((0,), AT_MOTOR),
    "motor's encoder, d on the load": ((0,), AT_LOAD),
    "load's encoder, d at the motor": ((1,), AT_MOTOR),
    "load's encoder, d on the load": ((1,), AT_LOAD),
    "both, d at the motor": ((0, 1), AT_MOTOR),
    "both, d on the load": ((0, 1), AT_LOAD),
    "both, d at both": ((0, 1), BOTH),
}


class Law(NamedTuple):
    """A design: its observer, and ``u = −K x̂ + Kd d̂ + Kr r``."""

    observer: MultivariableESO
    sensors: tuple[int, ...]
    gain: Any
    of_d: Any
    of_r: float


def law_of(sensors: tuple[int, ...], E: Any, omega_c: float, drift: float) -> Law:
    """Return a design; ``drift`` is that of each torque [(N m)²/s]."""
    observer = ESO.state_space(
        A, AT_MOTOR, ANGLES[list(sensors)], E, DT, accept_zeros=True, time_varying=False,
        noise_variance=[COUNT**2 / 12] * len(sensors), drift=[drift] * E.shape[1],
    )  # fmt: skip
    weight = ANGLES[1:].T @ ANGLES[1:]
    gain = quadratic_feedback(A, AT_MOTOR, weight, 1.0 / ((JM + JL) ** 2 * omega_c**4), DT)
    found = regulator(A, AT_MOTOR, ANGLES[1:], E)
    of_d = found.Gamma[0] + gain[0] @ found.Pi
    return Law(observer, sensors, gain[0], of_d, float((found.U + gain @ found.X)[0, 0]))


# ---- The loop in the linear plant ----


class Linear(NamedTuple):
    """Figures of a linear loop."""

    peak: float  # largest deviation of the load for a torque of 1 N m on it [rad]
    noise: float  # RMS of u for the quantisation of the encoders [N m]
    peak_sensitivity: float  # M_s
    is_stable: bool


def linear(law: Law) -> Linear:
    """Return the figures of a loop; the torque steps at a sample."""
    model, N = law.observer.model, law.observer.estimates
    phi, (gamma, load) = zero_order_hold(A, [AT_MOTOR, AT_LOAD], DT)
    C, L, row = ANGLES[list(law.sensors)], law.observer.gains[0], np.zeros(N)
    row[:4], row[4 : 4 + law.of_d.size] = -law.gain, law.of_d
    # x⁺ = Φ x + Γ u + G w;  z⁺ = (I − L C)(Φ_z z + Γ_z u) + L (C x⁺ + v);  u = row z
    rest = np.eye(N) - L @ model.output
    whole = np.block(
        [
            [phi, gamma @ row[None, :]],
            [
                L @ C @ phi,
                rest @ (model.transition + model.input @ row[None, :])
                + L @ C @ gamma @ row[None, :],
            ],
        ]
    )
    of_load = np.concatenate([load, L @ C @ load])[:, 0]
    stable = bool(np.max(np.abs(np.linalg.eigvals(whole))) < 1.0)
    if not stable:
        return Linear(math.inf, math.inf, math.inf, False)
    x, peak = np.zeros(4 + N), 0.0
    for _ in range(1200):
        x = whole @ x + of_load
        peak = max(peak, abs(x[2]))
    of_noise = np.vstack([np.zeros((4, len(law.sensors))), L]) * COUNT / math.sqrt(12)
    P, M = of_noise @ of_noise.T, whole.copy()
    for _ in range(40):
        P, M = P + M @ P @ M.T, M @ M
    noise = math.sqrt(row @ P[4:, 4:] @ row)
    worst = 0.0
    inner = np.block(
        [
            [phi, np.zeros((4, N))],
            [L @ C @ phi, rest @ (model.transition + model.input @ row[None, :])],
        ]
    )
    enter = np.vstack([gamma, L @ C @ gamma])
    # The controller knows the u that it gives; the plant gets u + what opens the loop.
    out = np.concatenate([np.zeros(4), row])
    for omega in np.geomspace(1.0, math.pi / DT, 1500):
        z = np.exp(1j * omega * DT)
        loop = -out @ np.linalg.solve(z * np.eye(4 + N) - inner, enter)[:, 0]
        worst = max(worst, 1.0 / abs(1.0 + loop))
    return Linear(peak, noise, worst, True)


# Bounds of the noise in u [mN m]: 0.2 and 2 % of the torque.
NOISES = (2.5, 25.0)
OMEGAS = (30.0, 50.0, 80.0, 120.0, 160.0, 240.0, 400.0)
DRIFTS = tuple((10.0 ** np.arange(-4.0, 5.0, 1.0)).tolist())


def print_linear(console: Console, given: Any) -> dict[str, Any]:
    """Print three loops for eight decades of the drift, and the best of each design."""
    table = Table("drift", "encoders", "peak [mrad/(N m)]", "RMS u of noise [mN m]", "M_s")
    figures: dict[str, Any] = {}
    for drift in given.drifts:
        for name in ("motor's encoder, d on the load", "load's encoder, d on the load",
                     "both, d on the load", "both, d at both"):  # fmt: skip
            found = linear(law_of(*DESIGNS[name], 80.0, drift))
            numbers = f"{1e3 * found.peak:.3f}", f"{1e3 * found.noise:.4f}"
            table.add_row(f"{drift:g}", name, *numbers, f"{found.peak_sensitivity:.2f}")
            figures[f"drift {drift:g}, {name}"] = _figures(found)
    console.print("omega_c = 80 rad/s, a torque of 1 N m steps on the load", table)
    table = Table(
        "design", "RMS u of noise at most", "peak [mrad/(N m)]", "omega_c", "drift", "M_s"
    )
    for name in given.designs:
        design = DESIGNS[name]
        pairs = itertools.product(given.omegas, given.drifts)
        grid = {each: linear(law_of(*design, *each)) for each in pairs}
        for noise in NOISES:
            fit = {
                each: found
                for each, found in grid.items()
                if found.peak_sensitivity <= 2.0 and 1e3 * found.noise <= noise
            }
            if not fit:
                table.add_row(name, f"{noise:g} mN m", "none has M_s <= 2")
                figures[f"{name}, noise {noise:g}"] = "none has M_s <= 2"
                continue
            best = min(fit, key=lambda each: fit[each].peak)
            figures[f"{name}, noise {noise:g}"] = {
                "omega_c": best[0], "drift": best[1], **_figures(fit[best])
            }  # fmt: skip
            table.add_row(
                name, f"{noise:g} mN m", f"{1e3 * fit[best].peak:.2f}",
                *(f"{number:g}" for number in best), f"{fit[best].peak_sensitivity:.2f}",
            )  # fmt: skip
    console.print("The smallest peak with M_s <= 2", table)
    return figures


def _figures(found: Linear) -> dict[str, Any]:
    if not found.is_stable:
        return {"stable": "no"}
    return {
        "peak [mrad/(N m)]": 1e3 * found.peak,
        "noise [mN m]": 1e3 * found.noise,
        "M_s": found.peak_sensitivity,
    }


# ---- The loop with play and friction ----


class Machine(NamedTuple):
    """A drawn axis, in which the coupling is not linear."""

    play: float  # the whole angle of the dead zone [rad]
    motor_friction: float  # Coulomb friction [N m]
    load_friction: float  # [N m]
    load_step: float  # torque on the load from the middle on [N m]
    load_wave: float  # amplitude of a torque on the load [N m]
    wave_speed: float  # [rad/s]
    stiffness: float  # ratio to the stiffness that is known
    inertia: float  # ratio of the load's inertia to the one that is known


def draw(random: np.random.Generator) -> Machine:
    """Return a machine: play of 0.2 to 3 mrad, friction of 1 to 8 % of the torque, 20 % off."""
    return Machine(
        play=10.0 ** random.uniform(math.log10(2e-4), math.log10(3e-3)),
        motor_friction=random.uniform(0.01, 0.1),
        load_friction=random.uniform(0.0, 0.05),
        load_step=random.uniform(-0.3, 0.3),
        load_wave=random.uniform(0.0, 0.1),
        wave_speed=random.uniform(2.0, 30.0),
        stiffness=random.uniform(0.8, 1.2),
        inertia=random.uniform(0.8, 1.2),
    )


@kernel
def stuck(speed: float, change: float) -> float:
    """Return a speed after dry friction, which takes ``change`` of it and at most all."""
    if abs(speed) <= change:
        return 0.0
    return speed - math.copysign(change, speed)


@compiled
def play_loop(
    model: Any, z: Any, estimate: Any, law: Any, numbers: Any, r: Any, loads: Any, phases: Any,
    x: Any, y: Any, applied: Any, known: Any, load: Any, u_of: Any,
) -> None:  # fmt: skip
    """Run a loop from rest; write the load's angle and u."""
    sensors, gain, of_d, of_r = law
    play, motor_friction, load_friction, stiffness, inertia = numbers
    h = DT / SUBSTEPS
    for k in range(r.size):
        for j in range(sensors.size):
            angle = x[2 * sensors[j]]
            y[j] = COUNT * math.floor(angle / COUNT + phases[sensors[j]])
        observe_signals(model, z, estimate, y, applied, known)
        u = of_r * r[k]
        for i in range(4):
            u -= gain[i] * estimate[i]
        for i in range(of_d.size):
            u += of_d[i] * estimate[4 + i]
        u = min(max(u, -LIMIT), LIMIT)
        applied[0] = u
        for _ in range(SUBSTEPS):
            twist, rate = x[0] - x[2], x[1] - x[3]
            torque = 0.0
            if twist > 0.5 * play:
                torque = max(K * stiffness * (twist - 0.5 * play) + DAMPING * rate, 0.0)
            elif twist < -0.5 * play:
                torque = min(K * stiffness * (twist + 0.5 * play) + DAMPING * rate, 0.0)
            x[1] = stuck(x[1] + h * (u - torque) / JM, h * motor_friction / JM)
            x[3] = stuck(
                x[3] + h * (torque + loads[k]) / (JL * inertia), h * load_friction / (JL * inertia)
            )
            x[0] += h * x[1]
            x[2] += h * x[3]
        load[k], u_of[k] = x[2], u


def moves(samples: int) -> Any:
    """Return a reference: smooth moves of 1 rad and back in 0.2 s, with rests of 0.3 s."""
    t = np.arange(samples) * DT
    part, whole = np.clip((t % 0.5) / 0.2, 0.0, 1.0), (t // 0.5).astype(int)
    rise = part**4 * (35.0 - 84.0 * part + 70.0 * part**2 - 20.0 * part**3)
    return np.where(whole % 2 == 0, rise, 1.0 - rise)


class Run(NamedTuple):
    """Figures of a run."""

    moving: float  # RMS error of the load in moves [mrad]
    resting: float  # RMS error of the load in the last 0.1 s of each rest [mrad]
    worst: float  # largest error in those [mrad]
    calm: float  # RMS change of u from sample to sample in those [mN m]


def run(law: Law, machine: Machine, seconds: float = 4.0, seed: int = 0) -> Run:
    """Return the figures of a loop with a drawn machine; the encoders' phases are drawn."""
    samples = round(seconds / DT)
    t, r = np.arange(samples) * DT, moves(samples)
    loads = machine.load_wave * np.sin(machine.wave_speed * t)
    loads[samples // 2 :] += machine.load_step
    model = law.observer.model
    z, estimate = np.zeros(model.states), np.zeros(law.observer.estimates)
    begin_signals(model, z, estimate)
    y, u = np.empty(samples), np.empty(samples)
    numbers = (machine.play, machine.motor_friction, machine.load_friction, machine.stiffness,
               machine.inertia)  # fmt: skip
    phases = np.random.default_rng(seed).random(2)
    gains = np.array(law.sensors), law.gain, law.of_d, law.of_r
    x, measured = np.zeros(4), np.zeros(len(law.sensors))
    known, applied = np.zeros(law.of_d.size), np.zeros(1)
    (play_loop.plain if dispatch.interpret_all else play_loop)(
        *(model, z, estimate, gains, numbers, r, loads, phases),
        *(x, measured, applied, known, y, u),
    )
    error = 1e3 * (y - r)
    rest, first = (t % 0.5) > 0.4, t > 0.5
    change = 1e3 * np.diff(u, prepend=u[0])
    return Run(
        float(np.sqrt(np.mean(error[first & ~rest] ** 2))),
        float(np.sqrt(np.mean(error[first & rest] ** 2))),
        float(np.max(np.abs(error[first & rest]))),
        float(np.sqrt(np.mean(change[first & rest] ** 2))),
    )


# Most RMS change of u from sample to sample at rest [mN m]: 2 % of the torque; more is chatter.
CALM = 25.0


def tuned(name: str, machines: list[Machine], given: Any) -> tuple[float, float]:
    """Return omega_c and drift of the best design by the mean RMS error at rest."""
    best, found = math.inf, (math.nan, math.nan)
    for omega_c, drift in itertools.product(given.omegas, given.drifts):
        law = law_of(*DESIGNS[name], omega_c, drift)
        if not linear(law).peak_sensitivity <= 2.0:
            continue
        runs = [run(law, machine, given.seconds) for machine in machines]
        score = float(np.mean([each.resting for each in runs]))
        if score < best and np.median([each.calm for each in runs]) <= CALM:
            best, found = score, (omega_c, drift)
    return found


def print_play(console: Console, given: Any) -> dict[str, Any]:
    """Tune each design on ten machines and judge it on others."""
    tuning = np.random.default_rng(1)
    machines = [draw(tuning) for _ in range(given.tuning_draws)]
    random, figures = np.random.default_rng(given.seed), dict[str, Any]()
    judged = [draw(random) for _ in range(given.draws)]
    table = Table(
        *("design", "omega_c", "drift", "M_s", "RMS at rest [mrad]", "largest at rest"),
        *("RMS over play/2", "RMS in moves [mrad]", "change of u [mN m]"),
    )
    for name in given.designs:
        omega_c, drift = tuned(name, machines, given)
        if math.isnan(omega_c):
            table.add_row(name, "NOT found: no design within M_s <= 2 and calm")
            figures[name] = "NOT found: no design within M_s <= 2 and calm"
            continue
        law = law_of(*DESIGNS[name], omega_c, drift)
        runs = [run(law, machine, given.seconds, i) for i, machine in enumerate(judged)]
        ratio = [each.resting / (500.0 * m.play) for each, m in zip(runs, judged, strict=True)]
        columns = [np.array(part) for part in zip(*runs, strict=True)]
        figures[name] = {
            "omega_c": omega_c, "drift": drift, "M_s": linear(law).peak_sensitivity,
            "at rest [mrad]": np.median(columns[1]),
            "at rest, 90 % [mrad]": np.percentile(columns[1], 90),
            "largest at rest [mrad]": np.median(columns[2]), "over half the play": np.median(ratio),
            "in moves [mrad]": np.median(columns[0]), "change of u [mN m]": np.median(columns[3]),
        }  # fmt: skip
        table.add_row(
            name, f"{omega_c:g}", f"{drift:g}", f"{linear(law).peak_sensitivity:.2f}",
            f"{np.median(columns[1]):.3f} ({np.percentile(columns[1], 90):.3f})",
            f"{np.median(columns[2]):.3f}", f"{np.median(ratio):.2f}",
            f"{np.median(columns[0]):.2f}", f"{np.median(columns[3]):.1f}",
        )  # fmt: skip
    console.print(table)
    console.print(f"{given.draws} machines, seed {given.seed}: medians, 90 % in brackets")
    return figures


# ---- Samples of the load's encoder that are missing ----

SHARES = (0.0, 0.1, 0.5, 0.9)


def print_missing(console: Console, samples: int, seed: int) -> dict[str, Any]:
    """Print the error of the load's angle where samples of its encoder do not arrive."""
    random, figures = np.random.default_rng(seed), dict[str, Any]()
    phi, (gamma, enter) = zero_order_hold(A, [AT_MOTOR, BOTH], DT)
    torques = np.cumsum(math.sqrt(DT) * random.normal(size=(samples, 2)), axis=0)
    u = 0.1 * np.sin(20.0 * DT * np.arange(samples))[:, None] - torques.sum(axis=1, keepdims=True)
    x, angles = np.zeros(4), np.empty((samples, 2))
    for k in range(samples):
        x = phi @ x + gamma @ u[k] + enter @ torques[k]
        angles[k] = ANGLES @ x
    y = angles + COUNT / math.sqrt(12) * random.normal(size=angles.shape)
    noise = {"noise_variance": [COUNT**2 / 12] * 2, "drift": [1.0, 1.0]}
    kinds = {
        "by noise": noise,
        "by noise, fixed gains": noise | {"time_varying": False},
        "by poles, omega_o = 1500 rad/s": {"omega_o": 1500.0},
    }
    table = Table("missing", *kinds)
    for share in SHARES:
        for burst in (1, 20):
            there, row = y.copy(), list[Any]()
            gone = np.repeat(random.random(samples // burst) < share, burst)
            there[gone, 1] = math.nan
            for options in kinds.values():
                observer = ESO.state_space(A, AT_MOTOR, ANGLES, BOTH, DT, **options)
                error = observer.filter(there, u)[2000:, 2] - angles[2000:, 1]
                lost = not np.max(np.abs(error)) < 1.0
                row.append("diverges" if lost else 1e6 * float(np.sqrt(np.mean(error**2))))
            name = f"{share:.0%}" + (f" in bursts of {burst}" if burst > 1 else "")
            if share > 0.0 or burst == 1:
                table.add_row(name, *(x if isinstance(x, str) else f"{x:.3g}" for x in row))
                figures[name] = dict(zip(kinds, row, strict=True))
    console.print("RMS error of the load's angle [µrad], while both torques wander", table)
    return figures


def main() -> None:
    """Run the parts."""
    parser = parser_of(__doc__)
    parser.add_argument("--part", choices=("linear", "play", "missing", "all"), default="all")
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--designs", nargs="+", choices=DESIGNS, default=[*DESIGNS])
    parser.add_argument("--omegas", type=float, nargs="+", default=OMEGAS, help="[rad/s]")
    parser.add_argument("--drifts", type=float, nargs="+", default=DRIFTS, help="[(N m)²/s]")
    parser.add_argument("--tuning-draws", type=int, default=10, help="machines to tune with")
    parser.add_argument("--seconds", type=float, default=4.0, help="of a run with play")
    parser.add_argument("--samples", type=int, default=40_000, help="of a run with missing ones")
    given = options_of(
        parser, draws=1, designs=["both, d on the load"], omegas=[80.0], drifts=[1.0],
        tuning_draws=1, seconds=1.0, samples=3000,
    )  # fmt: skip
    dispatch.interpret_all |= given.quick  # to compile the loops of all designs takes minutes
    figures: dict[str, Any] = {}
    console = Console(width=150)
    if given.part in ("linear", "all"):
        figures["linear"] = print_linear(console, given)
    if given.part in ("play", "all"):
        figures["play"] = print_play(console, given)
    if given.part in ("missing", "all"):
        figures["missing"] = print_missing(console, given.samples, given.seed)
    write(given, figures)


if __name__ == "__main__":
    main()
