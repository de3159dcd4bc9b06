"""The supervisor's rules one by one, at their limits, without a loop around them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.realtime.run import ModeChange, RigRun, lost_changes, mode_changes, scenario_part, tally
from quell.realtime.safety import Safety
from quell.realtime.supervisor import (
    FLUSH,
    Cause,
    Mode,
    Request,
    SupervisorState,
    change_mode,
    finished,
    initial_state,
    supervise_controls,
    update_mode,
)
from quell.records.trajectory import Trajectory
from quell.types import Status

from .cases import cases

RULES = (
    Safety(
        *(-2.0, 4.0),
        most_error=3.0,
        most_f=7.0,
        hold=5,
        ramp=4,
        settle=3,
        most_saturated=2,
        most_overruns=5,
        y_min=-9.0,
        y_max=9.0,
    )
    .rules(ql.baselines.PID(1.0, dt=1.0))
    .limits._replace(longest_start=50)
)
SAMPLES = 100
REST: Any = {"plant": "", "features": (), "final_state": None}


def state(mode: Mode = Mode.RUN, **fields: Any) -> SupervisorState:
    """Return a state in a mode, with y = 0 and the scenario begun at cycle 3."""
    made = initial_state()
    signals, memory = made.signals, made.memory[0]
    signals.watched[0].y = fields.pop("y", 0.0)
    signals.u[0], signals.at_limit[0] = fields.pop("u", 0.0), fields.pop("at_limit", 0)
    values: dict[str, Any] = {"mode": int(mode), "began": -1 if mode == Mode.START else 3}
    for name, value in (values | fields).items():
        assert hasattr(memory, name)
        setattr(memory, name, value)
    return made


def measure(made: SupervisorState, k: int, y: float, samples: int = SAMPLES) -> None:
    """Let a sample choose the mode."""
    made.signals.y[0] = y
    update_mode(RULES, made, k, samples)


def supervised(
    made: SupervisorState, k: int, wished: float, r: float = 0.0, f_hat: float = 0.0
) -> float:
    """Return the u of a sample in which the controller wishes another one."""
    signals = made.signals
    signals.wished[0], signals.r[0], signals.f_hat[0] = wished, r, f_hat
    supervise_controls(RULES, made, k)
    return float(signals.u[0])


def last_change(made: SupervisorState) -> tuple[Mode, Cause] | None:
    """Return mode and cause of the last change."""
    changes = mode_changes(made, 1.0)
    return (changes[-1].mode, changes[-1].cause) if changes else None


def updated(k: int = 10, y: float = 0.0, **fields: Any) -> tuple[Mode, Cause] | None:
    """Return the change that a sample in RUN makes before the controller's step."""
    made = state(**fields)
    measure(made, k, y)
    return last_change(made)


@cases(
    ("fields", "cause"),
    [
        ({"missed_in_row": 5}, None),
        ({"missed_in_row": 6}, Cause.LOST),
        ({"missed_in_row": 5, "y": math.nan}, Cause.LOST),
        ({"missed_in_row": 6, "skipped_in_row": 5}, Cause.LOST),  # a mixture, most of it skipped
        ({"missed_in_row": 6, "skipped_in_row": 6}, Cause.STALLED),
        ({"missed_in_row": 9, "skipped_in_row": 6, "y": math.nan}, Cause.STALLED),
        ({"unsent_in_row": 5}, None),
        ({"unsent_in_row": 6}, Cause.UNREACHABLE),
        ({"overruns_in_row": 5}, None),
        ({"overruns_in_row": 6}, Cause.OVERRUN),
        ({"tripped": 1}, Cause.WATCHDOG),
        ({"y": 9.0}, None),
        ({"y": -9.0}, None),
        ({"y": 9.001}, Cause.IMPLAUSIBLE),
        ({"y": -9.001}, Cause.IMPLAUSIBLE),
        ({"k": 102}, None),
        ({"k": 103}, Cause.COMPLETED),
    ],
)
def test_a_run_ends_beyond_its_limits_and_not_at_them(
    fields: dict[str, Any], cause: Cause | None
) -> None:
    """One sample more, or the next number, makes the difference; in HOLD as in RUN."""
    expected = None if cause is None else (Mode.RAMP, cause)
    assert updated(**fields) == expected
    if cause is not None:
        assert updated(mode=Mode.HOLD, **fields) == expected


