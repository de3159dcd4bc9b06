"""What users keep: memory images and setup files of the commit that made the corpus.

A later version loads them, and goes on as the stored run.
"""

from __future__ import annotations

import base64
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import quell as ql
from quell.setup import load

from .corpus import outcome_of, with_rounded_design, with_rounded_signals
from .loops import channels_of, controller_of, drive, inputs

# ---- Memory images ----

_TAUGHT, _NEXT = 150, 50


def _samples(controller: Any, case: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    widths = getattr(controller, "references", 1), getattr(controller, "outputs", 1)
    r, y = (inputs(_TAUGHT + _NEXT, n, 5 + i, case["scale"]) for i, n in enumerate(widths))
    return r, y


def _step(controller: Any, r: Any, y: Any) -> np.ndarray:
    if hasattr(controller, "inputs"):
        return np.array(controller.step(r, y))
    return np.array([controller.step(float(r[0]), float(y[0]))])


def image_of(case: Mapping[str, Any]) -> str:
    """Return the memory image of a controller that has learned, as text."""
    controller = controller_of(case)
    for r, y in zip(*(each[:_TAUGHT] for each in _samples(controller, case)), strict=True):
        _step(controller, r, y)
    return base64.b64encode(controller.memory()).decode()


def memory_case(case: Mapping[str, Any]) -> dict[str, Any]:
    """Return the samples after an image was loaded: into a running loop, and after a start."""
    image, logs, flags = base64.b64decode(case["image"]), {}, 0
    for name, running in (("u", True), ("u after a start", False)):
        controller = controller_of(case)
        controller.restore(image, running=running)
        r, y = (each[_TAUGHT:] for each in _samples(controller, case))
        logs[name] = np.array([_step(controller, *each) for each in zip(r, y, strict=True)])
        flags |= int(getattr(controller, "status", 0))
    return outcome_of(logs, flags, "why" in case)


# ---- Setup files ----


def setup_case(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the run of a setup file, or that of a controller in one without a plant."""
    path = folder / "setup.toml"
    path.write_text(case["text"], encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        setup = load(path)
        controller = with_rounded_design(setup.controller)
        tables = [name for name in ("rig", "sweep", "tune") if getattr(setup, name, None)]
        if setup.plant is None or setup.scenario is None:
            given = {"samples": 150, "seed": 3, "scale": 0.1, **case}
            found = drive(given, _Given(controller))
        else:
            plant = with_rounded_design(setup.plant)
            run = ql.simulate(
                plant, controller, with_rounded_signals(setup.scenario), interpret=True
            )
            found = outcome_of(channels_of(run), int(run.status), "why" in case)
    return {**found, "status": found["status"], "tables": tables}


class _Given:
    """A controller of a setup file, which is driven."""

    def __init__(self, controller: Any) -> None:
        self.controller = controller
        self.channels: tuple[Any, ...] = ()
        self.u = np.zeros(getattr(controller, "inputs", 1))

    def step(self, r: Any, y: Any) -> None:
        """Take a sample."""
        self.u = _step(self.controller, r, y)

    def known(self) -> np.ndarray:
        """Return nothing: u is compared."""
        return np.zeros(0)

    def status(self) -> int:
        """Return the flags of the last sample."""
        return int(getattr(self.controller, "status", 0))
