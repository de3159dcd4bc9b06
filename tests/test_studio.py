"""The studio's server: who may connect, what frames contain, and what messages can do."""

from __future__ import annotations

import json
import socket
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse
from quell.kernels.cache import compile_time
from quell.setup import load, made
from quell.setup.loading import changed
from quell.studio import messages, separate
from quell.studio.messages import Columns, frame, parsed_frame
from quell.studio.records import PageRecord
from quell.studio.runs import Maker, StoppedError, loop_of, python_of, toml_of
from quell.studio.server import FIRST_REQUEST, MOST_CONNECTIONS
from quell.studio.tasks import frames_for, varied

from .studio_server import AXES, TABLES, Client, running

PAGE = Path(ql.__file__).parent / "studio" / "page"


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    """The address of a studio."""
    with running(TABLES) as address:
        yield address


@pytest.fixture
def client(url: str) -> Iterator[Client]:
    """A page of it."""
    page = Client(url)
    yield page
    page.close()


def status(address: str, **headers: str) -> int:
    """Return the status of the answer to a request."""
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers)) as answer:
            code: int = answer.status
            return code
    except urllib.error.HTTPError as error:
        return error.code


def with_values(**values: Any) -> dict[str, Any]:
    """Return ``TABLES`` with values by path, a double underscore for each dot."""
    changes = {path.replace("__", "."): value for path, value in values.items()}
    return changed("tables", TABLES, changes)


def test_a_run_and_its_loop_are_those_of_simulate_and_analyse(client: Client) -> None:
    """In float32: the ends of each pixel column, the margins, the metrics."""
    found = client.ask("loop", do="run", setup=TABLES, columns=100)
    setup = made("tables", TABLES)
    assert setup.plant is not None
    assert setup.scenario is not None
    run = ql.simulate(setup.plant, setup.controller, setup.scenario)
    header, arrays, _ = found["run"]
    for name in ("y", "u", "f_hat"):
        assert arrays[name].size == 200
        assert np.max(arrays[name]) == np.float32(np.max(run[name]))
        assert np.min(arrays[name]) == np.float32(np.min(run[name]))
    assert header["metrics"][0]["iae"] == pytest.approx(run.metrics()["iae"], rel=1e-12)
    loop = analyse(setup.plant, setup.controller)
    numbers, curves = found["loop"][0]["loop"], found["loop"][1]
    assert numbers["m_s"] == pytest.approx(1.0 / loop.margins.modulus, rel=1e-12)
    assert numbers["phase_margin"] == pytest.approx(loop.margins.phase, rel=1e-12)
    S = np.abs(loop.response("S", curves["omega"]))
    assert 20.0 * np.log10(S) == pytest.approx(curves["S"], abs=1e-3)


def test_moving_a_slider_compiles_nothing(client: Client) -> None:
    """Bandwidths, b0 and the plant's parameters change values, not types."""
    client.ask("loop", do="run", setup=TABLES)
    before = compile_time.seconds
    tables = with_values(observer__omega_o=55.0, observer__b0=40.0, controller__omega_c=6.0)
    tables["plant"] = {"kind": "linear", "num": [45], "den": [1, 3.5, 0.25]}
    found = client.ask("loop", do="run", setup=tables)
    assert found["run"][0]["compiled"] == 0.0
    assert compile_time.seconds == before


def test_warnings_of_the_design_reach_the_page_each_time(client: Client) -> None:
    """An observer that is too fast for the sample time, also when something else moves."""
    for omega_c in (8.0, 9.0):
        tables = with_values(observer__omega_o=2000.0, controller__omega_c=omega_c)
        found = client.ask("loop", do="run", setup=tables)
        assert "omega_o * dt" in " ".join(found["run"][0]["warnings"])


