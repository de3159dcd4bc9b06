"""Invariant zeros, unobservable modes, and the existence of an observer for x and w."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

from quell.lti.zeros import invariant_zeros, observer_exists, unobservable_modes
from quell.types import Matrix

from .cases import cases


class Built(NamedTuple):
    """A system that was built around its zeros."""

    A: Matrix
    E: Matrix
    C: Matrix
    zeros: Any  # (k,)


def built(rng: np.random.Generator, zeros: Any, q: int, extra: int = 0, sees: int = 0) -> Built:
    """Return a system with q disturbances, q + ``extra`` outputs, and the given invariant zeros.

    In its normal form each of q outputs is the end of a chain of integrators, and the states with
    the zeros as their eigenvalues are driven by these outputs and act only where w enters. The
    extra outputs show the chains, and the last ``sees`` of the zeros' states, whose eigenvalues
    are therefore no zeros. Coordinates, mixtures and units are random.
    """
    block = real_blocks(zeros, rng)
    k = block.shape[0]
    degrees = rng.integers(1, 4, q)
    ends = np.cumsum(degrees)
    n = k + int(ends[-1])
    A, E, C = np.zeros((n, n)), np.zeros((n, q)), np.zeros((q + extra, n))
    A[:k, :k] = block
    for i, (end, degree) in enumerate(zip(ends, degrees, strict=True)):
        first, last = k + end - degree, k + end - 1
        for j in range(first, last):
            A[j, j + 1] = 1.0
        A[last] = rng.normal(size=n)
        A[:k, first] = rng.normal(size=k)
        E[last, i], C[i, first] = 1.0, 1.0
    if extra:
        C[q:, k:] = rng.normal(size=(extra, n - k))
        C[q:, k - sees : k] = rng.normal(size=(extra, sees))
    mixed = np.linalg.qr(rng.normal(size=(n, n)))[0]
    A, E, C = mixed @ A @ mixed.T, mixed @ E, C @ mixed.T
    E = E @ well_conditioned(rng, q)
    C = well_conditioned(rng, q + extra) @ C
    units, channels, sensors = (10.0 ** rng.uniform(-6.0, 6.0, s) for s in (n, q, q + extra))
    A, E, C = A * units[:, None] / units, E * units[:, None] * channels, C / units
    return Built(A, E, C * sensors[:, None], zeros[: k - sees])


def real_blocks(zeros: Any, rng: np.random.Generator) -> Matrix:
    """Return a real block-diagonal matrix with the eigenvalues; conjugates stand side by side."""
    size, at = len(zeros), 0
    block = np.zeros((size, size))
    while at < size:
        z = complex(zeros[at])
        if z.imag:
            block[at : at + 2, at : at + 2] = [[z.real, z.imag], [-z.imag, z.real]]
            at += 2
        else:
            block[at, at] = z.real
            at += 1
    return block


def well_conditioned(rng: np.random.Generator, size: int) -> Matrix:
    """Return an invertible matrix with singular values between 0.5 and 2."""
    left, right = (np.linalg.qr(rng.normal(size=(size, size)))[0] for _ in range(2))
    return left @ np.diag(rng.uniform(0.5, 2.0, size)) @ right


def drawn_zeros(rng: np.random.Generator, count: int) -> Any:
    """Return so many zeros at least 0.2 apart: real ones, one at 0 now and then, and pairs."""
    while True:
        found: list[complex] = []
        while len(found) < count:
            kind = rng.integers(3) if count - len(found) > 1 else rng.integers(2)
            if kind == 2:
                z = complex(rng.uniform(-2.0, 2.0), rng.uniform(0.3, 3.0))
                found += [z, z.conjugate()]
            else:
                found.append(complex(rng.uniform(-3.0, 3.0) if kind else 0.0))
        zeros = np.array(found)
        apart = np.abs(zeros[:, None] - zeros) + 9.0 * np.eye(count)
        if np.min(apart, initial=9.0) > 0.2:
            return zeros


def distance(found: Any, expected: Any) -> float:
    """Return the largest distance of the pairs when each found zero gets its nearest one."""
    from scipy.optimize import linear_sum_assignment

    if len(found) != len(expected):
        return np.inf
    away = np.abs(np.subtract.outer(np.asarray(found), np.asarray(expected)))
    return float(np.max(away[linear_sum_assignment(away)], initial=0.0))


@pytest.mark.parametrize("seed", range(200))
def test_existence_is_judged_rightly_and_each_zero_is_named(seed: int) -> None:
    """200 random systems, half of them with zeros, in units from 1e-6 to 1e6; some not square."""
    rng = np.random.default_rng([51, seed])
    count = 0 if seed % 2 else int(rng.integers(1, 4))
    q, extra = int(rng.integers(1, 4)), int(rng.integers(0, 3))
    seen = int(rng.integers(0, 3)) if extra else 0
    zeros = drawn_zeros(rng, count)
    system = built(rng, np.append(zeros, rng.uniform(4.0, 8.0, seen)), q, extra, seen)
    found = observer_exists(system.A, system.E, system.C)
    assert found.observable
    assert found.zeros.rank == q
    assert found.zeros.doubt is None
    assert distance(found.zeros.values, zeros) < 1e-6
    assert found.exists == (count == 0)
    assert found.finds_polynomials == (0.0 not in zeros)
    for zero in zeros[zeros.imag >= 0.0]:
        named = "at 0:" if zero == 0.0 else f"{zero.real:.4g}"
        assert named in str(found)


def test_a_repeated_zero_at_rest_is_found_as_exactly_zero() -> None:
    """A double zero at 0 strays by the root of the rounding errors; the report has 0."""
    rng = np.random.default_rng(7)
    A = np.array([[0.0, 1.0], [0.0, 0.0]])
    system = built(rng, [0.0], 1)
    n = 2 + system.A.shape[0]
    big = np.zeros((n, n))
    big[:2, :2], big[2:, 2:] = A, system.A
    big[1, 2:] = system.C[0]  # a double integrator that the output drives: two more zeros at 0
    E = np.vstack([np.zeros((2, 1)), system.E])
    found = invariant_zeros(big, E, np.hstack([np.zeros((1, 2)), system.C]))
    assert found.values.tolist() == [0.0, 0.0, 0.0]


@cases("seed", range(20))
def test_zeros_of_a_system_with_more_inputs_than_outputs_are_those_of_its_transpose(
    seed: int,
) -> None:
    """The pencil's rank does not change when it is transposed."""
    rng = np.random.default_rng([53, seed])
    zeros = drawn_zeros(rng, int(rng.integers(0, 4)))
    A, E, C, _ = built(rng, zeros, 2, extra=1)
    found = invariant_zeros(A.T, C.T, E.T)
    assert (found.rank, found.full_rank) == (2, False)
    assert distance(found.values, zeros) < 1e-6
    assert found.states.shape == (0, A.shape[0])


