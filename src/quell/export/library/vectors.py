"""Golden vectors: a run of the interpreted kernels, which the exported controller must repeat.

A small loop in which learners take part: the same in Python and in the C test.

The plant of each axis is a chain of integrators with poles at its own omega_c,
``x_i^(n) = (B0 u)_i − k·x`` with the B0 before the first sample, integrated by Euler's method. A
controller of one u and y is an axis whose B0 is b0. All numbers have the precision of the
controller, and the order of operations is that of the C program.
"""

from __future__ import annotations

import math
import re
import struct
import textwrap
from collections.abc import Callable, Iterator, Mapping
from enum import IntEnum
from importlib import resources
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from quell.controllers import memory
from quell.controllers.base import (
    change_parameters,
    reset_loop,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.bumpless import samples_to_settle
from quell.export.c_files import CSource
from quell.export.controller_source import Parts, at_path, limits_path, parts_of
from quell.export.translate.text import Literals
from quell.kernels.dispatch import as_python
from quell.types import Vector

# ---- The texts of the files around a controller, from templates with @names@ to fill in ----


def filled(name: str, values: Mapping[str, object]) -> str:
    """Return a template of the folder ``templates`` with its ``@names@`` replaced."""
    return fill((resources.files(__package__) / "templates" / name).read_text("utf-8"), values)


def fill(text: str, values: Mapping[str, object]) -> str:
    """Return a text with its ``@names@`` replaced."""
    return re.sub(r"@(\w+)@", lambda found: str(values[found[1]]), text)


# ---- A small loop in which learners take part ----

BLOCK = 50
"""Samples of a row: u is compared after the last."""
# Learners wait for two lag times. The kernels are interpreted: some 0.2 ms a sample.
_LAGS, _LEAST, _MOST = 6.0, 600, 2000
MULTIPLIER, INCREMENT = 1103515245, 12345  # of C's own example of rand()


class Plant(NamedTuple):
    """The plant of an axis, or of a controller of one u, and its signals."""

    gains: tuple[Any, ...]
    dt: Any
    amplitude: Any  # of the reference
    noise: Any  # factor of the random integers
    samples: int


def plant_of(inner: Any, amplitude: float, real: Callable[[Any], Any]) -> Plant:
    """Return the plant for an ADRC or a compensator."""
    observer, law = inner.observer, inner.gains
    count = round(_LAGS * observer.lag_time / observer.dt / BLOCK) * BLOCK
    return Plant(
        tuple(real(gain) for gain in law),
        real(observer.dt),
        real(amplitude),
        real(amplitude / 2.0**27),  # uniform within 2.4e-4 of the amplitude
        min(max(count, _LEAST), _MOST),
    )


class Loop:
    """A plant while it moves."""

    def __init__(self, plant: Plant, real: Callable[[Any], Any], seed: int) -> None:
        self.plant, self.real = plant, real
        self.x = [real(0.0)] * len(plant.gains)
        self.seed, self.sample = seed, 0

    def measure(self) -> tuple[Any, Any]:
        """Return r and y of the next sample."""
        plant, real, half = self.plant, self.real, self.plant.samples // 4
        self.seed = (self.seed * MULTIPLIER + INCREMENT) & 0x7FFFFFFF
        position = self.sample % (2 * half)
        position = position if position < half else 2 * half - position
        r = plant.amplitude * real(position) / real(half)
        self.sample += 1
        return r, self.x[0] + plant.noise * real((self.seed >> 15) - 32768)

    def advance(self, v: Any) -> None:
        """Move the plant by a sample."""
        plant, x, slope = self.plant, self.x, v
        with np.errstate(all="ignore"):
            for gain, value in zip(plant.gains, x, strict=True):
                slope = slope - gain * value
            for i in range(len(x) - 1):
                x[i] = x[i] + plant.dt * x[i + 1]
            x[-1] = x[-1] + plant.dt * slope


class Loops:
    """The plants of all axes while they move, or that of a controller of one u."""

    def __init__(self, parts: Parts, amplitude: float, dtype: Any) -> None:
        plants = [plant_of(each, amplitude, dtype) for each in parts.compensating]
        self.samples = max(plant.samples for plant in plants)
        plants = [plant._replace(samples=self.samples) for plant in plants]
        gain = [[parts.compensating[0].observer.b0]]
        self.B = np.array(gain if parts.sizes is None else parts.controller.first_gain, dtype=dtype)
        self.each = [Loop(plant, dtype, seed=i + 1) for i, plant in enumerate(plants)]
        self.references = len(plants) if parts.sizes is None else parts.sizes[0]
        self.dtype = dtype

    def measure(self) -> tuple[Vector, Vector]:
        """Return r and y of the next sample."""
        r, y = zip(*(loop.measure() for loop in self.each), strict=True)
        more = (0.0,) * (self.references - len(r))  # u_0 of more actuators than axes
        return np.array(r + more, dtype=self.dtype), np.array(y, dtype=self.dtype)

    def advance(self, u: Vector) -> None:
        """Move all plants by a sample."""
        for loop, row in zip(self.each, self.B, strict=True):
            v = self.dtype(0.0)
            with np.errstate(all="ignore"):
                for entry, signal in zip(row, u, strict=True):
                    v = v + entry * signal
            loop.advance(v)


_LOOP = """
/* A loop with a small plant for each y, in which the learners take part: a block of samples. */
static void play_loop(@NAME@_state *state, real u[ACTUATORS])
{
    static const int orders[MEASUREMENTS] = {@ORDERS@};
    static const real gains[MEASUREMENTS][@MOST@] = {@GAINS@};
    static const real B[MEASUREMENTS][ACTUATORS] = {@B@};
    static const real amplitude[MEASUREMENTS] = {@AMPLITUDE@}, noise[MEASUREMENTS] = {@NOISE@};
    static real x[MEASUREMENTS][@MOST@];
    static unsigned long seed[MEASUREMENTS] = {@SEEDS@};
    static int k;

    for (int n = 0; n < @BLOCK@; n++) {
        real r[REFERENCES] = {@ZERO@}, y[MEASUREMENTS];
        int position = k % (2 * @HALF@);

        position = position < @HALF@ ? position : 2 * @HALF@ - position;
        k++;
        for (int i = 0; i < MEASUREMENTS; i++) {
            seed[i] = (seed[i] * @MULTIPLIER@UL + @INCREMENT@UL) & 0x7fffffffUL;
            r[i] = amplitude[i] * (real)position / (real)@HALF@;
            y[i] = x[i][0] + noise[i] * (real)((int)(seed[i] >> 15) - 32768);
        }
@HALVES@        @STEP@;
        for (int i = 0; i < MEASUREMENTS; i++) {
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


def loop_code(source: CSource, loops: Loops) -> str:
    """Return the same loop in C, as a function that plays a block of samples."""
    write = Literals(source.precision == "single").write_real
    plants = [loop.plant for loop in loops.each]
    most = max(len(plant.gains) for plant in plants)
    padded = ([*plant.gains, *[0.0] * (most - len(plant.gains))] for plant in plants)
    return fill(_LOOP, {
        "NAME": source.name,
        "ORDERS": ", ".join(str(len(plant.gains)) for plant in plants),
        "MOST": most,
        "GAINS": ", ".join(_braces(write, each) for each in padded),
        "B": ", ".join(_braces(write, row) for row in loops.B),
        "AMPLITUDE": ", ".join(write(plant.amplitude) for plant in plants),
        "NOISE": ", ".join(write(plant.noise) for plant in plants),
        "SEEDS": ", ".join(str(i + 1) for i in range(len(plants))),
        "BLOCK": BLOCK,
        "HALF": loops.samples // 4,
        "MULTIPLIER": MULTIPLIER,
        "INCREMENT": INCREMENT,
        "HALVES": _halves(source, "r", "        "),
        "STEP": _step(source, "r", "y"),
        "ZERO": write(0.0),
        "DT": write(plants[0].dt),
    })  # fmt: skip


# ---- Golden vectors ----

# Samples of each part of the run: enough for observers to settle in, few enough that the file is
# read by people and fits into a small flash memory (in single precision 20 bytes each).
FIRST, PART = 60, 20
# Samples before the memory image that is compared: all is in motion, and y was missing in the last.
SAVED = 74
# A start under load takes twice the samples in which the observer settles; longer ones are left
# out, because the kernels are interpreted here (20 us a sample).
LONGEST_START = 4000
# A measurement beyond all physical quantities, by precision.
ABSURD, ABSURD_SINGLE = 1e80, 1e30
# Samples between the beginnings of references: they shall not move alike.
_APART = 13
# How far u goes beyond its limits, relative to their distance.
EXCESS = 1.5


class Action(IntEnum):
    """Events in a sample of the run; in the C test the names are those of an enum."""

    STEP = 0
    APPLIED = 1  # another u was applied than the last step returned
    TRACK = 2  # manual operation
    HAND_OVER = 3  # back from it
    LIMIT = 4  # other parameters, with a lower limit of u
    FREE = 5  # the default parameters again
    RESET = 6
    START = 7  # under load
    LEARN = 8  # a block of samples in a small loop
    HELD = 9  # the plant is held
    RELEASED = 10


class Row(NamedTuple):
    """A sample: what is given to the controller, and what it returns."""

    action: Action
    r: Vector
    y: Vector
    given: Vector  # u that is applied, in some actions
    u: Vector
    status: int


class Vectors(NamedTuple):
    """A run.

    Attributes
    ----------
    rows
        the samples.
    limit_path, limit
        field of the parameters with the upper limits of u, and their values after ``LIMIT``.
    scale
        RMS of each u.
    estimate
        all that the controller knows after the last sample, in the order of ``CSource.channels``.
    loops
        plants of the blocks in which learners take part, if there is a learner.
    images
        memory images after ``SAVED`` samples: running, and at rest as a start leaves it.
    parts
        number and largest size of the entries of each array in an image.
    fresh
        the last 8 bytes of an image before the first sample, its check.
    """

    rows: tuple[Row, ...]
    limit_path: str
    limit: Vector
    scale: Vector
    estimate: Vector
    loops: Loops | None
    images: tuple[bytes, bytes]
    parts: list[tuple[int, float]]
    fresh: bytes


class Player:
    """The interpreted kernels of a controller, one sample after the other.

    Signals are arrays; a controller of one u and y is handed their only number.
    """

    def __init__(self, controller: Any, precision: str = "double") -> None:
        self.parts = parts_of(controller, precision)
        self.default = self.design = self.limited = self.parts.parameters
        self.state, self.one = self.parts.state, self.parts.sizes is None
        self.sizes = self.parts.sizes or (1, 1, 1)
        self.dtype: Any = np.float32 if self.parts.single else np.float64
        self.rows: list[Row] = []
        self.loops: Loops | None = None

    def play(self, action: Action, r: Any, y: Any, given: Any = 0.0) -> Vector:
        """Do what the C test does for this row, and add it; return u."""
        old, state, kernels = self.design, self.state, self.parts.kernels
        r, y, given = (
            np.full(size, each, dtype=self.dtype)
            for size, each in zip(self.sizes, (r, y, given), strict=True)
        )
        u = np.zeros(self.sizes[2], dtype=self.dtype)
        r_, y_, given_ = map(self._argument, (r, y, given))
        with np.errstate(all="ignore"), as_python():
            if action is Action.APPLIED:
                kernels.applied(old, state, given_)
            elif action is Action.HAND_OVER:
                kernels.hand_over(old, state)
            elif action in (Action.LIMIT, Action.FREE):
                self.design = self.limited if action is Action.LIMIT else self.default
                change_parameters(old, self.design, state)
            elif action in (Action.HELD, Action.RELEASED):
                kernels.set_held(old, state, *(() if self.one else (0,)), action is Action.HELD)
            elif action is Action.RESET:
                reset_loop(old, state)
            elif action is Action.START:
                samples = self.settling
                kernels.start(old, state, samples[0] if self.one else samples, y_, given_, r_)
            if action is Action.LEARN:
                assert self.loops is not None
                for _ in range(BLOCK):
                    self._step(*self.loops.measure(), u)
                    self.loops.advance(u)
            elif action is Action.TRACK:
                self._set_derivatives(r)
                returned = kernels.track(self.design, state, r_, y_, given_)
                u[:] = returned if self.one else 0.0
            else:
                self._step(r, y, u)
        status = int(status_flags(self.design, state))
        self.rows.append(Row(action, r, y, given, u, status))
        return u

    @property
    def settling(self) -> list[int]:
        """Samples that each observer takes to settle at a start."""
        return [samples_to_settle(each.observer) for each in self.parts.compensating]

    def _argument(self, signals: Vector) -> Any:
        """Return signals as a kernel takes them."""
        if not self.one:
            return signals
        return signals[0] if self.dtype is np.float32 else float(signals[0])

    def _step(self, r: Vector, y: Vector, u: Vector) -> None:
        """Take a sample, and write u."""
        self._set_derivatives(r)
        given = (self.design, self.state, self._argument(r), self._argument(y))
        if self.one:
            u[0] = self.parts.kernels.step(*given)
        else:
            self.parts.kernels.step(*given, u)

    def _set_derivatives(self, r: Vector) -> None:
        """Set each derivative of the references, and each signal, to half the reference."""
        if any(self.parts.counts):
            halves = np.repeat(self.dtype(0.5) * r, self.parts.counts)
            set_reference_derivatives(self.design, self.state, halves)

    def limit_at(self, path: str, high: Any) -> None:
        """Set the parameters of ``LIMIT``: the upper limits at ``path`` are ``high``."""
        limits = at_path(self.default, path)
        high = np.maximum(np.full(self.sizes[2], high, dtype=self.dtype), limits.low)
        limits = limits._replace(high=self._argument(high))
        self.limited = _with_limits(self.default, path, limits)

    def u_of(self, rows: slice) -> Any:
        """Return all u of some rows, an array (rows, m)."""
        return np.array([row.u.astype(float) for row in self.rows[rows]])


def golden_vectors(controller: Any, source: CSource) -> Vectors:
    """Return a run with noise, missing samples, saturation, manual operation and retuning.

    Parameters
    ----------
    controller
        the controller.
    source
        its C code: its precision, and the functions that it has.

    Notes
    -----
    The measurement follows the reference as a plant under control would, whatever u is: the run
    needs no plant. It is so large that u exceeds its limits, if there are any, and 1 otherwise.
    """
    player, path = Player(controller, source.precision), limits_path(controller)
    available, (_, p, m) = source.operations, player.sizes
    fresh = memory.written_image(_layout(player))[-memory.CHECK.size :]
    amplitude = _amplitude(controller, source.precision, path)
    signals = _AllSignals(player, amplitude)
    for _ in range(2):  # before the first measurement
        player.play(Action.STEP, math.nan, math.nan)
    for _ in range(FIRST):
        player.play(Action.STEP, *signals.next())
    absurd = ABSURD_SINGLE if player.dtype is np.float32 else ABSURD
    for i in range(PART):  # one signal after the other
        r, y = signals.next()
        y[i % p] = (y[i % p], math.nan, y[i % p], math.inf, absurd)[i % 5]
        at = (i + 1) % r.size
        r[at] = math.nan if i % 7 == 3 else r[at]
        player.play(Action.STEP, r, y)
        if len(player.rows) == SAVED:
            images, parts = _images(player)
    for i in range(PART):
        action = Action.APPLIED if i % 5 == 0 else Action.STEP
        given = 0.5 * player.rows[-1].u.astype(float)
        given[i % m] = math.nan if i == PART // 2 else given[i % m]
        player.play(action, *signals.next(), given)
    if path:
        _play_limited(player, path, signals)
    if "track" in available:
        _play_manual(player, signals)
    if "set_held" in available:
        _play_held(player, signals)
    player.play(Action.RESET, *signals.next())
    for _ in range(PART):
        player.play(Action.STEP, *signals.next())
    if "start" in available and max(player.settling, default=0) <= LONGEST_START:
        r, y = signals.next()
        player.play(Action.START, r, y, np.median(player.u_of(slice(2, FIRST)), axis=0))
        player.play(Action.START, r, y, math.nan)  # changes nothing
        for _ in range(PART):
            player.play(Action.STEP, *signals.next())
    if any(each.parameters.learns for each in player.parts.compensating):
        player.play(Action.RESET, *signals.next())
        player.loops = Loops(player.parts, amplitude, player.dtype)
        for _ in range(player.loops.samples // BLOCK):
            player.play(Action.LEARN, 0.0, 0.0)
    scale = [
        math.sqrt(np.mean(np.square(each[np.isfinite(each)])))
        for each in player.u_of(slice(None)).T
    ]
    limit = np.atleast_1d(at_path(player.limited, path).high) if path else np.zeros(0)
    widths = (width for _, width in player.parts.controller.channels)
    row = np.zeros(sum(widths), dtype=player.dtype)
    write_row(player.design, player.state, row)
    sizes = np.array(scale)
    played = tuple(player.rows), path, limit, sizes, row, player.loops
    return Vectors(*played, images, parts, fresh)


def _layout(player: Player) -> memory.Layout:
    controller = player.parts.controller
    return memory.images_of(
        player.design, player.state, controller.dt, getattr(controller, "names", ())
    )


def _images(player: Player) -> tuple[tuple[bytes, bytes], list[tuple[int, float]]]:
    """Return the images of a player's state, and numbers and sizes of their parts."""
    state, known = player.state, _layout(player)
    running = memory.written_image(known)
    parts = [(each.size, float(np.max(np.abs(each[np.isfinite(each)]), initial=0.0)))
             for each in known.arrays.values() if each.size]  # fmt: skip
    kept = {name: array.copy() for name, array in memory.named_arrays(state).items()}
    memory.start_from_rest(player.design, state)
    at_rest = memory.written_image(known)
    for name, array in memory.named_arrays(state).items():
        array[...] = kept[name]
    return (running, at_rest), parts


def _play_limited(player: Player, path: str, signals: _AllSignals) -> None:
    """Set the upper limit into the middle of the range that u had so far, and back."""
    u = player.u_of(slice(2, FIRST))
    limits = at_path(player.default, path)
    high = 0.5 * (np.min(u, axis=0) + np.max(u, axis=0))
    player.limit_at(path, np.where(np.isfinite(high), high, limits.high))
    for action in (Action.LIMIT, Action.FREE):
        player.play(action, *signals.next())
        for _ in range(2 * PART):
            player.play(Action.STEP, *signals.next())


def _play_manual(player: Player, signals: _AllSignals) -> None:
    u = player.rows[-1].u.astype(float)
    for i in range(PART):
        given = u * (1.0 - 0.02 * i)
        given[i % u.size] = math.nan if i == PART // 2 else given[i % u.size]
        player.play(Action.TRACK, *signals.next(), given)
    player.play(Action.HAND_OVER, *signals.next())
    for _ in range(PART):
        player.play(Action.STEP, *signals.next())


def _play_held(player: Player, signals: _AllSignals) -> None:
    r, y = signals.next()
    for i in range(PART):
        player.play(Action.STEP if i else Action.HELD, r, y)
    player.play(Action.RELEASED, *signals.next())
    for _ in range(PART):
        player.play(Action.STEP, *signals.next())


class Signals:
    """A reference that moves and steps, and a measurement that follows it with noise."""

    def __init__(self, amplitude: float, seed: int, sample: int) -> None:
        self.amplitude, self.sample, self.y = amplitude, sample, 0.0
        self.random = np.random.default_rng(seed)  # a fixed one: the same file each time

    def next(self) -> tuple[float, float]:
        """Return r and y of the next sample."""
        k = self.sample
        r = self.amplitude * (math.sin(0.1 * k) + (1.0 if k % 50 >= 25 else 0.0))
        self.y += 0.1 * (r - self.y)
        self.sample += 1
        return r, self.y + 1e-3 * self.amplitude * float(self.random.standard_normal())


class _AllSignals:
    """References that move and step at different times, and measurements that follow them."""

    def __init__(self, player: Player, amplitude: float) -> None:
        self.count, p, _ = player.sizes
        self.each = [Signals(amplitude, i + 1, _APART * i) for i in range(max(self.count, p))]
        self.measured = p

    def next(self) -> tuple[Vector, Vector]:
        """Return r and y of the next sample."""
        r, y = zip(*(signals.next() for signals in self.each), strict=True)
        return np.array(r[: self.count]), np.array(y[: self.measured])


def _with_limits(design: Any, path: str, limits: Any) -> Any:
    name, _, rest = path.partition(".")
    inner = _with_limits(getattr(design, name), rest, limits) if rest else limits
    return design._replace(**{name: inner})


def _amplitude(controller: Any, precision: str, path: str) -> float:
    """Return the amplitude of the references at which all u exceed their limits."""
    player = Player(controller, precision)
    if not path:
        return 1.0
    limits, m = at_path(player.default, path), player.sizes[2]
    span = np.atleast_1d(np.asarray(limits.high, dtype=float) - limits.low)
    if not np.any(np.isfinite(span)):
        return 1.0
    low, high = (np.full(m, each, dtype=player.dtype) for each in (-np.inf, np.inf))
    free = limits._replace(low=player._argument(low), high=player._argument(high))
    player.design = _with_limits(player.default, path, free)
    signals = _AllSignals(player, 1.0)
    for _ in range(FIRST):
        player.play(Action.STEP, *signals.next())
    moved = np.ptp(player.u_of(slice(None)), axis=0)
    usable = np.isfinite(span) & np.isfinite(moved) & (moved > 0.0)
    return float(np.max(EXCESS * span[usable] / moved[usable])) if np.any(usable) else 1.0


# ---- The C program that compares a controller with golden vectors ----

# The largest differences of 16 controllers on emulated Cortex-M processors with newlib and FMA were
# 25 ulp without a learner that acts, and 1930 ulp with one, whose loop enlarges them.
_TOLERANCE, _TOLERANCE_LEARNING = 64.0, 4096.0
TOLERANCE_REASON = """With -ffp-contract=off the difference is
zero, but for functions such as sin that differ between C libraries; with FMA it is some ulps,
and more where a learner acts in a loop."""

# What the program does before the step in a sample of each kind.
_CODE_TEST_PROGRAM = {
    Action.APPLIED: ("@NAME@_applied(state, @GIVEN@);",),
    Action.TRACK: ("@TRACKED@@NAME@_track(state, @R@, @Y@, @GIVEN@@LAST@);", "return;"),
    Action.HAND_OVER: ("@NAME@_hand_over(state);",),
    Action.LIMIT: (
        "*limited = @NAME@_default_parameters;",
        "LIMITED",
        "@NAME@_retune(state, limited);",
    ),
    Action.FREE: ("@NAME@_retune(state, &@NAME@_default_parameters);",),
    Action.HELD: ("@NAME@_set_held(state, @PLACE@true);",),
    Action.RELEASED: ("@NAME@_set_held(state, @PLACE@false);",),
    Action.RESET: ("@NAME@_reset(state);",),
    Action.START: ("@NAME@_start(state, @Y@, @GIVEN@, @R@);",),
    Action.LEARN: ("play_loop(state, u);", "return;"),
}


def tolerance_of(learns: bool) -> float:
    """Return the largest difference on other machines [ulp]."""
    return _TOLERANCE_LEARNING if learns else _TOLERANCE


def test_program(source: CSource, vectors: Vectors) -> str:
    """Return the text of ``test_NAME.c``."""
    single = source.precision == "single"
    write = Literals(single).write_real
    used = [action for action in Action if any(row.action == action for row in vectors.rows)]
    limits = Action.LIMIT in used
    rows = (
        f"    {{{row.action.name}, {_braces(write, row.r)}, {_braces(write, row.y)}, "
        f"{_braces(write, row.given)}, {_braces(write, row.u)}, {row.status}}},"
        for row in vectors.rows
    )
    parameters = f"{source.name}_parameters"
    blocks = sum(row.action is Action.LEARN for row in vectors.rows)
    references, measurements, actuators = source.sizes or (1, 1, 1)
    return filled("test.c", {
        "name": source.name,
        "NAME": source.name.upper(),
        "precision": source.precision,
        "real": source.real,
        "epsilon": "FLT_EPSILON" if single else "DBL_EPSILON",
        "references": references,
        "measurements": measurements,
        "actuators": actuators,
        "scale": ", ".join(repr(float(each)) for each in vectors.scale),
        "digits": 9 if single else 17,
        "zero": write(0.0),
        "actions": ", ".join(action.name for action in used),
        "rows": "\n".join(rows),
        "expected": "\n".join(expected_lines(source, vectors.estimate)),
        "found": ",\n        ".join(f"(real)estimate.{place}" for place, *_ in places(source)),
        "cases": "\n".join(_cases(source, used, vectors)),
        "halves": _halves(source, "now->r", "    "),
        "step": _step(source, "now->r", "now->y"),
        "limited_parameter": f", {parameters} *limited" if limits else "",
        "limited_variable": f"    static {parameters} limited;\n" if limits else "",
        "limited_argument": ", &limited" if limits else "",
        "loop": loop_code(source, vectors.loops) if vectors.loops else "",
        "samples": f"count + {blocks * (BLOCK - 1)}" if blocks else "count",
        "tolerance": repr(tolerance_of(vectors.loops is not None)),
        "image_sample": SAVED,
        "counts": int("step_counts" in source.operations),
        "fresh": ", ".join(f"{byte:#x}" for byte in vectors.fresh),
        "running": _words_of(vectors.images[0]),
        "at_rest": _words_of(vectors.images[1]),
        "parts": "\n".join(f"    {{{count}, {size!r}}}," for count, size in vectors.parts),
        "constant": "\n".join(_constant_numbers(source.source)),
        "number": _NUMBER[source.precision],
        "tolerance_reason": TOLERANCE_REASON.replace("\n", "\n * "),
    })  # fmt: skip


_NUMBER = {
    "double": """    unsigned long long bits = 0;

    for (int i = 7; i >= 0; i--)
        bits = bits << 8 | first[i];
    memcpy(&x, &bits, sizeof x);""",
    "single": """    unsigned int bits = 0;

    for (int i = 3; i >= 0; i--)
        bits = bits << 8 | first[i];
    memcpy(&x, &bits, sizeof x);""",
}


def _constant_numbers(code: str) -> Iterator[str]:
    """Yield the runs of numbers in an image for which the code has a constant, and takes any."""
    checked = re.search(r" memory_ranges\[\d+\] = \{(.*?)\n\};", code, re.S)
    refused = re.findall(r"\{(\d+), ", checked[1]) if checked else []
    found = re.findall(r"memory_put\(image, (\d+), -?[\d.e+-]+f?\);", code)
    places = [*(int(place) for place in found if place not in refused), -1]
    first = places[0]
    for place, following in pairwise(places):
        if following != place + 1:
            yield f"    {{{first}, {place + 1}}},"
            first = following


def _words_of(image: bytes) -> str:
    """Return the words of an image that are not zero, with their places, as C code."""
    words = enumerate(struct.unpack(f"<{len(image) // 4}I", image))
    rows = ", ".join(f"{{{4 * at}, {word:#x}UL}}" for at, word in words if word)
    return "\n".join(textwrap.wrap(rows, 96, initial_indent="    ", subsequent_indent="    "))


def _braces(write: Callable[[Any], str], values: Any) -> str:
    return "{" + ", ".join(map(write, values)) + "}"


def _halves(source: CSource, r: str, pad: str) -> str:
    """Return the lines that make the last arguments of a step: half of the references each."""
    if not source.further:
        return ""
    names = ", ".join(f"{each}[REFERENCES]" for each in source.further)
    sets = " = ".join(f"{each}[i]" for each in source.further)
    half = Literals(source.precision == "single").write_real(0.5)
    return (
        f"{pad}real {names};\n\n{pad}for (int i = 0; i < REFERENCES; i++)\n"
        f"{pad}    {sets} = {half} * {r}[i];\n"
    )


def _step(source: CSource, r: str, y: str) -> str:
    """Return the statement that takes a step and writes u."""
    given = f"{source.name}_step(state, {_taken(source, r)}, {_taken(source, y)}{_last(source)}"
    return f"u[0] = {given})" if source.sizes is None else f"{given}, u)"


def _taken(source: CSource, signals: str) -> str:
    """Return an array as an argument: its only number where there is one u and y."""
    return f"{signals}[0]" if source.sizes is None else signals


def _last(source: CSource) -> str:
    return "".join(f", {_taken(source, each)}" for each in source.further)


def _cases(source: CSource, used: list[Action], vectors: Vectors) -> Iterator[str]:
    """Yield the lines of the events in a sample."""
    write, one = Literals(source.precision == "single").write_real, source.sizes is None
    words = {
        "NAME": source.name,
        "LAST": _last(source),
        "TRACKED": "u[0] = " if one else "",
        "PLACE": "" if one else "0, ",
        **{each: _taken(source, f"now->{each.lower()}") for each in ("GIVEN", "R", "Y")},
    }
    limited = [
        f"limited->{vectors.limit_path}.high{'' if one else f'[{k}]'} = {write(high)};"
        for k, high in enumerate(vectors.limit)
    ]
    for action in used:
        lines = _CODE_TEST_PROGRAM.get(action, ())
        if not lines:
            continue
        yield f"    case {action.name}:"
        for line in lines:
            for each in limited if line == "LIMITED" else (line,):
                yield f"        {fill(each, words)}"
        if lines[-1] != "return;":
            yield "        break;"


def places(source: CSource) -> Iterator[tuple[str, int, slice]]:
    """Yield the members of the estimate that are compared, their place, and their channel's."""
    at = 0
    for channel, width in source.channels:
        if channel.rpartition(".")[2] != "status":
            for i in range(width):
                yield f"{channel}[{i}]" if width > 1 else channel, at + i, slice(at, at + width)
        at += width


def expected_lines(source: CSource, row: Any) -> Iterator[str]:
    """Yield the lines of the estimate: name, value, and the largest size in its channel."""
    write = Literals(source.precision == "single").write_real
    for place, at, part in places(source):
        size = float(np.max(np.abs(np.where(np.isfinite(row[part]), row[part], 0.0))))
        yield f'    {{"{place}", {write(row[at])}, {size!r}}},'
