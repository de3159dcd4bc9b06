"""The guard's formulas: what it knows is exact, and what it permits is bounded."""

from __future__ import annotations

import math

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

import quell as ql
from quell.guard import assess, limit, nearest_permitted, record_output, start_again
from quell.guard.kernels import CORRECTED, respond
from quell.learners.base import lag_of, lag_push
from tests.guarded_samples import GUARD, OBSERVER, bounds, decide, trusted

from .cases import cases


@pytest.mark.trial
def test_the_correction_lies_within_its_bound(rng: np.random.Generator) -> None:
    """``|f_L − f_L^F| ≤ β κ e``, without authority κe, with e never above the largest |q|, whatever comes."""
    guard = ql.Guard(bound=0.8, every=1)
    design = guard.design(OBSERVER)
    memory = guard.memory(design)
    lag, chain, shadow = lag_of(OBSERVER), np.zeros((1, 5)), np.zeros((1, 5))
    f = f_plain = f_shown = largest = 0.0
    heard = 0
    for k in range(8000):
        largest = max(largest, abs(f_plain - memory.filtered[0]))
        assess(design, memory, f_plain)
        f += 0.05 * rng.normal() - 0.01 * f
        wild = rng.random() < 0.3
        output = f + rng.normal() * (10.0 ** rng.uniform(-3.0, 6.0) if wild else 0.05)
        if k % 3000 > 500:
            memory.sample[0].credit = 1.0  # the credit of one that is always right
        permitted, slope, cut_off = limit(design, memory, f_plain, f_shown, output, 0.0, 0.0)
        e, authority = memory.sample[0].typical_error, memory.sample[0].authority
        assert slope == 0.0
        assert not cut_off
        assert e <= largest * (1.0 + 1e-12) + 1e-199
        most = 0.8 * e * (authority if authority > 0.0 else 1.0)
        assert abs(permitted - f_shown) <= most * (1.0 + 1e-9) + 1e-12, k
        record_output(design, memory, permitted)
        f_shown = lag_push(lag, shadow, 0, permitted)
        f_plain = lag_push(lag, chain, 0, f)
        heard += permitted != f_shown
    assert heard > 2000, "hardly anything was permitted: the test says nothing"


@cases("side", [-1.0, 1.0])
@cases("e", [1.0, 1e-3])
def test_a_correction_beyond_its_bound_is_clipped(side: float, e: float) -> None:
    """f_L follows g up to κ_0 e from f_L^F, scaled by the authority; beyond it the slope is zero."""
    for credit in (1.0, 0.25):
        authority, bound = min(2.0 * credit, 1.0), 1.2 * e
        for share, inside in ((0.99, True), (1.01, False), (20.0, False)):
            design, memory = trusted(e)
            memory.sample[0].credit, memory.sample[0].target = credit, 3.0 * e
            memory.sample[0].share = authority
            g = side * share * bound
            permitted, slope, cut = limit(design, memory, 5.0 * e, 3.0 * e, g, 0.0, 0.0)
            expected = 3.0 * e + authority * (g if inside else side * bound)
            assert permitted == pytest.approx(expected, rel=1e-9)
            assert (slope, cut) == (0.0, False)
            reason = memory.sample[0].reason
            assert (reason == ql.Reason.OUT_OF_BOUNDS) == (not inside)
            assert nearest_permitted(design, memory, permitted) == permitted
            beyond = 3.0 * e + 1.001 * side * authority * bound
            assert nearest_permitted(design, memory, beyond) == pytest.approx(
                3.0 * e + side * authority * bound
            )


def test_full_authority_is_reached_and_not_only_approached() -> None:
    """β̄ moves by 0.05/30 lags at least while β is 1: a learner that is right loses nothing in the end."""
    design, memory = trusted()
    memory.sample[0].share = 0.95
    for _ in range(round(1.01 * 30.0 * 0.5 / 5e-3)):
        decide(design, memory, 1.0, 0.0, 0.5, 0.0, 0.0)
        memory.sample[0].target = 0.5
    assert memory.sample[0].share == 1.0


def test_the_authority_follows_a_close_match_eight_times_as_quickly() -> None:
    """β̄ comes nearer to β over 30 lags where the learner leaves 0.35 of q² or more, over 30/8 where it leaves nothing; not for n = 4."""
    cases = ((2, 0.0, 8.0), (2, 0.175, 4.5), (2, 0.35, 1.0), (2, 2.0, 1.0), (4, 0.0, 1.0))
    for order, left, quickness in cases:
        design, memory = trusted()
        design = design._replace(stages=order)
        memory.averages[0].newest_error, memory.averages[0].newest_left = 3.0, 3.0 * left
        memory.sample[0].share = 0.2
        for _ in range(100):  # a lag
            decide(design, memory, 1.0, 0.0, 0.5, 0.0, 0.0)
        expected = 1.0 - 0.8 * math.exp(-quickness / 30.0)
        assert memory.sample[0].share == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("distance", "moves"), [(-5000.0, 1.0), (-900.0, 0.0), (1100.0, -1.0)])
