"""Kills of the host or of the drive behind a proxy, and loops with the wrong sign of b0.

    python benchmarks/proxy_faults.py            # 200 kills and 600 loops: about ten minutes
    python benchmarks/proxy_faults.py --quick    # 8 kills, 30 loops

Kills: drive, ``quell proxy`` and host are processes, with UDP between them, and a tap on the wire
to the drive keeps the time of each command. The plants are axes of 50/(s (s + 1)) at 100 Hz with
``|u| <= 2``, one or three of them; b0 of the first one has the right or the wrong sign. At a random
instant of a motion the host or the drive is killed with SIGKILL, or the port of the drive is
closed. Bar: u is below 1 % of its limit 100 ms and the ramp later, and from then on, and the exit
code of the proxy is 3.

Loops: random plants of order 1 and 2, loads of up to 90 % of the limit of u, noise, PID controllers
as hosts; b0 wrong by up to a factor 2, and in half of the loops with the wrong sign as well. Two
questions: does the check of the sign of b0 (``quell.realtime.supervisor``) end an honest loop, and
how many of the others does it end?
"""

from __future__ import annotations

import os
import signal
import socket
import struct
import sys
import tempfile
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measured import parser_of, write

import quell as ql
from quell.kernels.dispatch import as_python
from quell.realtime import CompensatedDrive, Safety, open_device
from quell.realtime.registry import listen
from quell.realtime.rig import Rig
from quell.realtime.supervisor import initial_state, is_opposed
from quell.realtime.wire import COMMAND
from quell.setup import made, read

DT, LIMIT, OMEGA_O, GAIN = 0.01, 2.0, 30.0, 50.0
RAMP = 10 * DT  # the default of ``Safety`` at this sample time [s]
ALLOWED = 0.1 + RAMP  # from the kill on [s]
SMALL = 0.01 * LIMIT
VICTIMS = ("host", "drive", "port")


# ---- Processes ----


def setup_text(url: str, axes: int, sign: float) -> str:
    """Return the setup of the proxy."""
    text = f'dt = {DT}\n[rig]\ndevice = "{url}"\n'
    observer = f'kind = "model-free", order = 2, omega_o = {OMEGA_O}'
    if axes == 1:
        return (
            text + f"[observer]\n{_lines(observer)}\nb0 = {sign * GAIN}\n[controller]\n"
            f'kind = "compensator"\nu_min = {-LIMIT}\nu_max = {LIMIT}\n'
        )
    gains = np.diag([sign * GAIN, *[GAIN] * (axes - 1)]).tolist()
    text += f"[axes]\nB0 = {gains}\nu_min = {-LIMIT}\nu_max = {LIMIT}\n"
    for i in range(axes):
        text += f'[[axis]]\nname = "q{i}"\nobserver = {{ {observer} }}\ncompensator = {{}}\n'
    return text


def _lines(table: str) -> str:
    return table.replace(", ", "\n")


def plant_of(axes: int) -> Any:
    """Return the axes."""
    if axes == 1:
        return ql.plants.LinearPlant.of(([GAIN], [1.0, 1.0, 0.0]))
    parts = [[[0.0, 1.0], [0.0, -1.0]], [[0.0], [GAIN]], [[1.0, 0.0]]]
    blocks = (np.kron(np.eye(axes), np.array(part)).tolist() for part in parts)
    return ql.plants.LinearPlant(*blocks)


def in_child(work: Callable[[], int]) -> int:
    """Run work in a process of its own, which has what this one has compiled; return its number."""
    sys.stdout.flush()
    number = os.fork()
    if number:
        return number
    code = 1
    try:
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        if not os.environ.get("SHOW"):
            os.dup2(silence, 2)
        code = work()
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        os._exit(code)


def serve_drive(axes: int, url: str) -> int:
    """Be the drive."""
    with Rig(plant_of(axes), DT, listen(url), rest=True) as rig:
        rig.run()
    return 0


def serve_proxy(file: Path, url: str) -> int:
    """Be the proxy, as the command is."""
    from quell.cli.app import app

    app(["proxy", str(file), "--host", url, "--priority", "0"])
    return 0


