"""The studio's page in a browser: sliders move curves, pins stay, a lost connection recovers."""

from __future__ import annotations

import time
import zipfile
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quell.realtime import LiveSink
from quell.realtime.recordings import LOOP_WIDTH, Header, K, R, U, Y, row_channels
from quell.studio.runs import toml_of

from .studio_server import AXES, TABLES, Client, running, step_test

CHROMIUM = Path("/usr/bin/chromium")
OPTIONS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]
pytestmark = [
    pytest.mark.trial,
    pytest.mark.skipif(not CHROMIUM.exists(), reason=f"there is no browser at {CHROMIUM}"),
]
OMEGA_O = 'input[type=range][data-path="observer.omega_o"]'


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Debian's Chromium."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=str(CHROMIUM), args=OPTIONS)
        yield started
        started.close()


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    """The address of a studio."""
    with running(TABLES) as address:
        yield address


@pytest.fixture
def page(browser: Any, url: str) -> Iterator[Any]:
    """A page that shows the first run; an error in its scripts fails the test."""
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    opened = context.new_page()
    errors: list[str] = []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.goto(url)
    wait_for(lambda: opened.evaluate("window.studio.picture.frames") > 0)
    yield opened
    context.close()
    assert not errors


def wait_for(condition: Callable[[], Any], seconds: float = 60.0) -> None:
    """Wait until a condition holds, and fail if it does not."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


def curve(page: Any, name: str) -> Any:
    """Return a curve that the page shows."""
    return np.array(page.evaluate(f"Array.from(window.studio.picture.arrays.{name})"))


def slide(page: Any, key: str, times: int) -> None:
    """Press an arrow key on the slider of omega_o, and wait for the picture."""
    before = page.evaluate("window.studio.picture.times.length")
    for _ in range(times):
        page.locator(OMEGA_O).press(key)
    wait_for(lambda: page.evaluate("window.studio.picture.times.length") > before)
    wait_for(lambda: not page.evaluate("window.studio.busy()"))


def pixels(page: Any, plot: str) -> bytes:
    """Return a picture of a plot."""
    data: bytes = page.locator(plot).screenshot()
    return data


def test_a_slider_moves_the_curves_and_a_pinned_one_stays(page: Any) -> None:
    """By arrow keys; the pin has the curve of before, and nothing is compiled."""
    before, picture = curve(page, "y"), pixels(page, "#plot-y canvas")
    page.click("#pin")
    slide(page, "PageDown", 1)  # 40 steps
    after = curve(page, "y")
    assert np.max(np.abs(after - before)) > 0.02
    assert pixels(page, "#plot-y canvas") != picture
    assert page.locator(".pin").count() == 1
    pinned = np.array(page.evaluate("Array.from(window.studio.pins()[0].arrays.y)"))
    assert np.array_equal(pinned, before)

    def is_undone() -> bool:
        page.keyboard.press("Control+z")  # a pause between two inputs ends a step of undo
        wait_for(lambda: not page.evaluate("window.studio.busy()"))
        return np.array_equal(curve(page, "y"), before)

    wait_for(is_undone)
    page.locator('input[type=range][data-path="plant.den[1]"]').press("PageUp")
    assert page.input_value('input[data-path="plant.den"]') == "[1,6.34,0]"


def test_the_address_holds_the_state(page: Any, browser: Any) -> None:
    """Another page at the same address shows the same curves and pins."""
    page.click("#pin")
    slide(page, "PageUp", 1)
    shown = curve(page, "y")
    wait_for(lambda: len(page.evaluate("location.hash")) > 100)
    wait_for(lambda: page.evaluate("window.studio.saved()"))
    context = browser.new_context()
    other = context.new_page()
    other.set_viewport_size({"width": 1280, "height": 900})
    other.goto(page.evaluate("location.href"))
    wait_for(lambda: other.evaluate("window.studio.picture.frames") > 0)
    wait_for(lambda: other.evaluate("window.studio.pins().every((pin) => pin.arrays?.omega)"))
    assert other.locator(".pin").count() == 1
    assert curve(other, "y").max() == pytest.approx(shown.max(), abs=1e-4)
    context.close()


def test_exported_files_are_those_of_the_server(page: Any, url: str) -> None:
    """Which are those of the command line (test_studio)."""
    with page.expect_download() as download:
        page.click("#export-c")
    saved = Path(download.value.path()).read_bytes()
    client = Client(url)
    wanted = client.ask("file", do="export", to="c", setup=TABLES)["file"][2]
    client.close()
    with zipfile.ZipFile(BytesIO(saved)) as one, zipfile.ZipFile(BytesIO(wanted)) as other:
        assert one.namelist() == other.namelist()
        for name in one.namelist():
            assert one.read(name) == other.read(name)


def test_a_wrong_value_is_explained_and_the_next_one_works(page: Any) -> None:
    """The message names the key."""
    box = page.locator('input[type=text][data-path="observer.omega_o"]')
    box.fill("-5")
    wait_for(lambda: "omega_o" in page.inner_text("#message"))
    frames = page.evaluate("window.studio.picture.frames")
    box.fill("50")
    wait_for(lambda: page.evaluate("window.studio.picture.frames") > frames)
    wait_for(lambda: page.is_hidden("#message"))


def test_what_belongs_to_an_earlier_setup_is_dim_until_the_new_one_is_there(page: Any) -> None:
    """Curves and tiles of run and loop alike, with the reason; also beside a loop that does not run."""
    b0 = 'input[type=text][data-path="observer.b0"]'
    dim = "document.querySelectorAll('.stale').length"
    tiles = page.locator("#numbers > div").count()
    assert page.evaluate(dim) == 0
    page.fill(b0, "0")
    page.keyboard.press("Tab")
    wait_for(lambda: "the present one does not run" in page.inner_text("#stale"))
    assert page.locator("#numbers > .stale").count() == tiles
    assert page.locator(".grid.stale").count() == 2
    wait_for(lambda: float(page.evaluate(
        "getComputedStyle(document.querySelector('#numbers > .stale')).opacity")) < 0.5)  # fmt: skip
    wait_for(lambda: page.text_content("#said").startswith("Of an earlier setup"))
    page.fill(b0, "60")
    page.keyboard.press("Tab")
    wait_for(lambda: page.evaluate(dim) == 0)
    assert page.inner_text("#stale") == ""
    page.evaluate("window.studio.picture.want({ setup: {}, axis: 0 })")
    page.evaluate("window.studio.picture.of.run = window.studio.picture.wanted")
    page.evaluate("window.studio.picture.mark()")  # the run of a plant is there, its loop is not
    assert page.locator(".time.grid.stale").count() == 0
    assert page.locator(".loop.grid.stale").count() == 1
    parts = page.evaluate(
        "[...document.querySelectorAll('#numbers > .stale')].map((e) => e.dataset.part)"
    )
    assert set(parts) == {"loop"}


def test_a_lost_connection_recovers(browser: Any) -> None:
    """The server is killed and started again: the page goes on with what it had."""
    context = browser.new_context()
    page = context.new_page()
    with running(TABLES, token="same") as url:
        page.goto(url)
        wait_for(lambda: page.evaluate("window.studio.picture.frames") > 0)
        slide(page, "ArrowRight", 3)
        value = page.locator(OMEGA_O).get_attribute("aria-valuetext")
    wait_for(lambda: "lost" in page.inner_text("#state"))
    frames = page.evaluate("window.studio.picture.frames")
    with running(TABLES, int(url.split(":")[2].split("/")[0]), "same"):
        wait_for(lambda: page.evaluate("window.studio.picture.frames") > frames)
        assert page.locator(OMEGA_O).get_attribute("aria-valuetext") == value
        slide(page, "ArrowRight", 2)
        context.close()


def test_the_watch_tab_shows_a_running_loop(page: Any) -> None:
    """It connects to the live port of quell run-rig, as Foxglove does."""
    header = Header(row_channels((("status", 1),)), dt=1e-3, device="a lift", started=10**18)
    sink = LiveSink(port=0, rate=1000.0)
    sink.open(header)
    try:
        page.click("#tab-watch")
        page.fill("#watch-port", sink.url.rsplit(":", 1)[1])
        page.click("#watch-go")
        wait_for(lambda: "connected to a lift" in page.inner_text("#watch-state"))
        rows = np.zeros((1, LOOP_WIDTH + 1))

        def shown() -> bool:
            rows[0, [K, R, Y, U]] = rows[0, K] + 1.0, 1.0, 0.25, -0.5
            sink.write(rows)
            sink.flush()
            return "0.25" in page.inner_text("#watch-values")

        wait_for(shown)
        page.click("#tab-design")
    finally:
        sink.close()


def finished(page: Any) -> bool:
    """Return whether the page has drawn what it was asked for."""
    return not page.evaluate("window.studio.busy()") and page.is_hidden("#message")


def test_tours_set_the_sliders(page: Any) -> None:
    """Each next step changes the design, and says what to look at."""
    page.click("#tab-learn")
    page.locator("#tours button").nth(1).click()
    page.click("#tour-next")
    wait_for(lambda: page.input_value('input[type=text][data-path="observer.omega_o"]') == "15")
    assert "pinned" in page.inner_text("#tour-text")
    assert page.locator(".pin").count() == 1


def test_all_tours_run_through_all_their_steps(page: Any) -> None:
    """Without an error, which would leave the curves pale, and with the curves of the pins."""
    page.click("#tab-learn")
    for tour in range(page.locator("#tours button").count()):
        page.locator("#tours button").nth(tour).click()
        steps = int(page.inner_text("#tour-step").split(" of ")[1])
        for step in range(steps):
            assert page.inner_text("#tour-step") == f"{step + 1} of {steps}"
            wait_for(lambda: not page.evaluate("window.studio.busy()"), 120.0)
            wait_for(lambda: page.evaluate("window.studio.pins().every((pin) => pin.arrays?.t)"))
            assert page.get_attribute("#plots", "class") != "old"
            assert len(page.inner_text("#tour-text")) > 40
            page.click("#tour-next")
        assert page.is_hidden("#tour")


def test_pins_are_at_most_five_and_go_back_to_their_designs(page: Any) -> None:
    """Each has a colour of its own; a click goes back; one that is removed is undone."""
    before = page.locator(OMEGA_O).get_attribute("aria-valuetext")
    page.click("#pin")
    for _ in range(6):
        slide(page, "ArrowRight", 1)
        page.click("#pin")
    assert page.locator(".pin").count() == 5
    colours = page.evaluate(
        "[...document.querySelectorAll('.pin .swatch')].map((e) => getComputedStyle(e).borderTopColor)"
    )
    assert len(set(colours)) == 5
    first = page.evaluate("window.studio.pins()[0].setup.observer.omega_o")
    page.locator(".pin button").first.click()
    wait_for(lambda: page.locator(OMEGA_O).get_attribute("aria-valuetext") == f"{first:g}")
    assert before != f"{first:g}"
    wait_for(lambda: page.evaluate("window.studio.saved()"))  # what follows is a step of its own
    page.locator(".pin button").nth(1).click()
    assert page.locator(".pin").count() == 4
    wait_for(lambda: page.evaluate("window.studio.saved()"))
    page.click("#undo")
    wait_for(lambda: page.locator(".pin").count() == 5)


def test_a_text_that_is_no_number_says_why(page: Any) -> None:
    """By the field, for screen readers too; the loop keeps what it had; the next text works."""
    omega_o = page.locator('input[type=text][data-path="observer.omega_o"]')
    den = page.locator('input[type=text][data-path="plant.den"]')
    order = page.locator('input[type=text][data-path="observer.order"]')
    for box, text, reason in (
        (omega_o, "50,0", "50,0: write a decimal point, 50.0"),
        (omega_o, "fast", "fast is no number"),
        (order, "1.5", "1.5: must be a whole number"),
        (den, "[50, foo]", "foo is no number"),
        (den, "50,0", "a list has brackets, [50, 0]"),
        (den, "[1, 4, 0", "a bracket ] is missing"),
        (den, "1, 4, 0", "a list has brackets, [1, 4, 0]"),
    ):
        was = box.input_value()
        box.fill(text)
        assert reason in page.inner_text(".reason")
        assert box.get_attribute("aria-invalid") == "true"
        assert box.get_attribute("aria-describedby") == page.locator(".reason").get_attribute("id")
        box.fill(was)
        assert page.locator(".reason").count() == 0
    assert page.is_hidden("#message")
    page.click("#tune-box summary")
    page.fill("#tune-ms", "9")
    page.click("#tune")
    assert "9: must be from 1.05 to 5" in page.inner_text(".reason")
    assert not page.is_disabled("#tune")


def test_sliders_are_reached_in_few_tabs_and_by_arrow_keys(page: Any) -> None:
    """A group has one slider for Tab, Up and Down go on; titles and buttons likewise."""
    focused = "(e => e.dataset.path ? e.type + ' ' + e.dataset.path : e.id)(document.activeElement)"
    page.locator("#tab-design").focus()
    page.keyboard.press("Tab")
    assert page.evaluate(focused) == "open"
    page.keyboard.press("ArrowRight")
    assert page.evaluate(focused) == "save"
    page.locator("#forms .group > summary").first.focus()
    for _ in range(2):
        page.keyboard.press("ArrowDown")
    for _ in range(2):
        page.keyboard.press("Tab")
    assert page.evaluate(focused) == "range controller.omega_c"
    page.keyboard.press("ArrowDown")
    assert page.evaluate(focused) == "range controller.u_min"
    before = page.locator(":focus").get_attribute("aria-valuetext")
    page.keyboard.press("ArrowRight")
    assert page.locator(":focus").get_attribute("aria-valuetext") != before
    page.keyboard.press("Tab")
    assert page.evaluate(focused) == "text controller.u_min"
    page.keyboard.press("ArrowDown")
    assert page.evaluate(focused) == "text controller.u_max"


def test_the_numbers_are_said_when_they_are_at_rest(page: Any) -> None:
    """In a labelled live region; those outside of their bounds come first."""
    region = page.locator("#said")
    assert region.get_attribute("aria-live") == "polite"
    assert region.get_attribute("aria-label") == "Margins and metrics in words"
    wait_for(lambda: page.text_content("#said").startswith("All within bounds. M_s "))
    page.locator("details:has(#bounds) > summary").click()
    page.fill("#bound-m_s", "1.01")
    wait_for(lambda: page.text_content("#said").startswith("Outside of bounds: M_s "))


def test_a_tuned_controller_that_is_worse_is_shown_and_not_applied(page: Any) -> None:
    """Before and after stand side by side; a better one is applied; another plant's result goes."""
    omega_c = 'input[type=text][data-path="controller.omega_c"]'
    page.click("#tune-box summary")
    page.select_option("#tune-structure", "pi")
    page.click("#tune")
    wait_for(lambda: page.inner_text("#tune-verdict").startswith("NOT applied: worse in "))
    assert page.input_value(omega_c) == "8"
    assert page.locator("#tune-rows .worse").count() >= 2
    assert page.locator(".pin", has_text="tuned").count() == 1
    wait_for(lambda: page.is_enabled("#tune"))
    light = pixels(page, "#tradeoff canvas")
    page.click("#theme")
    assert pixels(page, "#tradeoff canvas") != light
    page.click("#tune-use")
    wait_for(lambda: page.input_value('select[data-path="controller.kind"]') == "pid")
    page.select_option("#tune-structure", "bandwidths")
    page.click("#tune")
    wait_for(lambda: page.inner_text("#tune-verdict").startswith(("Applied", "NOT applied")), 120.0)
    is_worse = page.locator("#tune-rows .worse").count() > 0
    assert page.inner_text("#tune-verdict").startswith("NOT applied" if is_worse else "Applied")
    wait_for(lambda: page.is_enabled("#tune"), 120.0)
    page.fill('input[type=text][data-path="plant.den"]', "[1, 5, 0]")
    assert page.inner_text("#tune-result") == ""
    assert page.is_hidden("#tune-compare")
    assert page.is_hidden("#tradeoff")


