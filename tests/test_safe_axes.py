"""The safe sets of several axes: the nearest u within limits and bands, or a proof that there is none."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog, nnls

import quell as ql
from quell.controllers import safe_axes
from quell.controllers.allocation import GainMemory
from quell.controllers.safe_axes import SafeAxesDesign, nearest, safe_axes_memory
from quell.kernels.dispatch import as_python

from .cases import cases

DT = 1e-3


def joint(safe_set: Any = None, omega_c: float = 12.0, order: int = 2) -> ql.ADRC:
    """Return a controller of an axis."""
    observer = ql.ESO.model_free(order=order, b0=1.0, omega_o=150.0, dt=DT)
    return ql.ADRC(observer, omega_c, safe_set=safe_set)


# ---- The quadratic program ----


def drawn_case(seed: int) -> dict[str, Any] | None:
    """Return a B0, limits and bounds in units from 1e-3 to 1e3; None for a poor B0."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    m = n + int(rng.integers(0, 3))
    units = 10.0 ** rng.uniform(-3, 3, m)
    B = rng.standard_normal((n, m)) * (10.0 ** rng.uniform(-4, 4, n))[:, None]
    if np.linalg.cond(B / np.linalg.norm(B, axis=1)[:, None]) > 100.0:
        return None
    B = B / units
    low, high = -units * rng.uniform(0.1, 1, m), units * rng.uniform(0.1, 1, m)
    start = rng.uniform(low, high)
    at_end = rng.random(m)
    start = np.where(at_end < 0.2, low, np.where(at_end < 0.4, high, start))
    if rng.random() < 0.2:
        high[0] = np.inf
    if rng.random() < 0.2:
        low[-1] = start[-1]
    middle = B @ (units * rng.uniform(-0.6, 0.6, m))
    half = np.abs(B) @ units * 10.0 ** rng.uniform(-3, 0, n)
    lo = np.where(rng.random(n) < 0.3, -np.inf, middle - half)
    hi = np.where(rng.random(n) < 0.3, np.inf, middle + half)
    return {
        "B": B, "weights": rng.uniform(0.2, 1, m) / units**2, "start": start,
        "low": np.append(low, lo), "high": np.append(high, hi), "units": units,
    }  # fmt: skip


def solved(case: dict[str, Any], soft: bool = False) -> tuple[bool, Any, Any]:
    """Return whether there is a u, u, and the room with the multipliers."""
    B = case["B"]
    n, m = B.shape
    memory = safe_axes_memory(SafeAxesDesign(case["weights"], np.full(n, math.inf)), n, m)
    gain = GainMemory(B, np.zeros((m, n)), np.zeros((n, m)), np.zeros((n, 2 * n)))
    memory.low[:], memory.high[:], memory.start[:] = case["low"], case["high"], case["start"]
    u = case["start"].copy()
    return nearest(gain, case["weights"], memory, soft, u), u, memory


def rows_of(case: dict[str, Any]) -> tuple[Any, Any, Any]:
    """Return all bounds as ``rows u ≤ ends``, and the scale of each, with u in units of one."""
    B, units = case["B"], case["units"]
    R = np.vstack([np.eye(units.size), B]) * units
    R = np.vstack([R, -R])
    ends = np.append(case["high"], -case["low"])
    scale = np.linalg.norm(R, axis=1)
    kept = np.isfinite(ends)
    return (R / scale[:, None])[kept], (ends / scale)[kept], scale[kept]


def by_least_distance(case: dict[str, Any]) -> Any:
    """Return the solution by Lawson and Hanson's least-distance programming, with SciPy's NNLS."""
    root = np.sqrt(case["weights"])
    R, ends, scale = rows_of(case)
    rows = R * scale[:, None] / case["units"] / root
    size = np.linalg.norm(rows, axis=1)
    away = (ends * scale - rows @ (root * case["start"])) / size
    E = np.vstack([-(rows / size[:, None]).T, -away])
    goal = np.append(np.zeros(root.size), 1.0)
    found = E @ nnls(E, goal, maxiter=1000)[0] - goal
    return case["start"] - found[:-1] / found[-1] / root


