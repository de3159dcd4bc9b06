"""A device whose measurements and faults come from arrays, and a loop on a virtual clock."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

import quell as ql
from quell.kernels.dispatch import kernel
from quell.plants.base import advance, measure
from quell.realtime.cycle import ControlLoop
from quell.realtime.devices import read_measurement, write_signals
from quell.realtime.recordings import row_channels
from quell.realtime.safety import Safety, as_scenario, reference_samples
from quell.realtime.system import pass_time, virtual_clock
from quell.realtime.telemetry import drain, ring

DT = 0.01


class Scripted(NamedTuple):
    """A plant with scripted faults; the last entry of a script holds for all later samples."""

    plant: Any
    x: Any
    scratch: Any
    w: Any
    at: Any
    """Samples fetched, samples put (2,)."""
    y: Any
    """What is added to y: NaN where nothing comes."""
    stall: Any
    """How long fetching takes [ns]."""
    moves: Any
    """By how many samples the plant has moved on meanwhile, under the last u."""
    refused: Any
    """What ``write_signals`` returns."""
    written: Any
    """What was put (·,)."""


@kernel
def _entry(script: Any, k: int) -> Any:
    return script[min(k, script.size - 1)]


@read_measurement.register(Scripted)
def _read_measurement(handle: Scripted, clock: Any, until: int) -> tuple[float, int]:
    k = handle.at[0]
    handle.at[0] += 1
    pass_time(clock, _entry(handle.stall, k))
    for _ in range(_entry(handle.moves, k)):
        advance(
            handle.plant, handle.x, handle.scratch, 0.0, handle.written[handle.at[1] - 1], handle.w
        )
    return measure(handle.plant, handle.x) + _entry(handle.y, k), 0


@write_signals.register(Scripted)
def _write_signals(handle: Scripted, u: Any) -> int:
    k = handle.at[1]
    handle.at[1] += 1
    handle.written[k] = u[0]
    if _entry(handle.refused, k) != 0:
        return _entry(handle.refused, k)
    advance(handle.plant, handle.x, handle.scratch, 0.0, u[0], handle.w)
    return 0


class ScriptedDevice:
    """The handle as a device; scripts are dictionaries from sample to value."""

    def __init__(
        self, plant: Any, *, samples: int = 3000, x0: Any = None, **scripts: dict[int, Any]
    ) -> None:
        self.paced = False
        model = plant.sampled(DT, False)
        x = np.zeros(plant.order) if x0 is None else np.array(x0, dtype=float)
        kinds = {"y": float, "stall": np.int64, "moves": np.int64, "refused": np.int64}
        arrays = {name: np.zeros(samples, dtype=kind) for name, kind in kinds.items()}
        for name, script in scripts.items():
            for k, value in script.items():
                arrays[name][k] = value
        room = np.full(samples, math.nan)
        self.handle = Scripted(
            model,
            x,
            np.zeros(6 * plant.order),
            np.zeros(plant.disturbances),
            np.zeros(2, np.int64),
            **arrays,
            written=room,
        )

    @property
    def written(self) -> Any:
        """Commands so far."""
        return self.handle.written[: self.handle.at[1]]

    def read(self) -> float:
        """Not used: the loop uses the handle."""
        raise NotImplementedError

    def write(self, u: float) -> None:
        """Not used: the loop uses the handle."""
        raise NotImplementedError

    def close(self) -> None:
        """Do nothing."""


PLANT = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [1.0, 0.0])


def adrc(**options: Any) -> ql.ADRC:
    """A controller for ``PLANT``."""
    return ql.ADRC(
        ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=DT),
        omega_c=1.5,
        **{"u_min": -3.0, "u_max": 3.0} | options,
    )


class Outcome(NamedTuple):
    """Result of a scripted loop."""

    loop: ControlLoop
    rows: Any
    device: Any

    def __getitem__(self, name: Any) -> Any:
        """Return a column of the rows."""
        from quell.realtime import recordings

        return self.rows[:, getattr(recordings, name)]


def run(
    device: Any,
    controller: Any = None,
    reference: Any = 1.0,
    duration: float = 3.0,
    *,
    late: Any = (0,),
    approach: float = 0.0,
    interpret: bool = False,
    asked: int = 0,
    channels: tuple[str, ...] = (),
    **safety: Any,
) -> Outcome:
    """Run a loop around a scripted device to its end; ``settle`` is 10 by default."""
    controller = adrc() if controller is None else controller
    width = sum(width for _, width in row_channels(controller.channels, channels))
    scenario = as_scenario(reference, duration)
    points = reference_samples(scenario, controller, approach)
    rules = Safety(**{"settle": 10} | safety).rules(controller, scenario)
    loop = ControlLoop.of(
        device,
        controller,
        points,
        rules,
        virtual_clock(late),
        ring(4096, width),
        channels=channels,
        interpret=interpret,
    )
    loop.controller.supervisor.requests[0] = asked
    loop.run()
    return Outcome(loop, drain(loop.controller.log.ring), device)
