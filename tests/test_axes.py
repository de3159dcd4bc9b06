"""Several axes: B0, limits of the actuators, and a loop that is that of single axes where it can be."""

from __future__ import annotations

import copy
import math
import pickle

import numpy as np
import pytest
from scipy.optimize import lsq_linear

import quell as ql
from quell.controllers.allocation import (
    ActuatorLimits,
    allocate,
    checked_actuator_limits,
    checked_gain,
    checked_rule,
    range_memory,
)
from quell.plants.multibody import rotor_levers

from .cases import cases

DT = 1e-3
NAMES = ("x", "y", "z")


def joint(omega_o: float = 60.0, omega_c: float = 8.0, order: int = 2, **parts: object) -> ql.ADRC:
    """Return a controller of an axis."""
    observer = ql.ESO.model_free(order=order, b0=1.0, omega_o=omega_o, dt=DT)
    return ql.ADRC(observer, omega_c, **parts)  # type: ignore[arg-type]


def two_masses(coupling: float = 0.0) -> ql.plants.LinearPlant:
    """Return two masses with friction, that their forces move together."""
    A = np.array([[0, 1, 0, 0], [0, -0.5, 0, 0], [0, 0, 0, 1], [0, 0, 0, -2.0]])
    B = np.array([[0, 0], [1, coupling], [0, 0], [coupling, 1]])
    return ql.plants.LinearPlant(A, B, [[1, 0, 0, 0], [0, 0, 1, 0]])


REFERENCES = (ql.signals.Step(1.0, 0.1), ql.signals.Sinusoid(0.5, 3.0))


class TestDecoupledAxes:
    """Axes that nothing couples are single loops."""

    @pytest.mark.trial
    @pytest.mark.parametrize("limit", [math.inf, 20.0])
    def test_are_the_single_loops(self, limit: float) -> None:
        """With the unit matrix for B0 and limits of each actuator, the runs are equal."""
        axes = ql.Axes([joint(), joint()], u_min=-limit, u_max=limit)
        scenario = ql.Scenario(reference=REFERENCES, duration=3.0)
        together = ql.simulate(two_masses(), axes, scenario)
        for i, damping in enumerate((0.5, 2.0)):
            plant = ql.plants.LinearPlant.of(([1.0], [1.0, damping, 0.0]))
            alone = ql.simulate(
                plant,
                joint(u_min=-limit, u_max=limit),
                ql.Scenario(reference=REFERENCES[i], duration=3.0),
            )
            own = together.axis(i)
            np.testing.assert_allclose(own["y"], alone["y"], rtol=0.0, atol=1e-11)
            np.testing.assert_allclose(own["u"], alone["u"], rtol=0.0, atol=1e-8)
            assert own["x_hat"].shape == alone["x_hat"].shape

    @pytest.mark.trial
    def test_with_the_right_matrix_coupled_actuators_are_no_coupling(self) -> None:
        """A force that moves both masses is divided by B0, so the axes do not feel each other."""
        plant = two_masses(coupling=0.4)
        scenario = ql.Scenario(reference=(ql.signals.Step(1.0, 0.1), 0.0), duration=3.0)
        right = ql.simulate(plant, ql.Axes([joint(), joint()], [[1, 0.4], [0.4, 1]]), scenario)
        wrong = ql.simulate(plant, ql.Axes([joint(), joint()]), scenario)
        assert np.max(np.abs(right.axis(1)["y"])) < 1e-12
        assert np.max(np.abs(wrong.axis(1)["y"])) > 1e-2


