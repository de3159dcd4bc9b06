"""Features: their interface and scaling, linear and polynomial ones, and those of the user.

The interface of a block of features.

A block (``State()``, ``Bias()``, …) is an immutable description; blocks are joined by ``+``.
``design(order)`` returns its parameters, a NamedTuple, for whose type ``write`` and ``unit`` are
registered. ``write`` gets *scaled* inputs, which lie in about [−1, 1] whatever the plant's units,
so that all features are O(1). A block whose functions have a meaning only in the plant's units, a
period for example, registers ``write_physical`` too, and ``write_nothing`` for ``write``. Features
of unknown size, for which ``unscaled`` is true, are divided by their largest value so far.

Sizes of features that are functions of signals in the plant's units.

Nothing is known of their size beforehand. So each is divided by the smallest power of two that is
at least its largest absolute value so far, or by √2 times a power of two, as signals are.

Automatic scaling: inputs and targets of O(1) whatever the plant's units.

The scale of x̂_i is the smallest power of two that is at least the largest ``|x̂_i|`` so far, so it
changes seldom and by a whole factor, by which a linear model converts its coefficients exactly. For
models that cannot be converted, and whose predictions change at once where a scale doubles, it is
√2 times a power of two: a signal that rests at 1, 2 or 10 is not at an edge, where noise would
double its scale. It is at least ``ω^(i−1)/8`` of the scale
of x̂_1, with a frequency ω of the plant: at rest, where the higher derivatives are noise, noise is
not scaled up to O(1). The control signal and the total disturbance, which a learner has to predict,
have their own scales.

The features of a linear model: the state, the control signal, a constant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import singledispatch
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types as nb_types
from numpy.typing import NDArray

from quell import checks
from quell.kernels import user_functions
from quell.kernels.dispatch import generic, generic_with_default, is_finite, kernel
from quell.kernels.frozen import frozen, kept_code
from quell.kernels.functions import is_single, log2
from quell.kernels.sized import Flag, Size
from quell.kernels.user_functions import (
    POINTER,
    NotCompilableError,
    call,
    compile_cfunc,
    jit_user_function,
    set_origin,
)
from quell.types import Vector

# ---- The interface of a block of features ----


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
    elif user_functions.is_user_defined(features):
        _check_block(features, order)
    return features.design(order)


def _check_block(block: Features, order: int) -> None:
    """Call the functions of a user-defined block once, interpreted."""
    name = type(block).__name__
    what = f"{name}.design({order})"
    parameters = user_functions.attempt(what, "design takes the plant's order", block.design, order)
    user_functions.check_named_tuple(what, parameters, "numbers and arrays")
    what = f"{name}.names({order})"
    names = user_functions.attempt(what, "names takes the plant's order", block.names, order)
    if not (isinstance(names, tuple) and names and all(isinstance(label, str) for label in names)):
        rule = "must return a tuple with a name for each feature"
        raise ValueError(f"{what} returns {names!r}: {rule}")
    user_functions.check_registered(name, parameters, write, unit)
    rule = f"it gets x ({order},), u, and room for {len(names)} features, one for each name"
    ones, marks = np.ones(order + 2), (7e77, -7e77)
    sample = (user_functions.sample_values(order), 0.5)
    for functions, arguments in (((write, write_physical), sample), ((unit,), (ones,))):
        written: list[Any] = []
        for mark in marks:
            out = np.full(len(names), mark)
            for function in functions:
                what = f"{name}: {function.__name__}"
                user_functions.attempt_kernel(what, rule, function, parameters, *arguments, out)
            written.append(out != mark)
        if not np.all(written):
            missing = np.flatnonzero(~np.all(written, axis=0)).tolist()
            what = f"{name}: {functions[0].__name__}"
            raise ValueError(f"{what} does not write features {missing}; {rule}")


# ---- Selection of the states that a block of features uses ----

StateIndices = NDArray[np.int64]


def check_states(states: Sequence[int] | None) -> None:
    """Raise a ``ValueError`` unless ``states`` is None or a tuple of different numbers from 1."""
    if states is None:
        return
    if not isinstance(states, tuple | list) or len(states) == 0:
        rule = "must be a tuple of the numbers of states, for example (1, 2)"
        raise ValueError(f"states = {states!r}: {rule}")
    for i, state in enumerate(states):
        checks.whole(f"states[{i}]", state, 1)
    if len(set(states)) < len(states):
        raise ValueError(f"states = {states!r}: must not repeat a state")


def state_indices(
    states: Sequence[int] | None, order: int, default: int | None = None
) -> StateIndices:
    """Return the indices (k,) of ``states`` in x; by default the first ``default``, or all."""
    if states is None:
        return np.arange(order if default is None else min(order, default))
    if max(states) > order:
        rule = f"a plant of order {order} has no state {max(states)}"
        raise ValueError(f"states = {states!r}: {rule}")
    return np.array(states, dtype=np.int64) - 1


# ---- Automatic scaling ----

# Avoids division by zero and the logarithm of zero; far below any signal.
LEAST, LEAST_SINGLE = 1e-100, 1e-30
# Least scale of a derivative, as a share of the one in a motion of x_1 at the frequency ω. Chosen
# by hand; not tuned further.
_FLOOR = 1.0 / 8.0
# √2: numbers at which people let a machine rest, as 1, 2 and 10, are not near √2 2^k.
_EDGE = 2.0**0.5


class Scaling(NamedTuple):
    """Parameters, for a plant of order n."""

    floors: Vector  # least scales (n + 2,) over that of x_1: ω^(i−1)/8 for x_2 … x_n, else 0
    fixed: Flag  # whether the scales are given and do not change


@singledispatch
def scaling(observer: Any, frequency: float, fixed: bool) -> Any:
    """Return the scaling for an observer and a ``frequency`` of the plant [rad/s]."""
    floors = frequency ** np.arange(observer.order) * _FLOOR
    floors[0] = 0.0
    return Scaling(np.append(floors, [0.0, 0.0]), fixed)


def initial_scale(scaling: Scaling) -> Vector:
    """Return the scales before the first sample (n + 2,)."""
    return np.full(scaling.floors.size, LEAST)


@kernel
def least_scale(like: float) -> float:
    """Return the scale of what was always zero, in the precision of ``like``."""
    return LEAST_SINGLE if is_single(like) else LEAST


@kernel
def reset_scale(scaling: Scaling, scale: Vector) -> None:
    """Go back to the scales before the first sample, unless they are given."""
    if scaling.fixed:
        return
    for i in range(scale.size):
        scale[i] = least_scale(scale[i])


@kernel
def covering(scale: float, size: float, powers: bool) -> float:
    """Return ``scale``, or if ``size`` is larger the next that covers it.

    With ``powers`` it is a power of two, else √2 times one.
    """
    if size > scale and is_finite(size):
        edge = 1.0 if powers else _EDGE
        return edge * 2.0 ** math.ceil(log2(size / edge))
    return scale


@generic_with_default
def update_scale(
    scaling: Any, scale: Vector, estimate: Vector, u: float, f: float, powers: bool
) -> None:
    """Increase ``scale`` (n + 2,) to cover the state in ``estimate`` (n + 1,), ``u`` and ``f``.

    With ``powers`` the scales are powers of two.
    """
    if scaling.fixed:
        return
    order = scale.size - 2
    for i in range(scale.size):
        size = abs(estimate[i]) if i < order else (abs(u) if i == order else abs(f))
        size = max(size, scaling.floors[i] * scale[0], least_scale(scale[i]))
        scale[i] = covering(scale[i], size, powers)


# ---- Sizes of features that are functions of signals in the plant's units ----

Indices = NDArray[np.int64]


def unscaled_indices(features: Features, order: int) -> Indices:
    """Return the indices (k,) of the features whose size is unknown, for a plant of order n."""
    return np.flatnonzero(features.unscaled(order))


def initial_sizes(unscaled: Indices) -> Vector:
    """Return the sizes (k,) before the first sample."""
    return np.full(unscaled.size, LEAST)


@kernel
def reset_sizes(sizes: Vector) -> None:
    """Go back to the sizes before the first sample."""
    for k in range(sizes.size):
        sizes[k] = least_scale(sizes[k])


@kernel
def update_sizes(unscaled: Indices, sizes: Vector, values: Vector, powers: bool) -> bool:
    """Let ``sizes`` (k,) cover features with these unscaled ``values`` (p,); return if one grew."""
    grown = False
    for k in range(sizes.size):
        covers = covering(sizes[k], abs(values[unscaled[k]]), powers)
        grown = grown or covers > sizes[k]
        sizes[k] = covers
    return grown


@kernel
def scale_by_sizes(unscaled: Indices, sizes: Vector, values: Vector) -> None:
    """Divide features by their sizes.

    One that was always zero remains so until it has a size, and one that is not finite is zero:
    where a function of the user is not defined, it explains nothing.
    """
    for k in range(sizes.size):
        value = values[unscaled[k]]
        known = sizes[k] > least_scale(sizes[k]) and is_finite(value)
        values[unscaled[k]] = value / sizes[k] if known else 0.0


@kernel
def write_units(
    features: Any, unscaled: Indices, scale: Vector, sizes: Vector, out: Vector
) -> None:
    """Write the ``unit`` of features to ``out`` (p,), divided by their sizes."""
    unit(features, scale, out)
    for k in range(sizes.size):
        out[unscaled[k]] /= sizes[k]


# ---- The features of a linear model ----


class StateDesign(NamedTuple):
    """Parameters of ``State``."""

    width: Size


@dataclass(frozen=True)
class State(Features):
    """The estimated output and its derivatives, ``x̂_1 … x̂_count``.

    Parameters
    ----------
    count
        number of states; all n by default.
    """

    count: int | None = None

    def __post_init__(self) -> None:
        checks.optional(checks.whole, "count", self.count, 1)

    def design(self, order: int) -> StateDesign:
        """Return the number of states."""
        if self.count is not None and self.count > order:
            raise ValueError(f"count = {self.count}: a plant of order {order} has {order} states")
        return StateDesign(order if self.count is None else self.count)

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1", …)``."""
        return tuple(f"x{i + 1}" for i in range(self.design(order).width))


