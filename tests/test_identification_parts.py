"""The parts of the search for a model: simulation, gradient, friction, noise, starts, tests of the error."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy import signal, stats

import quell as ql
from quell.identification import (
    delays,
    friction_search,
    model,
    output_error,
    search,
    starts,
    validation,
)
from quell.identification.frequency_starts import continuous
from quell.identification.gain_matrix import _of_u
from quell.identification.model import (
    Structure,
    chain,
    chains,
    companion,
    correlation,
    observable,
    output,
    output_gradient,
    sampled,
    states,
    states_with_friction,
)
from quell.identification.output_error import covariance_of, noise_model, refine
from quell.identification.search import Known, Wanted

from .cases import cases

pytestmark = pytest.mark.compiled


@cache
def binary(count: int, seed: int = 1) -> np.ndarray:
    """Return a u of ±1 that holds each value for three samples."""
    rng = np.random.default_rng(seed)
    return np.sign(rng.standard_normal(count)).repeat(3)[:count]


A = np.array([0.06, 0.3])
LAG = Structure(1, 0, (0, 0))
TWO = Structure(2, 0, (1, 0))


def inputs(u: np.ndarray) -> np.ndarray:
    """Return u with a constant force."""
    return np.column_stack([u, np.ones(u.size)])


# ---- simulation


def test_companion_forms_have_the_polynomial_of_their_poles() -> None:
    """Both; the first with states p^i/A v, the second with numerators as columns of B."""
    for matrix in (companion(A)[0], observable(A)):
        np.testing.assert_allclose(np.poly(matrix), [1.0, 0.3, 0.06])
    M, B = companion(A)
    s = 0.7j
    x = np.linalg.solve(s * np.eye(2) - M, B[:, 0])
    poly = s**2 + 0.3 * s + 0.06
    np.testing.assert_allclose(x, [1.0 / poly, s / poly])
    y = np.linalg.solve(s * np.eye(2) - observable(A), [5.0, 2.0])[0]
    assert y == pytest.approx((5.0 * s + 2.0) / poly)


def test_a_linear_input_is_sampled_exactly() -> None:
    """A ramp through 1/(s + 0.5): 2 t − 4 (1 − e^(−t/2)) at the samples; held it is another one."""
    one = sampled(np.array([[-0.5]]), np.ones((1, 1)), straight=True)
    t = np.arange(12.0)
    x = states(one, t[:, None])[:, 0]
    np.testing.assert_allclose(x[:-1], (2.0 * t - 4.0 * (1.0 - np.exp(-0.5 * t)))[:-1], atol=1e-12)
    held = states(sampled(np.array([[-0.5]]), np.ones((1, 1))), t[:, None])[:, 0]
    expected, now = [], 0.0
    for value in t:
        expected.append(now)
        now = math.exp(-0.5) * now + (1.0 - math.exp(-0.5)) * 2.0 * value
    np.testing.assert_allclose(held, expected)


def test_chains_are_the_derivatives_of_a_filtered_signal() -> None:
    """Responses p^i/A of held inputs by SciPy, and of an impulse, which is 1 in the highest at the start."""
    u = binary(40)
    bank = chains(A, u[:, None])
    num, den, _ = signal.cont2discrete(([1.0], [1.0, 0.3, 0.06]), 1.0)
    np.testing.assert_allclose(bank[:, 0, 0], signal.lfilter(np.ravel(num), den, u), atol=1e-12)
    num, den, _ = signal.cont2discrete(([1.0, 0.0], [1.0, 0.3, 0.06]), 1.0)
    np.testing.assert_allclose(bank[:, 1, 0], signal.lfilter(np.ravel(num), den, u), atol=1e-12)
    assert bank[0, :, 1].tolist() == [0.0, 1.0]
    root = np.roots([1.0, 0.3, 0.06])
    t = np.arange(40.0)
    impulse = (np.exp(root[0] * t) - np.exp(root[1] * t)) / (root[0] - root[1])
    np.testing.assert_allclose(bank[:, 0, 1], impulse.real, atol=1e-12)
    ramp = chain(np.array([0.5]), t)[:, 0]
    np.testing.assert_allclose(
        ramp[:-1], (2.0 * t - 4.0 * (1.0 - np.exp(-0.5 * t)))[:-1], atol=1e-11
    )


def test_the_output_of_a_model_is_its_transfer_function_with_force_and_start() -> None:
    """(b_1 s + b_0) u + c, all over A, from D; with direct feedthrough and a level at rest."""
    u = binary(50)
    theta = np.array([*A, 0.5, 2.0, 0.3, 0.7, -0.2])
    y = output(TWO, theta, inputs(u))
    num, den, _ = signal.cont2discrete(([2.0, 0.5], [1.0, 0.3, 0.06]), 1.0)
    of_u = signal.lfilter(np.ravel(num), den, u)
    num, den, _ = signal.cont2discrete(([0.3], [1.0, 0.3, 0.06]), 1.0)
    of_c = signal.lfilter(np.ravel(num), den, np.ones(50))
    bank = chains(A, u[:, None])[:, :, 1]
    np.testing.assert_allclose(y, of_u + of_c + bank @ [0.7, -0.2], atol=1e-12)
    direct = Structure(2, 0, (1, 0), direct=True)
    more = np.insert(theta, 5, 4.0)
    np.testing.assert_allclose(output(direct, more, inputs(u)), y + 4.0 * u, atol=1e-12)
    rest = Structure(2, 0, (1,), at_rest=True)
    np.testing.assert_allclose(
        output(rest, np.array([*A, 0.5, 2.0, 7.0]), u[:, None]), of_u + 7.0, atol=1e-12
    )


@cases(
    ("structure", "theta", "columns"),
    [
        (TWO, [*A, 0.5, 2.0, 0.3, 0.7, -0.2], 2),
        (Structure(2, 0, (1, 0), direct=True), [*A, 0.5, 2.0, 0.3, 4.0, 0.7, -0.2], 2),
        (Structure(2, 1, (0, 0)), [0.3, 0.5, 0.3, 0.7, -0.2], 2),
        (Structure(2, 0, (1,), at_rest=True), [*A, 0.5, 2.0, 7.0], 1),
        (Structure(1, 0, (0, 0), samples=(18, 12)), [0.2, 0.5, 0.3, 0.7, -0.2], 2),
    ],
)
def test_the_gradient_of_the_output_is_its_slope(structure: Any, theta: Any, columns: int) -> None:
    """By all parameters, as central differences; y is the output."""
    u, theta = binary(30), np.array(theta)
    v = inputs(u)[:, :columns]
    y, psi = output_gradient(structure, theta, v)
    np.testing.assert_allclose(y, output(structure, theta, v), atol=1e-12)
    assert psi.shape == (30, structure.size)
    for i in range(theta.size):
        step = 1e-5 * np.eye(theta.size)[i]
        slope = (output(structure, theta + step, v) - output(structure, theta - step, v)) / 2e-5
        np.testing.assert_allclose(psi[:, i], slope, atol=2e-7 * (1.0 + np.max(np.abs(slope))))
    linear = model.linear_columns(structure, structure.denominator(theta), v)
    np.testing.assert_allclose(linear, psi[:, structure.free :], atol=1e-10)


def test_a_structure_counts_its_parameters() -> None:
    """Free coefficients, numerators, feedthrough, a start of each record; powers of the unit of time."""
    one = Structure(3, 1, (1, 0), direct=True, samples=(5, 6))
    assert (one.free, one.common, one.of_start, one.size) == (2, 2 + 2 + 1 + 1, 3, 6 + 2 * 3)
    assert one.places == [2, 4]
    assert one.records(11) == [slice(0, 5), slice(5, 11)]
    assert one.single().samples == ()
    theta = np.arange(1.0, 13.0)
    assert one.denominator(theta).tolist() == [0.0, 1.0, 2.0]
    assert one.numerators(theta).tolist() == [[3.0, 4.0, 0.0], [5.0, 0.0, 0.0]]
    assert one.feedthrough(theta) == 6.0
    rest = Structure(2, 0, (1,), at_rest=True)
    assert (rest.of_start, rest.size, rest.level(np.arange(5.0))) == (1, 5, 4.0)
    assert rest.initial(np.arange(5.0)).tolist() == [0.0, 0.0]
    assert one.powers(2.0).tolist() == [4.0, 2.0, 8.0, 4.0, 8.0, 1.0, 4.0, 2.0, 1.0, 4.0, 2.0, 1.0]
    assert rest.powers(2.0).tolist() == [4.0, 2.0, 4.0, 2.0, 1.0]


# ---- friction


@cases(
    ("now", "free", "gain", "mean"),
    [
        (2.0, 2.0, 0.5, -1.0),  # it keeps its direction
        (-2.0, -2.0, 0.5, 1.0),
        (0.0, 0.2, 0.5, -0.4),  # it sticks: friction balances what would move it
        (0.0, -0.2, 0.5, 0.4),
        (0.0, 0.7, 0.5, -1.0),  # and breaks away
        (0.1, 0.2, 0.5, -0.4),  # it stops and sticks
        (1.0, -3.0, 0.5, 1.0 - 2.0 * 1.0 / 4.5 + 0.0),  # it turns round
        (0.3, 0.3, -0.5, -1.0),  # one that drives the motion
        (0.0, 0.3, 0.0, 0.0),
    ],
)
def test_friction_holds_turns_or_balances_a_speed(
    now: float, free: float, gain: float, mean: float
) -> None:
    """Minus the mean of the sign over a sample, of a speed that changes evenly."""
    found = model._mean_sign(now, free, gain)
    if mean == 1.0 - 2.0 * 1.0 / 4.5:
        # From 1 down by 4.5 under friction against it: the first 1/4.5 of the sample forwards.
        assert found == pytest.approx(-(1.0 / 4.5) + (1.0 - 1.0 / 4.5))
        return
    assert found == pytest.approx(mean)
    assert model._mean_sign(-now, -free, gain) == pytest.approx(-mean)


def test_a_mass_with_friction_stops_where_its_energy_is_spent() -> None:
    """Speed falls by c in each sample and then stays at zero; the sign is in the last input."""
    one = sampled(np.zeros((1, 1)), np.array([[0.0, 0.25]]))
    x, v = states_with_friction(one, np.zeros((8, 2)), np.ones((1, 1)), np.array([1.1]))
    np.testing.assert_allclose(x[:, 0], [1.1, 0.85, 0.6, 0.35, 0.1, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(v[:, 1], [-1.0, -1.0, -1.0, -1.0, -0.4, 0.0, 0.0, 0.0], atol=1e-12)


def test_the_measured_sign_is_that_of_the_slope_over_ten_samples() -> None:
    """Of each record by itself; of y itself in order 1."""
    t = np.arange(60.0)
    y = np.sin(0.1 * t)
    two = Structure(2, 0, (0, 0, 0))
    found = friction_search.measured_sign(two, y)
    expected = [-np.sign(y[min(k + 10, 59)] - y[max(k - 10, 0)]) for k in range(60)]
    assert found.tolist() == expected
    apart = friction_search.measured_sign(two._replace(samples=(30, 30)), np.r_[t[:30], -t[:30]])
    assert apart.tolist() == [-1.0] * 30 + [1.0] * 30
    assert friction_search.measured_sign(
        Structure(1, 0, (0, 0)), np.array([1.0, -2.0, 0.0])
    ).tolist() == [
        -1.0,
        1.0,
        0.0,
    ]


def test_the_resonance_of_a_model_is_its_least_damped_pair() -> None:
    """Its |p|; none for real poles, and none that is unstable."""
    a = np.polymul([1.0, 0.2, 4.0], [1.0, 2.0, 9.0])[:0:-1]
    assert friction_search._resonance(a) == pytest.approx(2.0)
    assert friction_search._resonance(np.polymul([1.0, 0.2], [1.0, 3.0])[:0:-1]) == 0.0
    assert friction_search._resonance(np.array([4.0, -0.2])) == 0.0


# ---- delays


def test_an_input_that_is_late_is_the_one_before_and_a_part_is_interpolated() -> None:
    """By 2 samples the u two before; by 2.25 a line is moved exactly, and a constant stays."""
    u = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    one = Structure(1, 0, (0,))
    found = delays.with_delay(one, u[:, None], u, 2.0)[:, 0]
    assert found.tolist() == [1.0, 1.0, 1.0, 2.0, 4.0, 8.0]
    k = np.arange(12.0)
    moved = delays.with_delay(one, k[:, None], k, 2.25)[:, 0]
    np.testing.assert_allclose(moved[5:], (k - 2.25)[5:])
    still = delays.with_delay(one, k[:, None], np.full(12, 3.0), 2.25)[:, 0]
    np.testing.assert_allclose(still, 3.0)
    both = delays.with_delay(one._replace(samples=(6, 6)), k[:, None], k, 2.0)[:, 0]
    assert both.tolist() == [0, 0, 0, 1, 2, 3, 6, 6, 6, 7, 8, 9]


def test_minima_of_the_error_over_delays_are_the_local_ones() -> None:
    """The least first; those much larger are left out; the range grows while the least is at its end."""
    costs = {0: 3.0, 1: 1.1, 2: 2.0, 3: 1.0, 4: 1.2, 5: 40.0}
    found = delays._minima(costs, 1)
    assert found[0] == 3
    assert set(found) <= {1, 3}
    assert delays._minima({0: 2.0, 2: 1.0, 4: 3.0}, 2) == [2]
    asked: list[range] = []

    def error(delays: range) -> dict[int, float]:
        asked.append(delays)
        return {each: abs(each - 33.0) + 1.0 for each in delays}

    high, stride, seen = delays._scanned(error, (0, 10), 200)
    assert (high, stride) == (80, 1)
    assert min(seen, key=lambda one: seen[one]) == 33
    assert [(each.start, each.stop) for each in asked] == [(0, 11), (11, 21), (21, 41), (41, 81)]
    assert delays._scanned(error, (0, 10), 10)[0] == 10
    assert delays.longest(LAG, np.zeros(1000), False) == 0
    assert delays.longest(LAG, np.zeros(1000), True) == int(delays.MOST_SHARE * 1000)


def test_the_part_of_a_record_in_which_u_moves_is_taken() -> None:
    """A record that is short is taken whole; else the part with the moves."""
    assert delays._moving_part(LAG, binary(100)) == slice(0, 100)
    u = np.zeros(20 * delays._SAMPLES)
    at = 9 * delays._SAMPLES
    u[at : at + delays._SAMPLES // 4] = binary(delays._SAMPLES // 4)
    part = delays._moving_part(LAG, u)
    assert part.stop - part.start == delays._SAMPLES
    assert part.start <= at
    assert at + delays._SAMPLES // 4 <= part.stop


def test_the_delay_near_a_model_is_found_step_by_step() -> None:
    """From 5 to 3 samples by halves of a stride; within the range."""
    u = binary(80)
    v = inputs(u)
    y = output(LAG, np.array([0.3, 0.6, 0.1, 0.0]), delays.with_delay(LAG, v, u, 3.0))
    start = refine(LAG, np.array([0.3, 0.6, 0.1, 0.0]), delays.with_delay(LAG, v, u, 5.0), y, 3)
    delay, found = delays.nearest_delay(LAG, start, u, v, y, (0, 8), 5, 2)
    assert delay == 3
    assert found.theta[:2].tolist() == pytest.approx([0.3, 0.6], rel=1e-6)
    assert delays.nearest_delay(LAG, start, u, v, y, (4, 8), 5, 2)[0] == 4


def test_a_part_of_a_sample_is_taken_where_the_record_shows_it() -> None:
    """Of 2.5 samples it is; of 2 with noise the whole one and its model stay."""
    u, theta = binary(70), np.array([0.3, 0.6, 0.1, 0.0])
    v = inputs(u)
    noise = 0.002 * np.random.default_rng(8).standard_normal(70)
    for true in (2.5, 2.0):
        y = output(LAG, theta, delays.with_delay(LAG, v, u, true)) + noise
        start = refine(LAG, theta, delays.with_delay(LAG, v, u, 2.0), y, 3)
        late, found = delays.with_part_of_sample(LAG, start, u, v, y, 2.0, (0.0, 4.0))
        if true == 2.0:
            assert late == 2.0
            assert found is start
        else:
            assert late == pytest.approx(2.5, abs=0.03)
            assert found.cost < 0.1 * start.cost


def test_a_delay_with_a_part_of_a_sample_has_a_deviation_like_any_parameter() -> None:
    """Its column is the slope of y by the delay; the interval is 1.96 deviations to both sides."""
    u, theta = binary(70), np.array([0.3, 0.6, 0.1, 0.0])
    v = delays.with_delay(LAG, inputs(u), u, 2.4)
    y = output(LAG, theta, v) + 0.01 * np.random.default_rng(8).standard_normal(70)
    estimate = refine(LAG, theta, v, y, 5)
    found, interval, of_delay = search._with_part(LAG, estimate, u, v, y, 2.4, 2)
    assert found.covariance.shape == (4, 4)
    np.testing.assert_array_equal(found.theta, estimate.theta)
    assert 0.5 * sum(interval) == pytest.approx(2.4)
    deviation = 0.5 * (interval[1] - interval[0]) / 1.959964
    assert of_delay.shape == (3,)
    assert of_delay[2] == pytest.approx(deviation**2, rel=1e-3)
    ends = [output(LAG, estimate.theta, delays.with_delay(LAG, v, u, at)) for at in (2.41, 2.39)]
    psi = np.column_stack([output_gradient(LAG, estimate.theta, v)[1], (ends[0] - ends[1]) / 0.02])
    plain = 1e-4 * np.linalg.inv(psi.T @ psi)
    assert deviation == pytest.approx(math.sqrt(plain[4, 4]), rel=0.6)
    # A delay that is not known makes the poles less certain.
    assert found.covariance[0, 0] > estimate.covariance[0, 0]


def test_a_delay_of_whole_samples_is_known_to_half_a_sample() -> None:
    """Where the neighbours fit far worse; with much noise the interval has them, too."""
    u, theta = binary(70), np.array([0.3, 0.6, 0.1, 0.0])
    v = delays.with_delay(LAG, inputs(u), u, 3.0)
    clean = output(LAG, theta, v)
    noise = np.random.default_rng(8).standard_normal(70)
    widths = []
    for size in (0.01, 1.5):
        y = clean + size * noise
        estimate = refine(LAG, theta, v, y, 8)
        found, interval, of_delay = search._over_delays(LAG, estimate, u, v, y, 3.0, (0.0, 8.0))
        assert interval[0] <= 2.5
        assert interval[1] >= 3.5
        assert of_delay[2] >= 1.0 / 12.0
        assert np.all(np.diag(found.covariance) >= np.diag(estimate.covariance) * (1.0 - 1e-6))
        widths.append(interval[1] - interval[0])
    assert widths[0] == 1.0
    assert widths[1] > 1.0
    given = search._over_delays(LAG, estimate, u, v, y, 3.0, (3.0, 3.0))
    assert given[0] is estimate
    assert given[1] == (3.0, 3.0)
    assert given[2].tolist() == [0.0, 0.0, 0.0]


def test_a_delay_under_friction_is_whole_where_its_part_is_hardly_one() -> None:
    """Of the least simulated error: 2 samples exactly, 2.4 nearly."""
    structure = Structure(1, 0, (0, 0, 0), friction=(0.0,))
    theta = np.array([0.3, 0.6, 0.1, 0.15, 0.0])
    u = 1.5 * binary(50)
    v = np.column_stack([inputs(u), np.zeros(50)])
    for true, at in ((2.0, 2.1), (2.4, 2.3)):
        late = delays.with_delay(structure, v, u, true)
        y = model.free_run(structure, theta, late, own_friction=True)[0]
        near = model.free_run(
            structure, theta, delays.with_delay(structure, v, u, at), own_friction=True
        )[1]
        found = friction_search.simulated_delay(structure, theta, u, near, y, (0.0, 4.0), at)
        assert found == (2 if true == 2.0 else pytest.approx(2.4, abs=0.02))


# ---- least squares and noise


def test_a_fit_in_one_step_has_the_linear_parameters_of_least_squares() -> None:
    """For given poles; from there Levenberg and Marquardt's steps find the poles, too."""
    rng = np.random.default_rng(3)
    u = binary(90)
    truth = np.array([0.3, 0.6, 0.1, 0.2])
    y = output(LAG, truth, inputs(u)) + 0.01 * rng.standard_normal(90)
    value, theta = output_error.projected(LAG, np.array([0.25, 9.0, 9.0, 9.0]), inputs(u), y)
    columns = model.linear_columns(LAG, np.array([0.25]), inputs(u))
    linear, left, *_ = np.linalg.lstsq(columns, y, rcond=None)
    np.testing.assert_allclose(theta, [0.25, *linear], rtol=1e-9)
    assert value == pytest.approx(float(left[0]) / 90)
    found = refine(LAG, np.array([0.15, 1.0, 0.0, 0.0]), inputs(u), y, 30)
    assert found.converged
    np.testing.assert_allclose(found.theta, truth, atol=0.03)
    assert found.cost == pytest.approx(
        float(np.mean((y - output(LAG, found.theta, inputs(u))) ** 2))
    )
    psi = output_gradient(LAG, found.theta, inputs(u))[1]
    assert np.max(np.abs(psi.T @ (y - output(LAG, found.theta, inputs(u))))) < 1e-4
    lost = output_error.projected(LAG, np.array([math.nan, 0, 0, 0]), inputs(u), y)
    assert lost[0] == math.inf


