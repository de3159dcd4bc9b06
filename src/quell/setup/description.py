"""A setup file as tables: what stands in it, before anything is built of it."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field, ValidationError

from quell.setup.errors import SetupError, mistakes
from quell.setup.schema import Table

if TYPE_CHECKING:  # they are made of signatures, which a type checker does not read
    from quell.setup.schema import Call as Controller
    from quell.setup.schema import Call as Guard
    from quell.setup.schema import Call as Learner
    from quell.setup.schema import Call as Metrics
    from quell.setup.schema import Call as Observer
    from quell.setup.schema import Call as Plant
    from quell.setup.schema import Call as Prefilter
    from quell.setup.schema import Call as Rig
    from quell.setup.schema import Call as Scenario
else:
    from quell.setup.registry import (
        Controller,
        Guard,
        Learner,
        Metrics,
        Observer,
        Plant,
        Prefilter,
        Rig,
        Scenario,
    )


class Description(Table):
    """All that a setup file may hold."""

    title: str = Field(
        "", description="what tables and figures call it; the file's name by default."
    )
    dt: float = Field(description="sample time of the loop [s], for all that has one.")
    plant: Plant | None = Field(
        None,
        description="what is controlled, for `quell run`, and for observers that know a model.",
    )
    observer: Observer | None = Field(None, description="what an `adrc` controller needs.")
    controller: Controller = Field(description="what controls.")
    learner: Learner | None = Field(
        None, description="what feeds forward what it has learned; none by default."
    )
    guard: Guard | None = Field(
        None, description="what gives the learner the authority it has earned; none by default."
    )
    prefilter: Prefilter | None = Field(
        None, description="what shapes the reference; none by default."
    )
    scenario: Scenario | None = Field(None, description="what happens.")
    rig: Rig | None = Field(
        None, description="the device, and the limits that keep it safe, for `quell run-rig`."
    )
    metrics: tuple[Metrics, ...] = Field(
        (), description="[[metrics]]: windows of time in which the response is judged."
    )


def read(path: str | os.PathLike[str]) -> tuple[str, dict[str, Any]]:
    """Return a TOML file's name, for messages, and what it holds.

    Raises
    ------
    SetupError
        for a file that can't be read, or is not TOML.
    """
    name = Path(path).name
    try:
        return name, tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise SetupError([f"{path}: can't be read ({error.strerror})"]) from None
    except UnicodeDecodeError as error:
        raise SetupError([f"{name}: not TOML: byte {error.start} is not UTF-8"]) from None
    except tomllib.TOMLDecodeError as error:
        raise SetupError([f"{name}: not TOML: {error}"]) from None
    except RecursionError:
        raise SetupError([f"{name}: not a setup: tables or lists are nested too deeply"]) from None


def describe(name: str, data: Mapping[str, Any]) -> Description:
    """Return the tables of ``data``.

    Raises
    ------
    SetupError
        with a line for each mistake.
    """
    whole = _as_python(data)
    try:
        return Description.model_validate(whole)
    except ValidationError as error:
        raise mistakes(name, error, whole) from None


def _as_python(value: Any) -> Any:
    """Return the same with tuples in the place of lists, as nothing that is built shall change, and None in that of the text none."""
    if isinstance(value, Mapping):
        return {key: _as_python(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return tuple(_as_python(part) for part in value)
    return None if value == "none" else value
