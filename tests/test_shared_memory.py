"""Shared memory: torn frames, files that are truncated, and files that others have planted."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quell.realtime.devices.registry import listen
from quell.realtime.wire import frames, mailbox, shared_memory
from quell.realtime.wire.mailbox import Mailbox, RefusedMailboxError
from quell.realtime.wire.shared_memory import HISTORY, SIZE, SLOT, SharedMemoryTransport
from quell.realtime.wire.transport import receive, send

from .rig_bench import Bench, connect, law, url_of

FOLDER = Path("/dev/shm")


class Ends:
    """The device's end and the loop's end of a wire; frames carry their number as the value."""

    def __init__(self) -> None:
        self.url = url_of("shm")
        self.listener = listen(self.url)
        self.device: SharedMemoryTransport = self.listener.transport
        there = object.__new__(shared_memory.SharedMemoryDevice)
        there.url = self.url
        self.loop = there._connect()
        self._there = there
        self.latest = 0

    def send(self, count: int = 1) -> None:
        """Send the next measurements."""
        for _ in range(count):
            self.latest += 1
            out = frames.buffer()
            number = self.latest
            frames.write_frame(out, frames.MEASUREMENT, number, number, number, number, number, 0)
            assert send(self.device, out) == 0

    def received(self) -> list[int]:
        """Return the numbers of all frames that wait; none may be put together of two."""
        frame, found = frames.buffer(), []
        while receive(self.loop, frame) >= 0:
            parts = {int(frame.words[1]), int(frame.words[2]), int(frame.words[3])}
            parts |= {int(frame.longs[2]), int(frame.doubles[3])}
            assert len(parts) == 1, f"the frame is put together of {sorted(parts)}"
            found += parts
        return found

    def close(self) -> None:
        """Remove the files."""
        for box in self._there._boxes:
            box.close()
        self.listener.close()


@pytest.fixture
def ends() -> Iterator[Ends]:
    """A new wire."""
    wire = Ends()
    yield wire
    wire.close()


def by_words(access: Any, between: Callable[[], None]) -> Any:
    """Return ``access`` to a file in steps of 8 bytes, with something done after each step."""

    def stepwise(file: int, address: int, size: int, offset: int) -> int:
        done = 0
        for at in range(0, size, 8):
            done += access(file, address + at, 8, offset + at)
            between()
        return done

    return stepwise


def test_a_frame_that_is_being_written_is_not_read(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reader looks after each word that the writer writes: it gets each frame once, whole."""
    found: list[int] = []
    looks = by_words(shared_memory._pwrite, lambda: found.extend(ends.received()))
    monkeypatch.setattr(shared_memory, "_pwrite", looks)
    ends.send(3 * HISTORY)
    assert found == [*range(1, 3 * HISTORY + 1)]


@pytest.mark.parametrize("more", [1, 2, HISTORY - 1, HISTORY, HISTORY + 1])
@pytest.mark.parametrize("waiting", [1, 2, 5])
def test_a_frame_that_is_replaced_while_it_is_read_is_read_again(
    ends: Ends, monkeypatch: pytest.MonkeyPatch, waiting: int, more: int
) -> None:
    """Whenever the writer interrupts the reader, and whatever it does: no frame is torn."""
    plain, step, at = shared_memory._pread, 0, 0

    def interrupt() -> None:
        nonlocal step
        step += 1
        if step == at:
            ends.send(more)

    while at < 40:
        ends.send(waiting)
        before, step, at = ends.latest, 0, at + 1
        monkeypatch.setattr(shared_memory, "_pread", by_words(plain, interrupt))
        found = ends.received()
        monkeypatch.setattr(shared_memory, "_pread", plain)
        found += ends.received()
        assert found == sorted(set(found))
        assert found[-1] == ends.latest
        if more < HISTORY - 6:
            assert found == [*range(before - waiting + 1, ends.latest + 1)]


@pytest.mark.parametrize("waiting", [HISTORY - 2, HISTORY - 1])
def test_the_oldest_frame_is_not_read_while_the_writer_replaces_it(
    ends: Ends, monkeypatch: pytest.MonkeyPatch, waiting: int
) -> None:
    """A reader that looks for the first time when the writer has come round to its next frame."""
    plain, step, at, found = shared_memory._pwrite, 0, 0, list[int]()

    def look() -> None:
        nonlocal step
        step += 1
        if step == at:
            found.extend(ends.received())

    while at < 14:
        ends.send(waiting)
        step, at = 0, at + 1
        monkeypatch.setattr(shared_memory, "_pwrite", by_words(plain, look))
        ends.send()
        monkeypatch.setattr(shared_memory, "_pwrite", plain)
        found.extend(ends.received())
        assert found == sorted(set(found))
        assert found[-1] == ends.latest


def test_a_reader_does_not_wait_for_a_writer_that_died_while_it_wrote(ends: Ends) -> None:
    """The counter stays odd; the next writer is understood again."""
    ends.send()
    assert ends.received() == [1]
    os.pwrite(ends.device.own, (3).to_bytes(8, "little"), SLOT)
    assert ends.received() == []
    again = ends.device.counts
    again[3] = 3  # what a new rig finds in the file
    ends.latest = 1
    ends.send(2)
    assert ends.received() == [2, 3]


