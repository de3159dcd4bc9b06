"""Generic functions over NamedTuple types, compiled and interpreted alike.

An algorithm is written once, as a plain function of immutable parameters (a NamedTuple of floats
and arrays) and explicit state (a NamedTuple of arrays), under one of these decorators:

``kernel``
    a plain helper; interpreted when called from Python, inlined when called from compiled code.
``generic``
    a function with one implementation for each NamedTuple type of its first argument. Compiled code
    selects it by Numba's overload resolution, at no cost at run time; interpreted code by a table.
``for_each``
    makes a function of one entry of tuples, as of the axes of a machine, one of all entries.
``compiled``
    an entry point, compiled once for each combination of types and cached on disk (``cache``).
"""

from __future__ import annotations

import functools
import gc
import inspect
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from types import FunctionType
from typing import Any, ParamSpec, Protocol, TypeAlias, TypeVar, cast

import numba
import numpy as np
from numba import types as nb_types
from numba.extending import overload, register_jitable

from quell.kernels.cache import code_cache
from quell.kernels.frozen import Frozen, frozen
from quell.kernels.functions import is_single
from quell.kernels.linking import KERNEL_OPTIONS, OPTIONS, EntryCompiler, WithoutOverlaps
from quell.kernels.numba_internals import NumbaError
from quell.kernels.sized import layout_of, type_of

# ---- Check whether arguments of a compiled loop share memory that the loop changes ----

Arrays: TypeAlias = Sequence[np.ndarray]


def overlap(read: Arrays, written: Arrays) -> bool:
    """Return whether an array that is written overlaps another one."""
    owners = [_owner(array) for array in written]
    if None not in owners and len({*owners}) == len(owners):
        others = {_owner(array) for array in read}
        if None not in others and others.isdisjoint(owners):
            return False  # arrays with different owners are apart
    bounds = [(*np.lib.array_utils.byte_bounds(array), False) for array in read]
    bounds += [(*np.lib.array_utils.byte_bounds(array), True) for array in written]
    end, last_is_written = -1, False  # of the arrays so far, the one that ends last
    for first, after, is_written in sorted(bounds):
        if first < end and (is_written or last_is_written):
            return True
        if after > end:
            end, last_is_written = after, is_written
    return False


def _owner(array: Any) -> int | None:
    """Return the identity of the array that owns the memory; None if that is another object."""
    base = array.base
    return id(array) if base is None else id(base) if type(base) is np.ndarray else None


# ---- Types with implementations that the user registered, and errors of compiling these ----

# Types with implementations from outside of this package, and their names in messages.
_USER_TYPES: dict[type, str] = {}

# Their implementations, by the name of the generic function, and those that were compiled.
_IMPLEMENTED: dict[type, dict[str, Callable[..., Any]]] = {}
_COMPILED: dict[tuple[type, str], Frozen] = {}

# Lines of Numba's error text that carry no reason.
_NO_REASON = re.compile(
    r"\W*$|There are \d|- Of which|Overload in|With argument|Rejected as|- Resolution|"
    r"(\w+Error: )?Failed in nopython"
)


def add_user_type(cls: type, name: str, implementation: Callable[..., Any]) -> None:
    """Add a type for which the user has registered an implementation of the function ``name``."""
    _USER_TYPES.setdefault(cls, cls.__name__)
    _IMPLEMENTED.setdefault(cls, {})[name] = implementation


def set_display_name(cls: type, name: str) -> None:
    """Use ``name`` for a user's type in messages: users know the class that makes it better."""
    if cls in _USER_TYPES:
        _USER_TYPES[cls] = name


def uses_user_types(value: Any) -> bool:
    """Return whether ``value``, or an entry of a tuple at any depth, is of a user's type."""
    if not _USER_TYPES:
        return False
    return type(value) in _USER_TYPES or (
        isinstance(value, tuple) and any(map(uses_user_types, value))
    )


def check_implementations(value: Any) -> None:
    """Raise a ``ValueError`` if implementations for user's types in ``value`` have changed.

    Numba compiles them only once for each type, so compiled code would be that of the first ones.
    """
    cls = type(value)
    for name, implementation in _IMPLEMENTED.get(cls, {}).items():
        now = frozen(implementation)
        if _COMPILED.setdefault((cls, name), now) != now:
            raise ValueError(
                f"{_USER_TYPES[cls]}.{name} (for {cls.__name__}) has been compiled, and it or a "
                "global that it uses has changed since: make such numbers fields of "
                f"{cls.__name__}, or define {cls.__name__} and its functions again. "
                "simulate(..., interpret=True) runs it as it is now"
            )
    if isinstance(value, tuple):
        for each in value:
            check_implementations(each)


