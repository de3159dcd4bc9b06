"""Check the links of the built pages: ``python docs/check_links.py SITE``.

Every file and anchor within the site must exist; addresses of other sites must be complete. Prints
each dead link and returns 1 if there is one.
"""

from __future__ import annotations

import argparse
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

# Pages that the theme makes for searching: their links are made by a script.
_MADE_BY_SCRIPT = ("search.html",)


class Page(HTMLParser):
    """The links and anchors of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors = {"", "top"}
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect ``href``, ``src``, ``id`` and ``name``."""
        for key, value in attrs:
            if key in ("href", "src") and value is not None:
                self.links.append(value)
            elif value and (key == "id" or (key == "name" and tag == "a")):
                self.anchors.add(value)


def dead_links(site: Path) -> list[str]:
    """Return a line for each dead link of the pages in a folder."""
    paths = [path.resolve() for path in sorted(site.rglob("*.html"))]
    pages = {path: Page(path) for path in paths if "_static" not in path.parts}
    found = []
    for path, page in pages.items():
        if path.name in _MADE_BY_SCRIPT:
            continue
        for link in dict.fromkeys(page.links):
            if reason := _reason(link, path, pages):
                found.append(f"{path.relative_to(site.resolve())}: {link}: {reason}")
    return found


def _reason(link: str, path: Path, pages: dict[Path, Page]) -> str:
    """Return what is wrong with a link of a page; empty if nothing is."""
    parts = urlsplit(link)
    if parts.scheme in ("mailto", "data"):
        return ""
    if parts.scheme or parts.netloc:
        good = parts.scheme in ("http", "https") and "." in parts.netloc
        return "" if good else "must be an http address with a host"
    target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
    if not target.is_file():
        return "there is no such file"
    page = pages.get(target)
    if page is not None and unquote(parts.fragment) not in page.anchors:
        return "the page has no such anchor"
    return ""


def main() -> int:
    """Check the folder that the command line names."""
    parser = argparse.ArgumentParser(description="Check the links of the built pages.")
    parser.add_argument("site", type=Path, help="folder of the built pages")
    site = parser.parse_args().site
    dead = dead_links(site)
    count = sum(len(Page(path).links) for path in site.rglob("*.html"))
    print(*dead, f"{count} links, {len(dead)} dead", sep="\n")
    return 1 if dead or not count else 0


if __name__ == "__main__":
    sys.exit(main())
