"""Filters 1/A(s) and their derivatives, sampled exactly: the basis of identification.

Polynomials are in ``p = s dt``: a sample is a unit of time, and nothing depends on the user's
seconds. The vector ``a`` (n,) holds the coefficients of ``A = p^n + a_{n−1} p^(n−1) + … + a_0`` in
ascending powers. A *chain* is the filter bank ``p^i/A(p)``, i = 0 … n − 1, of one signal: the
states of the controllable companion form.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import compiled
from quell.lti.discretize import zero_order_hold
from quell.types import Matrix, Vector

# States below this become zero: far below all values that matter, far above the denormal numbers
# (1e-308) that processors are slow with.
_TINY = 1e-140

Bank = NDArray[np.float64]  # states of a chain for several inputs (N, n, m)
Indices = NDArray[np.int64]


class Sampled(NamedTuple):
    """A sampled system ``x⁺ = Φ x + Γ v + Γ₁ (v⁺ − v)``, with held or linear inputs."""

    phi: Matrix  # Φ (n, n)
    gamma: Matrix  # Γ (n, m)
    slope: Matrix  # Γ₁ (n, m); zero for held inputs


@compiled
def _states(phi: Matrix, gamma: Matrix, slope: Matrix, v: Matrix, x: Vector, out: Matrix) -> None:
    """Write the states for inputs ``v`` (N, m) into ``out`` (N, n), starting at ``x``."""
    n, m = gamma.shape
    last = v.shape[0] - 1
    for k in range(v.shape[0]):
        for i in range(n):
            out[k, i] = x[i]
        after = min(k + 1, last)
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += phi[i, j] * out[k, j]
            for j in range(m):
                total += gamma[i, j] * v[k, j] + slope[i, j] * (v[after, j] - v[k, j])
            x[i] = total if abs(total) > _TINY else 0.0


@compiled
def _chains(phi: Matrix, gamma: Vector, v: Matrix, x: Matrix, out: Bank) -> None:
    """Write the states for held inputs ``v`` (N, m) into ``out`` (N, n, m), starting at ``x``."""
    n, m = x.shape
    for k in range(v.shape[0]):
        for i in range(n):
            for c in range(m):
                out[k, i, c] = x[i, c]
                x[i, c] = gamma[i] * v[k, c]
        for i in range(n):
            for j in range(n):
                for c in range(m):
                    x[i, c] += phi[i, j] * out[k, j, c]
            for c in range(m):
                x[i, c] = x[i, c] if abs(x[i, c]) > _TINY else 0.0


@compiled
def _gradient(
    one: Sampled,
    bank: Matrix,
    columns: Indices,
    both: Sampled,
    x: Vector,
    skipped: int,
    v: Matrix,
    y: Vector,
    out: Matrix,
) -> None:
    """Write y (N,) and its derivatives ``out`` (N, size); see ``structure.gradient``.

    ``one`` is the filter on each input, ``bank`` (2, n, inputs) its states now and at the next
    sample; ``columns`` (n, inputs) are their columns in ``out``, negative for none. ``both`` is the
    model followed by the filter, ``x`` (2, 2 n) their states.
    """
    _, n, m = bank.shape
    now, then = 0, 1
    for k in range(v.shape[0]):
        y[k] = x[now, 0]
        for i in range(skipped, n):
            out[k, i - skipped] = -x[now, n + i]
        for i in range(n):
            for c in range(m):
                if columns[i, c] >= 0:
                    out[k, columns[i, c]] = bank[now, i, c]
        for i in range(n):
            for c in range(m):
                bank[then, i, c] = one.gamma[i, 0] * v[k, c]
            for j in range(n):
                for c in range(m):
                    bank[then, i, c] += one.phi[i, j] * bank[now, j, c]
            for c in range(m):
                bank[then, i, c] = bank[then, i, c] if abs(bank[then, i, c]) > _TINY else 0.0
        for i in range(2 * n):
            total = 0.0
            for j in range(n if i < n else 2 * n):
                total += both.phi[i, j] * x[now, j]
            for c in range(m - 1):
                total += both.gamma[i, c] * v[k, c]
            x[then, i] = total if abs(total) > _TINY else 0.0
        now, then = then, now


@compiled
def _mean_sign(now: float, free: float, gain: float) -> float:
    """Return the mean over a sample of minus the sign of a speed; see ``structure``.

    The speed is ``now`` at the start, and ``free + gain v`` at the end if v acts all along.
    """
    if gain <= 0.0:  # it drives the motion: a model on the way of the search
        return -1.0 if now > 0.0 else (1.0 if now < 0.0 else 0.0)
    sign = 1.0 if now > 0.0 else (-1.0 if now < 0.0 else 0.0)
    change = free - sign * gain - now
    if now * (now + change) > 0.0:
        return -sign
    if sign != 0.0 and (change + 2.0 * sign * gain) * sign < 0.0:
        return sign * (1.0 + 2.0 * now / change)
    return min(max(-free / gain, -1.0), 1.0)


@compiled
def _states_with_friction(
    phi: Matrix, gamma: Matrix, v: Matrix, speeds: Matrix, offset: float, x: Vector, out: Matrix
) -> None:
    """Write the states and the last inputs: minus the mean signs of ``speeds`` times the state.

    ``offset`` is added to the speeds.
    """
    n, m = gamma.shape
    first = m - speeds.shape[0]
    for k in range(v.shape[0]):
        for i in range(n):
            out[k, i] = x[i]
        for i in range(n):
            x[i] = 0.0
            for j in range(n):
                x[i] += phi[i, j] * out[k, j]
            for j in range(first):
                x[i] += gamma[i, j] * v[k, j]
        for j in range(first, m):
            now = free = offset
            gain = 0.0
            for i in range(n):
                now += speeds[j - first, i] * out[k, i]
                free += speeds[j - first, i] * x[i]
                gain += speeds[j - first, i] * gamma[i, j]
            v[k, j] = _mean_sign(now, free, gain)
            for i in range(n):
                x[i] += gamma[i, j] * v[k, j]


def companion(a: Vector) -> tuple[Matrix, Matrix]:
    """Return A and B of the controllable companion form, with states ``p^i/A(p) v``."""
    n = a.size
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = -a
    return A, np.eye(n)[:, -1:]


def observable(a: Vector) -> Matrix:
    """Return A of the observable companion form; numerators, descending, are columns of B."""
    A = np.diag(np.ones(a.size - 1), 1)
    A[:, 0] -= a[::-1]
    return A


def sampled(A: Matrix, B: Matrix, straight: bool = False) -> Sampled:
    """Sample ``x' = A x + B v`` exactly over a unit of time; ``v`` is held or ``straight``."""
    n, m = B.shape
    if not straight:
        # An unstable model may give no finite numbers; the caller sees this in the output.
        with np.errstate(all="ignore"):
            phi, (gamma,) = zero_order_hold(A, [B], 1.0)
        return Sampled(phi, gamma, np.zeros((n, m)))
    # A linear input is the state of an integrator whose own input, the slope, is held.
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = A, B
    phi, (slope,) = zero_order_hold(block, [np.eye(n + m)[:, n:]], 1.0)
    return Sampled(*map(np.ascontiguousarray, (phi[:n, :n], phi[:n, n:], slope[:n])))