def be_host(axes: int, url: str, started: Any) -> int:
    """Move all axes in sinusoids with PD controllers, until this process is killed."""
    device = open_device(url, DT, signals=None if axes == 1 else (axes, axes))
    y, k, next_time = np.zeros(axes), 0, time.monotonic()
    rest = 40
    while not device.lost:
        before, new = y, np.atleast_1d(device.read())
        y = np.where(np.isfinite(new), new, before)
        r = 0.0 if k < rest else np.sin(3.0 * DT * (k - rest))
        u_0 = np.clip(0.7 * (r - y) - 0.24 * (y - before) / DT, -LIMIT, LIMIT)
        device.write(float(u_0[0]) if axes == 1 else u_0)
        if k == rest:
            os.write(started, b"1")
        k += 1
        next_time = max(next_time + DT, time.monotonic() - 0.5 * DT)
        time.sleep(max(next_time - time.monotonic(), 0.0))
    return 0


class Tap:
    """A wire to the drive that keeps time and largest |u| of each command."""

    def __init__(self, axes: int) -> None:
        self.axes, self.commands = axes, list[tuple[float, float]]()
        self._near, self._far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in "ab")
        for each in (self._near, self._far):
            each.bind(("127.0.0.1", 0))
            each.settimeout(0.1)
        self.url = f"udp://127.0.0.1:{self._near.getsockname()[1]}"
        self._drive, self._proxy = free_port(), None
        self.drive_url = f"udp://127.0.0.1:{self._drive}"
        self._over = threading.Event()
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._to_drive, self._to_proxy)
        ]

    def start(self) -> None:
        """Begin to pass frames on."""
        for each in self._threads:
            each.start()

    def close(self) -> None:
        """Close the port that the proxy sends to."""
        self._over.set()
        for each in self._threads:
            each.join()
        self._near.close()
        self._far.close()

    def _to_drive(self) -> None:
        while not self._over.is_set():
            with suppress(OSError):
                frame, self._proxy = self._near.recvfrom(2048)
                if frame[3] == COMMAND:
                    first, *others = struct.unpack_from(f"<{self.axes}d", frame, 24)
                    largest = max(abs(first), *map(abs, others), 0.0)
                    self.commands.append((time.monotonic(), largest))
                self._far.sendto(frame, ("127.0.0.1", self._drive))

    def _to_proxy(self) -> None:
        while not self._over.is_set():
            with suppress(OSError):
                frame = self._far.recv(2048)
                if self._proxy is not None:
                    self._near.sendto(frame, self._proxy)


def free_port() -> int:
    """Return a port that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        return int(opened.getsockname()[1])


class Kill(NamedTuple):
    """The result of one kill."""

    moved: float  # largest |u| before it, in units of the limit
    zero_after: float  # time from it until u was small for good [s]; NaN if the wire was closed
    code: int  # exit code of the proxy; −1 if it did not end
    before: bool  # whether the proxy had ended by itself before the kill


def killed(victim: str, axes: int, sign: float, wait: float, folder: Path) -> Kill:
    """Kill a process after ``wait`` seconds of a motion, and look at u and at the proxy's end."""
    tap, host_port = Tap(axes), free_port()
    file = folder / "proxy.toml"
    file.write_text(setup_text(tap.url, axes, sign), encoding="utf-8")
    host_url = f"udp://127.0.0.1:{host_port}"
    reads, started = os.pipe()
    children = {"drive": in_child(lambda: serve_drive(axes, tap.drive_url))}
    children["proxy"] = in_child(lambda: serve_proxy(file, host_url))
    children["host"] = in_child(lambda: be_host(axes, host_url, started))
    os.close(started)
    tap.start()
    os.read(reads, 1)  # the motion begins, or the host has ended
    os.close(reads)
    time.sleep(wait)
    end, code = ended(children["proxy"], 0.0)
    at = time.monotonic()
    if victim == "port":
        tap.close()
    else:
        os.kill(children[victim], signal.SIGKILL)
    before = end
    if not end:
        end, code = ended(children["proxy"], 20.0)
    for name, number in children.items():
        if name != "proxy" or not end:
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
            os.waitpid(number, 0)
    if victim != "port":
        tap.close()
    large = [t for t, u in tap.commands if u >= SMALL]
    moved = max((u for t, u in tap.commands if t < at), default=0.0)
    after = max((t - at for t in large), default=0.0)
    return Kill(moved / LIMIT, max(after, 0.0), code if end else -1, before)


