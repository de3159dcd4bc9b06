"""Starting under load, manual operation, retuning while running, increments, derivatives of the reference."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers import Prefiltered, ReferenceModel, in_single_precision
from quell.controllers.base import control
from quell.controllers.bumpless import samples_to_settle
from quell.controllers.law import unlimited_control
from quell.observers.eso import ESO
from quell.observers.forms import expected_measurement
from quell.plants.base import advance, measure

from .cases import cases
from .python_step import interpreted

DT = 0.01
OBSERVER = ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=DT)
PLANT = ql.plants.LinearPlant([[0.0, 1.0], [-1.0, -0.6]], [0.0, 2.0], [1.0, 0.0])
LOAD = -3.0  # enters as u does


def zero_at(zero: float) -> tuple[list[list[float]], list[float]]:
    """Return A and B of a plant with y = x_1 and this zero from u."""
    return [[0.0, 1.0], [-1.0, -0.6]], [1.0, -0.6 - zero]


class Rig:
    """A plant under a constant load, sample by sample."""

    def __init__(self, x: tuple[float, float] = (0.0, 0.0)) -> None:
        self.model, self.x, self.scratch = PLANT.sampled(DT), np.array(x), np.zeros(12)

    @property
    def y(self) -> float:
        """The measurement."""
        return measure(self.model, self.x)

    def apply(self, u: float) -> None:
        """Hold ``u`` for a sample."""
        advance(self.model, self.x, self.scratch, 0.0, u, np.array([LOAD]))


def test_a_start_under_load_makes_no_bump() -> None:
    """At rest at y with the u that holds it: u stays what it is, to rounding; a cold start drops the load by far."""
    y, u = 0.5, 0.5 / 2.0 - LOAD  # -y + 2 (u + load) = 0
    worst = {}
    for name in ("start", "cold"):
        rig, controller = Rig((y, 0.0)), ql.ADRC(OBSERVER, omega_c=3.0)
        if name == "start":
            controller.start(y, u)
        moved = 0.0
        for _ in range(300):
            rig.apply(controller.step(y, rig.y))
            moved = max(moved, abs(rig.y - y))
        worst[name] = moved
    assert worst["start"] < 1e-12
    assert worst["cold"] > 0.1


def test_a_start_takes_forty_time_constants_of_the_slowest_part_of_the_observer() -> None:
    """Of its lag or of its slowest pole, whichever is longer, and no more than some seconds."""
    assert samples_to_settle(OBSERVER) == round(40.0 * (3 / 20.0) / DT) + 3
    nonlinear = ESO.nonlinear(2, 2.0, 20.0, DT, delta=0.1, delay=0.02)
    assert samples_to_settle(nonlinear) == round(40.0 * (3 / 20.0) / DT) + 5
    for zero, wanted in ((-0.05, 40.0 / 0.05 / DT), (-1e-9, 1e8)):
        plant = ([3.0, -3.0 * zero], np.poly([-1.0, -0.3, -0.5]))
        slow = ESO.model_based(plant, 20.0, DT, keep_zeros=True)
        assert samples_to_settle(slow) == pytest.approx(wanted + 4, rel=1e-4)


def test_a_start_towards_another_reference_goes_on_from_u() -> None:
    """The first u is the old one to first order in dt, and the move still arrives."""
    rig, controller = Rig((0.5, 0.0)), ql.ADRC(OBSERVER, omega_c=3.0)
    controller.start(0.5, 3.25, r=1.0)
    first = controller.step(1.0, rig.y)
    assert first == pytest.approx(3.25, abs=0.1)
    cold = ql.ADRC(OBSERVER, omega_c=3.0)
    assert abs(cold.step(1.0, rig.y) - 3.25) > 0.9
    rig.apply(first)
    for _ in range(600):
        rig.apply(controller.step(1.0, rig.y))
    assert rig.y == pytest.approx(1.0, abs=1e-3)


@pytest.mark.trial
def test_a_start_keeps_what_was_learned_and_still_makes_no_bump() -> None:
    """The learner's share of f and the observer's add up to what holds u."""
    rig, controller = Rig(), ql.ADRC(OBSERVER, omega_c=3.0, learner=ql.learners.Kalman())
    for k in range(3000):
        rig.apply(controller.step(math.sin(0.01 * k), rig.y))
    learned = controller.estimate.theta
    rig = Rig((0.5, 0.0))
    controller.start(0.5, 3.25)
    assert controller.estimate.theta["x1"] == pytest.approx(learned["x1"], rel=1e-6)
    assert abs(controller.estimate.f_learned) > 0.1
    for _ in range(100):
        rig.apply(controller.step(0.5, rig.y))
        assert rig.y == pytest.approx(0.5, abs=2e-3)


def test_manual_operation_and_back_makes_no_bump() -> None:
    """While somebody else applies u the observer follows; the controller goes on from the last manual u, and arrives."""
    rig, controller = Rig(), ql.ADRC(OBSERVER, omega_c=3.0, u_min=-20.0, u_max=20.0)
    wished = 0.0
    for k in range(500):
        u = 3.0 + 0.4 * math.sin(0.02 * k)
        wished = controller.track(1.0, rig.y, u)
        assert controller.estimate.u == u
        rig.apply(u)
    assert controller.estimate.f == pytest.approx(
        2.0 * LOAD - controller.estimate.x[0] - 0.6 * controller.estimate.x[1], abs=0.05
    )
    bumpy = copy.deepcopy(controller)
    jump = abs(bumpy.step(1.0, rig.y) - u)
    assert jump > 1.0
    assert wished == pytest.approx(bumpy.estimate.u, abs=0.2)
    controller.hand_over()
    first = controller.step(1.0, rig.y)
    assert abs(first - u) < 0.1 * jump
    rig.apply(first)
    for _ in range(600):
        rig.apply(controller.step(1.0, rig.y))
    assert rig.y == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("learner", [None, ql.learners.Kalman()])
def test_retuning_while_running_makes_no_bump(learner: object) -> None:
    """In the middle of a move: u goes on, where a controller with the new gains from the same state would jump; the move arrives."""
    rig, controller = Rig(), ql.ADRC(OBSERVER, omega_c=2.0, learner=learner)
    for k in range(460):
        u = controller.step(math.sin(0.02 * k) if k < 400 else 1.0, rig.y)
        rig.apply(u)
    before = controller.estimate.u
    rough = copy.deepcopy(controller)
    rough.retune(omega_c=6.0)
    rough.state = controller.state  # as it was: nothing that fades
    jump = abs(rough.step(1.0, rig.y) - before)
    assert jump > 1.0
    controller.retune(omega_c=6.0, observer=ESO.model_free(order=2, b0=2.0, omega_o=60.0, dt=DT))
    first = controller.step(1.0, rig.y)
    assert abs(first - before) < 0.1 * jump
    assert controller.omega_c == 6.0
    rig.apply(first)
    for _ in range(400):
        rig.apply(controller.step(1.0, rig.y))
    assert rig.y == pytest.approx(1.0, abs=1e-3)


def test_retuning_again_before_the_next_sample_makes_no_bump_either() -> None:
    """Each change adds its part to the offset, whether the one before has faded or not."""
    controller = ql.ADRC(OBSERVER, omega_c=2.0)
    for k in range(60):
        u = control(controller.parameters, controller._state, 1.0, 0.01 * k)
    unchanged = copy.deepcopy(controller)
    for omega_c in (4.0, 9.0):
        controller.retune(omega_c=omega_c)
    loop = controller._state.loop[0]
    wished = unlimited_control(controller.parameters, controller._state, 0.0, 0.0)
    assert wished + loop.offset == pytest.approx(u, rel=1e-12)
    first = control(controller.parameters, controller._state, 1.0, 0.6)
    expected = control(unchanged.parameters, unchanged._state, 1.0, 0.6)
    assert abs(wished - u) > 5.0
    assert first == pytest.approx(expected, abs=0.1 * abs(wished - u))


def test_another_nominal_gain_counts_the_u_that_acts() -> None:
    """With a delay f changes by (b0 − b0') times the u that reaches the plant now, not the newest."""
    observer = ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=DT, delay=0.03)
    controller = ql.ADRC(observer, omega_c=3.0)
    for k in range(40):
        control(controller.parameters, controller._state, 1.0, math.sin(0.1 * k))
    state, before = controller._state, controller.estimate.f
    acting = float(state.z[-1])
    assert abs(acting - state.loop[0].u) > 0.5
    controller.retune(observer=ESO.model_free(2, 1.2, 20.0, DT, delay=0.03))
    assert controller.estimate.f - before == pytest.approx((2.0 - 1.2) * acting, rel=1e-12)
    assert state.z[2] == pytest.approx(state.estimates[2], rel=1e-12)