def test_the_motion_of_a_zero_leaves_the_outputs_at_zero() -> None:
    """``P(z) [x_0; u_0] = 0`` in the user's units, relative to the sizes of its terms."""
    A, E, C, zeros = built(np.random.default_rng(3), np.array([-1.0, 0.5 + 2j, 0.5 - 2j]), 2, 1)
    found = invariant_zeros(A, E, C)
    assert len(found.values) == len(zeros)
    for z, x, u in zip(found.values, found.states, found.inputs, strict=True):
        terms = np.abs(A) @ np.abs(x) + np.abs(E) @ np.abs(u)
        assert np.all(np.abs(A @ x + E @ u - z * x) < 1e-10 * terms)
        assert np.all(np.abs(C @ x) < 1e-10 * (np.abs(C) @ np.abs(x)))


def test_disturbances_that_one_combination_hides_are_refused_with_their_rank() -> None:
    """Three disturbances of which the third is a mixture, and three with two outputs."""
    A, E, C, _ = built(np.random.default_rng(11), np.zeros(0), 2, extra=1)
    mixed = observer_exists(A, np.column_stack([E, E @ [1.0, -2.0]]), C)
    assert mixed.observable
    assert not mixed
    assert not mixed.finds_polynomials
    assert "cannot be told apart: from w to y the system has the rank 2" in str(mixed)
    A, E, C, _ = built(np.random.default_rng(12), np.zeros(0), 3)
    few = observer_exists(A, E, C[:2])
    assert "for 3 disturbances and 2 outputs; keep 2 columns of E" in str(few)


@cases("seed", range(40))
def test_each_unobservable_mode_is_named(seed: int) -> None:
    """Modes that no output shows, in random coordinates and units, and none where all are shown."""
    rng = np.random.default_rng([54, seed])
    hidden = drawn_zeros(rng, int(rng.integers(0, 3)))
    k, n, p = len(hidden), len(hidden) + int(rng.integers(1, 5)), int(rng.integers(1, 3))
    A = np.zeros((n, n))
    A[:k] = np.hstack([real_blocks(hidden, rng), rng.normal(size=(k, n - k))])
    A[k:, k:] = rng.normal(size=(n - k, n - k))
    C = np.hstack([np.zeros((p, k)), rng.normal(size=(p, n - k))])
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    units = 10.0 ** rng.uniform(-6.0, 6.0, n)
    A, C = turn @ A @ turn.T * units[:, None] / units, C @ turn.T / units
    found = observer_exists(A, rng.normal(size=n) * units, C)
    assert distance(found.unobservable.values, hidden) < 1e-6
    assert found.observable == (k == 0)
    assert str(found).count("is not observable: the mode at") == np.count_nonzero(hidden.imag >= 0)
    modes = unobservable_modes(A, C)
    for mode, x in zip(modes.values, modes.states, strict=True):
        np.testing.assert_allclose(A @ x / units, mode * x / units, atol=1e-9)


