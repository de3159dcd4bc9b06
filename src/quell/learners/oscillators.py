"""Oscillators whose frequency is adapted while their amplitudes are learned.

An oscillator advances its own phase, ``ψ' = ω̂``, and has a pair of features (sin kψ, cos kψ) for
each of its orders k, by default 1 alone. For a load ``A sin(ωt + φ)`` the learned pair θ = (θ_s,
θ_c) is a vector of length A, which rotates at ω − ω̂. So each update δθ of the pair corrects the
frequency by the angle of its rotation:

    ω̂ ← ω̂ + κ ω̂ (θ_s δθ_c − θ_c δθ_s) / (|θ|² + c E[ε² + (0.1 f̂)²])

With several orders the pairs turn at k (ω − ω̂), and the angle is that of the least squares, with
``Σ k (…)`` in the numerator and ``Σ k² |θ_k|²`` in the denominator.

Two properties make it lock quickly and remain locked. The gain is relative to ω̂, because an
oscillator learns at a rate proportional to its frequency (``pair_bandwidth`` in
``learners/kalman.py``); so the loop of phase and frequency is equally damped at all frequencies.
And the unexplained part ε reduces the correction: when a load comes on, θ turns from an arbitrary
direction that noise has left, which carries no information on the frequency.

Least-squares fit of sinusoids of unknown frequency to past samples, a few samples at a time.

In a *pass* over the samples z at the times t = 0, −1, … of a window, the model

    z = c + Σ_i w_i r_i + Σ_j Σ_k a_jk sin(k ω_j t) + b_jk cos(k ω_j t)

with q given signals r, m frequencies ω and p orders k each is linearised in ω, and its normal
equations are added up:

    z = c + Σ w_i r_i + Σ (a s + b c)_jk + Σ_j δω_j t Σ_k k (a_jk c_jk − b_jk s_jk)

with s_jk = sin(k ω_j t) and c_jk = cos(k ω_j t). At the end of the pass c, w, a, b and δω are
solved for: a step of Gauss and Newton for the least squares over all parameters, which for white
noise is the most likely answer (Rife & Boorstyn, *Multiple tone parameter estimation from
discrete-time observations*, Bell System Technical Journal 55 (1976)). The given signals have a
ridge μ: what is minimised is

    Σ (z − model)² + μ Σ_i w_i² Σ (r_i − mean of r_i)²

so that where signals and sinusoids explain z equally well, the sinusoids do. In passes of few
samples the work for a sample of the loop is small and constant.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell.kernels.dispatch import kernel
from quell.kernels.functions import cos, is_single, sin, sqrt
from quell.kernels.sized import Size
from quell.learners.base import lag_push
from quell.types import Matrix, Vector

# κ and c: a broad optimum over random loops (studies/notes/harmonic.md).
_FREQUENCY_GAIN, _UNEXPLAINED_WEIGHT = 0.4, 60.0


class Oscillators(NamedTuple):
    """Parameters of m oscillators with p orders, whose features are consecutive in θ."""

    first: Size  # index in θ of the first pair
    omega: Vector  # initial frequencies [rad/s] (m,)
    low: float  # least frequency [rad/s]
    high: float  # largest frequency [rad/s]
    orders: Vector  # k (p,)


@kernel
def retune(
    oscillators: Oscillators,
    omega: Vector,
    j: int,
    theta: Vector,
    gain: Vector,
    step: float,
    unexplained: float,
) -> None:
    """Correct the frequency of oscillator ``j`` after θ changed by ``step · gain``.

    ``unexplained`` is E[ε² + (0.1 f̂)²].
    """
    orders = oscillators.orders
    turn = size = 0.0
    for k in range(orders.size):
        at, order = oscillators.first + 2 * (j * orders.size + k), orders[k]
        change_s, change_c = step * gain[at], step * gain[at + 1]
        turn += order * (theta[at] * change_c - theta[at + 1] * change_s)
        size += order * order * (theta[at] * theta[at] + theta[at + 1] * theta[at + 1])
    size += _UNEXPLAINED_WEIGHT * unexplained
    if size > 0.0:
        turned = omega[j] * (1.0 + _FREQUENCY_GAIN * (turn / size))
        omega[j] = min(max(turned, oscillators.low), oscillators.high)


@kernel
def combined(oscillators: Oscillators, phase: Vector, theta: Vector, constant: float) -> float:
    """Return ``constant`` and the sum of all pairs, weighted with θ."""
    orders = oscillators.orders
    for j in range(phase.size):
        for k in range(orders.size):
            at, angle = oscillators.first + 2 * (j * orders.size + k), orders[k] * phase[j]
            constant += theta[at] * sin(angle) + theta[at + 1] * cos(angle)
    return constant


@kernel
def push_pairs(
    oscillators: Oscillators, lag: Any, chain: Matrix, filtered: Vector, phase: Vector
) -> None:
    """Advance the lag filters of all pairs by a sample."""
    orders = oscillators.orders
    for j in range(phase.size):
        for k in range(orders.size):
            at, angle = oscillators.first + 2 * (j * orders.size + k), orders[k] * phase[j]
            filtered[at] = lag_push(lag, chain, at, sin(angle))
            filtered[at + 1] = lag_push(lag, chain, at + 1, cos(angle))


@kernel
def open_pairs(oscillators: Oscillators, covariance: Matrix, variance: float) -> None:
    """Let the amplitudes be unknown, apart from a ``variance``."""
    first = oscillators.first
    for i in range(first, first + 2 * oscillators.omega.size * oscillators.orders.size):
        for j in range(covariance.shape[0]):
            if covariance.shape[1] > covariance.shape[0]:  # the lower triangle and carries
                low, high = min(i, j), max(i, j)
                covariance[high, low] = covariance[low, high + 1] = 0.0
            else:
                covariance[i, j] = covariance[j, i] = 0.0
        covariance[i, i] = variance


@kernel
def turn_phases(phase: Vector, omega: Vector, dt: float) -> None:
    """Advance all phases by a sample."""
    for j in range(phase.size):
        phase[j] = (phase[j] + omega[j] * dt) % (2.0 * math.pi)


# A column whose part that others do not explain is below this share of its square is left out:
# it is rounding, some thousand times the unit roundoff, and more where rows are few.
_DEPENDENT, _DEPENDENT_SINGLE = 1e-11, 1e-5
# Standard deviation of a frequency of which nothing is known: beyond all frequencies [rad/sample].
_UNKNOWN = 10.0


class LineFit(NamedTuple):
    """State of a fit of q signals and up to m frequencies with p orders; C = 1 + q + 2mp + m."""

    omega: Vector  # frequencies ω [rad/sample] (m,)
    amplitude: Vector  # a, b of each pair (2mp,)
    wave: Vector  # sin and cos of each pair at this row (2mp,)
    turn: Vector  # sin and cos of the angle from one row to the next (2mp,)
    signal: Vector  # given signals r at this row (q,)
    column: Vector  # the row of the regression (C,)
    squares: Matrix  # sums of its squares and products, the lower triangle (C, C)
    products: Vector  # sums of its products with z (C,)
    gram: Matrix  # Cholesky factor of the normal equations (C, C)
    moment: Vector  # their right side, times the inverse of the factor (C,)
    solution: Vector  # c, w, a, b, δω (C,)
    deviation: Vector  # standard deviation of each frequency [rad/sample] (m,)
    square: Vector  # sum of z² (1,)


def line_fit(count: int, orders: int, signals: int) -> LineFit:
    """Return the state of a fit of up to ``count`` frequencies with ``orders`` orders each."""
    pairs = 2 * count * orders
    size = 1 + signals + pairs + count
    return LineFit(
        omega=np.zeros(count),
        amplitude=np.zeros(pairs),
        wave=np.zeros(pairs),
        turn=np.zeros(pairs),
        signal=np.zeros(signals),
        column=np.zeros(size),
        squares=np.zeros((size, size)),
        products=np.zeros(size),
        gram=np.zeros((size, size)),
        moment=np.zeros(size),
        solution=np.zeros(size),
        deviation=np.zeros(count),
        square=np.zeros(1),
    )


@kernel
def begin_pass(orders: Vector, fit: LineFit, found: int) -> None:
    """Begin a pass with the first ``found`` frequencies."""
    for j in range(found):
        for k in range(orders.size):
            at = 2 * (j * orders.size + k)
            angle = -orders[k] * fit.omega[j]
            fit.turn[at], fit.turn[at + 1] = sin(angle), cos(angle)
            fit.wave[at], fit.wave[at + 1] = 0.0, 1.0
    fit.square[0] = 0.0
    for i in range(fit.products.size):
        fit.products[i] = 0.0
        for j in range(i + 1):
            fit.squares[i, j] = 0.0


@kernel
def shift_amplitudes(orders: Vector, fit: LineFit, found: int, later: float) -> None:
    """Let the amplitudes refer to a time that is ``later`` by so many samples."""
    for j in range(found):
        for k in range(orders.size):
            at = 2 * (j * orders.size + k)
            sine = sin(orders[k] * fit.omega[j] * later)
            cosine = cos(orders[k] * fit.omega[j] * later)
            a, b = fit.amplitude[at], fit.amplitude[at + 1]
            fit.amplitude[at] = a * cosine - b * sine
            fit.amplitude[at + 1] = a * sine + b * cosine


@kernel
def fitted(fit: LineFit, pairs: int) -> float:
    """Return the value of the sinusoids at this row."""
    total = 0.0
    for i in range(pairs):
        total += fit.amplitude[i] * fit.wave[i]
    return total


@kernel
def next_row(fit: LineFit, pairs: int) -> None:
    """Turn the waves to the next row."""
    for at in range(0, pairs, 2):
        sine, cosine = fit.wave[at], fit.wave[at + 1]
        fit.wave[at] = sine * fit.turn[at + 1] + cosine * fit.turn[at]
        fit.wave[at + 1] = cosine * fit.turn[at + 1] - sine * fit.turn[at]


@kernel
def add_row(orders: Vector, fit: LineFit, found: int, time: float, value: float) -> None:
    """Add ``value``, the sample at ``time``, to the normal equations."""
    column, first, pairs = fit.column, 1 + fit.signal.size, 2 * orders.size * found
    size = first + pairs + found
    column[0] = 1.0
    for i in range(fit.signal.size):
        column[1 + i] = fit.signal[i]
    for i in range(pairs):
        column[first + i] = fit.wave[i]
    for j in range(found):
        slope = 0.0
        for k in range(orders.size):
            at = 2 * (j * orders.size + k)
            slope += orders[k] * (
                fit.amplitude[at] * fit.wave[at + 1] - fit.amplitude[at + 1] * fit.wave[at]
            )
        column[first + pairs + j] = time * slope
    fit.square[0] += value * value
    for i in range(size):
        fit.products[i] += column[i] * value
        for j in range(i + 1):
            fit.squares[i, j] += column[i] * column[j]


@kernel
def solve(fit: LineFit, linear: int, size: int, ridge: float) -> tuple[float, float]:
    """Solve the first ``size`` normal equations; the first ``linear`` are those of c, w, a, b.

    Return what is minimised, the squares with the ridge's, for c and w alone and for c, w, a, b.
    """
    gram, moment, solution = fit.gram, fit.moment, fit.solution
    left = without_lines = unexplained = fit.square[0]
    dependent = _DEPENDENT_SINGLE if is_single(left) else _DEPENDENT
    for i in range(size):
        moment[i] = fit.products[i]
        for j in range(i + 1):
            gram[i, j] = fit.squares[i, j]
    for i in range(1, 1 + fit.signal.size):
        gram[i, i] += ridge * (gram[i, i] - gram[i, 0] * gram[i, 0] / gram[0, 0])
    for i in range(size):
        whole = gram[i, i]
        for j in range(i + 1):
            total = gram[i, j]
            for k in range(j):
                total -= gram[i, k] * gram[j, k]
            if j < i:
                gram[i, j] = total / gram[j, j] if gram[j, j] > 0.0 else 0.0
            else:
                gram[i, i] = sqrt(total) if total > dependent * whole else 0.0
        total = moment[i]
        for k in range(i):
            total -= gram[i, k] * moment[k]
        moment[i] = total / gram[i, i] if gram[i, i] > 0.0 else 0.0
        left -= moment[i] * moment[i]
        if i == fit.signal.size:
            without_lines = left
        if i == linear - 1:
            unexplained = left
    for back in range(size):
        i = size - 1 - back
        total = moment[i]
        for k in range(i + 1, size):
            total -= gram[k, i] * solution[k]
        solution[i] = total / gram[i, i] if gram[i, i] > 0.0 else 0.0
    return max(without_lines, 0.0), max(unexplained, 0.0)


@kernel
def write_deviations(fit: LineFit, linear: int, size: int, noise: float) -> None:
    """Write the standard deviations of the frequencies for residuals of variance ``noise``.

    They are the roots of the last diagonal elements of the inverse of the normal matrix, whose
    Cholesky factor ``solve`` has left; at most 10 rad/sample, for what is not determined.
    """
    gram, column = fit.gram, fit.column
    for place in range(min(size - linear, fit.deviation.size)):
        j, total = linear + place, 0.0
        for i in range(j, size):
            value = 1.0 if i == j else 0.0
            for k in range(j, i):
                value -= gram[i, k] * column[k]
            column[i] = value / gram[i, i] if gram[i, i] > 0.0 else 0.0
            total += column[i] * column[i]
        determined = gram[j, j] > 0.0
        deviation = sqrt(noise * total) if determined else _UNKNOWN
        fit.deviation[place] = min(deviation, _UNKNOWN)
