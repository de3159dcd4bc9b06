"""``RLS(recall=True)``: a map that is periodic in position is found again after a lost index."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.features import Bias, Periodic, State
from quell.kernels.dispatch import as_python
from quell.learners.recall import RecallMemory, recall_memory, recall_rule
from quell.learners.regression import (
    convert_rule,
    forget_rule,
    reset_uncertainty,
    restart_rule,
    update_theta,
)
from quell.learners.rls import RlsMemory, RlsRule

from .cases import cases

ORDERS = np.array([2, 5, 9])
RULE = recall_rule(RlsRule(1.0, 1e-3, 100.0), 0, 6, ORDERS, 0.02)
MAP = np.array([0.5, -0.3, 0.2, 0.25, -0.1, 0.15])


def memory_of(rule: Any = RULE) -> RecallMemory:
    """The state of a rule with three pairs and a constant."""
    return recall_memory(RlsMemory(100.0 * np.eye(7), np.zeros(7)), rule, 7)


def features(x: float) -> Any:
    """Waves at a position, and the constant."""
    waves = [each for m in ORDERS for each in (math.sin(m * x), math.cos(m * x))]
    return np.array([*waves, 1.0])


def turned(shift: float, coefficients: Any = MAP) -> Any:
    """A map whose origin has moved by ``shift``, by the addition theorem."""
    found = np.empty(6)
    for k, m in enumerate(ORDERS):
        a, b = coefficients[2 * k : 2 * k + 2]
        found[2 * k] = a * math.cos(m * shift) + b * math.sin(m * shift)
        found[2 * k + 1] = b * math.cos(m * shift) - a * math.sin(m * shift)
    return found


def fed(
    memory: RecallMemory, theta: Any, force: Any, span: float, noise: float = 0.01, seed: int = 1
) -> None:
    """Move by a part of a revolution; ``force(x)`` is the target."""
    random = np.random.default_rng(seed)
    with as_python():
        for x in np.linspace(0.0, math.tau * span, round(4000 * span)):
            psi = features(float(x))
            error = force(float(x)) + noise * random.standard_normal() - theta @ psi
            update_theta(RULE, memory, theta, psi, error, 1.0)


def learned() -> tuple[RecallMemory, Any]:
    """State and θ after a revolution with the map, and a start from rest."""
    memory, theta = memory_of(), np.zeros(7)
    fed(memory, theta, lambda x: MAP @ features(x)[:6] + 0.4, 1.0)
    np.testing.assert_allclose(theta[:6], MAP, atol=0.01)
    with as_python():
        restart_rule(RULE, memory, theta)
    return memory, theta


@pytest.mark.trial
@pytest.mark.parametrize("shift", [0.0, 0.3, 1.7, 3.1, 4.4, 6.2])
def test_a_shifted_map_is_found_within_half_a_period(shift: float) -> None:
    """Also under another constant load; the coefficients are those of the addition theorem."""
    memory, theta = learned()
    assert not theta.any()
    force = turned(shift)
    fed(memory, theta, lambda x: force @ features(x)[:6] - 0.7, 0.5, seed=2)
    assert memory.loop[0].searching == 0.0
    np.testing.assert_allclose(theta[:6], force, atol=0.02)
    assert theta[6] == pytest.approx(-0.7, abs=0.02)
    away = (memory.loop[0].best - shift + math.pi) % math.tau - math.pi
    assert memory.loop[0].usual < 1e-3
    assert abs(away) < 0.2 or memory.loop[0].left == -1.0


@pytest.mark.trial
def test_nothing_is_accepted_before_a_quarter_of_a_period() -> None:
    """A short part fits many maps."""
    memory, theta = learned()
    force = turned(1.0)
    fed(memory, theta, lambda x: force @ features(x)[:6], 0.22)
    assert memory.loop[0].searching == 1.0


@pytest.mark.trial
def test_another_map_is_not_used_and_is_learned_anew() -> None:
    """Same amplitudes, other phases: after half a period the old map is gone, and θ is that of least squares alone."""
    memory, theta = learned()
    plain, alone = RlsMemory(100.0 * np.eye(7), np.zeros(7)), np.zeros(7)
    other = np.array([-0.3, 0.5, 0.25, -0.2, 0.15, 0.1])
    fed(memory, theta, lambda x: other @ features(x)[:6], 0.6)
    assert memory.loop[0].searching == 0.0
    random = np.random.default_rng(1)
    with as_python():
        for x in np.linspace(0.0, math.tau * 0.6, 2400):
            psi = features(float(x))
            error = other @ psi[:6] + 0.01 * random.standard_normal() - alone @ psi
            update_theta(RULE.inner, plain, alone, psi, error, 1.0)
    np.testing.assert_array_equal(theta, alone)
    np.testing.assert_allclose(theta[:6], other, atol=0.05)


@pytest.mark.trial
def test_noise_as_large_as_the_map_decides_nothing() -> None:
    """The map is not used on a guess."""
    memory, theta = learned()
    fed(memory, theta, lambda x: turned(1.0) @ features(x)[:6], 0.55, noise=1.0)
    assert memory.loop[0].searching == 0.0
    assert not np.allclose(theta[:6], turned(1.0), atol=0.02)


@pytest.mark.trial
def test_the_search_survives_a_second_start_and_a_change_of_scale() -> None:
    """What is set aside stays, in the units of the scaled f; what is forgotten does not."""
    memory, theta = learned()
    stored = memory.stored.copy()
    with as_python():
        restart_rule(RULE, memory, theta)
        np.testing.assert_array_equal(memory.stored, stored)
        convert_rule(RULE, memory, 0.5)
        np.testing.assert_array_equal(memory.stored, 0.5 * stored)
        reset_uncertainty(RULE, memory)
        assert memory.loop[0].searching == 1.0
        forget_rule(RULE, memory)
    assert (memory.loop[0].searching, memory.stored.any()) == (0.0, False)


def test_a_learner_without_a_map_has_nothing_to_recall() -> None:
    """Before anything is learned a start changes nothing."""
    memory, theta = memory_of(), np.zeros(7)
    theta[6] = 1.0
    with as_python():
        restart_rule(RULE, memory, theta)
    assert memory.loop[0].searching == 0.0
    assert theta[6] == 1.0


@cases(
    ("options", "message"),
    [
        ({"features": State() + Bias()}, "must have one block Periodic"),
        ({"features": Periodic() + Periodic(period=1.0)}, "must have one block Periodic"),
        ({"features": Periodic(highest=20), "strongest": 5}, "leave one of them out"),
        ({"features": Periodic(), "recall": 2}, "recall = 2"),
    ],
)
def test_what_can_not_be_recalled_is_refused(options: dict[str, Any], message: str) -> None:
    """A map is that of one block of waves, as a whole."""
    with pytest.raises(ValueError, match=message):
        ql.learners.RLS(**{"recall": True} | options)
