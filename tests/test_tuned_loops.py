"""Small tunings: optima against closed forms and brute force, units, what a result says."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import signal

import quell as ql
from quell.analysis import analyse
from quell.tuning import Constraints
from quell.tuning.designs import contradiction
from quell.tuning.optimiser.loops import SetResponses, load_step
from quell.tuning.optimiser.requirements import cost_of
from quell.tuning.plants import given_plants, plant_set

LAG = ([1.0], [1.0, 1.0])
LAGS = ([1.0], [1.0, 3.0, 3.0, 1.0])
DT = 0.05
M_KS = Constraints(m_ks=3.0)


def tune(plant: Any, structure: str, dt: float = DT, **options: Any) -> ql.Tuned:
    """Tune one structure for the integral gain, without a run of the written loop."""
    how: dict[str, Any] = {"objective": "load", "constraints": M_KS, "written": False}
    return ql.tune(plant, dt, structure=structure, compare=(), **{**how, **options})


def response(plant: Any, dt: float, omega: np.ndarray, delay: int = 0) -> np.ndarray:
    """Return P of a plant that is sampled with a hold, by SciPy."""
    num, den, _ = signal.cont2discrete(plant, dt)
    z = np.exp(1j * omega * dt)
    return np.polyval(np.ravel(num), z) / np.polyval(den, z) / z**delay


def pi_response(
    K: Any, T_i: Any, T_f: float, dt: float, omega: np.ndarray, T_d: float = 0.0
) -> np.ndarray:
    """Return C of a PI or PID controller that is sampled by Tustin's rule."""
    s = 2j / dt * np.tan(0.5 * omega * dt)
    F = 1.0 + T_f * s + (0.5 * (T_f * s) ** 2 if T_d else 0.0)
    return K * (1.0 + 1.0 / (T_i * s) + T_d * s) / F


# ---- optima


def test_no_pi_controller_nearby_has_a_larger_integral_gain_within_the_bounds() -> None:
    """Each of 24 steps of 2 % exceeds M_s or M_t, or has a smaller k_i; S and T are SciPy's."""
    found = tune(LAGS, "pi-unfiltered", 0.02, constraints=Constraints(m_s=1.5, noise_over_pi=None))
    K, T_i = (found.design.values[name] for name in ("K", "T_i"))
    omega = np.geomspace(0.01, math.pi / 0.02 * 0.999, 2000)
    P = response(LAGS, 0.02, omega)

    def peaks(K: float, T_i: float) -> tuple[float, float]:
        L = P * pi_response(K, T_i, 0.0, 0.02, omega)
        return float(np.max(1 / np.abs(1 + L))), float(np.max(np.abs(L / (1 + L))))

    m_s, m_t = peaks(K, T_i)
    assert m_s == pytest.approx(found.design.measures["M_s"], rel=1e-4)
    assert m_t == pytest.approx(found.design.measures["M_t"], rel=1e-4)
    assert m_s <= 1.501
    assert found.design.k_i == pytest.approx(K / T_i, rel=1e-12)
    for angle in np.arange(24) * math.pi / 12:
        near = K * math.exp(0.02 * math.cos(angle)), T_i * math.exp(0.02 * math.sin(angle))
        better = near[0] / near[1] > found.design.k_i * (1 + 1e-4)
        assert not better or max(peaks(*near)[0] / 1.5, peaks(*near)[1] / 1.6) > 1.0