def test_a_late_reader_misses_no_measurement(ends: Ends) -> None:
    """It reads them in order; of more than the mailbox keeps it reads the newest one."""
    ends.send(HISTORY - 1)
    assert ends.received() == [*range(1, HISTORY)]
    ends.send(HISTORY + 9)
    assert ends.received() == [ends.latest]


def test_a_mailbox_of_two_slots_is_enough(ends: Ends) -> None:
    """A device in another language may write the newest measurement only."""
    ends.send(7)
    os.truncate(ends.device.own, 2 * SLOT)
    assert ends.received() == [7]
    ends.send(7)
    os.truncate(ends.device.own, 2 * SLOT)
    os.truncate(ends.device.own, SIZE)
    assert ends.received() == [14]


@pytest.mark.parametrize("size", [0, 5, SLOT + 3, SLOT + 20, 2 * SLOT - 1])
def test_a_truncated_mailbox_counts_as_empty(ends: Ends, size: int) -> None:
    """Mapped memory would end the process; here frames arrive again as soon as there are new."""
    ends.send()
    assert ends.received() == [1]
    ends.send()
    os.truncate(ends.device.own, size)
    assert ends.received() == []
    ends.send()
    assert ends.received()[-1] == 3


@pytest.mark.compiled
def test_a_session_goes_on_after_its_files_were_truncated(bench: Callable[..., Bench]) -> None:
    """Both files lose their contents in compiled code of both sides; nothing dies."""
    here = bench("shm")
    device = here.open()
    here.cycle(device, law, 3)
    for path in FOLDER.glob(f"quell-{here.url.removeprefix('shm://')}-*"):
        os.truncate(path, 0)
    here.cycle(device, law, 3)
    assert here.rig.state == "live"
    assert device.counters["malformed"] == 0
    os.truncate(device.handle.transport.others, 30)
    assert np.isnan(device.read())


def test_a_closed_transport_touches_no_other_file(ends: Ends, tmp_path: Path) -> None:
    """The descriptor may belong to another file by now."""
    ends.close()
    taken = os.open(tmp_path / "data", os.O_RDWR | os.O_CREAT)
    assert taken in (ends.device.own, ends.device.others, ends.loop.own, ends.loop.others)
    frame = frames.buffer()
    for end in (ends.device, ends.loop):
        assert send(end, frame) != 0
        assert receive(end, frame) == -1
    assert os.fstat(taken).st_size == 0
    os.close(taken)


def plant_link(path: Path, victim: Path) -> None:
    """Make a symbolic link."""
    path.symlink_to(victim)


def plant_writable(path: Path, victim: Path) -> None:
    """Make a file that everyone may write."""
    path.write_bytes(bytes(SIZE))
    path.chmod(0o622)


def plant_second_name(path: Path, victim: Path) -> None:
    """Make a hard link."""
    victim = path.with_name(f"{path.name}-victim")
    victim.write_bytes(b"precious")
    os.link(victim, path)


def plant_pipe(path: Path, victim: Path) -> None:
    """Make a named pipe."""
    os.mkfifo(path, 0o600)


PLANTED = {
    plant_link: "is a symbolic link",
    plant_writable: r"owned by user \d+.*mode 622|mode 622.*owned by user \d+",
    plant_second_name: "not a regular file with one name",
    plant_pipe: "not a regular file with one name",
}


@pytest.mark.parametrize("kind", ["measurements", "commands"])
@pytest.mark.parametrize("plant", PLANTED)
def test_a_planted_file_is_refused_and_not_touched(
    plant: Callable[[Path, Path], None], kind: str, tmp_path: Path
) -> None:
    """By the rig, and by the loop; the message has owner and mode."""
    name, victim = uuid.uuid4().hex, tmp_path / "victim"
    victim.write_bytes(b"precious")
    paths = [FOLDER / f"quell-{name}-{part}" for part in ("measurements", "commands")]
    planted = FOLDER / f"quell-{name}-{kind}"
    try:
        plant(planted, victim)
        before = planted.lstat()
        with pytest.raises(ValueError, match=PLANTED[plant]):
            listen(f"shm://{name}")
        for path in paths:
            if path != planted:
                path.unlink(missing_ok=True)
                path.touch(0o600)
        with pytest.raises(ConnectionError, match=PLANTED[plant]):
            connect(f"shm://{name}", 0.01, 0.1)
        assert planted.lstat()[:9] == before[:9]
        assert victim.read_bytes() == b"precious"
    finally:
        for path in FOLDER.glob(f"quell-{name}-*"):
            path.unlink()


def test_a_file_of_another_user_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The message names both users."""
    path = tmp_path / "box"
    path.touch(0o600)
    own = os.geteuid()
    monkeypatch.setattr(mailbox.os, "geteuid", lambda: own + 1)
    with pytest.raises(
        RefusedMailboxError, match=rf"owned by user {own}.*belong to user {own + 1}"
    ):
        Mailbox(path, SIZE)


def test_a_new_mailbox_is_private(tmp_path: Path) -> None:
    """Whatever the process's mask is."""
    before = os.umask(0)
    try:
        box = Mailbox(tmp_path / "box", SIZE, create=True)
    finally:
        os.umask(before)
    assert (tmp_path / "box").stat().st_mode & 0o777 == 0o600
    box.close()
