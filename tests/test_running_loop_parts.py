"""The parts of the search for b0 in a running loop: predictors, fits, means, bandwidths, reports."""

from __future__ import annotations

import json
import math
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from scipy import signal

import quell as ql
from quell.analysis import analyse
from quell.identification import (
    GainBin,
    InputGain,
    InputGainMatrix,
    MarginError,
    identify_b0,
    identify_b0_by,
    input_gain,
)
from quell.identification.bandwidth import Candidate, Reach, bandwidth, near
from quell.identification.gain_by_signal import _average, _edges, _stretches
from quell.identification.gain_matrix import _balanced, _excitation, _names, _signals
from quell.identification.input_gain import (
    _not_reached,
    asked_margin,
    longest_delay,
    seconds_text,
    time_line,
    white_where,
)
from quell.identification.loop_search import (
    gain,
    gains,
    mixture,
    physical,
    total_delay,
    visible_up_to,
)
from quell.identification.running_loop import (
    Form,
    Inputs,
    LoopFit,
    derivatives,
    fit,
    growth,
    is_stable,
    is_unstable,
    limit_slopes,
    linear_columns,
    placed,
    power,
    predicted,
    responses,
    stabilised,
)
from quell.identification.running_loop import _known_by_limits as known_by_limits
from quell.identification.running_loop import _predictor as predictor

from .cases import cases

pytestmark = pytest.mark.compiled

PLAIN = Form(2, lag=False, delay=False, drift=False)
BOTH = PLAIN._replace(lag=True, delay=True)
DRIFT = BOTH._replace(drift=True)
A = np.array([0.06, 0.3])  # s² + 0.3 s + 0.06, in units of a sample


@cache
def binary(count: int, seed: int = 1) -> np.ndarray:
    """Return a u of ±1."""
    return np.sign(np.random.default_rng(seed).standard_normal(count)).repeat(3)[:count]


# ---- forms and predictors


def test_a_form_counts_its_parameters_and_knows_their_places() -> None:
    """a, l, λ, τ, T, then b and c, then the start."""
    assert (PLAIN.size, PLAIN.states, PLAIN.known, PLAIN.of_times) == (2, 3, 1, 0)
    assert (BOTH.size, BOTH.states, BOTH.of_times) == (4, 4, 2)
    assert (DRIFT.size, DRIFT.of_times) == (8, 3)
    assert DRIFT.gains == slice(2, 6)
    assert DRIFT.times == slice(6, 8)
    forgetting = DRIFT._replace(forgets=True)
    assert (forgetting.size, forgetting.times) == (9, slice(7, 9))
    assert forgetting.non_negative == slice(6, 9)
    phi = np.arange(1.0, 10.0)
    assert forgetting.rate_of(phi) == 7.0
    assert (forgetting.lag_of(phi), forgetting.delay_of(phi)) == (8.0, 9.0)
    assert (DRIFT.rate_of(phi), PLAIN.lag_of(phi), PLAIN.delay_of(phi)) == (0.0, 0.0, 0.0)
    shared = BOTH._replace(share=0.25)
    assert shared.size == 3
    assert (shared.lag_of(np.array([1.0, 2.0, 8.0])), shared.delay_of(np.array([1.0, 2.0, 8.0]))) == (2.0, 6.0)  # fmt: skip
    many = PLAIN._replace(actuators=3, couplings=((0, 0), (0, 1)))
    assert (many.known, many.gains_of_u) == (5, slice(2, 5))


def test_gains_place_all_poles_of_a_drifting_model_at_one_rate() -> None:
    """s^(n+1) + … has them at −ω, and a stays."""
    phi = placed(A, 0.2)
    assert phi[:2].tolist() == A.tolist()
    # s³ + (a_1 + l_0) s² + (a_0 + l_1) s + l_2
    found = [1.0, A[1] + phi[2], A[0] + phi[3], phi[4]]
    np.testing.assert_allclose(np.poly([-0.2] * 3), found)


def test_without_loads_the_predictor_is_the_sampled_plant() -> None:
    """SciPy's hold; a delay of 1.3 samples divides the input 0.3 to 0.7, a lag is one more pole."""
    num, den, _ = signal.cont2discrete(([1.0], [1.0, 0.3, 0.06]), 1.0)
    found = predictor(PLAIN, A, 200)
    poles = np.linalg.eigvals(found.phi)
    assert sorted(np.abs(poles))[:2] == pytest.approx(sorted(np.abs(np.roots(den))))
    u = binary(60)
    expected = signal.lfilter(np.ravel(num), den, u)
    y = predicted(PLAIN, [A], np.array([1.0, 0.0, 0.0, 0.0]), Inputs.of(u, u), u)[:, 0]
    np.testing.assert_allclose(y, expected, atol=1e-12)
    late = predictor(PLAIN._replace(delay=True), np.append(A, 1.3), 200)
    np.testing.assert_allclose(late.gamma[:, 0] + late.gamma[:, 1], found.gamma[:, 1], atol=1e-15)
    _, (rest,) = ql.lti.models.zero_order_hold(np.array([[0.0]]), [np.eye(1)], 0.7)
    assert rest[0, 0] == pytest.approx(0.7)
    with_lag = predicted(
        BOTH, [np.append(A, [2.0, 1.0])], np.r_[1.0, np.zeros(4)], Inputs.of(u, u), u
    )
    num, den, _ = signal.cont2discrete(([0.5], np.polymul([1.0, 0.3, 0.06], [1.0, 0.5])), 1.0)
    shown = signal.lfilter(np.ravel(num), den, np.r_[u[0], u[:-1]])
    np.testing.assert_allclose(with_lag[:, 0], shown, atol=1e-10)