def test_the_fastest_filter_and_the_bound_of_noise_give_the_pi_controller_of_a_lag() -> None:
    """T_f is dt/0.5, |C S| peaks at 3, and 1/k_i is the integral of a y that has one sign."""
    found = tune(LAG, "pi")
    values = found.design.values
    assert values["T_f"] == pytest.approx(DT / 0.5, rel=1e-9)
    omega = np.geomspace(0.01, math.pi / DT * 0.999, 3000)
    C = pi_response(values["K"], values["T_i"], values["T_f"], DT, omega)
    CS = np.abs(C / (1 + response(LAG, DT, omega) * C))
    assert np.max(CS) == pytest.approx(3.0, rel=1e-3)
    names = [each.name for each in found.design.active]
    assert names == ["M_ks", "|p| dt"]
    (noise, pole) = found.design.active
    assert (noise.limit, noise.plant, pole.limit) == (3.0, 0, 0.5)
    assert noise.omega == pytest.approx(float(omega[np.argmax(CS)]), rel=0.02)
    assert math.isnan(pole.omega)
    assert found.active[0].startswith("M_ks = 3 (limit 3) at ")
    assert found.active[1] == "|p| dt = 0.5 (limit 0.5)"
    assert found.design.objective == found.design.k_i
    # y undershoots a bit: the integral of |y| is more than that of y.
    assert 1.0 <= found.design.measures["iae"] * found.design.k_i < 1.2


def test_measures_are_those_of_an_independent_analysis() -> None:
    """Delay margin from the crossover of SciPy's L, noise by a sum over white noise's spectrum."""
    found = tune(LAGS, "pid", constraints=Constraints(m_ks=4.0), delay=2 * DT)
    values, measures = found.design.values, found.design.measures
    omega = np.linspace(1e-4, math.pi / DT * 0.99999, 60_000)
    C = pi_response(values["K"], values["T_i"], values["T_f"], DT, omega, values["T_d"])
    P = response(LAGS, DT, omega, 2)
    L = P * C
    at = int(np.flatnonzero(np.abs(L) > 1.0)[-1])
    margin = (math.pi + np.angle(L[at])) / omega[at]
    assert measures["delay_margin"] == pytest.approx(float(margin), rel=1e-3)
    power = np.trapezoid(np.abs(C / (1 + L)) ** 2, omega) * DT / math.pi
    assert measures["noise_gain"] == pytest.approx(math.sqrt(power), rel=1e-3)
    assert measures["M_ks"] == pytest.approx(float(np.max(np.abs(C / (1 + L)))), rel=1e-3)
    poles = np.log(np.asarray(found.analysis.poles, dtype=complex)) / DT
    swinging = poles[np.abs(poles.imag) > 1e-6]
    swinging = swinging[np.abs(swinging.imag) < math.pi / (4 * DT)]
    damping = float(np.min(-swinging.real / np.abs(swinging)))
    assert measures["damping"] == pytest.approx(damping, rel=1e-6)
    assert found.damping.startswith(f"least damped pole of the loop: damping {damping:.3g} at")


@pytest.mark.parametrize(
    ("structure", "plant", "order"),
    [
        ("pi-unfiltered", LAG, None),
        ("pi", LAGS, None),
        pytest.param("bandwidths", LAG, 1, marks=pytest.mark.trial),
        pytest.param("bandwidths", ([1.0], [1.0, 0.3, 0.0]), 2, marks=pytest.mark.trial),
        pytest.param("half-gain", ([1.0], [1.0, 0.3, 0.0]), 2, marks=pytest.mark.trial),
        pytest.param("p-pi-notch", ([1.0], [1.0, 0.3, 0.0]), None, marks=pytest.mark.trial),
    ],
)
def test_a_tuning_has_the_units_of_its_plant(structure: str, plant: Any, order: Any) -> None:
    """With y in mm, u in mA and t in ms: gains and times scale, peaks and damping stay."""
    num, den = plant
    y, u, t = 250.0, 8.0, 40.0
    n = len(den) - 1
    scaled = ([num[0] * y / u / t**n], [den[k] / t**k for k in range(n + 1)])
    one = tune(plant, structure, order=order)
    other = tune(scaled, structure, DT * t, order=order, constraints=Constraints(m_ks=3.0 * u / y))
    units = {"K": u / y, "K_p": u / y * t, "K_v": 1 / t, "b0": y / u / t ** (order or 1)}
    units |= {"T_i": t, "T_f": t, "T_n": t, "omega_c": 1 / t, "omega_o": 1 / t}
    assert one.design.values.keys() == other.design.values.keys()
    for name, value in one.design.values.items():
        assert other.design.values[name] == pytest.approx(value * units[name], rel=2e-4), name
    measures = {"M_s": 1.0, "M_t": 1.0, "M_ks": u / y, "noise_gain": u / y, "iae": y / u * t}
    measures |= {"delay_margin": t, "damping": 1.0}
    for name, factor in measures.items():
        size = one.design.measures[name] * factor
        assert other.design.measures[name] == pytest.approx(size, rel=2e-4), name
    assert other.design.k_i == pytest.approx(one.design.k_i * u / y / t, rel=2e-5)


