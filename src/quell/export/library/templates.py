"""The texts of the files around a controller, from templates with ``@names@`` to fill in."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import resources


def filled(name: str, values: Mapping[str, object]) -> str:
    """Return a template of the folder ``templates`` with its ``@names@`` replaced."""
    return fill((resources.files(__package__) / "templates" / name).read_text("utf-8"), values)


def fill(text: str, values: Mapping[str, object]) -> str:
    """Return a text with its ``@names@`` replaced."""
    return re.sub(r"@(\w+)@", lambda found: str(values[found[1]]), text)
