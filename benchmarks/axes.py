"""Several axes: an arm with and without its mass matrix, arms of MuJoCo, a quadrotor, and the cost.

    python benchmarks/axes.py [--part arm|draws|learners|mujoco|quadrotor|yaw|single|cost]
                              [--draws 100] [--seed 7]

*arm*: random rigid two-link arms (those of ``quell stress --loops axes``) that follow sines,
ω_c/ω_o = 8/60: RMS error against the response that the design asks for, from 5 s on, with M(q),
with M at the middle of the motion, and with two independent loops; without learner and with
``Harmonic()`` and a guard.

*learners*: the same arms with M at the middle of the motion, and references of three sines each, so
that no motion repeats: RMS error from 20 s on, and over that without learner, of learners that see
their own axis, of ones that see both, and of one that serves both, all with guards. ``--motion
sines`` is the motion of *arm*, in which each joint follows one sine.

*mujoco*: arms of two and three joints, one joint elastic in half of them, simulated by MuJoCo; the
model's masses, lengths and inertias are each up to 20 % off. Every run must be stable; the guarded
learner over none.

*quadrotor*: steps of the attitude to random targets, four rotors that meet their limits, inertias
up to 30 % off. One ``Axes`` with B0 of the attitude, roll and pitch before yaw, against three
single loops, each with the limits of its torque, whose torques are mixed and cut behind them. RMS
of the error against the response that the design asks for, all angles.

*yaw*: the same draws: the least RMS of yaw that the rotors allow, for a level craft, with its
inertia and the lag of its rotors known: at each step of the reference, not before, u is planned
for what is left of the response that the design asks for, with all of the torque for yaw.

*single*: u of single precision against that of double at the limits, with ``saturation="each"``
and by priority: gantries with two motors on one axis, quadrotors, and random B0 of the given
numbers of axes and actuators whose rows differ in size by up to 10⁴. Of each the median, the 99.9th
percentile and the largest difference of one actuator, in parts of its range.

*draws*: processor time to make each of some drawn arms and its ``Axes`` with M(q) and to take the
first samples, and that of a sample in the loop.

*cost*: ``step`` of three axes over three times ``step`` of one, and the compiled loop likewise; and
the loop of three axes with one learner for all over that with one for each.
"""

from __future__ import annotations

import math
import time
import warnings
from functools import partial
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from scipy.linalg import expm, toeplitz
from scipy.optimize import lsq_linear
from scipy.signal import lsim

import quell as ql
from quell.controllers.allocation import (
    allocate,
    checked_actuator_limits,
    checked_gain,
    checked_rule,
    range_memory,
)
from quell.experiments.stress.axes import draw_arm
from quell.kernels import dispatch
from quell.kernels.single import in_single
from quell.plants.multibody import rotor_levers

DT = 1e-3
OMEGA_C, OMEGA_O = 8.0, 60.0
NOISE = 2.0 * np.pi / 2**20  # of encoders with 20 bits [rad]


