"""What is run, described in a file: ``load`` reads TOML and builds plant, controller and scenario of it (docs/setup)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from quell import checks
from quell.controllers import Prefiltered
from quell.controllers.base import Controller
from quell.files import nonfinite_to_none
from quell.plants import Plant
from quell.setup.build import Builder, linear_part
from quell.setup.description import Description, describe, read
from quell.setup.errors import SetupError
from quell.simulation.scenario import Scenario

__all__ = ["EXAMPLES", "Description", "Setup", "SetupError", "load", "made", "read"]

EXAMPLES = Path(__file__).parent / "examples"
"""The folder of the files that come along: ``two_mass.toml`` and ``torsional_rig.toml``."""


@dataclass(frozen=True, eq=False)
class Setup:
    """What a setup file describes, built.

    Attributes
    ----------
    file : str
        the file's name.
    title : str
        what tables and figures call it.
    controller
        what controls, behind its prefilter if there is one; its ``dt`` is the loop's.
    plant
        what is controlled, or None.
    scenario : Scenario
        what happens, or None.
    rig : dict
        the arguments of ``run_rig`` and ``live``, or None.
    windows : tuple of dict
        for each window in which the response is judged the arguments of ``Trajectory.metrics``.
    description : Description
        the file's own tables.
    """

    file: str
    title: str
    controller: Controller
    plant: Plant | None
    scenario: Scenario | None
    rig: dict[str, Any] | None
    windows: tuple[dict[str, Any], ...]
    description: Description

    def as_json(self) -> dict[str, Any]:
        """Return what the file has, for ``quell.files.write_json``; in the place of an infinite number is None."""
        kept: dict[str, Any] = nonfinite_to_none(self.description.model_dump(exclude_unset=True))
        return kept

    def needed(self, table: str) -> Any:
        """Return what was built of a table that the file need not have, but should.

        Raises
        ------
        SetupError
            where it has not.
        """
        if getattr(self, table) is None:
            raise SetupError([f"{self.file}: {table}: missing; give a table [{table}]"])
        return getattr(self, table)


def load(path: str | os.PathLike[str]) -> Setup:
    r"""Read a TOML file and build what it describes.

    Raises
    ------
    SetupError
        with a line for each mistake: the file, the key's path, the value and the rule, or the
        nearest known name.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> text = "dt = 0.01\ncontroller = {omega_c = 2.0}\nobserver = {kind = 'model-free', order = 2, b0 = 1.0, omega_0 = 9.0}"
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "rig.toml"
    ...     _ = path.write_text(text)
    ...     load(path)
    Traceback (most recent call last):
        ...
    quell.setup.errors.SetupError: rig.toml: observer.omega_0: unknown; did you mean omega_o?
    """
    return made(*read(path))


def made(name: str, data: Mapping[str, Any]) -> Setup:
    """Build what ``data`` describes, which is as ``tomllib`` reads it from a file called ``name``.

    Raises
    ------
    SetupError
        as ``load``.
    """
    described, builder = describe(name, data), Builder(name)
    dt = builder.attempt("", (), checks.positive, "dt", described.dt, "s")

    def part(key: str, **context: Any) -> Any:
        table = getattr(described, key)
        return None if table is None else builder.build(table, key, dt=dt, **context)

    plant = part("plant")
    model = linear_part(plant)
    parts = {key: part(key, plant=model) for key in ("observer", "learner", "guard")}
    idle = [
        key
        for key, value in parts.items()
        if value is not None and key not in described.controller.context
    ]
    if idle:
        kind = described.controller.called
        raise SetupError(
            [f"{name}: {key}: a controller of the kind {kind} has no use for it" for key in idle]
        )
    controller = part("controller", plant=model, **parts)
    prefilter, scenario, rig = part("prefilter"), part("scenario"), part("rig")
    if prefilter is not None:
        controller = builder.attempt("prefilter", (), Prefiltered, controller, prefilter)
    if scenario is not None and plant is not None:
        builder.attempt("scenario", ("disturbances",), scenario.seeded_signals, plant.disturbances)
    windows = tuple(window.given() for window in described.metrics)
    for i, window in enumerate(windows):
        builder.attempt(f"metrics[{i}]", [*window], partial(_check_window, **window))
    title = described.title or name.removesuffix(".toml").replace("_", " ")
    return Setup(name, title, controller, plant, scenario, rig, windows, described)


def _check_window(
    start: float = 0.0, stop: float | None = None, target: float | None = None, band: float = 0.002
) -> None:
    """Say before the run what ``Trajectory.metrics`` would say after it."""
    checks.finite("start", start)
    if stop is not None:
        checks.interval("start", start, "stop", stop)
    if target is not None:
        checks.finite("target", target)
    checks.positive("band", band)
