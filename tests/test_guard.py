"""The guard's formulas: what it knows is exact, what it permits is bounded, and who is heard has earned it."""

from __future__ import annotations

import math

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

import quell as ql
from quell.guard import assess, confine, limit, record_output, start_again
from quell.guard.bound import _MOST_OWN, _SUDDEN_OWN, bounds_of, update_bound
from quell.guard.credit import removed_share
from quell.guard.state import CORRECTED
from quell.learners.lag import lag_of, lag_push

OBSERVER = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=5e-3)


def test_the_correction_lies_within_its_bound(rng: np.random.Generator) -> None:
    """``|f_L − f_L^F| ≤ β κ e``, without authority κe, with e never above the largest |q|, whatever comes."""
    design = ql.Guard(bound=0.8).design(OBSERVER)
    memory = ql.Guard(bound=0.8).memory(design)
    lag, chain, shadow = lag_of(OBSERVER), np.zeros((1, 5)), np.zeros((1, 5))
    f = f_plain = f_shown = largest = 0.0
    heard = 0
    for k in range(8000):
        largest = max(largest, abs(f_plain - memory.shown[0]))
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


def trusted(e: float = 1.0, b0: float = 1.0) -> tuple[object, object]:
    """A guard that trusts its learner, which has removed half of the squared error: κ_0 = 1.2, the error e, no output before."""
    observer = ql.ESO.model_free(order=4, b0=b0, omega_o=10.0, dt=5e-3)
    design = ql.Guard().design(observer)
    memory = ql.Guard().memory(design)
    memory.sample[0].credit = memory.sample[0].share = 1.0
    memory.sample[0].typical_error = memory.sample[0].peak = memory.sample[0].outside = e
    memory.averages[0].missed, memory.averages[0].gained = e**2, 0.5 * e**2
    return design, memory


def bounds(design: object, memory: object) -> tuple[float, float]:
    """Least and largest correction."""
    return bounds_of(design, memory, removed_share(design, memory))


def feed(design: object, memory: object, f: np.ndarray, g: np.ndarray) -> list[float]:
    """Authority in samples in which f does not depend on u, and the learner's output is g."""
    chain, authority = np.zeros((2, 5)), []
    f_plain = f_shown = 0.0
    for disturbance, output in zip(f, g, strict=True):
        assess(design, memory, f_plain)
        f_learned, _, _ = limit(design, memory, f_plain, f_shown, output, 0.0, 0.0)
        record_output(design, memory, f_learned)
        f_plain = lag_push(design.lag, chain, 0, disturbance)
        f_shown = lag_push(design.lag, chain, 1, f_learned)
        authority.append(float(memory.sample[0].authority))
    return authority


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("e", [1.0, 1e-3])
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
            assert confine(design, memory, permitted) == permitted
            beyond = 3.0 * e + 1.001 * side * authority * bound
            assert confine(design, memory, beyond) == pytest.approx(
                3.0 * e + side * authority * bound
            )


def test_what_is_not_the_output_s_own_doing_counts_for_the_bound() -> None:
    """The error less five times the own peak; an error that is sudden, less 1.5 times it."""
    for error, own_share in ((1.5, _MOST_OWN), (9.0, _SUDDEN_OWN)):
        design, memory = trusted()
        sample = memory.sample[0]
        sample.samples, sample.peak, sample.typical_error = 0.0, 2.0, 0.5
        sample.own_peak, sample.outside = 0.1, 0.3
        update_bound(design, memory, error)
        expected = 0.3 + design.rise * (error - 0.1 * own_share - 0.3)
        assert sample.outside == pytest.approx(expected, rel=1e-12)


def test_credit_from_small_errors_does_not_suffice_for_large_ones() -> None:
    """A learner that earns nothing has no authority left when e has grown by a factor of 17."""
    design, memory = trusted()
    sample = memory.sample[0]
    sample.authority = 1.0
    while sample.credit > 0.0 and sample.typical_error < 1e5:
        update_bound(design, memory, 1e6)
    assert sample.typical_error == pytest.approx(math.exp(1.0 / 0.35), rel=0.05)
    sample.credit = sample.authority = 0.0
    for _ in range(1000):
        update_bound(design, memory, 1e6)
    assert sample.credit == 0.0, "without authority the growth is free"
    assert sample.typical_error == pytest.approx(1e6, rel=1e-3)


