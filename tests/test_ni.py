"""Cards of NI: the package nidaqmx runs as it is, on a stand-in for the C library below it."""

import gc
import math
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import quell as ql
from quell.realtime.devices import TwinDevice, handle_of, read_measurement, write_signals
from quell.realtime.ni import NiDevice, Tasks, Voltage, ni_device
from quell.realtime.registry import open_device
from quell.realtime.system import virtual_clock

from . import scripted, scripted_axes
from .daqmx_standin import Card, Rack

library = pytest.importorskip("nidaqmx._lib").lib_importer
TAU = 2.0 * math.pi


def put_under(rack, monkeypatch):
    """Make the stand-in the library that the package finds."""
    for name, value in (("_windll", rack), ("_cdll", rack), ("_encoding", "utf-8")):
        monkeypatch.setattr(library, name, value)


def paper_s_rack(**more):
    """A PCI-6601 (Dev1) and a PCI-6221 (Dev2)."""
    return Rack(Dev1=Card(counters=4, lines=8), Dev2=Card(counters=2, outputs=2, lines=24), **more)


@pytest.fixture
def rack(monkeypatch):
    """The paper's two cards; nothing may be left on them that still runs."""
    gc.freeze()  # what other tests left need not be gone through
    rack = paper_s_rack()
    put_under(rack, monkeypatch)
    yield rack
    gc.collect()
    assert not rack.tasks, "a task was not cleared"


@pytest.fixture
def device(rack):
    """The paper's device on them."""
    device = NiDevice("Dev1/ctr0", "Dev2/ao0", counts=16000)
    yield device
    device.close()


def test_a_turn_of_the_shaft_is_two_pi(rack, device):
    """16000 edges a turn; zero is where it was opened."""
    assert device.read() == 0.0
    rack.edges = 16000
    assert device.read() == pytest.approx(TAU, rel=1e-15)
    rack.edges = -1
    assert device.read() == -TAU / 16000


def test_zero_is_where_the_device_was_opened(rack):
    """Wherever the shaft stood before."""
    rack.edges = 12345
    device = NiDevice("Dev1/ctr0", "Dev2/ao0")
    rack.edges += 4000
    assert device.read() == pytest.approx(TAU / 4)
    device.close()


@given(st.lists(st.integers(-(2**23) + 1, 2**23 - 1), max_size=30), st.sampled_from([24, 32]))
def test_a_counter_that_rolls_over_is_followed_across(steps, bits):
    """In both directions, with 24 and 32 bits: the position is the sum of all turns."""
    rack = paper_s_rack()
    rack.cards["Dev1"].bits = bits
    with pytest.MonkeyPatch.context() as patch:
        put_under(rack, patch)
        device = NiDevice("Dev1/ctr0", "Dev2/ao0", counts=4, bits=bits)
        for step in steps:
            rack.edges += step
            assert device.read() == TAU * rack.edges / 4
        device.close()


def test_the_ratio_and_the_sign_of_the_encoder_are_the_user_s(rack):
    """An encoder on the motor's side of a 3:1 belt that counts the other way."""
    device = NiDevice("Dev1/ctr0", "Dev2/ao0", counts=16000, ratio=-1 / 3)
    rack.edges = 48000
    assert device.read() == pytest.approx(-TAU)
    device.close()


def test_u_comes_out_in_volts_and_is_cut_at_its_limits(rack):
    """U beyond the limits never reaches the card; the driver was told the same limits."""
    device = NiDevice("Dev1/ctr0", "Dev2/ao1", volts=-2.0, u_min=-1.0, u_max=4.0)
    for u in (0.5, -7.0, 99.0):
        device.write(u)
    assert rack.cards["Dev2"].history == [("ao1", 0.0), ("ao1", -1.0), ("ao1", 2.0), ("ao1", -8.0)]
    assert next(task.channels for task in rack.tasks.values() if task.kind == "output") == {
        "ao1": (-8.0, 2.0)
    }
    device.close()