class TestObserversAndLimits:
    """Observers receive what was applied."""

    @pytest.mark.trial
    @pytest.mark.parametrize("saturation", ["each", "direction", ["axis2", "axis1"]])
    def test_a_limit_of_one_actuator_is_no_disturbance(self, saturation: object) -> None:
        """The estimates of f stay right while actuators are at their limits."""
        B0 = np.array([[1.0, 0.4], [0.4, 1.0]])
        axes = ql.Axes([joint(), joint()], B0, u_min=-5.0, u_max=5.0, saturation=saturation)
        scenario = ql.Scenario(reference=REFERENCES, duration=2.0)
        run = ql.simulate(two_masses(0.4), axes, scenario)
        assert ql.Status.SATURATED in run.status
        assert np.max(np.abs(run["u"])) <= 5.0
        np.testing.assert_allclose(run["v"], run["u"] @ B0.T, atol=1e-12)
        for i, damping in enumerate((0.5, 2.0)):
            true = -damping * run["x"][:, 2 * i + 1]
            wrong = run.axis(i)["f_hat"] - true
            # The lag of the observer, 3/ω_o, times the rate of f.
            assert np.max(np.abs(wrong)) < 1.2 * 3.0 / 60.0 * np.max(np.abs(np.diff(true))) / DT

    def test_rates_are_limited_for_each_actuator(self) -> None:
        """No control signal changes faster than its own limit."""
        axes = ql.Axes([joint(), joint()], rate_limit=[100.0, (-20.0, 50.0)])
        scenario = ql.Scenario(reference=(1.0, 1.0), duration=0.5)
        u = ql.simulate(two_masses(), axes, scenario)["u"]
        changes = np.diff(u, axis=0) / DT
        assert np.max(np.abs(changes[:, 0])) <= 100.0 * (1.0 + 1e-9)
        assert -20.0 - 1e-6 <= np.min(changes[:, 1]) <= np.max(changes[:, 1]) <= 50.0 + 1e-6

    def test_limits_can_change_while_running(self) -> None:
        """The next step is within the new limits, and what is not given stays."""
        axes = ql.Axes([joint(), joint()], u_min=-10.0, u_max=10.0)
        assert axes.step([1.0, 1.0], [0.0, 0.0]).tolist() == [10.0, 10.0]
        axes.set_limits(u_max=[3.0, 4.0])
        assert axes.step([1.0, 1.0], [0.0, 0.0]).tolist() == [3.0, 4.0]
        assert axes.limits.low.tolist() == [-10.0, -10.0]

    def test_an_axis_is_not_changed_behind_the_back_of_all_axes(self) -> None:
        """``retune`` and ``set_limits`` of one inside are refused; a copy is a controller."""
        axes = ql.Axes({"x": joint(), "y": joint()})
        other = joint().observer
        for one in (axes, copy.copy(axes), pickle.loads(pickle.dumps(axes))):
            before = one.axes[1].omega_c
            for change in ("retune", "prepare_retune"):
                with pytest.raises(ValueError, match=r"axis 'y' of .*call axes.retune\('y'"):
                    getattr(one.axes[1], change)(omega_c=3.0)
            with pytest.raises(ValueError, match=r"axis 'x' of .*call axes.set_limits"):
                one.axes[0].set_limits(u_max=1.0)
            assert one.axes[1].omega_c == before
            one.retune("y", omega_c=3.0, observer=other)
            with pytest.raises(ValueError, match="omega_c = -1"):
                one.retune("y", omega_c=-1.0)
            with pytest.raises(ValueError, match="axis 'y'"):
                one.axes[1].retune(omega_c=before)
        alone = copy.copy(axes.axes[1])
        alone.retune(omega_c=2.0)
        alone.set_limits(u_max=1.0)

    def test_what_was_applied_reaches_the_observers(self) -> None:
        """``applied`` with a smaller u is a controller with that limit."""
        free, limited = ql.Axes([joint(), joint()]), ql.Axes([joint(), joint()], u_max=2.0)
        y = np.zeros(2)
        for _ in range(20):
            u = limited.step([0.1, 0.2], y)
            free.step([0.1, 0.2], y)
            free.applied(u)
            y = y + 1e-4
        for one, other in zip(free.estimates.values(), limited.estimates.values(), strict=True):
            np.testing.assert_allclose(one.x, other.x, rtol=1e-12)
            assert one.f == pytest.approx(other.f, rel=1e-12)


def allocation(B0: object, saturation: object = "each", high: float = 1.0, **kw: object) -> object:
    """Return a function from v to u, and the flags, for one sample from u = 0."""
    gain = checked_gain(B0, None, kw.pop("weights", None), NAMES[: len(B0)], 2)  # type: ignore[arg-type,call-overload]
    n, m = gain.shape
    rule = checked_rule(saturation, kw.pop("wished", None), gain, NAMES[:n])
    limits: ActuatorLimits = checked_actuator_limits(-high, high, kw.get("rate", np.inf), m, DT)

    def solve(v: object) -> tuple[np.ndarray, int]:
        u, wanted = np.zeros(m), np.asarray(v, dtype=float)
        with np.errstate(all="ignore"):
            flags = allocate(
                rule, limits, gain.memory(), range_memory(n, m, rule), wanted, np.zeros(m), u
            )
        return u, flags

    return solve


