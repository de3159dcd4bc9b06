"""Identification: exact where it must be, good where there is noise, friction or a loop, and plain about what it can not do."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy import signal

import quell as ql
from quell.cli.app import app
from quell.identification import Identified, excitation, excited, frequency_response, read_record
from quell.identification.model import Structure, output, output_gradient, poles_of, root_covariance
from quell.identification.output_error import refine
from quell.quantities import Signals

from .cases import cases
from .commands import Shown

pytestmark = pytest.mark.compiled

DT = 2e-3
TESTBED = ([4.6e4], [1.0, 1.901, 1683.0, 1812.0, 0.1032])
QUANTUM = 2.0 * np.pi / 16_000


def answer(plant: Any, u: np.ndarray, dt: float, quantum: float = 0.0) -> np.ndarray:
    """Return the output of a linear plant to held inputs, from rest, by its exact sampled matrices."""
    model = ql.plants.LinearPlant.of(plant).sampled(dt)
    x, y = np.zeros(model.input.size), np.empty(u.size)
    for k, value in enumerate(u.tolist()):
        y[k] = model.output @ x
        x = model.transition @ x + model.input * value
    return np.round(y / quantum) * quantum if quantum else y


@cache
def twin_record(
    band: tuple[float, float], amplitude: float, offset: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return u and y of the twin with all its friction and quantisation, driven open loop by a PRBS for 60 s at 500 Hz."""
    record = excited(
        ql.plants.torsional(),
        excitation("prbs", band, 60.0, DT, offset - amplitude, offset + amplitude),
    )
    return record.u, record.y


@cache
def found_twin(band: tuple[float, float], amplitude: float) -> Identified:
    """Return the model of such a record, with friction."""
    return ql.identify(*twin_record(band, amplitude), DT, friction=True)


@cache
def twin_loop() -> tuple[np.ndarray, np.ndarray]:
    """Return u and y of the twin in a loop with an ADRC that knows no model, its reference a multisine within ±3 rad."""
    reference = excitation("multisine", (0.3, 40.0), 60.0, DT, -3.0, 3.0).signal
    observer = ql.ESO.model_free(order=4, b0=5.5e4, omega_o=90.0, dt=DT)
    controller = ql.ADRC(observer, omega_c=20.0, u_min=-5.0, u_max=5.0)
    run = ql.simulate(
        ql.plants.torsional(), controller, ql.Scenario(reference=reference, duration=60.0)
    )
    return run["u"], run["y_measured"]


def off(found: Identified) -> np.ndarray:
    """Return how far each pole is from the twin's that is nearest, as a share of that; from s = 0 in rad/s."""
    truth = np.linalg.eigvals(ql.plants.torsional().linear.A)
    poles = np.array([root.value for root in found.poles])
    assert poles.size == truth.size
    nearest = np.array([poles[np.argmin(np.abs(poles - p))] for p in truth])
    return np.abs(nearest - truth) / np.where(np.abs(truth) > 1e-6, np.abs(truth), 1.0)


@pytest.mark.trial
@cases(
    ("plant", "order", "zeros"),
    [
        (([3.0], [1.0, 2.0]), 1, 0),
        (([2.0], [1.0, 0.6, 9.0]), 2, 0),
        (([0.5, 3.0], [1.0, 1.0, 4.0]), 2, 1),
        (([50.0], [1.0, 22.0, 40.0, 0.0]), 3, 0),
        (([1.0, 0.4, 30.0], [1.0, 1.2, 40.0, 20.0, 100.0]), 4, 2),
    ],
    ids=["order 1", "resonance", "zero", "integrator", "two resonances and zeros"],
)
def test_without_noise_the_coefficients_are_exact(plant: Any, order: int, zeros: int) -> None:
    """To seven digits, whatever the start; nothing is told of the integrator."""
    u = excitation("prbs", (0.2, 30.0), 60.0, 0.01).u
    found = ql.identify(u, answer(plant, u, 0.01), 0.01, order=order, zeros=zeros)
    np.testing.assert_allclose(found.num, plant[0], rtol=1e-6)
    np.testing.assert_allclose(found.den, plant[1], rtol=1e-6, atol=1e-6)
    assert found.fits["held out"] > 99.9999
    assert found.converged
    assert found.integrators == int(plant[1][-1] == 0.0)


