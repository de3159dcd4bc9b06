"""From tables to objects."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from functools import partial, reduce
from operator import add
from typing import Any

from quell.features import Features
from quell.setup.errors import SetupError, refused
from quell.setup.schema import Call
from quell.signals import Signal

# Where a plant is a model of one.
_MODELS = ("observer.plant", "controller.plant")


def linear_part(plant: Any) -> Any:
    """Return what of a plant can be designed for: of one with friction, say, what it is without."""
    return getattr(plant, "linear", plant)


class Builder:
    """Builds the tables of one file, whose ``name`` is in front of what they are refused for."""

    def __init__(self, name: str) -> None:
        self.name = name

    def build(self, table: Call, path: str, **context: Any) -> Any:
        """Return what the call that a table is returns.

        Parameters
        ----------
        table
            what to build.
        path
            where it stands in the file.
        **context
            what the rest of the file has for it; it is given what it takes and does not have
            itself. What is None is not there.

        Raises
        ------
        SetupError
            for what the call refuses, and for what it lacks.
        """
        takes = inspect.signature(table.make).parameters
        arguments = {
            key: value for key, value in context.items() if key in takes and value is not None
        }
        inner = {"dt": context["dt"]} if "dt" in context else {}
        arguments |= {
            key: self._value(value, f"{path}.{key}", key != "disturbances", inner)
            for key, value in table.given().items()
        }
        for key, parameter in takes.items():
            if (
                key not in arguments
                and parameter.default is parameter.empty
                and parameter.kind is not parameter.VAR_KEYWORD
            ):
                raise SetupError([f"{self.name}: {path}: {key} is missing; give a table [{key}]"])
        return self.attempt(path, [*arguments], partial(table.make, **arguments))

    def attempt(
        self, path: str, keys: Sequence[str], action: Callable[..., Any], *arguments: Any
    ) -> Any:
        """Return what ``action`` returns; what it refuses is told with the path, and the key where it begins with one of ``keys``.

        Raises
        ------
        SetupError
            in the place of a ``ValueError``.
        """
        try:
            return action(*arguments)
        except ValueError as error:
            raise refused(self.name, path, error, keys) from None

    def _value(self, value: Any, path: str, joined: bool, context: dict[str, Any]) -> Any:
        """Build the tables in a value; features and signals in a list are added up where they are ``joined``."""
        if isinstance(value, Call):
            built = self.build(value, path, **context)
            return linear_part(built) if path in _MODELS else built
        if not isinstance(value, tuple):
            return value
        parts = tuple(
            self._value(part, f"{path}[{i}]", True, context) for i, part in enumerate(value)
        )
        if not (joined and any(isinstance(part, Features | Signal) for part in parts)):
            return parts
        return self.attempt(path, (), reduce, add, parts)