def test_a_target_far_from_the_learners_output_comes_nearer(distance: float, moves: float) -> None:
    """By e in 1000 lags, from 1000 e on: the constant part of f_L is free, but must not grow without end."""
    design, memory = trusted(e=2.0)
    sample = memory.sample[0]
    sample.authority, sample.output, sample.share = 1.0, 3.0, 1.0
    sample.target = start = 3.0 + 2.0 * distance
    record_output(design, memory, start)
    assess(design, memory, 0.0)
    assert (sample.target - start) / (2.0 * 5e-3 / (1000.0 * 0.5)) == pytest.approx(moves, abs=1e-3)


def test_where_nothing_is_permitted_the_target_is_what_is_fed_forward() -> None:
    """So that authority which is given later begins without a jump."""
    design, memory = trusted()
    memory.sample[0].authority = 0.0
    memory.sample[0].output = 5.0
    record_output(design, memory, 0.7)
    assert memory.sample[0].target == 0.7


def test_a_change_of_the_authority_over_a_constant_does_nothing() -> None:
    """The target moves by β times the change of g, however large g is."""
    design, memory = trusted()
    memory.sample[0].output, memory.sample[0].target = 50.0, 7.0
    for credit in (1.0, 0.3, 0.1, 0.4, 0.0):
        memory.sample[0].credit = credit
        assert decide(design, memory, 50.0, 7.0, 50.0, 0.0, 0.0)[0] == pytest.approx(7.0)


@pytest.mark.trial
def test_what_the_bound_took_is_made_up_for() -> None:
    """After a short pulse of twice the bound f_L still reaches g, and later the target comes to f_L."""
    design, memory = trusted()
    lag, shadow, shown = lag_of(OBSERVER), np.zeros((1, 5)), 0.0
    found = []
    for _ in range(8000):
        permitted, _, _ = limit(design, memory, 0.0, shown, 2.4, 0.0, 0.0)
        record_output(design, memory, permitted)
        shown = lag_push(lag, shadow, 0, permitted)
        found.append(permitted)
    assert found[0] == pytest.approx(1.2)
    assert 2.0 < max(found) <= 2.4
    assert found[-1] == pytest.approx(2.4, rel=0.06)


@pytest.mark.parametrize("b0", [2.0, -2.0])
def test_a_slope_is_permitted_while_the_effective_gain_is_half_to_twice_b0(b0: float) -> None:
    """``(b0 + s)/b0`` from 1/2 to 2, edges included; beyond, the output counts as a constant."""
    for share, kept in ((0.5, True), (2.0, True), (1.3, True), (0.49, False), (2.01, False)):
        design, memory = trusted(1.0, b0)
        slope, u = b0 * (share - 1.0), 0.4
        memory.sample[0].output = memory.sample[0].target = 2.0
        found = limit(design, memory, 2.0, 2.0, 2.0 - slope * u, slope, u)
        expected = (2.0 - slope * u, slope, False) if kept else (2.0, 0.0, False)
        assert found == (pytest.approx(expected[0]), expected[1], False), share


def test_an_output_is_cut_off_where_it_is_a_hundred_times_larger_than_f() -> None:
    """Or than P, where that is larger; then the learner has to prove itself again, and is not restarted."""
    for f, e in ((3.0, 1.0), (0.1, 3.0), (-3.0, 1.0)):
        for output, exploded in ((299.0, False), (-299.0, False), (301.0, True), (-301.0, True)):
            design, memory = trusted(e)
            permitted, slope, restart = limit(design, memory, f, 0.7, output, 0.1, 0.0)
            assert (memory.sample[0].reason == ql.Reason.EXPLODED) == exploded
            assert not restart
            if exploded:
                assert (permitted, slope, memory.sample[0].authority) == (0.7, 0.0, 0.0)
                assert (memory.sample[0].credit, memory.averages[0].loudness) == (-1.0, 0.5)
                assert memory.sample[0].output == math.copysign(300.0, output)


@cases(
    ("removed", "left", "widest"),
    [
        (0.5, 0.0, 3.0),  # κe
        (0.5, 0.6, 1.2 + 0.5 * (3.0 - 1.2)),
        (0.5, 0.8, 1.2),
        (0.0, 0.0, 1.2),
        (0.05, 0.0, 1.2 + 0.5 * (3.0 - 1.2)),
        (-0.002, 0.0, 1.2 * 0.8),  # the authority falls with a negative R
    ],
)
def test_a_learner_that_explains_nearly_everything_has_a_wider_bound(
    removed: float, left: float, widest: float
) -> None:
    """Up to κe, the more the less of q was left in 1.5 lags, and the more of the squared error was removed."""
    design, memory = trusted()
    memory.averages[0].missed, memory.averages[0].gained = 2.0, 2.0 * removed
    memory.averages[0].newest_error, memory.averages[0].newest_left = 3.0, 3.0 * left
    limit(design, memory, 1.0, 0.0, 0.0, 0.0, 0.0)
    assert bounds(design, memory) == pytest.approx((-widest, widest))