def test_the_testbed_is_found_through_its_encoder() -> None:
    """The paper's plant with 16000 counts a turn: what is left is the rounding of the encoder and passes for white."""
    u = excitation("prbs", (0.2, 60.0), 60.0, DT, -1.0, 1.0).u
    found = ql.identify(u, answer(TESTBED, u, DT, QUANTUM), DT, integrators=0)
    poles = np.array([root.value for root in found.poles])
    truth = np.roots(TESTBED[1])
    for p in truth:
        assert np.min(np.abs(poles - p)) < 1e-4 * abs(p) + 1e-6
    assert found.residuals.rms == pytest.approx(QUANTUM / np.sqrt(12.0), rel=0.05)
    assert found.residuals.white
    assert found.residuals.independent
    assert found.resolution == pytest.approx(QUANTUM, rel=1e-6)


@pytest.mark.trial
@pytest.mark.parametrize(("band", "amplitude"), [((0.2, 20.0), 2.0), ((0.2, 60.0), 5.0)])
def test_the_twin_is_found_with_its_friction(band: tuple[float, float], amplitude: float) -> None:
    """Open loop, all friction and quantisation: held-out fit ≥ 99.9 %, poles within 0.5 %, friction within 3 %."""
    found = found_twin(band, amplitude)
    assert found.fits["held out"] > 99.9
    assert np.max(off(found)) < 5e-3
    assert found.integrators == 1
    gain = 3.0 * 0.09617 * 2.0
    assert found.friction == pytest.approx((0.01 + 0.001) / gain, rel=0.03)


@pytest.mark.trial
def test_the_twin_is_found_in_a_closed_loop() -> None:
    """With an ADRC around it, and friction: held-out fit ≥ 99 %, poles within 2 %."""
    found = ql.identify(*twin_loop(), DT, friction=True)
    assert found.fits["held out"] > 99.0
    assert np.max(off(found)) < 2e-2


@pytest.mark.trial
def test_where_it_never_turns_back_friction_is_a_constant_force() -> None:
    """A positive u: the linear plant is exact to 1e-4 without any model of friction, and the friction is the bias."""
    found = ql.identify(*twin_record((0.3, 60.0), 1.0, 1.5), DT)
    assert np.max(off(found)) < 1e-4
    assert found.fits["held out"] > 99.999
    assert -found.bias == pytest.approx((0.01 + 0.001) / (3.0 * 0.09617 * 2.0), rel=0.02)


@pytest.mark.trial
def test_without_a_model_of_friction_the_slow_pole_is_wrong() -> None:
    """Coulomb friction is taken for viscous friction: 3 % and more, where with it there is a thousandth."""
    record = twin_record((0.2, 20.0), 2.0)
    assert np.max(off(ql.identify(*record, DT, integrators=1))) > 0.02
    assert np.max(off(found_twin((0.2, 20.0), 2.0))) < 2e-3


@pytest.mark.trial
def test_friction_of_a_single_inertia_is_found() -> None:
    """Order 2: mass, viscous and Coulomb friction, which sticks; from a simulation of small steps."""
    dt, fine = 0.01, 50
    u = excitation("multisine", (0.5, 10.0), 40.0, dt, -1.0, 1.0).u
    y, position, speed = np.empty(u.size), 0.0, 0.0
    for k, force in enumerate(u.tolist()):
        y[k] = position
        for _ in range(fine):
            after = speed + dt / fine * (5.0 * force - 0.8 * speed)
            # friction of 1.0, which stops what it can
            speed = after - min(max(after, -dt / fine), dt / fine)
            position += dt / fine * speed
    found = ql.identify(u, y, dt, order=2, friction=True)
    assert found.poles[1].value.real == pytest.approx(-0.8, rel=0.02)
    assert found.friction == pytest.approx(0.2, rel=0.03)
    assert found.fits["held out"] > 99.0


@pytest.mark.trial
@pytest.mark.parametrize("friction", [False, True])
def test_the_delay_is_found(friction: bool) -> None:
    """Of up to ten samples, by itself."""
    u, y = (
        (part[:10_000] for part in twin_record((0.2, 20.0), 2.0))
        if friction
        else (excitation("prbs", (0.2, 60.0), 30.0, DT).u, np.zeros(0))
    )
    y = y if friction else answer(TESTBED, u, DT, QUANTUM)
    late = np.concatenate([np.zeros(7), y[:-7]])
    found = ql.identify(u, late, DT, delay=(0.0, 10 * DT), friction=friction, held_out=0.2)
    assert found.delay == pytest.approx(7 * DT)


