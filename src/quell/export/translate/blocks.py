"""The statements of a C function as a tree, and the placement of its declarations.

A variable is declared where it is first set, in the innermost block that contains all its uses.
What is set but never used is removed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

_WORD = re.compile(r"(?<![\w.])(?<!->)[A-Za-z_]\w*")


@dataclass
class Line:
    """A statement, or the assignment ``target = code``."""

    code: str
    target: str = ""
    comments: list[str] = field(default_factory=list)
    behind: str = ""
    calls: bool = False  # whether a function is called
    updates: bool = False  # whether the target is read, too: ``target += code``
    declares: str = ""  # the declaration of the target, if it is declared here


@dataclass
class Branch:
    """If and else."""

    test: str
    body: Block
    orelse: Block
    comments: list[str] = field(default_factory=list)
    behind: str = ""


@dataclass
class Loop:
    """A loop over a range."""

    header: str
    variable: str
    body: Block
    comments: list[str] = field(default_factory=list)
    behind: str = ""


Item = Line | Branch | Loop
Block = list[Item]


def words(code: str) -> set[str]:
    """Return the names in a piece of code that are not fields of structs."""
    return set(_WORD.findall(code))


def names_in(item: Item) -> set[str]:
    """Return all names that a statement uses or sets."""
    if isinstance(item, Line):
        return words(item.code) | ({item.target} if item.target else set())
    if isinstance(item, Branch):
        inner = names_in_block(item.body) | names_in_block(item.orelse)
        return words(item.test) | inner
    return words(item.header) | names_in_block(item.body)


def names_in_block(block: Block) -> set[str]:
    """Return all names in a block."""
    found: set[str] = set()
    for item in block:
        found |= names_in(item)
    return found


def lines_of(block: Block) -> Iterator[Line]:
    """Yield all lines of a block and of the blocks in it."""
    for item in block:
        if isinstance(item, Line):
            yield item
        elif isinstance(item, Branch):
            yield from lines_of(item.body)
            yield from lines_of(item.orelse)
        else:
            yield from lines_of(item.body)


def _read_names(block: Block) -> set[str]:
    found: set[str] = set()
    for item in block:
        if isinstance(item, Line):
            found |= words(item.code)
        elif isinstance(item, Branch):
            found |= words(item.test) | _read_names(item.body) | _read_names(item.orelse)
        else:
            found |= words(item.header) | _read_names(item.body)
    return found


def remove_unused(block: Block, local: set[str]) -> Block:
    """Return a block without assignments to local names that are never read."""
    while True:
        unused = local - _read_names(block)
        smaller = _without(block, unused)
        if _count(smaller) == _count(block):
            return smaller
        block = smaller


def _count(block: Block) -> int:
    return sum(1 for _ in lines_of(block)) + sum(not isinstance(item, Line) for item in block)


def _without(block: Block, unused: set[str]) -> Block:
    kept: Block = []
    for item in block:
        if isinstance(item, Line):
            if item.target not in unused:
                kept.append(item)
            elif item.calls:
                kept.append(Line(item.code, comments=item.comments, behind=item.behind, calls=True))
        elif isinstance(item, Branch):
            body, orelse = _without(item.body, unused), _without(item.orelse, unused)
            if body or orelse or _has_call(item.test):
                kept.append(Branch(item.test, body, orelse, item.comments, item.behind))
        else:
            body = _without(item.body, unused)
            if body:
                kept.append(Loop(item.header, item.variable, body, item.comments, item.behind))
    return kept


def _has_call(code: str) -> bool:
    return bool(re.search(r"\w\(", code))


def place_declarations(block: Block, local: set[str], declare: Callable[[str, bool], str]) -> None:
    """Declare the local names of a function where they belong; change the block.

    ``declare(name, constant)`` returns the declaration without value.
    """
    counts: dict[str, int] = {}
    for line in lines_of(block):
        if line.target:
            counts[line.target] = counts.get(line.target, 0) + (2 if line.updates else 1)
    _place(block, local & names_in_block(block), counts, declare)


def _place(
    block: Block, local: set[str], counts: dict[str, int], declare: Callable[[str, bool], str]
) -> None:
    for name in sorted(local):
        places = [i for i, item in enumerate(block) if name in names_in(item)]
        if not places:
            continue
        first = block[places[0]]
        if len(places) == 1 and not isinstance(first, Line):
            inner = [first.body, first.orelse] if isinstance(first, Branch) else [first.body]
            head = first.test if isinstance(first, Branch) else first.header
            used = [part for part in inner if name in names_in_block(part)]
            if name not in words(head) and all(_sets_first(part, name) for part in used):
                for part in used:
                    _place(part, {name}, counts, declare)
                continue
        if isinstance(first, Line) and _sets(first, name):
            first.declares = declare(name, counts.get(name, 0) == 1)
        else:
            block.insert(places[0], Line("0", name, declares=declare(name, False)))


def _sets(line: Line, name: str) -> bool:
    return line.target == name and not line.updates and name not in words(line.code)


def _sets_first(block: Block, name: str) -> bool:
    """Return whether a block sets a variable before it reads it, whatever happens."""
    for item in block:
        if name not in names_in(item):
            continue
        if isinstance(item, Line):
            return _sets(item, name)
        if isinstance(item, Loop):
            return (
                name not in words(item.header)
                and _sets_first(item.body, name)
                and not any(name in names_in(later) for later in block[block.index(item) + 1 :])
            )
        arms = [item.body, item.orelse]
        later = any(name in names_in(each) for each in block[block.index(item) + 1 :])
        used = [arm for arm in arms if name in names_in_block(arm)]
        head = name in words(item.test)
        return not head and not later and all(_sets_first(arm, name) for arm in used)
    return False
