"""Values that compiled code has frozen of a user's function; the code is kept while they hold.

Numba makes constants of the globals of a function and of the variables of enclosing functions. In a
notebook they change while the function stays the same object, so the function alone does not tell
which code is its own.
"""

from __future__ import annotations

import dis
import hashlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache, wraps
from types import CodeType, FunctionType, ModuleType
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

# Functions whose names are kept. Chosen by hand: more than those of a study.
_FUNCTIONS = 256
# Packages whose functions and constants do not change.
_LIBRARIES = frozenset({"numba", "numpy", "quell", "scipy"})
# What helpers took from outside when they were compiled.
_compiled_with: WeakKeyDictionary[Any, tuple[Any, ...]] = WeakKeyDictionary()


class _Itself:
    """A value that equals only itself."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Itself) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


@dataclass(frozen=True)
class Frozen:
    """A user's function; equal to another one if the code that Numba makes of both is the same."""

    function: Callable[..., Any] = field(compare=False)
    data: tuple[Any, ...]


def frozen(function: Callable[..., Any]) -> Frozen:
    """Return a function with all that becomes constant in its code.

    That are its instructions and defaults, the variables of enclosing functions and the globals
    that it names: numbers, texts, the contents of arrays and tuples, and what modules have under
    the names in it; and the same of the helpers that it calls. Other objects count by identity.

    Numba keeps the code of a helper under ``numba.njit``, too: it is compiled again if any of this
    has changed, or may have changed before it was first seen here. So call this before the first
    trial of a function as well.
    """
    found = _reached(function)
    for helper in found:  # those that are called come before those that call them
        if hasattr(helper, "recompile"):
            now = _all_taken(helper)
            if _compiled_with.get(helper) != now:
                _compiled_with[helper] = now
                if helper.overloads and any(len(taken) > 2 for taken in now):  # any from outside
                    with suppress(Exception):  # it is raised again where the helper is called
                        helper.recompile()
    return Frozen(function, (_Itself(function), *found.values()))


def kept_code(most: int | None) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that keeps the last ``most`` results of a function that compiles.

    Arguments are functions of users, which count with what is ``frozen`` of them, and hashable
    values.
    """

    def decorate(build: Callable[..., Any]) -> Callable[..., Any]:
        @lru_cache(maxsize=most)
        def kept(*given: Any) -> Any:
            return build(*(each.function if isinstance(each, Frozen) else each for each in given))

        @wraps(build)
        def code(*given: Any) -> Any:
            return kept(*(frozen(each) if callable(each) else each for each in given))

        return code

    return decorate


def outdated_helper(function: Callable[..., Any]) -> Any:
    """Return a helper of a function that Numba has compiled with other values; None if none is.

    It is one under ``register_jitable``, which Numba compiles only once. Call this before each
    compilation: it notes what helpers take from outside.
    """
    for helper in _reached(function):
        if not hasattr(helper, "recompile") and helper is not function:
            now = _all_taken(helper)
            if _compiled_with.setdefault(helper, now) != now:
                return helper
    return None


def _reached(function: Any) -> dict[Any, tuple[Any, ...]]:
    """Return what a function and all helpers that it calls take from outside, itself as the last.

    There is nothing for what is no function.
    """
    found: dict[Any, tuple[Any, ...]] = {}
    begun = set()

    def reach(each: Any) -> None:
        if each not in begun:
            begun.add(each)
            helpers: list[Any] = []
            taken = _taken(getattr(each, "py_func", each), helpers)
            for helper in helpers:
                reach(helper)
            found[each] = taken

    if isinstance(getattr(function, "py_func", function), FunctionType):
        reach(function)
    return found


def _all_taken(helper: Any) -> tuple[Any, ...]:
    """Return what a helper and all that it calls take from outside."""
    return tuple(_reached(helper).values())


def _taken(function: FunctionType, helpers: list[Any]) -> tuple[Any, ...]:
    """Return what a function takes from outside, and add the helpers that it calls to the list."""
    code = function.__code__
    named, names = _names(code)
    taken = [(name, function.__globals__[name]) for name in named if name in function.__globals__]
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # a variable without a value yet
            taken.append((name, cell.cell_contents))
    taken.append(("=", (function.__defaults__, *(function.__kwdefaults__ or {}).values())))
    values = ((name, _comparable(value, names, helpers)) for name, value in taken)
    return (code, *values)


@lru_cache(maxsize=_FUNCTIONS)
def _names(code: CodeType) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of globals, and those of globals and attributes, also in inner functions."""
    named = [each.argval for each in dis.get_instructions(code) if each.opname == "LOAD_GLOBAL"]
    names = [*code.co_names]
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            for found, more in zip((named, names), _names(inner), strict=True):
                found.extend(more)
    return tuple(dict.fromkeys(named)), tuple(dict.fromkeys(names))


def _comparable(value: Any, names: tuple[str, ...], helpers: list[Any]) -> Any:
    """Return what is equal, and has the same hash, for the same constant in compiled code."""
    if isinstance(value, np.ndarray | np.generic):
        flags = value.flags
        layout = str(value.dtype), value.shape, flags.c_contiguous, flags.f_contiguous
        return type(value), *layout, hashlib.blake2b(value.tobytes()).digest()
    if value is None or isinstance(value, int | float | complex | str | bytes):
        return type(value), repr(value)  # nan is equal to nan, 0.0 not to −0.0
    if isinstance(value, tuple):
        return type(value), *(_comparable(each, names, helpers) for each in value)
    plain = getattr(value, "py_func", value)
    home = value.__name__ if isinstance(value, ModuleType) else getattr(plain, "__module__", None)
    if (home or "").partition(".")[0] in _LIBRARIES:
        return _Itself(value)
    if isinstance(value, ModuleType):
        held = vars(value)
        # Modules may lead in a circle: each name is followed once.
        return _Itself(value), *(
            (name, _comparable(held[name], names[:i] + names[i + 1 :], helpers))
            for i, name in enumerate(names)
            if name in held
        )
    if isinstance(plain, FunctionType):
        helpers.append(value)
    return _Itself(value)