def test_a_bound_that_does_not_grow_costs_nothing() -> None:
    """What e would grow by, and does not because it is limited by 2.5 o, is not paid for."""
    design, memory = trusted()
    sample = memory.sample[0]
    sample.authority, sample.own_peak, sample.outside = 1.0, 10.0, 0.4
    for _ in range(10):
        update_bound(design, memory, 5.0)
    assert (sample.credit, sample.typical_error) == (1.0, 1.0)


def test_rest_before_a_disturbance_changes_nothing() -> None:
    """An encoder at rest measures exact zeros: averages begin with the first motion, not with them."""
    load = np.sin(0.02 * np.arange(600))
    averages = []
    for rest in (0, 2_000):
        design = ql.Guard(time=0.4).design(OBSERVER)
        memory = ql.Guard(time=0.4).memory(design)
        feed(design, memory, np.append(np.zeros(rest), load), np.append(np.zeros(rest), load))
        averages.append(memory.averages.view(float).copy())
        assert memory.sample[0].authority > 0.0
    np.testing.assert_array_equal(*averages)
    assert np.all(averages[0][1:3] > 0.0)


def test_full_authority_is_reached_and_not_only_approached() -> None:
    """β̄ moves by 0.05/30 lags at least while β is 1: a learner that is right loses nothing in the end."""
    design, memory = trusted()
    memory.sample[0].share = 0.95
    for _ in range(round(1.01 * 30.0 * 0.5 / 5e-3)):
        limit(design, memory, 1.0, 0.0, 0.5, 0.0, 0.0)
        memory.sample[0].target = 0.5
    assert memory.sample[0].share == 1.0


@pytest.mark.parametrize(("distance", "moves"), [(-5000.0, 1.0), (-900.0, 0.0), (1100.0, -1.0)])
def test_a_target_far_from_the_learners_output_comes_nearer(distance: float, moves: float) -> None:
    """By e in 1000 lags, from 1000 e on: the constant part of f_L is free, but must not grow without end."""
    design, memory = trusted(e=2.0)
    sample = memory.sample[0]
    sample.authority, sample.output, sample.share = 1.0, 3.0, 1.0
    sample.target = start = 3.0 + 2.0 * distance
    record_output(design, memory, start)
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
        assert limit(design, memory, 50.0, 7.0, 50.0, 0.0, 0.0)[0] == pytest.approx(7.0)


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


@pytest.mark.parametrize(
    ("credit", "removed", "loudness", "authority", "reason"),
    [
        (-1.0, 0.5, 0.5, 0.0, ql.Reason.UNPROVEN),
        (0.0, 0.5, 0.5, 0.0, ql.Reason.UNPROVEN),
        (0.25, 0.5, 0.5, 0.5, ql.Reason.UNPROVEN),
        (0.5, 0.0, 0.5, 1.0, ql.Reason.TRUSTED),
        (1.0, 0.5, 0.2, 1.0, ql.Reason.TRUSTED),
        (1.0, 0.5, 0.8, 0.3, ql.Reason.TOO_LOUD),
        (0.1, 0.5, 0.8, 0.2, ql.Reason.UNPROVEN),
        (0.1, 0.5, 0.0, 0.2, ql.Reason.UNPROVEN),
        (1.0, -0.004, 0.5, 0.6, ql.Reason.UNPROVEN),
        (1.0, -0.011, 0.5, 0.0, ql.Reason.UNPROVEN),
    ],
)
def test_the_authority_is_what_a_learner_has_earned(
    credit: float, removed: float, loudness: float, authority: float, reason: ql.Reason
) -> None:
    """``β = min(clip(2 C, 0, 1), clip(1 + 100 R, 0, 1), 1.2 (1 − S)/S)``, and why."""
    design, memory = trusted()
    memory.sample[0].credit, memory.averages[0].loudness = credit, loudness
    memory.averages[0].missed, memory.averages[0].gained = 3.0, 3.0 * removed
    limit(design, memory, 1.0, 0.0, 0.0, 0.0, 0.0)
    assert memory.sample[0].authority == pytest.approx(authority)
    assert memory.sample[0].reason == reason


