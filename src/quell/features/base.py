"""The interface of a block of features.

A block (``State()``, ``Bias()``, …) is an immutable description; blocks are joined by ``+``.
``design(order)`` returns its parameters, a NamedTuple, for whose type ``write`` and ``unit`` are
registered. ``write`` gets *scaled* inputs, which lie in about [−1, 1] whatever the plant's units
(``scaling.py``), so that all features are O(1). A block whose functions have a meaning only in the
plant's units, a period for example, registers ``write_physical`` too, and ``write_nothing`` for
``write``. Features of unknown size, for which ``unscaled`` is true, are divided by their largest
value so far (``sizes.py``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell.kernels import validation
from quell.kernels.dispatch import generic, generic_with_default
from quell.kernels.sized import Size
from quell.types import Vector


@generic
def write(features: Any, x: Vector, u: float, out: Vector) -> None:
    """Write the features of the scaled ``x`` (n,) and ``u`` to ``out`` (p,)."""
    raise TypeError


@generic_with_default
def write_physical(features: Any, x: Vector, u: float, out: Vector) -> None:
    """Write the features of ``x`` (n,) and ``u`` in the plant's units to ``out`` (p,)."""


@generic
def unit(features: Any, scale: Vector, out: Vector) -> None:
    """Write to ``out`` (p,) the factors that convert coefficients to the plant's units.

    ``scale`` (n + 2,) has the scales of x_1 … x_n, u, f. A factor is 1 if a feature has no unit.
    """
    raise TypeError


def write_nothing(features: Any, x: Vector, u: float, out: Vector) -> None:
    """Write nothing: ``write`` of a block with ``write_physical``."""


def dimensionless(features: Any, scale: Vector, out: Vector) -> None:
    """Write factors of 1: ``unit`` of a block whose features have no unit."""
    for j in range(out.size):
        out[j] = 1.0


class Features:
    """A block of features; ``one + other`` has the features of both."""

    def design(self, order: int) -> Any:
        """Return the parameters (a NamedTuple) for a plant of order ``order``.

        Raises
        ------
        ValueError
            if the block does not fit a plant of this order.
        """
        raise NotImplementedError

    def names(self, order: int) -> tuple[str, ...]:
        """Return the name of each feature."""
        raise NotImplementedError

    @property
    def has_input(self) -> bool:
        """True if the last feature is u itself."""
        return False

    def constant(self, order: int) -> int:
        """Return the index of the constant feature 1, or −1 if there is none."""
        return -1

    def unscaled(self, order: int) -> tuple[bool, ...]:
        """Return for each feature whether its size is unknown, so that learners must scale it."""
        return (False,) * len(self.names(order))

    def __add__(self, other: Features) -> Joined:
        if not isinstance(other, Features):
            return NotImplemented
        return Joined(self, other)


class Joined(Features):
    """The features of two blocks, one after the other; made by ``first + second``.

    Raises ``ValueError`` if ``first`` has the control signal, which must be last and only once.
    """

    def __init__(self, first: Features, second: Features) -> None:
        if first.has_input:
            raise ValueError("features: Input() must be the last block, and occur once")
        self.first, self.second = first, second

    def design(self, order: int) -> JoinedDesign:
        """Return both blocks' parameters."""
        first, second = self.first.design(order), self.second.design(order)
        return JoinedDesign(first, second, len(self.first.names(order)))

    def names(self, order: int) -> tuple[str, ...]:
        """Return both blocks' names; repeated names are numbered."""
        found: list[str] = []
        for name in (*self.first.names(order), *self.second.names(order)):
            unique, number = name, 2
            while unique in found:
                unique, number = f"{name} ({number})", number + 1
            found.append(unique)
        return tuple(found)

    @property
    def has_input(self) -> bool:
        """True if the last feature is u itself."""
        return self.second.has_input

    def constant(self, order: int) -> int:
        """Return the index of the constant feature 1, or −1 if there is none."""
        first, second = self.first.constant(order), self.second.constant(order)
        return first if first >= 0 or second < 0 else len(self.first.names(order)) + second

    def unscaled(self, order: int) -> tuple[bool, ...]:
        """Return for each feature whether its size is unknown."""
        return self.first.unscaled(order) + self.second.unscaled(order)

    def __repr__(self) -> str:
        return f"{self.first!r} + {self.second!r}"


class JoinedDesign(NamedTuple):
    """Parameters of two blocks."""

    first: Any
    second: Any
    split: Size  # number of features of the first


@write.register(JoinedDesign)
def _write(features: JoinedDesign, x: Vector, u: float, out: Vector) -> None:
    write(features.first, x, u, out[: features.split])
    write(features.second, x, u, out[features.split :])


@write_physical.register(JoinedDesign)
def _write_physical(features: JoinedDesign, x: Vector, u: float, out: Vector) -> None:
    write_physical(features.first, x, u, out[: features.split])
    write_physical(features.second, x, u, out[features.split :])


@unit.register(JoinedDesign)
def _unit(features: JoinedDesign, scale: Vector, out: Vector) -> None:
    unit(features.first, scale, out[: features.split])
    unit(features.second, scale, out[features.split :])


def checked_design(features: Features, order: int) -> Any:
    """Return ``features.design(order)`` after a test of each user-defined block."""
    if isinstance(features, Joined):
        checked_design(features.first, order)
        checked_design(features.second, order)
    elif validation.is_user_defined(features):
        _check_block(features, order)
    return features.design(order)


def _check_block(block: Features, order: int) -> None:
    """Call the functions of a user-defined block once, interpreted."""
    name = type(block).__name__
    what = f"{name}.design({order})"
    parameters = validation.attempt(what, "design takes the plant's order", block.design, order)
    validation.check_named_tuple(what, parameters, "numbers and arrays")
    what = f"{name}.names({order})"
    names = validation.attempt(what, "names takes the plant's order", block.names, order)
    if not (isinstance(names, tuple) and names and all(isinstance(label, str) for label in names)):
        rule = "must return a tuple with a name for each feature"
        raise ValueError(f"{what} returns {names!r}: {rule}")
    validation.check_registered(name, parameters, write, unit)
    rule = f"it gets x ({order},), u, and room for {len(names)} features, one for each name"
    ones, marks = np.ones(order + 2), (7e77, -7e77)
    sample = (validation.sample_values(order), 0.5)
    for functions, arguments in (((write, write_physical), sample), ((unit,), (ones,))):
        written: list[Any] = []
        for mark in marks:
            out = np.full(len(names), mark)
            for function in functions:
                what = f"{name}: {function.__name__}"
                validation.attempt_kernel(what, rule, function, parameters, *arguments, out)
            written.append(out != mark)
        if not np.all(written):
            missing = np.flatnonzero(~np.all(written, axis=0)).tolist()
            what = f"{name}: {functions[0].__name__}"
            raise ValueError(f"{what} does not write features {missing}; {rule}")
