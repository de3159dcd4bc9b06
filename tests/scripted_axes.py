"""Loops of several axes on a virtual clock, a device in Python with faults, and frames."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np

import quell as ql
from quell.kernels.dispatch import compiled, interpreted
from quell.realtime import Safety, TwinDevice, wire
from quell.realtime.cycle import ControlLoop
from quell.realtime.recordings import Header, row_channels, trajectory_of
from quell.realtime.run import mode_changes
from quell.realtime.safety import reference_samples
from quell.realtime.supervisor import Cause, Mode
from quell.realtime.system import virtual_clock
from quell.realtime.telemetry import drain, ring

from .rig_bench import TIME

DT = 0.01
A = [[0, 1, 0, 0], [0, -0.5, 0, 0], [0, 0, 0, 1], [0, 0, 0, -0.3]]
B0 = [[2.0, 0.5], [0.4, 3.0]]
PLANT = ql.plants.LinearPlant(A, [[0, 0], B0[0], [0, 0], B0[1]], [[1, 0, 0, 0], [0, 0, 1, 0]])
THREE = ql.plants.LinearPlant(np.zeros((3, 3)), np.eye(3), np.eye(3))
SESSION = 0x5EED0001
FAST = Safety(settle=10, hold=4, ramp=10)


def axis(learner: Any = None, omega_o: float = 12.0, **options: Any) -> ql.ADRC:
    """Return the controller of an axis."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=omega_o, dt=DT)
    guard = None if learner is None else ql.Guard()
    return ql.ADRC(observer, omega_c=1.5, learner=learner, guard=guard, **options)


def gantry(*, learning: bool = False, **options: Any) -> ql.Axes:
    """Return the controller of ``PLANT``."""
    learners = (ql.learners.Kalman(), ql.learners.Harmonic()) if learning else (None, None)
    pair = dict(zip(("x", "y"), map(axis, learners), strict=True))
    return ql.Axes(pair, B0, **({"u_min": -3.0, "u_max": 3.0} | options))


class Scripted:
    """A twin in Python, with numbers added to single measurements of some samples."""

    def __init__(
        self,
        added: dict[int, tuple[float, float]] | None = None,
        counts: tuple[int, int] = (2, 2),
        **options: Any,
    ) -> None:
        self.twin, self.added = TwinDevice(PLANT, DT, **options), added or {}
        self.signal_counts, self.count = counts, -1
        self.written: list[Any] = []

    def read(self) -> Any:
        """Measure."""
        self.count += 1
        return self.twin.read() + np.array(self.added.get(self.count, (0.0, 0.0)))

    def write(self, u: Any) -> None:
        """Apply."""
        self.written.append(u)
        self.twin.write(u)

    def close(self) -> None:
        """Do nothing."""


class Outcome:
    """A loop on a virtual clock, after its end."""

    def __init__(
        self,
        device: Any = None,
        controller: Any = None,
        references: Any = (1.0, -0.5),
        *,
        duration: float = 2.0,
        approach: float = 0.0,
        late: Any = (0,),
        safety: Safety = FAST,
        names: tuple[str, ...] = (),
        interpret: bool = False,
    ) -> None:
        self.device = TwinDevice(PLANT, DT) if device is None else device
        self.controller = gantry() if controller is None else controller
        scenario = ql.Scenario(tuple(references), duration)
        self.rules = safety.rules(self.controller, scenario)
        counts = self.controller.outputs, self.controller.inputs
        channels = row_channels(self.controller.channels, names, *counts)
        self.loop = ControlLoop.of(
            self.device,
            self.controller,
            reference_samples(scenario, self.controller, approach),
            self.rules,
            virtual_clock(late),
            ring(4096, sum(width for _, width in channels)),
            channels=names,
            interpret=interpret,
        )
        self.loop.run()
        pairs = zip(self.controller.names, self.controller.axes, strict=True)
        notes = {"axes": {name: list(each.features) for name, each in pairs}}
        self.header = Header(channels, DT, notes=notes)
        self.rows = drain(self.loop.controller.log.ring)
        self.run = trajectory_of(self.header, self.rows)

    @property
    def changes(self) -> list[tuple[int, Mode, Cause, str]]:
        """Changes of mode: sample, mode, cause, signal."""
        state = self.loop.controller.supervisor
        found = mode_changes(state, DT, axis_names=self.controller.names)
        return [(round(each.t / DT), each.mode, each.cause, each.signal) for each in found]


def frame_of(
    kind: int, number: int, answers: int, values: Any, state: int = 0, session: int = SESSION
) -> bytes:
    """Return a frame of several numbers, made without the package."""
    head = struct.pack("<2sBBIIIq", b"QL", 1, kind, session, number, answers, TIME)
    body = head + struct.pack(f"<{len(values)}dI", *values, state)
    return body + struct.pack("<I", zlib.crc32(body))


@compiled
def accepted(frame: Any, size: int, own: Any) -> bool:
    """Return whether an endpoint takes a packet of so many bytes."""
    return wire.is_well_formed(frame, size, own.counters) and wire.accept(frame, own)


def offered(own: Any, data: bytes, entry: Any = None) -> bool:
    """Offer a packet to an endpoint, as a link would put it into its buffer."""
    frame = wire.buffer(wire.MOST_SIGNALS)
    cut = data[: frame.bytes.size]
    frame.bytes[: len(cut)] = np.frombuffer(cut, dtype=np.uint8)
    return bool((entry or interpreted(accepted))(frame, len(cut), own))
