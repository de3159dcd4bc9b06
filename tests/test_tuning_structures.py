"""Structures of tune: starts, poles, equivalents, tables; prefilters of its results."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from quell.analysis import analyse
from quell.plants.linear import LinearPlant
from quell.tuning.optimiser.loops import (
    law_of,
    reference_step,
    response,
)
from quell.tuning.reference import Axis, _behind, _duration, model_of_linear_step
from quell.tuning.structures.adrc import _damped, _factors, _split, equivalents

from .cases import cases
from .test_tuning_search import DT, LAG, PI, pi_response, sampled, structure_of

# ---- structures


def test_a_pi_controller_has_its_response_gain_and_neighbours() -> None:
    """K (1 + 1/(T_i s))/(1 + T_f s) by Tustin; parts; values from and for other PID controllers."""
    pi, pid = structure_of("pi"), structure_of("pid")
    omega = np.array([0.1, 2.0, 30.0])
    np.testing.assert_allclose(pi.response(PI, omega)[0], pi_response(omega), rtol=1e-12)
    assert pi.integral_gain(PI).tolist() == [1.5 / 0.8]
    assert [float(part[0]) for part in pi.parts(PI)] == [1.5, 1.5 / 0.8, 0.0, 0.2, 0.0]
    values = np.array([[1.5, 0.8, 0.1, 0.2]])
    assert [float(part[0]) for part in pid.parts(values)] == pytest.approx(
        [1.5, 1.5 / 0.8, 0.15, 0.2, 0.02]
    )
    s = 2j / DT * np.tan(0.5 * DT * omega)
    expected = 1.5 * (1.0 + 1.0 / (0.8 * s) + 0.1 * s) / (1.0 + 0.2 * s + 0.02 * s**2)
    np.testing.assert_allclose(pid.response(values, omega)[0], expected, rtol=1e-12)
    assert pi.from_other(pid, values[0]) is None
    assert pi.from_other(pi, PI[0]) is None
    more = pid.from_other(pi, PI[0])
    assert more is not None
    assert more[[0, 1, 3]].tolist() == [1.5, 0.8, 0.2]
    assert 0.0 < more[2] < 0.1 * 0.8
    unfiltered = structure_of("pi-unfiltered")
    assert unfiltered.from_other(pi, PI[0]).tolist() == [1.5, 0.8]
    assert pi.from_other(unfiltered, np.array([1.5, 0.8])).tolist() == [
        1.5,
        0.8,
        pi.parameters[2].low,
    ]
    tables = pid.tables(values[0])["controller"]
    assert tables == {"kind": "pid", "kp": 1.5, "ki": 1.5 / 0.8, "kd": pytest.approx(0.15),
                      "tf": [0.2, pytest.approx(0.02)]}  # fmt: skip
    assert pi.tables(PI[0])["controller"]["name"] == "PI"
    assert pi.beside(PI[0]).shape == (0, 3)
    assert pi.grid()[0].shape == (0, 3)
    assert pi.rules(PI).shape == (1, 0)
    assert pi.unstable_poles(PI).tolist() == [0.0]


def test_times_of_a_pi_controller_start_around_a_radian_of_the_crossover() -> None:
    """Five times each with three filters, no filter beyond 0.5/dt; the same in other units of time."""
    shapes = structure_of("pi").shapes()
    assert shapes.shape == (15, 3)
    assert np.unique(shapes[:, 1]).tolist() == pytest.approx([0.6, 1.5, 4.0, 12.0, 60.0])
    shortest = DT / 0.5
    for Ti, Tf in shapes[:, 1:]:
        near = [max(share * min(Ti, 2.0), 1.05 * shortest) for share in (0.02, 0.1, 0.4)]
        assert min(abs(Tf - each) for each in near) < 1e-9
    slow = structure_of("pi", ([0.1], [1.0, 0.1]), dt=10.0 * DT).shapes()
    np.testing.assert_allclose(slow[:, 1:], 10.0 * shapes[:, 1:])
    pid = structure_of("pid").shapes()
    assert pid.shape[1] == 4
    ratios = np.unique(np.round(pid[:45, 2] / pid[:45, 1], 9))
    assert ratios.tolist() == [0.1, 0.25, 0.5]


def test_bandwidths_start_from_six_laws_and_five_observers() -> None:
    """b0 of the plant, ω_c in units of the crossover, ω_o in units of ω_c, none beyond 0.5/dt."""
    structure = structure_of("bandwidths", LAG, 1)
    omega, fastest = structure.model.omega, 0.5 / DT
    expected = []
    for law, ratio in itertools.product(
        (0.02, 0.07, 0.2, 0.5, 1.2, 3.0), (0.3, 1.0, 3.0, 10.0, 30.0)
    ):
        pair = (law * omega, law * ratio * omega)
        if max(pair) > 0.999 * fastest:
            pair = (min(pair[0], 0.9 * fastest), 0.99 * fastest)
        expected.append([1.0, *pair])
    np.testing.assert_allclose(structure.shapes(), expected)
    assert len(structure_of("bandwidths-2", LAG, 1).shapes()) == 36
    free = structure_of("poles", LAG, 1)
    for row, pair in zip(free.shapes(), expected, strict=True):
        law, observer = (poles[0] for poles in free.poles(row[None, :]))
        np.testing.assert_allclose(law, -pair[1])
        np.testing.assert_allclose(observer, [-pair[2]] * 2, rtol=1e-6)
    other = structure_of("bandwidths", LAG, 2)
    assert np.unique(other.shapes()[:, 0]).tolist() == [1.0]


def test_a_pair_with_a_real_pole_beyond_the_fastest_breaks_a_rule() -> None:
    """1 − 2 ζ ω/R + (ω/R)² is zero where a pole is at R; of the law and the observer."""
    free = structure_of("poles", ([1.0], [1.0, 0.3, 0.0]), 2, dt=0.01)
    fastest = 50.0
    slow, quick = 5.0, 50.0
    omega, damping = math.sqrt(slow * quick), 0.5 * (slow + quick) / math.sqrt(slow * quick)
    values = np.array(
        [[1.0, omega, damping, 8.0, 0.5, 6.0], [1.0, 8.0, 0.5, omega, 1.01 * damping, 6.0]]
    )
    rules = free.rules(values)
    assert rules.shape == (2, 2)
    assert rules[0, 0] == pytest.approx(0.0, abs=1e-12)
    assert rules[1, 1] < 0.0
    share = 8.0 / fastest
    assert rules[0, 1] == rules[1, 0] == pytest.approx(1.0 - share + share**2)
    assert structure_of("bandwidths", LAG, 1).rules(np.ones((3, 3))).shape == (3, 0)


def test_poles_are_put_into_pairs_by_frequency_and_damping() -> None:
    """Complex ones first; of real ones neighbours, the slowest alone; unstable ones not at all."""
    found = _factors(np.array([-1.0, -8.0, -2.0, -3.0 + 4.0j, -3.0 - 4.0j]))
    assert found == pytest.approx([5.0, 0.6, 4.0, 10.0 / 8.0, 1.0])
    assert _factors(np.array([-2.0, -8.0])) == pytest.approx([4.0, 1.25])
    assert _factors(np.array([-2.0, 0.0])) is None
    assert _factors(np.array([-2.0 + 1e-12j, -8.0])) == pytest.approx([4.0, 1.25])
    moved = _damped(np.array([0.01 + 2.0j, 0.01 - 2.0j, 3.0, -0.5 + 0.5j]))
    angle = math.sqrt(1.0 - 0.05**2)
    size = abs(0.01 + 2.0j)
    np.testing.assert_allclose(
        moved, [size * (-0.05 + 1j * angle), size * (-0.05 - 1j * angle), -3.0, -0.5 + 0.5j]
    )


def test_the_law_gets_the_slowest_poles_that_are_well_damped() -> None:
    """Conjugates together; else those of the best damping."""
    poles = np.array([-1.0 + 3.0j, -1.0 - 3.0j, -4.0, -20.0])
    split = _split(poles, 2)
    assert split is not None
    assert sorted(split[0].real) == [-20.0, -4.0]
    split = _split(poles, 1)
    assert split is not None
    assert split[0].tolist() == [-4.0]
    assert split[1].size == 3
    ringing = np.array([-0.5 + 3.0j, -0.5 - 3.0j, -0.2 + 9.0j, -0.2 - 9.0j])
    split = _split(ringing, 2)
    assert split is not None
    np.testing.assert_allclose(np.abs(split[0]), abs(-0.5 + 3.0j))
    assert _split(ringing, 1) is None


@cases("order", [1, 2])
def test_an_equivalent_of_a_pid_controller_has_its_feedback(order: int) -> None:
    """To first order in dt; at most three, none for another order or form."""
    dt = 1e-3
    plant = ([1.0], [1.0, 1.0]) if order == 1 else ([1.0], [1.0, 1.0, 0.0])
    pid = structure_of("pi" if order == 1 else "pid", plant, dt=dt)
    values = np.array([1.5, 0.8, 0.05]) if order == 1 else np.array([3.0, 4.0, 0.6, 0.05])
    free = structure_of("poles", plant, order, dt)
    rows = equivalents(pid, values, free)
    assert 1 <= len(rows) <= 3
    assert len(equivalents(pid, values, free, most=1)) == 1
    omega = np.array([0.2, 1.0, 5.0, 20.0])
    C = pid.response(values[None, :], omega)[0]
    for row in free.response(rows, omega):
        np.testing.assert_allclose(row, C, rtol=0.02 * order)
    none = (0, len(free.parameters))
    assert equivalents(pid, values, structure_of("poles", plant, 3 - order, dt)).shape[0] == 0
    assert equivalents(structure_of("pi-unfiltered", plant, dt=dt), values[:2], free).shape == none
    assert equivalents(pid, values, structure_of("bandwidths", plant, order, dt)).shape[0] == 0


def test_tables_of_an_adrc_build_its_controller_again() -> None:
    """Kind, order, b0 with its sign, bandwidths, patterns, forms and delays."""
    plain = structure_of("bandwidths", ([-2.0], [1.0, 1.0]), 1)
    assert plain.tables(np.array([2.0, 3.0, 8.0])) == {
        "observer": {"kind": "model-free", "order": 1, "b0": -2.0, "omega_o": 8.0},
        "controller": {"kind": "adrc", "omega_c": 3.0},
    }
    free = structure_of("poles", ([1.0], [1.0, 0.3, 0.0]), 2, 0.01)
    values = np.array([1.5, 3.0, 0.7, 8.0, 0.5, 6.0])
    tables = free.tables(values)
    law = 0.7, math.sqrt(1.0 - 0.49)
    assert tables["controller"]["omega_c"] == pytest.approx(3.0)
    assert tables["controller"]["law_poles"] == [[pytest.approx(-law[0]), pytest.approx(law[1])]]
    omega_o = (8.0 * 8.0 * 6.0) ** (1.0 / 3.0)
    assert tables["observer"]["omega_o"] == pytest.approx(omega_o)
    real, pair = tables["observer"]["poles"]
    assert real == pytest.approx(-6.0 / omega_o)
    assert pair == pytest.approx([-4.0 / omega_o, 8.0 * math.sqrt(0.75) / omega_o])
    half = structure_of("half-gain", LAG, 1).tables(np.array([1.0, 3.0, 8.0]))
    assert half["observer"].get("half_gain", False) or half["controller"].get("half_gain", False)
    twice = structure_of("bandwidths-2", LAG, 1).tables(np.array([1.0, 3.0, 8.0]))
    assert twice["observer"]["disturbance_order"] == 2
    late = structure_of("delay", LAG, 1, delay=4 * DT).tables(np.array([1.0, 3.0, 8.0]))
    assert late["observer"]["delay"] == pytest.approx(4 * DT)


# ---- prefilters


def test_an_axis_is_the_rigid_part_of_a_plant_that_rests_anywhere() -> None:
    """By u = c_1 y' + c_2 y''; a plant that needs u at rest is none."""
    plant = LinearPlant.of(([4.0], [1.0, 0.5, 0.0]))
    axis = Axis.of(plant, 10.0)
    assert axis is not None
    assert (axis.viscous, axis.inertia) == pytest.approx((0.125, 0.25))
    assert Axis.of(LinearPlant.of(LAG), 10.0) is None
    heavy = Axis.heaviest([Axis(1.0, 2.0), Axis(3.0, 0.5)])
    assert heavy == Axis(3.0, 2.0)
    assert heavy.needs(0.1) == pytest.approx(2.0 / 1.0**2 + 3.0 / 1.0)
    assert Axis(3.0, 2.0).needs(0.2) == pytest.approx(2.0 / 4.0 + 3.0 / 2.0)


