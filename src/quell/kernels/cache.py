"""The disk cache of compiled code.

Numba's own cache checks only the file that an entry point is in. Kernels call kernels of other
files, so each version of them has a folder of its own, named by a hash of all files that compiled
code can depend on. Cache files that are damaged or can't be written lead to a new compilation.

Time for which this process has compiled, without what it loaded from the disk cache.

A compilation of more than a second is announced on the standard error, with what is compiled, and
how long it took. ``announcements(False)`` turns that off, and so does ``QUELL_QUIET=1``.
"""

from __future__ import annotations

import functools
import hashlib
import multiprocessing
import os
import re
import shutil
import stat
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numba
import platformdirs
from numba import types

from quell.kernels.numba_internals import CompileResultCacheImpl, FunctionCache, event

# Versions kept: the current one and those of a few other branches or environments. Chosen by hand.
_VERSIONS_KEPT = 4
# Marks a folder that quell may remove; backup programs skip such folders (bford.info/cachedir).
_MARKER_NAME = "CACHEDIR.TAG"
_MARKER = (
    "Signature: 8a477f597d28d172789f06886806bc55\n"
    "# Compiled code of the Python package quell; it is made anew when it is missing.\n"
)
# A file with one of these has kernels.
_KERNEL_MARKS = (b"@kernel", b"@compiled", b"@generic", b".register(")
_IMPORT = re.compile(rb"\nfrom (quell[\w.]*) import (\([^)]*\)|.*)")
_NAME = re.compile(rb"\w+")


@functools.cache
def cache_path() -> Path | None:
    """Return the folder of this version's compiled code; None if it can't be created or written to.

    None, too, if it is another user's: Numba unpickles what is in it.

    It is in ``quell-compiled`` under ``NUMBA_CACHE_DIR`` if that is set, else under the user's
    cache directory. Versions that were not used lately are removed, if they have quell's marker.
    """
    root = os.environ.get("NUMBA_CACHE_DIR") or platformdirs.user_cache_dir("quell")
    versions = Path(root) / "quell-compiled"
    path = versions / cache_key(Path(__file__).parents[1])
    try:
        Path(root).mkdir(parents=True, exist_ok=True)
        if not (_is_private(versions) and _is_private(path)):
            return None
        with tempfile.TemporaryFile(dir=path):  # checks for write access
            pass
        os.utime(path)  # it is the version that was used last
        if not (path / _MARKER_NAME).exists():
            (path / _MARKER_NAME).write_text(_MARKER, encoding="utf-8")
            _remove_old_versions(versions, path)
    except OSError:
        return None
    return path


def cache_key(package: Path) -> str:
    """Return a hash of Numba's version and of the sources that compiled code can depend on."""
    digest = hashlib.sha256(numba.__version__.encode())
    for module, source in sorted(kernel_sources(package).items()):
        digest.update(module.encode() + b"\0" + source + b"\0")
    return digest.hexdigest()[:16]


def kernel_sources(package: Path) -> dict[str, bytes]:
    """Return names and sources of the modules that have kernels and of all that these import.

    Imports inside functions do not count: a kernel can use only what its module imports.
    """
    sources = {}
    for folder, _, names in os.walk(package):
        module = os.path.relpath(folder, package.parent).replace(os.sep, ".")
        for name in names:
            if name.endswith(".py"):
                key = module if name == "__init__.py" else f"{module}.{name[:-3]}"
                sources[key] = Path(folder, name).read_bytes()
    found = {name for name, text in sources.items() if any(mark in text for mark in _KERNEL_MARKS)}
    todo = list(found)
    while todo:
        for module_bytes, names_bytes in _IMPORT.findall(sources[todo.pop()]):
            module = module_bytes.decode()
            for name in _NAME.findall(names_bytes):
                submodule = f"{module}.{name.decode()}"
                imported = submodule if submodule in sources else module
                if imported in sources and imported not in found:
                    found.add(imported)
                    todo.append(imported)
    return {name: sources[name] for name in found}


def code_cache(function: Callable[..., Any]) -> FunctionCache | None:
    """Return the disk cache of an entry point; None if there is no place for it."""
    folder = cache_path()
    if folder is None:
        return None
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(folder)
    try:
        return _FaultTolerantCache(function)
    except (RuntimeError, OSError):  # no place for the files of this function, or no source file
        return None
    finally:
        numba.config.CACHE_DIR = before


class _FilesInCacheDirectory(CompileResultCacheImpl):
    """Numba's cache files, in ``CACHE_DIR`` only: Numba's other places are not named by our key."""

    _locator_classes = CompileResultCacheImpl._locator_classes[:1]