def test_a_good_sample_forgets_missed_and_skipped_ones() -> None:
    """A sample that is not good counts, and forgets nothing."""
    made = state(missed_in_row=3, skipped_in_row=2)
    measure(made, 10, math.nan)
    memory = made.memory[0]
    assert (memory.missed_in_row, memory.skipped_in_row, memory.mode) == (4, 2, Mode.HOLD)
    watch = made.signals.watched[0]
    assert (made.counters[0].missed, watch.y) == (1, 0.0)
    measure(made, 11, 0.5)
    assert (memory.missed_in_row, memory.skipped_in_row, memory.mode) == (0, 0, Mode.RUN)
    assert (made.counters[0].missed, watch.y) == (1, 0.5)


def test_settling_takes_good_samples_in_a_row_and_has_an_end() -> None:
    """Three here; y at rest is remembered, and START ends after ``longest_start`` samples."""
    made = state(Mode.START, y=math.nan)
    for k, y in enumerate([0.5, math.nan, 0.1, -0.2, 0.3]):
        measure(made, k, y)
        assert (made.memory[0].mode, made.memory[0].began) == (Mode.START, -1)
    measure(made, 5, 0.7)
    memory, watch = made.memory[0], made.signals.watched[0]
    assert (memory.mode, memory.began, watch.y_began, memory.samples) == (Mode.RUN, 5, 0.7, 0)
    assert (watch.y_rest_low, watch.y_rest_high, watch.watching) == (-0.2, 0.5, 0)
    assert last_change(made) == (Mode.RUN, Cause.SETTLED)
    made = state(Mode.START)  # a scenario that is shorter than the settling has not begun
    measure(made, 40, 0.0, 5)
    assert last_change(made) is None
    assert updated(k=99, began=0) is None
    assert updated(k=100, began=0) == (Mode.RAMP, Cause.COMPLETED)
    assert updated(k=50, mode=Mode.START) is None
    assert updated(k=51, mode=Mode.START) == (Mode.RAMP, Cause.UNSETTLED)
    assert updated(k=51) is None


@cases("mode", [Mode.START, Mode.RUN, Mode.HOLD, Mode.RAMP])
def test_requests_come_first(mode: Mode) -> None:
    """A ramp before any fault, but not twice; zero at once in every mode but the last."""
    made = state(mode, missed_in_row=9, tripped=1)
    made.requests[0] = Request.RAMP
    measure(made, 10, 0.0)
    assert last_change(made) == (None if mode == Mode.RAMP else (Mode.RAMP, Cause.STOP_REQUESTED))
    made.requests[0] = Request.ZERO
    measure(made, 11, 0.0)
    assert last_change(made) == (Mode.STOPPED, Cause.ZERO_REQUESTED)
    before = int(made.changed[0])
    measure(made, 12, 0.0)
    assert made.changed[0] == before


def output(
    wished: float = 1.0, r: float = 0.0, f_hat: float = 0.0, **fields: Any
) -> tuple[float, Cause | None]:
    """Return u of a sample in RUN, and the cause if the run ends."""
    made = state(**fields)
    u = supervised(made, 10, wished, r, f_hat)
    change = last_change(made)
    return u, None if change is None else change[1]


