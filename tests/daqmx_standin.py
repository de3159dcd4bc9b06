# ruff: noqa: D102, N802
"""A stand-in for the C library of NI-DAQmx: its functions in use, its error codes, and cards.

It replaces the library below the package ``nidaqmx``, whose own code runs as with real cards.
"""

import ctypes
import math
import threading
from dataclasses import dataclass, field

from nidaqmx.constants import AngleUnits, EncoderType, Level
from nidaqmx.utils import unflatten_channel_string

INVALID_DEVICE = -200220
NO_CHANNEL = -200170
INVALID_VALUE = -200077
INVALID_AO_DATA = -200561
NO_WATCHDOG = -200662
WATCHDOG_EXPIRED = -200678
RESERVED = -50103
GONE = -200324
NOT_STARTED = -200846
INVALID_TASK = -200088

_SAYS = {
    INVALID_DEVICE: "Device identifier is invalid.",
    NO_CHANNEL: "Physical channel specified does not exist on this device.\n\n"
    "Refer to the documentation for its channels.",
    INVALID_VALUE: "Requested value is not a supported value for this property.",
    INVALID_AO_DATA: "Attempted writing analog data that is too large or too small.",
    NO_WATCHDOG: "Watchdog timer is not supported on this device.",
    WATCHDOG_EXPIRED: "Write failed, because the watchdog timer expired.",
    RESERVED: "The specified resource is reserved. "
    "The operation could not be completed as specified.",
    GONE: "Device not available for routing. "
    "It is possible that the device needs to be reset or that the device is being reset.",
    NOT_STARTED: "The task is not started and auto_start is false.",
    INVALID_TASK: "Task specified is invalid or does not exist.",
}


@dataclass
class Card:
    """A card: how many counters, outputs and lines it has, and what is on them."""

    counters: int = 0
    outputs: int = 0
    inputs: int = 0
    lines: int = 0
    bits: int = 32
    watchdog: bool = False
    present: bool = True
    volts: dict = field(default_factory=dict)
    """Of its analog outputs, and those that are at its inputs."""
    levels: dict = field(default_factory=dict)
    history: list = field(default_factory=list)
    """All that happened to its outputs and lines, in order."""

    def channels(self):
        """Return the names that this card knows."""
        return (
            {f"ctr{i}" for i in range(self.counters)}
            | {f"ao{i}" for i in range(self.outputs)}
            | {f"ai{i}" for i in range(self.inputs)}
            | {f"port0/line{i}" for i in range(self.lines)}
        )


@dataclass
class Task:
    """A task of the driver: its channels, with their limits, are on one device."""

    kind: str = ""
    device: str = ""
    channels: dict = field(default_factory=dict)
    running: bool = False
    origin: int = 0
    attributes: dict = field(default_factory=dict)
    expires: dict = field(default_factory=dict)
    timeout: float = math.inf
    left: float = math.inf
    expired: bool = False


class _Function:
    """A function of the library: it checks its arguments against ``argtypes``, as ctypes does."""

    def __init__(self, body):
        self.body, self.argtypes, self.arg_lock = body, None, threading.Lock()

    def __call__(self, *arguments):
        for argtype, argument in zip(self.argtypes, arguments, strict=False):
            argtype.from_param(argument)
        return self.body(*arguments)