@contextmanager
def explain_compile_errors(*arguments: Any) -> Iterator[None]:
    """Replace Numba's error about a user's function by a ``ValueError`` with one line."""
    try:
        yield
    except NumbaError as error:
        message = _explanation(str(error)) if any(map(uses_user_types, arguments)) else ""
        if not message:
            raise
        raise ValueError(message) from None


def _explanation(text: str) -> str:
    """Return the error of the innermost user's function in Numba's text; empty if there is none."""
    names = {cls.__name__: name for cls, name in _USER_TYPES.items()}
    calls = [found for found in re.finditer(r">>> (\w+)\((\w+)\(", text) if found[2] in names]
    if not calls:
        return ""
    rest = text[calls[-1].end() :]
    lines = [line.strip() for line in rest.splitlines()[1:]]
    reason = next((line for line in lines if not _NO_REASON.match(line)), "no reason given")
    allocates = "NRT required" in rest or "Only accept returning of array" in rest
    return (
        f"{names[calls[-1][2]]}.{calls[-1][1]} (for {calls[-1][2]}) "
        f"{'allocates memory' if allocates else 'can not be compiled'} "
        f"({reason.removesuffix(' found for signature:')}): use loops over numbers and arrays that "
        "are there from the start, as fields of the memory; no new arrays, no lists, no slices "
        "that are assigned to. simulate(..., interpret=True) runs it as Python"
    )


# ---- Generic functions over NamedTuple types, compiled and interpreted alike ----

F = TypeVar("F", bound=Callable[..., Any])
P = ParamSpec("P")
R_co = TypeVar("R_co", covariant=True)


class Generic(Protocol[P, R_co]):
    """A function with one implementation for each type of its first argument."""

    __name__: str
    implementations: dict[type, Callable[..., Any]]

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R_co:
        """Call the implementation for the type of the first argument; all arguments by position."""

    def register(self, cls: type) -> Callable[[F], F]:
        """Return a decorator that makes a function the implementation for ``cls``."""


_LARGEST, _LARGEST_SINGLE = sys.float_info.max, float(np.finfo(np.float32).max)

interpret_all = bool(numba.config.DISABLE_JIT)
"""Whether entry points run as plain Python wherever they are called by ``specialised``: for tests
that are not about compiled code, and with ``NUMBA_DISABLE_JIT=1``."""
_as_python: ContextVar[bool] = ContextVar("as_python", default=False)


def kernel(function: F) -> F:
    """Mark a helper that runs interpreted from Python and compiled from compiled code."""
    return register_jitable(**OPTIONS, **KERNEL_OPTIONS)(function)


def generic(declaration: Callable[P, R_co]) -> Generic[P, R_co]:
    """Make a generic function from its declaration, whose docstring is the contract.

    ``declaration.register(Type)`` decorates the implementation for the NamedTuple ``Type`` of the
    first argument; ``declaration.implementations`` is the table of them. The one for ``object`` is
    used for all types without their own.

    Raises
    ------
    TypeError
        on a call, when no implementation is registered for the first argument's type.
    """
    name = declaration.__name__
    table: dict[type | None, Callable[..., Any]] = {}

    @functools.wraps(declaration)
    def call(head: Any, *rest: Any) -> Any:
        implementation = table.get(type(head)) or table.get(object)
        if implementation is None:
            cls = type(head).__name__
            raise TypeError(
                f"{name}() has no implementation for {cls}; register one with "
                f"@{name}.register({cls}) before the first run"
            )
        return implementation(head, *rest)

    def resolve(head: Any, *rest: Any) -> Any:
        cls = tuple if isinstance(head, nb_types.BaseTuple) else None
        if isinstance(head, nb_types.BaseNamedTuple):
            cls = getattr(head, "instance_class", None)
        return table.get(cls) or table.get(object)

    def register(cls: type) -> Callable[[F], F]:
        def add(implementation: F) -> F:
            table[cls] = implementation
            if not implementation.__module__.startswith("quell."):
                add_user_type(cls, name, implementation)
            return implementation

        return add

    overload(call, strict=False, jit_options=OPTIONS | KERNEL_OPTIONS)(resolve)
    call.register = register  # type: ignore[attr-defined]
    call.implementations = table  # type: ignore[attr-defined]
    return cast("Generic[P, R_co]", call)


