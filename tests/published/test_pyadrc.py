"""A peer: pyadrc's ``StateSpace`` does the same thing on loops of order 1 and 2, with limits; and its tracking differentiator."""

from __future__ import annotations

import numpy as np
import pytest

import quell as ql
from quell.controllers.prefilters.differentiator import TrackingDifferentiator, fhan
from quell.controllers.prefilters.prefilter import prefilter

pyadrc = pytest.importorskip("pyadrc")


@pytest.mark.parametrize("half_gain", [False, True], ids=["full gain", "half gain"])
@pytest.mark.parametrize("order", [1, 2])
def test_every_sample_agrees_over_a_run_with_limits(order: int, half_gain: bool) -> None:
    """Observer, law, rate limit and saturation, with the applied u fed back, for 3000 samples of a noisy loop."""
    dt, rng = 0.01, np.random.default_rng(4)
    observer = ql.ESO.model_free(order=order, b0=2.0, omega_o=20.0, dt=dt, half_gain=half_gain)
    ours = ql.ADRC(observer, omega_c=4.0, u_min=-1.5, u_max=2.5, rate_limit=15.0)
    theirs = pyadrc.StateSpace(
        order=order,
        delta=dt,
        b0=2.0,
        w_cl=4.0,
        k_eso=5.0,
        m_lim=(-1.5, 2.5),
        r_lim=(-0.15, 0.15),
        half_gain=(False, half_gain),
    )
    y = speed = before = 0.0
    for k in range(3000):
        r = float(k // 500 % 2) + 0.2
        measured = y + 1e-3 * rng.normal() if k else 0.0
        u = ours.step(r, measured)
        assert u == pytest.approx(float(theirs(measured, before, r)), abs=1e-9)
        speed = speed + dt * (2.5 * u - speed - 0.4) if order == 2 else 2.5 * u - y - 0.4
        y, before = y + dt * speed, u


@pytest.mark.parametrize("order", [1, 2])
def test_a_half_gain_law_halves_k_where_pyadrc_halves_the_cancellation_too(order: int) -> None:
    """The paper halves k, and so does ``ADRC``. pyadrc 2 halves ``1/b0`` of f̂ as well, but not the gain of r: then y settles elsewhere.

    From the same y and u the two differ by just that, ``(k_1 r + f̂)/(2 b0)``, and ours settles at
    r.
    """
    dt, b0, omega_c = 0.01, 2.0, 4.0
    ours = ql.ADRC(
        ql.ESO.model_free(order=order, b0=b0, omega_o=20.0, dt=dt), omega_c=omega_c, half_gain=True
    )
    theirs = pyadrc.StateSpace(
        order=order, delta=dt, b0=b0, w_cl=omega_c, k_eso=5.0, half_gain=(True, False)
    )
    y = speed = before = 0.0
    for k in range(3000):
        r = 0.2 if k < 1500 else 1.0
        u = ours.step(r, y)
        peer = float(theirs(y, before, r))
        assert u == pytest.approx(
            peer - (omega_c**order * r + float(theirs.eso_states[-1, 0])) / (2.0 * b0), abs=1e-9
        )
        speed = speed + dt * (2.5 * u - speed - 0.4) if order == 2 else 2.5 * u - y - 0.4
        y, before = y + dt * speed, u
    assert y == pytest.approx(1.0, abs=1e-6)


def test_fhan_is_pyadrcs() -> None:
    """Over all its regions, borders near and far."""
    rng = np.random.default_rng(1)
    for _ in range(2000):
        x1, x2 = rng.normal(size=2) * 10.0 ** rng.uniform(-6.0, 1.0, 2)
        r0, h0 = 10.0 ** rng.uniform(-1.0, 2.0), 10.0 ** rng.uniform(-3.0, 0.0)
        assert fhan(x1, x2, r0, h0) == pytest.approx(
            pyadrc.fhan(x1, x2, r0, h0), rel=1e-9, abs=1e-9 * r0
        )


@pytest.mark.parametrize("horizon", [0.01, 0.05])
def test_the_tracking_differentiator_is_pyadrcs(horizon: float) -> None:
    """Sample by sample, v_1 and v_2, for a reference that jumps and wanders."""
    theirs = pyadrc.TrackingDifferentiator(delta=0.01, r0=3.0, h0=horizon)
    ours = TrackingDifferentiator(acceleration=3.0, horizon=horizon)
    design = ours.design(0.01)
    memory = ours.memory(design)
    for k in range(3000):
        r = float(k // 400 % 3) + 0.3 * np.sin(0.02 * k)
        v1 = prefilter(design, memory, r)
        np.testing.assert_allclose([v1, memory.v[1]], theirs(r), atol=1e-8)
