"""Other forms of the observer, against independent forms, closed forms or limit cases."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import control
import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

import quell as ql
from quell.lti.models import zero_order_hold
from quell.observers.design import response
from quell.observers.eso import ESO, noise_gains
from quell.observers.forms import (
    acting_control,
    begin,
    expected_measurement,
    fal,
    observe,
    state_for,
)

from .cases import cases
from .python_step import interpreted

DT = 5e-3


def run_observer(
    observer: ESO, y: np.ndarray, u: np.ndarray, f_learned: np.ndarray | None = None
) -> np.ndarray:
    """Feed records through an observer; return what it hands out, (samples, N)."""
    z, seen = np.zeros(observer.states), np.zeros(observer.order + 1)
    begin(observer.model, z, seen, y[0])
    out = [seen.copy()]
    for k in range(1, y.size):
        observe(
            observer.model, z, seen, y[k], u[k - 1], 0.0 if f_learned is None else f_learned[k - 1]
        )
        out.append(seen.copy())
    return np.array(out)


def poles(observer: ESO) -> np.ndarray:
    """Return the eigenvalues of the observer's own update."""
    return np.linalg.eigvals(
        response(observer.model, observer.estimates, observer.order).transition
    )


def records(rng: np.random.Generator, samples: int = 800) -> tuple[np.ndarray, np.ndarray]:
    """Return a y and a u that wander."""
    return np.cumsum(rng.normal(size=samples)) * 1e-2, np.cumsum(rng.normal(size=samples)) * 1e-2


def test_a_model_that_is_sampled_again_is_as_it_was() -> None:
    """Whatever was done to the first result: matrix exponentials are kept."""
    for A, inputs in (([[-2.0]], [[[1.0]]]), ([[0.0, 1.0], [-4.0, -0.1]], [])):
        first, second = (
            zero_order_hold(np.array(A), [np.array(B) for B in inputs], 0.1) for _ in range(2)
        )
        for one, other in zip((first[0], *first[1]), (second[0], *second[1]), strict=True):
            one += 1.0
            np.testing.assert_array_equal(one, other + 1.0)
    phi, _ = zero_order_hold(np.array([[-2.0]]), [np.ones((1, 1))], 0.1)
    assert phi[0, 0] == pytest.approx(math.exp(-0.2), rel=1e-15)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_reduced_form_is_the_reduced_order_observer(
    order: int, rng: np.random.Generator
) -> None:
    """Luenberger's reduced-order observer: x̂_1 = y, and w = (x_2 … f) is estimated."""
    b0, omega_o = 2.0, 15.0
    y, u = records(rng)
    observer = ESO.model_free(order=order, b0=b0, omega_o=omega_o, dt=DT, form="reduced")
    ours = run_observer(observer, y, u)
    A, B = np.diag(np.ones(order), 1), np.zeros((order + 1, 1))
    B[order - 1] = b0
    phi, (gamma,) = zero_order_hold(A, [B], DT)
    K = control.acker(
        phi[1:, 1:].T, phi[:1, 1:].T, np.full(order, math.exp(-omega_o * DT))
    ).reshape(-1, 1)
    w = np.zeros((order, 1))
    for k in range(1, y.size):
        surprise = y[k] - phi[0, 0] * y[k - 1] - phi[:1, 1:] @ w - gamma[0] * u[k - 1]
        w = phi[1:, 1:] @ w + phi[1:, :1] * y[k - 1] + gamma[1:] * u[k - 1] + K * surprise
        assert ours[k, 0] == pytest.approx(y[k], abs=1e-14)
        np.testing.assert_allclose(ours[k, 1:], w[:, 0], rtol=1e-6, atol=1e-6 * omega_o**order)


def test_half_gain_is_half_of_the_bandwidth_design_and_less_noise() -> None:
    """Exactly L/2, and stable. Noise in f̂ falls by 30 % at order 1 and not from order 5 on."""
    noise = []
    for order in range(1, 9):
        full, half = (
            ESO.model_free(order=order, b0=1.0, omega_o=20.0, dt=DT, half_gain=half)
            for half in (False, True)
        )
        np.testing.assert_array_equal(half.model.gain, 0.5 * full.model.gain)
        assert np.max(np.abs(poles(half))) < 1.0
        noise.append(math.sqrt(noise_gains(half)[-1] / noise_gains(full)[-1]))
    np.testing.assert_allclose(noise[:3], [0.69, 0.74, 0.80], atol=0.01)
    assert np.all(np.diff(noise) > 0.0)
    assert noise[4] > 1.0