@write.register(StateDesign)
def _write_state(features: StateDesign, x: Vector, u: float, out: Vector) -> None:
    for i in range(features.width):
        out[i] = x[i]


@unit.register(StateDesign)
def _unit_state(features: StateDesign, scale: Vector, out: Vector) -> None:
    for i in range(features.width):
        out[i] = 1.0 / scale[i]


class BiasDesign(NamedTuple):
    """Parameters of ``Bias``: none."""


@dataclass(frozen=True)
class Bias(Features):
    """The constant 1."""

    def design(self, order: int) -> BiasDesign:
        """Return no parameters."""
        return BiasDesign()

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("bias",)``."""
        return ("bias",)

    def constant(self, order: int) -> int:
        """Return 0, the index of the only feature."""
        return 0


@write.register(BiasDesign)
def _write_bias(features: BiasDesign, x: Vector, u: float, out: Vector) -> None:
    out[0] = 1.0


unit.register(BiasDesign)(dimensionless)


class InputDesign(NamedTuple):
    """Parameters of ``Input``: none."""


@dataclass(frozen=True)
class Input(Features):
    """The applied control signal u. It must be the last block.

    A linear learner solves the loop through u exactly and keeps the effective gain in an interval;
    other learners get the u of the sample before.
    """

    def design(self, order: int) -> InputDesign:
        """Return no parameters."""
        return InputDesign()

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("u",)``."""
        return ("u",)

    @property
    def has_input(self) -> bool:
        """True: the last feature is u."""
        return True