@pytest.mark.trial
def test_the_deviations_of_poles_are_those_of_many_records() -> None:
    """Thirty records with other coloured noise: the spread of the poles is what each record says it is, within a third.

    The refinement starts at the truth; for the first record it gives what the whole search gives.
    """
    plant, dt, rng = ([2.0], [1.0, 0.6, 9.0]), 0.02, np.random.default_rng(5)
    u = excitation("prbs", (0.3, 20.0), 60.0, dt).u
    clean, v = answer(plant, u, dt), np.column_stack([u, np.ones(u.size)])
    structure = Structure(2, 0, (0, 0))
    unit = structure.powers(dt)
    truth = np.array([9.0, 0.6, 2.0, 0.0, 0.0, 0.0]) * unit
    real, imag, told = [], [], []
    for i in range(30):
        noise = signal.lfilter(
            [0.01], [1.0, -0.95], np.append(0.0, rng.standard_normal(u.size - 1))
        )
        fitted = refine(structure, truth, v, clean + noise, 60)
        assert fitted.converged
        covariance = fitted.covariance / np.outer(unit, unit)
        pole = poles_of(fitted.theta[:2] / unit[:2], covariance[:2, :2], 0)[0]
        real.append(pole.value.real)
        imag.append(pole.value.imag)
        told.append((pole.real_std, pole.imag_std))
        if i == 0:
            found = ql.identify(u, clean + noise, dt, order=2, held_out=0.0).poles[0]
            assert found.value == pytest.approx(pole.value, rel=1e-4)
            assert (found.real_std, found.imag_std) == pytest.approx(told[0], rel=1e-2)
    spread = np.array([np.std(real, ddof=1), np.std(imag, ddof=1)])
    np.testing.assert_allclose(spread, np.median(told, axis=0), rtol=0.35)
    assert abs(np.mean(real) + 0.3) < 3.0 * spread[0] / np.sqrt(30)


@pytest.mark.trial
def test_a_reference_frees_a_closed_loop_of_bias() -> None:
    """A slow strong force in the loop: output error is far off, instrumental variables from the reference are not."""
    dt, plant = 0.02, ql.plants.LinearPlant.of(([3.0], [1.0, 0.6, 4.0]))
    controller = ql.ADRC(ql.ESO.model_free(order=2, b0=3.0, omega_o=15.0, dt=dt), omega_c=5.0)
    freed = []
    for seed in range(2):
        scenario = ql.Scenario(
            reference=excitation("prbs", (0.2, 10.0), 150.0, dt, seed=seed).signal,
            disturbances=(ql.signals.BandLimitedNoise(power=0.2, sample_time=0.3),),
            noise=ql.signals.BandLimitedNoise(power=1e-6, sample_time=dt),
            duration=150.0,
            seed=seed,
        )
        run = ql.simulate(plant, controller, scenario)
        record = run["u"], run["y_measured"], dt
        freed.append(ql.identify(*record, order=2, held_out=0.0, reference=run["r"]).den[1])
    assert abs(ql.identify(*record, order=2, held_out=0.0).den[1] - 0.6) > 0.3
    assert np.mean(freed) == pytest.approx(0.6, abs=0.15)


@pytest.mark.trial
def test_in_its_loop_an_unstable_plant_is_found_with_the_reference() -> None:
    """Its pole is not mirrored, and the report names it as unstable."""
    dt, plant = 0.01, ql.plants.LinearPlant.of(([2.0], [1.0, -0.3, 0.0]))
    controller = ql.ADRC(ql.ESO.model_free(order=2, b0=2.0, omega_o=15.0, dt=dt), omega_c=3.0)
    scenario = ql.Scenario(
        reference=excitation("prbs", (0.2, 10.0), 60.0, dt).signal,
        noise=ql.signals.BandLimitedNoise(power=1e-6, sample_time=dt),
        duration=60.0,
    )
    run = ql.simulate(plant, controller, scenario)
    found = ql.identify(run["u"], run["y_measured"], dt, order=2, reference=run["r"])
    assert sorted(pole.value.real for pole in found.poles) == pytest.approx([0.0, 0.3], abs=0.02)
    assert "unstable" in found.shortcomings[0]


