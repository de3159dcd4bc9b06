"""The ADRC that is equal to a PID controller."""

from __future__ import annotations

import copy
import math
import re
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import quell as ql
from quell.analysis.linearise import linear_law
from quell.controllers import PidEqual, equal_to_pid
from quell.setup import made as made_setup

from .cases import cases

# kp, ki, kd, tf and dt: a plain PI, PI with a filter, an oven at 1 Hz, PIDs of a servo of
# 2e-4 kg m² with a filter of the derivative, of the whole, and none.
PIDS: dict[str, tuple[float, float, float, Any, float]] = {
    "PI": (2.0, 1.0, 0.0, 0.0, 1e-2),
    "PI with a filter": (2.0, 1.0, 0.0, 0.1, 1e-2),
    "PI with a slow filter": (2.0, 1.0, 0.0, 0.9, 1e-2),
    "PI of negative gain": (-2.0, -1.0, 0.0, 0.1, 1e-2),
    "oven": (8.0, 0.02, 0.0, 10.0, 1.0),
    "oven without filter": (8.0, 0.02, 0.0, 0.0, 1.0),
    "servo": (1.2, 15.0, 0.03, 0.002, 1e-4),
    "servo, all filtered": (1.2, 15.0, 0.03, (0.002, 2e-6), 1e-4),
    "servo without filter": (1.2, 15.0, 0.03, 0.0, 1e-3),
}


@cache
def made(name: str, **options: Any) -> PidEqual:
    """Return the equal ADRC of an example."""
    kp, ki, kd, tf, dt = PIDS[name]
    return equal_to_pid(kp, ki, kd, tf=tf, dt=dt, **options)


@cache
def _adrc(name: str, **options: Any) -> ql.ADRC:
    """Make the controller of an example, whose search takes its time."""
    kp, ki, kd, tf, dt = PIDS[name]
    return ql.ADRC.from_pid(kp, ki, kd, tf=tf, dt=dt, **options)


def adrc(name: str, **options: Any) -> ql.ADRC:
    """Return the controller of an example, at rest; some sample slowly, as the PID does."""
    return copy.deepcopy(_adrc(name, **options))


def backward(kp: float, ki: float, kd: float, tf: Any, dt: float, y: Any) -> Any:
    """Return u for r = 0, sample by sample, as a program in a drive computes it."""
    integral = derivative = before = 0.0
    u = np.empty(y.size)
    if np.ndim(tf) == 0 and kd == 0.0:  # the whole through one lag
        filtered = 0.0
        for k, value in enumerate(y):
            filtered = (tf * filtered + dt * value) / (tf + dt)
            integral += ki * dt * filtered
            u[k] = -kp * filtered - integral
        return u
    if np.ndim(tf) == 0:  # the derivative alone
        for k, value in enumerate(y):
            integral += ki * dt * value
            derivative = (tf * derivative + kd * (value - before)) / (tf + dt)
            before = value
            u[k] = -kp * value - integral - derivative
        return u
    f1, f2 = tf
    x1 = x2 = 0.0  # the filtered y and the one before
    for k, value in enumerate(y):
        new = (value + (f1 / dt + 2.0 * f2 / dt**2) * x1 - f2 / dt**2 * x2) / (
            1.0 + f1 / dt + f2 / dt**2
        )
        x1, x2 = new, x1
        integral += ki * dt * x1
        u[k] = -kp * x1 - integral - kd * (x1 - x2) / dt
    return u


@pytest.mark.parametrize("name", PIDS)
def test_u_is_that_of_the_program_in_a_drive_sample_by_sample(name: str) -> None:
    """The difference equations of the PID, written out, and ``step``, for any y."""
    kp, ki, kd, tf, dt = PIDS[name]
    controller = adrc(name)
    y = np.cumsum(np.random.default_rng(2).normal(size=400))
    y[0] = 0.0  # both begin at rest
    u = np.array([controller.step(0.0, value) for value in y])
    expected = backward(kp, ki, kd, tf, dt, y)
    assert np.max(np.abs(u - expected)) < 1e-8 * np.max(np.abs(expected))


