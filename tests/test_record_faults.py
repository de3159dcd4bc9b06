"""What a record itself says: y early against u, another u before it, a gain that depends on u, parts of a sample."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import quell as ql
from quell.commissioning import measured
from quell.identification.delays import delayed
from quell.tuning.plants import record_model

DT = 0.01


def answer(num: Any, den: Any, u: Any, late: float = 0.0) -> Any:
    """Return y for a held u that is late by a tenth of samples: exactly, in ten steps a sample."""
    b, a, _ = cont2discrete((num, den), DT / 10)
    fine, count = np.repeat(u, 10), round(10 * late)
    return lfilter(b.ravel(), a, np.append(np.full(count, u[0]), fine)[: fine.size])[::10]


def random_steps(count: int, of: int = 15, seed: int = 0) -> Any:
    """Return u between −1 and 1, which may change after each ``of`` samples."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.choice([-1.0, 1.0], count // of + 1), of)[:count]


def noise(count: int, size: float, seed: int = 0) -> Any:
    """Return white noise."""
    return size * np.random.default_rng([seed, 1]).standard_normal(count)


@pytest.mark.parametrize("early", [0, 1, pytest.param(2, marks=pytest.mark.trial)])
def test_a_y_that_is_early_against_u_is_named_and_its_remedy_is_right(early: int) -> None:
    """By one sample and by two; without the first samples of u and the last of y nothing is named."""
    u = random_steps(1500, of=5)
    y = (answer([40.0], [1.0, 40.0], u) + noise(u.size, 1e-3))[early:]
    u = u[: y.size]
    found = ql.identify(u, y, DT, order=1)
    assert found.early == early
    assert any(f"early by {early} sample" in text for text in found.shortcomings) == (early > 0)
    mended = ql.identify(u[early:], y[: y.size - early], DT, order=1)
    assert mended.early == 0
    assert mended.den[1] == pytest.approx(40.0, rel=0.01)


def test_a_controller_that_answers_noise_at_once_makes_no_y_early() -> None:
    """Its u has the noise of the same sample, with the other sign."""
    rng, a = np.random.default_rng(3), np.exp(-2.0 * DT)
    x, u, y = 0.0, np.zeros(1500), np.zeros(1500)
    for k in range(u.size):
        y[k] = x + 0.05 * rng.standard_normal()
        u[k] = 4.0 * (np.sign(np.sin(0.05 * k)) - y[k])
        x = a * x + (1.0 - a) * u[k]
    assert ql.identify(u, y, DT, order=1).early == 0


@pytest.mark.trial
def test_samples_in_which_u_of_before_the_record_acts_are_left_out() -> None:
    """U has changed where the record begins, 30 samples before y sees it."""
    u = np.concatenate([np.zeros(200), np.tile(np.repeat([1.0, 0.2], 150), 4)])
    y = answer([2.0], [1.0, 2.0], u, late=30.0) + noise(u.size, 1e-3)
    cut = ql.identify(u[200:], y[200:], DT, order=1, delay=(0.0, 0.5))
    assert cut.left_out >= 30
    assert not cut.before
    assert cut.gain == pytest.approx(1.0, rel=2e-3)
    assert f"the first {cut.left_out} samples are left out" in str(cut)
    whole = ql.identify(u, y, DT, order=1, delay=(0.0, 0.5))
    assert whole.left_out == 0
    assert whole.delay == pytest.approx(0.3, abs=0.1 * DT)


@pytest.mark.parametrize("bent", [0.0, 0.3])
def test_a_gain_that_depends_on_u_is_named_before_a_higher_order(bent: float) -> None:
    """Stairs through a valve whose gain falls, and through a linear one."""
    u = np.repeat([1.0, 2.0, 3.0, 4.0, 5.0, 4.0, 3.0, 2.0, 1.0, 2.0], 150)
    y = answer([2.0], [1.0, 2.0], u / (1.0 + bent * u)) + noise(u.size, 2e-3)
    found = ql.identify(u, y, DT, order=1)
    told = [text for text in found.shortcomings if "depends on the operating point" in text]
    assert bool(told) == (bent > 0.0)
    assert not any("higher order" in text for text in found.shortcomings)


def test_a_pole_that_samples_do_not_show_leaves_gain_and_slow_pole_as_they_are() -> None:
    """Their intervals with two poles are those with one, and hold the estimates."""
    u = np.repeat([0.0, 1.0, 0.3, 0.8], 200)
    y = 0.02 * np.round((answer([1.0], [1.0, 2.0], u) + noise(u.size, 5e-3)) / 0.02)
    given: dict[str, Any] = {"delay": 0.0, "held_out": 0.0}
    one, two = (ql.identify(u, y, DT, order=order, **given) for order in (1, 2))
    assert two.poles[-1].omega > np.pi / DT
    low, high = two.gain_interval
    assert low <= two.gain <= high
    assert high - low == pytest.approx(np.ptp(one.gain_interval), rel=0.2)
    assert two.poles[0].real_std == pytest.approx(one.poles[0].real_std, rel=0.2)


