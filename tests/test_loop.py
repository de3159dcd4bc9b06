"""The loop: clocks of devices, reference, other controllers, compilation."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql
from quell.controllers.stateful import named_arrays
from quell.kernels.dispatch import compilations
from quell.kernels.sized import layout_of
from quell.realtime.cycle import ControlLoop, run_cycles
from quell.realtime.devices import PythonHandle, Tick, read_measurement, read_tick, write_signals
from quell.realtime.recordings import LOOP_WIDTH, Event, row_channels
from quell.realtime.run import mode_changes
from quell.realtime.safety import Safety, approach_curve, as_scenario, reference_samples
from quell.realtime.supervisor import Cause
from quell.realtime.system import now, pass_time, virtual_clock
from quell.realtime.telemetry import drain, ring

from .cases import cases
from .scripted import DT, PLANT, ScriptedDevice, adrc, run

SAMPLE = round(1e9 * DT)


class Ticking(NamedTuple):
    """A paced device that sends the number of each tick at its time."""

    period: float
    """Time between ticks by the loop's clock [ns]."""
    late: Any
    """Delay of tick k [ns]."""
    seen: Any
    """Last tick that was read, and greatest age of one after the first thousand [ns] (2,)."""


@read_tick.register(Ticking)
def _read_tick(handle: Ticking, clock: Any, until: int) -> Tick:
    begin = now(clock)
    k = int(handle.seen[0]) + 1
    comes = _comes(handle, k)
    if comes > until:
        pass_time(clock, max(until - begin, 0))
        return Tick(math.nan, 0, math.nan, 0, now(clock) - begin)
    pass_time(clock, max(comes - begin, 0))
    handle.seen[0] = k
    handle.seen[1] = max(handle.seen[1], now(clock) - comes) if k > 1000 else 0
    left = 0
    while _comes(handle, k + 1 + left) <= now(clock):
        left += 1
    return Tick(float(k), 1, math.nan, left, now(clock) - begin)


def _comes(handle: Ticking, k: int) -> int:
    """Return the time of tick k, which never comes before the one before it."""
    late = [handle.late[min(i, handle.late.size - 1)] for i in range(max(k - 9, 0), k + 1)]
    return max(int(i * handle.period) + int(late[i - k - 1]) for i in range(max(k - 9, 0), k + 1))


@write_signals.register(Ticking)
def _write_signals(handle: Ticking, u: Any) -> int:
    return 0


class TickingDevice:
    """The handle as a device."""

    paced = True

    def __init__(
        self, period: float, late: dict[int, int] | None = None, samples: int = 30_000
    ) -> None:
        delays = np.zeros(samples, dtype=np.int64)
        for k, value in (late or {}).items():
            delays[k] = value
        self.handle = Ticking(period, delays, np.array([-1, 0]))

    def read(self) -> float:
        """Not used."""
        raise NotImplementedError

    def write(self, u: float) -> None:
        """Not used."""
        raise NotImplementedError

    def close(self) -> None:
        """Do nothing."""


FLAT = ql.controllers.LinearController(
    ql.controllers.LinearLaw(*[np.zeros(s) for s in ((0, 0), 0, 0, 0, 0)], 0.0, 0.0),
    DT,
    u_min=-1,
    u_max=1,
)


def ticks(device: TickingDevice, duration: float, late: Any = (0,), **safety: Any) -> Any:
    """Run a controller with u = 0 around a paced device; return rows and loop."""
    clock = virtual_clock(late)
    width = sum(width for _, width in row_channels(FLAT.channels))
    rows = ring(40_000, width)
    rules = Safety(**{"settle": 1} | safety).rules(FLAT)
    loop = ControlLoop.of(
        device,
        FLAT,
        reference_samples(as_scenario(0.0, duration), FLAT, 0.0),
        rules,
        clock,
        rows,
        interpret=True,
    )
    loop.run()
    return drain(rows), loop