def test_a_frame_is_sent_without_waiting_for_the_one_before() -> None:
    """Each connection has the option of its listener; without it the loop came 40 ms late."""
    pytest.importorskip("uvicorn")
    from quell.studio.server import listen

    listener, studio, _ = listen(port=0)
    with listener, closing(studio), socket.create_connection(listener.getsockname()):
        connection, _ = listener.accept()
        with connection:
            assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_only_the_page_with_the_token_is_answered(url: str) -> None:
    """Another token, host or origin gets nothing; no path leads to files."""
    host = "/".join(url.split("/")[:3])
    assert status(url) == 200
    assert status(url + "main.js") == 200
    assert status(host + "/wrong/") == 403
    assert status(url, Host="evil.example") == 403
    assert status(url, Origin="http://evil.example") == 403
    for path in ("../server.py", "%2e%2e/server.py", "..%2fserver.py", "/etc/passwd", "page"):
        assert status(url + path) in (403, 404)
    from websockets.exceptions import InvalidStatus

    for wrong in ({"origin": "http://evil.example"}, {"origin": "null"}, {"origin": None}):
        with pytest.raises(InvalidStatus):
            Client(url, **wrong)
    with pytest.raises(InvalidStatus):
        Client(host + "/wrong/")


@pytest.mark.trial
def test_connections_that_ask_for_nothing_are_closed_and_lock_out_no_page(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Many that are silent, and some that send a request byte by byte: one line in the log."""
    with running(TABLES) as address, ExitStack() as stack:
        host, port = address.split("/")[2].split(":")
        silent = [
            stack.enter_context(socket.create_connection((host, int(port))))
            for _ in range(MOST_CONNECTIONS + 100)
        ]
        slow = stack.enter_context(socket.create_connection((host, int(port))))
        began = time.monotonic()
        assert status(address) == 200
        assert time.monotonic() - began < FIRST_REQUEST
        page = Client(address)
        for byte in b"GET / HT":
            slow.send(bytes([byte]))
            time.sleep(FIRST_REQUEST / 12)
        assert "texts" in page.ask("texts", do="toml", setup=TABLES)
        for each in (*silent, slow):
            each.settimeout(5.0)
            with suppress(ConnectionResetError):
                assert each.recv(1) == b""
        page.close()
    lines = [each.getMessage() for each in caplog.records if "connections were closed" in each.msg]
    assert len(lines) == 1


@pytest.mark.trial
def test_a_large_plant_is_analysed_apart_and_for_a_limited_time(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page of a plant of order 250 hears that it takes too long; another page does not wait."""
    monkeypatch.setattr(separate, "LONGEST", 0.5)
    heavy, other = Client(url), Client(url)
    other.ask("loop", do="run", setup=TABLES)
    den = np.poly(-np.linspace(1.0, 1.5, 250)).tolist()
    number = heavy.send(do="run", setup=with_values(plant__den=den))
    began = time.monotonic()
    for omega_o in (41.0, 42.0, 43.0):
        assert "loop" in other.ask("loop", do="run", setup=with_values(observer__omega_o=omega_o))
    waited = time.monotonic() - began
    found = heavy.answer("loop", number)
    assert "took more than 0.5 s" in " ".join(found["error"][0]["text"])
    assert waited < time.monotonic() - began
    heavy.close()
    other.close()


@pytest.mark.trial
def test_a_process_of_its_own_gives_the_same_frames() -> None:
    """A list beyond the limit makes a setup large; errors are the same sentence; a stop ends it."""
    den = np.poly(-np.linspace(1.0, 1.5, 45)).tolist()
    setup = with_values(plant__den=den)
    message = {"do": "toml", "id": 1, "setup": setup}
    assert separate.is_large(message)
    assert not separate.is_large({"do": "toml", "id": 1, "setup": TABLES})
    about = messages.Granted(), PageRecord(), lambda: False, lambda part, share: None
    apart = list(separate.frames_apart(message, *about))
    assert apart == list(frames_for(message, Maker(), *about))
    wrong = changed("tables", setup, {"observer.omega_o": None})
    with pytest.raises(ValueError, match="omega_o"):
        list(separate.frames_apart(message | {"setup": wrong}, *about))
    with pytest.raises(StoppedError):
        list(separate.frames_apart(message, about[0], about[1], lambda: True, about[3]))


HOSTILE = (
    "", "{", "[]", "null", '{"do": "run"}', '{"do": "rm", "id": 1}', '{"do": "run", "id": -1}',
    '{"do": "run", "id": 1, "setup": 3}', '{"do": "run", "id": 1, "setup": {"dt": NaN}}',
    "[" * 5000, '{"do": "run", "id": ' + "9" * 5000 + "}", '{"do": "open", "id": 1, "text": "a = "}',
    '{"do": "export", "id": 1, "to": "/etc"}',
    '{"do": "run", "id": 1, "setup": {"dt": 1, "plant": ' + "[" * 900 + "]" * 900 + "}}",
)  # fmt: skip


@pytest.mark.parametrize("text", HOSTILE)
def test_a_malformed_message_gives_an_error_and_no_more(client: Client, text: str) -> None:
    """The next message is answered as if nothing had been."""
    client.socket.send(text)
    assert client.next()[0]["kind"] == "error"
    assert "texts" in client.ask("texts", do="toml", setup=TABLES)


@pytest.mark.trial
@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("plant", {"kind": "fmu", "path": "/tmp/evil.fmu"}, "opens no files"),
        ("plant", {"kind": "python", "source": "evil.py:plant"}, "opens no files"),
        ("observer.plant", {"kind": "identified", "path": "/etc/passwd"}, "opens no files"),
        ("tune", {"storage": "/tmp/file"}, "the studio opens no files"),
        ("scenario.duration", 1e9, "must be at most"),
        ("observer.order", 1_000_000, "must be at most"),
        ("plant", {"kind": "delayed", "delay": 1e6, "plant": TABLES["plant"]}, "10000 samples"),
        ("observer.omega_o", "1", "observer.omega_o"),
        ("observer.omega_o", None, "observer.omega_o"),
        ("dt", 0.0, "dt"),
        ("plant.num", [0.0] * 2000, "entries"),
    ],
)
def test_a_setup_beyond_its_limits_names_its_key(
    client: Client, path: str, value: Any, words: str
) -> None:
    """Files, programs, and sizes that take memory or time are refused with a sentence."""
    found = client.ask("loop", do="run", setup=changed("tables", TABLES, {path: value}))
    assert words in " ".join(found["error"][0]["text"])


