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
    returns_several: bool = False  # whether the code is the list of numbers to be returned


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


def _parts(item: Branch | Loop) -> tuple[str, list[Block]]:
    """Return the code at the head of a branch or loop, and the blocks in it."""
    if isinstance(item, Branch):
        return item.test, [item.body, item.orelse]
    return item.header, [item.body]


def lines_of(block: Block) -> Iterator[Line]:
    """Yield all lines of a block and of the blocks in it."""
    for item in block:
        if isinstance(item, Line):
            yield item
        else:
            for part in _parts(item)[1]:
                yield from lines_of(part)


def _read_names(block: Block) -> set[str]:
    found: set[str] = set()
    for item in block:
        head, inner = (item.code, []) if isinstance(item, Line) else _parts(item)
        found |= words(head).union(*map(_read_names, inner))
    return found


def names_in_block(block: Block) -> set[str]:
    """Return all names that a block uses or sets."""
    return _read_names(block) | {line.target for line in lines_of(block) if line.target}


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
                code = f"(void){item.code}"
                kept.append(Line(code, comments=item.comments, behind=item.behind, calls=True))
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
        places = [i for i, item in enumerate(block) if name in names_in_block([item])]
        if not places:
            continue
        first = block[places[0]]
        if len(places) == 1 and not isinstance(first, Line) and _is_inside(first, name):
            for part in _parts(first)[1]:
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
    for i, item in enumerate(block):
        if name not in names_in_block([item]):
            continue
        if isinstance(item, Line):
            return _sets(item, name)
        return name not in names_in_block(block[i + 1 :]) and _is_inside(item, name)
    return False


def _is_inside(item: Branch | Loop, name: str) -> bool:
    """Return whether each block of a branch or loop that has a variable sets it first."""
    head, inner = _parts(item)
    used = [part for part in inner if name in names_in_block(part)]
    return name not in words(head) and all(_sets_first(part, name) for part in used)
