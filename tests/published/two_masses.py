"""The two-mass study of generalised observers by another way, without any code of quell.

The plant (m1 = m2 = 1 kg, k = 1 N/m, y = x2) and the observers, with m states f, f', …, f^(m) = 0,
are sampled exactly in rational numbers: exponentials by their series, the observer's gain by
Ackermann's formula ``L = p(Φ) O⁻¹ e_N`` with the rows ``C Φ^i`` (i = 1 … N) of O and all roots of p at
``exp(−ω_o dt)``. Unlike in quell f moves x within a sample, too, as f^(m) = 0 has it. The law is
``u = (k·(r, 0, 0, 0) − k·x̂ − f̂ + a·x̂)/b0`` with all its poles at −ω_c.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

DT, N = 1e-3, 4
_A = (
    (0, 1, 0, 0),
    (0, 0, 1, 0),
    (0, 0, 0, 1),
    (0, 0, -2, 0),
)  # of 1/(s^4 + 2 s^2)
_TERMS = 14
Rational = list[list[Fraction]]


class Figures(NamedTuple):
    """What is printed of an observer."""

    m_s: float
    m_ks: float
    peak: float  # |y − 1| under the force [m]
    overshoot: float
    settling: float  # [s]
    variation: float  # [N]


def product(one: Rational, other: Rational) -> Rational:
    """Return the product of two matrices."""
    columns = list(zip(*other, strict=True))
    return [[sum((a * b for a, b in zip(row, c, strict=True)), Fraction(0)) for c in columns] for row in one]  # fmt: skip


def unit(size: int) -> Rational:
    """Return the unit matrix."""
    return [[Fraction(int(i == j)) for j in range(size)] for i in range(size)]


def exponential(A: Rational) -> Rational:
    """Return exp(A) by its series."""
    total, term = unit(len(A)), unit(len(A))
    for i in range(1, _TERMS):
        term = [[value / i for value in row] for row in product(term, A)]
        total = [[a + b for a, b in zip(*rows, strict=True)] for rows in zip(total, term, strict=True)]  # fmt: skip
    return total


def solved(A: Rational, b: list[Fraction]) -> list[Fraction]:
    """Return A⁻¹ b by elimination."""
    rows = [[*row, value] for row, value in zip(A, b, strict=True)]
    for i in range(len(rows)):
        pivot = next(j for j in range(i, len(rows)) if rows[j][i] != 0)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        for j in range(len(rows)):
            if j != i and rows[j][i] != 0:
                share = rows[j][i] / rows[i][i]
                rows[j] = [x - share * y for x, y in zip(rows[j], rows[i], strict=True)]
    return [row[-1] / row[i] for i, row in enumerate(rows)]


def sampled_observer(based: bool, m: int, omega_o: float) -> tuple[Any, Any, Any]:
    """Return Φ (N + m, N + m), Γ_u and L of the observer in the current form."""
    size, dt = N + m, Fraction(1, 1000)
    A = [[Fraction(0)] * (size + 1) for _ in range(size + 1)]  # the last column is u
    for i in range(size - 1):
        A[i][i + 1] = dt
    if based:
        A[N - 1][2] = -2 * dt
    A[N - 1][size] = dt
    whole = exponential(A)
    phi, gamma = [row[:size] for row in whole[:size]], [row[size] for row in whole[:size]]
    row, rows = [unit(size)[0]], []
    for _ in range(size):
        row = product(row, phi)
        rows.append(row[0])
    vector = [
        [value] for value in solved(rows, [Fraction(int(i == size - 1)) for i in range(size)])
    ]
    beta = Fraction(math.exp(-omega_o * DT))
    shifted = [[a - beta * e for a, e in zip(*both, strict=True)] for both in zip(phi, unit(size), strict=True)]  # fmt: skip
    for _ in range(size):
        vector = product(shifted, vector)
    gain = np.array([float(value[0]) for value in vector])
    return np.array(phi, dtype=float), np.array(gamma, dtype=float), gain


def controller(based: bool, m: int, omega_o: float, omega_c: float = 1.0) -> tuple[Any, ...]:
    """Return A, B_y, B_r, C, D_y, D_r of the law with z⁻ as its state."""
    phi, gamma, L = sampled_observer(based, m, omega_o)
    size = L.size
    k = [math.comb(N, i) * omega_c ** (N - i) for i in range(N)]
    K = np.array([*k, 1.0, *[0.0] * (m - 1)])
    if based:
        K[2] -= 2.0
    closed = phi - np.outer(gamma, K)
    correct = np.eye(size) - np.outer(L, np.eye(size)[0])
    return closed @ correct, closed @ L, gamma * k[0], -K @ correct, -float(K @ L), k[0]


def sampled_plant() -> tuple[Any, Any]:
    """Return Φ (4, 4) of (y, y', x1 − x2, x1' − x2'), and the columns for u and the force on m2."""
    dt = Fraction(1, 1000)
    A = [[Fraction(value) * dt for value in [*row, 0, 0]] for row in _A] + [[Fraction(0)] * 6] * 2
    A[3][4] = dt
    A[1][5], A[3][5] = dt, -dt  # the third state is the spring's x1 − x2: y'' = x1 − x2 + w
    whole = np.array(exponential(A)[:4], dtype=float)
    return whole[:, :4], whole[:, 4:]


def figures(based: bool, m: int, omega_o: float, seed: int = 0) -> Figures:
    """Return the margins of the loop, and what the study measures."""
    phi, columns = sampled_plant()
    A, B_y, B_r, C, D_y, D_r = controller(based, m, omega_o)
    omega = np.geomspace(1e-2, math.pi / DT, 30_000)
    z = np.exp(1j * omega * DT)

    def response(M: Any, B: Any, out: Any) -> Any:
        values, vectors = np.linalg.eig(M)
        inner = np.linalg.solve(vectors, B)
        return ((out @ vectors) * inner / (z[:, None] - values)).sum(axis=1)

    whole = np.zeros((4 + C.size, 4 + C.size))
    whole[:4, :4] = phi + np.outer(columns[:, 0], D_y * np.eye(4)[0])
    whole[:4, 4:], whole[4:, 0], whole[4:, 4:] = np.outer(columns[:, 0], C), B_y, A
    # From noise n in y to u, C_y S = D_y + …, and to y, S − 1 = P C_y S.
    into = np.concatenate([columns[:, 0] * D_y, B_y])
    u_row = np.concatenate([D_y * np.eye(4)[0], C])
    of_u, of_y = response(whole, into, u_row) + D_y, response(whole, into, np.eye(4 + C.size)[0])
    drive = np.stack(
        [
            np.concatenate([columns[:, 0] * D_r, B_r]),
            np.concatenate([columns[:, 1], np.zeros(C.size)]),
            into,
        ],
        axis=1,
    )
    count, on = round(140.0 / DT), round(40.0 / DT)
    t = DT * np.arange(count)
    force = np.where(t >= 40.0, np.sin(0.1 * math.pi * (t - 40.0)), 0.0)
    noise = np.repeat(np.random.default_rng(seed).normal(0.0, 1e-5, count // 10), 10)
    given = np.stack([np.ones(count), force, noise])
    state, y, u = np.zeros(4 + C.size), np.empty(count), np.empty(count)
    driven = drive @ given
    for i in range(count):
        y[i] = state[0]
        u[i] = u_row @ state + D_r + D_y * noise[i]
        state = whole @ state + driven[:, i]
    outside = np.flatnonzero(np.abs(y[:on] - 1.0) > 0.002)
    return Figures(
        m_s=float(np.max(np.abs(1.0 + of_y))),
        m_ks=float(np.max(np.abs(of_u))),
        peak=float(np.max(np.abs(y[round(60.0 / DT) :] - 1.0))),
        overshoot=float(np.max(y[:on]) - 1.0),
        settling=DT * float(outside[-1] + 1),
        variation=float(np.sum(np.abs(np.diff(u[:on])))),
    )
