"""Controllers on a device: their telemetry, and exported ones in the emulator of a Cortex-M."""

import math
import threading
import types
from pathlib import Path

import numpy as np
import pytest

import quell as ql
from quell.export import plant_source
from quell.realtime import open_device, record_target, wire
from quell.realtime.transports import SerialDevice, SerialListener
from quell.realtime.wire import receive, send, wait_for_frame
from quell.signals import Sinusoid, Step
from quell.types import Status

from .benchmark_module import BENCHMARKS, benchmark
from .cases import cases

pytest.importorskip("serial")
DT = 1e-3
CHANNELS = (("r", 1), ("u", 1), ("x_hat", 2), ("status", 1))


class Target(threading.Thread):
    """A device that computes u = 2 r at each command; ``lost`` frames are not sent, ``end`` after the tick ``last``."""

    def __init__(self, lost=(), extra=0, last=10**6, end=wire.GOODBYE):
        super().__init__(daemon=True)
        self.line = SerialListener("serial://pty")
        self.lost, self.extra, self.last, self.end = lost, extra, last, end
        self.own = wire.endpoint(wire.COMMAND, 0, 20)
        self.begin = threading.Event()
        self.start()

    def send(self, kind, number, value, state=0):
        """Send a frame of the session."""
        out, own = wire.buffer(), self.own.numbers
        wire.write_frame(out, kind, own[wire.SESSION], number, own[wire.RECEIVED], 0, value, state)
        send(self.line.transport, out)

    def tick(self, r):
        """Send y and the telemetry of a tick."""
        self.own.numbers[wire.SENT] += 1
        k = int(self.own.numbers[wire.SENT])
        if k > self.last:
            if self.end is not None:
                self.send(self.end, k, 0.0, wire.WATCHDOG_TRIPPED)
            return
        values = (r, 2.0 * r, 10.0 + k, -1.0, 4.0, *[0.0] * self.extra)
        for channel, value in ((-1, k / 8.0), *enumerate(values)):
            if (k, channel) not in self.lost:
                kind = wire.MEASUREMENT if channel < 0 else wire.TELEMETRY
                self.send(kind, k, value, max(channel, 0))

    def run(self):
        """Answer frames until the session ends."""
        frame = wire.buffer()
        while True:
            wait_for_frame(self.line.transport, 10**8)
            if receive(self.line.transport, frame) < 0:
                continue
            if frame.bytes[3] == wire.HELLO and self.own.numbers[wire.SESSION] == 0:
                wire.start_session(self.own, int(frame.words[1]))
                self.send(wire.WELCOME, 0, DT)
                self.tick(0.0)
            elif frame.bytes[3] == wire.GOODBYE:
                return
            elif wire.accept(frame, self.own):
                self.tick(float(frame.doubles[3]))


def recorded(target, reference, duration, channels=CHANNELS, **options):
    """A record of the target; its line is closed."""
    try:
        with open_device(target.line.url, DT) as device:
            return record_target(device, reference, channels, duration, **options)
    finally:
        target.join(5.0)
        target.line.close()
        assert not target.is_alive()


def test_telemetry_becomes_a_trajectory():
    """From the first tick at which a reference acts; r, u and y are those of the same tick."""
    reference = Sinusoid(amplitude=2.0, omega=300.0)
    run = recorded(Target(), reference, 5 * DT)
    assert np.array_equal(run["r"], reference(np.arange(6) * DT))
    assert np.array_equal(run["u"], 2.0 * run["r"])
    assert np.array_equal(run["y"], np.arange(2, 8) / 8.0)
    assert np.array_equal(run["x_hat"], [[10.0 + k, -1.0] for k in range(2, 8)])
    assert run.status == Status.SATURATED
    assert run.dt == DT


def test_lost_telemetry_is_no_number():
    """A frame that has not come is NaN at its place; the others are at theirs."""
    run = recorded(Target(lost={(4, 1), (5, 4)}), 1.0, 5 * DT)
    gaps = np.argwhere(np.isnan(run.log)).tolist()
    assert gaps == [[2, 2], [3, 5]]
    assert run.status == Status.SATURATED


@cases(
    ("target", "error", "message"),
    [
        ({"extra": 1}, ValueError, "5 numbers are named, and it has sent one with the index 5"),
        ({"last": 3}, ConnectionError, "the device has ended the session"),
        ({"last": 3, "end": None}, ConnectionError, "nothing has come for 0.2 s"),
        ({"last": 3, "end": wire.MEASUREMENT}, ConnectionError, "no reference came in time"),
    ],
)
def test_a_record_that_can_not_be_made_is_an_error(target, error, message):
    """More channels than are named; a device that ends the session, is silent, or has tripped."""
    with pytest.raises(error, match=message):
        recorded(Target(**target), 1.0, 0.1, timeout=0.2)