@pytest.mark.parametrize("name", PIDS)
def test_the_response_is_that_of_the_controller(name: str) -> None:
    """Of its linear law, which is measured from ``step``."""
    found, law = made(name), linear_law(adrc(name))
    dt = PIDS[name][4]
    omega = np.geomspace(1e-3, 0.99, 12) * math.pi / dt
    A, one = law.A + np.outer(law.B_u, law.C), np.eye(law.C.size)
    B = law.B_y + law.B_u * law.D_y
    z = np.exp(1j * omega * dt)
    expected = np.array([-law.D_y - law.C @ np.linalg.solve(each * one - A, B) for each in z])
    assert np.allclose(found.response(omega), expected, rtol=1e-7)
    assert np.all(found.difference(omega, "backward") < 1e-7)


@pytest.mark.trial
@given(
    kp=st.floats(1e-3, 1e3),
    times=st.tuples(st.floats(1.5, 1e4), st.floats(0.0, 0.5), st.floats(0.0, 0.5)),
    kind=st.sampled_from(["PI", "PID", "filtered PID"]),
    dt=st.floats(1e-5, 1e3),
    sign=st.sampled_from([-1.0, 1.0]),
)
@settings(max_examples=15, deadline=None)
def test_any_pid_is_equal_or_refused(
    kp: float, times: tuple[float, float, float], kind: str, dt: float, sign: float
) -> None:
    """T_i from 1.5 to 10 000 samples, T_d and the filter's time as shares of it; any unit."""
    Ti = times[0] * dt
    Td, tf = times[1] * Ti, times[2] * Ti
    assume(kind == "PI" or Td > 1e-3 * Ti)
    kd = 0.0 if kind == "PI" else kp * Td
    filtered: Any = (tf, 0.5 * tf**2) if kind == "filtered PID" else tf
    found, why = None, ""
    try:
        found = equal_to_pid(sign * kp, sign * kp / Ti, sign * kd, tf=filtered, dt=dt)
    except ValueError as error:
        why = str(error)
    if found is None:
        assert "no ADRC is equal to this PID" in why
        return
    omega = np.geomspace(1e-4 / Ti, 0.99 * math.pi / dt, 40)
    assert np.max(found.difference(omega, "backward")) < 1e-6
    assert found.b0 * sign > 0.0
    assert found.omega_c <= found.omega_o * (1.0 + 1e-9)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("ratio", [3.0, 8.0])
def test_the_way_there_and_back_is_where_it_began(order: int, ratio: float) -> None:
    """From bandwidths to the PID in continuous time and back, but for the sampling, O(dt)."""
    for dt, near in ((1e-3, 0.1), (1e-5, 1e-3)):
        observer = ql.ESO.model_free(order=order, b0=3.0, omega_o=4.0 * ratio, dt=dt)
        pid = ql.baselines.equivalent_pid(ql.ADRC(observer, omega_c=4.0))
        tf = pid.filter[0] if order == 1 else pid.filter
        found = equal_to_pid(pid.kp, pid.ki, pid.kd, tf=tf, dt=dt)
        # A spread of the poles in one place is the root of that of the polynomial.
        assert (found.b0, found.omega_c, found.omega_o) == pytest.approx(
            (3.0, 4.0, 4.0 * ratio), rel=near
        )
        if order == 1:
            assert found.in_one_place


@pytest.mark.parametrize(("x", "in_one_place"), [(9.5, True), (8.0, False), (2.5, False)])
def test_a_pi_controller_has_bandwidths_alone_from_a_ratio_of_nine_on(
    x: float, in_one_place: bool
) -> None:
    """T_i/t_f ≥ 9; below, the observer's poles are complex."""
    found = equal_to_pid(2.0, 1.0, tf=2.0 / x, dt=1e-4)
    assert found.in_one_place is in_one_place
    assert np.max(found.difference(np.geomspace(0.01, 100.0, 50), "no")) < 0.02


@pytest.mark.trial
def test_no_adrc_is_equal_where_the_filter_is_slower_than_the_integral_time() -> None:
    """It is refused, with a filter that is possible: one with that is made, one above is not."""
    with pytest.raises(ValueError, match="no ADRC is equal") as refused:
        equal_to_pid(2.0, 1.0, tf=2.5, dt=1e-3)
    possible = float(re.findall(r"tf = ([\d.]+) s on", str(refused.value))[0])
    assert equal_to_pid(2.0, 1.0, tf=0.99 * possible, dt=1e-3).b0 > 0.0
    with pytest.raises(ValueError, match="no ADRC is equal"):
        equal_to_pid(2.0, 1.0, tf=1.01 * possible, dt=1e-3)