class TestAllocation:
    """From what the axes ask for to the actuators."""

    @cases("seed", range(20))
    @cases("saturation", ["each", "direction", "order"])
    def test_what_is_possible_is_done(self, seed: int, saturation: str) -> None:
        """Within the limits B0 u is what the axes ask for."""
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 4))
        m = n + int(rng.integers(0, 3))
        B0 = rng.standard_normal((n, m))
        possible = rng.uniform(-0.3, 0.3, m)
        rule = list(NAMES[:n]) if saturation == "order" else saturation
        if np.linalg.cond(B0) > 20.0:
            return
        u, flags = allocation(B0, rule, high=3.0)(B0 @ possible)  # type: ignore[operator]
        np.testing.assert_allclose(B0 @ u, B0 @ possible, atol=1e-10)
        assert flags == 0
        assert np.linalg.norm(u) <= np.linalg.norm(possible) * (1.0 + 1e-9)

    def test_direction_is_kept(self) -> None:
        """``"direction"`` gives a share of what the axes ask for."""
        rng = np.random.default_rng(1)
        B0 = np.eye(3) + 0.3 * rng.standard_normal((3, 3))
        v = np.array([4.0, -1.0, 2.0])
        u, flags = allocation(B0, "direction")(v)  # type: ignore[operator]
        share = (B0 @ u) / v
        assert np.ptp(share) < 1e-12
        assert 0.0 < share[0] < 1.0
        assert np.max(np.abs(u)) == pytest.approx(1.0)
        assert flags == int(ql.Status.SATURATED)

    @cases("seed", range(60))
    def test_priority_is_least_squares_with_weights_of_the_axes(self, seed: int) -> None:
        """SciPy's solver finds the same v; an axis counts 100 times as much as the next one."""
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 4))
        m = n + int(rng.integers(0, 4))
        B0, v = rng.standard_normal((n, m)), 3.0 * rng.standard_normal(n)
        order = [NAMES[i] for i in rng.permutation(n)]
        u, flags = allocation(B0, order)(v)  # type: ignore[operator]
        reach = np.sum(np.abs(B0), axis=1)  # of each axis alone, |u| up to 1
        ranks = np.array([order.index(name) for name in NAMES[:n]])
        rows = 1e3 * 10.0 ** (n - 1 - ranks) / np.linalg.norm(B0, axis=1)
        whole = np.vstack([rows[:, None] * B0, np.eye(m)])
        target = np.append(rows * np.clip(v, -reach, reach), np.zeros(m))
        best = lsq_linear(whole, target, (-1.0, 1.0), tol=1e-14)
        assert np.max(np.abs(u)) <= 1.0
        if flags:
            np.testing.assert_allclose(rows * (B0 @ u), rows * (B0 @ best.x), atol=2e-2)
            np.testing.assert_allclose(u, best.x, atol=2e-3)

    @pytest.mark.parametrize("order", [["x", "y", "z"], ["z", "x", "y"]])
    def test_an_actuator_at_its_limit_does_not_stop_the_others(self, order: list[str]) -> None:
        """A craft turns with all that its rotors have, 2 · 5.8 N · 0.015 m, not with 4 · 2.3 N."""
        B0 = rotor_levers(0.17, 0.015)
        gain = checked_gain(B0, None, None, NAMES, 2)
        rule = checked_rule(order, [2.5] * 4, gain, NAMES)
        limits = checked_actuator_limits(0.2, 6.0, np.inf, 4, DT)
        u, room = np.zeros(4), range_memory(3, 4, rule)
        flags = allocate(rule, limits, gain.memory(), room, np.array([0, 0, 9.0]), np.zeros(4), u)
        assert (B0 @ u)[2] == pytest.approx(2.0 * 5.8 * 0.015, rel=1e-5)
        assert flags == int(ql.Status.SATURATED)

    @cases("much", [1.0, 30.0, 1e6, 1e300])
    def test_an_axis_that_asks_for_more_than_there_is_takes_no_more(self, much: float) -> None:
        """Whatever yaw asks for, roll before it gets what it needs within 1 % of its reach."""
        B0 = rotor_levers(0.17, 0.015)
        solve = allocation(B0, ["x", "y", "z"])
        u, _ = solve([0.2, 0.0, much])  # type: ignore[operator]
        assert (B0 @ u)[0] == pytest.approx(0.2, abs=0.01 * np.sum(np.abs(B0[0])))

    def test_an_actuator_of_little_use_is_left_to_the_later_axis(self) -> None:
        """It gives the first axis 3 % of what its own does: the second one keeps it."""
        u, _ = allocation([[1.0, 0.03], [0.0, 1.0]], ["x", "y"])([50.0, -0.5])  # type: ignore[operator]
        assert u[0] == 1.0
        assert u[1] == pytest.approx(-0.5, abs=0.15)

    @cases("seed", range(60))
    def test_more_actuators_solve_least_squares_within_limits(self, seed: int) -> None:
        """SciPy's solver finds the same u, with weights and a wished u."""
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 4))
        m = n + int(rng.integers(1, 4))
        B0, v = rng.standard_normal((n, m)), 2.0 * rng.standard_normal(n)
        weights, wished = rng.uniform(0.2, 1.0, m), rng.uniform(-0.5, 0.5, m)
        u, flags = allocation(B0, weights=weights, wished=wished)(v)  # type: ignore[operator]
        rows = 1e4 / np.linalg.norm(B0, axis=1)
        scale = np.sqrt(weights / weights.max())
        whole = np.vstack([rows[:, None] * B0, np.diag(scale)])
        best = lsq_linear(whole, np.append(rows * v, scale * wished), (-1.0, 1.0), tol=1e-14)
        assert np.max(np.abs(u)) <= 1.0
        if flags:
            np.testing.assert_allclose(u, best.x, atol=1e-5)

    def test_actuators_stay_near_what_is_wished(self) -> None:
        """A craft that hovers keeps its thrust: the torques add nothing to the sum."""
        B0 = rotor_levers(0.17, 0.015)
        solve = allocation(B0, high=6.0, wished=[2.5] * 4)
        u, flags = solve([0.1, -0.05, 0.01])  # type: ignore[operator]
        assert np.sum(u) == pytest.approx(10.0, abs=1e-12)
        np.testing.assert_allclose(B0 @ u, [0.1, -0.05, 0.01], atol=1e-12)
        assert flags == 0

    @cases("saturation", ["each", "direction", "order"])
    @cases("bad", [np.nan, np.inf, -np.inf])
    def test_no_v_makes_a_u_that_is_no_number(self, saturation: str, bad: float) -> None:
        """Whatever the axes ask for, u is finite and within the limits."""
        rule = ["x", "y"] if saturation == "order" else saturation
        for B0 in (np.eye(2), np.array([[1.0, 0.2, 0.3], [0.1, 1.0, 0.4]])):
            u, flags = allocation(B0, rule)([1.0, bad])  # type: ignore[operator]
            assert np.all(np.abs(u) <= 1.0)
            assert flags != 0


