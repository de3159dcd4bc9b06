"""The real-time loop of several axes: frames, the supervisor of each signal, records, commands."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.kernels.dispatch import compiled, interpreted
from quell.quantities import AxesSignals
from quell.realtime import Safety, TwinDevice, load, replay, run_rig, wire
from quell.realtime.devices import handle_of, read_measurement
from quell.realtime.recordings import (
    CsvSink,
    Event,
    Header,
    McapSink,
    definition,
    header_path,
    row_channels,
    trajectory_of,
)
from quell.realtime.registry import open_device
from quell.realtime.run import mode_changes, silence_of
from quell.realtime.supervisor import Cause, Mode
from quell.records.trajectory import Trajectory
from quell.setup import made

from .cases import cases
from .commands import Shown
from .rig_bench import TIME
from .scripted_axes import (
    B0,
    DT,
    PLANT,
    SESSION,
    THREE,
    Outcome,
    Scripted,
    accepted,
    axis,
    frame_of,
    gantry,
    offered,
)
from .setups import GANTRY

# ---- Frames ----


@compiled
def _written(out: Any, own: Any, values: Any) -> None:
    wire.write_next_numbers(out, own, wire.MEASUREMENT, TIME, values, 0)


@cases("count", [1, 2, 3, wire.MOST_SIGNALS])
def test_a_frame_has_eight_bytes_more_for_each_signal(count: int) -> None:
    """State and CRC stand behind the last number; with one number it is the frame of one signal."""
    values = np.arange(count) + 0.25
    own, out = wire.endpoint(wire.COMMAND, SESSION, 20), wire.buffer(wire.MOST_SIGNALS)
    interpreted(_written)(out, own, values)
    expected = frame_of(wire.MEASUREMENT, 1, 0, values)
    assert out.length[0] == len(expected) == wire.LENGTH + 8 * (count - 1)
    assert out.bytes[: len(expected)].tobytes() == expected
    one = wire.buffer()
    wire.write_frame(one, wire.MEASUREMENT, SESSION, 1, 0, TIME, 0.25, 0)
    assert (one.bytes[: wire.LENGTH].tobytes() == expected) == (count == 1)


@pytest.mark.trial
@pytest.mark.compiled
def test_compiled_frames_of_several_numbers_are_the_same() -> None:
    """Written and accepted by compiled code."""
    own, out = wire.endpoint(wire.COMMAND, SESSION, 20), wire.buffer(wire.MOST_SIGNALS)
    _written(out, own, np.array([1.0, math.pi, -0.0]))
    expected = frame_of(wire.MEASUREMENT, 1, 0, (1.0, math.pi, -0.0))
    assert out.bytes[: len(expected)].tobytes() == expected
    receiver = wire.endpoint(wire.MEASUREMENT, SESSION, 20, 3)
    assert offered(receiver, expected, accepted)
    assert not offered(receiver, expected, accepted)


def test_a_frame_with_another_number_of_signals_is_refused() -> None:
    """Shorter, longer, cut, too long for any session, or with a wrong bit; one with NaN is no use."""
    own = wire.endpoint(wire.MEASUREMENT, SESSION, 20, 3)
    good = frame_of(wire.MEASUREMENT, 1, 0, (1.0, 2.0, 3.0))
    bad = [frame_of(wire.MEASUREMENT, 1, 0, [0.0] * n) for n in (1, 2, 4, 16, 17, 40)]
    bad += [good[:-1], good[:-8], good + b"\0" * 8, good[:40], b"", good[:20]]
    bad += [bytes([*good[:at], good[at] ^ 1, *good[at + 1 :]]) for at in (24, 40, 47, 48, 55)]
    for data in bad:
        assert not offered(own, data)
    assert wire.counts_by_name(own.counters)["malformed"] == len(bad)
    assert own.numbers[wire.RECEIVED] == 0
    assert offered(own, good)
    assert offered(own, frame_of(wire.MEASUREMENT, 2, 0, (1.0, math.nan, 3.0)))
    assert wire.counts_by_name(own.counters)["not_finite"] == 1


def test_a_goodbye_of_several_numbers_ends_no_session() -> None:
    """Hello apart, all that is not a measurement or a command has one number."""
    own = wire.endpoint(wire.MEASUREMENT, SESSION, 20, 2)
    frame = wire.buffer(wire.MOST_SIGNALS)
    for count, ends in ((2, False), (1, True)):
        data = frame_of(wire.GOODBYE, 0, 0, [0.0] * count)
        frame.bytes[: len(data)] = np.frombuffer(data, dtype=np.uint8)
        assert wire.is_well_formed(frame, len(data), own.counters)
        assert bool(wire.is_own(own, frame, wire.GOODBYE)) == ends


# ---- A device at a wire ----


@pytest.mark.parametrize("link", ["udp", "serial"])
def test_a_rig_of_several_signals_is_measured_and_commanded(
    bench: Callable[..., Any], link: str
) -> None:
    """Each number at its place, over both wires; commands are cut one by one."""
    found = bench(link, plant=THREE, u_max=[1.0, 2.0, 3.0], x0=[0.1, 0.2, 0.3])
    device = found.open(signals=(3, 3))
    found.rig.tick()
    assert device.read().tolist() == [0.1, 0.2, 0.3]
    device.write([0.5, -5.0, 7.0])
    found.await_frame()
    found.rig.tick(2)
    assert found.rig.model.signals[0].tolist() == [0.5, -2.0, 3.0]
    assert found.rig.counters["clipped"] == 1
    assert found.rig.largest == 7.0
    np.testing.assert_allclose(
        found.rig.x, np.array([0.1, 0.2, 0.3]) + 2 * DT * np.array([0.5, -2, 3])
    )
    with pytest.raises(ValueError, match="u has shape"):
        device.write([1.0, 2.0])


def test_a_command_with_one_nan_is_not_applied(bench: Callable[..., Any]) -> None:
    """None of its numbers: half a command is none."""
    found = bench("udp", plant=THREE)
    device = found.open(signals=(3, 3))
    device.write([0.5, 0.5, 0.5])
    found.rig.tick()
    wire.write_next_numbers(
        device.handle.outbox,
        device.handle.endpoint,
        wire.COMMAND,
        TIME,
        np.array([0.1, math.nan, 0.1]),
        0,
    )
    wire.send(device.handle.transport, device.handle.outbox)
    found.rig.tick()
    assert found.rig.model.signals[0].tolist() == [0.5] * 3
    assert found.rig.counters["not_finite"] == 1


@pytest.mark.parametrize(
    ("plant", "signals", "message"),
    [
        (THREE, (2, 2), "has 3 measurements and 3 control signals, the controller 2 measurements"),
        (THREE, (3, 1), "3 control signals, the controller 3 measurements and one control signal"),
        (THREE, (16, 16), "has 3 measurements .* the controller 16 measurements"),
        (THREE, None, "the controller one measurement and one control signal: must be as many"),
        (
            ql.plants.two_mass_spring(),
            (2, 2),
            "has one measurement and one control signal, the con",
        ),
    ],
)
def test_a_device_with_other_signals_names_both_numbers(
    bench: Callable[..., Any], plant: Any, signals: Any, message: str
) -> None:
    """Over a wire, whichever side has more; and what to do."""
    found = bench("udp", plant=plant)
    with pytest.raises(ValueError, match=message) as raised:
        found.open(signals=signals, timeout=0.3)
    assert r"[[axis]]" in str(raised.value)
    assert found.rig.state in ("idle", "waiting")


def packets_at(here: Any) -> Iterator[bytes]:
    """Yield the packets that come at a socket."""
    with suppress(TimeoutError):
        while True:
            yield here.recv(4096)


def test_a_hello_is_answered_by_three_times_its_bytes_at_most(bench: Callable[..., Any]) -> None:
    """Whatever it asks for: an address that has not proved that it receives gets no more."""
    import socket

    found = bench("udp", plant=THREE)
    host, port = found.url.removeprefix("udp://").split(":")
    word = wire.signals_word(3, 3)
    asked = (((DT, 0.0, 0.0), word), ((DT,), 0), ((DT,), word), ((DT,) * 5, word))
    for session, (values, state) in enumerate(asked, 1):
        with socket.socket(type=socket.SOCK_DGRAM) as other:
            other.settimeout(0.05)
            hello = frame_of(wire.HELLO, 0, 0, values, state, session)
            other.sendto(hello, (host, int(port)))
            found.rig.tick(10)
            answer = b"".join(packets_at(other))
            assert 0 < len(answer) <= 3 * len(hello)
            assert answer[3] == wire.WELCOME
            other.sendto(frame_of(wire.GOODBYE, 0, 0, (0.0,), 0, session), (host, int(port)))
            found.rig.tick()


def test_devices_without_a_wire_say_how_many_signals_they_have() -> None:
    """A twin, a device in Python, NI cards, and numbers that can't be."""
    with pytest.raises(
        ValueError, match="TwinDevice: has 3 measurements and 3 control signals, the"
    ):
        run_rig(TwinDevice(THREE, DT), gantry(), (0.0, 0.0), duration=0.1)
    with pytest.raises(ValueError, match="TwinDevice: has one measurement .* 2 measurements"):
        run_rig(TwinDevice(ql.plants.two_mass_spring(), DT), gantry(), (0.0, 0.0), duration=0.1)
    single = axis(u_min=-1.0, u_max=1.0)
    with pytest.raises(ValueError, match="has 2 measurements .* the controller one measurement"):
        run_rig(Scripted(), single, 0.0, duration=0.1)
    one = ql.Axes([axis()], u_min=-1.0, u_max=1.0)
    with pytest.raises(
        ValueError, match=r"Device: gives y .* as numbers, .*signal_counts = \(1, 1\)"
    ):
        run_rig(TwinDevice(ql.plants.two_mass_spring(), DT), one, 0.0, duration=0.1)
    with pytest.raises(ValueError, match="Scripted: gives y .* lists of one number, .*leave out"):
        run_rig(Scripted(counts=(1, 1)), single, 0.0, duration=0.1)
    with pytest.raises(ValueError, match="has one measurement .* the controller 2 measurements"):
        open_device("ni://Dev1/ctr0+Dev2/ao0", DT, signals=(2, 2))
    with pytest.raises(ValueError, match="has 2 measurements and one .* the controller one"):
        open_device("ni://Dev1/ctr0,Dev1/ctr1+Dev2/ao0", DT)
    for wrong in ((0, 1), (1, 17), (2,), 3, "ab"):
        with pytest.raises(ValueError, match="signals"):
            open_device("udp://127.0.0.1:1", DT, signals=wrong)  # type: ignore[arg-type]


