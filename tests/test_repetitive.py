"""Repetitive learning: a table over the phase of a cycle."""

from __future__ import annotations

import math

import numpy as np
import pytest

import quell as ql
from quell.learners import Repetitive
from quell.learners.base import (
    adapt,
    commit,
    forget,
    lag_memory,
    lag_of,
    lag_push,
    predict,
    restart,
)
from quell.learners.repetitive import correction_weights
from quell.types import Vector

from .cases import cases

DT = 0.01
OBSERVER = ql.ESO.model_free(2, 1.0, 40.0, DT)


def learned(f: Vector, cycles: int, gain: float, blind: range = range(0)) -> list[Vector]:
    """Return the table after each cycle of a disturbance that no control changes.

    In the samples ``blind`` of a cycle there is no measurement.
    """
    learner = Repetitive(period=f.size * DT, gain=gain)
    design = learner.design(OBSERVER, 4.0)
    memory = learner.memory(design)
    lag, chain, seen = lag_of(OBSERVER), lag_memory(lag_of(OBSERVER), 1), np.zeros(3)
    tables, f_plain = [], 0.0
    for _ in range(cycles):
        for k in range(f.size):
            if k not in blind:
                adapt(design, memory, seen, 0.0, 0.0, f_plain)
            commit(design, memory, seen, 0.0, predict(design, memory, seen, 0.0)[0])
            f_plain = lag_push(lag, chain, 0, float(f[k]))
        tables.append(memory.table.copy())
    return tables


def response(samples: int, harmonic: int) -> float:
    """Return ``W |F|²`` at a harmonic of a cycle, with F from its impulse response."""
    lag = lag_of(OBSERVER)
    memory = lag_memory(lag, 1)
    angle = 2.0 * math.pi * harmonic / samples
    total = sum(
        lag_push(lag, memory, 0, float(i == 0)) * np.exp(-1j * angle * i) for i in range(400)
    )
    weights = correction_weights(OBSERVER, lag)
    reach = weights.size // 2
    shape = sum(w * math.cos(angle * (i - reach)) for i, w in enumerate(weights))
    return float(shape * abs(total) ** 2)


@pytest.mark.parametrize("harmonic", [2, 8, 16])
def test_what_is_left_of_a_harmonic_shrinks_by_the_closed_form(harmonic: int) -> None:
    """By 1 − γ W |F|² in each cycle: the lag of the observer has no effect, only its magnitude."""
    samples, gain, cycles = 160, 0.6, 6
    k = np.arange(samples)
    f = np.cos(2.0 * math.pi * harmonic * k / samples + 0.4)
    tables = learned(f, cycles, gain)
    rest = [float(np.sqrt(2.0 * np.mean((f - table) ** 2))) for table in tables]
    factor = 1.0 - gain * response(samples, harmonic)
    assert 0.0 < factor < 1.0
    np.testing.assert_allclose(rest[2:], rest[1] * factor ** np.arange(1, cycles - 1), atol=0.01)
    assert rest[1] == pytest.approx(factor, abs=0.1)


def test_any_smooth_shape_is_learned_in_all_of_the_cycle() -> None:
    """A constant, too, and over the seam between two cycles; the start does not count."""
    k = np.arange(120)
    f = 5.0 + np.exp(2.0 * np.cos(2.0 * math.pi * (k - 5) / 120))
    tables = learned(f, 40, 0.6)
    assert np.max(np.abs(tables[0])) == 0.0
    np.testing.assert_allclose(tables[-1], f, rtol=5e-3)


def test_nothing_is_learned_where_there_is_no_measurement() -> None:
    """What was learned before in these samples stays; without any, f counts as zero there."""
    f = np.sin(2.0 * math.pi * np.arange(160) / 160)
    assert np.max(np.abs(learned(f, 10, 0.6, blind=range(160))[-1])) == 0.0
    tables = learned(f, 10, 0.6, blind=range(75, 80))
    assert np.max(np.abs(tables[-1] - f)[100:]) < 0.02
    assert np.max(np.abs(tables[-1])) < 1.5