def test_a_message_that_is_too_large_is_refused(url: str) -> None:
    """The connection ends, and another one is served."""
    from websockets.exceptions import ConnectionClosed

    page = Client(url)
    with pytest.raises(ConnectionClosed):
        page.ask("loop", do="toml", setup=TABLES, more="x" * (messages.MOST_BYTES + 1))
    page = Client(url)
    assert "texts" in page.ask("texts", do="toml", setup=TABLES)
    page.close()


def test_the_newest_of_many_messages_is_answered(client: Client) -> None:
    """A burst is not worked off one by one."""
    client.ask("loop", do="run", setup=TABLES)
    for omega_o in range(40, 140):
        last = client.send(do="run", setup=with_values(observer__omega_o=float(omega_o)))
    answered = []
    while not answered or answered[-1] != last:
        header = client.next()[0]
        if header["kind"] == "loop":
            answered.append(header["id"])
    assert len(answered) < 90


def test_toml_and_python_are_the_same_setup(client: Client, tmp_path: Path) -> None:
    """Both build what the page runs; a file that is opened is what was saved."""
    header = client.ask("texts", do="toml", setup=TABLES)["texts"][0]
    path = tmp_path / "setup.toml"
    path.write_text(header["toml"], encoding="utf-8")
    assert json.loads(json.dumps(load(path).tables())) == TABLES
    assert header["toml"] == toml_of(TABLES)
    assert header["python"] == python_of(TABLES, "A loop", True, 0.0)
    compile(header["python"], "setup.py", "exec")
    opened = client.ask("opened", do="open", text=header["toml"])["opened"][0]
    assert opened["setup"] == TABLES


def test_the_script_analyses_what_the_page_does(tmp_path: Path) -> None:
    """The linear part behind friction and late samples, or a plant about its operating point."""
    path = tmp_path / "plants.py"
    path.write_text(
        "import math\nimport quell as ql\ndef swing():\n"
        "    return ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], 50.0*u - math.sin(x[0])), 2)\n"
    )
    observer = {"kind": "model-free", "order": 4, "b0": 5.5e4, "omega_o": 90.0}
    changes: tuple[dict[str, Any], ...] = (
        {"plant": {"kind": "torsional", "late": 3}, "observer": observer},
        {"plant": {"kind": "python", "source": f"{path}:swing"}},
    )
    for each in changes:
        tables = TABLES | each
        granted, make = messages.Granted(messages.files_of(tables), trust=True), Maker(trust=True)
        message = {"id": 1, "do": "toml", "setup": tables}
        how = PageRecord(), lambda: False, lambda part, share: None
        (answer,) = frames_for(message, make, granted, *how)
        script, setup = parsed_frame(answer)[0]["python"], make(tables)
        (line,) = (line for line in script.splitlines() if "analyse(" in line)
        found = eval(line.removeprefix("print(").removesuffix(")"), {"ql": ql, "setup": setup})
        assert found == loop_of(setup).summary()