@cases("order", [1, 2, 5, 8])
@cases("dt", [1e-3, 1e-2])
def test_kalman_gains_for_a_drifting_f_put_the_poles_in_a_butterworth_pattern(
    order: int, dt: float
) -> None:
    """Symmetric root locus of integrators: omega_o is the radius ``(drift/(noise dt))^(1/2N)``."""
    radius, noise, size = 12.0, 1e-6, order + 1
    observer = ESO.kalman(
        order, 1.0, dt, noise_variance=noise, drift=noise * dt * radius ** (2 * size)
    )
    found = np.log(poles(observer).astype(complex)) / dt
    angles = np.pi + (np.arange(size) - (size - 1) / 2) * np.pi / size
    wanted = radius * np.exp(1j * angles)
    np.testing.assert_allclose(
        np.poly(found / radius).real, np.poly(wanted / radius).real, rtol=1e-3
    )
    assert observer.omega_o == pytest.approx(radius, rel=1e-4)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_kalman_gains_are_those_of_python_control(order: int) -> None:
    """``control.dlqe`` gives the predictor's gain, Φ L."""
    dt, noise, drift, jitter, size = 0.01, 1e-4, 3.0, 0.2, order + 1
    observer = ESO.kalman(order, 1.0, dt, noise_variance=noise, drift=drift, jitter=jitter)
    A = np.diag(np.ones(order), 1)
    # The sampled drive, by integration instead of an exponential of blocks.
    times = (np.arange(2000) + 0.5) * dt / 2000
    Q = np.zeros((size, size))
    for t in times:
        E = zero_order_hold(A, [], t)[0]
        Q += E @ np.diag([0.0] * (order - 1) + [jitter, drift]) @ E.T * dt / 2000
    gain, _, _ = control.dlqe(
        observer.model.transition, np.eye(size), np.eye(1, size), Q, np.array([[noise]])
    )
    np.testing.assert_allclose(
        observer.model.transition @ observer.model.gain, gain[:, 0], rtol=1e-5
    )


def test_no_gain_near_the_kalman_gain_estimates_f_with_less_variance() -> None:
    """The optimum is one: in each direction the error's variance grows."""
    dt, noise, drift = 0.01, 1e-4, 3.0
    observer = ESO.kalman(1, 1.0, dt, noise_variance=noise, drift=drift)
    phi, L = observer.model.transition, observer.model.gain
    Q = drift * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])

    def variance(gain: np.ndarray) -> float:
        keep = np.eye(2) - np.outer(gain, [1.0, 0.0])
        return float(
            solve_discrete_lyapunov(keep @ phi, keep @ Q @ keep.T + noise * np.outer(gain, gain))[
                1, 1
            ]
        )

    best = variance(L)
    for change in ([1.1, 1.0], [0.9, 1.0], [1.0, 1.1], [1.0, 0.9]):
        assert variance(L * change) > best


def test_a_cascade_of_one_level_is_the_plain_observer(rng: np.random.Generator) -> None:
    """The limit case, bit by bit."""
    y, u = records(rng)
    plain = run_observer(ESO.model_free(order=3, b0=2.0, omega_o=20.0, dt=DT), y, u)
    np.testing.assert_array_equal(
        run_observer(ESO.cascade(3, 2.0, 20.0, DT, levels=1), y, u), plain
    )


def test_the_levels_of_a_cascade_have_the_poles_they_were_given() -> None:
    """No level feeds back to one before it: (z − β_1)^N (z − β_2)^N (z − β_3)^N."""
    observer = ESO.cascade(1, 1.0, 40.0, DT, levels=3, ratio=2.0)
    wanted = np.repeat(np.exp(-np.array([10.0, 20.0, 40.0]) * DT), 2)
    np.testing.assert_allclose(
        np.poly(poles(observer) - 1.0), np.poly(wanted - 1.0), rtol=1e-6, atol=1e-12
    )


