"""The two-mass study of generalised observers by another way, without any code of quell.

Every figure is a mean over ten draws of the noise, and the peaks are those under forces of ``LOADS``.

The plant (m1 = m2 = 1 kg, k = 1 N/m, y = x2) and the observers, with m states f, f', …, f^(m) = 0,
are sampled exactly in rational numbers: exponentials by their series, the observer's gain by
Ackermann's formula ``L = p(Φ) O⁻¹ e_N`` with the rows ``C Φ^i`` (i = 1 … N) of O and all roots of p at
``exp(−ω_o dt)``. Either f moves x within a sample, too, as f^(m) = 0 has it, or it is *held* over a
sample, as in quell, which is the same for m = 1. The law is
``u = (k·(r, 0, 0, 0) − k·x̂ − f̂ + a·x̂)/b0`` with all its poles at −ω_c.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

DT, N, SEEDS = 1e-3, 4, 10
LOADS = (0.1, 0.1 * math.pi, 0.8)  # [rad/s]; the second one is the paper's
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
    peaks: tuple[float, float, float]  # |y − 1| under each force [m]
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


def sampled_observer(
    based: bool, m: int, omega_o: float, held: bool = False
) -> tuple[Any, Any, Any]:
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
    if held:  # with b0 = 1 a constant f moves x as u does; f itself is the polynomial that it was
        for i in range(N):
            phi[i][N:] = [gamma[i]] + [Fraction(0)] * (m - 1)
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


def controller(
    based: bool, m: int, omega_o: float, held: bool, omega_c: float = 1.0
) -> tuple[Any, ...]:
    """Return A, B_y, B_r, C, D_y, D_r of the law with z⁻ as its state."""
    phi, gamma, L = sampled_observer(based, m, omega_o, held)
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


def noise(count: int) -> Any:
    """Return ten draws of the noise of y, held for 10 ms (count, 10)."""
    draws = [np.random.default_rng(seed).normal(0.0, 1e-5, count // 10) for seed in range(SEEDS)]
    return np.repeat(np.array(draws).T, 10, axis=0)


def scored(y: Any, u: Any, forced: Any) -> tuple[Any, ...]:
    """Return peaks, overshoot, settling time and variation: y and u of the step (k, seeds).

    ``forced`` (j, loads) is y from 20 s after the force on.
    """
    outside = np.abs(y - 1.0) > 0.002
    settled = DT * (y.shape[0] - np.argmax(outside[::-1], axis=0))
    peaks = tuple(np.max(np.abs(forced - 1.0), axis=0).tolist())
    variation = np.abs(np.diff(u, axis=0)).sum(axis=0)
    overshoot = np.maximum(np.max(y, axis=0) - 1.0, 0.0)
    return peaks, float(np.mean(overshoot)), float(np.mean(settled)), float(np.mean(variation))


def figures(based: bool, m: int, omega_o: float, held: bool = False) -> Figures:
    """Return the margins of the loop, and what the study measures."""
    phi, columns = sampled_plant()
    A, B_y, B_r, C, D_y, D_r = controller(based, m, omega_o, held)
    z = np.exp(1j * OMEGA * DT)

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
    of_r = np.concatenate([columns[:, 0] * D_r, B_r])
    of_force = np.concatenate([columns[:, 1], np.zeros(C.size)])
    # The loop is linear: the step with each force without noise, and each noise alone.
    count, on = round(140.0 / DT), round(40.0 / DT)
    t = DT * np.arange(count)
    force = np.where(t[:, None] >= 40.0, np.sin(np.array(LOADS) * (t[:, None] - 40.0)), 0.0)
    drawn = noise(count)
    step, still = np.repeat(of_r[:, None], 3, axis=1), np.zeros((of_r.size, SEEDS))
    constant = np.hstack([step, still])
    state, y, u = (
        np.zeros(constant.shape),
        np.empty((count, 3 + SEEDS)),
        np.empty((count, 3 + SEEDS)),
    )
    for i in range(count):
        y[i], u[i] = state[0], u_row @ state
        state = whole @ state + constant
        state[:, :3] += of_force[:, None] * force[i]
        state[:, 3:] += into[:, None] * drawn[i]
    u[:, 3:] += D_y * drawn
    u[:, :3] += D_r
    late = round(60.0 / DT)
    found = scored(y[:on, 1:2] + y[:on, 3:], u[:on, 1:2] + u[:on, 3:], y[late:, :3] + y[late:, 3:4])
    return Figures(float(np.max(np.abs(1.0 + of_y))), float(np.max(np.abs(of_u))), *found)


OMEGA = np.geomspace(1e-2, math.pi / DT, 30_000)
BATCH = 10
READINGS = {"as printed": 0.01, "labelled once": 0.01, "without u": 1.0}
"""Readings of Algorithm 1, and the rate · batch / dt [1/s] of each.

