"""Claims of the papers that follow the one which quell implements (docs/claims, *Claims of its successors*).

**arXiv 2510.01007** (Chen, Gao & Lin) is about observers of sampled systems with several disturbances::

    x⁺ = A x + B u + E d,        y = C x,        d⁺ = d + (what nobody knows)

Let ν_j be the number of samples after which y_j shows d, and ``V d`` what it shows then: the rows of V are ``C_j A^(ν_j − 1) E``. Without
invariant zeros from d to y the ν_j sum up to n, so x follows from ν_j samples of each y_j. An unknown-input observer with its poles at the
origin takes x from them, and d from the sample that comes next::

    x̂ = T⁻¹ (y_j[k + i] − known inputs),        (V d̂[k])_j = y_j[k + ν_j] − C_j A^(ν_j) x̂ − known inputs

An extended state observer in the current form with all poles at β, whose subsystems are not coupled, estimates each ``(V d)_j`` by itself. No
zero is left in the transfer function, and the power of z in it is that of the sample in which y is known; so ::

    (V d̂)_j / (V d)_j = (1 − β)^(ν_j + 1) z / (z − β)^(ν_j + 1),        at β = 0:  (V d̂[k])_j = (V d[k − ν_j])_j

One minus it is the transfer function of the error. **arXiv 2208.12314** (Chen, Gao, Hu & Shao) has one output and one disturbance, q = 1. With zeros
from d to y the numerator has them as well, ``N(z)/N(1)``, and an observer with poles at them has not.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql
from quell.lti.models import zero_order_hold
from quell.lti.zeros import observer_exists
from quell.observers.design import response
from quell.observers.gains import place_equal_poles
from quell.types import Matrix, Vector
from tests.benchmark_module import benchmark
from tests.cases import cases

SYSTEMS = 50
# Where transfer functions are compared: 0.05 to 2.8 radians per sample.
POINTS = np.exp(1j * np.array([0.05, 0.4, 1.3, 2.8]))


class Sampled(NamedTuple):
    """A sampled system without invariant zeros from d to y, with as many outputs as disturbances."""

    A: Matrix
    B: Matrix
    E: Matrix
    C: Matrix
    degrees: Any  # ν_j (q,)

    @property
    def gain(self) -> Matrix:
        """V (q, q): what y shows of d after ν_j samples."""
        return np.array(
            [
                row @ np.linalg.matrix_power(self.A, nu - 1) @ self.E
                for row, nu in zip(self.C, self.degrees, strict=True)
            ]
        )


def well_conditioned(rng: np.random.Generator, size: int) -> Matrix:
    """Return an invertible matrix with singular values between 0.5 and 2."""
    left, right = (np.linalg.qr(rng.normal(size=(size, size)))[0] for _ in range(2))
    return left @ np.diag(rng.uniform(0.5, 2.0, size)) @ right


def drawn(seed: int, *, coupled: bool = False, q: int | None = None) -> Sampled:
    """Return a system of up to three outputs with 1 to 3 states each, in random coordinates, some of them unstable.

    The gain of d is not diagonal. No pole lies at the origin: the current form can't see one there.
    """
    rng = np.random.default_rng([68, seed])
    degrees = rng.integers(1, 4, q or int(rng.integers(1, 4)))
    n, q = int(degrees.sum()), degrees.size
    A, E, C = np.zeros((n, n)), np.zeros((n, q)), np.zeros((q, n))
    for i, (end, degree) in enumerate(zip(np.cumsum(degrees), degrees, strict=True)):
        own = slice(end - degree, end)
        A[own, own] = np.diag(np.ones(degree - 1), 1)
        poles = rng.uniform(0.4, 1.1, degree) * rng.choice([-1.0, 1.0], degree)
        A[end - 1, own] = -np.poly(poles)[:0:-1]
        if coupled:
            A[end - 1] += rng.uniform(-0.5, 0.5, n)
        E[end - 1, i] = C[i, end - degree] = 1.0
    turn = well_conditioned(rng, n)
    back = np.linalg.inv(turn)
    E = turn @ E @ well_conditioned(rng, q)
    return Sampled(turn @ A @ back, rng.normal(size=(n, 2)), E, C @ back, degrees)


def extended(system: Sampled, beta: float) -> tuple[Matrix, Matrix, Matrix]:
    """Return Φ, C and the gain L of the observer of x and d with all poles at β."""
    A, _, E, C, _ = system
    n, q = E.shape
    phi = np.block([[A, E], [np.zeros((q, n)), np.eye(q)]])
    rows = np.hstack([C, np.zeros((q, q))])
    gain = place_equal_poles(phi - np.eye(n + q), rows @ phi, 1.0 - beta)
    assert gain is not None
    return phi, rows, gain


def observed(system: Sampled, beta: float, y: Matrix, u: Matrix) -> Matrix:
    """Return d̂ (K, q) of the extended state observer for a record; ``u[k]`` acts from y[k] on."""
    phi, rows, gain = extended(system, beta)
    n, q = system.E.shape
    given, z, found = (
        np.vstack([system.B, np.zeros((q, 2))]),
        np.zeros(n + q),
        np.zeros((len(y), q)),
    )
    for k in range(len(y)):
        before = phi @ z + given @ u[k - 1] if k else z
        z = before + gain @ (y[k] - rows @ before)
        found[k] = z[n:]
    return found


def from_unknown_inputs(system: Sampled, y: Matrix, u: Matrix) -> Matrix:
    """Return d̂ (K, q) of the unknown-input observer with its poles at the origin: ``d̂[k]`` knows y up to k, as an observer does.

    (V d)_j is that of ν_j samples before. The first samples, which need some before the record, are NaN.
    """
    A, B, _, C, degrees = system
    powers = [np.linalg.matrix_power(A, i) for i in range(int(max(degrees)) + 1)]
    shows = [(j, i) for j, nu in enumerate(degrees) for i in range(nu)]
    states = np.linalg.inv([C[j] @ powers[i] for j, i in shows])
    found = np.full((len(y), degrees.size), np.nan)
    for k in range(int(max(degrees)), len(y)):
        shown = np.zeros(degrees.size)
        for j, nu in enumerate(degrees):
            # What u has moved since y[k − ν_j], the first sample that tells x; other outputs
            # do not matter where the subsystems are not coupled, and are left at zero.
            free, moved = y[k - nu : k + 1, j].copy(), np.zeros(A.shape[0])
            for i in range(nu + 1):
                free[i] -= C[j] @ moved
                moved = A @ moved + B @ u[k - nu + i]
            x = states @ [free[i] if other == j else 0.0 for other, i in shows]
            shown[j] = free[nu] - C[j] @ powers[nu] @ x
        found[k] = np.linalg.solve(system.gain, shown)
    return found


def estimate_over_disturbance(system: Sampled, beta: float, points: Any) -> Any:
    """Return the transfer matrices (K, q, q) from d to d̂ at ``points`` z, seen as ``V d``."""
    phi, rows, gain = extended(system, beta)
    n, size, V = system.A.shape[0], phi.shape[0], system.gain
    error, z = (np.eye(size) - gain @ rows) @ phi, np.reshape(points, (-1, 1, 1))
    measured = system.C @ np.linalg.solve(z * np.eye(n) - system.A, system.E)
    found = np.linalg.solve(z * np.eye(size) - error, z * gain @ measured)[:, n:]
    return V @ found @ np.linalg.inv(V)


def single(beta: Any, nu: Any, z: Any) -> Any:
    """Return ``(1 − β)^(ν + 1) z / (z − β)^(ν + 1)``."""
    return z * ((1.0 - beta) / (z - beta)) ** (nu + 1)


# ---- arXiv 2510.01007: several disturbances ----


def test_the_observer_with_its_poles_at_the_origin_is_the_unknown_input_observer() -> None:
    """To 1e-9 for 50 drawn systems whose subsystems are not coupled, with inputs, from any record: noise and unstable poles included."""
    for seed in range(SYSTEMS):
        system, rng = drawn(seed), np.random.default_rng([1007, seed])
        assert seed % 5 or observer_exists(system.A, system.E, system.C), seed
        n, q = system.E.shape
        u, d, x = rng.normal(size=(18, 2)), rng.normal(size=(18, q)), rng.normal(size=n)
        y = np.zeros((18, q))
        for k in range(18):
            y[k] = system.C @ x + 0.1 * rng.normal(size=q)
            x = system.A @ x + system.B @ u[k] + system.E @ d[k]
        forgotten = int(max(system.degrees)) + 2
        found, wanted = observed(system, 0.0, y, u), from_unknown_inputs(system, y, u)
        size = np.max(np.abs(y))
        np.testing.assert_allclose(
            found[forgotten:] / size,
            wanted[forgotten:] / size,
            rtol=0.0,
            atol=1e-9,
            err_msg=str(seed),
        )


def test_the_transfer_function_of_the_error_is_that_of_each_subsystem() -> None:
    """To 1e-9 for 50 drawn systems, poles at 0, 0.3 and 0.8: ``1 − (1 − β)^(ν + 1) z/(z − β)^(ν + 1)`` on the diagonal, nothing beside it."""
    for seed in range(SYSTEMS):
        system = drawn(seed)
        one = np.eye(system.degrees.size)
        for beta in (0.0, 0.3, 0.8):
            found = one - estimate_over_disturbance(system, beta, POINTS)
            wanted = [one - np.diag(single(beta, system.degrees, z)) for z in POINTS]
            assert np.max(np.abs(found - wanted)) < 1e-9, (seed, beta)


def test_coupled_subsystems_need_not_have_that_transfer_function() -> None:
    """The condition of the claim is needed: of 50 drawn coupled systems 37 have it with quell's gain, 13 have not."""
    equal, z = 0, POINTS[1]
    for seed in range(SYSTEMS):
        system = drawn(seed, coupled=True)
        wanted = np.diag(single(0.3, system.degrees, z))
        away = np.max(np.abs(estimate_over_disturbance(system, 0.3, z) - wanted))
        assert away < 1e-9 or away > 1e-3, (seed, away)
        assert away < 1e-9 or np.unique(system.degrees).size > 1, (seed, system.degrees)
        equal += bool(away < 1e-9)
    assert equal == 37


