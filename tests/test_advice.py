"""Advice on designs: sampling, noise, lags; and the bandwidth for a settling time."""

from __future__ import annotations

import math
import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell import analysis
from quell.controllers import warn_if_unwise
from quell.controllers.adrc import sampling_findings

from .cases import cases


def adrc(
    omega_o: float,
    omega_c: float,
    dt: float,
    order: int = 2,
    form: str = "current",
    **limits: float,
) -> ql.ADRC:
    """Return a controller for b0/s^n."""
    return ql.ADRC(
        ql.ESO.model_free(order=order, b0=1.0, omega_o=omega_o, dt=dt, form=form),
        omega_c=omega_c,
        **limits,
    )


def ideal(order: int) -> tuple[list[float], list[float]]:
    """Return the plant that the observer assumes."""
    return [1.0], [1.0, *[0.0] * order]


@pytest.mark.filterwarnings("ignore::quell.DesignWarning")
@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize(("form", "limit"), [("current", 1.0), ("predictor", 0.3)])
def test_the_limit_of_sampling_is_where_it_costs_a_sixth_of_the_margin(
    order: int, form: str, limit: float
) -> None:
    """At the limit 5 to 17 % of the modulus margin are lost; at twice the limit twice as much and more."""
    for ratio in (3.0, 10.0):
        fast, at_limit, beyond = (
            analysis.analyse(
                ideal(order), adrc(x / 1e-3, x / 1e-3 / ratio, 1e-3, order, form)
            ).margins.modulus
            for x in (0.01, limit, 2.0 * limit)
        )
        assert 0.05 < 1.0 - at_limit / fast < 0.17
        assert 1.0 - beyond / fast > 1.8 * (1.0 - at_limit / fast)


@pytest.mark.filterwarnings("ignore::quell.DesignWarning")
def test_beyond_the_law_s_limit_loops_are_lost() -> None:
    """With omega_o = omega_c, chains of 3 and 4 integrators are stable at ``omega_c dt = 0.5``, and not at 0.7."""
    for order in (3, 4):
        for form in ("current", "predictor"):
            for x, stable in ((0.5, True), (0.7, False)):
                assert (
                    analysis.analyse(
                        ideal(order), adrc(x / 0.01, x / 0.01, 0.01, order, form)
                    ).stable
                    is stable
                )


def test_a_slow_sample_time_is_warned_of_with_its_number() -> None:
    """On behalf of whoever designs; a good design passes in silence."""

    def design(observer: ql.ESO, omega_c: float) -> None:
        warn_if_unwise(observer, omega_c)

    with pytest.warns(
        ql.DesignWarning,
        match=r"omega_o \* dt = 1\.4 is above 1.*0\.00714 s or faster.*to 100 rad/s",
    ) as caught:
        design(adrc(140.0, 10.0, 0.01).observer, 10.0)
    assert caught[0].filename == __file__
    with pytest.warns(
        ql.DesignWarning, match=r"omega_o \* dt = 0\.5 is above 0\.3.*take the current form"
    ):
        design(adrc(50.0, 10.0, 0.01, form="predictor").observer, 10.0)
    with pytest.warns(ql.DesignWarning, match=r"omega_c \* dt = 0\.6 is above 0\.5"):
        design(adrc(90.0, 60.0, 0.01).observer, 60.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        design(adrc(100.0, 10.0, 0.01).observer, 10.0)
        design(adrc(10.0, 50.0, 0.01).observer, math.nextafter(50.0, math.inf))
    assert sampling_findings(adrc(30.0, 10.0, 0.01, form="predictor").observer, 10.0) == []


@pytest.mark.trial
@pytest.mark.compiled
def test_noise_is_judged_by_the_range_of_u() -> None:
    """By the RMS that a simulation shows; the omega_o it names passes, and without a range there is nothing to judge by."""
    plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0])
    controller = adrc(40.0, 4.0, 1e-3, u_min=-2.0, u_max=2.0)
    (finding,) = analysis.advise(controller, noise_std=1e-3)
    noise = 1e-3 * np.random.default_rng(1).normal(size=40_001)
    run = ql.simulate(
        plant,
        controller,
        ql.Scenario(noise=ql.signals.Samples(np.arange(noise.size) * 1e-3, noise), duration=40.0),
    )
    assert finding.subject == "noise"
    assert finding.value == pytest.approx(np.std(run["u"][2000:]) / 4.0, rel=0.05)
    assert finding.value > finding.limit
    lower = float(str(finding).split("lower omega_o to about ")[1].split()[0])
    assert (
        analysis.advise(
            adrc(0.98 * lower, 0.098 * lower, 1e-3, u_min=-2.0, u_max=2.0), noise_std=1e-3
        )
        == []
    )
    assert analysis.advise(adrc(40.0, 4.0, 1e-3), noise_std=1e-3) == []


