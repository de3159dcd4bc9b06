"""A part that a controller does not have adds no call to its sample, and no file to a reader's way."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import quell as ql
from quell.kernels import dispatch

ROOT = Path(ql.__file__).parent
DT = 1e-3
# Files of each part, and options of a controller that has it.
PARTS: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = {
    "learner": (("learners", "features"), {"learner": ql.learners.Kalman()}),
    "guard": (("guard",), {"learner": ql.learners.RLS(), "guard": ql.Guard()}),
    "schedule": (
        ("controllers/schedule",),
        {"schedule": ql.Schedule([0.0, 1.0], "y", b0=[1.0, 2.0])},
    ),
    "online gain": (("controllers/online_gain",), {"schedule": ql.OnlineGain(0.5, 2.0)}),
    "safe set": (
        ("controllers/safe_set",),
        {"safe_set": ql.SafeSet(-1.0, 1.0, alpha=8.0, f_rate=1.0), "u_min": -9.0, "u_max": 9.0},
    ),
    "held": (("controllers/held",), {"held": ql.HeldPlant(0.01)}),
}


def followed(run: Callable[[], Any]) -> list[tuple[str, str]]:
    """Return file and function of each call while a function runs."""
    found: list[tuple[str, str]] = []

    def follow(frame: FrameType, event: str, _: Any) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(ROOT):
            found.append((path.relative_to(ROOT).as_posix(), frame.f_code.co_qualname))

    sys.setprofile(follow)
    try:
        run()
    finally:
        sys.setprofile(None)
    return found


def calls(**options: Any) -> list[tuple[str, str]]:
    """Return file and function of each call in a sample with the interpreted kernels."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=DT)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dispatch, "interpret_all", True)
        controller = ql.ADRC(observer, omega_c=2.0, **options)
        for _ in range(5):
            controller.step(1.0, 0.0)
        return followed(lambda: controller.step(1.0, 0.01))


def in_files(found: list[tuple[str, str]], of: tuple[str, ...]) -> list[tuple[str, str]]:
    """Return the calls into files whose path begins with one of some texts.

    ``resolution`` of a sensor is no part of a learner, though it stands beside those.
    """
    return [each for each in found if each[0].startswith(of) and each[1] != "resolution"]


@pytest.mark.parametrize("has", [None, *PARTS])
def test_a_part_that_is_absent_is_not_called(has: str | None) -> None:
    """And one that is there is."""
    found = calls(**({} if has is None else PARTS[has][1]))
    known = PARTS[has][1].keys() if has else set()
    for name, (files, options) in PARTS.items():
        if name == has:
            assert in_files(found, files), name
        elif not options.keys() & known:
            assert not in_files(found, files), name


@pytest.mark.parametrize(
    ("options", "most", "files"),
    [
        ({}, 20, 6),
        ({"learner": ql.learners.Kalman(), "guard": ql.Guard()}, 88, 10),
    ],
)
def test_a_sample_is_short_to_follow(options: dict[str, Any], most: int, files: int) -> None:
    """The calls of a plain controller, and of one with learner and guard, and the files on their way, without the helpers of ``kernels``."""
    found = [path for path, _ in calls(**options) if not path.startswith("kernels/")]
    assert len(found) <= most
    assert len(set(found)) <= files


def test_a_plain_sample_has_forty_calls_at_most_with_all_helpers() -> None:
    """Writing numbers of the state and finding the kernel of an observer count, too."""
    assert len(calls()) <= 40


def test_axes_without_bands_learners_of_all_and_controls_do_not_call_them() -> None:
    """Nor prefilters, a moving B0 and drives: a sample of axes runs its axes, allocates, and tells them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dispatch, "interpret_all", True)
        axes = ql.Axes([ql.ADRC(ql.ESO.model_free(2, 1.0, 20.0, DT), 2.0) for _ in range(2)])
        axes.step([1.0, 0.0], [0.0, 0.0])
        found = followed(lambda: axes.step([1.0, 0.0], [0.01, 0.0]))
    files = ("axes_learning", "safe_axes", "shaped_references", "safe_set", "schedule", "held")
    assert not in_files(found, tuple(f"controllers/{each}" for each in files))
    names = {name for _, name in found}
    assert not names & {"_take_controls", "tell_given", "_tell_given", "_by_function", "_constant"}
