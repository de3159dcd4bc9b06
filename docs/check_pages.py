"""Look at the built pages in a browser: ``python docs/check_pages.py SITE [PAGE …]``.

Every page is opened in Chromium 1280 and 390 pixels wide, in the light and in the dark theme.
Prints each overflow and returns 1 if there is one:

- *page*: the page scrolls sideways;
- *sticks out*: code, a table, a formula or an image is wider than the place that it has. On the
  narrow screen tables and formulas may scroll by themselves; code may not, its lines are wrapped;
- *word*: a cell of a table breaks within a word;
- *contrast*: text has less contrast than WCAG 2.1 asks for at level AA;
- *small*: a picture that is shown smaller than 200 pixels on the wide screen.

At the end stand the longest pages but those of the API, in screens of 800 pixels, 1280 wide.
Without Chromium or Playwright nothing is looked at, and the program says so.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

CHROMIUM = Path("/usr/bin/chromium")
OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
WIDE, NARROW, HEIGHT = 1280, 390, 800
# Pages that the theme or Sphinx make.
_MADE = ("search.html", "genindex.html", "py-modindex.html")

_LAYOUT = """(narrow) => {
  const article = document.querySelector("article.bd-article") || document.body;
  const found = [];
  const name = element => element.textContent.trim().replace(/\\s+/g, " ").slice(0, 50)
    || element.getAttribute("src") || element.tagName;
  const root = document.documentElement;
  if (root.scrollWidth > root.clientWidth) found.push(["page", `${root.scrollWidth} px`]);
  const right = article.getBoundingClientRect().right + 1;
  const scrolls = element => {
    for (let e = element; e && e !== article; e = e.parentElement) {
      const style = getComputedStyle(e).overflowX;
      if ((style === "auto" || style === "scroll") && e.clientWidth) return e;
    }
    return null;
  };
  for (const element of article.querySelectorAll("pre, table, img, mjx-container, video")) {
    const box = element.getBoundingClientRect();
    if (!box.width) continue;
    const inside = scrolls(element);
    const own = element.matches("pre") ? element.scrollWidth - element.clientWidth : 0;
    const past = inside ? inside.scrollWidth - inside.clientWidth : box.right - right;
    const wide = Math.max(own, past);
    const free = narrow && inside && !element.matches("pre, img");
    if (wide > 1 && !free)
      found.push(["sticks out", `${element.tagName} by ${Math.round(wide)} px: ${name(element)}`]);
    if (element.matches("img") && !narrow && box.width < Math.min(200, element.naturalWidth))
      found.push(["small", `${Math.round(box.width)} px: ${name(element)}`]);
  }
  for (const cell of article.querySelectorAll("td, th")) {
    const walker = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
    for (let node; (node = walker.nextNode());) {
      if (node.parentElement.closest("mjx-container")) continue;
      for (const word of node.data.matchAll(/[\\p{L}\\p{N}_.]+/gu)) {
        const range = document.createRange();
        range.setStart(node, word.index);
        range.setEnd(node, word.index + word[0].length);
        const tops = new Set([...range.getClientRects()].map(rect => Math.round(rect.top)));
        if (tops.size > 1) found.push(["word", word[0]]);
      }
    }
  }
  return [found, article.getBoundingClientRect().height];
}"""

_CONTRAST = """() => {
  const article = document.querySelector("article.bd-article") || document.body;
  const parse = text => (text.match(/[\\d.]+/g) || []).map(Number);
  const channel = c => (c /= 255) <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * channel(r) + 0.7152 * channel(g) + 0.0722 * channel(b);
  const over = (top, under) => {
    const a = top.length > 3 ? top[3] : 1;
    return [0, 1, 2].map(i => a * top[i] + (1 - a) * under[i]);
  };
  const backs = new Map();
  const back = element => {
    if (!element) return [255, 255, 255];
    if (!backs.has(element)) {
      const own = parse(getComputedStyle(element).backgroundColor);
      const solid = own.length === 3 || own[3] === 1;
      backs.set(element, solid ? own.slice(0, 3) : over(own, back(element.parentElement)));
    }
    return backs.get(element);
  };
  const found = new Map();
  const walker = document.createTreeWalker(article, NodeFilter.SHOW_TEXT);
  for (let node; (node = walker.nextNode());) {
    const element = node.parentElement, text = node.data.trim();
    if (!text || element.closest("script, style, mjx-assistive-mml, .headerlink, button")) continue;
    if (!element.getClientRects().length) continue;
    const style = getComputedStyle(element), under = back(element);
    const ink = [...parse(style.color), 1].slice(0, 4);
    for (let e = element; e; e = e.parentElement) ink[3] *= getComputedStyle(e).opacity;
    const [a, b] = [light(over(ink, under)), light(under)];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    const size = parseFloat(style.fontSize), bold = parseInt(style.fontWeight) >= 700;
    const least = size >= 24 || (bold && size >= 18.66) ? 3 : 4.5;
    const key = `${style.color} on ${under.map(Math.round)}`;
    if (ratio < least && !found.has(key))
      found.set(key, `${ratio.toFixed(2)}, ${key}: ${text.slice(0, 30)}`);
  }
  return [...found.values()];
}"""


def look(view: Any, path: Path) -> tuple[list[str], float]:
    """Return what is wrong with a page, a line each, and its height in screens."""
    view.set_viewport_size({"width": WIDE, "height": HEIGHT})
    view.goto(path.as_uri())
    view.evaluate("async () => { if (window.MathJax?.startup) await MathJax.startup.promise; }")
    found, screens = [], 0.0
    for width in (WIDE, NARROW):
        view.set_viewport_size({"width": width, "height": HEIGHT})
        problems, height = view.evaluate(_LAYOUT, width == NARROW)
        found += [f"{width} px: {kind}: {what}" for kind, what in problems]
        screens = screens or height / HEIGHT
    for theme in ("light", "dark"):
        view.evaluate(
            "theme => { document.documentElement.dataset.theme = theme; "
            "document.documentElement.dataset.mode = theme; }",
            theme,
        )
        found += [f"{theme}: contrast: {what}" for what in view.evaluate(_CONTRAST)]
    return found, screens


def main() -> int:
    """Look at the pages of the folder that the command line names."""
    parser = argparse.ArgumentParser(description="Look at the built pages in a browser.")
    parser.add_argument("site", type=Path, help="folder of the built pages")
    parser.add_argument("pages", nargs="*", help="names of pages; all without")
    options = parser.parse_args()
    site = options.site.resolve()
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        print("NOT looked at: Playwright is not installed")
        return 0
    if not CHROMIUM.exists():
        print(f"NOT looked at: there is no browser at {CHROMIUM}")
        return 0
    paths = [path for path in sorted(site.rglob("*.html")) if path.name not in _MADE]
    paths = [path for path in paths if "_static" not in path.parts]
    if options.pages:
        paths = [path for path in paths if path.stem in options.pages]
    heights, count = {}, 0
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=OPTIONS)
        view = browser.new_page(reduced_motion="reduce")
        for path in paths:
            name = str(path.relative_to(site).with_suffix(""))
            found, heights[name] = look(view, path)
            for line in found:
                print(f"{name}: {line}", flush=True)
            count += len(found)
        browser.close()
    texts = [name for name in heights if not name.startswith("api/")]
    longest = sorted(texts, key=heights.__getitem__, reverse=True)
    print("screens:", ", ".join(f"{name} {heights[name]:.1f}" for name in longest[:12]))
    print(f"{len(paths)} pages, {count} overflows")
    return 1 if count or not paths else 0


if __name__ == "__main__":
    sys.exit(main())
