"""The studio's server takes a record of a machine: it is identified, and tuned for."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quell.commissioning import measured
from quell.setup import made
from quell.studio.messages import parsed_frame
from quell.studio.records import MOST_FILE, MOST_SAMPLES, PageRecord, for_page, record_frames
from quell.studio.runs import StoppedError
from quell.tuning import Constraints
from quell.tuning.plants import record_model

from .studio_server import TABLES, Client, running, step_test

OPTIONS = {"order": 2, "max_delay": 0.3}


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


def asked(content: bytes, **more: Any) -> dict[str, Any]:
    """Return a message of a record as a page's connection gives it to a thread."""
    return {"id": 1, "name": "step.csv", "content": content, **more}


def nothing(part: str, share: float) -> None:
    """Take progress."""


@pytest.mark.trial
def test_a_record_is_identified_as_on_the_command_line_and_tuned_for(
    client: Client, tmp_path: Path
) -> None:
    """The report, the set of plants and a first controller; then Tune is for the whole set."""
    path = tmp_path / "step.csv"
    path.write_bytes(step_test())
    wanted = record_model(measured(path), **OPTIONS)  # type: ignore[arg-type]
    found = client.answer("done", client.send_record(step_test(), columns=100, **OPTIONS))
    header, arrays, _ = found["record"]
    assert header["lines"] == wanted.lines
    assert header["nots"] == []
    assert header["fits"] == pytest.approx(wanted.model.fits)
    assert len(header["plants"]) == len(wanted.plants[0]) > 1
    assert header["plants"][0]["gain"] == f"{wanted.model.gain:.4g}"
    assert arrays["y"].size == arrays["simulated"].size == 200
    residual = wanted.model.y - wanted.model.simulated
    assert np.max(arrays["residual"]) == np.float32(np.max(residual))
    setup = header["setup"]
    assert setup["plant"]["den"] == wanted.model.den.tolist()
    run = client.ask("loop", do="run", setup=setup)
    assert run["loop"][0]["loop"]["m_s"] < 1.65
    task = {"do": "tune", "structure": "pi", "m_s": 1.4}
    tuned = client.ask("done", **task, setup=setup, record=True)["tuned"][0]
    assert tuned["plants"] == len(header["plants"])
    for other in (TABLES, setup | {"dt": 0.2}):
        assert client.ask("done", **task, setup=other, record=True)["tuned"][0]["plants"] == 1
    assert client.ask("done", **task, setup=setup)["tuned"][0]["plants"] == 1


@pytest.mark.trial
def test_nothing_is_tuned_for_a_record_that_does_not_decide(client: Client) -> None:
    """Noise: the line with NOT is shown, there is no setup, and tuning is refused with its text."""
    random = np.random.default_rng(1)
    rows = [f"{0.1 * k:.1f},{int(k >= 200)},{random.standard_normal():.4f}" for k in range(400)]
    content = "\n".join(["t,u,y", *rows]).encode()
    number = client.send_record(content, order=1, max_delay=0.0)
    header = client.answer("done", number)["record"][0]
    assert any("does not decide the sign of the gain" in line for line in header["nots"])
    assert header["setup"] is None
    assert header["plants"] == []
    task = {"do": "tune", "structure": "pi", "setup": TABLES}
    (text,) = client.ask("done", **task, record=True)["error"][0]["text"]
    assert text.startswith("NOT: no plant to tune for: ")
    assert "does not decide the sign of the gain" in text
    assert "tuned" in client.ask("done", **task)  # the record is closed


def test_tuning_for_a_record_that_the_server_does_not_know_is_refused(url: str) -> None:
    """The page showed it before the connection was lost."""
    page = Client(url)
    found = page.ask("done", do="tune", structure="pi", setup=TABLES, record=True)
    assert "identify it again" in found["error"][0]["text"][0]
    page.close()


@pytest.mark.parametrize(
    ("content", "options", "words"),
    [
        (b"time,power,heat\n" + b"0.1,1,2\n" * 20, {}, "say which with the field Columns"),
        (b"t,u,y\n0,1,2\n1,1,2\n", {}, "'step.csv': has 2 samples"),
        (b"", {}, "step.csv"),
        (b"PK\x03\x04" + b"\0" * 99, {}, "save its sheet as CSV"),
        (step_test(), {"dt": -1.0}, "dt = -1"),
        (step_test(), {"order": "4"}, "order = '4': must be a whole number"),
        (step_test(), {"order": True}, "order = True: must be a whole number"),
        (step_test(), {"order": 9}, "order = 9"),
        (step_test(), {"rest": "yes"}, "rest = 'yes': must be true or false"),
        (step_test(), {"time_unit": "weeks"}, "time_unit = 'weeks'"),
        (step_test(), {"size": 3}, "bytes of the file have come"),
    ],
)
def test_a_file_that_cannot_be_read_is_refused_with_the_field_that_helps(
    client: Client, content: bytes, options: dict[str, Any], words: str
) -> None:
    """One sentence, with the name of the file as the page has it, and no path of the server."""
    found = client.answer("done", client.send_record(content, **options))
    text = " ".join(found["error"][0]["text"])
    assert words in text
    assert tempfile.gettempdir() not in text
    assert "--" not in text