@pytest.mark.parametrize(
    ("square", "left", "before", "authority"),
    [
        (4.1, 0.21, 1.0, 0.0),
        (3.9, 0.21, 1.0, 1.0),  # q is not large beside o
        (4.1, 0.19, 1.0, 1.0),  # the learner explains nearly all of q
        (1.7, 0.0, 0.0, 0.0),  # withheld until q is small, whatever the learner says
        (1.68, 0.0, 0.0, 1.0),
    ],
)
@pytest.mark.parametrize("o", [1.0, 1e-3])
def test_authority_is_withheld_while_q_may_be_the_learner_s_own_doing(
    square: float, left: float, before: float, authority: float, o: float
) -> None:
    """From M > (2 o)² and M_left > 0.05 (2 o)² on, until M < (1.3 o)²; not for n = 4."""
    for order in (1, 3, 4):
        guard, observer = ql.Guard(), ql.ESO.model_free(order, b0=1.0, omega_o=10.0, dt=5e-3)
        design = guard.design(observer)
        memory = guard.memory(design)
        sample, averages = memory.sample[0], memory.averages[0]
        sample.credit, sample.authority, sample.outside = 1.0, before, o
        averages.square, averages.square_left = square * o**2, left * o**2
        averages.missed, averages.gained = 1.0, 0.5
        limit(design, memory, 1.0, 0.0, 0.0, 0.0, 0.0)
        assert sample.authority == (1.0 if order == 4 else authority)
        assert (sample.reason == ql.Reason.WITHHELD) == (sample.authority == 0.0)
        assert sample.credit == 1.0


def test_without_authority_the_guard_soon_forgets_what_the_learner_did() -> None:
    """c_L decays within ten lags, and within one where the learner is not heard."""
    design, memory = trusted()
    for authority, lags in ((1.0, 10.0), (0.0, 1.0)):
        memory.sample[0].own_peak, memory.sample[0].authority = 1.0, authority
        record_output(design, memory, 0.0)
        assert memory.sample[0].own_peak == pytest.approx(math.exp(-5e-3 / (lags * 0.5)))


@pytest.mark.parametrize(
    ("removed", "share"), [(-0.002, 0.7 * 0.8), (0.0, 0.7), (0.15, 0.85), (0.3, 1.0), (0.6, 1.0)]
)
def test_a_learner_that_has_removed_nothing_yet_has_a_smaller_bound(
    removed: float, share: float
) -> None:
    """From 0.7 κ_0 e at R = 0 to κ_0 e at R = 0.3, scaled by the authority, which falls with a negative R."""
    design, memory = trusted()
    memory.averages[0].missed, memory.averages[0].gained = 2.0, 2.0 * removed
    limit(design, memory, 1.0, 0.0, 0.0, 0.0, 0.0)
    assert bounds(design, memory) == pytest.approx((-1.2 * share, 1.2 * share))


@pytest.mark.parametrize(
    ("removed", "left", "shown", "outside", "widest"),
    [
        (0.5, 0.0, 2.0, 1.0, 2.4),  # 1.2 V
        (0.5, 0.0, 9.0, 1.0, 3.0),  # κe
        (0.5, 0.0, 9.0, 0.5, 2.0),  # 4 o
        (0.5, 0.6, 2.0, 1.0, 1.2 + 0.5 * (2.4 - 1.2)),
        (0.5, 0.8, 2.0, 1.0, 1.2),
        (0.05, 0.0, 2.0, 1.0, 1.2 * 0.75),
        (0.1, 0.0, 2.0, 1.0, 1.2 * 0.8 + 0.5 * (2.4 - 1.2 * 0.8)),
        (0.5, 0.0, 0.1, 1.0, 1.2),  # a wider bound is never narrower
    ],
)
def test_a_learner_that_explains_nearly_everything_has_a_wider_bound(
    removed: float, left: float, shown: float, outside: float, widest: float
) -> None:
    """Up to κe, 1.2 V and 4 o, the more the less of q was left in 1.5 lags, from R = 0.05 on."""
    design, memory = trusted()
    memory.averages[0].missed, memory.averages[0].gained = 2.0, 2.0 * removed
    memory.averages[0].newest_error, memory.averages[0].newest_left = 3.0, 3.0 * left
    memory.sample[0].largest_output, memory.sample[0].outside = shown, outside
    limit(design, memory, 1.0, 0.0, 0.0, 0.0, 0.0)
    assert bounds(design, memory) == pytest.approx((-widest, widest))


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize(("left", "share"), [(1.0, 1.0), (1.5, 1.0), (2.25, 0.5), (3.0, 0.3)])
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


