"""b0, lag and delay from records of running loops: true within the stated deviation, or said to be unknown."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal
from scipy.linalg import expm

import quell as ql
from quell.controllers.baselines import PID
from quell.identification import InputGain, identify_b0, identify_b0_by
from quell.identification.bandwidth import Candidate, Reach, bandwidth, pid_of_margin
from quell.identification.input_gain import MarginError, seconds_text, white_where
from quell.identification.loop_search import mixture
from quell.identification.running_loop import Form, Inputs, linear_columns, placed, predicted

from .benchmark_module import benchmark
from .cases import cases
from .commands import Shown
from .python_step import interpreted

pytestmark = pytest.mark.compiled

DT = 0.01
T = np.arange(1500) * DT


def trial() -> Any:
    """Return the benchmark's module, which simulates loops apart from the package's models."""
    return benchmark("running_loop")


def in_python(loop: Any) -> Any:
    """Return the loop with a controller whose step is not compiled: a record has few samples."""
    return loop._replace(controller=interpreted(loop.controller))


def record(
    den: list[float],
    controller: Any,
    noise: float,
    load: float = 0.0,
    t: Any = T,
    **plant: float,
) -> tuple[Any, Any]:
    """Return u and y of a chirp in a loop, with a random walk as load."""
    rng = np.random.default_rng(5)
    given = {"b": 40.0, "lag": 0.0, "delay": 0.0} | plant
    loop = trial().Loop(np.array(den), **given, dt=DT, omega=0.0, controller=controller, text="")
    loop = in_python(loop)
    r = np.sin(0.1 * t + 0.15 * t**2)
    walk = load * np.cumsum(rng.standard_normal(t.size))
    none, wrong = np.zeros(t.size), noise * rng.standard_normal(t.size)
    u, y = trial().simulated(loop, r, none, wrong, walk)
    return u, y + wrong


def adrc(order: int = 2, b0: float = 25.0) -> Any:
    """Return an ADRC with a wrong b0."""
    return ql.ADRC(ql.ESO.model_free(order, b0, omega_o=20.0, dt=DT), omega_c=5.0)


@pytest.mark.trial
def test_without_noise_gain_lag_and_delay_are_exact() -> None:
    """Also a delay that is no whole number of samples, under an ADRC whose b0 is 1.6 times too small."""
    u, y = record([1.0, 2.0, 3.0], adrc(), 0.0, t=T[:1000], lag=0.03, delay=0.01375)
    found = identify_b0(u, y, DT, order=2)
    assert found.b0 == pytest.approx(40.0, rel=1e-4)
    assert found.den == pytest.approx([1.0, 2.0, 3.0], rel=1e-3)
    assert found.lag == pytest.approx(0.03, rel=1e-3)
    assert found.delay == pytest.approx(0.01375, rel=2e-3)


@pytest.mark.trial
def test_a_load_does_not_bias_the_gain() -> None:
    """A drifting load in the loop: the output error is wrong by far more than the stated deviation, this is not."""
    u, y = record([1.0, 2.0, 0.0], adrc(), 2e-3, load=1e-3, delay=0.02)
    found = identify_b0(u, y, DT, order=2)
    assert abs(found.b0 - 40.0) < 3.0 * found.b0_std < 4.0
    assert found.delay + found.lag == pytest.approx(0.02, abs=4.0 * found.total_delay_std)
    biased = ql.identify(u, y, DT, order=2, delay=0.02, held_out=0.0)
    assert abs(biased.num[0] - 40.0) > 5.0 * found.b0_std


@pytest.mark.trial
def test_an_unstable_plant_is_found_in_its_loop_under_any_controller() -> None:
    """A pendulum that falls with 3 rad/s under a PID, which the function does not know."""
    pid = PID(kp=1.2, ki=1.0, kd=0.15, tf=0.02, dt=DT)
    u, y = record([1.0, 0.0, -9.0], pid, 1e-3, load=1e-4)
    found = identify_b0(u, y, DT, order=2)
    assert found.b0 == pytest.approx(40.0, abs=4.0 * found.b0_std)
    assert found.b0_std < 1.0
    assert max(np.roots(found.den).real) == pytest.approx(3.0, rel=0.1)


def unstable_record(pole: float, dt: float, samples: int, **plant: float) -> tuple[Any, Any]:
    """Return u and y of ``y'' = pole² y − 30 u`` under an ADRC, with steps as reference."""
    rng = np.random.default_rng(3)
    controller = ql.ADRC(ql.ESO.model_free(2, -30.0, 6.0 * pole, dt), omega_c=1.5 * pole)
    given = {"lag": 0.0, "delay": 0.0} | plant
    den = np.array([1.0, 0.0, -(pole**2)])
    loop = trial().Loop(den, -30.0, dt=dt, omega=0.0, controller=controller, text="", **given)
    r, none = np.repeat(rng.uniform(-1.0, 1.0, samples // 50), 50), np.zeros(samples)
    noise = 1e-3 * rng.standard_normal(samples)
    u, y = trial().simulated(in_python(loop), r, none, noise, none)
    return u, y + noise


@pytest.mark.trial
@pytest.mark.filterwarnings("ignore::quell.DesignWarning")
@pytest.mark.parametrize(
    ("pole", "dt", "samples", "plant"),
    [
        (38.7, 0.005, 4000, {}),
        (38.7, 0.001, 2000, {"delay": 0.001}),
        (3.0, 0.005, 2000, {"lag": 0.01}),
        (0.5, 0.005, 2000, {"delay": 0.005}),
    ],
)
def test_the_gain_of_an_unstable_plant_is_found_and_nothing_else_is_printed(
    pole: float, dt: float, samples: int, plant: dict[str, float], capfd: Any
) -> None:
    """exp(38.7 × 20 s) is no number: a simulated unstable plant ended in LAPACK's complaints."""
    u, y = unstable_record(pole, dt, samples, **plant)
    found = identify_b0(u, y, dt, order=2)
    assert abs(found.b0 + 30.0) < 3.0 * found.b0_std < 0.6
    assert max(np.roots(found.den).real) == pytest.approx(pole, rel=0.05)
    assert found.shortcomings == ()
    assert "LAPACK" not in str(shown := capfd.readouterr())
    assert "DLASCL" not in str(shown)


