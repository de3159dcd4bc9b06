"""``run_rig(..., memory=)``: what was learned outlives a real-time loop in a file."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.realtime import MemoryFile, Safety, TwinDevice, run_rig
from quell.realtime.supervisor import Mode

from .commands import in_this_process

DT = 0.01
PLANT = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [1.0, 0.0])
SAFETY = Safety(settle=5, ramp_time=0.02)
WAVE = ql.signals.Sinusoid(amplitude=1.0, omega=3.0)


def learning(**options: Any) -> ql.ADRC:
    """A controller that learns the spring and the damper of the plant."""
    observer = ql.ESO.model_free(order=2, b0=1.5, omega_o=30.0, dt=DT)
    return ql.ADRC(
        observer, 4.0, **{"learner": ql.learners.Kalman(), "u_min": -20.0, "u_max": 20.0} | options
    )


def run(memory: Any, controller: Any = None, duration: float = 1.5, **options: Any) -> Any:
    """Run a loop around the plant in real time."""
    controller = learning() if controller is None else controller
    return run_rig(
        TwinDevice(PLANT, DT),
        controller,
        WAVE,
        duration=duration,
        memory=memory,
        **{"safety": SAFETY, "priority": 0, "approach": 0.0} | options,
    )


def theta(file: Path) -> dict[str, float]:
    """What is learned in a file."""
    controller = learning()
    controller.restore(file.read_bytes())
    return dict(controller.estimate.theta)


@pytest.mark.trial
@pytest.mark.compiled
def test_a_second_run_begins_with_what_the_first_has_learned(tmp_path: Path) -> None:
    """Its file is what the first run ended with; the notes say so, and the controller is as before."""
    file, controller = tmp_path / "servo.qllm", learning()
    first = run(file, controller)
    assert first.completed
    assert any("does not exist yet" in note for note in first.notes)
    assert any(note.startswith(f"memory: saved to {file}") for note in first.notes)
    last = first.record["theta"][-1]
    found = theta(file)
    np.testing.assert_allclose([*found.values()][:2], last[:2], rtol=1e-12)
    assert abs(found["x1"]) > 0.1
    second = run(file, controller, duration=0.1)
    assert any(f"begins with what is in {file}" in note for note in second.notes)
    np.testing.assert_allclose(second.record["theta"][0][:2], last[:2], rtol=1e-12)
    assert controller.estimate.theta == dict.fromkeys(found, 0.0)
    assert [each.name for each in tmp_path.iterdir()] == ["servo.qllm"]


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.skipif(not hasattr(signal, "SIGUSR1"), reason="there is no SIGUSR1 here")
def test_it_is_saved_on_command_while_the_loop_runs(tmp_path: Path) -> None:
    """By a method from another thread, and by a signal; each time the file is whole."""
    kept, sizes = MemoryFile(tmp_path / "servo.qllm"), []
    before = signal.getsignal(signal.SIGUSR1)

    def ask(change: Any) -> None:
        if change.mode is Mode.RUN:
            os.kill(os.getpid(), signal.SIGUSR1)
        sizes.append(kept.saved)

    done = run(kept, duration=0.3, on_change=ask)
    assert done.completed
    assert kept.saved == 2
    assert len(theta(kept.path)) == 3
    assert signal.getsignal(signal.SIGUSR1) == before
    assert sizes[0] == 0


@pytest.mark.trial
@pytest.mark.compiled
def test_after_a_fault_the_file_is_as_before(tmp_path: Path) -> None:
    """What was learned may have contributed to it; a note says NOT."""
    file = tmp_path / "servo.qllm"
    run(file)
    before = file.read_bytes()
    ended = run(file, safety=Safety(settle=5, most_error=1e-3))
    assert not ended.completed
    assert file.read_bytes() == before
    assert any("NOT saved at the end" in note and "most_error" in note for note in ended.notes)


@pytest.mark.parametrize("damage", ["cut", "other", "text"])
def test_a_file_that_does_not_fit_ends_the_run_before_anything_moves(
    tmp_path: Path, damage: str
) -> None:
    """It would be replaced at the end; the message names the file and says what to do."""
    file, device = tmp_path / "servo.qllm", TwinDevice(PLANT, DT)
    image = learning().memory()
    other = learning(learner=ql.learners.Kalman(u=True)).memory()
    content = {"cut": image[:-3], "other": other, "text": b"theta = 1\n" * 10}[damage]
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"memory = .*servo\.qllm.*nothing has moved"):
        run_rig(device, learning(), WAVE, duration=1.0, memory=file)
    assert file.read_bytes() == content


def test_a_file_that_can_not_be_written_is_refused_at_the_start(tmp_path: Path) -> None:
    """In a folder that does not exist, before anything moves; and what is no path."""
    with pytest.raises(ValueError, match="the folder .* must exist"):
        run(tmp_path / "none" / "servo.qllm")
    with pytest.raises(ValueError, match=r"memory = 3: must be the path"):
        run(3)


@pytest.mark.trial
@pytest.mark.compiled
def test_the_command_keeps_what_was_learned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """``quell run-rig --memory``, with a twin; a second run begins with the file."""
    monkeypatch.chdir(tmp_path)
    for found in ("does not exist yet", "begins with what is in"):
        command = "run-rig --device twin:torsional --seconds 0.2 --priority 0 --memory axis.qllm"
        shown = in_this_process((*command.split(), "--no-figures"), monkeypatch, capsys)
        assert "memory: saved to axis.qllm" in shown.out
        assert found in shown.out
    assert (tmp_path / "axis.qllm").stat().st_size > 500
