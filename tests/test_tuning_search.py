"""The search of tune in its parts: plants on a grid, peaks, responses, bounds, starts, coupled axes."""

from __future__ import annotations

import itertools
import math
import re
from functools import cache
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from scipy import signal

import quell as ql
from quell.analysis import analyse
from quell.analysis.loop import law_matrix
from quell.analysis.margins import Response
from quell.lti.models import System
from quell.tuning import Constraints, designs
from quell.tuning.optimiser import loops as responses
from quell.tuning.optimiser import requirements, search
from quell.tuning.optimiser.coupled import CoupledLoops, Limits, Plant
from quell.tuning.optimiser.loops import (
    Inputs,
    PlantSet,
    SetResponses,
    area_of_step,
    area_until_rest,
    at_distance,
    dead_samples,
    law_of,
    load_step,
    peaks,
    pulse_in_blocks,
    reference_step,
    response,
)
from quell.tuning.optimiser.requirements import Bound, Followed, Pole, points_of
from quell.tuning.optimiser.search import Iterate, Problem, Solution
from quell.tuning.plants import given_plants, model_of, plant_set
from quell.tuning.structures.registry import make_structure
from tests.cases import cases

DT = 0.05
LAG = ([1.0], [1.0, 1.0])


@cache
def sampled(which: str = "lag", dt: float = DT, delay: float = 0.0) -> PlantSet:
    """Return plants on their grid."""
    plant: Any = {
        "lag": LAG,
        "two gains": [LAG, ([2.0], [1.0, 1.0])],
        "three lags": ([1.0], np.poly([-1.0, -1.0, -1.0])),
        "resonance": ([9.0], [1.0, 0.12, 9.0]),
        "unstable": ([1.0], np.poly([0.0, 0.5, -2.0])),
        "undamped": ([4.0], np.polymul([1.0, 0.0, 4.0], [1.0, 1.0])),
    }[which]
    return plant_set(given_plants(plant, dt, delay=delay), dt)


def structure_of(
    name: str, plant: Any = LAG, order: int = 0, dt: float = DT, delay: float = 0.0
) -> Any:
    """Return a structure for a plant."""
    given = given_plants(plant, dt, delay=delay)
    return make_structure(name, model_of(given, plant_set(given, dt), Constraints()), order)


PI = np.array([[1.5, 0.8, 0.2]])  # K, T_i, T_f


def pi_response(omega: Any, K: float = 1.5, T_i: float = 0.8, T_f: float = 0.2) -> Any:
    """Return C_y of a PI controller by Tustin's rule."""
    s = 2j / DT * np.tan(0.5 * DT * np.asarray(omega))
    return K * (1.0 + 1.0 / (T_i * s)) / (1.0 + T_f * s)


def lag_response(omega: Any) -> Any:
    """Return P of the lag with a hold."""
    z = np.exp(1j * np.asarray(omega) * DT)
    return (1.0 - math.exp(-DT)) / (z - math.exp(-DT))


# ---- plants on a grid


def test_the_crossover_is_where_the_phase_has_fallen_by_half_a_turn() -> None:
    """√3 for three lags of 1 s; a plant whose phase does not fall so far has the mean of its poles."""
    assert sampled("three lags", 0.002).crossover == pytest.approx(math.sqrt(3.0), rel=0.02)
    assert sampled("three lags", 0.002).crossover >= math.sqrt(3.0) * 0.99
    assert sampled("lag").crossover == pytest.approx(1.0)
    zeros = plant_set(given_plants(([1.0, 3.0], np.poly([-2.0, -8.0])), DT), DT)
    assert zeros.crossover == pytest.approx(4.0)
    late = sampled("lag", 0.01, 0.5)
    phase = math.atan(late.crossover) + late.crossover * (0.5 + 0.005)
    assert phase == pytest.approx(math.pi, rel=0.02)


def test_the_grid_has_24_points_a_decade_from_far_below_the_crossover_to_half_the_rate() -> None:
    """And more beside a resonance, and in each turn of a dead time."""
    plain = sampled("lag")
    top = math.pi / DT * (1.0 - 1e-6)
    assert (plain.omega[0], plain.omega[-1]) == pytest.approx((1e-4, top), rel=1e-12)
    count = math.ceil(24.0 * math.log10(top / 1e-4)) + 1
    np.testing.assert_allclose(plain.omega, np.geomspace(1e-4, top, count), rtol=1e-12)
    late = sampled("lag", 0.01, 0.5)
    own = np.geomspace(1e-4 * late.crossover, math.pi / 0.01 * (1.0 - 1e-6), 10000)
    gain = np.abs(late.responses(own)[0])
    at = np.abs(late.responses(np.array([late.crossover]))[0, 0])
    end = own[np.flatnonzero(gain > 0.02 * at)[-1]]
    turns = np.setdiff1d(late.omega, np.geomspace(late.omega[0], late.omega[-1],
        math.ceil(24.0 * math.log10(late.omega[-1] / late.omega[0])) + 1))  # fmt: skip
    even = np.arange(1.0, 1000.0) * (0.5 / 0.5)
    extra = [w for w in even if np.min(np.abs(turns - w)) < 1e-9 * w]
    assert extra == even[: len(extra)].tolist()
    assert extra[-1] == pytest.approx(end, rel=0.06)
    near = sampled("resonance")
    assert near.resonant
    assert not plain.resonant
    assert not plant_set(given_plants(([9.0], [1.0, 0.61, 9.0]), DT), DT).resonant
    assert plant_set(given_plants(([9.0], [1.0, 0.59, 9.0]), DT), DT).resonant
    within = np.abs(near.omega / 3.0 - 1.0) < 0.2
    assert np.sum(within) > 2 * 24.0 * math.log10(1.2 / 0.8)
    assert np.min(np.abs(near.omega - 3.0)) < 0.01