def test_linear_columns_add_up_to_the_prediction() -> None:
    """ŷ = columns β + the part of y, for drifting loads, lag and delay, and coupled axes."""
    rng = np.random.default_rng(4)
    u, y = binary(50), rng.standard_normal(50)
    phi = np.r_[placed(A, 0.3), 0.05, 1.5, 2.4]
    beta = rng.standard_normal(DRIFT.known + DRIFT.states)
    columns, of_y = linear_columns(DRIFT, phi, Inputs.of(u, y), y)
    whole = predicted(DRIFT, [phi], beta, Inputs.of(u, y), y)[:, 0]
    np.testing.assert_allclose(columns @ beta + of_y, whole, atol=1e-9)
    form = PLAIN._replace(actuators=2, couplings=((0, 0), (0, 1)))
    inputs = Inputs(np.column_stack([u, np.roll(u, 2)]), rng.standard_normal((50, 1)))
    beta = rng.standard_normal(form.known + form.states)
    columns, of_y = linear_columns(form, A, inputs, y)
    whole = predicted(form, [A], beta, inputs, y)[:, 0]
    np.testing.assert_allclose(columns @ beta + of_y, whole, atol=1e-9)


def test_derivatives_are_those_of_the_prediction() -> None:
    """Central differences with another step; of a time at zero one-sided."""
    rng = np.random.default_rng(4)
    u, y = binary(40), rng.standard_normal(40)
    phi = np.r_[placed(A, 0.3), 0.05, 1.5, 2.4]
    beta = rng.standard_normal(DRIFT.known + DRIFT.states)
    inputs = Inputs.of(u, y)
    found = derivatives(DRIFT, phi, beta, inputs, y)
    for i in range(DRIFT.size):
        step = 3e-6 * np.eye(DRIFT.size)[i]
        ends = predicted(DRIFT, [phi + step, phi - step], beta, inputs, y)
        np.testing.assert_allclose(
            found[:, i], (ends[:, 0] - ends[:, 1]) / 6e-6, rtol=2e-3, atol=2e-5
        )
    at_zero = np.append(A, [0.0])
    late = PLAIN._replace(delay=True)
    slope = derivatives(late, at_zero, np.ones(4), inputs, y)[:, 2]
    step = 1e-6
    ends = predicted(late, [at_zero + np.array([0.0, 0.0, step]), at_zero], np.ones(4), inputs, y)
    np.testing.assert_allclose(slope, (ends[:, 0] - ends[:, 1]) / step, rtol=1e-2, atol=1e-4)


def test_unstable_poles_are_mirrored_at_the_unit_circle() -> None:
    """Of s² − 0.2 s + 0.06 over 200 samples: e^λ becomes e^(−λ*); a slow growth is simulated."""
    a = np.array([0.06, -0.2])
    poles = np.roots([1.0, -0.2, 0.06])
    assert is_unstable(PLAIN, a, 200)
    closed = np.linalg.eigvals(predictor(PLAIN, a, 200).phi)
    for pole in poles:
        assert np.min(np.abs(closed - np.exp(-pole.conjugate()))) < 1e-9
    slow = np.array([0.06, -2e-3])
    assert not is_unstable(PLAIN, slow, 200)
    assert growth(PLAIN, slow, 200) == pytest.approx(200 * 2 * 1e-3)
    assert growth(DRIFT, placed(slow, 0.1), 200) == 0.0
    assert growth(PLAIN, A, 200) == 0.0
    assert is_stable(PLAIN, a, 200)


def test_an_unstable_predictor_is_replaced_by_one_with_the_same_spectrum() -> None:
    """Its poles outside are mirrored, the others stay; a stable one stays as it is."""
    form = PLAIN._replace(drift=True)
    phi = placed(A, 0.3)
    assert stabilised(form, phi, 100) is phi
    assert is_stable(form, phi, 100)
    wild = phi.copy()
    wild[2] = -0.5
    before = np.linalg.eigvals(predictor(form, wild, 100).phi)
    assert not is_stable(form, wild, 100)
    found = stabilised(form, wild, 100)
    assert is_stable(form, found, 100)
    after = np.linalg.eigvals(predictor(form, found, 100).phi)
    for z in before:
        expected = 1.0 / z.conjugate() if abs(z) > 1.0 else z
        assert np.min(np.abs(after - expected)) < 1e-8
    assert stabilised(PLAIN, A, 100) is A


def test_poles_at_the_limit_have_slopes_and_others_none() -> None:
    """A load without a gain has z = 1, which its gain moves inside; of a stable one there is none."""
    form = PLAIN._replace(drift=True)
    y = np.sin(0.3 * np.arange(100.0))
    at = np.r_[A, 0.0, 0.0, 0.0]
    slopes = limit_slopes(form, at, y)
    assert slopes.shape == (1, 5)
    step = 1e-6 * np.eye(5)[4]
    size = [max(abs(np.linalg.eigvals(predictor(form, phi, 100).phi))) for phi in (at + step, at)]
    assert slopes[0, 4] == pytest.approx((size[0] - size[1]) / 1e-6, rel=0.05)
    assert limit_slopes(form, placed(A, 0.3), y).shape == (0, 5)
    assert limit_slopes(PLAIN, A, y).shape == (0, 2)


