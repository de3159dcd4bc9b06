"""A peer: pyadrc's ``StateSpace`` does the same thing on loops of order 1 and 2, with limits; and its tracking differentiator."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.prefilters import TrackingDifferentiator, fhan, prefilter

pyadrc = pytest.importorskip("pyadrc")


@pytest.mark.parametrize("half_gain", [False, True], ids=["full gain", "half gain"])
@pytest.mark.parametrize("order", [1, 2])
def test_every_sample_agrees_over_a_run_with_limits(order: int, half_gain: bool) -> None:
    """Observer, law, rate limit and saturation, with the applied u fed back, for 1600 samples of a noisy loop."""
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
    for k in range(1600):
        r = float(k // 400 % 2) + 0.2
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
    found, known = [], []
    for k in range(3000):
        r = float(k // 400 % 3) + 0.3 * np.sin(0.02 * k)
        found.append((prefilter(design, memory, r), memory.v[1]))
        known.append(theirs(r))
    np.testing.assert_allclose(found, known, atol=1e-8)


class AsPyadrc:
    """An ``ADRC`` with the interface of pyadrc's ``StateSpace``, in absolute form and full gain."""

    def __init__(
        self,
        order: int,
        delta: float,
        b0: float,
        w_cl: float,
        k_eso: float,
        eso_init: Any = None,
        r_lim: Any = (None, None),
        m_lim: Any = (None, None),
    ) -> None:
        observer = ql.ESO.model_free(order=order, b0=b0, omega_o=k_eso * w_cl, dt=delta)
        self.controller = ql.ADRC(observer, omega_c=w_cl)
        self.limiter = (m_lim, r_lim)
        self.reset(eso_init)

    def __call__(self, y: float, u: float, r: float) -> float:
        """Return the control signal for y, the last u and r."""
        self.controller.applied(u)
        return self.controller.step(r, y)

    def reset(self, x0: Any = None) -> None:
        """Set the estimates (x̂, f̂)."""
        x0 = np.zeros(self.controller.observer.order + 1) if x0 is None else np.asarray(x0, float)
        self.controller.start_at(x0[:-1], f=x0[-1], r=0.0)

    @property
    def eso_states(self) -> Any:
        """The estimates as a column."""
        known = self.controller.estimate
        return np.append(known.x, known.f)[:, None]

    @property
    def limiter(self) -> Any:
        """Limits of magnitude, and of the change in a sample."""
        return self._limiter

    @limiter.setter
    def limiter(self, limits: Any) -> None:
        (low, high), (fall, rise) = self._limiter = limits
        dt, inf = self.controller.dt, np.inf
        self.controller.set_limits(
            u_min=-inf if low is None else low,
            u_max=inf if high is None else high,
            rate_limit=(-inf if fall is None else fall / dt, inf if rise is None else rise / dt),
        )


@pytest.mark.filterwarnings("ignore::quell.DesignWarning")
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("delta", "k_eso"), [(1.0, 1.0), (0.01, 5.0), (1.0, 3.0)])
def test_coarse_sampling_one_sided_limits_and_given_states_agree(
    order: int, delta: float, k_eso: float
) -> None:
    """``omega_o dt`` up to 12, limits of the rate that differ by direction and change while it runs, and an initial state: every sample agrees.

    pyadrc's own tests design with ``omega_o dt = 4``.
    """
    rng = np.random.default_rng(order)
    settings = {"order": order, "delta": delta, "b0": 2.0, "w_cl": 4.0, "k_eso": k_eso}
    initial = rng.normal(size=order + 1)
    limits = {"r_lim": (-0.1, 0.4), "m_lim": (-1.5, None)}
    ours = AsPyadrc(**settings, eso_init=initial, **limits)
    theirs = pyadrc.StateSpace(**settings, eso_init=initial, **limits)
    before = 0.0
    for k in range(400):
        if k == 100:
            ours.limiter = theirs.limiter = ((-0.2, 1.1), (None, 0.05))
        if k == 200:
            ours.limiter = theirs.limiter = ((None, None), (0.0, 1.0))
        if k == 300:
            fresh = rng.normal(size=order + 1)
            ours.limiter = theirs.limiter = ((None, None), (None, None))
            ours.reset(fresh)
            theirs.reset(fresh)
        y, r = rng.normal(), float(k // 50 % 2)
        u = ours(y, before, r)
        assert u == pytest.approx(float(theirs(y, before, r)), rel=1e-9)
        known = theirs.eso_states
        np.testing.assert_allclose(ours.eso_states, known, atol=1e-12 * np.max(np.abs(known)))
        before = u