def test_a_cascade_follows_its_equations(rng: np.random.Generator) -> None:
    """Each level is fed the f of the levels before it, of the sample before, and follows their output."""
    observer = ESO.cascade(2, 2.0, 40.0, DT, levels=3, ratio=2.0)
    plain = [ESO.model_free(2, 2.0, omega, DT).model for omega in (10.0, 20.0, 40.0)]
    (y, u), f_learned = records(rng, 100), rng.normal(size=100)
    found = run_observer(observer, y, u, f_learned)
    levels = np.array([[y[0], 0.0, 0.0]] * 3)
    for k in range(1, 100):
        fed = f_learned[k - 1] + np.append(0.0, np.cumsum(levels[:-1, 2]))
        target = y[k]
        for level, model in enumerate(plain):
            z = model.transition @ levels[level] + model.input * u[k - 1] + model.feed * fed[level]
            levels[level] = z + model.gain * (target - z[0])
            target = levels[level][0]
        expected = [*levels[2][:2], np.sum(levels[:, 2])]
        np.testing.assert_allclose(found[k], expected, rtol=1e-9, atol=1e-9)


def test_a_cascade_finds_a_ramp_of_f_without_lag() -> None:
    """Each level adds a power: one level trails a ramp by N/omega_o, two do not."""
    observer, plain = ESO.cascade(1, 1.0, 20.0, DT), ESO.model_free(1, 1.0, 20.0, DT)
    t = DT * np.arange(1000)
    y, f = t**2 / 2, t  # y' = f
    assert run_observer(observer, y, 0 * t)[-1, -1] == pytest.approx(f[-1], abs=1.01 * DT)
    assert f[-1] - run_observer(plain, y, 0 * t)[-1, -1] == pytest.approx(2 / 20.0, rel=0.1)


PLANT = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [1.0, 0.0])
PLAIN = ESO.model_free(2, 1.5, 30.0, 2e-3)


@cache
def rejection_and_noise(observer: ESO) -> tuple[float, float]:
    """Return the largest y after a step of the load, and the standard deviation of u from noise."""

    def run(noise: Any) -> ql.Trajectory:
        scenario = ql.Scenario(
            disturbances=(5.0 * ql.signals.Step(at=2.0),), noise=noise, duration=5.0, seed=3
        )
        return ql.simulate(PLANT, ql.ADRC(observer, omega_c=3.0), scenario)

    quiet, noisy = run(0.0), run(ql.signals.BandLimitedNoise(1e-6 * observer.dt, observer.dt))
    return float(np.max(np.abs(quiet["y"]))), float(
        np.std((noisy["u"] - quiet["u"])[quiet.t > 1.0])
    )


@pytest.mark.trial
def test_a_cascade_rejects_the_same_load_with_half_the_noise_in_u() -> None:
    """The claim of Łakomy & Madonski: ratio 3 against the plain ESO of the same bandwidth."""
    cascade = ESO.cascade(2, 1.5, 30.0, 2e-3, ratio=3.0)
    peak, noise = rejection_and_noise(PLAIN)
    cascade_peak, cascade_noise = rejection_and_noise(cascade)
    assert cascade_peak < peak
    assert cascade_noise < 0.6 * noise


@pytest.mark.trial
def test_half_gain_in_observer_rejects_the_same_load_with_less_noise_in_u() -> None:
    """The claim of Herbst et al., measured: the load's effect within 2 %, noise three quarters."""
    half = ESO.model_free(2, 1.5, 30.0, 2e-3, half_gain=True)
    (peak, noise), (half_peak, half_noise) = rejection_and_noise(PLAIN), rejection_and_noise(half)
    assert half_peak == pytest.approx(peak, rel=0.02)
    assert half_noise < 0.78 * noise


def test_fal_is_odd_continuous_and_linear_near_zero() -> None:
    """And the power it stands for beyond."""
    assert fal(0.05, 0.5, 0.1) == pytest.approx(0.05 / math.sqrt(0.1))
    assert fal(0.1, 0.25, 0.1) == pytest.approx(fal(0.1 * (1 + 1e-12), 0.25, 0.1))
    assert fal(-4.0, 0.5, 0.1) == -2.0
    assert fal(-3.0, 1.0, 0.1) == -3.0


def test_the_nonlinear_observer_with_powers_of_one_is_the_linear_one(
    rng: np.random.Generator,
) -> None:
    """And with any powers, as long as its error stays within delta; beyond, it is another."""
    y, u = records(rng)
    linear = run_observer(ESO.model_free(2, 2.0, 20.0, DT), y, u)
    for delta, alpha in ((1e-9, np.ones(3)), (1e3, None)):
        np.testing.assert_allclose(
            run_observer(ESO.nonlinear(2, 2.0, 20.0, DT, delta=delta, alpha=alpha), y, u),
            linear,
            rtol=1e-9,
            atol=1e-9,
        )
    other = run_observer(ESO.nonlinear(2, 2.0, 20.0, DT, delta=1e-3), y, u)
    assert np.max(np.abs(other - linear)) > 1.0