def test_a_start_counts_what_a_learner_says_of_u() -> None:
    """F_L = h + s u at once, and the observer has only the rest to find; u continues."""
    controller = ql.ADRC(OBSERVER, omega_c=3.0, learner=ql.learners.Kalman(u=True))
    controller._state.learner.theta[:] = -2.0, 0.5, 1.5, 0.25  # x1, x2, bias, u over b0
    y, u = 0.5, 3.25
    controller.start(y, u)
    loop = controller._state.loop[0]
    f_learned = -2.0 / 3.0**0 * y + 1.5 + 0.25 * 2.0 * u
    assert loop.f_learned == pytest.approx(f_learned, rel=1e-12)
    assert (loop.constant, loop.slope) == pytest.approx((-2.0 * y + 1.5, 0.5), rel=1e-12)
    np.testing.assert_allclose(controller.estimate.x, [y, 0.0], atol=1e-9)
    assert controller.estimate.f == pytest.approx(-2.0 * u, abs=1e-9)
    assert control(controller.parameters, controller._state, y, y) == pytest.approx(u, abs=1e-9)


def test_another_nominal_gain_changes_nothing_at_rest() -> None:
    """F is by definition what b0 u leaves: with b0 the estimate changes, u does not."""
    rig, controller = Rig((0.5, 0.0)), ql.ADRC(OBSERVER, omega_c=3.0)
    controller.start(0.5, 3.25)
    for b0 in (1.0, 3.0, 2.0):
        controller.retune(observer=ESO.model_free(order=2, b0=b0, omega_o=20.0, dt=DT))
        for _ in range(50):
            rig.apply(controller.step(0.5, rig.y))
            assert rig.y == pytest.approx(0.5, abs=1e-11)
        assert controller.estimate.f == pytest.approx(-b0 * 3.25, abs=1e-9)


