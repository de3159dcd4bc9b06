"""The observer of several outputs: against Kalman filters, single observers, and at its limits."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.linalg import block_diag, expm, solve_discrete_are, solve_discrete_lyapunov

from quell.export.c_files import CFiles, translated
from quell.observers.eso import ESO
from quell.observers.multivariable import MultivariableESO
from quell.observers.multivariable_forms import begin_signals, observe_signals
from quell.types import Matrix, Vector

from .cases import cases
from .in_c import InC, needs_gcc

# A motor and a load behind a coupling, 2e-4 kg m² in all, with encoders of 2²⁰ counts.
JM, JL, K, DAMPING, DT = 1.2e-4, 0.8e-4, 60.0, 0.005, 0.25e-3
SERVO = np.array(
    [
        [0.0, 1.0, 0.0, 0.0],
        [-K / JM, -DAMPING / JM, K / JM, DAMPING / JM],
        [0.0, 0.0, 0.0, 1.0],
        [K / JL, DAMPING / JL, -K / JL, -DAMPING / JL],
    ]
)
TORQUE, LOAD = (
    np.array([[0.0], [1.0 / JM], [0.0], [0.0]]),
    np.array([[0.0], [0.0], [0.0], [1.0 / JL]]),
)
ENCODERS = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
COUNT = math.tau / 2**20


def servo(**options: Any) -> MultivariableESO:
    """Return an observer of the servo with torques on the motor and on the load.

    Gains by noise are fixed unless asked for otherwise.
    """
    if "omega_o" not in options:
        options = {"time_varying": False} | options
    noise = {"noise_variance": [COUNT**2 / 12] * 2, "drift": [1.0, 1.0]}
    given = {"omega_o": 800.0} if "omega_o" in options else noise
    both = np.hstack([TORQUE, LOAD])
    return ESO.state_space(SERVO, TORQUE, ENCODERS, both, DT, **given | options)


def chain(order: int) -> tuple[Matrix, Vector, Vector]:
    """Return a chain of integrators."""
    return np.diag(np.ones(order - 1), 1), np.eye(order)[-1], np.eye(order)[0]


# ---- An independent Kalman filter, in the plant's own units ----


class Reference:
    """The Kalman filter of the extended model: predicted by matrices, corrected all at once."""

    def __init__(
        self, observer: MultivariableESO, noise: Any, drift: Any, jitter: Any, refine: bool = True
    ) -> None:
        A, B, C, E, dt, m = (
            *(observer.A, observer.B, observer.C, observer.E),
            *(observer.dt, observer.disturbance_order),
        )
        (n, q), p = E.shape, C.shape[0]
        size = n + q * m
        shift = np.kron(np.diag(np.ones(m - 1), 1), np.eye(q))
        whole = np.block([[A, E, np.zeros((n, q * (m - 1)))], [np.zeros((q * m, n)), shift]])
        held = expm(
            np.block([[A, np.hstack([B, E])], [np.zeros((B.shape[1] + q, n + B.shape[1] + q))]])
            * dt
        )
        self.phi = block_diag(held[:n, :n], expm(shift * dt))
        self.phi[:n, n : n + q] = held[:n, n + B.shape[1] :]
        self.gamma = np.vstack([held[:n, n : n + B.shape[1]], np.zeros((q * m, B.shape[1]))])
        self.C, self.D = np.hstack([C, np.zeros((p, q * m))]), observer.D
        density = block_diag(
            E @ np.diag(jitter) @ E.T, np.zeros((q * (m - 1),) * 2), np.diag(drift)
        )
        nodes, weights = np.polynomial.legendre.leggauss(20)
        self.Q = np.zeros((size, size))
        for node, weight in zip(nodes, weights, strict=True):
            step = expm(whole * 0.5 * dt * (1.0 + node))
            self.Q += 0.5 * dt * weight * step @ density @ step.T
        self.R = np.diag(noise)
        self.P = solve_discrete_are(self.phi.T, self.C.T, self.Q, self.R)
        # Newton's steps: SciPy's solution has errors of 1e-9 where a pole is slow.
        for _ in range(3 * refine):
            gain, after = self.after(np.ones(p, dtype=bool))
            rest = self.phi @ after @ self.phi.T + self.Q - self.P
            error = self.phi @ (np.eye(size) - gain @ self.C)
            self.P = self.P + solve_discrete_lyapunov(error, 0.5 * (rest + rest.T))

    def after(self, on: Any) -> tuple[Matrix, Matrix]:
        """Return the gain for the outputs that are measured, and the covariance with it."""
        C, R = self.C[on], self.R[np.ix_(on, on)]
        gain = self.P @ C.T @ np.linalg.inv(C @ self.P @ C.T + R)
        rest = np.eye(self.P.shape[0]) - gain @ C
        return gain, rest @ self.P @ rest.T + gain @ R @ gain.T

    def run(self, y: Matrix, u: Matrix, z: Vector, steady: bool) -> Matrix:
        """Return the estimates (K, N); the covariance is not advanced if ``steady``."""
        found, first = [], self.P
        for measured, control in zip(y, u, strict=True):
            on = np.isfinite(measured)
            gain, P = self.after(on)
            z = self.phi @ z + self.gamma @ control
            z = z + gain @ (measured - self.C @ z - self.D @ control)[on]
            self.P = first if steady else self.phi @ P @ self.phi.T + self.Q
            found.append(z)
        return np.array(found)


def draw(random: np.random.Generator) -> tuple[Any, ...]:
    """Return a random plant with up to 3 inputs, outputs and disturbances, and its noise."""
    p = int(random.integers(1, 4))
    q, m, n = int(random.integers(1, p + 1)), int(random.integers(1, 4)), int(random.integers(p, 7))
    A = random.normal(size=(n, n))
    A -= np.eye(n) * (np.max(np.linalg.eigvals(A).real) - random.uniform(-1.0, 0.2))
    B, C, E = (random.normal(size=shape) for shape in ((n, m), (p, n), (n, q)))
    D = random.normal(size=(p, m)) * int(random.integers(0, 2))
    noise, drift = 10.0 ** random.uniform(-4, 0, p), 10.0 ** random.uniform(-2, 2, q)
    jitter = 10.0 ** random.uniform(-3, 0, q) * int(random.integers(0, 2))
    options = {"D": D, "noise_variance": noise, "drift": drift, "jitter": jitter}
    return (A, B, C, E, 0.05), options


@pytest.mark.compiled
@pytest.mark.parametrize("time_varying", [False, True])
@pytest.mark.trial
@pytest.mark.parametrize("plants", [200])
def test_it_is_the_kalman_filter_of_the_extended_model(plants: int, time_varying: bool) -> None:
    """200 random plants with m, p, q to 3, 500 samples each: to 1e-9 of a state's largest value.

    With a covariance in each sample also where a third of all measurements is missing. In at most
    two of the plants a change of A in the 14th digit moves the states by more than 1e-9; there the
    difference is not above ten times that.
    """
    random = np.random.default_rng(51)
    sensitive = 0
    for case in range(plants):
        plant, options = draw(random)
        options["disturbance_order"] = 1 + case % 5 // 3
        observer = ESO.state_space(*plant, **options, time_varying=time_varying, accept_zeros=True)
        noise = [options[name] for name in ("noise_variance", "drift", "jitter")]
        reference = Reference(observer, *noise)
        on = np.ones(observer.C.shape[0], dtype=bool)
        P, found = reference.after(on)[1], observer.covariance
        assert np.max(np.abs(P - found) / np.sqrt(np.outer(np.diag(P), np.diag(P)))) < 1e-7
        y = np.cumsum(random.normal(size=(500, on.size)), axis=0)
        if time_varying:
            y[random.random(y.shape) < 0.3] = math.nan
        u = random.normal(size=(500, observer.B.shape[1]))
        start = random.normal(size=observer.estimates)
        wanted = reference.run(y, u, start, steady=not time_varying)
        found = observer.filter(y, u, start=start)
        size = np.max(np.abs(wanted), axis=0)
        difference = np.max(np.abs(found - wanted) / size)
        if difference > 1e-9:
            changed = replace(
                observer, A=observer.A * (1.0 + 1e-14 * random.normal(size=observer.A.shape))
            )
            other = Reference(changed, *noise).run(y, u, start, steady=not time_varying)
            assert difference < 10.0 * np.max(np.abs(other - wanted) / size), case
            sensitive += 1
    assert sensitive <= 2


# ---- Limit cases: one output, axes that are not coupled ----


@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize(
    ("b0", "omega_o", "dt"), [(1.5, 12.0, 0.01), (5e3, 200.0, DT), (0.02, 0.05, 1.0)]
)
def test_with_one_output_and_a_chain_it_is_the_single_observer(
    order: int, m: int, b0: float, omega_o: float, dt: float
) -> None:
    """Gains by poles and by noise are those of ``ESO.model_free`` and ``ESO.kalman``."""
    A, B, C = chain(order)
    more: dict[str, Any] = {"disturbance_order": m}
    one = ESO.model_free(order, b0, omega_o, dt, **more)
    found = ESO.state_space(A, b0 * B, C, B, dt, omega_o=omega_o, **more)
    np.testing.assert_allclose(found.gains[0, :, 0], one.model.gain, rtol=1e-9)
    np.testing.assert_allclose(
        found.model.transition, one.model.transition, rtol=1e-12, atol=1e-12 * dt
    )
    np.testing.assert_allclose(found.model.input[:, 0], one.model.input, rtol=1e-12)
    noise, drift = 1e-6, 1e-6 * dt * omega_o ** (2 * (order + m))
    one = ESO.kalman(order, b0, dt, noise_variance=noise, drift=drift, **more)
    found = ESO.state_space(A, b0 * B, C, B, dt, noise_variance=noise, drift=drift, **more)
    np.testing.assert_allclose(found.gains[0, :, 0], one.model.gain, rtol=1e-9)
    assert found.omega_o == pytest.approx(one.omega_o, rel=1e-6)


def test_axes_that_are_not_coupled_have_the_gains_of_single_observers() -> None:
    """Three axes of order 1 to 3 in one observer, with poles in one place, are three observers.

    So they are while a sensor is missing.
    """
    orders, gains, omega_o, dt = (2, 1, 3), (40.0, -3.0, 7.0), 30.0, 2e-3
    parts = [chain(order) for order in orders]
    A = block_diag(*(part[0] for part in parts))
    B = block_diag(*(gain * part[1][:, None] for gain, part in zip(gains, parts, strict=True)))
    E, C = (
        block_diag(*(part[1][:, None] for part in parts)),
        block_diag(*(part[2] for part in parts)),
    )
    observer = ESO.state_space(A, B, C, E, dt, omega_o=omega_o)
    first = np.cumsum((0, *orders))
    for axis, (order, b0) in enumerate(zip(orders, gains, strict=True)):
        alone = ESO.model_free(order, b0, omega_o, dt)
        own = [*range(first[axis], first[axis + 1]), sum(orders) + axis]
        others = np.delete(np.arange(observer.estimates), own)
        for measured in (7, 1 << axis):
            gain = observer.model.gains[measured].reshape(-1, 3)[:, axis]
            np.testing.assert_allclose(gain[own], alone.model.gain, rtol=1e-9)
            assert np.max(np.abs(gain[others])) < 1e-9 * np.max(np.abs(gain))


# ---- Gains by poles ----


def error_polynomial(observer: MultivariableESO, row: int) -> Vector:
    """Return the characteristic polynomial of the error about z = 1, in units of 1 − β.

    The states are in units of their gains' size: eigenvalues of multiplicity N move by ε^(1/N).
    """
    model, size = observer.model, observer.estimates
    gain = model.gains[row].reshape(size, -1)
    scale = observer._scaled.units
    error = (np.eye(size) - gain @ model.output) @ model.transition * scale / scale[:, None]
    return np.poly((error - np.eye(size)) / -math.expm1(-observer.omega_o * observer.dt))


@pytest.mark.parametrize("omega_o", [200.0, 800.0, 2000.0])
def test_all_poles_of_a_servo_with_two_encoders_lie_in_one_place(omega_o: float) -> None:
    """Six poles at exp(−omega_o dt), although two outputs have eigenvectors for two at most."""
    both = np.hstack([TORQUE, LOAD])
    observer = ESO.state_space(SERVO, TORQUE, ENCODERS, both, DT, omega_o=omega_o)
    wanted = [math.comb(6, i) for i in range(7)]
    np.testing.assert_allclose(error_polynomial(observer, 3), wanted, atol=1e-4)


@pytest.mark.trial
def test_all_poles_of_random_plants_lie_in_one_place() -> None:
    """So they do in 100 random plants, and with the sensors that are left if these observe all."""
    random = np.random.default_rng(3)
    for _ in range(100):
        (A, B, C, E, dt), _options = draw(random)
        try:
            observer = ESO.state_space(A, B, C, E, dt, omega_o=3.0, accept_zeros=True)
        except ValueError as error:
            assert "rounding errors" in str(error)  # noqa: PT017 - rare, and counted below
            pytest.fail(str(error))
        wanted = np.array([math.comb(observer.estimates, i) for i in range(observer.estimates + 1)])
        error = np.abs(error_polynomial(observer, 2 ** C.shape[0] - 1) - wanted)
        assert np.max(error) < 1e-5 * np.max(wanted)
        if C.shape[0] == 2 and E.shape[1] == 1:
            error = np.abs(error_polynomial(observer, 1) - wanted)
            assert np.max(error) < 1e-5 * np.max(wanted)


@pytest.mark.trial
def test_units_do_not_matter() -> None:
    """States, outputs, disturbances and time in units of 1e-6 to 1e6: the same observers."""
    random = np.random.default_rng(11)
    for case in range(25):
        (A, B, C, E, dt), options = draw(random)
        (n, q), p, m = E.shape, C.shape[0], 1 + case % 3
        x, y, d = (10.0 ** random.uniform(-6, 6, size) for size in (n, p, q))
        t = 10.0 ** random.uniform(-4, 3)
        units = np.concatenate([x, *(d / t**i for i in range(m))])
        plant = (
            A * x[:, None] / x / t,
            B * x[:, None] / t,
            C * y[:, None] / x,
            E * x[:, None] / d / t,
        )
        noise, drift = options["noise_variance"], options["drift"]
        more: dict[str, Any] = {"accept_zeros": True, "disturbance_order": m}
        pairs = (
            ({"omega_o": 3.0}, {"omega_o": 3.0 / t}),
            (
                {"noise_variance": noise, "drift": drift},
                {"noise_variance": noise * y**2, "drift": drift * d**2 / t ** (2 * m - 1)},
            ),
        )
        for one, other in pairs:
            wanted = ESO.state_space(A, B, C, E, dt, **one, **more).gains[0]
            found = ESO.state_space(*plant, dt * t, **other, **more).gains[0] * y / units[:, None]
            size = np.max(np.abs(wanted), axis=1, keepdims=True)
            assert np.max(np.abs(found - wanted) / size) < 1e-5


def test_the_predictor_form_knows_the_measurements_up_to_the_sample_before() -> None:
    """Its estimates are the current form's, moved by one sample of the model."""
    random = np.random.default_rng(8)
    y, u = 1e-3 * random.normal(size=(40, 2)), random.normal(size=(40, 1))
    for options in ({"omega_o": 800.0}, {}, {"time_varying": True}):
        current, late = servo(**options), servo(**options, form="predictor")
        model = servo(omega_o=800.0).model
        known = current.filter(y, u, start=np.zeros(6))
        found = late.filter(y, u, start=np.zeros(6))
        wanted = known[:-1] @ model.transition.T + u[1:] @ model.input.T
        size = np.max(np.abs(wanted), axis=0)
        assert np.max(np.abs(found[1:] - wanted) / size) < 1e-12


