"""Viewers of a running loop: what they get, who may watch, and that none of them can harm a run."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import websockets

from quell.realtime import LiveSink, McapSink, viewers
from quell.realtime.recordings import (
    EVENTS,
    LOOP_WIDTH,
    Header,
    K,
    load,
    log_rows,
    open_topic,
    row_channels,
)
from quell.realtime.telemetry import TelemetryWriter, push
from quell.types import Matrix

from .cases import cases

HEADER = Header(row_channels((("status", 1),)), dt=1e-3, device="a lift", started=10**18)
SUBSCRIBE = json.dumps({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": 1}]})
REQUEST = (
    "GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
)


@pytest.fixture
def live() -> Iterator[LiveSink]:
    """An open sink that lets one foreign page watch."""
    sink = LiveSink(port=0, rate=50.0, origins=["https://viewer.example"])
    sink.open(HEADER)
    yield sink
    sink.close()


def counted(count: int) -> Matrix:
    """Return rows of zeros with k."""
    rows = np.zeros((count, LOOP_WIDTH + 1))
    rows[:, K] = np.arange(count)
    return rows


async def _watch(url: str, wanted: int, begin: Any) -> tuple[list[dict[str, Any]], list[bytes]]:
    """Subscribe as a Foxglove viewer does, call ``begin``; return greetings and messages."""
    protocols: Any = ["foxglove.sdk.v1"]
    async with websockets.connect(url, subprotocols=protocols, open_timeout=60.0) as socket:
        greetings: list[dict[str, Any]] = [json.loads(await socket.recv()) for _ in range(2)]
        # foxglove-sdk counts the channels of a process.
        number = greetings[1]["channels"][0].pop("id")
        await socket.send(SUBSCRIBE.replace('"channelId": 1', f'"channelId": {number}'))
        messages: list[bytes] = []
        while len(messages) < wanted:
            begin()
            try:
                message = await asyncio.wait_for(socket.recv(), 0.2)
            except TimeoutError:
                continue
            if isinstance(message, bytes) and message[0] == 1:
                messages.append(message)
        return greetings, messages


def test_a_viewer_sees_rows_at_a_rate_it_can_follow_and_no_event_is_lost(live: LiveSink) -> None:
    """At 1 kHz and 50 rows/s: every twentieth row, with the events since the one before."""
    rows = counted(400)
    rows[:, EVENTS] = np.where(np.arange(400) % 20 == 7, 4.0, 1.0)
    sent = 0

    def send() -> None:
        nonlocal sent
        live.write(rows[sent : sent + 33])  # pieces that fit nothing
        live.flush()
        sent += 33

    assert live.url.startswith("ws://127.0.0.1:")
    _, messages = asyncio.run(asyncio.wait_for(_watch(live.url, 5, send), 60))
    seen = np.array([np.frombuffer(message[13 + 4 :], dtype="<f8") for message in messages])
    np.testing.assert_array_equal(np.diff(seen[:, K]), 20.0)
    np.testing.assert_array_equal(seen[:, EVENTS], np.where(seen[:, K] == 0, 1.0, 5.0))


def test_viewers_get_what_the_server_of_foxglove_sdk_sends(live: LiveSink) -> None:
    """The same channel, and the same bytes for a row."""
    import foxglove

    row = counted(8)[7:]
    context = foxglove.Context()
    server = foxglove.start_server(name="a lift", host="127.0.0.1", port=0, context=context)
    topic = open_topic(foxglove, HEADER, context)
    found = []
    for url, begin in (
        (f"ws://127.0.0.1:{server.port}", lambda: log_rows(topic, HEADER, row)),
        (live.url, lambda: (setattr(live, "_next", 0.0), live.write(row))),
    ):
        greetings, messages = asyncio.run(asyncio.wait_for(_watch(url, 1, begin), 60))
        names = {key: greetings[0][key] for key in ("op", "name", "capabilities")}
        found.append((names, greetings[1], messages))
    topic.close()
    server.stop()
    assert found[0] == found[1]


def answer(url: str, origins: list[str]) -> bytes:
    """Return the status line for a request with these Origin headers."""
    host, _, port = url.removeprefix("ws://").rpartition(":")
    with socket.create_connection((host, int(port)), timeout=30.0) as connection:
        lines = "".join(f"Origin: {origin}\r\n" for origin in origins)
        connection.sendall(REQUEST.replace("\r\n\r\n", f"\r\n{lines}\r\n").encode())
        return connection.recv(4096).partition(b"\r\n")[0]


def test_web_pages_of_other_computers_are_refused(live: LiveSink) -> None:
    """A browser names the page in the request; programs and pages of this computer may watch."""
    for origins in (
        [],
        ["file://"],
        ["http://localhost:8080"],
        ["https://127.0.0.1"],
        ["http://[::1]:3000"],
        ["https://viewer.example"],
    ):
        assert b" 101 " in answer(live.url, origins), origins
    for origins in (
        ["https://example.com"],
        ["null"],
        ["http://localhost.example.com"],
        ["http://127.0.0.1.example.com"],
        ["https://viewer.example:444"],
        ["https://user@example.com"],
        ["http://[::1"],
        [""],
        ["http://localhost", "https://example.com"],
    ):
        assert b" 403 " in answer(live.url, origins), origins


def test_an_origin_that_is_none_is_refused() -> None:
    """The message says what one looks like."""
    for origin in ("app.foxglove.dev", "https://", "https://a.example/path", "*"):
        with pytest.raises(ValueError, match=r"origins\[0\] = .* must be the scheme and host"):
            LiveSink(origins=[origin])
    for origins in ("https://a.example", None):
        with pytest.raises(ValueError, match="must be a list of origins"):
            LiveSink(origins=origins)  # type: ignore[arg-type]


def test_a_port_that_is_taken_is_refused_in_one_line(live: LiveSink) -> None:
    """Before the loop starts."""
    port = int(live.url.rpartition(":")[2])
    with pytest.raises(
        ValueError, match=f"port = {port}: can't listen there .* choose another port"
    ):
        LiveSink(port=port).open(HEADER)


def test_clients_cost_neither_rows_nor_time_nor_descriptors(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Silent ones, half a request, deaf viewers, noise, and many that leave at once.

    ``benchmarks/live_clients.py`` does the same with hundreds of each kind in real time.
    """
    sink, path = LiveSink(port=0), tmp_path / "run.mcap"
    telemetry = TelemetryWriter(HEADER, [sink, McapSink(path)])
    telemetry.start()
    address = ("127.0.0.1", int(sink.url.rpartition(":")[2]))
    before = len(list(Path("/proc/self/fd").iterdir()))
    clients = []
    for text in ("", REQUEST[:50], REQUEST, "\x00noise\r\n\r\n"):
        for _ in range(15):
            clients.append(socket.create_connection(address))
            clients[-1].sendall(text.encode())
    for _ in range(50):
        socket.create_connection(address).close()
    for row in counted(400):
        push(telemetry.ring, row)
    mine = len(list(Path("/proc/self/fd").iterdir())) - len(clients)
    telemetry.stop()
    for client in clients:
        client.close()
    assert telemetry.problems == []
    assert mine <= before
    assert len(load(path)) == 400
    assert sink._process is None
    assert capfd.readouterr() == ("", "")