def test_a_model_that_comes_later_changes_nothing_at_rest() -> None:
    """From model-free to model-based and back: part of f becomes the model's."""
    rig, controller = Rig((0.5, 0.0)), ql.ADRC(OBSERVER, omega_c=3.0)
    controller.start(0.5, 3.25)
    for observer, f in (
        (ESO.model_based(PLANT, omega_o=20.0, dt=DT), 2.0 * LOAD),
        (OBSERVER, 2.0 * LOAD - 0.5),
    ):
        controller.retune(observer=observer)
        for _ in range(50):
            rig.apply(controller.step(0.5, rig.y))
            assert rig.y == pytest.approx(0.5, abs=1e-11)
        assert controller.estimate.f == pytest.approx(f, abs=1e-9)


@pytest.mark.trial
@pytest.mark.parametrize(
    "compiled", [pytest.param(True, marks=pytest.mark.compiled), False], ids=["compiled", "Python"]
)
@pytest.mark.parametrize("disturbed", ["not", "by new limits", "by a restored state"])
def test_a_prepared_retuning_does_what_retune_does(compiled: bool, disturbed: str) -> None:
    """To rounding, to a design and back, also after what makes the packed parameters useless."""
    del compiled  # the mark decides
    learner = ql.learners.Kalman()
    other = ESO.model_free(order=2, b0=2.0, omega_o=60.0, dt=DT)
    controllers = [ql.ADRC(OBSERVER, omega_c=2.0, learner=learner) for _ in range(2)]
    one, another = controllers
    there = one.prepare_retune(omega_c=6.0, observer=other)
    back = one.prepare_retune(omega_c=2.0, observer=OBSERVER)
    assert one.omega_c == 2.0
    us = []
    for controller in controllers:
        rig, found = Rig(), []
        for k in range(200):
            if k == 60 and disturbed == "by new limits":
                controller.set_limits(u_min=-9.0, u_max=9.0)
            if k == 60 and disturbed == "by a restored state":
                controller.state = controller.state
            if k == 80:
                if controller is one:
                    there()
                else:
                    another.retune(omega_c=6.0, observer=other)
                assert (controller.omega_c, controller.observer) == (6.0, other)
            if k == 120:
                if controller is one:
                    back()
                else:
                    another.retune(omega_c=2.0, observer=OBSERVER)
            found.append(controller.step(math.sin(0.05 * k), rig.y))
            rig.apply(found[-1])
        us.append(found)
    assert us[0] == pytest.approx(us[1], rel=1e-9)
    assert len(set(us[0])) > 100


def _wrapped(kind: str) -> Any:
    """Return a wrapper around an ADRC, or a compensator."""
    law = ql.ADRC(OBSERVER, omega_c=2.0, u_min=-9.0, u_max=9.0)
    behind = Prefiltered(law, ReferenceModel(8.0))
    pid = ql.baselines.PID(kp=4.0, ki=2.0, kd=2.0, tf=0.05, dt=DT, u_min=-9.0, u_max=9.0)
    kinds: dict[str, Callable[[], Any]] = {
        "prefiltered": lambda: behind,
        "compensated": lambda: ql.Compensated(pid, ql.Compensator(OBSERVER)),
        "single": lambda: in_single_precision(law),
        "prefiltered in single": lambda: in_single_precision(behind),
        "compensated in single": lambda: in_single_precision(
            ql.Compensated(pid, ql.Compensator(OBSERVER))
        ),
    }
    return kinds[kind]()


