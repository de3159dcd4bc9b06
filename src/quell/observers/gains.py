"""Design of observers with several outputs: poles at one place, Kalman gains at several rates.

**Poles at one place.** No more than p poles of a system with p outputs can have eigenvectors of
their own at one place, so a method that asks for eigenvectors (``scipy.signal.place_poles``)
refuses more than p equal poles. Ackermann's formula does not: it makes a chain of generalised
eigenvectors, and here there is one chain for each output (Luenberger, *IEEE Trans. Automatic
Control* 12, 1967). Rows ``c_j Δ^k`` that are independent are collected level by level, k = 0, 1, …;
ν_j of them belong to output j, its observability index. With T made of all of them, and q_j the
column of ``T⁻¹`` that belongs to the last row of output j::

    c_i Δ^k q_j = 0   for k < ν_j − 1,        G_ij = c_i Δ^(ν_j − 1) q_j
    L = [π_1(Δ) q_1, …, π_p(Δ) q_p] G⁻¹,      π_j(s) = (s + o)^ν_j

puts the eigenvalues of ``Δ − L c`` at −o: those of chain j are the roots of π_j. With one output it
is Ackermann's formula, and with axes that are not coupled each one has the gain that it would have
alone. The gain is not unique; this one has the shortest chains, and takes the output that shows a
state most where several do.

**Kalman gains.** One sample changes the covariance of the prediction by::

    P⁻ ← Φ P⁻ (I + G P⁻)⁻¹ Φᵀ + Q,        G = Cᵀ R⁻¹ C  of the outputs that are measured

Such maps are closed under composition, ``X ← H + A X (I + G X)⁻¹ Aᵀ``. So the map of a period, in
which sensors of several rates are measured, is composed once, and then doubled: 2^k periods after k
steps, from P = 0 (the structure-preserving doubling algorithm; Anderson, *Int. J. Control* 28,
1978; Chu, Fan, Lin & Wang, *Int. J. Control* 77, 2004). Periodic Riccati equations: Bittanti,
Colaneri & De Nicolao, in *The Riccati Equation*, Springer 1991.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.lti.models import ZERO_TOLERANCE, gramian, zero_order_hold
from quell.lti.zeros import observer_exists, pencil_scales
from quell.observers.multivariable_forms import GainModel, RiccatiModel
from quell.types import Matrix, Vector

# ---- Poles at one place ----

# A row counts as independent of others if more than this share of it is left without them. Larger
# shares are tried first: they give smaller gains. Chosen by hand; not tuned further.
_SHARES = (1e-2, 1e-4, 1e-6, 1e-8)
# Shares that differ less than this are equal, as those of equal axes are. Chosen by hand.
_TIE = 1e-6
# Largest error of a coefficient of the characteristic polynomial, as a share of the largest one.
# Chosen by hand, far below what a designer sees, and above rounding errors.
_PLACED = 1e-6


def place_equal_poles(difference: Matrix, rows: Matrix, offset: float) -> Matrix | None:
    """Return L (N, p) that puts all N eigenvalues of ``difference − L rows`` at ``−offset``.

    Parameters
    ----------
    difference
        Δ (N, N), in coordinates in which it is O(1) after division by the offset.
    rows
        c (p, N).
    offset
        o > 0; for a sampled system with ``Δ = Φ − I`` the poles are at ``1 − o``.

    Returns
    -------
    L, or None if the rows do not observe Δ, or if rounding errors move the characteristic
    polynomial by more than a share of 1e-6.
    """
    size = np.linalg.norm(rows, axis=1)
    if not np.all(size > 0.0):
        kept = np.flatnonzero(size > 0.0)
        found = place_equal_poles(difference, rows[kept], offset) if kept.size else None
        if found is None:
            return None
        whole = np.zeros((difference.shape[0], size.size))
        whole[:, kept] = found
        return whole
    rate, unit_rows = difference / offset, rows / size[:, None]
    gain: Matrix | None
    for share in _SHARES:
        gain = _placed(rate, unit_rows, share)
        if gain is not None and _is_placed(rate - gain @ unit_rows):
            return gain * offset / size[None, :]
    return None


def _placed(rate: Matrix, rows: Matrix, share: float) -> Matrix | None:
    """Return L for the offset 1 and rows of length 1; None if the rows are not independent."""
    total, outputs = rate.shape[0], rows.shape[0]
    chains: list[list[Vector]] = [[] for _ in range(outputs)]
    basis = np.zeros((0, total))
    level, active = rows.copy(), list(range(outputs))
    while basis.shape[0] < total and active:
        left, active = active, []
        while left and basis.shape[0] < total:
            rests = np.array([_rest(level[j], basis) for j in left])
            whole = np.maximum(np.linalg.norm(level[left], axis=1), np.finfo(np.float64).tiny)
            shares = np.linalg.norm(rests, axis=1) / whole
            # The first of those that are equal but for rounding errors.
            best = int(np.argmax(shares >= (1.0 - _TIE) * np.max(shares)))
            if not shares[best] > share:
                break
            basis = np.vstack([basis, rests[best] / np.linalg.norm(rests[best])])
            chosen = left.pop(best)
            chains[chosen].append(level[chosen].copy())
            active.append(chosen)
        level = level @ rate
    if basis.shape[0] < total:
        return None
    try:
        inverse = np.linalg.inv(np.array([row for chain in chains for row in chain]))
        used = [j for j in range(outputs) if chains[j]]
        ends = np.cumsum([len(chain) for chain in chains]) - 1
        columns, coupling = [], []
        for j in used:
            vector = moved = inverse[:, ends[j]]
            for _ in chains[j]:
                vector = rate @ vector + vector
            for _ in chains[j][1:]:
                moved = rate @ moved
            columns.append(vector)
            coupling.append(rows[used] @ moved)
        gain = np.zeros((total, outputs))
        gain[:, used] = np.linalg.solve(np.array(coupling), np.array(columns)).T
    except np.linalg.LinAlgError:
        return None
    return gain


def _rest(row: Vector, basis: Matrix) -> Vector:
    """Return what is left of a row without its parts in an orthonormal basis."""
    for _ in range(2):  # once is not enough where little is left
        row = row - (row @ basis.T) @ basis
    return row


def _is_placed(error: Matrix) -> bool:
    """Return whether the eigenvalues are those of ``(s + 1)^N``, judged by the polynomial."""
    if not np.all(np.isfinite(error)):
        return False
    size = error.shape[0]
    wanted = np.array([math.comb(size, i) for i in range(size + 1)], dtype=np.float64)
    found = np.real(np.poly(error))
    return bool(np.max(np.abs(found - wanted)) <= _PLACED * np.max(wanted))


# ---- Kalman gains, of sensors with several rates ----

# Doublings until the covariance is that of the steady state; a filter that is not there after
# 2⁵⁰ samples is never there.
_DOUBLINGS = 50
# Newton's steps after the doublings, which leave rounding errors of 1e-8 where a pole is slow.
_REFINEMENTS = 2
# Share of an initial error after which it is forgotten. A mode that is not corrected never gets
# there; its computed pole may be slightly below 1. Chosen by hand.
_FORGOTTEN = 1e-3
# Change of the covariance at which it is steady: some units of rounding.
_STEADY = 1e-14


class RiccatiMap(NamedTuple):
    """The map of covariances ``X ← H + A X (I + G X)⁻¹ Aᵀ``."""

    A: Matrix
    G: Matrix
    H: Matrix

    def then(self, following: RiccatiMap) -> RiccatiMap:
        """Return this map followed by another one."""
        inner = np.eye(self.A.shape[0]) + self.H @ following.G
        forward = np.linalg.solve(inner, self.A)  # (I + H_1 G_2)⁻¹ A_1
        return RiccatiMap(
            following.A @ forward,
            _symmetric(self.G + self.A.T @ following.G @ forward),
            _symmetric(following.H + following.A @ np.linalg.solve(inner, self.H) @ following.A.T),
        )


def predicted_covariances(
    phi: Matrix, process: Matrix, outputs: Matrix, noise: Vector, due: Matrix
) -> list[Matrix] | None:
    """Return the covariances P⁻ (N, N) of the predictions, one for each sample of a period.

    Parameters
    ----------
    phi, process
        Φ (N, N) and the covariance Q (N, N) that a sample adds.
    outputs, noise
        C (p, N) and the variances of the outputs (p,).
    due
        (K, p), 1 where an output is measured in a sample of the period, else 0.

    Returns
    -------
    The K covariances, or None if the recursion has no steady state with a stable filter.
    """
    steps = [RiccatiMap(phi, (outputs.T * (row / noise)) @ outputs, process) for row in due]
    total = steps[0]
    for step in steps[1:]:
        total = total.then(step)
    try:
        with np.errstate(all="ignore"):  # what does not converge is found below
            for _ in range(_DOUBLINGS):
                before, total = total, total.then(total)
                size = np.sqrt(np.maximum(np.diag(total.H), 0.0))
                change = np.abs(total.H - before.H)
                if not (np.all(np.isfinite(change)) and np.all(np.isfinite(total.A))):
                    return None
                is_steady = np.all(change <= _STEADY * np.outer(size, size))
                if is_steady and np.max(np.abs(total.A)) < _FORGOTTEN:
                    break
            else:
                return None
            found, error = _over_period(total.H, steps, outputs, noise, due)
            for _ in range(_REFINEMENTS):
                if not np.max(np.abs(np.linalg.eigvals(error))) < 1.0:
                    return None
                P = found[0] + _sum_of_powers(error, found[-1] - found[0])
                found, error = _over_period(P, steps, outputs, noise, due)
            return found[:-1]
    except np.linalg.LinAlgError:
        return None


def _over_period(
    P: Matrix, steps: list[RiccatiMap], outputs: Matrix, noise: Vector, due: Matrix
) -> tuple[list[Matrix], Matrix]:
    """Return P⁻ and those that follow it, and the product of ``Φ (I − L C)`` over a period."""
    found, error = [P], np.eye(P.shape[0])
    for step, row in zip(steps, due, strict=True):
        gain = kalman_gain_of(P, outputs, noise, row > 0.0)
        P = _symmetric(step.A @ corrected(P, gain, outputs, noise) @ step.A.T + step.H)
        error = step.A @ (error - gain @ (outputs @ error))
        found.append(P)
    return found, error


def _sum_of_powers(error: Matrix, rest: Matrix) -> Matrix:
    """Return ``Σ F^k X F^kᵀ``, by doubling (Smith 1968): Newton's correction of a covariance."""
    for _ in range(_DOUBLINGS):
        more = error @ rest @ error.T
        rest, error = rest + more, error @ error
        if np.max(np.abs(more)) <= _STEADY * np.max(np.abs(rest)):
            break
    return _symmetric(rest)


