"""B0 of coupled axes from records: errors, and how often the stated intervals hold.

    python benchmarks/input_gain_matrix.py [--machine NAME] [--draws N] [--seed S] [--json FILE]

``gantry``: two axes that are coupled by 0.1 to 0.5, of 2e-4 to 1 kg (or kg m²), with viscous
friction that couples them, too, encoders of 20 bits on a turn, dt from 0.2 to 2 ms, under PD
controllers, with white loads or loads that drift, without or with a delay of one sample; the
multisines of ``interleaved_excitations`` are added to u. ``arm``: ``ql.plants.arm`` at rest in a
posture, held against gravity by ``ql.Axes`` with an inertia that is off by up to 30 %, small
multisines as references: B0 is the inverse of M(q). ``craft``: the attitude of a craft with three
axes and four rotors, around hover, each rotor excited alone. ``mixer``: the same, with an
excitation of roll, pitch and yaw through the mixer, so that no record can tell the rotors apart.
"""

from __future__ import annotations

import time
import warnings
from typing import Any, NamedTuple

import numpy as np
from measured import options_of, parser_of, write
from scipy.linalg import expm

import quell as ql
from quell.identification import identify_b0_matrix, interleaved_excitations
from quell.types import Matrix

TURN = 2.0 * np.pi / 2**20


class Record(NamedTuple):
    """A record and the true B0."""

    u: Matrix
    y: Matrix
    dt: float
    B0: Matrix
    text: str


def linear_record(
    rng: np.random.Generator,
    B0: Matrix,
    friction: Matrix,
    excitation: Matrix,
    dt: float,
    *,
    omega: float,
    step: float,
    load: float,
    walk: bool,
    late: int = 0,
) -> tuple[Matrix, Matrix]:
    """Return u and y of ``y'' = B0 u − friction y' + load`` under PD control, sampled exactly."""
    n, m = B0.shape
    A = np.block([[np.zeros((n, n)), np.eye(n)], [np.zeros((n, n)), -friction]])
    B = np.vstack([np.zeros((n, m + n)), np.hstack([B0, np.eye(n)])])
    both = expm(dt * np.block([[A, B], [np.zeros((m + n, 2 * n + m + n))]]))
    Phi, Gamma = both[: 2 * n, : 2 * n], both[: 2 * n, 2 * n :]
    # PD with a filtered speed and an inertia that is wrong by up to 30 %.
    wrong = np.linalg.pinv(B0 * rng.uniform(0.7, 1.3, B0.shape))
    samples, x = excitation.shape[0], np.zeros(2 * n)
    loads = load * rng.standard_normal((samples, n))
    if walk:
        loads = 0.05 * np.cumsum(loads, axis=0)
    offset = TURN * rng.uniform(-0.5, 0.5, n)
    u, y = np.zeros((samples, m)), np.zeros((samples, n))
    speed, before = np.zeros(n), np.zeros(n)
    for k in range(samples):
        y[k] = step * np.round((x[:n] + offset) / step)
        share = min(10.0 * omega * dt, 1.0)
        speed += share * ((y[k] - before) / dt - speed) if k else 0.0
        before = y[k]
        u[k] = wrong @ (-(omega**2) * y[k] - 1.4 * omega * speed) + excitation[k]
        applied = u[k - late] if k >= late else np.zeros(m)
        x = Phi @ x + Gamma @ np.append(applied, loads[k])
    return u, y


def gantry(rng: np.random.Generator) -> Record:
    """Return a record of two coupled axes."""
    dt = float(rng.choice([2e-4, 5e-4, 1e-3, 2e-3]))
    mass = np.exp(rng.uniform(np.log(2e-4), 0.0, 2))
    coupling = rng.uniform(0.1, 0.5, 2) * rng.choice([-1.0, 1.0], 2)
    # In units of y in which each actuator moves its own axis alike.
    B0 = np.array([[1.0, coupling[0]], [coupling[1], 1.0]]) / mass
    friction = rng.uniform(0.2, 5.0) * np.array(
        [[1.0, rng.uniform(0, 0.4)], [rng.uniform(0, 0.4), 1.0]]
    )
    samples = int(rng.choice([4000, 8000, 12000]))
    omega = float(rng.uniform(0.01, 0.04)) / dt
    designs = interleaved_excitations(
        2, (0.3 * omega, 5.0 * omega), samples * dt, dt, seed=int(rng.integers(360))
    )
    # Amplitudes that move the axes by some hundred steps of the encoder.
    size = rng.uniform(100.0, 1000.0) * TURN * omega**2
    excitation = np.column_stack([design.u for design in designs]) * size * mass
    load = float(rng.choice([0.0, 0.003, 0.03])) * size
    walk, late = bool(rng.integers(2)), int(rng.integers(2))
    u, y = linear_record(
        rng, B0, friction, excitation, dt, omega=omega, step=TURN, load=load, walk=walk, late=late
    )
    return Record(
        u, y, dt, B0, f"dt {dt}, load {load / size:.3g}, walk {walk}, late {late}, N {samples}"
    )


