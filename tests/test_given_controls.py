"""Axes that are compensators on top of u_0: from outside, or from controllers in the loop."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.plants.base import advance, measure_all

from .cases import cases

DT = 1e-3
B0 = np.array([[1.0, 0.4], [0.2, 2.0]])
WIDE = np.hstack([B0, [[0.5], [0.3]]])


def compensator(omega_o: float = 60.0, **parts: Any) -> ql.Compensator:
    """Return the compensator of an axis."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=omega_o, dt=DT)
    return ql.Compensator(observer, **parts)


def learning() -> ql.Compensator:
    """Return one that learns."""
    return compensator(omega_c=8.0, learner=ql.learners.Harmonic(), guard=ql.Guard())


def pid(**parts: Any) -> ql.baselines.PID:
    """Return a drive."""
    return ql.baselines.PID(kp=100.0, ki=50.0, kd=20.0, tf=0.005, dt=DT, **parts)


def masses(B: Any = B0, spring: float = 0.0) -> ql.plants.LinearPlant:
    """Return two masses that all forces move, perhaps with a spring between them."""
    A, inputs = np.zeros((4, 4)), np.zeros((4, np.shape(B)[1]))
    A[0, 1] = A[2, 3] = 1.0
    A[1, [0, 2]] = A[3, [2, 0]] = -spring, spring
    inputs[1], inputs[3] = B
    loads = [[0, 0], [1, 0], [0, 0], [0, 1]]
    return ql.plants.LinearPlant(A, inputs, [[1, 0, 0, 0], [0, 0, 1, 0]], E=loads)


LOADS = (ql.signals.Sinusoid(3.0, 6.0), ql.signals.Sinusoid(2.0, 9.0))


class TestFromOutside:
    """U_0 in the place of the references."""

    @pytest.mark.parametrize("B", [B0, WIDE])
    @pytest.mark.parametrize("saturation", ["each", "direction", ["axis2", "axis1"]])
    def test_u_is_u_0_less_what_cancels_f(self, B: Any, saturation: Any) -> None:
        """``u = u_0 − B0⁺ f̂`` in each sample; with more actuators the nearest to u_0."""
        axes = ql.Axes([compensator(), compensator()], B, saturation=saturation, u_min=-90.0)
        rng = np.random.default_rng(1)
        for k in range(200):
            u_0 = rng.uniform(-1.0, 1.0, B.shape[1])
            u = axes.step(u_0, [0.01 * np.sin(0.02 * k), 0.02 * np.cos(0.03 * k)])
            f = np.array([each.f for each in axes.estimates.values()])
            np.testing.assert_allclose(u, u_0 - np.linalg.pinv(B) @ f, atol=1e-9)
        assert np.max(np.abs(f)) > 0.1

    @pytest.mark.trial
    def test_decoupled_axes_are_the_single_compensators(self) -> None:
        """With the unit matrix each axis is a ``Compensator``, with learner and guard, to rounding."""
        axes, single = ql.Axes([learning(), compensator()]), (learning(), compensator())
        for k in range(500):
            u_0 = np.array([np.sin(0.01 * k), 0.3])
            y = np.array([0.01 * np.sin(0.02 * k), 0.02 * np.cos(0.03 * k)])
            u = axes.step(u_0, y)
            alone = [one.step(float(a), float(b)) for one, a, b in zip(single, u_0, y, strict=True)]
            np.testing.assert_allclose(u, alone, rtol=1e-9, atol=1e-9)
        assert axes.estimates["axis1"].authority == pytest.approx(single[0].estimate.authority)

    def test_one_that_is_no_number_is_the_one_before(self) -> None:
        """Only of this actuator, and the status says so."""
        axes = ql.Axes([compensator(), compensator()], B0)
        assert axes.step([np.nan, 1.0], [0.0, 0.0]).tolist() == [0.0, 1.0]
        assert ql.Status.REFERENCE_HELD in axes.status
        first = axes.step([0.5, 1.0], [0.0, 0.0])
        assert ql.Status.REFERENCE_HELD not in axes.status
        again = axes.step([np.nan, 1.0], [0.0, 0.0])
        assert again[0] == pytest.approx(first[0], abs=0.05)

    def test_limits_are_those_of_the_sum(self) -> None:
        """Of magnitude and rate; the observers receive what was applied, so f̂ stays right."""
        axes = ql.Axes([compensator(), compensator()], B0, u_min=-1.0, u_max=1.0, rate_limit=50.0)
        plant, x, before = masses(), np.zeros(4), np.zeros(2)
        model, scratch, y = plant.sampled(DT), np.zeros(40), np.zeros(2)
        for k in range(400):
            measure_all(model, x, y)
            u = axes.step([3.0 * np.sin(0.02 * k), 2.0], y)
            assert np.max(np.abs(u)) <= 1.0
            assert np.max(np.abs(u - before)) <= 50.0 * DT + 1e-12
            before = u
            advance(model, x, scratch, k * DT, u, np.array([0.5, -0.5]))
        f = [each.f for each in axes.estimates.values()]
        np.testing.assert_allclose(f, [0.5, -0.5], rtol=1e-3)

    @pytest.mark.trial
    def test_a_drive_in_front_follows_as_without_loads(self) -> None:
        """Two PID controllers of somebody, around a coupled machine: the load is all but gone."""
        errors = []
        for add in (False, True):
            drives = [pid(), pid()]
            axes = ql.Axes([compensator(), compensator()], B0)
            plant, x = masses(), np.zeros(4)
            model, scratch, y = plant.sampled(DT), np.zeros(40), np.zeros(2)
            largest = 0.0
            for k in range(3000):
                measure_all(model, x, y)
                u_0 = np.array(
                    [drive.step(0.0, float(at)) for drive, at in zip(drives, y, strict=True)]
                )
                u = axes.step(u_0, y) if add else u_0
                loads = np.array([float(load(np.array([k * DT]))[0]) for load in LOADS])
                advance(model, x, scratch, k * DT, u, loads)
                largest = max(largest, float(np.max(np.abs(y)))) if k > 1500 else largest
            errors.append(largest)
        assert errors[1] < 0.4 * errors[0]

    def test_a_b0_that_moves_is_that_of_this_sample(self) -> None:
        """With a function of the estimates, u_0 passes unchanged where there is no disturbance."""

        def gain(x):  # type: ignore[no-untyped-def]
            return (1.0 + x[0, 0] * x[0, 0], 0.4), (0.2, 2.0)

        axes = ql.Axes([compensator(), compensator()], gain)
        axes.start([0.5, 0.0])
        np.testing.assert_allclose(axes.step([0.0, 0.0], [0.5, 0.0]), [0.0, 0.0], atol=1e-12)