class TestFunctionOfTheEstimates:
    """B0, or its inverse M, as a function."""

    @pytest.mark.trial
    def test_a_function_that_is_constant_is_the_matrix(self) -> None:
        """B0 as a matrix, as a function, and M as a function give one run."""

        def gain(x):  # type: ignore[no-untyped-def]
            return (1.0, 0.4), (0.4, 1.0)

        matrix = np.array([[1.0, 0.4], [0.4, 1.0]])
        M = np.linalg.inv(matrix)
        a, b, c = M[0, 0], M[0, 1], M[1, 1]

        def mass(x):  # type: ignore[no-untyped-def]
            return np.array([[a, b], [b, c]])

        scenario = ql.Scenario(reference=REFERENCES, duration=1.0)
        kinds = ({"B0": matrix}, {"B0": gain}, {"M": mass}, {"M": M})
        runs = [
            ql.simulate(two_masses(0.4), ql.Axes([joint(), joint()], **kind), scenario)  # type: ignore[arg-type]
            for kind in kinds
        ]
        for run in runs[1:]:
            np.testing.assert_allclose(run["y"], runs[0]["y"], atol=1e-11)

    @pytest.mark.trial
    def test_a_matrix_that_is_not_good_is_not_used(self) -> None:
        """NaN and a singular matrix leave the last good one, and set a flag."""

        def gain(x):  # type: ignore[no-untyped-def]
            if x[0, 0] > 2.0:
                return (np.nan, 0.0), (0.0, 1.0)
            if x[0, 0] > 1.0:
                return (1.0, 1.0), (1.0, 1.0)
            return (2.0, 0.0), (0.0, 4.0)

        axes = ql.Axes([joint(), joint()], gain)
        for y in (0.0, 1.5, 2.5):
            axes.start([y, 0.0])
            u = axes.step([y + 0.1, 0.1], [y, 0.0])
            assert (ql.Status.GAIN_HELD in axes.status) == (y > 1.0)
            assert u[0] == pytest.approx(2.0 * u[1], rel=1e-6)

    @pytest.mark.trial
    def test_an_arm_with_its_mass_matrix_follows_better(self) -> None:
        """The arm's M(q) leaves a part of the error of its diagonal at rest."""
        arm = ql.plants.arm(gravity=0.0)
        references = (ql.signals.Sinusoid(0.5, 4.0), ql.signals.Sinusoid(0.8, 6.0))
        scenario = ql.Scenario(reference=references, duration=6.0)
        rms = []
        for M in (arm.inertia, np.diag(np.diag(arm.mass_matrix([0.0, 0.0])))):
            run = ql.simulate(arm, ql.Axes([joint(), joint()], M=M), scenario)
            ideal = ql.simulate(two_masses(), ql.Axes([joint(), joint()]), scenario)
            rms.append(np.sqrt(np.mean((run["y"] - ideal["y"])[2000:] ** 2, axis=0)))
        assert np.all(rms[0] < 0.7 * rms[1])


