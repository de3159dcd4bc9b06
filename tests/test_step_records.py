"""Records of steps and other usual records: the right model, or a line that says what they do not decide."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal

import quell as ql
from quell.controllers.linear import LinearController, LinearLaw
from quell.files import write_json
from quell.identification import alternatives, decided, excitation, not_told_apart
from quell.identification.model import gain_interval
from quell.identification.output_error import noise_model
from quell.plants.registry import identified
from quell.tuning.plants import identified_plants
from quell.types import Vector

from .benchmark_module import benchmark
from .commands import Shown
from .test_identification import answer

pytestmark = pytest.mark.compiled


def heated(
    rest: int, *, seed: int = 0, dead: int = 0, samples: int = 801, moving: float = 0.0
) -> tuple[Vector, Vector]:
    """Return u and y of a heater of 0.7 °C/% with lags of 142 and 19 s after a step of 50 %, once a second.

    ``rest`` samples are before the step; the measurement has noise of 0.1 °C and steps of 0.1 °C. A plant that is
    ``moving`` cools down from so many degrees above.
    """
    rng = np.random.default_rng([seed, rest])
    u = np.where(np.arange(samples) >= rest, 50.0, 0.0)
    late = np.concatenate([np.zeros(dead), u])[:samples]
    y = answer(
        ([0.7 / (142.0 * 19.0)], [1.0, 161.0 / (142.0 * 19.0), 1.0 / (142.0 * 19.0)]), late, 1.0
    )
    y = y + 20.0 + moving * np.exp(-np.arange(samples) / 142.0)
    return u, np.round((y + 0.1 * rng.standard_normal(samples)) / 0.1) * 0.1


@pytest.mark.parametrize("rest", [1, 5, 50])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_step_soon_after_the_start_gives_the_right_gain(rest: int, seed: int) -> None:
    """Within its interval or two more of its deviations, at most 2 % wide but for 50 samples, and nothing is NOT."""
    u, y = heated(rest, seed=seed)
    found = ql.identify(u, y, 1.0, order=2)
    low, high = found.gain_interval
    assert found.gain == pytest.approx(0.7, abs=high - low)
    assert high - low < 0.04
    assert found.gain == pytest.approx(0.7, rel=0.03)
    assert found.shortcomings == ()
    assert found.held_from == u.size


@pytest.mark.parametrize("rest", [1, 5, 50])
def test_a_model_of_too_low_an_order_is_called_so(rest: int) -> None:
    """One lag for two: the gain is far off, the report says NOT, and the alternatives name order 2."""
    u, y = heated(rest)
    found = ql.identify(u, y, 1.0, order=1, delay=0.0)
    assert not found.explained
    assert "NOT: the response to u is not of this form" in str(found)
    better = {one.name: one for one in alternatives(found)}["order 2"]
    assert better.verdict == "better"
    assert better.describe(found).startswith("NOT: order 2 (--order 2) fits better")
    assert decided(found).gain == pytest.approx(0.7, rel=0.04)


def test_a_lag_with_one_sample_before_the_step_needs_to_be_told_that_it_was_at_rest() -> None:
    """Two shapes for three numbers: the record does not decide; with ``rest=True`` the gain is right."""
    rng = np.random.default_rng(0)
    u = np.append(0.0, np.full(499, 10.0))
    y = answer(([0.03], [1.0, 0.02]), u, 1.0) + 0.05 * rng.standard_normal(u.size)
    found = ql.identify(u, y, 1.0, order=1)
    assert found.rest
    assert found.rest_probability < 0.95
    assert "NOT: the record does not decide whether the plant was at rest" in str(found)
    with pytest.raises(ValueError, match=r"at rest.*rest=True .--rest."):
        identified_plants(found)
    given = ql.identify(u, y, 1.0, order=1, rest=True)
    assert given.undecided == ()
    assert given.gain == pytest.approx(1.5, rel=0.01)
    assert "start at rest: given" in str(given)


@pytest.mark.parametrize("seed", range(4))
def test_a_plant_that_cools_down_at_the_start_is_not_taken_for_one_at_rest(seed: int) -> None:
    """Its gain is right within the interval, or not decided; ``rest=True`` is said to be contradicted."""
    u, y = heated(5, seed=seed, moving=15.0)
    found = ql.identify(u, y, 1.0, order=2, delay=0.0)
    low, high = found.gain_interval
    assert not found.rest or found.undecided
    assert found.undecided or low <= 0.7 <= high
    forced = ql.identify(u, y, 1.0, order=2, delay=0.0, rest=True)
    assert any("contradict the start at rest" in text for text in forced.shortcomings)


@pytest.mark.trial
def test_the_gain_of_drawn_steps_is_in_its_interval_or_said_to_be_undecided() -> None:
    """Orders 1 to 3, dead times and lengths of rest (benchmarks/step_records.py): few are wrong, no sign is."""
    trial = benchmark("step_records")
    results = [
        trial.judged(trial.drawn(500 + order, rest, 0.005, order, late), order)
        for order in (1, 2, 3)
        for late in (False, True)
        for rest in (1, 50)
    ]
    told = [one for one in results if not one["said_not"]]
    assert len(told) >= 6
    assert sum(not one["covered"] for one in told) <= 1
    assert not any(one["wrong_sign"] for one in told)


def test_a_gain_interval_is_that_of_small_deviations_and_opens_where_the_pole_may_be_at_zero() -> (
    None
):
    """The delta method for small ones; with a_0 within two deviations of zero the gain has no upper end."""
    a, b = np.array([2.0]), 6.0
    covariance = np.diag([1e-4, 4e-4])
    low, high = gain_interval(a, b, covariance)
    spread = 3.0 * np.sqrt(1e-4 / 4.0 + 4e-4 / 36.0)
    assert (high - low) / (2.0 * 1.96) == pytest.approx(spread, rel=1e-3)
    low, high = gain_interval(a, b, np.diag([1.5, 0.01]))
    assert high == np.inf
    assert 1.0 < low < 3.0
    low, high = gain_interval(a, b, np.diag([0.1, 100.0]))
    assert low < 0.0 < high
    # A fast pole that is uncertain by half multiplies a_0, a_1 and b by the same factor.
    a, b = np.array([100.0, 102.0]), 300.0
    direction = np.array([100.0, 100.0, 300.0])
    low, high = gain_interval(a, b, 0.25 * np.outer(direction, direction) + 1e-4 * np.eye(3))
    assert low == pytest.approx(3.0, rel=0.1)
    assert high == pytest.approx(3.0, rel=0.1)


def test_the_model_of_the_noise_is_that_of_an_autoregressive_process() -> None:
    """Of order 2, to a few per cent; white noise has no coefficients."""
    rng = np.random.default_rng(0)
    white = rng.standard_normal(20000)
    c, variance = noise_model(signal.lfilter([1.0], [1.0, -1.2, 0.5], white))
    assert c == pytest.approx([1.0, -1.2, 0.5], abs=0.03)
    assert variance == pytest.approx(1.0, rel=0.05)
    assert noise_model(white)[0].size == 1


@pytest.mark.trial
@pytest.mark.parametrize("memory", [0.0, 0.95])
@pytest.mark.parametrize("kind", ["step", "prbs"])
def test_deviations_hold_in_white_and_coloured_noise(memory: float, kind: str) -> None:
    """The error of the pole over its stated deviation has a root mean square of one, where all information is in one step, too."""
    prbs = excitation("prbs", (0.2, 5.0), 12.0, 0.02, -1.0, 1.0).u
    step = np.where(np.arange(600) >= 60, 1.0, 0.0)
    u = {"prbs": prbs, "step": step}[kind]
    clean, ratios = answer(([3.0], [1.0, 1.5]), u, 0.02), []
    for seed in range(40):
        white = np.random.default_rng(seed).standard_normal(u.size)
        noise = signal.lfilter([1.0], [1.0, -memory], white)
        y = clean + 0.02 * noise / np.std(noise)
        pole = ql.identify(u, y, 0.02, order=1, rest=True, held_out=0.0).poles[0]
        ratios.append((pole.value.real + 1.5) / pole.real_std)
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4


@pytest.mark.trial
def test_one_more_pole_is_missed_in_no_coloured_noise_and_where_there_is_one() -> None:
    """Noise with a long memory is no response to u; a second lag is."""
    u = excitation("prbs", (0.2, 5.0), 40.0, 0.02, -1.0, 1.0).u
    noise = signal.lfilter([1.0], [1.0, -0.97], np.random.default_rng(1).standard_normal(u.size))
    y = answer(([3.0], [1.0, 1.0, 4.0]), u, 0.02) + 0.02 * noise
    assert ql.identify(u, y, 0.02, order=2).explained
    assert not ql.identify(u, y, 0.02, order=1).explained


@pytest.mark.trial
def test_a_dead_time_beyond_the_range_is_found_or_said() -> None:
    """40 samples: the default range grows; a given one ends in a line with NOT that names the option."""
    u, y = heated(20, dead=40, samples=1000)
    found = ql.identify(u, y, 1.0, order=2, delay=None)
    low, high = found.delay_interval
    assert low <= 40.0 <= high
    assert found.undecided == ()
    short = ql.identify(u, y, 1.0, order=2, delay=(0.0, 20.0))
    assert short.delay == 20.0
    assert any("--max-delay" in text for text in short.undecided)


def test_the_ends_of_a_range_of_delays_need_not_be_samples() -> None:
    """With dt = 1.00024 s a range up to 30 s has 29 samples."""
    u, y = heated(20, dead=3)
    found = ql.identify(u, y, 1.00024, order=2, delay=(0.0, 30.0))
    assert found.delay == pytest.approx(3.0 * 1.00024, abs=1.1)
    assert found.delays_searched[1] == pytest.approx(29.0 * 1.00024)


def rubbing(b: float, seed: int = 0) -> tuple[Vector, Vector]:
    """Return u and the speed of ``y' = −2 y + b (u − 0.3 sign(y) sign(b))``, which may stick."""
    rng, h = np.random.default_rng(seed), 0.02 / 20
    u = np.repeat(rng.uniform(-1.5, 1.5, 60), 40)
    y, speed = np.empty(u.size), 0.0
    for k, force in enumerate(u.tolist()):
        y[k] = speed
        for _ in range(20):
            after = speed + h * (-2.0 * speed + b * force)
            speed = after - min(max(after, -h * abs(b) * 0.3), h * abs(b) * 0.3)
    return u, y + 1e-3 * rng.standard_normal(u.size)


