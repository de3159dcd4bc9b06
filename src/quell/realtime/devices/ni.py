"""Cards of National Instruments as a device: an encoder's counter in, an analog output out, by NI-DAQmx and its package ``nidaqmx``.

Both are read and written on demand: one value, when the loop asks. What is read is the counter's own whole number, not the driver's angle:
it is exact, and where it rolls over is known. With the counter's c_k, the position is::

    n_k = n_{k−1} + ((c_k − n_{k−1} + 2^(bits−1)) mod 2^bits) − 2^(bits−1)
    y_k = ratio · 2π · (n_k − n_0) / counts

which is right whichever way the counter rolls over, as long as the shaft turns by less than 2^(bits−1) counts from one sample to the next.

The index pulse is left alone: a counter that it reloads makes a step of y, and a step of y in a running loop is a blow to the shaft.
"""

from __future__ import annotations

import atexit
import math
import warnings
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from quell import checks
from quell.realtime.devices.daqmx import driver, said

# How long a call may take [s]. On demand, none has to wait.
_PATIENCE = 1.0


class NiDevice:
    """An encoder at a counter and a motor at an analog output.

    The output is set to zero when the device is opened, when it is closed, and when Python ends in whichever way lets it say good-bye.
    After a crash of the machine, or ``kill -9``, **the card holds the last voltage**: only a watchdog, of the card or behind
    ``heartbeat``, stops the motor then.

    Parameters
    ----------
    counter, output
        physical channels, such as "Dev1/ctr0" (of a PCI-6601) and "Dev2/ao0" (of a PCI-6221).
    counts
        of the encoder per turn [1], all four edges of each of its lines counted: 16000 for 4000 lines.
    ratio
        turns of the output y per turn of the encoder [1], or y-units per radian; negative where the encoder counts the other way.
    volts
        of the output per unit of u [V/u-unit]; negative where the amplifier turns the other way.
    u_min, u_max
        limits of u [u-unit]: what lies beyond is cut, and the card is told to refuse the rest. They must enclose zero.
    bits
        of the counter [1]: 32 for all but old E Series cards, which have 24.
    pulse_filter
        shortest pulse on A and B that counts [s], where the card can filter; 0 for all pulses.
    enable
        digital line, such as "Dev2/port0/line0", that is high from the first write until the device is closed: for the amplifier's enable.
    heartbeat
        digital line that changes its level at each write: for a relay or a charge pump that drops the amplifier's enable when it stops.
    watchdog
        after so long without a write the card itself sets the output to zero [s], counted from the first write on; None for cards that have
        no watchdog, as the PCI-6221.

    Raises
    ------
    ValueError
        for bad parameters, and for channels or limits that these cards do not have.
    OSError
        without a driver, or where a card is in use or does not answer.
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
        self._radians = (
            checks.nonzero("ratio", ratio, "or y would stand still")
            * math.tau
            / checks.whole("counts", counts, 1)
        )
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
        patience = None if watchdog is None else checks.positive("watchdog", watchdog, "s")

        self.name = f"NI {counter} and {output}"
        self._ni = driver()
        self._close: list[tuple[str, Callable[[], Any]]] = []
        self._watched: list[Any] = []
        self._armed = self._level = False
        atexit.register(self.close)
        try:
            self._watchdog = self._make_watchdog(output, enable, patience)
            self._read_count = self._start_counter(counter, shortest)
            self._write_volts = self._start_output(output)
            self._write_enable = self._start_line("enable", enable)
            self._write_heartbeat = self._start_line("heartbeat", heartbeat)
            with said(f"counter = {counter!r}"):
                self._count = self._zero = self._read_count(_PATIENCE)
        except BaseException:
            self.close()
            raise

    def read(self) -> float:
        """Return the position [y-unit], zero where the device was opened.

        Raises
        ------
        OSError
            where the card does not answer, or the device is closed.
        """
        self._check_open()
        with said("the counter can't be read"):
            ahead = self._read_count(_PATIENCE) - self._count
        self._count += (ahead + self._half) % (2 * self._half) - self._half
        return self._radians * (self._count - self._zero)

    def write(self, u: float) -> None:
        """Set the output to ``u`` [u-unit], cut to its limits.

        Raises
        ------
        ValueError
            for a value that is no number; the output is set to zero.
        OSError
            where the card does not answer, or the device is closed.
        """
        self._check_open()
        sound = math.isfinite(u)
        with said("the output can't be written"):
            if not self._armed:
                self._arm()
            self._write_volts(self._volts * min(max(u, self._low), self._high) if sound else 0.0)
            self._level = not self._level
            self._write_heartbeat(self._level)
            if self._watchdog is not None:
                self._watchdog.reset_timer()
        if not sound:
            raise ValueError(f"u = {u!r}: must be a finite number; the output is zero now")

    def close(self) -> None:
        """Set the output to zero, take back the enable line, and give the cards free.

        A card that can't be told so is warned of with a ``RuntimeWarning``: its output holds the last voltage.
        """
        steps, self._close = self._close, []
        atexit.unregister(self.close)
        failed = []
        for what, step in reversed(steps):
            try:
                with said(what):
                    step()
            except Exception as error:  # whatever it is, the other steps are taken
                failed.append(str(error))
        if failed:
            warnings.warn(". ".join(failed), RuntimeWarning, stacklevel=2)

    def _check_open(self) -> None:
        if not self._close:
            raise OSError("the device is closed: open it again")

    def _arm(self) -> None:
        """Start the watchdog, now that a loop writes, and enable the amplifier.

        On some chassis a watchdog can't be started while other tasks run there: so these begin after it.
        """
        if self._watchdog is not None:
            self._watchdog.start()
            for task in self._watched:
                task.start()
        self._write_enable(True)
        self._armed = True

    def _task(self, what: str) -> Any:
        """Return a new task, which is cleared at the end."""
        with said(what):
            task = self._ni.Task()
        self._close.append((f"{what} can't be cleared", task.close))
        return task

    def _start_counter(self, counter: str, shortest: float) -> Callable[[float], int]:
        constants = self._ni.constants
        task = self._task("the counter's task")
        with said(f"counter = {counter!r}"):
            channel = task.ci_channels.add_ci_ang_encoder_chan(
                counter, decoding_type=constants.EncoderType.X_4, units=constants.AngleUnits.TICKS
            )
        if shortest > 0.0:
            with said(f"pulse_filter = {shortest!r} s"):
                channel.ci_encoder_a_input_dig_fltr_min_pulse_width = shortest
                channel.ci_encoder_b_input_dig_fltr_min_pulse_width = shortest
                channel.ci_encoder_a_input_dig_fltr_enable = True
                channel.ci_encoder_b_input_dig_fltr_enable = True
        with said(f"counter = {counter!r}"):
            # A task that is not started is started and stopped by each read, and would begin to count anew.
            task.start()
        return self._ni.stream_readers.CounterReader(task.in_stream).read_one_sample_uint32

    def _start_output(self, output: str) -> Callable[[float], Any]:
        ends = sorted((self._volts * self._low, self._volts * self._high))
        task = self._task("the output's task")
        with said(f"output = {output!r} from {ends[0]:g} to {ends[1]:g} V"):
            task.ao_channels.add_ao_voltage_chan(output, min_val=ends[0], max_val=ends[1])
            writer = self._ni.stream_writers.AnalogSingleChannelWriter(
                task.out_stream, auto_start=True
            )
            writer.write_one_sample(0.0, _PATIENCE)
            self._begin(task)
        self._close.append(
            (
                f"{output} can't be set to zero, switch the amplifier off",
                lambda: writer.write_one_sample(0.0, _PATIENCE),
            )
        )
        return lambda value: writer.write_one_sample(value, _PATIENCE)

    def _start_line(self, name: str, line: str | None) -> Callable[[bool], Any]:
        """Set a digital line low, now and at the end; return what sets it."""
        if line is None:
            return _nothing
        task = self._task(f"the task of {name}")
        with said(f"{name} = {line!r}"):
            task.do_channels.add_do_chan(line)
            writer = self._ni.stream_writers.DigitalSingleChannelWriter(
                task.out_stream, auto_start=True
            )
            writer.write_one_sample_one_line(False, _PATIENCE)
            self._begin(task)
        self._close.append(
            (f"{line} can't be set low", lambda: writer.write_one_sample_one_line(False, _PATIENCE))
        )
        return lambda level: writer.write_one_sample_one_line(level, _PATIENCE)

    def _begin(self, task: Any) -> None:
        """Start a task, so that a write need not start and stop it; beside a watchdog, at the first write."""
        if self._watchdog is None:
            task.start()
        else:
            self._watched.append(task)

    def _make_watchdog(self, output: str, enable: str | None, patience: float | None) -> Any:
        if patience is None:
            return None
        ni, card = self._ni, output.split("/")[0]
        with said(f"watchdog = {patience!r} s"):
            task = ni.system.watchdog.WatchdogTask(card, timeout=patience)
        self._close.append(("the watchdog's task can't be cleared", task.close))
        with said(f"watchdog = {patience!r} s"):
            task.cfg_watchdog_ao_expir_states(
                [ni.types.AOExpirationState(output, 0.0, ni.constants.WatchdogAOExpirState.VOLTAGE)]
            )
            if enable is not None and enable.split("/")[0] == card:
                task.cfg_watchdog_do_expir_states(
                    [ni.types.DOExpirationState(enable, ni.constants.Level.LOW)]
                )
        return task


def _nothing(*_: Any) -> None:
    """Stand in for what this device does not have."""


_WHOLE, _WORDS = ("counts", "bits"), ("enable", "heartbeat")
_KEYS = (*_WHOLE, "ratio", "volts", "u_min", "u_max", "pulse_filter", *_WORDS, "watchdog")


def ni_device(url: str, dt: float) -> NiDevice:
    """Return the device at ``ni://COUNTER+OUTPUT?name=value&…``, such as ``ni://Dev1/ctr0+Dev2/ao0?counts=16000&enable=Dev2/port0/line0``.

    The names behind the question mark are the parameters of ``NiDevice``; the sample time dt is the loop's, these cards have none.

    Raises
    ------
    ValueError
        for a URL that is not of this form, and whatever ``NiDevice`` raises.
    """
    checks.positive("dt", dt, "s")
    parts = urlsplit(url)
    channels = (parts.netloc + parts.path).split("+")
    if parts.scheme != "ni" or len(channels) != 2 or not all(channels):
        raise ValueError(
            f"device = {url!r}: must be ni://COUNTER+OUTPUT, such as ni://Dev1/ctr0+Dev2/ao0?counts=16000"
        )
    given: dict[str, Any] = {}
    for key, text in parse_qsl(parts.query, keep_blank_values=True):
        if key not in _KEYS:
            raise ValueError(f"device = {url!r}: {key} is none of {', '.join(_KEYS)}")
        try:
            given[key] = text if key in _WORDS else int(text) if key in _WHOLE else float(text)
        except ValueError:
            raise ValueError(
                f"device = {url!r}: {key} = {text!r} must be a {'whole ' * (key in _WHOLE)}number"
            ) from None
    return NiDevice(*channels, **given)