def test_a_u_that_is_no_number_is_zero_on_the_card(rack, device):
    """And said."""
    device.write(3.0)
    with pytest.raises(
        ValueError, match="u = nan: must be a finite number; the output is zero now"
    ):
        device.write(math.nan)
    assert rack.cards["Dev2"].volts["ao0"] == 0.0


def test_the_output_is_zero_before_and_after(rack):
    """Whatever voltage was on it; the amplifier is enabled from the first write to the end."""
    card = rack.cards["Dev2"]
    card.volts["ao0"] = 7.0
    device = NiDevice("Dev1/ctr0", "Dev2/ao0", enable="Dev2/port0/line0")
    assert card.history == [("ao0", 0.0), ("port0/line0", False)]
    device.write(5.0)
    device.close()
    device.close()
    assert card.history[2:] == [
        ("port0/line0", True),
        ("ao0", 5.0),
        ("port0/line0", False),
        ("ao0", 0.0),
    ]


@pytest.mark.trial
def test_the_output_is_zero_when_python_ends():
    """Also where nobody closed the device: here the program ends by an exception."""
    program = (
        "from quell.realtime.ni import NiDevice\n"
        "from tests.daqmx_standin import Card, Rack\n"
        "from nidaqmx._lib import lib_importer as library\n"
        "import atexit\n"
        "rack = Rack(Dev1=Card(counters=1), Dev2=Card(outputs=1))\n"
        "library._windll = library._cdll = rack; library._encoding = 'utf-8'\n"
        "atexit.register(lambda: print(rack.cards['Dev2'].history, rack.tasks))\n"
        "NiDevice('Dev1/ctr0', 'Dev2/ao0').write(4.0)\n"
        "raise SystemExit(1)\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[1],
    )
    assert done.stdout.strip() == "[('ao0', 0.0), ('ao0', 4.0), ('ao0', 0.0)] {}", done.stderr


def test_the_heartbeat_changes_its_level_at_each_write(rack):
    """So that a relay behind it sees the loop live; it rests low."""
    device = NiDevice("Dev1/ctr0", "Dev2/ao0", heartbeat="Dev2/port0/line3")
    for _ in range(4):
        device.write(0.0)
    device.close()
    assert [level for name, level in rack.cards["Dev2"].history if name == "port0/line3"] == [
        False,
        True,
        False,
        True,
        False,
        False,
    ]


def test_the_card_s_watchdog_stops_the_motor_when_the_loop_does_not_write(rack):
    """On a card that has one: zero volts, amplifier off, an error for the late loop."""
    rack.cards["Dev3"] = Card(outputs=1, lines=1, watchdog=True)
    device = NiDevice("Dev1/ctr0", "Dev3/ao0", watchdog=0.01, enable="Dev3/port0/line0")
    rack.pass_time(30.0)
    for _ in range(20):
        rack.pass_time(0.009)
        device.write(2.0)
    assert rack.cards["Dev3"].volts["ao0"] == pytest.approx(2.0, abs=1e-3)
    rack.pass_time(0.011)
    assert rack.cards["Dev3"].volts["ao0"] == 0.0
    assert not rack.cards["Dev3"].levels["port0/line0"]
    with pytest.raises(OSError, match="-200678.*because the loop was late; reset the card"):
        device.write(2.0)
    with pytest.warns(
        RuntimeWarning, match="Dev3/ao0 can't be set to zero, switch the amplifier off"
    ):
        device.close()


def test_a_watchdog_that_never_began_is_closed_like_any(rack):
    """Nothing was written, nothing runs, the output is zero."""
    rack.cards["Dev3"] = Card(outputs=1, lines=1, watchdog=True)
    NiDevice("Dev1/ctr0", "Dev3/ao0", watchdog=0.01, enable="Dev3/port0/line0").close()
    assert rack.cards["Dev3"].volts["ao0"] == 0.0
    assert not rack.tasks