def test_the_nonlinear_observer_starts_again_beyond_all_errors() -> None:
    """Beyond 2¹⁶ δ its powers would take for ever to return; those nearer to one reach further."""
    observer = ESO.nonlinear(2, 2.0, 20.0, DT, delta=0.25)
    z, seen = np.zeros(3), np.zeros(3)
    edge = 0.25 * 2.0**16
    for y in (-edge, 1.01 * edge, -4e11, 1.0):
        observe(observer.model, z, seen, y, 0.0, 0.0)
        began = abs(y) != edge
        assert (seen.tolist() == [y, 0.0, 0.0]) == began, y
        np.testing.assert_array_equal(z, seen)
    for alpha, reach in ((0.5, 2.0**24), (0.9, 2.0**40), (1.0, 2.0**40)):
        model = ESO.nonlinear(2, 2.0, 20.0, DT, delta=0.25, alpha=[alpha] * 3).model
        assert model.largest_error == 0.25 * reach


def test_the_nonlinear_observer_is_hans_for_short_samples() -> None:
    """Against his Euler form with ``β_i = L_i δ^(1−α_i)/dt``: the difference falls with dt."""
    alpha, delta, errors = (1.0, 0.5, 0.25), 0.02, []
    for dt in (1e-3, 1e-4):
        observer = ESO.nonlinear(2, 1.0, 20.0, dt, delta=delta, alpha=alpha)
        t = dt * np.arange(round(2.0 / dt))
        y, u = 0.5 * np.sin(3.0 * t), np.cos(t)
        beta = observer.model.gain / dt * delta ** (1.0 - np.array(alpha))
        z = np.array([y[0], 0.0, 0.0])
        for k in range(1, t.size):
            e = z[0] - y[k - 1]
            z = z + dt * np.array(
                [
                    z[1] - beta[0] * e,
                    z[2] + u[k - 1] - beta[1] * fal(e, alpha[1], delta),
                    -beta[2] * fal(e, alpha[2], delta),
                ]
            )
        errors.append(abs(run_observer(observer, y, u)[-1, 2] - z[2]) / np.abs(z[2]))
    assert errors[0] < 0.1
    assert errors[1] < 0.2 * errors[0]


def test_the_nonlinear_observer_answers_an_outlier_gently() -> None:
    """An outlier of a hundred times delta changes f̂ by an eighth of the linear one's change."""
    moved = []
    for observer in (ESO.model_free(2, 1.0, 20.0, DT), ESO.nonlinear(2, 1.0, 20.0, DT, delta=0.01)):
        y = np.zeros(50)
        y[10] = 1.0
        moved.append(np.max(np.abs(run_observer(observer, y, 0 * y)[:, -1])))
    assert moved[1] < 0.13 * moved[0]


@pytest.mark.parametrize("late", [1, 7])
def test_an_observer_behind_a_delay_is_the_plain_one_fed_the_u_of_then(
    late: int, rng: np.random.Generator
) -> None:
    """Sample by sample; and it says which u acts."""
    y, u = records(rng)
    shifted = np.concatenate([np.zeros(late), u[:-late]])
    options: dict[str, Any] = {"order": 2, "b0": 2.0, "omega_o": 20.0, "dt": DT}
    late_one = ESO.model_free(**options, delay=late * DT)
    np.testing.assert_array_equal(
        run_observer(late_one, y, u), run_observer(ESO.model_free(**options), y, shifted)
    )
    z, seen = np.full(late_one.states, 9.0), np.full(3, 9.0)
    begin(late_one.model, z, seen, 0.0)
    assert not np.any(z)
    assert not np.any(seen)
    for k in range(1, 30):
        # What reaches the plant in the sample that u[k - 1] is sent for.
        assert acting_control(late_one.model, z, u[k - 1]) == shifted[k - 1]
        observe(late_one.model, z, seen, y[k], u[k - 1], 0.0)