def test_a_lag_is_judged_by_what_it_leaves_of_the_margins() -> None:
    """With the loop's own numbers: before, after, and the angle at the crossover."""
    controller = adrc(40.0, 4.0, 1e-3)
    assert analysis.advise(controller, actuator_lag=1e-3) == []
    (finding,) = analysis.advise(controller, actuator_lag=0.02)
    before, after = (
        analysis.analyse(ideal(2), controller, actuator_lag=lag).margins for lag in (0.0, 0.02)
    )
    assert finding.subject == "lag"
    assert (finding.value, finding.limit) == pytest.approx((after.modulus, 0.8 * before.modulus))
    cost = math.degrees(math.atan(0.02 * before.phase_omega))
    assert (
        f"an actuator lag of 20 ms, {cost:.1f}° at the crossover of {before.phase_omega:.3g} "
        "rad/s, leaves" in str(finding)
    )
    assert f"a phase margin of {after.phase:.1f}° of {before.phase:.1f}°" in str(finding)


def test_a_delay_beyond_the_delay_margin_is_a_lost_loop() -> None:
    """And is said with the margin."""
    controller = adrc(40.0, 4.0, 1e-3)
    margin = analysis.analyse(ideal(2), controller).margins.delay
    (finding,) = analysis.advise(controller, delay=1.1 * margin)
    assert finding.subject == "stability"
    assert finding.value > 1.0
    assert f"its delay margin is {1e3 * margin:.3g} ms" in str(finding)


def test_a_thin_margin_and_a_lost_loop_are_found_with_the_true_plant() -> None:
    """The plant that the observer assumes is kind to it; another gain is not."""
    controller = adrc(20.0, 4.0, 1e-3)
    assert analysis.advise(controller) == []
    findings = [analysis.advise(controller, ([gain], [1.0, 0.0, 0.0])) for gain in (5.0, -1.0)]
    subjects = [finding.subject for found in findings for finding in found]
    assert subjects == ["margin", "lag", "stability"]  # the lag: one sample takes the delay margin
    with pytest.raises(ValueError, match="does not know its plant"):
        analysis.advise(SimpleNamespace(law=None, dt=0.1))


SPRING = ([2.0, 6.0], [1.0, 0.4, 9.0, 0.0])
WITH_ZEROS = ql.ESO.model_based(SPRING, omega_o=40.0, dt=1e-3)


@cases(
    ("observer", "plant"),
    [
        (WITH_ZEROS, SPRING),
        (ql.ESO.model_based(SPRING, omega_o=40.0, dt=1e-3, b0=1.0), ([1.0, 3.0], SPRING[1])),
        (
            ql.ESO.model_based(
                ([[0.0, 1.0], [-4.0, -0.4]], [1.0, 1.0], [0.0, 1.0], [1.0, 0.0]),
                omega_o=20.0,
                dt=1e-3,
            ),
            ([1.0, 1.4], [1.0, 0.4, 4.0]),
        ),
        (ql.ESO.model_free(order=2, b0=3.0, omega_o=20.0, dt=1e-3), ([3.0], [1.0, 0.0, 0.0])),
    ],
    ids=["zeros", "zeros and a b0", "a channel for f", "a chain"],
)
def test_without_a_plant_it_is_the_one_that_the_observer_assumes(
    observer: ql.ESO, plant: tuple[list[float], list[float]]
) -> None:
    """Zeros, b0 and all: nothing but the lag is found, and that with the numbers of the plant itself."""
    controller = ql.ADRC(observer, omega_c=4.0)
    assert analysis.advise(controller) == []
    (finding,) = analysis.advise(controller, actuator_lag=0.05)
    expected = analysis.analyse(plant, controller, actuator_lag=0.05)
    value = expected.margins.modulus if expected.stable else max(abs(expected.poles))
    assert finding.value == pytest.approx(value, rel=1e-6)


@pytest.mark.filterwarnings("ignore::quell.DesignWarning")
def test_a_delay_that_the_observer_knows_of_is_in_the_plant_that_it_assumes() -> None:
    """It is no news; what it takes of the margin is found. Another delay comes on top of it."""

    def controller(omega_c: float) -> ql.ADRC:
        return ql.ADRC(
            ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01, delay=0.2), omega_c=omega_c
        )

    calm, hasty = controller(0.5), controller(2.0)
    assert analysis.advise(calm) == []
    margin = analysis.advise(hasty)[-1]
    assert margin.subject == "margin"
    assert margin.value == pytest.approx(
        analysis.analyse(ideal(2), hasty, delay=0.2).margins.modulus
    )
    (lag,) = analysis.advise(calm, delay=0.1)
    assert lag.subject == "lag"
    assert lag.value == pytest.approx(analysis.analyse(ideal(2), calm, delay=0.3).margins.modulus)