def kalman_gain_of(P: Matrix, outputs: Matrix, noise: Vector, measured: Any) -> Matrix:
    """Return the gain (N, p) for the outputs that are ``measured``; zero for the others."""
    gain = np.zeros((P.shape[0], outputs.shape[0]))
    on = np.flatnonzero(measured)
    if on.size:
        C = outputs[on]
        gain[:, on] = np.linalg.solve(C @ P @ C.T + np.diag(noise[on]), C @ P).T
    return gain


def corrected(P: Matrix, gain: Matrix, outputs: Matrix, noise: Vector) -> Matrix:
    """Return the covariance after a correction with any gain (Joseph's form)."""
    kept = np.eye(P.shape[0]) - gain @ outputs
    return _symmetric(kept @ P @ kept.T + (gain * noise) @ gain.T)


def _symmetric(P: Matrix) -> Matrix:
    return 0.5 * (P + P.T)


# ---- The extended model, sampled, in coordinates in which its entries are of similar size ----


class ExtendedModel(NamedTuple):
    """The sampled model of ``z = (x, d, d', …)`` (N,), scaled: ``z = units · z_scaled``."""

    transition: Matrix  # Φ (N, N)
    difference: Matrix  # Φ − I with full precision
    input: Matrix  # Γ_u (N, m)
    feed: Matrix  # Γ_d (N, q)
    output: Matrix  # C (p, N)
    continuous: Matrix  # the extended A (N, N)
    units: Vector  # (N,)