@pytest.mark.parametrize("name", ["PI with a filter", "oven", "servo", "servo, all filtered"])
@pytest.mark.parametrize("factor", [0.9, 1.2])
def test_a_given_b0_is_taken_and_its_poles_are_those_of_its_loop(name: str, factor: float) -> None:
    """The loop around the chain with this b0 has the poles of law and observer, and no others."""
    b0 = factor * made(name).b0
    found, controller = made(name, b0=b0), adrc(name, b0=b0)
    assert found.b0 == b0
    order = found.observer.order
    chain = ql.plants.LinearPlant.of(([b0], [1.0, *order * [0.0]]))
    loop = ql.analysis.analyse(chain, controller)
    s_poles = loop.s_poles[np.isfinite(loop.s_poles)]  # that at z = 0 is the reduced form's
    places = np.abs(np.expm1(s_poles * controller.dt))
    k = controller.parameters.law[:order][::-1]
    if order == 1:  # sampled, its pole is at 1 − k dt; of order 2 the product of two is in k
        assert np.min(np.abs(places / (k[0] * controller.dt) - 1.0)) < 1e-6
    for each in found.observer.poles or (-1.0,):
        pole = found.omega_o * (complex(*each) if isinstance(each, tuple) else complex(each))
        assert np.min(np.abs(places / abs(np.expm1(pole * controller.dt)) - 1.0)) < 1e-4


def test_a_b0_without_a_stable_loop_is_refused_with_one_that_has_one() -> None:
    """A PID is stable around a double integrator from a least gain on."""
    with pytest.raises(ValueError, match=r"b0 = 5\.0: the loop .* is not stable") as refused:
        made("servo", b0=5.0)
    possible = float(re.findall(r"b0 = ([\d.e+]+) is possible", str(refused.value))[0])
    assert made("servo", b0=possible).b0 == possible


MOTOR = ([50.0], [1.0, 22.0, 40.0])  # speed of a DC motor with an inductance
OVEN = ([0.8 / 600.0], [1.0, 1.0 / 600.0])  # 600 s, 0.8 K/W
SERVO = ([1.0 / 2e-4], [1.0, 0.5, 0.0])  # an inertia of 2e-4 kg m² with friction
PLANTS: dict[str, tuple[Any, str, float, float]] = {
    "DC motor": (MOTOR, "PI with a filter", 20.0, 1.0),
    "oven at 1 Hz": (OVEN, "oven", 4000.0, 10.0),
    "servo": (SERVO, "servo", 0.5, 0.02),
    "servo, all filtered": (SERVO, "servo, all filtered", 0.5, 0.02),
}


@pytest.mark.trial
@pytest.mark.parametrize("plant", PLANTS)
def test_in_a_loop_y_differs_from_that_of_the_pid_by_no_more_than_the_bound(plant: str) -> None:
    """The PID is that of ``baselines``, sampled by Tustin's rule; the load steps and swings."""
    model, name, duration, load = PLANTS[plant]
    kp, ki, kd, tf, dt = PIDS[name]
    found = made(name)
    if np.ndim(tf) == 0:  # as one polynomial over a filter of the whole
        gains = (kp + ki * tf, ki, kd + kp * tf) if kd else (kp, ki, 0.0)
        lags = (tf, 0.0)
    else:
        gains, lags = (kp, ki, kd), tf
    pid = ql.baselines.PID(*gains, tf=lags, dt=dt)
    loads = (
        ql.signals.Step(load, at=0.1 * duration),
        ql.signals.Sinusoid(load, 2.0 * found.omega_c),
    )
    scenario = ql.Scenario(0.0, duration, (loads[0] + loads[1],))
    with np.errstate(all="ignore"):
        runs = [
            ql.simulate(ql.plants.LinearPlant.of(model), each, scenario)["y"]
            for each in (adrc(name), pid)
        ]
    bound = found.bound(model)
    apart = ql.metrics.rms(runs[0] - runs[1]) / ql.metrics.rms(runs[1])
    assert 0.02 * bound < apart <= bound < 0.1


