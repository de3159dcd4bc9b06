"""Golden vectors: a run of the interpreted kernels, which the exported controller must repeat.

A small loop in which a learner takes part: the same in Python and in the C test.

The plant is a chain of integrators with the controller's own b0, poles at its omega_c, and a
disturbance of the learner's kind, ``x^(n) = b0 u − k·x``, integrated by Euler's method. All numbers
have the precision of the controller, and the order of operations is that of the C program.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from enum import IntEnum
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.base import (
    change_parameters,
    control,
    reset_loop,
    set_held,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.compensated import compensating_part
from quell.controllers.compensator import samples_to_settle
from quell.controllers.memory import learned_state
from quell.controllers.prefilters import without_prefilters
from quell.controllers.single import SinglePrecision
from quell.export import c_files
from quell.export.c_files import CSource
from quell.export.controller_source import at_path, in_double_precision, limits_path, parameters_of
from quell.export.translate.text import Literals
from quell.kernels.dispatch import as_python

# ---- The texts of the files around a controller, from templates with @names@ to fill in ----


def filled(name: str, values: Mapping[str, object]) -> str:
    """Return a template of the folder ``templates`` with its ``@names@`` replaced."""
    return fill((resources.files(__package__) / "templates" / name).read_text("utf-8"), values)


def fill(text: str, values: Mapping[str, object]) -> str:
    """Return a text with its ``@names@`` replaced."""
    return re.sub(r"@(\w+)@", lambda found: str(values[found[1]]), text)


# ---- A small loop in which a learner takes part ----

BLOCK = 50
"""Samples of a row: u is compared after the last."""
# Learners wait for two lag times. The kernels are interpreted: some 0.2 ms a sample.
_LAGS, _LEAST, _MOST = 6.0, 600, 2000
MULTIPLIER, INCREMENT = 1103515245, 12345  # of C's own example of rand()


class Plant(NamedTuple):
    """The plant and its signals."""

    b0: Any
    gains: tuple[Any, ...]
    dt: Any
    amplitude: Any  # of the reference
    noise: Any  # factor of the random integers
    samples: int


def plant_for(controller: Any, amplitude: float, real: Callable[[Any], Any]) -> Plant | None:
    """Return the plant for a controller; None for one that does not learn."""
    inner = compensating_part(without_prefilters(controller))
    if inner is None or not inner.parameters.learns:
        return None
    return plant_of(inner, amplitude, real)


def plant_of(inner: Any, amplitude: float, real: Callable[[Any], Any]) -> Plant:
    """Return the plant for an ADRC or a compensator."""
    observer, law = inner.observer, inner.gains
    count = round(_LAGS * observer.lag_time / observer.dt / BLOCK) * BLOCK
    return Plant(
        real(observer.b0),
        tuple(real(gain) for gain in law),
        real(observer.dt),
        real(amplitude),
        real(amplitude / 2.0**27),  # uniform within 2.4e-4 of the amplitude
        min(max(count, _LEAST), _MOST),
    )


class Loop:
    """The plant while it moves."""

    def __init__(self, plant: Plant, real: Callable[[Any], Any], seed: int = 1) -> None:
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

    def advance(self, u: Any) -> None:
        """Move the plant by a sample."""
        plant, x = self.plant, self.x
        with np.errstate(all="ignore"):
            slope = plant.b0 * u
            for gain, value in zip(plant.gains, x, strict=True):
                slope = slope - gain * value
            for i in range(len(x) - 1):
                x[i] = x[i] + plant.dt * x[i + 1]
            x[-1] = x[-1] + plant.dt * slope


def c_code(plant: Plant, write: Callable[[Any], str], real: str, source: CSource) -> str:
    """Return the same loop in C, as a function that plays a block of samples."""
    gains = ", ".join(write(gain) for gain in plant.gains)
    return fill(_CODE, {
        "REAL": real, "NAME": source.name, "ORDER": len(plant.gains), "GAINS": gains,
        "B0": write(plant.b0), "DT": write(plant.dt), "AMPLITUDE": write(plant.amplitude),
        "NOISE": write(plant.noise), "HALF": plant.samples // 4, "BLOCK": BLOCK,
        "DERIVATIVES": f", {write(0.5)} * r" * len(source.further),
        "MULTIPLIER": MULTIPLIER, "INCREMENT": INCREMENT, "ZERO": write(0.0),
    })  # fmt: skip


_CODE = """
/* A loop with a small plant, in which the learner takes part: a block of samples. */
static @REAL@ play_loop(@NAME@_state *state)
{
    static const real gains[@ORDER@] = {@GAINS@};
    static real x[@ORDER@];
    static unsigned long seed = 1;
    static int k;
    real u = @ZERO@;

    for (int n = 0; n < @BLOCK@; n++) {
        int position = k % (2 * @HALF@);
        real r, y, slope;

        seed = (seed * @MULTIPLIER@UL + @INCREMENT@UL) & 0x7fffffffUL;
        position = position < @HALF@ ? position : 2 * @HALF@ - position;
        r = @AMPLITUDE@ * (real)position / (real)@HALF@;
        y = x[0] + @NOISE@ * (real)((int)(seed >> 15) - 32768);
        k++;
        u = @NAME@_step(state, r, y@DERIVATIVES@);
        slope = @B0@ * u;
        for (int i = 0; i < @ORDER@; i++)
            slope -= gains[i] * x[i];
        for (int i = 0; i < @ORDER@ - 1; i++)
            x[i] += @DT@ * x[i + 1];
        x[@ORDER@ - 1] += @DT@ * slope;
    }
    return u;
}
"""


# ---- Golden vectors ----

# Samples of each part of the run: enough for observers to settle in, few enough that the file is
# read by people and fits into a small flash memory (in single precision 20 bytes each).
FIRST, PART = 60, 20
# A start under load takes twice the samples in which the observer settles; longer ones are left
# out, because the kernels are interpreted here (20 us a sample).
LONGEST_START = 4000
# A measurement beyond all physical quantities, by precision (``controllers.bad_samples``).
ABSURD, ABSURD_SINGLE = 1e80, 1e30
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
    r: Any
    y: Any
    given: Any  # u that is applied, in some actions
    u: Any
    status: int


class Vectors(NamedTuple):
    """A run.

    Attributes
    ----------
    rows
        the samples.
    limit_path, limit
        field of the parameters with the upper limit of u, and its value after ``LIMIT``.
    scale
        RMS of u.
    estimate
        all that the controller knows after the last sample, in the order of its channels.
    plant
        of the blocks in which a learner takes part, if there is one.
    """

    rows: tuple[Row, ...]
    limit_path: str
    limit: Any
    scale: float
    estimate: Any
    plant: Plant | None


class Player:
    """The interpreted kernels of a controller, one sample after the other."""

    def __init__(self, controller: Any) -> None:
        single = isinstance(controller, SinglePrecision)
        self.default = parameters_of(controller)
        self.design, self.state = self.default, learned_state(controller)
        self.limited = self.default
        self.real: Callable[[Any], Any] = np.float32 if single else float
        numbers = ("derivatives", "external_signals")
        self.further = sum(int(getattr(controller, name, 0)) for name in numbers)
        self.described = in_double_precision(controller)
        self.rows: list[Row] = []
        self.loop: Loop | None = None

    def play(self, action: Action, r: float, y: float, given: float = 0.0) -> float:
        """Do what the C test does for this row, and add it; return u."""
        real, old = self.real, self.design
        r_, y_, given_ = real(r), real(y), real(given)
        with np.errstate(all="ignore"), as_python():
            if action is Action.APPLIED:
                c_files.set_applied(old, self.state, given_)
            elif action is Action.HAND_OVER:
                c_files.hand_over(old, self.state)
            elif action in (Action.LIMIT, Action.FREE):
                self.design = self.limited if action is Action.LIMIT else self.default
                change_parameters(old, self.design, self.state)
            elif action in (Action.HELD, Action.RELEASED):
                set_held(old, self.state, action is Action.HELD)
            elif action is Action.RESET:
                reset_loop(old, self.state)
            elif action is Action.START:
                samples = _samples(self.described)
                c_files.start_from(old, self.state, samples, y_, given_, r_)
            if action is not Action.LEARN:
                self._set_derivatives(r_)
            if action is Action.LEARN:
                u = self._block()
            elif action is Action.TRACK:
                u = c_files.track(self.design, self.state, r_, y_, given_)
            else:
                u = control(self.design, self.state, r_, y_)
        status = int(status_flags(self.design, self.state))
        self.rows.append(Row(action, r_, y_, given_, u, status))
        return float(u)

    def _block(self) -> Any:
        """Play a block of samples in the loop; return the last u."""
        assert self.loop is not None
        u: Any = 0.0
        for _ in range(BLOCK):
            r, y = self.loop.measure()
            self._set_derivatives(r)
            u = control(self.design, self.state, r, y)
            self.loop.advance(u)
        return u

    def _set_derivatives(self, r: Any) -> None:
        """Set each derivative of the reference, and each signal, to half the reference."""
        if self.further:
            half = np.full(self.further, self.real(0.5) * r, dtype=type(self.real(0.0)))
            set_reference_derivatives(self.design, self.state, half)

    def limit_at(self, path: str, high: Any) -> None:
        """Set the parameters of ``LIMIT``: the upper limit at ``path`` is ``high``."""
        limits = at_path(self.default, path)
        limits = limits._replace(high=max(self.real(high), limits.low))
        self.limited = _with_limits(self.default, path, limits)

    def u_of(self, rows: slice) -> Any:
        """Return u of some rows."""
        return np.array([float(row.u) for row in self.rows[rows]])


def golden_vectors(controller: Any, available: tuple[str, ...]) -> Vectors:
    """Return a run with noise, missing samples, saturation, manual operation and retuning.

    Parameters
    ----------
    controller
        the controller, in double or single precision.
    available
        names of the functions that its C code has.

    Notes
    -----
    The measurement follows the reference as a plant under control would, whatever u is: the run
    needs no plant. It is so large that u exceeds its limits, if there are any, and 1 otherwise.
    """
    player, path = Player(controller), limits_path(controller)
    signals = Signals(_amplitude(controller, path))
    for _ in range(2):  # before the first measurement
        player.play(Action.STEP, math.nan, math.nan)
    for _ in range(FIRST):
        player.play(Action.STEP, *signals.next())
    absurd = ABSURD_SINGLE if player.real is np.float32 else ABSURD
    for i in range(PART):
        r, y = signals.next()
        y = (y, math.nan, y, math.inf, absurd)[i % 5]
        player.play(Action.STEP, math.nan if i % 7 == 3 else r, y)
    for i in range(PART):
        action = Action.APPLIED if i % 5 == 0 else Action.STEP
        given = math.nan if i == PART // 2 else 0.5 * float(player.rows[-1].u)
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
    if "start" in available and _samples(player.described) <= LONGEST_START:
        r, y = signals.next()
        player.play(Action.START, r, y, float(np.median(player.u_of(slice(2, FIRST)))))
        player.play(Action.START, r, y, math.nan)  # changes nothing
        for _ in range(PART):
            player.play(Action.STEP, *signals.next())
    plant = plant_for(player.described, signals.amplitude, player.real)
    if plant is not None:
        player.play(Action.RESET, *signals.next())
        player.loop = Loop(plant, player.real)
        for _ in range(plant.samples // BLOCK):
            player.play(Action.LEARN, 0.0, 0.0)
    u = player.u_of(slice(None))
    scale = float(np.sqrt(np.mean(np.square(u[np.isfinite(u)]))))
    limit = at_path(player.limited, path).high if path else math.inf
    row = np.zeros(sum(width for _, width in controller.channels), dtype=type(player.real(0.0)))
    write_row(player.design, player.state, row)
    return Vectors(tuple(player.rows), path, limit, scale, row, plant)


def _play_limited(player: Player, path: str, signals: Signals) -> None:
    """Set the upper limit into the middle of the range that u had so far, and back."""
    u = player.u_of(slice(2, FIRST))
    limits = at_path(player.default, path)
    high = 0.5 * (float(np.min(u)) + float(np.max(u)))
    player.limit_at(path, high if math.isfinite(high) else limits.high)
    for action in (Action.LIMIT, Action.FREE):
        player.play(action, *signals.next())
        for _ in range(2 * PART):
            player.play(Action.STEP, *signals.next())


def _play_manual(player: Player, signals: Signals) -> None:
    u = float(player.rows[-1].u)
    for i in range(PART):
        given = math.nan if i == PART // 2 else u * (1.0 - 0.02 * i)
        player.play(Action.TRACK, *signals.next(), given)
    player.play(Action.HAND_OVER, *signals.next())
    for _ in range(PART):
        player.play(Action.STEP, *signals.next())


def _play_held(player: Player, signals: Signals) -> None:
    r, y = signals.next()
    for i in range(PART):
        player.play(Action.STEP if i else Action.HELD, r, y)
    player.play(Action.RELEASED, *signals.next())
    for _ in range(PART):
        player.play(Action.STEP, *signals.next())


class Signals:
    """A reference that moves and steps, and a measurement that follows it with noise."""

    def __init__(self, amplitude: float, seed: int = 1) -> None:
        self.amplitude, self.sample, self.y = amplitude, 0, 0.0
        self.random = np.random.default_rng(seed)  # a fixed one: the same file each time

    def next(self) -> tuple[float, float]:
        """Return r and y of the next sample."""
        k = self.sample
        r = self.amplitude * (math.sin(0.1 * k) + (1.0 if k % 50 >= 25 else 0.0))
        self.y += 0.1 * (r - self.y)
        self.sample += 1
        return r, self.y + 1e-3 * self.amplitude * float(self.random.standard_normal())


def _with_limits(design: Any, path: str, limits: Any) -> Any:
    name, _, rest = path.partition(".")
    inner = _with_limits(getattr(design, name), rest, limits) if rest else limits
    return design._replace(**{name: inner})


def _amplitude(controller: Any, path: str) -> float:
    """Return the amplitude of the reference at which u exceeds its limits."""
    player = Player(controller)
    if not path:
        return 1.0
    limits = at_path(player.default, path)
    low, high = float(limits.low), float(limits.high)
    if not math.isfinite(high - low):
        return 1.0
    free = limits._replace(low=player.real(-math.inf), high=player.real(math.inf))
    player.design = _with_limits(player.default, path, free)
    signals = Signals(1.0)
    for _ in range(FIRST):
        player.play(Action.STEP, *signals.next())
    u = player.u_of(slice(None))
    span = float(np.max(u) - np.min(u))
    usable = math.isfinite(span) and span > 0.0
    return EXCESS * (high - low) / span if usable else 1.0


def _samples(controller: Any) -> int:
    inner = compensating_part(without_prefilters(controller))
    return 0 if inner is None else samples_to_settle(inner.observer)


# ---- The C program that compares a controller with golden vectors ----

# The largest differences of 16 controllers on emulated Cortex-M processors with newlib and FMA were
# 25 ulp without a learner that acts, and 1930 ulp with one, whose loop enlarges them.
_TOLERANCE, _TOLERANCE_LEARNING = 64.0, 4096.0
TOLERANCE_REASON = """With -ffp-contract=off the difference is
zero, but for functions such as sin that differ between C libraries; with FMA it is some ulps,
and more where a learner acts in a loop."""

# What the program does before the step in a sample of each kind; NAME is the controller's.
_CODE_TEST_PROGRAM = {
    Action.APPLIED: ("NAME_applied(state, now->given);",),
    Action.TRACK: ("return NAME_track(state, now->r, now->y, now->givenDERIVATIVES);",),
    Action.HAND_OVER: ("NAME_hand_over(state);",),
    Action.LIMIT: (
        "*limited = NAME_default_parameters;",
        "limited->PATH.high = LIMIT;",
        "NAME_retune(state, limited);",
    ),
    Action.FREE: ("NAME_retune(state, &NAME_default_parameters);",),
    Action.HELD: ("NAME_set_held(state, true);",),
    Action.RELEASED: ("NAME_set_held(state, false);",),
    Action.RESET: ("NAME_reset(state);",),
    Action.START: ("NAME_start(state, now->y, now->given, now->r);",),
    Action.LEARN: ("return play_loop(state);",),
}


def tolerance_of(learns: bool) -> float:
    """Return the largest difference on other machines [ulp]."""
    return _TOLERANCE_LEARNING if learns else _TOLERANCE


def test_program(source: CSource, vectors: Vectors) -> str:
    """Return the text of ``test_NAME.c``."""
    single = source.precision == "single"
    write = Literals(single).write_real
    # In each step its last arguments are half the reference.
    derivatives = f", {write(0.5)} * now->r" * len(source.further)
    used = [action for action in Action if any(row.action == action for row in vectors.rows)]
    limits = Action.LIMIT in used
    cases: list[str] = []
    for action in used:
        lines = _CODE_TEST_PROGRAM.get(action, ())
        if lines:
            cases.append(f"    case {action.name}:")
            cases += [f"        {line.strip()}" for line in lines]
            cases += [] if lines[-1].startswith("return") else ["        break;"]
    text = "\n".join(cases).replace("NAME", source.name).replace("PATH", vectors.limit_path)
    text = text.replace("DERIVATIVES", derivatives)
    limit = write(vectors.limit) if limits else ""
    rows = (
        f"    {{{row.action.name}, {write(row.r)}, {write(row.y)}, {write(row.given)}, "
        f"{write(row.u)}, {row.status}}},"
        for row in vectors.rows
    )
    parameters = f"{source.name}_parameters"
    blocks = sum(row.action is Action.LEARN for row in vectors.rows)
    return filled("test.c", {
        "name": source.name,
        "NAME": source.name.upper(),
        "precision": source.precision,
        "real": source.real,
        "epsilon": "FLT_EPSILON" if single else "DBL_EPSILON",
        "scale": repr(vectors.scale),
        "digits": 9 if single else 17,
        "actions": ", ".join(action.name for action in used),
        "rows": "\n".join(rows),
        "expected": "\n".join(expected_lines(source, vectors.estimate)),
        "found": ",\n        ".join(f"(real)estimate.{place}" for place, *_ in places(source)),
        "cases": text.replace("LIMIT;", f"{limit};"),
        "limited_parameter": f", {parameters} *limited" if limits else "",
        "limited_variable": f"    static {parameters} limited;\n" if limits else "",
        "limited_argument": ", &limited" if limits else "",
        "derivatives": derivatives,
        "loop": c_code(vectors.plant, write, "real", source) if vectors.plant else "",
        "samples": f"count + {blocks * (BLOCK - 1)}" if blocks else "count",
        "tolerance": repr(tolerance_of(vectors.plant is not None)),
        "tolerance_reason": TOLERANCE_REASON.replace("\n", "\n * "),
    })  # fmt: skip


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