class TestQuadraticProgram:
    """The solver against those of SciPy, and against the conditions of an optimum."""

    @pytest.mark.parametrize("block", range(4))
    def test_the_nearest_u_is_that_of_scipy(self, block: int) -> None:
        """Where there is one; where not, a linear program finds that the bounds are at odds."""
        counts = [0, 0]
        for seed in range(100 * block, 100 * block + 100):
            case = drawn_case(seed)
            if case is None:
                continue
            R, ends, _ = rows_of(case)
            widest = linprog(
                np.append(np.zeros(R.shape[1]), -1.0), np.column_stack([R, np.ones(ends.size)]),
                ends, bounds=[(None, None)] * R.shape[1] + [(None, 1.0)],
            )  # fmt: skip
            if abs(widest.x[-1]) < 1e-7:  # a slack of zero but for the tolerance of the program
                continue
            there_is, u, _ = solved(case)
            assert there_is == (widest.x[-1] > 0.0)
            counts[there_is] += 1
            if there_is:
                np.testing.assert_allclose(
                    u / case["units"], by_least_distance(case) / case["units"], atol=1e-7
                )
        assert counts[1] > 40
        assert counts[0] > 2

    @pytest.mark.parametrize("soft", [False, True])
    def test_the_conditions_of_an_optimum_hold(self, soft: bool) -> None:
        """Bounds are kept, multipliers have the sign of the side that is held, and u follows from them."""
        for seed in range(1000, 1200):
            case = drawn_case(seed)
            if case is None:
                continue
            there_is, u, memory = solved(case, soft)
            if not there_is:
                assert not soft
                continue
            B, (n, m) = case["B"], case["B"].shape
            R = np.vstack([np.eye(m), B])
            G = np.diag(R / case["weights"] @ R.T)
            slack = np.where(np.arange(n + m) < m, 0.0, 1e-8 * soft * G * memory.multipliers)
            value, size = R @ u, np.abs(R) @ (np.abs(u) + np.abs(case["start"]))
            tolerance = 1e-6 * size if soft else 1e-9 * size
            assert np.all(value - slack <= case["high"] + tolerance)
            assert np.all(value - slack >= case["low"] - tolerance)
            assert np.all(memory.multipliers * memory.held >= 0.0)
            assert np.all(memory.multipliers[memory.held == 0.0] == 0.0)
            for side, bound in ((1.0, case["high"]), (-1.0, case["low"])):
                at = memory.held == side
                assert np.all(np.abs(value - slack - bound)[at] <= tolerance[at])
            expected = case["start"] - R.T @ memory.multipliers / case["weights"]
            np.testing.assert_allclose(u, expected, rtol=1e-6, atol=0.0)

    def test_rounds_are_few(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A third of the limit at most, for drawn cases with a solution and without."""
        rounds, shares = [0], []
        real = safe_axes.solve_free

        def counted(*arguments: Any) -> None:
            rounds[0] += 1
            real(*arguments)

        monkeypatch.setattr(safe_axes, "solve_free", counted)
        for seed in range(2000, 2300):
            case = drawn_case(seed)
            for soft in (False, True):
                if case is not None:
                    rounds[0] = 0
                    solved(case, soft)
                    shares.append(rounds[0] / (sum(case["B"].shape) * safe_axes._ROUNDS))
        assert max(shares) < 1.0 / 3.0

    def test_a_slack_is_the_least_that_limits_allow(self) -> None:
        """One actuator, two axes at odds: the misses are equal where their bands are of one size."""
        case = {
            "B": np.array([[1.0], [1.0]]), "weights": np.ones(1), "start": np.zeros(1),
            "low": np.array([-5.0, 2.0, -np.inf]), "high": np.array([5.0, np.inf, 1.0]),
        }  # fmt: skip
        assert not solved(case)[0]
        there_is, u, _ = solved(case, soft=True)
        assert there_is
        assert u[0] == pytest.approx(1.5, abs=1e-7)


# ---- In the loop ----

B0 = np.array([[1.0, 0.6], [0.5, 1.0]])


def masses(B: Any = B0) -> ql.plants.LinearPlant:
    """Return two masses that both forces move."""
    A, inputs = np.zeros((4, 4)), np.zeros((4, 2))
    A[0, 1] = A[2, 3] = 1.0
    inputs[1], inputs[3] = B
    return ql.plants.LinearPlant(A, inputs, [[1, 0, 0, 0], [0, 0, 1, 0]])


# The first axis is pushed to its border while the second takes the actuators to their limits.
FAR = ql.Scenario(
    reference=(ql.signals.Step(30.0, 0.5), ql.signals.Sinusoid(100.0, 8.0)), duration=2.0
)


class TestLoop:
    """Axes with bands, and actuators that are short of what they are asked for."""

    @pytest.mark.trial
    @pytest.mark.parametrize("saturation", ["each", "direction", ["axis2", "axis1"]])
    def test_actuators_at_their_limits_leave_no_band(self, saturation: Any) -> None:
        """Without the actuators in common an axis leaves its band, in the same run."""
        safe, reached = ql.SafeSet(-1.0, 1.0, alpha=12.0, f_rate=1.0), []
        for together in (True, False):
            axes = ql.Axes(
                [joint(safe), joint(safe)], B0, u_min=-60.0, u_max=60.0, saturation=saturation
            )
            if not together:
                axes.parameters = axes.parameters._replace(safe=safe_axes.NoSafeAxes())
                room = safe_axes.NoSafeAxesMemory(np.zeros(0))
                axes._use_state(axes._state._replace(safe=room))
                axes.initial_state = lambda state=axes._state: state  # type: ignore[method-assign]
            run = ql.simulate(masses(), axes, FAR)
            assert np.max(np.abs(run["u"])) <= 60.0
            reached.append(np.max(np.abs(run["y"])))
            if together:
                assert ql.Status.SAFE_SET_ACTED in run.status
                assert ql.Status.UNSAFE not in run.status
        assert 0.99 < reached[0] <= 1.0 + 1e-9
        assert reached[1] > 1.1

    @pytest.mark.trial
    def test_a_band_that_is_far_changes_no_bit(self) -> None:
        """The run is that without safe sets, at limits of the actuators, too."""
        wide = ql.SafeSet(-1e3, 1e3, alpha=12.0)
        logs = []
        for safe in (wide, None):
            axes = ql.Axes([joint(safe), joint(safe)], B0, u_min=-5.0, u_max=5.0)
            run = ql.simulate(masses(), axes, ql.Scenario(reference=(1.0, -1.0), duration=1.0))
            assert ql.Status.SATURATED in run.status
            assert ql.Status.SAFE_SET_ACTED not in run.status
            logs.append((run["u"], run["y"]))
        for one, other in zip(*logs, strict=True):
            assert np.array_equal(one, other)

    def test_where_actuators_are_too_weak_the_axis_is_named(self) -> None:
        """``UNSAFE`` is in the status of the axis that leaves its bounds, and u within its limits."""
        safe = ql.SafeSet(-1.0, 1.0, alpha=12.0)
        axes = ql.Axes({"x": joint(safe), "y": joint()}, B0, u_min=-1.0, u_max=1.0)
        axes.start([0.0, 0.0])
        y, found = 0.0, ql.Status.OK
        for k in range(300):
            y += 0.02 * min(1.0, k / 200.0)  # somebody pushes the axis towards its border
            u = axes.step([0.0, 0.0], [y, 0.0])
            assert np.max(np.abs(u)) <= 1.0
            found |= axes.estimates["x"].status
            assert ql.Status.UNSAFE not in axes.estimates["y"].status
        assert ql.Status.UNSAFE in found
        assert ql.Status.UNSAFE in axes.status

    @pytest.mark.trial
    def test_bands_of_the_rate_hold_beside_those_of_y(self) -> None:
        """At the limits of the actuators, y' and y of both axes stay in their bands."""
        safe = ql.SafeSet(-1.0, 1.0, -2.0, 2.0, alpha=12.0, f_rate=1.0)
        axes = ql.Axes([joint(safe), joint(safe)], B0, u_min=-60.0, u_max=60.0)
        run = ql.simulate(masses(), axes, FAR)
        assert np.max(np.abs(run["y"])) <= 1.0 + 1e-9
        assert 1.9 < np.max(np.abs(run["x"][:, [1, 3]])) <= 2.0
        assert ql.Status.SATURATED in run.status
        assert ql.Status.UNSAFE not in run.status

    def test_a_band_of_the_rate_gives_way_to_that_of_y(self) -> None:
        """Where the limits allow one of both, y of the other axis stays in its band, and it is said."""
        gain = [[1.0, 1.0], [0.0, 1.0]]
        bands = (ql.SafeSet(-1.0, 1.0, alpha=12.0), ql.SafeSet(rate_max=0.1, alpha=12.0))
        axes = ql.Axes({"x": joint(bands[0]), "y": joint(bands[1])}, gain, u_min=-10.0, u_max=10.0)
        axes.axes[0].start_at([-1.1, 0.0])  # needs v of 14.4 at least
        axes.axes[1].start_at([0.0, 0.5])  # needs v of −4.8 at most
        u = axes.step([-1.1, 0.0], [-1.1, 0.5 * DT])
        np.testing.assert_allclose(u, [10.0, 4.4], atol=0.2)
        assert ql.Status.UNSAFE in axes.estimates["y"].status
        assert ql.Status.UNSAFE not in axes.estimates["x"].status

    def test_weights_say_which_actuator_gives_way(self) -> None:
        """The change is shared as 1/W, with as many actuators as axes, too."""
        gain = [[1.0, 0.5, 0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        safe = ql.SafeSet(-1.0, 1.0, alpha=12.0)
        for weights, share in (([1.0, 1.0, 3.0], 3.0), ([1.0, 3.0, 1.0], 1.0 / 3.0)):
            axes = ql.Axes(
                [joint(safe), joint(), joint()], gain, u_min=[-10.0, -90.0, -90.0], weights=weights
            )
            # The others ask for 40 each, so the first actuator would have to be at −26.
            u = axes.step([5.0, 40.0 / 144.0, 40.0 / 144.0], [0.9, 0.0, 0.0])
            assert u[0] == -10.0
            changes = 40.0 - u[1:]
            assert changes[0] == pytest.approx(share * changes[1], rel=1e-6)
            assert np.array(gain[0]) @ u == pytest.approx(14.4, rel=0.02)

    def test_interpreted_is_compiled(self) -> None:
        """With limits that bind, rates and a band of the rate."""
        safe = ql.SafeSet(-1.0, 1.0, -4.0, 4.0, alpha=12.0, f_rate=5.0)
        axes = ql.Axes([joint(safe), joint(safe)], B0, u_min=-90.0, u_max=90.0, rate_limit=2e4)
        short = ql.Scenario(reference=(ql.signals.Step(30.0), ql.signals.Step(-20.0)), duration=0.4)
        one = ql.simulate(masses(), axes, short)
        other = ql.simulate(masses(), axes, short, interpret=True)
        np.testing.assert_allclose(one.log, other.log, rtol=1e-7, atol=1e-7)

    @pytest.mark.trial
    def test_errors_of_b0_are_in_the_margin(self) -> None:
        """With a B0 that is 2 % off, nothing surprises a set that knows it; another one says ``UNSAFE``."""
        wrong = B0 * (1.0 + 0.02 * np.array([[1.0, -1.0], [-1.0, 1.0]]))
        largest = float(np.max(np.abs(B0) @ [60.0, 60.0]))
        for more in ({"gain_error": 0.02, "largest_u": largest}, {}):
            safe = ql.SafeSet(-1.0, 1.0, alpha=12.0, f_rate=1.0, **more)
            axes = ql.Axes([joint(safe), joint(safe)], B0, u_min=-60.0, u_max=60.0)
            run = ql.simulate(masses(wrong), axes, FAR)
            assert 0.95 < np.max(np.abs(run["y"])) <= 1.0
            assert (ql.Status.UNSAFE in run.status) == (not more)


def test_limits_that_are_refused_change_nothing() -> None:
    """Neither of axes nor of a single loop: the next change of something else is possible."""
    axes = _axes_with(largest_u=150.0)
    single = ql.Compensator(
        ql.ESO.model_free(2, 1.0, 150.0, DT), u_min=-1.0, u_max=1.0,
        safe_set=ql.SafeSet(y_max=1.0, gain_error=0.1),
    )  # fmt: skip
    for loop, more in ((axes, 100.0), (single, math.inf)):
        low, high, *_ = copy.deepcopy(loop.limits)
        with pytest.raises(ValueError, match=r"must be at least 160|give u_min and u_max"):
            loop.set_limits(u_max=more)
        loop.set_limits(rate_limit=1e3)
        assert np.array_equal(loop.limits.low, low)
        assert np.array_equal(loop.limits.high, high)
        assert np.array_equal(loop.parameters.limits.high, high)
    axes.retune("y", omega_c=13.0)
    assert axes.axes[1].omega_c == 13.0


def growing(x):  # type: ignore[no-untyped-def]
    """Return a B0 whose entries are twice as large from y_1 = 0.2 on."""
    return (1.0 + (x[0, 0] > 0.2), 0.4), (0.2, 2.0)


def _growing(gain_error: float = 0.02, largest_u: float = 70.0) -> ql.Axes:
    more = {"gain_error": gain_error, "largest_u": largest_u} if gain_error else {}
    bands = ql.SafeSet(-1e6, 1e6, alpha=12.0, f_rate=1.0, **more)  # is far
    return ql.Axes({"x": joint(bands), "y": joint()}, growing, u_min=-50.0, u_max=50.0)


@pytest.mark.parametrize(
    "make", [_growing, lambda: _growing(largest_u=121.0), lambda: _growing(0.0)]
)
def test_a_b0_that_makes_more_v_than_was_stated_is_unsafe(make: Any) -> None:
    """In the samples where the sum of |B0_ik u_k| is larger, of the axis whose margin it is."""
    axes = make()
    stated = axes.axes[0].safe_set.largest_u
    seen = set()
    with as_python():
        for k in range(60):
            u = axes.step([0.9, 3.0], [0.01 * k, 0.0])
            larger = (1.0 + (axes.axes[0]._state.estimates[0] > 0.2)) * abs(u[0]) + 0.4 * abs(u[1])
            unsafe = [ql.Status.UNSAFE in axis.estimate.status for axis in axes.axes]
            assert unsafe == [larger > stated, False]
            assert (ql.Status.UNSAFE in axes.status) == unsafe[0]
            seen.add(unsafe[0])
    assert seen == ({False, True} if stated == 70.0 else {False})


def _axes_with(**safe: Any) -> ql.Axes:
    bands = ql.SafeSet(-1.0, 1.0, alpha=12.0, gain_error=0.02, **safe)
    return ql.Axes({"x": joint(bands), "y": joint()}, B0, u_min=-90.0, u_max=90.0)


@cases(
    ("make", "message"),
    [
        (lambda: _axes_with(largest_u=20.0), "axes: x: safe_set.largest_u = 20.0: must be at least 144"),
        (lambda: _axes_with(largest_u=150.0).set_limits(u_max=100.0), "must be at least 160"),
        (lambda: _axes_with(largest_u=150.0).set_limits(u_max=math.inf), "the actuators have no limits"),
        (lambda: _axes_with(), "or largest_u for an axis of quell.Axes"),
        (lambda: ql.SafeSet(y_max=1.0, largest_u=3.0), "says what gain_error is of, which is 0"),
        (lambda: ql.SafeSet(y_max=1.0, gain_error=0.1, largest_u=-3.0), "largest_u = -3.0"),
        (
            lambda: ql.Compensator(
                ql.ESO.model_free(2, 1.0, 150.0, DT), u_min=-1.0, u_max=1.0,
                safe_set=ql.SafeSet(y_max=1.0, gain_error=0.1, largest_u=3.0),
            ),
            "limits of u say it",
        ),
    ],
)  # fmt: skip
def test_what_has_no_bound_is_refused(make: Any, message: str) -> None:
    """With the number that is needed."""
    with pytest.raises(ValueError, match=message):
        make()
