"""``quell doctor`` says what works and what to do, also where things are broken, without a traceback."""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from quell.cli import doctor
from quell.cli.exit_codes import ExitCode
from quell.lazy import install

from .commands import Shown, in_this_process


@pytest.fixture
def told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[[], tuple[Shown, dict[str, dict[str, Any]]]]:
    """Return a function that runs the command, and returns what it printed and its findings by name."""

    def of() -> tuple[Shown, dict[str, dict[str, Any]]]:
        file = tmp_path / "doctor.json"
        shown = in_this_process(("doctor", "--json", str(file), "--overwrite"), monkeypatch, capsys)
        assert "Traceback" not in shown.out + shown.err
        results = json.loads(file.read_text(encoding="utf-8"))
        assert results["works"] == (shown.code == 0)
        return shown, {each["name"]: each for each in results["found"]}

    return of


@pytest.mark.trial
def test_it_finds_what_is_here(told: Callable[..., Any]) -> None:
    """Versions, the folder of compiled code, a loop that was run, rights of a loop, and no NOT."""
    shown, found = told()
    assert shown.code == ExitCode.DONE, shown.out
    assert found["numpy"]["text"] == importlib.import_module("numpy").__version__
    assert "writable" in found["folder"]["text"]
    assert {
        "a small loop",
        "memory",
        "gcc",
        "simulation, tuning, identification, export of C",
    } <= set(found)
    assert "NOT " not in shown.out


@pytest.mark.trial
def test_an_unusable_cache_is_missing_and_quell_works(
    told: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each run compiles anew; the line says what to set."""
    monkeypatch.setattr("quell.kernels.cache.cache_path", lambda: None)
    shown, found = told()
    assert shown.code == 0
    assert found["folder"]["state"] == doctor.MISSING
    assert "NUMBA_CACHE_DIR" in found["folder"]["remedy"]
    assert "gcc" in found


@pytest.mark.trial
def test_a_library_that_cannot_be_imported_is_named(
    told: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With what its import raised, of any kind."""
    real = importlib.import_module

    def broken(name: str, *more: Any) -> Any:
        if name == "h5py":
            raise RuntimeError("libhdf5.so.310: wrong ELF class")
        return real(name, *more)

    monkeypatch.setattr("importlib.metadata.requires", lambda _: ["h5py>=3.11"])
    monkeypatch.setattr(importlib, "import_module", broken)
    shown, found = told()
    assert shown.code == ExitCode.BROKEN
    assert "wrong ELF class" in found["h5py"]["text"]
    assert found["h5py"]["remedy"].startswith("pip install 'h5py")


@pytest.mark.parametrize("part", [*doctor.LOOKS])
def test_a_part_that_fails_is_a_finding(
    told: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    """Whatever a broken installation raises in it."""

    def fails(_: Any) -> Any:
        raise OSError("Input/output error")
        yield

    # The parts that start programs or search for packages have tests of their own.
    others = {"Versions": doctor.LOOKS["Versions"]}
    monkeypatch.setattr(doctor, "LOOKS", others | {part: fails})
    shown, found = told()
    assert shown.code == ExitCode.BROKEN
    assert found["this part"]["text"] == "OSError: Input/output error"
    assert ("Python" in found) == (part != "Versions")


def test_a_wrong_result_is_not_taken_for_a_working_loop(
    told: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where compiled code computes something else, as a wrong processor would."""
    import quell as ql

    monkeypatch.setattr(ql, "simulate", lambda *_: {"y": [float("nan")]})
    shown, found = told()
    assert shown.code == ExitCode.BROKEN
    assert "results are wrong here" in found["a small loop"]["text"]


def test_a_compiler_that_does_not_run_is_missing(
    told: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A program of its name alone is not enough."""
    gcc = tmp_path / "gcc"
    gcc.write_text("#!/bin/sh\nexit 3\n", encoding="utf-8")
    gcc.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    _, found = told()
    assert found["gcc"]["state"] == doctor.MISSING
    assert "does not run" in found["gcc"]["text"]


def test_extras_are_those_of_the_distribution(
    told: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With what is missing, and the command that installs it; an older version than needed is named."""
    lines = [
        "numpy>=2.0",
        "pytest>=8 ; extra == 'test'",
        "no-such-package>=1.2; extra == 'fmi'",
        'numpy>=99.1; extra == "tuning"',
    ]
    monkeypatch.setattr("importlib.metadata.requires", lambda _: lines)
    shown, found = told()
    assert shown.code == ExitCode.DONE
    assert "test" not in found
    assert found["fmi"]["text"] == "no-such-package is not installed"
    assert found["fmi"]["remedy"] == install("fmi")
    assert found["tuning"]["text"].endswith("is older than 99.1")