@cases("given", [[0.5], [0.5, 0.5, 0.5], [], 0.5])
def test_a_device_in_python_that_gives_another_number_of_y_has_made_an_error(given: Any) -> None:
    """One number is not the y of both axes: nothing was measured, and the error is kept."""
    device = Scripted()
    handle = handle_of(device)
    device.read = lambda: given  # type: ignore[method-assign]
    y, state = read_measurement(handle, None, 0)
    assert math.isnan(y)
    assert state == 0
    assert np.isnan(handle.y).all()
    assert handle.faults[0] == 1
    assert given == 0.5 or f"gave {len(given)} numbers: must give 2" in str(handle.errors[0])


def test_compensators_alone_take_no_reference() -> None:
    """At a rig and in a replay: they would take it for the control signal of a host."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=12.0, dt=DT)
    pair = [ql.Compensator(observer), ql.Compensator(observer)]
    alone = ql.Axes(dict(zip(("x", "y"), pair, strict=True)), B0, u_min=-3.0, u_max=3.0)
    wide = ql.Axes(pair, np.hstack([B0, [[0.5], [0.3]]]), u_min=-3.0, u_max=3.0)
    rule = "controller = Axes of Compensators: takes u_0 .*drives="
    for controller in (alone, wide):
        device = Scripted()
        with pytest.raises(ValueError, match=rule):
            run_rig(device, controller, (0.0, 0.0), duration=0.1)
        assert not np.any(device.written)
    with pytest.raises(ValueError, match=rule):
        replay(Outcome(duration=0.2).run, alone)


# ---- The loop ----


@pytest.mark.trial
def test_a_run_is_that_of_a_simulation() -> None:
    """From when the controller takes over: at rest it has learned nothing, and u acts at once."""
    found = Outcome(controller=gantry(learning=True))
    began = 10
    scenario = ql.Scenario((1.0, -0.5), 2.0)
    simulated = ql.simulate(PLANT, gantry(learning=True), scenario)
    ours = found.run.log[began : began + len(simulated)]
    part = Trajectory(ours, found.run.channels, DT, axis_names=("x", "y"))
    for name in ("r", "y", "u", "v", "x.x_hat", "y.f_residual"):
        np.testing.assert_allclose(part[name], simulated[name], rtol=1e-9, atol=1e-12)
    assert [change[1:3] for change in found.changes] == [
        (Mode.RUN, Cause.SETTLED),
        (Mode.RAMP, Cause.COMPLETED),
        (Mode.STOPPED, Cause.RAMPED),
    ]


def test_v_in_a_record_is_what_acts() -> None:
    """B0 u with the u that was applied, at the limits and while the controller only observes."""
    found = Outcome(controller=gantry(u_min=-0.3, u_max=0.4), references=(3.0, -2.0))
    u, v = found.run["u"], found.run["v"]
    np.testing.assert_allclose(v, u @ np.array(B0).T, rtol=1e-12, atol=1e-15)
    assert np.min(u[:, 1]) == -0.3
    assert np.max(u[:, 0]) == 0.4
    assert not u[:10].any()


def test_the_approach_begins_where_each_axis_is() -> None:
    """And ends at its reference, with the derivatives that the axis feeds forward."""
    axes = {"x": axis(feedforward=True), "y": axis()}
    controller = ql.Axes(axes, B0, u_min=-3.0, u_max=3.0)
    device = TwinDevice(PLANT, DT, x0=[0.4, 0.0, -0.2, 0.0])
    found = Outcome(device, controller, (1.0, 0.0), approach=0.5)
    r = found.run["r"]
    np.testing.assert_allclose(r[10], [0.4, -0.2], atol=1e-6)
    np.testing.assert_array_equal(r[70], [1.0, 0.0])
    assert np.max(np.abs(np.diff(r[10:61], axis=0))) < 0.03


def test_all_u_go_to_zero_in_straight_lines() -> None:
    """Together, from where each is."""
    found = Outcome(references=(ql.signals.Sinusoid(0.5, 2.0), -0.5))
    (ramp,) = [k for k, mode, _, _ in found.changes if mode is Mode.RAMP]
    u = found.run["u"]
    for i in range(10):
        np.testing.assert_allclose(u[ramp + i], u[ramp - 1] * (9 - i) / 10, atol=1e-15)
    assert not u[ramp + 9 :].any()
    assert np.all(np.abs(u[ramp - 1]) > 1e-3)


@pytest.mark.trial
@cases(
    ("options", "script", "cause", "signal"),
    [
        ({"most_error": [9.0, 0.3]}, {}, Cause.TRACKING_ERROR, "y"),
        ({"most_error": [0.3, 9.0]}, {}, Cause.TRACKING_ERROR, "x"),
        ({"y_min": [-9.0, -0.2]}, {}, Cause.IMPLAUSIBLE, "y"),
        ({"y_max": 0.2}, {}, Cause.IMPLAUSIBLE, "x"),
        ({"most_f": [1e9, 0.5]}, {60: (0.0, 0.3)}, Cause.F_HAT, "y"),
        ({"u_max": [9.0, 0.05], "most_saturated": 5}, {}, Cause.SATURATED, "u[1]"),
        ({"u_min": [-0.01, -9.0], "most_saturated": 5}, {}, Cause.SATURATED, "u[0]"),
        ({}, dict.fromkeys(range(50, 60), (0.0, math.nan)), Cause.LOST, "y"),
        ({}, dict.fromkeys(range(50, 60), (math.inf, 0.0)), Cause.LOST, "x"),
        ({}, dict.fromkeys(range(50, 60), (math.nan, math.nan)), Cause.LOST, ""),
    ],
)  # fmt: skip
def test_a_limit_of_one_signal_ends_the_run_and_names_it(
    options: dict[str, Any], script: Any, cause: Cause, signal: str
) -> None:
    """All u are ramped to zero; the other signals did not exceed theirs."""
    safety = Safety(**({"settle": 10, "hold": 4, "ramp": 10} | options))
    references = {"u_max": (0.0, 0.5), "u_min": (-1.0, 0.0)}.get(
        next(iter(options), ""), (1.0, -0.5)
    )
    found = Outcome(Scripted(script), references=references, safety=safety)
    ends = [change for change in found.changes if change[1] is Mode.RAMP]
    assert [(end[2], end[3]) for end in ends] == [(cause, signal)]
    assert not found.device.written[-1].any()


def test_one_missing_measurement_holds_all_u() -> None:
    """The observers of the other axes go on with their own; the change names the axis."""
    found = Outcome(Scripted({60: (0.0, math.nan), 61: (0.0, math.nan)}))
    assert [change for change in found.changes if change[1] is Mode.HOLD] == [
        (60, Mode.HOLD, Cause.MISSED, "y")
    ]
    run = found.run
    np.testing.assert_array_equal(run["u"][60:62], run["u"][[59, 59]])
    assert np.isnan(run["y_measured"][60:62]).tolist() == [[False, True]] * 2
    assert np.isfinite(run["y"]).all()
    assert (run["events"].astype(int)[60:62] & Event.MISSED).all()
    assert run["x.status"][60] == 0
    assert int(run["y.status"][60]) & ql.Status.MEASUREMENT_HELD


@pytest.mark.trial
def test_a_wrong_sign_of_one_axis_is_found() -> None:
    """An encoder that counts backwards: the run ends, and names the axis."""
    turned = ql.plants.LinearPlant(PLANT.A, PLANT.B, [[1, 0, 0, 0], [0, 0, -1, 0]])
    found = Outcome(TwinDevice(turned, DT), duration=20.0)
    (end,) = [change for change in found.changes if change[1] is Mode.RAMP]
    assert end[2:] == (Cause.WRONG_WAY, "y")
    off = Outcome(
        TwinDevice(turned, DT),
        duration=5.0,
        safety=Safety(settle=10, hold=4, ramp=10, check_direction=False),
    )
    assert Cause.WRONG_WAY not in [change[2] for change in off.changes]


def test_skipped_deadlines_are_samples_without_measurement() -> None:
    """Of all axes, under the u that was held."""
    late = np.zeros(400, dtype=np.int64)
    late[60] = 2_500_000 * 10
    found = Outcome(late=late)
    assert 2 in np.diff(found.rows[:, 0]) or 3 in np.diff(found.rows[:, 0])
    back = replay(found.run, gantry())
    stop = int(np.argmax(found.run["mode"] == Mode.STOPPED))
    np.testing.assert_allclose(
        back["x.x_hat"][stop - 20 : stop], found.run["x.x_hat"][stop - 20 : stop], atol=1e-12
    )


def test_skipped_deadlines_are_observed_under_the_u_that_was_held() -> None:
    """While u moves: the estimates are those of a replay in each sample that was taken."""
    late = np.zeros(90, dtype=np.int64)
    late[14] = 3_500_000 * 10
    found = Outcome(duration=0.4, late=late)
    ran = found.run["mode"] == Mode.RUN
    back = replay(found.run, gantry())
    taken = ran & np.isin(np.arange(len(found.run)), found.rows[:, 0] - found.rows[0, 0])
    assert 5 < np.sum(taken) < np.sum(ran)
    for name in ("x.x_hat", "y.x_hat", "x.f_residual", "y.f_residual"):
        np.testing.assert_allclose(back[name][taken], found.run[name][taken], rtol=1e-9, atol=1e-12)


# ---- Rules ----


def test_limits_are_numbers_for_all_or_one_for_each() -> None:
    """The narrower ones of controller and rules hold; the text has them by name."""
    controller = gantry(u_min=-3.0, u_max=[2.0, 5.0])
    rules = Safety(u_max=[4.0, 4.0], most_error=0.5, y_min=[-1.0, -2.0]).rules(controller)
    assert rules.limits.high.tolist() == [2.0, 4.0]
    assert rules.limits.low.tolist() == [-3.0, -3.0]
    assert rules.limits.most_error.tolist() == [0.5, 0.5]
    text = rules.text(DT)
    assert "u[1] from -3 to 4" in text
    assert "y: y from -2 to inf" in text
    assert "x: |r − y| up to 0.5" in text


@cases(
    ("options", "message"),
    [
        ({"u_max": [1.0, 2.0, 3.0]}, "u_max = .*there are 2 actuators; must be one number for all"),
        ({"most_error": [1.0]}, "most_error = .*there are 2 axes"),
        ({"most_f": [1.0, -1.0]}, "most_f"),
        ({"y_min": [0.0, 1.0], "y_max": [1.0, 0.5]}, "y_min"),
        ({"u_min": [-1.0, 0.5]}, "zero"),
        ({"u_max": []}, "u_max"),
        ({"u_max": ["a", 1.0]}, "u_max"),
    ],
)  # fmt: skip
def test_limits_that_do_not_fit_are_refused(options: dict[str, Any], message: str) -> None:
    """With the number of signals."""
    with pytest.raises(ValueError, match=message):
        Safety(**options).rules(gantry())


def test_lists_are_for_several_axes() -> None:
    """They have no effect at one, so they are refused; and what axes can not have."""
    with pytest.raises(
        ValueError, match="most_error = .*must be one number; lists are for several"
    ):
        Safety(most_error=[1.0]).rules(axis(u_min=-1.0, u_max=1.0))
    with pytest.raises(ValueError, match="must be finite for a real device"):
        Safety().rules(gantry(u_min=-math.inf))
    with pytest.raises(ValueError, match="reference has 3 signals: there are 2 axes"):
        run_rig(TwinDevice(PLANT, DT), gantry(), (0.0, 0.0, 0.0), duration=0.1)


def test_the_first_motion_is_checked_only_where_b0_is_known() -> None:
    """Of compensators with drives nothing tells how far u may move y, as of a single PID."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=12.0, dt=DT)
    pair = [ql.Compensator(observer), ql.Compensator(observer)]
    drives = [ql.baselines.PID(kp=1.0, ki=0.1, dt=DT)] * 2
    rules = Safety().rules(ql.Axes(pair, B0, drives=drives, u_min=-3.0, u_max=3.0))
    assert rules.limits.direction.tolist() == [0.0, 0.0]
    assert "first motion not checked" in rules.text(DT)
    assert Safety().rules(gantry()).limits.direction.tolist() == [1.0, 1.0]
    unchecked = Safety(check_direction=False).rules(gantry())
    assert unchecked.limits.direction.tolist() == [0.0, 0.0]