@pytest.mark.trial
def test_exported_c_is_that_of_the_command_line(client: Client, tmp_path: Path) -> None:
    """Each file in the archive has the bytes of ``quell export``."""
    from quell.cli.run import export

    path = tmp_path / "setup.toml"
    path.write_text(toml_of(TABLES), encoding="utf-8")
    export(path, out=tmp_path / "c")
    header, _, content = client.ask("file", do="export", to="c", setup=TABLES)["file"]
    assert header["name"] == "controller.zip"
    with zipfile.ZipFile(BytesIO(content)) as archive:
        found = {name: archive.read(name) for name in archive.namelist()}
    wanted = [each for each in sorted((tmp_path / "c").rglob("*")) if each.is_file()]
    expected = {
        f"controller/{each.relative_to(tmp_path / 'c').as_posix()}": each.read_bytes()
        for each in wanted
    }
    assert found == expected


def test_a_band_contains_the_run_of_the_nominal_plant(client: Client) -> None:
    """It is the range over plants around it."""
    tables = with_values(scenario__duration=0.6)
    run = client.ask("loop", do="run", setup=tables, columns=100)["run"][1]
    header, band, _ = client.ask("band", do="band", setup=tables, columns=100, percent=20)["band"]
    assert header["diverged"] == 0
    inside = (band["y_low"] <= run["y"] + 2e-2) & (run["y"] <= band["y_high"] + 2e-2)
    assert np.all(inside)
    assert np.max(band["y_high"] - band["y_low"]) > 0.01


def test_a_band_changes_parameters_and_no_whole_numbers() -> None:
    """The parameters of a Python function, but not its order."""
    plant = {"kind": "python", "source": "a.py:f", "order": 2, "parameters": {"m": 1.0, "l": 2}}
    other = varied(plant, 20.0, None, np.random.default_rng(0))
    assert {key: other[key] for key in ("kind", "source", "order")} == {
        key: plant[key] for key in ("kind", "source", "order")
    }
    assert other["parameters"]["m"] != 1.0
    assert other["parameters"]["l"] == pytest.approx(2.0, rel=0.2)


def test_columns_keep_the_extrema_of_each_pixel() -> None:
    """A single sample that stands out is not lost."""
    values = np.zeros(10_000)
    values[7654], values[1234] = 3.0, -2.0
    cut = Columns(values.size, 100)
    points, t = cut.points(values), cut.times(np.arange(10_000.0))
    assert points.size == t.size == 200
    assert np.max(points) == 3.0
    assert np.min(points) == -2.0
    assert abs(t[np.argmax(points)] - 7654) <= 100
    assert np.all(np.diff(t) > 0)
    assert np.array_equal(Columns(50, 100).points(values[:50]), values[:50])


def test_a_frame_has_header_arrays_and_null_for_infinity() -> None:
    """The arrays begin at a multiple of four bytes."""
    header, arrays, rest = parsed_frame(
        frame({"kind": "run", "m": float("inf")}, {"y": [1.0, 2.5]})
    )
    assert header["m"] is None
    assert np.array_equal(arrays["y"], [1.0, 2.5])
    assert rest == b""


def test_presets_and_tours_are_setups_that_can_be_built() -> None:
    """Each step of each tour, too; there are six tours."""
    presets = json.loads((PAGE / "presets.json").read_text(encoding="utf-8"))
    tours = json.loads((PAGE / "tours.json").read_text(encoding="utf-8"))
    assert len(tours) == 6
    for preset in presets:
        Maker(preset["name"])(messages.checked(preset["setup"]))
    for tour in tours:
        tables = presets[tour["preset"]]["setup"]
        for step in tour["steps"]:
            tables = changed(tour["title"], tables, step["changes"])
            made(tour["title"], messages.checked(tables))


