"""Cards of National Instruments as a device.

The package ``nidaqmx``, and its errors in one line with a remedy.

Tasks of the driver NI-DAQmx: counters, analog inputs and outputs, digital lines and watchdogs.

All values are read and written on demand. Each output is set to zero when it is opened and when the
tasks are closed. Analog channels of a card share a task, as the driver asks for: they are read, or
written, in one call.

Cards of National Instruments as a device: encoders at counters and voltages at analog inputs are y,
analog outputs are u. Of several axes the channels are lists.

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
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, urlsplit

import numpy as np

from quell import checks
from quell.checks import import_extra
from quell.realtime.devices import SignalCounts, other_counts
from quell.types import Vector

# ---- The package nidaqmx, and its errors in one line with a remedy ----

# Error codes of NIDAQmx.h with their remedies: wrong arguments, then failures of the hardware.
_ARGUMENTS = {
    -200220: "for the cards present see NI MAX, or nidaqmx.system.System.local().devices",
    -200170: "counters have names like Dev1/ctr0, analog inputs Dev2/ai0, outputs Dev2/ao0, "
    "digital lines Dev2/port0/line0",
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


class Voltage(NamedTuple):
    """An analog channel and its range [V]."""

    name: str
    low: float
    high: float

    @property
    def card(self) -> str:
        """Name of its card."""
        return self.name.partition("/")[0]


class Tasks:
    """The tasks of one device, and the steps that close them.

    On some chassis a watchdog can't be started while other tasks run. Therefore tasks of analog
    channels and of lines are started by ``arm``, after the watchdogs, if there are some.
    """

    def __init__(self) -> None:
        self._ni = driver()
        self._closing: list[tuple[str, Callable[[], object]]] = []
        self._watchdogs: list[Any] = []
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

    def open_watchdog(self, outputs: list[str], enable: str | None, timeout: float) -> None:
        """Let a card set its ``outputs`` to zero ``timeout`` [s] after the last reset.

        The line ``enable`` becomes low then, if it is on the same card.
        """
        ni, card, setting = self._ni, outputs[0].split("/")[0], f"watchdog = {timeout!r} s"
        with translated_errors(setting):
            task = ni.system.watchdog.WatchdogTask(card, timeout=timeout)
        self._closing.append(("the watchdog's task can't be cleared", task.close))
        with translated_errors(setting):
            zero = ni.constants.WatchdogAOExpirState.VOLTAGE
            states = [ni.types.AOExpirationState(output, 0.0, zero) for output in outputs]
            task.cfg_watchdog_ao_expir_states(states)
            if enable is not None and enable.split("/")[0] == card:
                low = ni.types.DOExpirationState(enable, ni.constants.Level.LOW)
                task.cfg_watchdog_do_expir_states([low])
        self._watchdogs.append(task)

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

    def open_inputs(self, inputs: list[Voltage]) -> Callable[[], Vector]:
        """Return the function that reads the analog inputs of a card [V]."""
        task = self._new("the task of analog inputs")
        for each in inputs:
            with translated_errors(f"input = {each.name!r} from {each.low:g} to {each.high:g} V"):
                task.ai_channels.add_ai_voltage_chan(each.name, min_val=each.low, max_val=each.high)
        _check_count("input", inputs, task)
        values = np.zeros(len(inputs))
        with translated_errors(f"input = {inputs[0].name!r}"):
            self._begin(task)  # before that each read starts and stops it
            reader = self._ni.stream_readers.AnalogMultiChannelReader(task.in_stream)
            reader.verify_array_shape = False

        def read() -> Vector:
            reader.read_one_sample(values, _TIMEOUT)
            return values

        return read

    def open_outputs(self, outputs: list[Voltage]) -> Callable[[Vector], object]:
        """Return the function that sets the analog outputs of a card [V], all at once."""
        task = self._new("the output's task")
        for each in outputs:
            with translated_errors(f"output = {each.name!r} from {each.low:g} to {each.high:g} V"):
                task.ao_channels.add_ao_voltage_chan(each.name, min_val=each.low, max_val=each.high)
        _check_count("output", outputs, task)
        writer = self._ni.stream_writers.AnalogMultiChannelWriter(task.out_stream, auto_start=True)
        writer.verify_array_shape = False
        names = ", ".join(each.name for each in outputs)
        failure = f"{names} can't be set to zero, switch the amplifier off"
        with translated_errors(f"output = {names!r}"):
            return self._start(task, writer.write_one_sample, np.zeros(len(outputs)), failure)

    def open_line(self, name: str, line: str | None) -> Callable[[bool], object]:
        """Return the function that sets a digital line, if there is one."""
        if line is None:
            return lambda level: None
        task = self._new(f"the task of {name}")
        with translated_errors(f"{name} = {line!r}"):
            if (lines := task.do_channels.add_do_chan(line).do_num_lines) != 1:
                rule = "must be one line, such as Dev2/port0/line0"
                raise ValueError(f"{name} = {line!r}: is {lines} lines; {rule}")
            writer = self._ni.stream_writers.DigitalSingleChannelWriter
            write = writer(task.out_stream, auto_start=True).write_one_sample_one_line
            return self._start(task, write, False, f"{line} can't be set low")

    def arm(self) -> None:
        """Start the watchdogs, if there are some, and then the output tasks."""
        for watchdog in self._watchdogs:
            watchdog.start()
        if self._watchdogs:
            for task in self._waiting:
                task.start()

    def reset_watchdog(self) -> None:
        """Start the time of the watchdogs, if there are some, from zero."""
        for watchdog in self._watchdogs:
            watchdog.reset_timer()

    def _new(self, what: str) -> Any:
        with translated_errors(what):
            task = self._ni.Task()
        self._closing.append((f"{what} can't be cleared", task.close))
        return task

    def _begin(self, task: Any) -> None:
        """Start a task, with ``arm`` if there are watchdogs, which must be the first."""
        if self._watchdogs:
            self._waiting.append(task)
        else:
            task.start()

    def _start(self, task: Any, write: Any, zero: Any, failure: str) -> Callable[[Any], object]:
        """Set an output to zero, now and at the end; return the function that sets it."""
        write(zero, _TIMEOUT)
        self._begin(task)  # or each write would start and stop it
        self._closing.append((failure, lambda: write(zero, _TIMEOUT)))
        return lambda value: write(value, _TIMEOUT)


# The remedy for a name that is several channels.
_ONE_EACH = "name each one, ['Dev2/ao0', 'Dev2/ao1'], in a URL Dev2/ao0,Dev2/ao1"


def _check_count(what: str, channels: list[Voltage], task: Any) -> None:
    """Refuse names that are several channels: the driver would go beyond the array of values."""
    with translated_errors(f"{what} = {channels[0].name!r}"):
        count = task.number_of_channels
    if count != len(channels):
        names = ", ".join(each.name for each in channels)
        rule = f"must be {checks.counted(len(channels), 'channel')}; {_ONE_EACH}"
        raise ValueError(f"{what} = {names!r}: is {checks.counted(count, 'channel')}, {rule}")


# ---- Cards of National Instruments as a device ----


class _Encoder:
    """An encoder at a counter, with the place at which it was opened as zero."""

    def __init__(self, name: str, read: Callable[[], int], radians: float, bits: int) -> None:
        self.name, self._read, self._radians = name, read, radians
        self._half = 1 << bits - 1
        with translated_errors(f"counter = {name!r}"):
            self._count = self._zero = read()

    def read(self) -> float:
        """Return the position [y-unit]."""
        with translated_errors(f"{self.name} can't be read"):
            ahead = self._read() - self._count
        self._count += (ahead + self._half) % (2 * self._half) - self._half
        return self._radians * (self._count - self._zero)


class NiDevice:
    """Encoders at counters, or voltages, and motors at analog outputs.

    The outputs are set to zero when the device is opened, when it is closed, and when Python ends,
    unless it is killed. After ``kill -9`` or a crash of the computer **the card holds the last
    voltage**: only a watchdog, of the card or behind ``heartbeat``, stops the motor then.

    Of several axes ``counter`` and ``output`` are lists; then ``read`` returns an array (p,) and
    ``write`` takes one (m,), and each number below is one for all or a list with one for each of
    them. Channels of one card are read, or written, in one call; those of several one after the
    other.

    Parameters
    ----------
    counter, output
        physical channels, such as "Dev1/ctr0" (of a PCI-6601) and "Dev2/ao0" (of a PCI-6221). In
        the place of a counter an analog input, such as "Dev2/ai0", measures a voltage.
    counts
        counts of the encoder per turn [1], four per line: 16000, the default, for 4000 lines.
    ratio
        turns of the output y per turn of the encoder [1], or y-units per radian; negative if the
        encoder counts in the other direction. Of a voltage y-units per volt.
    volts
        output per unit of u [V/u-unit]; negative if the amplifier turns in the other direction.
    u_min, u_max
        limits of u [u-unit]: u is cut to them, and the driver refuses voltages beyond them. They
        must enclose zero.
    bits
        bits of the counter [1]: 32, the default, but 24 for old E Series cards.
    pulse_filter
        shortest pulse on A and B that counts [s], if the card can filter; 0, the default, for all
        pulses.
    zero
        voltage at an analog input at which y is zero [V]; 0 by default.
    enable
        digital line, such as "Dev2/port0/line0", that is high from the first write until the device
        is closed: for the enable of the amplifiers.
    heartbeat
        digital line that changes its level at each write: for a relay or a charge pump that drops
        the amplifiers' enable when the changes stop.
    watchdog
        time without a write after which the cards themselves set the outputs to zero [s], from the
        first write on; None for cards without a watchdog, such as the PCI-6221.

    Raises
    ------
    ValueError
        for bad parameters, those that have no effect on the channels, and for channels or limits
        that these cards do not have.
    OSError
        without a driver, or if a card is in use or does not answer.
    ImportError
        without the package ``nidaqmx``.
    """

    def __init__(
        self,
        counter: str | Sequence[str],
        output: str | Sequence[str],
        *,
        counts: int | Sequence[int | None] | None = None,
        ratio: float | Sequence[float] = 1.0,
        volts: float | Sequence[float] = 1.0,
        u_min: float | Sequence[float] = -10.0,
        u_max: float | Sequence[float] = 10.0,
        bits: int | Sequence[int | None] | None = None,
        pulse_filter: float | Sequence[float | None] | None = None,
        zero: float | Sequence[float | None] | None = None,
        enable: str | None = None,
        heartbeat: str | None = None,
        watchdog: float | None = None,
    ) -> None:
        counter, output = _as_list(counter), _as_list(output)
        several = checks.is_sequence(counter) or checks.is_sequence(output)
        inputs, outputs = _channels("counter", counter), _channels("output", output)
        self.signal_counts = SignalCounts(len(inputs), len(outputs)) if several else None
        analog = [name.rpartition("/")[2].startswith("ai") for name in inputs]
        encoders = [not each for each in analog]

        def of_inputs(name: str, given: Any, used: list[bool], default: Any) -> list[Any]:
            return _for_each(name, given, used, default, "an encoder" if used is encoders else _AN)

        turns = of_inputs("counts", counts, encoders, 16000)
        bit_counts = of_inputs("bits", bits, encoders, 32)
        filters = of_inputs("pulse_filter", pulse_filter, encoders, 0.0)
        zeros = of_inputs("zero", zero, analog, 0.0)
        ratios, every = _for_each("ratio", ratio, [True] * len(inputs)), [True] * len(outputs)
        scales = [checks.nonzero("ratio", each, "or y would stand still") for each in ratios]
        radians = [
            math.tau * scale / checks.whole("counts", turn, 1)
            for scale, turn in zip(scales, turns, strict=True)
        ]
        for each in bit_counts:
            checks.whole("bits", each, 8, 32)
        for each in filters:
            checks.non_negative("pulse_filter", each, "s")
        self._ratio = np.array(scales, dtype=float)
        self._zero = np.array([checks.finite("zero", each) for each in zeros])
        self._volts = np.array(
            [
                checks.nonzero("volts", each, "or u would do nothing")
                for each in _for_each("volts", volts, every)
            ],
            dtype=float,
        )
        limits = [
            _checked_limits(*pair)
            for pair in zip(
                _for_each("u_min", u_min, every), _for_each("u_max", u_max, every), strict=True
            )
        ]
        self._low, self._high = np.array(limits).T
        timeout = None if watchdog is None else checks.positive("watchdog", watchdog, "s")
        _check_line("enable", enable)
        _check_line("heartbeat", heartbeat)

        self.name = f"NI {', '.join(inputs)} and {', '.join(outputs)}"
        self._armed = self._level = False
        self._tasks = Tasks()
        atexit.register(self.close)
        ends = [
            Voltage(name, *sorted((each.item(0), each.item(1))))
            for name, each in zip(outputs, (self._volts * (self._low, self._high)).T, strict=True)
        ]
        try:
            if timeout is not None:
                for _, places in _by_card(outputs):
                    names = [outputs[k] for k in places]
                    self._tasks.open_watchdog(names, enable, timeout)
            self._encoders: dict[int, _Encoder] = {}
            for i in np.flatnonzero(encoders).tolist():
                read = self._tasks.open_counter(inputs[i], filters[i])
                self._encoders[i] = _Encoder(inputs[i], read, radians[i], bit_counts[i])
            self._voltages = [
                (places, self._tasks.open_inputs([Voltage(inputs[i], *_RANGE) for i in places]))
                for _, places in _by_card(inputs, analog)
            ]
            self._writers = [
                (places, self._tasks.open_outputs([ends[k] for k in places]))
                for _, places in _by_card(outputs)
            ]
            self._write_enable = self._tasks.open_line("enable", enable)
            self._write_heartbeat = self._tasks.open_line("heartbeat", heartbeat)
        except BaseException:
            self.close()
            raise

    def read(self) -> Any:
        """Return the positions, zero where the device was opened, and the voltages [y-unit].

        A number, or of several axes an array (p,).
        """
        self._check_open()
        y = np.zeros(self._ratio.size)
        for i, encoder in self._encoders.items():
            y[i] = encoder.read()
        for places, read in self._voltages:
            with translated_errors("the analog inputs can't be read"):
                y[places] = self._ratio[places] * (read() - self._zero[places])
        return float(y[0]) if self.signal_counts is None else y

    def write(self, u: Any) -> None:
        """Set the outputs to ``u`` [u-unit], a number or an array (m,), cut to its limits.

        If one is not finite all outputs are set to zero, and a ``ValueError`` is raised. If a card
        fails the others get their u nevertheless. Then its ``OSError`` is raised; the heartbeat
        does not change, and watchdogs are not reset.
        """
        self._check_open()
        given = np.asarray(u, dtype=float).reshape(-1)
        if given.size != self._volts.size:
            raise ValueError(f"u = {u!r:.60}: must be {self._volts.size} numbers")
        finite = bool(np.all(np.isfinite(given)))
        volts = self._volts * np.clip(given, self._low, self._high)
        with translated_errors("the output can't be written"):
            if not self._armed:
                self._tasks.arm()
                self._write_enable(True)
                self._armed = True
            failure: Exception | None = None
            for places, write in self._writers:
                try:
                    write(volts[places] if finite else np.zeros(len(places)))
                except Exception as error:  # the other cards would hold their last voltages
                    failure = failure or error
            if failure is not None:
                raise failure
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


_AN = "an analog input"
# Range of analog inputs [V], the widest of most cards.
_RANGE = (-10.0, 10.0)


def _channels(name: str, given: Any) -> list[str]:
    """Return physical channels, a list of different texts."""
    found = list(given) if checks.is_sequence(given) else [given]
    if not found or not all(isinstance(each, str) and each for each in found):
        rule = "must be a physical channel, or of several axes a list of them"
        raise ValueError(f"{name} = {given!r:.60}: {rule}")
    for each in found:
        if ":" in each or "," in each:
            raise ValueError(f"{name} = {each!r:.60}: is several channels; {_ONE_EACH}")
    if len(set(found)) < len(found):
        raise ValueError(f"{name} = {given!r:.60}: must be different channels")
    return found


def _check_line(name: str, given: Any) -> None:
    """Refuse what is not one digital line; None is none."""
    if given is None:
        return
    if not isinstance(given, str) or not given or ":" in given or "," in given:
        rule = "must be one digital line, a text such as 'Dev2/port0/line0'"
        raise ValueError(f"{name} = {given!r:.60}: {rule}; one serves all amplifiers")


def _as_list(given: Any) -> Any:
    """Return an array as a list, all else as it is."""
    return given.tolist() if isinstance(given, np.ndarray) else given


def _for_each(
    name: str, given: Any, used: list[bool], default: Any = None, kind: str = ""
) -> list[Any]:
    """Return a number for each channel, that of all or one of a list; None is the default."""
    given = _as_list(given)
    if given is None:
        return [default] * len(used)
    if not any(used):
        raise ValueError(
            f"{name} = {given!r:.60}: has no effect, no channel is {kind}; leave it out"
        )
    if not checks.is_sequence(given):
        return [given if each else default for each in used]
    if len(given) != len(used):
        rule = f"must be one number, or {len(used)}, one for each channel"
        raise ValueError(f"{name} = {given!r:.60}: {rule}")
    for value, each in zip(given, used, strict=True):
        if value is not None and not each:
            raise ValueError(
                f"{name} = {given!r:.60}: must be None for a channel that is not {kind}"
            )
    return [default if value is None else value for value in given]


def _checked_limits(u_min: Any, u_max: Any) -> tuple[float, float]:
    """Return limits of u with zero between them."""
    low, high = checks.interval(
        "u_min", checks.finite("u_min", u_min), "u_max", checks.finite("u_max", u_max)
    )
    if not low <= 0.0 <= high:
        raise ValueError(
            f"u_min = {u_min!r}, u_max = {u_max!r}: must enclose zero, the safe output"
        )
    return low, high


def _by_card(names: list[str], used: list[bool] | None = None) -> list[tuple[str, list[int]]]:
    """Return the places of channels, or of those that are used, by their cards."""
    places = [i for i in range(len(names)) if used is None or used[i]]
    places.sort(key=lambda i: names[i].partition("/")[0])  # stable: in order on each card
    groups = groupby(places, key=lambda i: names[i].partition("/")[0])
    return [(card, list(group)) for card, group in groups]


_INTEGERS, _LINES = ("counts", "bits"), ("enable", "heartbeat")
_KEYS = (
    *_INTEGERS,
    "ratio",
    "volts",
    "u_min",
    "u_max",
    "pulse_filter",
    "zero",
    *_LINES,
    "watchdog",
)


def ni_device(url: str, dt: float, signals: SignalCounts | None = None) -> NiDevice:
    """Return the device of a URL ``ni://COUNTER+OUTPUT?name=value&…``.

    For example ``ni://Dev1/ctr0+Dev2/ao0?counts=16000&enable=Dev2/port0/line0``. The names are the
    parameters of ``NiDevice``. Several channels, and their numbers, are separated by commas,
    ``ni://Dev1/ctr0,Dev1/ctr1+Dev2/ao0,Dev2/ao1?counts=16000,8000``; ``signals`` says how many
    there must be. The cards have no sample time of their own; dt is the loop's [s].
    """
    checks.positive("dt", dt, "s")
    parts = urlsplit(url)
    channels = [each.split(",") for each in (parts.netloc + parts.path).split("+")]
    if parts.scheme != "ni" or len(channels) != 2 or not all(map(all, channels)):
        raise ValueError(
            f"device = {url!r}: must be ni://COUNTER+OUTPUT, such as ni://Dev1/ctr0+Dev2/ao0, of "
            "several axes ni://Dev1/ctr0,Dev1/ctr1+Dev2/ao0,Dev2/ao1"
        )
    theirs = SignalCounts(len(channels[0]), len(channels[1]))
    if (theirs != (1, 1)) if signals is None else (theirs != signals):
        ours = None if signals is None else SignalCounts(*signals)
        raise ValueError(other_counts(url, theirs, ours))
    given: dict[str, Any] = {}
    for key, text in parse_qsl(parts.query, keep_blank_values=True):
        if key not in _KEYS:
            raise ValueError(f"device = {url!r}: {key} is none of {', '.join(_KEYS)}")
        given[key] = text if key in _LINES else _numbers(url, key, text)
    ends: Any = channels if signals is not None else [each[0] for each in channels]
    return NiDevice(*ends, **given)


def _numbers(url: str, key: str, text: str) -> Any:
    """Return the number of a key, or a list of those between commas; nothing is None."""
    kind: type = int if key in _INTEGERS else float
    found: list[Any] = []
    for each in text.split(","):
        try:
            found.append(None if not each and "," in text else kind(each))
        except ValueError:
            number = "whole number" if kind is int else "number"
            raise ValueError(f"device = {url!r}: {key} = {each!r} must be a {number}") from None
    return found if "," in text else found[0]