def ended(number: int, timeout: float) -> tuple[bool, int]:
    """Return whether a process ends within a time, and its exit code."""
    until = time.monotonic() + timeout
    while True:
        found, status = os.waitpid(number, os.WNOHANG)
        if found:
            return True, os.waitstatus_to_exitcode(status)
        if time.monotonic() >= until:
            return False, -1
        time.sleep(0.005)


def warm_up(axes: int, folder: Path) -> None:
    """Compile what the processes need, in this one."""
    signals = None if axes == 1 else (axes, axes)
    with ExitStack() as stack:
        drive = stack.enter_context(Rig(plant_of(axes), DT, listen("udp://127.0.0.1:0")))
        drive.prepare()
        file = folder / "warm.toml"
        file.write_text(setup_text(drive.listener.url, axes, 1.0), encoding="utf-8")
        over = threading.Event()

        def tick() -> None:
            while not over.wait(DT):
                drive.tick()

        thread = threading.Thread(target=tick)
        thread.start()
        stack.callback(thread.join)
        stack.callback(over.set)
        device = open_device(drive.listener.url, DT, signals=signals)
        stack.callback(device.close)
        proxy = CompensatedDrive(device, made(*read(file)).controller)
        with Rig(proxy, DT, listen("udp://127.0.0.1:0"), log=folder / f"log{axes}.csv") as rig:
            rig.prepare()
        device.read()
        device.write(0.0 if axes == 1 else np.zeros(axes))


