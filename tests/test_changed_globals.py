"""What a user's function takes from outside may change, in a notebook for example: compiled code never keeps old values."""

from __future__ import annotations

import math
import pickle
import types
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from numba.extending import register_jitable

import quell as ql
from quell.kernels import user_functions
from quell.plants.base import advance, measure, measure_all
from quell.plants.nonlinear import derivatives

pytestmark = pytest.mark.compiled

GAIN = 1.0
ARMS = np.array([0.3, 0.2])
PAIR = (1.0, np.array([2.0, 4.0]))
settings: Any = types.ModuleType("settings")
settings.inner = types.ModuleType("settings.inner")
settings.inner.scale = 1.0


@pytest.fixture(autouse=True)
def first_values(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the globals the same values before each test."""
    monkeypatch.setitem(globals(), "GAIN", 1.0)
    monkeypatch.setitem(globals(), "PAIR", (1.0, np.array([2.0, 4.0])))
    ARMS[:] = 0.3, 0.2
    settings.inner.scale = 1.0


@numba.njit
def innermost(value: float) -> float:
    """Return a number with a global."""
    return GAIN * value


@numba.njit
def helper(value: float) -> float:
    """Return a number by another helper."""
    return innermost(value) + 1.0


def of_a_number(value: float) -> float:
    """Return a number with a global."""
    return GAIN * value


def of_an_array(value: float) -> float:
    """Return a number with an entry of a global array."""
    return ARMS[0] * value


def of_a_tuple(value: float) -> float:
    """Return a number with an entry of an array in a global tuple."""
    return PAIR[1][1] * value


def of_a_module(value: float) -> float:
    """Return a number with a constant of a module in a module."""
    return settings.inner.scale * value


def of_a_helper(value: float) -> float:
    """Return a number by helpers that Numba compiles."""
    return helper(value)


def nothing() -> None:
    """Change nothing."""


def set_array() -> None:
    """Change an entry of the array, which stays the same object."""
    ARMS[0] = 7.0


def set_tuple() -> None:
    """Change an entry of the array in the tuple."""
    PAIR[1][1] = 7.0


def set_number() -> None:
    """Bind the global to another number."""
    globals()["GAIN"] = 7.0


def set_module() -> None:
    """Change the module's constant."""
    settings.inner.scale = 7.0


CHANGES = [
    (of_a_number, set_number),
    (of_an_array, set_array),
    (of_a_tuple, set_tuple),
    (of_a_module, set_module),
    (of_a_helper, set_number),
]


def joint() -> ql.ADRC:
    """Return the controller of an axis."""
    return ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3), omega_c=8.0)


def gain_of(B0: Callable[..., Any]) -> Any:
    """Return the compiled B0 of two axes for some estimates, and what it was at first."""
    gain = ql.Axes([joint(), joint()], B0=B0)._gain
    fresh = np.zeros((2, 2))
    x = np.array([[0.4, -0.3], [0.2, 0.9]])
    user_functions.call(gain.design.address, x, gain.design.numbers, fresh)
    return x, fresh, gain.first


def as_gain(name: str) -> Callable[..., Any]:
    """Return B0 as a function that takes the same from outside as a function of this file."""
    made: dict[str, Callable[..., Any]] = {
        "of_a_number": lambda x: ((2.0, GAIN * x[1, 0]), (0.0, GAIN)),
        "of_an_array": lambda x: ((2.0, ARMS[0] * x[1, 0]), (0.0, ARMS[0])),
        "of_a_tuple": lambda x: ((2.0, PAIR[1][1] * x[1, 0]), (0.0, PAIR[1][1])),
        "of_a_module": lambda x: (
            (2.0, settings.inner.scale * x[1, 0]),
            (0.0, settings.inner.scale),
        ),
        "of_a_helper": lambda x: ((2.0, helper(x[1, 0])), (0.0, helper(1.0))),
    }
    return made[name]


@pytest.mark.trial
@pytest.mark.parametrize(("function", "change"), CHANGES)
def test_b0_follows_what_its_function_takes_from_outside(
    function: Callable[..., Any], change: Callable[[], None]
) -> None:
    """The same function, axes made before and after a change: compiled code has the numbers that Python has."""
    B0 = as_gain(function.__name__)
    for step in (nothing, change):
        step()
        x, found, first = gain_of(B0)
        np.testing.assert_array_equal(found, B0(x))
        np.testing.assert_array_equal(first, B0(np.zeros((2, 2))))
    assert found[0, 1] in (7.0 * 0.2, 7.0 * 0.2 + 1.0)


