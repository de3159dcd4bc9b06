"""The JSON Schema of setup files and quell itself, on changed files: which of them refuse what.

    python benchmarks/setup_schema.py                  # 2000 changed setups
    python benchmarks/setup_schema.py --count 200 --seed 7
    python benchmarks/setup_schema.py --show relation # the messages of a class

Each setup of the package, of ``examples`` and of the documentation is changed at one place: an
unknown key, a value of another type, a number out of range, a missing key, another kind. The schema
(``quell setup --schema``) and ``quell.setup.made`` judge the same file. What the schema refuses
and quell takes is a fault of the schema. What only quell refuses is counted by class: relations
between values and the like, which a schema cannot express.
"""

from __future__ import annotations

import copy
import random
import re
import sys
import tomllib
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import jsonschema
from measured import options_of, parser_of, write

from quell.setup import EXAMPLES, SetupError, made, registry
from quell.setup.json_schema import json_schema

ROOT = Path(__file__).resolve().parents[1]
_BLOCK = re.compile(r"^```toml\n(.*?)^```", re.MULTILINE | re.DOTALL)
# Values of other types than those of most keys, and numbers out of most ranges.
TYPES: tuple[Any, ...] = ("text", True, 2.5, 3, [1.0], ["text"], {"a": 1}, [], "none")
NUMBERS: tuple[Any, ...] = (-1, 0, -2.5, 0.0, 1e400, -1e400, 10**6, 1e-9, 99)


def bases() -> dict[str, dict[str, Any]]:
    """Return the setups that are changed, by name: all that quell itself takes."""
    found = {
        file.name: file.read_text(encoding="utf-8") for file in sorted(EXAMPLES.glob("*.toml"))
    }
    for file in sorted((ROOT / "examples").glob("*.toml")):
        found[file.name] = file.read_text(encoding="utf-8")
    for page in sorted((ROOT / "docs").glob("*.md")):
        for i, block in enumerate(_BLOCK.findall(page.read_text(encoding="utf-8"))):
            found[f"{page.name}, {i + 1}"] = block
    tables: dict[str, dict[str, Any]] = {}
    for name, text in found.items():
        with suppress(tomllib.TOMLDecodeError):
            tables[name] = tomllib.loads(text)
    tables |= dict(_of_kinds())
    # Others are parts of a file, files with code, and kinds that need keys.
    return {name: data for name, data in tables.items() if refusal(name, data) is None}


def _of_kinds() -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield a setup for each kind of plant, learner and signal."""
    base = tomllib.loads((EXAMPLES / "two_mass.toml").read_text(encoding="utf-8"))
    for key, kinds in (("learner", registry.LEARNERS), ("plant", registry.PLANTS)):
        for kind in kinds:
            yield f"{key} {kind}", {**copy.deepcopy(base), key: {"kind": kind}}
    for kind in registry.SIGNALS:
        changed = copy.deepcopy(base)
        changed["scenario"]["reference"] = {"kind": kind}
        yield f"signal {kind}", changed


def refusal(name: str, data: Mapping[str, Any]) -> str | None:
    """Return the message with which quell refuses a setup, None for one that it takes."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made(name, data)
    except (SetupError, MemoryError) as error:
        return str(error)
    return None


# ---- Changes ----


