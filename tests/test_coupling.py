"""The relative gain array, and the advice that follows from it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse, coupling, invariant_zeros, relative_gains
from quell.analysis.coupling import is_turned
from quell.analysis.matrices import sampled_matrices
from quell.lti.models import zero_order_hold
from quell.plants.linear import LinearModelOfMany
from quell.types import Matrix

from .cases import cases


def sampled(A: Any, B: Any, C: Any) -> LinearModelOfMany:
    """Return a sampled plant without disturbances."""
    return LinearModelOfMany(A, B, np.zeros((len(A), 0)), C)


DT = 1e-3


def chains(B0: Any, order: int = 2, delays: Any = (), dt: float = DT) -> Any:
    """Return axes that integrate ``order`` times, inputs late by samples, as sampled matrices."""
    B0 = np.asarray(B0, dtype=float)
    axes = B0.shape[0]
    A = np.kron(np.eye(axes), np.diag(np.ones(order - 1), 1))
    B = np.kron(B0, np.eye(order)[:, -1:])
    A, (B,) = zero_order_hold(A, [B], dt)
    C = np.kron(np.eye(axes), np.eye(order)[:1])
    for j, samples in enumerate(delays):
        for _ in range(samples):
            n = A.shape[0]
            A = np.block([[A, B[:, j : j + 1]], [np.zeros((1, n + 1))]])
            B = np.vstack([B, np.zeros((1, axes))])
            B[:n, j], B[n, j] = 0.0, 1.0
            C = np.hstack([C, np.zeros((axes, 1))])
    return sampled(A, B, C)


def leaky(G: Any, times: Any = (1.0, 3.0)) -> Any:
    """Return ``G diag(1/(T s + 1))``, a plant with gains at rest, as sampled matrices."""
    times = np.asarray(times)
    A, (B,) = zero_order_hold(-np.diag(1.0 / times), [np.diag(1.0 / times)], DT)
    return sampled(A, B, np.asarray(G, dtype=float))


def test_relative_gains_are_those_of_the_definition_and_independent_of_units() -> None:
    """λ_ij by its definition, the gain with the others at rest over that with them held."""
    rng = np.random.default_rng(1)
    G = rng.normal(size=(3, 3))
    expected = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            # u_j moves y_i; the other inputs hold the other outputs at rest.
            rows, columns = [k for k in range(3) if k != i], [k for k in range(3) if k != j]
            others = np.linalg.solve(G[np.ix_(rows, columns)], -G[rows, j])
            expected[i, j] = G[i, j] / (G[i, j] + G[i, columns] @ others)
    units = 10.0 ** rng.uniform(-9.0, 9.0, (2, 3))
    np.testing.assert_allclose(relative_gains(G), expected, rtol=1e-9)
    np.testing.assert_allclose(
        relative_gains(G * units[0][:, None] * units[1]), expected, rtol=1e-7
    )
    wide = relative_gains(rng.normal(size=(2, 4)))
    np.testing.assert_allclose(wide.sum(axis=1), 1.0, rtol=1e-9)


def test_a_wood_berry_column_has_its_published_array() -> None:
    """λ_11 = 2.01 for the gains 12.8, −18.9, 6.6, −19.4 (Wood & Berry 1973)."""
    found = coupling(leaky([[12.8, -18.9], [6.6, -19.4]]), DT)
    assert found.at[0].where == "at rest"
    assert found.at[0].relative[0, 0].real == pytest.approx(2.01, abs=0.005)
    assert found.factor == pytest.approx(2.01, abs=0.005)
    assert found.advice.startswith("axis 1 and axis 2 are coupled by 2 at rest: use B0 (an error")


@cases("order", [1, 2, 4])
@cases("delays", [(), (3, 5, 0)])
def test_a_plant_that_integrates_is_judged_by_b0(order: int, delays: Any) -> None:
    """Inertias of 2e-4, dead times of several samples that differ: Λ of B0 to rounding."""
    M = np.array([[2.0, 0.8, 0.1], [0.8, 1.0, 0.3], [0.1, 0.3, 0.5]]) * 2e-4
    B0 = np.linalg.inv(M)
    found = coupling(chains(B0, order, delays), DT, bandwidth=20.0)
    assert [gains.where for gains in found.at] == ["B0", "at 20 rad/s"]
    np.testing.assert_allclose(found.at[0].relative, B0 * M.T, atol=1e-6)
    # A dead time turns the phase of a column, which Λ does not show.
    np.testing.assert_allclose(found.at[1].relative, B0 * M.T, atol=1e-6)
    assert found.decided
    assert found.factor == pytest.approx(np.max(np.diag(B0 * M.T)), rel=1e-6)


def test_axes_that_hardly_notice_each_other_need_no_b0() -> None:
    """A gain of 1.04 is no reason for a matrix."""
    found = coupling(chains([[1.0, 0.2], [0.2, 1.0]]), DT, axes=("x", "y"))
    assert found.advice == (
        "the axes hardly notice each other in B0 (with the other loops closed a gain changes by a "
        "factor of 1.04 at most): a controller for each axis, with its own b0, is enough"
    )


def test_a_motion_one_way_is_told_although_the_relative_gains_are_one() -> None:
    """Λ of a triangular matrix is that of a diagonal one."""
    found = coupling(chains([[1.0, 5.0], [0.0, 1.0]]), DT)
    assert found.factor == pytest.approx(1.0)
    assert found.advice.startswith("axis 2 moves axis 1 in B0, but not the other way: the loops")


def test_wrong_pairs_and_changes_of_sign_are_told() -> None:
    """Inputs that are exchanged, in two of three axes; and an axis whose sign depends on others."""
    swapped = coupling(chains([[0.1, 1.0, 0.0], [1.0, 0.1, 0.0], [0.0, 0.0, 2.0]]), DT)
    assert "paired with the wrong inputs in B0: move axis 1 by input 2, axis 2 by input 1" in (
        swapped.advice
    )
    G = np.array([[1.0, 2.0, -3.0], [1.5, 1.0, 2.0], [2.5, 1.0, 1.0]])
    assert np.diag(relative_gains(G)).real.min() < 0.0
    turned = coupling(leaky(G, (1.0, 2.0, 3.0)), DT)
    assert turned.factor == np.inf
    assert "changes its sign" in turned.advice or "wrong inputs" in turned.advice


def test_singular_and_nearly_singular_gains_are_not_decided() -> None:
    """Rank one in any units, and a matrix that an error of a part in a thousand makes singular."""
    B0 = np.array([[1.0, 2.0], [2.0, 4.0]])
    for units in ((1.0, 1.0), (1e-6, 1e6)):
        scaled: Matrix = B0 * np.array(units)[:, None]
        found = coupling(chains(scaled), DT)
        assert not found.decided
        assert np.isnan(found.factor)
        assert found.advice.startswith("NOT decided in B0: the gains are singular, of the rank 1")
    found = coupling(leaky([[1.0, 1.0], [1.0, 1.001]]), DT)
    assert found.advice.startswith("NOT decided at rest: the largest relative gain is 1e+03, so an")
    known = coupling(leaky([[1.0, 1.0], [1.0, 1.05]]), DT)
    assert "use B0, known to much better than 4.8 %" in known.advice


def test_what_cannot_be_judged_is_refused() -> None:
    """Other numbers of inputs, outputs that nothing moves, frequencies that do not exist."""
    A, B, _, C = chains(np.eye(2))
    with pytest.raises(ValueError, match=r"B has shape \(4, 1\) and C has shape \(2, 4\): an axis"):
        coupling(sampled(A, B[:, :1], C), DT)
    with pytest.raises(ValueError, match="output 2 of the plant: no input moves it"):
        coupling(chains([[1.0, 1.0], [0.0, 0.0]]), DT)
    with pytest.raises(ValueError, match="input 1 of the plant: it moves no output"):
        coupling(chains([[0.0, 1.0], [0.0, 1.0]]), DT)
    with pytest.raises(ValueError, match=r"bandwidth = 4000\.0 rad/s: must be at most half"):
        coupling(sampled(A, B, C), DT, bandwidth=4000.0)
    with pytest.raises(ValueError, match="its rank is not full"):
        relative_gains([[1.0, 2.0], [2.0, 4.0]])
    with pytest.raises(ValueError, match="axes = .*: must be 2 different names"):
        coupling(sampled(A, B, C), DT, axes=("x", "x"))


def tanks(shares: tuple[float, float]) -> ql.plants.LinearPlant:
    """Return the quadruple tank (Johansson, IEEE Trans. Control Syst. Technol. 8, 2000), [cm], [V].

    Two pumps fill the lower tanks, which are measured, with these shares, and cross over the upper
    ones with the rest. Shares with a sum below one give a zero in the right half plane.
    """
    a, b = shares
    A = [
        [-1 / 62, 0.0, 0.041, 0.0],
        [0.0, -1 / 90, 0.0, 0.033],
        [0.0, 0.0, -1 / 23, 0.0],
        [0.0, 0.0, 0.0, -1 / 30],
    ]
    B = [
        [a * 3.33 / 28, 0.0],
        [0.0, b * 3.35 / 32],
        [0.0, (1 - b) * 3.35 / 28],
        [(1 - a) * 3.33 / 32, 0.0],
    ]
    return ql.plants.LinearPlant(A, B, np.eye(4)[:2])


def test_a_zero_in_the_right_half_plane_is_named_and_b0_is_no_remedy() -> None:
    """The zero of a quadruple tank, of its model in continuous time; with more share below there is none, and B0 is proposed."""
    found = coupling(tanks((0.43, 0.34)), 1.0, bandwidth=0.01, axes=("h1", "h2"))
    assert found.pairing == (1, 0)
    (zero,) = found.zeros
    plant = tanks((0.43, 0.34))
    exact = max(invariant_zeros(plant.A, plant.B, plant.C).values.real)
    assert zero == pytest.approx(exact, rel=1e-3)
    assert found.advice.splitlines()[0] == (
        "the axes are paired with the wrong inputs at rest: move h1 by input 2, h2 by input 1"
    )
    assert "a zero in the right half plane, at 0.0208" in found.advice.splitlines()[-1]
    assert "use B0" not in found.advice
    sound = coupling(tanks((0.7, 0.6)), 1.0, bandwidth=0.01)
    assert sound.zeros == ()
    assert "use B0" in sound.advice
    # A zero far above the bandwidth, and those of sampling, are no matter.
    assert coupling(tanks((0.43, 0.34)), 1.0, bandwidth=1e-3).zeros == ()
    assert coupling(chains(np.eye(2), 4), DT).zeros == ()


@pytest.mark.parametrize("shares", [(0.43, 0.34), (0.7, 0.6)])
def test_where_gains_at_rest_are_turned_no_bandwidths_are_stable(
    shares: tuple[float, float],
) -> None:
    """Axes with the exact B0 of two tanks, from slow to fast, each with its own bandwidth."""
    plant, rng = tanks(shares), np.random.default_rng(3)
    A, B, C = sampled_matrices(plant, 1.0)
    B0 = plant.C @ plant.B
    turned = is_turned(A - np.eye(4), B @ np.linalg.inv(B0), C)

    def is_stable() -> bool:
        own = [
            ql.ADRC(ql.ESO.model_free(1, 1.0, omega_o=float(o), dt=1.0), float(c))
            for c, o in 10.0 ** rng.uniform([-4.0, -4.0], [-1.0, -0.5], (2, 2))
        ]
        return analyse(plant, ql.Axes(own, B0=B0)).stable

    assert turned == (sum(shares) < 1.0)
    assert any(is_stable() for _ in range(30)) != turned
