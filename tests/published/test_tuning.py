"""PI controllers with the largest integral gain at M_s = 1.4: published values, and the optimum itself.

With ``P(jω) = ρ e^(jφ)`` the bound |1 + L| ≥ R = 1/M_s excludes, at each frequency, an ellipse of (K, k_i).
Its lowest point is at ``K = −cos φ/ρ``, ``k_i = −ω (R + sin φ)/ρ``, and the optimum is the lowest point that
is stationary over ω (Åström, Panagopoulos & Hägglund, "Design of PI controllers based on non-convex
optimization", *Automatica* 34, 1998, whose values of two plants are here, too). For n equal lags, θ = atan ω::

    (sin nθ − R) (1 + n sin² θ) + n sin θ cos θ cos nθ = 0,    K = −cos nθ/cosⁿ θ

For 1/(s+1)⁴ an independent program has K = 0.438, T_i = 2.28, from a search. The optimum is K = 0.43261, T_i = 2.25357, which is
1.2 % off in both; the best k_i at K = 0.438 is only 0.01 % lower, with T_i = 2.282. So the pair is a point beside the
optimum, where a search ends that knows M_s at some frequencies only: at 401 from 0.1 to 100, for example.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

import quell as ql
from quell.tuning import Constraints

# Lags, sample time, published K and T_i.
PLANTS = {
    "1/(s+1)^3": ([1.0, 1.0, 1.0], 2e-3, 0.633, 1.95),
    "four lags": ([1.0, 0.2, 0.04, 0.008], 2e-4, 1.93, 0.745),
    "1/(s+1)^4": ([1.0, 1.0, 1.0, 1.0], 4e-3, 0.438, 2.28),
}
PUBLISHED = ("1/(s+1)^3", "four lags")
R = 1.0 / 1.4


def optimum(lags: list[float], late: float = 0.0) -> tuple[float, float]:
    """Return K and T_i of the optimum for a product of lags, behind a dead time [s]."""
    T = np.array(lags)

    def lowest(omega: float) -> tuple[float, float]:
        phi, rho = phase(omega), 1.0 / float(np.sqrt(np.prod(1.0 + (omega * T) ** 2)))
        return -np.cos(phi) / rho, -omega * (R + np.sin(phi)) / rho

    def phase(omega: float) -> float:
        return -float(np.sum(np.arctan(omega * T))) - omega * late

    def slope(omega: float) -> float:
        x = omega * T
        by_size = (R + np.sin(phase(omega))) * (1.0 + np.sum(x**2 / (1.0 + x**2)))
        return float(by_size - (np.sum(x / (1.0 + x**2)) + omega * late) * np.cos(phase(omega)))

    ends = [brentq(lambda w, at=at: phase(w) + at, 1e-3, 1e3) for at in (0.51 * np.pi, np.pi)]
    K, k_i = lowest(brentq(slope, *ends, xtol=1e-14))
    return float(K), float(K / k_i)


def tuned(name: str) -> dict[str, float]:
    """Return K and T_i of ``ql.tune``."""
    lags, dt, _, _ = PLANTS[name]
    den = np.poly(-1.0 / np.array(lags)) * np.prod(lags)
    bounds = Constraints(m_s=1.4, m_t=None, noise_over_pi=None)
    found = ql.tune(
        ([1.0], den.tolist()), dt, structure="pi-unfiltered", constraints=bounds, compare=()
    )
    return dict(found.design.values)


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_pi_optima_are_those_published(name: str) -> None:
    """K and T_i within 1 %; sampling adds half a sample of delay, which is 0.1 % of T_i at most."""
    found, (_, _, K, Ti) = tuned(name), PLANTS[name]
    assert found["K"] == pytest.approx(K, rel=0.01)
    assert found["T_i"] == pytest.approx(Ti, rel=0.01)


@pytest.mark.parametrize("name", PLANTS)
def test_the_pi_optima_are_those_of_the_closed_form(name: str) -> None:
    """K and T_i within 0.03 %, where half a sample of delay is part of the closed form."""
    found, (lags, dt, _, _) = tuned(name), PLANTS[name]
    K, Ti = optimum(lags, 0.5 * dt)
    assert found["K"] == pytest.approx(K, rel=3e-4)
    assert found["T_i"] == pytest.approx(Ti, rel=3e-4)
    without = optimum(lags)
    assert found["K"] / found["T_i"] == pytest.approx(without[0] / without[1], rel=3e-3)


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_values_are_the_closed_form_rounded(name: str) -> None:
    """To half a unit of their last digit."""
    _, _, K, Ti = PLANTS[name]
    exact = optimum(PLANTS[name][0])
    assert abs(exact[0] - K) <= 0.5 * (0.001 if K < 1.0 else 0.01)
    assert abs(exact[1] - Ti) <= 0.5 * (0.001 if Ti < 1.0 else 0.01)


def test_the_optimum_of_four_equal_lags_is_flat() -> None:
    """Ten digits from one equation in θ; K = 0.438 costs 0.01 % of k_i, and then T_i is 2.28."""

    def stationary(theta: float) -> float:
        inner = (np.sin(4.0 * theta) - R) * (1.0 + 4.0 * np.sin(theta) ** 2)
        return float(inner + 2.0 * np.sin(2.0 * theta) * np.cos(4.0 * theta))

    theta = brentq(stationary, 0.4, 0.6, xtol=1e-15)
    K = -np.cos(4.0 * theta) / np.cos(theta) ** 4
    k_i = np.tan(theta) * (np.sin(4.0 * theta) - R) / np.cos(theta) ** 4
    assert (K, K / k_i) == pytest.approx((0.4326131561, 2.2535661667), abs=1e-10)
    assert optimum(PLANTS["1/(s+1)^4"][0]) == pytest.approx((K, K / k_i), rel=1e-12)
    assert excess(K, K / k_i, np.geomspace(0.3, 0.9, 20_001)) == pytest.approx(0.0, abs=1e-8)
    beside = brentq(lambda Ti: excess(0.438, Ti, np.geomspace(0.3, 0.9, 20_001)), 2.0, 2.6)
    assert round(beside, 2) == 2.28
    assert 0.438 / beside == pytest.approx((1.0 - 1e-4) * k_i, rel=1e-5)


def excess(K: float, Ti: float, omega: Any) -> float:
    """Return the largest |S| at some frequencies less 1.4, for 1/(s+1)⁴."""
    s = 1j * omega
    L = K * (1.0 + 1.0 / (s * Ti)) / (s + 1.0) ** 4
    return float(np.max(1.0 / np.abs(1.0 + L))) - 1.4


def test_a_coarse_grid_ends_beside_the_flat_optimum() -> None:
    """M_s as the largest value at 401 frequencies from 0.1 to 100 gives K = 0.438, T_i = 2.28."""
    omega = np.geomspace(0.1, 100.0, 401)

    def gain(Ti: float) -> float:
        return float(brentq(excess, 0.2, 0.6, args=(Ti, omega), xtol=1e-12))

    found = minimize_scalar(lambda Ti: -gain(Ti) / Ti, bounds=(2.1, 2.45), method="bounded")
    assert (round(gain(found.x), 3), round(found.x, 2)) == (0.438, 2.28)