def extended_model(
    A: Matrix, B: Matrix, C: Matrix, E: Matrix, order: int, dt: float, omega: float, sizes: Vector
) -> ExtendedModel:
    """Return the sampled extended model, scaled for the speed ``omega`` [rad/s].

    ``sizes`` (p,) are the outputs' units. A state's unit is what moves an output by one of them,
    within 1/omega: no matter what units the plant is written in.
    """
    (n, q), p = E.shape, C.shape[0]
    size = n + q * order
    whole = np.zeros((size, size))
    whole[:n, :n], whole[:n, n : n + q] = A, E
    whole[n : size - q, n + q :] = np.eye(size - n - q)
    rows = np.hstack([C, np.zeros((p, size - n))])
    units = units_of(whole, rows / sizes[:, None], omega)
    continuous = whole * units[None, :] / units[:, None]
    inner = continuous[: n + q, : n + q]
    inputs = np.vstack([np.hstack([B, E]) / units[:n, None], np.zeros((q, B.shape[1] + q))])
    phi, (change, gammas) = zero_order_hold(inner, [inner, inputs], dt)
    difference = np.zeros((size, size))
    difference[: n + q, : n + q] = change
    for i in range(order):
        for j in range(i + 1, order):
            at, of = np.arange(n + i * q, n + (i + 1) * q), np.arange(n + j * q, n + (j + 1) * q)
            step = dt ** (j - i) / math.factorial(j - i)
            difference[at, of] = step * units[of] / units[at]
    transition = np.eye(size) + difference
    transition[: n + q, : n + q] = phi
    gammas = np.vstack([gammas, np.zeros((size - n - q, gammas.shape[1]))])
    m = B.shape[1]
    return ExtendedModel(
        *(transition, difference, gammas[:, :m], gammas[:, m:]),
        *(rows * units[None, :], continuous, units),
    )