# ---- Missing samples and several rates ----


def test_the_periodic_gain_is_the_limit_of_the_kalman_recursion() -> None:
    """A load encoder at a quarter of the rate: 4 gains, those of a recursion over 3000 samples."""
    observer = servo(every=(1, 4))
    reference = Reference(servo(), [COUNT**2 / 12] * 2, [1.0, 1.0], [0.0, 0.0], refine=False)
    for k in range(3000):
        gain, P = reference.after(np.array([True, k % 4 == 0]))
        if k >= 2996:
            wanted = np.zeros((6, 2))
            wanted[:, [True, k % 4 == 0]] = gain
            size = np.max(np.abs(wanted), axis=1, keepdims=True)
            assert np.max(np.abs(observer.gains[k % 4] - wanted) / size) < 1e-7
        reference.P = reference.phi @ P @ reference.phi.T + reference.Q
    assert np.max(np.abs(observer.poles())) < 1.0
    assert observer.standard_deviations[5] > servo().standard_deviations[5]


def test_the_table_and_the_covariance_agree_on_sensors_of_several_rates() -> None:
    """Periodic gains, and a covariance in each sample with NaN in between, are the same filter."""
    random = np.random.default_rng(5)
    y = 1e-3 * np.cumsum(random.normal(size=(200, 2)), axis=0)
    u = random.normal(size=(200, 1))
    gaps = y.copy()
    gaps[np.arange(200) % 4 != 0, 1] = math.nan
    table, start = servo(every=(1, 4)), np.zeros(6)
    found = table.filter(y, u, start=start)
    size = np.max(np.abs(found), axis=0)
    for other in (
        table.filter(gaps, u, start=start),
        servo(every=(1, 4), time_varying=True).filter(gaps, u, start=start),
    ):
        assert np.max(np.abs(other - found) / size) < 1e-9
    late = servo(time_varying=True).filter(gaps, u, start=start)
    assert np.max(np.abs(late - found)[150:] / size) < 1e-6  # from another covariance at the start


