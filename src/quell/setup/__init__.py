"""Setup files: TOML tables that describe plant, controller, scenario and device (docs/setup).

May import every folder below; only ``cli`` imports this one.
Names are imported when they are first used: whoever needs a plant only, as ``quell rig``, does not
wait for the tables of controllers and tuning.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from quell.lazy import imported_on_use, public_names

if TYPE_CHECKING:
    from quell.setup.axes import AxesDescription
    from quell.setup.description import Description
    from quell.setup.loading import EXAMPLES, Setup, controllers_of, varied
    from quell.setup.reading import load, made
    from quell.setup.schema import SetupError, plant_given, plant_of, read

_HOMES = {
    "AxesDescription": "axes",
    "EXAMPLES": "loading",
    "Description": "description",
    "Setup": "loading",
    "SetupError": "schema",
    "controllers_of": "loading",
    "load": "reading",
    "made": "reading",
    "plant_given": "schema",
    "plant_of": "schema",
    "read": "schema",
    "varied": "loading",
}

__all__ = [
    "EXAMPLES", "AxesDescription", "Description", "Setup", "SetupError", "controllers_of", "load",
    "made", "plant_given", "plant_of", "read", "varied"
]  # fmt: skip

# Names of the last release.
_RENAMED = {"load_axes": "load", "made_axes": "made"}

__getattr__ = imported_on_use(__name__, _HOMES, (), _RENAMED)

__dir__ = public_names(__name__)
