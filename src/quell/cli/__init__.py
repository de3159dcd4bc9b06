"""The command line: ``quell`` and its commands."""

from quell.cli.app import main

__all__ = ["main"]