def speed_under(plant: Any, force: float) -> float:
    """Return y after four seconds under a constant u."""
    none = np.zeros(0)
    law = LinearLaw(np.zeros((0, 0)), none, none, none, none, 1.0, 0.0)  # u = r
    scenario = ql.Scenario(reference=force, duration=4.0)
    return float(ql.simulate(plant, LinearController(law, 0.02), scenario)["y"][-1])


@pytest.mark.trial
@pytest.mark.lost  # u = r moves a plant with b < 0 away from r
@pytest.mark.parametrize("b", [4.0, -4.0])
def test_friction_in_a_record_of_speed_acts_against_motion(b: float, tmp_path: Path) -> None:
    """0.3, positive, for either sign of the gain; the plant of the model's file stands still below it and moves above."""
    u, y = rubbing(b)
    found = ql.identify(u, y, 0.02, order=1, friction=True)
    assert found.friction == pytest.approx(0.3, abs=max(3.0 * found.friction_std, 0.01))
    assert found.num[0] == pytest.approx(b, rel=0.02)
    model = ql.identification.simulated_plant(found).sampled(0.02)
    assert model.force == pytest.approx(np.copysign(found.friction, b))
    write_json(tmp_path / "model.json", found.to_json())
    plant: Any = identified(tmp_path / "model.json", dt=0.02)
    still, moving = (speed_under(plant, force) for force in (0.2, 1.3))
    assert abs(still) < 0.05 * abs(moving)
    assert moving == pytest.approx(0.5 * b * (1.3 - 0.3), rel=0.05)


