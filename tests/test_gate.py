"""``.ci/gate.py``: all steps run, those behind a failed one do not, and the table names each failure."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CI = Path(__file__).parents[1] / ".ci"
pytestmark = pytest.mark.skipif(not CI.exists(), reason="the gate is in the repository")


def gate(
    folder: Path, *names: str, turn: str = "1", **steps: str
) -> subprocess.CompletedProcess[str]:
    """Run a gate of these steps; their programs begin with their heads."""
    ci = folder / ".ci"
    (ci / "steps").mkdir(parents=True)
    shutil.copy(CI / "gate.py", ci)
    (ci / "turn").write_text(f"{turn}\n", encoding="utf-8")
    for name, program in steps.items():
        (ci / "steps" / f"{name}.sh").write_text(f"# shows: {name}\n{program}\n", encoding="utf-8")
    return subprocess.run(
        [sys.executable, "-S", "-E", str(ci / "gate.py"), *names],
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_all_steps_run_and_each_failure_is_listed(tmp_path: Path) -> None:
    """A failed step stops only those that need it; the exit code is that of a failure."""
    done = gate(
        tmp_path,
        a="echo fine",
        b='echo "cause of b"; exit 3',
        c="# after: a\ntest -d $OWN",
        d="# after: b\necho never",
        e="false | true",
    )
    table = done.stdout[done.stdout.index("step ") :].splitlines()
    said = {line.split()[0]: line.split(maxsplit=3)[3] for line in table[1:]}
    assert said == {
        "a": "passed",
        "b": "FAILED: exit code 3",
        "c": "passed",
        "d": "not run: b failed",
        "e": "FAILED: exit code 1",
        "all": "3 FAILED: b, d, e",
    }
    assert "cause of b" in done.stdout
    assert "never" not in done.stdout
    assert done.returncode == 1


def test_named_steps_bring_what_they_need_and_a_step_that_hangs_is_ended(tmp_path: Path) -> None:
    """With its processes; a name that is none is refused."""
    done = gate(
        tmp_path / "one", "c",
        a="true", b="exit 1", c="# after: a\n# minutes: 0.005\nsleep 60 & sleep 60",
    )  # fmt: skip
    table = done.stdout[done.stdout.index("step ") :]
    assert "FAILED: not finished after 0.005 minutes" in table
    assert "b " not in table
    refused = gate(tmp_path / "two", "z", a="true")
    assert "there is no step z: steps are a" in refused.stderr
    assert refused.returncode == 1


def test_parts_take_turns_by_a_whole_number(tmp_path: Path) -> None:
    """In decimal notation, also with zeros before it; anything else is refused before a step runs."""
    done = gate(tmp_path / "eight", a="echo part $((TURN % 5 + 1))", turn="008")
    assert "part 4" in done.stdout
    for i, text in enumerate(("", "-1", "1.5", "next")):
        refused = gate(tmp_path / str(i), a="echo never", turn=text)
        assert f".ci/turn has {text!r}: it must have a whole number" in refused.stderr
        assert "never" not in refused.stdout
        assert refused.returncode == 1


def test_every_step_of_the_gate_says_what_it_shows_and_needs_steps_that_exist() -> None:
    """The heads of all programs are read, and every check that a step calls exists."""
    programs = {path.stem: path.read_text(encoding="utf-8") for path in (CI / "steps").glob("*.sh")}
    assert len(programs) > 10
    for name, text in programs.items():
        heads = [line for line in text.splitlines() if line.startswith("# ")]
        assert heads[0].startswith("# shows: "), name
        after = next((line for line in heads if line.startswith("# after: ")), "# after: ")
        assert {*after.removeprefix("# after: ").split()} <= {*programs}, name
        for word in text.replace('"', " ").split():
            if ".ci/checks/" in word:
                assert (CI / "checks" / word.rsplit("/", 1)[1]).is_file(), word