def test_the_gradient_is_that_of_differences() -> None:
    """All parameters of a structure with integrator, zeros and a second input, against central differences."""
    structure = Structure(3, 1, (1, 0))
    theta = np.array([0.02, 0.3, 0.01, 0.2, 0.05, 0.4, -0.1, 1.0])
    v = np.column_stack([np.sign(np.sin(0.3 * np.arange(400.0))), np.ones(400)])
    y, psi = output_gradient(structure, theta, v)
    np.testing.assert_allclose(y, output(structure, theta, v), atol=1e-12)
    for i in range(theta.size):
        step = np.zeros(theta.size)
        step[i] = 1e-6
        slope = (output(structure, theta + step, v) - output(structure, theta - step, v)) / 2e-6
        np.testing.assert_allclose(psi[:, i], slope, atol=1e-5 * np.max(np.abs(slope)))


def test_the_deviation_of_a_root_is_its_derivative() -> None:
    """Of ``p² + a₁ p + a₀``: moving one coefficient by a little moves the root as the variance says."""
    a = np.array([4.0, 0.5])
    root = np.roots([1.0, 0.5, 4.0])[0]
    for i in range(2):
        moved = a.copy()
        moved[i] += 1e-6
        near = np.roots(np.append(1.0, moved[::-1]))
        shift = (near[np.argmin(np.abs(near - root))] - root) / 1e-6
        covariance = np.zeros((2, 2))
        covariance[i, i] = 1.0
        real, imag = root_covariance(a, covariance, root)
        assert (np.sqrt(real), np.sqrt(imag)) == pytest.approx(
            (abs(shift.real), abs(shift.imag)), rel=1e-4, abs=1e-8
        )


@pytest.mark.trial
def test_the_result_is_a_plant_for_an_observer() -> None:
    """A loop designed on the identified twin, friction and all, moves it to π as one with the true model does."""
    found = found_twin((0.2, 20.0), 2.0)
    twin = ql.plants.torsional()
    scenario = ql.Scenario(reference=ql.signals.Trapezoid(np.pi, 2.0), duration=5.0)
    ends = []
    for model in (found.plant, twin.linear):
        controller = ql.ADRC(
            ql.ESO.model_based(model, omega_o=90.0, dt=DT), omega_c=20.0, u_min=-5.0, u_max=5.0
        )
        ends.append(ql.simulate(twin, controller, scenario)["y"])
    assert abs(ends[0][-1] - np.pi) < 0.01
    assert np.max(np.abs(ends[0] - ends[1])) < 0.01


def test_an_excited_plant_is_told_the_design() -> None:
    """From rest, each sample held: what a linear plant answers is what its sampled matrices give."""
    design = excitation("prbs", (0.5, 60.0), 10.0, 0.005)
    record = excited(ql.plants.LinearPlant.of(([2.0], [1.0, 0.6, 9.0])), design)
    np.testing.assert_allclose(record.u, design.u, atol=1e-12)
    np.testing.assert_allclose(
        record.y, answer(([2.0], [1.0, 0.6, 9.0]), design.u, 0.005), atol=1e-10
    )


def test_the_empirical_response_is_the_plants_and_says_where_it_is_not() -> None:
    """Nine tenths of it within 10 % of the sampled plant where the coherence is high; noise has none."""
    u = excitation("prbs", (0.5, 60.0), 60.0, 0.005).u
    plant = ([30.0], [1.0, 4.0, 30.0, 0.0])
    found = ql.identify(u, answer(plant, u, 0.005), 0.005, order=3)
    empirical = found.empirical(segments=4)
    good = (empirical.coherence > 0.99) & (empirical.omega > 1.0) & (empirical.omega < 50.0)
    assert np.count_nonzero(good) > 20
    assert (
        np.quantile(
            np.abs(empirical.response[good] / found.response(empirical.omega[good]) - 1.0), 0.9
        )
        < 0.1
    )
    noise = np.random.default_rng(1).standard_normal(u.size)
    assert np.median(frequency_response(u, noise, 0.005).coherence) < 0.4


