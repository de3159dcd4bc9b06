"""Moves within limits of speed, acceleration and jerk that are planned on line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import quell as ql
from quell.controllers import Prefiltered, ProfileGenerator
from quell.controllers.prefilters import prefilter, settle, stopping_point, write_derivatives
from quell.export import c_source
from quell.export.library.vectors import Action, Player
from quell.kernels.dispatch import as_python
from quell.signals.moves import PARTS, moved, plan

from .cases import cases
from .in_c import InC, needs_gcc

DT = 2e-3
LIMITS = (2.0, 30.0, 900.0)
V, A, J = LIMITS

positive = st.floats(0.1, 10.0)
targets = st.lists(st.tuples(st.integers(0, 300), st.floats(-2.0, 2.0)), min_size=1, max_size=6)


class Moving:
    """A generator that runs; ``rows`` has position, speed, acceleration and jerk of each sample."""

    def __init__(self, limits: tuple[float, float, float] = LIMITS, dt: float = DT) -> None:
        generator = ProfileGenerator(*limits)
        self.design = generator.design(dt)
        self.memory = generator.memory(self.design)
        self.rows: list[Any] = []

    def step(self, r: float) -> Any:
        """Take a sample; return its row."""
        row = np.empty(4)
        row[0] = prefilter(self.design, self.memory, r)
        write_derivatives(self.design, self.memory, row[1:])
        self.rows.append(row)
        return row

    def settle_at(self, r: float, most: int = 20_000) -> int:
        """Go on until it rests; return the number of samples."""
        for k in range(most):
            row = self.step(r)
            if row[0] == r and not np.any(row[1:]):
                return k
        raise AssertionError(f"it does not rest at {r!r}: {row}")

    def check(self, dt: float = DT) -> None:
        """No limit is exceeded, and each row is the slope of the next one."""
        rows, design = np.array(self.rows), self.design
        for column, most in zip(
            rows.T[1:], (design.v_max, design.a_max, design.j_max), strict=True
        ):
            assert np.max(np.abs(column)) <= most * (1.0 + 1e-12)
        change = np.abs(np.diff(rows, axis=0))
        bounds = (design.v_max, design.a_max, design.j_max)
        for column, most in zip(change.T, bounds, strict=False):
            assert np.max(column) <= most * dt * (1.0 + 1e-6) + 1e-12


@pytest.mark.trial
@settings(max_examples=60, deadline=None)
@given(changes=targets, limits=st.tuples(positive, positive, positive))
def test_a_target_at_any_moment_is_reached_within_the_limits(
    changes: list[tuple[int, float]], limits: tuple[float, float, float]
) -> None:
    """Exactly, and then it rests; position, speed and acceleration have no jump."""
    run = Moving((limits[0], 4.0 * limits[1], 30.0 * limits[2]), 0.01)
    for samples, target in changes:
        for _ in range(samples % 90):
            run.step(target)
    run.settle_at(changes[-1][1])
    run.step(changes[-1][1])
    run.check(0.01)


@pytest.mark.trial
@settings(max_examples=40, deadline=None)
@given(distance=st.floats(-3.0, 3.0), later=st.integers(1, 400), further=st.floats(0.0, 2.0))
def test_a_move_has_no_overshoot(distance: float, later: int, further: float) -> None:
    """Also if the target moves on in the same direction: the position never turns back."""
    run, sign = Moving(), np.sign(distance)
    for _ in range(later):
        run.step(distance)
    run.settle_at(distance + sign * further)
    way = sign * np.array(run.rows)[:, 0]
    assert np.min(np.diff(way)) >= 0.0
    assert np.max(way) <= abs(distance + sign * further)


def state_of(at: int, seed: int) -> tuple[float, float]:
    """A speed and an acceleration within the limits that keep the speed there."""
    random = np.random.default_rng([at, seed])
    while True:
        v, a = (
            V * random.uniform(-1.0, 1.0),
            A * random.choice([0.0, 1.0, -1.0, random.uniform(-1, 1)]),
        )
        if abs(v + 0.5 * a * abs(a) / J) <= V:
            return v, a


def duration(v: float, a: float, distance: float) -> float:
    """Duration of the quickest move; it ends at rest at the distance."""
    times, jerks = np.zeros(PARTS), np.zeros(PARTS)
    plan(times, jerks, v, a, distance, 0.0, *LIMITS)
    way = 0.0
    for time, jerk in zip(times, jerks, strict=True):
        more, v, a = moved(v, a, jerk, time)
        way += more
    assert np.all(times >= 0.0)
    assert way == pytest.approx(distance, abs=1e-11)
    assert abs(v) < 1e-12 * V
    assert abs(a) < 1e-12 * A
    return float(np.sum(times))


def test_no_move_is_quicker() -> None:
    """From any state: as quick as Ruckig's, which is another program."""
    ruckig = pytest.importorskip("ruckig")
    random = np.random.default_rng(1)
    for k in range(400):
        v, a = state_of(k, 1)
        distance = float(random.choice([-1.0, 1.0]) * 10.0 ** random.uniform(-4.0, 1.0))
        wanted = ruckig.InputParameter(1)
        wanted.current_position, wanted.target_position = [0.0], [distance]
        wanted.current_velocity, wanted.current_acceleration = [v], [a]
        wanted.target_velocity = wanted.target_acceleration = [0.0]
        wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = [V], [A], [J]
        found = ruckig.Trajectory(1)
        assert ruckig.Ruckig(1).calculate(wanted, found) == ruckig.Result.Working
        assert duration(v, a, distance) == pytest.approx(found.duration, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_a_later_plan_along_the_way_is_the_rest_of_the_first_one(seed: int) -> None:
    """The quickest move to the same target from where it is after a time takes that much less."""
    v, a = state_of(7, seed)
    whole = duration(v, a, 0.7)
    times, jerks = np.zeros(PARTS), np.zeros(PARTS)
    plan(times, jerks, v, a, 0.7, 0.0, *LIMITS)
    gone = way = 0.0
    for time, jerk in zip(times, jerks, strict=True):
        half, v_half, a_half = moved(v, a, jerk, 0.5 * time)
        left = duration(v_half, a_half, 0.7 - way - half)
        assert left == pytest.approx(whole - gone - 0.5 * time, abs=1e-6)
        more, v, a = moved(v, a, jerk, time)
        way, gone = way + more, gone + time


@cases("after", [1, 20, 60, 150, 250])
def test_it_stops_at_the_stopping_point_in_the_shortest_time(after: int) -> None:
    """The speed goes to zero at once and never turns; there is no nearer point to stop at."""
    run = Moving()
    for _ in range(after):
        run.step(1.0)
    point = stopping_point(run.design, run.memory)
    first = len(run.rows)
    samples = run.settle_at(point)
    run.check()
    way = np.array(run.rows)[first - 1 :, 0]
    assert np.min(np.diff(way)) >= 0.0
    assert samples * DT <= V / A + 2.0 * A / J + DT
    nearer = Moving()
    for _ in range(after):
        nearer.step(1.0)
    nearer.settle_at(point - 1e-3)
    assert np.max(np.array(nearer.rows)[:, 0]) > point - 1e-3


def test_lower_limits_act_while_it_moves() -> None:
    """The speed comes below its new limit as quickly as the others allow, with and without room."""
    for target in (3.0, 0.55):
        run = Moving()
        for _ in range(120):
            run.step(3.0)
        assert run.rows[-1][1] == pytest.approx(V)
        run.design = run.design._replace(v_max=0.5)
        first = len(run.rows)
        run.settle_at(target)
        rows = np.array(run.rows)[first:]
        within = (V - 0.5) / A + A / J + DT
        assert np.max(np.abs(rows[int(within / DT) + 1 :, 1])) <= 0.5 * (1.0 + 1e-12)
        assert np.max(np.abs(rows[:, 2])) <= A * (1.0 + 1e-12)


def test_a_long_part_is_as_exact_as_a_short_one() -> None:
    """Counts of samples begin again after a million: time goes on, in single precision, too."""
    run = Moving((1e-3, 1.0, 10.0), 1e-4)
    for _ in range(5000):
        run.step(10.0)
    run.memory.loop[0].samples = 999_999.0
    before = run.rows[-1]
    loop, at = run.memory.loop[0], run.memory.loop[0].p_begin
    row = run.step(10.0)
    assert loop.samples == 0.0
    assert row[0] == loop.p_begin == pytest.approx(at + 1e-3 * (1e6 * 1e-4 + loop.offset), rel=1e-9)
    assert np.array_equal(row[1:], before[1:])


def test_a_loop_moves_as_with_the_signal_of_the_same_move() -> None:
    """A step of r behind the generator is a ``LimitedMove`` with its derivatives."""
    plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, -2.0]], [0.0, 5.0], [1.0, 0.0])
    observer = ql.ESO.model_free(2, 5.0, 60.0, DT)
    inner = ql.ADRC(observer, 15.0, feedforward=ql.Feedforward.of(plant))
    move = ql.signals.LimitedMove(0.8, *LIMITS, start=20 * DT)
    signal = ql.simulate(plant, inner, ql.Scenario(reference=move, duration=1.0), interpret=True)
    on_line = ql.simulate(
        plant,
        Prefiltered(inner, ProfileGenerator(*LIMITS)),
        ql.Scenario(reference=ql.signals.Step(0.8, at=20 * DT), duration=1.0),
        interpret=True,
    )
    for name in ("y", "u"):
        scale = np.max(np.abs(signal[name]))
        np.testing.assert_allclose(on_line[name], signal[name], atol=1e-6 * scale)


