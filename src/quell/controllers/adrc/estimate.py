"""The estimates of an ADRC controller after a step."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.adrc.law import AdrcDesign, AdrcState
from quell.guard import GUARD_CHANNELS, Reason, write_channels
from quell.learners.base import coefficients
from quell.types import Status, Vector


class Estimate(NamedTuple):
    """Estimates and status of an ADRC controller after a step."""

    x: Vector
    """(n,): y and its derivatives; if the plant has zeros, see ``observer.states_of``."""
    f: float
    """Total disturbance ``f_learned + f_residual`` [y-unit/s^n; y-unit/s^f_degree with zeros]."""
    f_learned: float
    """The learner's share, f_L; with a guard its constant part is free, and ``f`` is right."""
    f_residual: float
    """The observer's share, Δf̂."""
    theta: dict[str, float]
    """The learner's coefficients by feature."""
    u: float
    """The applied control signal."""
    status: Status
    """Status flags of the step."""
    authority: float = 1.0
    """Share of its output that the guard allows the learner."""
    error_plain: float = math.nan
    """RMS error in f of an ESO without learner, as the guard estimates it [y-unit/s^n]."""
    error_learned: float = math.nan
    """The same for the learner with full authority."""
    reason: Reason = Reason.TRUSTED
    """Reason for the authority."""
    f_derivatives: Vector = np.zeros(0)
    """(m − 1,): derivatives of Δf̂, of an observer with m extended states [y-unit/s^(n+j)]."""


def read_estimate(design: AdrcDesign, state: AdrcState, features: tuple[str, ...]) -> Estimate:
    """Return the estimates in ``state``, with the learner's coefficients named by ``features``."""
    order = design.law.size
    theta = np.zeros(len(features))
    coefficients(design.learner, state.learner, theta)
    learned, residual = float(state.loop[0].f_learned), float(state.seen[order])
    guarded: dict[str, Any] = {}
    row = np.zeros(len(GUARD_CHANNELS))
    if write_channels(design.guard, state.guard, row):
        guarded = dict(zip((name for name, _ in GUARD_CHANNELS), row.tolist(), strict=True))
        guarded["reason"] = Reason(int(guarded["reason"]))
    return Estimate(
        x=state.seen[:order].copy(),
        f=learned + residual,
        f_learned=learned,
        f_residual=residual,
        theta=dict(zip(features, theta.tolist(), strict=True)),
        u=float(state.loop[0].u),
        status=Status(int(state.loop[0].status)),
        **guarded,
        f_derivatives=state.seen[order + 1 :].copy(),
    )