def test_a_missing_load_encoder_leaves_the_gain_that_suits_the_motors() -> None:
    """With one disturbance, the motor's encoder alone observes all, and places all poles."""
    observer = ESO.state_space(
        SERVO, TORQUE, ENCODERS, TORQUE, DT, omega_o=300.0, accept_zeros=True
    )
    assert np.max(np.abs(np.abs(observer.poles([1])) - math.exp(-300.0 * DT))) < 2e-2
    noisy = ESO.state_space(
        SERVO, TORQUE, ENCODERS, LOAD, DT, noise_variance=[1e-12] * 2, drift=[1.0]
    )
    assert max(abs(noisy.poles())) < 1.0
    assert max(abs(noisy.poles([1]))) < 1.0
    assert max(abs(servo().poles([1]))) == pytest.approx(1.0, abs=1e-9)  # two torques, one sensor


def test_the_decay_with_samples_missing_is_that_of_the_mean_square() -> None:
    """Without gaps the slowest pole; half of the load's samples are too many for a fast observer.

    A slower one stands it, and says so: 4000 draws of 60 samples have that mean square.
    """
    fast, slow = servo(), servo(omega_o=800.0)
    assert fast.rms_decay([0.0, 0.0]) == pytest.approx(np.max(np.abs(fast.poles())), rel=1e-6)
    assert fast.rms_decay([0.0, 0.5]) > 1.0 > fast.rms_decay([0.0, 0.05])
    assert servo(every=(1, 4)).rms_decay([0.0, 0.0]) < 1.0
    assert slow.rms_decay([0.0, 0.5]) < 1.0
    random = np.random.default_rng(4)
    errors = random.normal(size=(4000, 6, 1))
    both, motor = slow._error(0, np.array([True, True])), slow._error(0, np.array([True, False]))
    sizes = []
    for _ in range(60):
        gone = random.random(4000) < 0.1
        errors = np.where(gone[:, None, None], motor @ errors, both @ errors)
        sizes.append(np.sqrt(np.mean(errors**2)))
    measured = (sizes[-1] / sizes[29]) ** (1.0 / 30.0)
    assert measured == pytest.approx(slow.rms_decay([0.0, 0.1]), abs=0.02)


