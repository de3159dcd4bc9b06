"""Do the figures of README and of the pages have their sources: ``python docs/check_figures.py``.

A *source* is ``docs/figures/NAME.json``: the figures of one command, as ``benchmarks/measured.py``
writes them. ``timings`` are parts of keys whose figures are times, or their ratios; ``only`` are
the parts that are kept of what a command of quell writes; ``transcribed`` says that it was copied
from the text. ``docs/figures/PAGE.toml`` says of each block of a page (a paragraph, an item of a
list, a table) where its numbers come from, in the order of the text::

    [[block]]
    begins = "With `RLS` it is"          # the first words of the block
    source = "cogging"
    numbers = ["=500", "error.rls", "error.rls / error.none * 100", "speed:batch"]

``=500`` is a setting, and stands so on the page. All else is computed from left to right: a number,
a key of the source, or a key of another source after its name. Lists in ``numbers`` may be nested.
The number on the page must be the figure, rounded to the digits that are shown.

Every block of README needs such an entry. On the other pages those do that cite a benchmark, the
tables that stand beside them, and the blocks beside code that cites one. Code, formulas, links and
headings have no numbers here.

    python docs/check_figures.py               are all numbers those of the sources?
    python docs/check_figures.py --write       put the figures of the sources into the pages
    python docs/check_figures.py --run NAME …  run the commands of sources again, and write them
    python docs/check_figures.py --rerun 2 --seed 7   run two drawn quick sources: is it the same?
    python docs/check_figures.py --list PAGE   print the blocks of a page with their numbers
"""

from __future__ import annotations

import argparse
import difflib
import json
import math
import os
import random
import re
import shlex
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from quell.files import write_json

ROOT = Path(__file__).resolve().parents[1]
CITED = re.compile(r"benchmarks/\w+\.py|quell reproduce [\w-]+ --seeds")
# Sources of at most this processor time [s] are drawn by ``--rerun``; a figure may differ by this
# share, and one that is named in ``timings`` by this factor.
QUICK, SHARE, FACTOR = 30.0, 1e-3, 2.0
# Below, figures are rounding errors.
ROUNDING = 1e-12

_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_NUMBER = re.compile(
    r"(?<![\w.])(?:\d+(?:\.\d+){2,}"  # a version
    r"|(?P<number>(?<![\w)])[−-]?(?:\d{1,3}(?:[  \u2009]\d{3})+(?!\d)|\d+)(?:\.\d+)?"
    r"(?:e[−-]?\d+)?(?:·10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+|[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)?)"
    r"|\d[\d.]*)"
)
_NO_NUMBERS = re.compile(
    r"```.*?```|``.*?``|`[^`]*`|\$\$.*?\$\$|\$[^$]*\$|\]\([^)]*\)|<!--.*?-->|<[^<>]*>", re.S
)
_ITEM = re.compile(r"\s*(?:[-*]|\d+\.)\s")


class Block(NamedTuple):
    """A part of a page."""

    start: int  # place of its first character on the page
    text: str
    kind: str  # text, table, code

    @property
    def words(self) -> str:
        """Return the text with single spaces."""
        return " ".join(self.text.split())


class Number(NamedTuple):
    """A number on a page."""

    start: int  # place on the page
    shown: str


class Entry(NamedTuple):
    """Where the numbers of a block come from."""

    begins: str
    source: str
    numbers: list[str]


# ---- Pages ----


def blocks(page: str) -> list[Block]:
    """Return the paragraphs, items of lists, tables and code of a page in Markdown."""
    found: list[Block] = []
    lines: list[str] = []
    start = place = 0
    fence = ""

    def end() -> None:
        nonlocal lines
        text = "".join(lines)
        if text.strip():
            first = text.lstrip("\n")
            kind = "table" if first.lstrip().startswith("|") else "text"
            in_list = found and found[-1].kind == "text" and _ITEM.match(found[-1].text)
            if first.startswith(("```", ":::")):
                kind = "code" if first.startswith("```") else "text"
            elif first.startswith("    ") and not in_list:
                kind = "code"
            found.append(Block(start, text, kind))
        lines = []

    for line in page.splitlines(keepends=True):
        if fence:
            lines.append(line)
            if line.strip() == fence:
                fence = ""
                end()
        elif line.lstrip().startswith("```"):
            end()
            start, fence = place, "```"
            lines.append(line)
        elif not line.strip():
            end()
        else:
            is_row = line.lstrip().startswith("|")
            if lines and (_ITEM.match(line) or is_row != lines[-1].lstrip().startswith("|")):
                end()
            if not lines:
                start = place
            lines.append(line)
        place += len(line)
    end()
    return found


