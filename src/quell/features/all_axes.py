"""Features of the states of all axes that ``quell.Axes`` runs together.

The signals of a learner in ``Axes`` are those of its own axis, then x̂ of all axes in their order,
then, if a block asks for it, v of all axes:

    x = (x̂_1 … x̂_n of the own axis, x̂ of axis 1, x̂ of axis 2, …, v of axis 1, v of axis 2, …)

``bound`` turns the features that a user gives into ones of these signals: a block that stands alone
gets the first n, one inside of ``AllAxes`` what is behind them. All signals are scaled in the same
way, so all blocks serve in both places.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from quell import checks
from quell.features.base import (
    Bias,
    Custom,
    Features,
    Joined,
    checked_design,
    unit,
    write,
    write_physical,
)
from quell.kernels.sized import Size
from quell.types import Vector


class AllAxes(Features):
    """Features of the states of all axes, for a learner that is given to ``quell.Axes``.

    Inside, the states are those of all axes in their order, so of two axes of order 2 x_1 and x_2
    are position and rate of the first one, x_3 and x_4 those of the second one; a function of
    ``Custom`` gets them as ``x[0] … x[3]``. Blocks beside it are of the own axis.

    Parameters
    ----------
    features
        blocks of features, for example ``State() + Polynomial(2)``.
    inputs
        whether v of all axes, what each asked for in the sample before, are states, too: x_5 and
        x_6 of two axes of order 2. They explain what a wrong B0 does. [y-unit/s^n]

    Raises
    ------
    ValueError
        for what is no block of features, or has ``Input()``, u of one axis.

    Examples
    --------
    >>> import math
    >>> gravity = Custom(lambda x, u: (math.cos(x[0]), math.cos(x[0] + x[2])), names=("g1", "g2"))
    >>> Friction() + AllAxes(Polynomial(2) + gravity) + Bias()  # doctest: +ELLIPSIS
    Friction(...) + AllAxes(Polynomial(...) + Custom(...)) + Bias()
    """

    def __init__(self, features: Features, inputs: bool = False) -> None:
        if not isinstance(features, Features):
            raise ValueError(
                f"features = {features!r}: must be made of blocks from quell.features, for example "
                "AllAxes(State())"
            )
        if features.has_input:
            raise ValueError(
                "features: Input() is the u of one axis; put it behind AllAxes(...), and take "
                "inputs=True for v of all axes"
            )
        if _has_all_axes(features):
            raise ValueError("features: AllAxes(...) is inside of AllAxes(...); one is enough")
        self.features, self.inputs = features, checks.flag("inputs", inputs)

    def __repr__(self) -> str:
        return f"AllAxes({self.features!r}{', inputs=True' if self.inputs else ''})"

    def design(self, order: int) -> Any:
        """Refuse: the states of the other axes are known to ``quell.Axes`` alone."""
        raise ValueError(f"features: {self!r} {_ONLY_IN_AXES}")

    def names(self, order: int) -> tuple[str, ...]:
        """Refuse, as ``design``."""
        raise ValueError(f"features: {self!r} {_ONLY_IN_AXES}")


_ONLY_IN_AXES = (
    "needs the states of all axes, and this controller has one: give the learner to quell.Axes, "
    "Axes(axes, learner=...), not to the ADRC of an axis"
)


def _has_all_axes(features: Any) -> bool:
    if isinstance(features, Joined):
        return _has_all_axes(features.first) or _has_all_axes(features.second)
    return isinstance(features, AllAxes)


def sees_all_axes(learner: Any) -> bool:
    """Return whether features of a learner are of all axes."""
    return _has_all_axes(getattr(learner, "features", None))


def asks_for_inputs(features: Features) -> bool:
    """Return whether features are of v of all axes, too."""
    if isinstance(features, Joined):
        return asks_for_inputs(features.first) or asks_for_inputs(features.second)
    return isinstance(features, AllAxes) and features.inputs


class OfAllDesign(NamedTuple):
    """Parameters of a block of all axes."""

    features: Any
    before: Size  # number of signals of the own axis


@write.register(OfAllDesign)
def _write(features: OfAllDesign, x: Vector, u: float, out: Vector) -> None:
    write(features.features, x[features.before :], u, out)


@write_physical.register(OfAllDesign)
def _write_physical(features: OfAllDesign, x: Vector, u: float, out: Vector) -> None:
    write_physical(features.features, x[features.before :], u, out)


@unit.register(OfAllDesign)
def _unit(features: OfAllDesign, scale: Vector, out: Vector) -> None:
    unit(features.features, scale[features.before :], out)


class _Bound(Features):
    """A block with a known number of states, the own ones or those of all axes."""

    def __init__(self, block: Features, states: int, before: int, labels: Sequence[str]) -> None:
        self.block, self.states, self.before, self.labels = block, states, before, tuple(labels)

    def design(self, order: int) -> Any:
        """Return the parameters of the block for its states."""
        found = checked_design(self.block, self.states)
        return OfAllDesign(found, self.before) if self.labels else found

    def names(self, order: int) -> tuple[str, ...]:
        """Return the names of the features; a state of all axes has the name of its axis."""
        if not self.labels:
            return self.block.names(self.states)
        return _named(self.block, self.states, self.labels)

    @property
    def has_input(self) -> bool:
        """True if the last feature is u itself."""
        return self.block.has_input

    def constant(self, order: int) -> int:
        """Return the index of the constant feature 1, or −1 if there is none."""
        return self.block.constant(self.states)

    def unscaled(self, order: int) -> tuple[bool, ...]:
        """Return for each feature whether its size is unknown."""
        return self.block.unscaled(self.states)

    def __repr__(self) -> str:
        return repr(self.block)


def _named(block: Features, states: int, labels: Sequence[str]) -> tuple[str, ...]:
    """Return names of features with those of the states, ``elbow.x1`` in place of ``x3``."""
    if isinstance(block, Joined):
        return (*_named(block.first, states, labels), *_named(block.second, states, labels))
    if isinstance(block, Custom):
        return block.names(states)

    def label(found: re.Match[str]) -> str:
        place = int(found[1])
        return labels[place - 1] if 1 <= place <= len(labels) else found[0]

    return tuple(re.sub(r"\bx(\d+)\b", label, name) for name in block.names(states))


def bound(features: Features, own: int, labels: Sequence[str], inputs: Sequence[str]) -> Features:
    """Return features of the signals of a learner in ``Axes``.

    Parameters
    ----------
    features
        as the user gives them.
    own
        states of the own axis; 0 for a learner that all axes share, which has none.
    labels, inputs
        names of the states of all axes, and of their v.

    Raises
    ------
    ValueError
        for blocks that do not fit, and for a block of one axis in a learner of all.
    """
    if isinstance(features, Joined):
        first = bound(features.first, own, labels, inputs)
        return Joined(first, bound(features.second, own, labels, inputs))
    if isinstance(features, AllAxes):
        seen = (*labels, *inputs) if features.inputs else tuple(labels)
        return _Bound(features.features, len(seen), own, seen)
    if own == 0 and not isinstance(features, Bias):
        raise ValueError(
            f"learner: {features!r} is of one axis, and the learner is shared by all: put it into "
            "AllAxes(...), or give a list with a learner for each axis"
        )
    return _Bound(features, own, 0, ())
