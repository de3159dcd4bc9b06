"""Gains of axes: b0 of an axis, B0 of the actuators, and what is the same in both forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse, certify
from quell.kernels.dispatch import as_python

DT = 1e-3
SETTINGS = {"a": (1.7, 2, 8.0), "b": (-0.3, 1, 5.0)}  # b0, order, omega_c
PLANT = ql.plants.LinearPlant(
    [[0, 1, 0], [0, -0.5, 0], [0, 0, -2.0]], [[0, 0], [1.5, 0], [0, -0.2]], [[1, 0, 0], [0, 0, 1]]
)


def axis(name: str, b0: float | None = None, **parts: Any) -> ql.ADRC:
    """Return the controller of an axis, with its own b0 or another one."""
    own, order, omega_c = SETTINGS[name]
    observer = ql.ESO.model_free(order, own if b0 is None else b0, omega_o=40.0, dt=DT)
    return ql.ADRC(observer, omega_c, **parts)


def test_axes_with_gains_of_their_own_are_the_single_controllers() -> None:
    """Bit for bit, with limits: by default an actuator moves one axis, with its b0."""
    rng, found = np.random.default_rng(3), []
    axes = ql.Axes({name: axis(name) for name in SETTINGS}, u_min=-30.0, u_max=30.0)
    single = [axis(name, u_min=-30.0, u_max=30.0) for name in SETTINGS]
    with as_python():
        for _ in range(60):
            r, y = rng.normal(size=(2, 2))
            alone = [each.step(r[i], y[i]) for i, each in enumerate(single)]
            found.append(axes.step(r, y).tolist() == alone)
    assert all(found)
    assert axes.first_gain.tolist() == [[1.7, 0.0], [0.0, -0.3]]


@pytest.mark.parametrize("learner", [None, ql.learners.Kalman()], ids=["none", "Kalman"])
def test_one_axis_is_the_single_controller_whatever_its_gain_is(learner: Any) -> None:
    """The gain in B0 becomes b0 of the axis, with a learner and a guard as without."""
    guard = None if learner is None else ql.Guard()
    parts: dict[str, Any] = {"learner": learner, "guard": guard}
    single = axis("a", u_max=9.0, **parts)
    given = ql.Axes({"a": axis("a", 1.0, **parts)}, [[1.7]], u_max=9.0)
    inverse = ql.Axes({"a": axis("a", 1.0, **parts)}, M=[[1.0 / 1.7]], u_max=9.0)
    assert given.axes[0].observer.b0 == 1.7
    assert given.first_gain.tolist() == [[1.7]]
    assert inverse.axes[0].observer.b0 == pytest.approx(1.7, rel=1e-15)
    rng = np.random.default_rng(1)
    with as_python():
        for _ in range(40):
            r, y = rng.normal(size=2)
            assert given.step([r], [y])[0] == single.step(r, y)


def test_v_is_what_u_does_to_an_axis_in_both_forms() -> None:
    """In a record, and so are the estimates: only the input of the axis has another unit."""
    own = ql.Axes({name: axis(name) for name in SETTINGS})
    unit = ql.Axes({name: axis(name, 1.0) for name in SETTINGS}, np.diag([1.7, -0.3]))
    scenario = ql.Scenario((1.0, ql.signals.Sinusoid(0.5, 3.0)), 0.05)
    first, second = (ql.simulate(PLANT, each, scenario, interpret=True) for each in (own, unit))
    for name in ("v", "u", "a.f_residual", "b.x_hat"):
        np.testing.assert_allclose(first[name], second[name], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(first["v"], first["u"] * [1.7, -0.3], rtol=1e-12)


def test_margins_and_certificates_are_those_of_axes_with_unit_gains() -> None:
    """The loop is the same: a gain is in the axis or in B0."""
    guard = ql.Guard()
    parts = {"learner": ql.learners.Kalman(), "guard": guard}
    own = ql.Axes({name: axis(name, **parts) for name in SETTINGS})
    unit = ql.Axes({name: axis(name, 1.0, **parts) for name in SETTINGS}, np.diag([1.7, -0.3]))
    first, second = (analyse(PLANT, each) for each in (own, unit))
    for name in first.inputs:
        modulus = second.channel_margins(name).modulus
        assert first.channel_margins(name).modulus == pytest.approx(modulus, rel=1e-9)
    one, other = (certify(PLANT, each) for each in (own, unit))
    np.testing.assert_allclose(one.gains, other.gains, rtol=1e-6)


def test_a_controller_for_another_gain_asks_for_as_much_of_the_plant() -> None:
    """Limits, the feedforward of a model and the reach of a safe set are in units of u."""
    model = ql.controllers.Feedforward.rigid(0.7, viscous=0.1, coulomb=0.2)
    made = axis("a", feedforward=model, u_min=-4.0, u_max=9.0, rate_limit=(-200.0, 300.0))
    turned = made.with_b0(-5.1)
    assert turned.limits.low == pytest.approx(-3.0)
    assert turned.limits.high == pytest.approx(4.0 / 3.0)
    rng = np.random.default_rng(2)
    with as_python():
        for _ in range(40):
            r, y, rate, bent = rng.normal(size=4)
            u = made.step(r, y, rate, bent)
            assert turned.step(r, y, rate, bent) == pytest.approx(u / -3.0, rel=1e-9, abs=1e-12)
    safe = ql.SafeSet(y_max=1.0, f_rate=1.0, gain_error=0.1, largest_u=6.0)
    assert axis("a", safe_set=safe).with_b0(5.1).safe_set.largest_u == pytest.approx(2.0)
    with pytest.raises(ValueError, match=r"b0 = 0.0: must not be zero"):
        made.with_b0(0.0)


def test_a_running_axis_keeps_its_gain_when_it_is_retuned() -> None:
    """A new observer is given as the old one was, with b0 = 1 below a gain of one actuator."""
    axes = ql.Axes({"a": axis("a", 1.0)}, [[1.7]])
    axes.retune("a", observer=ql.ESO.model_free(2, 1.0, omega_o=50.0, dt=DT), omega_c=9.0)
    assert (axes.axes[0].observer.b0, axes.axes[0].observer.omega_o) == (1.7, 50.0)


def test_a_gain_stands_in_one_place() -> None:
    """A function of the estimates knows the gains of the actuators, so its axes have none."""
    with pytest.raises(ValueError, match=r"a has an observer with b0 = 1.7: must be 1 where M is"):
        ql.Axes({"a": axis("a")}, M=lambda x: ((1.0 + x[0, 0] ** 2,),))


@pytest.mark.trial
def test_bandwidths_are_tuned_alike_in_both_forms() -> None:
    """With bounds in units of v; the tuned axes keep their gains."""
    own = ql.Axes({name: axis(name) for name in SETTINGS})
    unit = ql.Axes({name: axis(name, 1.0) for name in SETTINGS}, np.diag([1.7, -0.3]))
    first, second = (ql.tune(PLANT, controller=each) for each in (own, unit))
    for one, other in zip(first.controller.axes, second.controller.axes, strict=True):
        assert one.omega_c == pytest.approx(other.omega_c, rel=1e-3)
        assert one.observer.omega_o == pytest.approx(other.observer.omega_o, rel=1e-3)
    assert [each.observer.b0 for each in first.controller.axes] == [1.7, -0.3]