As printed the whole batch is labelled again with the newest θ (line 18), so its gradient is
``−Σ Δf̂ I``. Labelled once, each entry keeps the label ``f̂ = Δf̂ + F_L`` of its own sample. Without u
the features are ``(x̂, 1)``.
"""


def algorithm_1() -> dict[str, Figures]:
    """Return the figures of MF-ESO with Algorithm 1 in each reading, for the first draw of the noise.

    From rest 110 s of sin t, then from rest the step, and a force from 150 s. Labelled once, all
    peaks are those of the paper's force.
    """
    phi, columns = sampled_plant()
    transition, gamma, L = sampled_observer(False, 1, 10.0)
    correct = np.eye(5) - np.outer(L, np.eye(5)[0])
    # A row for each case: x (4), z (5), u and f_L.
    onto_z = np.hstack(
        [np.outer(L, np.eye(4)[0]), correct @ np.column_stack([transition, gamma, gamma])]
    )
    k = np.array([math.comb(N, i) for i in range(N)] + [1], dtype=float)
    cases = [(name, load) for name in ("as printed", "without u") for load in range(3)]
    cases.append(("labelled once", 1))
    alpha = np.array([[READINGS[name] * DT / BATCH] * 6 for name, _ in cases])
    alpha[[name == "without u" for name, _ in cases], 4] = 0.0
    count, reset, on = round(250.0 / DT), round(110.0 / DT), round(150.0 / DT)
    t = DT * np.arange(count)
    r = np.where(t < 110.0, np.sin(t), 1.0)
    force = np.where(t[:, None] >= 150.0, np.sin(np.array(LOADS) * (t[:, None] - 150.0)), 0.0)
    pushed = force[:, [load for _, load in cases], None] * columns[:, 1]
    seen = noise(count)[:, :1] * L
    rows, theta, total = (
        np.zeros((len(cases), 11)),
        np.zeros((len(cases), 6)),
        np.zeros((len(cases), 6)),
    )
    inputs, products = np.zeros((BATCH, len(cases), 6)), np.zeros((BATCH, len(cases), 6))
    inputs[:, :, 5], labels = 1.0, np.zeros(BATCH)
    y, u = np.empty((count, len(cases))), np.empty((count, len(cases)))
    for i in range(count):
        if i == reset:
            rows[:] = 0.0
        y[i] = rows[:, 0]
        z, row = rows @ onto_z.T + seen[i], i % BATCH
        own = inputs[row]
        own[:, :4], own[:, 4] = z[:, :4], rows[:, 9]
        total -= products[row]
        np.multiply(z[:, 4:], own, out=products[row])
        total += products[row]
        labels[row] = z[-1, 4] + rows[-1, 10]
        if i >= BATCH - 1:
            theta[:-1] += alpha[:-1] * total[:-1]
            once = inputs[:, -1]
            theta[-1] += alpha[-1] * ((labels - once @ theta[-1]) @ once)
        learned = (own * theta).sum(axis=1)
        u[i] = r[i] * k[0] - z @ k - learned
        rows[:, :4] = rows[:, :4] @ phi.T + u[i, :, None] * columns[:, 0] + pushed[i]
        rows[:, 4:9], rows[:, 9], rows[:, 10] = z, u[i], learned
    found = {}
    for name, of_loads, paper in (
        ("as printed", [0, 1, 2], 1),
        ("without u", [3, 4, 5], 4),
        ("labelled once", [6, 6, 6], 6),
    ):
        scores = scored(
            y[reset:on, [paper]], u[reset:on, [paper]], y[round(170.0 / DT) :, of_loads]
        )
        features = own[paper] * (alpha[paper] > 0.0)
        margins = _margins(READINGS[name] * DT / BATCH, theta[paper], features)
        found[name] = Figures(*margins, *scores)
    return found


def _margins(alpha: float, theta: Any, features: Any) -> tuple[float, float]:
    """Return M_s and M_ks of the loop at rest, linearised in θ and in the features.

    ``δf_L = θ·δI + I·δθ``, with ``δθ = α I Σ Δf̂`` over the batch, added up.
    """
    phi, columns = sampled_plant()
    transition, gamma, L = sampled_observer(False, 1, 10.0)
    z = np.exp(1j * OMEGA * DT)[:, None, None]
    rest = np.array([features[0], 0.0, 0.0, 0.0, features[4], 1.0])
    added = alpha * float(rest @ rest) * sum(z**-j for j in range(BATCH)) / (1.0 - 1.0 / z)
    # The unknowns are x̂ (4), Δf̂, f_L and u, for a y of one.
    M = np.zeros((OMEGA.size, 7, 7), dtype=complex)
    correct = np.eye(5) - np.outer(L, np.eye(5)[0])
    M[:, :5, :5] = np.eye(5) - (correct @ transition) / z
    M[:, :5, 5:6] = M[:, :5, 6:7] = -(correct @ gamma)[:, None] / z
    M[:, 5, :4], M[:, 5, 4], M[:, 5, 5] = -theta[:4], -added[:, 0, 0], 1.0
    M[:, 5, 6] = -theta[4] / z[:, 0, 0]
    M[:, 6, :4] = [math.comb(N, i) for i in range(N)]
    M[:, 6, 4:] = 1.0
    right = np.concatenate([L, [0.0, 0.0]]).astype(complex)
    C_y = -np.linalg.solve(M, np.broadcast_to(right[:, None], (OMEGA.size, 7, 1)))[:, 6, 0]
    P = np.linalg.solve(z * np.eye(4) - phi, columns[:, :1].astype(complex))[:, 0, 0]
    S = 1.0 / (1.0 + P * C_y)
    return float(np.max(np.abs(S))), float(np.max(np.abs(C_y * S)))