@pytest.mark.trial
def test_b0_follows_a_variable_of_the_enclosing_function() -> None:
    """Changed by nonlocal, while the function stays the same object."""
    scale = 1.0

    def own_gain(x: Any) -> Any:
        return (2.0, scale * x[1, 0]), (0.0, scale)

    assert gain_of(own_gain)[1][0, 1] == 0.2
    scale = 7.0
    assert gain_of(own_gain)[1][0, 1] == 7.0 * 0.2


@pytest.mark.trial
def test_b0_follows_its_defaults_and_its_instructions() -> None:
    """Tools that load a changed file again exchange both in the function that is there."""

    def own_gain(x: Any, scale: float = 1.0) -> Any:
        return (2.0, scale * x[1, 0]), (0.0, scale)

    def other(x: Any, scale: float = 1.0) -> Any:
        return (3.0, scale * x[1, 0]), (0.0, scale)

    bound = partial(own_gain)
    assert gain_of(bound)[1][0].tolist() == [2.0, 0.2]
    own_gain.__defaults__ = (7.0,)
    assert gain_of(bound)[1][0].tolist() == [2.0, 7.0 * 0.2]
    own_gain.__code__ = other.__code__
    assert gain_of(bound)[1][0].tolist() == [3.0, 7.0 * 0.2]


@pytest.mark.trial
def test_twenty_axes_of_one_function_compile_once(compiled_functions: list[Any]) -> None:
    """As long as nothing changes, and for other numbers that are bound by name."""
    helper(1.0)  # compiled by its user, for other globals than now

    def own_gain(x: Any, inertia: float) -> Any:
        return (inertia * GAIN, ARMS[0] * x[1, 0]), (0.0, helper(1.0))

    for inertia in np.linspace(1.0, 2.0, 20):
        gain_of(partial(own_gain, inertia=inertia))
    assert len(compiled_functions) == 1
    set_array()
    gain_of(partial(own_gain, inertia=1.0))
    assert len(compiled_functions) == 2


@pytest.mark.trial
@pytest.mark.parametrize(
    ("function", "change", "offset", "several", "parametric"),
    [
        (of_a_helper, set_number, 1.0, False, False),
        (of_an_array, set_array, 0.0, False, True),
        (of_a_helper, set_number, 1.0, True, True),
    ],
)
def test_plants_follow_what_their_equation_takes_from_outside(
    function: Callable[..., Any], change: Callable[[], None], offset: float,
    several: bool, parametric: bool,
) -> None:  # fmt: skip
    """Also one that was compiled before: each of its runs has the numbers of its time, compiled as in Python."""
    own = numba.njit(function)  # a helper whose own globals change

    def f(t, x, u, w, mass=2.0):  # type: ignore[no-untyped-def]
        return own(x[0]) / mass, x[0]

    def h(x):  # type: ignore[no-untyped-def]
        return own(x[1])

    def h_of_several(x):  # type: ignore[no-untyped-def]
        return own(x[1]), x[0]

    numbers: dict[str, Any] = {"parameters": {"mass": 4.0}} if parametric else {}
    make: Any = (
        partial(ql.plants.NonlinearPlant, f, 2, h_of_several, **numbers)
        if several
        else partial(ql.plants.NonlinearPlant, f, 2, h, **numbers)
    )
    mass = 4.0 if parametric else 2.0
    early = make()
    before = early.sampled(0.01)
    x = np.array([0.4, 0.2])
    u: Any = np.zeros(1) if several else 0.0

    def values(model: Any) -> list[float]:
        dx, y = np.zeros(2), np.zeros(2)
        derivatives(model, 0.0, x, u, np.zeros(1), dx)
        if several:
            measure_all(model, x, y)
        else:
            y[0] = measure(model, x)
        return [dx[0], y[0]]

    first = values(before)
    change()
    expected = [(7.0 * 0.4 + offset) / mass, 7.0 * 0.2 + offset]
    assert first != expected
    for plant in (early, make()):
        for interpret in (False, True):
            assert values(plant.sampled(0.01, interpret)) == expected, interpret
    assert values(before) == first  # a run that has begun goes on with its numbers


def test_features_follow_what_their_function_takes_from_outside() -> None:
    """A learner made after the change learns with the new function."""
    features = ql.features.Custom(lambda x, u: (GAIN * x[0], math.sin(u)), names=("a", "b"))
    out = np.zeros(2)
    found = []
    for step in (nothing, set_number):
        step()
        user_functions.call(features.design(2).address, np.array([0.5, 0.0]), 0.0, out)
        found.append(out[0])
    assert found == [0.5, 3.5]