def test_a_card_without_watchdog_is_refused_in_words_that_help(rack):
    """The PCI-6221 has none."""
    with pytest.raises(
        ValueError, match=r"watchdog = 0.1 s: .*-200662: this card has none .*heartbeat"
    ):
        NiDevice("Dev1/ctr0", "Dev2/ao0", watchdog=0.1)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            {"counter": "Dev9/ctr0"},
            r"counter = 'Dev9/ctr0': .*-200220: for the cards present see NI MAX",
        ),
        ({"counter": "Dev1/ctr7"}, r"counter = 'Dev1/ctr7': .*-200170: counters have names like"),
        ({"output": "Dev1/ao0"}, r"output = 'Dev1/ao0' from -10 to 10 V: .*-200170"),
        (
            {"volts": 2.0},
            r"output = 'Dev2/ao0' from -20 to 20 V: .*-200077: take limits within the range",
        ),
        ({"enable": "Dev2/port9/line0"}, r"enable = 'Dev2/port9/line0': .*-200170"),
        ({"counts": 0}, "counts = 0: must be a whole number"),
        ({"ratio": 0.0}, "ratio = 0.0: must not be zero"),
        ({"volts": 0.0}, "volts = 0.0: must not be zero"),
        ({"u_min": 1.0}, "u_min = 1.0, u_max = 10.0: must enclose zero"),
        ({"u_max": math.inf}, "u_max = inf: must be a finite number"),
        ({"bits": 64}, "bits = 64: must be a whole number from 8 to 32"),
        ({"watchdog": 0.0}, "watchdog = 0.0: must be finite and greater than zero"),
        ({"pulse_filter": -1.0}, "pulse_filter = -1.0: must be finite and not negative"),
        ({"output": "Dev2/ao0:1"}, "output = 'Dev2/ao0:1': is several channels; name each one"),
        ({"output": "Dev2/ao0,Dev2/ao1"}, "output = .*in a URL Dev2/ao0,Dev2/ao1"),
        ({"counter": "Dev1/ctr0:1"}, "counter = 'Dev1/ctr0:1': is several channels"),
        ({"enable": ["Dev2/port0/line0"]}, r"enable = \['Dev2/port0/line0'\]: must be one digital"),
        ({"heartbeat": "Dev2/port0/line0:1"}, "heartbeat = .*must be one digital line, a text"),
        ({"heartbeat": "Dev2/port0"}, "heartbeat = 'Dev2/port0': is 24 lines; must be one line"),
    ],
)
def test_bad_arguments_are_named_in_one_line(rack, arguments, says):
    """And no task stays behind, no output at any voltage."""
    with pytest.raises(ValueError, match=says) as caught:
        NiDevice(**{"counter": "Dev1/ctr0", "output": "Dev2/ao0"} | arguments)
    assert "\n" not in str(caught.value)
    assert rack.cards["Dev2"].volts.get("ao0", 0.0) == 0.0


def test_a_card_that_another_program_holds_is_said_so(rack, device):
    """Two devices can't have one output."""
    with pytest.raises(OSError, match="-50103: another program uses the card: close it"):
        NiDevice("Dev1/ctr1", "Dev2/ao0")
    device.write(1.0)
    assert rack.cards["Dev2"].volts["ao0"] == pytest.approx(1.0, abs=1e-3)


def test_the_pulse_filter_reaches_both_lines_of_the_encoder(rack):
    """Both its width and that it is on."""
    device = NiDevice("Dev1/ctr0", "Dev2/ao0", pulse_filter=1e-6)
    counter = next(task for task in rack.tasks.values() if task.kind == "counter")
    assert sorted(counter.attributes.values()) == [1e-6, 1e-6, True, True]
    device.close()


def test_without_a_driver_one_line_says_where_to_get_it(monkeypatch):
    """As on this machine, where there is none."""
    for name in ("_windll", "_cdll", "_encoding"):
        monkeypatch.setattr(library, name, None)
    monkeypatch.setattr("nidaqmx._lib.find_library", lambda name: None)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(
        OSError, match="Could not find an installation of NI-DAQmx.*python -m nidaqmx installdriver"
    ) as caught:
        NiDevice("Dev1/ctr0", "Dev2/ao0")
    assert "\n" not in str(caught.value)


def test_without_the_package_one_line_says_which_extra(monkeypatch):
    """The extra is called ni."""
    monkeypatch.setitem(sys.modules, "nidaqmx", None)
    with pytest.raises(ImportError, match=r"pip install 'quell-control\[ni\]'"):
        NiDevice("Dev1/ctr0", "Dev2/ao0")


