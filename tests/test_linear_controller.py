"""Linear controllers: realisation, sampling, anti-windup, rest, bad samples; prefilters before any controller."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest

import quell as ql
from quell.controllers import LinearController, LinearLaw, Prefiltered
from quell.controllers.baselines import PID
from quell.controllers.linear import anti_windup, as_state_space, realised, tustin

from .cases import cases
from .contracts.python_models import LeastMeanSquares

LAG = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -1.5]], [0.0, 2.0], [1.0, 0.0])


def response(law: LinearLaw, omega: float, dt: float) -> tuple[complex, complex]:
    """Frequency responses from r and from y to u, without limits."""
    A, z = law.A + np.outer(law.B_u, law.C), np.exp(1j * omega * dt)
    inner = np.linalg.inv(z * np.eye(law.C.size) - A)
    return tuple(
        law.C @ inner @ (B + law.B_u * D) + D for B, D in ((law.B_r, law.D_r), (law.B_y, law.D_y))
    )  # type: ignore[return-value]


def poly(num: list[float], den: list[float], s: complex) -> complex:
    """Value of a transfer function."""
    return complex(np.polyval(num, s) / np.polyval(den, s))


# Poles from 1e-3 to 1e3 rad/s, one at zero, two complex ones of little damping.
WIDE = ([3.0, 2.0, 50.0], np.polymul([1.0, 0.4, 100.0], np.poly([0.0, -1e-3, -1.0, -1e3])).tolist())


@pytest.mark.parametrize("dt", [1e-2, 1e-4])
def test_tustin_gives_c_at_the_warped_frequency_however_far_apart_its_poles_are(dt: float) -> None:
    """``C_d(e^(jω dt)) = C(j 2/dt tan(ω dt/2))`` exactly; a direct form in z would have lost half of its digits at 1e-4 s."""
    law = LinearController.from_transfer_function(*WIDE, dt=dt).law
    for omega in (1e-3, 0.1, 3.0, 10.0, 100.0):
        expected = poly(*WIDE, 2j / dt * math.tan(0.5 * omega * dt))
        from_r, from_y = response(law, omega, dt)
        assert abs(from_r - expected) < 1e-8 * abs(expected)
        assert from_y == pytest.approx(-from_r)


def test_prewarping_is_exact_where_it_is_asked_for() -> None:
    """At that frequency, not beside it."""
    num, den = [1.0, 0.2, 25.0], [1.0, 5.0, 25.0]
    plain, warped = (
        LinearController.from_transfer_function(num, den, dt=0.1, prewarp=w).law
        for w in (None, 6.0)
    )
    expected = poly(num, den, 6.0j)
    assert response(warped, 6.0, 0.1)[0] == pytest.approx(expected, rel=1e-10)
    assert abs(response(plain, 6.0, 0.1)[0] - expected) > 0.01


@pytest.mark.parametrize("method", ["tustin", "zoh"])
def test_python_control_samples_the_same(method: str) -> None:
    """A peer's ``sample_system``, from its own objects, transfer function and state space."""
    system = control.tf([2.0, 1.0, 0.5], [1.0, 3.0, 2.0, 0.0])
    theirs = control.sample_system(system, 0.05, method=method)
    for ours in (system, control.ss(system)):
        law = LinearController.from_transfer_function(
            ours, dt=0.05, method=method, feedback="output"
        ).law
        for omega in (0.01, 1.0, 30.0):
            from_r, from_y = response(law, omega, 0.05)
            assert from_r == 0.0
            assert from_y == pytest.approx(-complex(theirs(np.exp(1j * omega * 0.05))), rel=1e-9)


def test_a_realisation_serves_both_inputs_with_the_states_of_one() -> None:
    """``T(s)/D(s)`` and ``S(s)/D(s)`` with the order of D, and a static gain with none."""
    T, S, D = [1.0, 2.0], [3.0, 0.0, 1.0], [2.0, 3.0, 4.0, 0.0]
    A, B, C, through = realised([T, S], D)
    assert A.shape == (3, 3)
    for s in (0.1j, 2.0 + 1.0j):
        np.testing.assert_allclose(
            (C @ np.linalg.solve(s * np.eye(3) - A, B) + through)[0], [poly(T, D, s), poly(S, D, s)]
        )
    gain = LinearController.from_transfer_function([2.0], [4.0], dt=0.1)
    assert gain.law.C.size == 0
    assert gain.step(3.0, 1.0) == 1.0