def test_a_plant_with_a_negative_gain_has_the_same_tuning_with_the_other_sign() -> None:
    """K is negative, and all figures are the same."""
    plus, minus = (tune(([k], [1.0, 1.0]), "pi-unfiltered") for k in (1.0, -1.0))
    assert minus.design.values["K"] == pytest.approx(-plus.design.values["K"], rel=1e-9)
    assert minus.design.measures == pytest.approx(plus.design.measures, rel=1e-9)
    assert minus.analysis.stable


# ---- other bounds, objectives and sets of plants


def test_a_delay_margin_that_is_asked_for_is_reached() -> None:
    """Of a lag with 0.6 s; the bound is active, and ``analyse`` has it, too."""
    found = tune(LAG, "pi", constraints=Constraints(m_ks=3.0, delay_margin=0.6))
    assert found.design.measures["delay_margin"] == pytest.approx(0.6, rel=1e-3)
    assert found.analysis.margins.delay == pytest.approx(0.6, rel=1e-3)
    (active,) = [each for each in found.design.active if each.name == "delay margin"]
    assert (active.value, active.limit) == (pytest.approx(0.6, rel=1e-3), 0.6)


def test_noise_of_y_that_is_known_bounds_the_deviation_of_u() -> None:
    """std(u) is noise_gain times the noise, rounding included; a simulated loop shows it."""
    bounds = Constraints(u_std=0.02, noise_std=0.008, resolution=0.006 * math.sqrt(12.0))
    found = tune(LAG, "pi", constraints=bounds)
    assert bounds.noise == pytest.approx(0.01)
    assert found.design.measures["noise_gain"] * 0.01 == pytest.approx(0.02, rel=1e-3)
    rng, controller, y = np.random.default_rng(3), found.controller, 0.0
    a, used = math.exp(-DT), []
    for noise in 0.01 * rng.standard_normal(12_000):
        used.append(controller.step(0.0, y + noise))
        y = a * y + (1.0 - a) * used[-1]
    assert np.std(used) == pytest.approx(0.02, rel=0.05)


def test_the_largest_u_and_its_rate_after_a_step_are_bounded() -> None:
    """A simulated step of the reference has just that u and that rate."""
    bounds = Constraints(m_ks=20.0, u_max=2.0, rate_max=60.0)
    reference = ql.signals.Step(0.5)
    how = {"reference": reference, "duration": 4.0, "constraints": bounds}
    found = tune(LAG, "pi", objective="tracking", **how)
    scenario = ql.Scenario(reference=reference, duration=4.0)
    run = ql.simulate(ql.plants.LinearPlant.of(LAG), found.controller, scenario, interpret=True)
    largest = float(np.max(np.abs(run["u"])))
    rate = float(np.max(np.abs(np.diff(run["u"], prepend=0.0)))) / DT
    assert max(largest / 2.0, rate / 60.0) == pytest.approx(1.0, rel=2e-3)
    rms = math.sqrt(np.mean((run["r"] - run["y"])[:80] ** 2))
    assert found.design.objective == pytest.approx(rms, rel=0.02)
    assert found.design.measures["M_s"] <= 1.601


