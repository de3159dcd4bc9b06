"""Figures of generalised observers in the two-mass study, from a program without code of quell (``two_masses.py``)."""

from __future__ import annotations

from functools import cache

import pytest

import quell as ql
from quell.analysis import analyse

from . import two_masses

figures = cache(two_masses.figures)
PRINTED = {
    (False, 1, 10.0): ("2.63", "1.04e+04", "0.236", "4.50", "16.6", "108"),
    (False, 1, 30.0): ("1.80", "4.02e+05", "0.0505", "0.01", "14.2", "1.04e+04"),
    (True, 1, 10.0): ("2.25", "9.5e+03", "0.219", "0.00", "12.2", "99.6"),
    (False, 2, 7.0): ("4.02", "1.06e+04", "0.0422", "1.42", "11.8", "87.3"),
    (False, 2, 7.5): ("3.86", "1.32e+04", "0.0355", "0.75", "11.9", "116"),
    (True, 2, 7.5): ("3.24", "1.23e+04", "0.0347", "0.01", "12.2", "109"),
    (False, 3, 6.0): ("5.42", "1.53e+04", "0.00645", "0.01", "11.7", "119"),
    (True, 3, 6.0): ("4.47", "1.43e+04", "0.0063", "0.01", "12.2", "112"),
}
"""M_s, M_ks, peak [m], overshoot [‰], settling [s], control variation [N], by whether model-based, m and ω_o."""


@pytest.mark.parametrize("case", PRINTED)
def test_the_independent_program_gives_the_printed_figures(case: tuple[bool, int, float]) -> None:
    """MF-ESO with two extended states at 7 and 7.5 rad/s among them, to the printed digits."""
    found = figures(*case)
    first = f"{found.m_s:.2f}", *(f"{value:.3g}" for value in (found.m_ks, found.peak))
    second = f"{1e3 * found.overshoot:.2f}", f"{found.settling:.1f}", f"{found.variation:.3g}"
    assert (*first, *second) == PRINTED[case]


@pytest.mark.parametrize("case", PRINTED)
def test_the_margins_of_quell_are_those_of_the_independent_program(
    case: tuple[bool, int, float],
) -> None:
    """Equal for m = 1. For m > 1 quell holds f over a sample, which the program does not: a shift by half a sample."""
    based, m, omega_o = case
    plant, dt = ql.plants.two_mass_spring(), two_masses.DT
    observer = ql.ESO.model_free(4, 1.0, omega_o, dt, disturbance_order=m)
    if based:
        observer = ql.ESO.model_based(plant, omega_o, dt, disturbance_order=m)
    loop, found = analyse(plant, ql.ADRC(observer, 1.0)), figures(*case)
    tolerance = 1e-5 if m == 1 else 5e-4
    assert 1.0 / loop.margins.modulus == pytest.approx(found.m_s, rel=tolerance)
    assert loop.noise_to_control_peak == pytest.approx(found.m_ks, rel=tolerance)


@pytest.mark.compiled
@pytest.mark.parametrize("based", [False, True])
def test_the_rows_of_the_study_are_those_of_the_independent_program(based: bool) -> None:
    """Peak, overshoot and settling to three digits; the control variation to 2 %, as the noise is another draw."""
    from quell.experiments.two_mass_spring import setup as study

    settings, name = study.Settings(), study.MB_2 if based else study.MF_2
    controller = study.controllers(settings)[name]
    run = ql.simulate(study.two_mass_spring(), controller, study.scenario(settings))
    scores, found = study.score(run), figures(based, 2, 7.5)
    assert scores["disturbance_peak"] == pytest.approx(found.peak, rel=2e-3)
    assert scores["overshoot"] == pytest.approx(found.overshoot, abs=1e-5)
    assert scores["settling_time"] == pytest.approx(found.settling, abs=0.01)
    assert scores["control_variation"] == pytest.approx(found.variation, rel=0.02)
