"""The device's side in C: it is compiled, and connected to the loop's by a pseudoterminal."""

import os
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest

from quell.realtime.transports import SerialDevice

pytest.importorskip("serial")
COMPILER = shutil.which("cc")
SOURCE = Path(__file__).parents[1] / "examples" / "serial_device.c"
DT = 1e-3
IDLE, WAITING, LIVE, TRIPPED = range(4)


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """It compiles as C11, with all warnings as errors."""
    if COMPILER is None or not SOURCE.exists():
        pytest.skip("there is no C compiler here, or no examples")
    path = tmp_path_factory.mktemp("c") / "device"
    flags = ["-std=c11", "-D_GNU_SOURCE", "-O1", "-Wall", "-Wextra", "-Werror", "-DQUELL_HOST"]
    done = subprocess.run(
        [COMPILER, *flags, "-o", path, SOURCE, "-lm"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return path


class Board:
    """The program, which simulates y' = u; its ticks come when they are asked for."""

    def __init__(self, program):
        self.process = subprocess.Popen(
            [program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.url = self.process.stdout.readline().strip()

    def step(self, what):
        """Do it (t: tick, c: wait for a packet) and return mode, y and u."""
        self.process.stdin.write(what)
        self.process.stdin.flush()
        mode, y, u = self.process.stdout.readline().split()
        return int(mode), float(y), float(u)

    def opened(self, dt=DT):
        """A session of the loop with it."""
        with ThreadPoolExecutor(1) as pool:
            heard = pool.submit(self.step, "c")
            try:
                device = SerialDevice(self.url, dt, timeout=30.0)
            finally:
                heard.result()
        with suppress(
            ConnectionError
        ):  # nothing ticks yet: but what a first call compiles is there then
            device.tick(timeout=1e-3)
        return device

    def close(self):
        """End it."""
        self.process.stdin.close()
        self.process.stdout.close()
        assert self.process.wait() == 0


@pytest.fixture
def board(program):
    """A board for a test."""
    board = Board(program)
    yield board
    board.close()


def test_a_board_in_c_keeps_step_with_the_loop(board):
    """Y as sent; u acts a sample late and within the board's limit; goodbye ends the session."""
    y, u = 0.0, 0.0
    with board.opened() as device:
        for k in range(200):
            mode, state, applied = board.step("t")
            assert mode == (LIVE if k else WAITING)
            assert device.read() == y
            y += DT * u
            assert (state, applied) == (pytest.approx(y, abs=1e-15), u)
            wish = float(k % 7 - 3) * 4.0
            u = min(max(wish, -10.0), 10.0)
            device.write(wish)
            board.step("c")
        assert device.counters["accepted"] == 200
        assert sum(device.counters.values()) == 200
    assert board.step("c")[0] == IDLE
    assert board.step("t")[2] == 0.0


def test_its_watchdog_zeroes_u_for_good(board):
    """After twenty ticks without a command; the loop is told; a new session begins from there."""
    with board.opened() as device:
        board.step("t")
        device.read()
        device.write(3.0)
        board.step("c")
        modes = [board.step("t") for _ in range(21)]
        assert [mode for mode, _, _ in modes] == [LIVE] * 20 + [TRIPPED]
        assert modes[-1][2] == 0.0
        device.read()
        with pytest.raises(ConnectionError, match="watchdog has set u to zero"):
            device.write(3.0)
        board.step("c")
        assert board.step("t")[0] == TRIPPED
    board.step("c")
    with board.opened() as device:
        assert board.step("t")[0] == WAITING
        board_y = device.read()
        assert board_y == pytest.approx(0.06)
    board.step("c")


def test_it_refuses_another_sample_time(board):
    """In the words that any device's refusal has."""
    with pytest.raises(ValueError, match="dt = 0.002 s: the device at .* ticks every 0.001 s"):
        board.opened(dt=2e-3)


def test_it_is_not_moved_by_garbage(board, rng):
    """Any bytes between the loop's commands: u is what was commanded last."""
    with board.opened() as device:
        u = 0.0
        for _ in range(100):
            assert board.step("t")[2] == u
            device.read()
            noise = rng.integers(0, 256, size=rng.integers(1, 150), dtype="u1").tobytes() + b"\0"
            os.write(device.handle.transport.port.fd, noise)
            u = float(rng.uniform(-10.0, 10.0))
            device.write(u)
            for packet in noise.split(b"\0"):
                if packet:
                    board.step("c")
            board.step("c")
    board.step("c")
