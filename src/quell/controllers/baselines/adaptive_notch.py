"""State feedback of a Kalman filter with oscillators whose frequencies are found and followed.

The classical adaptive controller for sinusoids of unknown frequency. The load at the plant's input
is a slow bias and m sinusoids, each a rotation (Bodson, Sacks & Khosla, *IEEE Trans. Automatic
Control* 39, 1994: adaptive feedforward cancellation is an internal model)::

    x⁺ = Φ x + Γ (u + w),    w = d + Σ p_j,    d⁺ = d + noise
    p_j⁺ = c_j p_j + s_j q_j,    q_j⁺ = −s_j p_j + c_j q_j,    c_j, s_j = cos, sin of ω̂_j dt

and ``u = N r − K x̂ − ŵ``. The filter's covariance follows its Riccati equation in each sample::

    P⁻ = F P Fᵀ + Q,   L = P⁻ Hᵀ/(H P⁻ Hᵀ + R),   P = (I − L H) P⁻

with R = 1/dt, ``q b²/R dt = omega_o^(2(ν+1))`` for the bias as in ``LQG``, and for an oscillator
``2 q (bandwidth/ω̂_j)²``, with which its pole lies near ``−bandwidth ± j ω̂_j`` where that is below
omega_o.

*Frequencies are followed* by a phase-locked loop of second order (Bodson & Douglas, *Automatica*
33, 1997, section 4, the indirect method): a correction (δp, δq) turns the oscillator by

    δφ = (q δp − p δq)/(p² + q²),      ω̂ ← ω̂ + (bandwidth/4) δφ

critically damped, as δφ is ``bandwidth dt`` times the error of the phase. ``|δφ|`` counts up to
``bandwidth dt``, because the direction of an amplitude that is being found says nothing of ω.

*Frequencies are found* from the spectrum of ŵ over a window of ``listening`` seconds, with Hann's
window, at frequencies half a bin apart within ``band``. Its strongest lines, with parabolic
interpolation (Smith & Serra 1987), start oscillators where there is none within a bin; those that
have no line are taken for it, with a covariance that finds the amplitude within a period. A line
must have five times the mean power. Windows follow each other.

A load that depends on the position instead, as cogging, has a known *wave*: it turns by
``wave (x̂_1⁺ − x̂_1)`` from sample to sample in place of ω̂ dt, and nothing of it is searched.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import (
    Limits,
    RateLimit,
    apply_limits,
    checked_limits,
    control,
    control_at_rest,
    hold_last_good,
    is_usable_control,
    reset_loop,
    set_applied_control,
    status_flags,
    write_row,
)
from quell.controllers.baselines.state_feedback import (
    LQG,
    SampledModel,
    feedback_law,
    stationary_gain,
)
from quell.controllers.linear import LinearLaw
from quell.controllers.stateful import StatefulController
from quell.kernels.dispatch import kernel
from quell.kernels.functions import cos, log2, sin
from quell.kernels.sized import Scalars, clear
from quell.lti.models import leading_gain
from quell.plants.linear import LinearPlant
from quell.types import Channels, Matrix, Status, Vector

_MEASUREMENT_HELD = int(Status.MEASUREMENT_HELD)
_OVERFLOWED = int(Status.OVERFLOWED)
# A line of the spectrum has so many times its mean power. The highest frequency turns by at most so
# much between two values of the spectrum's sum.
_LINE, _TURN = 5.0, 0.3
# Frequencies that differ by less than this share are one.
_EQUAL = 1e-6
# Gain of the phase-locked loop: critically damped.
_FOLLOWS = 0.25


class NotchDesign(NamedTuple):
    """Parameters for n states, m oscillators and G frequencies of the spectrum; N = n + 1 + 2m."""

    transition: Matrix  # Φ (n, n)
    input: Vector  # Γ (n,)
    output: Vector  # H (n,)
    gain: Vector  # K (n,)
    reference: float  # N
    bias_noise: float  # q dt
    pair_noise: float  # 2 q dt bandwidth²
    measured_noise: float  # R
    follow: float  # bandwidth/4
    low: float  # limits of the frequencies [rad/s]
    high: float
    first: Vector  # frequencies to start with; zero: not known yet (m,)
    waves: Vector  # [rad/y-unit]; zero for an oscillator in time (m,)
    lines: Vector  # frequencies of the spectrum [rad/s] (G,)
    window: int  # values in a window; zero: nothing is searched
    stride: int  # samples in a value
    dt: float
    limits: Limits


class NotchLoop(Scalars):
    """Scalars of the loop, kept from one sample to the next."""

    u: float  # applied control signal
    u_unlimited: float
    r: float  # last finite reference
    y: float  # last finite measurement
    started: float  # 1 after the first finite measurement, else 0
    has_reference: float
    status: float
    total: float  # sum of ŵ over the samples of a value
    summed: float  # their number
    value: float  # number of the value in the window


class NotchState(NamedTuple):
    """State of the controller."""

    x: Vector  # x⁻, bias, pairs (N,)
    P: Matrix  # P⁻ (N, N)
    omega: Vector  # ω̂; zero where the oscillator rests (m,)
    sums: Matrix  # real and imaginary part of the spectrum (G, 2)
    turned: Matrix  # cos and sin of lines times time (G, 2)
    gained: Vector  # work: L (N,)
    moved: Matrix  # work: F P (N, N)
    rotations: Matrix  # work: cos and sin of the angles (m, 2)
    used: Vector  # work: 1 where a line belongs to the oscillator (m,)
    loop: NDArray[NotchLoop]  # (1,)


@kernel
def _start(design: NotchDesign, state: NotchState, y: float) -> None:
    """Begin at rest at ``y``, with nothing known."""
    n, h = design.input.size, 0.0
    clear(state.loop)
    for i in range(state.x.size):
        state.x[i] = 0.0
        for j in range(state.x.size):
            state.P[i, j] = 0.0
    for i in range(n):
        h += design.output[i] * design.output[i]
    for i in range(n):
        state.x[i] = design.output[i] * y / h
    for j in range(state.omega.size):
        state.omega[j] = design.first[j]
    _open_window(design, state)


@kernel
def _open_window(design: NotchDesign, state: NotchState) -> None:
    state.loop[0].value = state.loop[0].total = state.loop[0].summed = 0.0
    for i in range(design.lines.size):
        state.sums[i, 0] = state.sums[i, 1] = 0.0
        state.turned[i, 0], state.turned[i, 1] = 1.0, 0.0


@kernel
def _load(design: NotchDesign, state: NotchState) -> float:
    """Return ŵ."""
    n = design.input.size
    total = state.x[n]
    for j in range(state.omega.size):
        total += state.x[n + 1 + 2 * j]
    return total


@kernel
def _correct(design: NotchDesign, state: NotchState, y: float) -> None:
    """Correct estimate and covariance by a measurement, and turn the frequencies."""
    n, x, P, L = design.input.size, state.x, state.P, state.gained
    error, spread = y, design.measured_noise
    for i in range(x.size):
        total = 0.0
        for k in range(n):
            total += P[i, k] * design.output[k]
        L[i] = total
    for k in range(n):
        error -= design.output[k] * x[k]
        spread += design.output[k] * L[k]
    for j in range(state.omega.size):
        at = n + 1 + 2 * j
        if state.omega[j] > 0.0 and design.waves[j] == 0.0:
            p, q = x[at], x[at + 1]
            size = p * p + q * q
            if size > 0.0:
                turn = (q * L[at] - p * L[at + 1]) * error / (spread * size)
                most = 4.0 * design.follow * design.dt
                omega = state.omega[j] + design.follow * min(max(turn, -most), most)
                state.omega[j] = min(max(omega, design.low), design.high)
    for i in range(x.size):
        x[i] += L[i] * error / spread
        for k in range(i + 1):
            P[i, k] -= L[i] * L[k] / spread
            P[k, i] = P[i, k]


@kernel
def _predict(design: NotchDesign, state: NotchState, u: float) -> None:
    """Advance estimate and covariance by a sample."""
    n, x, P, M = design.input.size, state.x, state.P, state.moved
    size = x.size
    u_and_w, before = u + _load(design, state), x[0]
    for i in range(n):
        total = design.input[i] * u_and_w
        for k in range(n):
            total += design.transition[i, k] * x[k]
        state.gained[i] = total
    for i in range(n):
        x[i] = state.gained[i]
    for j in range(state.omega.size):
        angle = state.omega[j] * design.dt
        if design.waves[j] != 0.0:
            angle = design.waves[j] * (x[0] - before)
        c, s, at = cos(angle), sin(angle), n + 1 + 2 * j
        state.rotations[j, 0], state.rotations[j, 1] = c, s
        x[at], x[at + 1] = c * x[at] + s * x[at + 1], c * x[at + 1] - s * x[at]
    # M = F P, then P = M Fᵀ + Q.
    for column in range(size):
        of_load = P[n, column]
        for j in range(state.omega.size):
            of_load += P[n + 1 + 2 * j, column]
        for i in range(n):
            total = design.input[i] * of_load
            for k in range(n):
                total += design.transition[i, k] * P[k, column]
            M[i, column] = total
        M[n, column] = P[n, column]
        for j in range(state.omega.size):
            c, s, at = state.rotations[j, 0], state.rotations[j, 1], n + 1 + 2 * j
            M[at, column] = c * P[at, column] + s * P[at + 1, column]
            M[at + 1, column] = c * P[at + 1, column] - s * P[at, column]
    for row in range(size):
        of_load = M[row, n]
        for j in range(state.omega.size):
            of_load += M[row, n + 1 + 2 * j]
        for i in range(n):
            total = design.input[i] * of_load
            for k in range(n):
                total += design.transition[i, k] * M[row, k]
            P[row, i] = total
        P[row, n] = M[row, n]
        for j in range(state.omega.size):
            c, s, at = state.rotations[j, 0], state.rotations[j, 1], n + 1 + 2 * j
            P[row, at] = c * M[row, at] + s * M[row, at + 1]
            P[row, at + 1] = c * M[row, at + 1] - s * M[row, at]
    P[n, n] += design.bias_noise
    for j in range(state.omega.size):
        if state.omega[j] > 0.0:
            noise = design.pair_noise / (state.omega[j] * state.omega[j])
            P[n + 1 + 2 * j, n + 1 + 2 * j] += noise
            P[n + 2 + 2 * j, n + 2 + 2 * j] += noise


@kernel
def _listen(design: NotchDesign, state: NotchState) -> None:
    """Add ŵ to the spectrum; at the end of a window give oscillators their lines."""
    loop = state.loop[0]
    loop.total += _load(design, state)
    loop.summed += 1.0
    if loop.summed < design.stride:
        return
    value = loop.total / loop.summed
    loop.total = loop.summed = 0.0
    hann = 0.5 - 0.5 * cos(2.0 * math.pi * loop.value / design.window)
    for i in range(design.lines.size):
        state.sums[i, 0] += hann * value * state.turned[i, 0]
        state.sums[i, 1] += hann * value * state.turned[i, 1]
        angle = design.lines[i] * design.dt * design.stride
        c, s = cos(angle), sin(angle)
        real, imaginary = state.turned[i, 0], state.turned[i, 1]
        state.turned[i, 0], state.turned[i, 1] = c * real - s * imaginary, s * real + c * imaginary
    loop.value += 1.0
    if loop.value >= design.window:
        _give_lines(design, state)
        _open_window(design, state)


@kernel
def _power(state: NotchState, i: int) -> float:
    return float(state.sums[i, 0] * state.sums[i, 0] + state.sums[i, 1] * state.sums[i, 1])


@kernel
def _strongest(design: NotchDesign, state: NotchState, least: float, below: float) -> int:
    """Return the place of the strongest line with a power from ``least`` on and under ``below``."""
    best, largest = -1, least
    for i in range(1, design.lines.size - 1):
        power = _power(state, i)
        peak = power >= _power(state, i - 1) and power > _power(state, i + 1)
        if peak and largest <= power < below:
            best, largest = i, power
    return best


@kernel
def _give_lines(design: NotchDesign, state: NotchState) -> None:
    mean, n = 0.0, design.input.size
    for i in range(design.lines.size):
        mean += _power(state, i) / design.lines.size
    step = design.lines[1] - design.lines[0]
    for j in range(state.omega.size):
        state.used[j] = 1.0 if design.waves[j] != 0.0 else 0.0
    # First the oscillators that have a line keep it, then the others take those without one.
    for take in range(2):
        below = math.inf
        for _ in range(state.omega.size):
            i = _strongest(design, state, _LINE * mean, below)
            if i < 0 or mean <= 0.0:
                break
            below = _power(state, i)
            before, at, after = log2(_power(state, i - 1)), log2(below), log2(_power(state, i + 1))
            line = design.lines[i] + 0.5 * step * (before - after) / (before - 2.0 * at + after)
            near, free = -1, -1
            for j in range(state.omega.size):
                if design.waves[j] == 0.0 and abs(state.omega[j] - line) < 2.0 * step:
                    near = j
                elif state.used[j] == 0.0 and free < 0:
                    free = j
            if near >= 0:
                state.used[near] = 1.0
            elif take == 1 and free >= 0:
                state.used[free] = 1.0
                state.omega[free] = min(max(line, design.low), design.high)
                # A bandwidth of half the frequency, which falls as the pair is found.
                variance = 0.5 * design.bias_noise / (design.dt * state.omega[free])
                _open(state, n + 1 + 2 * free, variance)


@kernel
def _open(state: NotchState, at: int, variance: float) -> None:
    """Let the pair at ``at`` be zero, and unknown but for a variance."""
    for i in range(at, at + 2):
        state.x[i] = 0.0
        for k in range(state.x.size):
            state.P[i, k] = state.P[k, i] = 0.0
        state.P[i, i] = variance


@control.register(NotchDesign)
def _control(design: NotchDesign, state: NotchState, r: float, y: float) -> float:
    loop = state.loop[0]
    status = hold_last_good(loop, r, y)
    if loop.started == 0.0:
        if status & _MEASUREMENT_HELD != 0:
            loop.u = loop.u_unlimited = control_at_rest(design.limits)
            loop.status = status
            return loop.u
        known, reference, has = loop.y, loop.r, loop.has_reference
        _start(design, state, known)
        loop.y, loop.r, loop.has_reference, loop.started = known, reference, has, 1.0
    _correct(design, state, loop.y)
    unlimited = design.reference * loop.r - _load(design, state)
    for i in range(design.gain.size):
        unlimited -= design.gain[i] * state.x[i]
    if not is_usable_control(design.limits, unlimited):
        status |= _OVERFLOWED
        known, reference, has, unlimited = loop.y, loop.r, loop.has_reference, loop.u
        _start(design, state, known)
        loop.y, loop.r, loop.has_reference, loop.started = known, reference, has, 1.0
        loop.u = unlimited
    u, cut = apply_limits(design.limits, unlimited, loop.u)
    if design.window > 0:
        _listen(design, state)
    _predict(design, state, u)
    loop.u = u
    loop.u_unlimited = unlimited
    loop.status = status | cut
    return u


@write_row.register(NotchDesign)
def _write_row(design: NotchDesign, state: NotchState, row: Vector) -> None:
    row[0] = state.loop[0].u_unlimited
    row[1] = state.loop[0].status
    for j in range(state.omega.size):
        row[2 + j] = state.omega[j]


@status_flags.register(NotchDesign)
def _status_flags(design: NotchDesign, state: NotchState) -> int:
    return int(state.loop[0].status)


@reset_loop.register(NotchDesign)
def _reset_loop(design: NotchDesign, state: NotchState) -> None:
    clear(state.loop)


@set_applied_control.register(NotchDesign)
def _set_applied_control(design: NotchDesign, state: NotchState, u: float) -> None:
    # The prediction was made with the u that ``control`` returned.
    for i in range(design.input.size):
        state.x[i] += design.input[i] * (u - state.loop[0].u)
    state.loop[0].u = u


class AdaptiveNotch(StatefulController):
    """LQG with oscillators in its Kalman filter, whose frequencies are found and followed.

    It knows the plant, and what the load is made of: how many sinusoids, within which band, or
    which waves over the position. It does not know frequencies, amplitudes and phases.

    Parameters
    ----------
    plant
        anything that ``LinearPlant.of`` takes; its first state is y where ``waves`` are given.
    omega_c, omega_o
        bandwidths of the state feedback and of the filter with its bias, as for ``LQG`` [rad/s].
    dt
        sample time [s].
    bandwidth
        of the oscillators: they learn a load within some ``1/bandwidth`` [rad/s].
    count
        number of sinusoids whose frequency is searched, 0 to 4.
    band
        within which frequencies are searched and followed [rad/s].
    listening
        length of the windows whose spectrum finds them [s].
    frequencies
        frequencies to start with, at most ``count``; they are followed, too [rad/s].
    waves
        known waves over the position, as ``2π/pitch`` for cogging [rad/y-unit].
    u_min, u_max, rate_limit, name
        as for ``LinearController``.

    Raises
    ------
    ValueError
        as for ``LQG``, and for numbers out of range.

    Examples
    --------
    >>> controller = AdaptiveNotch(([1.0], [1.0, 0.0, 0.0]), 2.0, 10.0, 1e-2, band=(0.5, 5.0))
    >>> controller.step(r=0.0, y=0.0)
    0.0
    """

    features: tuple[str, ...] = ()

    def __init__(
        self,
        plant: Any,
        omega_c: float,
        omega_o: float,
        dt: float,
        *,
        bandwidth: float = 0.1,
        count: int = 1,
        band: tuple[float, float] = (0.1, 10.0),
        listening: float = 30.0,
        frequencies: Sequence[float] = (),
        waves: Sequence[float] = (),
        u_min: float = -math.inf,
        u_max: float = math.inf,
        rate_limit: RateLimit = math.inf,
        name: str = "adaptive notch",
    ) -> None:
        self.plant = LinearPlant.of(plant)
        base = LQG(self.plant, omega_c, omega_o, dt)
        self.base, self.dt, self.omega_c, self.omega_o = base, base.dt, base.omega_c, base.omega_o
        self.bandwidth = checks.positive("bandwidth", bandwidth, "rad/s")
        self.count = checks.whole("count", count, 0, 4)
        self.band = checks.interval("band[0]", band[0], "band[1]", band[1])
        if not 0.0 < self.band[0] < self.band[1] < math.pi / self.dt:
            raise ValueError(
                f"band = {band!r} rad/s: must be above 0, the first below the second, and both "
                f"below pi/dt = {math.pi / self.dt:.4g}"
            )
        self.listening = checks.positive("listening", listening, "s")
        self.frequencies = tuple(checks.positive_vector("frequencies", frequencies).tolist())
        self.waves = tuple(checks.positive_vector("waves", waves).tolist())
        if len(self.frequencies) > self.count:
            raise ValueError(
                f"frequencies = {list(frequencies)!r}: are more than count = {self.count}"
            )
        if self.count + len(self.waves) == 0:
            raise ValueError("count = 0 without waves: nothing is adapted; take LQG")
        self.name = name
        self._limits = checked_limits(u_min, u_max, rate_limit, self.dt)
        oscillators = self.count + len(self.waves)
        self.channels: Channels = (("u_wished", 1), ("status", 1), ("omega", oscillators))
        self._initialise()

    def _update_parameters(self) -> None:
        base, dt, (low, high) = self.base, self.dt, self.band
        F, G, H = base.model
        n = G.size - 1
        found = leading_gain(self.plant.A, self.plant.B, self.plant.C)
        assert found is not None  # LQG has refused it
        b, degree = found
        q = self.omega_o ** (2 * (degree + 1)) / b**2
        stride = max(int(_TURN / (high * dt)), 1)
        window = math.ceil(self.listening / (stride * dt)) if self.count else 0
        step = math.pi / (window * stride * dt) if window else 1.0
        lines = low + step * np.arange(-1.0, math.ceil((high - low) / step) + 2) if window else None
        unknown = self.count - len(self.frequencies)
        waves = np.array([0.0] * self.count + list(self.waves))
        # A wave turns at no frequency; its noise is that of the highest one.
        first = [*self.frequencies, *[0.0] * unknown, *[high] * len(self.waves)]
        self.parameters = NotchDesign(
            transition=np.ascontiguousarray(F[:n, :n]),
            input=np.ascontiguousarray(G[:n]),
            output=np.ascontiguousarray(H[:n]),
            gain=np.ascontiguousarray(base.K),
            reference=float(base.N),
            bias_noise=q * dt,
            pair_noise=2.0 * q * dt * self.bandwidth**2,
            measured_noise=1.0 / dt,
            follow=_FOLLOWS * self.bandwidth,
            low=low,
            high=high,
            first=np.array(first),
            waves=waves,
            lines=np.zeros(3) if lines is None else lines,
            window=window,
            stride=stride,
            dt=dt,
            limits=self._limits,
        )

    def initial_state(self) -> NotchState:
        """Return a state before the first sample."""
        design = self.parameters
        m, G = design.first.size, design.lines.size
        size = design.input.size + 1 + 2 * m
        return NotchState(
            x=np.zeros(size),
            P=np.zeros((size, size)),
            omega=design.first.copy(),
            sums=np.zeros((G, 2)),
            turned=np.zeros((G, 2)),
            gained=np.zeros(size),
            moved=np.zeros((size, size)),
            rotations=np.zeros((m, 2)),
            used=np.zeros(m),
            loop=NotchLoop.zeros(),
        )

    def law_at(self, state: NotchState) -> LinearLaw:
        """Return the linear law with the frequencies of a state, as ``run.final_state``."""
        design, base = self.parameters, self.base
        active = np.sort(state.omega[(state.omega > 0.0) & (design.waves == 0.0)])
        # Two at one frequency, as at an end of the band, are one.
        active = active[np.append(True, np.diff(active) > _EQUAL * active[1:])[: active.size]]
        n, size = design.input.size, design.input.size + 1 + 2 * active.size
        F, W = np.eye(size), np.zeros((size, size))
        F[: n + 1, : n + 1] = base.model.F
        W[n, n] = design.bias_noise
        for j, omega in enumerate(active.tolist()):
            at = n + 1 + 2 * j
            c, s = math.cos(omega * self.dt), math.sin(omega * self.dt)
            F[at : at + 2, at : at + 2] = [[c, s], [-s, c]]
            F[:n, at] = design.input
            W[at, at] = W[at + 1, at + 1] = design.pair_noise / omega**2
        pairs = np.zeros(2 * active.size)
        model = SampledModel(F, np.append(base.model.G, pairs), np.append(base.model.H, pairs))
        L = stationary_gain(model, W, design.measured_noise)
        cancel = np.tile([1.0, 0.0], active.size)
        return feedback_law(model, L, np.concatenate([base.K, [1.0], cancel]), base.N)

    @property
    def law(self) -> LinearLaw:
        """The linear law with the frequencies of the present state.

        It has the steady gain of the filter; waves do not turn at rest, and are part of the bias.
        """
        return self.law_at(self._state)

    @property
    def status(self) -> Status:
        """Status flags of the last step."""
        return Status(int(self._state.loop[0].status))