class TestOperation:
    """Start under load, manual operation, changes while running."""

    def test_an_arm_starts_without_a_bump_under_gravity(self) -> None:
        """The first u is that which holds the arm."""
        arm = ql.plants.arm()
        q = np.array([0.3, 0.4])
        rate = arm.sampled(1e-3, interpret=True).rate
        holding = -rate(0.0, np.array([*q, 0.0, 0.0]), np.zeros(2), np.zeros(2))[2:]
        u = arm.mass_matrix(q) @ holding
        axes = ql.Axes([joint(), joint()], M=arm.inertia)
        axes.start(q, u)
        np.testing.assert_allclose(axes.step(q, q), u, rtol=1e-9)
        assert axes.estimates["axis1"].f == pytest.approx(-holding[0], rel=1e-6)

    def test_manual_operation_ends_without_a_bump(self) -> None:
        """After ``hand_over`` the first u is that of manual operation."""
        axes = ql.Axes([joint(), joint()], [[1, 0.4], [0.4, 1]])
        for _ in range(50):
            axes.track([0.0, 0.0], [0.2, 0.1], [0.7, -0.3])
        axes.hand_over()
        np.testing.assert_allclose(axes.step([0.0, 0.0], [0.2, 0.1]), [0.7, -0.3], atol=1e-9)

    def test_hand_over_needs_a_sample(self) -> None:
        """Before the first sample there is nothing to continue from."""
        with pytest.raises(ValueError, match="hand_over: there was no sample yet"):
            ql.Axes([joint(), joint()]).hand_over()

    def test_one_axis_is_retuned_while_running(self) -> None:
        """The other axis goes on as before, and u of the first does not jump."""
        one, other = (ql.Axes({"a": joint(), "b": joint()}) for _ in range(2))
        for axes in (one, other):
            for _ in range(30):
                axes.step([0.1, 0.1], [0.0, 0.0])
        one.retune("a", omega_c=12.0)
        after, before = (axes.step([0.1, 0.1], [0.0, 0.0]) for axes in (one, other))
        assert after[1] == before[1]
        assert after[0] == pytest.approx(before[0], rel=0.02)
        assert one.axes[0].omega_c == 12.0

    def test_a_copy_goes_on_alike(self) -> None:
        """A copy has the state of the original, and is apart from it."""
        arm = ql.plants.arm(gravity=0.0)
        axes = ql.Axes([joint(learner=ql.learners.RLS()), joint()], M=arm.inertia)
        for k in range(50):
            axes.step([0.1, 0.2], [1e-3 * k, 0.0])
        twin = copy.copy(axes)
        assert (
            twin.step([0.1, 0.2], [0.05, 0.0]).tolist()
            == axes.step([0.1, 0.2], [0.05, 0.0]).tolist()
        )
        before = axes.estimates["axis1"].x.copy()
        twin.step([0.1, 0.2], [0.5, 0.0])
        assert np.array_equal(axes.estimates["axis1"].x, before)

    @pytest.mark.trial
    def test_feedforward_follows_without_lag(self) -> None:
        """With the references' derivatives each axis follows a sine far better."""
        scenario = ql.Scenario(reference=(ql.signals.Sinusoid(0.5, 3.0),) * 2, duration=4.0)
        errors = []
        for feedforward in (False, True):
            axes = ql.Axes([joint(feedforward=feedforward), joint(feedforward=feedforward)])
            run = ql.simulate(two_masses(), axes, scenario)
            errors.append(np.abs((run["r"] - run["y"])[1000:]).max(axis=0))
        assert np.all(errors[1] < 0.05 * errors[0])


