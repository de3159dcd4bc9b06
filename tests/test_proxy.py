"""A compensator between a host and a drive: two wires, one tick after the other."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.realtime import CompensatedDrive, TwinDevice

from .rig_bench import Bench

DT = 0.01
DRIVE = ([12.0], [1.0, 12.0, 0.0])
"""A closed drive that takes commands of speed; y is the position."""
LIMITS = {"u_min": -3.0, "u_max": 3.0}
OBSERVER = ql.ESO.model_based(DRIVE, omega_o=40.0, dt=DT)


def loaded_drive() -> Any:
    """Return the drive with a constant load, by a disturbance of the plant's own."""

    def motion(t: float, x: Any, u: float, w: Any) -> tuple[float, float]:
        return x[1], 12.0 * (u - x[1]) - 6.0

    return ql.plants.NonlinearPlant(motion, order=2, disturbances=0, substeps=1)


@pytest.mark.parametrize("with_proxy", [True, False])
def test_the_host_sees_a_drive_that_the_load_does_not_move(with_proxy: bool) -> None:
    """A host with a P controller holds a loaded drive; without the proxy it is off by load/gain."""
    with ExitStack() as stack:
        drive = Bench(stack, plant=loaded_drive())
        outer = drive
        if with_proxy:
            proxy = CompensatedDrive(drive.open(), ql.Compensator(OBSERVER, **LIMITS))
            outer = Bench(stack, plant=proxy)
        host = outer.open(meanwhile=drive.rig.tick if with_proxy else lambda: None)
        y = 0.0
        for _ in range(600):
            host.write(2.0 * (1.0 - y))
            outer.rig.tick()
            if with_proxy:
                drive.rig.tick()
            y = host.read()
        if with_proxy:
            assert 1.0 - y == pytest.approx(0.0, abs=2e-3)
            assert proxy.estimate.f == pytest.approx(-6.0, abs=0.05)
            proxy.close()
            drive.rig.tick()
            assert drive.rig.state == "idle"
        else:
            assert 1.0 - y == pytest.approx(6.0 / 12.0 / 2.0, abs=0.01)


def test_a_host_that_stops_leaves_the_drive_where_it_is() -> None:
    """After the watchdog's ticks u_0 is zero: the speed that is commanded is what holds the load."""
    device = TwinDevice(loaded_drive(), DT)
    with ExitStack() as stack:
        proxy = CompensatedDrive(device, ql.Compensator(OBSERVER, **LIMITS))
        outer = Bench(stack, plant=proxy, watchdog=5)
        host = outer.open()
        outer.cycle(host, lambda y: 0.3, count=300)
        outer.rig.tick(200)
        assert outer.rig.state == "tripped"
        before = device.read()
        outer.rig.tick(200)
        assert device.read() == pytest.approx(before, abs=1e-3)
        assert proxy.estimate.u == pytest.approx(0.5, abs=1e-3)


def test_what_does_not_fit_is_refused() -> None:
    """Another controller, no limits, another sample time, a device in Python."""
    twin, compensator = TwinDevice(loaded_drive(), DT), ql.Compensator(OBSERVER, **LIMITS)

    class InPython:
        """A device of a user's own."""

        def read(self) -> float:
            """Return y."""
            return 0.0

        def write(self, u: float) -> None:
            """Apply u."""

        def close(self) -> None:
            """Do nothing."""

    with pytest.raises(ValueError, match="the host has the controller"):
        CompensatedDrive(twin, ql.ADRC(OBSERVER, 3.0, **LIMITS))
    with pytest.raises(ValueError, match="give it u_min and u_max"):
        CompensatedDrive(twin, ql.Compensator(OBSERVER))
    with pytest.raises(ValueError, match="must be the same"):
        CompensatedDrive(TwinDevice(loaded_drive(), 0.02), compensator)
    with pytest.raises(ValueError, match="compiled code can use"):
        CompensatedDrive(InPython(), compensator)
    assert np.isfinite(CompensatedDrive(twin, compensator).estimate.u)
