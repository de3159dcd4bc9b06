"""A plant in this process as a device: it has no clock, and advances by a sample at each write."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quell import checks
from quell.kernels.dispatch import call_specialised, compiled
from quell.plants.base import Plant, advance, begin_run, check_plant, check_run, measure
from quell.plants.destroyed import is_destroyed
from quell.plants.labelled import signals_of
from quell.realtime.devices.base import read_measurement, write_command
from quell.types import Vector


class TwinHandle(NamedTuple):
    """A sampled plant and its state."""

    plant: Any
    x: Vector  # state of the plant (n,)
    scratch: Vector
    w: Vector  # disturbances: zero (m,)
    t: Vector  # samples since the start, and the sample time [s] (2,)


@read_measurement.register(TwinHandle)
def _read_measurement(handle: TwinHandle, clock: Any, until: int) -> tuple[float, int]:
    return measure(handle.plant, handle.x), 0


@write_command.register(TwinHandle)
def _write_command(handle: TwinHandle, u: float) -> int:
    advance(handle.plant, handle.x, handle.scratch, handle.t[0] * handle.t[1], u, handle.w)
    handle.t[0] += 1.0
    return 0


@compiled
def _read(handle: TwinHandle) -> float:
    return measure(handle.plant, handle.x)


@compiled
def _write(handle: TwinHandle, u: float) -> None:
    write_command(handle, u)


class TwinDevice:
    """A simulated plant: ``read`` measures it, ``write(u)`` advances it by a sample ``dt`` [s].

    It starts from the state ``x0`` (n,), zero by default. u acts at once. Over a wire it acts a
    sample later; ``quell.plants.delayed(plant, dt, dt)`` adds the same delay to this device.

    Raises
    ------
    ValueError
        if ``plant`` is not a plant, dt is not positive, or x0 has the wrong size.

    Examples
    --------
    >>> import quell as ql
    >>> from quell.realtime.devices.twin import TwinDevice
    >>> twin = TwinDevice(ql.plants.two_mass_spring(), dt=0.01)
    >>> twin.write(1.0)
    >>> f"{twin.read():.3g}"
    '4.17e-10'
    """

    paced = False
    lost = False

    def __init__(self, plant: Plant, dt: float, x0: ArrayLike | None = None) -> None:
        check_plant(plant)
        self.dt = checks.positive("dt", dt, "s")
        order = plant.order
        x = np.zeros(order) if x0 is None else checks.vector("x0", x0, order)
        scratch, w = np.zeros(6 * order), np.zeros(plant.disturbances)
        model = plant.sampled(dt, not plant.compiled)
        self._x0 = x.copy()
        self.signals = signals_of(plant)
        begin_run(model, x, scratch)
        self._handle = TwinHandle(model, x, scratch, w, np.array([0.0, dt]))
        # Without a public handle the loop runs as Python.
        self.handle = self._handle if plant.compiled else None

    @property
    def counters(self) -> dict[str, int]:
        """Number of samples written."""
        return {"written": int(self._handle.t[0])}

    @property
    def x(self) -> Vector:
        """State of the plant, as a copy (n,)."""
        return self._handle.x.copy()

    def read(self) -> float:
        """Return y [y-unit]."""
        if self.handle is None:
            return float(measure(self._handle.plant, self._handle.x))
        return float(call_specialised(_read, self.handle))

    def write(self, u: float) -> None:
        """Apply u [u-unit] for a sample."""
        if self.handle is None:
            write_command(self._handle, float(u))
        else:
            call_specialised(_write, self.handle, float(u))
        check_run(self._handle.plant, self._handle.scratch)

    def close(self) -> None:
        """Put a plant whose state is destroyed back to ``x0``, so that the device can be reused."""
        plant, x, scratch, _, t = self._handle
        if is_destroyed(x, self._x0):
            x[:], t[0] = self._x0, 0.0
            begin_run(plant, x, scratch)


def twin_device(url: str, dt: float, trust: bool = False) -> TwinDevice:
    """Return the device ``twin:PLANT``; PLANT is what ``quell.setup.plants.plant_given`` takes."""
    from quell.setup.plants import plant_given

    text = url.partition(":")[2]
    return TwinDevice(plant_given(text, dt, argument="device", trust=trust), dt)