@write.register(InputDesign)
def _write_input(features: InputDesign, x: Vector, u: float, out: Vector) -> None:
    out[0] = u


@unit.register(InputDesign)
def _unit_input(features: InputDesign, scale: Vector, out: Vector) -> None:
    out[0] = 1.0 / scale[scale.size - 2]


# ---- Monomials of the state ----

# A learner's covariance of so many features takes 8 MB, and a sample of it a millisecond.
_MOST_FEATURES = 1000


class PolynomialDesign(NamedTuple):
    """Parameters of ``Polynomial``."""

    factors: NDArray[np.int64]  # (p, degree): indices of the states to multiply; −1 for none


@dataclass(frozen=True)
class Polynomial(Features):
    """All monomials of the state of total degree 2 to ``degree``.

    They describe a spring that stiffens or a drag that grows with the square of the speed. Degree 1
    is ``State()``, degree 0 ``Bias()``.

    Parameters
    ----------
    degree
        the largest total degree.
    states
        numbers of the states, from 1; all by default.

    Raises
    ------
    ValueError
        for a degree below 2, more than a thousand monomials, or a state that the plant does not
        have.
    """

    degree: int = 3
    states: Sequence[int] | None = None

    def __post_init__(self) -> None:
        checks.whole("degree", self.degree, 2)
        check_states(self.states)

    def design(self, order: int) -> PolynomialDesign:
        """Return the table of factors."""
        chosen = state_indices(self.states, order).tolist()
        count = math.comb(len(chosen) + self.degree, len(chosen)) - 1 - len(chosen)
        if count > _MOST_FEATURES:
            raise ValueError(
                f"degree = {self.degree}: has {count:.3g} monomials of {len(chosen)} states: must "
                f"have at most {_MOST_FEATURES}; lower degree, or choose states"
            )
        rows = [
            [*factors, *[-1] * (self.degree - degree)]
            for degree in range(2, self.degree + 1)
            for factors in combinations_with_replacement(chosen, degree)
        ]
        return PolynomialDesign(np.array(rows, dtype=np.int64))

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1^2", "x1 x2", …)``."""
        return tuple(_name([int(i) for i in row if i >= 0]) for row in self.design(order).factors)


def _name(factors: list[int]) -> str:
    powers = {f"x{i + 1}": factors.count(i) for i in factors}
    return " ".join(f"{x}^{power}" if power > 1 else x for x, power in powers.items())