def test_all_controls_have_names_and_the_page_fits_a_phone(page: Any) -> None:
    """For screen readers and keyboards; without scrolling sideways."""
    nameless = page.evaluate(
        "[...document.querySelectorAll('input, select, button')].filter((e) => !(e.labels?.length"
        " || e.getAttribute('aria-label') || e.textContent.trim())).map((e) => e.outerHTML)"
    )
    assert nameless == []
    page.set_viewport_size({"width": 375, "height": 812})
    wait_for(lambda: page.evaluate("document.documentElement.scrollWidth <= 375"))


def drop(page: Any, *files: tuple[str, bytes]) -> None:
    """Drop files on the page."""
    transfer = page.evaluate_handle(
        "(files) => { const d = new DataTransfer(); files.forEach(([name, text]) =>"
        " d.items.add(new File([text], name))); return d; }",
        [[name, content.decode()] for name, content in files],
    )
    page.dispatch_event("body", "drop", {"dataTransfer": transfer})


def test_a_record_that_is_opened_is_shown_and_tuned_for(page: Any) -> None:
    """Plots, report and set of plants; the form has the model; a dropped one replaces it."""
    page.click("#record-box summary")
    page.fill("#record-order", "2")
    page.fill("#record-max_delay", "0.3")
    page.set_input_files(
        "#record-file", {"name": "heater.csv", "mimeType": "text/csv", "buffer": step_test()}
    )
    wait_for(lambda: page.is_visible("#record"))
    assert page.inner_text("#record-name").startswith("heater.csv: 400 samples, dt = 0.1 s")
    assert "gain 1.499" in page.text_content("#record-report")
    count = page.locator("#record-plants tr").count()
    assert page.text_content("#record-count") == f"Set of plants: {count}"
    assert page.locator("#plot-record-y canvas").count() == 1
    wait_for(lambda: page.input_value('input[type=text][data-path="dt"]') == "0.1")
    wait_for(lambda: not page.is_disabled("#record-go"))
    page.click("#tune-box summary")
    page.select_option("#tune-structure", "pi")
    page.click("#tune")
    wait_for(lambda: f"for the {count} plants of the record" in page.inner_text("#tune-result"))
    wait_for(lambda: not page.is_disabled("#tune"))
    drop(page, ("other.txt", step_test(300)))
    wait_for(lambda: page.inner_text("#record-name").startswith("other.txt: 300 samples"))
    wait_for(lambda: not page.is_disabled("#record-close"))
    page.click("#record-close")
    assert page.is_hidden("#record")


