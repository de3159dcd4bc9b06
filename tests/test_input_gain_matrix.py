"""B0 of coupled axes from records: true within the stated deviations, or said to be unknown."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.identification import (
    identify_b0,
    identify_b0_matrix,
    interleaved_excitations,
    save_excitations,
)
from quell.identification.gain_matrix import _balanced, _excitation

from .benchmark_module import benchmark
from .cases import cases
from .commands import Shown

pytestmark = pytest.mark.compiled

DT = 0.01
B0 = np.array([[40.0, 12.0], [-20.0, 300.0]])


def record(samples: int = 700, noise: float = 1e-6) -> tuple[Any, Any]:
    """Return u and y of two axes of order 1 that friction couples, too, each excited by itself."""
    designs = interleaved_excitations(2, (1.0, 25.0), samples * DT, DT)
    u = np.column_stack([design.u for design in designs])
    friction = np.array([[2.0, -0.1], [-0.5, 4.0]])
    exact = benchmark("input_gain_matrix").expm(
        DT * np.block([[-friction, B0], [np.zeros((2, 4))]])
    )
    y = np.zeros((samples, 2))
    for k in range(samples - 1):
        y[k + 1] = exact[:2, :2] @ y[k] + exact[:2, 2:] @ u[k]
    return u, y + noise * np.random.default_rng(3).standard_normal(y.shape)


@pytest.mark.trial
def test_the_matrix_is_right_in_a_loop_with_friction_that_couples() -> None:
    """A gantry under PD control with a wrong inertia: that the axes brake each other is no error."""
    rng = np.random.default_rng(2)
    mass = np.array([2e-4, 0.5])
    true = np.array([[1.0, 0.4], [-0.3, 1.0]]) / mass
    friction = np.array([[2.0, 0.7], [0.9, 3.0]])
    designs = interleaved_excitations(2, (10.0, 100.0), 0.7, 1e-3)
    excitation = np.column_stack([design.u for design in designs]) * mass
    loop = {"omega": 20.0, "step": 1e-9, "load": 1e-3, "walk": False}
    u, y = benchmark("input_gain_matrix").linear_record(
        rng, true, friction, excitation, 1e-3, **loop
    )
    found = identify_b0_matrix(u, y, 1e-3, order=2)
    scale = np.max(np.abs(true), axis=0)
    assert np.max(np.abs(found.B0 - true) / scale) < 1e-3
    assert not found.is_poor
    assert np.all(found.condition < 5.0)


@pytest.mark.trial
def test_a_single_axis_is_that_of_the_other_function() -> None:
    """With one u and one y the entry, lag and delay are those of ``identify_b0``; the deviation is enlarged by the other u, which is not given."""
    u, y = record(400)
    u, y = u[:, 0], y[:, 0]
    one, matrix = identify_b0(u, y, DT, 1), identify_b0_matrix(u[:, None], y[:, None], DT, 1)
    assert matrix.B0[0, 0] == pytest.approx(one.b0, rel=1e-9)
    assert matrix.std[0, 0] == pytest.approx(matrix.enlarged[0] * one.b0_std, rel=1e-9)
    assert matrix.enlarged[0] > 1.0
    assert "the deviations are enlarged by" in str(matrix)
    assert matrix.total_delay[0] == pytest.approx(one.total_delay, rel=1e-9, abs=1e-12)


@pytest.mark.trial
def test_the_result_is_the_matrix_of_axes_and_its_intervals_hold_the_truth() -> None:
    """``ql.Axes(…, B0=found.B0)``; the report has all entries, JSON all numbers."""
    u, y = record(noise=1e-3)
    found = identify_b0_matrix(u, y, DT, [1, 1], axes=["x", "y"], actuators=["left", "right"])
    assert np.all(np.abs(found.B0 - B0) < 4.0 * found.std)
    assert np.all(found.std < 0.05 * np.max(np.abs(B0), axis=1, keepdims=True))
    assert found.shortcomings == ()
    for text in ("B0 of x: left 40", "right 300", "condition number of the excitation 1."):
        assert text in str(found)
    assert (
        found.to_json()["intervals_95"][0][0][0] < 40.0 < found.to_json()["intervals_95"][0][0][1]
    )
    observers = [ql.ESO.model_free(order=1, b0=1.0, omega_o=20.0, dt=DT) for _ in range(2)]
    axes = ql.Axes([ql.ADRC(each, 4.0) for each in observers], B0=found.B0)
    assert axes.step([1.0, 0.0], [0.0, 0.0]).shape == (2,)


def test_actuators_that_moved_together_are_named() -> None:
    """With the condition number, and what to do; the third one, which moved alone, is not."""
    rng = np.random.default_rng(1)
    samples = 500
    u = np.repeat(rng.standard_normal((samples // 5, 3)), 5, axis=0)
    u[:, 1] = 2.0 * u[:, 0]
    y = np.zeros((samples, 1))
    for k in range(samples - 1):
        y[k + 1] = 0.99 * y[k] + DT * (u[k] @ [3.0, 1.0, 2.0])
    y += 1e-3 * rng.standard_normal(y.shape)
    found = identify_b0_matrix(u, y, DT, 1, actuators=["a", "b", "c"])
    (first, *_) = found.shortcomings
    assert first.startswith("axis axis1: a and b moved together (condition number")
    assert "excite each actuator at frequencies of its own" in first
    assert found.poor.tolist() == [[True, True, False]]
    assert found.may_be_singular
    assert found.enlarged[0] == 1.0  # the noise is white
    assert "as the error is not white" not in str(found)
    coloured = replace(found, enlarged=np.array([1.5]))
    assert "; deviations enlarged by 1.5, as the error is not white" in coloured.describe_rest()


@pytest.mark.trial
def test_an_actuator_that_is_not_recorded_leaves_no_entry_known() -> None:
    """The other actuator's entries, too, are not known: what moved the axes is not in the record."""
    u, y = record(300)
    u[:, 1] = 1e-9 * np.random.default_rng(8).standard_normal(len(u))
    found = identify_b0_matrix(u, y, DT, 1)
    assert "u2" in found.unseen
    assert np.all(found.poor)
    (first, *_) = found.shortcomings
    assert "u2 recorded, in the right column, as applied?" in first