@pytest.mark.trial
def test_prediction_beats_simulation_and_both_are_told() -> None:
    """With a force that the model does not know, ten samples ahead y is known better than from u alone."""
    dt, rng = 0.01, np.random.default_rng(2)
    u = excitation("prbs", (0.3, 20.0), 60.0, dt).u
    force = np.repeat(0.3 * rng.standard_normal(u.size // 100), 100)
    found = ql.identify(u, answer(([3.0], [1.0, 0.5, 4.0]), u + force, dt), dt, order=2)
    assert found.fits["held out"] < found.fits["held out, predicted"] - 5.0
    assert not found.residuals.white
    assert "white: no" in str(found)


@pytest.mark.trial
@pytest.mark.parametrize(("order", "noise"), [(2, 0.0), (6, 0.01)])
def test_a_higher_order_than_the_plants_finds_it_too(order: int, noise: float) -> None:
    """A lag by a model of up to six poles: it is fitted as well as by one, and the report says which poles no sample shows."""
    u = excitation("prbs", (0.2, 40.0), 20.0, 0.01, seed=3).u
    y = answer(([3.0], [1.0, 2.0]), u, 0.01)
    y = y + noise * np.std(y) * np.random.default_rng(1).standard_normal(y.size)
    found = ql.identify(u, y, 0.01, order=order)
    assert found.fits["held out"] > 100.0 * (1.0 - noise) - 0.5
    assert found.poles[0].value == pytest.approx(-2.0, rel=0.01)
    assert any("faster than samples show" in text for text in found.shortcomings)
    assert "NOT: " in str(found)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("plant", [([2.0], [1.0, 0.0]), ([2.0], [1.0, 0.0, 0.0])])
def test_one_integrator_alone_and_two_are_found_in_noise(plant: Any, seed: int) -> None:
    """With 1 % of noise the poles are put at s = 0, none beside it, where the model might run away."""
    u = excitation("prbs", (0.2, 40.0), 40.0, 0.01, seed=3).u
    y = answer(plant, u, 0.01)
    y = y + 0.01 * np.std(y) * np.random.default_rng(seed).standard_normal(y.size)
    found = ql.identify(u, y, 0.01, order=len(plant[1]) - 1)
    assert found.integrators == found.den.size - 1
    assert found.num[0] == pytest.approx(2.0, rel=0.01)
    assert found.shortcomings == ()


def test_a_slow_lag_is_no_integrator() -> None:
    """Its pole is many of its deviations from s = 0, also where a sinusoid is all that it was told, or the order is too low."""
    t = np.arange(4000) * 0.01
    u = np.sin(t)
    y = answer(([3.0], [1.0, 2.0]), u, 0.01) + 0.01 * np.random.default_rng(5).standard_normal(
        t.size
    )
    assert ql.identify(u, y, 0.01, order=2, delay=0.0).poles[0].value == pytest.approx(
        -2.0, rel=0.02
    )


@pytest.mark.trial
def test_the_report_says_what_speaks_against_the_model() -> None:
    """A pole and a zero that can't be told apart, and a pole in the right half plane, are named; a good model has nothing of it."""
    u = excitation("prbs", (0.2, 40.0), 40.0, 0.01, seed=3).u
    noise = 0.005 * np.random.default_rng(4).standard_normal(u.size)
    y = answer(([3.0], [1.0, 2.0]), u, 0.01) + noise
    assert ql.identify(u, y, 0.01, order=1).shortcomings == ()
    found = ql.identify(u, y, 0.01, order=2, zeros=1)
    assert any("nearly equals a zero" in text for text in found.shortcomings)
    assert found.integrators == 0
    astray = ql.identify(u, answer(([3.0], [1.0, -0.1, 0.3]), u, 0.01), 0.01, order=2)
    assert ["unstable" in text for text in astray.shortcomings] == [True]
    assert astray.to_json()["shortcomings"] == list(astray.shortcomings)


def test_a_record_that_ends_at_rest_is_refused_with_what_to_do() -> None:
    """On samples where nothing moves no model can be judged; by default none are held out, and the step is enough."""
    u = np.append(0.0, np.ones(1999))
    y = answer(([3.0], [1.0, 2.0]), u, 0.01)
    with pytest.raises(
        ValueError,
        match=r"held_out = 0\.3: u is 1 all through these samples.*hold fewer out, or none",
    ):
        ql.identify(u, y, 0.01, order=1, held_out=0.3)
    found = ql.identify(u, y, 0.01, order=1)
    assert found.held_from == u.size
    assert found.poles[0].value == pytest.approx(-2.0, rel=1e-6)


def test_the_report_has_all_of_it() -> None:
    """As text, as JSON without gaps, as a picture."""
    found = found_twin((0.2, 20.0), 2.0)
    for part in (
        "G(s) =",
        "pole [rad/s]",
        "constant force",
        "Coulomb friction",
        "fit, held out:",
        "white:",
        "independent of past u",
    ):
        assert part in str(found)
    told = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert told["friction_width"] == found.friction_width > 0.0
    assert told["poles"][1]["real"] == pytest.approx(found.poles[1].value.real)
    assert set(told["fits"]) == {
        "estimation",
        "estimation, predicted",
        "held out",
        "held out, predicted",
    }
    named = replace(found, signals=Signals.of(y="angle [rad]", u="voltage [V]"))
    assert str(ql.plants.signals_of(named.plant).u) == "voltage [V]"
    axes = named.plot()
    assert len(axes) == 7
    labels = [axes[i].get_ylabel() for i in (0, 3, 4)]
    assert labels == ["|G| [rad/V]", "angle [rad]", "error [rad]"]
    plt.close(axes[0].figure)
    with pytest.raises(ValueError, match="axes: must be 7 matplotlib axes"):
        found.plot([None])


GOOD = "\n".join(f"{0.1 * k:.1f},{k % 3},{k % 5}" for k in range(20))
U = np.sign(np.sin(0.05 * np.arange(2000.0) ** 1.1))


@cases(
    ("change", "message"),
    [
        ({"u": np.append(U[:-1], np.nan)}, "u: entry (1999,) is nan"),
        ({"y": U[:-1]}, "y has shape (1999,): must be a vector of 2000"),
        ({"u": np.ones(2000)}, "u is 1 all through the samples for the fit: must move"),
        (
            {"u": U[:60], "y": U[:60]},
            "u has 60 samples, 42 of them for the fit: must have at least",
        ),
        ({"dt": -1.0}, "dt = -1.0: must be finite and greater than zero"),
        ({"order": 0}, "order = 0: must be a whole number from 1 to 8"),
        ({"zeros": 3}, "zeros = 3: must be a whole number from 0 to 2"),
        ({"delay": (0.0, 1e9)}, "is longer than the record, which has 20 s"),
        ({"integrators": 5}, "integrators = 5: must be a whole number from 0 to 2"),
        (
            {"delay": (0.1, 0.0)},
            "delay = (0.1, 0.0): must be from 0 on, and the smallest comes first",
        ),
        ({"held_out": 0.95}, "held_out = 0.95: must be from 0 to 0.9"),
        ({"held_out": 0.01}, "held_out = 0.01: of 2000 samples these are 20"),
        ({"friction": 1}, "friction = 1: must be True or False"),
        ({"reference": np.zeros(2000)}, "reference is 0 all through: must move"),
        ({"reference": U[:10]}, "reference has shape (10,): must be a vector of 2000"),
    ],
)
def test_a_wrong_argument_is_named(change: dict[str, Any], message: str) -> None:
    """Argument, value and rule."""
    arguments: dict[str, Any] = {"u": U, "y": np.cumsum(U), "dt": 0.01, "order": 2} | change
    with pytest.raises(ValueError) as caught:
        ql.identify(**arguments)
    assert message in str(caught.value)


def test_the_command_prints_writes_and_draws(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """Tables, JSON and a figure from a file; the same numbers as the function."""
    u = excitation("prbs", (0.5, 30.0), 20.0, 0.01).u
    y = answer(([2.0], [1.0, 0.6, 9.0]), u, 0.01)
    np.savetxt(
        tmp_path / "data.csv",
        np.column_stack([np.arange(u.size) * 0.01, u, y]),
        delimiter=",",
        header="t,u,y",
        comments="",
    )
    shown = quell(
        "identify",
        "data.csv",
        "--order",
        "2",
        "--no-alternatives",
        "--json",
        "out.json",
        "--figures",
        "pictures",
    )
    assert shown.code == 0, shown.err
    assert all(part in shown.out for part in ("Poles and zeros", "Fit (NRMSE)", "white:"))
    told = json.loads((tmp_path / "out.json").read_text())
    assert told["den"] == pytest.approx([1.0, 0.6, 9.0], rel=1e-6)
    assert {p.name for p in (tmp_path / "pictures").iterdir()} == {
        "identified.png",
        "identified.svg",
        "identified.pdf",
    }


def test_the_commands_refuse_in_a_line_and_design(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is wrong with a file is a line; an excitation is told and written."""
    monkeypatch.chdir(tmp_path)
    Path("data.csv").write_text("t,u,y\n" + GOOD)
    with pytest.raises(
        ValueError,
        match="column z is missing; the first line names t, u, y; say which with --columns",
    ):
        app(["identify", "data.csv", "--columns", "t,u,z"], result_action="return_value")
    with pytest.raises(ValueError, match="band = .*must rise"):
        app(["excite", "u.csv", "--low", "70"], result_action="return_value")
    app(
        ["excite", "u.csv", "--high", "30", "--dt", "0.01", "--duration", "20"],
        result_action="return_value",
    )
    assert "PRBS of" in capsys.readouterr().out
    assert read_record("u.csv", ("t", "u", "1")).u.size == 2000


@cases(
    ("text", "columns", "dt", "message"),
    [
        ("", ("t", "u", "y"), None, "is empty"),
        ("t,u\n" + GOOD, ("t", "u", "y"), None, "column y is missing; the first line names t, u"),
        ("t,u,y\n0,1\n" + GOOD, ("t", "u", "y"), None, "line 2: y = '': must be a number"),
        (
            "t,u,y\n" + GOOD.replace("0.5,2,0", "0.5,inf,0"),
            ("t", "u", "y"),
            None,
            "line 7: u = inf: must be finite",
        ),
        (
            GOOD.replace("0.5,2,0", "0.5,x,0"),
            ("t", "u", "y"),
            None,
            "line 6: u = 'x': must be a number",
        ),
        (
            "\n".join(GOOD.split("\n")[:5] + GOOD.split("\n")[12:]),
            ("t", "u", "y"),
            None,
            "line 6: t rises by 0.8 s where samples are 0.1",
        ),
        (GOOD.replace("0.5,2,0", "0.35,2,0"), ("t", "u", "y"), None, "line 6: t falls from 0.4"),
        ("0,1,2\n1,2,3", ("t", "u", "y"), None, "has 2 samples; must have at least 8"),
        (GOOD, ("t", "u"), None, "columns = 't,u': must be t,u,y or t,u,y,r"),
        (GOOD, ("t", "u", "y"), -0.1, "dt = -0.1"),
        (GOOD, ("1", "2", "7"), None, "column 7 is missing; there are 3, counted from 1"),
    ],
)
def test_a_record_that_is_none_is_refused_with_its_line(
    text: str, columns: tuple[str, ...], dt: float | None, message: str, tmp_path: Path
) -> None:
    """File, line, column, value."""
    (tmp_path / "data.csv").write_text(text)
    with pytest.raises(ValueError) as caught:
        read_record(tmp_path / "data.csv", columns, dt)
    assert message in str(caught.value)


def test_records_are_read_with_and_without_names_and_times(tmp_path: Path) -> None:
    """By name in any order, by place, by number, with a sample time in place of times, with a reference."""
    rows = np.column_stack(
        [np.arange(20) * 0.1, np.arange(20) % 3, np.arange(20) % 5, np.arange(20) % 2]
    )
    plain = "\n".join(",".join(f"{value:g}" for value in row) for row in rows)
    (tmp_path / "plain.csv").write_text(plain)
    (tmp_path / "named.csv").write_text(
        "# a rig\ny, u, t\n" + "\n".join(f"{row[2]:g},{row[1]:g},{row[0]:g}" for row in rows)
    )
    for record in (
        read_record(tmp_path / "plain.csv"),
        read_record(tmp_path / "named.csv"),
        read_record(tmp_path / "plain.csv", ("2", "3"), dt=0.1),
    ):
        np.testing.assert_array_equal(record.u, rows[:, 1])
        np.testing.assert_array_equal(record.y, rows[:, 2])
        assert record.dt == pytest.approx(0.1)
        assert record.reference is None
    german = "t [s];u;y\n" + "\n".join(
        ";".join(f"{value:g}".replace(".", ",") for value in row[:3]) for row in rows
    )
    (tmp_path / "german.csv").write_text("\ufeff" + german, encoding="utf-8")
    (tmp_path / "tabs.csv").write_text(plain.replace(",", "\t"))
    for record in (
        read_record(tmp_path / "german.csv", ("t [s]", "u", "y")),
        read_record(tmp_path / "tabs.csv"),
    ):
        np.testing.assert_array_equal(record.y, rows[:, 2])
        assert record.dt == pytest.approx(0.1)
    reference = read_record(tmp_path / "plain.csv", ("t", "u", "y", "r")).reference
    assert reference is not None
    np.testing.assert_array_equal(reference, rows[:, 3])
