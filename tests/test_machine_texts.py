"""The texts for machines have all names and pages, and say of each what its docstring says."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest

import quell as ql

DOCS = Path(__file__).parents[1] / "docs"
pytestmark = pytest.mark.skipif(
    not DOCS.is_dir(), reason="the pages are in the repository, not in what is built of it"
)


@pytest.fixture(scope="module")
def texts() -> Any:
    """The module that writes them."""
    spec = importlib.util.spec_from_file_location("machine_texts", DOCS / "machine_texts.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["machine_texts"] = module
    spec.loader.exec_module(module)
    return module


def test_the_reference_has_every_name_with_its_parameters(texts: Any) -> None:
    """Of all pages of names; a class that is called has a signature, and no mark of Sphinx is left."""
    reference = texts.reference()
    headings = re.findall(r"^### ([\w.]+)", reference, re.MULTILINE)
    names = [name for page in texts.pages_of_names() for name, _, _ in texts.names_of(page)]
    assert headings == names
    assert len(names) > 200
    assert len({*names}) == len(names)
    assert {f"quell.{name}" for name in ql.__all__ if name[0].isupper()} <= {*names}
    assert "### quell.ADRC(observer, omega_c, *, lea" in reference
    kalman = reference.partition("### quell.learners.Kalman(")[2].partition("\n### ")[0]
    assert "- `prior`: " in kalman
    assert not re.search(r":\w+:`|0x[0-9a-f]{6,}|/root/", reference)


def test_the_list_has_every_page_with_a_sentence(texts: Any) -> None:
    """And nothing else: titles and links are those of the files."""
    listed = texts.contents()
    links = dict(re.findall(r"^- \[[^\]]+\]\((\w+)\.html\): (.+)$", listed, re.MULTILINE))
    assert set(links) == {page.stem for page in DOCS.glob("*.md")}
    assert all(10 < len(sentence) < 400 for sentence in links.values())


def test_all_three_files_are_written(
    texts: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The schema as JSON; what it holds has tests of its own."""
    monkeypatch.setattr(texts, "json_schema", lambda: {"type": "object"})
    texts.write(tmp_path)
    assert json.loads((tmp_path / "setup.schema.json").read_text()) == {"type": "object"}
    assert {path.name for path in tmp_path.iterdir()} == {
        "llms.txt",
        "reference.md",
        "setup.schema.json",
    }