def test_a_card_that_is_lost_is_an_error_that_the_loop_counts(rack, device):
    """Reading gives NaN, writing fails, and closing warns that the output is not zero."""
    handle = handle_of(device)
    rack.cards["Dev1"].present = rack.cards["Dev2"].present = False
    value, _ = read_measurement(handle, virtual_clock(), 0)
    assert math.isnan(value)
    assert write_signals(handle, np.ones(1)) != 0
    assert handle.faults[0] == 2
    assert "-200324: the card is gone" in str(handle.errors[0])
    with pytest.warns(RuntimeWarning, match="switch the amplifier off"):
        device.close()


def test_an_address_says_all_that_the_arguments_say(rack):
    """The one for the paper's cards, with an enable line."""
    device = ni_device("ni://Dev1/ctr2+Dev2/ao1?counts=8000&u_max=5&enable=Dev2/port0/line7", 1e-3)
    rack.edges = 8000
    assert device.read() == pytest.approx(TAU)
    device.write(9.0)
    assert ("ao1", 5.0) in rack.cards["Dev2"].history
    assert rack.cards["Dev2"].levels["port0/line7"] is True
    device.close()


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("ni://Dev1/ctr0+Dev2/ao0?count=3", "count is none of counts, bits, ratio"),
        ("ni://Dev1/ctr0+Dev2/ao0?counts=1.5", "counts = '1.5' must be a whole number"),
        ("ni://Dev1/ctr0+Dev2/ao0?ratio=x", "ratio = 'x' must be a number"),
    ],
)
def test_addresses_that_are_none_are_refused(rack, address, says):
    """In one line."""
    with pytest.raises(ValueError, match=says):
        ni_device(address, 1e-3)