@cases(
    ("options", "cause"),
    [
        ({"r": 3.0}, None),
        ({"r": 3.001}, Cause.TRACKING_ERROR),
        ({"r": -3.001}, Cause.TRACKING_ERROR),
        ({"r": math.nan}, Cause.TRACKING_ERROR),
        ({"f_hat": 7.0}, None),
        ({"f_hat": -7.001}, Cause.F_HAT),
        ({"f_hat": math.nan}, Cause.F_HAT),
        ({"f_hat": math.inf}, Cause.F_HAT),
        ({"wished": math.nan}, Cause.NOT_A_NUMBER),
        ({"wished": math.inf}, Cause.NOT_A_NUMBER),
        ({"wished": 4.0, "at_limit": 1}, None),
        ({"wished": 4.0, "at_limit": 2}, Cause.SATURATED),
        ({"wished": -2.0, "at_limit": 2}, Cause.SATURATED),  # the lower limit
        ({"wished": -9.0, "at_limit": 2}, Cause.SATURATED),
        ({"wished": 3.999, "at_limit": 2}, None),
        ({"wished": 2.0, "at_limit": 2}, None),
    ],
)
def test_what_the_controller_gives_is_checked(options: dict[str, Any], cause: Cause | None) -> None:
    """At each limit the run goes on with u within limits; beyond, and for NaN, the ramp begins."""
    u, found = output(u=0.8, **options)
    assert found == cause
    if cause is None:
        assert u == min(max(options.get("wished", 1.0), -2.0), 4.0)
    else:
        assert u == pytest.approx(0.6)  # the first of four steps from the last u


def test_without_limits_an_estimate_that_is_not_a_number_trips_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Infinite limits allow any number, and NaN is none."""
    without = np.array([math.inf])
    monkeypatch.setattr(f"{__name__}.RULES", RULES._replace(most_f=without, most_error=without))
    made = state()
    supervised(made, 10, 1.0, f_hat=math.inf)
    assert last_change(made) is None
    supervised(made, 11, 1.0, f_hat=math.nan)
    assert last_change(made) == (Mode.RAMP, Cause.F_HAT)


def test_samples_at_a_limit_count_in_a_row() -> None:
    """One in between begins the count again; both limits count."""
    made = state()
    counted = []
    for wished in (4.0, -2.0, 1.0, 9.0):
        supervised(made, 10, wished)
        counted.append(int(made.signals.at_limit[0]))
    assert counted == [1, 2, 0, 1]


def test_u_is_held_ramped_and_then_zero() -> None:
    """HOLD keeps it, RAMP takes four equal steps, STOPPED is written four more times."""
    made = state(Mode.HOLD, u=0.8)
    assert supervised(made, 10, 3.0) == 0.8
    change_mode(made, 11, Mode.RAMP, Cause.LOST)
    steps = [supervised(made, k, 3.0) for k in range(11, 15)]
    assert steps == pytest.approx([0.6, 0.4, 0.2, 0.0], abs=1e-15)
    assert last_change(made) == (Mode.STOPPED, Cause.RAMPED)
    more = 0
    while not finished(made):
        assert supervised(made, 15, 3.0) == 0.0
        more += 1
    assert more == FLUSH + 1
    assert not any(finished(state(mode, samples=99)) for mode in Mode if mode != Mode.STOPPED)
    still = state(Mode.RAMP)  # u was zero: there is nothing to ramp
    assert supervised(still, 10, 3.0) == 0.0
    assert last_change(still) == (Mode.STOPPED, Cause.RAMPED)
    assert supervised(state(Mode.START), 10, 3.0) == 0.0


@pytest.mark.trial
def test_the_first_changes_and_the_end_are_kept_of_more_than_4092() -> None:
    """A device that misses every other sample: the list ends, the loop goes on, the end is told."""
    made = state(Mode.RUN)
    for k in range(10, 6010):
        measure(made, k, math.nan if k % 2 == 0 else 0.0, 1 << 60)
    changes = mode_changes(made, 1.0)
    assert len(changes) == 4092
    assert changes[-1].t == 10 + 4091
    assert made.memory[0].mode == Mode.RUN
    assert lost_changes(made, 1.0) == (
        "only the first 4092 changes of mode, until 4101.000 s, were kept",
    )
    for k, mode in ((7000, Mode.RAMP), (7001, Mode.STOPPED)):
        change_mode(made, k, mode, Cause.RAMPED)
    assert [change.t for change in mode_changes(made, 1.0, 4092)] == [7000.0, 7001.0]
    for k in range(10):  # nothing is written beyond the array
        change_mode(made, k, Mode.STOPPED, Cause.RAMPED)
    assert made.changed[0] == made.changes.shape[0] == 4096
    few = state()
    change_mode(few, 5, Mode.HOLD, Cause.MISSED)
    assert lost_changes(few, 1.0) == ()


def test_the_last_places_of_the_list_of_changes_are_for_the_end() -> None:
    """Four of them; a change in operation is kept before them only."""
    made = state(Mode.RUN)
    kept = made.changes.shape[0]
    made.changed[0] = kept - 5
    change_mode(made, 7, Mode.HOLD, Cause.MISSED)
    assert made.changed[0] == kept - 4
    assert made.changes[kept - 5, :3].tolist() == [7, Mode.HOLD, Cause.MISSED]
    change_mode(made, 8, Mode.RUN, Cause.RECOVERED)
    assert made.changed[0] == kept - 4
    change_mode(made, 9, Mode.RAMP, Cause.LOST)
    assert made.changed[0] == kept - 3
    assert made.changes[kept - 4, :3].tolist() == [9, Mode.RAMP, Cause.LOST]


def test_every_cause_says_how_it_ends_the_run() -> None:
    """Numbers are those of the record's format; all but a few are faults."""
    assert [int(cause) for cause in Cause] == list(range(len(Cause)))
    endings = {cause: cause.ending.name for cause in Cause if cause.ending.name != "FAULT"}
    assert endings == {
        **dict.fromkeys((Cause.NONE, Cause.SETTLED, Cause.MISSED, Cause.RECOVERED), "NO"),
        **dict.fromkeys((Cause.STOP_REQUESTED, Cause.ZERO_REQUESTED), "REQUESTED"),
        Cause.COMPLETED: "COMPLETED",
        Cause.RAMPED: "NO",
        Cause.HOST_LEFT: "REQUESTED",
        Cause.WAITING: "NO",
    }
    assert all(cause.text for cause in Cause)
    assert [int(mode) for mode in Mode] == [0, 1, 2, 3, 4]
    assert [int(request) for request in Request] == [0, 1, 2]