WRAPPED = (
    "prefiltered",
    "compensated",
    "single",
    "prefiltered in single",
    "compensated in single",
)


@pytest.mark.parametrize("kind", WRAPPED)
@pytest.mark.parametrize("new_limits", [False, True])
def test_a_wrapper_prepares_a_retuning_too(kind: str, new_limits: bool) -> None:
    """It does what ``retune`` does, there and back; what it shows of itself is that of the design."""
    other = ESO.model_free(order=2, b0=2.0, omega_o=60.0, dt=DT)
    both: dict[str, Any] = {"there": {"observer": other}, "back": {"observer": OBSERVER}}
    if not kind.startswith("compensated"):
        both["there"]["omega_c"], both["back"]["omega_c"] = 6.0, 2.0
    one, another = _wrapped(kind), _wrapped(kind)
    prepared = {name: one.prepare_retune(**given) for name, given in both.items()}
    us = []
    for controller in (one, another):
        rig, found = Rig(), []
        for k in range(240):
            if k == 60 and new_limits:
                controller.set_limits(u_min=-7.0, u_max=7.0)
            for at, name in ((80, "there"), (120, "back"), (160, "there")):
                if k == at and controller is one:
                    prepared[name]()
                elif k == at:
                    another.retune(**both[name])
            found.append(controller.step(math.sin(0.05 * k), rig.y))
            rig.apply(found[-1])
        us.append(found)
        assert float(controller._adrc.observer.omega_o) == 60.0
        assert controller.limits.high == (7.0 if new_limits else 9.0)
    assert us[0] == us[1]
    assert len(set(us[0])) > 100


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.parametrize("kind", ["prefiltered", "compensated in single"])
def test_a_prepared_retuning_of_a_wrapper_is_compiled(kind: str) -> None:
    """The call is the compiled change, and gives what ``retune`` gives to rounding."""
    other = ESO.model_free(order=2, b0=2.0, omega_o=60.0, dt=DT)
    one, another = _wrapped(kind), _wrapped(kind)
    there = one.prepare_retune(observer=other)
    before = one._packed
    us = []
    for controller in (one, another):
        rig, found = Rig(), []
        for k in range(200):
            if k == 80 and controller is one:
                there()
                assert one._packed is not before
                assert one._packed is not None
            elif k == 80:
                another.retune(observer=other)
            found.append(controller.step(math.sin(0.05 * k), rig.y))
            rig.apply(found[-1])
        us.append(found)
    assert us[0] == pytest.approx(us[1], rel=1e-5 if "single" in kind else 1e-9, abs=1e-6)


def test_a_prepared_retuning_is_refused_as_retune_is() -> None:
    """When it is prepared; nothing has changed then."""
    controller = ql.ADRC(OBSERVER, omega_c=2.0, learner=ql.learners.Kalman())
    other = ESO.model_free(order=2, b0=3.0, omega_o=20.0, dt=DT)
    with pytest.raises(ValueError, match=r"what was learned refers to that"):
        controller.prepare_retune(observer=other)
    with pytest.raises(ValueError, match=r"omega_c = -1.0"):
        controller.prepare_retune(omega_c=-1.0)
    compensator = ql.Compensator(OBSERVER)
    compensator.step(1.0, 0.0)
    quick = ESO.model_free(order=2, b0=2.0, omega_o=40.0, dt=DT)
    compensator.prepare_retune(observer=quick)()
    assert compensator.observer is quick
    for kind in ("compensated", "compensated in single"):
        with pytest.raises(ValueError, match="omega_c = 3.0: a compensator has no law"):
            _wrapped(kind).prepare_retune(omega_c=3.0)
    with pytest.raises(ValueError, match="controller = PID: must be an ADRC"):
        in_single_precision(ql.baselines.PID(kp=1.0, dt=DT)).prepare_retune(omega_c=3.0)


def test_retuning_before_the_first_measurement_changes_no_state() -> None:
    """There is no u to continue from: the first sample is that of a controller made so."""
    controller = ql.ADRC(OBSERVER, omega_c=3.0)
    made = ql.ADRC(ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=DT), omega_c=6.0)
    for each in (controller, made):
        assert control(each.parameters, each._state, 1.0, math.nan) == 0.0
    before = controller.state
    controller.retune(omega_c=6.0, observer=made.observer)
    for name, array in controller.state.items():
        np.testing.assert_array_equal(array, before[name])
    first = control(controller.parameters, controller._state, 1.0, 0.25)
    assert first == control(made.parameters, made._state, 1.0, 0.25) == pytest.approx(27.0)