def test_a_learner_that_turns_is_seen_within_five_lags() -> None:
    """With g = f nothing of q is left; with g = −f from then on, more than twice q."""
    design, memory = trusted()
    lag = 100  # samples, 5/omega_o
    f = np.sin(2.0 * np.pi * np.arange(15 * lag) / (4 * lag))
    turned = np.where(np.arange(f.size) < 10 * lag, f, -f)
    feed(design, memory, f[: 10 * lag], f[: 10 * lag])
    averages = memory.averages[0]
    assert averages.newest_left < 0.02 * averages.newest_error
    design, memory = trusted()
    feed(design, memory, f, turned)
    averages = memory.averages[0]
    assert averages.newest_left > 2.0 * averages.newest_error


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_what_a_learner_has_done_is_taken_back_when_it_loses_its_authority(order: int) -> None:
    """ℓ e_L decays as n lags of 2/3 of the observer's do, whatever the learner says, unless κ_0 e is too small."""
    observer = ql.ESO.model_free(order=order, b0=1.0, omega_o=10.0, dt=1e-4)
    law = np.array([math.comb(order, i) for i in range(order)], dtype=float)  # omega_c = 1
    design = ql.Guard().design(observer, law)
    memory = ql.Guard().memory(design)
    stages, rate = design.stages, 1.5 / observer.lag_time
    memory.effects[CORRECTED] = 1.0
    memory.sample[0].typical_error = 1e6
    start, f_shown, samples = memory.effects[CORRECTED].copy(), 0.0, 10_000 * order
    moved, shadow = np.zeros(samples), np.zeros((1, order + 1))
    for k in range(samples):
        moved[k] = memory.effects[CORRECTED, -1]
        memory.shown[3] = f_shown
        f_learned, _, _ = limit(design, memory, 1.0, f_shown, 0.9 * (-1.0) ** k, 0.0, 0.0)
        record_output(design, memory, f_learned)
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
    assert bounds(design, memory) == pytest.approx((-0.012, -0.012))