def test_a_run_that_was_ended_has_no_measures_of_a_step_and_says_why() -> None:
    """In a window that it did not finish; in an earlier one it has them."""
    log = np.column_stack([np.ones(20), np.linspace(0.0, 0.5, 20), np.ones(20)])
    channels = (("r", 1), ("y", 1), ("u", 1))
    part = Trajectory(log=log, channels=channels, dt=0.5, status=Status(0), ended=9.5, **REST)

    def run(*causes: Cause) -> RigRun:
        changes = tuple(ModeChange(9.5, Mode.RAMP, cause) for cause in causes)
        parts: Any = (part, part, None, changes, None, {}, (), None)
        return RigRun(*parts)

    ended, done = run(Cause.SETTLED, Cause.LOST, Cause.RAMPED), run(Cause.COMPLETED)
    assert "rise_time" in done.metrics()
    found = ended.metrics()
    assert not {"overshoot", "settling_time", "rise_time"} & found.keys()
    assert found["rms"] == done.metrics()["rms"]
    reason = "the run was ended early: 9.500 s  RAMP: too many samples in a row were missed"
    assert found.missing["overshoot"].startswith(reason)
    assert "overshoot" in ended.metrics(0.0, 9.5)
    with pytest.raises(ValueError, match=f"the record ends at 9.5 s; .* {reason}"):
        ended.metrics(10.0)
    with pytest.raises(ValueError, match="must hold at least one sample$"):
        done.metrics(10.0)


def test_the_scenarios_part_has_its_samples_only() -> None:
    """From the sample at which the controller took over, as many as the scenario has."""
    log = np.column_stack([np.arange(20.0), np.zeros(20)])
    channels = (("k", 1), ("y", 1))
    record = Trajectory(log=log, channels=channels, dt=0.5, status=Status(0), ended=9.5, **REST)
    part = scenario_part(record, state(), 5)
    assert part["k"].tolist() == [3.0, 4.0, 5.0, 6.0, 7.0]
    assert part.ended == 2.0
    never = scenario_part(record, state(Mode.START), 5)
    assert (len(never), never.ended) == (0, 0.0)
    assert tally(state(), 7)[-1] == 7
