"""Nonlinear learners on a plant with friction and a stiffening spring.

    y'' = 2 u − y − 2 y³ − tanh(y'/0.05), model-free ESO of 30 rad/s, omega_c = 5 rad/s, dt = 2 ms

The error is the difference from the ideal closed loop ``omega_c²/(s + omega_c)²``, so it is caused
by the part of the disturbance that is not rejected. It is evaluated in the second minute. The
learners have their defaults except for the features named.

At each reversal the friction jumps by 2. Observer and bias detect it about N/omega_o = 0.1 s late.
A linear learner can only add damping that is too strong at high speed and too weak at low speed. A
nonlinear learner predicts the jump from earlier reversals. Features that match the plant
(``Friction``) are best. During the rests of the moves back and forth the friction depends on the
applied force, which no function of the state can represent, so black-box models bring no advantage
over the linear learner, whose bias is as fast as theirs.

*Compensation*: the same loops beside a friction model that is known, LuGre's (Canudas de Wit,
Olsson, Åström & Lischinsky, *IEEE Trans. Automatic Control* 40, 1995), with the bristles' mean
deflection z, in the plant and in what is fed forward along the response that the design asks for::

    z' = v − σ_0 |v|/g(v) z,      F = σ_0 z + σ_1 z',      g(v) = F_c + (F_s − F_c) exp(−(v/v_s)²)

It is known exactly, or with F_c and F_s 20 % too large. The plant has friction of this form, with
F_c = 1, F_s = 1.3, v_s = 0.1, σ_0 = 1000 and σ_1 = 30, or the tanh of above, for which the model
has F_s = 1.

python benchmarks/friction.py [--part learners|compensation]
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table
from scipy import signal

import quell as ql
from quell.features import RBF, Bias, Friction, Polynomial, RandomFourier, State

OMEGA_C, DT, TRAINED = 5.0, 2e-3, 60.0

s = ql.signals
MOVE = s.Trapezoid(distance=1.0, duration=1.5, start=0.5)
REFERENCES = {
    "two sinusoids": 0.5 * s.Sinusoid(omega=1.0) + 0.3 * s.Sinusoid(omega=2.3),
    "moves to and fro": sum(
        (
            (-1.0) ** k * s.Trapezoid(distance=1.0, duration=1.5, start=0.5 + 3.0 * k)
            for k in range(1, 40)
        ),
        start=MOVE,
    ),
}
LEARNERS: dict[str, Any] = {
    "none": None,
    "Kalman (linear)": ql.learners.Kalman(),
    "RLS (linear)": ql.learners.RLS(),
    "NLMS (linear)": ql.learners.NLMS(),
    "RLS, RBF(40)": ql.learners.RLS(State() + RBF(40) + Bias()),
    "NLMS, RBF(40)": ql.learners.NLMS(features=State() + RBF(40) + Bias()),
    "RLS, RandomFourier(40, 0.3)": ql.learners.RLS(
        State() + RandomFourier(40, length=0.3) + Bias()
    ),
    "RLS, Polynomial + Friction": ql.learners.RLS(State() + Polynomial() + Friction() + Bias()),
    "NLMS, Polynomial + Friction": ql.learners.NLMS(
        features=State() + Polynomial() + Friction() + Bias()
    ),
    "MLP": ql.learners.MLP(),
    "GaussianProcess": ql.learners.GaussianProcess(),
    "GaussianProcess(length=0.3)": ql.learners.GaussianProcess(length=0.3),
}


def stage(t: float, x: np.ndarray, u: float, w: np.ndarray) -> tuple[float, float]:
    """Return the derivatives: a mass with friction on a stiffening spring."""
    return x[1], 2.0 * u - x[0] - 2.0 * x[0] ** 3 - math.tanh(x[1] / 0.05) + w[0]


SLIDING, STATIC, STRIBECK, STIFFNESS, DAMPING = 1.0, 1.3, 0.1, 1000.0, 30.0


def bristled(t: float, x: np.ndarray, u: float, w: np.ndarray) -> tuple[float, float, float]:
    """Return the derivatives of position, speed and z: the same mass with LuGre's friction."""
    g = SLIDING + (STATIC - SLIDING) * math.exp(-((x[1] / STRIBECK) ** 2))
    dz = x[1] - STIFFNESS * abs(x[1]) / g * x[2]
    force = STIFFNESS * x[2] + DAMPING * dz
    return x[1], 2.0 * u - x[0] - 2.0 * x[0] ** 3 - force + w[0], dz


