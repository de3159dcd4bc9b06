"""The plant as the controller sees it: zero-order hold, dead time and actuator lag included.

Matrices are kept as ``A − I``: a double integrator sampled at 1 ms differs from the unit matrix in
the sixth digit, and all slow dynamics are in that difference.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.lti.discretize import zero_order_hold
from quell.lti.models import TransferFunction, leading_gain, read_model, to_state_space
from quell.plants.linear import LinearPlant
from quell.types import Matrix, Vector

# Limit on the states that a dead time adds; eigenvalues cost its cube. Chosen by hand.
_MOST_SAMPLES = 200


class SampledPlant(NamedTuple):
    """``x⁺ − x = N x + B u + E w``, ``y = C x``."""

    N: Matrix  # A − I (n, n)
    B: Vector  # (n,)
    E: Matrix  # (n, m)
    C: Vector  # (n,)
    b: dict[int, float]  # gain from u to y^(k), by k, for the first derivative that u reaches


def sampled_plant(
    plant: Any, dt: float, delay: float = 0.0, actuator_lag: float = 0.0
) -> SampledPlant:
    """Sample a linear plant exactly; see ``analyse`` for the parameters.

    A system of python-control or scipy.signal may be sampled already, with the same dt. Raises
    ``ValueError`` for another object, direct feedthrough, or a dead time of more than 200 samples.
    """
    delay = checks.non_negative("delay", delay, "s")
    actuator_lag = checks.non_negative("actuator_lag", actuator_lag, "s")
    if getattr(plant, "dt", None):
        if actuator_lag > 0.0 or not math.isclose(delay / dt, round(delay / dt), abs_tol=1e-9):
            raise ValueError(
                f"delay = {delay!r} s, actuator_lag = {actuator_lag!r} s: a sampled plant takes "
                "whole samples of delay and no lag; give it in continuous time"
            )
        model = read_model(plant, dt=dt)
        model = to_state_space(model) if isinstance(model, TransferFunction) else model
        N, B = model.A - np.eye(model.C.size), model.B[:, None]
        return _delayed(N, B, np.zeros_like(B), model.C, B, round(delay / dt), {})
    linear = LinearPlant.of(plant)
    A, B, C, E = linear.A, linear.B, linear.C[0], linear.E
    first = leading_gain(A, B, linear.C)
    gains = {} if first is None else {first[1]: first[0]}
    if actuator_lag > 0.0:
        n = A.shape[0]
        A = np.block([[A, B], [np.zeros((1, n)), np.full((1, 1), -1.0 / actuator_lag)]])
        B = np.vstack([np.zeros_like(B), [[1.0 / actuator_lag]]])
        C, E = np.append(C, 0.0), np.vstack([E, np.zeros((1, E.shape[1]))])
    if delay > _MOST_SAMPLES * dt:
        limit = f"{_MOST_SAMPLES} samples of {dt!r} s"
        raise ValueError(f"delay = {delay!r} s: must be at most {limit}")
    samples = math.floor(delay / dt * (1.0 + 1e-12))
    late = max(delay - samples * dt, 0.0)
    if late < 1e-12 * dt:  # a whole number of samples, to rounding
        late = 0.0
    identity = np.eye(A.shape[0])
    _, (whole, gamma_w) = zero_order_hold(A, [identity, E], dt)
    # The first part of each sample still sees the control signal before.
    _, (rest,) = zero_order_hold(A, [identity], dt - late)
    before = (whole - rest) @ B
    return _delayed(A @ whole, rest @ B, before, C, gamma_w, samples, gains)


def _delayed(
    N: Matrix, now: Matrix, before: Matrix, C: Vector, E: Matrix, samples: int, b: dict[int, float]
) -> SampledPlant:
    """Append the control signals that have not arrived yet as states, the newest last."""
    n, waiting = N.shape[0], samples + bool(np.any(before))
    A, B = np.zeros((n + waiting, n + waiting)), np.zeros(n + waiting)
    A[:n, :n] = N
    for i in range(waiting):
        A[n + i, n + i] = -1.0
        if i + 1 < waiting:
            A[n + i, n + i + 1] = 1.0
    if waiting:
        B[-1] = 1.0
    if waiting > samples:
        A[:n, n] = before[:, 0]
    # The state from which ``now`` arrives; without one, u itself.
    at = n + waiting - samples
    if samples:
        A[:n, at] = now[:, 0]
    else:
        B[:n] = now[:, 0]
    E = np.vstack([E, np.zeros((waiting, E.shape[1]))])
    return SampledPlant(A, B, E, np.append(C, np.zeros(waiting)), b)