@cases(
    "observer",
    [
        ql.ESO.model_free(1, 1.0, 20.0, 1e-2),
        ql.ESO.model_free(4, 1.0, 50.0, 1e-3),
        ql.ESO.model_free(2, 1.0, 20.0, 1e-2, form="predictor"),
        ql.ESO.cascade(2, 1.0, 20.0, 1e-2),
    ],
)
def test_no_frequency_is_amplified_from_cycle_to_cycle(observer: ql.ESO) -> None:
    """``W |F|²`` is between 0 and 1, for lag filters of any kind."""
    lag = lag_of(observer)
    memory, weights = lag_memory(lag, 1), correction_weights(observer, lag)
    pulse = np.array([lag_push(lag, memory, 0, float(i == 0)) for i in range(4096)])
    angle = np.linspace(0.0, math.pi, 2049)
    reach = weights.size // 2
    shape = sum(w * np.cos((i - reach) * angle) for i, w in enumerate(weights))
    product = shape * np.abs(np.fft.rfft(pulse)) ** 2
    assert np.all(product > -1e-9)
    assert np.max(product) == pytest.approx(1.0, rel=2e-2)


def test_a_start_from_rest_begins_a_cycle_and_keeps_the_table() -> None:
    """Its output begins at zero, because a constant is the observer's part. To forget is to start with zeros."""
    learner = Repetitive(period=0.2)
    design = learner.design(OBSERVER, 4.0)
    memory = learner.memory(design)
    memory.table[:] = np.arange(5.0, 25.0)
    memory.filters[:] = 1.0
    restart(design, memory)
    assert not memory.filters.any()
    for _ in range(7):
        commit(design, memory, np.zeros(3), 0.0, 0.0)
    assert predict(design, memory, np.zeros(3), 0.0) == (7.0, 0.0)
    restart(design, memory)
    assert predict(design, memory, np.zeros(3), 0.0) == (0.0, 0.0)
    np.testing.assert_array_equal(memory.table, np.arange(5.0, 25.0))
    forget(design, memory)
    assert not memory.table.any()
    memory.table[3] = np.inf
    restart(design, memory)
    assert not memory.table.any()


@cases(
    ("options", "message"),
    [
        ({"period": 0.0}, "period = 0.0"),
        ({"gain": 0.0}, "gain = 0.0"),
        ({"gain": 1.0}, r"gain = 1.0: must be below 1"),
        ({"period": 0.05}, r"period = 0.05 s: must be 10 to 1000000 times dt = 0.01 s"),
        ({"period": 2e4}, r"period = 20000.0 s: must be 10 to 1000000 times"),
        ({"period": 1.004}, r"period = 1.004 s: must be a multiple of dt = 0.01 s, for example 1"),
    ],
)
def test_mistakes_are_named(options: dict[str, float], message: str) -> None:
    """Argument, value, rule."""
    with pytest.raises(ValueError, match=message):
        Repetitive(**options).design(OBSERVER, 4.0)


@pytest.mark.trial
def test_twenty_five_repeats_of_a_move_leave_a_twentieth_of_the_error() -> None:
    """A trapezoid on an arm with gravity and friction, with b0 a quarter too large.

    As Python: to compile a plant of one's own with this learner takes longer.
    """
    arm = ql.plants.NonlinearPlant(
        lambda t, x, u, w: (
            x[1],
            20.0 * (u - 0.1 * x[1] - 2.0 * math.sin(x[0]) - 0.5 * math.tanh(x[1] / 0.02)) + w[0],
        ),
        order=2,
        substeps=2,
    )
    period, dt, repeats = 2.8, 1e-2, 25
    moves = ql.signals.Trapezoid(1.5, 1.0, start=0.2) - ql.signals.Trapezoid(1.5, 1.0, start=1.6)
    controller = ql.ADRC(
        ql.ESO.model_free(order=2, b0=25.0, omega_o=60.0, dt=dt),
        omega_c=10.0,
        learner=Repetitive(period),
        feedforward=True,
    )
    scenario = ql.Scenario(
        ql.signals.Repeated(moves, period),
        repeats * period,
        noise=ql.signals.BandLimitedNoise(4e-10 * dt, dt),
    )
    run = ql.simulate(arm, controller, scenario)
    errors = (run["y"] - run["r"])[:-1].reshape(repeats, -1)
    rms = np.sqrt(np.mean(errors**2, axis=1))
    assert rms[-1] < 0.05 * rms[0]
    assert np.max(rms[1:]) < rms[0]