# ---- Records ----


@pytest.mark.trial
def test_a_replay_gives_the_estimates_again() -> None:
    """Bit by bit, of each axis, until the loop has stopped; the u that were wished are beside them."""
    found = Outcome(controller=gantry(learning=True), references=(ql.signals.Sinusoid(), -0.5))
    back = replay(found.run, gantry(learning=True))
    stop = int(np.argmax(found.run["mode"] == Mode.STOPPED))
    for name, _ in gantry(learning=True).channels:
        np.testing.assert_array_equal(back[name][:stop], found.run[name][:stop], err_msg=name)
    ran = found.run["mode"] == Mode.RUN
    np.testing.assert_array_equal(back["u_wished"][ran], found.run["u"][ran])
    assert back.axis("y").features == gantry(learning=True).axes[1].features
    started = replay(found.run, gantry(), u_before=[0.0, 0.0])
    assert isinstance(started, Trajectory)


@pytest.mark.parametrize(
    ("run", "controller", "message"),
    [
        ("axes", axis(u_min=-1.0, u_max=1.0), r"run: has several axes \(x, y\): NOT possible here"),
        (
            "axes",
            ql.Axes([axis()], [[1.0]]),
            "2 measurements and 2 control signals, the controller",
        ),
    ],
)
def test_a_replay_needs_as_many_axes(run: str, controller: Any, message: str) -> None:
    """A record of several is not that of one."""
    with pytest.raises(ValueError, match=message):
        replay(Outcome(duration=0.2).run, controller)