@pytest.mark.trial
def test_a_helper_that_numba_can_not_compile_again_is_not_used_with_old_numbers() -> None:
    """A plant goes on as Python and says so; B0 is refused, with what to do."""

    @register_jitable
    def jitable(value: float) -> float:
        return GAIN * value

    plant = ql.plants.NonlinearPlant(lambda t, x, u, w: (jitable(x[0]),), 1)
    B0 = lambda x: ((2.0, 0.0), (0.0, jitable(1.0)))  # noqa: E731
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert plant.compiled
        assert gain_of(B0)[1][1, 1] == 1.0
        set_number()
    with pytest.warns(UserWarning, match="runs as Python.*jitable has been compiled with other"):
        model = plant.sampled(0.01)
    dx = np.zeros(1)
    derivatives(model, 0.0, np.array([0.5]), 0.0, np.zeros(1), dx)
    assert dx[0] == 3.5
    with pytest.raises(ValueError, match=r"B0 can't be compiled \(jitable .*: define it again"):
        gain_of(B0)


@pytest.mark.trial
def test_exported_code_is_that_of_the_controller_or_there_is_none(tmp_path: Any) -> None:
    """C is made of the function as it is now: after a change that is not what the controller computes."""
    axes = ql.Axes([joint(), joint()], B0=lopsided)
    set_number()
    with pytest.raises(ValueError, match="lopsided: its globals .* have changed"):
        ql.export.c(axes, tmp_path / "old")
    assert not (tmp_path / "old").exists()
    ql.export.c(ql.Axes([joint(), joint()], B0=lopsided), tmp_path / "new")


def lopsided(x: Any) -> Any:
    """Return B0 of two axes with a global."""
    return (2.0, GAIN * x[1, 0]), (0.0, GAIN)


class Odd:
    """A function with a condition of equality, and therefore without hash."""

    def __eq__(self, other: object) -> bool:
        return True

    def __call__(self, *arguments: Any) -> Any:
        """Return numbers."""
        return ((1.0, 0.0), (0.0, 1.0)) if len(arguments) == 1 else (1.0, 2.0)


class OddRate(Odd):
    """The same as an equation."""

    def __call__(self, *arguments: Any) -> Any:
        """Return numbers."""
        return (-arguments[1][0],)


def test_callable_objects_are_refused_or_run_as_python_with_hash_or_without() -> None:
    """As other callables that Numba can't compile."""
    with pytest.raises(ValueError, match="B0 can't be compiled"):
        ql.Axes([joint(), joint()], B0=Odd())
    for plant in (
        ql.plants.NonlinearPlant(OddRate(), 1),
        ql.plants.NonlinearPlant(OddRate(), 1, parameters={}),
        ql.plants.NonlinearPlant(OddRate(), 1, [[1.0]]),
    ):
        with pytest.warns(UserWarning, match="runs as Python"):
            plant.sampled(0.01)
    with pytest.raises(ValueError, match="can't be compiled"):
        ql.features.Custom(Odd(), names=("a", "b")).design(2)


def rate(t, x, u, w):  # type: ignore[no-untyped-def]
    """Return an equation that can be sent to another process."""
    return (u - GAIN * x[0],)


@pytest.mark.trial
def test_a_plant_that_was_compiled_can_be_sent_to_another_process() -> None:
    """Without its code."""
    plant = ql.plants.NonlinearPlant(rate, 1)
    assert plant.compiled
    sent = pickle.loads(pickle.dumps(plant))
    assert sent.f is rate
    assert sent.compiled


class LagDesign(NamedTuple):
    """A plant of the user's: a lag of one second."""

    dt: float


class Lag:
    """The same, as ``simulate`` takes it."""

    name, order, disturbances, compiled = "lag", 1, 1, True

    def sampled(self, dt: float, interpret: bool = False) -> LagDesign:
        """Return the plant for a sample time."""
        return LagDesign(dt)


@measure.register(LagDesign)
def _measure_lag(plant: LagDesign, x: Any) -> float:
    return x[0]


@advance.register(LagDesign)
def _advance_lag(plant: LagDesign, x: Any, scratch: Any, t: float, u: float, w: Any) -> None:
    x[0] += plant.dt * (GAIN * u - x[0])


@pytest.mark.trial
def test_a_kernel_of_the_users_that_has_changed_is_not_run_with_old_numbers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Numba compiles it once for each type: a changed global is refused, a field works; Python runs what is there."""
    law = ql.baselines.PID(kp=2.0, ki=2.0, dt=0.01)
    short = ql.Scenario(1.0, 0.1)
    first = ql.simulate(Lag(), law, short)
    monkeypatch.setitem(globals(), "dt", 3.0)  # the name of a field only
    np.testing.assert_array_equal(ql.simulate(Lag(), law, short)["y"], first["y"])
    set_number()
    with pytest.raises(ValueError, match=r"advance \(for LagDesign\) has been compiled, and it or"):
        ql.simulate(Lag(), law, short)
    assert ql.simulate(Lag(), law, short, interpret=True)["y"][-1] > 3.0 * first["y"][-1]
