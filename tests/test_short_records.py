"""Records of some 60 to 100 samples: rest, limits, loops with a reference, delays, friction, fast poles."""

from __future__ import annotations

import math
from functools import cache
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from scipy import optimize, signal

import quell as ql
from quell.identification import (
    Identified,
    delays,
    friction_search,
    input_gain,
    search,
    structures,
)
from quell.identification.given_records import resolution_of
from quell.identification.identify import _explains_more, _with_deviations, known_of
from quell.identification.model import Root, Structure, free_run, output
from quell.identification.output_error import ParameterEstimate, gauss_newton
from quell.identification.running_loop import Form
from quell.identification.search import Known, _without_one
from quell.identification.starts import (
    Start,
    _impulse_response,
    best_start,
    from_rest,
    general,
    with_poles,
)

from .cases import cases

pytestmark = pytest.mark.compiled

DT = 0.1
LAG = ([3.0], [1.0, 2.0])


@cache
def binary(count: int, seed: int = 1, hold: int = 2) -> np.ndarray:
    """Return a u of ±1 that holds each value for some samples."""
    rng = np.random.default_rng(seed)
    return np.sign(rng.standard_normal(count)).repeat(hold)[:count]


def answer(plant: Any, u: np.ndarray) -> np.ndarray:
    """Return y of a plant (num, den) to a held u, from rest, by SciPy's sampling."""
    num, den, _ = signal.cont2discrete(plant, DT)
    return np.asarray(signal.lfilter(np.ravel(num), den, u))


def noise(count: int, size: float, seed: int = 5) -> np.ndarray:
    """Return white noise."""
    return size * np.random.default_rng(seed).standard_normal(count)


def of_lag(theta: Any, u: np.ndarray) -> np.ndarray:
    """Return y of b/(s + a) with a force and a start, sample by sample."""
    a, b, force, x = theta
    p, y = math.exp(-a * DT), np.empty(u.size)
    for k in range(u.size):
        y[k] = x
        x = p * x + (1.0 - p) * b / a * (u[k] + force)
    return y


# ---- starts at rest


@cache
def step() -> Identified:
    """Return the model of a step at the third sample, from a level of 0.7."""
    u = np.concatenate([np.zeros(2), np.ones(68)])
    return ql.identify(u, 0.7 + answer(LAG, u) + noise(70, 0.02), DT, 1, delay=0.0)


def test_a_step_soon_after_the_start_is_fitted_from_rest() -> None:
    """Gain, pole and level by SciPy; the assumption is likely; the force holds the level."""
    found = step()
    u, y = found.u, found.y
    assert (found.rest, found.rest_given) == (True, False)
    assert 0.5 < found.rest_probability <= 1.0
    assert found.held_from == 70
    best = optimize.least_squares(
        lambda theta: of_lag((theta[0], theta[1], theta[2] * theta[0] / theta[1], theta[2]), u) - y,
        [2.0, 3.0, 0.7], xtol=1e-14, ftol=1e-14, gtol=1e-14,
    )  # fmt: skip
    a, b, level = best.x
    assert found.den.tolist() == pytest.approx([1.0, a], rel=1e-4)
    assert found.num.tolist() == pytest.approx([b], rel=1e-4)
    assert found.bias == pytest.approx(level * a / b, rel=1e-4)
    np.testing.assert_allclose(found.simulated, y + best.fun, atol=1e-4)
    covariance = np.linalg.inv(best.jac.T @ best.jac) * float(best.fun @ best.fun) / 67.0
    slope = np.array([-b / a**2, 1.0 / a, 0.0])
    half = 1.96 * math.sqrt(slope @ covariance @ slope)
    low, high = found.gain_interval
    assert high - low == pytest.approx(2.0 * half, rel=0.35)
    given = ql.identify(u, y, DT, 1, delay=0.0, rest=True)
    assert (given.rest, given.rest_given) == (True, True)
    assert given.den[1] == pytest.approx(a, rel=1e-4)