def test_deviations_for_white_noise_are_those_of_least_squares() -> None:
    """They are s² (ψᵀψ)⁻¹, or wider by blocks; for noise that is a moving mean they are wider."""
    rng = np.random.default_rng(5)
    psi = np.column_stack([np.ones(2400), np.sin(0.01 * np.arange(2400))])
    white = rng.standard_normal(2400)
    structure = Structure(1, 0, (0,), at_rest=True)._replace(degrees=())
    P = covariance_of(structure, psi, white)
    plain = np.linalg.inv(psi.T @ psi)
    np.testing.assert_allclose(np.sqrt(np.diag(P)), np.sqrt(np.diag(plain)), rtol=0.35)
    assert np.all(np.diag(P) > 0.8 * np.diag(plain))
    slow = signal.lfilter([1.0], [1.0, -0.9], white)
    wide = covariance_of(structure, psi, slow)
    # The power of the noise at low frequencies is 1/(1 − 0.9)² = 100.
    np.testing.assert_allclose(np.sqrt(wide[0, 0] / plain[0, 0]), 10.0, rtol=0.35)


def test_the_model_of_the_noise_is_autoregressive() -> None:
    """Of x_k = 0.7 x_(k−1) + w: C = (1, −0.7), and the variance of w; white noise has none."""
    rng = np.random.default_rng(2)
    w = 0.5 * rng.standard_normal(4000)
    c, variance = noise_model(signal.lfilter([1.0], [1.0, -0.7], w))
    assert c[1] == pytest.approx(-0.7, abs=0.04)
    assert variance == pytest.approx(0.25, rel=0.06)
    c, variance = noise_model(w)
    assert c.tolist() == [1.0]
    assert variance == pytest.approx(float(np.mean(w**2)))
    assert noise_model(np.zeros(400)) == (pytest.approx(np.ones(1)), 0.0)
    two = signal.lfilter([1.0], [1.0, -1.2, 0.8], w)
    c, variance = noise_model(two)
    np.testing.assert_allclose(c[:3], [1.0, -1.2, 0.8], atol=0.06)