def states(system: Sampled, v: Matrix, x0: Vector | None = None) -> Matrix:
    """Return the states (N, n) for the inputs ``v`` (N, m), starting at ``x0``, zero by default."""
    n = system.phi.shape[0]
    out = np.empty((v.shape[0], n))
    start = np.zeros(n) if x0 is None else np.array(x0, dtype=np.float64)
    _states(*system, np.ascontiguousarray(v), start, out)
    return out


def states_with_friction(
    system: Sampled, v: Matrix, speeds: Matrix, x0: Vector, offset: float = 0.0
) -> tuple[Matrix, Matrix]:
    """Return states and inputs; the last are minus the mean signs of ``speeds`` times the state.

    ``offset`` is added to the speeds.
    """
    out, inputs = np.empty((v.shape[0], x0.size)), np.array(v, order="C")
    speeds, x = np.ascontiguousarray(speeds), np.array(x0, dtype=np.float64)
    _states_with_friction(system.phi, system.gamma, inputs, speeds, offset, x, out)
    return out, inputs


def chain(a: Vector, v: Vector) -> Matrix:
    """Return ``p^i/A(p) v`` (N, n) at the samples, from rest, for ``v`` linear between them."""
    return states(sampled(*companion(a), straight=True), v[:, None])


def chains(a: Vector, v: Matrix) -> Bank:
    """Return ``p^i/A(p)`` (N, n, inputs + 1) of held inputs ``v`` and of an initial impulse."""
    one, count = sampled(*companion(a)), v.shape[1] + 1
    out = np.empty((v.shape[0], a.size, count))
    _chains(one.phi, one.gamma[:, 0].copy(), _with_impulse(v), _first(a.size, count), out)
    return out


def gradient(
    a: Vector, B: Matrix, start: Vector, columns: Indices, skipped: int, v: Matrix, size: int
) -> tuple[Vector, Matrix]:
    """Return y (N,) of a model in observable companion form, and its derivatives (N, size).

    The first are ``−p^i/A y`` for i from ``skipped`` on; the others are the states of ``chains``,
    in the columns given by ``columns`` (n, inputs + 1).
    """
    n = a.size
    A, both = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, B.shape[1]))
    A[:n, :n], A[n:, n:] = observable(a), companion(a)[0]
    A[-1, 0] = 1.0
    both[:n] = B
    x, bank = np.zeros((2, 2 * n)), np.zeros((2, n, v.shape[1] + 1))
    x[0, :n], bank[0] = start, _first(n, v.shape[1] + 1)
    y, out = np.empty(v.shape[0]), np.empty((v.shape[0], size))
    one, model, v = sampled(*companion(a)), sampled(A, both), _with_impulse(v)
    _gradient(one, bank, columns, model, x, skipped, v, y, out)
    return y, out


def _with_impulse(v: Matrix) -> Matrix:
    """Return the inputs and zeros for the impulse, which only sets the initial state."""
    return np.column_stack([v, np.zeros(v.shape[0])])


def _first(n: int, count: int) -> Matrix:
    """Return the initial states of ``count`` chains, the last of which starts with an impulse."""
    x = np.zeros((n, count))
    x[-1, -1] = 1.0
    return x