def units_of(whole: Matrix, rows: Matrix, omega: float) -> Vector:
    """Return units (N,) of the states of ``x' = whole x``.

    One of them moves one of the outputs ``rows x`` by one, within 1/omega.
    """
    from scipy.linalg import expm, matrix_balance

    balanced, (scale, _) = matrix_balance(whole, permute=False, separate=True)
    rows = rows * scale
    effect = np.max(np.abs(rows), axis=0)
    step = expm(balanced / (4.0 * omega))
    for _ in range(4):
        rows = rows @ step
        effect = np.maximum(effect, np.max(np.abs(rows), axis=0))
    return np.where(effect > 0.0, scale / np.where(effect > 0.0, effect, 1.0), 1.0)


def speed_from_noise(
    A: Matrix, C: Matrix, E: Matrix, densities: Vector, drift: Vector, jitter: Vector, order: int
) -> float:
    """Return about the speed [rad/s] of a Kalman filter: that of its fastest pair of y and d.

    From d_c to y_j there are r integrators with the gain g, so ``drift g²/density`` is the speed to
    the power 2 (r + order): the Butterworth radius of ``design.py``. ``densities`` (p,) are those
    of the outputs' noise.
    """
    fastest = 0.0
    for j, density in enumerate(densities):
        for c in range(E.shape[1]):
            row, bound = C[j], np.abs(C[j])
            for r in range(1, A.shape[0] + 1):
                gain = abs(float(row @ E[:, c]))
                if gain > ZERO_TOLERANCE * float(bound @ np.abs(E[:, c])):
                    powers = 0.5 / (r + order), 0.5 / r
                    ratios = gain**2 * np.array([drift[c], jitter[c]]) / density
                    fastest = max(fastest, *(ratios**powers).tolist())
                    break
                row, bound = row @ A, bound @ np.abs(A)
    return fastest


# ---- Design: gains for each sample of a period, and for each set of measured outputs ----


class ByNoise(NamedTuple):
    """A design by noise."""

    omega: float
    table: GainModel
    riccati: RiccatiModel
    covariance: Matrix
    gains: NDArray[np.float64]