@pytest.mark.parametrize("late", [0.4, 1.0, 2.7])
def test_the_delay_has_a_part_of_a_sample_where_the_record_shows_it(late: float) -> None:
    """A motor in 20-bit counts: gain and integrator are found, and no line begins with NOT."""
    u, count = random_steps(1500), 2.0 * np.pi / 2**20
    y = count * np.round(answer([300.0], [1.0, 3.0, 0.0], u, late) / count)
    found = ql.identify(u, y, DT, order=2, delay=(0.0, 0.05))
    assert found.delay / DT == pytest.approx(late, abs=0.01)
    assert found.integrators == 1
    assert found.gain == pytest.approx(100.0, rel=1e-3)
    low, high = found.delay_interval
    assert low <= found.delay <= high <= low + 1.01 * DT
    assert found.shortcomings == ()


@pytest.mark.parametrize("late", [0.0, 1.6])
def test_a_delay_is_searched_where_the_model_without_it_does_not_hold(late: float) -> None:
    """Without an option; where it holds, the delay is zero."""
    u = random_steps(1500)
    y = answer([2.0], [1.0, 2.0], u, late) + noise(u.size, 1e-4)
    found = ql.identify(u, y, DT, order=1)
    assert found.delay / DT == pytest.approx(late, abs=0.02)
    assert found.gain == pytest.approx(1.0, rel=1e-3)
    assert found.shortcomings == ()
    assert ql.identify(u, y, DT, order=1, delay=0.0).delay == 0.0


def test_a_whole_delay_stays_whole() -> None:
    """Noise shows no part of a sample."""
    u = random_steps(1500)
    y = answer([2.0], [1.0, 2.0], u, 3.0) + noise(u.size, 0.01)
    assert ql.identify(u, y, DT, order=1, delay=None).delay == pytest.approx(3.0 * DT, abs=1e-12)


def test_a_sine_is_late_by_a_part_of_a_sample() -> None:
    """To the share that the docstring gives, up to 0.6 rad per sample; whole delays exactly."""
    k = np.arange(200.0)
    for omega in (0.1, 0.6):
        found = delayed(np.sin(omega * k), 2.5)
        assert np.max(np.abs(found - np.sin(omega * (k - 2.5)))[4:-2]) < 3e-3
    np.testing.assert_array_equal(delayed(k, 2)[2:], k[:-2])


@pytest.mark.parametrize(("fast", "matters"), [(400.0, False), (5.0, True)])
def test_a_missing_pole_is_a_line_with_not_where_a_loop_would_feel_it(
    fast: float, matters: bool
) -> None:
    """A lag of a quarter of a sample is a plain line at most; one as slow as the plant's is not."""
    u = random_steps(1500, of=40)
    y = answer([2.0 * fast], np.polymul([1.0, 2.0], [1.0, fast]), u) + noise(u.size, 1e-4)
    found = ql.identify(u, y, DT, order=1, delay=0.0)
    assert not found.explained
    assert (found.misfit > 0.1) == matters
    assert any("not of this form" in text for text in found.shortcomings) == matters
    assert ("costs no margin" in str(found)) != matters


@pytest.mark.trial
def test_the_simplest_model_that_holds_is_taken_where_a_larger_one_has_faults(
    tmp_path: Any,
) -> None:
    """A heater whose loss grows and whose room drifts: one lag; the report names what more poles give."""
    levels, x = np.repeat([0.0, 25.0, 15.0, 50.0, 85.0, 100.0], 270), 0.0
    rng, y = np.random.default_rng(0), np.zeros(levels.size)
    for k, power in enumerate(levels):
        y[k] = 29.5 + 0.8 * np.sin(8.2 * k / levels.size) + x
        for _ in range(10):
            x += (power - 1.55 * x - 0.004 * x * x) / 910.0
    y = 0.24 * np.round((y + 0.1 * rng.standard_normal(y.size)) / 0.24)
    rows = np.column_stack([10.0 * np.arange(y.size), levels, y])
    file = tmp_path / "heater.csv"
    np.savetxt(file, rows, delimiter=",", header="t [s],u,y", comments="")
    found = record_model(measured(file))
    assert found.model.den.size == 2
    assert found.refusal == ""
    assert any("does not hold" in line for line in found.lines)
    assert found.model.gain == pytest.approx(0.57, rel=0.1)


@pytest.mark.trial
def test_a_speed_with_friction_and_an_early_step_is_one_lag_with_friction(tmp_path: Any) -> None:
    """An inertia of 2e-4 kg m² with friction of 0.02 N m: larger models without friction have faults."""
    inertia, viscous, friction, fine = 2e-4, 1e-3, 0.02, 20
    u = np.repeat([0.0, 0.1, -0.08, 0.06, -0.1], [3, 797, 700, 700, 800])
    speed, y = 0.0, np.zeros(u.size)
    for k, torque in enumerate(u):
        y[k] = speed
        for _ in range(fine):
            rub = friction * np.sign(speed) if speed else np.clip(torque, -friction, friction)
            new = speed + (torque - rub - viscous * speed) / inertia * 1e-3 / fine
            stuck = speed and np.sign(new) != np.sign(speed) and abs(torque) <= friction
            speed = 0.0 if stuck else new
    y += noise(u.size, 0.05)
    rows = np.column_stack([1e-3 * np.arange(u.size), u, y])
    file = tmp_path / "speed.csv"
    np.savetxt(file, rows, delimiter=",", header="t [s],u,y", comments="")
    model = record_model(measured(file)).model
    assert model.den.size == 2
    assert model.friction == pytest.approx(friction, rel=0.01)
    assert model.num[0] == pytest.approx(1.0 / inertia, rel=0.01)
    assert model.shortcomings == ()