@pytest.mark.trial
@pytest.mark.filterwarnings(
    "ignore::quell.DesignWarning"
)  # a delay of that size is unwise, and said to be
def test_a_known_delay_saves_a_loop_that_swings_without() -> None:
    """With a delay of 0.2 s at omega_o = 20 rad/s only the observer that knows it settles."""
    plant = ql.plants.delayed(
        ql.plants.LinearPlant([[0.0, 1.0], [-1.0, -1.0]], [0.0, 1.0], [1.0, 0.0]),
        delay=0.2,
        dt=0.01,
    )
    scenario = ql.Scenario(
        reference=1.0, disturbances=(0.5 * ql.signals.Step(at=15.0),), duration=30.0
    )
    swing = []
    for delay in (0.0, 0.2):
        observer = ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01, delay=delay)
        controller = ql.ADRC(observer, omega_c=2.0, u_min=-50.0, u_max=50.0)
        run = ql.simulate(plant, controller, scenario, interpret=True)
        swing.append(np.ptp(run["y"][run.t > 25.0]))
    assert swing[0] > 1.0
    assert swing[1] < 1e-6


def test_a_delayed_plant_is_the_plant_with_the_u_of_then() -> None:
    """Its states are those of the plant, followed by the delayed values of u, newest first."""
    run = ql.simulate(
        ql.plants.delayed(PLANT, 0.03, 0.01),
        ql.ADRC(ESO.model_free(2, 1.5, 10.0, 0.01), 1.0),
        ql.Scenario(1.0, 2.0),
        interpret=True,
    )
    np.testing.assert_array_equal(
        run["x"][4:, 2:], np.column_stack([run["u"][3:-1], run["u"][2:-2], run["u"][1:-3]])
    )
    model = PLANT.sampled(0.01)
    for k in range(3, 100):
        np.testing.assert_allclose(
            run["x"][k + 1, :2],
            model.transition @ run["x"][k, :2] + model.input * run["u"][k - 3],
            rtol=1e-12,
        )


def test_a_learner_finds_the_gain_of_a_delayed_plant() -> None:
    """With b = 1.4 b0, θ_u comes out as 0.4 b0: the learner is told of the u that acts."""
    plant = ql.plants.delayed(ql.plants.LinearPlant([[-1.0]], [1.4], [1.0]), delay=0.05, dt=0.01)
    observer = ESO.model_free(order=1, b0=1.0, omega_o=20.0, dt=0.01, delay=0.05)
    controller = ql.ADRC(observer, omega_c=2.0, learner=ql.learners.Kalman(u=True))
    run = ql.simulate(
        plant,
        controller,
        ql.Scenario(ql.signals.Sinusoid(omega=1.0) + ql.signals.Sinusoid(omega=2.7), duration=20.0),
        interpret=True,
    )
    theta = dict(zip(controller.features, run["theta"][-1], strict=True))
    assert theta["u"] == pytest.approx(0.4, abs=0.04)
    assert theta["x1"] == pytest.approx(-1.0, abs=0.1)


FORMS = {
    "current": ESO.model_free(2, 1.5, 20.0, DT),
    "predictor": ESO.model_free(2, 1.5, 20.0, DT, form="predictor"),
    "reduced": ESO.model_free(2, 1.5, 20.0, DT, form="reduced"),
    "half gain": ESO.model_free(2, 1.5, 20.0, DT, half_gain=True),
    "half gain, predictor": ESO.model_free(2, 1.5, 20.0, DT, half_gain=True, form="predictor"),
    "Kalman": ESO.kalman(2, 1.5, DT, noise_variance=1e-6, drift=1.0, jitter=1e-3),
    "Kalman, predictor": ESO.kalman(2, 1.5, DT, noise_variance=1e-6, drift=1.0, form="predictor"),
    "cascade": ESO.cascade(2, 1.5, 20.0, DT),
    "cascade of three": ESO.cascade(2, 1.5, 30.0, DT, levels=3, ratio=1.5),
    "delay": ESO.model_free(2, 1.5, 20.0, DT, delay=4 * DT),
}


@cases("name", FORMS)
def test_noise_gains_are_what_noise_does(name: str, rng: np.random.Generator) -> None:
    """White noise in y of a hundred observers, for a thousand samples from their steady state on, to 10 % in variance."""
    observer = FORMS[name]
    found = response(observer.model, 3, 2)
    seen, state = [], np.zeros((observer.states, 100))
    for y in rng.normal(size=(1200, 100)):
        seen.append(found.output @ state + found.feedthrough[:, :1] * y)
        state = found.transition @ state + found.input[:, :1] * y
    variance = np.mean(np.square(seen[200:]), axis=(0, 2))
    np.testing.assert_allclose(variance, noise_gains(observer), rtol=0.1)