def test_a_likelihood_ratio_counts_the_logarithm_of_the_error() -> None:
    """It is N log(Σ e_1²/Σ e_2²): of four times the power in 100 samples 100 log 4."""
    e = np.random.default_rng(0).standard_normal(100)
    found = output_error.likelihood_ratio((2.0 * e, e), 0.0)
    assert found == pytest.approx(100.0 * math.log(4.0), rel=1e-9)
    assert output_error.likelihood_ratio((e, e), 0.0) == pytest.approx(0.0)
    assert abs(output_error.likelihood_ratio((1e-9 * e, 1e-12 * e), 1.0)) < 1e-6


def test_correlations_are_those_of_numpy() -> None:
    """Over lags to both sides, divided by the number of samples."""
    rng = np.random.default_rng(7)
    a, b = rng.standard_normal(50), rng.standard_normal(50)
    found = correlation(a, b, 4)
    whole = np.correlate(a, b, "full") / 50
    middle = 49
    assert found.size == 9
    either = whole[middle - 4 : middle + 5]
    assert np.allclose(found, either) or np.allclose(found, either[::-1])
    assert found[4] == pytest.approx(float(np.mean(a * b)))


# ---- starts


def test_unstable_poles_of_a_start_are_mirrored() -> None:
    """Those in the right half plane; a stable start stays as it is."""
    theta = np.array([*np.polymul([1.0, -0.5], [1.0, 0.2])[:0:-1], 1.0, 2.0, 3.0, 4.0, 5.0])
    found = starts.stable(TWO, theta)
    np.testing.assert_allclose(sorted(np.roots([1.0, *found[1::-1]]).real), [-0.5, -0.2])
    np.testing.assert_array_equal(found[2:], theta[2:])
    good = np.array([*A, 1.0, 2.0, 3.0, 4.0, 5.0])
    assert starts.stable(TWO, good) is good


