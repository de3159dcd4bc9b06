"""The text of C code: indentation, comments and line breaks."""

from __future__ import annotations

import re
import textwrap

from quell.export.translate.blocks import Block, Branch, Line

_WIDTH = 100


def comment_block(text: str, indent: int = 0) -> list[str]:
    """Return a text as a comment: paragraphs are filled, indented lines stay as they are."""
    pad = " " * indent
    text = text.replace("*/", "* /").replace("/*", "/ *").replace("``", "").replace("::\n", ":\n")
    lines = [line for part in _paragraphs(text) for line in _filled(part, _WIDTH - indent - 6)]
    if len(lines) == 1:
        return [f"{pad}/* {lines[0]} */"]
    body = [f"{pad} * {line}".rstrip() for line in lines[1:]]
    return [f"{pad}/* {lines[0]}", *body[:-1], f"{body[-1]} */"]


def _paragraphs(text: str) -> list[str]:
    """Return a text with each paragraph in one line."""
    parts: list[str] = []
    for line in text.splitlines():
        in_list = bool(parts) and parts[-1][:2] in ("* ", "- ") and line[:2] == "  "
        starts = not parts or not line or line[0] in " *-123456789" or parts[-1][:1] in ("", " ")
        if starts and not in_list:
            parts.append(line)
        else:
            parts[-1] += f" {line.lstrip()}"
    return parts


def _filled(part: str, width: int) -> list[str]:
    if part[:1] == " ":
        return [part]
    indent = "  " if part[:2] in ("* ", "- ") else ""
    return textwrap.wrap(part, width, subsequent_indent=indent) or [""]


def wrapped(line: str) -> list[str]:
    """Return a line of code in lines of at most 100 signs, broken where it nests least."""
    if len(line) <= _WIDTH or line.lstrip().startswith(("/*", "*")):
        return [line]
    code, mark, comment = line.partition(" /* ")
    if mark and len(code) <= _WIDTH:
        pad = re.match(r" *", code)
        return [*comment_block(comment.removesuffix(" */"), len(pad[0]) if pad else 0), code]
    return _broken(line, len(line) - len(line.lstrip()) + 4)


def _broken(line: str, indent: int) -> list[str]:
    """Return a line in parts, all but the first with the same indentation."""
    place = _break(line) if len(line) > _WIDTH else None
    if place is None:
        return [line]
    return [line[:place].rstrip(), *_broken(" " * indent + line[place:].lstrip(), indent)]


def _break(line: str) -> int | None:
    """Return where to break a line: after a comma or before an operator, with least nesting."""
    best, place, depth = None, None, 0
    start = len(line) - len(line.lstrip()) + 8
    for i, sign in enumerate(line[:_WIDTH]):
        if sign in "([{":
            depth += 1
        elif sign in ")]}":
            depth -= 1
        if i < start:
            continue
        after = line[i : i + 4]
        comma = line[i - 1] == "," and sign == " "
        operator = sign == " " and re.match(r" (\|\||&&|\?|:|[-+*/]|==|<=?|>=?) ", after + " ")
        if comma or operator:
            rank = (depth, not (comma or "&&" in after or "||" in after))
            if best is None or rank <= best:
                best, place = rank, i
    return place


def block_lines(block: Block, result: str, indent: int = 4) -> list[str]:
    """Return the lines of a block; ``result`` is the struct that the function returns, if any."""
    lines: list[str] = []
    for item in block:
        pad = " " * indent
        for comment in item.comments and [" ".join(item.comments)]:
            lines += comment_block(comment, indent)
        behind = f" /* {item.behind} */" if item.behind else ""
        if isinstance(item, Line):
            text = item.code
            if item.returns_several:
                lines += wrapped(f"{pad}const {result} returned = {{{text}}};{behind}")
                text, behind = "return returned", ""
            elif item.target:
                name = item.declares or item.target
                text = item.code if item.updates else f"{name} = {item.code}" if item.code else name
            lines += wrapped(f"{pad}{text};{behind}")
        elif isinstance(item, Branch):
            lines += _branch(item, result, indent, behind)
        else:
            lines += wrapped(f"{pad}{item.header} {{{behind}")
            lines += [*block_lines(item.body, result, indent + 4), f"{pad}}}"]
    return lines


def _branch(item: Branch, result: str, indent: int, behind: str) -> list[str]:
    pad, lines = " " * indent, []
    opening = f"{pad}if ({item.test}) {{{behind}"
    chained = False
    while True:
        lines += wrapped(opening)
        lines += block_lines(item.body, result, indent + 4)
        rest = item.orelse
        if not rest:
            # A chain of tests ends with else (MISRA C:2012, rule 15.7).
            last = [f"{pad}}} else {{", f"{pad}    /* Nothing in any other case. */"]
            return [*lines, *(last if chained else []), f"{pad}}}"]
        if len(rest) == 1 and isinstance(rest[0], Branch):
            item = rest[0]
            for comment in item.comments and [" ".join(item.comments)]:
                lines += comment_block(comment, indent + 4)
            opening, chained = f"{pad}}} else if ({item.test}) {{", True
            continue
        return [*lines, f"{pad}}} else {{", *block_lines(rest, result, indent + 4), f"{pad}}}"]
