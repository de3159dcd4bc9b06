"""The parts of the corpus: how a case of each is run, and how two of its results are compared."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

from quell.kernels import dispatch

from . import kept, loops, results
from .corpus import cases_of, differences, tree_differences

Outcome = dict[str, Any]


class Part(NamedTuple):
    """A part: its file, what runs a case, what compares, and whether it runs compiled code."""

    file: str
    run: Callable[[Mapping[str, Any], Path], Outcome]
    differ: Callable[[Mapping[str, Any], Outcome, Outcome], Sequence[str]]
    compiled: bool = False


def _logs(case: Mapping[str, Any], stored: Outcome, now: Outcome) -> Sequence[str]:
    return differences(stored, now, case.get("why", ""))


def _trees(tolerance: float) -> Callable[..., Sequence[str]]:
    return lambda case, stored, now: [*tree_differences(stored, now, tolerance)]


PARTS: dict[str, Part] = {
    "loops": Part("loops", lambda case, folder: loops.simulate_case(case), _logs),
    "driven": Part("driven", lambda case, folder: loops.drive_case(case), _logs),
    "compiled": Part(
        "compiled",
        lambda case, folder: loops.compile_case(loops.loop_named(case["loop"])),
        lambda case, stored, now: loops.compiled_differences(stored, now),
        compiled=True,
    ),
    "tuned": Part("tuned", results.tune_case, _trees(1e-6)),
    "identified": Part("identified", results.identify_case, _trees(1e-6)),
    "commands": Part("commands", results.command_case, _trees(1e-6)),
    "memory": Part("memory", lambda case, folder: kept.memory_case(case), _logs),
    "setups": Part("setups", kept.setup_case, _logs),
}
"""The parts by their names; ``make`` writes them."""


def chosen(part: str, only: Sequence[str] = ("*",), share: tuple[int, int] = (0, 1)) -> list[Any]:
    """Return the cases of a part whose names match, or of them the i-th of n shares."""
    cases = [case for case in cases_of(part) if any(fnmatch(case["name"], each) for each in only)]
    return cases[share[0] :: share[1]]


@contextmanager
def as_python(compiled: bool = False) -> Iterator[None]:
    """Let entry points run as plain Python, unless they shall be ``compiled``."""
    before, dispatch.interpret_all = dispatch.interpret_all, not compiled
    try:
        yield
    finally:
        dispatch.interpret_all = before


def run(part: str, case: Mapping[str, Any]) -> Outcome:
    """Return what a case of a part gives now."""
    folder = Path(tempfile.mkdtemp(prefix="quell-golden-"))
    try:
        with as_python(PARTS[part].compiled):
            return PARTS[part].run(case, folder)
    except Exception as error:  # an outcome as any other: it is not the stored one
        return {"error": f"{type(error).__name__}: {error}"}
    finally:
        shutil.rmtree(folder)


def changes(part: str, case: Mapping[str, Any], now: Outcome) -> list[str]:
    """Return what is different from the stored result of a case, a line for each."""
    if "stored" not in case:
        return ["it has no stored result"]
    if "error" in now and "error" not in case["stored"]:
        return [f"it fails: {now['error']}"]
    return [*PARTS[part].differ(case, case["stored"], now)]


def run_in_c(case: Mapping[str, Any]) -> Outcome:
    """Return what the exported C code of a driven case gives now."""
    with as_python(), tempfile.TemporaryDirectory(prefix="quell-golden-") as folder:
        return loops.drive_in_c(case, Path(folder))
