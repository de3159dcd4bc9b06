"""``quell docs``: the pages of the documentation that come with the installation.

A search gives the sections of pages that answer it. A section scores by the words of the query that
it has, each with the weight of Okapi BM25 (Robertson & Zaragoza, *Foundations and Trends in
Information Retrieval* 3, 2009, eq. (3.15), k_1 = 1.2, b = 0.75)::

    Σ_words  ln(1 + (N − n + ½)/(n + ½)) · (k_1 + 1) f / (f + k_1 (1 − b + b l/l̄))

n of N sections have the word, f times in this one, whose length is l and l̄ in the mean. Words of
its heading count as ten in the text, those of the page's title as five. Short words in capitals, as
NOT, C and PID, are looked for in capitals; an s at the end of a word does not count.
"""

from __future__ import annotations

import math
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

from cyclopts import Parameter

_PACKAGE = Path(__file__).parents[1]
# Words of a heading and of a title, in words of the text. Chosen by hand.
_HEADING, _TITLE = 10, 5
_K1, _B = 1.2, 0.75
_HITS = 5  # that are shown
_WORD = re.compile(r"[^\W_]+(?:[_+#][^\W_]+)*")
# Other words for what pages call by one.
_SAME = {
    **{"license": "licence", "citation": "cite", "citing": "cite", "contributing": "contribute"},
    **{"pytorch": "torch", "omega": "omega_o", "ωo": "omega_o", "mac": "macos", "osx": "macos"},
}


class Section(NamedTuple):
    """A section of a page."""

    page: str  #: name of the page, as ``theory_guard``
    title: str  #: of the page
    heading: str  #: of the section; that of the page for its begin
    text: str


def docs(
    *words: str, browser: Annotated[bool, Parameter(name="--browser", negative="")] = False
) -> None:
    """Find a page of the documentation by words, or show the page of a name. Works offline.

    `quell docs encoder on the load` lists the sections that answer; `quell docs flexible_axis`
    shows that page. Without words it lists all pages.

    Parameters
    ----------
    words
        Words to look for, or the name of one page, as it stands in texts: `docs/theory_guard`.
    browser
        Open the page, or that of the best answer, in the browser.
    """
    from quell.cli.output import Console, print_line

    folder, console = folder_of_pages(), Console()
    sections = list(sections_in(folder))
    titles = {each.page: each.title for each in sections}
    if not words:
        if browser:
            raise ValueError("--browser: has no effect without a page; name one")
        width = max(map(len, titles))
        for name, title in titles.items():
            print_line(console, f"{name:{width}}  {title}")
        return
    page = page_named(" ".join(words), titles)
    if page is None:
        found = Index.of(sections).search(" ".join(words))[:_HITS]
        if not found:
            raise ValueError(
                f"docs {' '.join(words)}: no page has these words; try others, or quell docs "
                "alone, which lists all pages"
            )
        if not browser:
            for each in found:
                where = "" if each.heading == each.title else f": {each.heading}"
                print_line(console, f"{each.title}{where}")
                print_line(console, f"    {begin_of(each.text)}")
                print_line(console, f"    quell docs {each.page}")
            return
        page = found[0].page
    text = readable((folder / f"{page}.md").read_text(encoding="utf-8"))
    if browser:
        import webbrowser

        webbrowser.open(as_html(page, titles[page], text).as_uri())
        return
    show(text)


def folder_of_pages() -> Path:
    """Return the folder of the pages: of the installation, or of a checkout."""
    for folder in (_PACKAGE / "pages", _PACKAGE.parents[1] / "docs"):
        if (folder / "index.md").is_file():
            return folder
    raise ValueError("docs: this installation has no pages; install quell anew with pip")


def sections_in(folder: Path) -> Iterator[Section]:
    """Yield the sections of all pages."""
    for file in sorted(folder.glob("*.md")):
        title = heading = ""
        lines: list[str] = []
        fenced = False
        for line in [*readable(file.read_text(encoding="utf-8")).splitlines(), "# "]:
            fenced ^= line.startswith("```")
            mark = None if fenced else re.fullmatch(r"(#{1,3}) +(.*)|# ", line)
            if mark is None:
                lines.append(line)
                continue
            if heading:
                yield Section(file.stem, title, heading, "\n".join(lines).strip())
            heading, lines = (mark[2] or "").replace("`", ""), []
            title = title or heading


def page_named(given: str, titles: dict[str, str]) -> str | None:
    """Return the page of a name, as it stands in texts; None if there is none."""
    name = given.strip().removeprefix("docs/").partition("#")[0].removesuffix(".md")
    return name.removesuffix(".html") if name.removesuffix(".html") in titles else None