@cases("name", FORMS)
def test_an_observer_begins_at_y_whatever_its_state_was(name: str) -> None:
    """At rest: x̂_1 = y and all else zero, for any later sample as well while y and u = 0 stay."""
    observer = FORMS[name]
    z, seen = np.full(observer.states, 9.0), np.full(3, 9.0)
    begin(observer.model, z, seen, 2.0)
    assert seen.tolist() == [2.0, 0.0, 0.0]
    for _ in range(5):
        observe(observer.model, z, seen, 2.0, 0.0, 0.0)
        np.testing.assert_allclose(seen, [2.0, 0.0, 0.0], atol=1e-9)


@cases("name", FORMS)
def test_states_for_given_estimates_show_them(name: str) -> None:
    """After a sample with the expected y they are the estimates that the model moves."""
    observer = FORMS[name]
    x, f, u = np.array([0.3, -0.8]), 1.7, 0.6
    z, seen = state_for(observer.model, x, np.array([f]), u), np.zeros(3)
    assert z.shape == (observer.states,)
    y = 0.3 - 0.8 * DT + 0.5 * DT**2 * (1.5 * u + f)
    assert expected_measurement(observer.model, z, u, 0.0) == pytest.approx(y, rel=1e-12)
    observe(observer.model, z, seen, y, u, 0.0)
    assert seen == pytest.approx([y, -0.8 + DT * (1.5 * u + f), f], rel=1e-9)


def test_an_observer_says_what_it_is() -> None:
    """Its lag is that of one pole or of several, its order from 1 to 8."""
    one_pole = {name for name, observer in FORMS.items() if observer.has_one_pole}
    assert one_pole == {"current", "predictor", "delay"}
    assert repr(FORMS["cascade"]) == (
        "ESO(order=2, b0=1.5, omega_o=20, dt=0.005, form='current') [Cascade]"
    )
    assert not ESO.nonlinear(1, 1.0, 10.0, 0.01, delta=0.1).has_one_pole
    assert ESO.nonlinear(2, 1.0, 10.0, 0.01, delta=0.1).model.alpha.tolist() == [1.0, 0.5, 0.25]
    assert ESO.nonlinear(1, 1.0, 10.0, 0.01, delta=0.1).lag_time == pytest.approx(0.2)
    assert ESO.cascade(1, 1.0, 10.0, 0.01, levels=8, ratio=1.1).states == 16
    for order in (1, 8):
        kalman = ESO.kalman(order, 1.0, 0.01, noise_variance=1e-6, drift=1e-2)
        assert (kalman.order, kalman.degree, kalman.f_degree) == (order, order, order)
        based = ESO.model_based((np.ones(order), 1.0), 10.0, 0.01)
        assert (based.order, based.b0, based.cancel_f) == (order, 1.0, 1.0)
        assert based.cancel.tolist() == [1.0] * order
        assert based.pole == pytest.approx(math.exp(-0.1))


@cases("name", FORMS)
def test_the_response_of_an_observer_is_its_update_as_matrices(
    name: str, rng: np.random.Generator
) -> None:
    """Inputs are y, u and f_L, estimates x̂ and Δf̂, whatever the state."""
    observer = FORMS[name]
    found = response(observer.model, 3, 2)
    z, inputs, seen = rng.normal(size=observer.states), rng.normal(size=3), np.zeros(3)
    after = z.copy()
    observe(observer.model, after, seen, *inputs)
    for wanted, state, direct in (
        (after, found.transition, found.input),
        (seen, found.output, found.feedthrough),
    ):
        assert direct.shape == (wanted.size, 3)
        np.testing.assert_allclose(state @ z + direct @ inputs, wanted, rtol=1e-9, atol=1e-9)


SUMMED = {name: observer for name, observer in FORMS.items() if not observer.has_one_pole} | {
    "f before the last integrator": ESO.model_based(([1.5, 6.0], [1.0, 2.0, 3.0]), 20.0, DT)
}


@cases("name", SUMMED)
def test_noise_gains_are_those_of_the_lyapunov_equation(name: str) -> None:
    """``P = M P Mᵀ + g gᵀ`` and ``diag (C P Cᵀ + d dᵀ)``, where no formula is known."""
    observer = SUMMED[name]
    found = response(observer.model, 3, 2)
    g, d = found.input[:, :1], found.feedthrough[:, :1]
    P = solve_discrete_lyapunov(found.transition, g @ g.T)
    expected = np.diag(found.output @ P @ found.output.T + d @ d.T)
    np.testing.assert_allclose(noise_gains(observer), expected, rtol=1e-5)