def load_area(gain: float, values: Any) -> float:
    """Return ∫|y| of a lag with a PI controller after a unit load, by SciPy's difference equation."""
    K, c = values["K"], 0.5 * DT / values["T_i"]
    a = math.exp(-DT)
    # P = b/(z − a), C = K (z − 1 + c (z + 1))/(z − 1)
    b = gain * (1.0 - a)
    den = np.polyadd(np.polymul([1.0, -a], [1.0, -1.0]), b * K * np.array([1.0 + c, c - 1.0]))
    y = signal.lfilter([0.0, b, -b], den, np.ones(2000))
    return DT * float(np.sum(np.abs(y)))


def test_the_integral_of_y_without_its_sign_is_that_of_the_difference_equation() -> None:
    """∫|y| of the design; twice the load the other way costs twice as much."""
    found = tune(LAG, "pi-unfiltered", objective="load-iae")
    area = load_area(1.0, found.design.values)
    assert found.design.objective == pytest.approx(area, rel=1e-6)
    assert found.design.measures["iae"] == pytest.approx(area, rel=1e-6)
    solution = found.design.solution
    assert solution is not None
    over = SetResponses(found.plants, load_step(found.plants, -2.0, 5.0))
    twice = over.areas(solution.structure, solution.values)
    assert twice.tolist() == pytest.approx([2.0 * area], rel=1e-6)


def test_a_range_of_the_gain_is_a_set_of_three_plants() -> None:
    """From 80 to 125 % of b: the same as the plants 1, 0.8 and 1.25; the bound holds for the worst."""
    ranged = tune(LAG, "pi-unfiltered", b_range=(0.8, 1.25), check_samples=5)
    plants = [([gain], [1.0, 1.0]) for gain in (1.0, 0.8, 1.25)]
    listed = tune(plants, "pi-unfiltered")
    assert ranged.plants.factors.tolist() == [1.0, 0.8, 1.25]
    assert listed.plants.factors.tolist() == [1.0, 1.0, 1.0]
    for name, value in ranged.design.values.items():
        assert listed.design.values[name] == pytest.approx(value, rel=1e-4)
    m_ks = []
    omega = np.geomspace(0.01, math.pi / DT * 0.999, 2000)
    C = pi_response(ranged.design.values["K"], ranged.design.values["T_i"], 0.0, DT, omega)
    for plant in plants:
        m_ks.append(float(np.max(np.abs(C / (1 + response(plant, DT, omega) * C)))))
    assert ranged.design.measures["M_ks"] == pytest.approx(max(m_ks), rel=1e-3)
    assert ranged.check is not None
    assert (ranged.check.samples, ranged.check.unstable, ranged.check.violating) == (5, 0, 0)


def test_a_quantile_of_the_plants_is_the_objective() -> None:
    """Of four gains the second largest area at 2/3, the largest at 1, of their own loops."""
    design = tune(LAG, "pi-unfiltered").design
    one, gains = design.solution, [1.0, 0.7, 1.4, 0.5]
    assert one is not None
    plants = plant_set(given_plants([([gain], [1.0, 1.0]) for gain in gains], DT), DT)
    over = SetResponses(plants, load_step(plants))
    areas = sorted(load_area(gain, design.values) for gain in gains)
    for quantile, expected in ((2 / 3, areas[2]), (1.0, areas[3])):
        cost = cost_of("load-iae", over, quantile)(one.structure, one.values[None, :])
        assert math.exp(float(cost[0])) == pytest.approx(expected, rel=1e-5)