def test_the_predictor_of_an_unstable_plant_without_loads_is_the_stationary_kalman_filter() -> None:
    """Its gains equal those of the Riccati equation for noise in y alone, which scipy solves."""
    from scipy.linalg import solve_discrete_are

    form, rng = Form(2, False, False, False), np.random.default_rng(1)
    a, y = np.array([-0.02, 0.05]), rng.standard_normal(2000)
    A = np.array([[-0.05, 1.0], [0.02, 0.0]])  # observable form
    phi = expm(A)
    C = np.array([[1.0, 0.0]])
    P = solve_discrete_are(phi.T, C.T, 1e-14 * np.eye(2), np.eye(1))
    K = (phi @ P @ C.T / (1.0 + C @ P @ C.T))[:, 0]
    x, by_hand = np.zeros(2), []
    for value in y:
        by_hand.append(x[0])
        x = phi @ x + K * (value - x[0])
    found = predicted(form, [a], np.zeros(4), Inputs.of(0.0 * y, y), y)[:, 0]
    assert found == pytest.approx(by_hand, abs=1e-6)


@pytest.mark.trial
def test_u_before_the_record_does_not_matter() -> None:
    """A record that begins in motion: the u that still acts in its first samples is not in it."""
    u, y = record([1.0, 2.0, 3.0], adrc(), 0.0, delay=0.04375)
    found = identify_b0(u[700:], y[700:], DT, order=2)
    assert found.b0 == pytest.approx(40.0, rel=1e-4)
    assert found.delay == pytest.approx(0.04375, rel=2e-3)


