"""The supervisor: the table of faults in docs/rig, row by row, on a virtual clock."""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import quell as ql
from quell.controllers.base import control, set_applied_control, write_row
from quell.realtime import Safety
from quell.realtime.recordings import Event
from quell.realtime.run import mode_changes
from quell.realtime.supervisor import FLUSH, Cause, Mode, Request

from .cases import cases
from .scripted import DT, PLANT, Outcome, ScriptedDevice, adrc, run

HOLD, RAMP, SETTLE = 5, 10, 10
SAMPLE = round(1e9 * DT)
MISS = math.nan


@cache
def undisturbed() -> Outcome:
    """Return the loop of ``PLANT`` in which nothing happens."""
    return run(ScriptedDevice(PLANT))


def modes(outcome: Outcome) -> list[tuple[int, Mode, Cause]]:
    """Return cycle, mode and cause of each change."""
    return [
        (round(change.t / DT), change.mode, change.cause)
        for change in mode_changes(outcome.loop.controller.supervisor, DT)
    ]


def check_ramped(outcome: Outcome, k: int, ramp: int = RAMP) -> None:
    """Check that from cycle ``k`` on u is ramped to zero in ``ramp`` samples and stays there."""
    u = outcome["U"]
    first = int(np.flatnonzero(outcome["K"] == k)[0])
    before = u[first - 1]
    assert before != 0.0
    np.testing.assert_allclose(
        u[first : first + ramp], before * (1.0 - np.arange(1, ramp + 1) / ramp), atol=1e-12
    )
    assert np.all(u[first + ramp :] == 0.0)
    assert len(u) == first + ramp + FLUSH + 1
    assert np.all(outcome["MODE"][first + ramp - 1 :] == Mode.STOPPED)


def check_ended_by(outcome: Outcome, k: int, cause: Cause) -> None:
    """Check that a ramp began at cycle ``k`` for this cause, and was completed."""
    assert modes(outcome)[-2:] == [
        (k, Mode.RAMP, cause),
        (int(outcome["K"][-1]) - FLUSH - 1, Mode.STOPPED, Cause.RAMPED),
    ]
    check_ramped(outcome, k)


def test_nothing_happens_where_nothing_goes_wrong() -> None:
    """A run without faults equals ``simulate``, sample for sample."""
    outcome = run(ScriptedDevice(PLANT))
    run_ = ql.simulate(PLANT, adrc(), ql.Scenario(1.0, 3.0))
    mine = slice(SETTLE, SETTLE + len(run_))
    np.testing.assert_array_equal(outcome["U"][mine], run_["u"])
    np.testing.assert_array_equal(outcome["Y"][mine], run_["y"])
    np.testing.assert_array_equal(
        outcome.rows[mine, 9:],
        np.column_stack([run_["x_hat"], run_["f_residual"], run_["f_learned"], run_["status"]]),
    )
    assert modes(outcome)[0] == (SETTLE, Mode.RUN, Cause.SETTLED)
    check_ended_by(outcome, SETTLE + len(run_), Cause.COMPLETED)
    assert not outcome["EVENTS"][outcome["EVENTS"] != Event.CHANGED].any()


@pytest.mark.parametrize("value", [MISS, math.inf, -math.inf])
@pytest.mark.parametrize("missed", [1, HOLD])
def test_a_few_missed_samples_hold_u(value: float, missed: int) -> None:
    """The last u is held; the controller goes on with the first good sample."""
    outcome = run(ScriptedDevice(PLANT, y={60 + i: value for i in range(missed)}))
    u = outcome["U"]
    assert np.all(u[60 : 60 + missed] == u[59])
    assert u[60 + missed] != u[59]
    assert np.all(outcome["Y"][60 : 60 + missed] == outcome["Y"][59])
    assert modes(outcome)[1:3] == [
        (60, Mode.HOLD, Cause.MISSED),
        (60 + missed, Mode.RUN, Cause.RECOVERED),
    ]
    assert np.all(outcome["EVENTS"].astype(int)[60 : 60 + missed] & Event.MISSED)
    assert outcome["Y"][SETTLE + 300] == pytest.approx(undisturbed()["Y"][SETTLE + 300], abs=0.05)


