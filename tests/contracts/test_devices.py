"""Contracts of every device in the registry: it measures and moves its plant and ends safely."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.cli.app import app
from quell.kernels.dispatch import as_python
from quell.realtime.devices import (
    Device,
    PythonHandle,
    TwinDevice,
    handle_of,
    read_measurement,
    write_signals,
)
from quell.realtime.registry import SCHEMES, listen, open_device
from quell.realtime.rig import Rig
from quell.realtime.system import system_clock
from tests.cases import cases
from tests.rig_bench import DT, PLANT, WIRES, Bench, PlainRig

DOCS = Path(__file__).parents[2] / "docs" / "devices.md"
LIMIT = 2.0
"""Of u, at the rig and the card [N, V]; a twin has none."""


class OverWire:
    """A rig at the other end of a wire; u acts a sample late."""

    limit, delay, tolerance = LIMIT, DT, 0.0

    def __init__(self, stack: ExitStack, wire: str) -> None:
        self.plain = wire != "serial"  # a compiled rig takes seconds to compile: one is enough
        self.bench = Bench(stack, wire, kind=PlainRig if self.plain else Rig, u_max=LIMIT)
        self.url = self.bench.url

    def open(self, dt: float = DT) -> Any:
        """Return the device, which is closed at the end."""
        return self.bench.open(dt=dt, timeout=0.3 if dt != DT else 30.0)

    def second(self, device: Any) -> Any:
        """Open it once more while the loop of the first one goes on."""

        def answer() -> None:
            if math.isfinite(device.read()):
                device.write(1.0)

        return self.bench.open(timeout=0.2, meanwhile=answer)

    def sample(self, device: Any, u: float) -> float:
        """Return y; u is what answers it."""
        return self.bench.cycle(device, lambda y: u)[0]

    def applied(self) -> float:
        """Return the u that acts on the plant after all that was written or said."""
        self.bench.rig.tick()
        return self.bench.applied

    def after_close(self) -> float:
        """Return the u that acts after the device was closed."""
        self.bench.await_frame()
        return self.applied()

    def lose(self) -> None:
        """End the device."""
        self.bench.rig.close()


class NiCards:
    """The stand-in for NI's library; what the cards move is a twin."""

    limit, delay, tolerance = LIMIT, 0.0, 1e-3
    url = f"ni://Dev1/ctr0+Dev2/ao0?counts=16000&u_min={-LIMIT}&u_max={LIMIT}"

    def __init__(self, stack: ExitStack) -> None:
        library = pytest.importorskip("nidaqmx._lib").lib_importer
        from tests.daqmx_standin import Card, Rack

        self.rack = Rack(Dev1=Card(counters=1), Dev2=Card(outputs=1))
        self.plant = TwinDevice(PLANT, DT)
        self.stack = stack
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        for name, value in (("_windll", self.rack), ("_cdll", self.rack), ("_encoding", "utf-8")):
            patch.setattr(library, name, value)

    def open(self, dt: float = DT) -> Any:
        """Return the device, which is closed at the end."""
        return self.stack.enter_context(closing(open_device(self.url, dt)))

    def second(self, device: Any) -> Any:
        """Open it once more while it is open."""
        return self.open()

    def sample(self, device: Any, u: float) -> float:
        """Return y; u is what answers it."""
        self.rack.edges = math.floor(self.plant.read() * 16000 / math.tau + 0.5)
        y = device.read()
        device.write(u)
        self.plant.write(self.applied())
        return float(y)

    def applied(self) -> float:
        """Return the u that acts on the plant."""
        return float(self.rack.cards["Dev2"].volts["ao0"])

    after_close = applied

    def lose(self) -> None:
        """Take the cards away."""
        for card in self.rack.cards.values():
            card.present = False


class Twin:
    """A plant in this process: it takes any u, and has nothing to release or to lose."""

    limit, delay, tolerance = math.inf, 0.0, 0.0
    url = "twin:two-mass"

    def __init__(self, stack: ExitStack) -> None:
        self.written = 0.0

    def open(self, dt: float = DT) -> Any:
        """Return the device."""
        return open_device(self.url, dt)

    def sample(self, device: Any, u: float) -> float:
        """Return y; u is what answers it."""
        y = device.read()
        device.write(u)
        self.written = u
        return float(y)

    def applied(self) -> float:
        """Return the u that acts on the plant."""
        return self.written


