"""A peer: pyadrc's ``StateSpace`` does the same thing on loops of order 1 and 2, with limits."""

from __future__ import annotations

import numpy as np
import pytest

import quell as ql

pyadrc = pytest.importorskip("pyadrc")


@pytest.mark.parametrize("order", [1, 2])
def test_every_sample_agrees_over_a_run_with_limits(order: int) -> None:
    """Observer, law, rate limit and saturation, with the applied u fed back, for 3000 samples of a noisy loop."""
    dt, rng = 0.01, np.random.default_rng(4)
    ours = ql.ADRC(ql.ESO.model_free(order=order, b0=2.0, omega_o=20.0, dt=dt), omega_c=4.0, u_min=-1.5, u_max=2.5, rate_limit=15.0)
    theirs = pyadrc.StateSpace(order=order, delta=dt, b0=2.0, w_cl=4.0, k_eso=5.0, m_lim=(-1.5, 2.5), r_lim=(-0.15, 0.15))
    y = speed = before = 0.0
    for k in range(3000):
        r = float(k // 500 % 2) + 0.2
        measured = y + 1e-3 * rng.normal() if k else 0.0
        u = ours.step(r, measured)
        assert u == pytest.approx(float(theirs(measured, before, r)), abs=1e-9)
        speed = speed + dt * (2.5 * u - speed - 0.4) if order == 2 else 2.5 * u - y - 0.4
        y, before = y + dt * speed, u