def controller(smoothing: float = 0.0) -> Prefiltered:
    """A controller with feedforward behind the generator."""
    observer = ql.ESO.model_free(2, 5.0, 60.0, DT)
    model = ql.Feedforward.rigid(0.2, viscous=0.1)
    inner = ql.ADRC(observer, 15.0, feedforward=model, u_min=-9.0, u_max=9.0)
    return Prefiltered(inner, ProfileGenerator(*LIMITS, smoothing))


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize("smoothing", [0.0, 0.02])
@pytest.mark.parametrize("precision", ["double", "single"])
def test_exported_moves_are_the_same_bit_for_bit(
    tmp_path: Path, precision: str, smoothing: float
) -> None:
    """With targets that change during moves, a stop, a missing target, and another limit."""
    given: Any = controller(smoothing)
    if precision == "single":
        given = ql.controllers.in_single_precision(given)
    code, player = InC(c_source(given, "servo"), tmp_path), Player(given)
    random, r = np.random.default_rng(3), 0.0
    for k in range(1500):
        if k % 83 == 10:
            r = float(np.float32(random.uniform(-1.0, 1.0)))
        if k % 400 == 399:
            with as_python(), np.errstate(all="ignore"):
                r = float(stopping_point(player.design.prefilter, player.state.prefilter))
            assert code.run("stopping_point") == r
        wanted = np.nan if k % 97 == 5 else r
        y = float(np.float32(0.01 * random.standard_normal()))
        assert code.run("step", wanted, y) == player.play(Action.STEP, wanted, y)[0]


