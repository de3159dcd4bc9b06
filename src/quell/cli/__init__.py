"""The command line: ``quell`` and its commands.

May import every folder; nothing imports it.
"""

from quell.cli.app import main

__all__ = ["main"]