def test_gains_may_be_scheduled_every_sample() -> None:
    """Retuned to what it is in each sample, the loop is the loop that is left alone."""
    ys = {}
    for scheduled in (False, True):
        rig, controller = Rig(), ql.ADRC(OBSERVER, omega_c=3.0)
        for _ in range(150):
            if scheduled:
                controller.retune(omega_c=3.0, observer=OBSERVER)
            rig.apply(controller.step(1.0, rig.y))
        ys[scheduled] = rig.y
    assert ys[True] == pytest.approx(ys[False], abs=1e-12)


def test_an_observer_of_another_structure_is_refused() -> None:
    """Though its state is as long: compiled code, and the state, are made for the present one."""
    delayed = ql.ADRC(ESO.model_free(2, 1.0, 20.0, DT, half_gain=True, delay=0.05), 1.0)
    with pytest.raises(ValueError, match="of another structure"):
        delayed.retune(observer=ESO.nonlinear(2, 1.0, 20.0, DT, delta=0.1, delay=0.05))
    deep = ql.ADRC(ESO.cascade(2, 1.0, 20.0, DT, levels=2, delay=0.04), 1.0)
    with pytest.raises(ValueError, match="of another structure"):
        deep.retune(observer=ESO.cascade(2, 1.0, 20.0, DT, levels=3, delay=0.01))
    assert deep.observer.states == 10


def test_of_a_plant_with_zeros_only_the_bandwidth_may_change() -> None:
    """Its states are other ones with another model, or another way for f."""
    A, B, E, C = [[0.0, 1.0], [-4.0, -0.4]], [1.0, 1.0], [0.0, 1.0], [1.0, 0.0]
    controller = ql.ADRC(ESO.model_based((A, B, C), 20.0, DT), 2.0)
    for other in ((A, B, E, C), (A, [1.0, 3.0], C)):
        with pytest.raises(ValueError, match="observer has"):
            controller.retune(observer=ESO.model_based(other, 20.0, DT))
    controller.retune(observer=ESO.model_based((A, B, C), 30.0, DT))
    assert controller.observer.omega_o == 30.0


@pytest.mark.trial
@pytest.mark.parametrize("zero", [-0.5, -0.1])
@pytest.mark.parametrize("keep_zeros", [False, True])
def test_a_start_makes_no_bump_whatever_the_zeros(zero: float, keep_zeros: bool) -> None:
    """Poles of the observer that are kept at slow zeros are given their time."""
    den = np.poly([-1.0, -0.3, -0.5])
    observer = ESO.model_based(([3.0, -3.0 * zero], den), 20.0, DT, keep_zeros=keep_zeros)
    controller = ql.ADRC(observer, 2.0)
    u = 0.7
    y = -3.0 * zero / den[-1] * u
    controller.start(y, u)
    for _ in range(200):
        assert controller.step(y, y) == pytest.approx(u, abs=1e-9)


def test_a_controller_behind_a_prefilter_starts_hands_over_and_is_retuned() -> None:
    """As it does alone; and it is a copy, which the one that was passed does not disturb."""
    given = ql.ADRC(OBSERVER, omega_c=3.0)
    behind = ql.controllers.Prefiltered(given, ql.controllers.ReferenceModel(4.0))
    rig = Rig((0.5, 0.0))
    behind.start(0.5, 3.25)
    for _ in range(100):
        rig.apply(behind.step(0.5, rig.y))
        assert rig.y == pytest.approx(0.5, abs=1e-11)
    before = behind.estimate.u
    behind.retune(omega_c=6.0)
    assert (behind.controller.omega_c, given.omega_c) == (6.0, 3.0)
    assert behind.step(0.5, rig.y) == pytest.approx(before, abs=1e-9)
    copied = copy.deepcopy(behind)
    for _ in range(50):
        behind.track(1.0, rig.y, 3.25)
    behind.hand_over()
    assert behind.step(1.0, rig.y) == pytest.approx(3.25, abs=0.1)
    assert copied.controller.omega_c == 6.0
    with pytest.raises(ValueError, match="controller = PID: must be an ADRC to start under load"):
        ql.controllers.Prefiltered(ql.baselines.PID(1.0, dt=DT), ql.baselines.ZV(3.0)).start(0.0)


