"""What a learner is shown: features of the estimated state and the control signal.

A block of features (``State()``, ``Bias()``, …) is an immutable description; blocks are joined by ``+``. ``design(order)`` turns it
into a NamedTuple, for whose type ``write`` is registered. All blocks are given *scaled* inputs, which lie in about [−1, 1] whatever the
plant's units (``scaling.py``), so that all features are O(1).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell.kernels import validation
from quell.kernels.dispatch import generic
from quell.types import Vector


@generic
def write(features: Any, x: Vector, u: float, out: Vector) -> None:
    """Write the features of the scaled state ``x`` (n,) and the scaled control signal ``u`` into ``out`` (p,)."""
    raise TypeError


@generic
def unit(features: Any, scale: Vector, out: Vector) -> None:
    """Write by what a coefficient must be multiplied to stand for the plant's units; ``scale`` (n + 2,) is that of x_1 … x_n, u, f."""
    raise TypeError


class Features:
    """A block of features; ``one + other`` has the features of both."""

    def design(self, order: int) -> Any:
        """Return the parameters (a NamedTuple) for a plant of order ``order``.

        Raises
        ------
        ValueError
            where the block does not fit a plant of this order.
        """
        raise NotImplementedError

    def names(self, order: int) -> tuple[str, ...]:
        """Return what each feature is called."""
        raise NotImplementedError

    @property
    def has_input(self) -> bool:
        """Whether the last feature is u itself."""
        return False

    def constant(self, order: int) -> int:
        """Return which feature is the constant 1; −1 where there is none."""
        return -1

    def __add__(self, other: Features) -> Joined:
        if not isinstance(other, Features):
            return NotImplemented
        return Joined(self, other)


class Joined(Features):
    """The features of two blocks, one after the other; made by ``first + second``.

    Raises
    ------
    ValueError
        where ``first`` has the control signal, which must come last, and once.
    """

    def __init__(self, first: Features, second: Features) -> None:
        if first.has_input:
            raise ValueError("features: Input() must be the last of the blocks, and be there once")
        self.first, self.second = first, second

    def design(self, order: int) -> JoinedDesign:
        """Return both blocks' parameters."""
        return JoinedDesign(
            self.first.design(order), self.second.design(order), len(self.first.names(order))
        )

    def names(self, order: int) -> tuple[str, ...]:
        """Return both blocks' names; a name that comes again is numbered."""
        found: list[str] = []
        for name in (*self.first.names(order), *self.second.names(order)):
            again, number = name, 2
            while again in found:
                again, number = f"{name} ({number})", number + 1
            found.append(again)
        return tuple(found)

    @property
    def has_input(self) -> bool:
        """Whether the last feature is u itself."""
        return self.second.has_input

    def constant(self, order: int) -> int:
        """Return which feature is the constant 1; −1 where there is none."""
        first, second = self.first.constant(order), self.second.constant(order)
        return first if first >= 0 or second < 0 else len(self.first.names(order)) + second

    def __repr__(self) -> str:
        return f"{self.first!r} + {self.second!r}"


class JoinedDesign(NamedTuple):
    """Parameters of two blocks."""

    first: Any
    second: Any
    split: int
    """Number of features of the first."""


@write.register(JoinedDesign)
def _write(features: JoinedDesign, x: Vector, u: float, out: Vector) -> None:
    write(features.first, x, u, out[: features.split])
    write(features.second, x, u, out[features.split :])


@unit.register(JoinedDesign)
def _unit(features: JoinedDesign, scale: Vector, out: Vector) -> None:
    unit(features.first, scale, out[: features.split])
    unit(features.second, scale, out[features.split :])


def checked_design(features: Features, order: int) -> Any:
    """Return ``features.design(order)``; blocks of the user's own have to write their features once, interpreted.

    Raises
    ------
    ValueError
        that names the block's class and the rule, for whatever is wrong.
    """
    if isinstance(features, Joined):
        checked_design(features.first, order)
        checked_design(features.second, order)
    elif validation.is_user_defined(features):
        _try_block(features, order)
    return features.design(order)


def _try_block(block: Features, order: int) -> None:
    name = type(block).__name__
    what = f"{name}.design({order})"
    parameters = validation.attempt(what, "design takes the plant's order", block.design, order)
    validation.check_named_tuple(what, parameters, "numbers and arrays")
    names = validation.attempt(
        f"{name}.names({order})", "names takes the plant's order", block.names, order
    )
    if (
        not isinstance(names, tuple)
        or not names
        or not all(isinstance(label, str) for label in names)
    ):
        raise ValueError(
            f"{name}.names({order}) returns {names!r}: must return a tuple with a name for each feature"
        )
    validation.check_registered(name, parameters, write, unit)
    rule = (
        f"it is given x ({order},), u, and room for {len(names)} features, as many as it has names"
    )
    ones, marks = np.ones(order + 2), (7e77, -7e77)
    for function, arguments in ((write, (validation.sample_values(order), 0.5)), (unit, (ones,))):
        written = []
        for mark in marks:
            out = np.full(len(names), mark)
            validation.attempt_kernel(
                f"{name}: {function.__name__}", rule, function, parameters, *arguments, out
            )
            written.append(out != mark)
        if not np.all(written):
            raise ValueError(
                f"{name}: {function.__name__} leaves features {np.flatnonzero(~np.all(written, axis=0)).tolist()} unwritten; {rule}"
            )