@pytest.mark.trial
def test_a_delay_beyond_those_that_the_search_starts_at_is_found() -> None:
    """A lag of 2 s behind 25 and 40 samples of delay: no other form, and a PI stands beside."""
    rng, dt, held = np.random.default_rng(0), 0.05, math.exp(-0.025)
    for late in (25, 40):
        u, y, before, x = np.zeros(2500), np.zeros(2500), [0.0] * late, 0.0
        r = np.repeat(rng.uniform(-1.0, 1.0, 25), 100)
        for k in range(u.size):
            y[k] = x + 1e-3 * rng.standard_normal()
            u[k] = 0.2 * (r[k] - y[k]) + 0.3 * r[k] + 0.05 * rng.standard_normal()
            before.append(u[k])
            x = held * x + 2.0 * (1.0 - held) * before.pop(0)
        found = identify_b0(u, y, dt, order=1)
        assert found.b0 == pytest.approx(1.0, rel=0.01)
        assert found.delay == pytest.approx(late * dt, rel=0.01)
        assert found.shortcomings == ()
        beside = found.beside(found.omega_c())
        assert beside is not None
        assert beside.name == "PI"


def test_what_a_record_does_not_determine_is_said() -> None:
    """One sine and no noise: two numbers, which any b0 of a plant of order 2 can explain."""
    found = identify_b0(np.sin(5.0 * T), np.sin(5.0 * T + 1.0), DT, order=2)
    assert found.is_poor
    assert found.shortcomings[0].startswith("the excitation is too poor")


def test_poor_excitation_is_said() -> None:
    """A loop that only holds its place in noise tells nothing of b0; the report and omega_c say so."""
    slow = ql.ADRC(ql.ESO.model_free(2, 25.0, omega_o=1.0, dt=DT), omega_c=0.25)
    loop = trial().Loop(np.array([1.0, 2.0, 0.0]), 40.0, 0.0, 0.02, DT, 0.0, interpreted(slow), "")
    rng = np.random.default_rng(7)
    noise, none = 1e-3 * rng.standard_normal(600), np.zeros(600)
    u, y = trial().simulated(loop, none, none, noise, none)
    found = identify_b0(u, y + noise, DT, order=2)
    assert found.is_poor
    assert "the excitation is too poor" in str(found)


@pytest.mark.trial
def test_a_u_that_is_not_recorded_is_asked_for() -> None:
    """Noise in the place of u says nothing of b0."""
    u, y = record([1.0, 2.0, 0.0], adrc(), 1e-4)
    rng = np.random.default_rng(4)
    found = identify_b0(1e-9 * rng.standard_normal(u.size), y, DT, order=2)
    assert found.is_poor
    assert "is it u that was recorded?" in found.shortcomings[0]