@cases("order", [1, 2, 3, 4, 8])
def test_the_ideal_loop_settles_when_asked(order: int) -> None:
    """The step response of ``omega_c^n/(s + omega_c)^n``, summed, enters the band at that time."""
    for band in (0.02, 0.002):
        x = ql.omega_c_for(3.0, order, band) * 3.0
        left = math.exp(-x) * sum(x**k / math.factorial(k) for k in range(order))
        assert left == pytest.approx(band, rel=1e-9)


def test_herbst_s_rules_are_rounded_up() -> None:
    """4/T and 6/T for orders 1 and 2 and a band of 2 %."""
    for order, rule in ((1, 4.0), (2, 6.0)):
        assert 0.97 * rule < ql.omega_c_for(1.0, order) < rule


@pytest.mark.trial
def test_a_loop_with_a_model_and_a_fast_observer_settles_when_asked() -> None:
    """To 1 %, for a plant of order 3."""
    plant = ql.plants.LinearPlant(
        [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, -2.0, -1.5]], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    )
    controller = ql.ADRC(ql.ESO.model_based(plant, omega_o=60.0, dt=1e-3), ql.omega_c_for(4.0, 3))
    run = ql.simulate(plant, controller, ql.Scenario(reference=1.0, duration=10.0))
    assert run.metrics(target=1.0, band=0.02)["settling_time"] == pytest.approx(4.0, rel=0.01)


def test_a_wish_that_can_not_be_met_is_said_in_a_line() -> None:
    """By argument, value and rule."""
    for arguments, message in (
        ((0.0, 2), "settling_time = 0.0: must be finite and greater than zero"),
        ((1.0, 0), "order = 0: must be a whole number of at least 1"),
        ((1.0, 2, 1.0), "band = 1.0: must be below 1"),
    ):
        with pytest.raises(ValueError, match=message):
            ql.omega_c_for(*arguments)


CHAIN = ([1.0], [1.0, 0.0, 0.0])


@pytest.mark.filterwarnings("ignore::quell.DesignWarning")
@cases(
    ("plant", "poor", "advice", "better"),
    [
        (CHAIN, {"b0": -1.0}, "b = 1 and b0 = -1 differ in sign: correct b0", {}),
        (([5.0], CHAIN[1]), {}, "b/b0 = 5: take b0 = 5,", {"b0": 5.0}),
        (([0.02], CHAIN[1]), {}, "b/b0 = 0.02: take b0 = 0.02,", {"b0": 0.02}),
        (
            ([1.0], [1.0, 1.0, 0.0]),
            {"order": 1},
            "u reaches the derivative 2 of y first, and the observer assumes 1: take an observer of "
            "order 2,",
            {"order": 2},
        ),
        (
            CHAIN,
            {"dt": 1.0},
            "sample faster, or lower omega_o and omega_c together",
            {"dt": 1.0, "omega_o": 1.0, "omega_c": 0.2},
        ),
        (CHAIN, {"delay": 0.2}, ": lower omega_c", {"delay": 0.2, "omega_c": 1.25}),
        (
            ([1.0], [1.0, -30.0]),
            {"order": 1},
            "raise omega_o (noise permitting): the plant itself is unstable",
            {"order": 1, "omega_o": 90.0},
        ),
        (
            ([1.0], [1.0, 0.0, 0.0, 0.0, 0.0]),
            {"order": 4, "omega_c": 6.5, "dt": 1e-3},
            "raise omega_o (noise permitting) or lower omega_c",
            {"order": 4, "omega_c": 2.0, "dt": 1e-3},
        ),
    ],
)
def test_what_is_advised_helps(
    plant: Any, poor: dict[str, Any], advice: str, better: dict[str, Any]
) -> None:
    """A loop that is lost or nearly so gets the advice of its cause, and with it nothing is found but the sampling."""

    def found(**changes: Any) -> list[analysis.Finding]:
        design = {"order": 2, "b0": 1.0, "omega_o": 20.0, "dt": 0.01} | changes
        omega_c = design.pop("omega_c", 4.0)
        return analysis.advise(ql.ADRC(ql.ESO.model_free(**design), omega_c), plant, delay=0.0)

    worst = found(**poor)[-1]
    assert worst.subject in ("stability", "margin")
    assert advice in str(worst)
    assert found(**better) == []


