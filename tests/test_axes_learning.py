"""Learners that see the states of all axes, and one that serves all of them."""

from __future__ import annotations

import copy
import ctypes
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.several import control_all
from quell.export import c_source
from quell.export.controller_source import parts_of
from quell.features import AllAxes, Bias, Custom, Friction, Input, Polynomial, RandomFourier, State
from quell.kernels.dispatch import as_python
from quell.learners import MLP, NLMS, RLS, GaussianProcess, Kalman
from quell.learners.base import forget

from .cases import cases
from .in_c import needs_gcc
from .test_axes_export import RobotInC, outcome

DT = 1e-3
COUPLED = [[1.0, 0.3], [0.2, 1.0]]
LIMITS = {"u_min": -30.0, "u_max": 30.0}


def joint(order: int = 2, omega_o: float = 60.0, **parts: Any) -> ql.ADRC:
    """Return a controller of an axis."""
    observer = ql.ESO.model_free(order=order, b0=1.0, omega_o=omega_o, dt=DT)
    return ql.ADRC(observer, 8.0, **parts)


def product(x: Any, u: Any) -> tuple[float]:
    """Return position times rate of the other axis."""
    return (x[0] * x[3],)


def coupled(inputs: bool = False) -> ql.features.Features:
    """Return features of all axes."""
    return AllAxes(State() + Custom(product, names=("y1 y2'",)), inputs=inputs) + Bias()


def monomials() -> ql.features.Features:
    """Return features of all axes that single precision has."""
    return AllAxes(State() + Polynomial(2, states=(1, 4))) + Bias()


def force(x: Any, u: Any) -> tuple[float, float]:
    """Return what couples the joints of an arm."""
    return math.sin(x[2]) * x[3] * x[3], math.cos(x[0] + x[2])


KINDS: dict[str, Any] = {
    "RLS for all": lambda: RLS(coupled()),
    "RLS for all, with v": lambda: RLS(coupled(inputs=True)),
    "NLMS for all": lambda: NLMS(coupled()),
    "monomials for all": lambda: RLS(monomials()),
    "monomials for each": lambda: [RLS(Friction() + monomials() + Input()), RLS(monomials())],
    "RLS for each": lambda: [RLS(Friction() + coupled() + Input()), RLS(coupled())],
    "others": lambda: [GaussianProcess(AllAxes(State()), budget=6), MLP(coupled(), hidden=3)],
    "a function, and one axis without": lambda: [
        RLS(State() + AllAxes(Custom(force, names=("c", "g")) + RandomFourier(5)) + Bias()),
        None,
    ],
}


def axes_with(learner: Any, guard: Any = None, **parts: Any) -> ql.Axes:
    """Return two axes with learners of all axes, each with a guard."""
    names = {"shoulder": joint(**parts), "elbow": joint(**parts)}
    return ql.Axes(names, COUPLED, learner=learner, guard=guard or ql.Guard(), **LIMITS)


def unguarded(learner: Any, B0: Any = COUPLED) -> ql.Axes:
    """Return two axes with a learner of all and without guards."""
    return ql.Axes([joint(), joint()], B0, learner=learner, **LIMITS)


def run(axes: ql.Axes, samples: int, start: int = 0, x: Any = None) -> np.ndarray:
    """Take samples of two coupled masses with the interpreted kernels.

    Return the part of f that was not known before (samples, 2).
    """
    x = np.array([0.0, 3.0, 0.0, 4.4]) if x is None else x  # as the references begin
    left = np.empty((samples, 2))
    u = np.zeros(axes.inputs)
    with np.errstate(all="ignore"), as_python():
        for k in range(start, start + samples):
            r = np.array([0.5 * np.sin(0.006 * k), 0.4 * np.sin(0.011 * k)])
            control_all(axes.parameters, axes._state, r, x[[0, 2]].copy(), u)
            v = np.array(COUPLED) @ u
            f = np.array([-30.0 * x[2] + 8.0 * x[0] * x[3], 25.0 * x[0] - 6.0 * x[1]])
            for i in range(2):
                x[2 * i] += DT * x[2 * i + 1]
                x[2 * i + 1] += DT * (v[i] + f[i])
            left[k - start] = [axis._state.estimates[2] for axis in axes.axes]
    return left


