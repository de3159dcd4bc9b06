"""Rows of a loop, for tests of telemetry and replay."""

from __future__ import annotations

from functools import cache

import numpy as np

import quell as ql
from quell.realtime.recordings import LOOP_CHANNELS, Header, row_channels
from quell.types import Matrix

DT = 0.01
OBSERVER = ql.ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=DT)
PLANT = ql.plants.LinearPlant([[0.0, 1.0], [-1.0, -0.6]], [0.0, 2.0], [1.0, 0.0])


def controller(**options: object) -> ql.ADRC:
    """Return an ADRC, by default with a guarded learner, which has all kinds of channels."""
    learns = {"learner": ql.learners.Kalman(), "guard": ql.Guard()}
    return ql.ADRC(OBSERVER, omega_c=3.0, **(learns | options))  # type: ignore[arg-type]


@cache
def simulated(duration: float = 5.0, **options: object) -> ql.Trajectory:
    """Return a simulated run of this controller under noise; the same one for all that ask."""
    noise = ql.signals.BandLimitedNoise(power=1e-9, sample_time=DT)
    scenario = ql.Scenario(reference=ql.signals.Sinusoid(omega=2.0), duration=duration, noise=noise)
    return ql.simulate(PLANT, controller(**options), scenario)


def rows_of(run: ql.Trajectory, design: ql.ADRC) -> Matrix:
    """Return the rows that a loop would have written of a run."""
    loop = {
        "k": np.arange(float(len(run))),
        "lateness": np.linspace(1e-7, 3e-4, len(run)),
        "step_time": np.full(len(run), 1.0 / 3.0e6),
        "mode": np.ones(len(run)),
        "events": np.zeros(len(run)),
    }
    names = [name for name, _ in (*LOOP_CHANNELS, *design.channels)]
    return np.column_stack([loop[name] if name in loop else run[name] for name in names])


def header_of(run: ql.Trajectory, design: ql.ADRC) -> Header:
    """Return the header that a loop would have written."""
    return Header(
        row_channels(design.channels),
        run.dt,
        design.features,
        device="a lift",
        controller="ADRC",
        units={"y": "m"},
    )