class TestDrives:
    """Controllers in the loop give u_0."""

    @pytest.mark.trial
    @pytest.mark.parametrize("band", [None, ql.SafeSet(-0.8, 0.8, alpha=8.0, f_rate=10.0)])
    def test_one_axis_is_compensated(self, band: Any) -> None:
        """``Axes`` of one axis is ``Compensated``: limits, learner, guard, safe set, and a brake."""
        parts: dict[str, Any] = {"omega_c": 8.0, "learner": ql.learners.Harmonic()}
        parts |= {"guard": ql.Guard(), "safe_set": band}
        axes = ql.Axes([compensator(**parts)], drives=[pid()], u_min=-6.0, u_max=6.0)
        alone = ql.Compensated(pid(), compensator(**parts, u_min=-6.0, u_max=6.0))
        plant = ql.plants.LinearPlant.of(([1.0], [1.0, 0.5, 0.0]))
        model, x, scratch, y = plant.sampled(DT), np.zeros(2), np.zeros(20), 0.0
        for k in range(1200):
            if k in (500, 700):
                alone.set_held(k == 500)
                axes.axes[0].set_held(k == 500)
            r = 1.0 if k > 100 else 0.0
            u, expected = float(axes.step([r], [y])[0]), alone.step(r, y)
            assert u == pytest.approx(expected, rel=1e-7, abs=1e-7)
            if not 500 <= k < 700:
                advance(model, x, scratch, k * DT, u, np.zeros(1))
                y = float(x @ np.atleast_2d(plant.C)[0])
            else:
                x[1] = 0.0

    @pytest.mark.trial
    def test_loads_are_cancelled_and_learned(self) -> None:
        """RMS over that of the drives alone, with a spring that couples: the learner leaves less."""
        plant = masses(spring=20.0)
        scenario = ql.Scenario(reference=(0.1, -0.1), duration=12.0, disturbances=LOADS)
        rms = []
        for make in (compensator, learning):
            axes = ql.Axes([make(), make()], B0, drives=[pid(), pid()], u_min=-90.0, u_max=90.0)
            run = ql.simulate(plant, axes, scenario)
            assert not run.diverged
            rms.append(np.sqrt(np.mean((run["y"] - run["r"])[6000:] ** 2, axis=0)))
        assert np.all(rms[1] < 0.5 * rms[0])

    @pytest.mark.trial
    @pytest.mark.parametrize("saturation", ["each", "direction"])
    def test_integrators_do_not_wind_up_at_limits(self, saturation: Any) -> None:
        """After a long time at the limits, y overshoots by little."""
        axes = ql.Axes(
            [compensator(), compensator()], B0, drives=[pid(), pid()], u_min=-2.0, u_max=2.0,
            saturation=saturation,
        )  # fmt: skip
        run = ql.simulate(masses(), axes, ql.Scenario(reference=(4.0, 2.0), duration=12.0))
        assert ql.Status.SATURATED in run.status
        assert np.all(np.max(run["y"], axis=0) < [4.0 * 1.35, 2.0 * 1.35])
        np.testing.assert_allclose(run["y"][-1], [4.0, 2.0], rtol=0.02)

    def test_manual_operation_ends_without_a_bump(self) -> None:
        """After ``hand_over`` the first u is that of manual operation; so it is after a start."""
        axes = ql.Axes([compensator(), compensator()], B0, drives=[pid(), pid()])
        for _ in range(50):
            axes.track([0.0, 0.0], [0.2, 0.1], [0.7, -0.3])
        axes.hand_over()
        np.testing.assert_allclose(axes.step([0.0, 0.0], [0.2, 0.1]), [0.7, -0.3], atol=1e-6)
        axes.start([0.2, 0.1], [0.4, 0.5])
        np.testing.assert_allclose(axes.step([0.0, 0.0], [0.2, 0.1]), [0.4, 0.5], atol=1e-9)

    @pytest.mark.trial
    def test_a_safe_set_holds_above_drives(self) -> None:
        """A reference far outside: y stays in its band."""
        safe = ql.SafeSet(-1.0, 1.0, alpha=12.0, f_rate=5.0)
        each = [compensator(150.0, safe_set=safe), compensator(150.0)]
        axes = ql.Axes(each, B0, drives=[pid(), pid()], u_min=-60.0, u_max=60.0)
        scenario = ql.Scenario(reference=(ql.signals.Step(5.0, 0.2), 0.0), duration=2.0)
        run = ql.simulate(masses(), axes, scenario)
        assert ql.Status.UNSAFE not in run.status
        assert 0.9 < np.max(run["y"][:, 0]) <= 1.0

    def test_a_copy_and_an_image_go_on_alike(self) -> None:
        """What learners and drives remember is in both; the next u has the same bits."""
        axes = ql.Axes([learning(), compensator()], B0, drives=[pid(), pid()], u_max=9.0)
        for k in range(300):
            axes.step([0.5 * np.sin(0.01 * k), 0.2], [0.01 * np.cos(0.05 * k), 0.2])
        twin = copy.copy(axes)
        other = ql.Axes([learning(), compensator()], B0, drives=[pid(), pid()], u_max=9.0)
        other.restore(axes.memory(), running=True)
        expected = axes.step([0.3, 0.2], [0.31, 0.06])
        assert twin.step([0.3, 0.2], [0.31, 0.06]).tolist() == expected.tolist()
        assert other.step([0.3, 0.2], [0.31, 0.06]).tolist() == expected.tolist()
        image = axes.memory()
        with pytest.raises(ValueError, match="of another controller"):
            ql.Axes([learning(), compensator()], B0).restore(image)

    def test_interpreted_is_compiled(self) -> None:
        """With drives, limits and a learner."""
        axes = ql.Axes(
            [learning(), compensator()], B0, drives=[pid(), pid()], u_max=9.0, u_min=-9.0
        )
        scenario = ql.Scenario(reference=(0.3, -0.1), duration=0.3, disturbances=LOADS)
        one = ql.simulate(masses(), axes, scenario)
        other = ql.simulate(masses(), axes, scenario, interpret=True)
        np.testing.assert_allclose(one.log, other.log, rtol=1e-7, atol=1e-7)


