"""Loads by their spectrum, and internal models of sinusoids: ``LoadSpectrum``, ``frequencies`` and their structures."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import quell as ql
from quell.analysis import analyse
from quell.observers.design import motion_of_f
from quell.tuning import Constraints, LoadSpectrum
from quell.tuning.plants import given_plants, model_of, plant_set
from quell.tuning.structures.registry import make_structure

DT = 0.01
AXIS = ([100.0], [1.0, 2.0, 0.0])
BASE: dict[str, Any] = {"b0": 100.0, "omega_o": 30.0, "dt": DT}


# ---- the observer's model of f


def test_the_motion_of_f_is_that_of_a_constant_and_sinusoids() -> None:
    """``c + a sin(ω t)`` and its derivatives, sampled, follow the matrix; it is exp of the companion matrix less I."""
    omega, t = 3.0, np.arange(50) * DT
    parts = [
        0.7 + 0.4 * np.sin(omega * t),
        0.4 * omega * np.cos(omega * t),
        -0.4 * omega**2 * np.sin(omega * t),
    ]
    states = np.array([part * DT**i for i, part in enumerate(parts)])
    added = motion_of_f(3, np.array([omega * DT]))
    np.testing.assert_allclose(
        states[:, :-1] + added @ states[:, :-1], states[:, 1:], rtol=1e-11, atol=1e-15
    )
    companion = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -((omega * DT) ** 2), 0.0]])
    np.testing.assert_allclose(added, expm(companion) - np.eye(3), atol=1e-15)


@pytest.mark.parametrize("frequencies", [(3.0,), (2.0, 5.3)])
@pytest.mark.parametrize("m", [1, 2])
def test_an_observer_with_frequencies_rejects_loads_of_them_without_error(
    frequencies: tuple[float, ...], m: int
) -> None:
    """G_yd vanishes there, and nowhere beside; C_y has poles there and m at z = 1, whatever the plant is."""
    observer = ql.ESO.model_free(order=2, frequencies=frequencies, disturbance_order=m, **BASE)
    assert observer.estimates == 2 + m + 2 * len(frequencies)
    loop = analyse(AXIS, ql.ADRC(observer, omega_c=15.0))
    at = np.array(frequencies)
    assert loop.stable
    assert np.all(np.abs(loop.response("PS", at)) < 1e-9 * np.abs(loop.response("PS", 1.1 * at)))
    model_based = ql.ESO.model_based(AXIS, 30.0, DT, frequencies=frequencies, disturbance_order=m)
    loop = analyse(AXIS, ql.ADRC(model_based, omega_c=15.0))
    assert np.all(np.abs(loop.response("PS", at)) < 1e-9 * np.abs(loop.response("PS", 1.1 * at)))


def test_a_load_of_a_known_frequency_leaves_rounding_in_a_run() -> None:
    """A second after it came on the error is at rounding, in every form of the observer."""
    load = ql.signals.Sinusoid(omega=3.0, start=0.5)
    for form in ("current", "predictor", "reduced"):
        observer = ql.ESO.model_free(order=2, frequencies=(3.0,), form=form, **BASE)
        plant = ql.plants.LinearPlant(
            [[0.0, 1.0], [0.0, -2.0]], [[0.0], [100.0]], [[1.0, 0.0]], [[0.0], [100.0]]
        )
        held = ql.signals.Samples(
            DT * np.arange(601), np.array([load(k * DT) for k in range(601)]), hold="previous"
        )
        run = ql.simulate(
            plant,
            ql.ADRC(observer, omega_c=10.0),
            ql.Scenario(disturbances=(held,), duration=6.0),
            interpret=True,
        )
        assert np.max(np.abs(run["y"][:100])) > 1e-4
        assert np.max(np.abs(run["y"][-100:])) < 1e-9


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        ((0.0,), "above 0"),
        ((-1.0,), "above 0"),
        ((math.pi / DT,), "below pi/dt"),
        ((2.0, 2.0), "differ"),
    ],
)
def test_frequencies_that_cannot_be_modelled_are_refused(
    given: tuple[float, ...], rule: str
) -> None:
    """The message names the argument and the rule."""
    with pytest.raises(ValueError, match=f"frequencies = .*{rule}"):
        ql.ESO.model_free(order=2, frequencies=given, **BASE)


# ---- the structures


def loop_of(frequencies: tuple[float, ...] = ()) -> Any:
    """Return the set of the axis alone and what structures know of it."""
    given = given_plants(AXIS, DT)
    plants = plant_set(given, DT)
    return plants, model_of(given, plants, Constraints())._replace(frequencies=frequencies)


def test_the_argument_counts_unstable_loops_with_poles_on_the_circle(
    rng: np.random.Generator,
) -> None:
    """For drawn gains the count by the argument principle is that of the closed loop's eigenvalues."""
    plants, model = loop_of()
    structure = make_structure("resonator", model, 2)
    rows = structure.shapes()
    rows = rows[rng.permutation(len(rows))[:12]]
    rows[:, 0] *= np.exp(rng.uniform(-2.0, 2.0, len(rows)))
    C, outside = structure.response(rows, plants.omega), structure.unstable_poles(rows)
    found = plants.unstable_loops(C, outside, structure.integrators, structure.on_circle(rows))[
        :, 0
    ]
    for row, count in zip(rows, found, strict=True):
        assert (count < 0.5) == analyse(AXIS, structure.controller(row)).stable
    assert 0 < np.sum(found < 0.5) < len(rows)