def test_the_page_loads_nothing_from_elsewhere() -> None:
    """Its files name no other host, and the licence of uPlot is beside it."""
    assert "MIT" in (PAGE / "vendor" / "LICENSE-uPlot").read_text(encoding="utf-8")
    texts = [path for path in PAGE.rglob("*.*") if path.suffix in (".js", ".html", ".css")]
    own = [path for path in texts if path.parent.name != "vendor"]
    assert len(own) > 15
    for path in own:
        text = path.read_text(encoding="utf-8")
        assert "https://" not in text, path
        assert text.count("http://") == 0, path


def test_a_page_may_name_only_the_files_of_the_command_line(tmp_path: Path) -> None:
    """The plant of the setup that it began with, with other parameters."""
    path = tmp_path / "plants.py"
    path.write_text("import quell as ql\ndef motor(gain=1.0):\n    return ([gain], [1.0, 1.0])\n")
    plant = {"kind": "python", "source": f"{path}:motor", "parameters": {"gain": 2.0}}
    tables = TABLES | {"plant": plant}
    granted = messages.Granted(messages.files_of(tables), trust=True)
    assert messages.checked(tables, granted) == tables
    other = TABLES | {"plant": plant | {"parameters": {"gain": 3.0}}}
    assert messages.checked(other, granted) == other
    with pytest.raises(ValueError, match="opens no files"):
        messages.checked(TABLES | {"plant": plant | {"source": "other.py:motor"}}, granted)
    with pytest.raises(ValueError, match="opens no files"):
        messages.checked(other)


@pytest.mark.trial
def test_tuning_uses_the_noise_of_y_and_keeps_the_feedforward(client: Client) -> None:
    """The noise may use 2 % of the range of u; the controller of the form feeds its model forward."""
    tables = TABLES | {"controller": TABLES["controller"] | {"feedforward": "model"}}
    task = {"do": "tune", "structure": "bandwidths", "resolution": 1e-3, "setup": tables}
    tuned = client.ask("tuned", **task)["tuned"][0]
    assert tuned["noise_bound"].startswith("std(u): 2 % of half the range of u, 10")
    assert tuned["step"].startswith("Step of the reference by 1 at ")
    found = tuned["setup"]["controller"]["feedforward"]
    assert found["coefficients"] == pytest.approx([0.0, 4.0 / 50.0, 1.0 / 50.0])
    without = client.ask("tuned", **task | {"structure": "pid"})["tuned"][0]
    assert "feedforward" not in without["setup"]["controller"]


@pytest.mark.trial
def test_tuning_sends_the_runs_of_before_and_after(client: Client) -> None:
    """Run and loop of the setup as it was, and of the tuned one; the tuned one is not applied."""
    number = client.send(do="tune", structure="pi", setup=TABLES)
    frames: list[dict[str, Any]] = []
    while not frames or frames[-1]["kind"] not in ("done", "error"):
        frames += [header for header in (client.next()[0],) if header.get("id") == number]
    parts = [(each["pin"], each["kind"]) for each in frames if "pin" in each]
    assert parts == [
        ("before tuning", "run"),
        ("before tuning", "loop"),
        ("tuned", "run"),
        ("tuned", "loop"),
    ]
    tuned = next(each for each in frames if each["kind"] == "tuned")
    assert "--" not in tuned["noise_bound"]
    loops = [each["loop"]["m_s"] for each in frames if each["kind"] == "loop"]
    assert loops[1] == pytest.approx(1.6, rel=2e-3)  # the default bound, which is active
    kinds = [each["kind"] for each in frames]
    (verdict,) = (each["worse"] for each in frames if each["kind"] == "verdict")
    assert kinds.index("verdict") > max(i for i, kind in enumerate(kinds) if kind == "loop")
    texts = {each["key"]: each["text"] for each in verdict}
    assert all("→" in text for text in texts.values())
    margins = [each["loop"]["delay_margin"] for each in frames if each["kind"] == "loop"]
    assert ("loop.delay_margin" in texts) == (margins[1] < 0.9 * margins[0])
    of_u = [each["metrics"][0]["control_variation"] for each in frames if each["kind"] == "run"]
    assert ("run.0.control_variation" in texts) == (of_u[1] > 1.1 * of_u[0])