def generic_with_default(declaration: Callable[P, R_co]) -> Generic[P, R_co]:
    """Make a generic function whose declaration implements it for all types without their own."""
    function = generic(declaration)
    function.register(object)(declaration)
    return function


def for_each(name: str, function: Callable[..., Any], tuples: int = 2) -> Callable[..., Any]:
    """Return a function of tuples that calls ``function`` for their entries, one after the other.

    The entries may be of different types, so a loop can't be compiled: the calls stand in a row, in
    compiled code and in C, too::

        def ask_axis(axis, state, i, flags, r, y): ...      # returns the flags, own ones added
        ask_axes = for_each("ask_axes", ask_axis)

        flags = ask_axes(axes, states, flags, r, y)

    Parameters
    ----------
    name
        of the returned function.
    function
        a kernel, or a generic function of the first entry: it takes an entry of each tuple, their
        index if its next parameter is ``i``, and what all entries share. If it returns a
        value, that is the first of these for the next entry, and of the last entry the result.
    tuples
        number of the tuples, all of one length.
    """
    parameters = [*inspect.signature(function).parameters]
    indexed = parameters[tuples : tuples + 1] == ["i"]
    heads, shared = parameters[:tuples], parameters[tuples + indexed :]
    returns = function.__annotations__["return"] != "None"
    of_one = function if hasattr(function, "implementations") else kernel(function)
    floats = {each for each in shared if function.__annotations__[each] == "float"}
    typed = [f"{each}: float" if each in floats else each for each in shared]

    @functools.cache
    def unrolled(count: int) -> Any:
        lines = [f"def {name}({', '.join([*heads, *typed])}):"]
        for i in range(count):
            entries = [f"{head}[{i}]" for head in heads]
            entries += [str(i)] if indexed else []
            call = f"{function.__name__}({', '.join([*entries, *shared])})"
            lines.append(f"    {f'{shared[0]} = ' if returns else ''}{call}")
        lines.append(f"    return {shared[0]}" if returns else "    return")
        names = {function.__name__: of_one, "__name__": function.__module__}
        exec("\n".join(lines), names)
        found: Any = names[name]
        found.source = "\n".join(lines)
        return found

    def call(head: Any, *rest: Any) -> Any:
        return unrolled(len(head))(head, *rest)

    def resolve(head: Any, *rest: Any) -> Any:
        return unrolled(len(head))

    call.__name__, call.__module__, call.__doc__ = name, function.__module__, function.__doc__
    overload(call, strict=False, jit_options=OPTIONS | KERNEL_OPTIONS)(resolve)
    call.unrolled = unrolled  # type: ignore[attr-defined]
    return call


@kernel
def is_finite(value: float) -> bool:
    """Return whether ``value`` is finite.

    ``math.isfinite`` tests in compiled code whether x − x is a number. Where a compiler may
    re-order sums, and x is one, x − x becomes zero before the test. A comparison is always right.
    """
    return abs(value) <= (_LARGEST_SINGLE if is_single(value) else _LARGEST)


def compiled(function: F) -> F:
    """Compile an entry point for the types it is called with; it runs without the interpreter lock.

    Reference counting is switched off: it would cost more than the arithmetic, and without it Numba
    refuses to compile code that allocates memory, which proves that kernels allocate none.
    """
    return _dispatcher(function, nogil=True, _nrt=False)


def compiled_loop(*read_only: str) -> Callable[[F], F]:
    """Return a decorator as ``compiled``, for a function that runs for many samples.

    It writes to no array in its arguments ``read_only``. If none of the others overlaps another
    array, ``specialised`` returns code that relies on that, and is quicker; else code that does
    not.
    """

    def decorate(function: F) -> F:
        plain: Any = FunctionType(function.__code__, function.__globals__, function.__name__)
        plain.__qualname__ = f"{function.__qualname__}_with_overlaps"  # the name in the disk cache
        entry = _dispatcher(function, nogil=True, _nrt=False, pipeline_class=WithoutOverlaps)
        entry.with_overlaps = _dispatcher(plain, nogil=True, _nrt=False)
        names = inspect.signature(function).parameters
        entry.read_only = {i for i, name in enumerate(names) if name in read_only}
        return cast("F", entry)

    return decorate