@pytest.mark.trial
def test_a_loop_through_the_cards_is_the_simulated_loop(rack):
    """The testbed without encoder and converter behind the cards is the one with them."""
    dt = 1e-3
    observer = ql.ESO.model_free(order=4, b0=5.5e4, omega_o=90.0, dt=dt)
    controller = ql.ADRC(observer, omega_c=20.0, u_min=-5, u_max=5)
    scenario = ql.Scenario(
        reference=ql.signals.Sinusoid(amplitude=math.pi / 2, omega=math.pi / 2), duration=0.5
    )
    ideal = ql.simulate(
        ql.plants.torsional(counts=16000, dac_bits=16), controller, scenario, interpret=True
    )

    twin = TwinDevice(ql.plants.torsional(counts=None, dac_bits=None), dt)
    y, u = np.empty(len(ideal)), np.empty(len(ideal))
    with closing(NiDevice("Dev1/ctr0", "Dev2/ao0", counts=16000)) as device:
        for k, r in enumerate(ideal["r"]):
            rack.edges = math.floor(twin.read() * 16000 / TAU + 0.5)
            y[k] = device.read()
            u[k] = controller.step(r, y[k])
            device.write(u[k])
            twin.write(rack.cards["Dev2"].volts["ao0"])
    assert np.ptp(y) > 0.5
    assert np.ptp(u) > 0.1
    np.testing.assert_allclose(y, ideal["y"], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(u, ideal["u"], rtol=1e-6, atol=1e-9)


class Shaft:
    """The device, and what it moves: a sample passes with each write."""

    def __init__(self, rack, device, plant):
        self.rack, self.device, self.twin, self.samples = (
            rack,
            device,
            TwinDevice(plant, scripted.DT),
            0,
        )
        self.close = device.close

    def read(self):
        """Let the counter see where the shaft is, and read it."""
        self.samples += 1
        if self.samples == 150:
            self.rack.cards["Dev1"].present = False
        self.rack.edges = math.floor(self.twin.read() * 16000 / TAU + 0.5)
        return self.device.read()

    def write(self, u):
        """Write u, and let the card's voltage act for a sample."""
        self.device.write(u)
        self.twin.write(self.rack.cards["Dev2"].volts["ao0"])


def test_the_loop_goes_to_its_safe_state_when_the_counter_card_is_lost(rack):
    """It holds u, ramps it to zero in the samples allowed, and the amplifier is disabled."""
    device = NiDevice("Dev1/ctr0", "Dev2/ao0", enable="Dev2/port0/line0", u_min=-3.0, u_max=3.0)
    shaft = Shaft(rack, device, scripted.PLANT)
    done = scripted.run(shaft, duration=5.0, hold=5, ramp=20)
    volts = [value for name, value in rack.cards["Dev2"].history if name == "ao0"][1:]
    before, after = volts[:149], volts[149:]
    assert max(map(abs, volts)) <= 3.0
    assert abs(before[-1]) > 0.1
    assert after[:5] == [before[-1]] * 5
    assert after[25:] == [0.0] * len(after[25:])
    assert done.rows.shape[0] < 200
    assert "-200324" in str(done.loop.handle.errors[0])
    rack.cards["Dev1"].present = True
    shaft.close()
    assert not rack.cards["Dev2"].levels["port0/line0"]


# ---- Several axes ----


@pytest.fixture
def wide(rack):
    """Two counters and an analog input, two outputs of one card and one of another."""
    rack.cards["Dev3"] = Card(outputs=1, inputs=2, lines=2, watchdog=True)
    rack.cards["Dev4"] = Card(outputs=2, lines=1, watchdog=True)
    return rack


def several(**options):
    """Return the device of three axes on these cards."""
    inputs = ["Dev1/ctr0", "Dev3/ai1", "Dev1/ctr2"]
    outputs = ["Dev4/ao0", "Dev3/ao0", "Dev4/ao1"]
    given = {"counts": [16000, None, 8000], "ratio": [1.0, 2.5, -1.0], "zero": [None, 0.5, None]}
    return NiDevice(inputs, outputs, **(given | options))


def test_each_axis_has_its_own_channel_counts_and_ratio(wide):
    """Each number at its place, whichever card it comes from."""
    with closing(several()) as device:
        assert device.signal_counts == (3, 3)
        assert device.read().tolist() == [0.0, -1.25, 0.0]
        wide.shafts |= {"Dev1/ctr0": 8000, "Dev1/ctr2": 2000}
        wide.cards["Dev3"].volts["ai1"] = 1.5
        assert device.read().tolist() == [TAU / 2, 2.5, -TAU / 4]


def test_outputs_are_cut_one_by_one_and_end_at_zero(wide):
    """Those of a card are written at once; the others follow."""
    device = several(volts=[1.0, -2.0, 1.0], u_min=-3.0, u_max=[3.0, 2.0, 1.0])
    device.write([9.0, 9.0, 9.0])
    device.write(np.array([-9.0, -1.0, 0.5]))
    with pytest.raises(ValueError, match="u = .*: must be 3 numbers"):
        device.write([1.0, 2.0])
    with pytest.raises(ValueError, match="must be a finite number; the output is zero now"):
        device.write([1.0, math.nan, 1.0])
    device.close()
    values = {card: wide.cards[card].history for card in ("Dev3", "Dev4")}
    zero = [("ao0", 0.0), ("ao1", 0.0)]
    assert values["Dev4"] == [
        *zero,
        *(("ao0", 3.0), ("ao1", 1.0)),
        *(("ao0", -3.0), ("ao1", 0.5)),
        *zero,
        *zero,
    ]
    assert [value for _, value in values["Dev3"]] == [0.0, -4.0, 2.0, 0.0, 0.0]


def test_each_card_has_its_watchdog(wide):
    """All are reset by a write; whichever is late sets its outputs to zero."""
    device = several(watchdog=0.01, enable="Dev4/port0/line0")
    for _ in range(5):
        wide.pass_time(0.009)
        device.write([1.0, 2.0, 3.0])
    assert [wide.cards["Dev4"].volts[name] for name in ("ao0", "ao1")] == pytest.approx(
        [1.0, 3.0], abs=1e-3
    )
    wide.pass_time(0.011)
    for card, name in (("Dev3", "ao0"), ("Dev4", "ao0"), ("Dev4", "ao1")):
        assert wide.cards[card].volts[name] == 0.0
    assert not wide.cards["Dev4"].levels["port0/line0"]
    with pytest.raises(OSError, match="-200678.*because the loop was late"):
        device.write([0.0, 0.0, 0.0])
    with pytest.warns(RuntimeWarning, match="Dev4/ao0, Dev4/ao1 can't be set to zero"):
        device.close()


def test_a_card_that_is_lost_does_not_hold_up_the_voltage_of_another(wide):
    """Whichever is written first; the error is raised, and the heartbeat stands still."""
    for lost, left, name in (("Dev3", "Dev4", "ao1"), ("Dev4", "Dev3", "ao0")):
        device = several(heartbeat="Dev1/port0/line0")
        history = wide.cards["Dev1"].history
        device.write([1.0, 2.0, 3.0])
        assert wide.cards[left].volts[name] > 1.0
        beats = len(history)
        wide.cards[lost].present = False
        with pytest.raises(OSError, match="can't be written.*-200324: the card is gone"):
            device.write([0.0, 0.0, 0.0])
        assert wide.cards[left].volts[name] == 0.0
        wide.cards[left].volts[name] = 1.0
        with pytest.raises(OSError, match="-200324: the card is gone"):
            device.write([0.0, math.nan, 0.0])
        assert wide.cards[left].volts[name] == 0.0
        assert len(history) == beats
        with pytest.warns(RuntimeWarning, match=f"{lost}/ao0.*switch the amplifier off"):
            device.close()
        wide.cards[lost].present = True


def test_a_name_of_several_channels_is_refused_when_the_task_knows_them(wide):
    """However it is written: the driver would read and write beyond the array of values."""
    tasks = Tasks()
    with pytest.raises(ValueError, match="output = 'Dev4/ao0:1': is 2 channels, must be 1 channel"):
        tasks.open_outputs([Voltage("Dev4/ao0:1", -1.0, 1.0)])
    with pytest.raises(ValueError, match="input = 'Dev3/ai0:1': is 2 channels, must be 1 channel"):
        tasks.open_inputs([Voltage("Dev3/ai0:1", -1.0, 1.0)])
    assert tasks.close() == []


def test_arrays_are_lists(wide):
    """Of channels and of numbers."""
    channels = np.array(["Dev4/ao0", "Dev4/ao1"])
    with closing(
        NiDevice(
            ["Dev1/ctr0"], channels, volts=np.array([1.0, 2.0]), u_max=np.array([5, 4]), u_min=-1.0
        )
    ) as device:
        device.write([1.0, 1.0])
        assert wide.cards["Dev4"].history[-2:] == [("ao0", 1.0), ("ao1", 2.0)]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"counts": [1, 2]}, "counts = .*: must be one number, or 3, one for each channel"),
        ({"counts": [1, 2, 3]}, "counts = .*must be None for a channel that is not an encoder"),
        ({"zero": [1.0, 0.0, None]}, "zero = .*None for a channel that is not an analog input"),
        ({"u_max": [1.0, 2.0, -1.0]}, "u_max"),
        ({"u_min": [0.5, 0.0, 0.0]}, "u_min = 0.5, u_max = 10.0: must enclose zero"),
        ({"volts": [1.0, 0.0, 1.0]}, "volts = 0.0: must not be zero"),
        ({"ratio": []}, "ratio = .*must be one number, or 3"),
        ({"counter": []}, "counter = .*must be a physical channel, or of several axes a list"),
        ({"output": ["Dev3/ao0", "Dev3/ao0"]}, "output = .*must be different channels"),
        ({"counter": ["Dev1/ctr0", 3]}, "counter = .*must be a physical channel"),
        ({"counter": ["Dev3/ai7"], "counts": None, "zero": None, "ratio": 1.0}, "Dev3/ai7' from -10 to 10 V: .*-200170"),
        ({"counter": ["Dev3/ai0"], "zero": None, "ratio": 1.0}, "counts = .*has no effect, no channel is an encoder"),
        ({"counter": ["Dev1/ctr0"], "counts": None, "ratio": 1.0}, "zero = .*has no effect, no channel is an analog input"),
    ],
)  # fmt: skip
def test_lists_that_do_not_fit_are_refused(wide, options, says):
    """In one line, and no task stays behind."""
    inputs = ["Dev1/ctr0", "Dev3/ai1", "Dev1/ctr2"]
    given = {
        "counter": inputs,
        "output": ["Dev4/ao0", "Dev3/ao0", "Dev4/ao1"],
        "counts": [16000, None, 8000],
        "zero": [None, 0.5, None],
    }
    with pytest.raises(ValueError, match=says) as caught:
        NiDevice(**(given | options))
    assert "\n" not in str(caught.value)


