"""Who is heard has earned it: credit, account and withheld authority by the guard's formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest

import quell as ql
from quell.guard import assess, limit, record_output
from quell.guard.kernels import CORRECTED, removed_share, update_bound
from quell.learners.base import lag_push
from tests.guarded_samples import GUARD, OBSERVER, decide, feed, settle, trusted

from .cases import cases


def test_the_bound_grows_slowly_while_the_learner_acts() -> None:
    """By a factor of e in five lags at most; without authority as quickly as P, which it never exceeds."""
    for authority, lags in ((1.0, 5.0), (0.0, 0.7)):
        design, memory = trusted()
        sample = memory.sample[0]
        sample.authority = authority
        for _ in range(100):  # a lag
            update_bound(design, memory, 1e6)
            assert sample.typical_error <= sample.peak
        share = -math.expm1(-1.0 / lags)
        grown = (1.0 - math.expm1(-5e-3 / (lags * 0.5))) ** 100 if authority else 1.0 + share * 1e6
        assert sample.typical_error == pytest.approx(grown, rel=1e-5)


def test_rest_before_a_disturbance_changes_nothing() -> None:
    """An encoder at rest measures exact zeros: averages begin with the first motion, not with them."""
    load = np.sin(0.02 * np.arange(600))
    averages = []
    for rest in (0, 2_000):
        design = ql.Guard(time=0.4, every=1).design(OBSERVER)
        memory = ql.Guard(time=0.4, every=1).memory(design)
        feed(design, memory, np.append(np.zeros(rest), load), np.append(np.zeros(rest), load))
        averages.append(memory.averages.view(float).copy())
        assert memory.sample[0].authority > 0.0
    np.testing.assert_array_equal(*averages)
    assert np.all(averages[0][1:3] > 0.0)


@cases(
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


@cases(
    ("square", "left", "before", "authority"),
    [
        (4.1, 0.21, 1.0, 0.0),
        (3.9, 0.21, 1.0, 1.0),  # q is not large beside o
        (4.1, 0.19, 1.0, 1.0),  # the learner explains nearly all of q
        (1.7, 0.0, 0.0, 0.0),  # withheld until q is small, whatever the learner says
        (1.68, 0.0, 0.0, 1.0),  # without authority before, but not withheld
    ],
)
@cases("o", [1.0, 1e-3])
def test_authority_is_withheld_while_q_may_be_the_learner_s_own_doing(
    square: float, left: float, before: float, authority: float, o: float
) -> None:
    """From M > (2 o)² and M_left > 0.05 (2 o)² on, until M < (1.3 o)²; not for n = 4."""
    for order in (1, 3, 4):
        guard, observer = GUARD, ql.ESO.model_free(order, b0=1.0, omega_o=10.0, dt=5e-3)
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


@pytest.mark.parametrize(
    ("order", "goes", "own_doing"), [(2, True, True), (2, False, False), (3, True, False)]
)
def test_a_motion_that_went_with_the_learner_was_its_own_doing(
    order: int, goes: bool, own_doing: bool
) -> None:
    """Withheld at o = 1, M falls below (1.3)²: then nothing that was earned counts. If o rises instead, or for n = 3, all of it does.

    The same learner in a load that begins is heard again as soon as o has followed.
    """
    guard, observer = GUARD, ql.ESO.model_free(order, b0=1.0, omega_o=10.0, dt=5e-3)
    design = guard.design(observer)
    memory = guard.memory(design)
    sample, averages = memory.sample[0], memory.averages[0]
    sample.credit, sample.authority, sample.outside = 1.0, 1.0, 1.0
    averages.missed, averages.gained, averages.missed_recently = 1.0, 0.5, 0.1

    def authority(square: float, outside: float) -> float:
        averages.square = averages.square_left = square
        sample.outside = outside
        decide(design, memory, 1.0, 0.0, 0.0, 0.0, 0.0)
        return float(sample.authority)

    assert authority(4.1, 1.0) == 0.0
    assert sample.reason == ql.Reason.WITHHELD
    found = authority(1.68, 1.0) if goes else authority(4.1, 2.0)
    assert found == (0.0 if own_doing else 1.0)
    assert averages.gained == pytest.approx(-0.02 if own_doing else 0.5)
    # What was decided is decided once: a later M is compared with an o of its own.
    averages.gained = 0.5
    assert authority(1.0, 1.0) == 1.0
    assert averages.gained == 0.5


def test_without_authority_the_guard_soon_forgets_what_the_learner_did() -> None:
    """c_L decays within ten lags, and within one where the learner is not heard."""
    design, memory = trusted()
    for authority, lags in ((1.0, 10.0), (0.0, 1.0)):
        memory.sample[0].own_peak, memory.sample[0].authority = 1.0, authority
        record_output(design, memory, 0.0)
        assess(design, memory, 0.0)
        assert memory.sample[0].own_peak == pytest.approx(math.exp(-5e-3 / (lags * 0.5)))


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


@pytest.mark.trial
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


def test_what_a_learner_does_to_a_load_that_begins_is_compared_with_that_load() -> None:
    """J, which follows slowly, is a hundredth of the mean square of what y misses now: R is that much nearer to zero if it is negative."""
    for gained, removed in ((0.005, 0.5), (-0.005, -0.005)):
        design, memory = trusted()
        averages = memory.averages[0]
        averages.missed, averages.missed_recently, averages.gained = 0.01, 1.0, gained
        assert removed_share(design, memory) == pytest.approx(removed)
        settle(design, memory, 0.0, 0.0, 1)
        assert (memory.sample[0].credit == -1.0) == (removed < -0.01)


@pytest.mark.trial
def test_averages_are_those_of_the_formula(rng: np.random.Generator) -> None:
    """M, S, C, C_y, J, A, P, o, c_L and e by the module's equations, with outliers and small samples."""
    guard = ql.Guard(time=0.4, every=1)
    design, memory = guard.design(OBSERVER), guard.memory(guard.design(OBSERVER))
    forget, lag = -math.expm1(-5e-3 / 0.4), 5 / 10.0
    rise, decay, growth = (-math.expm1(-5e-3 / (lags * lag)) for lags in (0.7, 200.0, 5.0))
    left, s, credit, peak, e, f_shown = 0.0, 0.5, -1.0, 0.0, 0.0, 0.0
    shadow, square, outside, own = np.zeros((1, 5)), 0.0, 0.0, 0.0
    # Without the gains of a law, y is taken to respond as f̂ does, within four lags.
    respond, stages, missed, gained = -math.expm1(-5e-3 / lag), np.zeros((3, 4)), 0.0, 0.0
    at_y, seen, paid = -1.0, 0.0, 0
    begun_anew, late, account = 0, 0.0, 5e-3 / (300.0 * lag)
    newest, match, quick = np.zeros(2), -math.expm1(-5e-3 / 0.04), 0
    disturbance, said = np.zeros((1, 5)), 0.0
    record_output(design, memory, 0.0)
    for k in range(2500):
        f, g = rng.normal(), rng.normal()
        # At last g is the disturbance itself.
        explained = lag_push(design.lag, disturbance, 0, said)
        f, said = explained if k >= 1300 else f, g
        f *= 100.0 if k % 50 == 20 else 0.01 if 60 <= k < 70 else 1.0
        q = f - memory.filtered[0]
        assess(design, memory, f)
        p = memory.filtered[2]
        assert memory.sample[0].own_peak == pytest.approx(own, rel=1e-9)
        large = abs(q) if (k + 1) * forget < 1.0 else min(abs(q), 5.0 * peak)
        peak += rise * (large - peak) if large > peak else -decay * peak
        more = rise * (large - e)
        acts = memory.sample[0].authority > 0.0
        if more > 0.0:
            e += min(more, growth * e) if acts else more
        e = min(e, peak)
        outside = min(outside + max(rise * (large - 1.5 * own - outside), 0.0), peak)
        more = forget * ((q - p) ** 2 - left)
        left += more if (k + 1) * forget < 1.0 else min(more, rise * left)
        s += forget * (p * p / (q * q + p * p) - s)
        bounded = np.clip(p, -1.2 * e, 1.2 * e)
        more = forget * (q * q - square)
        square += more if (k + 1) * forget < 1.0 else min(more, rise * square)
        newest += match * (np.array([q * q, (q - p) ** 2]) - newest)
        earned = (2.0 * q * bounded - bounded**2) / max(q * q, square)
        matching = max(1.0 - newest[1] / newest[0] / 0.35, 0.0)
        quick += earned > 0.0 and matching > 0.0
        earned *= 1.0 + 7.0 * matching if earned > 0.0 else 1.0
        earn = 5e-3 / (0.4 * 2.0 / 3.0)
        credit = np.clip(credit + earn * max(earned, -3.0), -1.0, 1.0)
        for i in range(4):
            stages[0, i] += respond * (q - stages[0, i])
            stages[2, i] += respond * (bounded - stages[2, i])
            q, bounded = stages[0, i], stages[2, i]
        more = forget * (q * q - seen)
        seen += more if (k + 1) * forget < 1.0 else min(more, rise * seen)
        earned_at_y = (2.0 * q * bounded - bounded**2) / max(q * q, seen)
        at_y = np.clip(at_y + earn * max(earned_at_y, -3.0), -1.0, 1.0)
        if newest[1] > newest[0] and earned < 0.0:
            at_y, paid = max(at_y + earn * max(earned, -3.0), -1.0), paid + 1
        more, is_new = account * (q * q - missed), (k + 1) * forget < 1.0
        if is_new or more <= rise * missed:
            gained += account * (2.0 * q * late - 1.5 * late**2 - gained)
        missed += more if is_new else min(more, rise * missed)
        past = max(missed, seen)
        gained = min(max(gained, -0.02 * past), missed)
        credit, at_y = (-1.0, -1.0) if gained < -0.01 * past else (credit, at_y)
        begun_anew += gained < -0.01 * past
        if k % 100 == 99:
            credit = memory.sample[0].credit = 1.0
            at_y = memory.sample[0].credit_at_y = 0.5
        if k == 700:
            gained = memory.averages[0].gained = -0.015 * max(missed, seen)
        sample, averages = memory.sample[0], memory.averages[0]
        np.testing.assert_allclose(
            [sample.peak, sample.typical_error, sample.outside, sample.credit],
            [peak, e, outside, credit],
            rtol=1e-9,
        )
        np.testing.assert_allclose([averages.missed, averages.gained], [missed, gained], rtol=1e-6)
        assert sample.credit_at_y == pytest.approx(at_y, rel=1e-6, abs=1e-9)
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
        f_shown = lag_push(design.lag, shadow, 0, f_learned)
    assert begun_anew > 5, "the account never ran out: the test says nothing"
    assert paid > 5, "nothing was added to q: the test says nothing"
    assert quick > 5, "nothing was ever explained: the test says nothing"


