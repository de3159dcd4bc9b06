"""Several axes, and state feedback, in single precision: runs, steps, and the comparison."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers import in_single_precision
from quell.controllers.stateful import named_arrays
from quell.export import c_source
from quell.export.library.precision import _difference, compared
from quell.plants.multibody import rotor_levers

from . import gain_functions
from .test_axes_export import ROWS, SINGLE, SQUARE, WIDE, joint, plain
from .test_state_space import controller as feedback
from .test_state_space import drive

ROTORS = rotor_levers(0.17, 0.015) / np.array([[0.012], [0.012], [0.022]])


def plant(gain: Any) -> Any:
    """Return axes with springs and friction, which the others move, too."""
    n, m = np.shape(gain)
    A, B = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, m))
    A[:n, n:], A[n:, :n] = np.eye(n), 0.5 - 4.0 * np.eye(n)
    A[n:, n:], B[n:] = -0.2 * np.eye(n), 1.1 * np.asarray(gain)
    return ql.plants.LinearPlant(A, B, np.eye(2 * n)[:n])


def scenario(controller: Any, duration: float = 0.12, **parts: Any) -> ql.Scenario:
    """Return references that move, with noise and a start from rest in the middle."""
    count = controller.references
    moves = tuple(ql.signals.Sinusoid(0.3, 2.0 + i) for i in range(count))
    noise = ql.signals.BandLimitedNoise(1e-12, 1e-3)
    return ql.Scenario(moves, duration=duration, rest_at=(0.08,), noise=noise, **parts)


@pytest.mark.trial(cases="drives, direction|more actuators, least squares")
@pytest.mark.parametrize("name", SINGLE)
def test_axes_in_single_precision_do_what_they_do_in_double(name: str) -> None:
    """Their state and u are single throughout; ``precision`` of ``simulate`` is the same run."""
    axes = ROWS[name]()
    parts = plant(axes.first_gain), in_single_precision(axes), scenario(axes)
    run, double = ql.simulate(*parts), ql.simulate(parts[0], axes, parts[2])
    for each, array in named_arrays(run.final_state).items():
        assert array.dtype != np.float64, f"{each} is double"
    assert np.array_equal(run["u"], run["u"].astype(np.float32))
    assert run.status == double.status
    difference = run["u"] - double["u"]
    assert np.any(difference != 0.0)
    assert np.sqrt(np.mean(difference**2)) < 1e-3 * np.sqrt(np.mean(double["u"] ** 2))
    again = ql.simulate(parts[0], axes, parts[2], precision="single")
    np.testing.assert_array_equal(again.log, run.log)


def test_a_step_in_python_gives_the_u_of_the_run() -> None:
    """Bit by bit, with feedforward and learners; a copy and an image go on in the same way."""
    axes = ROWS["each, with rates"]()
    single = in_single_precision(axes)
    given = ql.Scenario((0.2, 0.3, -0.1), duration=0.03)
    run = ql.simulate(plant(axes.first_gain), single, given)
    flags = ql.Status.OK
    for k in range(len(run)):
        u = single.step(run["r"][k], run["y_measured"][k])
        np.testing.assert_array_equal(u, run["u"][k])
        flags |= single.status
    assert flags == run.status
    assert u.dtype == np.float64
    other = in_single_precision(axes)
    other.restore(single.memory(), running=True)
    signals = run["r"][-1], run["y_measured"][-1] + 1e-3
    twin = copy.copy(single)
    found = [each.step(*signals).tolist() for each in (single, other, twin)]
    assert found[0] == found[1] == found[2]
    assert single.estimates["elbow"].x.dtype == np.float32


def test_axes_in_single_precision_start_are_tracked_and_get_other_limits() -> None:
    """As those in double precision, to the digits of single."""
    axes = ROWS["priority"]()
    both = axes, in_single_precision(axes)
    zero, u = np.zeros(3), [0.5, -0.25, 1.0]
    found = []
    for each in both:
        each.start([0.1, 0.2, 0.3], u, [0.1, 0.2, 0.3])
        rows = [each.step([0.1, 0.2, 0.3], [0.1, 0.2, 0.3])]
        each.track(zero, [0.1, 0.2, 0.3], u)
        each.hand_over()
        rows.append(each.step(zero, [0.1, 0.2, 0.3]))
        each.set_limits(u_max=0.125)
        rows.append(each.step([1.0, 1.0, 1.0], [0.1, 0.2, 0.3]))
        each.applied(zero)
        rows.append(each.step([1.0, 1.0, 1.0], [0.1, 0.2, 0.3]))
        found.append(np.array(rows))
    np.testing.assert_allclose(found[1], found[0], rtol=2e-5, atol=2e-5)
    assert np.max(found[1][2:]) == 0.125
    with pytest.raises(ValueError, match="hand_over: there was no sample yet"):
        in_single_precision(axes).hand_over()


@pytest.mark.trial
def test_state_feedback_in_single_precision_does_what_it_does_in_double() -> None:
    """In a loop, with a start; it has no axes to track."""
    law = feedback(u_max=0.5)
    single = in_single_precision(law)
    given = ql.Scenario(0.3, duration=0.3)
    run, double = ql.simulate(drive(), single, given), ql.simulate(drive(), law, given)
    assert np.array_equal(run["u"], run["u"].astype(np.float32))
    assert 0.0 < np.max(np.abs(run["u"] - double["u"])) < 1e-3
    for each in (law, single):
        each.start([0.2, 0.2], [0.0], [0.2])
    assert single.step([0.2], [0.2, 0.2])[0] == pytest.approx(0.0, abs=1e-5)
    with pytest.raises(AttributeError, match="'StateFeedback' object has no attribute 'track'"):
        single.track([0.2], [0.2, 0.2], [0.0])


@pytest.mark.parametrize("saturation", ["each", ["wrist", "elbow", "shoulder"]])
@pytest.mark.parametrize("gain", [SQUARE, WIDE, ROTORS])
def test_u_at_the_limits_has_the_digits_of_single(gain: Any, saturation: Any) -> None:
    """With any number of actuators, from inside the limits to far outside."""
    axes = ql.Axes(plain(), gain, saturation=saturation, u_min=-1.0, u_max=2.0, rate_limit=1500.0)
    both, limited = (axes, in_single_precision(axes)), 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        signals = 0.2 * rng.standard_normal((2, 3)) * 10.0 ** rng.uniform(-1.0, 1.0)
        y, r = signals.astype(np.float32).astype(np.float64)
        found = []
        for each in both:
            each.reset()
            found += [each.step(r, y, np.zeros(3)), each.step(r, y, np.zeros(3))]
        limited += bool(axes.status & (ql.Status.SATURATED | ql.Status.RATE_LIMITED))
        np.testing.assert_allclose(found[2:], found[:2], rtol=0.0, atol=2e-5 * 3.0)
    assert limited > 20


def test_a_function_b0_is_refused_in_single_precision() -> None:
    """In a run as in C."""
    with pytest.raises(ValueError, match="B0 or M is a function"):
        in_single_precision(ql.Axes([joint(), joint()], gain_functions.nested_tuples))


@pytest.mark.trial
def test_the_code_of_axes_in_single_precision_is_that_of_the_axes_in_single() -> None:
    """``quell.export`` takes both, and what has no counterpart in another form is refused."""
    axes = ROWS["priority"]()
    single = in_single_precision(axes)
    assert c_source(single, "robot") == c_source(axes, "robot", precision="single")
    with pytest.raises(ValueError, match="several axes take y in its unit"):
        c_source(single, resolution=1e-3)


@pytest.mark.trial
def test_the_comparison_has_figures_of_each_axis_and_actuator(tmp_path: Path) -> None:
    """The largest decides; a few units of the last digit are written."""
    axes = ROWS["priority"]()
    given = plant(axes.first_gain), axes, scenario(axes, duration=0.2)
    found = compared(*given)
    names = ("shoulder", "elbow", "wrist")
    assert [each.name for each in found.each] == [
        *(f"u[{k}]" for k in range(3)),
        *(f"{signal}[{name}]" for signal in "vy" for name in names),
    ]
    assert found.u == max(each.single for each in found.each[:3])
    assert found.y == max(each.single for each in found.each[6:])
    for each in found.each:
        assert each.single is not None
        assert each.noise is not None
        assert 0.0 < each.single < min(1e-4, each.noise)
    done = ql.export.c(axes, tmp_path / "out", name="robot", precision="single",
                       plant=given[0], scenario=given[2])  # fmt: skip
    assert done.comparison == found


def test_an_axis_at_rest_is_not_compared() -> None:
    """Two motors move x, and the angle of the beam rests: its v and y are rounding in both runs.

    Noise of zero for each axis is none.
    """
    gain = [[0.02, 0.02], [0.05, -0.05]]
    axes = ql.Axes({"x": joint(), "beam": joint()}, gain, u_min=-300.0, u_max=300.0)
    given = ql.Scenario((ql.signals.Sinusoid(0.3, 3.0), 0.0), duration=0.3, noise=(0.0, 0.0))
    found = {each.name: each for each in compared(plant_of_two(gain), axes, given).each}
    assert [name for name, each in found.items() if each.single is None] == [
        "v[beam]",
        "y[beam]",
    ]
    assert all(each.noise is None for each in found.values())
    for name in ("u[0]", "u[1]", "v[x]", "y[x]"):
        assert found[name].single < 1e-4  # type: ignore[operator]


def test_an_actuator_at_its_limits_is_not_compared_and_the_others_are() -> None:
    """Two motors push one mass each: the one that is asked for too much is named, and counts not."""
    gain = [[1.0, 0.0], [0.0, 1.0]]
    pair = ql.Axes({"far": joint(), "near": joint()}, gain, u_min=-3.0, u_max=3.0)
    given = ql.Scenario((1e3, ql.signals.Sinusoid(0.01, 3.0)), duration=0.3)
    found = compared(plant_of_two(gain), pair, given)
    each = {one.name: one for one in found.each}
    assert each["u[0]"].single is None
    assert each["u[0]"].limited > 0.9
    assert "as u lies at its limits in" in each["u[0]"].reason
    assert found.limited == each["u[1]"].limited < 0.1
    assert found.u == each["u[1]"].single < 1e-4  # type: ignore[operator]
    found.check(pair)
    both = compared(plant_of_two(gain), pair, replace(given, reference=(1e3, -1e3)))
    assert all(one.single is None for one in both.each)
    with pytest.raises(ValueError, match="NOT compared with double, as u lies at its limits"):
        both.check(pair)


def plant_of_two(gain: Any) -> Any:
    """Return two masses with friction."""
    A = np.kron([[0.0, 1.0], [0.0, -0.2]], np.eye(2))
    return ql.plants.LinearPlant(
        A, np.vstack([np.zeros((2, 2)), 1.1 * np.asarray(gain)]), np.eye(4)[:2]
    )


def test_a_resting_signal_that_single_precision_moves_is_compared_with_the_largest() -> None:
    """It counts from ``LIMIT`` on; one that rests in both does not."""
    run = {"u": np.column_stack([np.ones(10), np.full(10, 1e-12)])}
    for moved, expected in ((1e-3, None), (0.05, 0.05)):
        other = {"u": run["u"] + np.array([0.0, moved])}
        found = _difference(_Run(run), _Run(other), "u", 1, 1.0)
        assert found == (None if expected is None else pytest.approx(expected))


class _Run(dict[str, Any]):
    """Channels, whose length is the number of samples."""

    def __len__(self) -> int:
        return 10


@pytest.mark.trial
@pytest.mark.parametrize(("precision", "parts", "message"), [
    ("double", ("plant", "scenario"), "are compared in single precision only"),
    ("single", ("plant",), "a comparison needs both"),
    ("single", ("scenario",), "a comparison needs both"),
])  # fmt: skip
def test_a_plant_or_scenario_without_effect_is_refused(
    tmp_path: Path, precision: str, parts: tuple[str, ...], message: str
) -> None:
    """Nothing is written, with ``accept``, too."""
    axes = ROWS["priority"]()
    given = {"plant": plant(axes.first_gain), "scenario": scenario(axes)}
    with pytest.raises(ValueError, match=message):
        ql.export.c(
            axes, tmp_path / "out", precision=precision, accept=True,
            **{name: given[name] for name in parts},
        )  # fmt: skip
    assert not (tmp_path / "out").exists()


@pytest.mark.trial
def test_single_precision_that_changes_u_of_one_actuator_too_much_is_refused(
    tmp_path: Path,
) -> None:
    """The message names the actuator, and the axis whose omega_o is too high; nothing is written."""
    fast = ql.ADRC(ql.ESO.model_free(order=4, b0=1.0, omega_o=300.0, dt=1e-3), 10.0)
    chain = np.diag(np.ones(5), 1)
    chain[1] = chain[5] = 0.0
    B = np.zeros((6, 2))
    B[1, 0] = B[5, 1] = 1.0
    machine = ql.plants.LinearPlant(chain, B, np.eye(6)[[0, 2]])
    axes = ql.Axes({"slow": joint(), "fast": fast})
    run = ql.Scenario(tuple(ql.signals.Sinusoid(1.0, 3.0) for _ in range(2)), duration=0.5)
    options: dict[str, Any] = {"precision": "single", "plant": machine, "scenario": run}
    with pytest.raises(ValueError, match=r"changes u\[1\] by .* a lower omega_o of fast"):
        ql.export.c(axes, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()
    done = ql.export.c(axes, tmp_path / "out", accept=True, **options)
    assert done.comparison is not None
    assert done.comparison.u > 0.01
    first = done.comparison.each[0].single
    assert first is not None
    assert first < 1e-3


@pytest.mark.compiled
@pytest.mark.trial
def test_compiled_axes_in_single_precision_differ_from_interpreted_ones_by_rounding() -> None:
    """Compiled code uses fused operations."""
    axes = ql.Axes([joint(), joint()], [[1.0, 0.3], [0.2, 2.0]], u_min=-20.0, u_max=20.0)
    given = plant(axes.first_gain), axes, scenario(axes, duration=0.2)
    compiled = ql.simulate(*given, precision="single")
    plain = ql.simulate(*given, precision="single", interpret=True)
    assert np.array_equal(compiled["u"], compiled["u"].astype(np.float32))
    np.testing.assert_allclose(compiled["u"], plain["u"], rtol=0.0, atol=1e-4)