def test_filtered_least_squares_is_exact_without_noise_and_refined_with_it() -> None:
    """Coefficients of a held u to some percent; refined instruments are nearer than least squares."""
    u = binary(240)
    truth = np.array([*A, 0.5, 2.0, 0.1, 0.0, 0.0])
    y = output(TWO, truth, inputs(u))
    best = starts.filtered_estimates(TWO, inputs(u), y)[0]
    np.testing.assert_allclose(best[:4], truth[:4], rtol=0.15)
    seen = y + 0.3 * np.random.default_rng(1).standard_normal(240)
    first = starts.filtered_estimates(TWO, inputs(u), seen)[0]
    cost, theta = starts.refined(TWO, first, inputs(u), seen)
    assert cost <= model.cost(TWO, first, inputs(u), seen)
    assert cost == pytest.approx(model.cost(TWO, theta, inputs(u), seen))
    np.testing.assert_allclose(theta[:2], A, rtol=0.15)


def test_a_smaller_structure_has_a_pole_and_a_zero_less() -> None:
    """Extended again by a fast pole it has nearly the same output; with a zero exactly."""
    one = starts.smaller(TWO)
    assert one is not None
    assert (one.order, one.degrees) == (1, (0, 0))
    assert starts.smaller(one) is None
    assert starts.smaller(Structure(2, 2, (0, 0))) is None
    u = binary(60)
    theta = np.array([0.2, 0.5, 0.1, 0.3])
    y = output(one, theta, inputs(u))
    more = [*starts.extended(TWO, one, theta)]
    assert len(more) == 3
    for each in more[:2]:
        assert np.max(np.abs(output(TWO, each, inputs(u)) - y)) < 0.02 * np.max(np.abs(y))
    # The third pole, at the mean of those that there are, has a zero on it but for the force.
    np.testing.assert_allclose(more[2][:2], [0.04, 0.4])
    np.testing.assert_allclose(more[2][2:4], [0.1, 0.5])
    np.testing.assert_allclose(starts._times(np.array([2.0, 3.0]), 5.0), [10.0, 17.0, 3.0])