def places(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of all values of a setup."""
    if path:
        yield path
    parts = (
        data.items()
        if isinstance(data, dict)
        else enumerate(data)
        if isinstance(data, list)
        else ()
    )
    for key, value in parts:
        yield from places(value, (*path, key))


def at(data: Any, path: tuple[Any, ...]) -> Any:
    """Return the value at a path."""
    for step in path:
        data = data[step]
    return data


def unknown_key(data: Any, draw: random.Random) -> str | None:
    """Add a key that is none, or one with a letter too much."""
    tables = [(), *(path for path in places(data) if isinstance(at(data, path), dict))]
    path = draw.choice(tables)
    table = at(data, path)
    key = draw.choice([*table] or ["key"]) + draw.choice("0_xs")
    table[key] = draw.choice((1.0, "text"))
    return ".".join(map(str, (*path, key)))


def wrong_type(data: Any, draw: random.Random) -> str | None:
    """Replace a value by one of another type."""
    return _replaced(data, [*places(data)], lambda _: draw.choice(TYPES), draw)


def out_of_range(data: Any, draw: random.Random) -> str | None:
    """Replace a number."""
    numbers = [path for path in places(data) if type(at(data, path)) in (int, float)]
    return _replaced(data, numbers, lambda old: draw.choice((*NUMBERS, -old)), draw)


def missing_key(data: Any, draw: random.Random) -> str | None:
    """Remove a key."""
    paths = [path for path in places(data) if isinstance(path[-1], str)]
    path = draw.choice(paths)
    del at(data, path[:-1])[path[-1]]
    return ".".join(map(str, path))


def other_kind(data: Any, draw: random.Random) -> str | None:
    """Replace a kind by another one, or by a word that is none."""
    kinds = (registry.LEARNERS, registry.OBSERVERS, registry.CONTROLLERS, registry.SIGNALS)
    names = [kind for group in (*kinds, registry.PLANTS) for kind in group]
    words = [path for path in places(data) if type(at(data, path)) is str and path[-1] != "title"]
    return _replaced(data, words, lambda old: draw.choice((*names, old + "x")), draw)


def _replaced(
    data: Any, paths: list[tuple[Any, ...]], new: Callable[[Any], Any], draw: random.Random
) -> str | None:
    if not paths:
        return None
    path = draw.choice(paths)
    where = at(data, path[:-1])
    where[path[-1]] = copy.deepcopy(new(where[path[-1]]))
    return ".".join(map(str, path))


CHANGES = (unknown_key, wrong_type, out_of_range, missing_key, other_kind)


# ---- What only quell refuses ----

# Classes of messages, by a part of them; the first that fits.
CLASSES: tuple[tuple[str, str], ...] = (
    (
        "a table or key that needs another one",
        r"give a table|does not use it|only one of|given: |there is no plant",
    ),
    ("files and code that a setup names", r"can't be read|No such file|give --trust"),
    ("more memory than there is", r"Unable to allocate"),
    ("a list in the place of one signal", r"has \d+ signals?:|is a list of \d+ signal"),
    (
        "shapes of lists, and inf and nan in them",
        r"has shape|got tuple|every entry must|has \d+ values",
    ),
    (
        "relations between values",
        r"must be less than|must lie within|must increase|duration / 2|too long|must reach|"
        r"times dt",
    ),
    ("a whole number that is written as 2.0", r"\.0: must be a whole number$"),
    ("nan, and inf where a time is not checked by its key", r"= nan:|= -?inf: must be a finite"),
)
OTHER = "another rule"


def class_of(message: str) -> str:
    """Return the class of a message."""
    for name, pattern in CLASSES:
        if re.search(pattern, message, re.MULTILINE):
            return name
    return OTHER


def run(count: int, seed: int) -> tuple[Counter[str], list[str], dict[str, list[str]]]:
    """Change setups; return verdicts by name, faults of the schema, and messages by class."""
    judge = jsonschema.Draft7Validator(json_schema())
    draw = random.Random(seed)
    originals = bases()
    names = [*originals]
    verdicts: Counter[str] = Counter()
    faults: list[str] = []
    only_quell: dict[str, list[str]] = {}
    for name, data in originals.items():
        for error in judge.iter_errors(data):
            faults.append(f"{name}: unchanged: {error.message:.200}")
    while verdicts.total() < count:
        name = draw.choice(names)
        data, change = copy.deepcopy(originals[name]), CHANGES[verdicts.total() % len(CHANGES)]
        where = change(data, draw)
        if where is None:
            continue
        message, broken = refusal(name, data), not judge.is_valid(data)
        what = f"{change.__name__} {where}"
        if message is None and broken:
            errors = "; ".join(f"{each.message:.150}" for each in judge.iter_errors(data))
            faults.append(f"{name}: {what}: {errors}")
        if message is not None and not broken:
            only_quell.setdefault(class_of(message), []).append(f"{what}: {message}")
        schema, quell = ("refused" if each else "taken" for each in (broken, message is not None))
        verdicts[f"{schema} by the schema, {quell} by quell"] += 1
    return verdicts, faults, only_quell


def main() -> None:
    """Print the counts."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--show", help="print the messages of this class")
    given = options_of(parser, count=60)
    verdicts, faults, only_quell = run(given.count, given.seed)
    for verdict, times in verdicts.most_common():
        print(f"{times:6d}  {verdict}")
    for name, messages in sorted(only_quell.items()):
        print(f"{len(messages):6d}  only quell: {name}")
        if given.show is not None and given.show in name:
            print(*(f"        {message}" for message in messages), sep="\n")
    print(*(f"FAULT {fault}" for fault in faults), sep="\n")
    classes = {name: len(messages) for name, messages in only_quell.items()}
    figures = {"files": given.count, **verdicts, "only quell": classes, "faults": len(faults)}
    write(given, figures)
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