def words_of(text: str) -> list[str]:
    """Return the words that are looked for; see above."""
    found = []
    for word in _WORD.findall(text):
        if word.isupper() and len(word) <= 4:
            found.append(word)
        plain = word.casefold()
        plain = _SAME.get(plain, plain)
        found.append(plain[:-1] if len(plain) > 3 and plain.endswith("s") else plain)
    return found


class Index(NamedTuple):
    """Sections with the words that each has, and how often."""

    sections: list[Section]
    counts: list[Counter[str]]

    @classmethod
    def of(cls, sections: list[Section]) -> Index:
        """Count the words of sections."""
        counts = []
        for each in sections:
            count = Counter(words_of(each.text))
            for text, weight in ((each.heading, _HEADING), (each.title, _TITLE)):
                for word in words_of(text):
                    count[word] += weight
            counts.append(count)
        return cls(sections, counts)

    def search(self, query: str) -> list[Section]:
        """Return the sections that have words of the query, the best first, one of each page."""
        lengths = [count.total() for count in self.counts]
        mean, scores = sum(lengths) / len(lengths), [0.0] * len(lengths)
        # The first form of a word is in capitals if it is given so.
        for word in {words_of(each)[0] for each in _WORD.findall(query)}:
            having = sum(word in count for count in self.counts)
            weight = math.log(1.0 + (len(scores) - having + 0.5) / (having + 0.5)) * (_K1 + 1.0)
            for i, (count, length) in enumerate(zip(self.counts, lengths, strict=True)):
                f = count[word]
                scores[i] += weight * f / (f + _K1 * (1.0 - _B + _B * length / mean))
        best: dict[str, tuple[float, Section]] = {}
        for score, each in zip(scores, self.sections, strict=True):
            if score > best.get(each.page, (0.0, each))[0]:
                best[each.page] = score, each
        return [each for _, each in sorted(best.values(), key=lambda pair: -pair[0])]


def begin_of(text: str, most: int = 110) -> str:
    """Return the first sentence of a section, as a line of so many characters."""
    prose = [part for part in text.split("\n\n") if re.match(r"[\w*`\[\"(]", part)]
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(" ".join(prose[:1]).split()))
    plain = plain.replace("**", "").replace("`", "")
    return plain if len(plain) <= most else f"{plain[: most - 1].rpartition(' ')[0]} …"


def readable(text: str) -> str:
    """Return a page as plain Markdown, without what only the build of the pages reads."""
    text = re.sub(r"\A---\n.*?\n---\n", "", text, flags=re.DOTALL)
    text = re.sub(r"^```\{(toctree|raw|container)\}.*?^```\n", "", text, flags=re.M | re.S)
    moves = "*A loop that moves: in the built pages, in a browser.*\n"
    text = re.sub(r"^```\{moving\}.*?^```\n", moves, text, flags=re.M | re.S)
    text = re.sub(
        r"^```\{figure\}[^\n]*\n(?::[^\n]*\n)*(.*?)^```\n", r"*Figure.* \1", text, flags=re.M | re.S
    )
    text = re.sub(
        r"^```\{literalinclude\} *(\S+)\n(?::[^\n]*\n)*```\n", r"See `\1`.\n", text, flags=re.M
    )
    text = re.sub(r"^```\{code-cell\}[^\n]*\n(?::[^\n]*\n)*", "```python\n", text, flags=re.M)
    text = re.sub(r"^\([\w-]+\)=\n", "", text, flags=re.M)
    text = re.sub(r"\{download\}`([^`<]*?) *<([^>]*)>`", r"\1 (`\2`)", text)
    return re.sub(r"!\[([^\]]*)\]\([^)]*\)", r"*Figure: \1*", text).lstrip()


def show(text: str) -> None:
    """Show a page in the terminal, with a pager; as Markdown where the output is no terminal."""
    if not sys.stdout.isatty():
        print(text)
        return
    from rich.console import Console
    from rich.markdown import Markdown

    console = Console()
    with console.pager(styles=True):
        console.print(Markdown(text))


_HTML = """<!doctype html><meta charset="utf-8"><title>{title}</title><style>
body {{ max-width: 46rem; margin: 2rem auto; padding: 0 1rem; font: 1rem/1.5 sans-serif;
  color-scheme: light dark }}
pre {{ overflow-x: auto; padding: .7rem; border: 1px solid #8886 }}
table {{ border-collapse: collapse; display: block; overflow-x: auto }}
td, th {{ border: 1px solid #8886; padding: .2rem .5rem }}
</style>
{body}"""


def as_html(page: str, title: str, text: str) -> Path:
    """Write a page as HTML into a folder of its own, for the browser; return the file."""
    import tempfile
    from html import escape

    from markdown_it import MarkdownIt

    body = MarkdownIt("commonmark", {"html": False}).enable("table").render(text)
    file = Path(tempfile.mkdtemp(prefix="quell-docs-")) / f"{page}.html"
    file.write_text(_HTML.format(title=escape(title), body=body), encoding="utf-8")
    return file