def test_only_a_generator_plans_a_stop() -> None:
    """Another prefilter says so; the property is what stops the reference."""
    given: Any = controller()
    for _ in range(30):
        given.step(1.0, 0.0)
    point = given.stopping_point
    assert 0.0 < point < 1.0
    for _ in range(300):
        given.step(point, 0.0)
    assert given.stopping_point == point
    shaped = Prefiltered(given.controller, ql.controllers.ReferenceModel(3.0))
    with pytest.raises(ValueError, match="ReferenceModel: plans no stop; take ProfileGenerator"):
        _ = shaped.stopping_point


def test_a_smoothed_move_is_the_mean_of_the_move_with_its_derivatives() -> None:
    """From its beginning to its end, with a target that changes; at rest it is the target."""
    plain, length = ProfileGenerator(*LIMITS), 25
    smooth = replace(plain, smoothing=length * DT)
    design, fine = smooth.design(DT), plain.design(DT)
    memory, whole = smooth.memory(design), plain.memory(fine)
    settle(design, memory, 0.2)
    settle(fine, whole, 0.2)
    rows, means = [], []
    for k in range(1500):
        r, derivatives = (0.2 if k < 5 else 0.9 if k < 60 else 0.4), np.zeros(4)
        means.append(prefilter(fine, whole, r))
        p = prefilter(design, memory, r)
        write_derivatives(design, memory, derivatives)
        rows.append([p, *derivatives])
    found = np.array(rows)
    box = np.convolve([0.5, *np.ones(length - 1), 0.5], [1.0 / length])
    padded = np.concatenate([np.full(length, 0.2), means])
    np.testing.assert_allclose(found[:, 0], np.convolve(padded, box, "valid"), atol=1e-13)
    assert found[-1].tolist() == [0.4, 0.0, 0.0, 0.0, 0.0]
    for i in range(3):
        slope, middle = np.diff(found[:, i]) / DT, 0.5 * (found[1:, i + 1] + found[:-1, i + 1])
        assert np.max(np.abs(slope - middle)) < 0.01 * np.max(np.abs(middle))
    assert stopping_point(design, memory) == 0.4
    assert np.max(np.abs(found[:, 4])) <= 2.0 * LIMITS[2] / (length * DT) * (1.0 + 1e-9)


def test_a_smoothing_out_of_range_is_refused() -> None:
    """With its name, its value and the rule."""
    with pytest.raises(ValueError, match="smoothing = -1.0"):
        ProfileGenerator(*LIMITS, smoothing=-1.0)
    with pytest.raises(ValueError, match="smoothing = 1.0 s with dt = 1e-08 s: must be at most"):
        ProfileGenerator(*LIMITS, smoothing=1.0).design(1e-8)
    assert ProfileGenerator(*LIMITS, smoothing=1e-9).design(DT).length == 1


@pytest.mark.parametrize("name", ["v_max", "a_max", "j_max"])
def test_a_limit_that_is_not_positive_is_refused(name: str) -> None:
    """With its name and value."""
    with pytest.raises(ValueError, match=f"{name} = 0.0: must be finite and greater than zero"):
        replace(ProfileGenerator(*LIMITS), **{name: 0.0})


def test_settled_at_a_value_it_rests_there() -> None:
    """With the same value as target nothing moves."""
    run = Moving()
    settle(run.design, run.memory, 0.3)
    assert run.step(0.3).tolist() == [0.3, 0.0, 0.0, 0.0]


@pytest.mark.trial
def test_the_library_says_what_r_is_and_how_to_stop(tmp_path: Path) -> None:
    """In header, description and sketch; the interrupt hands over a target, without derivatives."""
    ql.export.c(controller(), tmp_path, name="servo")
    header, text = (tmp_path / name for name in ("src/servo.h", "README.md"))
    assert "r is the target of a move" in header.read_text()
    assert "double servo_stopping_point(const servo_state *state);" in header.read_text()
    assert "call\n`servo_stopping_point` once" in text.read_text()
    assert "servo_step(&state, reference, y);" in text.read_text()
    assert "/* target of the moves */" in (tmp_path / "examples/servo/servo.ino").read_text()