def test_the_error_falls_with_time_and_with_faster_poles_for_steps_but_not_for_sinusoids() -> None:
    """After a step of d the error falls in each sample and with each faster β; under sin(0.3 k) poles at 0.68 leave 1.34 of d, at 0.99 they leave 1.00."""
    betas = np.linspace(0.0, 0.99, 100)
    for nu in (1, 2, 3):
        left = []
        for beta in betas:
            # The response to an impulse: the negative binomial distribution, ν samples late.
            k = np.arange(60)
            weights = (1.0 - beta) ** (nu + 1) * beta**k * [math.comb(i + nu, nu) for i in k]
            left.append(1.0 - np.cumsum(weights))
        assert np.all(np.diff(left, axis=1) <= 1e-12)
        assert np.all(np.diff(left, axis=0) >= -1e-12)
    sizes = np.abs(1.0 - single(betas, 2, np.exp(0.3j)))
    assert betas[int(np.argmax(sizes))] == pytest.approx(0.68)
    assert max(sizes) == pytest.approx(1.342, abs=1e-3)
    assert sizes[-1] == pytest.approx(1.0, abs=1e-3)
    assert sizes[0] == pytest.approx(0.591, abs=1e-3)


@cases("order", [1, 2, 3])
def test_a_plant_that_is_sampled_with_a_hold_has_zeros_and_its_estimate_is_an_average(
    order: int,
) -> None:
    """A chain of n integrators has n − 1 zeros due to sampling: with its poles at the origin the observer returns the mean of n samples of d, not one."""
    A, last = np.diag(np.ones(order - 1), 1), np.eye(order)[:, -1:]
    observer = ql.ESO.state_space(A, last, np.eye(1, order), last, 1.0, omega_o=40.0)
    phi, (step,) = zero_order_hold(A, [last], 1.0)
    running, x, found = observer.estimator(), np.zeros(order), []
    for k in range(8):
        found.append(running.step(x[:1], [0.0])[order])
        x = phi @ x + step[:, 0] * (k == 1)
    # The Eulerian numbers over n!.
    weights = {1: [1.0], 2: [0.5, 0.5], 3: [1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0]}[order]
    wanted = np.zeros(8)
    wanted[2 : 2 + order] = weights
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-9)
    assert bool(observer_exists(phi, step, np.eye(1, order))) == (order == 1)