@cases("names", [("y", "x"), ("x", "z")])
@cases("kind", [".csv", ".mcap", "a table alone"])
def test_a_replay_refuses_axes_of_other_names_or_order(
    tmp_path: Path, kind: str, names: tuple[str, str]
) -> None:
    """As a state of ``quell watch`` does: the record of one axis is not that of another."""
    if kind == ".mcap":
        pytest.importorskip("foxglove")
    found, path = Outcome(duration=0.2), tmp_path / ("run.mcap" if kind == ".mcap" else "run.csv")
    sink = {".csv": CsvSink, ".mcap": McapSink}[path.suffix](path)
    sink.open(found.header)
    sink.write(found.rows)
    sink.close()
    if kind == "a table alone":
        header_path(path).unlink()
    other = ql.Axes(dict(zip(names, gantry().axes, strict=True)), B0, u_min=-3.0, u_max=3.0)
    rule = f"run has x, y, the controller {', '.join(names)}: must be the same axes in the same"
    with pytest.raises(ValueError, match=rule):
        replay(load(path), other)
    assert replay(load(path), gantry()).axis_names == ("x", "y")


@pytest.mark.parametrize("suffix", [".csv", ".mcap"])
def test_a_recording_comes_back_bit_by_bit(tmp_path: Path, suffix: str) -> None:
    """With the names of the axes in its columns; a command of one axis refuses it."""
    if suffix == ".mcap":
        pytest.importorskip("foxglove")
    found = Outcome(controller=gantry(learning=True), duration=0.3)
    path = tmp_path / f"run{suffix}"
    sink = {".csv": CsvSink, ".mcap": McapSink}[suffix](path)
    sink.open(found.header)
    sink.write(found.rows)
    sink.close()
    back = load(path)
    assert isinstance(back, Trajectory)
    assert back.channels == found.run.channels
    np.testing.assert_array_equal(back.log, found.run.log)
    assert back.axis_names == ("x", "y")
    assert back.axis_features[1] == gantry(learning=True).axes[1].features
    assert back.axis("y")["mode"][-1] == Mode.STOPPED
    if suffix == ".csv":
        names = path.read_text().splitlines()[0].split(",")
        assert {"r[x]", "y[y]", "y_measured[x]", "u[1]", "v[y]", "x.x_hat[0]"} <= {*names}
        header_path(path).unlink()
        alone = load(path)
        np.testing.assert_array_equal(alone.log, found.run.log)
        assert alone.axis_names == ("x", "y")