def test_a_model_with_a_zero_that_starts_at_rest_away_from_zero_is_simulated_so() -> None:
    """From u = 2 the record of a step to 3 has the fit of its error; a zero acts on no first step."""
    u = np.concatenate([np.full(3, 2.0), np.full(100, 3.0)])
    y = 1.5 + answer(([2.0, 3.0], [1.0, 1.4, 4.0]), u - 2.0) + noise(103, 0.001)
    found = ql.identify(u, y, DT, 2, 1, delay=0.0, rest=True, held_out=0.0)
    assert found.num.tolist() == pytest.approx([2.0, 3.0], rel=2e-3)
    np.testing.assert_allclose(found.simulated, y, atol=0.004)
    assert found.fits["estimation"] > 99.4


@pytest.mark.trial
def test_a_record_that_begins_in_motion_is_not_taken_for_one_at_rest() -> None:
    """From a start of 2 the model at rest is contradicted."""
    u = np.concatenate([np.zeros(2), np.ones(68)])
    moving = answer(LAG, u) + 2.0 * np.exp(-0.2 * np.arange(70.0)) + noise(70, 0.02)
    assert not ql.identify(u, moving, DT, 1, delay=0.0).rest


@cases("direct", [False, True])
def test_a_model_at_rest_has_forces_and_starts_that_hold_its_levels(direct: bool) -> None:
    """Each record stays at its level under its first u; the covariance of A, B and D_u is kept."""
    rest = Structure(2, 0, (1,), direct=direct, at_rest=True, samples=(40, 50))
    theta = np.array([0.06, 0.3, 0.5, 2.0, *[0.4] * direct, 7.0, -3.0])
    u = np.concatenate([2.0 + binary(40), -1.0 + binary(50, 3)])
    covariance = np.arange(float(theta.size**2)).reshape(theta.size, theta.size)
    free, found = general(rest, ParameterEstimate(theta, covariance, 0.5, True), u)
    assert (free.degrees, free.at_rest, free.direct) == ((1, 0, 0), False, direct)
    v = np.zeros((90, 3))
    v[:, 0], v[:40, 1], v[40:, 2] = u, 1.0, 1.0
    held = v.copy()
    held[:40, 0], held[40:, 0] = u[0], u[40]
    level = output(free, found.theta, held)
    np.testing.assert_allclose(level, np.repeat([7.0, -3.0], [40, 50]), atol=1e-9)
    same = output(rest, theta, from_rest(rest, u)[:, None])
    np.testing.assert_allclose(output(free, found.theta, v), same, atol=1e-9)
    known = np.r_[:4, 6] if direct else np.r_[:4]
    of_rest = covariance[: known.size, : known.size]
    np.testing.assert_array_equal(found.covariance[np.ix_(known, known)], of_rest)
    others = np.setdiff1d(np.arange(found.theta.size), known)
    assert not found.covariance[others].any()
    assert (found.cost, found.converged) == (0.5, True)


# ---- limits, loops, several records