# ---- arXiv 2208.12314: one disturbance, and zeros ----


def test_with_one_output_the_error_is_gone_after_as_many_samples_as_there_are_states() -> None:
    """To 1e-9 for 50 drawn systems of one output: from any start, a constant d is exact after n + 1 samples and not before."""
    for seed in range(SYSTEMS):
        system, rng = drawn(seed, q=1), np.random.default_rng([12314, seed])
        n = system.A.shape[0]
        x, y, u = rng.normal(size=n), np.zeros((12, 1)), np.zeros((12, 2))
        for k in range(12):
            y[k] = system.C @ x
            x = system.A @ x + 1.7 * system.E[:, 0]
        away = np.abs(observed(system, 0.0, y, u)[:, 0] - 1.7)
        np.testing.assert_allclose(away[n:], 0.0, atol=1e-9, err_msg=str(seed))
        assert away[n - 1] > 1e-3, seed


@cases("zeros", [(-0.1,), (-2.0,), (-0.4, -3.0), (-0.6 + 2.0j, -0.6 - 2.0j)])
def test_an_observer_with_poles_at_the_zeros_follows_f_as_without_zeros(zeros: Any) -> None:
    """``keep_zeros=True``, to 1e-9: ``f̂/f`` has r + 1 equal poles and the zeros due to sampling, no other; without it the plant's zeros are in it."""
    dt, omega_o = 0.01, 20.0
    poles = [-1.0, -0.3, 0.5, -2.5][: len(zeros) + 2]
    plant = ql.plants.LinearPlant.of((3.0 * np.poly(zeros).real, np.poly(poles)))
    found = ql.canonical(plant)
    beta, r, n = math.exp(-omega_o * dt), found.degree, found.a.size
    chain = np.diag(np.ones(n - 1), 1)
    chain[-1] -= found.a
    phi, (step,) = zero_order_hold(chain, [found.E[:, None]], dt)
    for keep in (True, False):
        observer = ql.ESO.model_based(plant, omega_o, dt, keep_zeros=keep)
        given = response(observer.model, n + 1, n)
        for z in POINTS:
            at = np.linalg.solve(z * np.eye(n + 1) - given.transition, given.input[:, 0])
            y = np.linalg.solve(z * np.eye(n) - phi, step[:, 0])[0]
            ratio = (given.output[n] @ at + given.feedthrough[n, 0]) * y
            # Of relative degree 2 there is one zero due to sampling: close to −1, and part of y.
            sampled = of_sampling(phi, step[:, 0], zeros, dt)
            wanted = single(beta, r, z) * np.prod((z - sampled) / (1.0 - sampled))
            error = abs(ratio - wanted)
            assert error < 1e-9 if keep else error > 1e-3