def test_a_copy_of_a_prefiltered_controller_leaves_it_as_it_was() -> None:
    """Also one that another prefilter makes: each has its own state, on which its methods act."""
    given = ql.controllers.Prefiltered(ql.ADRC(OBSERVER, omega_c=3.0), ql.baselines.ZV(3.0))
    given.start(0.25)
    outer = ql.controllers.Prefiltered(given, ql.baselines.ZV(4.0))
    copied = copy.copy(given)
    single = ql.controllers.in_single_precision(ql.ADRC(OBSERVER, omega_c=3.0))
    behind = ql.controllers.Prefiltered(single, ql.baselines.ZV(4.0))
    for each, y in ((given, 0.5), (outer, 1.5), (copied, 2.5), (single, 3.5), (behind, 4.5)):
        each.start(y, 3.25)
    for each, y in ((given, 0.5), (outer, 1.5), (copied, 2.5), (single, 3.5), (behind, 4.5)):
        assert each.estimate.x[0] == pytest.approx(y, abs=1e-9)
        assert each.step(y, y) == pytest.approx(3.25, abs=1e-5)


def test_derivatives_are_fed_forward_in_manual_operation_too() -> None:
    """What the controller would do is what it does."""
    one, other = (ql.ADRC(OBSERVER, omega_c=3.0, feedforward=True) for _ in range(2))
    for k in range(20):
        r, v, a = math.sin(0.1 * k), math.cos(0.1 * k), -math.sin(0.1 * k)
        u = one.step(r, r, v, a)
        assert other.track(r, r, u, v, a) == u
    before = one.estimate.u
    assert one.increment(0.9, 0.9, 0.1, 0.2) == pytest.approx(
        other.step(0.9, 0.9, 0.1, 0.2) - before
    )


@pytest.mark.trial
@pytest.mark.compiled
def test_retuning_does_not_compile_again() -> None:
    """The types stay, so the step stays."""
    from quell.controllers.stateful import step_packed

    controller = ql.ADRC(OBSERVER, omega_c=2.0)
    controller.step(1.0, 0.0)
    count = len(step_packed.signatures)
    controller.retune(omega_c=3.0)
    controller.step(1.0, 0.0)
    assert len(step_packed.signatures) == count


def test_increments_add_up_to_the_control_signal() -> None:
    """Limits included; they are those of ``step``."""
    limited = {"u_min": -1.0, "u_max": 3.5, "rate_limit": 20.0}
    one, other = (ql.ADRC(OBSERVER, omega_c=3.0, **limited) for _ in range(2))
    total, rig = 0.0, Rig()
    for k in range(800):
        r = float(k > 100)
        total += one.increment(r, rig.y)
        assert total == pytest.approx(other.step(r, rig.y), abs=1e-12)
        rig.apply(total)


def test_increments_need_not_know_where_the_actuator_is() -> None:
    """An unknown offset is one more disturbance: started at y, the loop stays where it is."""
    rig, controller, actuator = Rig((0.5, 0.0)), ql.ADRC(OBSERVER, omega_c=3.0), 3.25
    controller.start(0.5)
    for _ in range(200):
        actuator += controller.increment(0.5, rig.y)
        rig.apply(actuator)
        assert rig.y == pytest.approx(0.5, abs=1e-11)


def test_an_actuator_that_did_otherwise_is_believed() -> None:
    """A limit that only the drive knows: told of it, the loop behaves as if the limit were its own; untold, it winds up."""
    ends = {}
    for name in ("own", "told", "untold"):
        rig = Rig()
        controller = ql.ADRC(
            OBSERVER,
            omega_c=3.0,
            learner=ql.learners.Kalman(u=True),
            u_max=3.6 if name == "own" else math.inf,
        )
        ys = []
        for k in range(700):
            u = controller.step(2.0 if k < 400 else 0.4, rig.y)
            applied = min(u, 3.6)
            if name == "told":
                controller.applied(applied)
            rig.apply(applied)
            ys.append(rig.y)
        ends[name] = np.array(ys)
    np.testing.assert_allclose(ends["told"], ends["own"], atol=1e-9)
    assert np.max(np.abs(ends["untold"] - ends["own"])) > 0.01


@pytest.mark.trial
def test_the_reference_fed_forward_is_followed_without_lag() -> None:
    """Y = r up to the observer's error, where the lag without derivatives is 2/omega_c."""
    plant = ql.plants.LinearPlant([[0.0, 1.0], [-1.0, -0.6]], [0.0, 2.0], [1.0, 0.0])
    observer = ESO.model_based(plant, omega_o=40.0, dt=1e-3)
    scenario = ql.Scenario(
        reference=ql.signals.SmoothMove(distance=1.0, duration=2.0, smoothness=3), duration=4.0
    )
    errors = []
    for feedforward in (False, True):
        run = ql.simulate(plant, ql.ADRC(observer, omega_c=3.0, feedforward=feedforward), scenario)
        errors.append(np.max(np.abs(run["y"] - run["r"])))
    assert errors[0] > 0.3
    assert errors[1] < 2e-3


