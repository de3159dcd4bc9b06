"""Friction features where a plant sticks: twins of EMPS and of the torsional testbed.

    python benchmarks/stiction.py [--twin TWIN]

EMPS is a prismatic robot joint whose dry friction dominates (Janot, Gautier & Brunot, *Data set and
reference models of EMPS*, 2019): pole −2.14 rad/s, gain 0.370 (m/s²)/V, Coulomb friction 0.58 V,
limit 10 V; dt = 1 ms, omega_c = 20, omega_o = 100 rad/s, encoder of 1 µm. The torsional testbed is
``plants.torsional`` with omega_c = 20, omega_o = 90 rad/s. Both stand still for part of the time in
all references but the faster sinusoid: a standing plant's friction is not a function of the state,
so no feature predicts it, and a learner can cause the error that it then explains.

RMS error of the second half of 80 s over that of MF-ESO (in µm or µrad), without and with guard.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.features import Bias, Friction, State
from quell.learners import RLS, Kalman

SECONDS = 80.0
s = ql.signals


def moves(distance: float, seconds: float) -> ql.signals.Signal:
    """Return moves to and fro of 2 s with rests of 2 s."""
    first: ql.signals.Signal = s.SmoothMove(distance=distance, duration=2.0)
    for k in range(1, round(seconds / 4.0)):
        first = first + s.SmoothMove(distance=(-1) ** k * distance, duration=2.0, start=4.0 * k)
    return first


def references(size: float, seconds: float = SECONDS) -> dict[str, ql.signals.Signal]:
    """Return the references of a ``size`` [y-unit]."""
    return {
        "sinusoid, 1.5 rad/s": size * s.Sinusoid(omega=1.5),
        "sinusoid, 0.2 rad/s": size * s.Sinusoid(omega=0.2),
        "moves and rests": moves(2.0 * size, seconds),
        "a move, then rest": s.SmoothMove(distance=size, duration=2.0),
    }


def emps() -> Any:
    """Return EMPS as a motor whose angle [rad] is the position [m], R = 1 ohm and J = 1."""
    gain, pole, dry = 0.370, 2.14, 0.58
    return ql.plants.dc_motor(
        resistance=1.0,
        torque_constant=gain,
        inertia=1.0,
        viscous=pole - gain**2,
        coulomb=gain * dry,
        counts=round(math.tau / 1e-6),
        voltage_limit=10.0,
    )


# Plant, order, b0, omega_c, omega_o [rad/s], limit of u, size of the references, speed over which
# the friction features reverse [y-unit/s].
TWINS: dict[str, Any] = {
    "EMPS": (emps, 2, 0.370, 20.0, 100.0, 10.0, 0.1, 5e-3),
    "torsional": (ql.plants.torsional, 4, 4.6e4, 20.0, 90.0, 5.0, 1.0, 0.05),
}


def learners(speed: float) -> dict[str, Any]:
    """Return the learners by name; ``speed`` is that of the friction features."""
    smooth = State() + Friction(speed=speed) + Bias()
    abrupt = State() + Friction(speed=speed, sign=True) + Bias()
    return {
        "none": None,
        "Kalman": Kalman(),
        "RLS": RLS(),
        "RLS, tanh": RLS(smooth),
        "RLS, tanh and sign": RLS(abrupt),
        "RLS, tanh, bias_bandwidth=0": RLS(smooth, bias_bandwidth=0.0),
        "RLS, tanh and sign, bias_bandwidth=0": RLS(abrupt, bias_bandwidth=0.0),
    }


def error(
    twin: str, learner: Any, guard: Any, reference: Any, held: Any = None, seconds: float = SECONDS
) -> float:
    """Return the RMS error in the second half of a run [y-unit]; infinite if it diverges."""
    plant, order, b0, omega_c, omega_o, most, _, _ = TWINS[twin]
    controller = ql.ADRC(
        ql.ESO.model_free(order=order, b0=b0, omega_o=omega_o, dt=1e-3),
        omega_c=omega_c,
        learner=learner,
        guard=guard,
        feedforward=True,
        u_min=-most,
        u_max=most,
        held=held,
    )
    run = ql.simulate(plant(), controller, ql.Scenario(reference, seconds))
    if run.diverged:
        return math.inf
    half = run.t >= 0.5 * seconds
    return float(np.sqrt(np.mean((run["r"] - run["y"])[half] ** 2)))


def main() -> None:
    """Print a table for each twin."""
    parser = parser_of(__doc__)
    parser.add_argument("--twin", choices=[*TWINS], help="this twin alone")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="duration of a run")
    parser.add_argument("--learners", nargs="+", choices=[*learners(1.0)], help="none and these")
    options = options_of(parser, seconds=8.0, twin="EMPS", learners=["RLS, tanh"])
    figures: dict[str, Any] = {}
    for twin in [options.twin] if options.twin else TWINS:
        *_, size, speed = TWINS[twin]
        cases = references(size, options.seconds)
        table = Table("learner", *cases, title=f"{twin}: without guard, with guard")
        plain: dict[str, float] = {}
        for label, learner in learners(speed).items():
            if label not in ("none", *(options.learners or learners(speed))):
                continue
            guards = (None, ql.Guard()) if learner is not None else (None,)
            rows = [
                {n: error(twin, learner, g, r, seconds=options.seconds) for n, r in cases.items()}
                for g in guards
            ]
            plain = plain or rows[0]
            if learner is None:
                cells = [f"{1e6 * value:.1f}" for value in plain.values()]
            else:
                cells = [", ".join(f"{row[n] / plain[n]:.3f}" for row in rows) for n in cases]
            table.add_row(label, *cells)
            for n in cases:
                mine: dict[str, float] = {"rms [um]": 1e6 * rows[0][n]}
                if learner is not None:
                    mine = {"without guard": rows[0][n] / plain[n]}
                    mine["with guard"] = rows[1][n] / plain[n]
                figures[f"{twin}, {n}: {label}"] = {
                    key: value if math.isfinite(value) else "diverged"
                    for key, value in mine.items()
                }
        Console(width=130).print(table)
    write(options, figures)


if __name__ == "__main__":
    main()