def test_responses_are_those_of_plant_and_noise() -> None:
    """|1/(A (1 + τ s))|, and |det(z − Φ + K C)/det(z − Φ)|, 1 without loads."""
    omega = np.array([0.05, 0.4, 1.5])
    s = 1j * omega
    phi = np.r_[placed(A, 0.3), 0.0, 2.0, 1.0]
    of_u, of_e = responses(DRIFT, phi, 200, omega)
    expected = np.abs(1.0 / (s**2 + 0.3 * s + 0.06) / (1.0 + 2.0 * s))
    np.testing.assert_allclose(of_u, expected)
    assert np.all(of_e > 1.0) or of_e[0] > 1.0
    one = responses(PLAIN, A, 200, omega)[1]
    np.testing.assert_allclose(one, 1.0)
    # With an integrator of the load errors at low frequencies are amplified as 1/ω.
    low = responses(DRIFT, phi, 200, np.array([1e-4, 1e-3]))[1]
    assert low[0] / low[1] == pytest.approx(10.0, rel=1e-2)


# ---- fits


def loop_record(count: int, b: float, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return u and y of y' = −0.1 y + b u in a proportional loop."""
    rng = np.random.default_rng(2)
    r, y, p = binary(count), 0.0, math.exp(-0.1)
    u_log, y_log = [], []
    for k in range(count):
        seen = y + noise * rng.standard_normal()
        u_log.append(0.8 * (r[k] - seen))
        y_log.append(seen)
        y = p * y + (1.0 - p) / 0.1 * b * u_log[-1]
    return np.array(u_log), np.array(y_log)


def test_a_fit_of_a_loop_without_noise_is_exact() -> None:
    """Both a and b to seven digits from starts that are off by a half; Σ e² is zero."""
    u, y = loop_record(60, 0.4)
    form = Form(1, lag=False, delay=False, drift=False)
    found = fit(form, np.array([0.15]), Inputs.of(u, y), y)
    assert found.converged
    assert found.phi.tolist() == pytest.approx([0.1], rel=1e-7)
    assert gain(found)[0] == pytest.approx(0.4, rel=1e-7)
    assert power(form, np.array([0.1]), Inputs.of(u, y), y) < 1e-20
    assert power(form, np.array([0.12]), Inputs.of(u, y), y) > 1e-4


def test_deviations_of_a_fit_are_those_of_its_linearised_problem() -> None:
    """s² (ψᵀψ)⁻¹ with ψ by differences; AIC counts N log Σ e² and the parameters twice."""
    u, y = loop_record(90, 0.4, 0.01)
    form, inputs = Form(1, lag=False, delay=False, drift=False), Inputs.of(u, y)
    found = fit(form, np.array([0.12]), inputs, y)
    columns, _ = linear_columns(form, found.phi, inputs, y)
    step = 1e-5
    ends = [predicted(form, [found.phi + d], found.beta, inputs, y)[:, 0] for d in (step, -step)]
    psi = np.column_stack([(ends[0] - ends[1]) / (2 * step), columns[:, :2]])
    count = found.beta.size + 1
    s2 = float(found.error @ found.error) / (90 - count)
    P = s2 * np.linalg.inv(psi.T @ psi)
    b, std = gain(found)
    assert std >= math.sqrt(P[1, 1]) * 0.99
    assert std <= math.sqrt(P[1, 1]) * 1.5
    assert abs(b - 0.4) < 3.0 * std
    assert found.aic == pytest.approx(90 * math.log(float(found.error @ found.error)) + 2 * count)
    np.testing.assert_allclose(gains(found)[0], [b])
    assert math.sqrt(gains(found)[1][0, 0]) == pytest.approx(std)


def test_a_time_at_zero_is_known_by_the_other_one() -> None:
    """λ at zero does not vary, τ or T by their sum."""
    form = DRIFT._replace(forgets=True)
    phi = np.r_[placed(A, 0.3), 0.0, 0.0, 0.0, 4.0]
    found = known_by_limits(form, phi)
    assert found.tolist() == [0.0] * 6 + [math.inf, 0.25, 0.0]
    none = known_by_limits(form, np.r_[placed(A, 0.3), 0.0, 0.0, 0.0, 0.0])
    assert none.tolist() == [0.0] * 6 + [math.inf] * 3


def made(form: Form, phi: Any, beta: Any, covariance: Any = None) -> LoopFit:
    """Return a fit with a unit covariance."""
    size = len(phi) + len(beta)
    P = np.eye(size) if covariance is None else np.asarray(covariance, dtype=float)
    phi, beta = np.array(phi, dtype=float), np.array(beta, dtype=float)
    return LoopFit(form, phi, beta, P, np.ones(100), 0.0, True)


def test_lag_and_delay_together_are_known_by_the_sum_of_their_covariance() -> None:
    """Var(τ + T) = Var τ + Var T + 2 Cov; with a given share it is a parameter of its own."""
    P = np.zeros((9, 9))
    P[2:4, 2:4] = [[4.0, -3.5], [-3.5, 5.0]]
    assert total_delay(made(BOTH, [0.1, 0.2, 2.0, 3.0], np.ones(5), P)) == (
        5.0,
        pytest.approx(math.sqrt(2.0)),
    )
    shared = BOTH._replace(share=0.25)
    P = np.diag([0.0, 0.0, 0.09] + [0.0] * 5)
    assert total_delay(made(shared, [0.1, 0.2, 3.0], np.ones(5), P)) == (3.0, pytest.approx(0.3))
    assert total_delay(made(PLAIN, [0.1, 0.2], np.ones(4))) == (0.0, 0.0)


def test_parameters_have_units_of_time_and_signals() -> None:
    """a_i by dt^(i − n), b by its unit, times by dt; the covariance with the highest a first."""
    one = made(
        BOTH, [0.1, 0.2, 2.0, 3.0], [1.5, 0, 0, 0, 0], np.diag([1.0, 2, 3, 4, 5, 6, 7, 8, 9])
    )
    scale, P = physical(one, 10.0, 0.5)
    assert scale.tolist() == [4.0, 2.0, 10.0, 0.5, 0.5]
    # a_1, a_0, b, τ, T
    assert np.diag(P).tolist() == [2.0 * 4.0, 1.0 * 16.0, 5.0 * 100.0, 3.0 / 4.0, 4.0 / 4.0]
    plain = physical(made(PLAIN, [0.1, 0.2], [1.5, 0, 0, 0]), 10.0, 0.5)[1]
    assert np.diag(plain).tolist() == [4.0, 16.0, 100.0, 0.0, 0.0]


def test_a_mean_of_models_counts_their_scatter() -> None:
    """It is Σ w (σ² + (b − mean)²)."""
    mean, std = mixture([(1.0, 0.1), (2.0, 0.2)], np.array([0.75, 0.25]))
    assert mean == pytest.approx(1.25)
    variance = 0.75 * (0.01 + 0.0625) + 0.25 * (0.04 + 0.5625)
    assert std == pytest.approx(math.sqrt(variance))


def test_the_plant_is_visible_where_u_moves_y_by_more_than_noise() -> None:
    """Of a lag 1/(s + 0.1) and white noise: up to the frequency where its gain has fallen to that."""
    rng = np.random.default_rng(6)
    form = Form(1, lag=False, delay=False, drift=False)
    one = made(form, [0.1], [1.0, 0.0, 0.0])._replace(error=0.5 * rng.standard_normal(6400))
    u = rng.standard_normal((6400, 1))
    # |1/(jω + 0.1)| = 0.5 at ω ≈ 2, by the flat spectra of both.
    assert visible_up_to(one, u, 0.1) == pytest.approx(20.0, rel=0.15)
    assert visible_up_to(one, 2.0 * u, 0.1) > visible_up_to(one, u, 0.1)
    assert visible_up_to(one, 1e-6 * u, 0.1) == 0.0


def test_whiteness_is_judged_in_some_samples_alone() -> None:
    """White errors of any size pass, a moving mean fails, too few samples fail."""
    rng = np.random.default_rng(8)
    e, where = rng.standard_normal(2000), np.arange(2000) % 200 < 120
    assert white_where(e, where, 20)
    assert white_where(e * (1.0 + 5.0 * (np.arange(2000) > 1000)), where, 20)
    assert not white_where(e + np.r_[0.0, e[:-1]], where, 20)
    assert white_where(np.where(where, e, np.roll(e, 1)), where, 20)
    assert not white_where(e, np.arange(2000) < 79, 20)


# ---- bandwidths


def test_the_largest_bandwidth_just_keeps_its_margin() -> None:
    """Of b/s with a delay: the phase margin of ``analyse`` is what was asked for; 1 % more has less."""
    loops = Candidate(2.0, np.array([1.0, 0.0]), 0.0, 0.02, b0=2.0, dt=0.01)
    found = bandwidth(loops, 50.0, 5.0)
    assert found.keeps

    def margin(omega_c: float) -> float:
        observer = ql.ESO.model_free(1, 2.0, 5.0 * omega_c, 0.01)
        return analyse(([2.0], [1.0, 0.0]), ql.ADRC(observer, omega_c), delay=0.02).margins.phase

    assert found.phase == pytest.approx(50.0, abs=1e-2)
    assert margin(found.omega_c) == pytest.approx(50.0, abs=1e-2)
    assert margin(1.01 * found.omega_c) < 50.0
    assert loops.exact(found.omega_c, 5.0) == pytest.approx(margin(found.omega_c))
    assert loops.rough(found.omega_c, 5.0) == pytest.approx(50.0, abs=0.15)
    assert near(loops, 50.0, 0.9 * found.omega_c, 5.0) == pytest.approx(found.omega_c, rel=1e-3)
    assert near(loops, 50.0, 1.1 * found.omega_c, 5.0) == pytest.approx(found.omega_c, rel=1e-3)


def test_a_bandwidth_scales_with_time_and_not_with_the_gain() -> None:
    """Ten times faster, with ten times the omega_c; b and b0 both a hundred times as large."""
    one = bandwidth(Candidate(2.0, np.array([1.0, 0.5]), 0.02, 0.02, b0=2.0, dt=0.01), 45.0, 5.0)
    fast = Candidate(200.0, np.array([1.0, 5.0]), 2e-3, 2e-3, b0=200.0, dt=1e-3)
    other = bandwidth(fast, 45.0, 5.0)
    assert other.omega_c == pytest.approx(10.0 * one.omega_c, rel=1e-4)
    assert other.phase == pytest.approx(one.phase, abs=1e-2)


def test_a_margin_that_no_bandwidth_keeps_gives_the_best_one() -> None:
    """Of y'' = b u with a ratio of 5: 41°, as its docstring says."""
    loops = Candidate(1.0, np.array([1.0, 0.0, 0.0]), 0.0, 0.0, b0=1.0, dt=1e-3)
    found = bandwidth(loops, 60.0, 5.0)
    assert not found.keeps
    assert found.phase == pytest.approx(41.0, abs=1.0)
    assert loops.exact(found.omega_c, 5.0) == pytest.approx(found.phase, abs=0.5)


# ---- results


def result(**changed: Any) -> InputGain:
    """Return b0 = 3 ± 0.1 of order 1."""
    given: dict[str, Any] = {"order": 1, "b0": 3.0, "b0_std": 0.1, "den": np.array([1.0, 0.5])}
    given |= {"lag": 0.02, "lag_std": 0.004, "delay": 0.01, "delay_std": 0.004, "dt": 0.01}
    given |= {"total_delay": 0.03, "total_delay_std": 1e-3, "samples": 500, "noise": 0.02}
    given |= {"omega_max": 40.0, "white": True, "independent": True, "converged": True}
    given |= {"covariance": np.diag([0.01, 0.01, 1.6e-5, 1.6e-5])}
    return InputGain(**{**given, **changed})


def test_b0_is_known_within_thirty_percent_at_two_deviations() -> None:
    """95 %: 1.96 deviations; from 15 % on the record is too poor, and an unseen u is asked for."""
    one = result()
    assert one.interval == pytest.approx((3.0 - 0.196, 3.0 + 0.196))
    assert not one.is_poor
    assert one.shortcomings == ()
    assert one.refusal == ""
    assert not result(b0_std=0.449).is_poor
    assert result(b0_std=0.45).is_poor
    poor = result(b0_std=0.6)
    assert poor.shortcomings[0].startswith(
        "the excitation is too poor: b0 may be anything from 1.824 to 4.176; record"
    )
    assert "is it u that was recorded?" not in poor.shortcomings[0]
    assert "is it u that was recorded?" in result(b0_std=0.8).shortcomings[0]
    assert poor.refusal.startswith("omega_c not computed, as b0 is not known")
    assert result(b0=-3.0).interval == pytest.approx((-3.196, -2.804))
    assert not result(b0=-3.0).is_poor


@cases(
    ("changed", "rejected", "text"),
    [
        ({"converged": False}, True, "the search did not converge; record longer"),
        ({"independent": False}, True, "the error depends on past u, so the plant is not of this"),
        ({"white": False, "white_in_motion": False}, True, "the error is not white, so plant or"),
        ({"white": False}, False, "the error is not white, as that of the rounding of y at rest"),
    ],
)
def test_what_rejects_the_form_of_the_plant_is_said(
    changed: Any, rejected: bool, text: str
) -> None:
    """Then there is no bandwidth, and no interval in JSON."""
    one = result(**changed)
    assert one.rejected is rejected
    assert len(one.shortcomings) == 1
    assert one.shortcomings[0].startswith(text)
    assert f"NOT: {text}" in str(one)
    assert (one.to_json()["interval_95"] is None) is rejected
    assert one.refusal.startswith("omega_c not computed, as the record does not") is rejected
    if rejected:
        with pytest.raises(MarginError, match="omega_c not computed"):
            one.omega_c()
        assert "a deviation within this form only, which the record rejects" in str(one)


def test_the_report_of_b0_has_units_and_times() -> None:
    """Line by line; without a visible frequency it says so."""
    lines = str(result()).splitlines()
    assert lines == [
        "b0 = 3 ± 0.1 y-unit/u-unit/s, 95 %: 2.804 to 3.196",
        "actuator's lag 20 ± 4 ms",
        "delay 10 ± 4 ms: hardly visible",
        "both together 30 ± 1 ms",
        "the record shows the plant up to 40 rad/s; error of the prediction: RMS 0.02",
    ]
    assert str(result(order=2)).startswith("b0 = 3 ± 0.1 y-unit/u-unit/s^2, ")
    blind = result(omega_max=0.0)
    assert "at no frequency u moves y by more than noise does; error" in str(blind)
    assert blind.refusal.startswith("omega_c not computed, as at no frequency u moves y")
    shown = json.loads(json.dumps(result().to_json()))
    assert (shown["b0"], shown["den"], shown["samples"]) == (3.0, [1.0, 0.5], 500)
    assert shown["interval_95"] == pytest.approx([2.804, 3.196])


@pytest.mark.trial
def test_the_deviation_of_a_bandwidth_follows_from_those_of_the_plant() -> None:
    """Of an exact plant it is none; of an uncertain delay by the slope of omega_c, as differences."""
    exact = result(covariance=np.zeros((4, 4)), lag=0.0, lag_std=0.0).omega_c(50.0, ratio=5.0)
    assert exact.std == 0.0
    known = np.diag([0.0, 0.0, 0.0, 1e-8])
    found = result(covariance=known, lag=0.0, lag_std=0.0).omega_c(50.0, ratio=5.0)
    assert found.omega_c == pytest.approx(exact.omega_c)
    late = result(delay=0.0101, covariance=np.zeros((4, 4)), lag=0.0).omega_c(50.0, ratio=5.0)
    assert found.std == pytest.approx(abs(late.omega_c - exact.omega_c), rel=0.05)
    assert found.ratio == 5.0


def test_a_lag_and_a_delay_that_may_be_none_are_not_negative() -> None:
    """Beyond zero the loop is that without them."""
    at, loops = result(lag=1e-3, delay=0.01)._loops()
    assert at[-2:].tolist() == [1e-3, 0.01]
    early, none = loops(at - [0.0, 0.0, 2e-3, 0.05]), loops(at - [0.0, 0.0, 1e-3, 0.01])
    for name in ("N", "B", "C"):
        np.testing.assert_array_equal(getattr(early.plant, name), getattr(none.plant, name))
    assert loops(at).plant.N.shape != none.plant.N.shape


@cases(
    ("given", "message"),
    [
        ({"phase_margin": 90.0}, "phase_margin = 90.0: must be below 90 degrees"),
        ({"phase_margin": 0.0}, "phase_margin = 0.0"),
        ({"phase_margin": 50.0, "ratio": -1.0}, "ratio = -1.0"),
    ],
)
def test_a_margin_out_of_range_is_refused(given: Any, message: str) -> None:
    """From 0 to 90 degrees, and a positive ratio."""
    with pytest.raises(ValueError, match=message):
        asked_margin(**given)
    assert asked_margin(60.0) == (60.0, None)
    assert asked_margin(60, 5) == (60.0, 5.0)
    with pytest.raises(ValueError, match="b0 is zero: there is no loop"):
        result(b0=0.0).omega_c()
    with pytest.raises(MarginError, match="is longer than 200 samples"):
        result(delay=2.01).omega_c()


def test_why_no_bandwidth_keeps_a_margin_is_said_with_the_best_one() -> None:
    """And with another ratio that keeps it."""
    best = Reach(12.345, 5.0, 41.23, False)
    text = _not_reached("60° of phase margin", best, 5.0, None)
    assert text == (
        "no omega_c keeps 60° of phase margin with an omega_o of 5 omega_c: the best is 41.2° with "
        "omega_c = 12.35 rad/s and omega_o = 5 omega_c; ask for less, or sample faster and make "
        "the delay or the lag shorter"
    )
    other = Reach(3.0, 30.0, 60.0, True)
    assert _not_reached("60°", best, 5.0, other).endswith(
        "; omega_o = 30 omega_c keeps it with omega_c = 3 rad/s"
    )
    none = _not_reached("60°", Reach(math.nan, 5.0, -180.0, False), None, None)
    assert none.startswith(
        "no omega_c keeps 60° with an omega_o from 3 to 100 omega_c: no such loop of this plant"
    )


def test_times_are_written_as_exactly_as_they_are_known() -> None:
    """In ms below a second, up to the second digit of the deviation, six digits at most."""
    assert seconds_text(0.0123456, 0.001) == "12.35 ± 1 ms"
    assert seconds_text(0.0123456, 1e-6) == "12.3456 ± 0.001 ms"
    assert seconds_text(0.0123456, 1e-9) == "12.3456 ± 1e-06 ms"
    assert seconds_text(1.5, 0.2) == "1.5 ± 0.2 s"
    assert seconds_text(0.5, 0.0) == "500 ± 0 ms"
    assert time_line("delay", 0.0, 0.0) == "delay: none is visible"
    assert time_line("delay", 0.01, 0.003).endswith(" ms")
    assert time_line("delay", 0.009, 0.003).endswith(" ms: hardly visible")
    assert longest_delay(None, 1000, 0.01) == 20
    assert longest_delay(None, 100, 0.01) == 5
    assert longest_delay(0.3, 1000, 0.01) == pytest.approx(30)


# ---- b0 in bins of a signal


def test_bins_divide_the_range_of_a_signal() -> None:
    """Evenly, or at given edges, which increase."""
    s = np.array([0.0, 1.0, 4.0])
    assert _edges(s, 4).tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert _edges(s, [0.5, 2.0]).tolist() == [0.5, 2.0]
    for bins, message in (
        ([1.0], "edges must be two or more increasing numbers"),
        ([1.0, 1.0], "edges must be two or more increasing numbers"),
        (0, "bins = 0"),
        (101, "bins = 101"),
    ):
        with pytest.raises(ValueError, match=message):
            _edges(s, bins)
    with pytest.raises(ValueError, match="signal is 2 all through"):
        _edges(np.full(5, 2.0), 3)
    mask = np.array([1, 1, 0, 1, 0, 0, 1, 1, 1], dtype=bool)
    assert _stretches(mask) == [slice(0, 2), slice(3, 4), slice(6, 9)]
    assert _stretches(np.zeros(3, dtype=bool)) == []


def test_estimates_are_averaged_by_their_deviations() -> None:
    """Weights 1/σ²; a scatter beyond the deviations widens them."""
    mean, std = _average(np.array([[1.0, 0.1], [1.1, 0.2]]))
    assert mean == pytest.approx((100.0 + 25.0 * 1.1) / 125.0)
    assert std == pytest.approx(math.sqrt(1.0 / 125.0))
    far, wide = _average(np.array([[1.0, 0.1], [2.0, 0.1]]))
    assert far == pytest.approx(1.5)
    # Σ w (b − mean)²/(2 − 1) = 2 · 100 · 0.25 = 50 times 1/200
    assert wide == pytest.approx(math.sqrt(50.0 / 200.0))
    assert _average(np.array([[1.0, 0.1]])) == (pytest.approx(1.0), pytest.approx(0.1))


def test_a_bin_says_b0_or_why_it_is_not_known() -> None:
    """A line of its own."""
    known = GainBin(0.0, 1.0, 0.4, 50, 40, 3.0, 0.1, "")
    assert known.is_known
    assert known.interval == pytest.approx((2.804, 3.196))
    assert str(known) == (
        "0 … 1 (mean 0.4): b0 = 3, 95 % interval 2.804 … 3.196, from 40 of 50 samples"
    )
    assert str(known._replace(reason="why")) == "NOT known at 0 … 1: why"
    signal_of = np.arange(100.0)
    u, y = loop_record(100, 0.4, 0.01)
    found = identify_b0_by(u, y, signal_of, 0.1, 1, bins=20)
    assert len(found) == 20
    assert all("no stretch of" in each.reason for each in found)
    assert [each.samples for each in found] == [5] * 20
    assert found[0].mean == pytest.approx(0.5 * 99.0 / 20)
    assert math.isnan(found[0].b0)
    assert found[0].b0_std == math.inf


# ---- coupled axes


def test_the_condition_of_an_excitation_is_that_of_correlated_inputs() -> None:
    """With a correlation ρ it is √((1 + ρ)/(1 − ρ)); beyond 30 the actuators moved together."""
    names = ["a", "b", "c"]
    for rho in (0.0, 0.5, 0.99):
        P = np.linalg.inv(np.array([[1.0, rho, 0.0], [rho, 1.0, 0.0], [0.0, 0.0, 1.0]]))
        P = P * np.outer([1.0, 100.0, 0.01], [1.0, 100.0, 0.01])  # whatever the units
        condition, together = _excitation(P, names)
        assert condition == pytest.approx(math.sqrt((1.0 + rho) / (1.0 - rho)), rel=1e-6)
        assert together == ()
    rho = 0.998
    P = np.linalg.inv(np.array([[1.0, rho, 0.0], [rho, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    assert _excitation(P, names) == (
        pytest.approx(math.sqrt(1.998 / 0.002), rel=1e-4),
        ("a", "b"),
    )
    assert _excitation(np.eye(1), ["a"]) == (1.0, ())
    assert _excitation(np.diag([1.0, 0.0]), ["a", "b"]) == (1.0, ())


def test_rows_and_columns_are_scaled_to_a_largest_entry_of_one() -> None:
    """What rows and columns have in proportion stays."""
    size = np.array([[2.0, 300.0], [0.5, 20.0]])
    found = _balanced(size, size)
    np.testing.assert_allclose(found.max(axis=0), 1.0)
    np.testing.assert_allclose(found.max(axis=1), 1.0)
    ratio = size[0, 0] * size[1, 1] / size[0, 1] / size[1, 0]
    assert found[0, 0] * found[1, 1] / found[0, 1] / found[1, 0] == pytest.approx(ratio)
    np.testing.assert_allclose(_balanced(size, 0.1 * size), 0.1 * found)


def matrix(**changed: Any) -> InputGainMatrix:
    """Return B0 of two axes that are known."""
    given: dict[str, Any] = {"B0": np.array([[2.0, -0.5], [0.4, 3.0]]), "dt": 0.01, "samples": 900}
    given |= {"std": np.full((2, 2), 0.02), "covariance": np.zeros((2, 2, 2)), "orders": (2, 2)}
    given |= {"axes": ("x", "y"), "actuators": ("u1", "u2"), "condition": np.array([2.0, 3.0])}
    for name in ("total_delay", "total_delay_std", "lag", "lag_std", "delay", "delay_std"):
        given[name] = np.array([2e-3, 3e-3]) if name == "total_delay" else np.zeros(2)
    given |= {"noise": np.full(2, 0.1), "omega_max": np.full(2, 40.0), "enlarged": np.ones(2)}
    given |= {"white": (True, True), "independent": (True, True), "converged": (True, True)}
    given |= {"together": ((), ())}
    return InputGainMatrix(**{**given, **changed})


def test_a_matrix_that_is_known_has_no_shortcomings() -> None:
    """Intervals of 1.96 deviations, a report of each row, JSON."""
    one = matrix()
    assert one.shortcomings == ()
    assert not one.is_poor
    assert not one.may_be_singular
    assert one.unseen == ()
    np.testing.assert_allclose(one.intervals[0, 0], [2.0 - 0.0392, 2.0 + 0.0392])
    lines = str(one).splitlines()
    assert lines[0] == "B0 of x: u1 2 ± 0.02, u2 -0.5 ± 0.02"
    assert lines[2].startswith(
        "x, order 2: lag: none is visible; delay: none is visible; together 2 ±"
    )
    assert lines[2].endswith("shown up to 40 rad/s; condition number of the excitation 2")
    assert len(lines) == 4
    shown = json.loads(json.dumps(one.to_json()))
    assert shown["B0"] == one.B0.tolist()
    assert shown["intervals_95"][0][0] == pytest.approx([1.9608, 2.0392])


def test_entries_are_known_beside_the_largest_of_their_row_and_column() -> None:
    """±30 % of themselves, or of the largest; half of 0.5 is too wide of itself, not beside 2."""
    std = np.full((2, 2), 0.02)
    std[0, 1] = 0.2
    assert not matrix(std=std).is_poor
    std[0, 1] = 0.6
    assert matrix(std=std).poor.tolist() == [[False, True], [False, False]]
    (line, *_) = matrix(std=std).shortcomings
    assert line.startswith(
        "axis x: the record is too poor for the entry of u2 from -1.676 to 0.676; move"
    )


def test_an_actuator_that_moves_no_axis_is_asked_for() -> None:
    """Then no entry is known; actuators that moved together are named instead."""
    std = np.array([[0.02, 0.2], [0.02, 1.0]])
    one = matrix(std=std)
    assert one.unseen == ("u2",)
    assert np.all(one.poor)
    assert one.shortcomings[0].startswith(
        "u2 is not seen to move an axis in this record: is u2 recorded, in the right column"
    )
    both = matrix(std=np.full((2, 2), 2.0))
    assert both.shortcomings[0].startswith(
        "u1 and u2 are not seen to move an axis in this record: are u1 and u2 recorded"
    )
    mixed = matrix(std=np.full((2, 2), 2.0), together=(("u1", "u2"), ()))
    assert mixed.unseen == ()
    assert mixed.shortcomings[0].startswith("axis x: u1 and u2 moved together (condition number 2)")
    assert "(quell excite --actuators 2)" in mixed.shortcomings[0]


def test_a_matrix_that_may_be_singular_or_was_not_found_is_said() -> None:
    """Rows in proportion, a search that did not end, an error that depends on u or is not white."""
    even = matrix(B0=np.array([[2.0, 1.0], [2.05, 1.0]]), std=np.full((2, 2), 0.03))
    assert even.may_be_singular
    assert even.shortcomings[0].startswith("B0 may be singular within its deviations")
    assert matrix(B0=np.ones((2, 1)), std=np.full((2, 1), 0.01), actuators=("u1",)).may_be_singular
    assert matrix(converged=(True, False)).shortcomings == (
        "axis y: the search did not converge; record longer, or check the order",
    )
    (text,) = matrix(independent=(False, True), enlarged=np.array([3.0, 1.0])).shortcomings
    assert text.startswith("axis x: the error depends on past u")
    assert "the deviations are enlarged by 3" in text
    (text,) = matrix(enlarged=np.array([1.0, 9.0])).shortcomings
    assert text.startswith("axis y: the error is not white: the deviations are enlarged by 9")
    assert "; deviations enlarged by 9, as the error is not white" in str(
        matrix(enlarged=np.array([1.0, 9.0]))
    )


def test_records_of_axes_are_tables_with_names() -> None:
    """A row for each sample, finite; names are different."""
    assert _signals("u", [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]).shape == (3, 2)
    for table in ([1.0, 2.0], [[1.0, 2.0], [3.0, 4.0]], [[1.0, 2.0, 3.0]]):
        with pytest.raises(ValueError, match="u has the shape"):
            _signals("u", table)
    with pytest.raises(ValueError, match=r"u\[1, 0\] = nan: must be finite"):
        _signals("u", [[1.0], [math.nan], [2.0]])
    assert _names("axes", None, "y", 2) == ("y1", "y2")
    assert _names("axes", ["a", "b"], "y", 2) == ("a", "b")
    for given in (["a"], ["a", "a"]):
        with pytest.raises(ValueError, match="must be 2 different names"):
            _names("axes", given, "y", 2)


# ---- whole searches


def record(count: int, delay: int = 0, noise: float = 0.01) -> Any:
    """Return u and y of y' = −y + 4 u, sampled at 0.1 s, in a loop, behind a delay."""
    rng, r = np.random.default_rng(2), binary(count)
    y, p = 0.0, math.exp(-0.1)
    used, seen = [0.0] * delay, []
    for k in range(count):
        seen.append(y + noise * rng.standard_normal())
        used.append(0.8 * (r[k] - seen[-1]))
        y = p * y + (1.0 - p) * 4.0 * used[k]
    return np.array(used[delay:]), np.array(seen)


@cache
def found_b0() -> InputGain:
    """Return b0 of 91 samples."""
    return identify_b0(*record(91), 0.1, 1)


def test_b0_of_a_short_record_of_a_loop_is_found_within_its_deviation() -> None:
    """4 within three deviations of a half percent; a_0 of 1, no lag or delay, white noise."""
    found = found_b0()
    assert abs(found.b0 - 4.0) < 3.0 * found.b0_std
    assert 0.002 < found.b0_std < 0.04
    assert found.den.tolist() == pytest.approx([1.0, 1.0], abs=0.05)
    assert found.total_delay < 4.0 * found.total_delay_std + 1e-3
    assert found.noise == pytest.approx(0.01, rel=0.2)
    assert (found.order, found.dt, found.samples) == (1, 0.1, 91)
    assert found.white
    assert found.independent
    assert found.converged
    assert found.shortcomings == ()
    assert found.omega_max == pytest.approx(math.pi / 0.1, rel=0.2)


def test_b0_has_the_units_of_its_record() -> None:
    """With y in mm, u in mA and t in ms: all figures scale, verdicts stay."""
    u, y = record(91)
    one, other = found_b0(), identify_b0(8.0 * u, 500.0 * y, 4.0, 1)
    assert other.b0 == pytest.approx(one.b0 * 500.0 / 8.0 / 40.0, rel=1e-6)
    assert other.b0_std == pytest.approx(one.b0_std * 500.0 / 8.0 / 40.0, rel=1e-4)
    assert other.den[1] == pytest.approx(one.den[1] / 40.0, rel=1e-5)
    assert other.total_delay == pytest.approx(40.0 * one.total_delay, rel=1e-3, abs=1e-6)
    assert other.noise == pytest.approx(500.0 * one.noise, rel=1e-6)
    assert other.omega_max == pytest.approx(one.omega_max / 40.0, rel=1e-9)
    assert other.shortcomings == one.shortcomings


@pytest.mark.trial
def test_a_delay_in_a_loop_is_found_beside_b0() -> None:
    """Two samples, within its deviation; the lag is none. By a search from fewer starts."""
    few = {"_RATES": (0.05,), "_GRID": 4, "_DENOMINATORS": 1, "_SHARES": (0.5,)}
    with patch.multiple(input_gain, **few):
        found = identify_b0(*record(91, delay=2), 0.1, 1)
    assert found.total_delay == pytest.approx(0.2, abs=4.0 * found.total_delay_std)
    assert found.total_delay_std < 2e-3
    assert abs(found.b0 - 4.0) < 4.0 * found.b0_std
    assert found.delay == pytest.approx(0.2, abs=3e-3)


def test_b0_in_bins_is_that_of_the_stretches_in_them() -> None:
    """The first 91 samples are one; the others are too few."""
    u, y = record(110)
    known, few = identify_b0_by(u, y, np.arange(110) >= 91, 0.1, 1, bins=2)
    assert known.is_known
    assert (known.samples, known.used, known.mean) == (91, 91, 0.0)
    assert abs(known.b0 - 4.0) < 3.0 * known.b0_std
    assert (few.samples, few.used) == (19, 0)
    assert "no stretch of 90 samples in a row" in few.reason
    assert str(few).startswith("NOT known at 0.5 … 1: ")


@pytest.mark.parametrize(
    ("u", "y", "options", "message"),
    [
        (80, 80, {}, "u has 80 samples: must have at least 90 for order 1; record longer"),
        (95, 94, {}, "y"),
        (95, 95, {"order": 5}, "order = 5"),
        (95, 95, {"dt": 0.0}, "dt = 0.0"),
        (95, 95, {"max_delay": -1.0}, "max_delay = -1.0"),
    ],
)
def test_records_of_a_loop_that_say_nothing_are_refused(
    u: int, y: int, options: Any, message: str
) -> None:
    """Too short, of other lengths, arguments out of range; one that rests."""
    given = {"dt": 0.1, "order": 1, **options}
    with pytest.raises(ValueError, match=message):
        identify_b0(binary(u), np.cumsum(binary(y)), **given)
    with pytest.raises(ValueError, match="y"):
        identify_b0(binary(95), np.ones(95), 0.1, 1)
