"""Arguments of ``quell.tune`` from a setup file: the plant, its ranges, constraints."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from quell.plants.delay import delayed
from quell.plants.linear_part import linear_model
from quell.setup.errors import SetupError
from quell.setup.loading import Setup, made
from quell.setup.toml_file import read
from quell.setup.vary import changed
from quell.tuning.constraints import Constraints
from quell.tuning.designs import SIMPLEST, range_of_u
from quell.tuning.plants import with_known_noise
from quell.tuning.result.scenario import late_tables, rest_of_plant
from quell.tuning.structures.registry import FEEDING_FORWARD

# What a tuning replaces. A law without effect stands in for the controller.
_REPLACED = ("observer", "controller", "learner", "guard", "prefilter")
_NO_CONTROLLER = {"kind": "pid", "kp": 0.0}


class TuningTask(NamedTuple):
    """Arguments of ``quell.tune``."""

    plant: Any  # a plant, linear unless simulated; with ranges, a function that makes it
    dt: float  # [s]
    options: dict[str, Any]  # all others
    setup: Setup


def tuning_task(
    path: str | os.PathLike[str],
    changes: Mapping[str, Any] | None = None,
    trust: bool = False,
    limits: Mapping[str, float] | None = None,
) -> TuningTask:
    """Read a setup file for ``quell.tune``; ``changes`` are values of ``[tune]`` by name.

    ``limits`` are limits of u that replace those of the file's controller.

    Observer, controller, learner, guard and prefilter of the file are left out: they are what is
    tuned. The limits of u stay, and the tuned controller has the feedforward of a model if the
    file's feeds forward, unless ``[tune]`` says otherwise. Dry friction and limits of the plant are
    left out, too; a tuning by simulation (``trials``) has them.

    Raises
    ------
    SetupError
        as ``load``; for a file without plant, and for ranges that are none of the plant's keys.
    """
    name, data = read(path)
    given = data.get("controller", {})
    kept = {key: value for key, value in data.items() if key not in _REPLACED}
    kept["controller"] = _NO_CONTROLLER
    table = data.get("tune", {})
    if isinstance(table, Mapping):
        asked = {**table, **(changes or {})}
        structure = asked.get("structure", SIMPLEST)
        if isinstance(given, Mapping) and structure in (SIMPLEST, *FEEDING_FORWARD):
            asked = _feedforward(given) | asked
        if asked:
            kept["tune"] = asked
    setup = made(name, kept, trust)
    plant, ranges = setup.needed("plant"), _ranges(setup)
    options = dict(setup.tune or {})
    if isinstance(given, Mapping):
        names = ("u_min", "u_max", "rate_limit")
        options = {key: given[key] for key in names if key in given} | options
    options |= limits or {}
    bounds, u_limits = options.get("constraints") or Constraints(), range_of_u(options)
    options["constraints"] = with_known_noise(bounds, plant, u_limits)
    options["setup"] = {key: value for key, value in data.items() if key not in _REPLACED}
    delay = options.get("delay", 0.0)
    if isinstance(delay, float) and delay > 0.0:  # the plant of the tuned file has it, too
        try:
            samples = delayed(plant, delay, setup.controller.dt).order - plant.order
        except ValueError as error:
            raise SetupError([f"{setup.file}: tune: {error}"]) from None
        options["setup"] = late_tables(options["setup"], delay, samples)
        if "tune" in data:
            kept_keys = {key: value for key, value in data["tune"].items() if key != "delay"}
            options["setup"]["tune"] = kept_keys
    if "scenario" not in data:
        with suppress(ValueError):  # of a plant without operating point, which tune refuses
            options["rest"] = rest_of_plant(plant, setup.controller.dt)
    part = linear_model
    if "search" in options:
        options["scenario"], part = setup.needed("scenario"), _whole
    if not ranges:
        return TuningTask(part(plant), setup.controller.dt, options, setup)
    for key in ranges:
        _with(setup.file, kept, {key: ranges[key][0]}, trust)  # an unknown key is an error now

    def make(**values: float) -> Any:
        return part(_with(name, kept, values, trust).plant)

    return TuningTask(make, setup.controller.dt, {**options, "uncertain": ranges}, setup)


def _feedforward(controller: Mapping[str, Any]) -> dict[str, Any]:
    """Return the feedforward of a controller's table as an option of [tune]."""
    if controller.get("feedforward"):
        return {"feedforward": controller["feedforward"]}
    if "inertia" in controller:  # of a cascade
        model = {key: controller[key] for key in ("inertia", "viscous") if key in controller}
        return {"feedforward": {"kind": "rigid"} | model}
    return {}


def _whole(plant: Any) -> Any:
    return plant


def _with(name: str, data: Mapping[str, Any], values: Mapping[str, float], trust: bool) -> Setup:
    changes = {f"plant.{key}": value for key, value in values.items()}
    return made(name, changed(name, data, changes), trust)


def _ranges(setup: Setup) -> dict[str, tuple[float, float]]:
    found = getattr(setup.description.plant, "uncertain", None)
    if found == {}:
        raise SetupError(
            [f"{setup.file}: plant.uncertain: is empty; give a range, m1 = [0.6, 1.4]"]
        )
    return dict(found or {})
