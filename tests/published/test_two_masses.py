"""Figures of generalised observers in the two-mass study, from a program without code of quell (``two_masses.py``)."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

import quell as ql
from quell.analysis import analyse

from . import two_masses

pytestmark = pytest.mark.trial

figures, algorithm_1 = cache(two_masses.figures), cache(two_masses.algorithm_1)
PRINTED = {
    (False, 1, 10.0): ("2.63", "1.04e+04", "0.236", "4.50", "16.6"),
    (False, 1, 30.0): ("1.80", "4.02e+05", "0.0505", "0.01", "14.2"),
    (True, 1, 10.0): ("2.25", "9.5e+03", "0.219", "0.01", "12.2"),
    (False, 2, 7.0): ("4.02", "1.06e+04", "0.0422", "1.42", "11.8"),
    (False, 2, 7.5): ("3.86", "1.32e+04", "0.0355", "0.75", "11.9"),
    (True, 2, 7.5): ("3.24", "1.23e+04", "0.0347", "0.01", "12.2"),
    (False, 3, 6.0): ("5.42", "1.53e+04", "0.00645", "0.01", "11.8"),
    (True, 3, 6.0): ("4.47", "1.43e+04", "0.0063", "0.01", "12.2"),
}
"""M_s, M_ks, peak [m], overshoot [‰], settling [s], by whether model-based, m and ω_o."""
ROWS = {
    "MF-ESO: knows only the plant's order": (False, 1, 10.0),
    "MB-ESO: knows the plant": (True, 1, 10.0),
    "MF-ESO at three times the bandwidth": (False, 1, 30.0),
    "MF-ESO m = 2: f and f', ω_o = 7.5": (False, 2, 7.5),
    "MB-ESO m = 2": (True, 2, 7.5),
    "MF-ESO m = 3: f, f' and f'', ω_o = 6": (False, 3, 6.0),
    "MB-ESO m = 3": (True, 3, 6.0),
    "L-ESO with the paper's Algorithm 1, 0.01/s": "as printed",
    "Algorithm 1 without u, 1/s": "without u",
}
"""Rows of the README by what the program knows them by."""
README = Path(__file__).parents[2] / "README.md"


@pytest.mark.parametrize("case", PRINTED)
def test_the_independent_program_gives_the_printed_figures(case: tuple[bool, int, float]) -> None:
    """MF-ESO with two extended states at 7 and 7.5 rad/s among them, to the printed digits."""
    found = figures(*case)
    first = f"{found.m_s:.2f}", *(f"{value:.3g}" for value in (found.m_ks, found.peaks[1]))
    assert (*first, f"{1e3 * found.overshoot:.2f}", f"{found.settling:.1f}") == PRINTED[case]


@pytest.mark.parametrize("row", ROWS)
def test_the_rows_of_the_readme_are_those_of_the_independent_program(row: str) -> None:
    """To the printed digits, with f held over a sample as in quell; the control variation within twice its interval."""
    case = ROWS[row]
    if isinstance(case, str):
        found = algorithm_1()[case]
    else:  # for m = 1 nothing depends on what f does within a sample
        found = figures(*case, True) if case[1] > 1 else figures(*case)
    cells = next(line for line in README.read_text(encoding="utf-8").splitlines() if row in line)
    overshoot, settling, *peaks, variation, m_s, m_ks = [c.strip() for c in cells.split("|")[2:-1]]
    assert overshoot == ("0" if found.overshoot < 5e-5 else f"{1e3 * found.overshoot:.2f}")
    assert settling == f"{found.settling:.1f}"
    assert peaks == [millimetres(peak) for peak in found.peaks]
    mean, half = (float(part.replace(" ", "")) for part in variation.split("±"))
    # The program's Algorithm 1 has one draw, with √10 times the deviation of a mean.
    assert found.variation == pytest.approx(mean, abs=2.0 * half + 0.5)
    assert m_s == f"{found.m_s:.2f}"
    size = found.m_ks / 1e4
    assert m_ks == (f"{size:.1f}e4" if size > 10.0 else f"{size:.2f}e4")


def millimetres(peak: float) -> str:
    """Return a peak as the README prints it."""
    size = 1e3 * peak
    return f"{size:.0f}" if size >= 100.0 else f"{size:.1f}" if size >= 1.0 else f"{size:.1g}"


def test_it_does_not_matter_when_algorithm_1_labels_its_batch() -> None:
    """Every entry anew with the newest θ, as printed, or once: the same figures to 0.1 %."""
    printed, once = (algorithm_1()[name] for name in ("as printed", "labelled once"))
    assert once.peaks[1] == pytest.approx(printed.peaks[1], rel=1e-3)
    for name in ("m_s", "m_ks", "overshoot", "settling", "variation"):
        assert getattr(once, name) == pytest.approx(getattr(printed, name), rel=1e-3)


@pytest.mark.parametrize("case", PRINTED)
def test_the_margins_of_quell_are_those_of_the_independent_program(
    case: tuple[bool, int, float],
) -> None:
    """Equal, but for m > 1, where f moves x within a sample in the program and not in quell: a shift by half a sample."""
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
@pytest.mark.parametrize("name", ["MF-ESO m = 2", "MB-ESO m = 2"])
def test_the_rows_of_the_study_are_those_of_the_independent_program(name: str) -> None:
    """Peak, overshoot and settling to three digits; the control variation to 2 %, as the noise is another draw."""
    from quell.experiments import two_mass_spring as study

    settings = study.Settings()
    controller = study.controllers(settings)[name]
    run = ql.simulate(study.two_mass_spring(), controller, study.scenario(settings))
    scores, found = study.score(run), figures(name.startswith("MB"), 2, 7.5, True)
    assert scores["disturbance_peak"] == pytest.approx(found.peaks[1], rel=1e-3)
    assert scores["overshoot"] == pytest.approx(found.overshoot, abs=1e-5)
    assert scores["settling_time"] == pytest.approx(found.settling, abs=0.01)
    assert scores["control_variation"] == pytest.approx(found.variation, rel=0.02)