def test_noise_gains_of_order_one_are_those_of_the_closed_form() -> None:
    """``∫ |2 w s + w²|²/|s + w|⁴ = 5 w/4`` and ``∫ |w² s|²/|s + w|⁴ = w³/4``, over ω/2π."""
    w, dt = 20.0, 1e-3
    found = noise_gains(ESO.model_free(1, 2.0, w, dt))
    np.testing.assert_allclose(found, [dt * 1.25 * w, dt * 0.25 * w**3], rtol=1e-3)


@pytest.mark.parametrize("learner", [ql.learners.Kalman(), ql.learners.NLMS(), ql.learners.MLP()])
def test_learners_that_must_tell_noise_from_motion_refuse_the_reduced_form(learner: Any) -> None:
    """Its x̂_1 is y itself; Algorithm 1, which looks at no noise, takes it."""
    with pytest.raises(ValueError, match="form = 'reduced'"):
        ql.ADRC(FORMS["reduced"], omega_c=2.0, learner=learner)
    ql.ADRC(FORMS["reduced"], omega_c=2.0, learner=ql.learners.BatchGradient(), guard=ql.Guard())


@pytest.mark.trial
@pytest.mark.parametrize("name", ["half gain", "half gain, predictor", "Kalman", "cascade"])
def test_a_guarded_learner_serves_other_forms(name: str) -> None:
    """The loop ends where it should, and the learner has found the spring."""
    controller = ql.ADRC(FORMS[name], omega_c=2.0, learner=ql.learners.Kalman(), guard=ql.Guard())
    run = ql.simulate(
        PLANT,
        controller,
        ql.Scenario(ql.signals.Sinusoid(omega=1.5).until(7.0, then=1.0), duration=12.0),
    )
    assert run["y"][-1] == pytest.approx(1.0, abs=1e-2)
    assert dict(zip(controller.features, run["theta"][-1], strict=True))["x1"] == pytest.approx(
        -2.0, abs=0.2
    )


def test_time_scales_are_those_of_the_poles() -> None:
    """N/omega_o if all are equal, n/omega_o for the reduced form, a sum over a cascade's levels."""
    assert FORMS["half gain"].lag_time == pytest.approx(3 / 20.0, rel=0.05)
    assert FORMS["reduced"].lag_time == pytest.approx(2 / 20.0, rel=0.05)
    assert FORMS["cascade"].lag_time == pytest.approx(3 / 20.0 + 3 / 10.0, rel=0.02)


@pytest.mark.trial
@pytest.mark.compiled
@cases("name", ["half gain", "cascade", "Kalman", "delay", "nonlinear"])
def test_a_hand_over_is_bumpless_in_every_form(name: str) -> None:
    """From somebody else's u at rest, with a load: u goes on from there, and y stays."""
    observer = ESO.nonlinear(2, 1.5, 20.0, DT, delta=0.05) if name == "nonlinear" else FORMS[name]
    controller = interpreted(ql.ADRC(observer, omega_c=2.0))
    # y = 1 is held against the spring by u = 2/1.5.
    controller.start(y=1.0, u=2.0 / 1.5)
    x, model = np.array([1.0, 0.0]), PLANT.sampled(DT)
    for _ in range(200):
        u = controller.step(1.0, float(x[0]))
        assert u == pytest.approx(2.0 / 1.5, abs=1e-6)
        x = model.transition @ x + model.input * u


@pytest.mark.parametrize(
    "extra",
    [
        {"learner": ql.learners.Kalman()},
        {"learner": ql.learners.BatchGradient()},
        {"guard": ql.Guard()},
    ],
)
def test_a_nonlinear_observer_takes_no_learner_and_no_guard(extra: dict[str, Any]) -> None:
    """It has no exact lag, and the error says so."""
    with pytest.raises(ValueError, match="no exact lag"):
        ql.ADRC(ESO.nonlinear(2, 1.5, 20.0, DT, delta=0.1), omega_c=2.0, **extra)


