"""Setup files: TOML tables that describe plant, controller, scenario and device (docs/setup).

May import every folder below; only ``cli`` imports this one.
"""

from quell.setup.description import Description
from quell.setup.errors import SetupError
from quell.setup.load import EXAMPLES, Setup, load, made
from quell.setup.plants import plant_given, plant_of
from quell.setup.toml_file import read
from quell.setup.vary import controllers_of, varied
from quell.suggestions import suggest_names

__all__ = [
    "EXAMPLES",
    "Description",
    "Setup",
    "SetupError",
    "controllers_of",
    "load",
    "made",
    "plant_given",
    "plant_of",
    "read",
    "varied",
]

suggest_names(__name__, __all__)
