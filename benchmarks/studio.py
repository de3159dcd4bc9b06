"""The studio: time from input to picture, hostile messages, many pages, memory.

    python benchmarks/studio.py                     # all parts: 2000 inputs, 10⁵ messages, 20 pages
    python benchmarks/studio.py --inputs 200 --messages 2000 --pages 5

1. A browser (Chromium, headless) moves the slider of ω_o, 20 times a second; the page notes the
   time from each input until the frame with its run (10 s at 1 kHz) and its loop plots is drawn.
2. A client sends malformed messages, and well-formed ones with values that make no sense; each must
   be answered with an error, or a result, and a page beside it must go on as if nothing had been.
3. Pages at once, each with runs of its own, that are killed and opened again.
4. Connections that never send a request, and clients that send theirs byte by byte, all without
   the token; meanwhile the page is asked for, and a run. The bars: 1 s, and a log below 1 MB.

Memory is that of the server's process; it is shown after each tenth of the messages.
"""

from __future__ import annotations

import importlib.util
import json
import multiprocessing
import os
import random
import re
import resource
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
from measured import options_of, parser_of, write

from quell.studio.messages import parsed_frame

CHROMIUM = "/usr/bin/chromium"
OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
OPTIONS += ["--disable-component-update", "--disable-sync", "--no-first-run"]
PAGE = Path(__file__).parents[1] / "src/quell/studio/page"
PRESETS = json.loads((PAGE / "presets.json").read_text(encoding="utf-8"))
TABLES: dict[str, Any] = PRESETS[0]["setup"]
PERIOD = 0.05  # time between two inputs [s]
BAR = 50.0  # 95 % of the pictures within this time [ms]


def main() -> None:
    """Run all parts and print a table for each."""
    parser = parser_of(__doc__)
    parser.add_argument("--inputs", type=int, default=2000)
    parser.add_argument("--messages", type=int, default=100_000)
    parser.add_argument("--pages", type=int, default=20)
    parser.add_argument("--idle", type=int, default=2000, help="connections without a request")
    parser.add_argument("--slow", type=int, default=200, help="clients that send byte by byte")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=30, help="requests beside idle clients")
    parser.add_argument("--runs", type=int, default=20, help="of each page at once")
    given = options_of(parser, inputs=20, messages=100, pages=2, idle=20, slow=5, rounds=2, runs=2)
    figures: dict[str, Any] = {}
    load = os.getloadavg()[0]
    print(f"{os.cpu_count()} cores, load of the last minute before: {load:.1f}")
    command = [sys.executable, "-m", "quell", "studio", "--no-browser", "--port", "0"]
    log = tempfile.TemporaryFile()  # noqa: SIM115
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
    try:
        assert server.stdout is not None
        found = re.search(r"http\S+", server.stdout.readline())
        if found is None:
            log.seek(0)
            sys.exit(f"the studio did not start: {log.read().decode(errors='replace')}")
        url = found.group()
        # Answers must be right. Times are judged in the long run only: here they say nothing.
        in_time, right = [], []
        if given.inputs:
            figures["pictures"] = pictures(url, given.inputs)
            in_time.append(figures["pictures"].get("within the bar [%]", 100.0) >= 95.0)
        if given.messages:
            figures["hostile"] = hostile(url, server.pid, given.messages, given.seed)
            right.append(figures["hostile"]["wrong"] == 0)
        if given.pages:
            figures["pages"] = many(url, server.pid, given.pages, given.runs)
            right.append(figures["pages"]["wrong"] == 0)
        if given.idle:
            figures["idle"] = idle(url, given.idle, given.slow, given.rounds)
            slowest = figures["idle"]
            in_time.append(max(slowest["slowest page [s]"], slowest["slowest run [s]"]) <= 1.0)
    finally:
        server.terminate()
        server.wait(10)
        size = log.seek(0, os.SEEK_END)
        print(f"log of the server: {size / 1e3:.1f} kB (bar: 1000)")
        figures["log [kB]"] = size / 1e3
    write(given, figures)
    good = all(right) and size < 1e6 and (given.quick or all(in_time))
    sys.exit(0 if good else 1)