@cases("side", [-1.0, 1.0])
@cases(("left", "share"), [(1.0, 1.0), (1.5, 1.0), (2.25, 0.5), (3.0, 0.3)])
def test_a_learner_that_is_wrong_has_less_where_it_pushes_and_may_take_it_back(
    left: float, share: float, side: float
) -> None:
    """Less of the bound on the side of ℓe_L, from 1.5 times the squared error in 1.5 lags on, 0.3 at least."""
    design, memory = trusted()
    memory.averages[0].newest_error, memory.averages[0].newest_left = 3.0, 3.0 * left
    memory.effects[CORRECTED, -1] = 0.1 * side
    limit(design, memory, 1.0, 0.0, 0.0, 0.0, 0.0)
    expected = (-1.2, 1.2 * share) if side > 0.0 else (-1.2 * share, 1.2)
    assert bounds(design, memory) == pytest.approx(expected)


@pytest.mark.trial
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_what_a_learner_has_done_is_taken_back_when_it_loses_its_authority(order: int) -> None:
    """ℓ e_L decays as n lags of 2/3 of the observer's do, whatever the learner says, unless κ_0 e is too small."""
    observer = ql.ESO.model_free(order=order, b0=1.0, omega_o=10.0, dt=1e-4)
    law = np.array([math.comb(order, i) for i in range(order)], dtype=float)  # omega_c = 1
    design = GUARD.design(observer, law)
    memory = GUARD.memory(design)
    stages, rate = design.stages, 1.5 / observer.lag_time
    memory.effects[CORRECTED] = 1.0
    memory.sample[0].typical_error, memory.sample[0].taking_back = 1e6, design.taking_back
    memory.sample[0].peak = 1e6
    start, f_shown, samples = memory.effects[CORRECTED].copy(), 0.0, 10_000 * order
    moved, shadow = np.zeros(samples), np.zeros((1, order + 1))
    for k in range(samples):
        moved[k] = memory.effects[CORRECTED, -1]
        memory.filtered[3] = f_shown
        f_learned, _, _ = limit(design, memory, 1.0, f_shown, 0.9 * (-1.0) ** k, 0.0, 0.0)
        record_output(design, memory, f_learned)
        assess(design, memory, 0.0)
        f_shown = lag_push(design.lag, shadow, 0, f_learned)
    # The chain of stages x' = A x + B e_L with omega_c = 1, closed by u = −K x with all poles at −rate.
    A = np.diag(-np.ones(stages)) + np.diag(np.ones(stages - 1), -1)
    B = np.eye(stages)[:, :1]
    closed = A - B @ np.reshape(ct.acker(A, B, np.full(stages, -rate)), (1, stages))
    t = 1e-4 * np.arange(samples)
    expected = np.array([(expm(closed * at) @ start)[-1] for at in t[::500]])
    np.testing.assert_allclose(moved[::500], expected, atol=0.02 * np.max(np.abs(expected)))
    assert abs(moved[-1]) < 0.03 or order == 1
    memory.effects[CORRECTED], memory.sample[0].typical_error = 1.0, 0.01
    memory.sample[0].taking_back = 1.0
    assert bounds(design, memory) == pytest.approx((-0.012, -0.012))
    memory.sample[0].taking_back = 0.0
    assert bounds(design, memory) == (0.0, 0.0)


def test_what_was_done_is_taken_back_without_swinging_where_the_bound_is_small() -> None:
    """A chain of four lags comes to rest although the pole placement asks for 300 times κ_0 e."""
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=20.0, dt=5e-3)
    design = GUARD.design(observer, np.array([1.0, 4.0, 6.0, 4.0]))  # omega_c = 1
    memory = GUARD.memory(design)
    memory.sample[0].typical_error, memory.sample[0].taking_back = 0.5, 6000.0
    memory.effects[CORRECTED] = start = 0.15
    moved = []
    for _ in range(6000):
        correction, _ = bounds(design, memory)
        assert abs(correction) <= 0.6
        moved.append(abs(respond(design, memory, CORRECTED, correction)))
    assert max(moved[4000:]) < 1e-3 * start


