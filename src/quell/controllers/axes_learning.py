"""Learners of several axes: the learner of an axis may use the signals of all axes.

A learner that is given to ``Axes`` sees the states of all axes (``learners/all_axes.py``). At the
beginning of a sample, before the axes run, all signals are gathered; a learner that all axes share
computes its gain when all have run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.adrc import ADRC
from quell.controllers.law import start_learning_again
from quell.guard import Guard
from quell.kernels.dispatch import for_each, generic_with_default
from quell.kernels.sized import Size, Work
from quell.learners.all_axes import (
    AxesView,
    OneOutput,
    SeeingLearner,
    SharedDesign,
    SharedLearner,
    SharedMemory,
    check_learner_of_axes,
    confidence_in,
    find_gain,
    look,
    share,
    show,
    take_gain,
)
from quell.learners.base import (
    NoLearner,
    NoLearnerDesign,
    NoLearnerMemory,
    forget,
    meaning,
    restart,
)
from quell.types import Status, Vector

_OVERFLOWED = int(Status.OVERFLOWED)

# ---- What the learners of all axes know together ----


class NoLearning(NamedTuple):
    """Parameters where no learner sees other axes: none."""


class NoLearningMemory(NamedTuple):
    """State of ``NoLearning``."""

    nothing: Vector  # (0,)


class LearningDesign(NamedTuple):
    """Parameters of learners that see all axes."""

    dt: float
    states: Size  # of all axes
    axes: Size
    shared: Any  # what the outputs of one learner share, or ``NoLearnerDesign``


@meaning.register(LearningDesign)
def _meaning(learning: LearningDesign) -> Any:
    return meaning(learning.shared)


class LearningMemory(NamedTuple):
    """State: x̂ of all axes, then v, y and y − x̂_1 of each."""

    before: Work  # in the last sample
    now: Work  # as they are expected in this one
    shared: Any


@generic_with_default
def look_at_all(learning: Any, memory: Any, axes: Any, states: Any) -> None:
    """Begin a sample: show the learners the signals of all axes."""


@generic_with_default
def learn_of_all(learning: Any, memory: Any, axes: Any, states: Any) -> int:
    """End a sample, all axes have run: let outputs of a shared learner learn; return the flags."""
    return 0


@generic_with_default
def restart_of_all(learning: Any, memory: Any) -> None:
    """Start from rest at the next sample; what was learned stays."""


def gather_axis(
    axis: Any, state: Any, i: int, at: int, learning: LearningDesign, before: Vector, now: Vector
) -> int:
    """Write the signals of an axis, whose states begin at ``at``; return where those behind begin.

    Both arrays have the states of all axes, then v, y and y − x̂_1 of each.
    """
    loop, estimates = state.loop[0], state.estimates
    order, dt = axis.law.size, learning.dt
    # y^(n) as the observer has it, for f that enters where v does.
    rate = axis.cancel_f * (axis.b0 * loop.u + estimates[order] + loop.f_learned + loop.f_known)
    for j in range(order):
        rate -= axis.cancel_f * axis.cancel[j] * estimates[j]
        before[at + j] = estimates[j]
    for j in range(order - 1):
        now[at + j] = estimates[j] + dt * estimates[j + 1]
    now[at + order - 1] = estimates[order - 1] + dt * rate
    place, step = learning.states + i, learning.axes
    before[place] = now[place] = loop.u
    before[place + step] = now[place + step] = loop.y
    before[place + 2 * step] = now[place + 2 * step] = loop.y - estimates[0]
    return at + order


def show_axis(axis: Any, state: Any, i: int, before: Vector, now: Vector) -> None:
    """Show the learner of an axis the signals of all."""
    show(axis.learner, state.learner, before, now)


def share_with_axis(
    axis: Any, state: Any, i: int, shared: SharedDesign, memory: SharedMemory
) -> None:
    """Hand the features of a shared learner to the output of an axis."""
    share(shared, memory, axis.learner, state.learner)


def least_confidence_with(
    axis: Any, state: Any, i: int, least: float, shared: SharedDesign, memory: SharedMemory
) -> float:
    """Return the least confidence of axes that learn in this sample, this one included."""
    if state.learner.loop[0].learns == 0.0:
        return least
    return min(confidence_in(shared, memory, axis.learner, i), least)


def take_gain_of_axis(axis: Any, state: Any, i: int, memory: SharedMemory) -> None:
    """Move θ of an output by its error."""
    take_gain(memory, state.learner)


def count_forgotten(axis: Any, state: Any, i: int, count: int) -> int:
    """Return the count of outputs whose θ was forgotten in this sample or in a restart before it.

    This one is included.
    """
    return count + (1 if state.learner.loop[0].forgot != 0.0 else 0)


def start_axis_again(axis: Any, state: Any, i: int) -> None:
    """Let an axis start learning again; one that has not forgotten its θ does it now."""
    # The observers of these axes take over what was fed forward, as after an overflow of their own.
    if state.learner.loop[0].forgot == 0.0:
        start_learning_again(axis, state)
        state.loop[0].status = int(state.loop[0].status) | _OVERFLOWED
    state.learner.loop[0].forgot = 0.0


gather_axes = for_each("gather_axes", gather_axis)
show_axes = for_each("show_axes", show_axis)
share_with_axes = for_each("share_with_axes", share_with_axis)
least_confidence = for_each("least_confidence", least_confidence_with)
take_gains = for_each("take_gains", take_gain_of_axis)
axes_forgotten = for_each("axes_forgotten", count_forgotten)
start_all_again = for_each("start_all_again", start_axis_again)


@generic_with_default
def begin_shared(shared: Any, memory: Any, axes: Any, states: Any, before: Any, now: Any) -> None:
    """Begin a sample of a shared learner; by default there is none."""


@begin_shared.register(SharedDesign)
def _begin_shared(
    shared: SharedDesign, memory: SharedMemory, axes: Any, states: Any, before: Vector, now: Vector
) -> None:
    look(shared, memory, before, now)
    share_with_axes(axes, states, shared, memory)


@generic_with_default
def end_shared(shared: Any, memory: Any, axes: Any, states: Any) -> int:
    """End a sample of a shared learner, return the flags; by default there is none."""
    return 0


@end_shared.register(SharedDesign)
def _end_shared(shared: SharedDesign, memory: SharedMemory, axes: Any, states: Any) -> int:
    if axes_forgotten(axes, states, 0) > 0:
        forget(shared, memory)
        start_all_again(axes, states)
        return _OVERFLOWED
    least = least_confidence(axes, states, 2.0, shared, memory)
    if least <= 1.0 and find_gain(shared, memory, least):
        take_gains(axes, states, memory)
    return 0


@look_at_all.register(LearningDesign)
def _look_at_all(learning: LearningDesign, memory: LearningMemory, axes: Any, states: Any) -> None:
    before, now = memory.before, memory.now
    gather_axes(axes, states, 0, learning, before, now)
    show_axes(axes, states, before, now)
    begin_shared(learning.shared, memory.shared, axes, states, before, now)


@learn_of_all.register(LearningDesign)
def _learn_of_all(learning: LearningDesign, memory: LearningMemory, axes: Any, states: Any) -> int:
    return end_shared(learning.shared, memory.shared, axes, states)


@restart_of_all.register(LearningDesign)
def _restart_of_all(learning: LearningDesign, memory: LearningMemory) -> None:
    restart(learning.shared, memory.shared)


# ---- Learners and guards that users give to Axes ----


def given_for_each(what: str, given: Any, names: Sequence[str]) -> list[Any]:
    """Return what is given for each axis: a list, or a dictionary by name; None where it is not."""
    if isinstance(given, Mapping):
        for name in given:
            checks.one_of(f"{what} of axis", name, names)
        return [given.get(name) for name in names]
    found = list(given)
    if len(found) != len(names):
        raise ValueError(
            f"{what} has {len(found)} entries, there are {len(names)} axes ({', '.join(names)}): "
            "must have one for each, None for one without"
        )
    return found


class LearningOfAxes:
    """The learners that are given to ``Axes``, and what they know together.

    Parameters
    ----------
    learner
        one for all axes, or a list or dictionary with one for each; or None.
    guard
        one description for all axes, each of which has its own, or one for each; or None.
    axes, names
        the controllers of the axes.

    Raises
    ------
    ValueError
        for learners without features of all axes, two learners or guards of one axis, and what
        ``SharedLearner`` raises.
    """

    def __init__(
        self, learner: Any, guard: Any, axes: Sequence[ADRC], names: Sequence[str]
    ) -> None:
        self.learner, self.guard = learner, guard
        self.is_shared = not (isinstance(learner, Mapping) or checks.is_sequence(learner))
        count = len(axes)
        if learner is None and guard is not None:
            raise ValueError(
                f"guard = {guard!r}: has no effect without a learner of Axes; give the guard of a "
                "learner that an ADRC has to the ADRC"
            )
        self._learners = [learner] * count
        if not self.is_shared:
            self._learners = given_for_each("learner", learner, names)
        self._guards = [None if own is None else guard for own in self._learners]
        if isinstance(guard, Mapping) or checks.is_sequence(guard):
            self._guards = given_for_each("guard", guard, names)
        for name, axis, own, watch in zip(names, axes, self._learners, self._guards, strict=True):
            _check_parts(name, axis, own, watch, self.is_shared)
        self._names = tuple(names)
        self._shared: SharedLearner | None = None

    @property
    def learns(self) -> bool:
        """Whether a learner sees the states of all axes."""
        return any(own is not None for own in self._learners)

    def attach(self, axes: Sequence[ADRC]) -> None:
        """Give the axes their learners and guards."""
        if not self.learns:
            return
        self._design_for(axes)
        for i, axis in enumerate(axes):
            own = self._learners[i]
            if own is None:
                continue
            axis.learner = self._learner_of(i)
            axis.guard = axis.guard if self._guards[i] is None else self._guards[i]
            axis._initialise()

    def update(self, axes: Sequence[ADRC]) -> None:
        """Design the learners again, after a change of an observer."""
        if not self.learns:
            return
        self._design_for(axes)
        for i, axis in enumerate(axes):
            if self._learners[i] is not None:
                axis.learner = self._learner_of(i)
                axis._update_parameters()

    def _design_for(self, axes: Sequence[ADRC]) -> None:
        self._view = AxesView(self._names, tuple(axis.observer for axis in axes))
        if self.is_shared:
            # Scales and memory are for the slowest axis: shorter ones would be too short for it.
            omega_c = min(float(axis._learner_omega_c) for axis in axes)
            self._shared = SharedLearner(self.learner, self._view, omega_c)

    def _learner_of(self, i: int) -> Any:
        if self._shared is not None:
            return OneOutput(self._shared, i)
        return SeeingLearner(self._learners[i], self._view, i)

    def design(self, dt: float) -> NoLearning | LearningDesign:
        """Return the parameters."""
        if not self.learns:
            return NoLearning()
        states = sum(observer.order for observer in self._view.observers)
        shared = NoLearnerDesign() if self._shared is None else self._shared.design()
        return LearningDesign(dt, states, len(self._names), shared)

    def memory(self, parameters: Any) -> NoLearningMemory | LearningMemory:
        """Return the state before anything is learned."""
        if not self.learns:
            return NoLearningMemory(np.zeros(0))
        before, now = np.zeros((2, parameters.states + 3 * parameters.axes))
        shared: Any = NoLearnerMemory(np.zeros(0))
        if self._shared is not None:
            shared = self._shared.memory(parameters.shared)
        return LearningMemory(before, now, shared)

    def check_retuning(self, changes: dict[str, Any]) -> None:
        """Raise a ``ValueError`` for another observer of one axis, if all share one lag filter."""
        if self._shared is not None and changes.get("observer") is not None:
            raise ValueError(
                "observer: all axes share a learner, whose features pass through one lag filter; "
                "make Axes anew with other observers, or give a list with a learner for each axis"
            )


def _check_parts(name: str, axis: ADRC, learner: Any, guard: Any, is_shared: bool) -> None:
    """Check learner and guard of one axis."""
    if learner is None:
        if guard is not None:
            raise ValueError(
                f"guard: {name} has no learner of Axes; give the guard of its own learner to its "
                "ADRC"
            )
        return
    check_learner_of_axes(learner, "learner" if is_shared else f"learner of {name}")
    if not isinstance(axis.learner, NoLearner):
        raise ValueError(
            f"learner: {name} has one already, {axis.learner!r}: an axis has one learner; leave "
            "it out of the ADRC"
        )
    if guard is not None and not isinstance(guard, Guard):
        raise ValueError(f"guard = {guard!r}: must be a quell.Guard(), or None")
    if guard is not None and axis.guard is not None:
        raise ValueError(f"guard: {name} has one already, {axis.guard!r}; give one of them")
