"""b0, lag and delay from records of running loops: true within the stated deviation, or said to be unknown."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.baselines import PID
from quell.identification import identify_b0
from quell.identification.running_loop.bandwidth import RATIOS, Candidate, bandwidth
from quell.identification.running_loop.model import Form, linear_columns, placed, predicted

from .benchmark_module import benchmark
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


def test_without_noise_gain_lag_and_delay_are_exact() -> None:
    """Also a delay that is no whole number of samples, under an ADRC whose b0 is 1.6 times too small."""
    u, y = record([1.0, 2.0, 3.0], adrc(), 0.0, t=T[:1000], lag=0.03, delay=0.01375)
    found = identify_b0(u, y, DT, order=2)
    assert found.b0 == pytest.approx(40.0, rel=1e-4)
    assert found.den == pytest.approx([1.0, 2.0, 3.0], rel=1e-3)
    assert found.lag == pytest.approx(0.03, rel=1e-3)
    assert found.delay == pytest.approx(0.01375, rel=2e-3)


def test_a_load_does_not_bias_the_gain() -> None:
    """A drifting load in the loop: the output error is wrong by far more than the stated deviation, this is not."""
    u, y = record([1.0, 2.0, 0.0], adrc(), 2e-3, load=1e-3, delay=0.02)
    found = identify_b0(u, y, DT, order=2)
    assert abs(found.b0 - 40.0) < 3.0 * found.b0_std < 4.0
    assert found.delay + found.lag == pytest.approx(0.02, abs=4.0 * found.total_delay_std)
    biased = ql.identify(u, y, DT, order=2, delay=0.02, held_out=0.0)
    assert abs(biased.num[0] - 40.0) > 5.0 * found.b0_std


def test_an_unstable_plant_is_found_in_its_loop_under_any_controller() -> None:
    """A pendulum that falls with 3 rad/s under a PID, which the function does not know."""
    pid = PID(kp=1.2, ki=1.0, kd=0.15, tf=0.02, dt=DT)
    u, y = record([1.0, 0.0, -9.0], pid, 1e-3, load=1e-4)
    found = identify_b0(u, y, DT, order=2)
    assert found.b0 == pytest.approx(40.0, abs=4.0 * found.b0_std)
    assert found.b0_std < 1.0
    assert max(np.roots(found.den).real) == pytest.approx(3.0, rel=0.1)


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
    assert predicted(form, [phi], beta, u, y)[:, 0] == pytest.approx(by_hand, abs=1e-12)
    columns, of_y = linear_columns(form, phi, u, y)
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


@pytest.mark.parametrize(
    ("change", "message"),
    [
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