def test_advice_to_a_linear_controller_does_not_speak_of_observers() -> None:
    """It has gains."""
    (finding,) = analysis.advise(ql.baselines.PID(-0.5, dt=0.01), ([1.0], [1.0, 0.0]))
    assert str(finding).endswith(": change its gains")
    late = analysis.advise(ql.baselines.PID(2.0, dt=0.01), ([1.0], [1.0, 0.0]), delay=1.0)
    assert str(late[-1]).endswith("shorten it, or lower its gains")


def test_a_known_delay_is_not_advised_to_be_made_known() -> None:
    """And times from a second on are said in seconds."""
    for known, hint in ((0.0, True), (2.0, False)):
        observer = ql.ESO.model_free(order=1, b0=1.0, omega_o=4.0, dt=0.1, delay=known)
        controller = ql.ADRC(observer, omega_c=0.2)
        finding = analysis.advise(controller, ([1.0], [1.0, 0.0]), delay=2.0)[-1]
        assert ("let the observer know of the delay" in str(finding)) is hint
        assert "a delay of 2 s" in str(finding)


def test_the_summary_of_a_loop_that_needs_no_phase_margin_says_so() -> None:
    """There are no infinite degrees and no times that are not numbers."""
    loop = analysis.analyse(([1e-9], [1.0, 1.0]), ql.baselines.PID(0.5, dt=0.01))
    assert "no limit of the phase: the gain is never 1" in loop.summary()
    assert "delay margin infinite" in loop.summary()
    assert "nan" not in loop.summary()
    assert loop.margins.phase == math.inf


@pytest.mark.trial
def test_a_law_that_is_faster_than_its_observer_is_found() -> None:
    """At ten times omega_o the loop keeps its margins, but a wrong b0 makes it ten times as slow as the law says."""
    (finding,) = analysis.advise(adrc(20.0, 200.0, 1e-3))
    assert (finding.subject, finding.value, finding.limit) == ("bandwidth", 10.0, 1.0)
    assert "lower omega_c to 20 rad/s or less, or raise omega_o to 200 rad/s or more" in str(
        finding
    )
    assert analysis.advise(adrc(20.0, 20.0, 1e-3)) == []
    plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 0.8], [1.0, 0.0])
    slow, fast = (
        ql.simulate(
            plant, adrc(20.0, omega_c, 1e-3), ql.Scenario(reference=1.0, duration=3.0)
        ).metrics(target=1.0, band=0.02)["settling_time"]
        for omega_c in (20.0 / 3.0, 200.0)
    )
    ideal = 5.83  # omega_c times the settling time of two poles at −omega_c, to 2 %
    assert slow * 20.0 / 3.0 < 1.2 * ideal
    assert fast * 200.0 > 5.0 * ideal


def test_a_delay_that_nobody_stated_is_found_where_it_loses_the_loop() -> None:
    """The one of a sample that the calculation takes, and the plant's own that the observer does not know."""
    hasty = adrc(60.0, 20.0, 0.01, order=3)
    finding = analysis.advise(hasty)[-1]
    margin = analysis.analyse(ideal(3), hasty).margins.delay
    assert (finding.subject, finding.value, finding.limit) == ("lag", pytest.approx(margin), 0.01)
    assert not analysis.analyse(ideal(3), hasty, delay=0.01).stable
    assert f"the delay margin of {1e3 * margin:.3g} ms is below one sample of 10 ms" in str(finding)
    assert analysis.advise(hasty, delay=0.01)[-1].subject == "stability"  # now it is stated
    double = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0])
    unaware = adrc(40.0, 4.0, 0.01)
    (finding,) = analysis.advise(unaware, ql.plants.delayed(double, 0.5, 0.01))
    margin = analysis.analyse(ideal(2), unaware).margins.delay
    assert finding.subject == "stability"
    assert str(finding).startswith("the loop is unstable with the plant's delay of 500 ms")
    assert f"stable up to {1e3 * margin:.3g} ms; let the observer know of the delay" in str(finding)


def test_times_in_one_message_have_one_unit() -> None:
    """A delay of a second beside a delay margin and a lag below it: all in seconds."""
    findings = analysis.advise(adrc(40.0, 4.0, 0.01), actuator_lag=1e-3, delay=1.0)
    (finding,) = findings
    assert "an actuator lag of 0.001 s and a delay of 1 s" in str(finding)
    assert "its delay margin is 0." in str(finding)
    assert " ms" not in str(finding)
