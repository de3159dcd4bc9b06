"""Safety rules: default bounds of y, times in seconds, and the check of the first motion."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.realtime import Safety
from quell.realtime.run import mode_changes
from quell.realtime.safety import plausible_range
from quell.realtime.supervisor import (
    ARMED,
    OFF,
    SUSPECT,
    Cause,
    initial_state,
    runs_away,
)
from quell.setup import load

from .cases import cases
from .scripted import DT, PLANT, Outcome, ScriptedDevice, adrc, run

CONSTANT = ql.Scenario(1.0, 3.0)


def causes(outcome: Outcome) -> list[tuple[int, Cause]]:
    """Return cycle and cause of each change of mode."""
    changes = mode_changes(outcome.loop.controller.supervisor, DT)
    return [(round(change.t / DT), change.cause) for change in changes]


def controller(dt: float) -> ql.ADRC:
    """Return a controller with another sample time."""
    return ql.ADRC(
        ql.ESO.model_free(order=1, b0=-2.0, omega_o=0.3 / dt, dt=dt), 0.05 / dt, u_min=-1, u_max=2
    )


def range_of_y(limits: Any) -> tuple[float, float]:
    """Return the bounds of y of one axis."""
    return float(limits.y_low[0]), float(limits.y_high[0])


def test_bounds_of_y_follow_from_reference_and_reach_of_u() -> None:
    """Zero and the reference, and ten times that range plus b0 max|u| / omega_c²."""
    reach = 1.5 * 3.0 / 1.5**2
    for design in (adrc(), ql.controllers.Prefiltered(adrc(), ql.baselines.ZV(3.0))):
        limits = Safety().rules(design, CONSTANT).limits
        assert limits.reach == pytest.approx(reach)
        assert range_of_y(limits) == pytest.approx((-10 * (1 + reach), 1 + 10 * (1 + reach)))
    swing = Safety().rules(adrc(), ql.Scenario(ql.signals.Sinusoid(2.0), 10.0)).limits
    assert range_of_y(swing) == pytest.approx((-62.0, 62.0), abs=1e-3)
    # Without b0 there is no scale of y but the reference.
    pid = ql.baselines.PID(4.0, 2.0, 1.0, tf=0.05, dt=DT, u_min=-3, u_max=3)
    assert range_of_y(Safety().rules(pid, CONSTANT).limits) == (-1e6, 1e6 + 1.0)
    assert Safety(u_min=-1.0).rules(adrc(), CONSTANT).limits.reach == pytest.approx(reach)
    assert plausible_range([-7.0, 5.0], math.nan) == (-7e6 - 7.0, 7e6 + 5.0)
    assert plausible_range([-3.0, 5.0], math.nan) == (-5e6 - 3.0, 5e6 + 5.0)
    assert range_of_y(Safety().rules(adrc()).limits) == (-math.inf, math.inf)
    given = Safety(y_min=-1.0, y_max=math.inf).rules(adrc(), CONSTANT)
    assert range_of_y(given.limits) == (-1.0, math.inf)


@pytest.mark.parametrize("value", [1e300, -1e300])
def test_a_device_that_reports_nonsense_ends_the_run(value: float) -> None:
    """In the same sample, with the default rules; before the run as well, and u is never moved."""
    later = run(ScriptedDevice(PLANT, y=dict.fromkeys(range(60, 3000), value)), interpret=True)
    assert causes(later)[-2] == (60, Cause.IMPLAUSIBLE)
    assert np.max(np.abs(np.diff(later["U"][59:]))) <= abs(later["U"][59]) / 10 + 1e-12
    before = run(ScriptedDevice(PLANT, y=dict.fromkeys(range(3000), value)), interpret=True)
    assert causes(before) == [(0, Cause.IMPLAUSIBLE), (0, Cause.RAMPED)]
    assert not before.device.written.any()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_y_may_lie_at_its_bound_but_not_beyond(sign: float) -> None:
    """Both bounds."""
    bounds = {"y_min": -4.0, "y_max": 4.0}
    for y, ends in ((sign * 4.0, False), (sign * np.nextafter(4.0, 5.0), True)):
        device = ScriptedDevice(PLANT, samples=60, y={5: y})
        found = causes(run(device, duration=0.01, interpret=True, **bounds))
        assert (Cause.IMPLAUSIBLE in [cause for _, cause in found]) == ends


@cases(
    ("dt", "counts"),
    [
        (1e-4, (50, 50, 500, 2000)),
        (1e-3, (5, 5, 50, 200)),  # as before they were times
        (1e-2, (5, 5, 10, 20)),
        (1.0, (5, 5, 10, 20)),
    ],
)
def test_default_times_hold_at_every_rate(dt: float, counts: tuple[int, ...]) -> None:
    """Seconds at quick rates, a least number of samples at slow ones: 10 s of ramp at 1 Hz."""
    rules = Safety().rules(controller(dt)).limits
    assert (rules.hold, rules.most_overruns, rules.ramp, rules.settle) == counts
    assert rules.longest_start == 10 * counts[-1] + max(round(1.0 / dt), 10)
    assert rules.most_saturated > 1e15


def test_times_are_given_in_seconds_or_in_samples() -> None:
    """Rounded to samples, at least one; never both."""
    times = {"hold": "hold", "most_overruns": "overrun", "ramp": "ramp", "settle": "settle"}
    times["most_saturated"] = "saturated"
    for samples, seconds in times.items():
        name = f"{seconds}_time"
        for value, count in ((0.07, 7), (0.076, 8), (1e-9, 1)):
            assert getattr(Safety(**{name: value}).rules(controller(0.01)).limits, samples) == count
        assert getattr(Safety(**{samples: 3}).rules(controller(0.01)).limits, samples) == 3
        with pytest.raises(ValueError, match=f"{samples} = 3, {name} = 0.1: give one of them"):
            Safety(**{samples: 3, name: 0.1})
        with pytest.raises(ValueError, match=f"{name} = 0.0: must be finite and greater than zero"):
            Safety(**{name: 0.0})
    assert Safety(hold=0).rules(controller(0.01)).limits.hold == 0
    assert Safety(most_overruns=0, ramp=1, settle=1, most_saturated=1).ramp == 1


def test_a_setup_file_gives_times_in_seconds(tmp_path: Path) -> None:
    """And bounds of y; the names that count samples remain."""
    text = """dt = 0.01
