"""Texts of the site for machines: ``llms.txt``, ``reference.md`` and ``setup.schema.json``.

    python docs/machine_texts.py FOLDER

The build of the pages writes them, too (``conf.py``). ``llms.txt`` lists the pages
(https://llmstxt.org). ``reference.md`` has the public names of the pages in ``api``, each with its
signature, the first paragraph of its docstring, and its parameters. ``setup.schema.json`` is what
``quell setup --schema`` prints.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from quell import __version__
from quell.setup.json_schema import json_schema
from quell.setup.schema import parameter_descriptions, summary

DOCS = Path(__file__).parent
# A directive of a page, with its members.
_DIRECTIVE = re.compile(r"^\.\. auto(\w+):: (\S+)$((?:\n   :\w+:.*$)*)", re.MULTILINE)
_MEMBERS = re.compile(r":members:(.*)")
# What Sphinx and Markdown write in front of a page's text.
_HEADER = re.compile(r"\A---\n.*?\n---\n", re.DOTALL)
_ROLE = re.compile(r":\w+:`~?([^`<]*)(?: <[^`]*>)?`")
_LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")


# ---- The reference ----


def reference() -> str:
    """Return the reference of all public names in Markdown."""
    lines = [
        f"# quell {__version__}: reference of the public names",
        "",
        "`import quell as ql`; `ql.ADRC` and `quell.ADRC` are the same. Matrices and vectors are",
        "arrays of NumPy, times are in seconds, frequencies in rad/s. An argument that breaks its",
        "rule raises `ValueError`, which names the argument, its value and the rule.",
    ]
    for page in pages_of_names():
        title = page.read_text(encoding="utf-8").splitlines()[0]
        lines += ["", f"## {title}"]
        for name, thing, members in names_of(page):
            lines += ["", *entry(name, thing), *member_lines(thing, members)]
    return _plain("\n".join(lines)) + "\n"


def pages_of_names() -> list[Path]:
    """Return the pages of names, in the order of their table of contents."""
    contents = (DOCS / "api.rst").read_text(encoding="utf-8")
    return [DOCS / f"{name}.rst" for name in re.findall(r"^   (api/\w+)$", contents, re.MULTILINE)]


def names_of(page: Path) -> Iterator[tuple[str, Any, list[str]]]:
    """Yield the names that a page documents, what they stand for, and their listed members."""
    for kind, target, options in _DIRECTIVE.findall(page.read_text(encoding="utf-8")):
        found = _MEMBERS.search(options)
        members = [] if found is None else [each.strip() for each in found[1].split(",")]
        members = [each for each in members if each]
        if kind == "module":
            module = importlib.import_module(target)
            yield from ((f"{target}.{each}", getattr(module, each), []) for each in members)
            if members:
                continue
        if kind != "module":
            place, _, name = target.rpartition(".")
            thing = getattr(importlib.import_module(place), name)
            if found is not None and not members:  # all that are documented
                members = [each for each in vars(thing) if not each.startswith("_")]
            yield target, thing, members


def entry(name: str, thing: Any) -> Iterator[str]:
    """Yield the lines of a class, a function or a value."""
    yield f"### {name}{signature(thing)}"
    told = summary(thing) if callable(thing) else ""
    if told:
        yield ""
        yield told
    described = parameter_descriptions(thing) if callable(thing) else {}
    if described:
        yield ""
        yield from (f"- `{key}`: {text}" for key, text in described.items())


def member_lines(thing: Any, members: list[str]) -> Iterator[str]:
    """Yield a line for each method and property of a class."""
    if members:
        yield ""
    for each in members:
        member = inspect.getattr_static(thing, each, None)
        member = getattr(
            member, "__func__", getattr(member, "func", member)
        )  # class methods, caches
        if isinstance(member, property):
            member = member.fget
            sign = ""
        else:
            sign = signature(member)
        told = summary(member) if inspect.isroutine(member) else ""
        yield f"- `.{each}{sign}`" + (f": {told}" if told else "")


def signature(thing: Any) -> str:
    """Return the arguments of a function or class with their defaults, without types."""
    if not callable(thing):
        return ""
    try:
        given = inspect.signature(thing)
    except (TypeError, ValueError):
        return ""
    bare = [each.replace(annotation=each.empty) for each in given.parameters.values()]
    if bare and bare[0].name in ("self", "cls"):
        bare = bare[1:]
    text = str(given.replace(parameters=bare, return_annotation=given.empty))
    text = re.sub(
        r"<[^<>]*(?:<lambda>)?[^<>]* at 0x[0-9a-f]+>", "…", text
    )  # a mark of a missing argument
    return re.sub(r"<(?:function|class) ?'?([\w.]+)[^>]*>", r"\1", text)


def _plain(text: str) -> str:
    """Return a text of docstrings without the marks of Sphinx."""
    return _ROLE.sub(r"`\1`", text).replace("``", "`").replace("``", "`")


# ---- The list of pages ----


def contents() -> str:
    """Return the list of the site's pages, with the first sentence of each."""
    lines = [
        "# quell",
        "",
        "> Python library for disturbance-rejection control that learns: extended state observers,",
        "> ADRC, online learners with a guard, tuning, identification, C for microcontrollers.",
        "",
        "## For machines",
        "",
        "- [reference.md](reference.md): all public names with signatures and parameters",
        "- [setup.schema.json](setup.schema.json): JSON Schema of setup files",
        "",
        "## Pages",
        "",
    ]
    for page in sorted(DOCS.glob("*.md")):
        title, first = opening(page.read_text(encoding="utf-8"))
        lines.append(f"- [{title}]({page.stem}.html): {first}")
    lines += ["", "## Pages of names", ""]
    for page in pages_of_names():
        title = page.read_text(encoding="utf-8").splitlines()[0]
        lines.append(f"- [{title}](api/{page.stem}.html)")
    return "\n".join(lines) + "\n"


def opening(text: str) -> tuple[str, str]:
    """Return the title of a page and its first sentence."""
    text = _HEADER.sub("", text).strip()
    title = re.search(r"^# (.*)$", text, re.MULTILINE)
    paragraphs = [" ".join(part.split()) for part in text.split("\n\n")]
    prose = next((part for part in paragraphs if re.match(r"[A-Z*`\[]", part)), "")
    prose = _LINK.sub(lambda link: link[1], prose).replace("**", "")
    return title[1] if title else "", re.split(r"(?<=[.:]) ", prose, maxsplit=1)[0]


def write(folder: Path) -> None:
    """Write all three files."""
    schema = json.dumps(json_schema(), indent=1, allow_nan=False, ensure_ascii=False)
    texts = {
        "llms.txt": contents(),
        "reference.md": reference(),
        "setup.schema.json": schema + "\n",
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write the texts of the site for machines.")
    parser.add_argument("folder", type=Path)
    write(parser.parse_args().folder)