def test_known_frequencies_are_no_parameters_and_their_number_is_that_of_the_structure() -> None:
    """They stand in the controller and in its setup table."""
    _, model = loop_of((3.0, 5.0))
    structure = make_structure("resonator-2", model, 2)
    assert not any(parameter.name.startswith("omega_r") for parameter in structure.parameters)
    values = structure.shapes()[4]
    assert structure.controller(values).observer.frequencies == (3.0, 5.0)
    assert structure.tables(values)["observer"]["frequencies"] == [3.0, 5.0]
    with pytest.raises(ValueError, match="resonator of order 2 has 1 of them"):
        make_structure("resonator", model, 2)
    with pytest.raises(ValueError, match="frequencies = .*has no effect"):
        ql.tune(AXIS, DT, structure="poles", frequencies=(3.0,), compare=())


# ---- the spectrum, and the objective


def test_the_power_of_a_band_is_that_of_its_sinusoid() -> None:
    """a²/2, spread over the band."""
    load = LoadSpectrum.band(0.5, 5.5, amplitude=3.0)
    assert load.rms == pytest.approx(3.0 / math.sqrt(2.0))
    assert (load.omega[0], load.omega[-1]) == (0.5, 5.5)


def test_the_spectrum_of_a_record_has_its_power_where_its_sinusoids_are() -> None:
    """Two sinusoids on a constant, which does not count."""
    t = DT * np.arange(20_000)
    load = LoadSpectrum.of_record(5.0 + np.sin(2.0 * t) + 0.5 * np.sin(7.0 * t), DT)
    assert load.rms == pytest.approx(math.sqrt(0.5 + 0.125), rel=2e-3)
    for omega, power in ((2.0, 0.5), (7.0, 0.125)):
        near = np.abs(load.omega - omega) < 0.1
        assert float(np.sum(load.power[near])) == pytest.approx(power, rel=1e-2)


@pytest.mark.parametrize(
    ("make", "rule"),
    [
        (lambda: LoadSpectrum([1.0, 2.0], [1.0]), "one for each"), (lambda: LoadSpectrum([0.0], [1.0]), "above 0"),
        (lambda: LoadSpectrum([1.0], [-1.0]), "negative"), (lambda: LoadSpectrum([1.0], [0.0]), "zero everywhere"),
        (lambda: LoadSpectrum.band(2.0, 1.0), "low must be below high"), (lambda: LoadSpectrum.of_record(np.zeros(9), 0.1), "at least 16"),
        (lambda: LoadSpectrum.of_record(np.ones(99), 0.1), "constant"),
    ],
)  # fmt: skip
def test_what_is_no_spectrum_is_refused(make: Any, rule: str) -> None:
    """The message says the rule."""
    with pytest.raises(ValueError, match=rule):
        make()


@pytest.mark.trial
def test_the_objective_is_the_rms_of_y_and_beats_a_design_for_a_step() -> None:
    """As ``analyse`` has it; a resonator in the band leaves less than three integrators, and they less than one."""
    load = LoadSpectrum.band(0.5, 5.5)
    bounds = Constraints(m_s=2.0, m_t=None, m_ks=100.0, damping=0.3)
    left = {}
    for structure in ("poles", "poles-3", "resonator"):
        tuned = ql.tune(
            AXIS, 2e-3, structure=structure, order=2, objective=load, compare=(), constraints=bounds
        )
        loop = analyse(AXIS, tuned.controller)
        size = np.abs(loop.response("PS", load.omega)) ** 2
        assert tuned.design.objective == pytest.approx(math.sqrt(size @ load.power), rel=1e-6)
        assert 1.0 / loop.margins.modulus <= 2.002
        assert loop.noise_to_control_peak <= 100.1
        left[structure] = tuned.design.objective
    for_step = ql.tune(AXIS, 2e-3, structure="poles", order=2, compare=(), constraints=bounds)
    size = np.abs(analyse(AXIS, for_step.controller).response("PS", load.omega)) ** 2
    assert left["resonator"] < 0.5 * left["poles-3"] < 0.25 * left["poles"]
    assert left["poles"] < math.sqrt(size @ load.power)