@pytest.mark.trial
@pytest.mark.parametrize("drift", [-50e-6, 50e-6, 1e-3])
def test_the_grid_follows_a_devices_clock(drift: float) -> None:
    """For slower and faster clocks each cycle gets the next tick, and none is old."""
    device = TickingDevice(SAMPLE * (1.0 + drift))
    found, loop = ticks(device, 20.0)
    assert device.handle.seen[1] <= SAMPLE // 5_000
    y = found[:, LOOP_WIDTH - 2]
    np.testing.assert_array_equal(np.diff(y), 1.0)
    assert len(y) > 1_950
    assert loop.controller.supervisor.counters[0].overruns == 0


# Of two cycles one wakes just before the tick, the next one just after.
@pytest.mark.parametrize("k", [300, 301])
@pytest.mark.parametrize("hiccup", [SAMPLE // 2 + 1000, SAMPLE, 5 * SAMPLE // 2])
def test_a_delay_of_the_device_costs_no_measurement(hiccup: int, k: int) -> None:
    """Its late ticks come at once; the loop takes a step for each, with its own measurement."""
    late = {k + i: max(hiccup - i * SAMPLE, 0) for i in range(4)}
    found, loop = ticks(TickingDevice(SAMPLE, late), 3.5)
    ahead = found[:, LOOP_WIDTH - 2] - found[:, 0]
    np.testing.assert_array_equal(np.diff(found[:, 0]), 1.0)
    np.testing.assert_array_equal(ahead, ahead[0])
    counters = loop.controller.supervisor.counters[0]
    assert (counters.missed, counters.overruns) == (0, 0)
    assert counters.skipped == hiccup // SAMPLE


@pytest.mark.parametrize("k", [300, 301])
@pytest.mark.parametrize("hiccup", [SAMPLE // 2, 3 * SAMPLE - 1000, 3 * SAMPLE + 1000])
def test_a_delay_of_the_loop_costs_no_measurement(hiccup: int, k: int) -> None:
    """The loop wakes late: it makes up for the ticks meanwhile, and sends u for the newest."""
    late = np.zeros(20_000, dtype=np.int64)
    late[k] = hiccup
    found, loop = ticks(TickingDevice(SAMPLE), 3.5, late)
    ahead = found[:, LOOP_WIDTH - 2] - found[:, 0]
    np.testing.assert_array_equal(np.diff(found[:, 0]), 1.0)
    np.testing.assert_array_equal(ahead, ahead[0])
    counters = loop.controller.supervisor.counters[0]
    assert counters.missed == 0
    assert abs(counters.skipped - hiccup // SAMPLE) <= 1
    assert counters.overruns == (hiccup >= SAMPLE)


def test_a_loop_that_stood_still_for_too_long_is_stopped() -> None:
    """Though all measurements are there: u was held for more than ``hold`` samples."""
    late = np.zeros(20_000, dtype=np.int64)
    late[300] = 7 * SAMPLE
    _, loop = ticks(TickingDevice(SAMPLE), 10.0, late, hold=5)
    causes = [change.cause for change in mode_changes(loop.controller.supervisor, DT)]
    assert causes == [Cause.SETTLED, Cause.STALLED, Cause.RAMPED]


def test_a_device_that_falls_silent_is_lost_after_the_time_for_which_u_is_held() -> None:
    """The loop goes on by its own clock: the ramp, then the end."""
    found, loop = ticks(TickingDevice(SAMPLE, {301: 10**15}), 10.0, hold=5)
    (settled, held, lost, _) = mode_changes(loop.controller.supervisor, DT)
    assert (settled.cause, held.cause, lost.cause) == (Cause.SETTLED, Cause.MISSED, Cause.LOST)
    assert round((lost.t - held.t) / DT) == 5
    np.testing.assert_array_equal(np.diff(found[:, 0]), 1.0)
    gone = np.isnan(found[:, LOOP_WIDTH - 2])
    assert np.flatnonzero(gone)[0] == held.t / DT
    assert np.all(gone[round(held.t / DT) :])


def test_a_device_that_sends_nothing_is_not_started() -> None:
    """The loop stops before the first cycle, within two seconds, and names the cause."""
    found, loop = ticks(TickingDevice(1e18), 1.0)
    assert [change.cause for change in mode_changes(loop.controller.supervisor, DT)] == [
        Cause.NO_MEASUREMENT
    ]
    assert now(loop.clock) < 2.1e9
    assert np.all(found[:, LOOP_WIDTH - 1] == 0.0)


def test_skipped_deadlines_do_not_disturb_the_observer() -> None:
    """A stall of three samples leaves the estimates of a model-based observer exact."""
    stalled = ScriptedDevice(PLANT, stall={40: 35_000_000}, moves={41: 3})
    controller = ql.ADRC(
        ql.ESO.model_based(PLANT, omega_o=12.0, dt=DT), omega_c=1.5, u_min=-3.0, u_max=3.0
    )
    found = run(stalled, controller)
    k = found["K"]
    assert 3 in np.diff(k) - 1
    assert np.max(np.abs(np.diff(found["U"][:60]))) > 1e-3
    f_residual = found.rows[:, found.loop.controller.f_hat[0, 1]]
    np.testing.assert_allclose(f_residual, 0.0, atol=1e-9)


def test_the_reference_slides_from_where_y_is() -> None:
    """With the least jerk and matching derivatives; after ``approach`` it is the scenario's own."""
    controller = adrc()
    fed = ql.ADRC(controller.observer, 1.5, feedforward=True, u_min=-3.0, u_max=3.0)
    reference = ql.signals.Sinusoid(omega=1.0)
    outcome = run(
        ScriptedDevice(PLANT, x0=[0.0, 0.0], y=dict.fromkeys(range(3000), 0.5)),
        fed,
        reference,
        approach=1.0,
        interpret=True,
    )
    r = outcome["R"][10:311]
    t = np.arange(301) * DT
    assert r[0] == 0.5
    np.testing.assert_array_equal(r[100:], np.sin(t)[100:])
    tau = t[:100]
    np.testing.assert_allclose(
        r[:100], np.sin(tau) + 0.5 * (1.0 - (10 * tau**3 - 15 * tau**4 + 6 * tau**5)), atol=1e-12
    )
    slide = approach_curve(1e-4, 1.0, 3)
    for i in range(3):
        np.testing.assert_allclose(
            np.gradient(slide[:, i], 1e-4)[2:-2], slide[2:-2, i + 1], atol=2e-5
        )
    assert slide[0].tolist() == [1.0, 0.0, 0.0, -60.0]
    assert abs(slide[-1, 0]) < 1e-10
    assert approach_curve(DT, 0.0, 2).shape == (0, 3)


def test_it_takes_over_without_a_bump() -> None:
    """From rest at y = 0.4 and u = 0 the control signal starts at zero and stays small."""
    free = ql.plants.LinearPlant([[0.0, 1.0], [0.0, -0.3]], [0.0, 1.5], [1.0, 0.0])
    u = run(ScriptedDevice(free, x0=[0.4, 0.0]), reference=1.0, approach=2.0, settle=50)["U"]
    assert np.all(np.abs(np.diff(u)[:60]) < 0.02)
    # Where the plant does not rest, the controller would rather have done something already.
    moving = run(ScriptedDevice(PLANT, x0=[0.4, 0.0]), approach=2.0, settle=20)
    assert abs(moving["U"][20]) < 0.05
    wish = (moving.rows[19, 11] + moving.rows[19, 12]) / 1.5
    assert abs(wish) > 0.2
    jumps = run(ScriptedDevice(free, x0=[0.4, 0.0]), reference=1.0, approach=0.0, settle=50)["U"]
    assert np.max(np.abs(np.diff(jumps))) > 0.5


class ThroughPython:
    """A device without a compiled handle."""

    def __init__(self, device: ScriptedDevice) -> None:
        self.inner, self.clock = device, virtual_clock()

    def read(self) -> float:
        """Read."""
        y, _ = read_measurement(self.inner.handle, self.clock, 0)
        if math.isinf(y):
            raise OSError("the driver is not well")
        return y

    def write(self, u: float) -> None:
        """Write; the driver may fail."""
        if write_signals(self.inner.handle, np.array([u])):
            raise OSError("the driver is not well")

    def close(self) -> None:
        """Do nothing."""


@pytest.mark.trial
@pytest.mark.compiled
def test_a_controller_is_stepped_compiled_though_the_device_is_python() -> None:
    """Plain Python and a compiled step agree; errors of the driver count as missed samples."""
    scripts: dict[str, Any] = {"y": {60: math.inf}, "refused": {90: 1}}
    plain = run(ScriptedDevice(PLANT, **scripts), adrc(), interpret=True)
    device: Any = ThroughPython(ScriptedDevice(PLANT, **scripts))
    half = run(device, adrc())
    # A driver that raises has measured nothing: NaN, where the line of the script says infinite.
    plain.rows[:, LOOP_WIDTH - 2][np.isinf(plain.rows[:, LOOP_WIDTH - 2])] = math.nan
    np.testing.assert_allclose(half.rows, plain.rows, rtol=1e-9, atol=1e-9)
    handle = half.loop.handle
    assert isinstance(handle, PythonHandle)
    assert (handle.faults[0], str(handle.errors[0])) == (2, "the driver is not well")
    assert int(half["EVENTS"][60]) & Event.MISSED
    assert int(half["EVENTS"][90]) & Event.UNSENT


@pytest.mark.trial
@pytest.mark.compiled
def test_plain_python_does_what_compiled_code_does() -> None:
    """Missed samples, a stall, an unsent command and a trip: same modes, same numbers."""
    scripts: dict[str, Any] = {
        "y": {60: math.nan, 61: math.nan, 200: 1.0},
        "stall": {100: round(3e9 * DT)},
        "refused": {80: 1},
    }
    compiled, plain = (
        run(ScriptedDevice(PLANT, **scripts), interpret=interpret, most_error=1.1)
        for interpret in (False, True)
    )
    changes, same = (
        mode_changes(outcome.loop.controller.supervisor, DT) for outcome in (compiled, plain)
    )
    assert changes == same
    assert len(changes) == 5
    np.testing.assert_allclose(plain.rows, compiled.rows, rtol=1e-12, atol=1e-12)


@pytest.mark.trial
@pytest.mark.compiled
def test_a_loop_compiles_before_it_begins_and_leaves_its_controller_alone() -> None:
    """No cycle runs, a second loop compiles nothing, the controller's own state is unchanged."""
    controller = adrc()
    before = controller.state
    device = ScriptedDevice(PLANT)
    rules, points = (
        Safety(settle=10).rules(controller),
        reference_samples(as_scenario(1.0, 1.0), controller, 0.0),
    )
    width = sum(width for _, width in row_channels(controller.channels))
    loop = ControlLoop.of(device, controller, points, rules, virtual_clock(), ring(4096, width))
    assert device.handle.at.tolist() == [0, 0]
    for array in named_arrays(loop.controller.state).values():
        assert not np.any(array)
    compiled = compilations(run_cycles)
    loop.run()
    run(ScriptedDevice(PLANT))
    assert compilations(run_cycles) == compiled
    for label, array in controller.state.items():
        np.testing.assert_array_equal(array, before[label])


def test_loops_of_any_duration_are_the_same_code() -> None:
    """Also short ones, with and without derivatives of the reference and an approach."""
    for controller in (adrc(), adrc(feedforward=True)):
        layouts = {
            layout_of(reference_samples(as_scenario(1.0, duration), controller, approach))
            for duration in (0.1, 1.0, 10.0)
            for approach in (0.0, 0.2, 5.0)
        }
        assert len(layouts) == 1


@cases(
    ("scenario", "duration", "message"),
    [
        (1.0, None, "duration = None: give the duration"),
        ("up", 1.0, "scenario = 'up': must be a number"),
        (ql.Scenario(1.0, 5.0, rest_at=(1.0,)), None, "a real plant can't be put back to rest"),
        (ql.Scenario(1.0, 1e6), None, "must be at most 1e\\+07 samples"),
    ],
)
def test_a_scenario_that_can_not_be_run_is_refused(
    scenario: Any, duration: float | None, message: str
) -> None:
    """The error comes before anything moves."""
    with pytest.raises(ValueError, match=message):
        reference_samples(as_scenario(scenario, duration), FLAT, 1.0)


def test_a_reference_that_is_not_finite_is_refused() -> None:
    """The error names the time of the first bad sample."""

    class Gap(ql.signals.Signal):
        def evaluate(self, t: Any) -> Any:
            return np.where(t > 0.5, np.nan, t)

    with pytest.raises(ValueError, match="is not finite at 0.51 s"):
        reference_samples(as_scenario(Gap(), 1.0), FLAT, 1.0)