def test_a_guard_with_kappa_of_the_usual_bound_has_no_wider_one() -> None:
    """``Guard(bound=1.2)`` limits every learner to 1.2 e, and a smaller κ holds for all as well."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=5e-3)
    assert ql.Guard(bound=1.2).design(observer).usual_bound == 1.2
    assert ql.Guard(bound=0.5).design(observer).usual_bound == 0.5
    assert ql.Guard(bound=5.0).design(observer).usual_bound == 1.2
    design, memory = trusted()
    for bound, expected in ((1.2, 1.2), (0.5, 0.5), (2.0, 2.0)):
        memory.averages[0].newest_left = 0.0
        narrower = design._replace(bound=bound, usual_bound=min(bound, 1.2))
        decide(narrower, memory, 1.0, 0.0, 0.0, 0.0, 0.0)
        assert bounds(narrower, memory)[1] == pytest.approx(expected)


def test_a_guard_that_starts_again_is_a_new_one(rng: np.random.Generator) -> None:
    """All of its state is that before the first sample, but for the time in which q is wrong."""
    design, memory = trusted()
    for _ in range(50):
        assess(design, memory, rng.normal())
        limit(design, memory, 1.0, 0.0, rng.normal(), 0.0, 0.0)
        record_output(design, memory, 0.3)
    start_again(design, memory)
    assert memory.sample[0].unsettled == design.settling == 300.0
    before = memory.sample[0].typical_error
    for _ in range(300):
        assess(design, memory, 1e3)
    assert memory.sample[0].typical_error == before
    start_again(design, memory)
    memory.sample[0].unsettled = 0.0
    for array, fresh in zip(memory, GUARD.memory(design), strict=True):
        np.testing.assert_array_equal(array, fresh)


@pytest.mark.trial
def test_a_learner_is_cut_off_within_the_sample_and_has_to_prove_itself_again() -> None:
    """After a NaN it is unheard for T_C/8, the least time in which credit is earned, though it is right; what it did is undone."""
    guard = ql.Guard(time=2.0, every=1)
    design = guard.design(OBSERVER)
    memory = guard.memory(design)
    chain, shown, f_shown, heard = np.zeros((2, 5)), 0.0, 0.0, []
    for k in range(6000):
        f = math.sin(0.7 * k * OBSERVER.dt)
        assess(design, memory, shown)
        said = math.nan if k == 3000 else f
        kept, slope, cut_off = limit(design, memory, shown, f_shown, said, 0.0, 0.0)
        assert cut_off == (k == 3000)
        if k == 3000:
            moved = memory.effects[CORRECTED, -1]
            assert slope == 0.0
            assert (
                0.0 < (f_shown - kept) / moved <= 1.2 * memory.sample[0].typical_error / abs(moved)
            )
            assert ql.Reason(int(memory.sample[0].reason)) == ql.Reason.NOT_FINITE
        record_output(design, memory, kept)
        heard.append(memory.sample[0].authority > 0.0)
        shown = lag_push(design.lag, chain, 0, f)
        f_shown = lag_push(design.lag, chain, 1, kept)
    again = heard[3001:].index(True)
    assert heard[2999]
    least = round(2.0 / 3.0 * 2.0 / 8.0 / OBSERVER.dt)
    assert least <= again < 4.0 * heard.index(True)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ql.Guard(bound=0.0), "bound = 0.0: must be finite and greater than zero"),
        (lambda: ql.Guard(time=-1.0), "time = -1.0"),
        (lambda: ql.Guard(every=0), "every = 0: must be a whole number of at least 1"),
        (
            lambda: ql.ADRC(OBSERVER, 1.0, learner=ql.learners.Kalman(), guard=True),
            "guard = True: must be a quell.Guard",
        ),
    ],
)
def test_mistakes_are_named(make: object, message: str) -> None:
    """Argument, value, rule."""
    with pytest.raises(ValueError, match=message):
        make()


def test_the_loop_s_response_has_as_many_poles_as_the_relative_degree() -> None:
    """ω_c is that of the law, whose gains beyond it are zero, and the geometric mean of other poles; there is nothing to take back where the plant has zeros."""
    plant = ([1.0, 30.0, 900.0], [1.0, 2.0, 40.0, 10.0, 0.0])
    zeros = ql.ESO.model_based(plant, 40.0, 1e-3)
    chain = ql.ESO.model_free(2, 1.0, 40.0, 1e-3)
    for observer, takes_back in ((zeros, False), (chain, True)):
        for options, omega_c in (({}, 5.0), ({"half_gain": True}, 5.0 / math.sqrt(2.0))):
            learner = ql.learners.Kalman()
            loop = ql.ADRC(observer, 5.0, learner=learner, guard=GUARD, **options)
            design = loop.parameters.guard
            assert design.stages == 2
            assert design.respond == pytest.approx(-math.expm1(-omega_c * 1e-3))
            assert (design.taking_back > 0.0) == takes_back