class TestRuns:
    """``simulate`` and its record."""

    @pytest.mark.trial
    def test_interpreted_is_compiled(self) -> None:
        """The same functions as Python give the same run, with learner, guard and a function."""
        arm = ql.plants.arm()
        axes = ql.Axes(
            [joint(learner=ql.learners.Harmonic(), guard=ql.Guard()), joint(omega_o=50.0)],
            M=arm.inertia,
            u_max=30.0,
        )
        scenario = ql.Scenario(reference=REFERENCES, duration=0.3, noise=0.001)
        one = ql.simulate(arm, axes, scenario)
        other = ql.simulate(arm, axes, scenario, interpret=True)
        np.testing.assert_allclose(one.log, other.log, rtol=1e-7, atol=1e-7)

    @pytest.mark.trial
    def test_record_is_saved_whole(self, tmp_path) -> None:  # type: ignore[no-untyped-def]
        """Channels, names and status come back; an axis is a record with metrics and plot."""
        axes = ql.Axes({"shoulder": joint(learner=ql.learners.RLS()), "elbow": joint()})
        run = ql.simulate(two_masses(), axes, ql.Scenario(reference=REFERENCES, duration=1.0))
        run.save(tmp_path / "run.nc")
        found = ql.Trajectory.load(tmp_path / "run.nc")
        assert np.array_equal(found.log, run.log)
        assert found.axis_names == run.axis_names
        assert found.channels == tuple(each for each in run.channels if each[1])
        own = found.axis("shoulder")
        assert own.features == axes.axes[0].features
        assert own["theta"].shape == (1001, len(own.features))
        assert own.metrics()["overshoot"] == run.metrics()["shoulder"]["overshoot"]
        assert len(own.plot()) == 4
        assert run.plot().size == 7
        run.to_csv(tmp_path / "run.csv")
        head = (tmp_path / "run.csv").read_text().partition("\n")[0]
        assert "elbow.x_hat[1]" in head

    @pytest.mark.lost
    def test_a_loop_that_diverges_ends(self) -> None:
        """The wrong sign of B0 is reported with a time."""
        axes = ql.Axes([joint(), joint()], -np.eye(2))
        run = ql.simulate(two_masses(), axes, ql.Scenario(reference=(1.0, 0.0), duration=20.0))
        assert run.diverged
        assert run.ended < 20.0
        assert "went beyond limit" in run.message

    def test_noise_of_each_output_is_its_own(self) -> None:
        """One noise for all has other numbers at each output."""
        noise = ql.signals.BandLimitedNoise(power=1e-9, sample_time=DT)
        scenario = ql.Scenario(reference=(0.0, 0.0), duration=1.0, noise=noise)
        run = ql.simulate(two_masses(), ql.Axes([joint(), joint()]), scenario)
        added = run["y_measured"] - run["y"]
        assert abs(np.corrcoef(added.T)[0, 1]) < 0.1
        assert np.std(added, axis=0) == pytest.approx([1e-3, 1e-3], rel=0.1)