@write.register(PolynomialDesign)
def _write_polynomial(features: PolynomialDesign, x: Vector, u: float, out: Vector) -> None:
    factors = features.factors
    for j in range(factors.shape[0]):
        product = 1.0
        for k in range(factors.shape[1]):
            if factors[j, k] >= 0:
                product *= x[factors[j, k]]
        out[j] = product


@unit.register(PolynomialDesign)
def _unit_polynomial(features: PolynomialDesign, scale: Vector, out: Vector) -> None:
    factors = features.factors
    for j in range(factors.shape[0]):
        product = 1.0
        for k in range(factors.shape[1]):
            if factors[j, k] >= 0:
                product /= scale[factors[j, k]]
        out[j] = product


# ---- Features computed by a function of the user ----

_SIGNATURE = nb_types.void(POINTER, nb_types.float64, POINTER)


class CustomDesign(NamedTuple):
    """Parameters of ``Custom``."""

    address: int  # address of the compiled function; the cache of ``_machine_code`` keeps it alive


class Custom(Features):
    """The values of ``function(x, u)`` at the estimated state x (n,) and the control signal u.

    x_1 is in the units of y, x_2 … x_n are its derivatives by time [y-unit/s …], and u is in its
    own unit. The values may have any size: learners divide them by powers of two, so that they are
    O(1), and show the coefficients in the plant's units.

    Parameters
    ----------
    function
        a plain function that returns a tuple of numbers; Numba compiles it, and it is called by
        address.
    names
        name of each of the numbers.
    c_function
        name of the same function in C, ``void name(const double *x, double u, double *out)``, with
        ``float`` in single precision. Exported code then calls it, and does not contain a
        translation of ``function``.

    Raises
    ------
    ValueError
        if there are no names; by ``design`` if the function returns another number of values or
        can't be compiled.

    Examples
    --------
    >>> import math
    >>> gravity = Custom(lambda x, u: (math.sin(x[0]), math.cos(x[0])), names=("sin", "cos"))
    """

    def __init__(
        self, function: Callable[..., Any], names: Sequence[str], *, c_function: str | None = None
    ) -> None:
        if not callable(function):
            raise ValueError(f"function = {function!r}: must be a function f(x, u)")
        listed = isinstance(names, Sequence) and not isinstance(names, str) and len(names) > 0
        if not (listed and all(isinstance(name, str) for name in names)):
            raise ValueError(f"names = {names!r}: must be a tuple with a name for each feature")
        if len(set(names)) < len(names):
            raise ValueError(f"names = {names!r}: must not repeat a name")
        if c_function is not None and not (
            isinstance(c_function, str) and c_function.isidentifier() and c_function.isascii()
        ):
            raise ValueError(f"c_function = {c_function!r}: must be the name of a function in C")
        self.function = function
        self.c_function = c_function
        self.labels = tuple(names)

    def __repr__(self) -> str:
        name = getattr(self.function, "__name__", self.function)
        return f"Custom({name!s}, names={self.labels!r})"

    def design(self, order: int) -> CustomDesign:
        """Compile the function, for a plant of order ``order``."""
        count = len(self.labels)
        frozen(self.function)  # compiles helpers again whose globals have changed
        try:
            returned = np.shape(self.function(np.zeros(order), 0.0))
        except ArithmeticError:  # not defined at the origin, for example 1/x
            returned = (count,)
        except Exception as error:
            raise ValueError(
                f"function(zeros({order}), 0.0) fails with {type(error).__name__}: {error}"
            ) from error
        if returned != (count,):
            raise ValueError(
                f"function returns shape {returned}: must return a tuple of {count} numbers, one "
                "for each of names"
            )
        address = _machine_code(self.function, order, count).address
        set_origin(address, self.function, self.c_function)
        return CustomDesign(address)

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``names``."""
        return self.labels

    def unscaled(self, order: int) -> tuple[bool, ...]:
        """Return True for each feature: a function's values may have any size."""
        return (True,) * len(self.labels)


@kept_code(None)  # keeps the code for ever, because designs hold its address
def _machine_code(function: Callable[..., Any], order: int, count: int) -> Any:
    def features(px, u, pout):  # type: ignore[no-untyped-def]
        out = numba.carray(pout, (count,))
        found = compiled(numba.carray(px, (order,)), u)
        for j in range(count):
            out[j] = found[j]

    try:
        compiled = jit_user_function(function)
        return compile_cfunc(_SIGNATURE, features)
    except NotCompilableError as error:
        raise ValueError(
            f"function can't be compiled by Numba: {error}; it must be a plain function of numbers"
        ) from error


@write_physical.register(CustomDesign)
def _write_custom(features: CustomDesign, x: Vector, u: float, out: Vector) -> None:
    call(features.address, x, u, out)


write.register(CustomDesign)(write_nothing)
unit.register(CustomDesign)(dimensionless)
