"""``docs/check_pages.py``: what it finds in pages that are built to be wrong."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "docs" / "check_pages.py"
pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
pytestmark = [
    pytest.mark.trial,
    pytest.mark.skipif(
        not SCRIPT.exists() or not Path("/usr/bin/chromium").exists(),
        reason="the script is in the repository, and needs a browser",
    ),
]
PAGE = """<!doctype html><html><head><meta charset="utf-8"><style>
body {{ margin: 0; background: white; color: black }} article {{ padding: 10px }} {style}
</style></head><body><article class="bd-article">{body}</article></body></html>"""
GOOD = "<p>text</p><pre>code</pre><table><tr><td>a word</td></tr></table>"


def looked_at(folder: Path, **pages: tuple[str, str]) -> tuple[int, str]:
    """Write pages of a style and a body, and return the exit code and what is printed."""
    for name, (style, body) in pages.items():
        text = PAGE.format(style=style, body=body)
        (folder / f"{name}.html").write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(folder)], capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout + done.stderr


def test_pages_that_fit_pass_and_each_fault_of_others_is_named(tmp_path: Path) -> None:
    """One page for each kind of fault; the good page has no line."""
    long = "x" * 300
    code, said = looked_at(
        tmp_path,
        good=("", GOOD),
        code=("", f"<pre>{long}</pre>"),
        word=(
            "td { overflow-wrap: anywhere; width: 30px } table { width: 30px; table-layout: fixed }",
            "<table><tr><td>uninterrupted</td></tr></table>",
        ),
        grey=("p { color: #999 }", "<p>hardly legible</p>"),
    )
    assert code == 1
    assert "good:" not in said
    assert "code: 1280 px: page:" in said
    assert "code: 1280 px: sticks out: PRE by" in said
    assert "word: 1280 px: word: uninterrupted" in said
    assert "grey: light: contrast: 2.85" in said


def test_a_table_may_scroll_by_itself_on_the_narrow_screen_only(tmp_path: Path) -> None:
    """800 pixels fit into 1280, and scroll in a box of their own at 390."""
    box = '<div style="overflow-x: auto"><table style="min-width: {}px"><tr><td>a</td></tr></table></div>'
    code, said = looked_at(tmp_path, fits=("", box.format(800)))
    assert (code, "0 overflows" in said) == (0, True), said
    code, said = looked_at(tmp_path, fits=("", box.format(2000)))
    assert code == 1
    assert "fits: 1280 px: sticks out: TABLE" in said
    assert "390" not in said