def kills(count: int, sizes: tuple[int, ...], seed: int) -> dict[str, Any]:
    """Return the figures of so many kills."""
    draw, found = np.random.default_rng(seed), list[tuple[str, Kill]]()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for axes in sizes:
            warm_up(axes, folder)
        for i in range(count):
            victim = VICTIMS[(i // 2) % 2] if draw.random() < 0.8 else "port"
            axes, sign = sizes[(i // 4) % len(sizes)], 1.0 if i % 2 == 0 else -1.0
            kill = killed(victim, axes, sign, float(draw.uniform(0.05, 2.5)), folder)
            found.append((f"{victim}, {axes} axes, sign {sign:+.0f}", kill))
            print(f"{i}: {found[-1][0]}: {kill}", flush=True)
    all_kills = [kill for _, kill in found]
    behind = [kill for kill in all_kills if not kill.before]
    late = [name for name, kill in found if not kill.before and kill.zero_after > ALLOWED]
    codes = Counter(kill.code for kill in all_kills)
    print(f"{count} kills, exit codes {dict(codes)}; late: {late or 'none'}")
    slowest = max((kill.zero_after for kill in behind), default=0.0)
    print(f"u small after {slowest:.3f} s at most, allowed {ALLOWED:.3f} s")
    return {
        "kills": count,
        "ended before the kill": len(all_kills) - len(behind),
        "u moved, share of the limit, median": float(np.median([k.moved for k in all_kills])),
        "u small after [s], most": slowest,
        "allowed [s]": ALLOWED,
        "later than allowed": len(late),
        "exit code 3": codes[3],
        "other exit codes": count - codes[3],
    }


# ---- Loops with the right and the wrong sign ----


def loop(draw: np.random.Generator, wrong: bool) -> tuple[float, float]:
    """Return the largest score of a random loop over the one that ends it, and the largest |y|.

    |y| is in units of the reach of u or of the reference, whichever is larger.
    """

    def between(low: float, high: float) -> float:
        return float(np.exp(draw.uniform(np.log(low), np.log(high))))

    order, omega_o = int(draw.integers(1, 3)), between(10.0, 80.0)
    omega_c, dt = omega_o / between(4.0, 12.0), float(draw.choice([0.1, 0.2])) / omega_o
    b, limit, kind = (
        between(0.5, 50.0),
        between(0.5, 5.0),
        draw.choice(["free", "damped", "spring"]),
    )
    slow = 0.0 if kind == "free" else omega_c * between(0.1, 2.0)
    den = [1.0, slow] if order == 1 else [1.0, slow, 0.0]
    if order == 2 and kind == "spring":
        omega = omega_c * between(0.2, 3.0)
        den = [1.0, 2.0 * between(0.02, 0.7) * omega, omega**2]
    b0 = b * between(0.5, 2.0) * (-1.0 if wrong else 1.0)
    observer = ql.ESO.model_free(order=order, b0=b0, omega_o=omega_o, dt=dt)
    compensator = ql.Compensator(observer, u_min=-limit, u_max=limit)
    kp = omega_c**order / b
    more = {"kd": 2.0 * omega_c / b, "tf": 0.1 / omega_c} if order == 2 else {}
    ki = kp * omega_c * 0.2 * int(draw.integers(0, 2))
    host = ql.baselines.PID(kp=kp, ki=ki, dt=dt, u_min=-limit, u_max=limit, **more)
    reach = b * limit / omega_c**order
    height = reach * between(0.02, 5.0)
    references = (height, ql.signals.Sinusoid(height, 0.3 * omega_c), 0.0)
    load, at = limit * draw.uniform(0.05, 0.9) * draw.choice([-1, 1]), between(0.01, 1.0) * 10.0
    loads: tuple[list[Any], ...] = (
        [],
        [ql.signals.Step(load, at / omega_c)],
        [ql.signals.Sinusoid(load, omega_c * between(0.1, 2.0))],
    )
    chosen = int(draw.integers(0, 3))
    scenario = ql.Scenario(
        references[chosen],
        duration=60.0 / omega_c,
        disturbances=loads[int(draw.integers(0, 3))],
        noise=reach * between(1e-6, 1e-3),
    )
    run = ql.simulate(([b], den), ql.Compensated(host, compensator), scenario)
    rules, signals, largest = Safety().rules(compensator).limits, initial_state().signals, 0.0
    u, f = run["u"].tolist(), run["f_hat"].tolist()
    with as_python():
        for k in range(1, len(u)):
            at_limit = abs(u[k - 1]) >= limit
            signals.v[0], signals.f_hat[0] = b0 * u[k - 1], f[k]
            is_opposed(rules, signals, 0, at_limit)
            largest = max(largest, signals.watched[0].opposed)
    scale = max(reach, height if chosen < 2 else 0.0)
    return largest / rules.most_opposed[0], float(np.max(np.abs(run["y"]))) / scale


def signs(count: int, seed: int) -> dict[str, Any]:
    """Return the figures of so many loops, half of them with the wrong sign."""
    draw = np.random.default_rng(seed)
    scores: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for i in range(count):
            scores[i % 2 == 1].append(loop(draw, i % 2 == 1))
    honest, wrong = (np.array(scores[key]) for key in (False, True))
    missed = wrong[wrong[:, 0] <= 1.0, 1]
    print(
        f"{len(honest)} honest loops: {int(np.sum(honest[:, 0] > 1.0))} ended, largest score "
        f"{honest[:, 0].max():.2f} of the one that ends a loop; {len(wrong)} loops with the wrong "
        f"sign: {int(np.sum(wrong[:, 0] > 1.0))} ended; the others came to |y| of "
        f"{missed.max() if missed.size else 0.0:.2g} times reach or reference at most"
    )
    return {
        "honest loops": len(honest),
        "honest loops ended": int(np.sum(honest[:, 0] > 1.0)),
        "largest score of an honest loop": float(honest[:, 0].max()),
        "loops with the wrong sign": len(wrong),
        "of these ended": int(np.sum(wrong[:, 0] > 1.0)),
        "largest |y| of the others, in reaches": float(missed.max()) if missed.size else 0.0,
    }


def main() -> int:
    """Run both parts; return 1 if the bar is not met."""
    parser = parser_of(__doc__)
    parser.add_argument("--kills", type=int, help="number of kills, 200 by default")
    parser.add_argument("--loops", type=int, help="number of loops, 600 by default")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    count = options.kills if options.kills is not None else 8 if options.quick else 200
    loops = options.loops if options.loops is not None else 30 if options.quick else 600
    figures: dict[str, Any] = {}
    if count:
        figures["kills"] = kills(count, (1,) if options.quick else (1, 3), options.seed)
    if loops:
        figures["signs"] = signs(loops, options.seed)
    write(options, figures)
    failed = figures.get("kills", {})
    return int(failed.get("later than allowed", 0) + failed.get("other exit codes", 0) > 0)


if __name__ == "__main__":
    sys.exit(main())