def test_a_guard_with_kappa_of_the_usual_bound_has_no_wider_one() -> None:
    """``Guard(bound=1.2)`` limits every learner to 1.2 e, and a smaller κ holds for all as well."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=5e-3)
    assert ql.Guard(bound=1.2).design(observer).usual_bound == 1.2
    assert ql.Guard(bound=0.5).design(observer).usual_bound == 0.5
    assert ql.Guard(bound=5.0).design(observer).usual_bound == 1.2
    design, memory = trusted()
    memory.sample[0].largest_output = 9.0
    for bound, expected in ((1.2, 1.2), (0.5, 0.5), (2.0, 2.0)):
        narrower = design._replace(bound=bound, usual_bound=min(bound, 1.2))
        limit(narrower, memory, 1.0, 0.0, 0.0, 0.0, 0.0)
        assert bounds(narrower, memory)[1] == pytest.approx(expected)


def settle(design: object, memory: object, q: float, correction: float, samples: int) -> None:
    """Samples with the same q and the same correction, whatever the guard thinks of it."""
    for _ in range(samples):
        f_plain = q + memory.shown[0]
        assess(design, memory, f_plain)
        memory.shown[3] = 0.0
        record_output(design, memory, correction)


def test_the_account_is_the_share_of_the_squared_error_that_was_removed() -> None:
    """With a correction of x times what is missed it tends to ``2 x − 1.5 x²``, and to −0.02 at least."""
    for share in (0.0, 0.5, 2.0 / 3.0, 1.0, 1.34, 3.0, -0.5):
        design, memory = trusted()
        design = design._replace(forget_account=100.0 * design.forget_account)  # 3 lags
        memory.averages[0].missed = memory.averages[0].gained = 0.0
        settle(design, memory, 0.4, 0.4 * share, 3_000)
        removed = memory.averages[0].gained / memory.averages[0].missed
        expected = max(2.0 * share - 1.5 * share**2, -0.02)
        assert removed == pytest.approx(expected, abs=2e-3), share


def test_who_has_added_a_hundredth_to_the_squared_error_begins_anew_and_may_within_200_lags() -> (
    None
):
    """Credit is −1 while R < −0.01, whatever the learner earns; without its corrections R goes back to zero over 300 lags."""
    design, memory = trusted()
    design = design._replace(forget_account=10.0 * design.forget_account)  # 30 lags
    lag, account = round(0.5 / 5e-3), memory.averages[0]
    account.missed, account.square, account.gained = 0.4**2, 0.4**2, 0.0
    settle(design, memory, 0.4, -0.4, 10 * lag)
    assert account.gained == pytest.approx(-0.02 * account.missed)
    assert memory.sample[0].credit == -1.0
    waited = 0
    while memory.sample[0].credit == -1.0:
        memory.effects[CORRECTED] = memory.sample[0].late_effect = 0.0
        memory.sample[0].credit = 1.0
        settle(design, memory, 0.4, 0.0, 1)
        waited += 1
    # The account halves in 30 log 2 = 21 lags.
    assert waited == pytest.approx(30.0 * math.log(2.0) * lag, rel=0.1)
    assert account.gained == pytest.approx(-0.01 * account.missed, rel=1e-2)


def test_averages_are_those_of_the_formula(rng: np.random.Generator) -> None:
    """M, S, C, J, A, P, o, c_L and e by the module's equations, with outliers and small samples."""
    guard = ql.Guard(time=0.4)
    design, memory = guard.design(OBSERVER), guard.memory(guard.design(OBSERVER))
    forget, lag = -math.expm1(-5e-3 / 0.4), 5 / 10.0
    rise, decay, growth = (-math.expm1(-5e-3 / (lags * lag)) for lags in (0.7, 200.0, 5.0))
    left, s, credit, peak, e, own, f_shown = 0.0, 0.5, -1.0, 0.0, 0.0, 0.0, 0.0
    shadow, square, spared, outside = np.zeros((1, 5)), 0.0, 0, 0.0
    # Without the gains of a law, y is taken to respond as f̂ does, within four lags.
    respond, stages, missed, gained = -math.expm1(-5e-3 / lag), np.zeros((2, 4)), 0.0, 0.0
    begun_anew, late, account = 0, 0.0, 5e-3 / (300.0 * lag)
    newest, match, quick = np.zeros(2), -math.expm1(-5e-3 / 0.04), 0
    disturbance, said = np.zeros((1, 5)), 0.0
    for k in range(2500):
        f, g = rng.normal(), rng.normal()
        # At last g is the disturbance itself.
        explained = lag_push(design.lag, disturbance, 0, said)
        f, said = explained if k >= 1300 else f, g
        f *= 100.0 if k % 50 == 20 else 0.01 if 60 <= k < 70 else 1.0
        q, p = f - memory.shown[0], memory.shown[2]
        assess(design, memory, f)
        large = abs(q) if (k + 1) * forget < 1.0 else min(abs(q), 5.0 * peak)
        most_own = own if large > 1.15 * peak else 5.0 * own
        peak += rise * (large - peak) if large > peak else -decay * peak
        more = rise * (large - 0.2 * own - e)
        spared += large > e > large - 0.2 * own
        acts, before = memory.sample[0].authority > 0.0, e
        if more > 0.0:
            e += min(more, growth * e) if acts else more
        more = rise * (large - most_own - outside)
        outside = min(outside + max(more, 0.0), peak)
        e = min(e, peak, 2.5 * outside)
        credit -= 0.35 * (e / before - 1.0) if acts and e > before else 0.0
        more = forget * ((q - p) ** 2 - left)
        left += more if (k + 1) * forget < 1.0 else min(more, rise * left)
        s += forget * min(1.0, (q * q + p * p) / (0.4 * peak) ** 2) * (p * p / (q * q + p * p) - s)
        bounded = np.clip(p, -1.2 * e, 1.2 * e)
        more = forget * (q * q - square)
        square += more if (k + 1) * forget < 1.0 else min(more, rise * square)
        newest += match * (np.array([q * q, (q - p) ** 2]) - newest)
        earned = (2.0 * q * bounded - bounded**2) / max(q * q, 4.0 * square)
        matching = max(1.0 - newest[1] / newest[0] / 0.35, 0.0)
        quick += earned > 0.0 and matching > 0.0
        earned *= 1.0 + 7.0 * matching if earned > 0.0 else 1.0
        credit = np.clip(credit + 5e-3 / (0.4 * 2.0 / 3.0) * max(earned, -3.0), -1.0, 1.0)
        for i in range(4):
            stages[0, i] += respond * (q - stages[0, i])
            q = stages[0, i]
        more, is_new = account * (q * q - missed), (k + 1) * forget < 1.0
        if is_new or more <= rise * missed:
            gained += account * (2.0 * q * late - 1.5 * late**2 - gained)
        missed += more if is_new else min(more, rise * missed)
        missed = min(missed, 1e4 * square)
        gained = min(max(gained, -0.02 * missed), missed)
        credit = -1.0 if gained < -0.01 * missed else credit
        begun_anew += gained < -0.01 * missed
        if k % 100 == 99:
            credit = memory.sample[0].credit = 1.0
        if k == 700:
            gained = memory.averages[0].gained = -0.015 * missed
        sample, averages = memory.sample[0], memory.averages[0]
        np.testing.assert_allclose(
            [sample.peak, sample.typical_error, sample.credit], [peak, e, credit], rtol=1e-9
        )
        np.testing.assert_allclose([averages.missed, averages.gained], [missed, gained], rtol=1e-6)
        assert averages.loudness == pytest.approx(s, rel=1e-9)
        assert averages.square == pytest.approx(square, rel=1e-9)
        assert averages.square_left == pytest.approx(left, rel=1e-9)
        f_learned, _, _ = limit(design, memory, f, f_shown, g, 0.0, 0.0)
        value = f_learned - f_shown
        for i in range(4):
            stages[1, i] += respond * (value - stages[1, i])
            value = stages[1, i]
        late += -math.expm1(-5e-3 / lag) * (value - late)
        remembered = 10.0 if sample.authority > 0.0 else 1.0
        own = max(abs(f_learned - f_shown), math.exp(-5e-3 / (remembered * lag)) * own)
        record_output(design, memory, f_learned)
        assert sample.own_peak == pytest.approx(own, rel=1e-9)
        f_shown = lag_push(design.lag, shadow, 0, f_learned)
    assert spared > 5, "the learner's own share never counted: the test says nothing"
    assert begun_anew > 5, "the account never ran out: the test says nothing"
    assert quick > 5, "nothing was ever explained: the test says nothing"


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
    for array, fresh in zip(memory, ql.Guard().memory(design), strict=True):
        np.testing.assert_array_equal(array, fresh)