def compiled_call(function: F) -> F:
    """Compile an entry point for short calls from Python: it keeps the interpreter lock."""
    return _dispatcher(function, _nrt=False)


def specialised(entry: Any, *arguments: Any) -> Any:
    """Return an entry point compiled for arguments like these: shapes and constants included.

    See ``kernels/sized.py``. It does not check the types of its arguments: call it with arguments
    of the same types, shapes and constants only.
    """
    if interpret_all or _as_python.get():
        return entry.plain
    dispatcher, layouts = _dispatcher_and_layouts(entry, arguments)
    found = dispatcher.specialised.get(layouts)
    if found is None:
        with _without_garbage_collection():
            found = _call_deep(dispatcher.compile, tuple(map(type_of, arguments)))
        dispatcher.specialised[layouts] = found
    return found


def _call_deep(function: Callable[[Any], Any], argument: Any) -> Any:
    """Call a function that calls many others inside each other, with room for all their frames.

    Python keeps frames in chunks of 16 kB, and gives a chunk back to the system as soon as it is
    empty. The compiler calls some functions a hundred thousand times at the end of a chunk. This
    function's own frame asks for a chunk of a megabyte, which the frames above it share: 6 % of the
    time.
    """
    return function(argument)


_call_deep.__code__ = _call_deep.__code__.replace(co_stacksize=90_000)  # words


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Spare the garbage collector the objects of the compiler, which live long: 5 % of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def is_available(entry: Any, *arguments: Any) -> bool:
    """Return whether ``specialised`` has no need to compile: its code is here, or on the disk."""
    if interpret_all or _as_python.get():
        return True
    dispatcher, _ = _dispatcher_and_layouts(entry, arguments)
    types = tuple(map(type_of, arguments))
    if types in dispatcher.overloads:
        return True
    return dispatcher._cache.load_overload(types, dispatcher.targetctx) is not None


def _dispatcher_and_layouts(entry: Any, arguments: tuple[Any, ...]) -> tuple[Any, tuple[Any, ...]]:
    """Return the dispatcher whose assumptions hold for the arguments, and their layouts."""
    read: list[Any] = []
    written: list[Any] = []
    read_only = getattr(entry, "read_only", ())
    layouts = tuple(
        layout_of(argument, False, read if i in read_only else written)
        for i, argument in enumerate(arguments)
    )
    if read_only and overlap(read, written):
        entry = entry.with_overlaps
    return dispatcher_for(entry, *arguments), layouts


@contextmanager
def as_python() -> Iterator[None]:
    """Make ``specialised`` return plain Python inside the ``with`` block."""
    token = _as_python.set(True)
    try:
        yield
    finally:
        _as_python.reset(token)


def call_specialised(entry: Any, *arguments: Any) -> Any:
    """Call an entry point, ``specialised`` for its arguments."""
    return specialised(entry, *arguments)(*arguments)


def dispatcher_for(entry: Any, *arguments: Any) -> Any:
    """Return the dispatcher of an entry point to call with ``arguments``.

    If the user has registered implementations for one of their types, at any depth, it has no disk
    cache: the cache would not notice an edit of those implementations.

    Raises
    ------
    ValueError
        if such an implementation has changed since it was compiled.
    """
    if not any(map(uses_user_types, arguments)):
        return entry
    check_implementations(arguments)
    return entry.uncached


def compilations(entry: Any) -> int:
    """Return how often an entry point was compiled in this process, not loaded from the disk."""
    return int(sum(entry.stats.cache_misses.values()))


def interpreted(function: Any) -> Any:
    """Return the plain Python function of a compiled entry point; a plain function itself."""
    return getattr(function, "py_func", function)


def _plain(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that runs as Python and, like compiled code, without NumPy's warnings."""

    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        with np.errstate(all="ignore"):
            return function(*arguments)

    return run


def _dispatcher(function: Any, **options: Any) -> Any:
    """Return a dispatcher with a disk cache if possible; its ``uncached`` is one without."""
    options = {"pipeline_class": EntryCompiler} | OPTIONS | options
    dispatcher = numba.njit(function, **options)
    dispatcher.uncached, dispatcher.specialised = dispatcher, {}
    dispatcher.plain = _plain(function)
    cache = code_cache(function)
    if cache is not None:
        dispatcher.uncached = numba.njit(function, **options)
        dispatcher.uncached.specialised = {}
        dispatcher._cache = cache  # what ``cache=True`` does with Numba's own
    return dispatcher