def fed_forward(reference: Any, seconds: float, static: float, share: float) -> ql.signals.Signal:
    """Return LuGre's friction along the ideal response, with ``share`` of its forces."""
    t = np.arange(0.0, seconds + DT, DT)
    system = ([OMEGA_C**2, 0.0], [1.0, 2.0 * OMEGA_C, OMEGA_C**2])
    v = signal.lsim(system, reference(t), t)[1]
    force, z = np.zeros(t.size), 0.0
    for k, each in enumerate(v.tolist()):
        g = share * (SLIDING + (static - SLIDING) * math.exp(-((each / STRIBECK) ** 2)))
        rate = STIFFNESS * abs(each) / g
        # Exact for a speed that is held over a sample.
        end = math.copysign(g / STIFFNESS, each) if each else z
        force[k] = STIFFNESS * z + DAMPING * (each - rate * z)
        z = end + (z - end) * math.exp(-rate * DT)
    return s.Samples(t, force)


def rms_error(run: ql.Trajectory, since: float) -> float:
    """Return the RMS of y minus the ideal response to r, from ``since`` [s] on."""
    ideal = signal.lsim(([OMEGA_C**2], [1.0, 2.0 * OMEGA_C, OMEGA_C**2]), run["r"], run.t)[1]
    return float(np.sqrt(np.mean((run["y"] - ideal)[run.t >= since] ** 2)))


def compensation(trained: float, interpret: bool) -> dict[str, Any]:
    """Print the errors beside a known model of the friction, for each plant and reference."""
    observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=30.0, dt=DT)
    plants = {
        "LuGre": (ql.plants.NonlinearPlant(bristled, order=3, substeps=8), STATIC),
        "tanh": (ql.plants.NonlinearPlant(stage, order=2, substeps=4), SLIDING),
    }
    learned = ("none", "Kalman (linear)", "RLS, Polynomial + Friction")
    figures: dict[str, Any] = {}
    for kind, (plant, static) in plants.items():
        for name, reference in REFERENCES.items():
            fed = {
                "": 0.0,
                "LuGre": fed_forward(reference, 2.0 * trained, static, 1.0),
                "LuGre, 20 % off": fed_forward(reference, 2.0 * trained, static, 1.2),
            }
            table = Table("fed forward", *learned, title=f"Friction of {kind}, {name}")
            found: dict[str, Any] = {}
            for label, force in fed.items():
                noise = s.BandLimitedNoise(1e-12, 0.01)
                scenario = ql.Scenario(reference, 2.0 * trained, (force,), noise)
                found[label or "nothing"] = {
                    each.replace(" + ", " and "): rms_error(
                        ql.simulate(
                            plant, ql.ADRC(observer, omega_c=OMEGA_C, learner=LEARNERS[each]),
                            scenario, interpret=interpret,
                        ),
                        trained,
                    )
                    for each in learned
                }  # fmt: skip
            for label, errors in found.items():
                table.add_row(label, *(f"{error:.6f}" for error in errors.values()))
            Console().print(table)
            figures[f"{kind}, {name}"] = found
    return figures


def learners(trained: float, interpret: bool) -> dict[str, Any]:
    """Print a table for each reference."""
    figures: dict[str, Any] = {}
    plant = ql.plants.NonlinearPlant(stage, order=2, substeps=4)
    observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=30.0, dt=DT)
    for name, reference in REFERENCES.items():
        table = Table("learner", "RMS error", "to Kalman", "ns, with plant", title=name)
        scenario = ql.Scenario(reference, 2.0 * trained, noise=s.BandLimitedNoise(1e-12, 0.01))
        errors = {}
        for label, learner in LEARNERS.items():
            controller = ql.ADRC(observer, omega_c=OMEGA_C, learner=learner)
            if not interpret:
                ql.simulate(plant, controller, ql.Scenario(0.0, 1.0))
            start = time.perf_counter()
            run = ql.simulate(plant, controller, scenario, interpret=interpret)
            took = (time.perf_counter() - start) / run.t.size * 1e9
            errors[label] = (rms_error(run, trained), took)
        figures[name] = {
            label: {
                "RMS error": error,
                "over Kalman": error / errors["Kalman (linear)"][0],
                "ns, with plant": took,
            }
            for label, (error, took) in errors.items()
        }
        for label, (error, took) in errors.items():
            table.add_row(
                label, f"{error:.6f}", f"{error / errors['Kalman (linear)'][0]:.2f}", f"{took:.0f}"
            )
        Console().print(table)
    return figures


def main() -> None:
    """Run the parts."""
    parser = parser_of(__doc__)
    parser.add_argument("--part", choices=("learners", "compensation"), action="append")
    options = options_of(parser)
    # Python's plant is compiled anew in each process: a short run is quicker without.
    trained, interpret = (0.3, True) if options.quick else (TRAINED, False)
    figures: dict[str, Any] = {}
    if options.part is None or "learners" in options.part:
        figures |= learners(trained, interpret)
    if options.part is None or "compensation" in options.part:
        figures["compensation"] = compensation(trained, interpret)
    write(options, figures)


if __name__ == "__main__":
    main()
