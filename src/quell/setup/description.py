"""The tables of a setup file, before anything is built of them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator, Field, ValidationError

from quell import checks
from quell.setup.schema import SetupError, Table, from_validation, immutable
from quell.setup.schema import parsed as parsed
from quell.setup.schema import read as read

if TYPE_CHECKING:  # these types are made at run time, which a type checker cannot follow
    from quell.setup.schema import CallTable as Controller
    from quell.setup.schema import CallTable as Guard
    from quell.setup.schema import CallTable as Learner
    from quell.setup.schema import CallTable as Metrics
    from quell.setup.schema import CallTable as Observer
    from quell.setup.schema import CallTable as OnTop
    from quell.setup.schema import CallTable as Plant
    from quell.setup.schema import CallTable as Prefilter
    from quell.setup.schema import CallTable as Rig
    from quell.setup.schema import CallTable as Scenario
    from quell.setup.schema import CallTable as Sweep
    from quell.setup.schema import CallTable as Tune
else:
    from quell.setup.registry import (
        Controller,
        Guard,
        Learner,
        Metrics,
        Observer,
        OnTop,
        Plant,
        Prefilter,
        Rig,
        Scenario,
        Sweep,
        Tune,
    )


def optional(description: str) -> Any:
    """Return the field of a table that may be missing."""
    return Field(None, description=description)


Title = Annotated[str, AfterValidator(partial(checks.printable, "title"))]
TITLE: Any = Field("", description="title of tables and figures; the file's name by default.")
DT: Any = Field(description="sample time of the loop and all of its parts [s].")


class Description(Table):
    """The tables and keys of a setup file."""

    title: Title = TITLE
    dt: float = DT
    plant: Plant | None = optional("the plant, for `quell run` and observers with a model.")
    observer: Observer | None = optional("the observer of an `adrc` or a compensator.")
    controller: Controller = Field(description="the controller.")
    compensator: OnTop | None = optional(
        "a compensator on top of a controller without observer; none by default."
    )
    learner: Learner | None = optional("the learner; none by default.")
    guard: Guard | None = optional("the guard of the learner; none by default.")
    prefilter: Prefilter | None = optional("the prefilter of the reference; none by default.")
    scenario: Scenario | None = optional("the scenario.")
    sweep: Sweep | None = optional("many runs with other values, for `quell sweep`.")
    rig: Rig | None = optional("the device and its safety limits, for `quell run-rig`.")
    tune: Tune | None = optional("what `quell tune` optimises, and its constraints.")
    metrics: tuple[Metrics, ...] = Field(
        (), description="[[metrics]]: windows of time in which the response is judged."
    )


OF_AXES = ("axis", "axes")
"""Keys of a setup of several axes only."""


def is_of_axes(data: Mapping[str, Any]) -> bool:
    """Return whether the content of a file is a setup of several axes."""
    return any(key in data for key in OF_AXES)


def describe(name: str, data: Mapping[str, Any]) -> Description:
    """Return the tables of ``data``, the content of the file ``name``, of one axis."""
    if is_of_axes(data):
        raise SetupError(
            [
                f"{name}: NOT for several axes yet: this works on one axis, and the file has "
                "[[axis]]; quell run, run-rig, replay, proxy, tune, sweep, compare, studio and "
                "export take it, in Python quell.setup.load reads it"
            ]
        )
    values = immutable(data)
    try:
        return Description.model_validate(values)
    except ValidationError as error:
        raise from_validation(name, error, values) from None