def test_a_motor_and_a_load_in_real_units() -> None:
    """Inertia 2e-4 kg m², a coupling of 50 N m/rad, a slide in µm with an encoder in µm.

    At the motor a force on the slide is found. A torque on the motor has the zeros of the slide on
    its spring; with a sensor at the slide as well there are none.
    """
    J, m, k, d, lead = 2e-4, 1.5, 50.0, 0.01, 0.005 / (2.0 * np.pi)
    # x: angle [rad], speed [rad/s], slide [µm], its speed [µm/s]; the spring acts on angle − x/lead
    spring = np.array([1.0, 0.0, -1e-6 / lead, 0.0])
    damper = np.array([0.0, 1.0, 0.0, -1e-6 / lead])
    torque = k * spring + d * damper
    A = np.array([[0, 1, 0, 0], -torque / J, [0, 0, 0, 1], 1e6 * torque / lead / m])
    motor, slide = np.array([0, 1 / J, 0, 0]), np.array([0, 0, 0, 1e6 / m])
    angle, place = np.array([1.0, 0, 0, 0]), np.array([0, 0, 1.0, 0])
    assert observer_exists(A, motor, np.vstack([angle, place]))
    assert observer_exists(A, np.column_stack([motor, slide]), np.vstack([angle, place]))
    force = observer_exists(A, slide, angle)  # damper: the zero at −k/d
    np.testing.assert_allclose(force.zeros.values, [-k / d], rtol=1e-9)
    at_motor = observer_exists(A, motor, angle)
    own = np.roots([m, d / lead**2, k / lead**2])
    assert distance(at_motor.zeros.values, own) < 1e-9 * abs(own[0])
    assert at_motor.finds_polynomials
    assert "w1 moves as e^(st) with x3 and x4" in str(at_motor)
    speed = observer_exists(A, motor, np.array([0, 1.0, 0, 0]))
    assert "the mode at 0, a motion of x1 and x3" in str(speed)


def test_rounding_errors_in_place_of_zeros_change_nothing() -> None:
    """Entries of 1e-17 in A, E and D do not become paths by scaling."""
    rng = np.random.default_rng(5)
    A = np.array([[0, 1, 0, 0], [-1, 0, 1, 0], [0, 0, 0, 1], [1, 0, -1, 0]], dtype=float)
    dirt = 1e-17 * rng.normal(size=(4, 4))
    E, C = np.array([[0, 0, 0, 1.0]]).T, np.array([[1.0, 0, 0, 0]])
    found = invariant_zeros(A + dirt, E + 1e-17 * rng.normal(size=(4, 1)), C, [[1e-17]])
    assert found.values.size == 0
    chain = np.diag(np.ones(3), 1)
    assert invariant_zeros(chain + dirt, E, C).values.size == 0


def test_a_model_close_to_another_rank_is_not_certain() -> None:
    """A path of 1e-11 beside one of 1 may be a rounding error or not: the report says NOT."""
    A = np.diag([-1.0, -2.0])
    C = np.eye(2)
    E = np.array([[1.0, 1.0], [1.0, 1.0 + 3e-10]])
    found = observer_exists(A, E, C)
    assert str(found).splitlines()[-1].startswith("NOT certain: a relative singular value of")


def test_matrices_that_do_not_fit_are_refused_with_both_shapes() -> None:
    """The error says what rows and columns stand for."""
    A = np.eye(3)
    with pytest.raises(
        ValueError, match=r"E has shape \(2, 1\) and A has shape \(3, 3\): .*states"
    ):
        observer_exists(A, [[1.0], [1.0]], [1.0, 0.0, 0.0])
    with pytest.raises(
        ValueError, match=r"C has shape \(1, 2\) and A has shape \(3, 3\): .*output"
    ):
        unobservable_modes(A, [1.0, 0.0])
    with pytest.raises(ValueError, match=r"D has shape \(1, 1\): must be \(1, 2\).*outputs"):
        invariant_zeros(A, np.ones((3, 2)), [1.0, 0.0, 0.0], 0.0)
    with pytest.raises(ValueError, match=r"A has shape \(2, 3\): must be square"):
        unobservable_modes(np.ones((2, 3)), [1.0, 0.0])
