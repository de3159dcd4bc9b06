"""Rows that clients of the live port cost, how long they delay the end of a run, what they use up.

    python benchmarks/live_clients.py [seconds] [--count N] [--kinds KIND ...]

For each kind of client a process pushes rows at 1 kHz through the telemetry writer to an MCAP file,
a CSV file and the live port, while N clients of that kind, in another process, connect. Printed are
the rows that the files lack, the time that the end took, the largest number of descriptors that the
writing process had open beyond those before the clients, and its output on stderr.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from measured import options_of, parser_of, write

from quell.realtime import CsvSink, LiveSink, McapSink
from quell.realtime.recordings import Header, load, row_channels
from quell.realtime.telemetry import TelemetryWriter, push

CHANNELS = row_channels((("x_hat", 4), ("f_learned", 1), ("status", 1), ("theta", 9)))
REQUEST = (
    "GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n{more}\r\n"
)
SUBSCRIBE = json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1}]}).encode()


def frame(text: bytes) -> bytes:
    """Return a text message of less than 126 bytes as a client sends it, with a mask of zeros."""
    return bytes((0x81, 0x80 | len(text), 0, 0, 0, 0)) + text


def silent(connection: socket.socket) -> None:
    """Connect and say nothing."""


def slow_request(connection: socket.socket) -> None:
    """Begin a request and do not finish it."""
    connection.sendall(REQUEST[:40].encode())


def deaf(connection: socket.socket) -> None:
    """Subscribe and never read."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.sendall(REQUEST.format(more="").encode())
    connection.sendall(frame(SUBSCRIBE))


def idle(connection: socket.socket) -> None:
    """Finish the request, and neither subscribe nor say goodbye."""
    connection.sendall(REQUEST.format(more="").encode())
    connection.recv(65536)


def foreign_page(connection: socket.socket) -> None:
    """Send the request of a web page of another computer, as a browser does."""
    connection.sendall(REQUEST.format(more="Origin: https://example.com\r\n").encode())
    if b" 101 " in connection.recv(65536):
        print("let in")


def noise(connection: socket.socket) -> None:
    """Send random bytes."""
    connection.sendall(os.urandom(2000))


def broken_messages(connection: socket.socket) -> None:
    """Send messages that are no messages of the protocol."""
    connection.sendall(REQUEST.format(more="").encode())
    for text in (b"", b"nonsense", b"[1]", b'{"op":3}', b"[" * 120):
        connection.sendall(frame(text))
    connection.sendall(b"\xff" * 100)


KINDS: dict[str, Callable[[socket.socket], None] | None] = {
    "none": None,
    "silent": silent,
    "slow request": slow_request,
    "idle": idle,
    "deaf": deaf,
    "foreign page": foreign_page,
    "noise": noise,
    "broken messages": broken_messages,
}


def connect(kind: str, port: int, count: int, seconds: float) -> None:
    """Keep ``count`` connections of a kind open; close and open each anew all the time, too."""
    act = KINDS[kind]
    assert act is not None
    end, kept = time.monotonic() + seconds, []
    while time.monotonic() < end:
        try:
            connection = socket.create_connection(("127.0.0.1", port), timeout=0.5)
            kept.append(connection)
            act(connection)
        except OSError:
            time.sleep(0.01)
        if len(kept) >= count:
            kept.pop(0).close()
        time.sleep(0.001)
    time.sleep(60.0)  # still connected at the end of the run; then this process is ended


def run_case(kind: str, seconds: float, count: int) -> None:
    """Write rows while clients of a kind are there; print what was found as JSON."""
    rows = np.random.default_rng(1).standard_normal((round(1000 * seconds), 24))
    rows[:, 0], rows[:, 3:5] = np.arange(len(rows)), 0.0
    assert rows.shape[1] == sum(width for _, width in CHANNELS)
    most, stop = [0], threading.Event()

    def watch() -> None:
        while not stop.wait(0.02):
            most[0] = max(most[0], len(list(Path("/proc/self/fd").iterdir())))

    with tempfile.TemporaryDirectory() as folder:
        files, live = [Path(folder) / "run.mcap", Path(folder) / "run.csv"], LiveSink(0)
        sinks = [live, McapSink(files[0]), CsvSink(files[1])]
        telemetry = TelemetryWriter(Header(CHANNELS, 1e-3), sinks)
        telemetry.start()
        before = len(list(Path("/proc/self/fd").iterdir()))
        command = [sys.executable, __file__, str(seconds), "--count", str(count)]
        command += ["--connect", kind, "--port", live.url.rpartition(":")[2]]
        clients = None if kind == "none" else subprocess.Popen(command, stdout=subprocess.PIPE)
        watcher = threading.Thread(target=watch)
        watcher.start()
        began = time.perf_counter()
        for k, row in enumerate(rows):
            time.sleep(max(began + k * 1e-3 - time.perf_counter(), 0.0))
            push(telemetry.ring, row)
        ended = time.perf_counter()
        telemetry.stop()
        took = time.perf_counter() - ended
        stop.set()
        watcher.join()
        let_in = 0
        if clients is not None:
            clients.kill()
            let_in = clients.communicate()[0].count(b"let in")
        lost = [len(rows) - len(load(file)) for file in files]
    found = {"rows": len(rows), "lost": lost, "end": took, "descriptors": most[0] - before}
    print(json.dumps(found | {"let_in": let_in}))


def main() -> None:
    """Run a case for each kind and print a table."""
    parser = parser_of(__doc__)
    parser.add_argument("seconds", type=float, nargs="?", default=5.0)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=[*KINDS])
    for hidden in ("--case", "--connect", "--port"):
        parser.add_argument(hidden, help=argparse.SUPPRESS)
    given = options_of(parser, seconds=0.5, count=20, kinds=["none", "deaf", "foreign page"])
    if given.connect:
        connect(given.connect, int(given.port), given.count, given.seconds)
    elif given.case:
        run_case(given.case, given.seconds, given.count)
    else:
        heading = f"{given.count} clients that are"
        print(f"{heading:24s} rows  lost (MCAP, CSV)  end [s]  descriptors  stderr [B]  let in")
        figures: dict[str, object] = {}
        for kind in given.kinds:
            command = [sys.executable, __file__, str(given.seconds), "--count", str(given.count)]
            done = subprocess.run([*command, "--case", kind], capture_output=True, check=False)
            if done.returncode:
                print(f"{kind:20s} ended with {done.returncode}: {done.stderr[-300:]!r}")
                sys.exit(1)
            found = json.loads(done.stdout)
            print(
                f"{kind:20s} {found['rows']:8d} {found['lost'][0]:8d}, {found['lost'][1]:6d} "
                f"{found['end']:9.2f} {found['descriptors']:12d} {len(done.stderr):11d} "
                f"{found['let_in']:7d}",
                flush=True,
            )
            figures[kind] = {
                "rows": found["rows"],
                "lost, MCAP": found["lost"][0],
                "lost, CSV": found["lost"][1],
                "end [s]": found["end"],
                "descriptors": found["descriptors"],
                "stderr [B]": len(done.stderr),
                "let in": found["let_in"],
            }
        write(given, figures)


if __name__ == "__main__":
    main()