def test_a_profile_needs_the_room_of_u_at_most_and_is_the_quickest_of_forty() -> None:
    """It has viscous v + inertia a = room; without friction the speed is ten times what is reached."""
    free = Axis(0.0, 2.0).profile(3.0, 4.0, 0.1)
    assert (free.a_max, free.j_max) == pytest.approx((2.0, 20.0))
    assert free.v_max == pytest.approx(10.0 * math.sqrt(6.0))
    one = Axis(0.5, 2.0).profile(3.0, 4.0, 0.1)
    assert 0.5 * one.v_max + 2.0 * one.a_max == pytest.approx(4.0)
    assert one.j_max == pytest.approx(one.a_max / 0.1)
    times = []
    for k in range(40):
        v = 8.0 * (k + 0.5) / 40.0
        a = (4.0 - 0.5 * v) / 2.0
        times.append(3.0 / v + v / a if v * v / a <= 3.0 else 2.0 * math.sqrt(3.0 / a))
    assert one.v_max == pytest.approx(8.0 * (int(np.argmin(times)) + 0.5) / 40.0)
    speed = Axis(2.0, 0.0).profile(3.0, 4.0, 0.1)
    assert 2.0 * speed.v_max + 0.2 * speed.a_max == pytest.approx(4.0)


def test_a_move_from_rest_lasts_its_trapezium_of_speed_and_its_ramp() -> None:
    """Of acceleration that is ramped: distance over speed, and speed over acceleration, and ramp."""
    made = Axis(0.5, 2.0).profile(30.0, 4.0, 0.1)
    expected = 30.0 / made.v_max + made.v_max / made.a_max + 0.1
    assert _duration(made, 30.0) == pytest.approx(expected, rel=1e-6)