def test_the_poles_of_an_impulse_response_are_found() -> None:
    """Of two exponentials; in continuous time by their logarithm, stable and within range."""
    g = 0.9 ** np.arange(1.0, 41.0) + 2.0 * 0.5 ** np.arange(1.0, 41.0)
    np.testing.assert_allclose(sorted(starts._poles(g, 2).real), [0.5, 0.9], rtol=1e-8)
    assert starts._poles(np.full(40, np.nan), 2).size == 0
    assert starts._poles(g[:3], 2).size == 0
    p = continuous(np.array([0.9 + 0j, 1.1 + 0j, -0.5 + 0j, 0.5j]), 2)
    assert p[0] == pytest.approx(math.log(0.9) / 2)
    assert p[1] == pytest.approx(-math.log(1.1) / 2)
    assert p[2] == pytest.approx(-math.pi / 2)
    assert p[3] == pytest.approx((math.log(0.5) + 0.5j * math.pi) / 2)
    theta = starts._with_poles(
        Structure(2, 1, (0, 0)), np.array([-0.3 + 0j, -1e-6 + 0j, -5.0 + 0j])
    )
    assert theta.tolist() == pytest.approx([0.3, 0.0, 0.0, 0.0, 0.0])
    u = binary(300)
    y = output(LAG, np.array([0.3, 0.6, 0.0, 0.0]), inputs(u))
    found = next(starts.reduced_models(LAG, inputs(u), y))
    assert found[0] == pytest.approx(0.3, rel=1e-3)


