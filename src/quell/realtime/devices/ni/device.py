"""Cards of National Instruments as a device: an encoder's counter is y, an analog output is u.

The counter's integer is read and not the driver's angle, because it is exact and its roll-over is
known. With the counter's c_k the position is::

    n_k = n_{k−1} + ((c_k − n_{k−1} + 2^(bits−1)) mod 2^bits) − 2^(bits−1)
    y_k = ratio · 2π · (n_k − n_0) / counts

which holds across roll-overs in both directions if the shaft turns by less than 2^(bits−1) counts
per sample. The index pulse is not used: it would reset the counter and give y a step.
"""

from __future__ import annotations

import atexit
import math
import warnings
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from quell import checks
from quell.realtime.devices.ni.driver import translated_errors
from quell.realtime.devices.ni.tasks import Tasks


class NiDevice:
    """An encoder at a counter and a motor at an analog output.

    The output is set to zero when the device is opened, when it is closed, and when Python ends,
    unless it is killed. After ``kill -9`` or a crash of the computer **the card holds the last
    voltage**: only a watchdog, of the card or behind ``heartbeat``, stops the motor then.

    Parameters
    ----------
    counter, output
        physical channels, such as "Dev1/ctr0" (of a PCI-6601) and "Dev2/ao0" (of a PCI-6221).
    counts
        counts of the encoder per turn [1], four per line: 16000 for 4000 lines.
    ratio
        turns of the output y per turn of the encoder [1], or y-units per radian; negative if the
        encoder counts in the other direction.
    volts
        output per unit of u [V/u-unit]; negative if the amplifier turns in the other direction.
    u_min, u_max
        limits of u [u-unit]: u is cut to them, and the driver refuses voltages beyond them. They
        must enclose zero.
    bits
        bits of the counter [1]: 32, but 24 for old E Series cards.
    pulse_filter
        shortest pulse on A and B that counts [s], if the card can filter; 0 for all pulses.
    enable
        digital line, such as "Dev2/port0/line0", that is high from the first write until the device
        is closed: for the amplifier's enable.
    heartbeat
        digital line that changes its level at each write: for a relay or a charge pump that drops
        the amplifier's enable when the changes stop.
    watchdog
        time without a write after which the card itself sets the output to zero [s], from the first
        write on; None for cards without a watchdog, such as the PCI-6221.

    Raises
    ------
    ValueError
        for bad parameters, and for channels or limits that these cards do not have.
    OSError
        without a driver, or if a card is in use or does not answer.
    ImportError
        without the package ``nidaqmx``.
    """

    def __init__(
        self,
        counter: str,
        output: str,
        *,
        counts: int = 16000,
        ratio: float = 1.0,
        volts: float = 1.0,
        u_min: float = -10.0,
        u_max: float = 10.0,
        bits: int = 32,
        pulse_filter: float = 0.0,
        enable: str | None = None,
        heartbeat: str | None = None,
        watchdog: float | None = None,
    ) -> None:
        turn = checks.nonzero("ratio", ratio, "or y would stand still") * math.tau
        self._radians = turn / checks.whole("counts", counts, 1)
        self._volts = checks.nonzero("volts", volts, "or u would do nothing")
        self._low, self._high = checks.interval(
            "u_min", checks.finite("u_min", u_min), "u_max", checks.finite("u_max", u_max)
        )
        if not self._low <= 0.0 <= self._high:
            raise ValueError(
                f"u_min = {u_min!r}, u_max = {u_max!r}: must enclose zero, the safe output"
            )
        self._half = 1 << checks.whole("bits", bits, 8, 32) - 1
        shortest = checks.non_negative("pulse_filter", pulse_filter, "s")
        timeout = None if watchdog is None else checks.positive("watchdog", watchdog, "s")

        self.name = f"NI {counter} and {output}"
        self._armed = self._level = False
        self._tasks = Tasks()
        atexit.register(self.close)
        try:
            if timeout is not None:
                self._tasks.open_watchdog(output, enable, timeout)
            self._read_count = self._tasks.open_counter(counter, shortest)
            ends = sorted((self._volts * self._low, self._volts * self._high))
            self._write_volts = self._tasks.open_output(output, *ends)
            self._write_enable = self._tasks.open_line("enable", enable)
            self._write_heartbeat = self._tasks.open_line("heartbeat", heartbeat)
            with translated_errors(f"counter = {counter!r}"):
                self._count = self._zero = self._read_count()
        except BaseException:
            self.close()
            raise

    def read(self) -> float:
        """Return the position [y-unit], zero where the device was opened."""
        self._check_open()
        with translated_errors("the counter can't be read"):
            ahead = self._read_count() - self._count
        self._count += (ahead + self._half) % (2 * self._half) - self._half
        return self._radians * (self._count - self._zero)

    def write(self, u: float) -> None:
        """Set the output to ``u`` [u-unit], cut to its limits.

        A value that is not finite sets the output to zero and raises a ``ValueError``.
        """
        self._check_open()
        finite = math.isfinite(u)
        with translated_errors("the output can't be written"):
            if not self._armed:
                self._tasks.arm()
                self._write_enable(True)
                self._armed = True
            self._write_volts(self._volts * min(max(u, self._low), self._high) if finite else 0.0)
            self._level = not self._level
            self._write_heartbeat(self._level)
            self._tasks.reset_watchdog()
        if not finite:
            raise ValueError(f"u = {u!r}: must be a finite number; the output is zero now")

    def close(self) -> None:
        """Set the output to zero and the enable line low, and release the cards.

        If a card does not answer, a ``RuntimeWarning`` says so: its output holds the last voltage.
        """
        atexit.unregister(self.close)
        if failed := self._tasks.close():
            warnings.warn(". ".join(failed), RuntimeWarning, stacklevel=2)

    def _check_open(self) -> None:
        if not self._tasks.is_open:
            raise OSError("the device is closed: open it again")


_INTEGERS, _CHANNELS = ("counts", "bits"), ("enable", "heartbeat")
_KEYS = (*_INTEGERS, "ratio", "volts", "u_min", "u_max", "pulse_filter", *_CHANNELS, "watchdog")


def ni_device(url: str, dt: float) -> NiDevice:
    """Return the device of a URL ``ni://COUNTER+OUTPUT?name=value&…``.

    For example ``ni://Dev1/ctr0+Dev2/ao0?counts=16000&enable=Dev2/port0/line0``. The names are the
    parameters of ``NiDevice``. The cards have no sample time of their own; dt is the loop's [s].
    """
    checks.positive("dt", dt, "s")
    parts = urlsplit(url)
    channels = (parts.netloc + parts.path).split("+")
    if parts.scheme != "ni" or len(channels) != 2 or not all(channels):
        raise ValueError(
            f"device = {url!r}: must be ni://COUNTER+OUTPUT, such as ni://Dev1/ctr0+Dev2/ao0"
        )
    given: dict[str, Any] = {}
    for key, text in parse_qsl(parts.query, keep_blank_values=True):
        if key not in _KEYS:
            raise ValueError(f"device = {url!r}: {key} is none of {', '.join(_KEYS)}")
        kind: type = str if key in _CHANNELS else int if key in _INTEGERS else float
        try:
            given[key] = kind(text)
        except ValueError:
            number = "whole number" if kind is int else "number"
            raise ValueError(f"device = {url!r}: {key} = {text!r} must be a {number}") from None
    return NiDevice(*channels, **given)