def test_what_is_not_measured_has_no_effect() -> None:
    """NaN, infinity and numbers above 1e60 are missing, in a sample that counts otherwise."""
    for observer in (servo(omega_o=800.0), servo(), servo(time_varying=True)):
        results = []
        for bad in (math.nan, math.inf, -math.inf, 1e300):
            running = observer.estimator()
            running.start([0.0, 0.0])
            for k in range(20):
                running.step([1e-4 * k, bad if k % 3 else 1e-4 * k], [0.1])
            results.append(running.estimate)
            assert np.all(np.isfinite(results[-1]))
            assert running.innovations[1] == 0.0
        assert np.all(np.array(results) == results[0])


@pytest.mark.trial
@pytest.mark.compiled
def test_the_covariance_survives_years_without_measurements() -> None:
    """A million samples without any, then a hundred with: it is positive, and as it was before."""
    observer = servo(time_varying=True)
    running, found = observer.estimator(), np.empty((1_000_000, 6))
    running.start([0.0, 0.0])
    running.step_record(
        np.full((1_000_000, 2), math.nan), np.zeros((1_000_000, 1)), np.zeros((1_000_000, 2)), found
    )
    assert np.all(np.isfinite(running.covariance))
    for _ in range(100):
        running.step([0.5, 0.5], [0.0])
        deviations = np.sqrt(np.diag(running.covariance))
        assert (
            np.min(np.linalg.eigvalsh(running.covariance / np.outer(deviations, deviations))) > 0.0
        )
    np.testing.assert_allclose(deviations, observer.standard_deviations, rtol=1e-6)
    assert running.x[0] == pytest.approx(0.5, abs=1e-5)


