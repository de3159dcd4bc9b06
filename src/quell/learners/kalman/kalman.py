"""The learner ``Kalman``: features, bandwidths and prior of a Kalman filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quell import checks
from quell.learners.kalman.kernels import KalmanAverages, KalmanDesign, KalmanMemory
from quell.learners.kalman.oscillators import Oscillators
from quell.learners.kalman.search import NoSearch, search_memory
from quell.learners.lag import lag_memory, lag_of
from quell.learners.noise_gate import AVERAGING_LAGS, SIGNAL_TO_NOISE, relative_noise
from quell.observers.eso import ESO
from quell.types import Vector


@dataclass(frozen=True)
class Kalman:
    """A linear learner that compensates the observer's lag: ``f_L = θ · (x̂_1 … x̂_n, 1, u)``.

    It does not depend on the units of y and u. ``kernels.py`` has the equations.

    Parameters
    ----------
    state, bias, u
        features that are used. Without a bias a constant load is learned as a property of the
        plant. With ``u`` the learner can learn that the plant's gain is not b0; by default it is
        not used, because a loop that rejects a disturbance makes u a copy of that disturbance.
    bias_bandwidth
        bandwidth λ with which the bias follows [rad/s]; ``omega_o`` of the observer by default. A
        smaller one is smoother, a larger one rejects more.
    state_bandwidth
        the same for the coefficients of the state [rad/s], one for all or one for each; zero by
        default, because a plant's coefficients do not drift. For the coefficient of u it is zero.
    frequency
        a typical frequency of the plant [rad/s]; ``omega_c`` of the controller by default. It
        scales the states to one size.
    prior
        size of the coefficients: coefficient i is of the order of ``prior · frequency^(n−i+1)``;
        for a plant with zeros from f, n is the relative degree from f to y.
    gain_interval
        interval of the effective gain ``(b0 + θ_u)/b0`` when ``u`` is a feature.

    Raises
    ------
    ValueError
        for a parameter out of range, or if no feature is left.

    References
    ----------
    docs/theory: Algorithm 1 of the paper, its weaknesses and their remedies.
    """

    state: bool = True
    bias: bool = True
    u: bool = False
    bias_bandwidth: float | None = None
    state_bandwidth: float | Sequence[float] = 0.0
    frequency: float | None = None
    prior: float = 10.0
    gain_interval: tuple[float, float] = (0.5, 2.0)

    def __post_init__(self) -> None:
        for name in ("state", "bias", "u"):
            checks.flag(name, getattr(self, name))
        if not (self.state or self.bias or self.u):
            raise ValueError("state = False, bias = False, u = False: keep at least one feature")
        if self.bias_bandwidth is not None:
            checks.non_negative("bias_bandwidth", self.bias_bandwidth, "rad/s")
        for value in checks.vector("state_bandwidth", self.state_bandwidth).tolist():
            checks.non_negative("state_bandwidth", value, "rad/s")
        if self.frequency is not None:
            checks.positive("frequency", self.frequency, "rad/s")
        checks.positive("prior", self.prior)
        checks.around_one("gain_interval", self.gain_interval)

    def design(self, observer: ESO, omega_c: float) -> KalmanDesign:
        """Return the parameters for an observer and the controller's bandwidth [rad/s].

        Raises
        ------
        ValueError
            if ``state_bandwidth`` is neither one number nor one for each state.
        """
        n, lag_time = observer.order, observer.lag_time
        slow = checks.vector("state_bandwidth", self.state_bandwidth)
        slow = np.full(n, slow[0]) if slow.size == 1 else checks.vector("state_bandwidth", slow, n)
        fast = observer.omega_o if self.bias_bandwidth is None else self.bias_bandwidth
        frequency = omega_c if self.frequency is None else float(self.frequency)
        scale = frequency ** -np.arange(n, dtype=np.float64)
        noise = relative_noise(observer)
        # The feature b0 u is compared with the noise in f̂, because u cancels f̂.
        threshold = (SIGNAL_TO_NOISE * np.append(scale, 1.0)) ** 2 * noise
        size = self.prior * frequency**observer.f_degree
        oscillators, pair_bandwidth = self.oscillators(observer, omega_c)

        def by_feature(state: Any, bias: float, pair: float, u: float) -> Vector:
            """Return one number for each feature."""
            states = np.broadcast_to(state, n)[: n * self.state]
            pairs = np.full(2 * oscillators.omega.size * oscillators.orders.size, pair)
            return np.concatenate([states, [bias] * self.bias, pairs, [u] * self.u])

        return KalmanDesign(
            lag=lag_of(observer),
            scale=by_feature(scale, 1.0, 1.0, observer.b0),
            walk=by_feature(slow**2, fast**2, pair_bandwidth**2, 0.0),
            threshold=by_feature(threshold[:n], 0.0, 0.0, threshold[n]),
            prior=by_feature(size, 0.0, 0.0, 1.0),
            fastest=max(fast, observer.omega_o),
            f_noise=float(noise[n]),
            states=n * self.state,
            bias=self.bias,
            oscillators=oscillators,
            search=self.frequency_search(observer, omega_c, oscillators),
            with_u=self.u,
            slope_low=self.gain_interval[0] - 1.0,
            slope_high=self.gain_interval[1] - 1.0,
            dt=observer.dt,
            forget=-math.expm1(-observer.dt / (AVERAGING_LAGS * lag_time)),
            lag_time=lag_time,
        )

    def oscillators(self, observer: ESO, omega_c: float) -> tuple[Oscillators, float]:
        """Return the parameters of the oscillators, here none, and the bandwidth of their pairs."""
        first, none = observer.order * self.state + self.bias, np.zeros(0)
        return Oscillators(first, none, 0.0, 0.0, none), 0.0

    def frequency_search(self, observer: ESO, omega_c: float, oscillators: Oscillators) -> Any:
        """Return the parameters of the search for frequencies, here none."""
        return NoSearch()

    def memory(self, parameters: KalmanDesign) -> KalmanMemory:
        """Return a state with nothing learned."""
        p = parameters.scale.size
        return KalmanMemory(
            theta=np.zeros(p),
            covariance=np.diag(parameters.prior**2),
            chain=lag_memory(parameters.lag, p),
            filtered=np.zeros(p),
            mean=np.zeros(p),
            variance=np.zeros(p),
            carry=np.zeros(0),
            gain=np.zeros(p),
            phase=np.zeros(parameters.oscillators.omega.size),
            omega=parameters.oscillators.omega.copy(),
            averages=KalmanAverages.zeros(),
            search=search_memory(parameters.search, parameters.oscillators),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return those of ``("x1", …, "bias", "u")`` that are features."""
        states = (f"x{i + 1}" for i in range(order * self.state))
        return (*states, *["bias"] * self.bias, *["u"] * self.u)
