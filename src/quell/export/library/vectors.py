"""Golden vectors: a run of the interpreted kernels, which the exported controller must repeat."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.adrc.adrc import ADRC
from quell.controllers.adrc.handover import samples_to_settle
from quell.controllers.base import (
    control,
    reset_loop,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.prefilters.prefilter import without_prefilters
from quell.controllers.single import SinglePrecision
from quell.export import operations
from quell.export.inspection import at_path, in_double_precision, limits_path, parameters_of
from quell.export.library.loop import BLOCK, Loop, Plant, plant_for
from quell.kernels.dispatch import as_python

# Samples of each part of the run: enough for observers to settle in, few enough that the file is
# read by people and fits into a small flash memory (in single precision 20 bytes each).
_FIRST, _PART = 60, 20
# A start under load takes twice the samples in which the observer settles; longer ones are left
# out, because the kernels are interpreted here (20 us a sample).
_LONGEST_START = 4000
# A measurement beyond all physical quantities, by precision (``controllers.bad_samples``).
_ABSURD, _ABSURD_SINGLE = 1e80, 1e30
# How far u goes beyond its limits, relative to their distance.
_EXCESS = 1.5


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
    LEARN = 8  # a block of samples in a small loop, see ``loop.py``


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
        self.design, self.state = self.default, controller.initial_state()
        self.limited = self.default
        self.real: Callable[[Any], Any] = np.float32 if single else float
        self.derivatives = int(getattr(controller, "derivatives", 0))
        self.described = in_double_precision(controller)
        self.rows: list[Row] = []
        self.loop: Loop | None = None

    def play(self, action: Action, r: float, y: float, given: float = 0.0) -> float:
        """Do what the C test does for this row, and add it; return u."""
        real, old = self.real, self.design
        r_, y_, given_ = real(r), real(y), real(given)
        with np.errstate(all="ignore"), as_python():
            if action is Action.APPLIED:
                operations.set_applied(old, self.state, given_)
            elif action is Action.HAND_OVER:
                operations.hand_over(old, self.state)
            elif action in (Action.LIMIT, Action.FREE):
                self.design = self.limited if action is Action.LIMIT else self.default
                operations.retune(old, self.design, self.state)
            elif action is Action.RESET:
                reset_loop(old, self.state)
            elif action is Action.START:
                samples = _samples(self.described)
                operations.start_from(old, self.state, samples, y_, given_, r_)
            if action is not Action.LEARN:
                self._set_derivatives(r_)
            if action is Action.LEARN:
                u = self._block()
            elif action is Action.TRACK:
                u = operations.track(self.design, self.state, r_, y_, given_)
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
        """Set each derivative of the reference to half the reference."""
        if self.derivatives:
            half = np.full(self.derivatives, self.real(0.5) * r, dtype=type(self.real(0.0)))
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
    signals = _Signals(_amplitude(controller, path))
    for _ in range(2):  # before the first measurement
        player.play(Action.STEP, math.nan, math.nan)
    for _ in range(_FIRST):
        player.play(Action.STEP, *signals.next())
    absurd = _ABSURD_SINGLE if player.real is np.float32 else _ABSURD
    for i in range(_PART):
        r, y = signals.next()
        y = (y, math.nan, y, math.inf, absurd)[i % 5]
        player.play(Action.STEP, math.nan if i % 7 == 3 else r, y)
    for i in range(_PART):
        action = Action.APPLIED if i % 5 == 0 else Action.STEP
        given = math.nan if i == _PART // 2 else 0.5 * float(player.rows[-1].u)
        player.play(action, *signals.next(), given)
    if path:
        _play_limited(player, path, signals)
    if "track" in available:
        _play_manual(player, signals)
    player.play(Action.RESET, *signals.next())
    for _ in range(_PART):
        player.play(Action.STEP, *signals.next())
    if "start" in available and _samples(player.described) <= _LONGEST_START:
        r, y = signals.next()
        player.play(Action.START, r, y, float(np.median(player.u_of(slice(2, _FIRST)))))
        player.play(Action.START, r, y, math.nan)  # changes nothing
        for _ in range(_PART):
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


def _play_limited(player: Player, path: str, signals: _Signals) -> None:
    """Set the upper limit into the middle of the range that u had so far, and back."""
    u = player.u_of(slice(2, _FIRST))
    limits = at_path(player.default, path)
    high = 0.5 * (float(np.min(u)) + float(np.max(u)))
    player.limit_at(path, high if math.isfinite(high) else limits.high)
    for action in (Action.LIMIT, Action.FREE):
        player.play(action, *signals.next())
        for _ in range(2 * _PART):
            player.play(Action.STEP, *signals.next())


def _play_manual(player: Player, signals: _Signals) -> None:
    u = float(player.rows[-1].u)
    for i in range(_PART):
        given = math.nan if i == _PART // 2 else u * (1.0 - 0.02 * i)
        player.play(Action.TRACK, *signals.next(), given)
    player.play(Action.HAND_OVER, *signals.next())
    for _ in range(_PART):
        player.play(Action.STEP, *signals.next())


class _Signals:
    """A reference that moves and steps, and a measurement that follows it with noise."""

    def __init__(self, amplitude: float) -> None:
        self.amplitude, self.sample, self.y = amplitude, 0, 0.0
        self.random = np.random.default_rng(1)  # a fixed seed: the same file each time

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
    signals = _Signals(1.0)
    for _ in range(_FIRST):
        player.play(Action.STEP, *signals.next())
    u = player.u_of(slice(None))
    span = float(np.max(u) - np.min(u))
    usable = math.isfinite(span) and span > 0.0
    return _EXCESS * (high - low) / span if usable else 1.0


def _samples(controller: Any) -> int:
    inner = without_prefilters(controller)
    return samples_to_settle(inner.observer) if isinstance(inner, ADRC) else 0