@pytest.mark.trial
def test_an_actuator_that_moves_one_axis_only_is_recorded() -> None:
    """Its entry of the other axis is zero within its deviation, and known."""
    u, y = record(500, noise=1e-3)
    y[:, 0] = 0.0
    for k in range(len(u) - 1):
        y[k + 1, 0] = 0.98 * y[k, 0] + 0.4 * u[k, 0]
    y[:, 0] += 1e-3 * np.random.default_rng(4).standard_normal(len(y))
    found = identify_b0_matrix(u, y, DT, 1)
    assert abs(found.B0[0, 1]) < 4.0 * found.std[0, 1]
    assert found.unseen == ()
    assert not found.is_poor


@cases("actuators", range(2, 7))
def test_never_a_single_actuator_moved_together(actuators: int) -> None:
    """At least two are named, of covariances of u that hardly can be told apart, in any units."""
    rng = np.random.default_rng(actuators)
    names = [f"u{j}" for j in range(actuators)]
    for _ in range(50):
        u = rng.standard_normal((40, actuators)) * 10.0 ** rng.uniform(-6, 6, actuators)
        first = int(rng.integers(actuators))
        u[:, first] = np.delete(u, first, axis=1) @ rng.standard_normal(actuators - 1)
        u *= 1.0 + 1e-3 * rng.standard_normal(u.shape)
        size = np.linalg.norm(u, axis=0)
        inverse = np.linalg.inv((u / size).T @ (u / size))
        condition, together = _excitation(inverse / np.outer(size, size), names)
        assert (condition > 30.0) == (len(together) > 0)
        assert len(together) != 1