def test_ranges_of_parameters_are_designed_for_and_checked_on_fresh_plants() -> None:
    """The set has the middle, the corners and a hypercube; the counts are those of ``analyse``."""

    def plant(gain: float, lag: float) -> Any:
        return [gain], [lag, 1.0]

    ranges = {"gain": (0.8, 1.2), "lag": (0.9, 1.1)}
    found = tune(plant, "pi", uncertain=ranges, samples=6, check_samples=12, seed=4)
    assert len(found.plants.plants) == 6
    check = found.check
    assert check is not None
    assert (check.samples, check.unstable, check.violating) == (12, 0, 0)
    assert check.interval[0] == 0.0
    # Clopper and Pearson's upper end without a failure: 1 − (α/2)^(1/n).
    assert check.interval[1] == pytest.approx(1.0 - 0.025 ** (1 / 12))
    m_ks = analyse(plant(**check.worst_values), found.controller).noise_to_control_peak
    assert check.worst["M_ks"] == pytest.approx(m_ks, rel=1e-3)
    assert all(ranges[k][0] <= v <= ranges[k][1] for k, v in check.worst_values.items())
    assert "12 fresh samples: 0 exceed a limit, 0 of them unstable" in str(check)
    assert "a share of 0 to 26 % (95 % interval)" in str(check)
    from quell.tuning.tuned import Uncertain

    box = Uncertain(plant, ranges)
    rows = box.design_set(6, 0)
    corners = {(0.8, 0.9), (0.8, 1.1), (1.2, 0.9), (1.2, 1.1)}
    np.testing.assert_allclose(rows[0], [1.0, 1.0])
    assert {tuple(row) for row in rows[1:5].tolist()} == corners
    assert np.all((rows[5] > [0.8, 0.9]) & (rows[5] < [1.2, 1.1]))
    fresh = box.fresh(500, 0)
    assert fresh.shape == (500, 2)
    np.testing.assert_allclose(fresh.min(axis=0), [0.8, 0.9], atol=0.01)
    np.testing.assert_allclose(fresh.max(axis=0), [1.2, 1.1], atol=0.01)
    assert box.plants(rows[:1]) == [([1.0], [1.0, 1.0])]


@pytest.mark.parametrize(
    ("make", "ranges", "message"),
    [
        (lambda a: a, {}, "uncertain = {}: must have at least one parameter"),
        (LAG, {"a": (0.0, 1.0)}, "with uncertain it must be a function that returns a plant"),
        (lambda a: a, {"b": (0.0, 1.0)}, "plant can't be called with these"),
        (lambda a: a, {"a": (2.0, 1.0)}, "a"),
    ],
)
def test_ranges_without_a_sense_are_refused(make: Any, ranges: Any, message: str) -> None:
    """None, a plant that is no function, names that it does not have, ends in the wrong order."""
    with pytest.raises(ValueError, match=message):
        tune(make, "pi", uncertain=ranges)


def test_bounds_that_contradict_each_other_are_named_with_the_least_excess() -> None:
    """Behind 1/(s − 1) with K alone |C S| is K or K/(K − 1), 2 at least: M_ks of 0.8 lacks 150 %."""
    found = tune(([1.0], [1.0, -1.0]), "pi-unfiltered", constraints=Constraints(m_ks=8.0))
    solution = found.design.solution
    assert solution is not None
    bounds = Constraints(m_s=3.0, m_t=3.0, m_ks=0.8, noise_over_pi=None)
    text = contradiction(replace(found.task, constraints=bounds).problem(), solution, bounds)
    assert text.startswith("the constraints contradict each other for this structure: ")
    assert "M_ks 0.8" in text
    share = float(text.split("the least excess that was found is ")[1].split(" %")[0])
    assert 149.0 <= share < 400.0


# ---- what a result says


