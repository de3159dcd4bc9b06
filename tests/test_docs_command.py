"""``quell docs``: pages of the documentation found by words, and shown."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from quell.cli import pages
from quell.cli.pages import Index, folder_of_pages, page_named, readable, sections_in, words_of

from .cases import cases
from .commands import Shown, in_this_process


@pytest.fixture(scope="module")
def index() -> Index:
    """The sections of all pages."""
    return Index.of(list(sections_in(folder_of_pages())))


@cases(
    ("question", "answers"),
    [
        ("encoder on the load", {"flexible_axis", "second_measurement"}),
        ("omega_o", {"adrc_numbers", "questions"}),
        ("NOT", {"questions"}),
        ("C", {"questions", "target", "servo_drive"}),
        ("safe", {"drive", "axes_bands", "questions"}),
        ("PID", {"pid"}),
        ("torch", {"python_models"}),
        ("cite", {"questions"}),
        ("licence", {"questions"}),
        ("license", {"questions"}),
        ("Windows", {"questions"}),
        ("Python", {"questions"}),
        ("contribute", {"questions"}),
        ("STM32", {"questions"}),
        ("ESP32", {"questions"}),
        ("Arduino", {"ecosystems"}),
        ("macOS", {"questions"}),
        ("iterative learning", {"questions", "repeated"}),
        ("dead time", {"oven", "pid", "identification", "tuning", "adrc_limits"}),
        ("Gymnasium", {"envs"}),
    ],
)
def test_a_question_has_its_page_among_the_first_three(
    index: Index, question: str, answers: set[str]
) -> None:
    """Words as people type them: another spelling, capitals, a name of a board."""
    found = [each.page for each in index.search(question)[:3]]
    assert answers & set(found), found


@cases(
    ("given", "page"),
    [
        ("theory_guard", "theory_guard"),
        ("docs/theory_guard", "theory_guard"),
        ("docs/target_faults.md", "target_faults"),
        ("rig.md#times-and-bounds", "rig"),
        ("guard_measured.html", "guard_measured"),
        ("theory guard", None),
    ],
)
def test_a_page_opens_by_its_name_as_it_stands_in_texts(
    index: Index, given: str, page: str | None
) -> None:
    """With or without folder, ending and section."""
    assert page_named(given, {each.page: each.title for each in index.sections}) == page


def test_every_page_that_the_package_names_exists(index: Index) -> None:
    """In messages, help and docstrings: what `docs/NAME` says opens so."""
    known = {each.page for each in index.sections}
    named = {
        name
        for file in Path(pages.__file__).parents[1].rglob("*.py")
        for name in re.findall(r"docs/([a-z_0-9]+)\b(?!\.py|/)", file.read_text(encoding="utf-8"))
    }
    assert len(named) > 20
    assert named - known <= {"figures", "_build"}


def test_a_page_is_plain_markdown_without_directives(index: Index) -> None:
    """What only the build of the pages reads is left out; code stays code."""
    for file in folder_of_pages().glob("*.md"):
        text = readable(file.read_text(encoding="utf-8"))
        assert not re.search(r"^```\{|^\([\w-]+\)=$|!\[", text, flags=re.M), file.name
        assert text.startswith("# "), file.name
    assert "```python\n" in readable((folder_of_pages() / "start.md").read_text(encoding="utf-8"))


def test_words_keep_short_capitals_and_know_other_spellings() -> None:
    """NOT is not the word not, and a licence is a license."""
    assert words_of("NOT decided: not here") == ["NOT", "not", "decided", "not", "here"]
    assert words_of("license") == words_of("licence")
    assert words_of("loops") == words_of("loop")


def test_the_command_shows_a_page_lists_all_and_finds_by_words(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In plain text where the output is no terminal; what has no answer or effect is refused."""

    def shown(*arguments: str) -> Shown:
        return in_this_process(("docs", *arguments), monkeypatch, capsys)

    assert shown("docs/zeros").out.startswith("# Plants with zeros")
    listed = shown().out
    assert re.search(r"^zeros +Plants with zeros$", listed, flags=re.M)
    assert len(listed.splitlines()) > 100
    assert "    quell docs flexible_axis\n" in shown("encoder", "on", "the", "load").out
    for arguments, said in ((("xyzzy",), "no page has these words"), (("--browser",), "no effect")):
        refused = shown(*arguments)
        assert refused.code == 2
        assert said in refused.err


def test_a_page_opens_in_the_browser(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a file of its own, with tables, and nothing of the page as HTML of its own."""
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    assert in_this_process(("docs", "wire", "--browser"), monkeypatch, capsys).code == 0
    text = Path(opened[0].removeprefix("file://")).read_text(encoding="utf-8")
    assert "<table>" in text
    assert "<script" not in text


def test_pages_are_found_in_an_installation_and_in_a_checkout(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """In the package first; an installation without them says what to do."""
    package = tmp_path / "src" / "quell"
    monkeypatch.setattr(pages, "_PACKAGE", package)
    with pytest.raises(ValueError, match="no pages; install quell anew"):
        folder_of_pages()
    for folder in (tmp_path / "docs", package / "pages"):
        folder.mkdir(parents=True)
        (folder / "index.md").write_text("# quell\n", encoding="utf-8")
        assert folder_of_pages() == folder