@pytest.mark.parametrize("b", [5.0, -5.0])
def test_friction_of_a_mass_is_positive_for_either_sign_of_the_gain(b: float) -> None:
    """A mass that sticks under less than 0.2 V; also in the simulated plant."""
    rng, h = np.random.default_rng(0), 0.02 / 20
    u = np.repeat(rng.uniform(-1.0, 1.0, 40), 50)
    y, position, speed = np.empty(u.size), 0.0, 0.0
    for k, force in enumerate(u.tolist()):
        y[k] = position
        for _ in range(20):
            after = speed + h * (b * force - 0.8 * speed)
            speed = after - min(max(after, -h), h)
            position += h * speed
    found = ql.identify(u, y + 1e-3 * rng.standard_normal(u.size), 0.02, order=2, friction=True)
    assert found.friction == pytest.approx(0.2, rel=0.05)
    model = ql.identification.simulated_plant(found).sampled(0.02)
    assert np.sign(model.force) == np.sign(b)


@pytest.mark.parametrize("integrators", [1, 2])
def test_poles_at_zero_may_be_given(integrators: int) -> None:
    """Also as many as there are poles."""
    u = excitation("prbs", (0.5, 10.0), 20.0, 0.02).u
    den = [1.0, 0.8, 0.0] if integrators == 1 else [1.0, 0.0, 0.0]
    y = answer(([5.0], den), u, 0.02) + 1e-3 * np.random.default_rng(0).standard_normal(u.size)
    found = ql.identify(u, y, 0.02, order=2, integrators=integrators)
    assert found.den == pytest.approx(den, abs=0.02)