def test_a_table_alone_has_the_names_of_axes_and_actuators(tmp_path: Path) -> None:
    """Without the header beside it; columns of anything else are refused, and say so."""
    found = Outcome(duration=0.3)
    texts = AxesSignals.of(("x", "y"), ("way [m]", ""), ("left [N]", "right")).texts()
    sink = CsvSink(tmp_path / "run.csv")
    sink.open(Header(found.header.channels, DT, notes={**found.header.notes, "signals": texts}))
    sink.write(found.rows)
    sink.close()
    header_path(tmp_path / "run.csv").unlink()
    alone = load(tmp_path / "run.csv")
    np.testing.assert_array_equal(alone.log, found.run.log)
    assert alone.axis_names == ("x", "y")
    assert [each.name for each in alone.signals.u] == ["left", "right"]
    text = (tmp_path / "run.csv").read_text().replace("u[right]", "u[1 [N]")
    (tmp_path / "run.csv").write_text(text)
    with pytest.raises(ValueError, match="its columns differ from those of a recording"):
        load(tmp_path / "run.csv")


def test_names_of_axes_that_differ_in_their_case_only_have_fields_of_their_own() -> None:
    """Fields of ROS messages have small letters; names that others have already get a number."""
    pair = ql.Axes({"A": axis(), "a": axis()}, B0, u_min=-3.0, u_max=3.0)
    header = Header(row_channels(pair.channels, (), 2, 2), DT, notes={"axes": {"A": [], "a": []}})
    fields = re.findall(r"^float64(?:\[\d+\])? (\w+)", definition(header), re.M)
    assert len(fields) == len({*fields})
    assert {"r_a", "r_a_2", "a_x_hat", "a_x_hat_2", "a_status", "a_status_2"} <= {*fields}


