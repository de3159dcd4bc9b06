"""Loops and controllers of the corpus: simulated, driven sample by sample, and as C.

A case of ``loops`` has a plant, a controller and a scenario, which are simulated by the interpreted
kernels. One of ``driven`` has a controller that is given a sequence of references and measurements,
with NaN among them, and is told of other events: another u was applied, manual operation, a start,
new limits. The exported C code of a driven case gets the same and gives the same bits.
"""

from __future__ import annotations

import ctypes
import itertools
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import quell as ql
from quell.controllers.base import reset_loop, status_flags, write_row
from quell.controllers.single import in_single_precision
from quell.export import CSource, c_source
from tests.in_c import InC

from .corpus import cases_of, differences, made, numbers_at, outcome_of, with_rounded_design

COMPILED_POINTS = 20

# ---- Simulated loops ----


def controller_of(case: Mapping[str, Any]) -> Any:
    """Return the controller of a case."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        controller = with_rounded_design(made(case["controller"]))
    if case.get("precision") == "single":
        return with_rounded_design(in_single_precision(controller))
    return controller


def simulated(case: Mapping[str, Any], interpret: bool = True) -> Any:
    """Return the run of a case."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plant = with_rounded_design(made(case["plant"]))
        return ql.simulate(plant, controller_of(case), made(case["scenario"]), interpret=interpret)


def channels_of(run: Any) -> dict[str, Any]:
    """Return the channels of a record by name."""
    found, at = {}, 0
    for name, width in run.channels:
        found[name] = run.log[:, at : at + width]
        at += width
    return found


def simulate_case(case: Mapping[str, Any]) -> dict[str, Any]:
    """Return the outcome of a loop."""
    run = simulated(case)
    return outcome_of(channels_of(run), int(run.status), "why" in case)


def compile_case(case: Mapping[str, Any]) -> dict[str, Any]:
    """Return some numbers of the compiled run of a loop."""
    run = simulated(case, interpret=False)
    names = [name for name, _ in run.channels if name.rpartition(".")[2] in _COMPARED]
    numbers = numbers_at(channels_of(run), COMPILED_POINTS, names)
    return {"samples": len(run.log), "status": int(run.status), "numbers": numbers}


def loop_named(name: str) -> Mapping[str, Any]:
    """Return the case of ``loops`` with this name."""
    return next(case for case in cases_of("loops") if case["name"] == name)


_COMPARED = ("y", "u", "v", "x_hat", "f_learned", "authority")


