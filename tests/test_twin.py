"""Devices in this process: twins, and devices of one's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.realtime.devices import (
    Device,
    PythonHandle,
    TwinDevice,
    handle_of,
    read_measurement,
    write_signals,
)
from quell.realtime.system import system_clock

from .rig_bench import DT, PLANT


@pytest.mark.parametrize(
    "plant", [PLANT, ql.plants.delayed(PLANT, 2 * DT, DT)], ids=lambda plant: plant.name
)
def test_the_twin_in_process_is_the_simulated_plant(plant: Any) -> None:
    """Bit for bit: what it measures is what the simulation has measured under the same u."""
    controller = ql.ADRC(
        ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=DT), omega_c=1.0, u_min=-3.0, u_max=3.0
    )
    run = ql.simulate(plant, controller, ql.Scenario(reference=1.0, duration=5.0))
    twin = TwinDevice(plant, DT)
    assert isinstance(twin, Device)
    assert not twin.paced
    for y, u in zip(run["y"], run["u"], strict=True):
        assert twin.read() == y
        twin.write(u)
    assert twin.counters["written"] == run["y"].size


@pytest.mark.parametrize("value", [np.nan, 2e9, 1e6])
def test_a_twin_that_is_destroyed_comes_back_to_rest_when_it_is_closed(value: float) -> None:
    """So that the next run with the same object can begin; other states are kept."""
    twin = TwinDevice(PLANT, DT, x0=[0.1, 0.0, 0.2, 0.0])
    start = twin.x
    twin.handle.x[1] = value  # type: ignore[union-attr]
    twin.close()
    assert np.array_equal(twin.x, start) == (value != 1e6)


def test_a_twin_of_a_plant_in_python_is_used_through_python() -> None:
    """It has no line of its own."""

    class Slow:
        order, disturbances, compiled, name = PLANT.order, PLANT.disturbances, False, "slow"

        def sampled(self, dt: float, interpret: bool = False) -> Any:
            assert interpret
            return PLANT.sampled(dt)

    slow, quick = (
        TwinDevice(Slow(), DT, x0=[0.1, 0.2, 0.0, 0.0]),
        TwinDevice(PLANT, DT, x0=[0.1, 0.2, 0.0, 0.0]),
    )
    assert isinstance(handle_of(slow), PythonHandle)
    for _ in range(20):
        assert slow.read() == pytest.approx(quick.read(), rel=1e-12)
        slow.write(1.0)
        quick.write(1.0)


def test_a_device_that_raises_gives_no_number_and_says_so() -> None:
    """The loop goes on to its safe action; what was raised is kept."""

    class Broken:
        def read(self) -> float:
            raise OSError("cable")

        def write(self, u: float) -> None:
            raise OSError("cable")

        def close(self) -> None:
            pass

    handle = handle_of(Broken())
    assert np.isnan(read_measurement(handle, system_clock(), 0)[0])
    assert write_signals(handle, np.ones(1)) != 0
    assert handle.faults[0] == 2
    assert str(handle.errors[0]) == "cable"
