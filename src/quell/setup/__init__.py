"""Setup files: TOML tables that describe plant, controller, scenario and device (docs/setup).

May import every folder below; only ``cli`` imports this one.
"""

from quell.setup.description import Description, read
from quell.setup.errors import SetupError
from quell.setup.load import EXAMPLES, Setup, load, made
from quell.setup.vary import controllers_of, varied

__all__ = [
    "EXAMPLES",
    "Description",
    "Setup",
    "SetupError",
    "controllers_of",
    "load",
    "made",
    "read",
    "varied",
]