def test_a_linear_step_overshoots_by_five_percent_behind_the_model_that_is_found() -> None:
    """By bisection, the fastest one; a loop that overshoots less gets none."""
    plants, structure = sampled("lag"), structure_of("pi")
    quick = structure.controller(np.array([3.0, 0.2, 0.1]))
    model = model_of_linear_step(plants, quick)
    assert model is not None
    assert model.order == 2
    loop = analyse(LAG, quick)
    pulse = np.diff(
        response(plants.scaled()[0], law_of(quick), reference_step(plants)), prepend=0.0
    )
    assert loop.stable
    for factor, sign in ((1.0, 0.0), (1.01, 1.0), (0.97, -1.0)):
        lag = math.exp(-factor * model.omega * DT)
        r = signal.lfilter(
            [(1.0 - lag) ** 2], np.polymul([1.0, -lag], [1.0, -lag]), np.ones(pulse.size)
        )
        y = np.convolve(pulse, r)[: pulse.size]
        over = float(np.max(y)) - 1.0
        if sign == 0.0:
            assert over == pytest.approx(0.05, abs=1e-6)
            np.testing.assert_allclose(_behind(model, pulse, DT), y, atol=1e-9)
        else:
            assert sign * (over - 0.05) > 0.0
    assert model_of_linear_step(plants, structure.controller(np.array([0.5, 1.0, 0.1]))) is None
    assert model_of_linear_step(plants, structure.controller(np.array([400.0, 0.8, 0.2]))) is None
    assert replace(model, omega=1.0).order == 2