EXAMPLES = {wire: lambda stack, wire=wire: OverWire(stack, wire) for wire in WIRES} | {
    "ni": NiCards,
    "twin": Twin,
}
REAL = [scheme for scheme in SCHEMES if scheme != "twin"]


@pytest.fixture
def example(request: pytest.FixtureRequest) -> Iterator[Any]:
    """A device of the scheme that the test is for, and what lies behind it."""
    with ExitStack() as stack:
        yield EXAMPLES[request.param](stack)


every = pytest.mark.parametrize("example", SCHEMES, indirect=True)
every_real = pytest.mark.parametrize("example", REAL, indirect=True)


def test_every_device_has_an_example() -> None:
    """Nothing in the registry escapes the contracts."""
    assert set(EXAMPLES) == set(SCHEMES)


@every
def test_it_is_a_device_and_opened_by_its_url(example: Any) -> None:
    """With the methods of the protocol; a device is also taken as it is."""
    device = example.open()
    assert isinstance(device, Device)
    assert open_device(device, DT) is device
    assert example.sample(device, 0.0) == 0.0


@pytest.mark.trial
@pytest.mark.compiled
@every
def test_it_measures_the_plant_that_u_moves(example: Any) -> None:
    """Bit for bit as a twin, delayed by a sample over a wire; to the quanta of the card.

    UDP as Python: tests/test_wire.py compiles what is of UDP.
    """
    with as_python() if example.url.startswith("udp:") else nullcontext():
        device = example.open()
        plant = ql.plants.delayed(PLANT, example.delay, DT) if example.delay else PLANT
        twin = TwinDevice(plant, DT)
        for k in range(300):
            u = 1.5 * math.sin(0.02 * k)
            y = example.sample(device, u)
            with as_python() if getattr(example, "plain", False) else nullcontext():
                assert abs(y - twin.read()) <= example.tolerance
                twin.write(u)
        assert abs(y) > 0.1


@every
def test_the_loop_uses_it_through_its_handle(example: Any) -> None:
    """Reading and writing through the handle is reading and writing."""
    device = example.open()
    example.sample(device, 0.5)
    handle, clock = handle_of(device), system_clock()
    assert isinstance(handle, PythonHandle) == (getattr(device, "handle", None) is None)
    assert write_signals(handle, np.ones(1)) == 0
    assert not math.isfinite(example.limit) or abs(example.applied() - 1.0) < 1e-3
    y, waited = read_measurement(handle, clock, time.monotonic_ns() + 10**9)
    assert math.isfinite(y)
    assert waited >= 0


@every_real
@pytest.mark.parametrize("u", [math.nan, math.inf, -math.inf])
def test_a_u_that_is_not_finite_never_acts(example: Any, u: float) -> None:
    """The last one holds or it is zero; whether it is an error depends on the device."""
    device = example.open()
    example.sample(device, 1.0)
    with suppress(ValueError):
        example.sample(device, u)
    assert example.applied() == pytest.approx(1.0, abs=1e-3) or example.applied() == 0.0


@every_real
def test_a_u_beyond_the_limit_is_cut_to_it(example: Any) -> None:
    """At the far end, whatever the loop does."""
    device = example.open()
    for u in (-100.0, 1e300, LIMIT, -LIMIT):
        example.sample(device, u)
        assert example.applied() == pytest.approx(math.copysign(LIMIT, u), abs=1e-3)


@every_real
def test_closing_sets_u_to_zero_and_ends_it(example: Any) -> None:
    """Twice does no harm; what is closed can't be used."""
    device = example.open()
    for _ in range(3):
        example.sample(device, 1.0)
    assert example.applied() == pytest.approx(1.0, abs=1e-3)
    device.close()
    assert example.after_close() == 0.0
    device.close()
    for use in (device.read, lambda: device.write(1.0)):
        with pytest.raises((ValueError, OSError), match="closed"):
            use()


