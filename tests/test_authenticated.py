"""Frames with a tag: what is taken, what is refused, and keys in files."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql
from quell.kernels.dispatch import as_python
from quell.realtime import wire
from quell.realtime.authenticated import authenticated, read_key, siphash
from quell.realtime.rig import Rig
from quell.realtime.transports import UdpDevice, UdpListener, key_of
from quell.types import DesignWarning

KEY = np.array([0x0706050403020100, 0x0F0E0D0C0B0A0908], dtype=np.uint64)
S1, S2 = 0x5EED0001, 0x5EED0002


class Line(NamedTuple):
    """One end of a line in memory."""

    there: list[bytes]  # packets that were sent
    here: list[bytes]  # packets to receive


@wire.receive.register(Line)
def _receive(line: Line, frame: wire.Buffer) -> int:
    if not line.here:
        return -1
    packet = line.here.pop(0)[: frame.bytes.size]
    frame.bytes[: len(packet)] = np.frombuffer(packet, dtype=np.uint8)
    return len(packet)


@wire.send.register(Line)
def _send(line: Line, frame: wire.Buffer) -> int:
    line.there.append(frame.bytes[: frame.length[0]].tobytes())
    return 0


def ends(key: Any = KEY) -> tuple[Any, Any, list[bytes], list[bytes]]:
    """Return the loop's end, the device's, and the packets to the device and to the loop."""
    to_device: list[bytes] = []
    to_loop: list[bytes] = []
    loop = authenticated(Line(to_device, to_loop), KEY, is_device=False)
    return loop, authenticated(Line(to_loop, to_device), key, is_device=True), to_device, to_loop


def packet(kind: int, session: int, number: int = 0, value: float = 0.5) -> wire.Buffer:
    """Return a frame to send."""
    out = wire.buffer()
    wire.write_frame(out, kind, session, number, 0, 0, value, 0)
    return out


def taken(end: Any) -> int:
    """Return the length of the next frame that an end takes, in a buffer of its own."""
    with np.errstate(all="ignore"), as_python():
        return int(wire.receive(end, wire.buffer()))


def sent(end: Any, frame: wire.Buffer) -> None:
    """Send a frame."""
    with np.errstate(all="ignore"), as_python():
        assert wire.send(end, frame) == 0


def opened(session: int = S1) -> tuple[Any, Any, list[bytes], list[bytes]]:
    """Return both ends after the handshake of a session."""
    loop, device, to_device, to_loop = ends()
    sent(loop, packet(wire.HELLO, session))
    assert taken(device) == -1  # it answers with a challenge
    assert taken(loop) == -1
    sent(loop, packet(wire.HELLO, session))
    assert taken(device) == wire.LENGTH
    return loop, device, to_device, to_loop


def test_tags_are_those_of_siphash_by_its_authors() -> None:
    """Two vectors of the reference implementation: 8 and 16 bytes, 0, 1, 2 and so on."""
    words = np.frombuffer(bytes(range(16)), dtype="<u4").astype(np.uint32)
    with np.errstate(all="ignore"):
        found = [int(siphash(KEY, words, size, np.zeros(4, dtype=np.uint64))) for size in (8, 16)]
    assert found == [0x93F5F5799A932462, 0x3F2ACC7F57C29BDB]


def test_after_the_handshake_frames_pass_both_ways() -> None:
    """A command and a measurement with the nonce of the session are taken, with 8 bytes of tag."""
    loop, device, to_device, _ = opened()
    command = packet(wire.COMMAND, S1, 1)
    sent(loop, command)
    assert len(to_device[0]) == wire.LENGTH + 8
    assert command.length[0] == wire.LENGTH
    assert taken(device) == wire.LENGTH
    sent(device, packet(wire.MEASUREMENT, S1, 1))
    assert taken(loop) == wire.LENGTH


def test_who_does_not_know_the_key_is_not_heard() -> None:
    """Another key opens no session; a plain frame and one with any bit changed are refused."""
    loop, stranger, _, _ = ends(KEY + np.uint64(1))
    sent(loop, packet(wire.HELLO, S1))
    assert taken(stranger) == 0
    loop, device, to_device, _ = opened()
    sent(loop, packet(wire.COMMAND, S1, 1))
    good = to_device.pop()
    to_device.append(good[: wire.LENGTH])
    assert taken(device) == 0
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        to_device.append(bytes(bad))
        assert taken(device) == 0
    to_device.append(good)
    assert taken(device) == wire.LENGTH
    assert device.counts[2] == 1 + 8 * len(good)


def test_a_recorded_session_can_not_be_played_again() -> None:
    """A device that was started anew draws another nonce: hellos are challenged, commands refused."""
    loop, device, to_device, _ = ends()
    recorded = []
    for kind in (wire.HELLO, wire.HELLO, wire.COMMAND):
        sent(loop, packet(kind, S1, int(kind == wire.COMMAND)))
        recorded.append(to_device[-1])
        taken(device)
        taken(loop)
    _, anew, to_anew, _ = ends()
    for each in recorded:
        to_anew.append(each)
        assert taken(anew) <= 0
    # Nor in the same one, when eight other sessions have been asked for since: their nonces went.
    for i in range(12):
        sent(loop, packet(wire.HELLO, S2 + i))
        taken(device)
    assert S1 in device.sessions  # its frames were the last that were taken: it stays
    to_device.clear()


def test_a_challenge_counts_only_for_a_session_that_was_asked_for() -> None:
    """One of another session, or a second one, changes nothing."""
    loop, device, _, to_loop = opened()
    nonce = loop.nonces.copy()
    other, _, to_other, _ = ends()
    sent(other, packet(wire.HELLO, S2))
    device.inner.here.append(to_other[0])
    assert taken(device) == -1
    assert len(to_loop) == 1
    assert taken(loop) == -1
    assert np.array_equal(loop.nonces, nonce)
    assert S2 not in loop.sessions


def test_a_key_file_is_ones_own_and_has_32_digits(tmp_path: Path) -> None:
    """Mode 600, hexadecimal; what is wrong is named with what to do."""
    file = tmp_path / "rig.key"
    file.write_text("000102030405060708090a0b0c0d0e0f\n")
    file.chmod(0o644)
    with pytest.raises(ValueError, match=r"others may use the file \(mode 644\).*chmod 600"):
        read_key(file)
    file.chmod(0o600)
    assert np.array_equal(read_key(file), KEY)
    file.write_text("too short")
    with pytest.raises(ValueError, match="32 hexadecimal digits.*openssl rand -hex 16"):
        read_key(file)
    with pytest.raises(ValueError, match="can't be read"):
        read_key(tmp_path / "none")
    with pytest.raises(ValueError, match="has baud; udp://HOST:PORT takes key"):
        key_of("udp://127.0.0.1:5?baud=3")


def test_a_port_that_others_reach_asks_for_a_key(tmp_path: Path) -> None:
    """A warning unless there is a key or ``?key=none``; on this computer there is none."""
    with pytest.warns(DesignWarning, match="who can send to this port can drive the machine"):
        UdpListener("udp://0.0.0.0:0").close()
    UdpListener("udp://0.0.0.0:0?key=none").close()
    UdpListener("udp://127.0.0.1:0").close()
    file = tmp_path / "rig.key"
    file.write_text("0" * 32)
    file.chmod(0o600)
    here = UdpListener(f"udp://0.0.0.0:0?key={file}")
    assert here.url.endswith(f"?key={file}")
    here.close()


@pytest.mark.trial
@pytest.mark.compiled
def test_a_loop_with_the_key_runs_and_one_without_finds_no_device(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over UDP, compiled: y comes and u acts with the key; without, and with another, nothing."""
    for name, digits in (("rig.key", "0f"), ("other.key", "f0")):
        (tmp_path / name).write_text(digits * 16)
        (tmp_path / name).chmod(0o600)
    plant = ql.plants.LinearPlant.of(([1.0], [1.0, 1.0]))
    listener = UdpListener(f"udp://127.0.0.1:0?key={tmp_path / 'rig.key'}")
    rig = Rig(plant, 0.005, listener, u_max=5.0, watchdog=50)
    thread = threading.Thread(target=rig.run, daemon=True)
    thread.start()
    try:
        while rig.counters["ticks"] == 0:  # until it is compiled
            assert thread.is_alive()
            time.sleep(0.1)
        plain = listener.url.split("?")[0]
        for url in (plain, f"{plain}?key={tmp_path / 'other.key'}"):
            with pytest.raises(ConnectionError, match="no device answers"):
                UdpDevice(url, 0.005, timeout=0.3)
        with UdpDevice(listener.url, 0.005, timeout=5.0) as device:
            y = 0.0
            for _ in range(100):
                y = device.read()
                device.write(2.0)
        assert y > 0.1
    finally:
        rig.stop()
        thread.join(5.0)
        rig.close()
