"""``quell tune``: transfer functions, setup files, outputs, errors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from quell.setup import load
from quell.tuning import STRUCTURES
from tests.commands import Shown, in_this_process

LAG = ("tune", "--num", "1", "--den", "1,1", "--dt", "0.1", "--structure", "pi")
SETUP = """
dt = 0.02
plant = {{ kind = "linear", num = [1.0], den = [1.0, 1.0], uncertain = {{ {range} }} }}

[tune]
structure = "pi"
m_s = 1.5
compare = []
samples = 3
check_samples = 20
"""


@pytest.fixture
def quell(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> object:
    """Return the function that runs a command here."""
    return lambda *arguments: in_this_process(arguments, monkeypatch, capsys)


@pytest.mark.slow
def test_a_transfer_function_is_tuned_and_written_as_a_setup(quell: object, tmp_path: Path) -> None:
    """With the references in the JSON file; nothing that exists is replaced."""
    out, results = tmp_path / "tuned.toml", tmp_path / "tuned.json"
    more = ("--out", str(out), "--json", str(results), "--no-figures")
    shown: Shown = quell(*LAG, *more)  # type: ignore[operator]
    assert shown.code == 0, shown.err
    assert "active: M_s = 1.6" in shown.out
    assert load(out).controller.dt == 0.1
    read = json.loads(results.read_text(encoding="utf-8"))
    assert read["design"]["k_i"] == pytest.approx(read["designs"]["pi"]["k_i"])
    assert {"pid", "poles", "bandwidths"} <= read["designs"].keys()
    again: Shown = quell(*LAG, *more)  # type: ignore[operator]
    assert again.code == 2
    assert "exists" in again.err


@pytest.mark.slow
def test_a_setup_with_ranges_is_tuned_for_them(quell: object, tmp_path: Path) -> None:
    """And checked on fresh samples; the result keeps plant, ranges, [tune] and feedforward."""
    path, out = tmp_path / "lag.toml", tmp_path / "tuned.toml"
    path.write_text(SETUP.format(range="friction = [0.5, 2.0]"), encoding="utf-8")
    shown: Shown = quell("tune", str(path), "--no-figures")  # type: ignore[operator]
    assert shown.code == 2
    assert "plant.friction" in shown.err
    text = SETUP.format(range="k = [0.9, 1.1]").replace(
        'kind = "linear", num = [1.0], den = [1.0, 1.0]', 'kind = "lagged-two-mass"'
    )
    text = text.replace("lagged-two-mass", "two-mass").replace('"pi"', '"bandwidths"')
    text = text.replace("m_s = 1.5", "m_s = 2.5\nm_t = 2.5\nm_ks = 3000.0\norder = 4")
    text += '[observer]\nkind = "model-free"\n[controller]\nfeedforward = true\nomega_c = 1.0\n'
    path.write_text(text, encoding="utf-8")
    shown = quell("tune", str(path), "--out", str(out), "--no-figures")  # type: ignore[operator]
    assert shown.code == 0, shown.err
    assert "20 fresh samples" in shown.out
    setup = load(out)
    assert setup.description.plant.uncertain == {"k": (0.9, 1.1)}
    assert setup.controller.observer.order == 4
    assert setup.controller.feedforward


def test_the_help_names_all_structures(quell: object) -> None:
    """As the registry has them."""
    shown: Shown = quell("tune", "--help")  # type: ignore[operator]
    words = shown.out.replace(",", " ").replace(";", " ").split()
    assert set(STRUCTURES) <= set(words)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("tune",), "setup: missing"),
        (("tune", "--num", "1", "--den", "1,x", "--dt", "0.1"), "den = '1,x'"),
        ((*LAG, "--m-s", "0.9"), "m_s = 0.9: must be above 1"),
        (("tune", "--num", "1,0", "--den", "1,3,3", "--dt", "0.1"), "zero at s = 0"),
    ],
)
def test_a_wrong_call_is_one_clear_error(
    quell: object, arguments: tuple[str, ...], message: str
) -> None:
    """With exit code 2."""
    shown: Shown = quell(*arguments, "--no-figures")  # type: ignore[operator]
    assert shown.code == 2
    assert message in shown.err