def arm(rng: np.random.Generator) -> Record:
    """Return a record of an arm that is held against gravity."""
    dt = float(rng.choice([5e-4, 1e-3, 2e-3]))
    plant = ql.plants.arm(viscous=float(rng.uniform(0.05, 0.5)), payload=float(rng.uniform(0, 1)))
    q = rng.uniform(-1.2, 1.2, 2)
    M = plant.mass_matrix(q)
    omega_c = float(rng.uniform(8.0, 20.0))
    axes = [
        ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=5.0 * omega_c, dt=dt), omega_c)
        for _ in range(2)
    ]
    wrong = np.linalg.inv(M) * rng.uniform(0.7, 1.3)
    controller = ql.Axes(axes, wrong)
    samples = int(rng.choice([6000, 12000]))
    size = float(rng.uniform(3e-3, 1e-2))
    designs = interleaved_excitations(2, (1.0, 6.0 * omega_c), samples * dt, dt, -size, size)
    settle = 2.0
    reference = tuple(float(q[i]) + design.signal for i, design in enumerate(designs))
    loads = tuple(
        ql.signals.BandLimitedNoise(
            power=float(rng.choice([0.0, 1e-9])) * dt, sample_time=dt, seed=int(rng.integers(1000))
        )
        for _ in range(2)
    )
    scenario = ql.Scenario(
        reference=reference, disturbances=loads, duration=settle + samples * dt, x0=[*q, 0.0, 0.0]
    )
    encoded = ql.plants.encoded_outputs(plant, TURN)
    run = ql.simulate(encoded, controller, scenario)
    first = round(settle / dt)
    u, y = run["u"][first:], run["y_measured"][first:]
    return Record(
        u, y, dt, np.linalg.inv(M), f"dt {dt}, q {q.round(2)}, size {size:.3g}, N {samples}"
    )


def craft(rng: np.random.Generator, mixed: bool = False) -> Record:
    """Return a record of the attitude of a craft around hover."""
    dt, m = float(rng.choice([1e-3, 2e-3, 4e-3])), 4
    inertia = np.array([5e-3, 5e-3, 9e-3]) * rng.uniform(0.5, 2.0, 3)
    lever, drag = 0.17, 0.016
    K = np.array([[-1, -1, 1, 1], [1, -1, -1, 1], [1, -1, 1, -1]]) * np.array(
        [[lever], [lever], [drag]]
    )
    B0 = K * rng.uniform(0.9, 1.1, K.shape) / inertia[:, None]
    samples = int(rng.choice([5000, 10000]))
    omega = float(rng.uniform(8.0, 15.0))
    count = 3 if mixed else m
    designs = interleaved_excitations(count, (2.0, 80.0), samples * dt, dt, -0.3, 0.3)
    excitation = np.column_stack([design.u for design in designs])
    # Through a mixer the craft is a machine with three inputs.
    mixer = np.sign(K).T if mixed else np.eye(m)
    v, y = linear_record(
        rng,
        B0 @ mixer,
        0.3 * np.eye(3),
        excitation,
        dt,
        omega=omega,
        step=1e-5,
        load=0.3,
        walk=False,
    )
    u = v @ mixer.T
    return Record(u, y, dt, B0, f"dt {dt}, N {samples}")


MACHINES = {
    "gantry": gantry,
    "arm": arm,
    "craft": craft,
    "mixer": lambda rng: craft(rng, mixed=True),
}


def main() -> None:
    """Draw machines and print how the intervals hold."""
    parser = parser_of(__doc__)
    parser.add_argument("--machine", choices=[*MACHINES], default="gantry")
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samples", type=int, help="use no more of each record")
    parser.add_argument("--verbose", action="store_true")
    given = options_of(parser, draws=1, samples=1000)
    warnings.simplefilter("ignore")
    scores: list[float] = []
    silent: list[float] = []  # of axes without a line with NOT
    poor = reported = 0
    relative: list[float] = []
    conditions: list[float] = []
    seconds = 0.0
    for draw in range(given.draws):
        record = MACHINES[given.machine](np.random.default_rng([given.seed, draw]))
        begin = time.perf_counter()
        found = identify_b0_matrix(
            record.u[: given.samples], record.y[: given.samples], record.dt, 2
        )
        seconds += time.perf_counter() - begin
        z = ((found.B0 - record.B0) / found.std).ravel()
        scores += z.tolist()
        told = [any(f"axis {name}:" in text for text in found.shortcomings) for name in found.axes]
        silent += z.reshape(found.B0.shape)[~np.array(told)].ravel().tolist()
        conditions += found.condition.tolist()
        relative.append(float(np.max(found.std / np.max(np.abs(record.B0), axis=1, keepdims=True))))
        poor += found.is_poor
        reported += bool(found.shortcomings)
        if given.verbose:
            print(
                record.text, np.round(z, 1), f"{relative[-1]:.2g}", found.shortcomings, flush=True
            )
    size = np.abs(scores)
    result: dict[str, Any] = {
        "machine": given.machine,
        "entries": size.size,
        "within 68 %": float(np.mean(size < 1.0)),
        "within 95 %": float(np.mean(size < 1.96)),
        "largest": float(np.max(size)),
        "entries without NOT": len(silent),
        "of these within 95 %": float(np.mean(np.abs(silent) < 1.96)) if silent else 1.0,
        "their largest": float(np.max(np.abs(silent), initial=0.0)),
        "rms": float(np.sqrt(np.mean(size**2))),
        "median relative deviation": float(np.median(relative)),
        "median condition": float(np.median(conditions)),
        "poor": poor,
        "with shortcomings": reported,
        "seconds each": seconds / given.draws,
    }
    for name, value in result.items():
        print(f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}")
    write(given, result)


if __name__ == "__main__":
    main()