def numbers(block: Block) -> list[Number]:
    """Return the numbers of a block in order; code, formulas and links have none."""
    if block.kind == "code" or block.text.startswith("#"):
        return []
    text = _NO_NUMBERS.sub(lambda found: " " * len(found[0]), block.text)
    listed = re.match(r"\s*\d+\.\s", text)
    if listed:  # the number of an item
        text = " " * listed.end() + text[listed.end() :]
    return [
        Number(block.start + found.start("number"), found["number"])
        for found in _NUMBER.finditer(text)
        if found["number"]
    ]


def to_cover(name: str, all_of_page: Sequence[Block]) -> list[Block]:
    """Return the blocks that need entries: of README all, else those about a command they cite.

    Besides those that cite, these are the tables next to them, the blocks beside code that cites,
    and, with a citation in brackets of its own, all above it to the last heading or citation.
    """
    if name == "README.md":
        return list(all_of_page)
    chosen: set[int] = set()
    cites = [bool(CITED.search(block.text)) for block in all_of_page]
    for i, block in enumerate(all_of_page):
        if not cites[i]:
            continue
        chosen.add(i)
        for j in (i - 1, i + 1):
            if 0 <= j < len(all_of_page) and (
                all_of_page[j].kind == "table" or block.kind == "code"
            ):
                chosen.add(j)
        # The table that the paragraph after the code introduces.
        if block.kind == "code" and [each.kind for each in all_of_page[i + 2 : i + 3]] == ["table"]:
            chosen.add(i + 2)
        j = i - 1
        while block.text.startswith("(") and j >= 0 and not cites[j]:
            if all_of_page[j].text.startswith("#"):
                break
            chosen.add(j)
            j -= 1
    return [all_of_page[i] for i in sorted(chosen)]


# ---- Numbers and figures ----


def read(shown: str) -> tuple[float, float]:
    """Return the value of a number as it is shown, and half a unit of its last digit.

    Zeros at the end of a whole number count as digits as far as the second one only.
    """
    plain = re.sub(r"[  \u2009]", "", shown).replace("−", "-")
    power = re.search(r"(·10)?([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)$", plain)
    scale = 1.0
    if power:
        exponent = int(power[2].translate(_SUPERSCRIPTS))
        plain = plain[: power.start()]
        if not power[1]:
            return float(plain) ** exponent, 0.05 * abs(float(plain)) ** exponent
        scale = 10.0**exponent
    mantissa, _, exponent_text = plain.partition("e")
    scale *= 10.0 ** int(exponent_text or 0)
    if "." in mantissa:
        unit = 10.0 ** -len(mantissa.split(".")[1])
    else:
        digits = mantissa.lstrip("-")
        zeros = len(digits) - len(digits.rstrip("0"))
        unit = 10.0 ** max(min(zeros, len(digits) - 2), 0)
    return float(mantissa) * scale, 0.5 * unit * scale


def agrees(shown: str, value: float) -> bool:
    """Return whether a figure, rounded to the digits that are shown, is what is shown."""
    number, half = read(shown)
    return abs(value - number) <= half * (1.0 + 1e-6) + 1e-9 * abs(number)


