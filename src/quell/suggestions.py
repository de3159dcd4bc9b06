"""Errors of calls with an unknown keyword argument suggest the nearest name.

Python 3.13 does so itself, and nothing is changed there. On older versions a package passes its
public names to ``suggest_names``: their functions are wrapped, their classes get wrapped
constructors and wrapped methods, those that have optional parameters. A call that succeeds takes
0.1 µs longer. Kernels and methods called by position stay as they are, ``step`` above all.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterable
from types import FunctionType
from typing import Any

_NEEDED = sys.version_info < (3, 13)
# Of functions and constructors, and of each wrapper itself.
_WRAPPERS: dict[Callable[..., Any], Callable[..., Any]] = {}


def suggest_names(module: str, names: Iterable[str]) -> None:
    """Let public names of a module suggest; its file calls this when all of them exist."""
    namespace = vars(sys.modules[module])
    for name in names:
        if name in namespace:
            namespace[name] = suggesting(namespace[name], module)


def suggesting(value: Any, module: str) -> Any:
    """Return the value of a public name of ``module`` such that a call of it suggests.

    A class is returned as it is, with other constructors and methods. A function is wrapped;
    ``module``, which has to export the wrapper, becomes its home, where pickle and ``help`` look
    for it.
    """
    if not _NEEDED:
        return value
    if isinstance(value, type) and value.__module__.startswith("quell."):
        _wrap_constructors(value)
        for base in value.__mro__:
            if base.__module__.startswith("quell."):
                _wrap_methods(base)
    elif isinstance(value, FunctionType) and not _stays(value):
        if value not in _WRAPPERS:
            _wrapper(value).__module__ = module
        return _WRAPPERS[value]
    return value


def _stays(function: FunctionType) -> bool:
    """Return whether a wrapper would be in the way: of a kernel's registry, or of a stack level."""
    return hasattr(function, "implementations") or "stacklevel" in function.__code__.co_varnames


def _wrap_constructors(cls: Any) -> None:
    """Wrap ``__init__``, ``__new__`` of a NamedTuple, and class methods."""
    for name, value in list(vars(cls).items()):
        function = getattr(value, "__func__", value)
        if not isinstance(function, FunctionType):
            continue
        if isinstance(value, classmethod) and not name.startswith("_"):
            setattr(cls, name, classmethod(_wrapper(function)))
        elif name == "__new__" and issubclass(cls, tuple):
            setattr(cls, name, staticmethod(_wrapper(function)))
        elif name == "__init__":
            setattr(cls, name, _wrapper(function))


def _wrap_methods(cls: Any) -> None:
    """Wrap the public methods with optional parameters: what is called with keyword arguments."""
    for name, value in list(vars(cls).items()):
        if name.startswith("_") or not isinstance(value, FunctionType) or _stays(value):
            continue
        if value.__defaults__ or value.__kwdefaults__:
            setattr(cls, name, _wrapper(value))


def _wrapper(function: Callable[..., Any]) -> Any:
    """Return a function that calls the given one and suggests a name if that is not possible."""
    if function in _WRAPPERS:
        return _WRAPPERS[function]

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except TypeError as error:
            # With a further frame the function has begun, so that the call itself was in order.
            begun = error.__traceback__ is None or error.__traceback__.tb_next is not None
            hint = "" if begun else _hint(function, kwargs)
            if not hint:
                raise
            raise TypeError(f"{error}. {hint}") from None

    _WRAPPERS[function] = _WRAPPERS[call] = call
    return call


def _hint(function: Callable[..., Any], given: Iterable[str]) -> str:
    """Return the suggestion of Python 3.13 for the first unknown name, "" if there is none."""
    import difflib
    import inspect

    parameters = inspect.signature(function).parameters
    unknown = [name for name in given if name not in parameters]
    near = difflib.get_close_matches(unknown[0], [*parameters], n=1) if unknown else ()
    return f"Did you mean {near[0]!r}?" if near else ""