def test_a_server_that_is_gone_is_reported_and_the_file_goes_on(tmp_path: Path) -> None:
    """The sink is closed as any other that fails."""
    sink, path = LiveSink(port=0), tmp_path / "run.mcap"
    with TelemetryWriter(HEADER, [sink, McapSink(path)]) as telemetry:
        assert sink._process is not None
        sink._process.kill()
        sink._process.wait()
        for row in counted(400):
            push(telemetry.ring, row)
    assert len(telemetry.problems) == 1
    assert telemetry.problems[0].startswith(f"{sink.url}: ")
    assert len(load(path)) == 400


def test_a_slow_viewer_loses_the_oldest_rows() -> None:
    """It does not fill the memory of the server."""
    viewer = viewers.Viewer(None)
    for row in (b"1", b"2"):
        viewer.offer(row)
    assert not viewer.waiting
    viewer.answer(SUBSCRIBE, 1)
    for number in range(1000):
        viewer.offer(b"%d" % number)
    assert len(viewer._rows) == viewers._BACKLOG
    assert viewer._rows[-1] == b"\x01\x07\x00\x00\x00999"


@cases(
    "message",
    [
        "",
        b"\xff",
        "3",
        "[]",
        "{}",
        '{"op": "subscribe"}',
        '{"op": "subscribe", "subscriptions": 3}',
        '{"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1}]}',
        '{"op": "subscribe", "subscriptions": [{"id": "1", "channelId": 1}]}',
        '{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 2}]}',
        '{"op": "unsubscribe", "subscriptionIds": {}}',
        "[" * 16_000,
    ],
)
def test_messages_that_make_no_sense_change_nothing(message: str | bytes) -> None:
    """A viewer that has subscribed stays so."""
    viewer = viewers.Viewer(None)
    viewer.answer(message, 1)
    viewer.offer(b"row")
    assert not viewer.waiting
    viewer.answer(SUBSCRIBE, 1)
    viewer.answer(message, 1)
    viewer.offer(b"row")
    assert viewer.waiting
    viewer.answer('{"op": "unsubscribe", "subscriptionIds": [7]}', 1)
    assert viewer._subscription is None