def test_derivatives_reach_a_loop_of_ones_own() -> None:
    """``step(r, y, v, a)`` is what ``simulate`` does with the signal's derivatives."""
    move = ql.signals.SmoothMove(distance=1.0, duration=2.0)
    controller = ql.ADRC(OBSERVER, omega_c=3.0, feedforward=True)
    run = ql.simulate(PLANT, controller, ql.Scenario(reference=move, duration=3.0))
    speed, acceleration = move.derivative(), move.derivative().derivative()
    u = [
        controller.step(r, y, v, a)
        for r, y, v, a in zip(run["r"], run["y"], speed(run.t), acceleration(run.t), strict=True)
    ]
    np.testing.assert_allclose(u, run["u"], atol=1e-10)


@cases(
    ("make", "message"),
    [
        (lambda c: c.start(math.nan), "y = nan: must be a finite number"),
        (lambda c: c.track(1.0, 0.0, math.inf), "u = inf: must be a finite number"),
        (lambda c: c.applied(math.nan), "u = nan: must be a finite number"),
        (lambda c: c.hand_over(), "hand_over: there was no sample yet"),
        (lambda c: c.retune(omega_c=0.0), "omega_c = 0.0: must be finite and greater than zero"),
        (
            lambda c: c.retune(observer=ESO.model_free(3, 1.0, 20.0, DT)),
            "observer has order = 3, the present one 2",
        ),
        (
            lambda c: c.retune(observer=ESO.model_free(1, 1.0, 20.0, DT)),
            "observer has order = 1, the present one 2: must be the same",
        ),
        (
            lambda c: c.retune(observer=ESO.model_free(2, 2.0, 20.0, 0.02)),
            "observer has dt = 0.02, the present one 0.01",
        ),
        (
            lambda c: c.retune(observer=ESO.model_free(2, 2.0, 20.0, 0.005)),
            "observer has dt = 0.005, the present one 0.01",
        ),
        (
            lambda c: c.retune(observer=ESO.model_free(2, 2.0, 20.0, DT, form="predictor")),
            "observer has form = 'predictor', the present one 'current'",
        ),
        (
            lambda c: c.retune(observer=ESO.model_free(2, 2.0, 20.0, DT, delay=DT)),
            "observer has states = 4, the present one 3",
        ),
        (
            lambda c: c.retune(
                observer=ESO.model_based((*zero_at(-1.0), [0.0, 1.0], [1.0, 0.0]), 20.0, DT)
            ),
            "observer has degree = 1, the present one 2",
        ),
        (lambda c: c.retune(observer="eso"), "observer = 'eso': must be an ESO"),
        (
            lambda c: c.step(1.0, 0.0, 1.0),
            "step was given 1 derivatives of the reference: make the controller with "
            "feedforward=True",
        ),
    ],
)
def test_a_mistake_is_named_and_changes_nothing(make: object, message: str) -> None:
    """With the argument, its value and the rule."""
    controller = ql.ADRC(OBSERVER, omega_c=3.0)
    before = controller.state
    with pytest.raises(ValueError, match=message):
        make(controller)  # type: ignore[operator]
    for name, array in controller.state.items():
        np.testing.assert_array_equal(array, before[name])
    assert controller.omega_c == 3.0


def test_what_was_learned_forbids_another_nominal_gain() -> None:
    """Its coefficients refer to the old one; nor may the model change, but the bandwidth may."""
    controller = ql.ADRC(OBSERVER, omega_c=3.0, learner=ql.learners.Kalman())
    for other in (
        ESO.model_free(2, 1.0, 20.0, DT),
        ESO.model_free(2, 3.0, 20.0, DT),
        ESO.model_based(PLANT, 20.0, DT),
    ):
        with pytest.raises(ValueError, match="what was learned refers to that"):
            controller.retune(observer=other)
    controller.retune(observer=ESO.model_free(2, 2.0, 30.0, DT))
    assert controller.observer.omega_o == 30.0


