"""``quell doctor``: what works on this machine, and what to install or permit for the rest."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from quell import __version__
from quell.cli.exit_codes import ExitCode
from quell.cli.options import RESULT_OUTPUTS, ResultOutputs
from quell.lazy import DISTRIBUTION, install

WORKS, MISSING, BROKEN = "works", "missing", "NOT"
"""States of what is found: it works; it is not here, and not needed; it is needed and fails."""

_SECONDS = 20.0  # a program that does not tell its version by then does not work


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    subject: str  # part of the report
    name: str
    state: str  # WORKS, MISSING or BROKEN
    text: str  # version, place, or what is wrong
    remedy: str = ""  # what to do


def doctor(*, outputs: ResultOutputs = RESULT_OUTPUTS) -> None:
    """Show what works here: versions, compiled code, compilers, rights for real time, extras.

    Compiles or loads a small loop. A line with NOT is about something that quell needs and that
    does not work; the exit code is then 7. What is only missing has a line with what installs it.
    """
    from quell.cli.output import Console, check_outputs, print_line, write_results

    outputs = check_outputs(outputs)
    console = Console()
    found: list[Finding] = []
    for subject, look in LOOKS.items():
        print_line(console, f"\n{subject}" if found else subject)
        for finding in looked(subject, look, found):
            found.append(finding)
            remedy = f": {finding.remedy}" if finding.remedy else ""
            print_line(console, f"  {finding.state:8}{finding.name}: {finding.text}{remedy}")
    broken = [each for each in found if each.state == BROKEN]
    results = {"version": __version__, "works": not broken, "found": [asdict(f) for f in found]}
    write_results(console, results, outputs)
    if broken:
        sys.exit(ExitCode.BROKEN)


def looked(
    subject: str, look: Callable[[list[Finding]], Iterator[Finding]], found: list[Finding]
) -> Iterator[Finding]:
    """Yield the findings of a part; a part that fails itself is a finding, not a traceback."""
    try:
        yield from look([*found])
    except Exception as error:  # whatever a broken installation raises
        text = f"{type(error).__name__}: {' '.join(str(error).split())}"
        yield Finding(subject, "this part", BROKEN, text, _AGAIN)


_AGAIN = f"{install()} --force-reinstall makes a broken installation whole"

# ---- Versions and extras ----

# Extras for those who work on quell itself.
_OF_DEVELOPERS = ("test", "docs", "bench", "mutation", "dev")
_REQUIREMENT = re.compile(r"([\w.-]+)(?:\[[^\]]*\])?\s*(?:\(?>=([\d.]+))?")
_EXTRA = re.compile(r"extra\s*==\s*['\"]([\w-]+)['\"]")


def requirements() -> dict[str, list[tuple[str, str]]]:
    """Return names and lowest versions of what quell needs, by extra; "" needs no extra.

    They are those of the installed distribution. Extras that only add up others are left out.
    """
    found: dict[str, list[tuple[str, str]]] = {}
    for line in importlib.metadata.requires(DISTRIBUTION) or ():
        of = _REQUIREMENT.match(line)
        extra = _EXTRA.search(line)
        if of is not None and of[1] != DISTRIBUTION:
            found.setdefault(extra[1] if extra else "", []).append((of[1], of[2] or "0"))
    return found


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def _fault(name: str, least: str) -> tuple[str, str]:
    """Return the version of a distribution, and what is wrong with it, empty if nothing is."""
    try:
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "", "is not installed"
    if _numbers(version) < _numbers(least):
        return version, f"{version} is older than {least}"
    return version, ""


def _versions(_: list[Finding]) -> Iterator[Finding]:
    part = "Versions"
    yield Finding(part, "quell", WORKS, f"{__version__} in {Path(__file__).parents[1]}")
    yield Finding(part, "Python", WORKS, f"{platform.python_version()} in {sys.executable}")
    yield Finding(part, "system", WORKS, f"{platform.platform()}, {os.cpu_count()} processors")
    try:
        needed = requirements()[""]
    except (importlib.metadata.PackageNotFoundError, KeyError):
        text = "is not installed as a distribution, so what it needs is not known"
        yield Finding(part, DISTRIBUTION, MISSING, text, f"{install()}, or pip install -e .")
        needed = [(name, "0") for name in ("numpy", "numba", "scipy", "matplotlib")]
    for name, least in needed:
        version, fault = _fault(name, least)
        if not fault:
            try:
                importlib.import_module(name)
            except Exception as error:  # a broken library can raise anything
                fault = f"{version} can't be imported ({type(error).__name__}: {error})"
        remedy = f"pip install '{name}>={least}'" if fault else ""
        yield Finding(part, name, BROKEN if fault else WORKS, fault or version, remedy)


def _extras(_: list[Finding]) -> Iterator[Finding]:
    part = "Extras"
    try:
        needed = requirements()
    except importlib.metadata.PackageNotFoundError:
        yield Finding(part, "extras", MISSING, "not known: see Versions", install())
        return
    for extra, parts in needed.items():
        if extra in ("", *_OF_DEVELOPERS):
            continue
        told = [(name, *_fault(name, least)) for name, least in parts]
        faults = [f"{name} {fault}" for name, _, fault in told if fault]
        versions = ", ".join(f"{name} {version}" for name, version, _ in told)
        yield Finding(
            part,
            extra,
            MISSING if faults else WORKS,
            "; ".join(faults) or versions,
            install(extra) if faults else "",
        )


# ---- Compiled code ----


def _compiled(_: list[Finding]) -> Iterator[Finding]:
    part = "Compiled code"
    from quell.kernels.cache import cache_path, compile_time

    place = cache_path()
    if place is None:
        text = "can't be created or written to, or is another user's: each run compiles anew"
        yield Finding(part, "folder", MISSING, text, "set NUMBA_CACHE_DIR to a folder of your own")
    else:
        files = [file for file in place.rglob("*") if file.is_file()]
        size = sum(file.stat().st_size for file in files) / 1e6
        yield Finding(
            part, "folder", WORKS, f"{place}, writable, {len(files)} files, {size:.1f} MB"
        )
    import quell as ql

    before, began = compile_time.seconds, time.perf_counter()
    plant = ql.plants.LinearPlant([[-1.0]], [1.0], [1.0])
    observer = ql.ESO.model_free(order=1, b0=1.0, omega_o=10.0, dt=0.01)
    scenario = ql.Scenario(reference=ql.signals.Step(), duration=1.0)
    run = ql.simulate(plant, ql.ADRC(observer, omega_c=2.0), scenario)
    took, compiling = time.perf_counter() - began, compile_time.seconds - before
    compile_time.told = compile_time.seconds  # a line below says it
    reached = float(run["y"][-1])
    if not abs(reached - 0.86) < 0.1:
        text = f"y = {reached:.3g} after 1 s, must be 0.86: results are wrong here"
        yield Finding(part, "a small loop", BROKEN, text, "please report it")
    elif compiling > 0.0:
        text = f"was compiled in {compiling:.1f} s; run quell doctor again to see it reused"
        yield Finding(part, "a small loop", WORKS, text)
    else:
        yield Finding(part, "a small loop", WORKS, f"is reused: loaded and run in {took:.2f} s")


# ---- Programs ----

# What each program is for, and what installs it on Debian and Ubuntu.
_PROGRAMS: Mapping[str, tuple[str, str]] = {
    "gcc": ("C of a controller compared and sized, FMUs", "apt install gcc"),
    "clang": ("another compiler for the same", "apt install clang"),
    "arm-none-eabi-gcc": (
        "sizes for a Cortex-M",
        "apt install gcc-arm-none-eabi libnewlib-arm-none-eabi",
    ),
    "qemu-system-arm": ("C run on an emulated Cortex-M", "apt install qemu-system-arm"),
    "frama-c": ("quell export --prove", "apt install frama-c-base"),
    "cppcheck": ("style of exported C", "apt install cppcheck"),
}


def _programs(_: list[Finding]) -> Iterator[Finding]:
    part = "Programs for exported controllers"
    for name, (purpose, remedy) in _PROGRAMS.items():
        place = shutil.which(name)
        if place is None:
            yield Finding(part, name, MISSING, f"for {purpose}", remedy)
            continue
        try:
            option = "-version" if name == "frama-c" else "--version"
            done = subprocess.run(
                [place, option], capture_output=True, timeout=_SECONDS, check=True
            )
        except (OSError, subprocess.SubprocessError) as error:
            text = f"{place} does not run ({type(error).__name__})"
            yield Finding(part, name, MISSING, text, remedy)
            continue
        said = done.stdout.decode(errors="replace").strip()  # in any language
        line = next(iter(said.splitlines()), "")
        yield Finding(part, name, WORKS, f"{line}, for {purpose}")


# ---- Real time ----


def _real_time(_: list[Finding]) -> Iterator[Finding]:
    part = "Real time"
    from quell.realtime.system import enter_real_time, real_time_process

    if not hasattr(os, "sched_setscheduler"):
        text = f"{platform.system()} has no SCHED_FIFO: loops run with ordinary priority"
        yield Finding(part, "scheduling", MISSING, text, "use Linux for loops above 100 Hz")
    with real_time_process(50, interpreted=False) as notes:
        if hasattr(os, "sched_setscheduler"):
            # Of a thread, which ends: this process keeps its priority.
            thread = threading.Thread(target=enter_real_time, args=(50, None, notes))
            thread.start()
            thread.join()
    for note in notes:
        granted = note.startswith(("memory is locked", "processors stay", "scheduling is"))
        name = next((word for word in ("memory", "processors") if word in note), "scheduling")
        text, _between, remedy = note.partition("; ")
        yield Finding(part, name, WORKS if granted else MISSING, text, remedy)


# ---- What works ----


def _uses(found: list[Finding]) -> Iterator[Finding]:
    part = "What works here"
    state = {finding.name: finding.state for finding in found}

    def use(name: str, *needs: str) -> Finding:
        missing = [each for each in needs if state.get(each) != WORKS]
        told = f"needs {', '.join(missing)}" if missing else "works"
        return Finding(part, name, MISSING if missing else WORKS, told)

    broken = [finding.name for finding in found if finding.state == BROKEN]
    if broken:
        yield Finding(part, "quell", BROKEN, f"is broken by {', '.join(broken)}", "see above")
        return
    yield use("simulation, tuning, identification, export of C")
    yield use("proof of exported C", "frama-c")
    yield use("sizes for a Cortex-M", "arm-none-eabi-gcc")
    compiler = "clang" if state.get("clang") == WORKS else "gcc"
    yield use("FMUs with code, comparison of exported C", compiler)
    yield use("loops in real time that nothing delays", "scheduling", "memory", "processors")
    yield use("rigs with recording in MCAP and a serial line", "telemetry", "serial")
    yield use("the page in the browser", "studio")


LOOKS: Mapping[str, Callable[[list[Finding]], Iterator[Finding]]] = {
    "Versions": _versions,
    "Compiled code": _compiled,
    "Programs for exported controllers": _programs,
    "Real time": _real_time,
    "Extras": _extras,
    "What works here": _uses,
}
"""Parts of the report, in order; each is given what the parts before found."""