@pytest.mark.trial
def test_a_perfect_learner_explains_all_that_would_have_been_missed() -> None:
    """For a perfect learner p = q: all is explained, and e is the peak of q where it was measured."""
    guard, observer = (
        ql.Guard(time=2.0, every=1),
        ql.ESO.model_free(4, b0=1.0, omega_o=10.0, dt=1e-2),
    )
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
    assert 0.8 * missed < memory.sample[0].typical_error < 1.01 * missed


@pytest.mark.trial
def test_a_learner_that_adds_to_slow_errors_is_hardly_heard_however_well_it_explains_quick_ones() -> (
    None
):
    """Y is q through n integrations: what counts in the end is what a learner does to it.

    It explains a sinusoid of 3 rad/s, and adds to one of 0.1 rad/s, which is a fifth of q and 95 %
    of what is seen in y.
    """
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=2e-2)
    gains = ql.ADRC(observer, omega_c=1.0).parameters.law
    t = observer.dt * np.arange(5_000)
    quick, load = np.sin(3.0 * t), 5.0 * np.sin(0.1 * t)
    for sign, heard in ((1.0, True), (-1.0, False)):
        design = GUARD.design(observer, gains)
        memory = GUARD.memory(design)
        authority = np.mean(feed(design, memory, quick + load, quick + sign * load)[2_500:])
        assert authority > 0.99 if heard else authority < 0.1


@pytest.mark.trial
def test_a_learner_is_heard_in_noise_that_y_hardly_shows(rng: np.random.Generator) -> None:
    """The disturbance has noise of a measurement, differentiated; q is noise, ℓ q is the load, which the learner knows, and C_y alone gives it authority."""
    design = GUARD.design(OBSERVER)
    memory = GUARD.memory(design)
    load = np.sin(0.6 * 5e-3 * np.arange(30_000))
    # In q more than the load, in ℓ q little.
    pushes = 1000.0 * rng.normal(size=30_001)
    authority = feed(design, memory, load + np.diff(pushes), load)
    assert memory.sample[0].credit < 0.0
    assert memory.sample[0].credit_at_y > 0.5
    assert np.mean(authority) > 0.7
