"""Sinusoids of unknown frequency."""

from __future__ import annotations

import math

import numpy as np
import pytest

import quell as ql
from quell.controllers.stateful import named_arrays
from quell.learners.oscillators import (
    Oscillators,
    add_row,
    begin_pass,
    line_fit,
    next_row,
    retune,
    solve,
    turn_phases,
    write_deviations,
)

from .cases import cases

pytestmark = pytest.mark.compiled


def test_a_turning_pair_retunes_its_oscillator_by_how_much_it_turns() -> None:
    """In the closed form: with nothing unexplained, ω̂ grows by κ ω̂ times the angle; with much unexplained, by little."""
    oscillators = Oscillators(1, np.array([2.0]), 0.1, 10.0, np.ones(1))
    theta, angle = np.array([0.3, 3.0, 4.0]), 1e-3
    change = np.array([0.0, -theta[2], theta[1]])
    omega = oscillators.omega.copy()
    retune(oscillators, omega, 0, theta, change, angle, 0.0)
    assert omega[0] == pytest.approx(2.0 * (1.0 + 0.4 * angle), rel=1e-9)
    omega = oscillators.omega.copy()
    retune(oscillators, omega, 0, theta, change, angle, 25.0 / 60.0)
    assert omega[0] == pytest.approx(2.0 * (1.0 + 0.2 * angle), rel=1e-9)
    retune(oscillators, omega, 0, theta, change, 1e6, 0.0)
    assert omega[0] == 10.0
    retune(oscillators, omega, 0, 0.0 * theta, change, angle, 0.0)
    assert omega[0] == 10.0
    retune(oscillators, omega, 0, theta, change, -1e6, 0.0)
    assert omega[0] == 0.1


def test_pairs_of_several_orders_retune_their_oscillator_together() -> None:
    """A pair of order k turns by k times the angle; the least squares of both give the angle."""
    oscillators = Oscillators(0, np.array([2.0]), 0.1, 10.0, np.array([1.0, 3.0]))
    theta, angle = np.array([3.0, 4.0, -1.0, 2.0]), 1e-3
    change = np.array([-theta[1], theta[0], -3.0 * theta[3], 3.0 * theta[2]])
    omega = oscillators.omega.copy()
    retune(oscillators, omega, 0, theta, change, angle, 0.0)
    assert omega[0] == pytest.approx(2.0 * (1.0 + 0.4 * angle), rel=1e-9)


def test_phases_turn_at_their_frequency() -> None:
    """And stay within a turn."""
    phase, omega = np.array([0.0, 1.0]), np.array([2.0, 0.5])
    for _ in range(10_000):
        turn_phases(phase, omega, 1e-2)
    np.testing.assert_allclose(np.exp(1j * phase), np.exp(1j * np.array([200.0, 51.0])), atol=1e-9)
    assert np.all((phase >= 0.0) & (phase < 2.0 * math.pi))


@pytest.mark.trial
@pytest.mark.parametrize("start", [0.2, 2.5])
@pytest.mark.parametrize("truth", [0.4, 1.2])
def test_an_unknown_frequency_is_found_and_the_load_rejected(start: float, truth: float) -> None:
    """From far below or above, within a minute."""
    controller = ql.ADRC(
        ql.ESO.model_free(4, 1.0, 10.0, 5e-3),
        omega_c=1.0,
        learner=ql.learners.Harmonic(omegas=(start,)),
    )
    scenario = ql.Scenario(
        reference=ql.signals.Sinusoid().until(40.0, then=ql.signals.Step(at=40.0)),
        disturbances=(0.0, ql.signals.Sinusoid(omega=truth, start=60.0)),
        noise=ql.signals.BandLimitedNoise(1e-12, 0.01),
        duration=140.0,
    )
    run = ql.simulate(ql.plants.two_mass_spring(), controller, scenario, record_every=4)
    plain = ql.simulate(
        ql.plants.two_mass_spring(),
        ql.ADRC(controller.observer, omega_c=1.0),
        scenario,
        record_every=4,
    )
    assert run.final_state.learner.omega[0] == pytest.approx(truth, rel=0.01)
    late = run.window(130.0, 140.0)
    assert np.max(np.abs(run["y"][late] - 1.0)) < 0.02 * np.max(np.abs(plain["y"][late] - 1.0))


def bounded_run(noise: object) -> ql.Trajectory:
    """1e5 samples in a loop with a limited u: all of the learner's state is below 1e30."""
    controller = ql.ADRC(
        ql.ESO.model_free(4, 1.0, 10.0, 0.01),
        omega_c=1.0,
        learner=ql.learners.Harmonic(),
        u_min=-100.0,
        u_max=100.0,
    )
    scenario = ql.Scenario(0.5, duration=1000.0, noise=noise)
    run = ql.simulate(
        ql.plants.two_mass_spring(), controller, scenario, record_every=10, limit=1e30
    )
    assert not run.diverged
    for name, array in named_arrays(run.final_state.learner).items():
        assert np.all(np.abs(array) < 1e30), name
    return run


