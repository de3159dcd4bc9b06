"""Machine code of a user's differential equation whose parameters are numbers by name.

The numbers are an array beside the addresses of the code: other numbers need no other code.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any

import numba
import numpy as np
from numba.core import types as nb_types
from numba.np.unsafe.ndarray import to_fixed_tuple

from quell import checks
from quell.kernels import function_pointers
from quell.kernels.function_pointers import POINTER
from quell.types import Vector

_RATE_SIGNATURE = nb_types.void(
    nb_types.float64, POINTER, nb_types.float64, POINTER, POINTER, POINTER
)
_OUTPUT_SIGNATURE = nb_types.float64(POINTER, POINTER)
# Pairs of functions whose code is kept, for plants that are made again with other numbers. Chosen
# by hand: more than the plants of a study.
_KEPT = 32


def named_parameters(function: Callable[..., Any], first: int) -> dict[str, Any]:
    """Return the parameters of a function after its ``first`` ones, and their defaults."""
    try:
        takes = [*inspect.signature(function).parameters.values()][first:]
    except (TypeError, ValueError):
        return {}
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return {each.name: each.default for each in takes if each.kind not in variable}


def checked_parameters(
    given: Mapping[str, Any], f: Callable[..., Any], output: Any
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the numbers that f and the output take after (t, x, u, w) and (x), in their order.

    Raises
    ------
    ValueError
        for a name that neither takes, a missing one, or a value that is no finite number.
    """
    if not isinstance(given, Mapping):
        raise ValueError(f"parameters = {given!r:.60}: must be numbers by name")
    taken = named_parameters(f, 4), named_parameters(output, 1) if callable(output) else {}
    known = list(dict.fromkeys([*taken[0], *taken[1]]))
    for name in given:
        if name not in known:
            hint = checks.nearest(str(name), known) if known else "f takes (t, x, u, w) only"
            raise ValueError(f"parameters[{name!r}]: is no argument of f or output; {hint}")
    found = []
    for names in taken:
        values = {}
        for name, default in names.items():
            value = given.get(name, default)
            if value is inspect.Parameter.empty:
                raise ValueError(f"parameters: {name} is missing, f or output takes it")
            values[name] = checks.finite(f"parameters[{name!r}]", value)
        found.append(values)
    return found[0], found[1]


def bound(function: Callable[..., Any], values: Mapping[str, float]) -> Callable[..., Any]:
    """Return a function with its numbers given, for Python."""
    return partial(function, **values) if values else function


@lru_cache(maxsize=_KEPT)
def row_output(row: tuple[float, ...]) -> Callable[[Vector], float]:
    """Return the function ``C x`` of a row C."""

    def linear(x: Vector) -> float:
        y = 0.0
        for i in range(len(row)):
            y += row[i] * x[i]
        return y

    return linear


@lru_cache(maxsize=_KEPT)
def machine_code(
    rate_of: Callable[..., Any],
    output_of: Callable[..., Any],
    sizes: tuple[int, int],
    counts: tuple[int, int],
) -> tuple[Any, Any]:
    """Return the compiled f and output, which take a pointer to all numbers as well.

    Parameters
    ----------
    rate_of, output_of
        the user's functions.
    sizes
        numbers of states and of disturbances.
    counts
        numbers of parameters of f and of the output, which follow each other in the array.

    Raises
    ------
    NotCompilableError
        if Numba can't compile a function.
    """
    (n, m), (own, more) = sizes, counts
    every = own + more
    f = function_pointers.jit_user_function(rate_of)
    h = function_pointers.jit_user_function(output_of)

    def rate(t, px, u, pw, pp, pdx):  # type: ignore[no-untyped-def]
        dx = numba.carray(pdx, (n,))
        values = to_fixed_tuple(numba.carray(pp, (every,))[:own], own)
        derivatives = f(t, numba.carray(px, (n,)), u, numba.carray(pw, (m,)), *values)
        for i in range(n):
            dx[i] = derivatives[i]

    def output(px, pp):  # type: ignore[no-untyped-def]
        values = to_fixed_tuple(numba.carray(pp, (every,))[own:], more)
        return h(numba.carray(px, (n,)), *values)

    compile_cfunc = function_pointers.compile_cfunc
    return compile_cfunc(_RATE_SIGNATURE, rate), compile_cfunc(_OUTPUT_SIGNATURE, output)


def as_array(*values: Mapping[str, float]) -> Vector:
    """Return all numbers in their order."""
    return np.array([number for each in values for number in each.values()])
