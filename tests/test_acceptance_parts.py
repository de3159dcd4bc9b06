"""What tune says of a design at the limits of u; constraints as text; designs of excitations in words."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.prefilters import ReferenceModel
from quell.identification import excitation
from quell.identification.excitation import interleaved_excitations, save_excitations
from quell.plants.linear import LinearPlant
from quell.tuning import Constraints
from quell.tuning.acceptance import (
    Judged,
    Seen,
    _of_others,
    _seen,
    _together,
    accepted,
    conditionally_stable,
    place_of,
    with_others,
)
from quell.tuning.constraints import first_given, given_constraints
from quell.tuning.plants import given_plants, plant_set
from quell.tuning.written import MoveFigures, Overload, StepFigures, Written

from .cases import cases

DT = 0.05
LAG = LinearPlant.of(([2.0], [1.0, 1.0]))
STEP = StepFigures(2.0, 1.0, 0.03, 0.8, 0.02, 5.0, 0.1)
MOVE = MoveFigures(0.4, 0.1)
LOAD = Overload(1.4, 0.5, 2.0, 1.2, 0.6)
NEVER = LOAD._replace(back=math.nan)


def seen(
    name: str = "plant 2", step: Any = STEP, move: Any = None, loads: Any = (), fails: Any = ()
) -> Seen:
    """Return what a controller does with another plant."""
    return Seen(name, step, move, tuple(loads), tuple(fails))


def judged(**parts: Any) -> Judged:
    """Return a design in its file."""
    nothing = Judged(None, None, STEP, None, None, None, (), ())  # type: ignore[arg-type]
    return nothing._replace(**parts)


# ---- texts


def test_a_judged_design_is_told_in_lines() -> None:
    """Its step with a prefilter or one that is offered, a larger step, overloads, failures."""
    assert str(judged()) == (
        "step of the reference by 2 at 1 s: overshoots by 3.0 %, settles within 2 % in 0.8 s"
    )
    model = ReferenceModel(4.0, 2)
    assert str(judged(prefilter=model)).endswith(
        'in 0.8 s, behind the [prefilter] kind = "reference-model", omega = 4, order = 2'
    )
    offered = judged(offered=model, offered_step=STEP._replace(overshoot=0.05, settling=1.23456))
    assert str(offered).endswith(
        'in 0.8 s; with a prefilter ([prefilter] kind = "reference-model", omega = 4, order = 2) it '
        "overshoots by 5.0 % and settles in 1.23 s"
    )
    assert str(judged(offered=model)) == str(judged())
    lost = STEP._replace(settling=math.nan)
    larger = judged(larger=lost)
    assert str(larger).splitlines()[1] == (
        "one near what u can hold, NOT settled: step of the reference by 2 at 1 s: overshoots by "
        "3.0 %; not within 2 % at the end of its 5 s"
    )
    both = judged(overloads=(LOAD, NEVER), failures=("NOT a", str(STEP)))
    assert str(both).splitlines()[1:] == [
        "overload, a load of 1.4 times what u can hold: 1.4 for 0.5 s: back in 1.2 s; 1.4 for 0.5 "
        "s: back never",
        "NOT a",
    ]
    moving = judged(step=None, move=MOVE)
    assert str(moving) == "scenario: the largest |r − y| is 0.4, 0.1 in its last tenth"
    several = judged(others=(seen(), seen("plant 3")), several="with 2 other plants")
    assert str(several).splitlines()[1] == (
        "with 2 other plants: overshoots by 3.0 %, settles in 0.8 s at most"
    )
    axes = judged(step=None, others=(seen("x"), seen("y", None, MOVE)))
    assert str(axes).splitlines() == [f"{STEP} (x)", f"{MOVE} (y)"]


def test_a_judged_design_is_a_table() -> None:
    """Step with its prefilter, overloads, others and what fails."""
    model = ReferenceModel(4.0, 2)
    value = judged(prefilter=model, offered=model, overloads=(LOAD,), failures=("NOT a",)).to_json()
    step = value["reference_step"]
    assert "signals" not in step
    assert (step["overshoot"], step["settling"], step["size"]) == (0.03, 0.8, 2.0)
    assert step["prefilter"] == {"kind": "reference-model", "omega": 4.0, "order": 2}
    assert step["prefilter_omega"] == 4.0
    assert value["overloads"] == [LOAD.to_json()]
    assert value["not"] == ["NOT a"]
    assert "others" not in value
    plain = judged(others=(seen(loads=[LOAD]), seen("y", None, MOVE))).to_json()
    assert plain["reference_step"]["prefilter"] is None
    assert plain["reference_step"]["prefilter_omega"] is None
    first, second = plain["others"]
    assert (first["name"], first["move"], first["overloads"]) == ("plant 2", None, [LOAD.to_json()])
    assert first["step"]["looked"] == 5.0
    assert second["step"] is None
    assert second["move"] == {"largest": 0.4, "last": 0.1}
    assert judged(step=None).to_json()["reference_step"] is None


def test_several_plants_are_told_by_their_worst() -> None:
    """Overshoot, settling, the largest error, and the time back; what never comes is said."""
    slow = STEP._replace(overshoot=0.01, settling=2.5)
    assert _together([seen(), seen(step=slow)]) == "overshoots by 3.0 %, settles in 2.5 s at most"
    lost = seen(step=STEP._replace(settling=math.nan))
    assert _together([seen(), lost]) == "overshoots by 3.0 %, not all settle at most"
    moves = [seen(step=None, move=MOVE), seen(step=None, move=MOVE._replace(largest=0.7))]
    assert _together(moves) == "the largest |r − y| is 0.7"
    back = seen(step=None, loads=[LOAD, LOAD._replace(back=3.0)])
    assert (
        _together([back]) == "back in 3 s after overloads at most"
        or _together([back]) == "back in 3 s"
    )
    never = seen(step=None, loads=[LOAD, NEVER])
    assert "not back from all overloads" in _together([never])
    assert _together([]) == ""


def test_the_first_failure_of_others_is_told_with_how_many_fail() -> None:
    """One of one has no count."""
    assert _of_others([seen(), seen()]) == ()
    bad = seen(fails=["NOT stable: a (plant 2)", "NOT b"])
    assert _of_others([seen(), bad, bad]) == ("NOT stable: a (plant 2); 2 of 3 fail",)
    assert _of_others([bad]) == ("NOT stable: a (plant 2)",)


def test_a_design_that_fails_gives_way_to_the_first_that_does_not() -> None:
    """With the reason; where none passes it stays."""
    results = {
        "a": judged(failures=("NOT a",)),
        "b": judged(failures=("NOT b",)),
        "c": judged(),
        "d": judged(),
    }
    asked = []

    def judge(name: str) -> Judged:
        asked.append(name)
        return results[name]

    assert accepted("a", ["b", "c", "d"], judge, "pi") == (
        "c",
        results["c"],
        "pi is left out: NOT a",
    )
    assert asked == ["a", "b", "c"]
    assert accepted("a", ["b"], judge, "pi") == ("a", results["a"], "")
    asked.clear()
    assert accepted("c", ["d"], judge, "pi") == ("c", results["c"], "")
    assert asked == ["c"]


def test_loops_that_need_a_least_gain_are_conditionally_stable() -> None:
    """The largest of the least gains and the least of the largest."""
    assert conditionally_stable([]) == []
    assert conditionally_stable([(0.0, 3.0), (0.0, 5.0)]) == []
    assert conditionally_stable([(0.0, 3.0), (0.25, 5.0)], " of x") == [
        "conditionally stable: it bears 0.25 to 3 times its gain of x"
    ]


class _File:
    """A file of which a run has given figures."""

    def __init__(self, step: Any, move: Any = None, cycling: bool = False, loads: Any = ()) -> None:
        self.name, self._step, self._move = "", step, move
        self._cycling, self._loads, self.asked = cycling, list(loads), 0

    def runs(self, controller: Any) -> list[str]:
        return ["run"]

    def of_draws(self, controller: Any, runs: Any) -> Any:
        assert runs == ["run"]
        return self._step, self._move

    def cycles(self, controller: Any, run: Any) -> bool:
        return self._cycling

    def overloads(self, *_: Any) -> Any:
        self.asked += 1
        return self._loads


LIMITED = SimpleNamespace(limits=SimpleNamespace(low=-1.0, high=1.0))
FREE = SimpleNamespace(limits=SimpleNamespace(low=-1.0, high=math.inf))
HELD = np.array([[-1.0]])


def looked(
    file: _File,
    controller: Any = LIMITED,
    remedy: str = "do less",
    held: Any = HELD,
    name: str = "",
) -> Seen:
    """Return what is seen of a file."""
    return _seen(file, controller, 0.5, held, remedy, name)  # type: ignore[arg-type]


def test_overshoot_cycles_and_slow_recovery_are_failures_where_u_has_limits() -> None:
    """From 6 % on; each line begins with NOT, with the name of the plant behind it."""
    passes = looked(_File(STEP, loads=[LOAD]))
    assert (passes.failures, passes.overloads, passes.step) == ((), (LOAD,), STEP)
    over = STEP._replace(overshoot=0.061)
    (line,) = looked(_File(over)).failures
    assert line == "NOT below 5 %: the step overshoots by 6.1 %: do less"
    assert looked(_File(STEP._replace(overshoot=0.0599))).failures == ()
    assert looked(_File(over), remedy="").failures == ()
    assert looked(_File(over), FREE).failures == ()
    (line,) = looked(_File(STEP, cycling=True)).failures
    assert line == (
        "NOT at rest: at the end of the scenario u still goes from limit to limit; bound the loop "
        "more (M_ks, M_s), or give a smaller step"
    )
    assert looked(_File(STEP, cycling=True), FREE).failures == ()
    lost = STEP._replace(settling=math.nan)
    file = _File(lost, loads=[LOAD])
    assert looked(file, name="x").failures == (f"{lost} (x)",)
    assert file.asked == 0
    (line,) = looked(_File(STEP, loads=[LOAD, NEVER])).failures
    assert line == (
        "NOT soon back after an overload: a load of 1.4 for 0.5 s: back never, after one that u can "
        "hold in 0.6 s; bound the loop more (M_ks, M_s), or keep such loads away"
    )
    assert looked(_File(STEP, loads=[NEVER]), FREE).overloads == ()
    assert looked(_File(STEP, loads=[NEVER]), held=np.zeros((1, 1))).overloads == ()
    moving = looked(_File(None, MOVE))
    assert (moving.step, moving.move, str(moving)) == (None, MOVE, str(MOVE))
    wild = MoveFigures(math.inf, math.inf)
    assert looked(_File(None, wild)).failures == ("NOT stable: y diverges in the scenario",)


# ---- other plants of a set


def test_the_ends_of_a_set_and_some_between_are_looked_at() -> None:
    """Those of the largest and least gain and phase first, with their numbers and factors."""
    scenario = ql.Scenario(ql.signals.Step(at=1.0), 4.0)
    file = Written(LAG, scenario, DT)
    gains = [2.0, 1.0, 3.0, 2.5]
    plants = [([gain], [1.0, 1.0]) for gain in gains]
    linear = [LinearPlant.of(plant) for plant in plants]
    found = with_others(file, linear, [(0.0, 0.0)] * 4, plant_set(given_plants(plants, DT), DT))
    assert [each.name for each in found.others][:2] == ["plant 3 of the set", "plant 2 of the set"]
    assert {each.name for each in found.others} == {f"plant {i} of the set" for i in (2, 3, 4)}
    assert found.of_others == "other plants of the set of 4, linear"
    assert found.others[0].plant.B[0, 0] * found.others[0].plant.C[0, 0] == pytest.approx(3.0)
    alone = plant_set(given_plants(plants[:1], DT), DT)
    assert with_others(file, linear[:1], [(0.0, 0.0)], alone) is file


def test_another_plant_has_the_scenario_of_the_file_at_rest() -> None:
    """A delay adds states that hold u; signals of a schedule are left out where it is held."""
    scenario = ql.Scenario(ql.signals.Step(at=1.0), 4.0, x0=[0.8], disturbances=[0.1])
    file = Written(LAG, scenario, DT)
    double = LinearPlant(2.0 * LAG.A, LAG.B, LAG.C, LAG.E)
    place = place_of(file, double, (0.0, 2.0 * DT), "slow", (3.0,))
    assert (place.name, place.at, place.dt) == ("slow", (3.0,), DT)
    assert place.linear is double
    x0 = np.asarray(place.scenario.x0)
    y = float(LAG.C[0, 0]) * 0.8
    assert float(double.C[0, 0]) * x0[0] == pytest.approx(y)
    u = -(float(double.A[0, 0]) * x0[0] + float(double.E[0, 0]) * 0.1) / float(double.B[0, 0])
    assert x0[1:].tolist() == pytest.approx([u] * (x0.size - 1))
    assert place.plant.order == x0.size
    free = place_of(replace(file, scenario=ql.Scenario(0.0, 4.0)), double, (0.0, 0.0), "free")
    assert free.scenario.x0 is None


# ---- constraints


def test_constraints_are_told_with_all_bounds_that_hold() -> None:
    """In order; those that are None are left out."""
    every = Constraints(
        m_s=1.5,
        m_t=1.4,
        m_ks=3.0,
        u_std=0.2,
        noise_std=0.01,
        resolution=0.02,
        delay_margin=0.1,
        damping=0.5,
        u_max=2.0,
        rate_max=7.0,
    )
    noise = math.hypot(0.01, 0.02 / math.sqrt(12.0))
    assert str(every) == (
        f"M_s ≤ 1.5, M_t ≤ 1.4, M_ks ≤ 3, std(u) ≤ 0.2 for noise of {noise:.3g} in y, delay margin ≥ "
        "0.1 s, damping ≥ 0.5, |u| ≤ 2, |u'| ≤ 7/s, |p| dt ≤ 0.5 for poles of observers and filters"
    )
    assert every.noise == pytest.approx(noise)
    assert str(Constraints(m_t=None, damping=None)) == (
        "M_s ≤ 1.6, |p| dt ≤ 0.5 for poles of observers and filters"
    )


@cases(
    ("given", "message"),
    [
        ({"damping": 1.0}, "damping = 1.0: must be below 1, the damping of real poles (0.4 lets"),
        ({"m_s": 1.0}, "m_s = 1.0: must be above 1; |S| exceeds 1 at some frequency"),
        ({"m_t": 0.9}, "m_t = 0.9: must be above 1;"),
        ({"u_std": 0.1}, "u_std = 0.1: needs noise_std or resolution, the noise of y that causes it"),
        ({"m_s": None, "m_t": None}, "m_s = None, m_t = None: one of them must bound the loop"),
        *(({name: -1.0}, f"{name} = -1.0: must be finite and greater than zero") for name in (
            "m_s", "m_t", "m_ks", "u_std", "noise_std", "delay_margin", "u_max", "rate_max",
            "noise_over_pi", "resolution", "damping", "noise_share", "omega_o_dt")),
    ],
)  # fmt: skip
def test_constraints_out_of_range_are_named(given: Any, message: str) -> None:
    """Name, value, rule."""
    with pytest.raises(ValueError) as caught:
        Constraints(**given)
    assert str(caught.value).startswith(message)


def test_bounds_that_were_given_are_those_that_are_not_the_default() -> None:
    """The first of the names; any other object is refused."""
    names = ("m_s", "m_ks", "u_max")
    assert first_given(Constraints(), names) == ""
    assert first_given(Constraints(u_max=1.0, m_ks=2.0), names) == "m_ks"
    assert first_given(Constraints(m_s=1.7), names) == "m_s"
    assert first_given(Constraints(m_s=None), names) == ""
    mine = Constraints(m_s=2.0)
    assert given_constraints(None) == Constraints()
    assert given_constraints(None, mine) is mine
    assert given_constraints(mine) is mine
    with pytest.raises(ValueError, match="constraints = 1.6: must be quell.tuning.Constraints"):
        given_constraints(1.6)


# ---- excitations


def test_a_chirp_says_how_long_an_octave_takes() -> None:
    """From one period of the lowest frequency in the lowest octave on."""
    design = excitation("chirp", (1.0, 64.0), 60.0, 0.01)
    assert design.details == "chirp from 1 to 64 rad/s in 60 s, 10 s an octave"
    assert design.shortcomings == ()
    assert (design.period, design.band) == (math.inf, (1.0, 64.0))
    short = excitation("chirp", (1.0, 64.0), 36.0, 0.01)
    assert short.shortcomings == (
        "the lowest octave gets 0.95 periods of its lowest frequency; take longer, or a multisine",
    )
    shorter = excitation("chirp", (1.0, 64.0), 6.0, 0.01)
    assert shorter.shortcomings[1] == (
        "6 s is less than one period of 1 rad/s; take longer, or begin the band higher"
    )


def test_a_prbs_says_what_it_holds_and_what_it_lacks() -> None:
    """Each value is held so that the spectrum is 3 dB down at the upper end; bits for the lower."""
    half = 2.0 * math.pi * 0.443
    design = excitation("prbs", (2.0, 40.0), 20.0, 0.01)
    samples = math.floor(half / 40.0 / 0.01)
    bits = math.ceil(math.log2(2.0 * math.pi / (2.0 * samples * 0.01) + 1.0))
    period = (2**bits - 1) * samples * 0.01
    assert design.details == (
        f"PRBS of {bits} bits, each held for {samples} samples ({samples * 0.01:.4g} s), period "
        f"{period:.4g} s"
    )
    assert design.period == pytest.approx(period)
    assert design.band == pytest.approx((2.0 * math.pi / period, half / (samples * 0.01)))
    assert design.shortcomings == ()
    assert str(design).splitlines() == [
        design.details,
        f"excites {design.band[0]:.4g} to {design.band[1]:.4g} rad/s; crest factor "
        f"{design.crest:.3f}, RMS {design.rms:.4g}, from -1 to 1",
    ]
    few = excitation("prbs", (2.0, 250.0), 1.0, 0.01)
    assert few.band[1] == pytest.approx(half / 0.01)
    assert few.details.startswith("PRBS of 6 bits, each held for 1 samples (0.01 s), period 0.63 s")
    lowest = 2.0 * math.pi / 0.63
    wanted = math.ceil(math.log2(2.0 * math.pi / (2.0 * 0.01) + 1.0))
    assert few.shortcomings[0] == (
        f"the lowest line is {lowest:.4g} rad/s, not 2: {wanted} bits take "
        f"{(2**wanted - 1) * 0.01:.4g} s, more than there are; take longer, or begin the band higher"
    )
    fast = excitation("prbs", (2.0, 300.0), 20.0, 0.01)
    assert fast.shortcomings == (
        f"at 300 rad/s it is more than 3 dB down, from {half / 0.01:.4g} on; sample faster, or end "
        "the band lower",
    )
    assert str(fast).splitlines()[2] == f"NOT: {fast.shortcomings[0]}"


def test_a_multisine_says_how_many_lines_and_times_it_has() -> None:
    """As many periods as the lowest frequency allows; of more than 120 lines the gaps are told."""
    design = excitation("multisine", (2.0, 20.0), 10.0, 0.01)
    base = 2.0 * math.pi / (333 * 0.01)
    lines = np.unique(np.round(np.geomspace(1, 10, 10)))
    assert design.details == f"multisine of {lines.size} lines, period 3.33 s, 3 times"
    assert design.period == pytest.approx(3.33)
    assert design.band == pytest.approx((base, 10.0 * base))
    spectrum = np.abs(np.fft.rfft(design.u[:333]))[1:]
    assert (np.flatnonzero(spectrum > 1e-6 * np.max(spectrum)) + 1).tolist() == lines.tolist()
    gap = np.max(np.diff(lines)) * base
    assert design.shortcomings == (
        f"lines are up to {gap:.3g} rad/s apart: a narrower resonance may lie between; take a PRBS "
        "or a narrower band",
    )
    once = excitation("multisine", (2.0, 20.0), 5.0, 0.01)
    assert once.details.endswith("period 5 s, 1 time")
    assert once.shortcomings[0] == (
        "there is only one period, so the transient of the start is not separated from the "
        "response; take longer for two"
    )
    alone = excitation("multisine", (2.0, 5.0), 10.0, 0.01)
    assert (alone.details, alone.shortcomings) == (
        "multisine of 2 lines, period 3.33 s, 3 times",
        (),
    )
    many = excitation("multisine", (0.7, 150.0), 20.0, 0.01)
    spread = np.unique(np.round(np.geomspace(1, math.floor(150.0 / (math.pi / 5.0)), 120)))
    assert many.details.startswith(f"multisine of {spread.size} lines, period 10 s, 2 times")
    with pytest.raises(
        ValueError, match="has no multiple of 1.257 rad/s, the lowest frequency of the"
    ):
        excitation("multisine", (1.0, 1.1), 5.0, 0.01)
    turned = excitation("multisine", (2.0, 20.0), 10.0, 0.01, seed=90)
    spectrum = [np.fft.rfft(each.u[:333])[lines.astype(int)] for each in (design, turned)]
    shift = np.angle(spectrum[1] / spectrum[0])
    np.testing.assert_allclose(shift, 0.5 * math.pi, atol=1e-3)


def test_lines_of_several_actuators_are_dealt_out_in_turn(tmp_path: Any) -> None:
    """No two have one in common; each has its own limits; one file has all."""
    one, two = interleaved_excitations(2, (1.0, 20.0), 10.0, 0.01, [-1.0, 0.0], 2.0)
    spectra = [
        np.abs(np.fft.rfft(each.u - np.mean(each.u))) > 1e-6 * each.u.size for each in (one, two)
    ]
    assert not np.any(spectra[0] & spectra[1])
    base = 2.0 * math.pi / one.period
    assert one.band[0] == pytest.approx(base)
    assert two.band[0] == pytest.approx(one.band[0] + base)
    assert (np.min(one.u), np.max(one.u)) == pytest.approx((-1.0, 2.0))
    assert (np.min(two.u), np.max(two.u)) == pytest.approx((0.0, 2.0))
    save_excitations([one, two], tmp_path / "u.csv")
    head, first, *rest = (tmp_path / "u.csv").read_text().splitlines()
    assert head == "t,u1,u2"
    assert [float(value) for value in first.split(",")] == pytest.approx([0.0, one.u[0], two.u[0]])
    assert len(rest) == 999
    with pytest.raises(ValueError, match="has 3 lines: must have one for each of 4 actuators"):
        interleaved_excitations(4, (1.0, 2.0), 10.0, 0.01)


@cases(
    ("duration", "dt", "message"),
    [
        (0.15, 0.01, "duration = 0.15 s: must be at least 16 samples and a tenth of the slowest"),
        (0.62, 0.01, "and a tenth of the slowest period, 6.283 s"),
    ],
)
def test_an_excitation_is_sixteen_samples_and_a_tenth_of_a_period_long(
    duration: float, dt: float, message: str
) -> None:
    """Both limits from both sides."""
    low = 1.0 if duration > 0.5 else 10.0
    with pytest.raises(ValueError, match=message):
        excitation("prbs", (low, 50.0), duration, dt)
    assert excitation("prbs", (low, 50.0), duration + 0.01, dt).u.size == round(
        (duration + 0.01) / dt
    )