@pytest.mark.trial
def test_it_stays_bounded_without_excitation() -> None:
    """A constant reference for 1e5 samples: nothing winds up, drifts or leaves the numbers."""
    run = bounded_run(ql.signals.BandLimitedNoise(1e-12, 0.01))
    assert np.max(np.abs(run["y"][run.t >= 100.0] - 0.5)) < 1e-2
    for name, array in named_arrays(run.final_state.learner).items():
        assert np.all(np.abs(array) < 1e6), name


@pytest.mark.trial
def test_it_stays_bounded_whatever_it_is_shown(rng: np.random.Generator) -> None:
    """1e5 measurements with errors of very different size: state and output stay finite and repeatable."""
    size = np.repeat(10.0 ** rng.uniform(-6.0, 3.0, 100), 1000)
    size *= np.where(rng.random(size.size) < 1e-3, 1e3, 1.0)
    wild = ql.signals.Samples(0.01 * np.arange(size.size), size * rng.normal(size=size.size))
    first, again = bounded_run(wild), bounded_run(wild)
    np.testing.assert_array_equal(first.log, again.log)
    assert np.all(np.isfinite(first.log))
    assert np.max(np.abs(first["f_learned"])) > 1.0, "it said nothing: the test says nothing"


@pytest.mark.trial
def test_sinusoids_closer_than_a_line_width_are_separated_by_the_search() -> None:
    """A factor of 1.2, one minute of load, 0.57 of a beat period before it is judged: 1/50 of MF-ESO's error.

    As Python: to compile the search takes longer, and the contracts compare it compiled.
    """
    controller = ql.ADRC(
        ql.ESO.model_free(4, 1.0, 6.0, 0.0625),
        omega_c=1.0,
        learner=ql.learners.Harmonic(count=2, search=True),
    )
    load = ql.signals.Sinusoid(omega=0.5, start=10.0) + ql.signals.Sinusoid(omega=0.6, start=10.0)
    scenario = ql.Scenario(
        disturbances=(0.0, load), noise=ql.signals.BandLimitedNoise(1e-12, 0.0625), duration=100.0
    )
    run, without = (
        ql.simulate(ql.plants.two_mass_spring(), law, scenario, interpret=True)
        for law in (controller, ql.ADRC(controller.observer, omega_c=1.0))
    )
    np.testing.assert_allclose(np.sort(run.final_state.learner.omega), (0.5, 0.6), rtol=2e-3)
    late = run.window(73.0, 100.0)
    assert np.max(np.abs(run["y"][late])) < 0.02 * np.max(np.abs(without["y"][late]))


def test_a_fit_finds_frequencies_amplitudes_and_their_deviations() -> None:
    """Without noise exactly; with residuals of known variance, as the Cramér-Rao bound says for one sinusoid."""
    orders, size, truth = np.array([1.0, 3.0]), 60, (0.21, 0.25)
    times = -np.arange(size)
    z = 1.5 + sum(
        a * np.sin(k * w * times + p)
        for w, k, a, p in zip(
            np.repeat(truth, 2), (1, 3, 1, 3), (2.0, 0.5, 1.0, 0.7), range(4), strict=True
        )
    )
    fit = line_fit(2, 2, 0)
    fit.omega[:] = (0.2, 0.26)
    for _ in range(8):
        begin_pass(orders, fit, 2)
        for i in range(size):
            add_row(orders, fit, 2, -float(i), float(z[i]))
            next_row(fit, 8)
        total, left = solve(fit, 9, 11, 0.0)
        fit.amplitude[:] = fit.solution[1:9]
        fit.omega[:] += np.clip(fit.solution[9:], -0.03, 0.03)
    np.testing.assert_allclose(fit.omega, truth, rtol=1e-7)
    np.testing.assert_allclose(
        np.hypot(fit.amplitude[::2], fit.amplitude[1::2]), (2.0, 0.5, 1.0, 0.7), rtol=1e-5
    )
    assert fit.solution[0] == pytest.approx(1.5)
    assert left < 1e-9 * total
    one, many, amplitude = line_fit(1, 1, 0), 400, 3.0
    one.omega[0], one.amplitude[0] = 0.7, amplitude
    begin_pass(np.ones(1), one, 1)
    for i in range(many):
        add_row(np.ones(1), one, 1, -float(i), 0.0)
        next_row(one, 2)
    solve(one, 3, 4, 0.0)
    write_deviations(one, 3, 4, 0.04)
    assert one.deviation[0] == pytest.approx(
        math.sqrt(24.0 * 0.04 / amplitude**2 / many**3), rel=0.01
    )


