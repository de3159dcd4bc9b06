"""Each argument of tuning, identification and excitation out of its range is named with its value and rule."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.identification import (
    excitation,
    frequency_response,
    identify_b0_matrix,
    interleaved_excitations,
    save_excitations,
)
from quell.tuning import Constraints
from quell.tuning.by_simulation import tune_structure

from .cases import cases

LAG = ([1.0], [1.0, 1.0])
DT = 0.05
rng = np.random.default_rng(3)
U = np.sign(rng.standard_normal(200)).repeat(2)[:200]
Y = np.cumsum(U) * 0.1
SHAPE = {"structure": "pi", "compare": (), "written": False, "objective": "load"}


def tune(**options: Any) -> Any:
    """Tune a lag."""
    return ql.tune(options.pop("plant", LAG), options.pop("dt", DT), **{**SHAPE, **options})


@cases(
    ("options", "message"),
    [
        ({"dt": 0.0}, "dt = 0.0"),
        ({"structure": "piid"}, "structure = 'piid'"),
        ({"compare": "pi"}, "compare = 'pi': must be a list of structures"),
        ({"compare": ("none",)}, "compare = 'none'"),
        ({"quantile": 0.0}, "quantile = 0.0: must be above 0 and at most 1, the worst case"),
        ({"quantile": 1.01}, "quantile = 1.01"),
        ({"seed": -1}, "seed = -1"),
        ({"seed": 0.5}, "seed = 0.5"),
        ({"load": 0.0, "objective": "load-iae"}, "load = 0.0"),
        ({"duration": -1.0, "reference": 1.0, "objective": "tracking"}, "duration = -1.0"),
        ({"order": 0, "structure": "bandwidths"}, "order"),
        ({"u_min": 1.0, "u_max": -1.0}, "u_min = 1.0, u_max = -1.0"),
        ({"u_mx": 1.0}, "u_mx: tune has no such argument"),
        (
            {"m_s": 1.5},
            r"m_s = 1.5: is a bound of the loop; give constraints=quell.tuning.Constraints\(m_s=1.5\)",
        ),
        ({"search": {"trials": 3}}, "is for a tuning by simulation; give a scenario, too"),
        ({"constraints": {"m_s": 1.5}}, r"must be quell.tuning.Constraints\(m_s=…\)"),
        ({"samples": 5}, "samples = 5: has no effect: no plant is drawn"),
        ({"check_samples": 5}, "check_samples = 5: has no effect"),
        ({"seed": 3}, "seed = 3: has no effect"),
        ({"load": 2.0}, "load = 2.0: has no effect"),
        (
            {"reference": 1.0},
            "reference = 1.0: has no effect: objective = 'load' is about the load",
        ),
        ({"quantile": 0.5}, "quantile = 0.5: has no effect"),
        ({"objective": "iae"}, "objective = 'iae': must be load, load-iae or tracking"),
        ({"objective": "tracking"}, "objective = 'tracking' needs a signal to follow"),
        ({"delay": -0.1}, "delay"),
        ({"actuator_lag": -0.1}, "lag"),
        ({"rest": (1.0,)}, "rest"),
    ],
)
def test_an_argument_of_tune_out_of_range_is_named(options: Any, message: str) -> None:
    """Before anything is searched."""
    with pytest.raises(ValueError, match=message):
        tune(**options)


@cases(
    ("options", "message"),
    [
        ({"samples": 0}, "samples = 0"),
        ({"seed": -1}, "seed = -1"),
    ],
)
def test_draws_of_a_plant_out_of_range_are_named(options: Any, message: str) -> None:
    """Of plants for ranges of their parameters."""
    with pytest.raises(ValueError, match=message):
        tune(plant=lambda gain: ([gain], [1.0, 1.0]), uncertain={"gain": (0.9, 1.1)}, **options)


@cases(
    ("options", "message"),
    [
        ({"m_s": 1.0}, "m_s = 1.0: must be above 1"),
        ({"m_t": 0.9}, "m_t = 0.9: must be above 1"),
        ({"m_s": None, "m_t": None}, "m_s = None, m_t = None: one of them must bound the loop"),
        ({"damping": 1.0}, "damping = 1.0: must be below 1"),
        ({"damping": 0.0}, "damping = 0.0"),
        ({"u_std": 0.1}, "u_std = 0.1: needs noise_std or resolution"),
        ({"noise_std": -1.0}, "noise_std = -1.0"),
        ({"resolution": 0.0}, "resolution = 0.0"),
        ({"noise_share": 0.0}, "noise_share = 0.0"),
        ({"delay_margin": 0.0}, "delay_margin = 0.0"),
        ({"u_max": -1.0}, "u_max = -1.0"),
        ({"rate_max": 0.0}, "rate_max = 0.0"),
        ({"noise_over_pi": 0.0}, "noise_over_pi = 0.0"),
        ({"omega_o_dt": -1.0}, "omega_o_dt = -1.0"),
        ({"m_ks": 0.0}, "m_ks = 0.0"),
    ],
)
def test_a_bound_that_no_loop_can_have_is_named(options: Any, message: str) -> None:
    """Each by its name; None is none."""
    with pytest.raises(ValueError, match=message):
        Constraints(**options)


def test_the_bounds_that_hold_are_said() -> None:
    """In their order; what is None is left out."""
    assert str(Constraints(m_t=None, damping=None)) == (
        "M_s ≤ 1.6, |p| dt ≤ 0.5 for poles of observers and filters"
    )
    all_of_them = Constraints(
        m_ks=3.0, u_std=0.1, noise_std=0.01, delay_margin=0.2, u_max=2.0, rate_max=5.0
    )
    assert str(all_of_them) == (
        "M_s ≤ 1.6, M_t ≤ 1.6, M_ks ≤ 3, std(u) ≤ 0.1 for noise of 0.01 in y, delay margin ≥ 0.2 s, "
        "damping ≥ 0.4, |u| ≤ 2, |u'| ≤ 5/s, |p| dt ≤ 0.5 for poles of observers and filters"
    )


@cases(
    ("options", "message"),
    [
        ({"tables": "none"}, "tables = 'none'"),
        ({"structure": "pid"}, "structure = 'pid'"),
        ({"compare": ("pi",)}, "compare: tune_schedule has no such argument"),
        ({"order": 9}, "order = 9"),
        ({"between": -1}, "between = -1"),
        ({"points": None}, "a plant that is a function needs the points of the tables"),
        ({"points": (1.0, 1.0)}, "points"),
        ({"plant": 3.0}, "plant = 3.0: must be a function of the signal that returns a plant"),
        ({"plant": {}, "points": None}, r"keys must be numbers, or pairs of two numbers"),
        ({"plant": {0.0: LAG}, "points": (0.0, 1.0)}, "points: the plants have them, as keys"),
        (
            {"plant": {(0.0, 0.0): LAG, (1.0, 1.0): LAG}, "points": None},
            "needs one for each pair of points",
        ),
        (
            {"plant": {0.0: LAG, 1.0: ([1.0], [1.0, 1.0, 1.0])}, "points": None},
            r"plant at \(1.0,\) has the relative degree 2, the first one 1",
        ),
    ],
)
def test_an_argument_of_a_schedule_out_of_range_is_named(options: Any, message: str) -> None:
    """And plants that one controller can not serve."""
    given = {"plant": lambda b: ([b], [1.0, 1.0]), "points": (1.0, 2.0), **options}
    with pytest.raises(ValueError, match=message):
        ql.tune_schedule(given.pop("plant"), DT, **given)


def test_the_factor_of_a_search_is_above_one() -> None:
    """The width of its ranges."""
    for factor in (1.0, math.nan):
        with pytest.raises(ValueError, match="factor = "):
            tune_structure(None, None, {}, factor=factor)  # type: ignore[arg-type]


# ---- identification


@cases(
    ("options", "message"),
    [
        ({"order": 0}, "order = 0"),
        ({"order": 9}, "order = 9"),
        ({"order": 1.5}, "order = 1.5"),
        ({"zeros": -1}, "zeros = -1"),
        ({"zeros": 2}, "zeros = 2"),
        ({"integrators": -1}, "integrators = -1"),
        ({"integrators": 2}, "integrators = 2"),
        ({"dt": 0.0}, "dt = 0.0"),
        ({"horizon": 0}, "horizon = 0"),
        ({"held_out": 0.95}, "held_out = 0.95: must be from 0 to 0.9"),
        ({"held_out": -0.1}, "held_out = -0.1"),
        ({"held_out": 0.01}, "held_out = 0.01: of 200 samples these are 2, must be at least"),
        ({"held_out": 0.295}, "of 200 samples these are 59, must be at least 60 to be judged on"),
        ({"held_out": 0.1, "horizon": 4}, "of 200 samples these are 20, must be at least 24 to be"),
        ({"delay": -0.1}, "delay = -0.1"),
        (
            {"delay": (0.3, 0.1)},
            r"delay = \(0.3, 0.1\): must be from 0 on, and the smallest comes first",
        ),
        ({"reference": U[:100]}, "reference"),
        ({"validation": (U[:5], Y[:5])}, "validation: has 5 samples, must have at least"),
        ({"validation": (U, np.ones(200))}, "validation: y is 1 all through: must move"),
        ({"u": U[:20], "y": Y[:20]}, "u has 20 samples, .* must have at least"),
        ({"u": U[:100]}, "y"),
        (
            {"u": np.ones(200)},
            "u is 1 all through the samples for the fit: must move; of a y that rings",
        ),
        ({"y": np.ones(200)}, "y is 1 all through the samples for the fit: must move$"),
        ({"y": np.full(200, math.nan)}, "y"),
        ({"friction": True, "rest": True}, "rest"),
    ],
)
def test_an_argument_of_identify_out_of_range_is_named(options: Any, message: str) -> None:
    """Before anything is fitted."""
    given = {"u": U, "y": Y, "dt": 0.1, "order": 1, "delay": 0.0, **options}
    with pytest.raises(ValueError, match=message):
        ql.identify(**given)


@cases(
    ("arguments", "message"),
    [
        (("sine", (1.0, 10.0), 10.0, 0.01), "kind = 'sine'"),
        (
            ("prbs", (0.0, 10.0), 10.0, 0.01),
            "band = .*: must rise from above 0 to below pi / dt = 314.2",
        ),
        (("prbs", (10.0, 1.0), 10.0, 0.01), "band"),
        (("prbs", (1.0, 315.0), 10.0, 0.01), "band"),
        (("prbs", (1.0, 10.0), 0.0, 0.01), "duration = 0.0"),
        (("prbs", (1.0, 10.0), 10.0, 0.0), "dt = 0.0"),
        (("prbs", (1.0, 10.0), 0.1, 0.01), "duration = 0.1 s: must be at least 16 samples"),
        (("prbs", (0.001, 10.0), 10.0, 0.01), "and a tenth of the slowest period, 6283 s"),
        (("prbs", (1.0, 10.0), 10.0, 0.01, 1.0, -1.0), "u_min = 1.0, u_max = -1.0"),
        (("prbs", (1.0, 10.0), 10.0, 0.01, -math.inf, 1.0), "u_min"),
        (("multisine", (1.0, 1.1), 3.0, 0.01), "band = .*: has no multiple of"),
    ],
)
def test_an_argument_of_an_excitation_out_of_range_is_named(arguments: Any, message: str) -> None:
    """Kind, band, duration, sample time, limits, seed."""
    with pytest.raises(ValueError, match=message):
        excitation(*arguments)
    with pytest.raises(ValueError, match="seed = -1"):
        excitation("prbs", (1.0, 10.0), 10.0, 0.01, seed=-1)


def test_a_multisine_has_whole_periods_of_its_lowest_line() -> None:
    """Of 1 rad/s in 20 s: three periods of 6.66 s, with lines at its multiples, from the first on."""
    found = excitation("multisine", (1.0, 10.0), 20.0, 0.01, -2.0, 3.0)
    assert found.period == pytest.approx(6.66)
    base = 2.0 * math.pi / 6.66
    spectrum = np.abs(np.fft.rfft(found.u[:666] - np.mean(found.u[:666])))
    lines = np.flatnonzero(spectrum > 0.1 * np.max(spectrum))
    assert lines[0] == 1
    assert lines[-1] == math.floor(10.0 / base + 1e-9)
    assert found.band == pytest.approx((base, lines[-1] * base))
    assert (float(np.min(found.u)), float(np.max(found.u))) == (-2.0, 3.0)
    np.testing.assert_allclose(found.u[:666], found.u[666:1332], atol=1e-9)
    away = found.u - np.mean(found.u)
    assert found.crest == pytest.approx(float(np.max(np.abs(away)) / np.sqrt(np.mean(away**2))))
    other = excitation("multisine", (1.0, 10.0), 20.0, 0.01, -2.0, 3.0, seed=90)
    assert not np.allclose(other.u, found.u, atol=0.1)
    few = excitation("multisine", (1.0, 10.0), 7.0, 0.01)
    assert any("there is only one period" in text for text in few.shortcomings)


def test_actuators_have_lines_of_their_own(tmp_path: Any) -> None:
    """Each line belongs to one of them; a file has a column for each."""
    designs = interleaved_excitations(2, (1.0, 10.0), 20.0, 0.01)
    spectra = [np.abs(np.fft.rfft(each.u[:666] - np.mean(each.u[:666]))) for each in designs]
    taken = [set(np.flatnonzero(each > 0.1 * np.max(each)).tolist()) for each in spectra]
    assert not taken[0] & taken[1]
    assert taken[0] | taken[1] <= set(range(1, 11))
    assert min(map(len, taken)) >= 3
    save_excitations(designs, tmp_path / "u.csv")
    lines = (tmp_path / "u.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "t,u1,u2"
    assert len(lines) == 2001
    assert [float(each) for each in lines[3].split(",")] == pytest.approx(
        [0.02, designs[0].u[2], designs[1].u[2]]
    )
    for options, message in (
        ({"actuators": 0}, "actuators = 0"),
        ({"actuators": 12}, "lines: must have one for each of 12 actuators at least"),
    ):
        with pytest.raises(ValueError, match=message):
            interleaved_excitations(
                **{"actuators": 2, "band": (1.0, 10.0), "duration": 20.0, "dt": 0.01, **options}
            )


def test_a_frequency_response_is_that_of_the_plant() -> None:
    """Of a held white u through a lag, by averages over eight segments; y = 3 u has 3 and a coherence of 1."""
    white = np.random.default_rng(1).standard_normal(4000)
    found = frequency_response(white, 3.0 * white, 0.1)
    np.testing.assert_allclose(found.response, 3.0, rtol=1e-9)
    np.testing.assert_allclose(found.coherence, 1.0)
    np.testing.assert_allclose(found.deviation, 0.0, atol=1e-6)
    assert found.omega[0] > 0.0
    assert found.omega[-1] == pytest.approx(math.pi / 0.1, rel=0.01)
    noisy = frequency_response(white, white + np.random.default_rng(2).standard_normal(4000), 0.1)
    assert float(np.mean(noisy.coherence)) == pytest.approx(0.5, abs=0.08)
    assert float(np.median(noisy.deviation)) == pytest.approx(
        math.sqrt(0.5 / (2.0 * 0.5 * 8)), rel=0.2
    )
    for options, message in (
        ({"segments": 1}, "segments = 1"),
        (
            {"segments": 400},
            "u has 4000 samples: must have at least 6800 for 400 segments; take fewer",
        ),
        ({"dt": 0.0}, "dt = 0.0"),
        ({"y": white[:-1]}, "y"),
        ({"reference": white[:-1]}, "reference"),
    ):
        with pytest.raises(ValueError, match=message):
            frequency_response(**{"u": white, "y": white, "dt": 0.1, **options})


@cases(
    ("options", "message"),
    [
        ({"order": 5}, "order"),
        ({"order": (1, 1, 1)}, "order"),
        ({"dt": 0.0}, "dt = 0.0"),
        ({"u": U}, "u has the shape"),
        ({"axes": ["a"]}, "axes = .*: must be 2 different names"),
        ({"actuators": ["a", "a"]}, "actuators = .*: must be 2 different names"),
        ({"max_delay": -1.0}, "max_delay = -1.0"),
    ],
)
def test_an_argument_of_a_gain_matrix_out_of_range_is_named(options: Any, message: str) -> None:
    """Orders, names, tables of signals."""
    table = np.column_stack([U, np.roll(U, 7)])
    given = {"u": table, "y": np.cumsum(table, axis=0), "dt": 0.1, "order": 1, **options}
    with pytest.raises(ValueError, match=message):
        identify_b0_matrix(**given)
