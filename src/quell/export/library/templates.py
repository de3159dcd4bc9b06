"""The texts of the files around a controller, from templates with ``@names@`` to fill in."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import resources


def filled(name: str, values: Mapping[str, object]) -> str:
    """Return a template of the folder ``templates`` with its ``@names@`` replaced."""
    text = (resources.files(__package__) / "templates" / name).read_text(encoding="utf-8")
    return re.sub(r"@(\w+)@", lambda found: str(values[found[1]]), text)
