"""Cards of National Instruments as a device.

The package ``nidaqmx``, and its errors in one line with a remedy.

Tasks of the driver NI-DAQmx: a counter, an analog output, digital lines and a watchdog.

All values are read and written on demand. Each output is set to zero when it is opened and when the
tasks are closed.

Cards of National Instruments as a device: an encoder's counter is y, an analog output is u.

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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from quell import checks
from quell.checks import import_extra

# ---- The package nidaqmx, and its errors in one line with a remedy ----

# Error codes of NIDAQmx.h with their remedies: wrong arguments, then failures of the hardware.
_ARGUMENTS = {
    -200220: "for the cards present see NI MAX, or nidaqmx.system.System.local().devices",
    -200170: "counters have names like Dev1/ctr0, outputs Dev2/ao0, digital lines Dev2/port0/line0",
    -200077: "take limits within the range of this card's output",
    -200662: "this card has none (X Series and some cDAQ chassis have one): "
    "give a digital line as heartbeat to a relay instead",
}
_HARDWARE = {
    -50103: "another program uses the card: close it",
    -201003: "the card does not answer: check that it is plugged in and on",
    -200324: "the card is gone",
    -200045: "the card was removed",
    -200678: "the card's watchdog has set the output to zero because the loop was late; "
    "reset the card in NI MAX before the next run",
}


def driver() -> Any:
    """Return the package ``nidaqmx`` with the modules that are used here."""
    for module in ("constants", "stream_readers", "stream_writers", "system.watchdog", "types"):
        import_extra(f"nidaqmx.{module}", "ni", "a card of NI")
    return import_extra("nidaqmx", "ni", "a card of NI")


@contextmanager
def translated_errors(context: str) -> Iterator[None]:
    """Turn an error of the driver into an error with one line, which begins with ``context``.

    It is a ``ValueError`` for arguments that are wrong for these cards, else an ``OSError``.
    """
    from nidaqmx import errors

    missing = (
        errors.DaqNotFoundError,
        errors.DaqNotSupportedError,
        errors.DaqFunctionNotSupportedError,
    )
    try:
        yield
    except missing as error:
        raise OSError(
            f"{context}: {_in_one_line(error)} The driver is not part of the Python package: "
            "python -m nidaqmx installdriver, or ni.com/downloads"
        ) from None
    except errors.DaqError as error:
        code, text = error.error_code, f"{context}: {_in_one_line(error)}"
        if code in _ARGUMENTS:
            raise ValueError(f"{text}: {_ARGUMENTS[code]}") from None
        raise OSError(f"{text}: {_HARDWARE[code]}" if code in _HARDWARE else text) from None


def _in_one_line(error: Exception) -> str:
    return "; ".join(part.strip().rstrip(".") for part in str(error).splitlines() if part.strip())


# ---- Tasks of the driver NI-DAQmx ----

# Longest time for a call of the driver [s]; calls on demand do not wait. Chosen by hand.
_TIMEOUT = 1.0


class Tasks:
    """The tasks of one device, and the steps that close them.

    On some chassis a watchdog can't be started while other tasks run. Therefore output tasks are
    started by ``arm``, after the watchdog, if there is one.
    """

    def __init__(self) -> None:
        self._ni = driver()
        self._closing: list[tuple[str, Callable[[], object]]] = []
        self._watchdog: Any = None
        self._waiting: list[Any] = []

    @property
    def is_open(self) -> bool:
        """Whether there is a task."""
        return bool(self._closing)

    def close(self) -> list[str]:
        """Set all outputs to zero and clear the tasks, newest first; return what failed."""
        steps, self._closing = self._closing, []
        failed = []
        for failure, step in reversed(steps):
            try:
                with translated_errors(failure):
                    step()
            except Exception as error:  # whatever it is, the other steps must be taken
                failed.append(str(error))
        return failed

    def open_watchdog(self, output: str, enable: str | None, timeout: float) -> None:
        """Let the card set ``output`` to zero ``timeout`` [s] after the last reset.

        The line ``enable`` becomes low then, if it is on the same card.
        """
        ni, card, setting = self._ni, output.split("/")[0], f"watchdog = {timeout!r} s"
        with translated_errors(setting):
            task = ni.system.watchdog.WatchdogTask(card, timeout=timeout)
        self._closing.append(("the watchdog's task can't be cleared", task.close))
        with translated_errors(setting):
            zero = ni.constants.WatchdogAOExpirState.VOLTAGE
            task.cfg_watchdog_ao_expir_states([ni.types.AOExpirationState(output, 0.0, zero)])
            if enable is not None and enable.split("/")[0] == card:
                low = ni.types.DOExpirationState(enable, ni.constants.Level.LOW)
                task.cfg_watchdog_do_expir_states([low])
        self._watchdog = task

    def open_counter(self, counter: str, pulse_filter: float) -> Callable[[], int]:
        """Return the function that reads the count of an encoder, all four edges of its lines.

        Pulses shorter than ``pulse_filter`` [s] do not count, unless it is zero.
        """
        constants = self._ni.constants
        task = self._new("the counter's task")
        with translated_errors(f"counter = {counter!r}"):
            channel = task.ci_channels.add_ci_ang_encoder_chan(
                counter, decoding_type=constants.EncoderType.X_4, units=constants.AngleUnits.TICKS
            )
        if pulse_filter > 0.0:
            with translated_errors(f"pulse_filter = {pulse_filter!r} s"):
                channel.ci_encoder_a_input_dig_fltr_min_pulse_width = pulse_filter
                channel.ci_encoder_b_input_dig_fltr_min_pulse_width = pulse_filter
                channel.ci_encoder_a_input_dig_fltr_enable = True
                channel.ci_encoder_b_input_dig_fltr_enable = True
        with translated_errors(f"counter = {counter!r}"):
            task.start()  # or each read would start it, and the count would begin at zero
        read = self._ni.stream_readers.CounterReader(task.in_stream).read_one_sample_uint32
        return lambda: read(_TIMEOUT)

    def open_output(self, output: str, low: float, high: float) -> Callable[[float], object]:
        """Return the function that sets an analog output [V], from ``low`` to ``high``."""
        task = self._new("the output's task")
        with translated_errors(f"output = {output!r} from {low:g} to {high:g} V"):
            task.ao_channels.add_ao_voltage_chan(output, min_val=low, max_val=high)
            writer = self._ni.stream_writers.AnalogSingleChannelWriter
            write = writer(task.out_stream, auto_start=True).write_one_sample
            failure = f"{output} can't be set to zero, switch the amplifier off"
            return self._start(task, write, 0.0, failure)

    def open_line(self, name: str, line: str | None) -> Callable[[bool], object]:
        """Return the function that sets a digital line, if there is one."""
        if line is None:
            return lambda level: None
        task = self._new(f"the task of {name}")
        with translated_errors(f"{name} = {line!r}"):
            task.do_channels.add_do_chan(line)
            writer = self._ni.stream_writers.DigitalSingleChannelWriter
            write = writer(task.out_stream, auto_start=True).write_one_sample_one_line
            return self._start(task, write, False, f"{line} can't be set low")

    def arm(self) -> None:
        """Start the watchdog, if there is one, and then the output tasks."""
        if self._watchdog is not None:
            self._watchdog.start()
            for task in self._waiting:
                task.start()

    def reset_watchdog(self) -> None:
        """Start the time of the watchdog, if there is one, from zero."""
        if self._watchdog is not None:
            self._watchdog.reset_timer()

    def _new(self, what: str) -> Any:
        with translated_errors(what):
            task = self._ni.Task()
        self._closing.append((f"{what} can't be cleared", task.close))
        return task

    def _start(self, task: Any, write: Any, zero: Any, failure: str) -> Callable[[Any], object]:
        """Set an output to zero, now and at the end; return the function that sets it."""
        write(zero, _TIMEOUT)
        if self._watchdog is None:
            task.start()  # or each write would start and stop it
        else:
            self._waiting.append(task)
        self._closing.append((failure, lambda: write(zero, _TIMEOUT)))
        return lambda value: write(value, _TIMEOUT)


# ---- Cards of National Instruments as a device ----


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