# ---- Start, records, and the running observer ----


def test_it_starts_at_rest_under_a_load() -> None:
    """At rest under u = 0.3, the wind-up of the coupling tells the torque on the load."""
    for observer in (servo(omega_o=800.0), servo(), servo(time_varying=True)):
        running = observer.estimator()
        y = np.array([0.2, 0.2 - 0.3 / K])
        running.start(y, [0.3])
        np.testing.assert_allclose(running.d, [0.0, -0.3], atol=1e-9)
        np.testing.assert_allclose(running.step(y, [0.3]), [y[0], 0, y[1], 0, 0, -0.3], atol=1e-7)
        running.reset()
        assert not running.is_started
        assert np.array_equal(running.step([math.nan, math.nan], [0.3]), np.zeros(6))
        np.testing.assert_allclose(running.step(y, [0.3])[4:], [0.0, -0.3], atol=1e-9)
        alone = observer.at_rest([0.2, math.nan])
        np.testing.assert_allclose(alone, [0.2, 0, 0.2, 0, 0, 0], atol=1e-9)


def test_a_known_disturbance_is_not_estimated() -> None:
    """A torque that is told as ``d_known`` leaves d at zero; untold, d finds it."""
    observer = servo()
    phi, feed = observer.model.transition, observer.model.feed
    for told in (0.0, 1.0):
        running, z = observer.estimator(), np.zeros(6)
        running.start([0.0, 0.0])
        for _ in range(200):
            z = phi @ z + feed @ [0.0, 0.25]
            running.step(ENCODERS @ z[:4], [0.0], [0.0, told * 0.25])
        assert running.d[1] == pytest.approx(0.25 * (1.0 - told), abs=1e-9)