@pytest.mark.parametrize("content", [step_test(), b"no record"])
def test_the_file_of_a_record_is_removed_whether_it_can_be_read_or_not(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It lies in a temporary folder only while it is read, whatever its name is."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def leaving(part: str, share: float) -> None:
        assert list(tmp_path.iterdir()) == []
        raise StoppedError

    message = asked(content, name="../../evil.csv", **OPTIONS)
    with pytest.raises((StoppedError, ValueError)):
        list(record_frames(PageRecord(), message, lambda: False, leaving))
    assert list(tmp_path.iterdir()) == []
    assert not (tmp_path.parent.parent / "evil.csv").exists()


@pytest.mark.trial
def test_a_page_that_leaves_or_cancels_ends_the_identification(client: Client) -> None:
    """Between the parts of the search; the next message is answered."""
    steps: list[float] = []
    record = PageRecord()
    work = record_frames(
        record, asked(step_test(), **OPTIONS), lambda: len(steps) > 3, lambda _, s: steps.append(s)
    )
    with pytest.raises(StoppedError):
        next(work)
    assert len(steps) == 4
    assert steps == sorted(steps)
    assert record.shown is None
    number = client.send_record(step_test(), **OPTIONS)
    kinds = []
    while "stopped" not in kinds:
        header = client.next()[0]
        if header["id"] == number:
            kinds.append(header["kind"])
            client.send(do="cancel")
    assert "record" not in kinds
    assert "loop" in client.ask("loop", do="run", setup=TABLES)


def test_parts_of_a_file_come_in_their_order_and_within_the_limit() -> None:
    """A part that does not fit is refused, and a new first part begins again."""
    record, data = PageRecord(), base64.b64encode(b"x" * 1000).decode()
    record.take_part({"at": 0, "data": data})
    for wrong in (
        {"at": 10, "data": data},
        {"at": "0", "data": data},
        {"data": data},
        {"at": 1000},
    ):
        with pytest.raises(ValueError, match="one after the other"):
            record.take_part(wrong)
    with pytest.raises(ValueError, match="must be base64"):
        record.take_part({"at": 1000, "data": "?"})
    record.take_part({"at": 0, "data": data})
    record.take_part({"at": 1000, "data": data})
    assert record.content(2000) == b"x" * 2000
    large = base64.b64encode(b"x" * MOST_FILE).decode()
    record.take_part({"at": 0, "data": large})
    with pytest.raises(ValueError, match="more than 8 MiB"):
        record.take_part({"at": MOST_FILE, "data": data})


def test_a_record_with_too_many_samples_is_refused_before_it_is_identified() -> None:
    """The sentence names the command that takes it."""
    table = BytesIO()
    np.savetxt(
        table,
        np.random.default_rng(0).random((MOST_SAMPLES + 1, 2)),
        fmt="%.2f",
        header="u,y",
        delimiter=",",
        comments="",
    )
    message = asked(table.getvalue(), dt=0.1)
    with pytest.raises(ValueError, match="50001 samples: .* quell tune FILE"):
        list(record_frames(PageRecord(), message, lambda: False, nothing))


def test_options_of_the_command_line_are_named_as_fields_of_the_page() -> None:
    """With their values; others stay."""
    text = "give time_unit = 'ms' (--time-unit ms), or say which with --columns (--dt, --max-size)"
    assert for_page(text) == (
        "give time_unit = 'ms' (the field Time unit: ms), or say which with the field Columns "
        "(the field Sample time, --max-size)"
    )


@pytest.mark.trial
def test_a_double_integrator_gets_a_first_controller_with_damping() -> None:
    """A PI controller cannot stabilise it: the next structure is taken."""
    random = np.random.default_rng(0)
    u = np.repeat(np.sign(random.standard_normal(40)), 10)
    y, v = np.zeros(400), 0.0
    for k in range(399):
        y[k + 1] = y[k] + 0.1 * v + 0.005 * u[k]
        v += 0.1 * u[k]
    y += 1e-3 * random.standard_normal(400)
    table = BytesIO()
    np.savetxt(table, np.column_stack([u, y]), header="u,y", delimiter=",", comments="")
    options = {"dt": 0.1, "order": 2, "integrators": 2, "max_delay": 0.0}
    frames = record_frames(PageRecord(), asked(table.getvalue(), **options), lambda: False, nothing)
    header, _, _ = parsed_frame(next(frames))
    assert header["structure"] == "pid"
    assert header["plants"][0]["gain"].endswith("of s² G")


@pytest.mark.parametrize("limits", [{"u_min": -10.0, "u_max": 10.0}, {}])
def test_the_noise_of_the_scenario_bounds_u_where_its_limits_are_known(
    limits: dict[str, float],
) -> None:
    """Power 4e-11 in samples of 0.1 ms: a standard deviation of 6.3e-4, as it runs."""
    noise = {"kind": "noise", "power": 4e-11, "sample_time": 1e-4}
    tables = {
        "dt": 1e-4,
        "plant": {"kind": "linear", "num": [1.0], "den": [1.0, 1.0]},
        "observer": {"kind": "model-free", "order": 1, "b0": 1.0, "omega_o": 50.0},
        "controller": {"kind": "adrc", "omega_c": 10.0},
        "scenario": {"duration": 0.2, "noise": noise},
    }
    setup, given = made("setup", tables), Constraints()
    found = PageRecord().with_noise(given, limits, setup, {})
    if limits:
        assert found.noise_std == pytest.approx(6.3e-4, rel=0.1)
    else:
        assert found == given
