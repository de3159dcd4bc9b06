"""The files by which package managers know an exported controller: Arduino, PlatformIO, ESP-IDF.

The folder of ``quell.export.c`` is one library for all of them. What Arduino's Library Manager asks
for beyond a C identifier as a name is in ``arduino_objection``; the rest holds for each export.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from quell.export.c_files import CSource
from quell.export.library.vectors import filled

FILES = ("LICENSE", "idf_component.yml", "library.json", "library.properties")
"""Templates of the root of the folder; ``keywords.txt`` is written from the header."""

# Rules LP010, LP014 and LP016 of arduino-lint with --compliance strict.
_LONGEST = 32
_WORDS = ("arduino", "library")


def arduino_objection(name: str) -> str:
    """Return why Arduino's Library Manager does not take a library of this name; or nothing."""
    found = [word for word in _WORDS if word in name.lower()]
    if found:
        return f"the name {name} has {found[0]} in it"
    if len(name) > _LONGEST:
        return f"the name {name} has {len(name)} characters, {_LONGEST} are allowed"
    return ""


def package_files(source: CSource, values: Mapping[str, object]) -> dict[str, str]:
    """Return the text of the files of package managers by path."""
    return {**{each: filled(each, values) for each in FILES}, "keywords.txt": _keywords(source)}


def package_note(source: CSource) -> str:
    """Return the paragraph of README.md on what to change before the folder is published."""
    objection = arduino_objection(source.name)
    if not objection:
        return ""
    return (
        f"NOT for Arduino's Library Manager: {objection}. Export with another name to submit it; "
        "in your\nsketchbook the folder works as it is.\n\n"
    )


def _keywords(source: CSource) -> str:
    """Return ``keywords.txt``: types, functions and constants that Arduino's editor colours."""
    name, upper = source.name, source.name.upper()
    types = re.findall(rf"^(?:}} |typedef \w+ )({name}_\w+);$", source.header, re.M)
    constants = re.findall(rf"^#define ({upper}_\w+) ", source.header, re.M)
    for members in re.findall(r"^enum \w+ \{(.*?)\}", source.header, re.M | re.S):
        constants += re.findall(rf"\b({upper}_\w+) =", members)
    rows = [
        *((each, "KEYWORD1") for each in types),
        *((f"{name}_{each}", "KEYWORD2") for each in source.operations),
        *((each, "LITERAL1") for each in (*constants, f"{name}_default_parameters")),
    ]
    return "".join(f"{word}\t{kind}\n" for word, kind in dict(rows).items())