@pytest.mark.trial
def test_the_bound_holds_for_the_worst_load_nearly() -> None:
    """A sinusoid at the worst frequency comes near to it: the bound is not a loose one."""
    model, name, _, _ = PLANTS["DC motor"]
    found = made(name)
    omega = np.geomspace(0.1, 100.0, 200)
    s = 1j * omega
    P = 50.0 / (s**2 + 22.0 * s + 40.0)
    C, other = found.response(omega), found.pid_response(omega, "tustin")
    worst = omega[np.argmax(np.abs(P * (C - other) / (1.0 + P * C)))]
    kp, ki, _, tf, dt = PIDS[name]
    pid = ql.baselines.PID(kp, ki, tf=(tf, 0.0), dt=dt)
    scenario = ql.Scenario(0.0, 60.0, (ql.signals.Sinusoid(1.0, float(worst)),))
    plant = ql.plants.LinearPlant.of(model)
    runs = [ql.simulate(plant, each, scenario)["y"][3000:] for each in (adrc(name), pid)]
    apart = ql.metrics.rms(runs[0] - runs[1]) / ql.metrics.rms(runs[1])
    assert 0.9 * found.bound(model) < apart <= found.bound(model)


def test_the_controller_keeps_limits_learner_and_guard() -> None:
    """They are options, and the report is of the same numbers."""
    controller = adrc(
        "servo, all filtered", u_min=-2.0, u_max=2.0, learner=ql.learners.Kalman(), guard=ql.Guard()
    )
    assert controller.limits.high == 2.0
    assert isinstance(controller.learner, ql.learners.Kalman)
    assert controller.observer.b0 == made("servo, all filtered").b0
    assert abs(controller.step(1.0, 0.0)) <= 2.0


def test_the_report_says_what_is_equal_what_is_not_and_what_comes_next() -> None:
    """And the jump of u for a step of the reference is that of the controller."""
    found = made("servo")
    text = found.describe()
    assert f"b0 = {found.b0:.5g}" in text
    jump = float(re.findall(r"u jumps by ([\d.e+-]+) per unit", text)[0])
    assert jump == pytest.approx(adrc("servo").step(1.0, 0.0), rel=1e-3)
    assert text.count("NOT equal") == 2
    assert "quell b0" in text
    assert "ESO.model_free(2" in made("servo", b0=found.b0).describe()


@cases(
    ("gains", "options", "message"),
    [
        ((2.0, 0.0), {}, "ki = 0.0: must not be zero, an ADRC integrates"),
        ((2.0, -1.0), {}, "must have one sign"),
        ((2.0, 1.0, -0.1), {}, "must have one sign"),
        ((2.0, 1.0), {"b0": -1.0}, "must have the sign of ki"),
        ((2.0, 1.0), {"tf": -1.0}, "tf = -1.0"),
        ((2.0, 1.0), {"tf": (0.1, 0.01)}, "give tf = 0.1"),
        ((2.0, 1.0, 0.1), {"tf": (0.0, 0.1)}, "must not be negative"),
        ((2.0, 1.0), {"half_gain": True}, "half_gain = True: the PID controller decides it"),
        ((2.0, 1.0), {"dt": 0.0}, "dt = 0.0"),
    ],
)
def test_bad_arguments_are_named(gains: tuple[float, ...], options: Any, message: str) -> None:
    """With their value and the rule."""
    with pytest.raises(ValueError, match=re.escape(message)):
        ql.ADRC.from_pid(*gains, **({"dt": 0.01} | options))


def test_a_setup_file_has_it_as_a_kind_of_controller() -> None:
    """``adrc-pid``, with a learner and limits; options that the PID decides are unknown there."""
    table = {"kind": "adrc-pid", "kp": 2.0, "ki": 1.0, "tf": 0.1, "u_max": 4.0}
    data = {"dt": 0.01, "controller": table, "learner": {"kind": "kalman"}}
    found = made_setup("pid.toml", data).controller
    equal = equal_to_pid(2.0, 1.0, tf=0.1, dt=0.01)
    assert isinstance(found, ql.ADRC)
    assert (found.observer.b0, found.omega_c) == (equal.b0, equal.omega_c)
    assert isinstance(found.learner, ql.learners.Kalman)
    assert found.limits.high == 4.0
    with pytest.raises(ValueError, match="half_gain: unknown"):
        made_setup("pid.toml", data | {"controller": table | {"half_gain": True}})