def test_gaps_are_filled_in_all_columns() -> None:
    """Nothing is known of a sample that was skipped; u stays."""
    found = Outcome(duration=0.3)
    rows = np.delete(found.rows, 5, axis=0)
    run = trajectory_of(found.header, rows)
    assert np.isnan(run["y_measured"][5]).all()
    np.testing.assert_array_equal(run["u"][5], run["u"][4])
    assert int(run["events"][5]) == Event.GAP


@pytest.mark.trial
def test_names_and_units_of_signals_are_in_files_and_views(tmp_path: Path) -> None:
    """Of axes and actuators; a name with signs that separate columns stays one column."""
    signals = AxesSignals.of(["x", "y"], ["way [mm]", "angle [rad]"], ["f [N]", "m [N m]"])
    found = Outcome(duration=0.3)
    notes = {**found.header.notes, "signals": signals.texts()}
    header = Header(found.header.channels, DT, notes=notes)
    text = definition(header)
    for line in (
        "float64 y_x  # output, x [mm]",
        "float64 y_y  # output, y [rad]",
        "float64 u_f  # control signal as applied, f [N]",
        "float64 v_x  # B0 u, as applied to the axes, x [mm/s^n]",
        "float64[2] y_x_hat  #",
    ):
        assert line in text
    fields = [line.split("  #")[0].split()[1] for line in text.splitlines()]
    assert all(each.replace("_", "a").isalnum() and each.islower() for each in fields)
    run = trajectory_of(header, found.rows)
    run.to_csv(tmp_path / "run.csv")
    first = (tmp_path / "run.csv").read_text().splitlines()[0].split(",")
    assert {"y[x] [mm]", "y[y] [rad]", "u[m] [N m]", "u[f] [N]"} <= {*first}
    run.save(tmp_path / "run.nc")
    back = Trajectory.load(tmp_path / "run.nc")
    assert back.signals == signals
    np.testing.assert_array_equal(back["u"], run["u"])
    frame = back.to_xarray().to_dataframe()
    assert {"y[x]", "u[m]"} <= {*frame.columns}
    assert run.axis("y").signals.y.unit == "rad"
    odd = Header(header.channels, DT, notes={"axes": {'a,"b]': [], "c": []}})
    assert odd.columns[6] == "r[c]"
    assert odd.columns[5] == "r[a__b_]"