@pytest.mark.trial
@pytest.mark.parametrize("seed", [1, 5])
def test_the_interval_holds_the_gain_in_draws_of_the_trial(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two draws of benchmarks/running_loop.py at 30 dB, ADRC moved by r and PID by u; 200 of them are its table."""
    drawn_loop = trial().drawn_loop
    monkeypatch.setattr(trial(), "drawn_loop", lambda rng: in_python(drawn_loop(rng)))
    loop, u, y, _ = trial().drawn_record(seed, 30.0)
    found = identify_b0(u, y, loop.dt, loop.den.size - 1)
    assert found.b0 == pytest.approx(loop.b, rel=0.05)
    assert found.interval[0] < loop.b < found.interval[1]


def test_the_predictor_is_the_observer_written_out() -> None:
    """ŷ equals the recursion of x by hand, and is linear in b and the initial state."""
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((2, 50))
    form = Form(1, False, True, True)
    a, T, b, x = 0.3, 1.25, 0.7, np.array([0.2, -0.1])
    phi = np.append(placed(np.array([a]), 0.4), T)
    beta = np.append(b, x)
    late = np.concatenate([np.full(2, u[0]), u])
    phi_xx, gain, by_hand = np.exp(-a), lambda t: (1.0 - np.exp(-a * t)) / a, []
    l1, l2 = phi[1:3]
    K = np.array([l1 * gain(1.0) + l2 * (1.0 - gain(1.0)) / a, l2])
    for k in range(u.size):
        by_hand.append(x[0])
        arrived = late[k + 1] * gain(0.75) + late[k] * (gain(1.0) - gain(0.75))
        e = y[k] - x[0]
        x = np.array([phi_xx * x[0] + gain(1.0) * x[1] + b * arrived, x[1]]) + K * e
    assert predicted(form, [phi], beta, Inputs.of(u, y), y)[:, 0] == pytest.approx(
        by_hand, abs=1e-12
    )
    columns, of_y = linear_columns(form, phi, Inputs.of(u, y), y)
    assert columns @ beta + of_y == pytest.approx(by_hand, abs=1e-12)


def test_the_bandwidth_keeps_the_phase_margin_and_no_larger_one_does() -> None:
    """The loop at the result has 60 degrees, to rounding, in ``analyse``; 2 % faster it has less."""
    den = np.array([1.0, 2.0, 0.0])
    loops = Candidate(40.0, den, 0.02, 0.013, b0=40.0, dt=DT)
    omega_c = bandwidth(loops, 60.0, 5.0).omega_c
    margins = [
        ql.analysis.analyse(
            ([40.0], den),
            ql.ADRC(ql.ESO.model_free(2, 40.0, 5.0 * each, DT), each),
            delay=0.013,
            actuator_lag=0.02,
        ).margins.phase
        for each in (omega_c, 1.02 * omega_c)
    ]
    assert margins[0] == pytest.approx(60.0, abs=0.02)
    assert margins[1] < 59.95


@pytest.mark.trial
@pytest.mark.parametrize("kind", ["unstable", "integrating", "resonant", "negative"])
def test_the_interval_holds_the_gain_of_plants_of_each_kind(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A draw of ``benchmarks/running_loop.py --plants`` each; 200 of them are its table."""
    drawn = trial().drawn_special
    monkeypatch.setattr(trial(), "drawn_special", lambda *how: in_python(drawn(*how)))
    loop, u, y, _ = trial().drawn_special_record(11, kind, (1, 2))
    found = identify_b0(u, y, loop.dt, loop.den.size - 1)
    assert found.b0 == pytest.approx(loop.b, rel=0.05)
    assert abs(found.b0 - loop.b) < 3.0 * found.b0_std


def result(b0: float, den: list[float], delay: float, dt: float) -> InputGain:
    """Return a result without a lag, whose b0 alone has a deviation, of 1 %."""
    n = len(den) - 1
    covariance = np.zeros((n + 3, n + 3))
    covariance[n, n] = (0.01 * b0) ** 2
    numbers = {"lag": 0.0, "lag_std": 0.0, "delay": delay, "delay_std": 0.0}
    return InputGain(
        **{"order": n, "b0": b0, "b0_std": 0.01 * abs(b0), "den": np.array(den), **numbers},
        **{"total_delay": delay, "total_delay_std": 0.0, "dt": dt, "samples": 1000, "noise": 0.0},
        **{"omega_max": 1.0, "white": True, "independent": True, "converged": True},
        covariance=covariance,
    )


def phase_of(found: InputGain, omega_c: float, ratio: float) -> float:
    """Return the phase margin of the loop at a bandwidth [degrees]; zero for an unstable one."""
    observer = ql.ESO.model_free(found.order, found.b0, ratio * omega_c, found.dt)
    plant, controller = ([found.b0], found.den), ql.ADRC(observer, omega_c)
    return ql.analysis.analyse(plant, controller, delay=found.delay).margins.phase


@pytest.mark.trial
def test_the_ratio_is_chosen_where_the_usual_one_cannot_keep_the_margin() -> None:
    """An inertia with a delay of 1 ms has 41° with omega_o = 5 omega_c, however slow the loop."""
    inertia = result(30.0, [1.0, 0.0, 0.0], 0.001, 0.001)
    omega_c, std, ratio = inertia.omega_c(60.0)
    assert phase_of(inertia, omega_c, ratio) == pytest.approx(60.0, abs=0.01)
    assert 30.0 <= ratio <= 100.0
    assert 0.0 < std < 0.2 * omega_c
    with pytest.raises(MarginError, match=r"the best is 41\.2°.*; omega_o = .* keeps it") as caught:
        inertia.omega_c(60.0, ratio=5.0)
    assert caught.value.phase_margin == pytest.approx(41.2, abs=0.1)


@pytest.mark.trial
def test_the_range_of_an_unstable_plant_is_found_between_its_ends() -> None:
    """A slower loop than the pole is unstable, a faster one than the delay allows, too."""
    found = result(-30.0, [1.0, 0.0, -9.0], 0.002, 0.001)
    omega_c, _, ratio = found.omega_c(45.0)
    assert phase_of(found, omega_c, ratio) == pytest.approx(45.0, abs=0.01)
    assert phase_of(found, 0.05 * omega_c, ratio) == 0.0
    assert phase_of(found, 1.02 * omega_c, ratio) < 45.0


@pytest.mark.trial
def test_a_plant_that_no_adrc_stabilises_has_no_bandwidth() -> None:
    """A pole of 38.7 rad/s behind a delay of 100 ms: the error says that no loop is stable."""
    found = result(-30.0, [1.0, 0.0, -(38.7**2)], 0.1, 0.005)
    with pytest.raises(MarginError, match="is stable; ask for less") as caught:
        found.omega_c()
    assert caught.value.phase_margin is None


def servo_record(inertias: list[float], stiffnesses: list[float]) -> tuple[Any, Any]:
    """Return torque and angle of a servo with a 20 bit encoder at the motor: a PRBS of 4000 samples of 0.25 ms."""
    count, size = 2.0**20, len(inertias)
    M, K = np.diag(inertias), np.zeros((size, size))
    for i, k in enumerate(stiffnesses):
        K[i : i + 2, i : i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    A = np.zeros((2 * size, 2 * size))
    A[:size, size:] = np.eye(size)
    A[size:] = -np.linalg.solve(M, np.hstack([K, 5e-5 * K]))
    B = np.zeros((2 * size, 1))
    B[size] = 1.0 / inertias[0]
    u = np.repeat(np.random.default_rng(3).choice([-0.05, 0.05], 500), 8)
    C, D = np.eye(2 * size)[:1], np.zeros((1, 1))
    _, y, _ = signal.dlsim(signal.cont2discrete((A, B, C, D), 2.5e-4), u)
    return u, np.round(y[:, 0] / (2.0 * np.pi) * count) * 2.0 * np.pi / count


@pytest.mark.trial
def test_where_the_record_rejects_the_form_no_interval_and_no_bandwidth_is_given(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """A servo with a flexible coupling at 178 Hz: b0 of order 2 is neither that of the motor nor of both; a stiff one has both."""
    u, y = servo_record([1.2e-4, 0.8e-4], [60.0])
    found = identify_b0(u, y, 2.5e-4, order=2)
    assert found.rejected
    with pytest.raises(MarginError, match="omega_c not computed.*resonance.*quell identify"):
        found.omega_c()
    report = str(found)
    assert "95 %" not in report
    assert "which the record rejects" in report
    assert found.to_json()["interval_95"] is None
    rows = np.column_stack([np.arange(u.size) * 2.5e-4, u, y])
    np.savetxt(tmp_path / "servo.csv", rows, delimiter=",", header="t,u,y", comments="")
    shown = quell("b0", "servo.csv", "--order", "2", "--json", "servo.json")
    assert "NOT: omega_c not computed" in shown.out
    assert "keeps" not in shown.out
    assert json.loads((tmp_path / "servo.json").read_text())["omega_c"] is None
    stiff = identify_b0(*servo_record([2e-4], []), 2.5e-4, order=2)
    assert not stiff.rejected
    assert stiff.b0 == pytest.approx(5000.0, rel=1e-3)
    assert "95 %" in str(stiff)


def test_rounding_at_rest_does_not_reject_the_form() -> None:
    """The error of a rounded y at rest is not white; that in motion is, and an error that is none in motion is found."""
    rng = np.random.default_rng(4)
    error = rng.standard_normal(3000)
    error[1500:] = np.repeat(rng.standard_normal(150), 10)
    moving = np.arange(3000) < 1500
    assert white_where(error, moving, 50)
    assert not white_where(error, ~moving, 50)
    assert not white_where(error, np.arange(3000) < 100, 50)  # too few samples to tell


@pytest.mark.parametrize("change", ["independent", "converged", "white_in_motion"])
def test_each_reason_to_reject_the_form_refuses_a_bandwidth(change: str) -> None:
    """The error depends on u, the search did not converge, or the error is not white."""
    found = result(30.0, [1.0, 0.0, 0.0], 0.001, 0.001)
    assert found.refusal == ""
    assert replace(found, **{change: False}).refusal.startswith("omega_c not computed")
    blind = replace(found, omega_max=0.0)
    assert "at no frequency" in blind.refusal
    assert "up to 0 rad/s" not in str(blind)


def test_a_wrong_phase_margin_is_refused_before_the_search(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """Nothing else is printed: the record need not even be searched."""
    rows = np.column_stack([T, np.sin(T), np.cos(T)])
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header="t,u,y", comments="")
    shown = quell("b0", "run.csv", "--order", "1", "--phase-margin", "95")
    assert shown.code == 2
    assert "phase_margin = 95.0: must be below 90 degrees" in shown.err
    assert shown.out == ""


def test_a_time_has_one_unit_for_value_and_deviation() -> None:
    """A dead time of an oven in s, that of a servo in ms; the digits are those that the deviation leaves."""
    assert seconds_text(19.968, 0.0543) == "19.968 ± 0.054 s"
    assert seconds_text(1.0, 0.1) == "1 ± 0.1 s"
    assert seconds_text(0.999, 0.1) == "999 ± 1e+02 ms"
    assert seconds_text(0.0123456, 0.0012) == "12.35 ± 1.2 ms"


@cases(
    ("change", "message"),
    [
        ({"y": 1e200 * np.cos(T)}, "y has values up to 1e\\+200"),
        ({"order": 5}, "order = 5"),
        ({"dt": 0.0}, "dt = 0.0"),
        ({"u": np.zeros(1500)}, "u is 0 all through: must move"),
        ({"u": np.ones(20), "y": np.ones(20)}, "must have at least"),
        ({"max_delay": 10.0}, "max_delay = 10.0 s: must be at most a quarter"),
    ],
)
def test_a_wrong_argument_is_named(change: dict[str, Any], message: str) -> None:
    """Each error names the argument, its value and the rule."""
    arguments: dict[str, Any] = {"u": np.sin(T), "y": np.cos(T), "dt": DT, "order": 1} | change
    with pytest.raises(ValueError, match=message):
        identify_b0(**arguments)


@pytest.mark.trial
def test_the_command_reads_a_saved_run_and_the_setup_of_its_loop(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """``quell b0 run.nc --loop setup.toml``: order and ratio of the loop, b/b0, omega_c, and JSON."""
    setup = tmp_path / "loop.toml"
    setup.write_text(
        f"dt = {DT}\ncontroller = {{omega_c = 5.0}}\n"
        "observer = {kind = 'model-free', order = 1, b0 = 25.0, omega_o = 20.0}\n"
    )
    plant = ql.plants.LinearPlant.of(([40.0], [1.0, 2.0]))
    reference = ql.identification.excitation("chirp", (0.5, 8.0), 6.0, DT, -1.0, 1.0).signal
    scenario = ql.Scenario(reference=reference, duration=6.0)
    run = ql.simulate(plant, adrc(order=1), scenario, interpret=True)
    run.save(tmp_path / "run.nc")
    shown = quell("b0", "run.nc", "--loop", "loop.toml", "--json", "out.json")
    assert shown.code == 0, shown.err
    assert "the loop ran with b0 = 25: b/b0 = 1.6" in shown.out
    assert "keeps 60° of phase margin with omega_o = 4 omega_c" in shown.out
    told = json.loads((tmp_path / "out.json").read_text())
    assert told["b0"] == pytest.approx(40.0, rel=1e-3)
    assert told["omega_c"] > 0.0
    refused = quell("b0", "run.nc")
    assert refused.code == 2
    assert "order: missing; give --order, or with --loop" in refused.err


@pytest.mark.trial
def test_the_command_succeeds_where_no_bandwidth_keeps_the_margin(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """A double integrator with omega_o = 5 omega_c: a line with NOT, null in JSON; without the ratio there is one."""
    u, y = record([1.0, 0.0, 0.0], adrc(), 1e-3, t=T[:800])
    rows = np.column_stack([T[:800], u, y])
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header="t,u,y", comments="")
    shown = quell("b0", "run.csv", "--order", "2", "--ratio", "5", "--json", "5.json")
    assert shown.code == 0, shown.err
    assert "NOT: no omega_c keeps 60° of phase margin with an omega_o of 5 omega_c" in shown.out
    told = json.loads((tmp_path / "5.json").read_text())
    assert told["omega_c"] is None
    assert told["best_phase_margin"] == pytest.approx(41.2, abs=1.0)
    shown = quell("b0", "run.csv", "--order", "2", "--json", "free.json")
    told = json.loads((tmp_path / "free.json").read_text())
    assert f"omega_o = {told['ratio']:.3g} omega_c" in shown.out
    assert told["ratio"] > 20.0
    assert told["omega_c"] > 0.0


@pytest.mark.trial
def test_b0_by_a_signal_is_that_of_each_bin(tmp_path: Path) -> None:
    """On a loop whose gain changes with a signal; a bin without samples is NOT known, and says what to do."""
    t = np.arange(6000) * 0.01
    speed = np.where(t < 20.0, 0.0, np.where(t < 40.0, 1.0, 3.0))
    gain = np.where(t < 20.0, 4.0, np.where(t < 40.0, 2.0, 1.0))
    observer = ql.ESO.model_free(order=1, b0=2.0, omega_o=20.0, dt=0.01)
    controller, y, u = ql.ADRC(observer, omega_c=4.0), np.zeros(t.size), np.zeros(t.size)
    noise = 1e-3 * np.random.default_rng(5).standard_normal(t.size)
    for k in range(t.size - 1):
        u[k] = controller.step(math.sin(0.2 * (t[k] % 20.0) ** 1.7), y[k] + noise[k])
        y[k + 1] = y[k] + 0.01 * (gain[k] * u[k] + 0.3)
    found = identify_b0_by(u, y + noise, speed, 0.01, 1, bins=3)
    assert [each.is_known for each in found] == [True, True, True]
    for each, true in zip(found, (4.0, 2.0, 1.0), strict=True):
        low, high = each.interval
        assert low < true < high
        assert high - low < 0.3 * true
    wide = identify_b0_by(u[:2500], y[:2500], speed[:2500], 0.01, 1, bins=(-0.5, 0.5, 0.8, 2.0))
    assert not wide[1].is_known
    assert str(wide[1]).startswith("NOT known at 0.5 … 0.8")
    for bins, rule in (((1.0, 0.0), "increasing"), (0, "bins")):
        with pytest.raises(ValueError, match=rule):
            identify_b0_by(u, y, speed, 0.01, 1, bins=bins)
    with pytest.raises(ValueError, match="nothing to divide"):
        identify_b0_by(u, y, np.ones(u.size), 0.01, 1)


def test_the_deviation_of_a_mixture_has_the_spread_of_its_means() -> None:
    """The closed form: the mean of the variances, and the variance of the means."""
    mean, std = mixture([(0.0, 1.0), (2.0, 3.0)], np.array([0.75, 0.25]))
    assert mean == 0.5
    assert std**2 == pytest.approx((0.75 * 1.0 + 0.25 * 9.0) + 0.75 * 0.25 * 2.0**2)


@pytest.mark.parametrize(
    ("lag", "delay", "share", "expected"),
    [
        (True, True, None, (3.0, 5.0)),
        (True, False, None, (3.0, 0.0)),
        (False, True, None, (0.0, 3.0)),
        (False, False, None, (0.0, 0.0)),
        (True, True, 0.25, (0.75, 2.25)),
    ],
)
def test_what_a_model_does_not_have_is_zero(
    lag: bool, delay: bool, share: float | None, expected: tuple[float, float]
) -> None:
    """Lag and delay, of their places in the parameters; a share divides their sum."""
    form = Form(2, lag, delay, False, share=share)
    phi = np.concatenate([np.full(form.times.start, 7.0), [3.0, 5.0]])[: form.size]
    assert (form.lag_of(phi), form.delay_of(phi)) == expected


@pytest.mark.parametrize(("order", "late"), [(1, 0.0), (1, 0.05), (2, 0.02)])
def test_a_pi_or_pid_of_the_same_margin_stands_beside_omega_c(order: int, late: float) -> None:
    """Its margin is that of the sampled loop, and no other crossover has a larger k_i."""
    dt, den = 0.01, np.array([1.0, 0.5] + [0.0] * (order - 1))
    loops = Candidate(-3.0, den, 0.0, late, b0=-3.0, dt=dt)
    found = pid_of_margin(loops, 60.0, Reach(2.0, 10.0, 60.0, True))
    assert found is not None
    assert found.name == ("PI" if order == 1 else "PID")
    assert found.phase == pytest.approx(60.0, abs=0.6)
    assert found.kp < 0.0
    pid = PID(found.kp, found.ki, found.kd, tf=found.tf, dt=dt)
    loop = ql.analysis.analyse(([-3.0], den), pid, delay=late)
    assert loop.margins.phase == pytest.approx(found.phase, rel=1e-9)
    adrc = loops.loop(2.0, 10.0)
    k_adrc = abs(adrc.response("C_y", np.array([1e-4]))[0]) * 1e-4
    assert found.over_adrc == pytest.approx(abs(found.ki) / k_adrc, rel=1e-3)


def test_a_pi_stands_beside_an_order_of_two_where_samples_leave_no_place_for_a_pid() -> None:
    """The filter of the PID would be faster than half a sample."""
    loops = Candidate(2.0, np.array([1.0, 3.0, 1.0]), 0.0, 0.2, b0=2.0, dt=0.2)
    found = pid_of_margin(loops, 60.0, Reach(0.8, 3.0, 60.0, True))
    assert found is not None
    assert found.name == "PI"
    assert found.phase == pytest.approx(60.0, abs=0.6)


def test_no_simple_controller_stands_beside_a_third_order() -> None:
    """It has no phase for three integrators."""
    loops = Candidate(1.0, np.array([1.0, 0.0, 0.0, 0.0]), 0.0, 0.0, b0=1.0, dt=0.01)
    assert pid_of_margin(loops, 60.0, Reach(1.0, 30.0, 60.0, True)) is None