GOOD = (joint(), joint())
BAD: tuple[tuple[object, str], ...] = (
    (lambda: ql.Axes([]), "axes has no entries"),
    (lambda: ql.Axes(joint()), "axes = ADRC.*: must be an ADRC for each axis, in a list"),  # type: ignore[arg-type]
    (lambda: ql.Axes(GOOD).step(0.1, 0.2), "r = 0.1, y = 0.2: each must have 2 numbers"),  # type: ignore[arg-type]
    (lambda: ql.Axes(GOOD).step([0.1], [0.2]), "each must have 2 numbers"),
    (lambda: ql.Axes(GOOD, u_min=3.0, u_max=2), r"u\[0\]: u_min = 3.0, u_max = 2: u_min must"),
    (lambda: ql.Axes([joint(), 3.0]), "axis2 = 3.0: must be an ADRC"),  # type: ignore[list-item]
    (lambda: ql.Axes([joint(u_max=1.0), joint()]), "axis1 has limits of u: must have none"),
    (lambda: ql.Axes(GOOD, np.eye(3)), r"B0 has shape \(3, 3\), there are 2 axes \(axis1, axis2\)"),
    (lambda: ql.Axes(GOOD, [[1, 2], [2, 4]]), "is singular"),
    (lambda: ql.Axes(GOOD, [[1, 2], [0, 0]]), "no actuator moves axis 'axis2'"),
    (lambda: ql.Axes(GOOD, np.eye(2), M=np.eye(2)), "B0 and M are both given"),
    (lambda: ql.Axes(GOOD, u_max=[1.0]), "u_max has 1 values, there are 2 actuators"),
    (lambda: ql.Axes(GOOD, u_min=[-1, 3], u_max=2), r"u\[1\]: u_min"),
    (lambda: ql.Axes(GOOD, saturation="scale"), "saturation = 'scale'"),
    (lambda: ql.Axes(GOOD, saturation=["axis1"]), "all axes in the order of their priority"),
    (lambda: ql.Axes(GOOD, weights=[1, 2]), "leave them out"),
    (lambda: ql.Axes(GOOD, wished=[1, 2]), "leave it out"),
    (lambda: ql.Axes(GOOD, lambda x: x[3]), "B0.zeros. fails"),
    (lambda: ql.Axes(GOOD).step([1.0], [1.0, 2.0, 3.0]), "each must have 2 numbers"),
    (lambda: ql.Axes(GOOD).retune(0, omega_c=-1.0), "omega_c"),
    (lambda: ql.Axes(GOOD).retune("tool", omega_c=1.0), "axis = 'tool'"),
    (
        lambda: ql.simulate(two_masses(), joint(), ql.Scenario()),
        "2 control signals and 2 outputs, the controller 1 and 1: control it by quell.Axes",
    ),
    (
        lambda: ql.simulate(ql.plants.two_mass_spring(), ql.Axes(GOOD), ql.Scenario()),
        "has 1 control signal and 1 output, the controller 2 and 2",
    ),
    (
        lambda: ql.simulate(two_masses(), ql.Axes([joint()]), ql.Scenario()),
        "has 2 control signals and 2 outputs, the controller 1 and 1",
    ),
    (
        lambda: ql.simulate(two_masses(), ql.Axes(GOOD), ql.Scenario(reference=(1.0,))),
        "reference has 1 signal: there are 2 axes",
    ),
    (
        lambda: ql.simulate(ql.plants.two_mass_spring(), joint(), ql.Scenario(reference=(1, 2))),
        r"reference = \(1, 2\): is a list of 2 signals, and the loop has one output",
    ),
    (
        lambda: ql.controllers.Prefiltered(ql.Axes(GOOD), ql.baselines.ZV(3.0)),
        "2 control signals and 2 outputs: NOT possible here yet",
    ),
)


@cases(("wrong", "message"), BAD, ids=range(len(BAD)))
def test_what_does_not_fit_is_named(wrong, message: str) -> None:  # type: ignore[no-untyped-def]
    """Errors name the axis, the shapes and the rule."""
    with pytest.raises(ValueError, match=message):
        wrong()


def test_a_nearly_singular_matrix_is_warned_of() -> None:
    """The warning names the condition number; units of the axes do not count."""
    with pytest.warns(ql.DesignWarning, match="B0 is badly conditioned, "):
        ql.Axes(GOOD, [[1.0, 0.99], [0.99, 1.0]])
    ql.Axes(GOOD, [[1e6, 0.0], [0.0, 1e-4]])
