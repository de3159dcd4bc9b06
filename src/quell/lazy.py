"""Public names that are imported when they are first used; how to install what is missing."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from quell.hints import OF_MODULES, MissingAttributeError


def imported_on_use(
    package: str,
    homes: Mapping[str, str],
    modules: Iterable[str] = (),
    renamed: Mapping[str, str] | None = None,
) -> Callable[[str], Any]:
    """Return the function ``__getattr__`` of a package.

    Parameters
    ----------
    package
        its name.
    homes
        the module of each public class and function, below the package.
    modules
        public modules, below the package.
    renamed
        the present names of public names of earlier releases; a ``FutureWarning`` says them.
    """
    known = {path.rpartition(".")[2]: path for path in modules}

    def get(name: str) -> Any:
        if renamed and name in renamed:
            now = renamed[name]
            warnings.warn(f"{package}.{name} is {package}.{now} now", FutureWarning, stacklevel=2)
            name = now
        if name in vars(sys.modules[package]):
            return vars(sys.modules[package])[name]
        if name in homes:
            value = getattr(importlib.import_module(f"{package}.{homes[name]}"), name)
        elif name in known:
            value = importlib.import_module(f"{package}.{known[name]}")
        else:
            public = vars(sys.modules[package]).get("__all__", [*homes, *known])
            raise MissingAttributeError(
                f"module {package!r}", name, lambda: public, lambda: OF_MODULES
            )
        setattr(sys.modules[package], name, value)
        return value

    return get


def public_names(package: str) -> Callable[[], list[str]]:
    """Return the function ``__dir__`` of a package: its public names, and those of Python."""

    def names() -> list[str]:
        own = vars(sys.modules[package])
        return sorted([*own["__all__"], *(name for name in own if name.startswith("__"))])

    return names


DISTRIBUTION = "quell-control"
"""Name of the distribution on the package index."""


def install(extra: str = "") -> str:
    """Return the command that installs quell, with an extra."""
    return f"pip install '{DISTRIBUTION}[{extra}]'" if extra else f"pip install {DISTRIBUTION}"