@cases(
    ("options", "message"),
    [
        ({"channels": (("r", 1),)}, "must have r and u"),
        ({"channels": (("r", 1), ("u", 2))}, "must have r and u"),
        ({"channels": (("r", 1), ("u", 1), ("y", 1))}, "each once"),
        ({"duration": 0.0}, "duration = 0.0: must be"),
        ({"timeout": -1.0}, "timeout = -1.0: must be"),
        ({"reference": math.nan}, "reference = nan"),
    ],
)
def test_wrong_arguments_are_named_before_anything_is_sent(options, message):
    """The device is not touched: there is none here."""
    device = types.SimpleNamespace(dt=DT)
    given = {"reference": 1.0, "channels": CHANNELS, "duration": 0.1} | options
    with pytest.raises(ValueError, match=message):
        record_target(device, **given)


# ---- exported controllers in the emulator ----

DRIVE = ql.plants.LinearPlant(A=[[0.0, 1.0], [0.0, -0.6]], B=[0.0, 5.0], C=[1.0, 0.0])


@pytest.fixture(scope="module")
def table():
    """The benchmark, which has the emulator; skipped where the tools or the script are missing."""
    if not (BENCHMARKS / "target.py").exists():
        pytest.skip("there are no benchmarks here")
    table = benchmark("target")
    if tool := table.emulator.missing_tool():
        pytest.skip(f"{tool} is not installed")
    return table


def servo(learner=None, disturbance_order=1):
    """A controller for the drive."""
    observer = ql.ESO.model_free(2, 5.0, 50.0, DT, disturbance_order=disturbance_order)
    return ql.ADRC(observer, omega_c=10.0, learner=learner, u_min=-10.0, u_max=10.0)


def moving():
    """The same with feedforward by a model, behind a generator of moves: r is the target."""
    plain, generator = servo(), ql.controllers.ProfileGenerator(3.0, 40.0, 1500.0)
    model = ql.Feedforward.of(DRIVE)
    limits = {"u_min": plain.limits.low, "u_max": plain.limits.high}
    fed = ql.ADRC(plain.observer, plain.omega_c, feedforward=model, **limits)
    return ql.controllers.Prefiltered(fed, generator)


def built(table, folder, board, precision, parts, *flags, controller=None):
    """The path of a program of the examples with a controller."""
    table.export(controller or servo(), precision, "servo", folder)
    table.write_source(plant_source(DRIVE, DT), folder)
    sources = [*(table.emulator.HERE / part for part in parts), folder / "plant.c"]
    program = folder / "servo.elf"
    flags = (f"-I{folder}", *flags)
    table.emulator.build(board, program, [*sources, folder / "servo.c"], *flags)
    return program


@pytest.mark.trial
def test_the_emulator_counts_instructions(table, tmp_path):
    """A thousand of them as a thousand; u is that of the simulation; stack and state are small."""
    scenario = ql.Scenario(reference=Sinusoid(), duration=0.2)
    run = ql.simulate(DRIVE, servo(), scenario, interpret=True)
    case = table.Case("servo", "Cortex-M4F", "single", DRIVE, servo())
    found = table.measured(case, run, tmp_path)  # an error if a known loop is counted wrongly
    assert 100.0 < found["instructions"] <= found["most"] < 400.0
    assert found["state"] <= 100.0
    assert 0.0 < found["stack"] <= 100.0
    assert found["difference"] < 1e-4


@pytest.mark.trial
def test_a_second_extended_state_takes_a_third_more_instructions_at_most(table, tmp_path):
    """Of a step of order 2 in single precision, 1.35 times as many; u is still that of the simulation."""
    scenario = ql.Scenario(reference=Sinusoid(), duration=0.2)
    instructions = []
    for m in (1, 2):
        controller = servo(disturbance_order=m)
        run = ql.simulate(DRIVE, controller, scenario, interpret=True)
        case = table.Case("servo", "Cortex-M4F", "single", DRIVE, controller)
        found = table.measured(case, run, tmp_path)
        assert found["difference"] < 1e-3
        instructions.append(found["instructions"])
    assert instructions[0] < instructions[1] <= 1.35 * instructions[0]


@pytest.mark.trial
@pytest.mark.parametrize(
    ("board", "precision"), [("Cortex-M4F", "single"), ("Cortex-M7", "double")]
)
def test_golden_vectors_hold_on_the_target(table, tmp_path, board, precision):
    """Those of the export, with sines and roots of the C library, saturation, NaN and retuning.

    Without FMA newlib differs from the C library of this machine by a few units in the last place.
    """
    case = table.Case("servo", board, precision, DRIVE, servo(ql.learners.Harmonic()))
    assert table.golden(case, tmp_path / "c") < 16.0  # an error if the test in C has failed