@cases(
    "axes",
    [["x", "y"], {"x": 1, "y": []}, {"x": []}, {"x": [], "y": [], "z": []}],
)
def test_a_header_with_wrong_axes_is_refused(axes: Any) -> None:
    """As a file that somebody has changed may have one."""
    import json

    found = Outcome(duration=0.1)
    fields = json.loads(found.header.to_json())
    fields["notes"]["axes"] = axes
    with pytest.raises(ValueError, match="axes"):
        Header.from_json(json.dumps(fields))


def test_a_run_of_missing_measurements_says_what_came() -> None:
    """The note about silence works on records of several axes, too."""
    found = Outcome(Scripted(dict.fromkeys(range(50, 60), (0.0, math.nan))))
    changes = mode_changes(found.loop.controller.supervisor, DT, axis_names=("x", "y"))
    (note,) = silence_of(found.run, changes, {}, {})
    assert note.startswith("the device gave no measurement, or none that is a number, for 0.1 s")


# ---- Commands ----


@pytest.mark.trial
def test_a_simulated_run_is_written_as_csv_or_netcdf(quell: Callable[..., Shown]) -> None:
    """By the suffix, with names and units for each signal; a text that is no unit is refused."""
    text = GANTRY.replace('name = "x"', 'name = "x"\nsignal = "way [mm]"')
    text = text.replace("dt = 1e-3", "dt = 0.02").replace("omega_o = 60.0", "omega_o = 15.0")
    text = text.replace("omega_c = 8.0", "omega_c = 2.0").replace("= 1e-3 }", "= 0.02 }")
    text = text.replace('B0 = "plant"', 'B0 = "plant", actuators = ["left [N]", "right [N]"]')
    Path("g.toml").write_text(text, encoding="utf-8")
    for name in ("run.csv", "run.nc"):
        assert quell("run", "g.toml", "--no-figures", "--save", name).code == 0
    lines = Path("run.csv").read_text().splitlines()
    assert {"time [s]", "y[x] [mm]", "y[y]", "u[left] [N]", "v[x] [mm/s^n]"} <= {
        *lines[0].split(",")
    }
    run = Trajectory.load("run.nc")
    assert len(lines) == len(run) + 1
    assert float(lines[-1].split(",")[0]) == run.t[-1]
    assert run.signals.u[1].unit == "N"
    shown = quell("run", "g.toml", "--no-figures", "--save", "run.csv")
    assert (shown.code, "run.csv" in shown.err) == (2, True)
    Path("bad.toml").write_text(text.replace("way [mm]", "way [mm"), encoding="utf-8")
    shown = quell("run", "bad.toml", "--no-figures")
    assert (shown.code, "must be a name and a unit" in shown.err) == (2, True)


def slow_gantry(**rig: Any) -> str:
    """Return the gantry's setup at 50 Hz, with a device."""
    options = {"hold_time": 1.0, "overrun_time": 10.0, "settle_time": 0.1}
    text = GANTRY.replace("dt = 1e-3", "dt = 0.02").replace("omega_o = 60.0", "omega_o = 15.0")
    text = text.replace("omega_c = 8.0", "omega_c = 2.0").replace(
        "sample_time = 1e-3", "sample_time = 0.02"
    )
    lines = [f"{key} = {value!r}" for key, value in ({"device": "twin:"} | rig).items()]
    lines += ["priority = 0", "", "[rig.safety]", *(f"{k} = {v}" for k, v in options.items())]
    return "\n".join([text, "", "[rig]", *lines, ""])