def test_responses_are_those_of_the_sampled_plants_with_their_factors() -> None:
    """Of all plants, or of one for each frequency; plants of the same matrices are scaled."""
    plants = sampled("two gains")
    expected = np.vstack([lag_response(plants.omega), 2.0 * lag_response(plants.omega)])
    np.testing.assert_allclose(plants.P, expected, rtol=1e-9)
    omega, members = np.array([0.3, 0.3, 2.0, 9.0]), np.array([0, 1, 1, 0])
    by_member = lag_response(omega) * np.array([1.0, 2.0, 2.0, 1.0])
    np.testing.assert_allclose(plants.responses_of(omega, members), by_member, rtol=1e-9)
    one = PlantSet([plants.plants[0]] * 2, np.array([1.0, 3.0]), DT)
    np.testing.assert_allclose(one.P[1], 3.0 * one.P[0])
    first, second = one.scaled()
    assert first is one.plants[0]
    np.testing.assert_allclose(second.B, 3.0 * first.B)
    np.testing.assert_allclose(second.E, 3.0 * first.E)
    np.testing.assert_allclose(one.responses_of(omega, members), lag_response(omega) * [1, 3, 3, 1])


def test_responses_of_plants_of_different_size_and_delay_are_their_own() -> None:
    """At frequencies and members in any order, and at points of the s-plane."""
    plants = [LAG, ([1.0], np.poly([-1.0, -1.0, -1.0])), LAG, ([2.0], [1.0, 3.0])]
    given = given_plants(plants, DT, delay=[0.0, 0.02, 0.13, 0.0])
    several, rng = plant_set(given, DT), np.random.default_rng(0)
    members, omega = rng.integers(0, 4, 60), rng.uniform(0.1, 60.0, 60)
    for points in (omega, omega * (1.0 - 0.2j)):
        each = several.responses(points)
        found = several.responses_of(points, members)
        np.testing.assert_allclose(found, each[members, np.arange(60)], rtol=1e-12)
        for j, plant in enumerate(several.plants):
            system = System(plant.N, plant.B, plant.C, 0.0)
            np.testing.assert_allclose(each[j], Response(system)(points, DT), rtol=1e-12)


@cases("name", ["bandwidths", "reduced", "half-gain-law", "delay-poles", "model-based", "poles-2"])
def test_the_law_of_a_structure_is_that_of_its_controller(name: str) -> None:
    """From the matrices of the designs: its C_y is that of the controller and of ``response``."""
    plant, late = ([1.0], np.poly([-1.0, -2.0])), 0.1 if name == "delay-poles" else 0.0
    structure = structure_of(name, plant, 2 * (name != "model-based"), delay=late)
    omega = np.geomspace(1e-2, 50.0, 40)
    for values in structure.shapes()[::7]:
        expected = structure.response(values[None], omega)[0]
        for reference in (False, True):
            law = responses.law_at(structure, values, reference)
            into = law.B_y + law.B_u * law.D_y
            C = Response(System(law_matrix(law), into, -law.C, -law.D_y))(omega, DT)
            np.testing.assert_allclose(C, expected, rtol=1e-8)


def test_open_poles_are_unstable_integrators_or_undamped() -> None:
    """Poles at 0, 0.5 and −2; a pair at 2j."""
    (unstable, integrators, on_axis) = sampled("unstable")._open[0]
    assert (unstable, integrators, on_axis.tolist()) == (1.0, 1.0, [])
    (unstable, integrators, on_axis) = sampled("undamped")._open[0]
    assert (unstable, integrators) == (0.0, 0.0)
    assert on_axis.tolist() == pytest.approx([2.0])
    np.testing.assert_allclose(sampled("lag").s_poles(sampled("lag").plants[0]), [-1.0])


def test_loops_are_unstable_by_as_many_poles_as_the_encirclements_tell() -> None:
    """Of a gain around three lags: stable below 8; with a pole of the plant above z = 1; too slow."""
    plants = sampled("three lags", 0.01)
    gains = np.array([0.5, 7.0, 9.0])
    C = gains[:, None] * (1.0 + 1e-2 / (1j * plants.omega))
    assert plants.unstable_loops(C, np.zeros(3)).tolist() == [[0.0], [0.0], [2.0]]
    assert plants.unstable_loops(1e-9 * C, np.zeros(3))[0, 0] == math.inf
    undamped = sampled("undamped", 0.01)
    given = analyse(([4.0], np.polymul([1.0, 0.0, 4.0], [1.0, 1.0])),
                    ql.baselines.PID(kp=0.3, ki=0.1, dt=0.01))  # fmt: skip
    outside = int(np.sum(np.abs(given.poles) > 1.0))
    C = given.response("C_y", undamped.omega)[None, :]
    assert undamped.unstable_loops(C, np.zeros(1))[0, 0] == outside


