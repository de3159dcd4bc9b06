"""What a recording says of itself before its first row."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from quell import checks
from quell.realtime.telemetry.channels import LOOP_CHANNELS
from quell.records.record import is_vector

VERSION = 1
"""Of the recording's layout; a reader refuses others."""


@dataclass(frozen=True)
class Header:
    """What is recorded, and of what.

    Parameters
    ----------
    channels : tuple of (name, width)
        what a row holds, in order; the first ones are ``LOOP_CHANNELS``.
    dt
        sample time [s]: row k belongs to the time ``k dt``.
    features
        what the entries of ``theta`` multiply.
    device, controller
        what was controlled, and by what, in words.
    units
        of ``y`` and ``u``, for example ``{"y": "rad", "u": "A"}``; where none are given they are ``y-unit`` and ``u-unit``.
    notes
        what else is worth keeping: anything that JSON can hold.
    started
        when the row with k = 0 was due: nanoseconds since 1970, UTC.

    Raises
    ------
    ValueError
        for a dt that is not positive, and for channels that do not begin as those of a loop.
    """

    channels: tuple[tuple[str, int], ...]
    dt: float
    features: tuple[str, ...] = ()
    device: str = ""
    controller: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)
    started: int = field(default_factory=time.time_ns)

    def __post_init__(self) -> None:
        checks.positive("dt", self.dt, "s")
        if tuple(self.channels[: len(LOOP_CHANNELS)]) != LOOP_CHANNELS:
            raise ValueError(
                f"channels = {self.channels!r}: must begin with {', '.join(name for name, _ in LOOP_CHANNELS)}"
            )

    @property
    def width(self) -> int:
        """How many numbers a row has."""
        return sum(width for _, width in self.channels)

    @property
    def columns(self) -> tuple[str, ...]:
        """Name of each of a row's numbers; ``x_hat[0]`` is the first one of a channel of several."""
        named: list[str] = []
        for name, width in self.channels:
            named += (
                [f"{name}[{i}]" for i in range(width)] if is_vector(name, width) else [name] * width
            )
        return tuple(named)

    def to_json(self) -> str:
        """Return the header as JSON."""
        return json.dumps({"quell_recording": VERSION, **asdict(self)}, ensure_ascii=False)

    @classmethod
    def from_json(cls, text: str) -> Header:
        """Return the header that ``to_json`` wrote.

        Raises
        ------
        ValueError
            where the text is something else, or of another version.
        """
        try:
            told = json.loads(text)
            version = told.pop("quell_recording")
            told["channels"] = tuple((str(name), int(width)) for name, width in told["channels"])
            told["features"] = tuple(map(str, told["features"]))
            if version != VERSION:
                raise ValueError(
                    f"is version {version!r} of the layout, this quell reads {VERSION}"
                )
            return cls(**told)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"its header is not that of a recording by quell ({error!r})"
            ) from None
