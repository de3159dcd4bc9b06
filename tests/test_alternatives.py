"""Other structures for a record: friction is suggested where it is, and the report says what a record cannot decide."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.identification import Identified, alternatives, decided, excitation, read_record

from .commands import Shown
from .test_identification import answer

pytestmark = pytest.mark.compiled

RECORDS = Path(__file__).resolve().parents[2] / "shared" / "data"
DT = 0.02


def by_name(found: Identified) -> dict[str, Any]:
    """Return the alternatives of a model by their names."""
    return {one.name: one for one in alternatives(found)}


@cache
def mass(seed: int, friction: float) -> tuple[Any, Any]:
    """Return u and y of a mass with viscous and Coulomb friction, which sticks, in small steps."""
    fine, rng = 8, np.random.default_rng(seed)
    u = excitation("prbs", (0.5, 10.0), 20.0, DT, -1.0, 1.0, seed=seed).u
    y, position, speed, h = np.empty(u.size), 0.0, 0.0, DT / fine
    for k, force in enumerate(u.tolist()):
        y[k] = position
        for _ in range(fine):
            after = speed + h * (5.0 * force - 0.8 * speed)
            speed = after - min(max(after, -h * friction), h * friction)
            position += h * speed
    return u, y + 1e-3 * rng.standard_normal(u.size)


@pytest.mark.trial
def test_friction_is_suggested_where_it_is_and_its_model_is_the_decision() -> None:
    """A mass with friction, fitted without: the report suggests it, by far more than chance."""
    u, y = mass(0, friction=1.0)
    found = ql.identify(u, y, DT, order=2)
    other = by_name(found)["Coulomb friction"]
    assert other.verdict == "better"
    assert "NOT: Coulomb friction (--friction) fits better" in other.describe(found)
    chosen = decided(found)
    assert chosen.friction == pytest.approx(0.2, rel=0.05)
    assert chosen.den.size == 3


@pytest.mark.trial
def test_no_friction_is_suggested_where_there_is_none() -> None:
    """A mass without friction under a load that the model lacks: the error is not white, but friction does not explain it."""
    u = excitation("prbs", (0.5, 10.0), 30.0, DT, -1.0, 1.0).u
    load = 0.05 * np.sin(0.7 * np.arange(u.size) * DT)
    y = answer(([5.0], [1.0, 0.8, 0.0]), u + load, DT)
    found = ql.identify(u, y, DT, order=2)
    assert not found.residuals.white
    assert "Coulomb friction" not in by_name(found)


def test_a_pole_too_many_is_said_to_be_undecided() -> None:
    """A second pole for a lag in noise: the record cannot decide, and the smaller model is the decision."""
    rng = np.random.default_rng(1)
    u = excitation("prbs", (0.5, 10.0), 30.0, DT).u
    y = answer(([3.0], [1.0, 2.0]), u, DT) + 0.05 * rng.standard_normal(u.size)
    found = ql.identify(u, y, DT, order=2, delay=0.0)
    other = by_name(found)["order 1"]
    assert other.verdict == "undecided"
    assert "cannot decide between order 2 and order 1" in other.describe(found)
    assert "take order 1 (--order 1), which has fewer parameters" in other.describe(found)
    assert decided(found).den == pytest.approx([1.0, 2.0], rel=0.05)


def test_a_pole_too_few_is_worse_and_not_mentioned() -> None:
    """One pole for a plant of two: worse, by far more than chance, without a line of text."""
    u = excitation("prbs", (0.5, 10.0), 30.0, DT).u
    y = answer(([3.0], [1.0, 2.0, 4.0]), u, DT)
    y = y + 0.01 * np.random.default_rng(2).standard_normal(u.size)
    found = ql.identify(u, y, DT, order=2)
    other = by_name(found)["order 1"]
    assert other.verdict == "worse"
    assert other.describe(found) == ""


@pytest.mark.trial
def test_a_flexible_axis_with_its_encoder_at_the_motor_gets_two_zeros() -> None:
    """Four poles without zeros do not explain it; three have one that is faster than samples show, and are not advised."""
    dt, plant = 2.5e-4, ([8333.0, 3.7e5, 6.4e9], [1.0, 69.7, 1.281e6, 1.281e6, 0.0])
    u = np.repeat(np.random.default_rng(3).choice([-0.05, 0.05], 375), 8)
    step = 2.0 * np.pi / 2.0**20
    found = ql.identify(u, np.round(answer(plant, u, dt) / step) * step, dt, order=4, zeros=0)
    assert not found.explained
    others = by_name(found)
    zeros = others["order 4 with 2 zeros"]
    assert zeros.verdict == "better"
    assert zeros.options == "--order 4 --zeros 2"
    assert zeros.usable
    assert zeros.model.num == pytest.approx(plant[0], rel=1e-2)
    assert "take it" in zeros.describe(found)
    poor = replace(zeros, model=replace(zeros.model, converged=False))
    assert "do NOT take it: its search did not converge" in poor.describe(found)
    for other in others.values():
        if not other.usable:
            assert not other.describe(found).endswith("; take it")


def test_another_record_validates_the_model() -> None:
    """Its fit is that of a simulation from a fitted state; a record of another plant is not described."""
    plant, rng = ([5.0], [1.0, 0.8, 0.0]), np.random.default_rng(3)
    inputs = [excitation("prbs", (0.5, 10.0), 30.0, DT, seed=seed).u for seed in (3, 4)]
    records = [(u, answer(plant, u, DT) + 1e-3 * rng.standard_normal(u.size)) for u in inputs]
    found = ql.identify(*records[0], DT, order=2, validation=records[1])
    assert found.fits["validation"] > 99.0
    assert found.residuals.independent
    other = answer(([5.0], [1.0, 0.3, 2.0]), records[1][0], DT)
    wrong = ql.identify(*records[0], DT, order=2, validation=(records[1][0], other))
    assert wrong.fits["validation"] < 50.0
    assert not wrong.residuals.white
    with pytest.raises(ValueError, match="validation: has 5 samples, must have at least"):
        ql.identify(*records[0], DT, order=2, validation=(np.arange(5.0), np.arange(5.0)))


@pytest.mark.trial
def test_the_command_validates_and_suggests(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """``quell identify data.csv --validate other.csv``: fit, suggestion, and alternatives in JSON."""
    for name, seed in (("data", 0), ("other", 5)):
        u, y = mass(seed, friction=1.0)
        table = np.column_stack([np.arange(u.size) * DT, u, y])
        np.savetxt(tmp_path / f"{name}.csv", table, delimiter=",", header="t,u,y", comments="")
    order = ("identify", "data.csv", "--order", "2", "--no-figures")
    shown = quell(*order, "--validate", "other.csv", "--json", "out.json")
    assert shown.code == 0, shown.err
    assert "validation" in shown.out
    assert "NOT: Coulomb friction (--friction)" in shown.out
    told = json.loads((tmp_path / "out.json").read_text())
    assert {one["name"]: one["verdict"] for one in told["alternatives"]} == {
        "order 1": "worse",
        "Coulomb friction": "better",
        "order 3": "undecided",
    }
    shown = quell(*order, "--no-alternatives")
    assert "fits better" not in shown.out


@pytest.mark.trial
@pytest.mark.skipif(not RECORDS.is_dir(), reason="the public records are not on this machine")
def test_a_positioning_system_with_friction_gets_the_published_parameters() -> None:
    """EMPS in means of 20 ms: friction is suggested; pole, gain and friction are near to those of Janot, Gautier & Brunot 2019."""
    record, every = read_record(RECORDS / "emps.csv"), 20
    size = record.u.size // every * every
    u, y = record.u[:size].reshape(-1, every).mean(axis=1), record.y[:size:every]
    found = ql.identify(u, y, every * record.dt, order=2)
    assert by_name(found)["Coulomb friction"].verdict == "better"
    chosen = decided(found)
    assert chosen.poles[1].value.real == pytest.approx(-2.14, rel=0.05)
    assert chosen.num[0] == pytest.approx(0.370, rel=0.05)
    assert chosen.friction == pytest.approx(0.58, rel=0.05)
    assert chosen.fits["held out"] > 97.0


@pytest.mark.trial
def test_a_lag_does_not_become_a_part_of_the_delay() -> None:
    """Lags of 20 and 1.4 samples behind a delay of 3: a model of one lag with 4.3 may be as good by Schwarz's criterion, but does not hold the delay."""
    rng, delays = np.random.default_rng(8), (0.0, 8.0)
    u = np.repeat(rng.uniform(-1.0, 1.0, 50), 20)
    late = np.append(np.full(3, u[0]), u)[: u.size]
    y = answer(([1.0], [28.0, 21.4, 1.0]), late, 1.0) + 0.025 * rng.standard_normal(u.size)
    found = ql.identify(u, y, 1.0, order=2, delay=delays)
    (other,) = [one for one in alternatives(found, delays) if one.name == "order 1"]
    assert other.model.delay_interval[0] > 4.0
    assert other.verdict == "undecided"
    assert other.in_delay == pytest.approx(1.4, rel=0.1)
    assert "has a longer delay in place of a lag of 1.33 s" in other.describe(found)
    assert not other.may_be_as_good
    assert decided(found, delays).delay == 3.0
