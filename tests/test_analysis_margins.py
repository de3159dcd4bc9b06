"""Margins, against closed forms, a textbook and python-control."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest

import quell as ql
from quell import analysis
from quell.analysis.margins import _sign_changes, least, margins
from quell.controllers.linear import LinearLaw
from tests.analysed_loops import PLANT, adrc, chain


def integrator(gain: float, dt: float) -> Any:
    """Return a controller of proportional action."""
    nothing = np.zeros(0)
    return SimpleNamespace(
        dt=dt, law=LinearLaw(np.zeros((0, 0)), nothing, nothing, nothing, nothing, gain, -gain)
    )


def test_margins_of_an_integrator_are_those_of_the_closed_form() -> None:
    """``L = K dt/(z − 1)`` has the real part −K dt/2 at all frequencies."""
    K, dt = 20.0, 0.01
    m = analysis.analyse(([1.0], [1.0, 0.0]), integrator(K, dt)).margins
    crossing = 2.0 / dt * math.asin(0.5 * K * dt)
    assert m.gain == pytest.approx((0.0, 2.0 / (K * dt)), rel=1e-12)
    assert m.gain_omega[1] == pytest.approx(math.pi / dt)
    assert m.phase_omega == pytest.approx(crossing, rel=1e-12)
    assert m.phase == pytest.approx(90.0 - math.degrees(0.5 * crossing * dt), rel=1e-12)
    assert m.delay == pytest.approx(math.radians(m.phase) / crossing, rel=1e-12)
    assert m.modulus == pytest.approx(1.0 - 0.5 * K * dt, rel=1e-12)
    # |S − ½| is largest there too: (1 + 0.1)/(1 − 0.1)/2.
    assert m.disk == pytest.approx(2.0 * 0.9 / 1.1, rel=1e-12)
    assert m.disk_gain[1] == pytest.approx(m.gain[1], rel=1e-9)


def test_margins_go_to_the_textbook_s_as_sampling_gets_faster() -> None:
    """``1/(s(s + 1))`` with unit gain: crossover 0.786 rad/s, phase margin 51.83°."""
    m = analysis.analyse(([1.0], [1.0, 1.0, 0.0]), integrator(1.0, 1e-4)).margins
    crossing = math.sqrt((math.sqrt(5.0) - 1.0) / 2.0)
    assert m.phase_omega == pytest.approx(crossing, rel=1e-4)
    assert m.phase == pytest.approx(90.0 - math.degrees(math.atan(crossing)), rel=1e-4)


@pytest.mark.parametrize("plant", [chain(2), chain(4), ql.plants.two_mass_spring()])
def test_margins_are_those_of_python_control(plant: Any) -> None:
    """Gain, phase, modulus and disk margin; ours are refined between the points of a grid, so ours are never larger."""
    controller = adrc(plant.order)
    loop = analysis.analyse(plant, controller)
    m, L = loop.margins, loop.system("L")
    omega = np.geomspace(0.1, 100.0, 2000)
    data = control.FrequencyResponseData(loop.response("L", omega), omega)
    gain, phase, modulus, _, at, _ = control.stability_margins(data)
    assert m.gain[1] == pytest.approx(gain, rel=1e-4)
    assert (m.phase, m.phase_omega) == pytest.approx((phase, at), rel=1e-4)
    assert m.modulus == pytest.approx(modulus, rel=1e-4)
    disk, _, disk_phase = control.disk_margins(L, omega)
    assert (m.disk, m.disk_phase) == pytest.approx((disk, disk_phase), rel=1e-3)
    np.testing.assert_allclose(
        loop.response("L", omega), L(np.exp(1j * omega * loop.dt)), rtol=1e-6
    )


def test_the_summary_says_what_the_disk_margin_allows() -> None:
    """As a factor of the gain and as an angle: a gain or a phase at its end, on the edge of the disk, keeps the loop stable."""
    loop = analysis.analyse(PLANT, adrc(2))
    m = loop.margins
    said = f"disk margin {m.disk:.3f}: gain {m.disk_gain[0]:.3g} … {m.disk_gain[1]:.3g} or phase ±{m.disk_phase:.1f}°, or some of both"
    assert said in loop.summary().splitlines()
    assert m.gain[0] < m.disk_gain[0] < 1.0 < m.disk_gain[1] < m.gain[1]
    assert 0.0 < m.disk_phase < m.phase


def test_a_loop_is_lost_with_the_first_sample_of_delay_beyond_its_delay_margin() -> None:
    """And with the last before it, it is stable."""
    controller = adrc(2)
    samples = analysis.analyse(chain(2), controller).margins.delay / controller.dt
    assert samples > 3.0
    for count, stable in ((math.floor(samples), True), (math.ceil(samples), False)):
        assert analysis.analyse(chain(2), controller, delay=count * controller.dt).stable is stable


def test_an_unstable_loop_has_no_margins() -> None:
    """They are zero, not those of a formula that presumes stability; and it says so."""
    loop = analysis.analyse(([-1.0], [1.0, 0.0, 0.0]), adrc(2))
    assert not loop.stable
    assert (loop.margins.phase, loop.margins.modulus, loop.margins.delay, loop.margins.gain) == (
        0.0,
        0.0,
        0.0,
        (1.0, 1.0),
    )
    assert loop.noise_to_control == math.inf
    assert "unstable" in repr(loop)


@pytest.mark.parametrize("samples", [1, 7, 200])
def test_margins_with_a_dead_time_are_those_of_the_closed_form(samples: int) -> None:
    """``L = K dt z⁻ᵈ/(z − 1)`` has the phase ``−90° − (d + ½) ω dt`` and the gain ``K dt/(2 sin(ω dt/2))``."""
    dt = 0.01
    K = 0.3 / (dt * (samples + 0.5))
    m = analysis.analyse(([1.0], [1.0, 0.0]), integrator(K, dt), delay=samples * dt).margins
    turned = math.pi / (2 * samples + 1)
    assert m.gain == pytest.approx((0.0, 2.0 * math.sin(0.5 * turned) / (K * dt)), rel=1e-11)
    assert m.gain_omega[1] == pytest.approx(turned / dt, rel=1e-11)
    crossing = 2.0 / dt * math.asin(0.5 * K * dt)
    assert m.phase_omega == pytest.approx(crossing, rel=1e-11)
    assert m.phase == pytest.approx(90.0 - math.degrees((samples + 0.5) * crossing * dt), rel=1e-11)
    assert m.delay == pytest.approx(math.radians(m.phase) / crossing, rel=1e-11)


def test_a_gain_margin_may_lie_at_standstill() -> None:
    """``2/(s − 1)`` with unit gain: half of it no longer holds the plant, which then drifts away without oscillation."""
    m = analysis.analyse(([2.0], [1.0, -1.0]), integrator(1.0, 0.01)).margins
    # At z = 1 the sampled plant is the continuous one, −2; at z = −1 it is 2 tanh(dt/2).
    assert m.gain == pytest.approx((0.5, 1.0 / (2.0 * math.tanh(0.005))), rel=1e-5)
    assert 0.0 < m.gain_omega[0] < 0.01
    assert m.gain_omega[1] == pytest.approx(math.pi / 0.01)


def test_a_crossing_that_loses_nothing_is_no_gain_margin() -> None:
    """The negative real axis is crossed at −1/2 and at −1/3, −2 and −4, and only the outer ones change stability."""
    sizes = [0.5, 1.0 / 3.0, 2.0, 4.0]

    def loop(omega: Any) -> Any:
        shape = np.interp(omega, [1.0, 2.0, 3.0, 4.0], sizes)
        return -shape * np.exp(1j * (omega - 1.0) * (omega - 2.0) * (omega - 3.0) * (omega - 4.0))

    omega = np.linspace(0.95, 4.05, 300)
    m = margins(loop, omega, 0.1, lambda gain: 0.3 < gain < 2.9)
    assert m.gain == pytest.approx((0.25, 3.0), rel=1e-9)
    assert m.gain_omega == pytest.approx((4.0, 2.0), rel=1e-9)
    assert margins(loop, omega, 0.1, lambda gain: True).gain == (0.0, math.inf)
    sizes[:] = [0.8, 2.0 / 3.0, 1.25, 1.5]  # factors near one: 1.25, 1.5, 0.8 and 2/3
    for low, high in ((0.8, 1.25), (0.8, 1.5)):
        stable = (0.99 * low, 1.01 * high)
        m = margins(loop, omega, 0.1, lambda gain, stable=stable: stable[0] < gain < stable[1])
        assert m.gain == pytest.approx((low, high), rel=1e-9)


def test_of_several_crossovers_the_least_margins_count() -> None:
    """Whichever comes first: phase and delay have their own; a phase counts in both directions."""

    def least_of(*leads: float) -> Any:
        def loop(omega: Any) -> Any:
            size = np.interp(omega, [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5], [4, 1, 0.5, 1, 2, 1, 0.1])
            lead = np.interp(omega, [1.0, 2.0, 3.0], leads)
            return -size * np.exp(1j * lead)

        return margins(loop, np.linspace(0.45, 3.55, 300), 0.1, lambda gain: True)

    for leads, phase, delay in (
        ((2.0, 1.0, 3.0), (1.0, 2.0), (0.5, 2.0)),
        ((0.5, 2.5, 2.9), (0.5, 1.0), (0.5, 1.0)),
        ((2.0, 2.5, 1.2), (1.2, 3.0), (0.4, 3.0)),
        ((2.0, 1.6, 6.0), (2.0 * math.pi - 6.0, 3.0), (0.8, 2.0)),
    ):
        m = least_of(*leads)
        assert (math.radians(m.phase), m.phase_omega) == pytest.approx(phase, rel=1e-9)
        assert (m.delay, m.delay_omega) == pytest.approx(delay, rel=1e-9)


def test_a_change_of_sign_that_does_not_repeat_is_none() -> None:
    """At half the sampling rate it is a rounding error; what is not finite has no sign."""
    omega = np.array([1.0, 2.0])
    for size, values in (
        (1e-17, [-1e-17, 1e-17]),
        (1.0, [-math.inf, 1.0]),
        (1.0, [-1.0, math.inf]),
    ):
        assert (
            _sign_changes(lambda w, size=size: np.full(w.shape, size), omega, np.array(values))
            == []
        )
    for values in ([-math.inf, 0.5], [-0.5, math.inf]):
        assert _sign_changes(lambda w: w - 1.5, omega, np.array(values)) == []
    assert _sign_changes(lambda w: w - 1.5, omega, omega - 1.5) == pytest.approx([1.5], rel=1e-12)


def test_the_lowest_of_several_dips_is_found_between_the_points_of_the_grid() -> None:
    """Also where the grid shows it as the third lowest; at the ends of the grid it is a grid point."""

    def dips(omega: Any) -> Any:
        x = np.log(omega)
        depths = ((0.5, 1.0), (0.6, 2.0), (0.8, 3.15), (0.1, 4.0))
        return 1.0 - sum(depth * np.exp(-(((x - at) / 0.1) ** 2)) for depth, at in depths)

    omega = np.exp(np.arange(0.0, 5.01, 0.25))
    order = np.argsort(dips(omega))
    assert np.log(omega[order[:3]]) == pytest.approx([2.0, 1.0, 3.25])
    value, at = least(dips, omega, dips(omega))
    assert value == pytest.approx(0.2, abs=1e-9)
    assert math.log(at) == pytest.approx(3.15, abs=1e-4)
    for turned in (1.0, -1.0):
        values = (lambda w, turned=turned: turned * np.log(w))(omega)
        found = least(lambda w, turned=turned: turned * np.log(w), omega, values)
        assert found == (np.min(values), omega[int(np.argmin(values))])


def test_a_disk_margin_of_two_allows_any_gain_and_a_quarter_turn() -> None:
    """It is the largest that a loop with L = 0 at some frequency can have."""
    m = margins(lambda omega: 1j * omega, np.geomspace(0.01, 1.0, 5), 0.1, lambda gain: True)
    m = m._replace(disk=2.0)
    assert m.disk_gain == (0.0, math.inf)
    assert m.disk_phase == pytest.approx(90.0, rel=1e-15)
    assert m._replace(disk=2.0 - 1e-9).disk_gain[1] == pytest.approx(4e9, rel=1e-6)