def compiled_differences(stored: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return what two outcomes of compiled runs do not have in common."""
    return differences(stored, now, "compiled code rounds otherwise")


# ---- Driven controllers ----


def inputs(samples: int, width: int, seed: int, scale: float = 1.0) -> np.ndarray:
    """Return sequences without any library: a triangle and noise (samples, width)."""
    values, state = np.zeros((samples, width)), 7919 * seed + 1
    for k in range(samples):
        for i in range(width):
            state = (state * 1103515245 + 12345) & 0x7FFFFFFF
            position = (k * (i + 2) + 29 * seed) % 120
            triangle = (position if position < 60 else 120 - position) / 60.0 - 0.5
            values[k, i] = scale * (triangle + 0.02 * ((state >> 15) / 32768.0 - 0.5))
    return values


def sequences(case: Mapping[str, Any], controller: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return references and measurements of a driven case, some of which are NaN.

    Between the pairs of samples in ``still`` the measurements stay, as those of a held plant.
    """
    samples, seed, scale = case["samples"], case["seed"], case.get("scale", 1.0)
    widths = getattr(controller, "references", 1), getattr(controller, "outputs", 1)
    r, y = (inputs(samples, n, seed + i, scale) for i, n in enumerate(widths))
    for first, last in case.get("still", ()):
        y[first:last] = y[first]
    for k in range(samples):
        if k % 31 == 7:
            r[k, k % widths[0]] = np.nan
        if k % 23 == 5:
            y[k, k % widths[1]] = np.nan
    return r, y


def events_of(case: Mapping[str, Any]) -> dict[int, list[tuple[str, Any]]]:
    """Return what happens before each sample: name and argument."""
    found: dict[int, list[tuple[str, Any]]] = {}
    for k, name, value in case.get("events", ()):
        found.setdefault(k, []).append((name, value))
    return found


class Driven:
    """A controller in Python that is driven; ``step`` returns u as an array."""

    def __init__(self, case: Mapping[str, Any]) -> None:
        self.controller = controller_of(case)
        self.several = hasattr(self.controller, "inputs")
        self.u = np.zeros(getattr(self.controller, "inputs", 1))
        self.channels = self.controller.channels
        self.row = np.zeros(sum(width for _, width in self.channels))

    def _argument(self, values: Any) -> Any:
        return np.array(values) if self.several else float(values[0])

    def step(self, r: Any, y: Any) -> None:
        """Take a sample."""
        self.u = np.atleast_1d(self.controller.step(self._argument(r), self._argument(y)))

    def track(self, r: Any, y: Any, u: Any) -> None:
        """Take a sample in manual operation."""
        self.controller.track(*(self._argument(each) for each in (r, y, u)))
        self.u = np.array(u)

    def happen(self, name: str, value: Any, y: Any) -> None:
        """Do what happens before a sample."""
        this = self.controller
        if name == "applied":
            this.applied(self._argument(value * self.u))
        elif name == "start":
            this.start(self._argument(np.nan_to_num(y)), self._argument(0.3 * self.u))
        elif name == "held":
            this.set_held(value)
        elif name == "signals":
            this.set_signals(*value)
        elif name == "limits":
            this.set_limits(**made(value))
        elif name == "retune":
            this.retune(**made(value))
        elif name == "memory":
            this.restore(this.memory(), running=value)
        elif name == "reset":  # what was learned is kept, as in C
            reset_loop(this.parameters, this._state)
        elif name == "forget":
            this.reset()
        else:
            getattr(this, name)()

    def known(self) -> np.ndarray:
        """Return what the controller writes into a record."""
        write_row(self.controller.parameters, self.controller._state, self.row)
        return self.row

    def status(self) -> int:
        """Return the flags of the last sample."""
        return int(status_flags(self.controller.parameters, self.controller._state))


def drive(case: Mapping[str, Any], driven: Any) -> dict[str, Any]:
    """Return the outcome of a driven controller, in Python or in C."""
    r, y = sequences(case, driven.controller)
    events, manual = events_of(case), False
    u, known, flags = [], [], 0
    with np.errstate(all="ignore"):
        for k in range(len(r)):
            for name, value in events.get(k, ()):
                manual = (manual or name == "manual") and name != "hand_over"
                if name != "manual":
                    driven.happen(name, value, y[k])
            if manual:
                driven.track(r[k], y[k], 0.1 * np.cos(np.arange(len(driven.u)) + 0.0))
            else:
                driven.step(r[k], y[k])
            u.append(np.array(driven.u, dtype=float))
            known.append(np.array(driven.known(), dtype=float))
            flags |= driven.status()
    rows, at, log = np.array(known), 0, {"u": np.array(u)}
    for name, width in driven.channels:
        log[name] = rows[:, at : at + width]
        at += width
    return outcome_of(log, flags, "why" in case)


def drive_case(case: Mapping[str, Any]) -> dict[str, Any]:
    """Return the outcome of a driven case by the interpreted kernels."""
    return drive(case, Driven(case))


# ---- The same in C ----

_numbers = itertools.count()


def _row_code(source: CSource) -> str:
    """Return a C function that writes the channels of the estimate into an array."""
    lines, at = [], 0
    for name, width in source.channels:
        for i in range(width):
            index = f"[{i}]" if width > 1 else ""
            lines.append(f"    row[{at}] = (double)estimate.{name}{index};")
            at += 1
    n = source.name
    return (
        f"\nvoid {n}_row(const {n}_state *state, double *row);\n"
        f"void {n}_row(const {n}_state *state, double *row)\n{{\n"
        f"    const {n}_estimate estimate = {n}_get_estimate(state);\n" + "\n".join(lines) + "\n}\n"
    )


class DrivenInC:
    """The exported controller of a driven case."""

    def __init__(self, case: Mapping[str, Any], folder: Path) -> None:
        self.controller = controller_of(case)
        source = c_source(self.controller, "servo")
        self.channels = source.channels
        self.program = InC(source, folder, _row_code(source))
        self.several = hasattr(self.controller, "inputs")
        self.u = np.zeros(getattr(self.controller, "inputs", 1))
        self.row = np.zeros(sum(width for _, width in self.channels))
        self.derivatives = source.derivatives
        self.real = np.float32 if source.precision == "single" else np.float64

    def _call(self, name: str, result: Any, *arguments: Any) -> Any:
        function = getattr(self.program.library, f"servo_{name}")
        function.restype = result
        kept = [
            np.ascontiguousarray(each, dtype=self.real) if isinstance(each, np.ndarray) else each
            for each in arguments
        ]
        given = [
            each.ctypes.data_as(ctypes.c_void_p) if isinstance(each, np.ndarray) else each
            for each in kept
        ]
        value = function(self.program.state, *given)
        return value, kept

    def _signals(self, *values: Any) -> list[Any]:
        return [np.array(v) if self.several else self.program.real(float(v[0])) for v in values]

    def _zeros(self) -> list[Any]:
        zeros = np.zeros(getattr(self.controller, "outputs", 1))
        return self._signals(*[zeros] * self.derivatives)

    def step(self, r: Any, y: Any) -> None:
        """Take a sample."""
        if self.several:
            u = np.zeros(self.u.size)
            _, kept = self._call("step", None, *self._signals(r, y), *self._zeros(), u)
            self.u = kept[-1]
        else:
            value, _ = self._call("step", self.program.real, *self._signals(r, y), *self._zeros())
            self.u = np.array([value])

    def track(self, r: Any, y: Any, u: Any) -> None:
        """Take a sample in manual operation."""
        result = None if self.several else self.program.real
        self._call("track", result, *self._signals(r, y, u), *self._zeros())
        self.u = np.array(u)

    def happen(self, name: str, value: Any, y: Any) -> None:
        """Do what happens before a sample."""
        if name == "applied":
            self._call("applied", None, *self._signals(value * self.u))
        elif name == "start":
            rest = np.nan_to_num(y)
            self._call("start", None, *self._signals(rest, 0.3 * self.u, rest))
        elif name == "held":
            self._call("set_held", None, ctypes.c_bool(value))
        else:
            self._call(name, ctypes.c_bool if name == "hand_over" else None)

    def known(self) -> np.ndarray:
        """Return the channels of the estimate."""
        row = np.zeros(len(self.row))
        function = self.program.library.servo_row
        function.restype = None
        function(self.program.state, row.ctypes.data_as(ctypes.c_void_p))
        return row

    def status(self) -> int:
        """Return the flags of the last sample."""
        return int(self._call("status", ctypes.c_int)[0])


def drive_in_c(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the outcome of a driven case by its exported C code."""
    return drive(case, DrivenInC(case, folder))