def pictures(url: str, count: int) -> dict[str, Any]:
    """Move a slider in a browser; return the times until the pictures came [ms]."""
    if not Path(CHROMIUM).exists() or importlib.util.find_spec("playwright") is None:
        print("NOT measured: pictures, there is no Chromium or no playwright here")
        return {"NOT measured": "there is no Chromium or no playwright here"}
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(url)
        while page.evaluate("window.studio.picture.frames") == 0:
            time.sleep(0.1)
        slider = page.locator('input[type=range][data-path="observer.omega_o"]')
        slider.focus()
        compiled = page.evaluate("window.studio.picture.compiled")
        began = time.perf_counter()
        for i in range(count):
            page.keyboard.press("ArrowRight" if i // 40 % 2 else "ArrowLeft")
            time.sleep(max(0.0, began + PERIOD * (i + 1) - time.perf_counter()))
        time.sleep(1.0)
        times = np.array(page.evaluate("window.studio.picture.times"))
        first = np.array(page.evaluate("window.studio.picture.firstTimes"))
        compiled = page.evaluate("window.studio.picture.compiled") - compiled
        seconds = page.evaluate(
            "[window.studio.picture.run.seconds, window.studio.picture.lastLoop]"
        )
        browser.close()
    print(f"\ntime from input to picture, {count} inputs, {1 / PERIOD:.0f} a second [ms]")
    print(f"{'':24}{'pictures':>9}{'50 %':>8}{'95 %':>8}{'99 %':>8}{'largest':>9}")
    figures: dict[str, Any] = {}
    for name, each in (("response", first), ("response and loop plots", times)):
        ends = np.percentile(each, [50, 95, 99, 100])
        print(f"{name:24}{each.size:>9}" + "".join(f"{end:8.1f}" for end in ends))
        figures[name] = dict(zip(("50 %", "95 %", "99 %", "largest"), ends, strict=True))
    print(f"compiled meanwhile: {compiled:.1f} s; last run and analysis: {seconds} s")
    share = float(np.mean(times <= BAR))
    print(f"within {BAR:.0f} ms: {100 * share:.1f} % (bar: 95 %)")
    return figures | {"inputs": count, "within the bar [%]": 100.0 * share}


class Client:
    """A page without a browser."""

    def __init__(self, url: str) -> None:
        from contextlib import ExitStack

        from websockets.sync.client import connect

        self.stack, self.count = ExitStack(), 0
        origin: Any = "/".join(url.split("/")[:3])
        address = f"ws{url.removeprefix('http')}socket"
        made = connect(address, origin=origin, max_size=None, compression=None)
        self.socket = self.stack.enter_context(made)
        self.next()

    def next(self) -> dict[str, Any]:
        """Return the header of the next frame."""
        data = self.socket.recv(timeout=300.0)
        assert isinstance(data, bytes)
        return parsed_frame(data)[0]

    def run(self, tables: dict[str, Any]) -> list[dict[str, Any]]:
        """Ask for a run, and return the headers of the answer."""
        self.count += 1
        message = {"do": "run", "id": self.count, "setup": tables, "columns": 300}
        self.socket.send(json.dumps(message))
        found: list[dict[str, Any]] = []
        while not found or found[-1]["kind"] not in ("loop", "error", "stopped"):
            header = self.next()
            if header.get("id") == self.count:
                found.append(header)
        return found


def memory(process: int) -> float:
    """Return the resident memory of a process [MB]."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


ODD = (0, -1, 1e308, -1e308, 5e-324, 2**60, "x", "", None, [], {}, [[]], True, {"kind": "step"})


def attack(choose: random.Random) -> str:
    """Return a message that is broken, or has a value that makes no sense."""
    text = json.dumps({"do": "run", "id": 7, "setup": TABLES, "columns": 300})
    kind = choose.randrange(5)
    if kind == 0:
        return "".join(chr(choose.randrange(1, 0x250)) for _ in range(choose.randrange(200)))
    if kind == 1:
        return text[: choose.randrange(len(text))]
    if kind == 2:
        place = choose.randrange(len(text))
        return text[:place] + chr(choose.randrange(32, 127)) + text[place + 1 :]
    tables = json.loads(json.dumps(TABLES))
    where: Any = tables
    while True:
        key = choose.choice(list(where) if isinstance(where, dict) else range(len(where)))
        inner = where[key]
        if not isinstance(inner, dict | list) or not inner or choose.random() < 0.2:
            break
        where = inner
    where[key] = choose.choice(ODD)
    do = "run" if kind == 3 else choose.choice(("toml", "band", "export", "tune", "x", 3, None))
    if do == "tune":
        do = "cancel"
    return json.dumps({"do": do, "id": choose.choice((7, -1, "7", 1.5, None)), "setup": tables})


def hostile(url: str, process: int, count: int, seed: int) -> dict[str, Any]:
    """Send hostile messages beside a page at work; return how it was affected, and the memory."""
    choose, attacker, page = random.Random(seed), Client(url), Client(url)
    wanted = page.run(TABLES)[-1]["loop"]
    used, began, wrong = [], time.perf_counter(), 0
    received = [0]
    ended = threading.Event()

    def drain() -> None:
        while not ended.is_set():
            try:
                attacker.socket.recv(timeout=0.5)
                received[0] += 1
            except TimeoutError:
                continue

    draining = threading.Thread(target=drain)
    draining.start()
    for i in range(count):
        attacker.socket.send(attack(choose))
        if i % 100 == 99:
            found = page.run(TABLES)[-1]
            wrong += found["kind"] != "loop" or found["loop"] != wanted
        if (i + 1) % max(count // 10, 1) == 0:
            used.append(memory(process))
    ended.set()
    draining.join()
    seconds = time.perf_counter() - began
    print(f"\n{count} hostile messages in {seconds:.0f} s, {received[0]} frames in answer")
    print(f"runs of the page beside: {count // 100}, of which wrong: {wrong}")
    print(f"memory after each tenth [MB]: {', '.join(f'{each:.0f}' for each in used)}")
    attacker.stack.close()
    page.stack.close()
    return {"messages": count, "answers": received[0], "wrong": wrong, "memory [MB]": used}


def many(url: str, process: int, count: int, runs: int) -> dict[str, Any]:
    """Open pages at once, three times over; return how many got other answers than their own."""
    wrong, slowest = [0], [0.0]

    def work(number: int) -> None:
        page = Client(url)
        for k in range(runs):
            tables = json.loads(json.dumps(TABLES))
            tables["scenario"]["reference"]["height"] = 1.0 + number
            tables["observer"]["omega_o"] = 30.0 + k
            began = time.perf_counter()
            found = page.run(tables)
            slowest[0] = max(slowest[0], time.perf_counter() - began)
            peak = next(each for each in found if each["kind"] == "run")["metrics"][0]["peak_error"]
            wrong[0] += abs(peak - (1.0 + number)) > 0.05
        page.socket.socket.close()  # killed: without a goodbye

    before = memory(process)
    for _ in range(3):
        threads = [threading.Thread(target=work, args=(number,)) for number in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    after = memory(process)
    print(f"\n{count} pages at once, three times, {runs} runs each: wrong answers {wrong[0]}")
    print(f"slowest answer {1e3 * slowest[0]:.0f} ms; memory {before:.0f} MB, then {after:.0f} MB")
    return {
        "pages": count,
        "wrong": wrong[0],
        "slowest [ms]": 1e3 * slowest[0],
        "memory before [MB]": before,
        "memory after [MB]": after,
    }


def idle(url: str, count: int, slow: int, rounds: int) -> dict[str, float]:
    """Open connections that ask for nothing or slowly; return the slowest answers to others."""
    wanted = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(wanted, count + slow + 500), wanted))
    host, port = url.split("/")[2].split(":")
    # A process of its own, so that it takes no time of the client that is measured.
    apart = multiprocessing.get_context("fork")
    ended, opened = apart.Event(), apart.Value("i", 0)
    slowest = {"page": 0.0, "run": 0.0}
    request = f"GET /wrong/ HTTP/1.1\r\nHost: {host}:{port}\r\nX: {'x' * 500}\r\n\r\n".encode()

    def flood() -> None:
        """Keep ``count`` connections open, and ``slow`` that send a byte in a tenth of a second."""
        made: list[Any] = []
        at = 0
        while not ended.is_set():
            for each in made[:]:
                try:
                    if each[1] is not None and each[1] < len(request):
                        each[0].send(request[each[1] : each[1] + 1])
                        each[1] += 1
                    elif each[1] is None and each[0].recv(1, socket.MSG_DONTWAIT) == b"":
                        raise ConnectionResetError
                except BlockingIOError:
                    continue
                except OSError:
                    each[0].close()
                    made.remove(each)
            while len(made) < count + slow and not ended.is_set():
                one = socket.socket()
                one.settimeout(1.0)
                try:
                    one.connect((host, int(port)))
                except OSError:
                    one.close()
                    break
                at += 1
                made.append([one, 0 if at % (count + slow) < slow else None])
            opened.value = at
            time.sleep(0.1)
        for each in made:
            each[0].close()

    page = Client(url)
    page.run(TABLES)
    flooding = apart.Process(target=flood)
    flooding.start()
    time.sleep(2.0)
    for _ in range(rounds):
        began = time.perf_counter()
        with urllib.request.urlopen(url, timeout=60.0) as answer:
            answer.read()
        slowest["page"] = max(slowest["page"], time.perf_counter() - began)
        began = time.perf_counter()
        found = page.run(TABLES)
        slowest["run"] = max(slowest["run"], time.perf_counter() - began)
        assert found[-1]["kind"] == "loop"
        other = Client(url)
        other.socket.socket.close()
        time.sleep(0.5)
    ended.set()
    flooding.join()
    print(f"\n{count} idle and {slow} slow clients, {opened.value} connections in all")
    print(f"slowest page {1e3 * slowest['page']:.0f} ms, slowest run {1e3 * slowest['run']:.0f} ms")
    return {
        "connections": opened.value,
        "slowest page [s]": slowest["page"],
        "slowest run [s]": slowest["run"],
    }


if __name__ == "__main__":
    main()
