"""Plots of loops."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

import quell as ql
from quell import analysis
from tests.analysed_loops import PLANT, adrc


def test_pictures_show_what_was_calculated() -> None:
    """Curves and margins, in axes of one's own too; a wrong number of axes is an error."""
    plt = importlib.import_module("matplotlib.pyplot")
    loop = analysis.analyse(PLANT, adrc(2))
    top, low = analysis.plot_bode(loop)
    np.testing.assert_allclose(
        top.lines[0].get_ydata(), np.abs(loop.response("L", loop.omega[:-1]))
    )
    assert f"{loop.margins.phase:.0f}°" in [text.get_text() for text in low.texts]
    four = analysis.plot_gang_of_four(loop)
    np.testing.assert_allclose(
        four[3].lines[0].get_ydata(), np.abs(loop.response("CS", loop.omega))
    )
    omegas = [5.0, 10.0]

    def make(omega_o: float) -> ql.ADRC:
        return ql.ADRC(ql.ESO.model_free(order=2, b0=2.0, omega_o=omega_o, dt=0.01), omega_c=2.0)

    axes = analysis.plot_margins_against_omega_o(PLANT, make, omegas)
    assert axes[1].lines[0].get_ydata()[1] == pytest.approx(
        analysis.analyse(PLANT, make(10.0)).margins.phase
    )
    axes = analysis.plot_margins_over_time([0.0, 1.0], [loop, loop], plt.subplots(3)[1])
    assert axes[0].lines[0].get_ydata()[0] == loop.margins.modulus
    with pytest.raises(ValueError, match="must be 2 matplotlib axes, got 3"):
        analysis.plot_bode(loop, plt.subplots(3)[1])
    plt.close("all")
