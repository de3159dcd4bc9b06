"""Features computed by a function of the user."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numba
import numpy as np
from numba.core import types as nb_types

from quell.features.base import (
    Features,
    dimensionless,
    unit,
    write,
    write_nothing,
    write_physical,
)
from quell.kernels.function_pointers import (
    POINTER,
    NotCompilableError,
    call,
    compile_cfunc,
    jit_user_function,
    set_origin,
)
from quell.types import Vector

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


@cache  # keeps the code for ever, because designs hold its address
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
def _write(features: CustomDesign, x: Vector, u: float, out: Vector) -> None:
    call(features.address, x, u, out)


write.register(CustomDesign)(write_nothing)
unit.register(CustomDesign)(dimensionless)