def theta(axes: ql.Axes, i: int) -> dict[str, float]:
    """Return the coefficients of an axis by the names of their features."""
    return dict(axes.axes[i].estimate.theta)


class TestWhatIsLearned:
    """Coefficients, and what they are good for."""

    @pytest.mark.trial
    @pytest.mark.parametrize("learner", [RLS(coupled()), [RLS(coupled()), RLS(coupled())]])
    def test_the_coupling_is_found_in_the_plants_units(self, learner: Any) -> None:
        """Of f_1 = −30 y_2 + 8 y_1 y_2' and f_2 = 25 y_1 − 6 y_1', shared or each for itself."""
        axes = axes_with(learner)
        run(axes, 2500)
        first, second = theta(axes, 0), theta(axes, 1)
        assert first["elbow.x1"] == pytest.approx(-30.0, rel=0.1)
        assert first["y1 y2'"] == pytest.approx(8.0, rel=0.3)
        assert second["shoulder.x1"] == pytest.approx(25.0, rel=0.1)
        assert second["shoulder.x2"] == pytest.approx(-6.0, rel=0.1)

    @pytest.mark.trial
    def test_one_for_all_is_one_for_each(self) -> None:
        """Least squares of the same features have one gain: the coefficients are the same to 1 %."""
        shared, each = axes_with(RLS(coupled())), axes_with([RLS(coupled()), RLS(coupled())])
        run(shared, 1500)
        run(each, 1500)
        for i in range(2):
            largest = max(map(abs, theta(each, i).values()))
            for name, value in theta(each, i).items():
                assert theta(shared, i)[name] == pytest.approx(value, abs=0.01 * largest)

    @pytest.mark.trial
    def test_what_one_axis_can_not_know_is_learned(self) -> None:
        """Of forces by the other axis a tenth is left of what features of the own axis leave."""
        own = {name: joint(learner=RLS(State() + Bias())) for name in "ab"}
        theirs = run(ql.Axes(own, COUPLED, **LIMITS), 1600)[1200:]
        ours = run(unguarded(RLS(coupled())), 1600)[1200:]
        assert np.all(np.std(ours, axis=0) < 0.1 * np.std(theirs, axis=0))

    @pytest.mark.trial
    def test_a_wrong_b0_is_learned_from_v_of_all(self) -> None:
        """With v of all axes among the features less is left of what B0 lacks."""
        without = run(unguarded(RLS(coupled()), np.eye(2)), 1200)[800:]
        known = run(unguarded(RLS(coupled(inputs=True)), np.eye(2)), 1200)[800:]
        assert np.all(np.std(known, axis=0) < 0.7 * np.std(without, axis=0))

    @pytest.mark.trial
    def test_at_rest_nothing_is_learned_from_noise(self) -> None:
        """Signals that do not move teach nothing, those of other axes neither."""
        for learner in (RLS(coupled()), [RLS(coupled()), RLS(coupled())]):
            axes, noise = axes_with(learner), np.random.default_rng(1)
            u = np.zeros(2)
            with as_python():
                for _ in range(1500):
                    y = 1e-5 * noise.standard_normal(2)
                    control_all(axes.parameters, axes._state, np.zeros(2), y, u)
            for axis in axes.axes:
                assert all(abs(v) < 1e-9 for k, v in axis.estimate.theta.items() if k != "bias")


