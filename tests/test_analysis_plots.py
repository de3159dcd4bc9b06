"""Plots of loops."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

import quell as ql
from quell import analysis
from tests.analysed_loops import PLANT, adrc


def design(omega_o: float) -> ql.ADRC:
    """Return a controller with a bandwidth of its observer."""
    return ql.ADRC(ql.ESO.model_free(order=2, b0=2.0, omega_o=omega_o, dt=0.01), omega_c=2.0)


def test_pictures_show_what_was_calculated() -> None:
    """Curves and margins, in axes of one's own too; a wrong number of axes is an error."""
    plt = importlib.import_module("matplotlib.pyplot")
    loop = analysis.analyse(PLANT, adrc(2))
    top, low = analysis.plot_bode(loop)
    np.testing.assert_allclose(
        top.lines[0].get_ydata(), np.abs(loop.response("L", loop.omega[:-1]))
    )
    assert f"phase margin {loop.margins.phase:.0f}°" in low.get_title(loc="right")
    four = analysis.plot_gang_of_four(loop)
    np.testing.assert_allclose(
        four[3].lines[0].get_ydata(), np.abs(loop.response("CS", loop.omega))
    )
    omegas = [5.0, 10.0]
    axes = analysis.plot_margins_against_omega_o(PLANT, design, omegas)
    assert axes[1].lines[0].get_ydata()[1] == pytest.approx(
        analysis.analyse(PLANT, design(10.0)).margins.phase
    )
    axes = analysis.plot_margins_over_time([0.0, 1.0], [loop, loop], plt.subplots(3)[1])
    assert axes[0].lines[0].get_ydata()[0] == loop.margins.modulus
    with pytest.raises(ValueError, match="must be 2 matplotlib axes, got 3"):
        analysis.plot_bode(loop, plt.subplots(3)[1])
    plt.close("all")


def test_a_bode_plot_in_decibels_and_hertz_has_the_same_curve() -> None:
    """20 lg |L| over ω/2π; the margins stand above the axes, where they cover nothing."""
    plt = importlib.import_module("matplotlib.pyplot")
    loop = analysis.analyse(PLANT, design(20.0))
    plain, other = analysis.plot_bode(loop), analysis.plot_bode(loop, decibels=True, hertz=True)
    omega, size = plain[0].lines[0].get_data()
    hertz, decibels = other[0].lines[0].get_data()
    np.testing.assert_allclose(hertz, np.asarray(omega) / (2.0 * np.pi))
    np.testing.assert_allclose(decibels, 20.0 * np.log10(size))
    assert f"{loop.margins.phase:.0f}°" in other[1].get_title(loc="right")
    assert not [*plain[0].texts, *plain[1].texts]
    four = analysis.plot_gang_of_four(loop, ax=plt.subplots(2, 2)[1], decibels=True, hertz=True)
    assert four[2].get_xlabel() == "frequency [Hz]"
    low, high = four[2].get_ylim()
    analysis.plot_gang_of_four(analysis.analyse(PLANT, design(100.0)), four, decibels=True)
    both = four[2].get_ylim()  # both loops are seen
    assert both[0] <= low
    assert both[1] >= high
    plt.close("all")


def test_a_nyquist_plot_has_the_circle_that_touches_the_curve() -> None:
    """The curve is nowhere nearer to −1 than the modulus margin, and that near at one point."""
    plt = importlib.import_module("matplotlib.pyplot")
    loop = analysis.analyse(PLANT, design(20.0))
    ax = plt.subplots()[1]
    assert analysis.plot_nyquist(loop, ax=ax) is ax
    x, y = (np.asarray(part) for part in ax.lines[0].get_data())
    nearest = float(np.min(np.abs(x + 1j * y + 1.0)))
    assert nearest == pytest.approx(loop.margins.modulus, rel=1e-2)
    with pytest.raises(ValueError, match=r"ax: must be one of matplotlib's axes, got 2"):
        analysis.plot_nyquist(loop, plt.subplots(2)[1])
    plt.close("all")


def test_a_root_locus_has_the_poles_of_each_design() -> None:
    """Each point is a pole of one of the loops."""
    plt = importlib.import_module("matplotlib.pyplot")
    values = [10.0, 20.0, 40.0]
    ax = analysis.plot_root_locus(PLANT, design, values)
    drawn = np.asarray(ax.collections[0].get_offsets())
    found = np.concatenate([analysis.analyse(PLANT, design(each)).s_poles for each in values])
    assert 0 < len(drawn) <= found.size
    assert all(np.min(np.abs(found - complex(*point))) < 1e-9 for point in drawn)
    plt.close("all")
