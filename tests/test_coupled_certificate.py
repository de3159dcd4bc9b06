"""Certificates of guarded axes that act on each other."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell import analysis
from quell.analysis import certify, certify_coupled
from quell.analysis.coupled import coupled_loop
from quell.guard.guard import state_path
from quell.lti.models import MatrixSystem, System, zero_order_hold
from quell.types import Matrix

DT = 0.005


def axis(order: int = 2, omega_o: float = 10.0, b0: float = 1.0, kappa: float = 1.2) -> ql.ADRC:
    """Return an axis with a guarded learner."""
    observer = ql.ESO.model_free(order=order, b0=b0, omega_o=omega_o, dt=DT)
    guard = ql.Guard(bound=kappa)
    learner = ql.learners.Kalman()
    return ql.ADRC(observer, omega_c=omega_o / 10.0, learner=learner, guard=guard)


def inertias(gains: Any) -> tuple[Matrix, Matrix, Matrix]:
    """Return double integrators with a gain matrix."""
    size = len(gains)
    A, B = np.kron(np.eye(size), [[0.0, 1.0], [0.0, 0.0]]), np.kron(gains, [[0.0], [1.0]])
    return A, B, np.kron(np.eye(size), [[1.0, 0.0]])


def random_system(rng: np.random.Generator, size: int, states: int = 4) -> MatrixSystem:
    """Return a stable system from e to q that does not follow e at once."""
    A = rng.normal(size=(states, states))
    A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
    B, C = rng.normal(size=(states, size)), rng.normal(size=(size, states))
    return MatrixSystem(A - np.eye(states), B, C, np.zeros((size, size)))


@pytest.mark.parametrize(
    ("order", "b", "b0", "delay"), [(2, 1.3, 1.0, 0), (1, 0.7, 1.0, 4), (2, 5200.0, 5000.0, 0)]
)
def test_one_axis_has_the_bounds_of_certify(order: int, b: float, b0: float, delay: int) -> None:
    """Γ and Γ_y to the accuracy of the sums, with delays, and for an inertia of 2e-4."""
    single = analysis.certify(([b], [1.0, *[0.0] * order]), axis(order, b0=b0), delay=delay * DT)
    plant = ql.plants.LinearPlant(
        np.diag(np.ones(order - 1), 1), b * np.eye(order)[:, -1:], np.eye(order)[:1]
    )
    late = ql.plants.delayed_inputs(plant, delay * DT, DT)
    found = certify(late, ql.Axes([axis(order)], [[b0]]))
    assert found.gains[0, 0] == pytest.approx(single.gain, rel=1e-5)
    assert found.output_gains is not None
    assert found.output_gains[0, 0] == pytest.approx(single.output_gain, rel=1e-5)
    assert found.certified == single.certified
    assert found.error_bound([2.0])[0] == pytest.approx(single.error_bound(2.0), rel=1e-5)
    assert found.output_bound([2.0])[0] == pytest.approx(single.output_bound(2.0), rel=1e-5)
    assert found.largest_factor * 1.2 == pytest.approx(single.largest_kappa, rel=1e-5)


def test_axes_that_b0_decouples_are_certified_one_by_one() -> None:
    """With the true B0 each axis is the chain of its observer, and Γ is that of the chain."""
    true = np.array([[2.0, -0.9], [-0.9, 1.5]])
    both = {"x": axis(), "y": axis(omega_o=20.0)}
    found = certify(inertias(true), ql.Axes(both, true))
    np.testing.assert_allclose(found.gains, 0.0, atol=1e-8)
    assert found.certified
    assert found.spectral_radius < 1e-7
    off = certify(inertias(1.3 * true), ql.Axes(both, true))
    for i, omega_o in enumerate((10.0, 20.0)):
        single = analysis.certify(([1.3], [1.0, 0.0, 0.0]), axis(omega_o=omega_o))
        assert off.gains[i, i] == pytest.approx(single.gain, rel=1e-5)
    assert off.gains[0, 1] < 1e-7
    assert off.weakest in off.axes


def test_the_gains_are_those_of_the_loop_with_the_controllers_themselves() -> None:
    """A pulse of the learner's output in one axis moves the q of both as the loop says.

    The observers and laws run as quell's own kernels do, through ``linear_law``; a pulse of e_L in
    terms of v is added by hand.
    """
    true, known = np.array([[1.2, 0.4], [0.3, 0.9]]), np.array([[1.0, 0.1], [0.0, 1.0]])
    A, B, C = inertias(true)
    A, (B,) = zero_order_hold(A, [B], DT)
    plain = [
        ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=w, dt=DT), omega_c=w / 10.0)
        for w in (10.0, 15.0)
    ]
    to_error, to_output = coupled_loop((A, B, C), plain, np.linalg.inv(known))
    laws = [analysis.linear_law(each) for each in plain]
    x, states = np.zeros(4), [np.zeros(law.A.shape[0]) for law in laws]
    K = np.linalg.inv(known)
    # The path from e_L to w starts with its feedthrough of one: w[0] = e_L[0].
    pulse, expected, w = np.zeros((60, 2)), np.zeros((60, 2)), np.zeros((60, 2))
    path = state_path(plain[0].observer, plain[0].parameters.law)
    inner = np.zeros(path.N.shape[0])
    for k in range(60):
        w[k, 0] = path.C @ inner + path.D * float(k == 0)
        inner = inner + path.N @ inner + path.B * float(k == 0)
    for k in range(60):
        y = C @ x
        expected[k] = y
        v = np.zeros(2)
        for i, law in enumerate(laws):
            v[i] = law.C @ states[i] + law.D_y * y[i] - w[k, i]
            states[i] = law.A @ states[i] + law.B_y * y[i] + law.B_u * v[i]
        x = A @ x + B @ (K @ v)
    state = np.zeros(to_output.N.shape[0])
    for k in range(60):
        pulse[k] = to_output.C @ state
        state = state + to_output.N @ state + to_output.B[:, 0] * float(k == 0)
    np.testing.assert_allclose(pulse, expected, atol=1e-12)
    assert to_error.N.shape == to_output.N.shape


@pytest.mark.parametrize("seed", range(20))
def test_no_learners_exceed_the_bounds_and_none_are_certified_beyond_them(seed: int) -> None:
    """Corrections that push each q as hard as they may, in random loops of two or three axes."""
    rng = np.random.default_rng([71, seed])
    size = int(rng.integers(2, 4))
    system = random_system(rng, size)
    gains = certify_coupled(system, np.ones(size))
    rho = rng.uniform(0.3, 0.9)
    K = rng.uniform(0.0, 1.0, (size, size))
    K *= rho / certify_coupled(system, K).spectral_radius
    found = certify_coupled(system, K)
    np.testing.assert_allclose(found.gains, gains.gains)
    assert found.certified
    assert found.largest_factor == pytest.approx(1.0 / rho)
    A = system.N + np.eye(system.N.shape[0])
    pulses = np.array([system.C @ np.linalg.matrix_power(A, k) @ system.B for k in range(60)])
    for goal in range(size):
        x, e, past = np.zeros(A.shape[0]), np.zeros(size), np.zeros(size)
        for k in range(600):
            q = 1.0 + system.C @ x  # q_0 is one in all axes
            past = np.maximum(past, np.abs(q))
            # The sign with which a pulse now will move q of the goal at the end of its stage.
            later = pulses[59 - k % 60, goal]
            e = np.where(later < 0.0, -1.0, 1.0) * (K @ past)
            x = A @ x + system.B @ e
        assert np.all(past <= found.error_bound(np.ones(size)) * (1.0 + 1e-9))
        assert past[goal] > 1.0


def test_the_condition_is_necessary_in_a_loop_of_two() -> None:
    """Beyond a spectral radius of one there are corrections within K that lose the loop.

    e_2 moves q_1 and e_1 moves q_2, each by half of a sum of 4: no axis alone has any gain.
    """
    row = System(np.array([[-0.5]]), np.array([1.0]), np.array([1.0]), 0.0)  # Γ = 2
    blocks = [[None, row], [row, None]]
    assert certify_coupled(blocks, [0.45, 0.55]).certified
    found = certify_coupled(blocks, [0.6, 0.6])
    assert found.spectral_radius == pytest.approx(1.2, rel=1e-5)
    assert np.all(np.isinf(found.error_bound([1.0, 1.0])))
    assert str(found).startswith("not certified: ρ(ΓK) = 1.2 must be below 1: multiply all κ by")
    x, past = np.zeros(2), np.ones(2)
    for _ in range(1000):
        past = np.maximum(past, np.abs(1.0 + x[::-1]))
        x = 0.5 * x + 0.6 * past
    assert past[0] > 1e20


def test_a_weak_axis_is_named_and_the_file_has_everything() -> None:
    """The axis whose κ lowers the spectral radius most."""
    row = System(np.array([[-0.5]]), np.array([1.0]), np.array([1.0]), 0.0)
    small = row._replace(C=np.array([0.1]))
    found = certify_coupled([[small, small], [small, row]], [1.0, 1.0], axes=("x", "y"))
    assert found.weakest == "y"
    saved = json.loads(json.dumps(found.to_json()))
    assert saved["certified"] is False
    assert saved["error_factors"] == [[None, None], [None, None]]
    assert saved["gains"][1][1] == pytest.approx(2.0, rel=1e-5)
    with pytest.raises(ValueError, match="certify with to_output"):
        found.output_bound([1.0, 1.0])


@pytest.mark.compiled
def test_what_the_bounds_do_not_cover_is_said() -> None:
    """Limits, encoders, large motions, a B0 that moves; nothing for a linear loop."""
    robot = ql.plants.arm(gravity=0.0)
    axes = ql.Axes([axis(), axis()], M=robot.inertia, u_max=5.0)
    pose = ([0.3, 1.0, 0.0, 0.0], [0.0, 0.0])
    found = certify(ql.plants.encoded_outputs(robot, 1e-5), axes, pose)
    assert found.certified
    assert found.spectral_radius < 1e-2
    assert len(found.excluded) == 4
    assert str(found).splitlines()[-1].startswith("not covered: times when u is limited;")
    plain = certify(inertias(np.eye(2)), ql.Axes([axis(), axis()]))
    assert plain.excluded == ()
    assert "not covered" not in str(plain)


def test_the_verdict_of_axes_names_those_that_learn_without_guard() -> None:
    """Axes without learner need no guard; without any learner there is nothing to certify."""

    def line(**axes: ql.ADRC) -> str:
        return str(certify(inertias(np.eye(2)), ql.Axes(axes))).splitlines()[0]

    guarded = axis()
    free = ql.ADRC(guarded.observer, omega_c=1.0, learner=ql.learners.Kalman())
    plain = ql.ADRC(guarded.observer, omega_c=1.0)
    assert line(x=guarded, y=free) == "NOT guarded: y: holds with guard=Guard()"
    assert line(x=plain, y=guarded).startswith("certified: ")
    assert line(x=plain, y=plain).startswith("no learner: nothing to certify")


def test_what_cannot_be_certified_is_refused() -> None:
    """Unstable loops, matrices that do not fit, bounds that are none."""
    row = System(np.array([[-0.5]]), np.array([1.0]), np.array([1.0]), 0.0)
    unstable = row._replace(N=np.array([[0.1]]))
    with pytest.raises(
        ValueError, match=r"to_error\[0\]\[1\] is unstable, with a pole at \|z\| = 1\.1"
    ):
        certify_coupled([[row, unstable], [None, row]], [1.0, 1.0])
    with pytest.raises(ValueError, match="to_error has 1 outputs and 2 inputs: must have one q"):
        certify_coupled([[row, row]], [1.0, 1.0])
    with pytest.raises(ValueError, match=r"uncertain has shape \(3,\): must be \(2, 2\)"):
        certify_coupled([[row, row], [row, row]], [1.0, 1.0, 1.0])
    with pytest.raises(ValueError, match="must not be negative, it has bounds"):
        certify_coupled([[row]], [-1.0])
    with pytest.raises(ValueError, match="q_0 = .*must not be negative"):
        certify_coupled([[row]], [0.1]).error_bound([-1.0])
    with pytest.raises(ValueError, match="plant has 2 inputs and 2 outputs: must have an output"):
        certify(inertias(np.eye(2)), ql.Axes([axis()]))
    with pytest.raises(ValueError, match=r"to_error.* is unstable"):
        certify(inertias(-np.eye(2)), ql.Axes([axis(), axis()]))