def test_laguerre_functions_have_their_transfer_function() -> None:
    """√(2 λ) (p − λ)^(k−1)/(p + λ)^k of a slow sinusoid at the end of it."""
    rate, omega = 0.3, 0.02
    t = np.arange(2400.0)
    found = starts._laguerre(rate, np.sin(omega * t))
    s = 1j * omega
    for k in (1, 2, 5):
        H = math.sqrt(2.0 * rate) * (s - rate) ** (k - 1) / (s + rate) ** k
        expected = np.abs(H) * np.sin(omega * t + np.angle(H))
        np.testing.assert_allclose(found[-300:, k - 1], expected[-300:], atol=2e-3 * abs(H))


def test_a_start_at_rest_is_likely_where_the_record_begins_so() -> None:
    """A step from rest and one from a moving start; a model at rest has a force and a start, too."""
    u = np.r_[np.zeros(4), np.ones(56)]
    rest = Structure(1, 0, (0,), at_rest=True)
    v = starts.from_rest(rest, u)[:, None]
    noise = 1e-3 * np.random.default_rng(4).standard_normal(60)
    truth = np.array([0.1, 0.2, 3.0])
    y = output(rest, truth, v) + noise
    estimate = refine(rest, truth, v, y, 5)
    assert starts.probability(rest, estimate, v, y, 0.0) > 0.5
    moving = y + 0.5 * np.exp(-0.1 * np.arange(60.0))
    other = refine(rest, truth, v, moving, 5)
    assert starts.probability(rest, other, v, moving, 0.0) < 0.01
    structure, same = starts.general(rest, estimate, u)
    wide = inputs(u)
    np.testing.assert_allclose(
        output(structure, same.theta, wide), output(rest, estimate.theta, v), atol=1e-9
    )
    two = Structure(1, 0, (0,), at_rest=True, samples=(30, 30))
    shifted = starts.from_rest(two, np.r_[np.full(30, 2.0), np.full(30, 5.0)])
    assert shifted.tolist() == [0.0] * 60


