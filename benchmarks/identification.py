"""Accuracy and time of the identification of the torsional twin, with and without a friction model.

    python benchmarks/identification.py [--quick] [--json FILE]

60 s at 1 kHz in open and closed loop, with the friction, converter and encoder of the twin. The
slow pole and the resonance are compared with those of its linear part. Times are the best of
several, with compiled kernels, for the whole of ``identify`` (search and validation): elapsed time
and processor time, which are equal on an idle machine.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from measured import options_of, parser_of, write

import quell as ql
from quell.identification import Identified, excitation, excited

DT = 1e-3
TWIN = ql.plants.torsional()


def closed_loop(reference: Any, seconds: float) -> tuple[Any, Any]:
    """Return u and y of the twin in a loop with a model-free ADRC."""
    observer = ql.ESO.model_free(order=4, b0=5.5e4, omega_o=90.0, dt=DT)
    controller = ql.ADRC(observer, omega_c=20.0, u_min=-5.0, u_max=5.0)
    run = ql.simulate(TWIN, controller, ql.Scenario(reference=reference, duration=seconds))
    return run["u"], run["y_measured"]


def records(seconds: float, only: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield name, u and y of the records whose name contains ``only``."""
    for name, kind, band, low, high in (
        ("PRBS to 20 rad/s, ±2 V", "prbs", (0.2, 20.0), -2.0, 2.0),
        ("PRBS to 60 rad/s, ±2 V", "prbs", (0.2, 60.0), -2.0, 2.0),
        ("PRBS to 60 rad/s, ±5 V", "prbs", (0.2, 60.0), -5.0, 5.0),
        ("multisine to 60 rad/s, ±2 V", "multisine", (0.3, 60.0), -2.0, 2.0),
        ("one way: PRBS to 60 rad/s, 0.5 to 2.5 V", "prbs", (0.3, 60.0), 0.5, 2.5),
    ):
        if only in name:
            record = excited(TWIN, excitation(kind, band, seconds, DT, low, high))
            yield name, record.u, record.y
    multisine = excitation("multisine", (0.3, 40.0), seconds, DT, -3.0, 3.0)
    prbs = excitation("prbs", (0.3, 10.0), seconds, DT, -np.pi / 2, np.pi / 2)
    for name, reference in (
        ("closed loop: multisine to 40 rad/s, ±3 rad", multisine.signal),
        ("closed loop: PRBS to 10 rad/s, ±π/2", prbs.signal),
        ("closed loop: (π/2) sin(π t/2)", ql.signals.Sinusoid(0.5 * np.pi, 0.5 * np.pi)),
    ):
        if only in name:
            yield name, *closed_loop(reference, seconds)


def judged(found: Identified) -> dict[str, float]:
    """Return the errors of the poles [%], and the fits [%]."""
    truth = np.linalg.eigvals(TWIN.linear.A)
    slow = min((p for p in truth if abs(p) > 1e-6), key=abs)
    resonance = max(truth, key=lambda p: p.imag)
    poles = np.array([root.value for root in found.poles])
    near = poles[np.argmin(np.abs(poles - resonance))]
    return {
        "slow": 100.0 * abs(poles[np.argmin(np.abs(poles - slow))] - slow) / abs(slow),
        "resonance": 100.0 * abs(near - resonance) / abs(resonance),
        "damping": 100.0 * abs(near.real / resonance.real - 1.0),
        "integrators": found.integrators,
        "held out": found.fits["held out"],
        "estimation": found.fits["estimation"],
    }


def main() -> None:
    """Run all cases and print one table."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of a record")
    parser.add_argument("--only", default="", help="records whose name contains this")
    parser.add_argument("--trials", type=int, default=3, help="whose best time is printed")
    options = options_of(parser, seconds=10.0, only="PRBS to 10 rad/s", trials=1)
    figures: dict[str, Any] = {}
    print(
        f"{'record':44} friction  time [s]  CPU [s]  slow [%]  resonance [%]  its damping [%] "
        f" held out [%]"
    )
    for name, u, y in records(options.seconds, options.only):
        for friction in (True, False):
            taken, used = [], []
            for _ in range(options.trials + 1):
                began, before = time.perf_counter(), time.process_time()
                found = ql.identify(u, y, DT, friction=friction)
                taken.append(time.perf_counter() - began)
                used.append(time.process_time() - before)
            row = {
                "seconds": min(taken[1:]),
                "cpu": min(used[1:]),
                **judged(found),
            }
            figures.setdefault(name, {})["with friction" if friction else "without"] = row
            print(
                f"{name:44} {'yes' if friction else 'no':8} {row['seconds']:9.2f} "
                f"{row['cpu']:8.2f} "
                f"{row['slow']:9.3f} {row['resonance']:14.3f} "
                f"{row['damping']:16.2f} {row['held out']:13.3f}",
                flush=True,
            )
    write(options, figures)


if __name__ == "__main__":
    main()