@pytest.mark.trial
def test_a_setup_of_axes_runs_at_its_device(quell: Callable[..., Shown]) -> None:
    """``quell run-rig`` prints each axis, records all, and ``quell replay`` and ``b0`` read it."""
    Path("gantry.toml").write_text(slow_gantry(), encoding="utf-8")
    arguments = ("--csv", "run.csv", "--save", "run.nc", "--json", "run.json", "--no-figures")
    shown = quell("run-rig", "gantry.toml", *arguments)
    assert shown.code == 0, shown.err + shown.out
    for text in ("gantry: x", "gantry: y", "u[0] from -25 to 20", "the scenario is over"):
        assert text in shown.out
    run = load("run.csv")
    assert run.axis_names == ("x", "y")
    assert Trajectory.load("run.nc").axis_names == ("x", "y")
    shown = quell("replay", "run.csv", "gantry.toml", "--no-figures", "--json", "replay.json")
    assert shown.code == 0, shown.err
    assert "run.csv through gantry: y" in shown.out
    Path("alone.csv").write_bytes(Path("run.csv").read_bytes())  # without run.csv.json
    names = ("run.csv", "alone.csv")
    for name in names:
        for command in (("identify", name, "--order", "2"), ("b0", name, "--order", "2")):
            shown = quell(*command)
            assert shown.code == 2
            assert "has several axes (x, y): NOT possible here" in shown.err
    shown = quell("rank", "A=run.csv", "B=alone.csv")
    assert shown.code == 0, shown.err
    assert "NOT decided for x, y" in shown.out
    read = {name: quell("b0", name, "--axes", "x,y", "--order", "2") for name in names}
    said = [(each.out + each.err).replace(name, "") for name, each in read.items()]
    assert said[0] == said[1]
    assert "u has 26 samples: must have at least 150" in said[0]
    shown = quell("run-rig", "gantry.toml", "--watch", "watch.json", "--no-figures")
    assert shown.code == 0, shown.err
    assert "NOT watched: no whole window of 60 s; run longer" in shown.out
    shown = quell("run-rig", "gantry.toml", "--omega-c", "3.0")
    assert (shown.code, "--omega-c" in shown.err) == (2, True)
    assert (
        made(
            "a.toml",
            {
                "dt": 0.01,
                "axis": [
                    {
                        "observer": {"kind": "model-free", "order": 1, "omega_o": 9.0},
                        "controller": {"omega_c": 1.0},
                    }
                ],
            },
        ).rig
        is None
    )


def test_a_replay_refuses_actuators_in_another_order(quell: Callable[..., Shown]) -> None:
    """Where the setup and the record name them: each u acts on other axes."""
    text = slow_gantry().replace("axes = {", 'axes = { actuators = ["left [N]", "right [N]"],')
    Path("gantry.toml").write_text(text, encoding="utf-8")
    Path("turned.toml").write_text(
        text.replace('"left [N]", "right [N]"', '"right [N]", "left [N]"'), encoding="utf-8"
    )
    arguments = ("--csv", "run.csv", "--seconds", "0.5", "--no-figures")
    assert quell("run-rig", "gantry.toml", *arguments).code == 0
    shown = quell("replay", "run.csv", "turned.toml", "--no-figures")
    rule = "run has left, right, the controller right, left: must be the same actuators"
    assert (shown.code, rule in shown.err) == (2, True), shown.err
    header_path(Path("run.csv")).unlink()
    shown = quell("replay", "run.csv", "turned.toml", "--no-figures")
    assert (shown.code, rule in shown.err) == (2, True), shown.err
    assert quell("replay", "run.csv", "gantry.toml", "--no-figures").code == 0


@pytest.mark.trial
def test_a_served_rig_of_axes_is_run_over_udp(quell: Callable[..., Shown]) -> None:
    """``quell rig --plant gantry.toml`` on one side, ``quell run-rig gantry.toml`` on the other."""
    import os
    import subprocess
    import sys

    Path("gantry.toml").write_text(slow_gantry(), encoding="utf-8")
    command = ("rig", "--plant", "gantry.toml", "--dt", "0.02", "--device", "udp://127.0.0.1:0")
    with subprocess.Popen(
        [sys.executable, "-m", "quell", *command, "--priority", "0", "--wait", "1.0"],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
    ) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert "with 2 measurements and 2 control signals" in line
            url = line.partition(" at ")[2].partition(",")[0]
            shown = quell("run-rig", "gantry.toml", "--device", url, "--no-figures")
        finally:
            process.kill()
    assert shown.code == 0, shown.err + shown.out
    assert "the scenario is over" in shown.out
