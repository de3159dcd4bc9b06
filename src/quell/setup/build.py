"""A builder: objects from tables."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from functools import cache, partial, reduce
from operator import add
from typing import Any

from quell.features.base import Features
from quell.plants.labelled import labelled
from quell.plants.linear_part import linear_model
from quell.plants.registry import RUN_CODE
from quell.setup.errors import SetupError, with_path
from quell.setup.schema import CallTable
from quell.signals.base import Signal

# Keys whose plant is a model: only its linear part is used.
_MODELS = ("observer.plant", "controller.plant", "guard.certified_for")


@cache
def parameters_of(function: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Return the parameters of a function by name."""
    return dict(inspect.signature(function).parameters)


class Builder:
    """A builder of the tables of one file, whose ``name`` stands at the beginning of its errors.

    With ``trust`` it runs the Python files and FMUs that plants are in.
    """

    def __init__(self, name: str, trust: bool = False) -> None:
        self.name = name
        self.trust = trust

    def build(self, table: CallTable, path: str, **context: Any) -> Any:
        """Return the object that a table describes; ``path`` is its place in the file.

        ``context`` has objects of other tables, None for a missing one. Those that the table's
        function takes, and that the table does not have itself, become arguments.
        """
        takes = parameters_of(table.function)
        if table.function in RUN_CODE and not self.trust:
            rule = "would run this program; give --trust (in Python trust=True) if you trust it"
            raise SetupError(
                [f"{self.name}: {path}: path = {table.written().get('path')!r}: {rule}"]
            )
        context["trust"] = self.trust
        arguments = {
            key: value for key, value in context.items() if key in takes and value is not None
        }
        inner: dict[str, Any] = {key: context[key] for key in ("dt", "plant") if key in context}
        for key, value in table.written().items():
            arguments[key] = self._value(value, f"{path}.{key}", key != "disturbances", inner)
        for key, parameter in takes.items():
            needed = parameter.default is parameter.empty
            if needed and key not in arguments and parameter.kind is not parameter.VAR_KEYWORD:
                raise SetupError([f"{self.name}: {path}: {key} is missing; give a table [{key}]"])
        made = self.attempt(path, [*arguments], partial(table.function, **arguments))
        signals = getattr(table, "signals", None) if "signals" in table.beside else None
        if signals is None:
            return made
        return self.attempt(f"{path}.signals", "yuw", partial(labelled, made, **signals.written()))

    def attempt(
        self, path: str, keys: Sequence[str], action: Callable[..., Any], *arguments: Any
    ) -> Any:
        """Return ``action(*arguments)``; an error names the path and, if possible, the key."""
        try:
            return action(*arguments)
        except ValueError as error:
            raise with_path(self.name, path, error, keys) from None
        except ArithmeticError as error:
            beyond = ValueError(f"these numbers are beyond what can be computed ({error})")
            raise with_path(self.name, path, beyond, keys) from None

    def _value(self, value: Any, path: str, add_up: bool, context: dict[str, Any]) -> Any:
        """Build the tables in a value; add up the features or signals of a list if ``add_up``."""
        if isinstance(value, CallTable):
            built = self.build(value, path, **context)
            return linear_model(built) if path.partition("[")[0] in _MODELS else built
        if not isinstance(value, tuple):
            return value
        entries = enumerate(value)
        parts = tuple(self._value(part, f"{path}[{i}]", True, context) for i, part in entries)
        if add_up and any(isinstance(part, Features | Signal) for part in parts):
            return self.attempt(path, (), reduce, add, parts)
        return parts