def test_anti_windup_moves_the_integrator_and_nothing_else() -> None:
    """Poles on the unit circle go to where they are asked, in whatever company; without limits the law stays the same."""
    A, _, C, _ = tustin(as_state_space([1.0, 0.5], np.poly([0.0, -2.0, -30.0])), 0.01)
    back = anti_windup(A, C[0], 0.9)
    moved = np.sort(np.linalg.eigvals(A - np.outer(back, C[0])).real)
    kept = np.sort(np.linalg.eigvals(A).real)
    np.testing.assert_allclose(moved, np.sort([*kept[:2], 0.9]), rtol=1e-9)
    twice = tustin(as_state_space([1.0, 0.5], [1.0, 2.0, 0.0, 0.0]), 0.01)
    left = np.linalg.eigvals(
        twice[0] - np.outer(anti_windup(twice[0], twice[2][0], 0.9), twice[2][0])
    )
    np.testing.assert_allclose(
        np.poly(left), np.poly([0.9, 0.9, (1 - 0.01) / (1 + 0.01)]), rtol=1e-9
    )


def test_an_integrator_does_not_wind_up() -> None:
    """After 40 s against a limit it leaves it at once when the reference comes back; without B_u it stays for many seconds."""
    reference = ql.signals.Constant(5.0).until(40.0, then=ql.signals.Constant(0.5))
    scenario = ql.Scenario(reference=reference, duration=60.0)
    controller = LinearController.from_transfer_function(
        [1.0, 2.0], [1.0, 0.0], dt=0.01, u_min=-1.0, u_max=1.0
    )
    law = controller.law
    A = law.A + np.outer(law.B_u, law.C)
    naive = law._replace(
        A=A, B_r=law.B_r + law.B_u * law.D_r, B_y=law.B_y + law.B_u * law.D_y, B_u=0.0 * law.B_u
    )
    run, wound = (
        ql.simulate(LAG, c, scenario)
        for c in (controller, LinearController(naive, 0.01, u_min=-1.0, u_max=1.0))
    )
    after = run.window(40.0, 41.0)
    assert run["u"][after.start] == pytest.approx(0.5, abs=0.02)  # back-calculated: I = 1, P = −0.5
    assert np.all(wound["u"][wound.window(40.0, 50.0)] == 1.0)
    assert run["y"][-1] == pytest.approx(0.5, abs=0.02)
    assert run["u_wished"][100] > 1.0


@cases(
    "controller",
    [
        LinearController.from_transfer_function([2.0, 1.0], [0.1, 1.0, 0.0], dt=0.01),
        LinearController.from_transfer_function([1.0, 2.0, 1.0], [0.1, 1.0, 0.0, 0.0], dt=0.01),
        ql.baselines.PID(2.0, 1.0, 0.5, tf=0.1, b=0.3, dt=0.01),
        ql.baselines.LQG(LAG, 3.0, 20.0, 0.01),
    ],
)
def test_a_loop_that_rests_anywhere_goes_on_resting(controller: LinearController) -> None:
    """No bump from y_0 ≠ 0: r = y = 7 for ever leaves u at zero, whatever weighs the set-point."""
    assert max(abs(controller.step(7.0, 7.0)) for _ in range(200)) < 1e-6


def test_a_law_without_integrator_starts_at_its_own_rest() -> None:
    """A lead filter on −y: its state is at rest, and u what it makes of y."""
    controller = LinearController.from_transfer_function(
        [1.0, 2.0], [0.1, 1.0], dt=0.01, feedback="output"
    )
    assert [controller.step(0.0, 3.0) for _ in range(3)] == pytest.approx([-6.0] * 3)


