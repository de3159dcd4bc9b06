"""The moving pictures of the documentation, in a browser: they have the bits of ``simulate``."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import quell as ql

from .cases import cases

SCRIPT = Path(__file__).parents[1] / "docs" / "moving_loop.py"
CHROMIUM = Path("/usr/bin/chromium")
OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
MACHINES = ("two-mass", "servo")
STRUCTURES = {"plain": (False, False), "learner": (True, False), "guarded": (True, True)}
# What the pages of the site may weigh, and how long the test runs a loop.
LARGEST, SAMPLES = 200_000, 4000
pytestmark = pytest.mark.skipif(
    not SCRIPT.exists() or importlib.util.find_spec("sphinx") is None,
    reason="the pages are in the repository, and Sphinx builds them",
)
PAGE = """<!doctype html><html data-theme="light"><meta charset="utf-8">
<meta name="viewport" content="width=device-width"><link rel="stylesheet" href="moving.css">"""
BLOCK = """<div class="moving-loop" data-machine="{name}"></div>
<script src="moving-{name}.js"></script><script src="moving.js"></script>"""


@pytest.fixture(scope="module")
def pictures() -> Iterator[ModuleType]:
    """The module of the pages that makes the pictures."""
    sys.path.insert(0, str(SCRIPT.parent))
    try:
        import moving_loop

        yield moving_loop
    finally:
        sys.path.remove(str(SCRIPT.parent))


@pytest.fixture(scope="module")
def site(pictures: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files of the pictures, and a page for each machine."""
    if pictures.missing_tools():
        pytest.skip(f"not installed: {' '.join(pictures.missing_tools())}")
    folder = tmp_path_factory.mktemp("moving")
    pictures.write(folder)
    blocks = {name: BLOCK.format(name=name) for name in MACHINES}
    for name, text in {**blocks, "both": "".join(blocks.values())}.items():
        (folder / f"{name}.html").write_text(PAGE + text, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def browser(site: Path) -> Iterator[Any]:
    """Debian's Chromium."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    if not CHROMIUM.exists():
        pytest.skip(f"there is no browser at {CHROMIUM}")
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=str(CHROMIUM), args=OPTIONS)
        yield started
        started.close()


@pytest.fixture(params=MACHINES)
def page(request: pytest.FixtureRequest, browser: Any, site: Path) -> Iterator[Any]:
    """A page with a machine, opened from its file; an error in its scripts fails the test."""
    opened = browser.new_page(viewport={"width": 900, "height": 700})
    errors: list[str] = []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.goto((site / f"{request.param}.html").as_uri())
    opened.wait_for_function("window.movingLoops?.length > 0")
    opened.machine = request.param
    yield opened
    opened.close()
    assert not errors


def pull(page: Any) -> None:
    """Take the machine with the mouse, pull it to and fro, and let it go."""
    page.evaluate("movingLoops[0].canvases[0].scrollIntoView()")
    box = page.locator(".ml-machine").bounding_box()
    now = page.evaluate("movingLoops[0].places()")
    if page.machine == "servo":
        x, y = 0.6 * now["tip"][0] + 0.4 * now["cx"], 0.6 * now["tip"][1] + 0.4 * now["cy"]
    else:
        x, y = now["centres"][0], now["floor"] - 0.5 * now["size"]
    page.mouse.move(box["x"] + x, box["y"] + y)
    page.mouse.down()
    for step in range(12):
        page.mouse.move(box["x"] + x + 90 * np.sin(0.5 * step), box["y"] + y - 4 * step)
        page.wait_for_timeout(40)
    page.mouse.up()


def run_of_page(page: Any, learner: bool, guard: bool, positions: list[int]) -> dict[str, Any]:
    """Run the page from rest while a mouse pulls, and return what it did."""
    page.evaluate(
        """([learner, guard, positions]) => {
          const picture = movingLoops[0];
          Object.assign(picture.settings, {learner, guard, positions, load: 12});
          picture.recording = true;
          picture.paused = false;
          picture.restart();
        }""",
        [learner, guard, positions],
    )
    pull(page)
    page.evaluate(
        f"""() => {{
          const picture = movingLoops[0];
          picture.paused = true;
          picture.advance(Math.max({SAMPLES} - picture.count, 1));
        }}"""
    )
    record = page.evaluate("movingLoops[0].record")
    return {key: np.array(value) for key, value in record.items()}


def held(values: Any, dt: float) -> ql.signals.Samples:
    """Return samples of a page as a signal."""
    return ql.signals.Samples(dt * np.arange(len(values)), values, hold="previous")


@pytest.mark.trial
@pytest.mark.parametrize("structure", STRUCTURES)
@pytest.mark.parametrize("positions", [[12, 12, 12], [15, 10, 17]], ids=["first", "moved"])
def test_a_page_has_the_bits_of_a_simulation(
    page: Any, pictures: ModuleType, structure: str, positions: list[int]
) -> None:
    """y, u, f̂ and f_L under references and loads of the page, of a mouse among them."""
    found = run_of_page(page, *STRUCTURES[structure], positions)
    assert np.abs(found["w"]).max() > 0.0
    assert np.ptp(found["r"]) > 0.0
    machine = pictures.MACHINES[page.machine]()
    design = [
        machine.values(slider)[at] for slider, at in zip(pictures.SLIDERS, positions, strict=True)
    ]
    scenario = ql.Scenario(
        reference=held(found["r"], machine.dt),
        disturbances=tuple(held(w, machine.dt) for w in found["w"].T),
        duration=machine.dt * (found["r"].size - 1),
    )
    controller = machine.controller(structure, *design)
    run = ql.simulate(machine.plant, controller, scenario, interpret=True)
    assert run.t.size == found["y"].size >= SAMPLES
    for key, channel in {"r": "r", "y": "y", "u": "u", "x": "x", "w": "w", "fHat": "f_hat"}.items():
        assert np.array_equal(found[key], run[channel].reshape(found[key].shape)), key
    if structure != "plain":
        assert np.array_equal(found["fLearned"], run["f_learned"].ravel())
        assert np.abs(found["fLearned"]).max() > 0.0


@pytest.mark.trial
def test_the_true_f_of_a_page_is_the_derivative_of_y_without_b0_u(page: Any) -> None:
    """Its mean over a sample's neighbours, against differences of y, where r and u do not jump."""
    found = run_of_page(page, False, False, [12, 12, 12])
    machine = page.evaluate("movingLoops[0].machine")
    n, dt, b0 = machine["order"], machine["dt"], machine["positions"][0][12]
    if page.machine == "servo":  # the mean over a sample: of the speed
        derivative = np.diff(found["x"][:, 1]) / dt
        f, u = found["f"][:-1], found["u"][:-1]
    else:  # the n-th difference is a mean over n samples, about their middle
        coarse = 20
        y = found["y"][::coarse]
        derivative = np.diff(y, n) / (coarse * dt) ** n
        weights = np.ones(1)
        for _ in range(n):
            weights = np.convolve(weights, np.full(coarse, 1.0 / coarse))
        f, u = (np.convolve(found[key], weights, "valid")[::coarse] for key in ("f", "u"))
    size = min(derivative.size, f.size)
    wanted = derivative[:size] - b0 * u[:size]
    error = np.abs(f[:size] - wanted)
    assert np.quantile(error, 0.9) < 0.02 * np.abs(wanted).max()


@pytest.mark.trial
def test_the_margin_of_a_page_is_that_of_analyse(page: Any, pictures: ModuleType) -> None:
    """M_s to 1e-3 where the loop is stable, and NOT stable where it is not, over the sliders."""
    machine, rng = pictures.MACHINES[page.machine](), np.random.default_rng(2)
    verdicts = set()
    for _ in range(40):
        positions = rng.integers(0, pictures.POSITIONS, 3).tolist()
        shown = page.evaluate(
            """(positions) => {
              const picture = movingLoops[0];
              picture.loop.write(positions);
              return movingLoops.largestSensitivity(picture.machine, picture.loop.design());
            }""",
            positions,
        )
        design = [machine.values(s)[k] for s, k in zip(pictures.SLIDERS, positions, strict=True)]
        loop = ql.analysis.analyse(machine.linear, machine.controller("plain", *design))
        verdicts.add(bool(loop.stable))
        if loop.stable:
            assert shown == pytest.approx(1.0 / loop.margins.modulus, rel=1e-3)
        else:
            assert shown == np.inf
    assert True in verdicts


@pytest.mark.trial
def test_a_loop_that_is_not_stable_says_so_and_what_helps(browser: Any, site: Path) -> None:
    """A b0 of 0.4 is too low for two masses; the first way out that is named works."""
    opened = browser.new_page()
    opened.goto((site / "two-mass.html").as_uri())
    opened.wait_for_function("window.movingLoops?.length > 0")
    opened.evaluate("movingLoops[0].set('b0', 0)")
    assert opened.inner_text("[data-n=margin]") == "NOT stable: raise b0"
    opened.evaluate("movingLoops[0].set('b0', 12)")
    assert opened.inner_text("[data-n=margin]").startswith("2.63")
    opened.close()


@pytest.mark.trial
def test_switches_and_sliders_keep_what_the_observer_knows(page: Any) -> None:
    """f̂ goes on without a jump where a learner comes or goes, and where a bandwidth changes."""
    run_of_page(page, True, True, [12, 12, 12])
    for change in ("learner', false", "learner', true", "guard', false", "omega_o', 15"):
        before, after, usual = page.evaluate(
            f"""() => {{
              const picture = movingLoops[0], list = picture.record.fHat;
              const before = list.at(-1), usual = Math.max(...list.slice(-400).map(Math.abs));
              picture.set('{change});
              picture.advance(1);
              return [before, list.at(-1), usual];
            }}"""
        )
        assert abs(after - before) < 0.1 * usual, change


@pytest.mark.trial
def test_the_controls_of_a_page_do_what_they_say(page: Any) -> None:
    """Sliders by keys, switches, a button that pushes, a change of the theme, a narrow screen."""
    state = "(() => { const p = movingLoops[0]; return [p.settings, p.structure, p.margin]; })()"
    page.evaluate("movingLoops[0].set('learner', false); movingLoops[0].set('load', 0)")
    before = page.evaluate(state)
    page.locator("input[data-key=omega_o]").press("ArrowRight")
    page.locator("input[data-key=learner]").check()
    page.locator("input[data-key=guard]").uncheck()
    after = page.evaluate(state)
    assert after[0]["positions"][2] == before[0]["positions"][2] + 1
    assert (before[1], after[1]) == (0, 1)
    assert after[2] != before[2]
    page.locator("[data-do=right]").hover()
    page.mouse.down()
    page.wait_for_function("movingLoops[0].load.some((w) => w > 0)")
    page.mouse.up()
    page.wait_for_function("movingLoops[0].hand.target === 0")
    page.evaluate("document.documentElement.dataset.theme = 'dark'")
    page.wait_for_function("movingLoops[0].colours.y === '#62b0ff'")
    page.set_viewport_size({"width": 390, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.trial
def test_a_page_may_have_several_pictures(browser: Any, site: Path) -> None:
    """Each has the machine that it names."""
    opened = browser.new_page()
    opened.goto((site / "both.html").as_uri())
    opened.wait_for_function("window.movingLoops?.length === 2")
    names = "movingLoops.map((each) => each.element.dataset.machine + each.machine.order)"
    assert sorted(opened.evaluate(names)) == ["servo2", "two-mass4"]
    opened.close()


@pytest.mark.trial
def test_the_files_of_the_pictures_are_small(site: Path) -> None:
    """Both machines with code and style."""
    files = [path for path in site.iterdir() if path.suffix in (".js", ".css")]
    assert len(files) == 4
    assert sum(path.stat().st_size for path in files) <= LARGEST


@pytest.mark.trial
def test_the_webassembly_needs_nothing_from_outside(page: Any) -> None:
    """No function of a library of the browser is in the bits."""
    imports = page.evaluate(
        """() => {
          const bytes = Uint8Array.from(atob(movingLoops[0].machine.wasm), (c) => c.charCodeAt(0));
          return WebAssembly.compile(bytes).then((made) => WebAssembly.Module.imports(made).length);
        }"""
    )
    assert imports == 0


def test_without_a_compiler_a_page_says_what_to_install(
    pictures: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The names are those of Debian's packages."""
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert pictures.missing_tools() == ["clang", "lld"]
    monkeypatch.setattr(shutil, "which", lambda name: name if name.startswith("clang") else None)
    assert pictures.missing_tools() == ["lld"]


@pytest.mark.trial
def test_a_site_is_built_without_a_compiler(tmp_path: Path) -> None:
    """A page has the figure and the packages; nothing warns."""
    pages, bare = tmp_path / "pages", tmp_path / "bare"
    (pages / "images").mkdir(parents=True)
    bare.mkdir()
    shutil.copyfile(SCRIPT.parent / "images" / "learning.png", pages / "images" / "learning.png")
    (pages / "conf.py").write_text("extensions = ['myst_parser', 'moving_loop']\n")
    (pages / "index.md").write_text("# Page\n\n```{moving} servo\n:load: 0.3\n```\n")
    paths = f"{SCRIPT.parent}:{Path(ql.__file__).parents[1]}"
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "-b", "html", pages, tmp_path / "site"]
    done = subprocess.run(
        command,
        env={"PATH": str(bare), "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert "clang lld" in text
    assert "images/learning.png" in text
    assert "moving.js" not in text


@cases(
    ("text", "struct", "offsets", "size"),
    [
        ("typedef struct {\n    bool a;\n    double b[2];\n} p;", "p", [0, 8, 16], 24),
        ("typedef struct {\n    int a; /* of it */\n    bool b;\n} p;", "p", [0, 4], 8),
        (
            "typedef struct {\n    bool a;\n    int b;\n} q;\ntypedef struct {\n    bool a;\n"
            "    q b;\n    double c[2][1];\n} p;",
            "p",
            [0, 4, 8, 16, 24],
            32,
        ),
    ],
)
def test_the_layout_of_c_is_computed(
    pictures: ModuleType, text: str, struct: str, offsets: list[int], size: int
) -> None:
    """By hand for 32 bits; the compiler checks each offset of the real ones."""
    entries, found = pictures.layout(text, struct)
    assert [entry.offset for entry in entries] == offsets
    assert found == size