class MultivariableDesign(NamedTuple):
    """A plant, and what its observer is asked for."""

    A: Matrix
    B: Matrix
    C: Matrix
    E: Matrix
    D: Matrix
    dt: float
    order: int
    predictor: bool
    due: Matrix

    def by_poles(self, omega: float) -> tuple[GainModel, NDArray[np.float64]]:
        """Return the observer with all poles at ``exp(−omega dt)``, and its gain (1, N, p)."""
        p = self.C.shape[0]
        q = self.E.shape[1]
        # Units of the outputs that do not depend on those of the model decide the chains.
        of_outputs = pencil_scales(self.A, self.E, self.C, np.zeros((p, q)))[2]
        model = self._extended(omega, 1.0 / of_outputs)
        offset = -math.expm1(-omega * self.dt)

        def placed(outputs: Any) -> Matrix | None:
            return place_equal_poles(
                model.difference, model.output[outputs] @ model.transition, offset
            )

        whole = placed(list(range(p)))
        if whole is None:
            raise ValueError(
                f"omega_o = {omega!r} rad/s with dt = {self.dt!r} s: rounding errors move poles of "
                "so many states at one place; give noise_variance and drift in place of omega_o, "
                "or take an omega_o closer to the plant's own poles and to 0.1/dt"
            )
        rows = []
        for measured in sets_of(p):
            on = np.flatnonzero(measured)
            own = placed(on) if on.size else None
            gain = whole * measured
            if own is not None:
                gain = np.zeros_like(whole)
                gain[:, on] = own
            rows.append(gain)
        gains = np.array([gain * model.units[:, None] for gain in rows])
        return self._table(model, gains), gains[-1:]

    def by_noise(self, noise_variance: Any, drift: Any, jitter: Any) -> ByNoise:
        """Return the observers with Kalman gains."""
        (n, q), p = self.E.shape, self.C.shape[0]
        noise = _densities("noise_variance", noise_variance, p, "output", positive=True)
        drift = _densities("drift", drift, q, "disturbance", positive=True)
        jitter = np.zeros(q) if jitter is None else _densities("jitter", jitter, q, "disturbance")
        density = noise * self.dt * np.array([1.0 / np.mean(row) for row in self.due.T])
        omega = speed_from_noise(self.A, self.C, self.E, density, drift, jitter, self.order)
        omega = min(max(omega, _SLOWEST / self.dt), 1.0 / self.dt)
        model = self._extended(omega, np.sqrt(noise))
        drive, size = np.zeros(model.transition.shape), model.units.size
        jittered = self.E / model.units[:n, None]
        drive[:n, :n] = (jittered * jitter) @ jittered.T
        drive[size - q :, size - q :] = np.diag(drift / model.units[size - q :] ** 2)
        process = gramian(model.continuous, drive, self.dt)
        usual_P = predicted_covariances(model.transition, process, model.output, noise, self.due)
        if usual_P is None:
            raise ValueError(
                f"noise_variance = {noise.tolist()!r}, drift = {drift.tolist()!r}, jitter = "
                f"{jitter.tolist()!r} with dt = {self.dt!r} s: there is no steady state. "
                "An integrator or an undamped or unstable mode of A that no disturbance moves is "
                "never corrected: give E a column that reaches it; otherwise bring noise and "
                "drift closer to each other"
            )
        sets, P = sets_of(p), {}
        for on in sets[:-1]:
            P[tuple(on)] = self._without(model, process, noise, on) or usual_P
        P[tuple(sets[-1])] = usual_P
        gains = np.array(
            [
                kalman_gain_of(P[tuple(on | ~due)][k], model.output, noise, due & on)
                for k, due in enumerate(self.due > 0.0)
                for on in sets
            ]
        )
        usual = gains[2**p - 1 :: 2**p]
        last = corrected(usual_P[-1], usual[-1], model.output, noise)
        units = model.units
        error = np.eye(size)
        for gain in usual:
            error = (np.eye(size) - gain @ model.output) @ model.transition @ error
        with np.errstate(divide="ignore"):
            logs = np.log(np.linalg.eigvals(error).astype(complex)) / (len(usual) * self.dt)
            speed = float(np.exp(np.mean(np.log(np.maximum(np.abs(logs), 1e-300)))))
        riccati = RiccatiModel(
            *(model.transition, model.input, model.feed, model.output, self.D, self.due),
            *(noise, process, last, units, self.due.shape[0], self.predictor),
        )
        table = self._table(model, gains * units[:, None])
        return ByNoise(
            *(speed, table, riccati, last * np.outer(units, units)), usual * units[:, None]
        )

    def _without(
        self, model: ExtendedModel, process: Matrix, noise: Vector, on: NDArray[np.bool_]
    ) -> list[Matrix] | None:
        """Return the covariances P⁻ over a period in which only some sensors exist.

        If these do not observe all, the others count as very bad ones, so that what they alone
        show has a covariance.
        """
        phi, C = model.transition, model.output
        if np.any(on):
            found = predicted_covariances(phi, process, C[on], noise[on], self.due[:, on])
            if found is not None:
                return found
        worse = np.where(on, noise, _BAD * noise)
        return predicted_covariances(phi, process, C, worse, self.due)

    def _extended(self, omega: float, sizes: Vector) -> ExtendedModel:
        return extended_model(self.A, self.B, self.C, self.E, self.order, self.dt, omega, sizes)

    def _table(self, model: ExtendedModel, gains: NDArray[np.float64]) -> GainModel:
        """Return the update in the plant's units, with ``gains`` (K 2^p, N, p) in these."""
        units = model.units
        return GainModel(
            transition=model.transition * units[:, None] / units[None, :],
            input=model.input * units[:, None],
            feed=model.feed * units[:, None],
            output=model.output / units[None, :],
            direct=self.D,
            due=self.due,
            gains=np.ascontiguousarray(gains.reshape(gains.shape[0], -1)),
            period=self.due.shape[0],
            predictor=self.predictor,
        )