def like(shown: str, value: float) -> str:
    """Write a figure with as many digits as the number that is shown, and in its form."""
    mantissa = re.split(r"e|·", shown)[0]
    digits = re.sub(r"[^\d]", "", mantissa).lstrip("0")
    if "." not in mantissa:
        digits = digits.rstrip("0").ljust(min(2, len(digits)), "0")
    count = max(len(digits), 1)
    sign = "−" if value < 0.0 and "−" in shown else "-" if value < 0.0 else ""
    size = abs(value)
    power = math.floor(math.log10(float(f"{size:.{count - 1}e}"))) if size else 0
    if "·" in shown or "e" in shown:
        base = f"{size / 10.0**power:.{count - 1}f}"
        if "e" in shown:
            return f"{sign}{base}e{power}"
        superscript = str(power).translate(str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻"))
        return f"{sign}{base}·10{superscript}"
    decimals = count - 1 - power
    text = f"{round(size, decimals):.{max(decimals, 0)}f}"
    if "." not in text and len(text) > 4:
        text = f"{int(text):,}".replace(",", " ")
    return sign + text


@cache
def source(name: str, folder: Path) -> dict[str, Any]:
    """Return what ``NAME.json`` holds.

    Raises
    ------
    ValueError
        for a source that does not exist.
    """
    path = folder / f"{name}.json"
    if not path.exists():
        raise ValueError(f"figures/{name}.json does not exist")
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content


def figure(name: str, key: str, folder: Path) -> float:
    """Return the figure with this key; parts of keys may have dots of their own."""
    value: Any = source(name, folder)["figures"]
    rest = key
    while rest:
        if isinstance(value, list):
            head, _, tail = rest.partition(".")
            within = head.isdigit() and int(head) < len(value)
            value, rest = (value[int(head)], tail) if within else (None, "")
        elif isinstance(value, dict):
            fits = [k for k in value if rest == k or rest.startswith(f"{k}.")]
            best = max(fits, key=len, default=None)
            value = None if best is None else value[best]
            rest = "" if best is None else rest[len(best) + 1 :]
        else:
            value, rest = None, ""
    if isinstance(value, bool) or not isinstance(value, int | float):
        known = [each for each, _ in _leaves(source(name, folder)["figures"], "")]
        near = difflib.get_close_matches(key, known, 2, 0.0)
        raise ValueError(f"figures/{name}.json has no number {key!r}; near are {near}")
    return float(value)


def computed(text: str, default: str, folder: Path) -> tuple[float, set[str]]:
    """Return the value of ``KEY`` or ``NAME:KEY``, or of several with `` * ``, `` / `` and so on.

    The names of the sources come with it.
    """
    try:
        return _operand(text, default, folder)
    except ValueError:
        parts = re.split(r" ([*/+-]) ", text)
        if len(parts) == 1:
            raise
    result, names = 0.0, set()
    for operator, operand in zip(["+", *parts[1::2]], parts[::2], strict=True):
        value, used = _operand(operand, default, folder)
        names |= used
        result = {
            "+": result + value,
            "-": result - value,
            "*": result * value,
            "/": result / value if value else math.inf,
        }[operator]
    return result, names


def _operand(text: str, default: str, folder: Path) -> tuple[float, set[str]]:
    """Return the value of a number or a key, and of which source it is."""
    named = re.fullmatch(r"([\w.-]+):(?! )(.+)", text)
    name, key = (named[1], named[2]) if named else (default, text)
    if not named and re.fullmatch(r"-?\d+(\.\d+)?", text):
        return float(text), set()
    return figure(name, key, folder), {name}


# ---- The check ----


def entries(path: Path) -> list[Entry]:
    """Read the entries of a page."""
    if not path.exists():
        return []
    with path.open("rb") as file:
        content = tomllib.load(file)
    return [
        Entry(each["begins"], each.get("source", ""), [*_flat(each["numbers"])])
        for each in content["block"]
    ]


def _flat(nested: Any) -> Iterator[str]:
    for each in nested:
        if isinstance(each, list):
            yield from _flat(each)
        else:
            yield each


class Checked(NamedTuple):
    """What was found on a page."""

    problems: list[str]
    changes: list[tuple[Number, str]]  # numbers that differ, and what the sources say
    of_sources: int  # numbers that have a source
    used: set[str]  # names of sources


def check(name: str, page: str, given: Sequence[Entry], folder: Path) -> Checked:
    """Compare the numbers of a page with its entries and their sources."""
    found = Checked([], [], 0, set())
    problems, used, count = found.problems, found.used, 0
    if not given and name != "README.md" and not CITED.search(page):
        return found
    parts = blocks(page)
    words = [block.words for block in parts]
    covered = set()
    for entry in given:
        begun = (text.startswith(entry.begins) for text in words)
        fits = [block for block, begins in zip(parts, begun, strict=True) if begins]
        if len(fits) != 1:
            how = "no block begins" if not fits else f"{len(fits)} blocks begin"
            problems.append(f"{name}: {how} with {entry.begins!r}")
            continue
        covered.add(fits[0].start)
        shown = numbers(fits[0])
        for place, (number, said) in enumerate(zip(shown, entry.numbers, strict=False)):
            if said.startswith("="):
                if said[1:] != number.shown:
                    problems.append(
                        f"{name}, {entry.begins!r}: number {place + 1} is {number.shown}, its "
                        f"entry has {said}: put its source or the new setting there"
                    )
                    break
                continue
            try:
                value, names = computed(said, entry.source, folder)
            except ValueError as error:
                problems.append(f"{name}, {entry.begins!r}: {number.shown} from {said!r}: {error}")
                continue
            used |= names
            count += 1
            if not agrees(number.shown, value):
                problems.append(
                    f"{name}, {entry.begins!r}: says {number.shown}, {said} of "
                    f"{', '.join(sorted(names))} is {value:.6g}: "
                    "change the text (--write), or run the source again (--run)"
                )
                found.changes.append((number, like(number.shown, value)))
        if len(shown) != len(entry.numbers):
            more = [number.shown for number in shown[len(entry.numbers) :]]
            problems.append(
                f"{name}, {entry.begins!r}: has {len(shown)} numbers, its entry has "
                f"{len(entry.numbers)}{': figure without a source: ' if more else ''}"
                f"{', '.join(more)}"
            )
    for block in to_cover(name, parts):
        shown = numbers(block)
        if shown and block.start not in covered:
            listed = ", ".join(number.shown for number in shown)
            problems.append(
                f"{name}, {block.words[:60]!r}: figures without a source: {listed}; "
                f"write an entry into docs/figures/{Path(name).stem}.toml"
            )
    return found._replace(of_sources=count)


def check_all(root: Path = ROOT, write: bool = False) -> tuple[list[str], str]:
    """Check README and all pages; return the problems, and a sentence about what was checked."""
    folder = root / "docs" / "figures"
    source.cache_clear()
    pages = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    problems: list[str] = []
    used: set[str] = set()
    count = 0
    for path in pages:
        page = path.read_text(encoding="utf-8")
        name = path.relative_to(root).as_posix()
        found = check(name, page, entries(folder / f"{path.stem}.toml"), folder)
        if write and found.changes:
            for number, text in sorted(found.changes, reverse=True):
                page = page[: number.start] + text + page[number.start + len(number.shown) :]
            path.write_text(page, encoding="utf-8")
            found = check(name, page, entries(folder / f"{path.stem}.toml"), folder)
        problems += found.problems
        used |= found.used
        count += found.of_sources
    stems = {path.stem for path in pages}
    problems += [
        f"docs/figures/{path.name}: there is no such page"
        for path in sorted(folder.glob("*.toml"))
        if path.stem not in stems
    ]
    names = sorted(path.stem for path in folder.glob("*.json"))
    for name in names:
        content = source(name, folder)
        program = shlex.split(content["command"])[1]
        if program.endswith(".py") and not (root / program).exists():
            problems.append(f"docs/figures/{name}.json: {program} does not exist any more")
        if name not in used:
            problems.append(f"docs/figures/{name}.json: no page uses it; delete it")
        if not content.get("transcribed") and not content.get("date"):
            problems.append(f"docs/figures/{name}.json: needs a date, or 'transcribed'")
    again = sum(1 for name in names if not source(name, folder).get("transcribed"))
    return problems, (
        f"{count} numbers on {len(pages)} pages from {len(names)} sources, of which {again} were "
        f"run and {len(names) - again} copied from the text"
    )


# ---- Running sources ----


def run(name: str, folder: Path) -> dict[str, Any]:
    """Run the command of a source and return what it writes, with its processor time."""
    known = source(name, folder)
    words = shlex.split(known["command"])
    of_quell = words[0] == "quell"
    words[:1] = [sys.executable, "-m", "quell"] if of_quell else [sys.executable]
    with tempfile.TemporaryDirectory() as work:
        out = Path(work) / "figures.json"
        before = os.times()
        done = subprocess.run(
            [*words, "--json", str(out)],
            cwd=work if of_quell else ROOT,  # quell leaves more files than this one
            check=False,
            capture_output=True,
            text=True,
        )
        after = os.times()
        if done.returncode or not out.exists():
            raise ValueError(
                f"{known['command']} ends with {done.returncode}: {done.stderr[-500:]}"
            )
        content: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    if of_quell:  # only parts of what it writes are figures
        kept = {key: content[key] for key in known.get("only", content)}
        content = {"date": f"{datetime.now(UTC):%Y-%m-%d}", "figures": kept}
    spent = after.children_user + after.children_system
    spent -= before.children_user + before.children_system
    made = {**content, "command": known["command"], "seconds": round(spent, 1)}
    return made | {key: known[key] for key in ("timings", "only") if key in known}


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return which figures of a source are other ones when it is run again."""
    timings = old.get("timings", [])
    after = dict(_leaves(new["figures"], ""))
    found = []
    for key, value in _leaves(old["figures"], ""):
        if key not in after:
            found.append(f"{key} is not measured any more")
            continue
        other = after[key]
        if max(abs(value), abs(other)) < ROUNDING:
            continue
        if any(each in key for each in timings):
            same = value > 0.0 and 1.0 / FACTOR <= other / value <= FACTOR
        else:
            same = abs(other - value) <= SHARE * abs(value)
        if not same:
            found.append(f"{key} was {value:.6g} and is {other:.6g}")
    return found


def _leaves(value: Any, name: str) -> Iterator[tuple[str, float]]:
    pairs: Any = ()
    if isinstance(value, dict):
        pairs = value.items()
    elif isinstance(value, list):
        pairs = enumerate(value)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield name, float(value)
    for key, each in pairs:
        yield from _leaves(each, f"{name}.{key}" if name else str(key))


def main() -> int:
    """Check, write or run; return 1 if there are problems."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true", help="change numbers of pages")
    parser.add_argument("--run", nargs="+", default=[], metavar="NAME", help="run sources, write")
    parser.add_argument("--rerun", type=int, default=0, metavar="K", help="compare K sources")
    parser.add_argument("--seed", type=int, default=0, help="of the draw of --rerun")
    parser.add_argument("--list", type=Path, metavar="PAGE", help="print numbers of a page")
    options = parser.parse_args()
    folder = ROOT / "docs" / "figures"
    if unknown := [name for name in options.run if not (folder / f"{name}.json").exists()]:
        parser.error(f"--run {' '.join(unknown)}: docs/figures has no such source")
    if options.list and not options.list.is_file():
        parser.error(f"--list {options.list}: there is no such page")
    if options.list:
        for block in blocks(options.list.read_text(encoding="utf-8")):
            if shown := numbers(block):
                print(f"{block.words[:60]}\n    {'  '.join(number.shown for number in shown)}")
        return 0
    for name in options.run:
        made = run(name, folder)
        for line in differences(source(name, folder), made):
            print(f"{name}: {line}")
        write_json(folder / f"{name}.json", made, overwrite=True)
    problems, sentence = check_all(write=options.write)
    print(sentence)
    quick = [
        path.stem
        for path in sorted(folder.glob("*.json"))
        if 0.0 <= source(path.stem, folder).get("seconds", math.inf) <= QUICK
    ]
    for name in random.Random(options.seed).sample(quick, min(options.rerun, len(quick))):
        print(f"again: {source(name, folder)['command']}")
        found = differences(source(name, folder), run(name, folder))
        problems += [f"docs/figures/{name}.json: {line}" for line in found]
    for problem in problems:
        print(problem)
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