@pytest.mark.trial
def test_a_timer_interrupt_controls_a_drive(table, tmp_path):
    """Under load from the start, through manual operation, and off when the sensor has failed."""
    board = table.emulator.BOARDS["Cortex-M4F"]
    parts = ("timer_interrupt.c", "simulated_drive.c")
    program = built(table, tmp_path, board, "single", parts)
    code, output = table.emulator.run(board, program, "-icount", "shift=6,sleep=off")
    assert code == 0, output
    y, u = np.loadtxt(output.splitlines(), unpack=True)
    assert np.max(np.abs(y[:200])) < 1e-6  # started under load
    assert abs(y[1199] - 1.0) < 1e-3
    assert np.allclose(u[1200:1700], 3.2)  # manual
    assert abs(u[1700] - 3.2) < 0.02  # handed over
    assert abs(y[2499] - 1.0) < 5e-3
    assert np.max(np.abs(np.diff(u[2490:3290]))) < 0.05  # retuned, and five samples without y
    assert np.all(u[-75:] == 0.0)


@pytest.mark.trial
def test_a_target_in_double_precision_equals_the_simulation(table, tmp_path):
    """Target, output, control signal, move, feedforward and estimates over the serial line, bit for bit.

    The device and the record wait for each other for a minute: a busy machine may stop either of them.
    """
    board, controller = table.emulator.BOARDS["Cortex-M7"], moving()
    reference = Step(0.4) - Step(0.7, at=0.06)
    parts = ("serial_target.c", "mps2_uart.c")
    flags = ("-DMOST_WAIT=60000", "-DLOAD_AT=50", "-DLOAD=(-3.0)")
    program = built(table, tmp_path, board, "double", parts, *flags, controller=controller)
    load = Step(height=-3.0, at=50 * DT)
    scenario = ql.Scenario(reference=reference, disturbances=(load,), duration=0.15)
    simulated = ql.simulate(DRIVE, controller, scenario, interpret=True)
    channels = (("r", 1), ("u", 1), *controller.channels)
    line = table.emulator.serial_line(board, program)
    with line as url, SerialDevice(url, DT, timeout=60.0) as device:
        run = record_target(device, reference, channels, scenario.duration, timeout=60.0)
    for name in run.names:
        assert np.array_equal(run[name], simulated[name]), name


@pytest.mark.trial
@pytest.mark.parametrize(
    ("board", "precision"), [("Cortex-M4F", "single"), ("Cortex-M7", "double")]
)
def test_a_servo_axis_moves_on_the_target_as_in_simulation(table, board, precision):
    """Two inertias, encoder, late torque, a move by 90° with the model's feedforward and a load: bit for bit.

    Single precision is that of the simulation in single precision, on both sides; what it changes is
    below 0.1 % of the torque, and two counts of the encoder.
    """
    move = benchmark("servo_move")
    observer = ql.ESO.model_based(move.axis(), 1185.0, move.DT, b0=5440.0)
    model = ql.Feedforward.of(move.axis(), delay=move.DT)
    controller = move.moving(ql.ADRC(observer, 81.0, feedforward=model, u_min=-3.5, u_max=3.5))
    found = move.on_target(controller, board, precision)
    assert move.apart(move.simulated(controller, precision), found) == dict.fromkeys(found, 0.0)
    double = move.simulated(controller)
    errors = move.apart(double, found)
    assert errors["u"] <= 1e-3 * move.TORQUE
    assert errors["y"] <= 2.1 * math.tau / move.COUNTS
    error = np.abs(double["y"] - np.ravel(double["r_shaped"]))
    assert np.degrees(np.max(error[: move.TORQUE_AT])) < move.BARS[1.0]


@pytest.mark.trial
def test_a_tick_never_sees_half_of_a_command(table, tmp_path):
    """Wherever the timer interrupts the receiver, if it masks the timer; else ticks do see it."""
    emulator, wrong = table.emulator, []
    board, source = emulator.BOARDS["Cortex-M4F"], Path(__file__).with_name("preempted_device.c")
    for flags in ((), ("-DLOCKED",)):
        program, include = tmp_path / "device.elf", f"-I{emulator.HERE.parent}"
        emulator.build(board, program, [source], include, *flags)
        code, output = emulator.run(board, program, "-icount", "shift=10,sleep=off")
        assert code == 0, output
        assert "live 1" in output
        wrong.append(int(output.split()[2]))
    assert wrong[0] > 0
    assert wrong[1] == 0