def test_a_record_gives_what_single_samples_give() -> None:
    """``filter`` is ``step`` after ``step``, from the first measurement on."""
    random = np.random.default_rng(1)
    y, u = 1e-3 * random.normal(size=(30, 2)), random.normal(size=(30, 1))
    y[:3] = math.nan
    for observer in (servo(every=(1, 4)), servo(time_varying=True)):
        running = observer.estimator()
        assert np.array_equal(
            observer.filter(y, u), [running.step(*each) for each in zip(y, u, strict=True)]
        )


# ---- The same in C, and compiled ----


class Signals(NamedTuple):
    """A state with the signals of a sample."""

    z: Vector
    estimate: Vector
    y: Vector
    u: Vector
    d: Vector


def take(design: Any, state: Signals, a: float, b: float) -> float:
    """Take a sample with the measurements a and b; return a mixture of the estimates."""
    state.y[0], state.y[1] = a, b
    state.u[0] = -0.1 * state.estimate[0]
    observe_signals(design, state.z, state.estimate, state.y, state.u, state.d)
    total = 0.0
    for i in range(state.estimate.size):
        total += state.estimate[i]
    return total


@needs_gcc
@pytest.mark.parametrize("kind", ["poles", "rates", "covariance", "predictor"])
def test_in_c_it_calculates_the_same_bits(kind: str, tmp_path: Path) -> None:
    """The kernels become C; with missing measurements and hostile numbers, too."""
    observer = {
        "poles": lambda: servo(omega_o=800.0),
        "rates": lambda: servo(every=(1, 3)),
        "covariance": lambda: servo(time_varying=True, every=(1, 2)),
        "predictor": lambda: servo(form="predictor", time_varying=True),
    }[kind]()

    def fresh() -> Signals:
        state = Signals(
            np.zeros(observer.model.states), np.zeros(6), np.zeros(2), np.zeros(1), np.zeros(2)
        )
        begin_signals(observer.model, state.z, state.estimate)
        return state

    def write(findings: Any) -> Any:
        files = CFiles("t", observer.model, fresh(), findings)
        files.add_init()
        call = files.call(take, *files.both, files.number("a"), files.number("b"))
        files.add(
            "run", "double NAME(t_state *state, double a, double b)", "Run.", f"    return {call};"
        )
        return files.write(["Test."], (), [])

    in_c, state = InC(translated(write), tmp_path), fresh()
    random = np.random.default_rng(2)
    samples = 1e-3 * np.cumsum(random.normal(size=(300, 2)), axis=0)
    samples[random.random(samples.shape) < 0.2] = math.nan
    samples[50] = 1e300, -math.inf
    for a, b in samples:
        assert in_c.run("run", a, b) == take(observer.model, state, a, b)


