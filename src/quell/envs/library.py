"""The environments ``quell/…-v0``: the library's plants with scenarios that are drawn.

Each name with ``-residual`` has an ADRC with ``Policy`` and ``Guard`` around the plant of the name
without it. All other arguments of ``Env`` can be given, also in place of these here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from quell import plants
from quell.controllers.adrc.adrc import ADRC
from quell.envs.policy import Policy
from quell.guard import Guard
from quell.observers.eso import ESO
from quell.signals import BandLimitedNoise, Sinusoid, Step
from quell.simulation.scenario import Scenario

# Bandwidths and b0 of the loops are those of the library's studies: two masses and the torsional
# testbed of the paper (experiments/), the motor of benchmarks/cogging.py.


def two_mass_scenario(rng: np.random.Generator) -> Scenario:
    """Draw 20 s: a step of r of up to 1 m, a sinusoidal force on m2 of up to 0.3 N, noise."""
    force = Sinusoid(
        amplitude=float(rng.uniform(0.0, 0.3)),
        omega=float(rng.uniform(0.2, 0.6)),
        start=float(rng.uniform(0.0, 5.0)),
    )
    return Scenario(
        reference=Step(height=float(rng.uniform(-1.0, 1.0))),
        disturbances=(0.0, force),
        noise=BandLimitedNoise(power=1e-12, sample_time=0.01),
        duration=20.0,
        seed=int(rng.integers(2**31)),
    )


def dc_motor_scenario(rng: np.random.Generator) -> Scenario:
    """Draw 2 s: a step of r of up to a turn, from 1 s on a load torque of up to 0.02 N m."""
    return Scenario(
        reference=Step(height=float(rng.uniform(-math.tau, math.tau))),
        disturbances=(Step(height=float(rng.uniform(-0.02, 0.02)), at=1.0),),
        duration=2.0,
    )


def torsional_scenario(rng: np.random.Generator) -> Scenario:
    """Draw 4 s: a sinusoid of r of up to π/2 rad, and a quarter to half a turn a second."""
    reference = Sinusoid(
        amplitude=float(rng.uniform(0.0, 0.5 * math.pi)),
        omega=float(rng.uniform(0.5 * math.pi, math.pi)),
    )
    return Scenario(reference, duration=4.0)


def _loop(name: str) -> dict[str, Any]:
    """Return the arguments of ``Env`` for the action u."""
    if name == "two-mass":
        loop = {"plant": plants.two_mass_spring(), "scenario": two_mass_scenario, "dt": 0.01}
        return loop | {"u_min": -8.0, "u_max": 8.0, "limit": 10.0}
    if name == "dc-motor":
        loop = {"plant": plants.dc_motor(), "scenario": dc_motor_scenario, "dt": 1e-3}
        limits = {"u_min": -24.0, "u_max": 24.0, "limit": 20.0, "x_limit": (20.0, 600.0)}
        return loop | limits | {"action_repeat": 5}
    plant = plants.torsional()
    loop = {"plant": plant, "scenario": torsional_scenario, "dt": 1e-3}
    return loop | {"u_min": -plant.u_max, "u_max": plant.u_max, "limit": 20.0, "action_repeat": 5}


def _residual_loop(name: str) -> dict[str, Any]:
    """Return the arguments of ``Env`` for the action f."""
    loop = _loop(name)
    dt, u_min, u_max = loop.pop("dt"), loop.pop("u_min"), loop.pop("u_max")
    order, b0, omega_o, omega_c, most = {
        "two-mass": (4, 1.0, 10.0, 1.0, 2.0),
        "dc-motor": (2, 500.0, 200.0, 40.0, None),
        "torsional": (4, 5.5e4, 90.0, 20.0, None),
    }[name]
    controller = ADRC(
        ESO.model_free(order=order, b0=b0, omega_o=omega_o, dt=dt),
        omega_c=omega_c,
        learner=Policy(most),
        guard=Guard(),
        u_min=u_min,
        u_max=u_max,
    )
    return loop | {"controller": controller}


def arguments(name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of the environment ``name``, with those that are given instead."""
    plain = name.removesuffix("-residual")
    loop = _loop(plain) if plain == name else _residual_loop(plain)
    return loop | dict(given)


def make(name: str, **given: Any) -> Any:
    """Return the environment ``name`` of ``registration.NAMES``."""
    from quell.envs.env import Env

    return Env(**arguments(name, given))


def make_vector(name: str, num_envs: int, **given: Any) -> Any:
    """Return the same as a ``VectorEnv``."""
    from quell.envs.vector import VectorEnv

    return VectorEnv(num_envs, **arguments(name, given))