def test_given_signals_are_fitted_with_a_ridge(rng: np.random.Generator) -> None:
    """The solution, and what the signals leave without and with sinusoids, are those of NumPy."""
    size, ridge, omega = 50, 0.3, 0.4
    times, signals = -np.arange(size), rng.normal(1.0, 2.0, (size, 2))
    z = signals @ [0.5, -1.0] + np.sin(omega * times) + rng.normal(0.0, 0.1, size)
    fit = line_fit(1, 1, 2)
    fit.omega[0] = omega
    begin_pass(np.ones(1), fit, 1)
    for i in range(size):
        fit.signal[:] = signals[i]
        add_row(np.ones(1), fit, 1, float(times[i]), float(z[i]))
        next_row(fit, 2)
    for _ in range(2):  # sums are kept, so another ridge can follow
        without, left = solve(fit, 5, 5, ridge)
    waves = np.column_stack([np.sin(omega * times), np.cos(omega * times)])
    penalty = np.diag(np.sqrt(ridge * size) * np.std(signals, axis=0))
    for columns, minimum in ((2, without), (4, left)):
        rows = np.column_stack([np.ones(size), signals, waves])[:, : 1 + columns]
        extra = np.pad(penalty, ((0, 0), (1, columns - 2)))
        matrix, right = np.vstack([rows, extra]), np.append(z, np.zeros(2))
        solution, squares, *_ = np.linalg.lstsq(matrix, right, rcond=None)
        assert minimum == pytest.approx(float(squares[0]))
    np.testing.assert_allclose(fit.solution[:5], solution, rtol=1e-9)


def test_frequencies_start_apart_and_stay_within_their_limits() -> None:
    """By default ω_c, 0.3 ω_c, …; names and θ fit."""
    observer = ql.ESO.model_free(2, 1.0, 20.0, 1e-2)
    learner = ql.learners.Harmonic(count=3, u=True)
    design = learner.design(observer, 2.0)
    np.testing.assert_allclose(design.oscillators.omega, [2.0, 0.6, 0.18])
    assert learner.feature_names(2) == (
        "x1",
        "x2",
        "bias",
        "sin1",
        "cos1",
        "sin2",
        "cos2",
        "sin3",
        "cos3",
        "u",
    )
    assert design.scale.size == 10
    assert (design.oscillators.low, design.oscillators.high) == (0.04, 10.0)


def test_behind_a_law_that_is_faster_than_the_observer_slow_loads_are_found() -> None:
    """Limits and first frequencies follow the observer then."""
    observer = ql.ESO.model_free(2, 1.0, 20.0, 1e-2)
    found = ql.learners.Harmonic(count=2).design(observer, 90.0).oscillators
    assert (found.low, found.high) == (0.4, 10.0)
    np.testing.assert_allclose(found.omega, [10.0, 6.0])


@cases(
    ("options", "message"),
    [
        ({"count": 0}, "count = 0"),
        ({"count": 2, "omegas": (1.0,)}, "omegas"),
        ({"omegas": (-1.0,)}, "omegas = -1.0"),
        ({"limits": (2.0, 1.0)}, "0 < low < high"),
        ({"limits": (0.0, 1.0)}, "0 < low < high"),
        ({"limits": (1.0, 1.0)}, "0 < low < high"),
        ({"orders": ()}, r"orders = \(\)"),
        ({"orders": 3}, "orders = 3"),
        ({"orders": (1, 0)}, r"orders\[1\] = 0"),
        ({"orders": (1, 3, 1)}, "must not repeat"),
        ({"count": 3, "orders": (1, 2, 3, 4, 5, 6)}, "16 sinusoids at most"),
        ({"search": 1}, "search = 1"),
        ({"pair_bandwidth": 0.0}, "pair_bandwidth = 0.0"),
        ({"bias_bandwidth": -1.0}, "bias_bandwidth"),
    ],
)
def test_mistakes_are_named(options: dict[str, object], message: str) -> None:
    """Argument, value, rule."""
    with pytest.raises(ValueError, match=message):
        ql.learners.Harmonic(**options)


def test_a_start_outside_of_the_limits_is_refused() -> None:
    """Not clipped without a word; at a limit it is taken."""
    at_limits = ql.learners.Harmonic(count=2, omegas=(2.0, 0.5), limits=(0.5, 2.0))
    observer = ql.ESO.model_free(2, 1.0, 20.0, 1e-2)
    assert at_limits.design(observer, 1.0).oscillators.omega.tolist() == [2.0, 0.5]
    with pytest.raises(ValueError, match=r"omegas = \(0.4,\) rad/s: must lie within limits"):
        ql.learners.Harmonic(omegas=(0.4,), limits=(0.5, 2.0)).design(observer, 1.0)
    with pytest.raises(ValueError, match=r"omegas = \(50.0,\) rad/s: must lie within limits"):
        ql.ADRC(
            ql.ESO.model_free(2, 1.0, 20.0, 1e-2), 1.0, learner=ql.learners.Harmonic(omegas=(50.0,))
        )