# Below this ratio of singular values a direction counts as undecided. Chosen by hand.
_RANK = 1e-9


def settle(stages: list[tuple[Matrix, Vector]], units: Vector) -> Vector:
    """Return x (N,) with the least ``|rows x − wanted|``, one pair of these after the other.

    Each stage decides what those before it leave open. ``units`` are those of x.
    """
    found, free = np.zeros(units.size), np.eye(units.size)
    for rows, wanted in stages:
        scaled = rows * units
        size = float(np.max(np.abs(scaled), initial=np.finfo(np.float64).tiny))
        left = scaled @ free / size
        found += free @ (np.linalg.pinv(left, rcond=_RANK) @ ((wanted - scaled @ found) / size))
        _, values, right = np.linalg.svd(left)
        free = free @ right[int(np.count_nonzero(values > _RANK)) :].T
    return found * units


# Most sets of measured outputs and samples of a period that have gains of their own; 2 outputs at
# rates of 1 and 1000 are 4000. Chosen by hand.
_MOST_GAINS = 4096
# Variance of a sensor that is missing, in units of its own, where one is needed. Chosen by hand.
_BAD = 1e6
# Slowest unit of time of a design by noise [1/dt]; chosen by hand.
_SLOWEST = 1e-6


def sets_of(outputs: int) -> NDArray[np.bool_]:
    """Return all sets (2^p, p) of measured outputs; bit j of a set's number is output j."""
    return (np.arange(2**outputs)[:, None] >> np.arange(outputs)) & 1 == 1


def _densities(name: str, value: Any, count: int, of: str, positive: bool = False) -> Vector:
    """Return a number for each output or disturbance."""
    if value is None:
        raise ValueError(f"{name} = None: must be given for gains by noise, one for each {of}")
    found = checks.vector(name, value, count)
    if not np.all(found > 0.0 if positive else found >= 0.0):
        rule = "greater than zero" if positive else "not negative"
        raise ValueError(f"{name} = {value!r}: each entry must be {rule}")
    return found


def rates_of(every: Any, outputs: int) -> tuple[tuple[int, ...], Matrix]:
    """Return ``every``, and which outputs are due (K, p) in each sample of the period."""
    if every is None:
        every = (1,) * outputs
    if not checks.is_sequence(every) or len(every) != outputs:
        raise ValueError(
            f"every = {every!r}: must have a whole number of samples for each of the {outputs} "
            "outputs, as (1, 4)"
        )
    rates = tuple(checks.whole(f"every[{j}]", one, 1) for j, one in enumerate(every))
    period = math.lcm(*rates)
    if min(rates) > 1:
        raise ValueError(
            f"every = {rates}: one output must be measured in every sample; take a longer dt"
        )
    if period * 2**outputs > _MOST_GAINS:
        raise ValueError(
            f"every = {rates}: the rates meet every {period} samples, which makes "
            f"{period * 2**outputs} gains; must be at most {_MOST_GAINS}: take rates with a "
            "smaller common multiple, or time_varying = True with NaN in between"
        )
    due = np.array([[float(k % rate == 0) for rate in rates] for k in range(period)])
    return rates, due


def check_existence(A: Matrix, E: Matrix, C: Matrix, accept_zeros: bool) -> None:
    """Raise a ``ValueError`` that says why an observer of x and d does not exist."""
    found = observer_exists(A, E, C)
    if found.exists or (accept_zeros and found.finds_polynomials):
        return
    more = ""
    if found.finds_polynomials:
        more = (
            "; if d is slow against every zero, accept_zeros = True makes an observer that finds "
            "constant d, and exaggerates or hides d at the frequencies of the zeros"
        )
    raise ValueError(f"no observer of x and d exists: {found}{more}")
