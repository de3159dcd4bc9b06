"""Calls with a misspelt keyword argument suggest the nearest name, and public names stay what they are."""

from __future__ import annotations

import importlib
import inspect
import pickle
import sys
import warnings
from collections.abc import Callable, Iterator
from enum import EnumMeta
from typing import Any

import pytest

import quell as ql
from quell.suggestions import suggesting
from quell.warn import warn

ROOMS = (
    "quell", "quell.analysis", "quell.commissioning", "quell.controllers",
    "quell.controllers.baselines", "quell.envs", "quell.export", "quell.features",
    "quell.identification", "quell.learners", "quell.observers", "quell.plants", "quell.realtime",
    "quell.setup", "quell.signals", "quell.simulation", "quell.sweeping", "quell.tuning",
    "quell.tuning.simulated",
)  # fmt: skip
# Kernels that users implement, called by position; a table with checks of its own; a function that
# counts the frames of its callers.
LEFT_OUT = {"infer", "learn", "Description", "warn_if_unwise"}
OLDER = pytest.mark.skipif(sys.version_info >= (3, 13), reason="Python suggests names itself")


def public() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Yield functions, classes and their methods of all rooms, with a label."""
    for room in ROOMS:
        module = importlib.import_module(room)
        for name in set(module.__all__) - LEFT_OUT:
            value = getattr(module, name)
            ours = getattr(value, "__module__", "").startswith("quell")
            if not (ours and callable(value)) or isinstance(value, EnumMeta):
                continue
            if isinstance(value, type) and issubclass(value, Exception):
                continue
            yield f"{room}.{name}", value
            for method in dir(value) if isinstance(value, type) else ():
                kept = getattr(value, method)
                if not method.startswith("_") and (inspect.ismethod(kept) or has_options(kept)):
                    yield f"{room}.{name}.{method}", kept


def has_options(value: Any) -> bool:
    """Whether a value is a function of quell with optional parameters."""
    ours = inspect.isfunction(value) and (value.__module__ or "").startswith("quell")
    return ours and any(
        p.default is not p.empty for p in inspect.signature(value).parameters.values()
    )


def misspelt(function: Callable[..., Any]) -> tuple[str, str] | None:
    """Return a parameter's name without its second letter, and the name; None if it takes none, or any."""
    parameters = inspect.signature(function).parameters.values()
    names = [p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    if not names or any(p.kind is p.VAR_KEYWORD for p in parameters):
        return None
    name = max(names, key=len)
    return (name[:1] + name[2:] if len(name) > 2 else 2 * name), name


def test_every_public_name_suggests_the_nearest_parameter() -> None:
    """Functions, classes, class methods and methods with optional parameters alike."""
    silent, asked = [], 0
    for label, function in public():
        if (names := misspelt(function)) is None or names[0] in inspect.signature(
            function
        ).parameters:
            continue
        asked += 1
        with pytest.raises(TypeError) as caught:
            function(**{names[0]: 1})
        if f"Did you mean '{names[1]}'?" not in str(caught.value):
            silent.append(f"{label}: {caught.value}")
    assert silent == []
    assert asked > 150


def test_options_that_are_passed_on_are_suggested_too() -> None:
    """The class that takes them suggests them."""
    with pytest.raises(TypeError, match="Did you mean 'u_max'?"):
        ql.baselines.NotchPID(ql.baselines.Notch(1.0, 0.1, 1.0), 1.0, dt=0.1, umax=1.0)
    with pytest.raises(TypeError, match="Did you mean 'u_max'?"):
        ql.baselines.LQG(ql.plants.two_mass_spring(), 1.0, 4.0, 0.01, umax=1.0)


def test_a_name_that_is_like_no_other_and_an_error_inside_of_a_call_stay_as_they_are() -> None:
    """Only the call itself is judged."""
    with pytest.raises(TypeError) as caught:
        ql.Scenario(zzz=1)  # type: ignore[call-arg]
    assert "Did you mean" not in str(caught.value)

    def inside(reference: float = 0.0) -> None:
        inside(referense=1.0)  # type: ignore[call-arg]

    with pytest.raises(TypeError) as caught:
        suggesting(inside, __name__)()
    assert ("Did you mean" in str(caught.value)) == (sys.version_info >= (3, 13))


def test_public_names_have_their_signatures_docstrings_and_pickles() -> None:
    """And kernels are not wrapped; a name in two rooms is one object."""
    for label, value in public():
        if inspect.ismethod(value):
            continue
        assert pickle.loads(pickle.dumps(value)) is value, label
        assert value.__doc__ is not None
        assert value.__name__ == label.rpartition(".")[2] or isinstance(value, type), label
        assert "kwargs" not in str(inspect.signature(value)) if misspelt(value) else True, label
    assert ql.observers.canonical is ql.canonical
    assert not hasattr(ql.learners.infer, "__wrapped__") or ql.learners.infer.implementations
    assert not hasattr(ql.ADRC.step, "__wrapped__")


@OLDER
def test_wrapping_twice_changes_nothing() -> None:
    """Neither a function nor a class."""
    init = ql.ESO.__init__
    assert suggesting(suggesting(ql.ESO, "quell"), "quell").__init__ is init
    assert suggesting(ql.simulate, "quell") is ql.simulate


def test_a_warning_points_to_the_line_that_called_quell() -> None:
    """However many frames of quell, and wrappers, are between."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=140.0, dt=0.01)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ql.ADRC(observer, omega_c=10.0)
        ql.simulate((1.0, [1.0, 1.0]), ql.baselines.PID(1.0, dt=0.1), ql.Scenario(duration=0.15))
        warn("here")
    assert {one.filename for one in caught} == {__file__}
    assert len({one.lineno for one in caught}) == 3