class TestOperation:
    """Guards, restarts, hand-over, retuning, copies and images."""

    @pytest.mark.trial
    @pytest.mark.parametrize("name", KINDS)
    def test_an_image_continues_bit_by_bit(self, name: str) -> None:
        """Of a running loop; and from rest what was learned is there."""
        axes, other, rested = (axes_with(KINDS[name]()) for _ in range(3))
        run(axes, 400)
        image = axes.memory()
        other.restore(image, running=True)
        rested.restore(image)
        for one, two in zip(axes.axes, rested.axes, strict=True):
            same = {name: value for name, value in one.estimate.theta.items() if name != "bias"}
            assert same.items() <= two.estimate.theta.items()
        assert np.array_equal(run(axes, 60, 400), run(other, 60, 400))
        assert axes.memory() == other.memory()

    def test_an_image_of_other_features_is_refused(self) -> None:
        """Also where the number of features is the same."""
        image = axes_with(RLS(coupled())).memory()
        fourier = AllAxes(RandomFourier(5)) + Bias()
        for other in (RLS(fourier), NLMS(coupled()), [RLS(coupled()), RLS(coupled())]):
            with pytest.raises(ValueError, match="of another controller"):
                axes_with(other).restore(image)

    @pytest.mark.trial(cases="others")
    @pytest.mark.parametrize("name", ["RLS for all", "others"])
    def test_a_copy_goes_on_alike(self, name: str) -> None:
        """Bit by bit, and apart from the original."""
        axes = axes_with(KINDS[name]())
        run(axes, 300)
        twin = copy.deepcopy(axes)
        assert np.array_equal(run(axes, 50, 300), run(twin, 50, 300))

    @pytest.mark.trial
    @pytest.mark.parametrize("name", ["RLS for all", "RLS for each"])
    def test_an_axis_is_retuned_without_a_bump(self, name: str) -> None:
        """What was learned stays."""
        axes = axes_with(KINDS[name]())
        run(axes, 1000)
        before, kept = axes._state.u.copy(), [axis.estimate.theta for axis in axes.axes]
        axes.retune("elbow", omega_c=6.0)
        for axis, old in zip(axes.axes, kept, strict=True):
            assert axis.estimate.theta == old
        u = np.zeros(2)
        with as_python():
            control_all(axes.parameters, axes._state, axes._state.r_given, axes._state.y_given, u)
        assert np.all(np.isfinite(u))
        assert np.any(before != u)

    def test_the_order_of_axes_does_not_matter(self) -> None:
        """With two bandwidths: one learner for all has the frequency of the slowest axis."""
        found = []
        for order in (1, -1):
            axes = [joint(), ql.ADRC(joint().observer, 24.0)][::order]
            learning = ql.Axes(axes, learner=RLS(AllAxes(State()) + Bias())).parameters.learning
            linear = learning.shared.linear
            found.append([linear.inputs.gate.forget, linear.rule.forget])
            floors = np.split(linear.inputs.scaling.floors[:4], 2)
            assert np.array_equal(*floors)
        assert found[0] == found[1]

    @pytest.mark.parametrize("name", ["RLS for all", "RLS for each"])
    def test_a_copy_designs_its_own_learners(self, name: str) -> None:
        """Retuning one of both does not reach the other."""
        axes = axes_with(KINDS[name]())
        twin = copy.copy(axes)
        view, before = axes.axes[0].learner, axes.learning._view
        twin.retune("elbow", omega_c=6.0)
        assert twin.learning is not axes.learning
        assert axes.axes[0].learner is view
        assert axes.learning._view is before

    def test_another_observer_needs_a_learner_for_each(self) -> None:
        """Features that all axes share pass through one filter."""
        faster = ql.ESO.model_free(order=2, b0=1.0, omega_o=80.0, dt=DT)
        with pytest.raises(ValueError, match="features pass through one lag filter"):
            axes_with(RLS(coupled())).retune(0, observer=faster)
        axes = axes_with(KINDS["RLS for each"]())
        run(axes, 100)
        axes.retune(0, observer=faster)
        assert axes.axes[1].learner.view.observers[0].omega_o == 80.0
        assert np.all(np.isfinite(run(axes, 100, 100)))

    def test_hand_over_continues_the_control_signal(self) -> None:
        """After manual operation with a learner of all axes."""
        axes = axes_with(RLS(coupled()))
        y = np.array([0.1, -0.2])
        with as_python():
            for _ in range(400):
                axes.track([0.0, 0.0], y, [1.0, 2.0])
            axes.hand_over()
            np.testing.assert_allclose(axes.step([0.0, 0.0], y), [1.0, 2.0], atol=1e-6)

    @pytest.mark.trial
    def test_where_one_axis_forgets_all_learn_again(self) -> None:
        """Scales and θ of all are those of the start; the observers take over what was fed forward."""
        axes, x = unguarded(RLS(coupled())), np.array([0.0, 3.0, 0.0, 4.4])
        run(axes, 1500, 0, x)
        own, other = axes.axes
        forget(own.parameters.learner, own._state.learner)
        assert not any(own.estimate.theta.values())
        fed = float(other._state.loop[0].f_learned_filtered)  # as the observer alone has it
        assert abs(fed) > 1.0
        run(axes, 1, 1500, x)
        assert np.all(axes._state.learning.shared.linear.scale < 1e-90)
        assert not any(other.estimate.theta.values())
        for axis in axes.axes:
            assert axis.estimate.status & ql.Status.OVERFLOWED or axis is own
        assert ql.Status.OVERFLOWED in axes.status
        run(axes, 1, 1501, x)
        assert other.estimate.f == pytest.approx(fed, abs=0.3 * abs(fed))
        left = run(axes, 1500, 1502, x)
        assert np.all(np.std(left[-300:], axis=0) < 1.0)  # of 10
        assert theta(axes, 1)["axis1.x1"] == pytest.approx(25.0, rel=0.1)

    @pytest.mark.trial
    def test_a_glitch_leaves_no_scales_behind(self) -> None:
        """Of one sample of 1e6 in y; soon as little is unknown as before it."""
        axes, x = unguarded(RLS(coupled())), np.array([0.0, 3.0, 0.0, 4.4])
        before = run(axes, 2500, 0, x)[-500:]
        run(axes, 1, 2500, np.array([1e6, x[1], x[2], x[3]]))
        after = run(axes, 3500, 2501, x)[-500:]
        assert np.max(axes._state.learning.shared.linear.scale[:4]) < 100.0
        assert np.all(np.std(after, axis=0) < 3.0 * np.std(before, axis=0) + 0.05)

    @pytest.mark.trial
    @pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
    def test_bad_samples_do_not_end_the_loop(self, bad: float) -> None:
        """Neither in r nor in y; u is finite and within its limits."""
        axes = axes_with(RLS(coupled()))
        run(axes, 300)
        u = np.zeros(2)
        with np.errstate(all="ignore"), as_python():
            for k in range(600):
                y = np.array([bad if 50 < k < 60 else 1e-3, 0.01])
                r = np.array([0.0, bad if k == 80 else 0.0])
                control_all(axes.parameters, axes._state, r, y, u)
                assert np.all(np.abs(u) <= 30.0)

    @pytest.mark.trial
    @pytest.mark.compiled
    @pytest.mark.lost  # B0 is that of other machines
    def test_compiled_is_interpreted(self) -> None:
        """``simulate`` in both ways, with one learner for all and with guards."""
        plant = ql.plants.arm(gravity=0.0)
        scenario = ql.Scenario(
            (ql.signals.Sinusoid(0.5, 3.0), ql.signals.Sinusoid(0.3, 5.0)), duration=0.6
        )
        ours = ql.simulate(plant, axes_with(RLS(coupled())), scenario)
        theirs = ql.simulate(plant, axes_with(RLS(coupled())), scenario, interpret=True)
        np.testing.assert_allclose(ours.log, theirs.log, rtol=1e-6, atol=1e-7)