def test_samples_of_dead_time_are_counted() -> None:
    """Whole ones; a part takes another one."""
    assert [dead_samples(sampled("lag", DT, d).plants[0]) for d in (0.0, DT, 4 * DT)] == [0, 1, 4]


# ---- peaks


def test_maxima_between_points_are_refined_and_those_below_the_least_left_out() -> None:
    """Two rows of 1/(1 + (ln ω/ω_i)²), and a row that rises to its end."""
    centres, heights = np.array([0.713, 3.1, 8.0]), np.array([2.0, 0.9, 0.4])

    def function(omega: np.ndarray, rows: np.ndarray) -> np.ndarray:
        humps = heights[rows] / (1.0 + np.log(omega / centres[rows]) ** 2)
        return np.where(rows == 3, 1.0, humps)

    omega = np.geomspace(0.1, 20.0, 24)
    values = np.array([function(omega, np.full(24, i)) for i in range(3)])
    found = peaks(function, omega, values, 0.5)
    assert [peak.plant for peak in found] == [0, 1]
    for peak in found:
        assert peak.omega == pytest.approx(centres[peak.plant], rel=1e-3)
        assert peak.value == pytest.approx(heights[peak.plant], rel=1e-7)
    rising = np.log(omega)[None, :]
    (end,) = peaks(lambda w, rows: np.log(w), omega, rising, 0.0)
    assert (end.omega, end.value) == (pytest.approx(20.0), pytest.approx(math.log(20.0)))
    assert peaks(function, omega, values, 2.5) == []


# ---- responses over time


def test_a_load_lasts_150_radians_of_the_crossover_and_long_ones_have_a_distance() -> None:
    """200 000 samples at most, at distances that are powers of two."""
    plants = sampled("lag")
    load = load_step(plants, 2.0)
    assert (load.r.size, load.distance, load.load) == (3000, 1, 2.0)
    assert load.d.tolist() == [2.0] * 3000
    assert not load.r.any()
    assert load_step(plants, 1.0, 0.1).d.size == 10
    long = load_step(plants, 1.0, 200_001 * DT)
    assert (long.d.size, long.distance) == (100_001, 2)
    assert load_step(plants, 1.0, 200_000 * DT).distance == 1
    longer = load_step(plants, 1.0, 500_000 * DT)
    assert (longer.d.size, longer.distance) == (125_000, 4)
    step = reference_step(plants)
    assert (step.r.size, step.r[0], step.d.any(), step.distance) == (3000, 1.0, False, 1)
    feed = Inputs(np.ones(3), np.full(3, 2.0), np.array([5.0, 6.0, 7.0]))
    (one, r), (other, d) = feed.of_loop()
    assert (one, other) == ("n", "d")
    assert (r.tolist(), d.tolist()) == ([-1.0] * 3, [7.0, 8.0, 9.0])