TWO = [compensator(), compensator()]


@cases(
    ("make", "message"),
    [
        (lambda: ql.Axes([compensator(), ql.ADRC(TWO[0].observer, 8.0)]), "axis2 is of another kind"),
        (lambda: ql.Axes([compensator(u_max=1.0), compensator()]), "axis1 has limits of u"),
        (lambda: ql.Axes(TWO, WIDE, wished=[1, 2, 3]), "u is the one nearest to u_0"),
        (lambda: ql.Axes(TWO, B0, drives=[pid()]), "must be a controller for each axis"),
        (lambda: ql.Axes(TWO, WIDE, drives=[pid(), pid()]), "3 actuators for 2 axes"),
        (lambda: ql.Axes(TWO, B0, drives=[pid(u_max=1.0), pid()]), "axis1 has limits of u"),
        (lambda: ql.Axes(TWO, B0, drives=[TWO[0], pid()]), "axis1: controller = Compensator"),
        (lambda: ql.Axes(TWO, B0, drives=[3.0, pid()]), "drives: axis1 = 3.0"),
        (
            lambda: ql.Axes([ql.ADRC(TWO[0].observer, 8.0)] * 2, B0, drives=[pid(), pid()]),
            "the axes are ADRCs",
        ),
        (
            lambda: ql.Axes(TWO, B0, drives=[ql.baselines.PID(kp=1.0, dt=0.01), pid()]),
            "must be one dt",
        ),
        (lambda: ql.Axes(TWO, WIDE).step([1.0, 2.0], [0.0, 0.0]), "u_0 must have 3 numbers"),
        (lambda: ql.Axes(TWO, B0).retune(0, omega_c=3.0), "a compensator has no law"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_named(make: Any, message: str) -> None:
    """With the axis and the rule."""
    with pytest.raises(ValueError, match=message):
        make()
