"""The program as the parts of the translator know it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from quell.export.translate.findings import Findings
from quell.export.translate.literals import Literals
from quell.export.translate.structs import Structs
from quell.export.translate.values import Kind, Struct, Value


class Translation(Protocol):
    """A program while it is written; ``program.py`` has it."""

    findings: Findings
    literals: Literals
    structs: Structs
    calls: Any  # a ``Calls``
    helpers: set[str]
    results: dict[str, Struct]
    externals: dict[str, str]  # declarations of functions that the user has in C

    def function(
        self,
        python: Callable[..., Any],
        arguments: list[Value],
        declaration: Callable[..., Any] | None = None,
        hints: tuple[str, ...] = (),
        into_array: bool = False,
    ) -> Any:
        """Return the C function of a Python function for arguments like these.

        If it implements a generic function, that is the ``declaration``. With ``into_array``, the
        last of them is an array for the numbers that it returns.
        """

    def has_function(self, name: str) -> bool:
        """Return whether a function has this name."""

    def named_constant(self, name: str, value: Any, module: str) -> str:
        """Return the C name of a constant of a module."""

    def pointer(self, kind: Kind, name: str, const: bool) -> str:
        """Return the declaration of a variable that points to an array or a struct."""

    def parameter(self, kind: Kind, name: str, const: bool) -> str:
        """Return the declaration of a parameter that is an array or a struct."""