@pytest.mark.parametrize("said", [0.9, -0.9])
def test_a_guard_starts_with_no_correction(said: float) -> None:
    """A trusted learner's first output is a constant: the observer's estimate has it all."""
    learner, guard = ql.learners.Kalman(state=False), ql.Guard()
    controller = ql.ADRC(OBSERVER, omega_c=3.0, learner=learner, guard=guard)
    state = controller._state
    state.learner.theta[0] = said
    state.guard.sample[0].credit = state.guard.sample[0].share = 1.0
    state.guard.sample[0].typical_error = state.guard.sample[0].peak = 1.0
    controller.start_at([0.5, 0.0], 2.0)
    assert state.loop[0].f_learned == 0.0
    assert controller.estimate.f == pytest.approx(2.0, rel=1e-12)
    assert state.estimates[2] == pytest.approx(2.0, rel=1e-12)
    assert state.guard.sample[0].output == said


def test_without_a_reference_a_started_loop_keeps_the_one_it_was_started_with() -> None:
    """It counts as the last one; a loop that was not started stays where y is."""
    for r in (0.5, 0.8):
        controller = ql.ADRC(OBSERVER, omega_c=3.0)
        controller.start(0.5, 3.25, r=r)
        control(controller.parameters, controller._state, math.nan, 0.5)
        assert controller._state.loop[0].r == r


@cases("learner", [None, ql.learners.Kalman()])
@cases("delay", [0.0, 0.02])
def test_a_start_in_motion_goes_on_from_the_estimates(learner: object, delay: float) -> None:
    """With the estimates and u of another controller, every later u is that controller's; with a delay, after a constant u."""
    observer = ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=DT, delay=delay)
    limits = {"u_min": -4.0, "u_max": 4.0}
    one, other = (
        interpreted(ql.ADRC(observer, omega_c=3.0, learner=learner, **limits)) for _ in range(2)
    )
    for k in range(300):
        one.step(1.0, 0.3 * math.sin(0.05 * k))
    for _ in range(3):
        one.track(1.0, 0.1, 0.7)
    known = one.estimate
    if learner is not None:  # which has to know the same
        other.state = other.state | {
            name: value for name, value in one.state.items() if name.startswith("learner.")
        }
    other.start_at(known.x, known.f, u=0.7, r=1.0)
    told = other.estimate
    assert told.x.tolist() == known.x.tolist()
    assert told.f == pytest.approx(known.f, rel=1e-12)
    assert told.u == 0.7
    ys = (0.1, 0.12, math.nan, 0.15, 0.2)
    if learner is not None:  # whose own filters start afresh
        ys = ys[:1]
    later = [(one.step(1.0, y), other.step(1.0, y)) for y in ys]
    np.testing.assert_allclose(*np.transpose(later), rtol=1e-12)


def test_a_start_in_motion_may_continue_from_u() -> None:
    """By ``hand_over``; without it the next u is the law's own. All forms of the observer take the estimates."""
    for make in (
        lambda: OBSERVER,
        lambda: ESO.cascade(2, 2.0, 20.0, DT),
        lambda: ESO.nonlinear(2, 2.0, 20.0, DT, delta=0.1),
    ):
        controller = ql.ADRC(make(), omega_c=3.0)
        design, state = controller.parameters, controller._state
        controller.start_at([0.2, -0.5], 0.8, u=0.4, r=0.5)
        # What the law says of the estimates, a sample later by the model: y moves as predicted.
        y = expected_measurement(design.eso, state.z, 0.4, 0.0)
        assert y == pytest.approx(0.2 - 0.5 * DT + 0.5 * DT**2 * (0.8 + 2.0 * 0.4), rel=1e-12)
        u = control(design, state, math.nan, y)
        speed = -0.5 + DT * (0.8 + 2.0 * 0.4)
        law = (9.0 * (0.5 - y) - 6.0 * speed - 0.8) / 2.0
        assert u == pytest.approx(law, rel=1e-9)
        controller.start_at([0.2, -0.5], 0.8, u=0.4, r=0.5)
        controller.hand_over()
        assert control(design, state, 0.5, y) == pytest.approx(0.4, rel=1e-12)
    with pytest.raises(ValueError, match=r"x has shape \(3,\): must be a vector of 2"):
        controller.start_at([0.0, 0.0, 0.0])


def test_behind_a_prefilter_a_start_in_motion_settles_the_prefilter_there() -> None:
    """The next reference is a step from y on."""
    shaped = interpreted(
        ql.controllers.Prefiltered(ql.ADRC(OBSERVER, 3.0), ql.baselines.ZV(omega=5.0))
    )
    shaped.start_at([0.2, 0.0], 0.0, u=0.1)
    assert shaped.step(0.2, 0.2) == pytest.approx(ql.ADRC(OBSERVER, 3.0).step(0.2, 0.2), abs=0.5)
    assert shaped.state["loop"][0] == pytest.approx(0.2)