observer = {kind = "model-free", order = 1, b0 = 1.0, omega_o = 9.0}
controller = {omega_c = 2.0, u_min = -1, u_max = 1}
rig = {device = "twin:two-mass", safety = {hold_time = 0.08, ramp = 7, y_max = 3.0}}"""
    (tmp_path / "rig.toml").write_text(text)
    setup = load(tmp_path / "rig.toml")
    assert setup.rig is not None
    rules = setup.rig["safety"].rules(setup.controller, CONSTANT).limits
    assert (rules.hold, rules.ramp, rules.y_high) == (8, 7, 3.0)


def test_rules_are_told_in_a_line() -> None:
    """With the derived bounds, and with times beside the samples."""
    told = Safety(most_error=2.0, most_f=9.0, saturated_time=1.0).rules(adrc(), CONSTANT).text(DT)
    assert told == (
        "u from -3 to 3, y from -30 to 31, |r − y| up to 2, |f̂| up to 9, first motion checked, "
        "settle 20 samples (0.2 s), hold 5 samples (0.05 s), ramp 10 samples (0.1 s), "
        "most_overruns 5 samples (0.05 s), most_saturated 100 samples (1 s)"
    )
    bare = Safety(check_direction=False).rules(adrc()).text(DT)
    assert bare.startswith("u from -3 to 3, first motion not checked, settle")
    assert "saturated" not in bare


@cases(
    ("options", "message"),
    [
        ({"y_min": 2.0, "y_max": 1.0}, "y_min must be less than y_max"),
        ({"y_min": math.nan}, "y_min = nan"),
        ({"check_direction": 1}, "check_direction = 1: must be True or False"),
        ({"most_error": -5.0}, "most_error = -5.0: must be greater than zero"),
        ({"most_f": -math.inf}, "most_f = -inf: must be greater than zero"),
        ({"u_max": [], "most_error": -5.0, "y_min": math.nan}, r"u_max = \[\]: must be a number"),
        ({"y_min": [-1.0, None]}, r"y_min = \[-1.0, None\]: must be a number, or a list of"),
        ({"u_max": [None, 1.0]}, r"u_max = \[None, 1.0\]: must be a number, or a list of"),
    ],
)
def test_wrong_bounds_are_named(options: dict[str, Any], message: str) -> None:
    """By name and value."""
    with pytest.raises(ValueError, match=message):
        Safety(**options)


def reversed_plant() -> ql.plants.LinearPlant:
    """``PLANT`` with the encoder reversed."""
    return ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [-1.0, 0.0])


def test_an_encoder_that_is_reversed_is_noticed_by_its_first_motion() -> None:
    """Long before y comes to its bounds; the other way round, b0 < 0, as well."""
    free = ql.plants.LinearPlant([[0.0, 1.0], [0.0, -0.3]], [0.0, 1.5], [-1.0, 0.0])
    outcome = run(ScriptedDevice(free), approach=1.0, duration=20.0)
    k, cause = causes(outcome)[-2]
    assert cause is Cause.WRONG_WAY
    assert np.min(outcome["Y"][: k + 1]) > -6.0
    assert k * DT < 4.0
    blind = run(ScriptedDevice(free), approach=1.0, duration=20.0, check_direction=False)
    assert causes(blind)[-2][1] is Cause.IMPLAUSIBLE
    negative = ql.ADRC(
        ql.ESO.model_free(order=2, b0=-1.5, omega_o=12.0, dt=DT), 1.5, u_min=-3.0, u_max=3.0
    )
    assert causes(run(ScriptedDevice(free), negative, approach=1.0))[1][1] is Cause.COMPLETED


def test_a_load_that_is_released_with_the_take_over_does_not_trip() -> None:
    """The plant falls while u pushes up, but u holds it in the end."""
    fallen = {k: -1.0 * min((k - 10) * DT, 1.0) ** 2 for k in range(10, 3000)}
    outcome = run(ScriptedDevice(PLANT, y=fallen), approach=1.0)
    assert [cause for _, cause in causes(outcome)][1] is Cause.COMPLETED
    assert np.min(outcome["Y"][10:100]) < -0.05


LIMITS = Safety(u_min=-2.0, u_max=4.0).rules(
    ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=12.0, dt=DT), math.sqrt(3.2))
)
LIMITS = LIMITS.limits


def signals(r: float, **fields: float) -> Any:
    """Return signals of RUN with y at rest at 10 ± 0.001 before it."""
    made = initial_state().signals
    made.r[0], made.v[0] = r, fields.pop("v")
    values = {"y_began": 10.0, "y_rest_low": 9.999, "y_rest_high": 10.001, "watching": ARMED}
    for name, value in (values | fields).items():
        setattr(made.watched[0], name, value)
    return made


@cases(
    ("fields", "r", "watching"),
    [
        ({"y": 9.976, "v": 1.0}, 10.5, ARMED),  # less than 2 % of the reach of u
        ({"y": 9.974, "v": 1.0}, 10.5, SUSPECT),
        ({"y": 9.974, "v": 1.0, "y_rest_low": 9.998}, 10.5, ARMED),  # ten times the noise
        ({"y": 9.974, "v": 1.0}, 10.026, SUSPECT),
        ({"y": 9.974, "v": 1.0}, 9.5, OFF),  # the reference goes the same way
        ({"y": 9.974, "v": 1.0}, 10.025, OFF),  # y moved before the reference: a load
        ({"y": 9.974, "v": -1.0}, 10.5, OFF),  # u pushes that way
        ({"y": 9.974, "v": -1.0, "pushed": 5.0}, 10.5, SUSPECT),  # it pushed the other way so far
        ({"y": 10.026, "v": 1.0}, 10.5, OFF),  # the right way
        ({"y": 9.0, "v": 1.0, "watching": OFF}, 10.5, OFF),
        ({"y": 9.99, "v": 0.0}, 10.5, ARMED),
        ({"y": 10.063, "v": 0.0, "pushed": 5.0, "watching": SUSPECT}, 10.5, SUSPECT),
        ({"y": 10.063, "v": 1.0, "watching": SUSPECT}, 10.5, OFF),  # the right way after all
        ({"y": 10.062, "v": 1.0, "watching": SUSPECT}, 10.5, SUSPECT),
        ({"y": 10.0625, "v": 1.0, "watching": SUSPECT}, 10.5, SUSPECT),  # at the very limit
        (
            {"y": -0.025, "y_began": 0.0, "y_rest_low": 0.0, "y_rest_high": 0.0, "v": 1.0},
            0.5,
            ARMED,
        ),
        ({"y": 10.063, "v": -1.0, "pushed": 5.0, "watching": SUSPECT}, 10.5, SUSPECT),
    ],
)
def test_the_first_motion_is_judged(fields: dict[str, float], r: float, watching: int) -> None:
    """By its direction against that of u and of the reference."""
    made = signals(r, **fields)
    assert not runs_away(LIMITS, made, 0)
    assert made.watched[0].watching == watching


@cases(
    ("fields", "r", "trips"),
    [
        ({"y": 7.49, "v": 2.0}, 10.5, True),  # twice the reach of u
        ({"y": 7.51, "v": 2.0}, 10.5, False),
        ({"y": 7.49, "v": 1.99}, 10.5, False),  # less than half of the limit
        ({"y": 7.49, "v": 2.0}, 11.26, False),  # the reference is further away
        ({"y": 7.49, "v": 2.0, "y_rest_low": 9.875}, 10.5, False),  # noisy
        ({"y": 7.49, "v": 2.0, "pushed": -9.0}, 10.5, False),  # u has only just turned
        ({"y": 12.51, "v": -1.0, "pushed": -9.0}, 9.5, True),  # the lower limit is −2
        ({"y": 12.51, "v": -0.99, "pushed": -9.0}, 9.5, False),
        ({"y": 12.51, "v": 2.0}, 10.5, False),  # with u
    ],
)
def test_a_motion_against_u_trips_when_it_is_large(
    fields: dict[str, float], r: float, trips: bool
) -> None:
    """Beyond twice the scales of an honest loop, with u pushing against it."""
    assert runs_away(LIMITS, signals(r, watching=SUSPECT, **fields), 0) == trips
    # Each direction has its own limit.
    one_way = LIMITS._replace(v_low=np.array([-1.0]))
    assert not runs_away(one_way, signals(10.5, watching=SUSPECT, y=7.49, v=0.9), 0)