@pytest.mark.trial
def test_a_lag_that_is_not_known_is_not_a_matter_of_the_actuators() -> None:
    """A machine of order 2 that is taken for order 1: the gains and the lag are not told apart, the actuators are."""
    u, _ = record(300)
    y = np.zeros(u.shape)
    speed = np.zeros(2)
    for k in range(len(u) - 1):
        speed = speed + DT * B0 @ u[k]
        y[k + 1] = y[k] + DT * speed
    y += 1e-6 * np.random.default_rng(5).standard_normal(y.shape)
    found = identify_b0_matrix(u, y, DT, 1)
    assert np.all(found.condition < 5.0)
    assert "moved together" not in str(found)


@pytest.mark.trial
@pytest.mark.parametrize("machine", ["gantry", "arm", "craft"])
def test_the_intervals_hold_the_truth(machine: str) -> None:
    """A draw of benchmarks/input_gain_matrix.py: a gantry, an arm under gravity, a craft."""
    drawn = benchmark("input_gain_matrix").MACHINES[machine](np.random.default_rng([77, 3]))
    found = identify_b0_matrix(drawn.u, drawn.y, drawn.dt, 2)
    told = [any(f"axis {name}:" in each for each in found.shortcomings) for name in found.axes]
    wrong = np.abs(found.B0 - drawn.B0) / found.std
    assert np.all(wrong[~np.array(told)] < 4.0)


def test_interleaved_excitations_have_no_line_in_common() -> None:
    """They use the range of each actuator, and over the record they are uncorrelated."""
    designs = interleaved_excitations(
        3, (1.0, 40.0), 20.0, DT, u_min=[-1.0, -2.0, 0.0], u_max=[1.0, 2.0, 5.0]
    )
    period = round(designs[0].period / DT)
    spectra = [np.abs(np.fft.rfft(each.u[:period] - np.mean(each.u[:period]))) for each in designs]
    excited = [spectrum > 1e-3 * np.max(spectrum) for spectrum in spectra]
    assert not np.any(np.sum(excited, axis=0) > 1)
    assert [float(np.max(each.u)) for each in designs] == pytest.approx([1.0, 2.0, 5.0])
    assert float(np.min(designs[2].u)) == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(ValueError, match="must have one for each of 3 actuators"):
        interleaved_excitations(3, (1.0, 1.4), 10.0, DT)


@cases(
    ("change", "message"),
    [
        ({"u": np.zeros(700)}, r"u has the shape \(700,\): must have a row for each sample"),
        ({"y": np.zeros((600, 2))}, "u has 700 samples, y 600"),
        ({"order": [1, 2, 3]}, "order has 3 numbers: must have one, or 2"),
        ({"order": 5}, "order"),
        ({"axes": ["x"]}, r"axes = \['x'\]: must be 2 different names"),
        ({"u": np.zeros((700, 2))}, "u1 is 0 all through: must move"),
        ({"u": np.full((700, 2), np.nan)}, r"u\[0, 0\] = .*nan.*: must be finite"),
        ({"u": np.ones((20, 2)), "y": np.ones((20, 2))}, "must have at least"),
    ],
)
def test_a_wrong_argument_is_named(change: dict[str, Any], message: str) -> None:
    """Each error names the argument, its value and the rule."""
    u, y = record()
    arguments: dict[str, Any] = {"u": u, "y": y, "dt": DT, "order": 1} | change
    with pytest.raises(ValueError, match=message):
        identify_b0_matrix(**arguments)


