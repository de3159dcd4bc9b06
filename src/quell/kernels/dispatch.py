"""Generic functions over NamedTuple types, compiled and interpreted alike.

An algorithm is written once, as a plain function of immutable parameters (a NamedTuple of floats and arrays) and explicit state
(a NamedTuple of arrays). Three decorators are all there is:

``kernel``
    a plain helper; interpreted when called from Python, inlined when called from compiled code.
``generic``
    a function with one implementation for each NamedTuple type of its first argument. The choice is made by the type: when
    compiling by Numba's overload resolution, so it costs nothing at run time; when interpreting by a dictionary.
``compiled``
    an entry point, compiled once for each combination of types and cached on disk.

Numba's own disk cache looks only at the file a function stands in. A kernel here calls kernels in other files, so the cache
directory is named after a hash of all of the package's sources (and Numba's version): an edit anywhere starts a new one.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeVar, cast

import numba
import platformdirs
from numba.core import config as numba_config
from numba.core import types as nb_types
from numba.core.errors import NumbaError
from numba.extending import overload, register_jitable

from quell.kernels.linking import KERNEL_OPTIONS

F = TypeVar("F", bound=Callable[..., Any])
P = ParamSpec("P")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)


class Generic(Protocol[P, R_co]):
    """A generic function: called as its declaration says, with one implementation for each type of its first argument."""

    __name__: str
    implementations: dict[type, Callable[..., Any]]

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R_co:
        """Call the implementation for the type of the first argument; all arguments by position."""

    def register(self, cls: type) -> Callable[[F], F]:
        """Return a decorator that makes a function the implementation for ``cls``."""


# Fused multiply-add and re-ordered sums, but NaN and Inf keep their meaning: guards test for them. Inlining is forced because a
# NamedTuple of arrays is passed as some eighty words, which costs more than most kernels do.
OPTIONS: dict[str, Any] = {
    "fastmath": {"contract", "reassoc", "nsz"},
    "error_model": "numpy",
    "forceinline": True,
}

_CACHES_KEPT = 4
_LARGEST = sys.float_info.max
# Types with implementations from outside of this package, and what they are called in messages.
_FOREIGN: dict[type, str] = {}


def kernel(function: F) -> F:
    """Mark a helper that runs interpreted from Python and compiled from compiled code."""
    return register_jitable(**OPTIONS, **KERNEL_OPTIONS)(function)


def generic(declaration: Callable[P, R]) -> Generic[P, R]:
    """Make a generic function out of its declaration, whose docstring is the contract.

    ``declaration.register(Type)`` decorates the implementation for the NamedTuple ``Type`` of the first argument;
    ``declaration.implementations`` is the table of them. What is registered for ``object`` serves all types without one of their own.

    Raises
    ------
    TypeError
        on a call, when no implementation is registered for the first argument's type.
    """
    table: dict[type, Callable[..., Any]] = {}

    @functools.wraps(declaration)
    def call(head: Any, *rest: Any) -> Any:
        implementation = table.get(type(head)) or table.get(object)
        if implementation is None:
            raise TypeError(_no_implementation(declaration.__name__, type(head).__name__))
        return implementation(head, *rest)

    def resolve(head: Any, *rest: Any) -> Any:
        cls = (
            getattr(head, "instance_class", None)
            if isinstance(head, nb_types.BaseNamedTuple)
            else None
        )
        return table.get(cls) or table.get(object)  # type: ignore[arg-type]

    def register(cls: type) -> Callable[[F], F]:
        def add(implementation: F) -> F:
            table[cls] = implementation
            if not implementation.__module__.startswith("quell."):
                _FOREIGN.setdefault(cls, cls.__name__)
            return implementation

        return add

    overload(call, strict=False, jit_options=OPTIONS | KERNEL_OPTIONS)(resolve)
    call.register = register  # type: ignore[attr-defined]
    call.implementations = table  # type: ignore[attr-defined]
    return cast("Generic[P, R]", call)


@kernel
def is_finite(value: float) -> bool:
    """Say whether ``value`` is a number.

    ``math.isfinite`` will not do in compiled code: it asks whether ``x − x`` is a number, and where x is itself a sum, reordering sums
    makes that zero before it is asked. A comparison stays.
    """
    return abs(value) <= _LARGEST


def compiled(function: F) -> F:
    """Compile an entry point for the types it is called with; keep the code on disk; release the interpreter while it runs.

    Reference counting is switched off: it would cost more than the arithmetic, and without it Numba refuses to compile whatever
    allocates memory, so that compiled kernels provably do not.
    """
    return _dispatcher(function, nogil=True, _nrt=False)


def compiled_call(function: F) -> F:
    """Compile an entry point for calls one at a time from Python, on a handle (``structref``): counts references, keeps the interpreter."""
    return _dispatcher(function)


def for_types(entry: Any, *arguments: Any) -> Any:
    """Return the dispatcher of an entry point to call with ``arguments``.

    Where one of their types, at any depth, has implementations outside of this package, it is one without disk cache: the cache would not
    notice that those have changed.
    """
    return (
        entry.uncached
        if _FOREIGN and any(_is_foreign(argument) for argument in arguments)
        else entry
    )


def call_it(cls: type, name: str) -> None:
    """Call a type from outside of this package ``name`` in messages: its user knows the class that makes it better."""
    if cls in _FOREIGN:
        _FOREIGN[cls] = name


@contextmanager
def compiling(*arguments: Any) -> Iterator[None]:
    """Around the first call of an entry point with ``arguments``: what Numba says of code from outside of this package, in a line.

    Raises
    ------
    ValueError
        where such code can't be compiled, or allocates memory.
    """
    try:
        yield
    except NumbaError as error:
        told = _blame(str(error)) if any(map(_is_foreign, arguments)) else ""
        if not told:
            raise
        raise ValueError(told) from None


# What Numba says before it comes to the point.
_PREAMBLE = re.compile(
    r"\W*$|There are \d|- Of which|Overload in|With argument|Rejected as|- Resolution|(\w+Error: )?Failed in nopython"
)


def _blame(text: str) -> str:
    """Return what is wrong with the innermost function from outside of this package that Numba was at; nothing where there is none."""
    names = {cls.__name__: name for cls, name in _FOREIGN.items()}
    calls = [found for found in re.finditer(r">>> (\w+)\((\w+)\(", text) if found[2] in names]
    if not calls:
        return ""
    rest = text[calls[-1].end() :]
    lines = [line.strip() for line in rest.splitlines()[1:]]
    reason = next(
        (line for line in lines if not _PREAMBLE.match(line)), "no reason given"
    ).removesuffix(" found for signature:")
    fault = (
        "allocates memory"
        if "NRT required" in rest or "Only accept returning of array" in rest
        else "can not be compiled"
    )
    return (
        f"{names[calls[-1][2]]}.{calls[-1][1]} (for {calls[-1][2]}) {fault} ({reason}): use loops over numbers and arrays that are there "
        "from the start, as fields of the memory; no new arrays, no lists, no slices that are assigned to. "
        "simulate(..., interpret=True) runs it as Python"
    )


def compilations(entry: Any) -> int:
    """Return how many times an entry point was compiled in this process, rather than loaded from the disk cache."""
    return int(sum(entry.stats.cache_misses.values()))


def _is_foreign(value: Any) -> bool:
    return type(value) in _FOREIGN or (isinstance(value, tuple) and any(map(_is_foreign, value)))


def _dispatcher(function: Any, **options: Any) -> Any:
    """Return a dispatcher with disk cache, where that can be had; ``uncached`` is its twin without."""
    options |= OPTIONS
    uncached = numba.njit(function, **options)
    if cache_path() is None:
        uncached.uncached = uncached
        return uncached
    before = numba_config.CACHE_DIR
    numba_config.CACHE_DIR = str(cache_path())
    try:
        cached = numba.njit(function, cache=True, **options)
    finally:
        numba_config.CACHE_DIR = before
    cached.uncached = uncached
    return cached


def interpreted(function: Any) -> Any:
    """Return the plain Python function behind a compiled entry point (itself, where there is nothing behind it)."""
    return getattr(function, "py_func", function)


@functools.cache
def cache_path() -> Path | None:
    """Return the directory of this version's compiled code, made if need be; None where there is no place to write to.

    It lies under ``NUMBA_CACHE_DIR`` when that is set, else under the user's cache directory.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    package = Path(__file__).parents[1]
    for source in sorted(package.rglob("*.py")):
        digest.update(source.relative_to(package).as_posix().encode())
        digest.update(source.read_bytes())
    root = Path(
        os.environ.get("NUMBA_CACHE_DIR") or Path(platformdirs.user_cache_dir("quell")) / "compiled"
    )
    path = root / f"quell-{digest.hexdigest()[:16]}"
    try:
        fresh = not path.is_dir()
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
        if fresh:
            _forget_old_caches(root, path)
    except OSError:
        return None
    return path


def _forget_old_caches(root: Path, current: Path) -> None:
    """Remove all but the newest few caches of other versions of the package."""
    others = sorted(
        (p for p in root.glob("quell-*") if p != current),
        key=lambda p: p.stat().st_mtime,
        reverse=True,
    )
    for stale in others[_CACHES_KEPT - 1 :]:
        shutil.rmtree(stale, ignore_errors=True)


def _no_implementation(name: str, type_name: str) -> str:
    return f"{name}() has no implementation for {type_name}; register one with @{name}.register({type_name}) before the first run"