@pytest.mark.trial
@pytest.mark.compiled
def test_compiled_and_interpreted_agree() -> None:
    """To rounding errors, for all kinds of gains."""
    random = np.random.default_rng(2)
    y, u = 1e-3 * random.normal(size=(50, 2)), random.normal(size=(50, 1))
    for observer in (servo(omega_o=800.0), servo(every=(1, 3)), servo(time_varying=True)):
        compiled = observer.filter(y, u, start=np.zeros(6))
        z, estimate = np.zeros(observer.model.states), np.zeros(6)
        begin_signals(observer.model, z, estimate)
        for k in range(50):
            observe_signals(observer.model, z, estimate, y[k], u[k], np.zeros(2))
            np.testing.assert_allclose(compiled[k], estimate, rtol=1e-9, atol=1e-12)


# ---- What can not be observed, and bad arguments ----


def test_what_no_observer_finds_is_named() -> None:
    """The hidden mode, the zero, or the rank; and what to do."""
    with pytest.raises(ValueError, match=r"mode at 0.*motion of x1.*measure another output"):
        ESO.state_space(
            SERVO[:2, :2] * [[0, 1], [0, 1]], TORQUE[:2], [0.0, 1.0], TORQUE[:2], DT, omega_o=100.0
        )
    resonance = r"invariant zero from w to y at -31\.25±865\.5j(.|\n)*accept_zeros = True"
    with pytest.raises(ValueError, match=resonance):
        ESO.state_space(SERVO, TORQUE, ENCODERS[0], TORQUE, DT, omega_o=800.0)
    both = np.hstack([TORQUE, LOAD])
    with pytest.raises(ValueError, match="can not|cannot be told apart"):
        ESO.state_space(SERVO, TORQUE, ENCODERS[0], both, DT, omega_o=800.0, accept_zeros=True)
    with pytest.raises(ValueError, match="zero from w to y at 0"):
        ESO.state_space(
            [[0.0, 1.0], [-1.0, -1.0]],
            [0.0, 1.0],
            [0.0, 1.0],
            [0.0, 1.0],
            0.01,
            omega_o=5.0,
            accept_zeros=True,
        )