def of_sampling(phi: Matrix, step: Vector, zeros: Any, dt: float) -> Any:
    """Return the zeros of a sampled plant that do not belong to ``zeros`` of the plant."""
    from quell.lti.zeros import invariant_zeros

    found = list(invariant_zeros(phi, step, np.eye(1, step.size)).values)
    for zero in np.exp(np.array(zeros) * dt):
        found.pop(int(np.argmin(np.abs(np.array(found) - zero))))
    return np.array(found)


def test_slow_zeros_enlarge_the_estimate_of_an_observer_without_poles_at_them() -> None:
    """A unit step of f, ω_o = 20 rad/s, a zero at −0.1 rad/s: the estimate reaches 45, with ``keep_zeros`` 1.0."""
    plant = ql.plants.LinearPlant.of((3.0 * np.poly([-0.1]), np.poly([-1.0, -0.3, 0.5])))
    phi, (step,) = zero_order_hold(plant.A, [np.reshape(plant.E, (3, -1))[:, :1]], 1e-3)
    largest = {}
    for keep in (False, True):
        observer = ql.ESO.model_based(plant, 20.0, 1e-3, keep_zeros=keep)
        given, x, f = response(observer.model, 4, 3), np.zeros(3), []
        z = np.zeros(given.transition.shape[0])
        for _ in range(2000):
            y = float(np.ravel(plant.C @ x)[0])
            f.append(given.output[3] @ z + given.feedthrough[3, 0] * y)
            z = given.transition @ z + given.input[:, 0] * y
            x = phi @ x + step[:, 0]
        largest[keep] = max(f) / ql.canonical(plant).f_gain
    assert largest[False] == pytest.approx(45.2, abs=0.1)
    assert largest[True] == pytest.approx(1.0, abs=1e-6)


# ---- arXiv 2512.05292: a compensator and a band above a closed drive ----


@pytest.mark.trial
def test_a_compensator_above_a_closed_drive_tracks_better_and_keeps_its_band() -> None:
    """The setting of the paper, figures of quell's own: a joint with a hidden speed loop and a payload of 2 kg, three seconds of ``benchmarks/compensator.py``."""
    found = benchmark("compensator").on_the_joint(True)
    assert found["compensator"]["without payload, over alone"] < 0.3
    assert found["compensator"]["with payload, over alone"] < 0.1
    assert found["outer controller alone"]["max |y| at r = 1.0"] > 0.85
    assert found["model-based, with a safe set, r = 0.5"]["max |y| at r = 1.0"] < 0.85