def test_an_address_has_channels_and_numbers_between_commas(wide):
    """As many as the controller has; a single one may be a list, too."""
    url = "ni://Dev1/ctr0,Dev3/ai1+Dev4/ao0,Dev4/ao1?counts=8000,&zero=,0.5&u_max=5,3&ratio=1,2"
    with closing(open_device(url, 1e-3, signals=(2, 2))) as device:
        wide.shafts["Dev1/ctr0"] = 8000
        assert device.read() == pytest.approx([TAU, -1.0])
        device.write([9.0, 9.0])
        assert wide.cards["Dev4"].history[-2:] == [("ao0", 5.0), ("ao1", 3.0)]
    with closing(open_device("ni://Dev1/ctr0+Dev4/ao0", 1e-3, signals=(1, 1))) as device:
        assert device.read().tolist() == [0.0]
    for wrong, signals, says in (
        (url, (3, 2), "has 2 measurements and 2 control signals, the controller 3"),
        (url, None, "has 2 measurements and 2 control signals, the controller one"),
        ("ni://Dev1/ctr0,+Dev4/ao0", (2, 1), "must be ni://COUNTER.OUTPUT"),
        ("ni://Dev1/ctr0,Dev1/ctr1+Dev4/ao0?counts=8,x", (2, 1), "counts = 'x' must be a whole"),
    ):
        with pytest.raises(ValueError, match=says):
            open_device(wrong, 1e-3, signals=signals)