class Rack:
    """Cards, a shaft whose angle their counters see, and the driver's functions as attributes."""

    def __init__(self, **cards):
        self.cards = cards
        self.tasks = {}
        self.error = 0
        self.last_channel = ""
        self.edges = 0
        """Where the shaft is [edges of A and B]."""
        self.shafts = {}
        """Where the shafts of single counters are, by physical channel; others see ``edges``."""
        for name in dir(type(self)):
            if name.startswith("DAQmx"):
                setattr(self, name, _Function(self._guarded(getattr(self, name))))

    def __getattr__(self, name):
        raise AttributeError(name)  # the package makes DaqFunctionNotSupportedError of it

    def pass_time(self, seconds):
        """Let time pass for the watchdogs."""
        for task in self.tasks.values():
            if task.kind == "watchdog" and task.running:
                task.left -= seconds
                if task.left <= 0.0 and not task.expired:
                    task.expired = True
                    card = self.cards[task.device]
                    card.volts.update(
                        {
                            name: value
                            for name, value in task.expires.items()
                            if name.startswith("ao")
                        }
                    )
                    card.levels.update(
                        {
                            name: value
                            for name, value in task.expires.items()
                            if not name.startswith("ao")
                        }
                    )

    # What the functions have in common.

    def _guarded(self, body):
        def call(*arguments):
            try:
                return body(*arguments) or 0
            except DriverError as error:
                self.error = error.code
                return error.code

        return call

    def _task(self, handle):
        if handle.value not in self.tasks:
            raise DriverError(INVALID_TASK)
        return self.tasks[handle.value]

    def _card(self, task):
        if not self.cards[task.device].present:
            raise DriverError(GONE)
        return self.cards[task.device]

    def _claim(self, task, physical, kind):
        for each in unflatten_channel_string(physical):  # a range is several channels
            device, _, channel = each.partition("/")
            if device not in self.cards:
                raise DriverError(INVALID_DEVICE)
            lines = [f"port0/line{i}" for i in range(self.cards[device].lines)]
            channels = lines if (kind, channel) == ("line", "port0") else [channel]
            if not self.cards[device].channels().issuperset(channels):
                raise DriverError(NO_CHANNEL)
            if task.channels and (kind == "counter" or task.device != device):
                raise DriverError(INVALID_VALUE)
            task.kind, task.device = kind, device
            task.channels |= dict.fromkeys(channels, (-10.0, 10.0))
        self.last_channel = physical

    def _is_taken(self, task):
        others = (other for other in self.tasks.values() if other is not task and other.running)
        return any(
            other.device == task.device
            # Analog inputs of a card have one converter, which one task has.
            and (
                other.kind == task.kind == "input"
                or not other.channels.keys().isdisjoint(task.channels)
            )
            for other in others
        )

    def _edges(self, task):
        return self.shafts.get(f"{task.device}/{next(iter(task.channels))}", self.edges)

    def _new(self, handle, task):
        handle._obj.value = 1 + max(self.tasks, default=0)
        self.tasks[handle._obj.value] = task

    def _say(self, text, out, size):
        raw = text.encode() + b"\0"
        if size == 0:
            return len(raw)
        ctypes.memmove(out, raw[:size], min(size, len(raw)))
        return 0

    # The functions, as NIDAQmx.h has them.

    def DAQmxSetRuntimeEnvironment(self, *_):
        pass

    def DAQmxGetSystemInfoAttribute(self, attribute, out):
        out._obj.value = {0x1272: 24, 0x1923: 5, 0x2F22: 0}[attribute]

    def DAQmxGetExtendedErrorInfo(self, out, size):
        self._say(
            f"{_SAYS[self.error]}\n\nTask Name: _unnamedTask<0>\n\nStatus Code: {self.error}",
            out,
            size,
        )

    def DAQmxGetTaskAttribute(self, handle, attribute, out, size=0):
        if attribute == 0x2181:
            out._obj.value = len(self._task(handle).channels)
            return 0
        assert attribute == 0x1276, "only its name and number of channels are asked for"
        return self._say(f"_unnamedTask<{handle.value}>", out, size)

    def DAQmxInternalGetLastCreatedChan(self, out, size):
        return self._say(self.last_channel, out, size)

    def DAQmxCreateTask(self, name, out):
        self._new(out, Task())

    def DAQmxClearTask(self, handle):
        del self.tasks[handle.value]

    def DAQmxCreateCIAngEncoderChan(
        self, handle, counter, name, decoding, zidx, zidx_val, phase, units, pulses, initial, scale
    ):
        assert (decoding, units, zidx) == (EncoderType.X_4.value, AngleUnits.TICKS.value, False)
        self._claim(self._task(handle), counter, "counter")

    def DAQmxCreateAOVoltageChan(self, handle, channel, name, low, high, units, scale):
        task = self._task(handle)
        self._claim(task, channel, "output")
        self._limit(task, channel, low, high)

    def DAQmxCreateAIVoltageChan(self, handle, channel, name, terminals, low, high, units, scale):
        task = self._task(handle)
        self._claim(task, channel, "input")
        self._limit(task, channel, low, high)

    def _limit(self, task, physical, low, high):
        if not -10.0 <= low < high <= 10.0:
            raise DriverError(INVALID_VALUE)
        for each in unflatten_channel_string(physical):
            task.channels[each.partition("/")[2]] = (low, high)

    def DAQmxCreateDOChan(self, handle, lines, name, grouping):
        self._claim(self._task(handle), lines, "line")

    def DAQmxGetChanAttribute(self, handle, channel, attribute, out):
        assert attribute == 0x2179, "only the number of lines is asked for"
        out._obj.value = len(self._task(handle).channels)

    def DAQmxSetChanAttribute(self, handle, channel, attribute, value):
        self._task(handle).attributes[attribute] = value.value

    def DAQmxStartTask(self, handle):
        task = self._task(handle)
        self._card(task)
        if self._is_taken(task):
            raise DriverError(RESERVED)
        if task.kind == "watchdog" and any(
            other.device == task.device and other.running for other in self.tasks.values()
        ):
            raise DriverError(-201477)
        task.running = True
        if task.kind == "counter":
            task.origin = self._edges(task)

    def DAQmxReadCounterScalarU32(self, handle, timeout, out, reserved):
        task = self._task(handle)
        card = self._card(task)
        if not task.running:
            task.origin = self._edges(task)  # an implicit start begins to count anew
        out._obj.value = (self._edges(task) - task.origin) % (1 << card.bits)

    def DAQmxReadAnalogF64(self, handle, samples, timeout, layout, out, size, read, reserved):
        task = self._task(handle)
        card = self._card(task)
        assert samples == 1
        assert size == len(task.channels)
        out[:] = [card.volts.get(channel, 0.0) for channel in task.channels]
        read._obj.value = 1

    def DAQmxWriteAnalogF64(
        self, handle, samples, auto_start, timeout, layout, values, written, reserved
    ):
        task = self._writable(handle, auto_start)
        assert samples == 1
        assert values.shape == (len(task.channels),)
        card, step = self.cards[task.device], 20.0 / (1 << 16)
        pairs = list(zip(task.channels.items(), values.tolist(), strict=True))
        if not all(low <= value <= high for (_, (low, high)), value in pairs):
            raise DriverError(INVALID_AO_DATA)
        for (channel, _), value in pairs:
            card.volts[channel] = min(math.floor(value / step + 0.5), (1 << 15) - 1) * step
            card.history.append((channel, value))

    def DAQmxWriteDigitalLines(
        self, handle, samples, auto_start, timeout, layout, values, written, reserved
    ):
        task = self._writable(handle, auto_start)
        assert samples == 1
        assert values.shape == (1,)
        card = self.cards[task.device]
        (line,) = task.channels
        card.levels[line] = bool(values[0])
        card.history.append((line, bool(values[0])))

    def _writable(self, handle, auto_start):
        task = self._task(handle)
        self._card(task)
        if not task.running and auto_start and self._is_taken(task):
            raise DriverError(RESERVED)
        if not task.running and not auto_start:
            raise DriverError(NOT_STARTED)
        if any(other.expired and other.device == task.device for other in self.tasks.values()):
            raise DriverError(WATCHDOG_EXPIRED)
        return task

    def DAQmxCreateWatchdogTimerTaskEx(self, device, name, out, timeout):
        if device not in self.cards:
            raise DriverError(INVALID_DEVICE)
        if not self.cards[device].watchdog:
            raise DriverError(NO_WATCHDOG)
        self._new(out, Task("watchdog", device, timeout=timeout, left=timeout))

    def DAQmxCfgWatchdogAOExpirStates(self, handle, names, states, types, size):
        every = unflatten_channel_string(names)
        assert size == len(every)
        for name, state in zip(every, states, strict=True):
            self._task(handle).expires[name.partition("/")[2]] = float(state)

    def DAQmxCfgWatchdogDOExpirStates(self, handle, names, states, size):
        self._task(handle).expires[names.partition("/")[2]] = states[0] == Level.HIGH.value

    def DAQmxControlWatchdogTask(self, handle, action):
        assert action == 0, "the timer is only ever reset"
        task = self._task(handle)
        if task.expired:
            raise DriverError(-200644)
        task.left = task.timeout


class DriverError(Exception):
    """A function failed with ``code``."""

    def __init__(self, code):
        super().__init__(code)
        self.code = code
