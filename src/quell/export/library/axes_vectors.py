"""Golden vectors of several axes, and the C program that compares the exported code with them.

As ``vectors.py`` has them for one u and one y. In the small loop each axis is a chain of
integrators with poles at its own omega_c, ``x_i^(n) = (B0 u)_i − k·x``, with the B0 before the
first sample.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.axes import Axes, hand_over_all
from quell.controllers.base import (
    change_parameters,
    reset_loop,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.compensator import samples_to_settle
from quell.controllers.several import control_all
from quell.export import axes_source
from quell.export.axes_source import AxesParts
from quell.export.c_files import CSource
from quell.export.library.vectors import (
    ABSURD,
    ABSURD_SINGLE,
    BLOCK,
    EXCESS,
    FIRST,
    INCREMENT,
    LONGEST_START,
    MULTIPLIER,
    PART,
    TOLERANCE_REASON,
    Action,
    Loop,
    Signals,
    expected_lines,
    fill,
    filled,
    places,
    plant_of,
    tolerance_of,
)
from quell.export.translate.text import Literals
from quell.kernels.dispatch import as_python
from quell.types import Vector

# Samples between the beginnings of the axes' references: they shall not move alike.
_APART = 13


class AxesRow(NamedTuple):
    """A sample: what is given to the controller, and what it returns."""

    action: Action
    r: Vector
    y: Vector
    given: Vector  # u that is applied, in some actions
    u: Vector  # zero in manual operation
    status: int


class AxesVectors(NamedTuple):
    """A run of several axes.

    Attributes
    ----------
    rows
        the samples.
    limits
        upper limits of the actuators after ``LIMIT``.
    scale
        RMS of each u.
    estimate
        all that the controller knows after the last sample, in the order of ``CSource.channels``.
    loops
        a plant for each axis and B0, for blocks in which learners take part; None without one.
    """

    rows: tuple[AxesRow, ...]
    limits: Vector
    scale: Vector
    estimate: Vector
    loops: AxesLoops | None


class AxesLoops:
    """The plants of all axes while they move."""

    def __init__(self, controller: Axes, amplitudes: Vector, dtype: Any) -> None:
        plants = [
            plant_of(axis, float(amplitude), dtype)
            for axis, amplitude in zip(controller.axes, amplitudes, strict=True)
        ]
        self.samples = max(plant.samples for plant in plants)
        plants = [plant._replace(samples=self.samples) for plant in plants]
        self.B = np.array(controller.first_gain, dtype=dtype)
        self.each = [Loop(plant, dtype, seed=i + 1) for i, plant in enumerate(plants)]
        self.dtype = dtype

    def measure(self) -> tuple[Vector, Vector]:
        """Return r and y of the next sample."""
        r, y = zip(*(loop.measure() for loop in self.each), strict=True)
        return np.array(r, dtype=self.dtype), np.array(y, dtype=self.dtype)

    def advance(self, u: Vector) -> None:
        """Move all plants by a sample."""
        for loop, row in zip(self.each, self.B, strict=True):
            v = self.dtype(0.0)
            with np.errstate(all="ignore"):
                for entry, signal in zip(row, u, strict=True):
                    v = v + entry * signal
            loop.advance(v)


class AxesPlayer:
    """The interpreted kernels of several axes, one sample after the other."""

    def __init__(self, controller: Axes, parts: AxesParts) -> None:
        self.default = self.design = self.limited = parts.parameters
        self.state, self.controller = parts.state, controller
        self.dtype: Any = parts.state.u.dtype.type
        self.counts = [samples_to_settle(axis.observer) for axis in controller.axes]
        self.rows: list[AxesRow] = []
        self.loops: AxesLoops | None = None

    def play(self, action: Action, r: Any, y: Any, given: Any = None) -> Vector:
        """Do what the C test does for this row, and add it; return u."""
        old, state, dtype = self.design, self.state, self.dtype
        r, y = (np.array(each, dtype=dtype) for each in (r, y))
        given = np.array(np.zeros(self.controller.inputs) if given is None else given, dtype=dtype)
        u = np.zeros(self.controller.inputs, dtype=dtype)
        with np.errstate(all="ignore"), as_python():
            if action is Action.APPLIED:
                axes_source.set_applied_controls(old, state, given)
            elif action is Action.HAND_OVER:
                hand_over_all(old, state)
            elif action in (Action.LIMIT, Action.FREE):
                self.design = self.limited if action is Action.LIMIT else self.default
                change_parameters(old, self.design, state)
            elif action in (Action.HELD, Action.RELEASED):
                axes_source.set_held_of_axes(old, state, 0, action is Action.HELD)
            elif action is Action.RESET:
                reset_loop(old, state)
            elif action is Action.START:
                axes_source.start_axes_from(old, state, self.counts, y, given, r)
            if action is Action.LEARN:
                self._block(u)
            elif action is Action.TRACK:
                self._set_derivatives(r)
                axes_source.track_axes(self.design, state, r, y, given, u)
                u[:] = 0.0
            else:
                self._set_derivatives(r)
                control_all(self.design, state, r, y, u)
        status = int(status_flags(self.design, state))
        self.rows.append(AxesRow(action, r, y, given, u, status))
        return u

    def _block(self, u: Vector) -> None:
        """Play a block of samples in the loop."""
        if self.loops is None:
            raise AssertionError
        for _ in range(BLOCK):
            r, y = self.loops.measure()
            self._set_derivatives(r)
            control_all(self.design, self.state, r, y, u)
            self.loops.advance(u)

    def _set_derivatives(self, r: Vector) -> None:
        """Set each derivative of the references to half the reference."""
        inner, states = self.design.axes, self.state.axes
        for i, axis in enumerate(self.controller.axes):
            if axis.derivatives:
                half = np.full(axis.derivatives, self.dtype(0.5) * r[i], dtype=self.dtype)
                set_reference_derivatives(inner.axis, states.axis, half)
            inner, states = inner.others, states.others

    def limit_at(self, high: Any) -> None:
        """Set the parameters of ``LIMIT``, with these upper limits."""
        limits = self.default.limits
        narrower = np.maximum(np.array(high, dtype=self.dtype), limits.low)
        self.limited = self.default._replace(limits=limits._replace(high=narrower))

    def estimate(self) -> Vector:
        """Return what the controller knows, in the order of ``CSource.channels``."""
        parts = [self.state.v.astype(self.dtype), [status_flags(self.design, self.state)]]
        inner, states = self.design.axes, self.state.axes
        for axis in self.controller.axes:
            row = np.zeros(sum(width for _, width in axis.channels), dtype=self.dtype)
            write_row(inner.axis, states.axis, row)
            parts.append(row)
            inner, states = inner.others, states.others
        return np.concatenate(parts)

    def u_of(self, rows: slice) -> Any:
        """Return u of some rows."""
        return np.array([row.u.astype(float) for row in self.rows[rows]])


class _AxesSignals:
    """References that move and step at different times, and measurements that follow them."""

    def __init__(self, amplitudes: Vector) -> None:
        self.each = [Signals(float(each), seed=i + 1) for i, each in enumerate(amplitudes)]
        for i, signals in enumerate(self.each):
            signals.sample = _APART * i

    def next(self) -> tuple[Vector, Vector]:
        """Return r and y of the next sample."""
        r, y = zip(*(signals.next() for signals in self.each), strict=True)
        return np.array(r), np.array(y)


def golden_vectors_of_axes(
    controller: Axes, parts: AxesParts, available: tuple[str, ...]
) -> AxesVectors:
    """Return a run with noise, missing samples, saturation, manual operation and retuning.

    Parameters
    ----------
    controller
        the axes.
    parts
        parameters and state that are exported.
    available
        names of the functions that the C code has.
    """
    player, n, m = AxesPlayer(controller, parts), controller.outputs, controller.inputs
    amplitudes = np.full(n, _amplitude(controller, parts))
    signals = _AxesSignals(amplitudes)
    missing = np.full(n, math.nan)
    for _ in range(2):  # before the first measurement
        player.play(Action.STEP, missing, missing)
    for _ in range(FIRST):
        player.play(Action.STEP, *signals.next())
    absurd = ABSURD_SINGLE if player.dtype is np.float32 else ABSURD
    for i in range(PART):  # one axis after the other
        r, y = signals.next()
        y[i % n] = (y[i % n], math.nan, y[i % n], math.inf, absurd)[i % 5]
        r[(i + 1) % n] = math.nan if i % 7 == 3 else r[(i + 1) % n]
        player.play(Action.STEP, r, y)
    for i in range(PART):
        action = Action.APPLIED if i % 5 == 0 else Action.STEP
        given = 0.5 * player.rows[-1].u
        given[i % m] = math.nan if i == PART // 2 else given[i % m]
        player.play(action, *signals.next(), given)
    u = player.u_of(slice(2, FIRST))
    player.limit_at(0.5 * (np.min(u, axis=0) + np.max(u, axis=0)))
    for action in (Action.LIMIT, Action.FREE):
        player.play(action, *signals.next())
        for _ in range(2 * PART):
            player.play(Action.STEP, *signals.next())
    at = player.rows[-1].u
    for i in range(PART):
        given = at * (1.0 - 0.02 * i)
        given[i % m] = math.nan if i == PART // 2 else given[i % m]
        player.play(Action.TRACK, *signals.next(), given)
    player.play(Action.HAND_OVER, *signals.next())
    for _ in range(PART):
        player.play(Action.STEP, *signals.next())
    if "set_held" in available:
        r, y = signals.next()
        for i in range(PART):
            player.play(Action.STEP if i else Action.HELD, r, y)
        player.play(Action.RELEASED, *signals.next())
        for _ in range(PART):
            player.play(Action.STEP, *signals.next())
    player.play(Action.RESET, *signals.next())
    for _ in range(PART):
        player.play(Action.STEP, *signals.next())
    if max(player.counts) <= LONGEST_START:
        r, y = signals.next()
        rest = np.median(player.u_of(slice(2, FIRST)), axis=0)
        player.play(Action.START, r, y, rest)
        player.play(Action.START, r, y, np.full(m, math.nan))  # changes nothing
        for _ in range(PART):
            player.play(Action.STEP, *signals.next())
    if any(axis.parameters.learns for axis in controller.axes):
        player.play(Action.RESET, *signals.next())
        player.loops = AxesLoops(controller, amplitudes, player.dtype)
        zeros = np.zeros(n)
        for _ in range(player.loops.samples // BLOCK):
            player.play(Action.LEARN, zeros, zeros)
    u = player.u_of(slice(None))
    return AxesVectors(
        tuple(player.rows),
        player.limited.limits.high,
        np.sqrt(np.mean(np.square(u), axis=0)),
        player.estimate(),
        player.loops,
    )


def _amplitude(controller: Axes, parts: AxesParts) -> float:
    """Return the amplitude of the references at which all u exceed their limits."""
    limits = parts.parameters.limits
    span = np.asarray(limits.high, dtype=float) - limits.low
    if not np.any(np.isfinite(span)):
        return 1.0
    state = axes_source.parts_of_axes(controller, parts.state.u.dtype == np.float32).state
    player = AxesPlayer(controller, AxesParts(parts.parameters, state))
    wide = limits._replace(low=np.full_like(limits.low, -np.inf),
                           high=np.full_like(limits.high, np.inf))  # fmt: skip
    player.design = player.design._replace(limits=wide)
    signals = _AxesSignals(np.ones(controller.outputs))
    for _ in range(FIRST):
        player.play(Action.STEP, *signals.next())
    moved = np.ptp(player.u_of(slice(None)), axis=0)
    usable = np.isfinite(span) & np.isfinite(moved) & (moved > 0.0)
    return float(EXCESS * np.max(span[usable] / moved[usable])) if np.any(usable) else 1.0


# ---- The C program ----

# What the program does before the step in a sample of each kind; NAME is the controller's.
_CODE_TEST_PROGRAM = {
    Action.APPLIED: ("NAME_applied(state, now->given);",),
    Action.TRACK: ("NAME_track(state, now->r, now->yFURTHER, now->given);", "return;"),
    Action.HAND_OVER: ("NAME_hand_over(state);",),
    Action.LIMIT: (
        "*limited = NAME_default_parameters;",
        "LIMITED",
        "NAME_retune(state, limited);",
    ),
    Action.FREE: ("NAME_retune(state, &NAME_default_parameters);",),
    Action.HELD: ("NAME_set_held(state, 0, true);",),
    Action.RELEASED: ("NAME_set_held(state, 0, false);",),
    Action.RESET: ("NAME_reset(state);",),
    Action.START: ("NAME_start(state, now->y, now->given, now->r);",),
    Action.LEARN: ("play_loop(state, u);", "return;"),
}

_LOOP = """
/* A loop with a small plant for each axis, in which the learners take part: a block of samples. */
static void play_loop(@NAME@_state *state, real u[ACTUATORS])
{
    static const int orders[AXES] = {@ORDERS@};
    static const real gains[AXES][@MOST@] = {@GAINS@};
    static const real B[AXES][ACTUATORS] = {@B@};
    static const real amplitude[AXES] = {@AMPLITUDE@}, noise[AXES] = {@NOISE@};
    static real x[AXES][@MOST@];
    static unsigned long seed[AXES] = {@SEEDS@};
    static int k;

    for (int n = 0; n < @BLOCK@; n++) {
        real r[AXES], y[AXES];
        int position = k % (2 * @HALF@);

        position = position < @HALF@ ? position : 2 * @HALF@ - position;
        k++;
        for (int i = 0; i < AXES; i++) {
            seed[i] = (seed[i] * @MULTIPLIER@UL + @INCREMENT@UL) & 0x7fffffffUL;
            r[i] = amplitude[i] * (real)position / (real)@HALF@;
            y[i] = x[i][0] + noise[i] * (real)((int)(seed[i] >> 15) - 32768);
        }
@DERIVATIVES@        @NAME@_step(state, r, y@FURTHER@, u);
        for (int i = 0; i < AXES; i++) {
            real v = @ZERO@, slope;

            for (int j = 0; j < ACTUATORS; j++)
                v += B[i][j] * u[j];
            slope = v;
            for (int j = 0; j < orders[i]; j++)
                slope -= gains[i][j] * x[i][j];
            for (int j = 0; j < orders[i] - 1; j++)
                x[i][j] += @DT@ * x[i][j + 1];
            x[i][orders[i] - 1] += @DT@ * slope;
        }
    }
}
"""


def test_program_of_axes(source: CSource, vectors: AxesVectors) -> str:
    """Return the text of ``test_NAME.c``."""
    single = source.precision == "single"
    literals = Literals(single)
    used = [action for action in Action if any(row.action == action for row in vectors.rows)]
    further = "".join(f", {each}" for each in source.further)
    parameters = f"{source.name}_parameters"
    limits = Action.LIMIT in used
    blocks = sum(row.action is Action.LEARN for row in vectors.rows)
    rows = (
        f"    {{{row.action.name}, {_braces(literals, row.r)}, {_braces(literals, row.y)}, "
        f"{_braces(literals, row.given)}, {_braces(literals, row.u)}, {row.status}}},"
        for row in vectors.rows
    )
    return filled("test_axes.c", {
        "name": source.name,
        "NAME": source.name.upper(),
        "precision": source.precision,
        "real": source.real,
        "epsilon": "FLT_EPSILON" if single else "DBL_EPSILON",
        "axes": len(source.axes),
        "actuators": source.actuators,
        "scale": ", ".join(repr(float(each)) for each in vectors.scale),
        "digits": 9 if single else 17,
        "zero": literals.write_real(0.0),
        "actions": ", ".join(action.name for action in used),
        "rows": "\n".join(rows),
        "expected": "\n".join(expected_lines(source, vectors.estimate)),
        "found": ",\n        ".join(f"(real)estimate.{place}" for place, *_ in places(source)),
        "cases": "\n".join(_cases(source, used, vectors, literals, further)),
        "derivatives": _halves(source, literals, "now->r", "    "),
        "further": further,
        "limited_parameter": f", {parameters} *limited" if limits else "",
        "limited_variable": f"    static {parameters} limited;\n" if limits else "",
        "limited_argument": ", &limited" if limits else "",
        "loop": _loop_code(source, vectors.loops, literals) if vectors.loops else "",
        "samples": f"count + {blocks * (BLOCK - 1)}" if blocks else "count",
        "tolerance": repr(tolerance_of(vectors.loops is not None)),
        "tolerance_reason": TOLERANCE_REASON.replace("\n", "\n * "),
    })  # fmt: skip


def _braces(literals: Literals, values: Any) -> str:
    return "{" + ", ".join(map(literals.write_real, values)) + "}"


def _halves(source: CSource, literals: Literals, r: str, pad: str) -> str:
    """Return the lines that set each derivative of the references to half of them."""
    if not source.further:
        return ""
    names = ", ".join(f"{each}[AXES]" for each in source.further)
    sets = " = ".join(f"{each}[i]" for each in source.further)
    return (
        f"{pad}real {names};\n\n{pad}for (int i = 0; i < AXES; i++)\n"
        f"{pad}    {sets} = {literals.write_real(0.5)} * {r}[i];\n"
    )


def _cases(
    source: CSource,
    used: list[Action],
    vectors: AxesVectors,
    literals: Literals,
    further: str,
) -> Iterator[str]:
    limited = (
        f"limited->limits.high[{k}] = {literals.write_real(high)};"
        for k, high in enumerate(vectors.limits)
    )
    for action in used:
        lines = _CODE_TEST_PROGRAM.get(action, ())
        if not lines:
            continue
        yield f"    case {action.name}:"
        for line in lines:
            for each in limited if line == "LIMITED" else (line,):
                yield f"        {each.replace('NAME', source.name).replace('FURTHER', further)}"
        if lines[-1] != "return;":
            yield "        break;"


def _loop_code(source: CSource, loops: AxesLoops, literals: Literals) -> str:
    plants = [loop.plant for loop in loops.each]
    most = max(len(plant.gains) for plant in plants)
    padded = ([*plant.gains, *[0.0] * (most - len(plant.gains))] for plant in plants)
    return fill(_LOOP, {
        "NAME": source.name,
        "ORDERS": ", ".join(str(len(plant.gains)) for plant in plants),
        "MOST": most,
        "GAINS": ", ".join(_braces(literals, each) for each in padded),
        "B": ", ".join(_braces(literals, row) for row in loops.B),
        "AMPLITUDE": ", ".join(literals.write_real(plant.amplitude) for plant in plants),
        "NOISE": ", ".join(literals.write_real(plant.noise) for plant in plants),
        "SEEDS": ", ".join(str(i + 1) for i in range(len(plants))),
        "BLOCK": BLOCK,
        "HALF": loops.samples // 4,
        "MULTIPLIER": MULTIPLIER,
        "INCREMENT": INCREMENT,
        "DERIVATIVES": _halves(source, literals, "r", "        "),
        "FURTHER": "".join(f", {each}" for each in source.further),
        "ZERO": literals.write_real(0.0),
        "DT": literals.write_real(plants[0].dt),
    })  # fmt: skip