class Axes2:
    """Two coupled axes behind the cards: positions are voltages, a sample passes with a write."""

    def __init__(self, rack, device):
        self.rack, self.device, self.twin = rack, device, TwinDevice(scripted_axes.PLANT, 0.01)
        self.signal_counts, self.close, self.count = device.signal_counts, device.close, 0
        self.lost = 10**9

    def read(self):
        """Let the converter see where the axes are, and read it."""
        self.count += 1
        self.rack.cards["Dev3"].present = self.count < self.lost
        volts = self.rack.cards["Dev3"].volts
        volts["ai0"], volts["ai1"] = self.twin.read().tolist()
        return self.device.read()

    def write(self, u):
        """Write u, and let the voltages act for a sample."""
        self.device.write(u)
        volts = self.rack.cards["Dev4"].volts
        self.twin.write([volts["ao0"], volts["ao1"]])


def test_a_loop_of_two_axes_runs_through_the_cards(wide):
    """As around the twin, but for the steps of the outputs; a lost card ramps both to zero."""
    ideal = scripted_axes.Outcome(duration=1.0).run
    channels = ["Dev3/ai0", "Dev3/ai1"], ["Dev4/ao0", "Dev4/ao1"]
    with closing(Axes2(wide, NiDevice(*channels, u_min=-3.0, u_max=3.0))) as device:
        found = scripted_axes.Outcome(device, duration=1.0)
    np.testing.assert_allclose(found.run["y"], ideal["y"], atol=2e-3)
    assert np.ptp(found.run["y"][:, 0]) > 0.1
    with closing(Axes2(wide, NiDevice(*channels, u_min=-3.0, u_max=3.0))) as device:
        device.lost = 60
        found = scripted_axes.Outcome(device, duration=1.0)
        assert "RAMP" in [change[1].name for change in found.changes]
        assert "-200324: the card is gone" in str(found.loop.handle.errors[0])
        wide.cards["Dev3"].present = True
    assert [wide.cards["Dev4"].volts[name] for name in ("ao0", "ao1")] == [0.0, 0.0]