@pytest.mark.trial
def test_a_clean_record_of_a_lag_gives_a_lag_from_order_four_on() -> None:
    """Without noise, and without a warning of NumPy (warnings are errors here)."""
    u = np.sign(np.sin(2.0 * np.pi * 0.7 * np.arange(2000) * 1e-3)) + 0.3
    y = answer(([10.0], [1.0, 2.0]), u, 1e-3)
    found = decided(ql.identify(u, y, 1e-3, order=4, delay=None), None)
    assert found.den == pytest.approx([1.0, 2.0], rel=1e-6)
    assert found.faults == ()


def test_the_order_that_leaves_white_noise_is_not_advised_against() -> None:
    """A second lag of 50 ms in the record of a few steps with the exact delay: order 2 stays."""
    rng = np.random.default_rng(3)
    u = np.repeat([0.0, 1.0, 0.0, 1.0], 300)
    late = np.concatenate([np.zeros(5), u[:-5]])
    y = answer(([40.0], [1.0, 22.0, 40.0]), late, 0.01) + 2e-3 * rng.standard_normal(u.size)
    found = ql.identify(u, y, 0.01, order=2, delay=0.05)
    assert found.residuals.white
    smaller = {one.name: one for one in alternatives(found)}["order 1"]
    assert smaller.verdict == "worse"
    assert "take order 1" not in smaller.describe(found)


def test_several_records_have_one_model_and_each_its_own_start() -> None:
    """A step up and a step down from other levels: the deviations are smaller than those of one."""
    (u, y), (other_u, other_y) = heated(50, seed=1), heated(50, seed=2)
    other_u, other_y = 80.0 - other_u, 95.0 - other_y
    alone = ql.identify(u, y, 1.0, order=2)
    both = ql.identify([u, other_u], [y, other_y], 1.0, order=2)
    assert both.gain == pytest.approx(0.7, rel=0.02)
    assert both.samples == (801, 801)
    widths = [one.gain_interval[1] - one.gain_interval[0] for one in (both, alone)]
    assert widths[0] < widths[1]
    assert decided(both).gain == pytest.approx(0.7, rel=0.02)
    with pytest.raises(ValueError, match="lists of as many arrays"):
        ql.identify([u, other_u], [y], 1.0, order=2)
    with pytest.raises(ValueError, match="goes with one record"):
        ql.identify([u, other_u], [y, other_y], 1.0, order=2, held_out=0.3)


@pytest.mark.trial
def test_models_that_the_record_does_not_tell_apart_are_all_in_the_set() -> None:
    """The chosen one has fewest parameters; the larger ones from which it was taken are plants of the set, too."""
    rng = np.random.default_rng(0)
    u = np.repeat([0.0, 50.0, 0.0, 50.0], 150)
    y = answer(([0.0014], [1.0, 0.21, 0.002]), u, 1.0) + 1.0 * rng.standard_normal(u.size)
    found, *others = not_told_apart(ql.identify(u, y, 1.0, order=2, delay=None), None)
    assert found.den.size == 2
    assert [one.den.size for one in others] == [3]
    plants, delays = identified_plants(found, others)
    own, _ = identified_plants(found)
    assert len(plants) == len(delays) == len(own) + len(others)
    np.testing.assert_array_equal(plants[-1][1], others[0].den)
    gains = [num[-1] / den[-1] for num, den in plants]
    assert min(gains) <= 0.7 <= max(gains)


def test_rest_with_friction_or_without_a_constant_force_is_refused() -> None:
    """Friction may hold a plant anywhere, and without a constant force y at rest is known."""
    u, y = heated(5)
    with pytest.raises(ValueError, match=r"rest = True: goes without friction"):
        ql.identify(u, y, 1.0, order=2, rest=True, friction=True)
    with pytest.raises(ValueError, match=r"rest = True: goes with bias = True"):
        ql.identify(u, y, 1.0, order=2, rest=True, bias=False)


def saved(path: Path, u: Vector, y: Vector) -> None:
    """Write a record with times once a second."""
    table = np.column_stack([np.arange(u.size), u, y])
    np.savetxt(path, table, delimiter=",", header="time_s,u,y", comments="")


