"""What the plots of identifications and tunings show: lines, labels, limits."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import quell as ql
from quell.identification.frequencies import FrequencyResponse
from quell.identification.frequency_model import FrequencyModel
from quell.identification.result import draw_bode, draw_output, draw_tests, seven_axes
from quell.identification.spectra import SpectralModes
from quell.identification.swings import Decay, FreeSwing
from quell.identification.validation import Residuals
from quell.quantities import UNKNOWN, Quantity, Signals
from quell.tuning import Constraints
from quell.tuning.optimiser.loops import law_of, load_step, reference_step, response
from quell.tuning.report import draw, phase_of

DT = 0.05
T = np.arange(40.0)
OMEGA = np.geomspace(0.5, 50.0, 30)


def axes_of(count: int) -> list[Axes]:
    """Return axes of a figure that nothing shows."""
    return list(np.ravel(Figure().subplots(count)))


def data(ax: Axes, number: int) -> np.ndarray:
    """Return x and y of a line."""
    return np.array(ax.lines[number].get_data(), dtype=float)


def texts(ax: Axes) -> list[str]:
    """Return the texts of a legend."""
    legend = ax.get_legend()
    return [] if legend is None else [text.get_text() for text in legend.get_texts()]


def test_a_spectrum_is_drawn_over_hertz_with_its_model() -> None:
    """Both scales are logarithmic."""
    found = SpectralModes((), OMEGA, 2.0 * OMEGA, 3.0 * OMEGA)
    (ax,) = axes_of(1)
    assert found.plot(ax)[0] is ax
    np.testing.assert_allclose(data(ax, 0), [OMEGA / (2.0 * math.pi), 2.0 * OMEGA])
    np.testing.assert_allclose(data(ax, 1), [OMEGA / (2.0 * math.pi), 3.0 * OMEGA])
    assert texts(ax) == ["table", "model"]
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("frequency [Hz]", "power")


def test_a_swing_and_a_decay_are_drawn_with_their_errors() -> None:
    """Measured, simulated, and the difference below."""
    y, simulated = np.cos(0.3 * T), np.cos(0.31 * T)
    swing = FreeSwing((), None, 1.0, 0.0, (-1.0, 1.0), 99.0, 0.1, y, simulated)
    decay = swing._replace(decay=Decay(4.0, (3.0, 5.0)))
    for found in (swing, decay):
        shown, error = found.plot(axes_of(2))
        np.testing.assert_allclose(data(shown, 0), [0.1 * T, y])
        np.testing.assert_allclose(data(shown, 1), [0.1 * T, simulated])
        np.testing.assert_allclose(data(error, 0), [0.1 * T, y - simulated])
        assert texts(shown) == ["measured", "simulated"]
        assert (shown.get_ylabel(), error.get_ylabel()) == ("y", "error")
        assert error.get_xlabel() == "time [s]"
    with pytest.raises(ValueError, match="axes and ax: are two names of the same; give one"):
        swing.plot(axes_of(2), ax=axes_of(2))
    with pytest.raises(ValueError, match="must be 2 matplotlib axes, got 1"):
        swing.plot(axes_of(1))


def test_a_frequency_response_is_drawn_where_it_is_known() -> None:
    """Size and phase without the other points, the coherence with all."""
    G = 4.0 / (1.0 + 1j * OMEGA) ** 3
    deviation = np.where(np.arange(30) == 7, 0.3, 0.1)
    found = FrequencyResponse(OMEGA, G, np.linspace(1.0, 0.5, 30), deviation)
    size, phase, coherence = found.plot(axes_of(3))
    hertz = OMEGA / (2.0 * math.pi)
    known = deviation < 0.2
    drawn = data(size, 0)
    np.testing.assert_allclose(drawn[0], hertz)
    np.testing.assert_allclose(drawn[1][known], np.abs(G)[known])
    assert np.isnan(drawn[1][7])
    expected = -np.degrees(3.0 * np.arctan(OMEGA))
    np.testing.assert_allclose(data(phase, 0)[1][known], expected[known])
    assert np.isnan(data(phase, 0)[1][7])
    np.testing.assert_allclose(data(coherence, 0), [hertz, np.linspace(1.0, 0.5, 30)])
    labels = [ax.get_ylabel() for ax in (size, phase, coherence)]
    assert labels == ["|G|", "phase of G [°]", "coherence"]
    assert coherence.get_xlabel() == "frequency [Hz]"
    assert coherence.get_ylim() == pytest.approx((0.0, 1.05))
    assert (size.get_xscale(), size.get_yscale()) == ("log", "log")


def test_a_table_of_frequencies_is_drawn_with_its_model_and_error() -> None:
    """The phase of the table within half a turn of that of the model; the error in percent."""
    num, den = np.array([4.0]), np.poly([-1.0, -1.0, -1.0])
    model = num[0] / (1.0 + 1j * OMEGA) ** 3 * np.exp(-0.02j * OMEGA)
    table = model * 1.1 * np.exp(0.05j)
    found = FrequencyModel(num, den, np.eye(4), (), (), 0, 0.02, np.zeros(5), (3.0, 5.0), 0.1,
                           OMEGA, table, None, True, True)  # fmt: skip
    size, phase, error = found.plot(axes_of(3))
    hertz = OMEGA / (2.0 * math.pi)
    np.testing.assert_allclose(data(size, 0), [hertz, np.abs(table)])
    fine = np.geomspace(0.5, 50.0, 2000)
    assert data(size, 1)[0][[0, -1]] == pytest.approx(fine[[0, -1]] / (2.0 * math.pi))
    at = np.interp(3.0, 2.0 * math.pi * data(size, 1)[0], data(size, 1)[1])
    assert at == pytest.approx(4.0 / 10.0**1.5, rel=1e-4)
    degrees = -np.degrees(3.0 * np.arctan(OMEGA) + 0.02 * OMEGA)
    np.testing.assert_allclose(data(phase, 0)[1], degrees + math.degrees(0.05), atol=1e-3)
    np.testing.assert_allclose(np.interp(hertz, *data(phase, 1)), degrees, atol=0.05)
    np.testing.assert_allclose(data(error, 0), [hertz, 100.0 * np.abs(1.0 / (1.1 * np.exp(0.05j)) - 1.0)
                                                * np.ones(30)])  # fmt: skip
    assert texts(size) == ["table", "model"]
    assert [ax.get_ylabel() for ax in (size, phase, error)] == [
        "|G|",
        "phase of G [°]",
        "error [%]",
    ]
    assert error.get_xlabel() == "frequency [Hz]"
    assert error.get_yscale() == "log"


def test_the_response_of_a_record_is_drawn_where_it_is_coherent() -> None:
    """Gain, phase and coherence, the model on 2000 frequencies, limits around the points."""
    G = 4.0 / (1.0 + 1j * OMEGA) ** 3
    coherence = np.where(np.arange(30) < 20, 0.9, 0.1)
    measured = FrequencyResponse(OMEGA, 1.2 * G, coherence, np.full(30, 0.1))
    axes = axes_of(3)
    draw_bode(axes, measured, lambda omega: 4.0 / (1.0 + 1j * omega) ** 3, UNKNOWN)
    gain, phase, share = axes
    np.testing.assert_allclose(data(gain, 0), [OMEGA[:20], 1.2 * np.abs(G[:20])])
    fine = np.geomspace(0.5, 50.0, 2000)
    np.testing.assert_allclose(data(gain, 1), [fine, 4.0 / np.hypot(1.0, fine) ** 3])
    degrees = -np.degrees(3.0 * np.arctan(OMEGA))
    np.testing.assert_allclose(data(phase, 0), [OMEGA[:20], degrees[:20]], atol=1e-3)
    np.testing.assert_allclose(data(phase, 1), [fine, -np.degrees(3.0 * np.arctan(fine))])
    np.testing.assert_allclose(data(share, 0), [OMEGA, coherence])
    assert texts(gain) == ["empirical", "model"]
    assert [ax.get_ylabel() for ax in axes] == ["|G|", "phase of G [°]", "coherence"]
    assert share.get_xlabel() == "ω [rad/s]"
    assert share.get_ylim() == pytest.approx((0.0, 1.05))
    for ax in axes:
        assert ax.get_xlim() == pytest.approx((0.5, 50.0))
    size = 1.2 * np.abs(G[:20])
    assert gain.get_ylim() == pytest.approx((0.3 * size[-1], 3.0 * size[0]))
    assert phase.get_ylim() == pytest.approx((degrees[19] - 30.0, degrees[0] + 30.0), abs=1e-2)
    nothing = axes_of(3)
    none = np.zeros(0)
    draw_bode(
        nothing, FrequencyResponse(none, none.astype(complex), none, none), lambda x: x, UNKNOWN
    )
    assert [ax.texts[0].get_text() for ax in nothing] == ["u moves too little"] * 3
    named = axes_of(3)
    draw_bode(named, measured, lambda omega: omega, Signals.of(y="angle [rad]", u="voltage [V]"))
    assert named[0].get_ylabel() == "|G| [rad/V]"


def test_the_output_is_drawn_in_its_parts_with_their_fits() -> None:
    """Held out from a sample on; none without it."""
    y, simulated = np.cos(0.3 * T), np.cos(0.31 * T)
    axes = axes_of(2)
    fits = {"estimation": 98.765, "held out": 91.234}
    draw_output(axes, T, y, simulated, 25, fits, Quantity("angle", "rad"))
    output, error = axes
    np.testing.assert_allclose(data(output, 0), [T, y])
    np.testing.assert_allclose(data(output, 1), [T[:25], simulated[:25]])
    np.testing.assert_allclose(data(output, 2), [T[25:], simulated[25:]])
    np.testing.assert_allclose(data(error, 0), [T[:25], (y - simulated)[:25]])
    np.testing.assert_allclose(data(error, 1), [T[25:], (y - simulated)[25:]])
    assert texts(output) == ["measured", "simulated, 98.77 %", "held out, 91.23 %"]
    assert (output.get_ylabel(), error.get_ylabel()) == ("angle [rad]", "error [rad]")
    assert error.get_xlabel() == "time [s]"
    whole = axes_of(2)
    draw_output(whole, T, y, simulated, 40, fits, Quantity("", ""))
    assert len(whole[0].lines) == 2
    assert whole[0].get_ylabel() == "output"


def test_tests_of_the_error_are_drawn_with_their_limits() -> None:
    """Sticks from lag 0 on, and from −M on; bands of 99 %."""
    found = Residuals(
        0.1, 3, np.array([1.0, 0.2, -0.1, 0.05]), 1.0, 9.0, np.arange(7.0) / 10.0, 0.4
    )
    axes = axes_of(2)
    draw_tests(axes, found, 100)
    auto, cross = axes
    sticks = [ax.collections[0].get_segments() for ax in axes]
    assert [stick[:, 0].tolist() for stick in sticks[0]] == [[k, k] for k in range(4)]
    assert [float(stick[1, 1]) for stick in sticks[0]] == found.autocorrelation.tolist()
    assert [stick[0].tolist() for stick in sticks[1]] == [[k, 0.0] for k in range(-3, 4)]
    assert [float(stick[1, 1]) for stick in sticks[1]] == found.cross_correlation.tolist()
    tops = [float(ax.patches[0].get_y() + ax.patches[0].get_height()) for ax in axes]
    assert tops == pytest.approx([0.2576, 0.4], rel=1e-3)
    assert auto.get_ylabel() == "correlation\nof the error"
    assert cross.get_ylabel() == "with u"
    assert cross.get_xlabel() == "error later than u by [samples]"
    assert texts(auto) == ["99 %"]
    with pytest.raises(ValueError, match="axes: must be 7 matplotlib axes, got 2"):
        seven_axes(axes)
    given = axes_of(7)
    assert seven_axes(given) == given


# ---- tunings


@cache
def tuned() -> ql.Tuned:
    """Return a lag with a PI controller."""
    return ql.tune(([1.0], [1.0, 1.0]), DT, structure="pi", compare=(), written=False,
                   objective="load", constraints=Constraints(m_ks=3.0))  # fmt: skip


def test_a_tuned_loop_is_drawn_with_its_sensitivities_bounds_and_responses() -> None:
    """|L| with its phase, |S| and |T| dashed, a step of r and one of a load."""
    found = tuned()
    plants, design = found.task.plants, found.design
    figure = Figure()
    axes = np.ravel(figure.subplots(2, 2))
    draw(plants, {"pi": design}, Constraints(m_s=1.6, m_t=1.3), UNKNOWN, axes)
    bode, sensitivity, step, load = axes
    omega = plants.omega
    C = design.solution.structure.response(design.solution.values[None, :], omega)[0]
    L = plants.P[0] * C
    np.testing.assert_allclose(data(bode, 0), [omega, np.abs(L)])
    np.testing.assert_allclose(data(sensitivity, 0), [omega, np.abs(1.0 / (1.0 + L))])
    np.testing.assert_allclose(data(sensitivity, 1), [omega, np.abs(L / (1.0 + L))])
    assert [line.get_linestyle() for line in sensitivity.lines] == ["-", "--", "-", "--"]
    assert [float(line.get_ydata()[0]) for line in sensitivity.lines[2:]] == [1.6, 1.3]
    assert float(bode.lines[1].get_ydata()[0]) == 1.0
    (phase,) = [ax for ax in figure.axes if ax.get_ylabel() == "phase of L [°]"]
    shown = data(phase, 0)
    inside = np.abs(L) >= 0.02
    np.testing.assert_allclose(shown[1][inside], np.degrees(np.unwrap(np.angle(L)))[inside])
    assert np.all(np.isnan(shown[1][~inside]))
    assert float(phase.lines[1].get_ydata()[0]) == -180.0
    law, (plant,) = law_of(design.controller), plants.scaled()
    for ax, inputs in ((step, reference_step(plants)), (load, load_step(plants))):
        t, y = data(ax, 0)
        np.testing.assert_allclose(t, DT * np.arange(t.size))
        np.testing.assert_allclose(y, response(plant, law, inputs)[: t.size], atol=1e-9)
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("t [s]", "y")
        assert ax.get_xlim()[0] == 0.0
        assert 1.0 < ax.get_xlim()[1] < t[-1]
    assert bode.get_title() == "loop L, its phase dashed"
    assert bode.get_ylabel() == "|L|"
    assert sensitivity.get_title() == "sensitivities, with their bounds"
    assert sensitivity.get_ylabel() == "|S|, |T| dashed"
    assert (step.get_title(), load.get_title()) == (
        "step of r",
        "step of a load at the plant's input",
    )
    assert texts(load) == ["pi"]
    for ax in figure.axes:
        assert all(line.get_linewidth() > 0.0 for line in ax.lines)
    for ax in (bode, sensitivity):
        assert ax.get_xlabel() == "ω [rad/s]"
        assert omega[0] <= ax.get_xlim()[0] < 1.0
    top = max(1.6, float(np.max(np.abs(1.0 / (1.0 + L)))))
    assert sensitivity.get_ylim()[1] == pytest.approx(1.5 * top)
    with_units = np.ravel(Figure().subplots(2, 2))
    signals = Signals.of(y="angle [rad]", u="voltage [V]")
    draw(
        plants,
        {"pi": design, "other": design},
        Constraints(m_s=1.7, m_t=None),
        signals,
        with_units,
    )
    assert with_units[2].get_title() == "step of r by 1 rad"
    assert with_units[3].get_title() == "step of a load at the plant's input by 1 V"
    assert with_units[2].get_ylabel() == "angle [rad]"
    assert texts(with_units[3]) == ["pi", "other: pi"]
    assert len(with_units[1].lines) == 5


def test_the_phase_of_a_loop_begins_between_zero_and_a_turn_below() -> None:
    """It is continuous from there."""
    angle = -np.radians(np.linspace(90.0, 800.0, 60))
    turned = phase_of(np.exp(1j * (angle + np.pi)))
    np.testing.assert_allclose(turned, -180.0 - np.linspace(90.0, 800.0, 60))