class TestC:
    """The exported code."""

    @pytest.mark.trial
    @needs_gcc
    @pytest.mark.parametrize(
        ("name", "precision"),
        [
            *((name, "double") for name in KINDS),
            ("monomials for all", "single"),
            ("monomials for each", "single"),
        ],
    )
    def test_the_c_code_repeats_the_kernels_bit_for_bit(
        self, tmp_path: Path, name: str, precision: str
    ) -> None:
        """With NaN, manual operation, restarts, and a loop that learns."""
        axes = axes_with(KINDS[name]())
        ql.export.c(axes, tmp_path / "out", name="robot", precision=precision, accept=True)
        code, text = outcome(tmp_path / "out", "0")
        assert code == 0, text
        assert "largest difference 0 ulp" in text

    @pytest.mark.trial
    @needs_gcc
    def test_c_goes_on_with_what_was_learned(self, tmp_path: Path) -> None:
        """An export begins with it, and both images are the same bytes; also behind a glitch."""
        axes = unguarded(RLS(coupled()))
        run(axes, 1200)
        state = parts_of(axes).state
        learned = axes._state.learning.shared.linear.rule.covariance
        assert np.array_equal(state.learning.shared.linear.rule.covariance, learned)
        robot = RobotInC(c_source(axes, "robot"), tmp_path)
        image = axes.memory()
        length = ctypes.c_size_t(len(image))
        assert robot.call("load", ctypes.c_bool, image, length, ctypes.c_bool(True))
        u = np.zeros(2)
        seen = ql.Status(0)
        for k in range(80):
            r, y = np.array([0.3, 0.1 * np.sin(0.1 * k)]), np.array([1e-3 * k, 0.05])
            y[0] += 1e6 * (k == 40)  # a glitch, after which all that is shared is forgotten
            with np.errstate(all="ignore"), as_python():
                control_all(axes.parameters, axes._state, r, y, u)
            assert np.array_equal(robot.step(r, y, 2), u)
            seen |= axes.status
        assert ql.Status.OVERFLOWED in seen
        assert robot.image(len(image)) == axes.memory()