@cache
def by_hand(count: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return y and u after a unit load, and y after a unit reference, sample by sample."""
    a, s = math.exp(-DT), 2.0 / DT
    # C = K (1 + 1/(T_i s))/(1 + T_f s) with s = 2/dt (z − 1)/(z + 1).
    num = 1.5 * np.polymul([1.0 + 1.0 / (0.8 * s), 1.0 / (0.8 * s) - 1.0], [1.0, 1.0])
    den = np.polymul([1.0, -1.0], [1.0 + 0.2 * s, 1.0 - 0.2 * s])
    found = []
    for r, d in ((0.0, 1.0), (1.0, 0.0)):
        x, e, u, y_all, u_all = 0.0, np.zeros(3), np.zeros(3), [], []
        for _ in range(count):
            e = np.array([r - x, *e[:2]])
            now = (num @ e - den[1:] @ u[:2]) / den[0]
            u = np.array([now, *u[:2]])
            y_all.append(x)
            u_all.append(now)
            x = a * x + (1.0 - a) * (now + d)
        found += [np.array(y_all), np.array(u_all)]
    return found[0], found[1], found[2]


def test_responses_of_a_loop_are_those_sample_by_sample() -> None:
    """Of y and u after loads and references, with a feedforward of u, and at each second sample."""
    plants, structure = sampled("lag"), structure_of("pi")
    law, (plant,) = law_of(structure.controller(PI[0])), plants.scaled()
    y, u, follows = by_hand()
    np.testing.assert_allclose(response(plant, law, load_step(plants, 1.0, 20.0)), y, atol=1e-10)
    np.testing.assert_allclose(
        response(plant, law, load_step(plants, 1.0, 20.0), "u"), u, atol=1e-10
    )
    wave = np.sin(0.1 * np.arange(400))
    inputs = Inputs(np.ones(400), 0.5 * wave)
    of_wave = signal.lfilter(np.diff(y, prepend=0.0), [1.0], 0.5 * wave)
    np.testing.assert_allclose(response(plant, law, inputs), follows + of_wave, atol=1e-9)
    second = Inputs(np.zeros(200), np.ones(200), None, 2)
    np.testing.assert_allclose(response(plant, law, second), y[::2], atol=1e-9)
    unstable = law_of(structure.controller(np.array([400.0, 0.8, 0.2])))
    assert np.all(np.isinf(response(plant, unstable, load_step(plants, 1.0, 150.0))))
    fed = Inputs(np.ones(400), np.zeros(400), np.full(400, 0.25))
    np.testing.assert_allclose(response(plant, law, fed), 0.25 * y + follows, atol=1e-9)
    np.testing.assert_allclose(
        response(plant, law, fed, "u") - 0.25,
        response(plant, law, Inputs(np.zeros(400), np.full(400, 0.25)), "u")
        + response(plant, law, Inputs(np.ones(400), np.zeros(400)), "u"),
        atol=1e-9,
    )


def test_the_area_of_a_load_lasts_until_y_is_at_rest() -> None:
    """Σ |y| dt times the load; infinite for a loop that is not stable or does not come to rest."""
    plants, structure = sampled("two gains"), structure_of("pi")
    over = SetResponses(plants, load_step(plants, 2.0))
    y, _, _ = by_hand(2000)
    areas = over.areas(structure, PI[0])
    assert areas[0] == pytest.approx(2.0 * DT * np.sum(np.abs(y)), rel=1e-8)
    assert areas.size == 2
    one = SetResponses(plants, load_step(plants), [1])
    assert one.areas(structure, PI[0])[0] == pytest.approx(0.5 * areas[1], rel=1e-12)
    assert one.of(structure, PI[0]) is one.of(structure, PI[0])
    assert len(over.of(structure, PI[0])) == 2
    assert over.areas(structure, np.array([400.0, 0.8, 0.2])).tolist() == [math.inf] * 2
    decay = responses.System(np.array([[-0.1]]), np.array([1.0]), np.array([1.0]), 0.0)
    assert area_until_rest(decay) == math.inf
    blocks = pulse_in_blocks(decay, 30)
    np.testing.assert_allclose(blocks, np.append(0.0, 0.9 ** np.arange(29.0)), rtol=1e-12)
    held = at_distance(decay, 4)
    np.testing.assert_allclose(1.0 + held.N, [[0.9**4]])
    level = np.cumsum(np.append(0.0, 0.9 ** np.arange(99.0)))
    assert area_of_step(decay, 100) == pytest.approx(np.sum(level))


def test_a_slow_response_is_summed_at_distances_that_double() -> None:
    """Of (z − 1)/(z − p), whose step is p^k: 1/(1 − p) in all, to a ten-thousandth."""
    p = 1.0 - 1e-5
    slow = responses.System(np.array([[p - 1.0]]), np.array([p - 1.0]), np.array([1.0]), 1.0)
    assert area_until_rest(slow) == pytest.approx(1e5, rel=1e-6)
    assert area_of_step(slow, 130_000) == pytest.approx(
        1e5 * -math.expm1(130_000 * math.log(p)), rel=1e-5
    )
    fast = responses.System(np.array([[-0.5]]), np.array([-0.5]), np.array([1.0]), 1.0)
    assert area_until_rest(fast) == pytest.approx(2.0, rel=1e-8)


# ---- constraints


def test_bounds_beside_those_over_frequency_are_ratios_to_their_limits() -> None:
    """Noise, delay margin, u and its rate; the swing of a structure that may swing."""
    plants, structure = sampled("lag"), structure_of("pi")
    given = Constraints(u_std=0.2, noise_std=0.1, delay_margin=0.5, u_max=1.2, rate_max=2.0)
    over = SetResponses(plants, load_step(plants, 1.0, 20.0))
    extras = {each.name: each for each in search.extras_of(given, over)}
    assert [*extras] == ["u_std", "delay margin", "u_max", "rate_max", "k_i |P S/ω|"]
    assert [each.limit for each in extras.values()] == [0.2, 0.5, 1.2, 2.0, 2.0]
    assert [each.over_time for each in extras.values()] == [False, False, True, True, False]
    omega = np.linspace(1e-6, math.pi / DT * (1.0 - 1e-6), 400_001)
    C, P = pi_response(omega), lag_response(omega)
    power = DT / math.pi * float(np.trapezoid(np.abs(C / (1.0 + P * C)) ** 2, omega))
    ratio = extras["u_std"].ratio(structure, PI)[0]
    assert ratio == pytest.approx(math.sqrt(power) / 2.0, rel=1e-4)
    L = P * C
    at = np.flatnonzero((np.abs(L[:-1]) > 1.0) & (np.abs(L[1:]) <= 1.0))[0]
    margin = (math.pi + np.angle(L[at])) / omega[at]
    assert extras["delay margin"].ratio(structure, PI)[0] == pytest.approx(0.5 / margin, rel=1e-4)
    u = by_hand()[1]
    assert extras["u_max"].ratio(structure, PI)[0] == pytest.approx(
        np.max(np.abs(u)) / 1.2, rel=1e-9
    )
    fastest = np.max(np.abs(np.diff(u, prepend=0.0))) / DT
    assert extras["rate_max"].ratio(structure, PI)[0] == pytest.approx(fastest / 2.0, rel=1e-9)
    assert extras["k_i |P S/ω|"].ratio(structure, PI).tolist() == [0.0]
    wild = np.array([[400.0, 0.8, 0.2]])
    assert extras["u_max"].ratio(structure, wild)[0] == 1e6
    based = structure_of("model-based")
    values = np.array([[1.0, 2.0, 5.0]])
    swing = extras["k_i |P S/ω|"].ratio(based, values)[0]
    some = plants.omega[::4]
    S = 1.0 / (1.0 + plants.P[0, ::4] * based.response(values, some)[0])
    k_i = based.integral_gain(values)[0]
    assert swing == pytest.approx(0.5 * k_i * np.max(np.abs(plants.P[0, ::4] * S / some)), rel=1e-9)
    assert search.extras_of(Constraints(), over)[0].name == "k_i |P S/ω|"


def test_the_delay_margin_of_a_set_is_the_least() -> None:
    """That of the plant of twice the gain; without a crossover it is infinite."""
    structure = structure_of("pi")
    both = search.delay_margin(sampled("two gains"), structure, PI)[0]
    one = search.delay_margin(sampled("lag"), structure, PI)[0]
    double = search.delay_margin(sampled("lag"), structure, PI * [2.0, 1.0, 1.0])[0]
    assert both == pytest.approx(double, rel=1e-6)
    assert both < one
    loop = analyse(LAG, structure.controller(PI[0]))
    assert one == pytest.approx(loop.margins.delay, rel=1e-5)
    assert search.delay_margin(sampled("lag"), structure, PI * [1e-9, 1.0, 1.0])[0] == math.inf


def test_slacks_and_their_slopes_are_those_of_the_ratios() -> None:
    """1 − log2(1 + r²) at points of |S|, |T| and |C S|; by differences."""
    rng = np.random.default_rng(5)
    bounds = (Bound("M_s", 1.5), Bound("M_t", 1.2), Bound("M_ks", 2.0))
    assert requirements.bounds_of(Constraints(m_s=1.5, m_t=1.2, m_ks=2.0)) == bounds
    assert requirements.bounds_of(Constraints(m_s=None, m_t=1.2)) == (Bound("M_t", 1.2),)
    omega = np.array([0.5, 1.0, 2.0])
    kind, at = np.array([0, 1, 2, 0, 2]), np.array([0, 1, 2, 2, 1])
    P = rng.standard_normal(5) + 1j * rng.standard_normal(5)
    C = rng.standard_normal(3) + 1j * rng.standard_normal(3)
    points = points_of(bounds, kind, P, at, omega)
    assert points.total == 5

    def by_hand_slack(C: np.ndarray) -> np.ndarray:
        S = 1.0 / (1.0 + P * C[at])
        sizes = np.choose(kind, [np.abs(S), np.abs(1.0 - S), np.abs(C[at] * S)])
        r = sizes / np.array([1.5, 1.2, 2.0])[kind]
        return 1.0 - np.log2(1.0 + r**2)

    np.testing.assert_allclose(requirements.slacks(points, C), by_hand_slack(C), rtol=1e-12)
    dC = rng.standard_normal((2, 3)) + 1j * rng.standard_normal((2, 3))
    slopes = requirements.slopes_of_slacks(points, C, dC)
    for i in range(2):
        two = [by_hand_slack(C + sign * 1e-6 * dC[i]) for sign in (1.0, -1.0)]
        np.testing.assert_allclose(slopes[:, i], (two[0] - two[1]) / 2e-6, atol=1e-8)


def test_poles_with_little_damping_have_points_beside_them() -> None:
    """At −3, −1, 0, 1 and 3 half widths, inside the grid, and none for damped or real poles."""
    plants = sampled("lag")
    poles = [np.array([-0.05 + 2.0j, -0.05 - 2.0j, -0.3 + 2.0j, -1.0, 0.1 + 3.0j])]
    found = requirements.beside_poles(plants, poles)
    expected = [2.0 + 0.05 * k for k in (-3, -1, 0, 1, 3)] + [
        3.0 + 0.1 * k for k in (-3, -1, 0, 1, 3)
    ]
    assert sorted(found) == pytest.approx(sorted(expected))
    assert requirements.beside_poles(plants, []).size == 0
    assert requirements.beside_poles(plants, [np.array([-0.1 + 100.0j])]).size == 0


def test_followed_poles_are_those_of_a_controller_nearby_to_third_order() -> None:
    """Slack is damping less its bound over what is left to one; damped poles are not followed."""
    plants, structure = sampled("lag"), structure_of("pi", dt=DT)
    values = np.array([12.0, 0.2, 0.1])
    (s,) = requirements.closed_loop_poles(plants, structure, values)
    loop = analyse(LAG, structure.controller(values))
    z = np.asarray(loop.poles)
    z = z[np.abs(z) > 1e-6]
    ours = np.exp(s[np.isfinite(s)] * DT)
    for each in z:
        assert np.min(np.abs(ours - each)) < 1e-8
    counted = requirements.counted(plants, [s], 0.4)
    followed = Followed(plants, counted)
    near = values * [1.02, 0.99, 1.01]
    (moved,) = requirements.closed_loop_poles(plants, structure, near)
    kept = [pole for pole in counted if pole.damping < 0.75]
    assert kept
    slack = followed.slacks(structure, near[None, :])[0]
    assert slack.size == len(kept)
    for value, pole in zip(slack, kept, strict=True):
        after = moved[np.argmin(np.abs(moved - pole.s))]
        assert value == pytest.approx((-after.real / abs(after) - 0.4) / 0.6, abs=1e-4)
    calm = Followed(plants, [Pole(-0.76 + 0.6j, 0, 0.4, False)])
    assert calm.slacks(structure, near[None, :]).shape == (1, 0)
    own = Pole(-0.10 + 2.0j, 0, 0.04, True)
    assert Followed(plants, [own]).slacks(structure, near[None, :]).shape == (1, 1)
    assert Followed(plants, [own._replace(least=0.03)]).slacks(structure, near[None, :]).shape == (
        1,
        0,
    )


def test_all_peaks_have_the_number_of_their_bound_and_plant() -> None:
    """Refined maxima of the ratios of both plants, above the least."""
    plants, structure = sampled("two gains"), structure_of("pi")
    values = PI * [4.0, 0.5, 0.2]
    bounds = (Bound("M_s", 1.1), Bound("M_t", 1.1))

    def controller(omega: np.ndarray) -> np.ndarray:
        return structure.response(values, omega)[0]

    found = requirements.all_peaks(
        bounds, plants, controller, controller(plants.omega), np.zeros(0), 0.95
    )
    fine = np.geomspace(0.05, math.pi / DT * 0.999, 20_001)
    for kind, j in itertools.product((0, 1), (0, 1)):
        size = requirements.sizes(bounds[kind].kind, plants.responses(fine)[j], controller(fine))
        top = max(peak.value for number, peak in found if (number, peak.plant) == (kind, j))
        assert top == pytest.approx(np.max(size) / 1.1, rel=1e-5)
    beside = np.array([2.345])
    more = requirements.all_peaks(
        bounds, plants, controller, controller(plants.omega), beside, 0.95
    )
    assert len(more) == len(found)


def test_costs_are_logarithms_and_unstable_ones_the_worst() -> None:
    """−ln k_i, ln ∫|y|, ln RMS(r − y); a quantile of a set."""
    plants, structure = sampled("two gains"), structure_of("pi")
    load = SetResponses(plants, load_step(plants))
    assert requirements.cost_of("load", load, 1.0)(structure, PI)[0] == pytest.approx(
        -math.log(1.5 / 0.8)
    )
    areas = load.areas(structure, PI[0])
    iae = requirements.cost_of("load-iae", load, 1.0)
    assert iae(structure, PI)[0] == pytest.approx(math.log(np.max(areas)))
    half = requirements.cost_of("load-iae", load, 0.5)(structure, PI)[0]
    assert half == pytest.approx(math.log(np.median(areas)))
    assert iae(structure, np.array([[400.0, 0.8, 0.2]]))[0] == 200.0
    step = SetResponses(sampled("lag"), Inputs(np.ones(400), np.zeros(400)))
    tracking = requirements.cost_of("tracking", step, 1.0)(structure, PI)[0]
    error = 1.0 - by_hand()[2]
    assert tracking == pytest.approx(0.5 * math.log(np.mean(error**2)), rel=1e-9)
    none = SimpleNamespace(integrators=1, integral_gain=lambda values: np.array([0.0, -1.0, 2.0]))
    cost = requirements.load_cost(none, np.ones((3, 1)), plants)
    assert cost.tolist() == [200.0, 200.0, pytest.approx(-math.log(2.0))]


# ---- the problem of a round, and where a search begins


def problem(**more: Any) -> Problem:
    """Return the problem of the load for a lag with M_s and M_ks."""
    plants = sampled("lag")
    given = Constraints(m_s=1.6, m_t=None, m_ks=3.0)
    over = SetResponses(plants, load_step(plants))
    parts = {"damping": 0.4, "extras": search.extras_of(given, over), **more}
    return Problem(plants, requirements.bounds_of(given), objective="load",
                   cost=requirements.cost_of("load", over, 1.0), **parts)  # fmt: skip


def test_a_round_has_the_slopes_of_its_cost_and_constraints() -> None:
    """By central differences of its own values; constraints are slacks, then extras and damping."""
    whole, structure = problem(), structure_of("pi")
    x = np.log([3.0, 0.3, 0.15])
    here = Iterate(whole, structure, x)
    points = here.points(0.5, [])
    near = search.FiniteProblem(whole, structure, points, here.followed, x)
    size = points.total + 1 + len([p for p in here.counted if p.damping < 0.75])
    assert near.constraints(x).shape == (size,)
    for at in (x, x + np.array([0.05, -0.02, 0.03])):
        cost, slopes = near.slope_of_cost(at), near.slopes_of_constraints(at)
        for k in range(3):
            step = 1e-5 * np.eye(3)[k]
            two = [near.cost(at + sign * step) for sign in (1.0, -1.0)]
            assert cost[k] == pytest.approx((two[0] - two[1]) / 2e-5, abs=1e-5)
            rows = [near.constraints(at + sign * step) for sign in (1.0, -1.0)]
            np.testing.assert_allclose(slopes[:, k], (rows[0] - rows[1]) / 2e-5, atol=2e-4)
    assert near.cost(x) == pytest.approx(-math.log(10.0))


def test_where_a_search_has_come_to_is_a_cost_and_a_violation() -> None:
    """The largest of the ratios less one: here of M_ks, or of the damping."""
    whole, structure = problem(), structure_of("pi")
    here = Iterate(whole, structure, np.log([3.0, 0.3, 0.15]))
    omega = np.geomspace(0.1, math.pi / DT * 0.999, 20_001)
    C = pi_response(omega, 3.0, 0.3, 0.15)
    S = 1.0 / (1.0 + lag_response(omega) * C)
    ratios = [float(np.max(np.abs(S))) / 1.6, float(np.max(np.abs(C * S))) / 3.0]
    ratios += [pole.ratio for pole in here.counted]
    assert here.stable
    assert here.violation == pytest.approx(max(ratios) - 1.0, rel=1e-5)
    assert here.cost == pytest.approx(-math.log(10.0))
    calm = Iterate(whole, structure, np.log([0.3, 1.0, 0.15]))
    assert calm.violation == 0.0
    wild = Iterate(whole, structure, np.log([400.0, 0.3, 0.15]))
    assert not wild.stable
    without = Iterate(problem(damping=None), structure, np.log([400.0, 0.3, 0.15]))
    assert not without.stable
    assert without.counted == []
    assert Iterate(problem(damping=None), structure, np.log([0.3, 1.0, 0.15])).stable
    at = search.solution_at(whole, structure, np.array([0.3, 1.0, 0.15]))
    assert at is not None
    assert at.values.tolist() == pytest.approx([0.3, 1.0, 0.15])
    assert search.solution_at(whole, structure, np.array([400.0, 0.3, 0.15])) is None


def test_points_are_those_above_a_share_of_their_bound() -> None:
    """On the grid, and further ones; one far from all bounds is the first of the grid."""
    whole, structure = problem(), structure_of("pi")
    here = Iterate(whole, structure, np.log([3.0, 0.3, 0.15]))
    C = pi_response(whole.plants.omega, 3.0, 0.3, 0.15)
    S = np.abs(1.0 / (1.0 + whole.plants.P[0] * C))
    expected = int(np.sum(S > 0.8)) + int(np.sum(np.abs(C) * S > 1.5))
    assert here.points(0.5, []).total == expected
    more = [(1, responses.Peak(1.0, 2.3456, 0))]
    assert here.points(0.5, more).total == expected + 1
    assert 2.3456 in here.points(0.5, more).omega
    none = here.points(1e9, [])
    assert none.omega.tolist() == [whole.plants.omega[0]]
    assert none.total == 1


def test_starts_keep_to_all_bounds_first_and_then_may_exceed_them() -> None:
    """Five of those that a structure has, all of them stable."""
    whole, structure = problem(damping=None), structure_of("pi")
    found = search.starts(whole, structure, structure.shapes(), 5)
    assert found.shape == (5, 3)
    C = structure.response(found, whole.plants.omega)
    ratio = requirements.worst_ratio(whole.bounds, whole.plants, C)
    assert np.all(ratio[:3] <= 1.0)
    costs = whole.cost(structure, found)
    assert np.all(np.diff(costs[:3]) >= 0.0)
    merits = costs + 10.0 * np.log(np.maximum(ratio, 1.0))
    assert np.all(np.diff(merits[3:]) >= 0.0)
    for row in found:
        assert Iterate(whole, structure, np.log(row)).stable


def test_of_shapes_that_are_near_only_the_best_is_a_start() -> None:
    """Those with a cost, the least first; within the spacing in all parameters but the gain."""
    shapes = np.array([[1.0, 1.0], [5.0, 1.1], [1.0, 2.0], [1.0, 9.0], [1.0, 9.5]])
    costs = np.array([0.3, 0.2, 0.25, math.inf, 0.1])
    assert search._best(costs, shapes, 0.0).tolist() == [4, 1, 2, 0]
    assert search._best(costs, shapes, 0.2).tolist() == [4, 1, 2]
    assert search._best(costs, shapes, math.log(2.0 / 1.1) + 1e-9).tolist() == [4, 1]


def test_results_are_ordered_by_what_they_exceed_and_cost() -> None:
    """Those that keep to all limits first; ends agree within a thousandth."""
    structure = structure_of("pi")

    def solution(cost: float, violation: float) -> Solution:
        return Solution(structure, PI[0], cost, violation)

    good, worse, over, far = (
        solution(1.0, 5e-4),
        solution(2.0, 0.0),
        solution(0.0, 6e-4),
        solution(-5.0, 0.1),
    )
    assert sorted([far, over, worse, good], key=search._rank) == [good, worse, over, far]
    assert (good.feasible, over.feasible) == (True, False)
    assert search.merit(far) == pytest.approx(-5.0 + 20.0 * 0.1)
    assert search._agree([solution(1.0, 0.0), solution(1.00099, 0.0)])
    assert not search._agree([solution(1.0, 0.0), solution(1.0011, 0.0)])


# ---- coupled axes


def coupled(objective: str = "load", plants: int = 1, **limits: Any) -> CoupledLoops:
    """Return two lags with gains of 1 and 0.5, each times the gain of a plant, and ADRC of order 1."""
    a = math.exp(-DT)
    B = (1.0 - a) * np.diag([1.0, 0.5])
    one = Plant(a * np.eye(2), B, np.eye(2), np.diag([1.0, 2.0]))
    parts = [ql.ADRC(ql.ESO.model_free(1, 1.0, 4.0, DT), 2.0)] * 2
    given = {"m_s": 1.6, "m_t": 1.7, "m_ks": (3.0, 4.0), "disk": 0.6, "damping": 0.4}
    each = [one._replace(B=(1.0 + 0.3 * j) * B) for j in range(plants)]
    return CoupledLoops(each, parts, Limits(**{**given, **limits}), DT, 0, np.ones(2), objective)


def test_slacks_of_decoupled_axes_are_those_of_each_loop_and_its_disk() -> None:
    """|S|, |T| at outputs and inputs, |C S|, |S − 1/2| of the disk, the damping; of each plant."""
    values = np.array([[2.0, 3.0], [6.0, 4.0]])
    many = coupled(plants=2)
    found = many.measured(values)
    omega = np.geomspace(0.05, math.pi / DT * 0.999, 4001)
    for j, gain in enumerate((1.0, 1.3)):
        expected, disk, dampings = np.zeros((3, 2)), [], []
        for i, (omega_c, omega_o) in enumerate(values.tolist()):
            one = ql.ADRC(ql.ESO.model_free(1, 1.0, omega_o, DT), omega_c)
            loop = analyse(([gain], [1.0, 1.0]), one)
            S = loop.response("S", omega)
            C = loop.response("C_y", omega)
            expected[:, i] = [float(np.max(np.abs(x))) for x in (S, 1.0 - S, C * S)]
            disk.append(float(np.max(np.abs(S - 0.5))))
            s = np.log(np.asarray(loop.poles, dtype=complex)[np.abs(loop.poles) > 1e-9]) / DT
            s = s[(s.imag > 1e-6) & (s.imag < math.pi / (2.0 * DT))]
            dampings += (-s.real / np.abs(s)).tolist()
        slack = found.slacks[j]
        at = -np.log(expected / np.array([[1.6] * 2, [1.7] * 2, [3.0, 4.0]]))
        np.testing.assert_allclose(slack[:4], at[:2].ravel(), atol=3e-3)
        np.testing.assert_allclose(slack[4:8], at[:2].ravel(), atol=3e-3)
        np.testing.assert_allclose(slack[8:10], at[2], atol=3e-3)
        np.testing.assert_allclose(slack[10:12], -math.log(max(disk) * 0.6), atol=1e-3)
        least = min(dampings, default=1.0)
        wanted = 1.0 if not dampings else 1.0 - (1.0 - least) / 0.6
        assert slack[12] == pytest.approx(wanted, abs=1e-6)
    assert found.stable
    fewer = coupled(m_s=None, m_ks=None, damping=None).measured(values)
    assert fewer.slacks.shape == (1, 2 + 2 + 2 + 1)
    pole = many.least_damped(values, 0)
    assert (pole is None) == (not dampings)


def test_starts_and_the_optimum_of_coupled_axes_keep_their_bounds() -> None:
    """The costs are those of single loops; an unstable set has a hundred times the cost alone."""
    values = np.array([[2.0, 3.0], [2.5, 4.0]])
    found = coupled().measured(values)
    assert found.cost == pytest.approx(float(np.mean(np.log(found.costs))))
    assert found.violation == pytest.approx(max(math.expm1(-float(np.min(found.slacks))), 0.0))
    both = coupled("load-iae").measured(values)
    for i, (omega_c, omega_o) in enumerate(values.tolist()):
        one = ql.ADRC(ql.ESO.model_free(1, 1.0, omega_o, DT), omega_c)
        y = response(sampled("lag").scaled()[0], law_of(one), load_step(sampled("lag"), 1.0, 60.0))
        assert both.costs[i] == pytest.approx(DT * float(np.sum(np.abs(y))), rel=1e-4)


@cases(
    ("omega", "damping", "refused"),
    [(62.0, 6e-7, True), (62.0, -1e-5, True), (62.0, 0.01, False), (50.0, 6e-7, False)],
)
def test_no_search_begins_for_an_undamped_pair_at_half_the_rate(
    omega: float, damping: float, refused: bool
) -> None:
    """Samples can't damp it: it is refused where it decides stability, before any evaluation."""
    dt, pair = 0.05, [1.0, 2.0 * damping * omega, omega**2]
    plant = [omega**2], np.polymul([1.0, 2.05, 1.05], pair)
    begun: list[str] = []

    def best_solution(problem: Problem, structure: Any, more: Any) -> None:
        begun.append(structure.name)

    how: dict[str, Any] = {"structure": "pi", "compare": (), "written": False}
    what = "pair of poles with a damping of .* samples at dt = 0.05 s can't damp it; sample with"
    with patch.object(designs, "best_solution", best_solution), pytest.raises(ValueError) as error:
        ql.tune([plant, plant], dt, **how)
    assert bool(re.search(what, str(error.value))) == refused
    assert bool(begun) != refused