def test_a_controller_with_integral_action_starts_under_load() -> None:
    """PID and PI continue from u, also to another reference; a law without integrator says why not."""
    pid = PID(kp=2.0, ki=1.0, kd=0.5, tf=0.1, dt=0.01)
    pid.start(3.0, 1.5)
    assert [pid.step(3.0, 3.0) for _ in range(20)] == pytest.approx([1.5] * 20)
    pid.start(3.0, 1.5, r=4.0)
    assert pid.step(4.0, 3.0) == pytest.approx(1.5)
    assert pid.step(4.0, 3.0) > 1.5
    with pytest.raises(ValueError, match=r"u = 1.0 at y = 2.0: the law has no integral action"):
        PID(kp=1.0, dt=0.01).start(2.0, 1.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_bad_sample_is_held(bad: float) -> None:
    """As if the last good one had come again, and said so."""
    one, other = (
        LinearController.from_transfer_function([2.0, 1.0], [0.1, 1.0, 0.0], dt=0.01)
        for _ in range(2)
    )
    for y in (0.1, 0.2):
        one.step(1.0, y)
        other.step(1.0, y)
    assert one.step(1.0, bad) == other.step(1.0, 0.2)
    assert one.status == ql.Status.MEASUREMENT_HELD
    assert one.step(bad, 0.3) == other.step(1.0, 0.3)
    assert one.status == ql.Status.REFERENCE_HELD


def test_nothing_happens_before_a_first_good_measurement_nor_without_reference() -> None:
    """Then it begins at rest there."""
    controller = LinearController.from_transfer_function(
        [2.0, 1.0], [1.0, 0.0], dt=0.01, u_min=0.5, u_max=2.0
    )
    assert controller.step(5.0, math.nan) == 0.5
    controller = LinearController.from_transfer_function([2.0, 1.0], [1.0, 0.0], dt=0.01)
    assert controller.step(math.nan, 4.0) == 0.0
    assert controller.step(5.0, 4.0) == pytest.approx(2.0, abs=0.1)


def test_an_overflow_starts_afresh() -> None:
    """U holds, the status says it."""
    controller = LinearController.from_transfer_function(
        [1e200, 0.0], [1.0, 1.0], dt=0.01, u_max=1.0, u_min=-1.0
    )
    controller.step(1.0, 0.0)
    assert controller.step(1e200, 0.0) == 1.0
    assert ql.Status.OVERFLOWED in controller.status
    assert np.all(np.isfinite(controller.state["x"]))


def test_rest_forgets_the_state() -> None:
    """A second half from rest repeats the first."""
    controller = Prefiltered(ql.baselines.PID(2.0, 1.0, dt=0.01), ql.baselines.ZV(3.0))
    run = ql.simulate(LAG, controller, ql.Scenario(reference=1.0, duration=6.0, rest_at=(3.0,)))
    np.testing.assert_allclose(run["y"][300:600], run["y"][:300], atol=1e-12)


def test_a_prefilter_starts_at_the_first_measurement() -> None:
    """A reference elsewhere is a step to it; none at all is passed on as none; a lost one is held."""
    shaped = Prefiltered(ql.baselines.PID(1.0, dt=0.1), ql.baselines.ZV(math.pi))  # parts 1 s apart
    assert shaped.step(math.nan, 2.0) == 0.0
    assert shaped.step(4.0, 2.0) == pytest.approx(1.0)
    assert shaped.step(math.nan, 2.0) == pytest.approx(1.0)
    assert shaped.status == ql.Status.REFERENCE_HELD
    rest = [shaped.step(4.0, 2.0) for _ in range(12)]
    assert rest[7] == pytest.approx(1.0)
    assert rest[8] == pytest.approx(2.0)


def test_a_prefilter_serves_adrc_with_a_learner() -> None:
    """Channels, coefficients and the estimate are ADRC's; a constant prefilter changes nothing."""
    adrc = ql.ADRC(ql.ESO.model_free(2, 2.0, 20.0, 0.01), 3.0, learner=ql.learners.NLMS())
    scenario = ql.Scenario(reference=ql.signals.Sinusoid(), duration=0.6)
    plain, shaped = (
        ql.simulate(LAG, c, scenario, interpret=True)
        for c in (adrc, Prefiltered(adrc, ql.baselines.Shaper((0.0,), (1.0,))))
    )
    np.testing.assert_array_equal(plain["u"], shaped["u"])
    np.testing.assert_array_equal(shaped["r_shaped"], shaped["r"])
    np.testing.assert_array_equal(plain["theta"], shaped["theta"])
    assert shaped.features == plain.features
    assert Prefiltered(adrc, ql.baselines.ZV(1.0)).read(shaped.final_state).u == plain["u"][-1]


def test_a_prefilter_keeps_what_a_python_learner_keeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """What lies outside of the arrays is in the state, by name, and comes back."""
    learner = ql.learners.PythonModel(LeastMeanSquares())
    shaped = Prefiltered(
        ql.ADRC(ql.ESO.model_free(2, 2.0, 20.0, 0.01), 3.0, learner=learner), ql.baselines.ZV(3.0)
    )
    outside = [name for name, value in shaped.state.items() if value.dtype == object]
    assert outside
    assert all(name.startswith("controller.learner.") for name in outside)
    recalled: list[object] = []
    monkeypatch.setattr(
        learner, "recall", lambda memory, snapshots: recalled.append(set(snapshots))
    )
    shaped.state = shaped.state
    assert recalled == [{name.removeprefix("controller.learner.") for name in outside}]


LAW = LinearLaw(np.eye(2), np.zeros(2), np.zeros(2), np.zeros(2), np.ones(2), 0.0, 0.0)
make = LinearController.from_transfer_function


@cases(
    ("wrong", "message"),
    [
        (
            lambda: LinearController("law", 0.1),
            "law = 'law': must be a quell.controllers.LinearLaw",
        ),
        (
            lambda: LinearController(LAW._replace(C=np.ones(3)), 0.1),
            r"law.C has shape \(3,\): must be a vector of 2",
        ),
        (
            lambda: LinearController(LAW._replace(D_y=math.nan), 0.1),
            "law.D_y = nan: must be a finite number",
        ),
        (lambda: LinearController(LAW, 0.0), "dt = 0.0: must be finite and greater than zero"),
        (lambda: LinearController(LAW, 0.1, u_min=1.0, u_max=0.0), "u_min = 1.0, u_max = 0.0"),
        (
            lambda: make([1.0, 0.0], [1.0], 0.1),
            "is of degree 1, den of degree 0: C.s. must be proper",
        ),
        (lambda: make([1.0], [0.0], 0.1), "den = .0.0.: must not be zero"),
        (
            lambda: make(3.0, dt=0.1),
            "num = 3.0: must be a polynomial, with den, or a control.TransferFunction",
        ),
        (
            lambda: make(control.tf([1.0], [1.0, 0.5], 0.1), dt=0.1),
            "transfer function has a sample time, dt = 0.1",
        ),
        (
            lambda: make([1.0], [1.0, 1.0], 0.1, method="euler"),
            "method = 'euler': must be one of tustin, zoh",
        ),
        (
            lambda: make([1.0], [1.0, 1.0], 0.1, method="zoh", prewarp=1.0),
            "prewarp = 1.0: goes with method = 'tustin' only",
        ),
        (
            lambda: make([1.0], [1.0, 1.0], 0.1, prewarp=40.0),
            "prewarp = 40.0 rad/s with dt = 0.1 s: must be below pi/dt",
        ),
        (
            lambda: make([1.0], [1.0, 1.0], 0.1, feedback="y"),
            "feedback = 'y': must be one of error, output",
        ),
        (
            lambda: make([1.0], [1.0, 0.0], 0.1, tracking_time=0.0),
            "tracking_time = 0.0: must be finite and greater than zero",
        ),
        (lambda: make([1.0], [1.0, 0.0]), "dt = None: must be a number"),
        (
            lambda: Prefiltered("pid", ql.baselines.ZV(1.0)),
            "controller = 'pid': must be a controller",
        ),
        (
            lambda: Prefiltered(
                ql.ADRC(ql.ESO.model_free(2, 1.0, 10.0, 0.01), 1.0, feedforward=True),
                ql.baselines.ZV(1.0),
            ),
            "controller has feedforward, and Shaper provides no derivatives",
        ),
        (
            lambda: Prefiltered(ql.baselines.PID(1.0, dt=0.1), 3),
            "prefilter = 3: must be a prefilter",
        ),
    ],
)
def test_a_mistake_is_named(wrong: object, message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        wrong()  # type: ignore[operator]