OTHER = ql.learners.RLS(coupled())
WRONG: dict[str, tuple[Any, str]] = {
    "outside": (lambda: joint(learner=RLS(coupled())), "give the learner to quell.Axes"),
    "own states alone": (lambda: axes_with(RLS()), "has no features of all axes"),
    "no features": (lambda: axes_with(Kalman()), "must be a learner on features"),
    "not linear": (lambda: axes_with(MLP(coupled())), "linear in its features"),
    "one axis in all": (lambda: axes_with(RLS(Friction() + coupled())), "is of one axis"),
    "Input in all": (lambda: axes_with(RLS(coupled() + Input())), "is of one axis"),
    "strongest": (lambda: axes_with(RLS(coupled(), strongest=3)), "decide by the error of one"),
    "scale": (lambda: axes_with(RLS(coupled(), scale=[1.0] * 6)), "is that of one axis"),
    "two learners": (
        lambda: ql.Axes([joint(learner=Kalman()), joint()], learner=OTHER),
        "axis1 has one already",
    ),
    "too few": (lambda: axes_with([OTHER]), "has 1 entries, there are 2 axes"),
    "a name": (lambda: axes_with({"wrist": OTHER}), "learner of axis = 'wrist'"),
    "a guard alone": (lambda: axes_with(None), "has no effect without a learner"),
    "no guard": (lambda: axes_with(OTHER, guard=3), "must be a quell.Guard"),
    "two bandwidths": (
        lambda: ql.Axes([joint(), joint(omega_o=50.0)], learner=OTHER),
        "one order, omega_o and form",
    ),
    "nested": (lambda: AllAxes(coupled()), "is inside of AllAxes"),
    "Input inside": (lambda: AllAxes(State() + Input()), "is the u of one axis"),
    "no block": (lambda: AllAxes(3), "must be made of blocks"),
}  # fmt: skip


@cases("name", WRONG)
def test_what_does_not_fit_is_named(name: str) -> None:
    """The message says what to do."""
    make, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        make()


def test_an_axis_does_not_run_alone() -> None:
    """Neither in a simulation nor in C nor in other axes: its learner would see no other axis."""
    plant = ql.plants.LinearPlant.of(([1.0], [1.0, 0.0, 0.0]))
    for learner in (RLS(coupled()), [RLS(coupled()), RLS(coupled())]):
        axis = axes_with(learner).axes[0]
        for use in (
            lambda axis=axis: ql.simulate(plant, axis, ql.Scenario(1.0, duration=0.01)),
            lambda axis=axis: c_source(axis, "axis"),
            lambda axis=axis: ql.Axes([axis, joint()]),
            lambda axis=axis: axis.step(0.1, 0.0),
            lambda axis=axis: axis.track(0.1, 0.0, 0.0),
        ):
            with pytest.raises(ValueError, match="needs the signals of all axes"):
                use()
        with pytest.raises(ValueError, match="call axes.retune"):
            axis.prepare_retune(omega_c=6.0)


def test_a_dictionary_gives_learners_and_guards_by_name() -> None:
    """An axis that is not in it has none; its own learner stays."""
    axes = ql.Axes(
        {"shoulder": joint(learner=Kalman(), guard=ql.Guard()), "elbow": joint()},
        COUPLED,
        learner={"elbow": RLS(coupled())},
        guard={"elbow": ql.Guard()},
    )
    assert isinstance(axes.axes[0].learner, Kalman)
    assert axes.axes[1].features[0] == "shoulder.x1"
    assert axes.axes[1].guard is not None
