"""A plant as the controller sees it: sampled with zero-order hold, with dead time and actuator lag if there are any.

Matrices are kept as ``A − I``: a double integrator sampled at 1 ms differs from the unit matrix in the sixth digit, and all that is slow
is in that difference.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.observers.discretize import zero_order_hold
from quell.types import Matrix, Vector

# A dead time of more samples makes matrices too large to be quick.
_MOST_SAMPLES = 200


class SampledPlant(NamedTuple):
    """``x⁺ − x = N x + B u + E w``, ``y = C x``."""

    N: Matrix
    """A − I (n, n)."""
    B: Vector
    """(n,)."""
    E: Matrix
    """(n, m)."""
    C: Vector
    """(n,)."""
    b: dict[int, float]
    """What u adds to y^(k), by k, where that is the first derivative it reaches."""


def sampled_plant(plant: Any, dt: float, delay: float = 0.0, actuator_lag: float = 0.0) -> SampledPlant:
    """Sample a linear plant exactly.

    Parameters
    ----------
    plant
        a ``LinearPlant``, ``control.StateSpace``, ``control.TransferFunction``, or ``(num, den)`` in powers of s; one of python-control
        may be sampled already, with the same dt.
    dt
        sample time [s].
    delay
        dead time before u gets to the plant [s]; any fraction of a sample.
    actuator_lag
        time constant of a first-order lag between u and the plant [s].

    Raises
    ------
    ValueError
        for what is no such plant, for one that answers to u at once, or for a dead time of more than 200 samples.
    """
    delay = checks.non_negative("delay", delay, "s")
    actuator_lag = checks.non_negative("actuator_lag", actuator_lag, "s")
    A, B, C, E, is_sampled = _state_space(plant, dt)
    if is_sampled:
        if actuator_lag > 0.0 or not math.isclose(delay / dt, round(delay / dt), abs_tol=1e-9):
            raise ValueError(
                f"delay = {delay!r} s, actuator_lag = {actuator_lag!r} s: a sampled plant takes whole samples of delay and no lag; "
                "give it in continuous time"
            )
        return _delayed(A - np.eye(A.shape[0]), B, np.zeros_like(B), C, E, round(delay / dt), {})
    gains = _first_gain(A, B, C)
    if actuator_lag > 0.0:
        n = A.shape[0]
        A = np.block([[A, B], [np.zeros((1, n)), np.full((1, 1), -1.0 / actuator_lag)]])
        B, C, E = np.vstack([np.zeros_like(B), [[1.0 / actuator_lag]]]), np.append(C, 0.0), np.vstack([E, np.zeros((1, E.shape[1]))])
    if delay > _MOST_SAMPLES * dt:
        raise ValueError(f"delay = {delay!r} s: must be at most {_MOST_SAMPLES} samples of dt = {dt!r} s")
    samples = math.floor(delay / dt * (1.0 + 1e-12))
    late = max(delay - samples * dt, 0.0)
    if late < 1e-12 * dt:
        late = 0.0
    identity = np.eye(A.shape[0])
    _, (whole, gamma_w) = zero_order_hold(A, [identity, E], dt)
    # Of a held u the first part of a sample is still the one before.
    _, (rest,) = zero_order_hold(A, [identity], dt - late)
    before = (whole - rest) @ B
    return _delayed(A @ whole, rest @ B, before, C, gamma_w, samples, gains)


def _delayed(N: Matrix, now: Matrix, before: Matrix, C: Vector, E: Matrix, samples: int, gains: dict[int, float]) -> SampledPlant:
    """Append the control signals that have not arrived yet as states, the newest last."""
    waiting = samples + bool(np.any(before))
    n = N.shape[0]
    size = n + waiting
    big, B = np.zeros((size, size)), np.zeros(size)
    big[:n, :n] = N
    for i in range(waiting):
        big[n + i, n + i] = -1.0
        if i + 1 < waiting:
            big[n + i, n + i + 1] = 1.0
    if waiting:
        B[-1] = 1.0
    if waiting > samples:
        big[:n, n] = before[:, 0]
        if samples:
            big[:n, n + 1] = now[:, 0]
        else:
            B[:n] = now[:, 0]
    elif waiting:
        big[:n, n] = now[:, 0]
    else:
        B[:n] = now[:, 0]
    pad = np.zeros((waiting, E.shape[1]))
    return SampledPlant(big, B, np.vstack([E, pad]), np.append(C, np.zeros(waiting)), gains)


def _first_gain(A: Matrix, B: Matrix, C: Vector) -> dict[int, float]:
    """Return ``{k: C A^(k−1) B}`` for the first that is not zero."""
    row = C.copy()
    for k in range(1, A.shape[0] + 1):
        gain, bound = float(row @ B[:, 0]), float(np.abs(row) @ np.abs(B[:, 0]))
        if abs(gain) > 1e-12 * bound:
            return {k: gain}
        row = row @ A
    return {}


def _state_space(plant: Any, dt: float) -> tuple[Matrix, Matrix, Vector, Matrix, bool]:
    """Return A, B (n, 1), C (n,), E (n, m), and whether they are sampled already."""
    if isinstance(plant, tuple) and len(plant) == 2:
        return *_companion(checks.vector("num", plant[0]), checks.vector("den", plant[1])), False
    is_sampled = bool(getattr(plant, "dt", None))
    if is_sampled and (plant.dt is True or not math.isclose(plant.dt, dt, rel_tol=1e-9)):
        raise ValueError(
            f"plant has a sample time of {plant.dt!r}: must be in continuous time, or sampled at the controller's dt = {dt!r} s"
        )
    if hasattr(plant, "num") and hasattr(plant, "den"):
        if np.shape(plant.num)[:2] != (1, 1):
            raise ValueError(f"plant has {np.shape(plant.num)[:2]} outputs and inputs: must have one of each")
        return *_companion(np.asarray(plant.num[0][0], float), np.asarray(plant.den[0][0], float)), is_sampled
    if not all(hasattr(plant, name) for name in "ABC"):
        raise ValueError(
            f"plant = {plant!r}: must be linear: a LinearPlant, a control.StateSpace or TransferFunction, or (num, den); "
            "a nonlinear one has to be linearised first"
        )
    A = checks.matrix("A", plant.A)
    n = A.shape[0]
    A, B, C = checks.matrix("A", A, n, n), checks.matrix("B", plant.B, n, 1), checks.matrix("C", plant.C, 1, n)
    if np.any(np.asarray(getattr(plant, "D", 0.0)) != 0.0):
        raise ValueError(f"D = {np.asarray(plant.D).tolist()}: must be zero, the output may not follow the input at once")
    E = checks.matrix("E", plant.E, n) if hasattr(plant, "E") else B
    return A, B, C[0].copy(), E, is_sampled


def _companion(num: Vector, den: Vector) -> tuple[Matrix, Matrix, Vector, Matrix]:
    """Return a chain of states with the last row ``−den``; what disturbs enters as u does."""
    num, den = np.trim_zeros(num, "f"), np.trim_zeros(den, "f")
    if not 0 < num.size < den.size:
        raise ValueError(
            f"num = {num.tolist()}, den = {den.tolist()}: must be polynomials, num of lower degree than den and neither zero, "
            "or the output follows the input at once"
        )
    n = den.size - 1
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = -den[:0:-1] / den[0]
    B, C = np.zeros((n, 1)), np.zeros(n)
    B[-1, 0] = 1.0
    C[: num.size] = num[::-1] / den[0]
    return A, B, C, B
