"""Header of a recording."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from quell import checks
from quell.quantities import Signals, signals_from
from quell.realtime.telemetry.channels import LOOP_CHANNELS
from quell.records.channels import is_vector
from quell.types import Channels

# Numbers in a row, far above those of any controller: chosen by hand.
_MOST_COLUMNS = 10_000
VERSION = 1  # version of the recording's layout; a reader refuses others


@dataclass(frozen=True)
class Header:
    """Description of a recording.

    Parameters
    ----------
    channels : tuple of pairs
        names and widths in a row, in order; the first ones are ``LOOP_CHANNELS``.
    dt
        sample time [s]: row k belongs to the time ``k dt``.
    features
        factors of the entries of ``theta``.
    device, controller
        names of the device and the controller.
    units
        of ``y`` and ``u``, such as ``{"y": "rad", "u": "A"}``; by default ``y-unit``, ``u-unit``.
    notes
        anything else that JSON can represent.
    started
        deadline of the row with k = 0, in nanoseconds since 1970, UTC.
    """

    channels: Channels
    dt: float
    features: tuple[str, ...] = ()
    device: str = ""
    controller: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)
    started: int = field(default_factory=time.time_ns)

    def __post_init__(self) -> None:
        checks.positive("dt", self.dt, "s")
        if any(width < 0 for _, width in self.channels) or self.width > _MOST_COLUMNS:
            raise ValueError(
                f"channels: a row of {self.width} numbers; must be at most {_MOST_COLUMNS}"
            )
        if tuple(self.channels[: len(LOOP_CHANNELS)]) != LOOP_CHANNELS:
            first = ", ".join(name for name, _ in LOOP_CHANNELS)
            raise ValueError(f"channels = {self.channels!r}: must begin with {first}")

    @property
    def signals(self) -> Signals:
        """Names and units of y and u, which ``notes`` may have."""
        return signals_from(self.notes.get("signals"))

    @property
    def width(self) -> int:
        """Number of values in a row."""
        return sum(width for _, width in self.channels)

    @property
    def columns(self) -> tuple[str, ...]:
        """Name of each value in a row; ``x_hat[0]`` is the first entry of a vector channel."""
        names: list[str] = []
        for name, width in self.channels:
            vector = is_vector(name, width)
            names += [f"{name}[{i}]" for i in range(width)] if vector else [name] * width
        return tuple(names)

    def to_json(self) -> str:
        """Return the header as JSON."""
        return json.dumps({"quell_recording": VERSION, **asdict(self)}, ensure_ascii=False)

    @classmethod
    def from_json(cls, text: str) -> Header:
        """Return the header that ``to_json`` wrote."""
        try:
            fields = json.loads(text)
            version = fields.pop("quell_recording")
            fields["channels"] = tuple(_channel(*entry) for entry in fields["channels"])
            fields["features"] = tuple(map(str, fields["features"]))
            fields["device"] = str(fields["device"])
            if version != VERSION:
                raise ValueError(f"its layout has version {version!r}, this quell reads {VERSION}")
            if not isinstance(fields.get("notes", {}), dict):
                raise TypeError("notes")
            return cls(**fields)
        except RecursionError:
            raise ValueError("its header is nested too deeply") from None
        except (KeyError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(f"its header is not that of a quell recording ({error!r})") from None


def _channel(name: Any, width: Any) -> tuple[str, int]:
    return str(name), checks.whole("width", width, 0)