# ---- tests of the error


def fitted(u: np.ndarray, y: np.ndarray, order: int = 1, delay: float = 0.0) -> Any:
    """Return a fit, linearised."""
    wanted = Wanted(order=order, zeros=0, integrators=0, delays=(delay, delay), grows=False,
                    bias=True, friction=False, rest=False, resolution=0.0, known=None, report=lambda: None)  # fmt: skip
    found = search.fit(u, y, (), wanted)
    return validation.Linearised.of(found, u, y)


def test_white_noise_passes_the_tests_of_the_error_and_a_missing_pole_does_not() -> None:
    """Whiteness and independence at 99 %: statistics by hand; a moving mean fails the first."""
    rng = np.random.default_rng(9)
    e, u = rng.standard_normal(400), binary(400)
    found = validation.residuals(e, u, 20)
    assert found.white
    assert found.independent
    assert found.rms == pytest.approx(float(np.sqrt(np.mean(e**2))))
    centred = e - e.mean()
    r = np.array([centred[k:] @ centred[: 400 - k] for k in range(21)]) / (centred @ centred)
    np.testing.assert_allclose(found.autocorrelation, r, atol=1e-12)
    assert found.whiteness == pytest.approx(400.0 * float(np.sum(r[1:] ** 2)))
    assert found.whiteness_limit == pytest.approx(float(stats.chi2.ppf(0.99, 20)))
    assert not validation.residuals(e + np.r_[0.0, e[:-1]], u, 20).white
    late = validation.residuals(e + 0.5 * np.r_[0.0, 0.0, u[:-2]], u, 20)
    assert not late.independent
    assert validation.nrmse(u, u) == 100.0
    assert validation.nrmse(u, np.full(400, u.mean())) == pytest.approx(0.0)
    assert validation.nrmse(u, -u) < 0.0