def test_a_file_that_is_dropped_is_read_or_refused(page: Any) -> None:
    """A setup is opened; a table without the columns names the field; two files are too many."""
    drop(page, ("a.csv", b"x"), ("b.csv", b"x"))
    assert "Drop one file" in page.inner_text("#record-state")
    drop(page, ("table.csv", b"time,power,heat\n" + b"0.1,1,2\n" * 20))
    wait_for(lambda: "the field Columns" in page.inner_text("#record-state"))
    assert page.is_hidden("#record")
    drop(page, ("setup.toml", toml_of(TABLES | {"dt": 0.004}).encode()))
    wait_for(lambda: page.input_value('input[type=text][data-path="dt"]') == "0.004")


def test_a_setup_with_an_identified_model_is_opened_with_its_file(page: Any) -> None:
    """Alone it names the file; together the form has the numbers of the model."""
    plant = {"kind": "identified", "path": "results/model.json"}
    setup = ("setup.toml", toml_of(TABLES | {"plant": plant}).encode())
    drop(page, setup)
    wait_for(lambda: "open the setup and model.json together" in page.inner_text("#message"))
    drop(page, setup, ("model.json", b'{"num": [50.0], "den": [1.0, 3.0, 0.0], "delay": 0.01}'))
    den = 'input[type=text][data-path="plant.den"]'
    wait_for(lambda: page.locator(den).count() and page.input_value(den) == "[1,3,0]")
    assert page.input_value('select[data-path="plant.kind"]') == "identified"
    wait_for(lambda: finished(page))


def test_of_several_axes_one_is_chosen_and_each_has_its_sliders(page: Any) -> None:
    """A pin's curves are those of the axis that is shown."""
    drop(page, ("axes.toml", toml_of(AXES).encode()))
    wait_for(lambda: page.is_visible("#axes"))
    wait_for(lambda: finished(page))
    assert page.locator("#axis option").all_inner_texts() == ["left", "right"]
    left = curve(page, "y")
    assert left.max() > 0.5
    page.click("#pin")
    page.select_option("#axis", index=1)
    wait_for(lambda: finished(page) and np.abs(curve(page, "y")).max() < 0.3)
    wait_for(lambda: page.evaluate("window.studio.pins()[0].arrays?.y?.length > 0"))
    pinned = np.array(page.evaluate("Array.from(window.studio.pins()[0].arrays.y)"))
    assert np.array_equal(pinned, curve(page, "y"))
    page.locator('input[type=range][data-path="axis[1].observer.omega_o"]').press("PageDown")
    wait_for(lambda: finished(page) and not np.array_equal(curve(page, "y"), pinned))
    drop(page, ("setup.toml", toml_of(TABLES).encode()))
    wait_for(lambda: page.is_hidden("#axes"))