@cases(
    ("make", "message"),
    [
        (
            lambda: ESO.model_free(2, 1.0, 10.0, 0.01, delay=0.014),
            r"delay = 0.014 s with dt = 0.01 s: .* 0.01 and 0.02 s",
        ),
        (lambda: ESO.model_free(2, 1.0, 10.0, 0.01, delay=-1.0), "delay = -1.0"),
        (
            lambda: ESO.model_free(2, 1.0, 10.0, 0.01, half_gain=True, form="reduced"),
            "half_gain = True",
        ),
        (lambda: ESO.model_free(2, 1.0, 10.0, 0.01, half_gain=1), "half_gain = 1"),  # type: ignore
        (lambda: ESO.cascade(2, 1.0, 10.0, 0.01, levels=0), "levels = 0"),
        (lambda: ESO.cascade(2, 1.0, 10.0, 0.01, ratio=0.0), "ratio = 0.0"),
        (lambda: ESO.cascade(2, 1.0, 10.0, 0.01, ratio=0.5), "ratio = 0.5: must be above 1"),
        (lambda: ESO.cascade(2, 1.0, 10.0, 0.01, ratio=1.0), "ratio = 1.0: must be above 1"),
        (lambda: ESO.cascade(2, 1.0, 10.0, 0.01, levels=9), "levels = 9: must be .* from 1 to 8"),
        *(
            (
                lambda change=change: ESO.kalman(
                    **{"order": 2, "b0": 1.0, "dt": 0.01, "noise_variance": 1e-6, "drift": 1.0}
                    | change
                ),
                message,
            )
            for change, message in (
                ({"order": 0}, "order = 0: must be a whole number from 1 to 8"),
                ({"order": 9}, "order = 9: must be a whole number from 1 to 8"),
                ({"dt": 0.0}, "dt = 0.0"),
                ({"drift": 0.0}, "drift = 0.0"),
                ({"jitter": -1.0}, "jitter = -1.0"),
                ({"form": "reduced"}, "form = 'reduced': must be one of current, predictor$"),
            )
        ),
        (
            lambda: ESO.model_based(([1.0], 1.0), 10.0, 0.01, keep_zeros=1),  # type: ignore
            "keep_zeros = 1",
        ),
        (lambda: ESO.kalman(2, 1.0, 0.01, noise_variance=0.0, drift=1.0), "noise_variance = 0.0"),
        (
            lambda: ESO.kalman(2, 1.0, 0.01, noise_variance=1e-30, drift=1e30),
            r"no steady-state gain is found; they ask for about 2.15e\+10 rad/s",
        ),
        (  # beyond what SciPy scales without a warning
            lambda: ESO.kalman(2, 1.0, 0.01, noise_variance=1e-30, drift=1e-30, jitter=1e30),
            r"no steady-state gain is found; they ask for about 3.16e\+15 rad/s",
        ),
        (
            lambda: ESO.kalman(2, 1.0, 0.01, noise_variance=1e-20, drift=1e-20, jitter=1e10),
            r"no steady-state gain is found; they ask for about 1e\+08 rad/s",
        ),
        (  # so slow that no correction is left
            lambda: ESO.kalman(1, 1.0, 0.01, noise_variance=1e12, drift=1e-14),
            r"no steady-state gain is found; they ask for about 1e-06 rad/s",
        ),
        *(
            (
                lambda noise=noise, drift=drift: ESO.kalman(
                    1, 1.0, 0.01, noise_variance=noise, drift=drift
                ),
                f"no steady-state gain is found; they ask for about {omega} rad/s",
            )
            for noise, drift, omega in ((1e300, 1e-300, "0"), (1e-323, 1.0, "inf"))
        ),
        (  # stable, but faster than the samples
            lambda: ESO.kalman(1, 1.0, 0.01, noise_variance=1e-8, drift=100.0),
            r"no steady-state gain is found; they ask for about 1e\+03 rad/s",
        ),
        (lambda: ESO.nonlinear(2, 1.0, 10.0, 0.01, delta=0.0), "delta = 0.0"),
        *(
            (
                lambda alpha=alpha: ESO.nonlinear(2, 1.0, 10.0, 0.01, delta=0.1, alpha=alpha),
                "alpha = .*: each entry must be above 0 and at most 1",
            )
            for alpha in ((1.0, 0.5, 1.5), (1.0, 0.5, 0.0), (1.0, -0.5, 0.5))
        ),
        (lambda: ESO.nonlinear(2, 1.0, 10.0, 0.01, delta=0.1, alpha=(1.0, 0.5)), "alpha has shape"),
        (lambda: ql.plants.delayed(PLANT, 0.0, 0.01), "delay = 0.0"),
        (lambda: ql.plants.delayed(PLANT, 0.02, 0.01).sampled(0.005), "dt = 0.005"),
        (lambda: ql.plants.delayed(3, 0.02, 0.01), "plant = 3"),  # type: ignore[arg-type]
    ],
)
def test_bad_input_is_named(make: Any, message: str) -> None:
    """Argument, value and rule."""
    with pytest.raises(ValueError, match=message):
        make()
