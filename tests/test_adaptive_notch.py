"""The adaptive notch: a Kalman filter with oscillators whose frequencies are found and followed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse
from quell.controllers.baselines import LQG, AdaptiveNotch
from quell.controllers.baselines.state_feedback import SampledModel, stationary_gain
from quell.tuning import Constraints, LoadSpectrum

DT = 0.01
AXIS = ([100.0], [1.0, 2.0, 0.0])
LOADED = ql.plants.LinearPlant(
    [[0.0, 1.0], [0.0, -2.0]], [[0.0], [100.0]], [[1.0, 0.0]], [[0.0], [100.0]]
)


def notch(**options: Any) -> AdaptiveNotch:
    """Return one for the axis."""
    return AdaptiveNotch(LOADED, 8.0, 15.0, DT, **{"band": (0.5, 10.0)} | options)


def run_of(controller: Any, load: Any, duration: float, **options: Any) -> Any:
    """Return a run under a load, a function of time."""
    t = DT * np.arange(round(duration / DT) + 1)
    load = ql.signals.Samples(t, load(t))
    noise = ql.signals.BandLimitedNoise(power=1e-12 * DT, sample_time=DT)
    scenario = ql.Scenario(disturbances=(load,), noise=noise, duration=duration)
    return ql.simulate(LOADED, controller, scenario, **options)


def test_its_law_is_an_internal_model_of_its_frequencies() -> None:
    """G_yd vanishes there; without oscillators it is LQG."""
    loop = analyse(AXIS, notch(count=2, frequencies=(2.0, 5.3)))
    at = np.array([2.0, 5.3])
    assert loop.stable
    assert np.all(np.abs(loop.response("PS", at)) < 1e-9 * np.abs(loop.response("PS", 1.1 * at)))
    omega = np.geomspace(0.1, 100.0, 20)
    plain = analyse(AXIS, LQG(LOADED, 8.0, 15.0, DT)).response("C_y", omega)
    np.testing.assert_allclose(analyse(AXIS, notch()).response("C_y", omega), plain, rtol=1e-6)


def test_the_filter_in_the_loop_has_the_gain_of_the_riccati_equation() -> None:
    """Sample by sample its covariance goes to the solution that SciPy has, with a frequency that stands."""
    controller = notch(frequencies=(3.0,), bandwidth=2.0)
    for _ in range(1200):
        controller.step(r=0.0, y=0.0)
    state, design = controller._state, controller.parameters
    at = state.P @ np.append(design.output, [0.0, 0.0, 0.0])
    gain = at / (at[0] + design.measured_noise)
    c, s = np.cos(3.0 * DT), np.sin(3.0 * DT)
    F = np.eye(5)
    F[:3, :3] = controller.base.model.F
    F[:2, 3], F[3:, 3:] = design.input, [[c, s], [-s, c]]
    W = np.diag([0.0, 0.0, design.bias_noise, *[design.pair_noise / 9.0] * 2])
    steady = stationary_gain(SampledModel(F, np.zeros(5), np.eye(5)[0]), W, design.measured_noise)
    np.testing.assert_allclose(gain, steady, rtol=1e-5)
    assert state.omega[0] == 3.0


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        ({"band": (0.0, 1.0)}, "band = .*above 0"), ({"band": (2.0, 400.0)}, "below pi/dt"), ({"count": 5}, "count = 5"),
        ({"count": 0}, "take LQG"), ({"frequencies": (1.0, 2.0)}, "more than count"), ({"bandwidth": 0.0}, "bandwidth = 0.0"),
    ],
)  # fmt: skip
def test_what_it_cannot_be_is_refused(options: dict[str, Any], rule: str) -> None:
    """The message names the argument and the rule."""
    with pytest.raises(ValueError, match=rule):
        notch(**options)


@pytest.mark.trial
def test_it_finds_and_follows_sinusoids_down_to_the_noise() -> None:
    """Two of unknown frequency; what is left is what the noise of y makes, and the frequencies are those of the load."""
    run = run_of(
        notch(count=2, bandwidth=0.3, listening=20.0),
        lambda t: np.sin(2.0 * t) + 0.7 * np.sin(5.3 * t),
        200.0,
    )
    np.testing.assert_allclose(np.sort(run["omega"][-1]), [2.0, 5.3], atol=1e-5)
    quiet = run_of(notch(count=2, bandwidth=0.3, listening=20.0), lambda t: 0.0 * t, 200.0)
    late = [np.sqrt(np.mean(each["y"][-2000:] ** 2)) for each in (run, quiet)]
    assert late[0] < 3.0 * late[1]


@pytest.mark.trial
def test_it_follows_a_frequency_that_drifts() -> None:
    """One per cent in a minute leaves a share of what a frequency that stands would leave."""
    left = [
        run_of(
            notch(bandwidth=b, listening=20.0),
            lambda t: np.sin(3.0 * t * (1.0 + 0.005 * t / 60.0)),
            120.0,
        )
        for b in (0.3, 1.0)
    ]
    sizes = [np.sqrt(np.mean(run["y"][-2000:] ** 2)) for run in left]
    without = run_of(LQG(LOADED, 8.0, 15.0, DT), lambda t: np.sin(3.0 * t), 120.0)
    assert sizes[1] < sizes[0] < 0.1 * np.sqrt(np.mean(without["y"][-2000:] ** 2))


@pytest.mark.trial
def test_waves_over_the_position_are_learned_in_motion() -> None:
    """Cogging of a known pitch is rejected, and a steady motion does not matter."""

    def rate(t: float, x: Any, u: float, w: Any) -> tuple[float, float]:
        return x[1], -2.0 * x[1] + 100.0 * (u + w[0] + 0.3 * np.sin(20.0 * x[0]))

    plant = ql.plants.NonlinearPlant(rate, order=2, disturbances=1)
    scenario = ql.Scenario(
        reference=ql.signals.Sinusoid(omega=0.5), disturbances=(0.0,), duration=50.0
    )
    plain = LQG(LOADED, 30.0, 100.0, 2e-3)
    waving = AdaptiveNotch(LOADED, 30.0, 100.0, 2e-3, count=0, waves=(20.0,), bandwidth=1.0)
    alone, *runs = (
        ql.simulate(*loop, scenario)["y"][-10_000:]
        for loop in ((LOADED, plain), (plant, plain), (plant, waving))
    )
    errors = [np.sqrt(np.mean((y - alone) ** 2)) for y in runs]
    assert errors[1] < 0.05 * errors[0]


@pytest.mark.trial
def test_tune_finds_its_bandwidths_within_the_bounds() -> None:
    """At frequencies that are given, and in the middle of a spectrum."""
    bounds = Constraints(m_s=2.0, m_t=None, m_ks=100.0, damping=None)
    for how in ({"frequencies": (3.0,)}, {"objective": LoadSpectrum.band(2.0, 4.0)}):
        tuned = ql.tune(
            AXIS, 2e-3, structure="adaptive-notch", compare=(), constraints=bounds, **how
        )
        assert isinstance(tuned.controller, AdaptiveNotch)
        assert 1.0 / tuned.analysis.margins.modulus <= 2.002
        assert tuned.analysis.noise_to_control_peak <= 100.1
    with pytest.raises(ValueError, match="give frequencies"):
        ql.tune(AXIS, 2e-3, structure="adaptive-notch", compare=(), constraints=bounds)