@pytest.mark.parametrize("value", [MISS, math.inf])
def test_one_missed_sample_too_many_ramps_u_down(value: float) -> None:
    """The ramp begins after ``hold`` samples; later good ones do not stop it."""
    outcome = run(ScriptedDevice(PLANT, y={60 + i: value for i in range(HOLD + 1)}))
    check_ended_by(outcome, 60 + HOLD, Cause.LOST)


def test_a_device_that_never_comes_back_is_lost() -> None:
    """The ramp needs no measurement."""
    check_ended_by(
        run(ScriptedDevice(PLANT, y=dict.fromkeys(range(60, 3000), MISS))), 60 + HOLD, Cause.LOST
    )


def test_a_stall_skips_deadlines_and_never_catches_up() -> None:
    """Reading takes 3.5 samples: three deadlines are skipped, then the grid is as before."""
    outcome = run(ScriptedDevice(PLANT, stall={60: 7 * SAMPLE // 2}))
    k = outcome["K"]
    np.testing.assert_array_equal(np.diff(k)[:70], [1.0] * 60 + [4.0] + [1.0] * 9)
    assert int(outcome["EVENTS"][60]) == Event.OVERRUN
    assert outcome["STEP_TIME"][60] == pytest.approx(3.5 * DT)
    assert np.all(outcome["LATENESS"] == 0.0)
    assert modes(outcome)[1] == (SETTLE + 301, Mode.RAMP, Cause.COMPLETED)


def test_oversleeping_skips_deadlines_as_well() -> None:
    """The loop wakes 2.2 samples late: the cycle is that of the newest deadline."""
    late = np.zeros(100, dtype=np.int64)
    late[60] = 11 * SAMPLE // 5
    outcome = run(ScriptedDevice(PLANT), late=late)
    np.testing.assert_array_equal(np.diff(outcome["K"])[57:63], [1.0, 1.0, 3.0, 1.0, 1.0, 1.0])
    assert outcome["LATENESS"][60] == pytest.approx(2.2 * DT)
    assert int(outcome["EVENTS"][60]) == Event.OVERRUN


def test_a_stall_of_too_many_samples_ramps_u_down() -> None:
    """The first cycle after it begins the ramp."""
    outcome = run(ScriptedDevice(PLANT, stall={60: (HOLD + 1) * SAMPLE + 1}))
    check_ended_by(outcome, 60 + HOLD + 2, Cause.STALLED)
    assert not any(
        cause is Cause.STALLED
        for _, _, cause in modes(run(ScriptedDevice(PLANT, stall={60: HOLD * SAMPLE + 1})))
    )


def test_too_many_overruns_in_a_row_ramp_u_down() -> None:
    """``most_overruns`` in a row are allowed, one more is not."""
    enough = run(ScriptedDevice(PLANT, stall=dict.fromkeys(range(60, 65), SAMPLE)))
    assert modes(enough)[1][2] is Cause.COMPLETED
    outcome = run(ScriptedDevice(PLANT, stall=dict.fromkeys(range(60, 66), SAMPLE)))
    check_ended_by(outcome, 60 + 2 * 6, Cause.OVERRUN)


def test_a_device_that_is_not_reached_too_often_is_given_up() -> None:
    """``hold`` commands in a row may fail; then the ramp is written, in case it arrives."""
    few = run(ScriptedDevice(PLANT, refused=dict.fromkeys(range(60, 60 + HOLD), 1)))
    assert modes(few)[1][2] is Cause.COMPLETED
    assert np.sum(few["EVENTS"].astype(int) & Event.UNSENT > 0) == HOLD
    check_ended_by(
        run(ScriptedDevice(PLANT, refused=dict.fromkeys(range(60, 3000), 1))),
        60 + HOLD + 1,
        Cause.UNREACHABLE,
    )


@pytest.mark.parametrize("fault", [2, 3])
def test_a_device_that_has_set_u_to_zero_itself_ends_the_run(fault: int) -> None:
    """The ramp begins one sample after the device has reported it."""
    check_ended_by(
        run(ScriptedDevice(PLANT, refused=dict.fromkeys(range(60, 3000), fault))),
        61,
        Cause.WATCHDOG,
    )


def test_a_tracking_error_beyond_its_limit_trips() -> None:
    """The ramp begins in the sample that exceeds the limit."""
    check_ended_by(
        run(ScriptedDevice(PLANT, y={200: 2.0}), most_error=1.5), 200, Cause.TRACKING_ERROR
    )
    assert modes(run(ScriptedDevice(PLANT), most_error=1.5))[1][2] is Cause.COMPLETED


def test_an_f_hat_beyond_its_limit_trips() -> None:
    """The limit is on the whole estimate, with the learned part."""
    outcome = run(ScriptedDevice(PLANT), most_f=1.0)
    plain = undisturbed()
    f_hat = plain.rows[:, 11] + plain.rows[:, 12]
    check_ended_by(outcome, int(np.flatnonzero(np.abs(f_hat) > 1.0)[0]), Cause.F_HAT)


def test_a_u_that_stays_at_its_limit_trips() -> None:
    """The ramp begins after ``most_saturated`` samples, not before."""
    outcome = run(ScriptedDevice(PLANT), most_saturated=30, u_min=-0.5, u_max=0.5)
    check_ended_by(outcome, SETTLE + 30, Cause.SATURATED)
    assert np.max(np.abs(outcome["U"])) == 0.5
    assert np.all(outcome["EVENTS"].astype(int)[SETTLE + 1 : SETTLE + 30] & Event.CLIPPED)
    assert (
        modes(run(ScriptedDevice(PLANT), most_saturated=30, u_min=-1.4, u_max=1.4))[1][2]
        is Cause.COMPLETED
    )


class Broken(NamedTuple):
    """A user's controller that returns NaN after some samples."""

    good: int


class BrokenState(NamedTuple):
    """Samples so far (1,)."""

    samples: Any


@control.register(Broken)
def _control(design: Broken, state: BrokenState, r: float, y: float) -> float:
    state.samples[0] += 1.0
    return 1.0 if state.samples[0] <= design.good else math.nan


@set_applied_control.register(Broken)
def _set_applied_control(design: Broken, state: BrokenState, u: float) -> None:
    assert math.isfinite(u)


@write_row.register(Broken)
def _write_row(design: Broken, state: BrokenState, row: Any) -> None:
    pass


class BrokenController:
    """The controller as an object."""

    dt, parameters, features, channels = DT, Broken(70), (), ()

    def initial_state(self) -> BrokenState:
        """Return the state before the first sample."""
        return BrokenState(np.zeros(1))


def test_a_u_that_is_not_finite_is_never_written() -> None:
    """If the controller returns NaN, the ramp begins in that sample from the last u."""
    outcome = run(ScriptedDevice(PLANT), BrokenController(), interpret=True, u_min=-2.0, u_max=2.0)
    check_ended_by(outcome, 70, Cause.NOT_A_NUMBER)


def test_the_first_request_ramps_and_the_second_is_zero_at_once() -> None:
    """Before the controller takes over there is nothing to ramp."""
    assert modes(run(ScriptedDevice(PLANT), asked=Request.RAMP)) == [
        (0, Mode.RAMP, Cause.STOP_REQUESTED),
        (0, Mode.STOPPED, Cause.RAMPED),
    ]
    assert modes(run(ScriptedDevice(PLANT), asked=Request.ZERO)) == [
        (0, Mode.STOPPED, Cause.ZERO_REQUESTED)
    ]


def test_it_takes_over_only_after_good_samples_in_a_row() -> None:
    """A missed sample restarts the count; u is zero meanwhile."""
    outcome = run(ScriptedDevice(PLANT, x0=[0.3, 0.0], y={4: MISS}), settle=SETTLE)
    assert modes(outcome)[0] == (5 + SETTLE, Mode.RUN, Cause.SETTLED)
    assert np.all(outcome["U"][: 5 + SETTLE] == 0.0)
    np.testing.assert_array_equal(outcome["R"][: 5 + SETTLE], outcome["Y"][: 5 + SETTLE])


def test_a_device_that_stutters_never_starts() -> None:
    """Without enough good samples in a row the run ends, and the cause says so."""
    outcome = run(ScriptedDevice(PLANT, y=dict.fromkeys(range(0, 3000, 5), MISS)))
    assert [cause for _, _, cause in modes(outcome)] == [Cause.UNSETTLED, Cause.RAMPED]
    assert np.all(outcome.device.written == 0.0)


faults = st.fixed_dictionaries(
    {
        "y": st.dictionaries(
            st.integers(0, 120), st.sampled_from([MISS, math.inf, -1e300, 50.0]), max_size=40
        ),
        "stall": st.dictionaries(st.integers(0, 120), st.integers(0, 20 * SAMPLE), max_size=10),
        "refused": st.dictionaries(st.integers(0, 120), st.integers(1, 3), max_size=10),
    }
)


@pytest.mark.trial
@settings(max_examples=30)
@given(scripts=faults)
def test_under_any_faults_u_is_within_limits_and_ends_at_zero(
    scripts: dict[str, dict[int, Any]],
) -> None:
    """Random faults: modes only advance, the ramp only reduces |u|, the last commands are zero."""
    outcome = run(ScriptedDevice(PLANT, **scripts), duration=1.0)
    u, mode = outcome.device.written, outcome["MODE"]
    assert np.all(np.abs(u) <= 3.0)
    assert np.all(u[-FLUSH - 1 :] == 0.0)
    assert np.all(u[mode == Mode.START] == 0.0)
    ending = mode >= Mode.RAMP
    assert np.all(np.diff(ending.astype(int)) >= 0)
    assert np.all(np.diff(np.abs(u[np.flatnonzero(ending)])) <= 0.0)
    assert np.sum(ending) <= RAMP + FLUSH + 1
    assert np.all(np.diff(outcome["K"]) >= 1.0)
    # Where u was held, it was held.
    held = np.flatnonzero(mode == Mode.HOLD)
    np.testing.assert_array_equal(u[held], u[held - 1])
    began = outcome.loop.controller.supervisor.memory[0].began
    assert (began >= SETTLE) == bool(np.any(mode == Mode.RUN))


@cases(
    ("options", "message"),
    [
        (
            {"u_min": 1.0, "u_max": 2.0},
            "u_min = 1.0, u_max = 2.0: must have zero, the safe u, between them",
        ),
        ({"u_min": 2.0, "u_max": 1.0}, "u_min must be less than u_max"),
        ({"most_error": 0.0}, "most_error = 0.0: must be greater than zero"),
        ({"most_f": math.nan}, "most_f = nan"),
        ({"ramp": 0}, "ramp = 0: must be a whole number of at least 1"),
        ({"hold": -1}, "hold = -1: must be a whole number of at least 0"),
        ({"most_saturated": 0.5}, "most_saturated = 0.5: must be a whole number"),
    ],
)
def test_what_is_out_of_range_is_named(options: dict[str, Any], message: str) -> None:
    """The message names the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        Safety(**options)


def test_without_limits_of_u_no_loop_is_closed() -> None:
    """Limits of the controller and of Safety combine to the narrower ones."""

    def range_of(rules: Any) -> tuple[float, float]:
        return float(rules.limits.low[0]), float(rules.limits.high[0])

    bare = ql.ADRC(ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=DT), omega_c=1.5)
    with pytest.raises(
        ValueError, match="u_min = -inf, u_max = inf: must be finite for a real device"
    ):
        Safety().rules(bare)
    assert range_of(Safety(u_min=-1.0, u_max=2.0).rules(bare)) == (-1.0, 2.0)
    assert range_of(Safety(u_min=-9.0, u_max=2.0).rules(adrc())) == (-3.0, 2.0)
    shaped = ql.controllers.Prefiltered(adrc(), ql.baselines.ZV(3.0))
    assert range_of(Safety().rules(shaped)) == (-3.0, 3.0)