def test_samples_at_a_limit_are_bounded_and_not_fitted() -> None:
    """The least error of free samples, and of those at the limit where the model is below it."""
    k = np.arange(64.0)
    u = 1.4 * np.sin(0.13 * k) + 0.5 * np.sin(0.71 * k)
    full = answer(LAG, u) + noise(64, 0.01)
    y = np.minimum(full, 1.0)
    found = ql.identify(u, y, DT, 1, delay=0.0, held_out=0.0)
    at = y == 1.0
    assert found.at_limits == int(np.sum(at)) > 10

    def error(theta: np.ndarray) -> np.ndarray:
        e = of_lag(theta, u) - y
        return np.where(at, np.minimum(e, 0.0), e)

    best = optimize.least_squares(error, [2.0, 3.0, 0.0, 0.0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert found.den[1] == pytest.approx(best.x[0], rel=2e-3)
    assert found.num[0] == pytest.approx(best.x[1], rel=2e-3)
    assert found.num[0] == pytest.approx(3.0, rel=0.02)
    low, high = found.gain_interval
    assert 0.5 * (low + high) == pytest.approx(found.gain, rel=1e-2)
    assert found.poles[0].real_std == pytest.approx(math.sqrt(found.covariance[0, 0]), rel=1e-6)
    np.testing.assert_array_equal(found.y[~at], y[~at])


def loop(size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return u, y and r of the lag behind u = 2 (r − y), with coloured noise in y."""
    r = binary(84, hold=4)
    e = signal.lfilter([1.0], [1.0, -0.8], noise(84, size))
    x, u, y, p = 0.0, np.zeros(84), np.zeros(84), math.exp(-0.2)
    for k in range(84):
        y[k] = x + e[k]
        u[k] = 2.0 * (r[k] - y[k])
        x = p * x + 1.5 * (1.0 - p) * u[k]
    return u, y, r


def test_a_loop_with_its_reference_has_the_plant_without_bias() -> None:
    """Without noise exactly; with coloured noise within its deviations, which are not too small."""
    u, y, r = loop(0.0)
    found = ql.identify(u, y, DT, 1, delay=0.0, reference=r, held_out=0.0)
    assert found.num[0] == pytest.approx(3.0, rel=1e-6)
    assert found.den[1] == pytest.approx(2.0, rel=1e-6)
    assert found.method == "instrumental variables from the reference, started by output error"
    np.testing.assert_array_equal(found.reference, r)
    u, y, r = loop(0.05)
    found = ql.identify(u, y, DT, 1, delay=0.0, reference=r, held_out=0.0)
    std = np.sqrt(np.diag(found.covariance))
    assert abs(found.den[1] - 2.0) < 3.0 * std[0] < 2.0
    assert abs(found.num[0] - 3.0) < 3.0 * std[1] < 3.0
    assert found.converged
    for reference, message in (
        (np.ones(84), "reference is 1 all through: must move; without one leave it out"),
        (r[:-1], "reference"),
    ):
        with pytest.raises(ValueError, match=message):
            ql.identify(u, y, DT, 1, delay=0.0, reference=reference, held_out=0.0)
    with pytest.raises(ValueError, match="reference: goes with one record, not with several"):
        ql.identify([u[:42], u[42:]], [y[:42], y[42:]], DT, 1, delay=0.0, reference=r)
    with pytest.raises(ValueError, match="zeros = 1: with reference must be less than order = 1"):
        ql.identify(u, y, DT, 1, 1, delay=0.0, reference=r)


def test_several_records_have_forces_and_starts_of_their_own() -> None:
    """Exactly, from poles of either record."""
    one, two = binary(60), binary(64, 3)
    y = [of_lag((2.0, 3.0, 0.4, 1.0), one), of_lag((2.0, 3.0, -0.2, -2.0), two)]
    found = ql.identify([one, two], y, DT, 1, delay=0.0, rest=False)
    assert found.num.tolist() == pytest.approx([3.0], rel=1e-6)
    assert found.den.tolist() == pytest.approx([1.0, 2.0], rel=1e-6)
    assert found.samples == (60, 64)
    assert found.bias == pytest.approx(0.4, rel=1e-5)
    np.testing.assert_allclose(found.simulated, np.concatenate(y), atol=1e-6)
    for given, message in (
        (
            ([one, two], y[:1]),
            "u, y: must both be arrays, or lists of as many arrays, one for each",
        ),
        ((one, y), "u, y: must both be arrays, or lists of as many arrays, one for each record"),
        (([one, two], [y[0], y[1][:-1]]), r"y\[1\]"),
        (([one[:, None]], [y[0][:, None]]), r"^u has shape \(1, 60, 1\): must be a vector"),
    ):
        with pytest.raises(ValueError, match=message):
            ql.identify(*given, DT, 1)
    alone = ql.identify([one], [y[0]], DT, 1, delay=0.0, rest=False, held_out=0.0)
    assert alone.samples == ()


# ---- delays


def test_a_delay_explains_more_where_it_is_there() -> None:
    """The likelihood ratio of both errors against 3 ln N, and no more faults."""
    u = binary(56)
    y = np.concatenate([np.zeros(2), answer(LAG, u)[:-2]]) + noise(56, 0.01)
    how: dict[str, Any] = {"held_out": 0.0, "horizon": 1, "rest": False}
    plain, late = (ql.identify(u, y, DT, 1, delay=delay, **how) for delay in (0.0, 0.2))
    assert late.num[0] == pytest.approx(3.0, rel=0.03)
    assert _explains_more(plain, late)
    assert not _explains_more(late, plain)
    assert not _explains_more(plain, plain)
    assert structures.fits_better(plain, late)
    assert not structures.fits_better(late, plain)
    assert not structures.fits_better(plain, plain)


@cases(
    ("first", "late", "takes", "asked"),
    [
        ({}, {"delay": 0.3}, False, 1),
        ({"shortcomings": ("a",)}, {"delay": 0.3}, True, 2),
        ({"shortcomings": ("a",)}, {"delay": 0.0}, False, 2),
        ({"shortcomings": ("a",), "early": 1}, {"delay": 0.3}, True, 2),
        ({"shortcomings": ("a",), "bends": True}, {"delay": 0.3}, False, 1),
        ({"shortcomings": ("a",), "bends": True, "at_limits": 9}, {"delay": 0.3}, True, 2),
        ({"shortcomings": ("a",)}, None, False, 2),
    ],
)
def test_a_delay_is_looked_for_where_the_model_without_it_has_shortcomings(
    first: Any, late: Any, takes: bool, asked: int
) -> None:
    """Not where y bends, unless it stands at a limit; a record that is too short for it keeps the model without."""
    none = {"shortcomings": (), "early": 0, "bends": False, "at_limits": 0, "delay": 0.0}
    models = [SimpleNamespace(**{**none, **first})]
    models += [] if late is None else [SimpleNamespace(**{**none, **late})]
    calls: list[Any] = []

    def identified(records: Any, dt: float, options: Any, *rest: Any, progress: Any = None) -> Any:
        calls.append(options.delay)
        (progress or rest[-1])(0.5)
        if len(calls) > len(models):
            raise ValueError("too short")
        return models[len(calls) - 1]

    shares: list[float] = []
    with (
        patch("quell.identification.identify.identified", identified),
        patch("quell.identification.identify._explains_more", lambda *_: True),
    ):
        found = ql.identify(binary(70), binary(70), DT, 1, progress=shares.append)
    assert found is models[int(takes)]
    assert calls == [0.0, None][:asked]
    assert shares == pytest.approx([0.15, 0.65][:asked])


def test_a_range_of_delays_is_scanned_in_steps_and_doubled_while_the_best_is_at_its_end() -> None:
    """At most so many delays at once; the end of a range is its last fifth; the record ends it."""
    most = delays._SCANNED
    asked: list[range] = []

    def scanned(best: float, low: int, high: int, end: int) -> tuple[int, int, list[int]]:
        asked.clear()

        def costs(which: range) -> dict[int, float]:
            asked.append(which)
            return {one: abs(one - best) for one in which}

        last, stride, found = delays._scanned(costs, (low, high), end)
        return last, stride, sorted(found)

    assert scanned(3.0, 2, 2 + most - 1, 999) == (most + 1, 1, [*range(2, most + 2)])
    assert scanned(3.0, 2, 2 + most, 999)[1] == 2
    low, high = 100, 100 + 3 * most - 1
    assert scanned(101.0, low, high, 999) == (high, 3, [*range(low, high + 1, 3)])
    last, stride, found = scanned(20.0, 0, 20, 60)
    assert (last, stride) == (40 if most > 20 else last, -(-21 // most))
    assert found == [*range(0, last + 1, stride)]
    assert scanned(59.0, 0, 20, 60)[0] == 60
    assert len(asked) > 1
    assert scanned(16.0, 0, 20, 60)[0] == 20
    assert scanned(17.0, 0, 20, 60)[0] == 40
    assert scanned(20.0, 0, 20, 20)[0] == 20


def test_a_known_model_has_poles_per_sample_and_the_delays_that_were_searched() -> None:
    """A search from there tries these poles at all delays of the range."""
    found = step()
    known = known_of(found)
    assert known.a.tolist() == pytest.approx([found.den[1] * DT])
    assert known.searched == (0, 0)
    structure = Structure(1, 0, (0, 0))
    u = binary(60)
    v = np.column_stack([u, np.ones(60)])
    truth = np.array([0.2, 0.3, 0.0, 0.0])
    y = output(structure, truth, delays.with_delay(structure, v, u, 3.0))
    told: list[int] = []
    delay, estimate = delays.from_poles(
        structure, [np.array([0.2])], u, v, y, (0, 5), lambda: told.append(1)
    )
    assert delay == 3
    assert estimate.theta[:2].tolist() == pytest.approx([0.2, 0.3], rel=1e-5)
    assert told


@cases(("grows", "searched"), [(True, (0, 5)), (False, (2, 4))])
def test_a_search_from_a_known_model_has_its_range_of_delays_if_that_may_grow(
    grows: bool, searched: Any
) -> None:
    """Else the range that is given; for another order all starts are tried at the best delay."""
    structure, u = Structure(1, 0, (0, 0)), binary(40)
    v, asked = np.column_stack([u, np.ones(40)]), list[Any]()

    def estimate(cost: float) -> ParameterEstimate:
        return ParameterEstimate(np.zeros(4), np.eye(4), cost, True)

    def from_poles(
        structure: Any, poles: Any, u: Any, v: Any, y: Any, delays: Any, report: Any
    ) -> Any:
        asked.append((len(poles), delays))
        return 5 if last else 3, estimate(2.0)

    for a, last, near, expected in (  # noqa: B007
        (np.array([0.2]), False, 1.0, (searched, 3, 2.0)),
        (np.array([0.4, 2.2]), False, 1.0, (searched, 4, 1.0)),
        (np.array([0.4, 2.2]), False, 3.0, (searched, 3, 2.0)),
        (np.array([0.2]), True, 1.0, ("again", 6, 0.5) if grows else (searched, 5, 2.0)),
    ):
        wanted: Any = SimpleNamespace(grows=grows, delays=(2, 4), report=lambda: None)
        with (
            patch.object(search, "from_poles", from_poles),
            patch.object(search, "longest", lambda *_: 10),
            patch.object(search, "best_start", lambda *_: Start(estimate(9.0), True)),
            patch.object(search, "nearest_delay", lambda *_, near=near: (4, estimate(near))),
            patch.object(
                search, "start_with_delay", lambda *_: ("again", 6, Start(estimate(0.5), True))
            ),
        ):
            found = search._from_known(structure, Known(a, (0, 5)), u, v, u, wanted)
        assert (found[0], found[1], found[2].estimate.cost) == expected
        assert asked[-1] == (a.size, searched)
        assert found[2].confirmed


def test_a_pole_less_is_each_one_left_out_or_a_real_one_for_a_pair() -> None:
    """Coefficients in ascending powers without the highest."""
    a = np.poly([-1.0, -2.0 + 3.0j, -2.0 - 3.0j]).real[:0:-1]
    found = {tuple(np.round(each, 9)) for each in _without_one(a)}
    size = abs(-2.0 + 3.0j)
    pair = np.poly([-2.0 + 3.0j, -2.0 - 3.0j]).real[:0:-1]
    real = np.poly([-1.0, -size]).real[:0:-1]
    assert found == {tuple(np.round(pair, 9)), tuple(np.round(real, 9))}


# ---- fast poles, friction


def test_poles_have_the_deviations_of_a_model_without_fast_poles() -> None:
    """Those nearest to its own, in seconds; beyond π per sample they keep theirs."""
    slow, fast = Root(-2.0 + 0j, 9.0, 0.0), Root(-100.0 + 0j, 50.0, 0.0)
    estimate = ParameterEstimate(
        np.array([0.21, 0.3, 0.0, 0.0]), np.diag([4e-4, 1.0, 1.0, 1.0]), 0.0, True
    )
    shown: Any = SimpleNamespace(structure=Structure(1, 0, (0, 0)), estimate=estimate)
    found = _with_deviations((slow, fast), shown, DT)
    assert found[0].value == -2.0
    assert found[0].real_std == pytest.approx(0.02 / DT)
    assert found[1] == fast
    assert _with_deviations((Root(-31.4 + 0j, 9.0, 0.0),), shown, DT)[0].real_std == pytest.approx(
        0.2
    )
    assert _with_deviations((Root(-31.5 + 0j, 9.0, 0.0),), shown, DT)[0].real_std == 9.0
    # Of two poles −2 and −8, by the slopes ∂p/∂a of (s + 2)(s + 8).
    theta = np.array([0.16, 1.0, 0.3, 0.0, 0.0, 0.0])
    both = ParameterEstimate(theta, np.diag([1e-6, 4e-4, 1.0, 1.0, 1.0, 1.0]), 0.0, True)
    shown = SimpleNamespace(structure=Structure(2, 0, (0, 0)), estimate=both)
    near = (Root(-2.1 + 0j, 9.0, 0.0), Root(-7.9 + 0j, 9.0, 0.0))
    for pole, p in zip(_with_deviations(near, shown, DT), (-2.0, -8.0), strict=True):
        slope = -np.array([1.0, p]) / (2.0 * p + 10.0)
        std = np.array([1e-3 / DT**2, 0.02 / DT])
        assert pole.real_std == pytest.approx(math.hypot(*(slope * std)), rel=1e-6)


def test_direct_feedthrough_is_b_plus_d_times_a() -> None:
    """(0.4 s + 3)/(s + 2): b_0 and b_1 exactly, and their deviations by SciPy."""
    u = binary(80)
    y = answer(([0.4, 3.0], [1.0, 2.0]), u)
    exact = ql.identify(u, y, DT, 1, 1, delay=0.0, held_out=0.0)
    assert exact.num.tolist() == pytest.approx([0.4, 3.0], rel=1e-6)
    found = ql.identify(u, y + noise(80, 0.02), DT, 1, 1, delay=0.0, held_out=0.0)

    def error(theta: np.ndarray) -> np.ndarray:
        a, b_0, d, force, start = theta
        return d * u + of_lag((a, b_0 - d * a, force, start), u) - found.y

    best = optimize.least_squares(
        error, [2.0, 3.0, 0.4, 0.0, 0.0], xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    a, b_0, d = best.x[:3]
    assert found.den[1] == pytest.approx(a, rel=1e-5)
    assert found.num.tolist() == pytest.approx([d, b_0], rel=1e-5)
    covariance = np.linalg.inv(best.jac.T @ best.jac) * float(best.fun @ best.fun) / 75.0
    np.testing.assert_allclose(
        np.sqrt(np.diag(found.covariance)), np.sqrt(np.diag(covariance)[:3]), rtol=0.4
    )
    (zero,) = found.zeros
    assert zero.value.real == pytest.approx(-b_0 / d)
    slope = np.array([0.0, -1.0 / d, b_0 / d**2])
    spread = math.sqrt(slope @ found.covariance @ slope)
    assert zero.real_std == pytest.approx(spread, rel=1e-6)
    with pytest.raises(ValueError, match="feedthrough"):
        _ = exact.plant


def test_friction_of_a_speed_is_the_force_that_turns_with_it() -> None:
    """Of y' + 2 y = 3 (u − 0.4 sign y): three numbers exactly, from signs of the measured speed."""
    u = 1.5 * np.sin(0.21 * np.arange(60.0)) + 0.5 * binary(60, hold=5)
    structure = Structure(1, 0, (0, 0), (0.0,))
    theta = np.array([0.2, 0.3, 0.12, 0.0])
    y, _ = free_run(structure, theta, np.column_stack([u, np.zeros(60)]), own_friction=True)
    found = ql.identify(u, y, DT, 1, delay=0.0, bias=False, friction=True, held_out=0.0)
    assert found.num[0] == pytest.approx(3.0, rel=0.02)
    assert found.den[1] == pytest.approx(2.0, rel=0.02)
    assert found.friction == pytest.approx(0.4, rel=0.03)
    assert found.friction_std < 0.05
    estimate = ParameterEstimate(theta, np.eye(4), 0.0, True)
    least, v = friction_search.least_simulated(
        structure, estimate, np.column_stack([u, -np.sign(y)]), y
    )
    assert least.cost <= 1e-12
    np.testing.assert_allclose(least.theta[:3], theta[:3], rtol=1e-4)
    assert v.shape == (60, 2)


# ---- verdicts on models


def test_the_best_start_of_a_short_record_is_its_plant() -> None:
    """With one more pole than the plant it fits as well; of poles alone the rest is linear."""
    u = binary(90)
    v = np.column_stack([u, np.ones(90)])
    y = output(Structure(1, 0, (0, 0)), np.array([0.2, 0.3, 0.05, 0.4]), v)
    start = best_start(Structure(1, 0, (0, 0)), v, y)
    assert start.confirmed
    np.testing.assert_allclose(start.estimate.theta, [0.2, 0.3, 0.05, 0.4], rtol=1e-5)
    theta = with_poles(Structure(2, 1, (0, 0)), np.array([0.0, 0.5]))
    assert theta.tolist() == [0.5, 0.0, 0.0, 0.0, 0.0]
    two = best_start(Structure(2, 0, (1, 0)), v, y)
    assert two.estimate.cost <= 1e-12 * float(np.var(y))


def test_the_impulse_response_of_a_model_with_many_lags_is_that_of_u_alone() -> None:
    """Of a lag with a constant force, which has no part in it; over three times the lags, twice."""
    u = binary(120)
    y = of_lag((2.0, 3.0, 0.7, 0.0), u)
    g = _impulse_response(1, np.column_stack([u, np.ones(120)]), y)
    lags = int(min(20, max(0.05 * 120, 2)))
    assert g.size == 6 * lags
    p = math.exp(-0.2)
    np.testing.assert_allclose(g, 1.5 * (1.0 - p) * p ** np.arange(g.size), atol=1e-6)


@cases(
    ("y", "step"),
    [
        (np.round(np.sin(0.3 * np.arange(100.0)) / 0.05) * 0.05, 0.05),
        (np.sin(0.3 * np.arange(100.0)), 0.0),
        (np.ones(20), 0.0),
        (0.2 * np.array([0.0, 1.0, 3.0, 4.0, 9.0, 3.0]), 0.2),
    ],
)
def test_the_step_of_a_rounded_signal_is_its_smallest_change(y: Any, step: float) -> None:
    """If all changes are multiples of it."""
    assert resolution_of(y) == pytest.approx(step)


@cases(
    ("given", "message"),
    [
        ({"order": 9}, "order = 9: must be a whole number from 1 to 8"),
        ({"zeros": 2}, "zeros = 2: must be a whole number from 0 to 1"),
        ({"integrators": 2}, "integrators = 2: must be a whole number from 0 to 1"),
        (
            {"rest": True, "bias": False},
            "rest = True: goes with bias = True: y at rest is not known",
        ),
        (
            {"rest": True, "friction": True},
            "rest = True: goes without friction, which may hold a plant",
        ),
        ({"horizon": 0}, "horizon = 0: must be a whole number of at least 1"),
        (
            {"held_out": 0.91},
            "held_out = 0.91: must be from 0 to 0.9, the share of the record that",
        ),
        (
            {"held_out": 0.3},
            "held_out = 0.3: of 90 samples these are 27, must be at least 60 to be",
        ),
        (
            {"delay": 9.0},
            "delay = 9.0 s: the longest delay to search .--max-delay. is longer than the",
        ),
        (
            {"delay": (0.2, 0.1)},
            r"delay = \(0.2, 0.1\): must be from 0 on, and the smallest comes first",
        ),
        (
            {"held_out": 0.0, "validation": (np.ones(59), np.arange(59.0))},
            "validation: has 59 samples, must have at least 60",
        ),
        (
            {"held_out": 0.0, "validation": (binary(90), np.ones(90))},
            "validation: y is 1 all through: must move",
        ),
        ({"bias": 1}, "bias = 1"),
        ({"dt": 0.0}, "dt = 0"),
    ],
)
def test_what_can_not_be_identified_is_named(given: Any, message: str) -> None:
    """Argument, value, rule."""
    u = binary(90)
    how: dict[str, Any] = {"dt": DT, "order": 1, "delay": 0.0, **given}
    with pytest.raises(ValueError, match=message):
        ql.identify(u, answer(LAG, u), **how)


def test_records_that_are_short_or_rest_are_refused() -> None:
    """60 samples for order 1, u and y must move in the part for the fit, and in that held out."""
    u = binary(90)
    y = answer(LAG, u)
    how: dict[str, Any] = {"delay": 0.0, "held_out": 0.0}
    with pytest.raises(
        ValueError, match="u has 59 samples, 59 of them for the fit: must have at least"
    ):
        ql.identify(u[:59], y[:59], DT, 1, **how)
    assert ql.identify(u[:60], y[:60], DT, 1, **how).num[0] == pytest.approx(3.0)
    with pytest.raises(
        ValueError, match="u is 1 all through the samples for the fit: must move; of a y"
    ):
        ql.identify(np.ones(90), y, DT, 1, **how)
    with pytest.raises(ValueError, match="y is 2 all through the samples for the fit: must move$"):
        ql.identify(u, np.full(90, 2.0), DT, 1, **how)
    ends = np.concatenate([u, np.ones(60)])
    rests = answer(LAG, ends)
    assert ql.identify(ends, rests, DT, 1, delay=0.0).held_from == 150
    with pytest.raises(
        ValueError, match="held_out = 0.4: u is 1 all through these samples, must move;"
    ):
        ql.identify(ends, rests, DT, 1, delay=0.0, held_out=0.4)


def test_a_gauss_newton_step_solves_a_linear_problem_and_predicts_its_error() -> None:
    """Of numerator, force and start, with the pole that is right."""
    u = binary(50)
    v = np.column_stack([u, np.ones(50)])
    structure, truth = Structure(1, 0, (0, 0)), np.array([0.2, 0.3, 0.05, 0.4])
    y = output(structure, truth, v) + noise(50, 0.01)
    predicted, theta = gauss_newton(structure, truth, v, y)
    J = np.column_stack([
        (output(structure, truth + step, v) - output(structure, truth - step, v)) / 2e-6
        for step in 1e-6 * np.eye(4)
    ])  # fmt: skip
    e = y - output(structure, truth, v)
    step, *_ = np.linalg.lstsq(J, e, rcond=None)
    np.testing.assert_allclose(theta, truth + step, atol=1e-6)
    assert predicted == pytest.approx(float(np.mean((e - J @ step) ** 2)), rel=1e-6)
    wild = gauss_newton(structure, np.array([-1e3, 1.0, 0.0, 1.0]), v, y)
    assert wild[0] == math.inf


def test_a_search_is_confirmed_by_a_wider_form_at_the_same_error() -> None:
    """One that converged, with each part that the best has, and no share."""

    def model(flags: Any, size: float, converged: bool, share: Any = None) -> Any:
        form = Form(1, *flags)._replace(share=share)
        return SimpleNamespace(form=form, error=np.full(100, size), converged=converged)

    lag = (True, False, False, False)
    both = (True, True, False, False)
    best = model(lag, 1.0, False)
    same = math.sqrt(1.0 + 0.5 * input_gain._SAME_ERROR / 100.0)
    other = math.sqrt(1.0 + 2.0 * input_gain._SAME_ERROR / 100.0)
    for one, confirmed in (
        (model(both, same, True), True), (model(both, same, False), False),
        (model(both, other, True), False), (model((False,) * 4, same, True), False),
        (model(both, same, True, 0.5), False), (model(lag, 1.0, True), True),
    ):  # fmt: skip
        assert input_gain._confirmed(best, [one]) == confirmed
    assert input_gain._confirmed(model(lag, 1.0, True), [])
    assert not input_gain._confirmed(best, [])


@cases(
    ("z", "gain", "by_likelihood", "expected"),
    [
        (-1.4, -0.5, False, True),
        (-1.6, -0.5, False, False),
        (1.4, -0.5, False, True),
        (-9.0, -0.019, False, True),
        (-9.0, -0.021, False, False),
        (-2.9, -0.5, True, True),
        (-3.1, 0.5, True, False),
    ],
)
def test_an_alternative_may_be_as_good_without_a_hint_of_the_contrary(
    z: float, gain: float, by_likelihood: bool, expected: bool
) -> None:
    """From half of the limit on, with a gain of 2 %; by the likelihood from the whole on."""
    one = structures.Alternative("order 2", False, gain, z, 3.0, by_likelihood, step(), "")
    assert one.may_be_as_good == expected
