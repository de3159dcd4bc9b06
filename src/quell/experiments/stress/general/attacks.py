"""Adversaries that know the loop: drawn at random, or found by a search (``cross_entropy``).

Both are ``Program`` learners with the loop's own numbers: a point θ in ``SIZE`` dimensions says how
much of the exact f (``exact_weights``) and of each input they return in their two modes, and when
they change between them.
"""

from __future__ import annotations

import json
from functools import cache
from math import comb
from pathlib import Path

import numpy as np

from quell.experiments.stress.adversaries import KINDS as BLIND_KINDS
from quell.experiments.stress.adversaries import draw_adversary
from quell.experiments.stress.general.loops import GeneralLoop
from quell.experiments.stress.general.loops.random_plants import load_gain
from quell.experiments.stress.general.program import INPUTS, RULES, Program
from quell.guard import Guard
from quell.learners import Learner
from quell.types import Vector

Rng = np.random.Generator

EARN, SEARCHED = "earn and spend", "searched"
KINDS = (*BLIND_KINDS, EARN, SEARCHED)
"""Hostile learners by name: those of the two-mass trial, and two that see everything."""

_WIDTH = len(INPUTS)
SIZE = 2 * (1 + _WIDTH) + len(RULES) + 1
"""Numbers in θ: of each mode the share of the exact f and the weights; the rules, the frequency."""
_AT = {name: i for i, name in enumerate(INPUTS)}
# Spread of the points around one that a search has found, in units of the search's own spread at
# its beginning. Chosen by hand: enough that no two are alike.
_NEARBY = 0.05
FOUND = Path(__file__).with_name("searched.json")
"""Points that the searches found for each order: made by ``benchmarks/stress_search.py``."""


def exact_weights(loop: GeneralLoop) -> Vector:
    """Return the weights of ``INPUTS`` whose sum is f, in the linear part of the plant.

    ``f = −a x + (b − b0) u + w``; a load that does not enter where u does counts as it acts at low
    frequencies.
    """
    n, A = loop.order, loop.plant.linear.A
    a = np.poly(A[:n, :n])[:0:-1]
    gains = np.array([comb(n, i) for i in range(n)])  # of the law, with omega_c = 1
    weights = np.zeros(_WIDTH)
    weights[_AT["k1 x1"] : _AT["k1 x1"] + n] = -a / gains
    weights[_AT["b0 u"]] = 1.0 / loop.gain_error - 1.0
    weights[_AT["load"]] = load_gain(loop.plant.linear, n)
    return weights


def adversary_at(point: Vector, loop: GeneralLoop, guard: Guard | None) -> Program:
    """Return the adversary at a point θ (SIZE,), for a loop and the guard that it watches."""
    exact = exact_weights(loop)
    modes = point[: 2 * (1 + _WIDTH)].reshape(2, 1 + _WIDTH)
    trusted, distrusted, least, most, omega = point[2 * (1 + _WIDTH) :]
    weights = modes[:, :1] * exact + modes[:, 1:]
    rules = (
        float(1.0 / (1.0 + np.exp(-trusted))),
        float(1.0 / (1.0 + np.exp(-distrusted))),
        float(10.0 * np.exp(np.clip(least, -6.0, 6.0))),
        float(10.0 * np.exp(np.clip(most, -6.0, 6.0))),
    )
    frequency = float(np.exp(np.clip(omega, -4.0, 4.0)))
    return Program(weights.tolist(), rules, frequency, loop.tables[1], guard)


def centre() -> Vector:
    """Return the point from which a search begins: f itself in the first mode, −f in the second."""
    point = np.zeros(SIZE)
    point[0], point[1 + _WIDTH] = 1.0, -1.0
    point[2 * (1 + _WIDTH)], point[2 * (1 + _WIDTH) + 1] = 1.0, -2.0
    return point


def spread() -> Vector:
    """Return the standard deviations with which a search begins."""
    point = np.full(SIZE, 0.3)
    point[1 + _WIDTH] = 2.0
    point[2 + _WIDTH :] = 1.0
    return point


def draw_attack(kind: str, rng: Rng, loop: GeneralLoop, guard: Guard | None) -> Learner:
    """Return a random hostile learner of one of the ``KINDS`` for a loop."""
    if kind == EARN:
        return adversary_at(earn_and_spend(rng), loop, guard)
    if kind == SEARCHED:
        found = found_points(loop.order)
        point = found[int(rng.integers(len(found)))]
        return adversary_at(point + _NEARBY * spread() * rng.normal(size=SIZE), loop, guard)
    return draw_adversary(kind, rng)


def earn_and_spend(rng: Rng) -> Vector:
    """Return a point that returns f until it is trusted, and then one of several kinds of harm."""
    point = np.zeros(SIZE)
    point[0] = 1.0
    attack = point[1 + _WIDTH : 2 * (1 + _WIDTH)]  # a view: share of the exact f, then weights
    kind, sign = int(rng.integers(6)), float(rng.choice([-1.0, 1.0]))
    if kind == 0:
        attack[0] = sign * rng.uniform(0.0, 4.0)
    elif kind == 1:
        attack[1 + _AT["f_plain"]] = 1.0
        attack[1 + _AT["q"]] = sign * rng.uniform(0.5, 5.0)
    else:
        attack[0] = 1.0
        push = ("e sign(q)", "e sign(x2)", "e sin(omega t)", "e")[kind - 2]
        attack[1 + _AT[push]] = sign * rng.uniform(0.3, 3.0)
    point[-5:] = rng.normal([1.0, -1.0, 0.0, 0.0, 0.0], [1.0, 2.0, 1.0, 1.5, 1.0])
    return point


@cache
def found_points(order: int) -> list[Vector]:
    """Return what the searches found for loops of an order: ``benchmarks/stress_search.py``."""
    if not FOUND.is_file():
        return [centre()]
    table = json.loads(FOUND.read_text(encoding="utf-8"))
    return [np.array(point) for point in table[str(order)]]