def joint(learner: bool = False, omega_c: float = OMEGA_C, omega_o: float = OMEGA_O) -> ql.ADRC:
    """Return the controller of an axis."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=omega_o, dt=DT)
    parts: dict[str, Any] = {}
    if learner:
        parts = {"learner": ql.learners.Harmonic(), "guard": ql.Guard()}
    return ql.ADRC(observer, omega_c, **parts)


def asked_for(r: Any, t: Any) -> Any:
    """Return the response that the design asks for, ω_c²/(s + ω_c)², of each reference."""
    design = ([OMEGA_C**2], [1.0, 2.0 * OMEGA_C, OMEGA_C**2])
    return np.stack([lsim(design, one - one[0], t)[1] + one[0] for one in r.T], axis=1)


def rms(error: Any, t: Any, start: float = 5.0) -> Any:
    """Return the RMS of each column from a time on."""
    return np.sqrt(np.mean(error[t >= start] ** 2, axis=0))


# ---- Random rigid arms ----


def part_arm(draws: int, seed: int, share: float = 1.0) -> dict[str, Any]:
    """Print errors of both joints, medians over the arms, with and without M(q)."""
    kinds = ("M(q)", "M at the middle", "two loops")
    found: dict[tuple[str, bool], list[Any]] = {}
    for i in range(draws):
        drawn = draw_arm(np.random.default_rng([seed, i]))
        plant = ql.plants.arm(drawn.lengths, drawn.masses, gravity=drawn.gravity)
        middle = np.array([0.0, drawn.elbow])
        M = plant.mass_matrix(middle)
        matrices = (plant.inertia, M, np.diag(1.0 / np.diag(np.linalg.inv(M))))
        sines = [
            ql.signals.Sum((ql.signals.Constant(at), ql.signals.Sinusoid(amplitude, omega)))
            for at, amplitude, omega in zip(
                middle, drawn.amplitudes, drawn.frequencies, strict=True
            )
        ]
        noise = ql.signals.BandLimitedNoise(power=NOISE**2 * DT, sample_time=DT)
        start = np.array([*middle, 0.0, 0.0])
        scenario = ql.Scenario(sines, 40.0 * share, noise=noise, x0=start, seed=i)
        for kind, matrix in zip(kinds, matrices, strict=True):
            for learns in (False, True):
                run = ql.simulate(
                    plant, ql.Axes([joint(learns), joint(learns)], M=matrix), scenario
                )
                error = np.full(2, np.inf)
                if not run.diverged:
                    error = rms(asked_for(run["r"], run.t) - run["y"], run.t, 5.0 * share)
                found.setdefault((kind, learns), []).append(1e3 * error)
    print(f"two-link arms, {draws}, RMS error [mrad], median of joint 1, joint 2")
    figures: dict[str, Any] = {}
    for (kind, learns), errors in found.items():
        one, two = np.median(errors, axis=0)
        plain = np.array(found[kind, False])
        worst = np.max(np.array(errors) / plain)
        print(f"  {kind:16} {'Harmonic, guard' if learns else 'no learner':16} "
              f"{one:7.2f} {two:7.2f}   worst over none {worst:.3f}")  # fmt: skip
        figures[f"{kind}, {'Harmonic, guard' if learns else 'no learner'}"] = {
            "joint 1 [mrad]": one, "joint 2 [mrad]": two, "worst over none": worst,
        }  # fmt: skip
    return figures


def part_draws(draws: int, seed: int, share: float = 1.0) -> dict[str, Any]:
    """Print what each further arm takes: its code is that of the first."""
    times = []
    for i in range(draws):
        drawn = draw_arm(np.random.default_rng([seed, i]))
        start = [0.0, drawn.elbow, 0.0, 0.0]
        begin = time.process_time()
        plant = ql.plants.arm(drawn.lengths, drawn.masses, gravity=drawn.gravity)
        axes = ql.Axes([joint(), joint()], M=plant.inertia)
        ql.simulate(plant, axes, ql.Scenario(0.1, 0.01, x0=start))
        times.append(time.process_time() - begin)
    samples = []
    for _ in range(5):
        begin = time.process_time()
        ql.simulate(plant, axes, ql.Scenario(0.1, 20.0 * share, x0=start), record_every=1000)
        samples.append((time.process_time() - begin) / (20000.0 * share))
    print(f"{draws} arms, processor time of making one: the first {times[0]:.2f} s, the others "
          f"{np.median(times[1:]):.3f} s; a sample {1e6 * min(samples):.2f} us")  # fmt: skip
    return {
        "the first [s]": times[0],
        "the others [s]": np.median(times[1:]) if draws > 1 else "there is one only",
        "a sample [us]": 1e6 * min(samples),
    }


# ---- Learners that see both joints ----


def forces(x, u):  # type: ignore[no-untyped-def]
    """Return the functions in the equations of a two-link arm, of its angles, rates and v."""
    c, s = math.cos(x[2]), math.sin(x[2])
    return (
        math.cos(x[0]), math.cos(x[0] + x[2]),
        s * x[1] * x[1], s * x[1] * x[3], s * x[3] * x[3],
        x[1], x[3], c * x[4], c * x[5],
    )  # fmt: skip


FORCES = ("g1", "g2", "s v1^2", "s v1 v2", "s v2^2", "d1", "d2", "c a1", "c a2")


def learners() -> dict[str, Any]:
    """Return for each name the learner of an axis, and that of ``Axes``."""
    F, L = ql.features, ql.learners
    plain = F.State() + F.Polynomial(2)
    both, cubes = F.AllAxes(plain) + F.Bias(), F.AllAxes(F.State() + F.Polynomial(3)) + F.Bias()
    known = F.AllAxes(F.Custom(forces, FORCES), inputs=True) + F.Bias()
    return {
        "none": (None, None),
        "Harmonic, own": (L.Harmonic(), None),
        "RLS, own, monomials to 2": (L.RLS(plain + F.Bias()), None),
        "RLS, both, monomials to 2": (None, [L.RLS(both), L.RLS(both)]),
        "RLS, one for both, to 2": (None, L.RLS(both)),
        "RLS, one for both, to 3": (None, L.RLS(cubes)),
        "RLS, one for both, functions": (None, L.RLS(known)),
        "NLMS, own, monomials to 2": (L.NLMS(plain + F.Bias()), None),
        "NLMS, one for both, to 2": (None, L.NLMS(both)),
        "GaussianProcess, own": (L.GaussianProcess(F.State()), None),
        "GaussianProcess, both": (
            None, [L.GaussianProcess(F.AllAxes(F.State()), length=1.0) for _ in range(2)],
        ),
    }  # fmt: skip


def part_learners(
    draws: int, seed: int, share: float = 1.0, motion: str = "three"
) -> dict[str, Any]:
    """Print errors of both joints, medians over the arms, for each learner."""
    found: dict[str, list[Any]] = {}
    for i in range(draws):
        rng = np.random.default_rng([seed, i])
        drawn = draw_arm(rng)
        plant = ql.plants.arm(drawn.lengths, drawn.masses, gravity=drawn.gravity)
        middle = np.array([0.0, drawn.elbow])
        M = plant.mass_matrix(middle)
        references = []
        for at, amplitude, omega in zip(middle, drawn.amplitudes, drawn.frequencies, strict=True):
            omegas = (omega, *rng.uniform(0.5, 4.0, 2)) if motion == "three" else (omega,)
            sizes = (0.5, 0.25, 0.25) if motion == "three" else (1.0,)
            waves = [
                ql.signals.Sinusoid(amplitude * size, each)
                for size, each in zip(sizes, omegas, strict=True)
            ]
            references.append(ql.signals.Sum((ql.signals.Constant(at), *waves)))
        noise = ql.signals.BandLimitedNoise(power=NOISE**2 * DT, sample_time=DT)
        scenario = ql.Scenario(
            references, duration=40.0 * share, noise=noise, x0=np.array([*middle, 0.0, 0.0]), seed=i
        )
        for name, (own, of_axes) in learners().items():
            guard = None if own is None else ql.Guard()
            joints = [
                ql.ADRC(joint().observer, OMEGA_C, learner=own, guard=guard) for _ in range(2)
            ]
            watch = None if of_axes is None else ql.Guard()
            run = ql.simulate(plant, ql.Axes(joints, M=M, learner=of_axes, guard=watch), scenario)
            error = np.full(2, np.inf)
            if not run.diverged:
                error = rms(asked_for(run["r"], run.t) - run["y"], run.t, 20.0 * share)
            found.setdefault(name, []).append(1e3 * error)
    print(f"learners, {draws} arms, seed {seed}, motion {motion}: RMS error [mrad] of joint 1, "
          "joint 2; over none, median and largest")  # fmt: skip
    plain = np.array(found["none"])
    figures: dict[str, Any] = {}
    for name, errors in found.items():
        one, two = np.median(errors, axis=0)
        ratios = np.array(errors) / plain
        print(f"  {name:30} {one:7.2f} {two:7.2f}   {np.median(ratios):6.3f} {np.max(ratios):6.3f}")
        figures[name] = {
            "joint 1 [mrad]": one,
            "joint 2 [mrad]": two,
            "over none": {"median": np.median(ratios), "largest": np.max(ratios)},
        }
    return figures


# ---- Arms in MuJoCo ----


def mujoco_arm(lengths: Any, masses: Any, motors: Any, stiffness: Any) -> Any:
    """Return a model of MuJoCo of a planar arm of rods; an elastic joint has a motor before it."""
    import mujoco

    body, end, actuators = "", "", ""
    for i, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        about, at = mass * length**2 / 12.0, lengths[i - 1] if i else 0.0
        joint = f'<joint name="j{i}" type="hinge" axis="0 -1 0" damping="0.05"'
        inertia = f"{about} {about} {about}"
        inertial = f'<inertial pos="{length / 2} 0 0" mass="{mass}" diaginertia="{inertia}"/>'
        if np.isfinite(stiffness[i]):
            k, d = stiffness[i], 0.01 * 2.0 * np.sqrt(stiffness[i] * motors[i])
            small = "1e-6 1e-6 1e-6"
            body += (
                f'<body pos="{at} 0 0"><joint name="m{i}" type="hinge" axis="0 -1 0" '
                f'armature="{motors[i]}"/><inertial pos="0 0 0" mass="1e-4" diaginertia="{small}"/>'
                f'<body>{joint[:-15]} stiffness="{k}" damping="{d}"/>{inertial}'
            )
            end += "</body></body>"
            actuators += f'<motor joint="m{i}"/>'
        else:
            body += f'<body pos="{at} 0 0">{joint} armature="{motors[i]}"/>{inertial}'
            end += "</body>"
            actuators += f'<motor joint="j{i}"/>'
    xml = (
        f'<mujoco><option gravity="0 0 -9.81" timestep="{DT}" integrator="implicitfast"/>'
        f"<worldbody>{body}{end}</worldbody><actuator>{actuators}</actuator></mujoco>"
    )
    return mujoco.MjModel.from_xml_string(xml)


def part_mujoco(draws: int, seed: int, share: float = 1.0) -> dict[str, Any] | str:
    """Print how many runs are stable, and the guarded learner's RMS over none, worst joint."""
    try:
        import mujoco
    except ImportError:
        print("no arms of MuJoCo: it is not installed")
        return "MuJoCo is not installed"

    stable, ratios = 0, []
    t = DT * np.arange(round(20000 * share))
    for i in range(draws):
        rng = np.random.default_rng([seed, i])
        n = 2 + i % 2
        lengths, masses = rng.uniform(0.2, 0.5, n), rng.uniform(0.5, 3.0, n)
        motors, stiffness = rng.uniform(0.02, 0.1, n), np.full(n, np.inf)
        guess = ql.plants.arm(
            lengths * rng.uniform(0.8, 1.2, n), masses * rng.uniform(0.8, 1.2, n),
            motor_inertia=motors * rng.uniform(0.8, 1.2, n),
        )  # fmt: skip
        if (i // 2) % 2:
            # The elastic joint is the last: its motor alone is at 25 to 60 Hz against the link.
            link = masses[-1] * lengths[-1] ** 2 / 3.0
            stiffness[-1] = link * (2.0 * np.pi * rng.uniform(25.0, 60.0)) ** 2
        model = mujoco_arm(lengths, masses, motors, stiffness)
        at = [
            model.joint(f"m{j}" if np.isfinite(stiffness[j]) else f"j{j}").qposadr[0]
            for j in range(n)
        ]
        omegas, sizes = rng.uniform(0.5, 4.0, n), rng.uniform(0.2, 0.8, n)
        r = sizes * np.sin(np.outer(t, omegas))
        errors = []
        for learns in (False, True):
            axes = ql.Axes([joint(learns) for _ in range(n)], M=guess.inertia)
            data, noise = mujoco.MjData(model), np.random.default_rng(i)
            y = np.empty_like(r)
            for k in range(t.size):
                y[k] = data.qpos[at]
                data.ctrl[:] = axes.step(r[k], y[k] + NOISE * noise.standard_normal(n))
                mujoco.mj_step(model, data)
            errors.append(rms(asked_for(r, t) - y, t, 5.0 * share))
        good = bool(np.all(np.isfinite(errors)) and np.max(errors) < 0.3)
        stable += good
        if good:
            ratios.append(errors[1] / errors[0])
    if not ratios:
        return {"arms": draws, "stable": 0}
    every = np.concatenate(ratios)
    worst = np.array([each.max() for each in ratios])
    print(f"MuJoCo, {draws} arms, model 20 % off: stable {stable}; guarded over none: median "
          f"{np.median(every):.3f}, worst joint of the arms: 95 % {np.quantile(worst, 0.95):.3f}, "
          f"largest {worst.max():.3f}")  # fmt: skip
    return {
        "arms": draws,
        "stable": stable,
        "guarded over none": np.median(every),
        "worst joint": {"95 %": np.quantile(worst, 0.95), "largest": worst.max()},
    }


# ---- A quadrotor ----


ATTITUDE = {"roll": (8.0, 40.0), "pitch": (8.0, 40.0), "yaw": (6.0, 30.0)}
TARGETS = (0.7, 0.7, 0.8)  # largest angles [rad]
INERTIA = np.array([0.012, 0.012, 0.022])  # [kg m²]
HOVER, LEAST, MOST = 2.5, 0.2, 6.0  # thrusts of a rotor [N]


def moves(rng: Any, size: float) -> Any:
    """Return steps at eight random times to random targets within ±``size``."""
    targets = rng.uniform(-size, size, 8)
    times = np.sort(rng.uniform(0.0, 18.0, 8))
    changes = np.diff(targets, prepend=0.0)
    return ql.signals.Sum(
        tuple(ql.signals.Step(float(c), float(at)) for c, at in zip(changes, times, strict=True))
    )


def drawn_flight(seed: int, i: int, share: float = 1.0) -> tuple[Any, ql.Scenario]:
    """Return B0 of the level craft as the controllers have it, and what it flies through."""
    rng = np.random.default_rng([seed, i])
    level = rotor_levers(0.17, 0.015) / (INERTIA * rng.uniform(0.7, 1.3, 3))[:, None]
    gusts = [ql.signals.Sinusoid(0.05, float(rng.uniform(2.0, 8.0))) for _ in range(2)]
    return level, ql.Scenario(
        [moves(rng, size) for size in TARGETS], duration=20.0 * share, disturbances=gusts,
        x0=[0.0] * 6 + [HOVER] * 4, seed=i,
    )  # fmt: skip


def part_quadrotor(draws: int, seed: int, share: float = 1.0) -> dict[str, Any]:
    """Print the RMS of Axes over that of three single loops, all angles."""
    ratios, roll_and_pitch, yaw = [], [], []
    hover, most = HOVER, MOST
    for i in range(draws):
        level, scenario = drawn_flight(seed, i, share)
        craft = ql.plants.quadrotor_attitude(INERTIA)
        axes = {name: joint(omega_c=c, omega_o=o) for name, (c, o) in ATTITUDE.items()}
        controller = ql.Axes(
            axes, partial(gain_of_attitude, level=level), saturation=["roll", "pitch", "yaw"],
            u_min=LEAST, u_max=most, wished=[hover] * 4,
        )  # fmt: skip
        run = ql.simulate(craft, controller, scenario)
        asked = np.stack(
            [
                lsim(([c**2], [1.0, 2.0 * c, c**2]), one, run.t)[1]
                for (c, _), one in zip(ATTITUDE.values(), run["r"].T, strict=True)
            ],
            axis=1,
        )
        ours = asked[: len(run)] - run["y"]
        theirs = asked - single_loops(craft, level, run["r"], scenario, hover, most)
        ratios.append(np.sqrt(np.mean(ours**2) / np.mean(theirs**2)))
        roll_and_pitch.append(np.sqrt(np.mean(ours[:, :2] ** 2) / np.mean(theirs[:, :2] ** 2)))
        yaw.append([np.sqrt(np.mean(each[:, 2] ** 2)) for each in (ours, theirs)])
    print(f"quadrotor, {draws} draws: RMS of Axes over three single loops: median "
          f"{np.median(ratios):.2f}, largest {np.max(ratios):.2f}; of roll and pitch "
          f"{np.median(roll_and_pitch):.2f}, {np.max(roll_and_pitch):.2f}")  # fmt: skip
    return {
        "draws": draws,
        "all angles": {"median": np.median(ratios), "largest": np.max(ratios)},
        "roll and pitch": {
            "median": np.median(roll_and_pitch), "largest": np.max(roll_and_pitch),
        },
        "yaw of each draw, Axes and single [rad]": yaw,
    }  # fmt: skip


def gain_of_attitude(x, level):  # type: ignore[no-untyped-def]
    """Return B0 at the angles, from that of the level craft (3, 4)."""
    roll, pitch = x[0, 0], x[1, 0]
    W = np.zeros((3, 3))  # from rates of the body to rates of the angles
    W[0, 0], W[0, 1], W[0, 2] = (
        1.0,
        math.sin(roll) * math.tan(pitch),
        math.cos(roll) * math.tan(pitch),
    )
    W[1, 1], W[1, 2] = math.cos(roll), -math.sin(roll)
    W[2, 1], W[2, 2] = math.sin(roll) / math.cos(pitch), math.cos(roll) / math.cos(pitch)
    out = np.zeros((3, 4))
    for i in range(3):
        for j in range(4):
            for k in range(3):
                out[i, j] += W[i, k] * level[k, j]
    return out


def single_loops(craft: Any, B0: Any, r: Any, scenario: Any, hover: float, most: float) -> Any:
    """Return the angles under three ADRCs, each with the torque's limit of its own axis."""
    from quell.plants.base import advance, measure_all

    mixer = np.linalg.pinv(B0)
    reach = [(most - hover) * np.sum(np.abs(row)) for row in B0]
    loops = []
    for a, (omega_c, omega_o) in zip(reach, ATTITUDE.values(), strict=True):
        observer = ql.ESO.model_free(2, 1.0, omega_o, DT)
        loops.append(ql.ADRC(observer, omega_c, u_min=-a, u_max=a))
    model, x = craft.sampled(DT), np.array(scenario.x0)
    t = DT * np.arange(len(r))
    w = np.stack([*(d(t) for d in scenario.disturbances), np.zeros(t.size)], axis=1)
    y, scratch, angles = np.zeros(3), np.zeros(60), np.empty_like(r)
    for k in range(len(r)):
        measure_all(model, x, y)
        angles[k] = y
        v = np.array([loop.step(r[k, i], y[i]) for i, loop in enumerate(loops)])
        u = np.clip(hover + mixer @ v, LEAST, most)
        advance(model, x, scratch, t[k], u, w[k])
        if not np.all(np.abs(x) < 1e6):
            angles[k:] = 10.0
            break
    return angles


def part_yaw(draws: int, seed: int, share: float = 1.0) -> dict[str, Any]:
    """Print the least RMS of yaw of each draw."""
    dt, ahead = 0.02, max(3.0 * share, 0.2)
    figures: dict[str, Any] = {}
    torque = 2.0 * (MOST - LEAST) * 0.015
    plant, design = np.zeros((4, 4)), np.zeros((3, 3))
    plant[0, 1], plant[1, 2], plant[2, 2:] = 1.0, 1.0 / INERTIA[2], (-50.0, 50.0 * torque)
    omega = ATTITUDE["yaw"][0]
    design[0, 1], design[1] = 1.0, (-(omega**2), -2.0 * omega, omega**2)
    A, B, ask = expm(plant * dt)[:3, :3], expm(plant * dt)[:3, 3], expm(design * dt)[:2]
    size = int(ahead / dt)
    pulse, x = np.zeros(size), B
    for k in range(size):
        pulse[k], x = x[0], A @ x
    H = np.tril(toeplitz(pulse))
    for i in range(draws):
        r = drawn_flight(seed, i)[1].reference[2](dt * np.arange(int(max(20.0 * share, 1.0) / dt)))
        x, f, u, missed = np.zeros(3), np.zeros(2), np.zeros(0), []
        for k, now in enumerate(r):
            missed.append(f[0] - x[0])
            if u.size == 0 or now != r[k - 1]:
                rest, free, asked = x, f, []
                for _ in range(size):
                    rest, free = A @ rest, ask @ np.append(free, now)
                    asked.append(free[0] - rest[0])
                u = lsq_linear(H, asked, (-1.0, 1.0), method="bvls", max_iter=500).x
            x, f, u = A @ x + B * u[0], ask @ np.append(f, now), u[1:]
        figures[f"draw {i} [rad]"] = np.sqrt(np.mean(np.square(missed)))
        print(f"draw {i}: RMS of yaw at best {figures[f'draw {i} [rad]']:.4f} rad")
    return figures


# ---- The cost ----


def part_cost(draws: int, seed: int, share: float = 1.0) -> dict[str, Any]:
    """Print the time of three axes over three times that of one, best of several."""
    figures: dict[str, Any] = {}
    one, three = joint(learner=True), ql.Axes([joint(learner=True) for _ in range(3)])
    plain_one, plain_three = joint(), ql.Axes([joint() for _ in range(3)])
    r, y = np.array([0.1, 0.2, 0.3]), np.zeros(3)

    def best(call: Any, count: int = round(20000 * share)) -> float:
        call()
        found = []
        for _ in range(9 if share == 1.0 else 2):
            start = time.perf_counter()
            for _ in range(count):
                call()
            found.append((time.perf_counter() - start) / count)
        return min(found)

    for name, single, several in (("plain", plain_one, plain_three), ("learner", one, three)):
        a, b = best(lambda s=single: s.step(0.1, 0.0)), best(lambda s=several: s.step(r, y))
        figures[f"step, {name}"] = {"one [us]": 1e6 * a, "over three": b / (3 * a)}
        print(f"step, {name}: one {1e6 * a:.2f} us, three axes {1e6 * b:.2f} us, "
              f"ratio to three {b / (3 * a):.2f}")  # fmt: skip
    seen = ql.features.AllAxes(ql.features.State() + ql.features.Polynomial(2)) + ql.features.Bias()
    for_each = ql.Axes([joint() for _ in range(3)], learner=[ql.learners.RLS(seen)] * 3)
    for_all = ql.Axes([joint() for _ in range(3)], learner=ql.learners.RLS(seen))
    moves = 0.1 * np.sin(
        np.outer(0.01 * np.arange(round(2000 * share)), [1.0, 1.3, 1.7])
    )  # at rest none learns

    def run_moving(axes: ql.Axes) -> None:
        for each in moves:
            axes.step(r, each)

    a, b = (
        best(lambda s=each: run_moving(s), 5 if share == 1.0 else 1) / len(moves)
        for each in (for_each, for_all)
    )
    print(f"step, three axes, RLS of 28 features: one for each {1e6 * a:.2f} us, "
          f"one for all {1e6 * b:.2f} us, ratio {b / a:.2f}")  # fmt: skip
    figures["step, RLS of 28 features, one for all over one for each"] = b / a
    masses = ql.plants.LinearPlant(
        np.kron(np.eye(3), [[0, 1], [0, -1]]), np.kron(np.eye(3), [[0], [1]]),
        np.kron(np.eye(3), [[1, 0]]),
    )  # fmt: skip
    mass = ql.plants.LinearPlant.of(([1.0], [1.0, 1.0, 0.0]))
    sine = ql.signals.Sinusoid(0.5, 3.0)
    scenario = ql.Scenario(sine, duration=100.0 * share)
    all_three = ql.Scenario((sine,) * 3, duration=100.0 * share)
    for name, single, several in (("plain", plain_one, plain_three), ("learner", one, three)):
        a = best(lambda s=single: ql.simulate(mass, s, scenario, record_every=1000), 1)
        b = best(lambda s=several: ql.simulate(masses, s, all_three, record_every=1000), 1)
        figures[f"loop, {name}"] = {"one [ms]": 1e3 * a, "over three": b / (3 * a)}
        print(f"loop, {name}: one {1e3 * a:.1f} ms, three axes {1e3 * b:.1f} ms, "
              f"ratio to three {b / (3 * a):.2f}")  # fmt: skip
    return figures


# ---- Single precision at the limits ----


def drawn_gain(kind: str, rng: Any) -> tuple[Any, float, float, list[float] | None]:
    """Return B0, the limits of u, and the u that is wished."""
    if kind == "quadrotor":
        return rotor_levers(0.17, 0.015) / drawn_inertia(rng)[:, None], LEAST, MOST, [HOVER] * 4
    if kind == "gantry":  # x and the angle of the beam by two motors, y by the third one
        m, J, half, at, y = (rng.uniform(*each) for each in (
            (20, 60), (5, 20), (0.5, 1.0), (-0.4, 0.4), (5, 15),
        ))  # fmt: skip
        more = rng.normal(0.0, (0.02 / m, 0.05 / J, 0.01, 0.01))
        B0 = [[1 / m, 1 / m, more[0]], [(half - at) / J, -(half + at) / J, more[1]],
              [more[2], more[3], 1 / y]]  # fmt: skip
        return np.array(B0), -300.0, 300.0, None
    n, m = map(int, kind.split(" by "))
    while True:
        B0 = rng.standard_normal((n, m))
        if np.linalg.cond(B0 / np.linalg.norm(B0, axis=1)[:, None]) < 10.0:
            return B0 * 10.0 ** rng.uniform(-2.0, 2.0, n)[:, None], -1.0, 1.0, None


def drawn_inertia(rng: Any) -> Any:
    """Return inertias of a quadrotor up to 30 % off [kg m²]."""
    return INERTIA * rng.uniform(0.7, 1.3, 3)


def difference_in_single(kind: str, by_priority: bool, rng: Any) -> float:
    """Return how much u differs, in parts of its range; 0 if no limit is met."""
    B0, low, high, wished = drawn_gain(kind, rng)
    n, m = B0.shape
    names = [f"axis{i + 1}" for i in range(n)]
    order = [names[i] for i in rng.permutation(n)] if by_priority else "each"
    gain = checked_gain(B0, None, None, names, 2)
    rule = checked_rule(order, wished if m > n else None, gain, names)
    rate = rng.choice([np.inf, 50.0 * (high - low)])
    limits = checked_actuator_limits(low, high, rate, m, DT)
    middle = B0 @ np.full(m, 0.5 * (low + high)) if wished is None else B0 @ wished
    reach = 0.5 * (high - low) * np.sum(np.abs(B0), axis=1)
    v = middle + reach * rng.choice([0.5, 1.5]) * rng.standard_normal(n)
    room, before = range_memory(n, m, rule), rng.uniform(low, high, m)
    double = rule, limits, gain.memory(), room, v, before, np.zeros(m)
    single = in_single(double)
    if allocate(*double) | allocate(*single) == 0:
        return 0.0
    return float(np.max(np.abs(double[-1] - single[-1])) / (high - low))


def part_single(draws: int, seed: int, share: float = 1.0) -> dict[str, Any]:
    """Print the differences of each kind of B0."""
    figures: dict[str, Any] = {}
    kinds = (
        "gantry",
        "quadrotor",
        "2 by 2",
        "3 by 3",
        "4 by 4",
        "2 by 3",
        "3 by 4",
        "3 by 6",
        "4 by 6",
    )
    for name, by_priority in (("each", False), ("priority", True)):
        for kind in kinds:
            rng = np.random.default_rng(seed)
            count = max(draws, 20)  # at a limit are most of them, not each
            drawn = np.array([difference_in_single(kind, by_priority, rng) for _ in range(count)])
            found = drawn[drawn > 0.0]
            print(f"single precision, {name}, {kind}: u differs by {np.median(found):.1e}, "
                  f"{np.quantile(found, 0.999):.1e}, {np.max(found):.1e} of its range "
                  f"in {found.size} draws at the limits; {np.sum(found > 1e-4)} above 1e-4",
                  flush=True)  # fmt: skip
            figures[f"{name}, {kind}"] = {
                "draws at the limits": found.size,
                "median": np.median(found),
                "99.9 %": np.quantile(found, 0.999),
                "largest": np.max(found),
                "above 1e-4": np.sum(found > 1e-4),
            }
    return figures


PARTS: dict[str, Any] = {
    "arm": part_arm,
    "draws": part_draws,
    "learners": part_learners,
    "mujoco": part_mujoco,
    "quadrotor": part_quadrotor,
    "yaw": part_yaw,
    "single": part_single,
    "cost": part_cost,
}


def main() -> None:
    """Run the parts."""
    parser = parser_of(__doc__)
    parser.add_argument("--part", choices=PARTS, action="append")
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--motion", choices=("three", "sines"), default="three")
    options = options_of(parser, draws=1)
    warnings.simplefilter("ignore")
    # Runs of 50 ms and the like are quicker interpreted than to compile.
    share, dispatch.interpret_all = (0.00125, True) if options.quick else (1.0, False)
    figures: dict[str, Any] = {"draws": options.draws, "seed": options.seed}
    for name in options.part or PARTS:
        more = (options.motion,) if name == "learners" else ()
        figures[name] = PARTS[name](options.draws, options.seed, share, *more)
    write(options, figures)


if __name__ == "__main__":
    main()
