"""The environments ``quell/…-v0``: the library's plants with scenarios that are drawn.

Each name with ``-residual`` has an ADRC for each axis, with ``Policy`` and ``Guard``, around the
plant of the name without it. All other arguments of ``Env`` can be given, also in place of these.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from quell import plants
from quell.controllers.adrc import ADRC
from quell.controllers.axes import Axes
from quell.envs.actions import Policy
from quell.envs.env import Env, VectorEnv
from quell.guard import Guard
from quell.observers.eso import ESO
from quell.signals import BandLimitedNoise, Constant, Sinusoid, Step, Sum
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


def arm_scenario(rng: np.random.Generator) -> Scenario:
    """Draw 4 s from rest: a sinusoid of up to 0.6 rad for each joint, about a posture."""
    posture = rng.uniform((-math.pi, -2.0), (math.pi, 2.0))
    amplitudes, omegas = rng.uniform(0.0, 0.6, 2), rng.uniform(1.5, 5.0, 2)
    references = [
        Sum((Constant(float(angle)), Sinusoid(float(amplitude), float(omega))))
        for angle, amplitude, omega in zip(posture, amplitudes, omegas, strict=True)
    ]
    return Scenario(references, duration=4.0, x0=[*posture, 0.0, 0.0])


def _axes_of_arm(dt: float, u_min: tuple[float, ...], u_max: tuple[float, ...]) -> Axes:
    """Return an ADRC for each joint; the links of their model are 20 % too heavy and too light."""
    joints = {
        name: ADRC(
            ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=dt),
            omega_c=8.0,
            feedforward=True,
            learner=Policy(most),
            guard=Guard(),
        )
        # In 8 scenarios |f_hat| was up to 34 and 79 rad/s².
        for name, most in (("shoulder", 50.0), ("elbow", 100.0))
    }
    model = plants.arm(masses=(2.4, 0.8)).inertia
    return Axes(joints, M=model, u_min=u_min, u_max=u_max, saturation="direction")


def _loop(name: str) -> dict[str, Any]:
    """Return the arguments of ``Env`` for the action u."""
    if name == "two-mass":
        loop = {"plant": plants.two_mass_spring(), "scenario": two_mass_scenario, "dt": 0.01}
        return loop | {"u_min": -8.0, "u_max": 8.0, "limit": 10.0}
    if name == "dc-motor":
        loop = {"plant": plants.dc_motor(), "scenario": dc_motor_scenario, "dt": 1e-3}
        limits = {"u_min": -24.0, "u_max": 24.0, "limit": 20.0, "x_limit": (20.0, 600.0)}
        return loop | limits | {"action_repeat": 5}
    if name == "arm":
        loop = {"plant": plants.arm(viscous=0.1), "scenario": arm_scenario, "dt": 2e-3}
        limits = {"u_min": (-30.0, -6.0), "u_max": (30.0, 6.0), "limit": 20.0}
        return loop | limits | {"x_limit": (20.0, 20.0, 100.0, 100.0), "action_repeat": 5}
    plant = plants.torsional()
    loop = {"plant": plant, "scenario": torsional_scenario, "dt": 1e-3}
    return loop | {"u_min": -plant.u_max, "u_max": plant.u_max, "limit": 20.0, "action_repeat": 5}


def _residual_loop(name: str) -> dict[str, Any]:
    """Return the arguments of ``Env`` for the action f."""
    loop = _loop(name)
    dt, u_min, u_max = loop.pop("dt"), loop.pop("u_min"), loop.pop("u_max")
    if name == "arm":
        return loop | {"controller": _axes_of_arm(dt, u_min, u_max)}
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
    """Return the environment ``name`` of ``quell.envs.NAMES``."""
    return Env(**arguments(name, given))


def make_vector(name: str, num_envs: int, **given: Any) -> Any:
    """Return the same as a ``VectorEnv``."""
    return VectorEnv(num_envs, **arguments(name, given))