@pytest.mark.trial
def test_the_command_tunes_from_a_step_test_by_itself(
    quell: Callable[..., Shown], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``quell tune heater.csv``: nothing is held out, which is said; what the record does not decide is not tuned for."""
    monkeypatch.setattr(ql.tuning, "tune", partial(ql.tune, compare=()))
    saved(tmp_path / "heater.csv", *heated(5))
    shown = quell(
        *("tune", "heater.csv", "--structure", "pi", "--no-figures", "--out", "tuned.toml"),
        *("--u-min", "0", "--u-max", "100"),
    )
    assert shown.code == 0, shown.err
    assert "nothing is held out" in shown.out
    assert "NOT" not in shown.out
    assert (tmp_path / "tuned.toml").is_file()
    u = np.append(0.0, np.full(499, 10.0))
    y = answer(([0.03], [1.0, 0.02]), u, 1.0)
    y = y + 0.05 * np.random.default_rng(0).standard_normal(u.size)
    saved(tmp_path / "lag.csv", u, y)
    pi = ("--structure", "pi", "--no-figures", "--model-order", "1", "--max-delay", "0")
    refused = quell("tune", "lag.csv", *pi)
    assert refused.code == 2
    assert "--rest" in refused.err
    assert quell("tune", "lag.csv", *pi, "--rest").code == 0


def test_options_of_records_are_refused_where_nothing_is_identified(
    quell: Callable[..., Shown],
) -> None:
    """They would have no effect."""
    shown = quell("tune", "--num", "1", "--den", "1,1", "--dt", "0.1", "--friction", "--zeros", "1")
    assert shown.code == 2
    assert "--zeros, --friction: goes with a record" in shown.err


def test_the_command_identifies_several_records(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """One model; both names are shown."""
    for i in range(2):
        saved(tmp_path / f"step{i}.csv", *heated(5, seed=i))
    shown = quell("identify", "step0.csv", "step1.csv", "--order", "2", "--no-figures")
    assert shown.code == 0, shown.err
    assert "step0.csv, step1.csv" in shown.out
    assert "gain 0.7" in shown.out or "gain 0.69" in shown.out


@pytest.mark.trial
def test_noise_and_swapped_columns_are_said(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """U that has nothing to do with y, and y in the place of u: lines with NOT say it."""
    rng = np.random.default_rng(0)
    saved(tmp_path / "noise.csv", rng.standard_normal(600), rng.standard_normal(600))
    shown = quell("identify", "noise.csv", "--order", "1", "--no-figures")
    assert "NOT: u explains hardly anything of y" in shown.out
    u = excitation("prbs", (0.005, 0.3), 600.0, 1.0, 0.0, 50.0).u
    y = answer(([0.014], [1.0, 0.02]), u, 1.0) + 0.1 * rng.standard_normal(u.size)
    saved(tmp_path / "swapped.csv", y, u)
    shown = quell("identify", "swapped.csv", "--order", "1", "--no-figures", "--no-alternatives")
    assert "NOT: u and y look swapped" in shown.out


def test_a_step_at_the_second_sample_is_drawn() -> None:
    """It has no empirical response; output, error and tests are in the picture."""
    u, y = heated(1)
    axes = ql.identify(u, y, 1.0, order=2).plot()
    assert axes[3].lines
    assert axes[0].texts


@pytest.mark.trial
@pytest.mark.parametrize("late", [0, 1])
def test_a_torque_step_soon_after_the_start_of_a_servo(late: int) -> None:
    """2e-4 kg m² with a 20-bit encoder at 4 kHz, a torque from the third sample on, at once or a sample late.

    Without the delay in the model two samples are all that tells torque from a constant force: then it is not decided.
    """
    dt, inertia, viscous = 2.5e-4, 2e-4, 1e-3
    u = np.where(np.arange(4000) >= 2, 0.01, 0.0)
    applied = np.concatenate([np.zeros(late), u])[: u.size]
    y = answer(([1.0 / inertia], [1.0, viscous / inertia, 0.0]), applied, dt)
    y = np.round(y / (2.0 * np.pi / 2**20)) * (2.0 * np.pi / 2**20)
    found = ql.identify(u, y, dt, order=2, delay=None)
    assert found.undecided == ()
    assert found.gain == pytest.approx(1.0 / viscous, rel=1e-6)
    low, high = found.gain_interval
    assert low < found.gain < high
    wrong = ql.identify(u, y, dt, order=2, delay=0.0)
    assert wrong.undecided or wrong.gain == pytest.approx(1.0 / viscous, rel=1e-6)
    assert bool(wrong.undecided) == (late == 1)