@every
def test_it_can_be_opened_again(example: Any) -> None:
    """As if it had never been open; the plant need not be at rest."""
    device = example.open()
    example.sample(device, 1.0)
    device.close()
    with closing(example.open()) as again:
        assert math.isfinite(example.sample(again, 1.0))
        assert math.isfinite(example.sample(again, 0.0))


@every_real
def test_it_has_one_user(example: Any) -> None:
    """A second one is refused, and the first does not notice."""
    device = example.open()
    example.sample(device, 1.0)
    with pytest.raises((ValueError, OSError), match="another (session|program)"):
        example.second(device)
    example.sample(device, 1.0)
    assert example.applied() == pytest.approx(1.0, abs=1e-3)


@every_real
@pytest.mark.filterwarnings("ignore:.*switch the amplifier off:RuntimeWarning")
def test_a_device_that_is_lost_is_an_error_and_never_a_number(example: Any) -> None:
    """Reading gives no number, writing says that it failed; neither waits for ever."""
    device = example.open()
    for _ in range(3):
        example.sample(device, 1.0)
    example.lose()
    handle, clock = handle_of(device), system_clock()
    start = time.monotonic()
    for _ in range(3):
        y, _ = read_measurement(handle, clock, time.monotonic_ns() + 1_000_000)
    assert math.isnan(y)
    assert write_signals(handle, np.ones(1)) != 0
    with pytest.raises(OSError, match="."):
        device.write(1.0)
    assert time.monotonic() - start < 5.0
    device.close()


@every
def test_a_sample_time_must_be_positive(example: Any) -> None:
    """The message names it."""
    with pytest.raises(ValueError, match="dt = -1"):
        open_device(example.url, -1)


@pytest.mark.parametrize("example", WIRES, indirect=True)
def test_a_device_with_a_clock_has_the_loop_s_sample_time(example: Any) -> None:
    """The message has both."""
    with pytest.raises(ValueError, match=r"dt = 0.02 s: the device at .* ticks every 0.01 s"):
        example.open(dt=0.02)
    assert example.bench.rig.counters["refused"] >= 1
    assert example.bench.rig.state == "idle"


URLS = [
    *("", "foo", "tcp://127.0.0.1:5", "shm://rig", "twin:nothing"),
    *("udp://127.0.0.1", "udp://:5", "udp://127.0.0.1:70000", "udp://127.0.0.1:5/x"),
    *("udp://127.0.0.1:0", "udp:///dev/ttyUSB0", "serial://", "serial:///dev/ttyUSB0?baud=fast"),
    *("serial:///dev/ttyUSB0?baud=0", "serial:///dev/ttyUSB0?parity=odd"),
    *("ni://Dev1/ctr0", "ni://Dev1/ctr0+"),
    *("ni://Dev1/ctr0+Dev2/ao0?counts=1.5", "ni://Dev1/ctr0+Dev2/ao0?ratio=x"),
]


@cases("url", URLS)
def test_a_url_of_no_device_is_refused_in_a_line(url: str) -> None:
    """Before anything is opened, at both ends."""
    ends = [lambda: open_device(url, DT)]
    if url != "udp://127.0.0.1:0":
        ends.append(lambda: listen(url))
    for end in ends:
        with pytest.raises(ValueError, match=r"^device = .*must") as caught:
            end()
        assert "\n" not in str(caught.value)


@pytest.mark.trial
@cases("scheme", SCHEMES)
def test_it_is_named_wherever_devices_are(scheme: str, capsys: pytest.CaptureFixture[str]) -> None:
    """In the message about an unknown one, in the commands' help and on the page."""
    with pytest.raises(ValueError, match=re.escape(SCHEMES[scheme].example)):
        open_device("tcp://x", DT)
    app(["run-rig", "--help"], result_action="return_value")
    assert f"{scheme}:" in capsys.readouterr().out
    app(["rig", "--help"], result_action="return_value")
    assert (f"{scheme}:" in capsys.readouterr().out) == bool(SCHEMES[scheme].listener)
    if DOCS.exists():
        assert f"`{SCHEMES[scheme].example}" in DOCS.read_text(encoding="utf-8")


def test_what_is_no_device_is_refused() -> None:
    """The message says what a device has."""
    with pytest.raises(ValueError, match="must have read"):
        open_device(3, DT)  # type: ignore[arg-type]