class _FaultTolerantCache(FunctionCache):
    """Numba's cache of a function; faults of its files are never errors."""

    _impl_class = _FilesInCacheDirectory

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        # Numba numbers the data files. Two processes, or an index that was lost, can give one
        # number to two signatures, and then the code of the wrong one is loaded.
        self._cache_file._data_name = lambda number: (
            f"{self._impl.filename_base}.{uuid.uuid4().hex}.nbc"
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return compiled code from the disk; None if there is none, or if it can't be read."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # unpickling a damaged file can raise anything
            try:
                self.flush()
            except OSError:
                self.disable()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write compiled code to the disk if that is possible: the disk may be full."""
        with suppress(OSError):
            super().save_overload(sig, data)


def _is_private(folder: Path) -> bool:
    """Create a folder; return whether it is this user's, and make sure that no other can write."""
    folder.mkdir(mode=0o700, exist_ok=True)
    if not hasattr(os, "geteuid"):  # Windows: the user's own folders are private
        return True
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid():
        return False
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        folder.chmod(0o700)
    return True


def _remove_old_versions(versions: Path, current: Path) -> None:
    """Remove the folders of ``versions`` that have quell's marker, but for the ones used last."""
    old = [path for path in versions.iterdir() if path != current and _is_ours(path)]
    old.sort(key=lambda path: path.stat().st_mtime, reverse=True)
    for path in old[_VERSIONS_KEPT - 1 :]:
        shutil.rmtree(path, ignore_errors=True)


def _is_ours(path: Path) -> bool:
    try:
        return (path / _MARKER_NAME).read_text(encoding="utf-8") == _MARKER
    except (OSError, UnicodeDecodeError):
        return False


_EVENT = "numba:compile"  # https://numba.readthedocs.io/en/stable/developer/event_api.html
# Shorter compilations are not worth a line [s].
_LONG = 1.0
# Ends of names of kernels' parameters, which say nothing about what they are.
_ENDS = ("Parameters", "Model", "Design")
# Names that end so belong to a part that is named anyway.
_BESIDE = ("State", "Memory", "Scalars")
# Most names of parts in a line. Chosen by hand.
_MOST_PARTS = 8


class CompileTime(event.Listener):
    """The time [s] that compilation took.

    Numba's events nest: what an entry point calls is compiled within it, in the same thread.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self.running = 0  # threads that compile now
        self.told = 0.0  # share of it that was announced
        self.announced = not os.environ.get("QUELL_QUIET")
        self._own = threading.local()

    def on_start(self, event: Any) -> None:
        """Note when the outermost compilation of a thread starts."""
        self._own.depth = getattr(self._own, "depth", 0) + 1
        if self._own.depth == 1:
            self._own.began = time.perf_counter()
            self.running += 1
            # Of several processes only the first speaks.
            if self.announced and multiprocessing.parent_process() is None:
                self._own.timer = threading.Timer(_LONG, _announce, (event.data,))
                self._own.timer.daemon = True
                self._own.timer.start()

    def on_end(self, event: Any) -> None:
        """Add the time of the outermost compilation of a thread."""
        self._own.depth -= 1
        if self._own.depth == 0:
            # Numba compiles in one thread at a time, so the sum is safe.
            took = time.perf_counter() - self._own.began
            self.seconds += took
            self.running -= 1
            timer, self._own.timer = getattr(self._own, "timer", None), None
            if timer is not None:
                timer.cancel()
                if took >= _LONG:
                    self.told += took
                    later = "later runs load it from the disk"
                    if not _is_kept(event.data):
                        later = (
                            "each run compiles it, as it is a user's or depends on one's numbers"
                        )
                    _print(f"compiled in {took:.1f} s; {later}")


@contextmanager
def announcements(on: bool) -> Iterator[None]:
    """Turn announcements of long compilations on or off for a while."""
    before, compile_time.announced = compile_time.announced, on
    try:
        yield
    finally:
        compile_time.announced = before


def _announce(data: Any) -> None:
    """Print what is being compiled."""
    function = getattr(data.get("dispatcher"), "py_func", None)
    name = getattr(function, "__name__", "code").strip("_").replace("_", " ")
    parts = list(dict.fromkeys(_parts(data.get("args", ()))))
    about = f" for {', '.join(parts[:_MOST_PARTS])}" if parts else ""
    once = ", once" if _is_kept(data) else ""
    _print(f"compiling {name}{about}: takes up to a minute{once}")


def _is_kept(data: Any) -> bool:
    """Return whether what is compiled is kept in the disk cache."""
    return isinstance(getattr(data.get("dispatcher"), "_cache", None), FunctionCache)


def _parts(kinds: Any) -> Iterator[str]:
    """Yield the names of the NamedTuples among some types, those inside after those outside."""
    inside = []
    for kind in kinds:
        if isinstance(kind, types.BaseNamedTuple):
            name = kind.instance_class.__name__
            for end in _ENDS:
                name = name.removesuffix(end)
            if name and not name.endswith(_BESIDE):
                yield name
            inside += list(getattr(kind, "types", ()))
    if inside:
        yield from _parts(inside)


def _print(text: str) -> None:
    stream = sys.stderr
    if stream is not None:
        print(f"quell: {text}", file=stream, flush=True)


compile_time = CompileTime()
event.register(_EVENT, compile_time)
