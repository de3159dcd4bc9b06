"""Tuning rules for first-order plants with dead time: Skogestad's figures, the equivalent PI, and simulated loops."""

from __future__ import annotations

import math

import numpy as np
import pytest

import quell as ql
from quell import analysis
from quell.controllers import adrc_for_dead_time, dead_time_tuning
from quell.setup import made
from tests.cases import cases

DT = 0.01
HALF = 0.5 * DT


@pytest.mark.parametrize(
    ("T", "largest_sensitivity", "gain_margin", "phase_margin"),
    [(1.0, 1.59, 3.14, 61.4), (8.0, 1.59, 3.14, 61.4), (1e4, 1.70, 2.96, 46.9)],
    ids=["T = L", "T = 8 L", "integrating"],
)
def test_robustness_is_skogestads(
    T: float, largest_sensitivity: float, gain_margin: float, phase_margin: float
) -> None:
    """His table for τ_c = θ (*J. Process Control* 13, 2003, table 2), to its digits with his PI controller, and near them with the ADRC.

    The ADRC's filter, a tenth of the dead time, costs what it has to.
    """
    plant, late = ([1.0], [T, 1.0]), 1.0 - HALF  # the hold adds half a sample
    m = analysis.analyse(plant, ql.baselines.PID.simc(1.0, T, 1.0, dt=DT), delay=late).margins
    assert 1.0 / m.modulus == pytest.approx(largest_sensitivity, abs=0.01)
    assert m.gain[1] == pytest.approx(gain_margin, abs=0.02)
    assert m.phase == pytest.approx(phase_margin, abs=0.2)
    b0, omega_c, omega_o = dead_time_tuning(1.0, T, 1.0)
    observer = ql.ESO.model_free(order=1, b0=b0, omega_o=omega_o, dt=DT)
    m = analysis.analyse(plant, ql.ADRC(observer, omega_c), delay=late).margins
    assert 1.0 / m.modulus == pytest.approx(largest_sensitivity, abs=0.12)
    assert m.gain[1] == pytest.approx(gain_margin, rel=0.09)
    assert m.phase == pytest.approx(phase_margin, abs=3.2)


@cases("rule", ["simc", "amigo"])
@cases("T", [0.1, 1.0, 3.0, 30.0])
def test_the_adrc_is_the_pi_of_the_rule(rule: str, T: float) -> None:
    """Its equivalent PID has K_c and T_i as the rules print them, and a filter of a tenth of L or T_i."""
    K, L = -2.0, 0.7
    b0, omega_c, omega_o = dead_time_tuning(K, T, L, rule=rule)
    if rule == "simc":
        Kc, Ti = T / (2.0 * K * L), min(T, 8.0 * L)
    else:
        Kc = 0.15 / K + (0.35 - L * T / (L + T) ** 2) * T / (K * L)
        Ti = 0.35 * L + 13.0 * L * T**2 / (T**2 + 12.0 * L * T + 7.0 * L**2)
    observer = ql.ESO.model_free(order=1, b0=b0, omega_o=omega_o, dt=1e-3)
    pi = ql.baselines.equivalent_pid(ql.ADRC(observer, omega_c))
    assert (pi.kp, pi.kp / pi.ki) == pytest.approx((Kc, Ti), rel=1e-12)
    assert pi.filter == pytest.approx((0.1 * min(L, Ti), 0.0), rel=1e-12)
    assert omega_o >= omega_c > 0.0


@pytest.mark.parametrize("rule", ["simc", "amigo"])
@pytest.mark.parametrize("ratio", [0.1, 0.2, 1.0, 6.0, 50.0])
def test_loops_of_all_ratios_are_robust(rule: str, ratio: float) -> None:
    """For T/L from 0.1 to 50: 1/modulus below 1.8 (SIMC) and 1.55 (AMIGO); with 30 % more gain and dead time all are stable."""
    plant, controller = ([3.0], [ratio, 1.0]), adrc_for_dead_time(3.0, ratio, 1.0, dt=DT, rule=rule)
    m = analysis.analyse(plant, controller, delay=1.0).margins
    assert 1.0 / m.modulus < {"simc": 1.8, "amigo": 1.55}[rule]
    assert analysis.analyse(([3.9], [ratio, 1.0]), controller, delay=1.3).stable


@pytest.mark.trial
def test_a_late_plant_follows_and_rejects_a_load() -> None:
    """Without visible overshoot, with the integral of the error under a load that theory gives: T_i/K_c."""
    K, T, L = 2.0, 4.0, 1.0
    controller = adrc_for_dead_time(K, T, L, dt=DT)
    plant = ql.plants.LinearPlant.of(([K], [T, 1.0]))
    late = ql.plants.delayed(plant, L, DT)
    step = ql.simulate(late, controller, ql.Scenario(reference=1.0, duration=30.0))
    assert step.metrics(target=1.0, band=0.02)["overshoot"] < 0.05
    assert step["y"][-1] == pytest.approx(1.0, abs=1e-3)
    load = ql.Scenario(disturbances=(ql.signals.Step(height=1.0),), duration=60.0)
    run = ql.simulate(late, controller, load)
    Kc, Ti = T / (K * 2.0 * (L + HALF)), min(T, 8.0 * (L + HALF))
    assert DT * np.sum(run["y"]) == pytest.approx(Ti / Kc, rel=2e-3)


def test_a_setup_file_can_have_it_and_mistakes_are_named() -> None:
    """As a kind of controller, with the options of an ADRC."""
    table = {"kind": "adrc-dead-time", "gain": 2.0, "time_constant": 4.0, "dead_time": 1.0}
    file = {"dt": DT, "controller": table | {"u_max": 3.0, "rule": "amigo"}}
    found = made("late.toml", file).controller
    assert found.observer.b0 == dead_time_tuning(2.0, 4.0, 1.0 + HALF, rule="amigo").b0
    assert found.limits.high == 3.0
    for change, message in (
        ({"gain": 0.0}, "gain = 0.0: must not be zero"),
        ({"dead_time": 0.0}, "dead_time = 0.0: must be finite and greater"),
        ({"rule": "zn"}, "rule = 'zn': must be one of simc, amigo"),
        ({"rule": "amigo", "tau_c": 1.0}, "tau_c = 1.0 with rule = 'amigo': only"),
        ({"gain": 1e-300, "time_constant": 1e300}, "beyond all numbers; check the units"),
        ({"rule": "amigo", "time_constant": 1e300}, "beyond all numbers; check the units"),
    ):
        with pytest.raises(ValueError, match=message):
            made("late.toml", {"dt": DT, "controller": table | change})
    slow = dead_time_tuning(2.0, 4.0, 1.0, tau_c=3.0)
    assert slow.b0 == pytest.approx(2.0 * dead_time_tuning(2.0, 4.0, 1.0).b0, rel=1e-12)
    assert math.isfinite(slow.omega_o)