@pytest.mark.trial
def test_the_command_reads_a_table_of_several_axes(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """``quell excite --actuators 2``, ``quell b0 --axes --actuators``; errors say what to give."""
    shown = quell("excite", "u.csv", "--actuators", "2", "--duration", "5", "--dt", "0.01")
    assert shown.code == 0, shown.err
    assert (tmp_path / "u.csv").read_text().startswith("t,u1,u2\n0,")
    u, y = record(400, 1e-4)
    rows = np.column_stack([DT * np.arange(400), y, u])
    names = "time,x,y,left,right"
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header=names, comments="")
    base = ("b0", "log.csv", "--axes", "x,y", "--actuators", "left,right")
    of_time = ("--columns", "time")
    shown = quell(*base, *of_time, "--order", "1", "--json", "out.json")
    assert shown.code == 0, shown.err
    assert "B0 = [[" in shown.out
    told = json.loads((tmp_path / "out.json").read_text())
    np.testing.assert_allclose(told["B0"], B0, rtol=0.05)
    assert told["actuators"] == ["left", "right"]
    for more, message in (
        (("--order", "1", *of_time, "--ratio", "5"), "--ratio: is for one axis"),
        (of_time, "order: missing"),
        (("--order", "1", "--columns", "time,x"), "must be the column of times only"),
        (("--order", "1", "--dt", "0.01", *of_time), "there are no times"),
    ):
        refused = quell(*base, *more)
        assert refused.code == 2
        assert message in refused.err
    refused = quell("b0", "log.csv", "--axes", "x,x", "--actuators", "left", "--order", "1")
    assert "x is there twice" in refused.err
    refused = quell("b0", "log.csv", "--axes", "x,y", "--order", "1")
    assert "actuators: missing; give the column of the u of each actuator" in refused.err


@pytest.mark.trial
def test_a_saved_run_of_axes_is_read(tmp_path: Path) -> None:
    """With the names of its axes and all of its u."""
    from quell.commissioning import measured_axes

    observers = [ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=DT) for _ in range(2)]
    axes = ql.Axes({"x": ql.ADRC(observers[0], 4.0), "y": ql.ADRC(observers[1], 4.0)})
    A = np.array([[0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0]])
    plant = ql.plants.LinearPlant(A, [[0, 0], [1, 0], [0, 0], [0, 1]], [[1, 0, 0, 0], [0, 0, 1, 0]])
    run = ql.simulate(plant, axes, ql.Scenario(reference=(1.0, 0.5), duration=1.0))
    run.save(tmp_path / "run.nc")
    found = measured_axes(tmp_path / "run.nc", ["y", "x"])
    assert (found.axes, found.actuators, found.dt) == (("y", "x"), ("u1", "u2"), DT)
    np.testing.assert_array_equal(found.u, run["u"])
    np.testing.assert_array_equal(found.y, run["y_measured"][:, ::-1])
    with pytest.raises(ValueError, match="have no effect on a saved run"):
        measured_axes(tmp_path / "run.nc", ["x"], ["u1"])


def test_designs_are_written_whole_or_not_at_all(tmp_path: Path) -> None:
    """A file that exists is refused."""
    designs = interleaved_excitations(2, (1.0, 40.0), 5.0, DT)
    save_excitations(designs, tmp_path / "u.csv")
    table = np.loadtxt(tmp_path / "u.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table[:, 1:], np.column_stack([d.u for d in designs]), atol=1e-8)
    with pytest.raises(ValueError, match=r"u\.csv"):
        save_excitations(designs, tmp_path / "u.csv")


def test_rows_and_columns_of_a_balanced_matrix_have_the_largest_size_1() -> None:
    """In whatever units axes and actuators are; the signs stay."""
    values = np.array([[1.0, -0.5], [0.25, 1.0], [0.1, -1.0]])
    scaled = values * np.array([[1e3], [2e-4], [7.0]]) * np.array([[5.0, 1e-6]])
    found = _balanced(np.abs(scaled), scaled)
    assert np.max(np.abs(found), axis=0) == pytest.approx(1.0)
    assert np.max(np.abs(found), axis=1) == pytest.approx(1.0)
    np.testing.assert_array_equal(np.sign(found), np.sign(values))
