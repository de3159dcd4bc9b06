"""The page of all names has all names."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

import quell as ql

PAGE = Path(__file__).parents[1] / "docs" / "api.rst"
ROOMS = (
    "analysis",
    "controllers",
    "controllers.baselines",
    "features",
    "learners",
    "observers",
    "plants",
    "signals",
)

pytestmark = pytest.mark.skipif(
    not PAGE.exists(), reason="the pages are in the repository, not in what is built of it"
)


def listed() -> set[str]:
    """Return the names that the page's directives document, and the last part of the modules."""
    page = PAGE.read_text(encoding="utf-8")
    targets = re.findall(r"^\.\. auto\w+:: (\S+)$", page, re.MULTILINE)
    members = [
        name.strip()
        for line in re.findall(r"^   :members: (.+)$", page, re.MULTILINE)
        for name in line.split(",")
    ]
    return {part for target in targets for part in target.split(".")} | set(members)


@pytest.mark.parametrize("room", ROOMS)
def test_every_public_name_of_a_room_is_on_the_page(room: str) -> None:
    """By a directive of its own, or among a module's members."""
    names = set(importlib.import_module(f"quell.{room}").__all__)
    assert names
    assert sorted(names - listed()) == []


def test_every_name_of_the_package_is_on_the_page_and_every_target_exists() -> None:
    """Rooms too; and nothing is documented that is gone."""
    assert sorted(set(ql.__all__) - listed()) == []
    page = PAGE.read_text(encoding="utf-8")
    for kind, target, members in re.findall(
        r"^\.\. auto(\w+):: (\S+)$(?:\n   :members: (.+)$)?", page, re.MULTILINE
    ):
        place, _, name = target.rpartition(".")
        thing = (
            importlib.import_module(target)
            if kind == "module"
            else getattr(importlib.import_module(place), name)
        )
        for member in filter(None, members.split(", ")):
            annotated = getattr(thing, "__annotations__", {})
            assert hasattr(thing, member) or member in annotated, f"{target} has no {member}"
