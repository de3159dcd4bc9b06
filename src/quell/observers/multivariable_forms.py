"""Kernels of the observer with several outputs: gains from a table, or from a covariance.

``multivariable.py`` has the equations. A running state is (z, phase, innovations, …): the N
estimates (scaled, with a covariance), the number of the next sample in the period of all sensors,
and the p innovations of the last one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from quell.checks import LARGEST_SIGNAL
from quell.kernels.dispatch import compiled, compiled_call, generic, kernel
from quell.kernels.functions import is_single
from quell.kernels.sized import Flag, Size
from quell.types import Matrix, Vector

# ---- Kernels: running states (z, phase, innovations …), and what all kinds of gains share ----


@generic
def observe_signals(
    model: Any, z: Vector, estimate: Vector, y: Vector, u: Vector, d_known: Vector
) -> None:
    """Advance the running state ``z`` by a sample; write ``(x̂, d̂, d̂', …)`` into ``estimate``.

    ``u`` (m,) was applied, and ``d_known`` (q,) is the part of d that is known, over the sample
    that ends with the measurements ``y`` (p,). One that is not finite is missing.
    """
    raise TypeError


@generic
def begin_signals(model: Any, z: Vector, estimate: Vector) -> None:
    """Start with the estimates in ``estimate`` (N,); the next sample is the first of a period."""
    raise TypeError


@kernel
def predict_signals(
    model: Any, z: Vector, predicted: Vector, u: Vector, d_known: Vector
) -> None:  # fmt: skip
    """Write ``Φ z + Γ_u u + Γ_d d_known`` into ``predicted`` (N,)."""
    for i in range(predicted.size):
        total = 0.0
        for j in range(predicted.size):
            total += model.transition[i, j] * z[j]
        for j in range(d_known.size):
            total += model.feed[i, j] * d_known[j]
        for j in range(u.size):
            total += model.input[i, j] * u[j]
        predicted[i] = total


@kernel
def innovation(model: Any, z: Vector, j: int, y: Vector, u: Vector) -> float:
    """Return ``y_j − C_j z − D_j u``."""
    total = 0.0
    for i in range(model.output.shape[1]):
        total += model.output[j, i] * z[i]
    for i in range(u.size):
        total += model.direct[j, i] * u[i]
    return y[j] - total


# Larger numbers are no measurements; the one in single precision is that of the
# controllers, whose squares are finite.
_LARGEST_SINGLE = 1e12


@kernel
def is_measured(model: Any, phase: int, j: int, y: Vector) -> bool:
    """Return whether output j is due in this sample of the period, and has been measured."""
    largest = _LARGEST_SINGLE if is_single(y[j]) else LARGEST_SIGNAL
    return model.due[phase, j] > 0.0 and abs(y[j]) <= largest


@kernel
def phase_of(model: Any, value: float) -> int:
    """Return the sample of the period that a running state holds; 0 if it holds no such number."""
    return int(value) if 0.0 <= value < model.period else 0


@kernel
def next_phase(model: Any, phase: int) -> float:
    """Return the following sample of the period."""
    return 0.0 if phase + 1 >= model.period else phase + 1.0


class GainModel(NamedTuple):
    """Parameters of an observer whose gain follows from what is due and measured.

    With N states, p outputs and a period of K samples; running state (z, phase, innovations).
    """

    transition: Matrix  # Φ (N, N)
    input: Matrix  # Γ_u (N, m)
    feed: Matrix  # Γ_d (N, q)
    output: Matrix  # C (p, N)
    direct: Matrix  # D (p, m)
    due: Matrix  # (K, p), 1 where an output is measured in a sample of the period
    gains: Matrix  # (K 2^p, N p), a row for each sample of the period and set of measured outputs
    period: Size  # K
    predictor: Flag  # whether the estimate is z⁻ instead of z

    @property
    def states(self) -> int:
        """Length of the running state."""
        return int(self.transition.shape[0] + 1 + self.output.shape[0])


@observe_signals.register(GainModel)
def _observe(
    model: GainModel, z: Vector, estimate: Vector, y: Vector, u: Vector, d_known: Vector
) -> None:
    size, outputs = estimate.size, y.size
    phase = phase_of(model, z[size])
    predict_signals(model, z, estimate, u, d_known)
    measured, weight = 0, 1
    for j in range(outputs):
        error = 0.0
        if is_measured(model, phase, j, y):
            error = innovation(model, estimate, j, y, u)
            measured += weight
        z[size + 1 + j] = error
        weight *= 2
    row = phase * weight + measured
    for i in range(size):
        total = estimate[i]
        for j in range(outputs):
            total += model.gains[row, i * outputs + j] * z[size + 1 + j]
        z[i] = total
        if not model.predictor:
            estimate[i] = total
    z[size] = next_phase(model, phase)


@begin_signals.register(GainModel)
def _begin(model: GainModel, z: Vector, estimate: Vector) -> None:
    for i in range(z.size):
        z[i] = estimate[i] if i < estimate.size else 0.0


# The variances grow to this multiple of the usual ones while nothing is measured. Beyond it, the
# next correction would leave rounding errors of 1e-6 in place of a covariance. Chosen by hand.
_MOST_GROWTH = 1e10


class RiccatiModel(NamedTuple):
    """Parameters of a Kalman filter that calculates its covariance in each sample.

    In scaled coordinates, in which all entries are of similar size. Running state (z, phase,
    innovations, P row by row, work space (N,)).
    """

    transition: Matrix  # Φ (N, N)
    input: Matrix  # Γ_u (N, m)
    feed: Matrix  # Γ_d (N, q)
    output: Matrix  # C (p, N)
    direct: Matrix  # D (p, m)
    due: Matrix  # (K, p), 1 where an output is measured in a sample of the period
    noise: Vector  # variances of the outputs (p,)
    process: Matrix  # Q (N, N), covariance that a sample adds
    start: Matrix  # P (N, N) before the first sample of a period
    units: Vector  # (N,), estimates per unit of the scaled state
    period: Size  # K
    predictor: Flag  # whether the estimate is z⁻ instead of z

    @property
    def states(self) -> int:
        """Length of the running state."""
        size = self.units.size
        return int(size + 1 + self.output.shape[0] + size * size + size)


@kernel
def predict_covariance(model: Any, z: Vector, at: int, work: int) -> None:
    """Replace P, from entry ``at`` of ``z``, by ``Φ P Φᵀ + Q``, of limited size."""
    size = model.units.size
    for j in range(size):
        for i in range(size):
            total = 0.0
            for k in range(size):
                total += model.transition[i, k] * z[at + k * size + j]
            z[work + i] = total
        for i in range(size):
            z[at + i * size + j] = z[work + i]
    growth = 1.0
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += z[at + i * size + k] * model.transition[j, k]
            z[work + j] = total + model.process[i, j]
        for j in range(size):
            z[at + i * size + j] = z[work + j]
        growth = max(growth, z[at + i * size + i] / (_MOST_GROWTH * model.start[i, i]))
    for i in range(size):
        for j in range(i + 1):
            mean = 0.5 * (z[at + i * size + j] + z[at + j * size + i]) / growth
            z[at + i * size + j] = mean
            z[at + j * size + i] = mean


@observe_signals.register(RiccatiModel)
def _observe_with_covariance(
    model: RiccatiModel, z: Vector, estimate: Vector, y: Vector, u: Vector, d_known: Vector
) -> None:
    size, outputs = estimate.size, y.size
    at, work = size + 1 + outputs, size + 1 + outputs + size * size
    phase = phase_of(model, z[size])
    predict_signals(model, z, estimate, u, d_known)
    for i in range(size):
        z[i] = estimate[i]
    predict_covariance(model, z, at, work)
    for j in range(outputs):
        z[size + 1 + j] = 0.0
        if is_measured(model, phase, j, y):
            z[size + 1 + j] = innovation(model, estimate, j, y, u)
    # One output after the other: their noises are independent, and nothing has to be inverted.
    for j in range(outputs):
        if is_measured(model, phase, j, y):
            variance = model.noise[j]
            for i in range(size):
                total = 0.0
                for k in range(size):
                    total += z[at + i * size + k] * model.output[j, k]
                z[work + i] = total
                variance += model.output[j, i] * total
            error = innovation(model, z, j, y, u) / variance
            for i in range(size):
                z[i] += z[work + i] * error
                for k in range(size):
                    z[at + i * size + k] -= z[work + i] * z[work + k] / variance
    for i in range(size):
        estimate[i] = model.units[i] * (estimate[i] if model.predictor else z[i])
    z[size] = next_phase(model, phase)


@begin_signals.register(RiccatiModel)
def _begin_with_covariance(model: RiccatiModel, z: Vector, estimate: Vector) -> None:
    size = estimate.size
    at = size + 1 + model.output.shape[0]
    for i in range(z.size):
        z[i] = estimate[i] / model.units[i] if i < size else 0.0
    for i in range(size):
        for j in range(size):
            z[at + i * size + j] = model.start[i, j]


@compiled_call
def observe_sample(
    model: Any, z: Vector, estimate: Vector, y: Vector, u: Vector, d_known: Vector
) -> None:
    """Take one sample; see ``observe_signals``."""
    observe_signals(model, z, estimate, y, u, d_known)


@compiled
def observe_record(
    model: Any, z: Vector, estimate: Vector, y: Matrix, u: Matrix, d_known: Matrix, found: Matrix
) -> None:
    """Take the samples of a record, one in each row; write the estimates into ``found``."""
    for k in range(y.shape[0]):
        observe_signals(model, z, estimate, y[k], u[k], d_known[k])
        for i in range(estimate.size):
            found[k, i] = estimate[i]
