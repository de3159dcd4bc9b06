"""Tasks of the driver NI-DAQmx: a counter, an analog output, digital lines and a watchdog.

All values are read and written on demand. Each output is set to zero when it is opened and when the
tasks are closed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from quell.realtime.devices.ni.driver import driver, translated_errors

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