@pytest.mark.trial
def test_other_limits_give_what_a_tuning_with_them_gives() -> None:
    """The trade-off of M_ks at 2.7 and 3.3."""
    found = tune(LAG, "pi")
    rows = {limit: value for name, limit, value in found.tradeoff if name == "M_ks"}
    assert list(rows) == pytest.approx([2.7, 3.3])
    again = tune(LAG, "pi", constraints=Constraints(m_ks=3.3))
    assert rows[max(rows)] == pytest.approx(again.design.k_i, rel=1e-3)
    assert rows[min(rows)] < found.design.k_i < rows[max(rows)]
    assert found.noise_curve == []
    text = found.summary()
    assert text.startswith("constraints: M_s ≤ 1.6, M_t ≤ 1.6, M_ks ≤ 3, damping ≥ 0.4, |p| dt ≤")
    assert f"M_ks 2.7: k_i {rows[min(rows)]:.4g}" in text
    assert f"pi: k_i {found.design.k_i:.4g}, IAE " in text
    assert repr(found) == f"Tuned pi:\n{text}"


@pytest.mark.trial
def test_a_guess_of_the_noise_has_a_curve_of_five_bounds() -> None:
    """Ten times the M_ks of the optimal PI controller, halves and doubles; more noise gives more k_i."""
    found = tune(LAG, "pi", constraints=None)
    pi = tune(LAG, "pi-unfiltered", constraints=Constraints(noise_over_pi=None))
    bound = found.constraints.m_ks
    assert bound == pytest.approx(10.0 * pi.design.measures["M_ks"], rel=1e-4)
    limits, values = zip(*found.noise_curve, strict=True)
    assert list(limits) == pytest.approx([bound * 2.0**k for k in range(-2, 3)])
    assert values[2] == pytest.approx(found.design.objective, rel=1e-9)
    assert found.noise[0] == found.noise_bound
    assert found.noise[1].startswith("k_i over bounds of M_ks: ")
    assert sorted(values) == list(values)


def test_the_setup_file_has_plant_scenario_and_controller() -> None:
    """Read by ``tomllib``: K, K/T_i and the filter, matrices, a step and later a load."""
    found = tune(LAG, "pi", delay=0.1, actuator_lag=0.02)
    text = found.toml()
    tables = tomllib.loads(text)
    values = found.design.values
    controller = tables["controller"]
    assert controller["kind"] == "pid"
    assert controller["kp"] == values["K"]
    assert controller["ki"] == pytest.approx(values["K"] / values["T_i"], rel=1e-12)
    assert controller["tf"] == [values["T_f"], 0.0]
    assert tables["dt"] == DT
    outer = tables["plant"]
    assert (outer["kind"], outer["delay"]) == ("delayed", pytest.approx(0.1))
    assert (outer["plant"]["kind"], outer["plant"]["lag"]) == ("lagged", 0.02)
    assert outer["plant"]["plant"]["A"] == [[-1.0]]
    scenario = tables["scenario"]
    half = 0.5 * scenario["duration"]
    assert scenario["disturbances"] == [{"kind": "step", "at": pytest.approx(half)}]
    assert [each["start"] for each in tables["metrics"]] == [0.0, pytest.approx(half)]
    assert text.startswith("# pi, tuned by quell\n# constraints: M_s ≤ 1.6")


@pytest.mark.trial
def test_the_json_has_the_numbers_of_the_design() -> None:
    """As a file reads them: finite numbers, and None for what is infinite."""
    found = tune(LAG, "pi-unfiltered")
    shown = json.loads(json.dumps(found.to_json()))
    assert shown["structure"] == "pi-unfiltered"
    assert shown["objective"] == "load"
    assert shown["constraints"]["m_ks"] == 3.0
    assert shown["design"]["values"] == dict(found.design.values)
    assert shown["design"]["measures"] == dict(found.design.measures)
    assert shown["design"]["k_i"] == found.design.k_i
    assert shown["plants"] == 1
    assert shown["dt"] == DT
    assert shown["check"] is None
    assert shown["noise_curve"] == []
    assert [each["constraint"] for each in shown["tradeoff"]] == [
        name for name, _, _ in found.tradeoff
    ]
    assert shown["designs"].keys() == {"pi-unfiltered"}
    (pole, *_) = shown["design"]["least_damped"] or [{}]
    assert not pole or 0.0 < pole["damping"] <= 1.0