def test_a_mode_that_no_disturbance_moves_has_no_steady_gain() -> None:
    """Two axes and a disturbance on one of them: the other one is believed for ever."""
    A, C = block_diag(chain(2)[0], chain(2)[0]), block_diag(chain(2)[2], chain(2)[2])
    E = np.eye(4)[1]
    with pytest.raises(ValueError, match="no steady state.*give E a column"):
        ESO.state_space(A, E, C, E, 0.01, noise_variance=[1e-6, 1e-6], drift=[1.0])


@cases(
    ("options", "message"),
    [
        ({"noise_variance": None, "drift": None}, "give omega_o for gains by poles"),
        ({"omega_o": 100.0, "noise_variance": [1e-9, 1e-9]}, "give omega_o for gains by poles"),
        ({"noise_variance": [1e-9]}, "noise_variance has shape"),
        ({"noise_variance": [1e-9, 0.0]}, "noise_variance.*greater than zero"),
        ({"drift": None}, "drift = None"),
        ({"drift": [1.0, -1.0]}, "drift.*greater than zero"),
        ({"jitter": [1.0, -1.0]}, "jitter.*not negative"),
        ({"every": 4}, "every = 4: must have a whole number"),
        ({"every": (2, 4)}, "one output must be measured in every sample"),
        ({"every": (1, 0)}, r"every\[1\] = 0"),
        ({"every": (1, 5000)}, "take rates with a smaller common multiple"),
        ({"form": "reduced"}, "form = 'reduced'"),
        ({"disturbance_order": 4}, "disturbance_order = 4"),
        ({"D": [[1.0]]}, "D has shape"),
        ({"time_varying": 1}, "time_varying = 1"),
    ],
)
def test_bad_arguments_are_named(options: dict[str, Any], message: str) -> None:
    """With their value and the rule."""
    given = {"noise_variance": [1e-12, 1e-12], "drift": [1.0, 1.0]} | options
    both = np.hstack([TORQUE, LOAD])
    with pytest.raises(ValueError, match=message):
        ESO.state_space(SERVO, TORQUE, ENCODERS, both, DT, **given)


def test_options_without_effect_are_refused() -> None:
    """Gains by poles do not know what a sample is worth."""
    both = np.hstack([TORQUE, LOAD])
    for option in ({"every": (1, 4)}, {"time_varying": True}, {"time_varying": False}):
        with pytest.raises(ValueError, match="only gains by noise"):
            ESO.state_space(SERVO, TORQUE, ENCODERS, both, DT, omega_o=800.0, **option)
    with pytest.raises(ValueError, match="know no noise"):
        _ = servo(omega_o=800.0).standard_deviations


@cases(
    ("call", "message"),
    [
        (lambda r: r.step([0.0], [0.0]), "y has 1 entries: must have 2"),
        (lambda r: r.step("far", [0.0]), "y = 'far'"),
        (lambda r: r.step([0.0, 0.0], [math.nan]), "u: entry"),
        (lambda r: r.step([0.0, 0.0], [0.0, 0.0]), "u has shape"),
        (lambda r: r.step([0.0, 0.0], [0.0], [0.0]), "d_known has shape"),
        (lambda r: r.start([math.nan, math.nan]), "at least one output"),
        (lambda r: r.set([0.0]), "estimate has shape"),
        (lambda r: r.observer.poles([2]), "missing = 2"),
        (lambda r: r.observer.rms_decay([0.5]), "missing has shape"),
        (lambda r: r.observer.rms_decay([0.5, 2.0]), "missing = .* from 0 to 1"),
        (
            lambda r: servo(time_varying=True).rms_decay([0.0, 0.5]),
            "calculated for what is missing",
        ),
        (lambda r: r.observer.filter(np.zeros((3, 2)), np.zeros((4, 1))), "u has shape"),
    ],
)
def test_bad_samples_are_named(call: Any, message: str) -> None:
    """A size that does not fit, or an applied u that is no number."""
    with pytest.raises(ValueError, match=message):
        call(servo().estimator())