def test_an_identified_model_is_opened_with_its_file(client: Client, tmp_path: Path) -> None:
    """Its numbers stand in place of the path, also inside of a delay; friction keeps its width."""
    model = {"num": [50.0], "den": [1.0, 3.0, 0.0], "delay": 0.01, "friction": 0.1}
    table = {"kind": "identified", "path": "results\\model.json"}
    text = toml_of(TABLES | {"plant": {"kind": "encoded", "counts": 4096, "plant": table}})
    (reason,) = client.ask("opened", do="open", text=text)["error"][0]["text"]
    assert "open the setup and model.json together" in reason
    full = model | {"friction_width": 0.05}
    for content in (model, full):
        files = {"model.json": json.dumps({"model": content})}
        opened = client.ask("opened", do="open", text=text, models=files)["opened"][0]["setup"]
        width = {"friction_width"} <= content.keys()
        wanted = full if width else {key: model[key] for key in ("num", "den", "delay")}
        assert opened["plant"]["plant"] == {"kind": "identified"} | wanted
        assert "run" in client.ask("loop", do="run", setup=opened)
    for wrong, words in (
        ({"model.json": "{}"}, "has no model"),
        ({"model.json": "[1"}, "must be a file of results in JSON"),
        ({"model.json": 3}, "models: must be texts"),
        (["model.json"], "models: must be texts"),
    ):
        (reason,) = client.ask("opened", do="open", text=text, models=wrong)["error"][0]["text"]
        assert words in reason
    path = tmp_path / "model.json"
    path.write_text(json.dumps(full))
    read = messages.with_models({"plant": {"kind": "identified", "path": str(path)}})
    assert read["plant"] == {"kind": "identified"} | full
    with pytest.raises(ValueError, match="can't be read"):
        messages.with_models({"plant": {"kind": "identified", "path": str(path) + "x"}})


@pytest.mark.trial
def test_of_several_axes_one_is_shown_with_all_actuators(client: Client) -> None:
    """Its curves are those of ``simulate``, its margins those of its channel; tuning says NOT."""
    setup = made("two", AXES)
    run = ql.simulate(setup.plant, setup.controller, setup.scenario)
    loop = analyse(setup.plant, setup.controller)
    for i, name in enumerate(setup.controller.names):
        found = client.ask("loop", do="run", setup=AXES, axis=i)
        header, arrays, _ = found["run"]
        assert header["axes"] == ["left", "right"]
        assert "u" not in arrays
        cut = Columns(len(run), 600)
        np.testing.assert_allclose(arrays["y"], cut.points(run["y"][:, i]), rtol=1e-6)
        np.testing.assert_allclose(arrays["u_2"], cut.points(run["u"][:, 1]), rtol=1e-6)
        numbers = found["loop"][0]["loop"]
        assert numbers["m_s"] == pytest.approx(1.0 / loop.channel_margins(name).modulus)
        assert numbers["gains_at_once"] == pytest.approx(list(loop.disk_margin("inputs").gain))
        S = found["loop"][1]["S"]
        assert 20.0 * np.log10(numbers["m_s"]) == pytest.approx(S.max(), abs=0.05)
    for task, last in (("tune", "done"), ("compare", "done"), ("band", "band")):
        (reason,) = client.ask(last, do=task, setup=AXES)["error"][0]["text"]
        assert reason.startswith("NOT for several axes: ")
    (reason,) = client.ask("loop", do="run", setup=AXES, axis=2)["error"][0]["text"]
    assert reason == "axis = 2: must be a whole number from 0 to 1"


@pytest.mark.trial
def test_texts_and_c_of_several_axes_are_those_of_the_setup(client: Client) -> None:
    """The TOML opens again as it was, the script runs, and the archive has the C files."""
    texts = client.ask("texts", do="toml", setup=AXES)["texts"][0]
    assert client.ask("opened", do="open", text=texts["toml"])["opened"][0]["setup"] == AXES
    names: dict[str, Any] = {}
    exec(compile(texts["python"].replace("plt.show()", ""), "script", "exec"), names)
    assert names["run"].axis_names == ("left", "right")
    content = client.ask("file", do="export", to="c", setup=AXES)["file"][2]
    with zipfile.ZipFile(BytesIO(content)) as archive:
        assert "controller/src/controller.c" in archive.namelist()