def test_a_prediction_of_the_error_uses_its_past() -> None:
    """Of an error that falls by a factor in each sample the fit is perfect, two samples ahead."""
    e = 0.9 ** np.arange(60.0)
    weights = validation.fit_predictor(e, 2, 1)
    assert weights.tolist() == pytest.approx([0.81])
    y = np.sin(np.arange(60.0))
    assert validation.prediction_fit(y, e, 2, weights) == pytest.approx(100.0)
    past, ahead = validation._error_history(np.arange(10.0), 2, 2)
    assert ahead.tolist() == [4.0, 5.0, 6.0, 7.0, 8.0, 9.0]
    assert past.tolist() == [[k - 2.0, k - 4.0] for k in range(4, 10)]


TRUTH = np.array([0.5, 1.0, 0.0, 0.0])


def record() -> tuple[np.ndarray, np.ndarray]:
    """Return a u of many sizes, and noise."""
    u = binary(150) * (1.0 + 0.5 * np.sin(0.2 * np.arange(150)))
    return u, 0.01 * np.random.default_rng(6).standard_normal(150)


def test_a_plain_record_passes_all_tests_of_its_error() -> None:
    """It is not early, has no other u before, and no gain that depends on u."""
    u, noise = record()
    plain = fitted(u, output(LAG, TRUTH, inputs(u)) + noise)
    assert validation.early_samples(plain) == 0
    assert not validation.before_the_record(plain)
    assert validation.curvature(plain) == 0.0
    test = validation.one_more_pole(plain)
    assert test.statistic < test.limit


def test_a_y_that_is_stored_a_sample_too_early_is_found() -> None:
    """By one sample, with the sign of the plant."""
    u, noise = record()
    y = output(LAG, TRUTH, inputs(u)) + noise
    assert validation.early_samples(fitted(u[:-1], y[1:])) == 1


def test_a_gain_that_depends_on_u_is_found() -> None:
    """The response to u + 0.4 u² explains nearly all of the error of a linear model."""
    u, noise = record()
    y = output(LAG, TRUTH, inputs(u + 0.4 * u**2)) + noise
    assert validation.curvature(fitted(u, y)) > 0.9


def test_another_u_before_the_record_is_found_in_its_delay() -> None:
    """In the first four samples of a delay of four."""
    u, noise = record()
    before = delays.with_delay(LAG, inputs(u), u, 4.0)
    before[:4, 0] = -3.0 * u[0]
    late = fitted(u, output(LAG, TRUTH, before) + noise, delay=4.0)
    assert validation.before_the_record(late)
    assert validation.early_samples(late) == 0


def test_a_missing_pole_is_seen_by_the_test_for_one_more() -> None:
    """A lag for two lags: the misfit of G is some ten percent."""
    u = binary(160)
    num, den, _ = signal.cont2discrete(([0.5], np.polymul([1.0, 0.2], [1.0, 1.0])), 1.0)
    y = signal.lfilter(np.ravel(num), den, u) + 0.003 * np.random.default_rng(1).standard_normal(
        160
    )
    test = validation.one_more_pole(fitted(u, y))
    assert test.statistic > 3.0 * test.limit
    assert 0.05 < test.misfit < 3.0
    assert 2.0 * math.pi / 160 <= test.omega <= math.pi
    assert test.limit == pytest.approx(float(stats.chi2.isf(1e-3, validation._EXTRA_POLES)))


def test_the_covariance_of_gains_for_a_given_lag_is_that_without_it() -> None:
    """Schur's complement of the whole, whatever the units."""
    from quell.identification.running_loop import Form, LoopFit

    form = Form(1, True, True, False, actuators=2)
    rng = np.random.default_rng(3)
    root = rng.standard_normal((8, 8)) * np.array([1, 5, 0.1, 2, 1, 1, 1, 1.0])[:, None]
    P = root @ root.T
    size = form.size + form.known + form.states
    P = P[:size, :size]
    one = LoopFit(form, np.ones(3), np.ones(size - 3), P, np.ones(5), 0.0, True)
    times, b = [1, 2], [3, 4]
    expected = P[np.ix_(b, b)] - P[np.ix_(b, times)] @ np.linalg.solve(
        P[np.ix_(times, times)], P[np.ix_(times, b)]
    )
    np.testing.assert_allclose(_of_u(one), expected, rtol=1e-6)


def test_known_poles_are_where_a_search_begins() -> None:
    """From two given poles the search for one pole ends at the plant's."""
    u = binary(120)
    y = output(LAG, np.array([0.3, 0.6, 0.0, 0.0]), inputs(u))
    found = ql.identify(u, y, 1.0, 1, delay=0.0, held_out=0.0)
    known = Known(np.array([0.3 * 4.0, 4.3]), (0, 0))
    wanted = Wanted(order=1, zeros=0, integrators=0, delays=(0, 0), grows=False, bias=True,
                    friction=False, rest=False, resolution=0.0, known=known, report=lambda: None)  # fmt: skip
    again = search.fit(u, y, (), wanted)
    assert again.estimate.theta[0] == pytest.approx(found.den[1], rel=1e-5)