def test_a_perfect_learner_explains_all_that_would_have_been_missed() -> None:
    """For a perfect learner p = q: all is explained, and e is the peak of q where it was measured."""
    guard, observer = ql.Guard(time=2.0), ql.ESO.model_free(4, b0=1.0, omega_o=10.0, dt=1e-2)
    design = guard.design(observer)
    memory = guard.memory(design)
    f = np.sin(0.7 * observer.dt * np.arange(6_000))
    feed(design, memory, f, f)
    assert memory.sample[0].authority == 1.0
    assert memory.averages[0].loudness == pytest.approx(0.5, abs=1e-3)
    assert memory.averages[0].square_left == pytest.approx(0.0, abs=1e-9)
    # |q| of a sinusoid: |F (1 − F)| at 0.7 rad/s, with F = (1 + s/10)^-5.
    response = (1.0 + 0.07j) ** -5
    missed = abs(response * (1.0 - response))
    assert memory.sample[0].peak == pytest.approx(missed, rel=0.1)
    # While the learner acts, e rises to |q| less a fifth of its correction, which is as large.
    assert 0.8 * missed < memory.sample[0].typical_error < 1.01 * missed


def test_a_learner_that_adds_to_slow_errors_is_hardly_heard_however_well_it_explains_quick_ones() -> (
    None
):
    """Y is q through n integrations: what counts in the end is what a learner does to it.

    It explains a sinusoid of 3 rad/s, and adds to one of 0.1 rad/s, which is a fifth of q and 95 %
    of what is seen in y.
    """
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=2e-2)
    gains = ql.ADRC(observer, omega_c=1.0).parameters.law
    guard = ql.Guard(time=2.0)
    t = observer.dt * np.arange(5_000)
    quick, load = np.sin(3.0 * t), 5.0 * np.sin(0.1 * t)
    for sign, heard in ((1.0, True), (-1.0, False)):
        design = guard.design(observer, gains)
        memory = guard.memory(design)
        authority = np.mean(feed(design, memory, quick + load, quick + sign * load)[2_500:])
        assert authority > 0.99 if heard else authority < 0.05


def test_a_learner_is_cut_off_within_the_sample_and_has_to_prove_itself_again() -> None:
    """After a NaN it is unheard for at least half as long as at the start, though it is right; what it did is undone."""
    design = ql.Guard(time=2.0).design(OBSERVER)
    memory = ql.Guard(time=2.0).memory(design)
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
    assert 0.5 < again / heard.index(True) < 4.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ql.Guard(bound=0.0), "bound = 0.0: must be finite and greater than zero"),
        (lambda: ql.Guard(time=-1.0), "time = -1.0"),
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
