"""``identify_b0_matrix``: B0 of coupled axes, from a record with several u and y.

For each axis ``y_i^(n_i) = f_i + Σ_j B0_ij u_j`` the prediction-error fits of ``identify_b0`` are
made with all u, and with the y of the other axes as known inputs (``running_loop`` has the
equations). So friction, stiffness and gravity that couple the axes are no load, and need no model.

What the u have in common is in the covariance C of the entries of a row for a given lag and delay,
τ, (these make the errors of all entries alike, which is no matter of the u)::

    C = C_bb − C_bτ C_ττ⁻¹ C_τb

The information is C⁻¹; its rows and columns are divided by the roots of its diagonal, so that the
units of the u do not count, and the root of the ratio of its eigenvalues is the condition number of
the excitation (Belsley, Kuh & Welsch, *Regression Diagnostics*, 1980, sec. 3.2): 1 for u that have
nothing in common, above 30 for u that hardly can be told apart. The eigenvector of the least
eigenvalue, the combination that is known least, names the actuators that moved together.

A u that moves no axis by four of its deviations says nothing of its actuator: it rested, or what is
recorded as u is not what reached the machine. In the second case the actuator is a load that no
model of the noise describes, and that is correlated with the y and u of the other axes: the entries
of the others are wrong by far more than their deviations. To leave the column out does not help, as
what is missing is then missing as well. So no entry is taken as known.

Where the error is not white, or depends on past u, the model of the noise is not true, and in a
loop the gains are biased. The deviations are then multiplied by the root of ζ over its limit, or by
the largest correlation over its limit (``result.Residuals``), whichever is larger. That is by trial
(``benchmarks/input_gain_matrix.py``): records whose only noise are the steps of an encoder, in
which B0 is right to 1e-3, need it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quell import checks
from quell.identification.input_gain import (
    UNSEEN,
    check_motion,
    longest_delay,
    samples_before,
    time_line,
)
from quell.identification.loop_search import (
    fits,
    gains,
    is_usable,
    mixture,
    physical,
    total_delay,
    visible_up_to,
    weighted,
)
from quell.identification.running_loop import Inputs, LoopFit
from quell.identification.validation import residuals
from quell.lti.models import Stack
from quell.parallel import one_blas_thread
from quell.types import Matrix, Vector

# Half width of a 95 % interval in deviations, and its share of an entry, or of the largest entries
# beside it, from which on it is not known: as in ``identify_b0``.
_WITHIN_95, _POOR = 1.96, 0.3
# Condition number of the excitation from which on the actuators that moved together are named
# (Belsley et al. 1980), and the share of the weakest direction that counts as taking part.
_COLLINEAR, _TAKES_PART = 30.0, 0.3
# Least ratio of eigenvalues that is more than rounding.
_LEAST_SHARE = 1e-24
# Factor of the deviations from which on they are said to be open: chosen by hand.
_MUCH = 1.5
# Rounds that scale the rows and columns of B0 to a largest entry of 1.
_ROUNDS = 20
# Least samples for each parameter, as in ``identify``.
_SAMPLES_PER_PARAMETER = 10
_LAGS = 50


@dataclass(frozen=True, eq=False)
class InputGainMatrix:
    """The gains of coupled axes ``y_i^(n_i) = f_i + (B0 u)_i`` with their deviations.

    ``str()`` gives the report; ``ql.Axes(axes, B0=result.B0)`` uses it.
    """

    B0: Matrix  #: (n, m) [y-unit/u-unit/s^n]
    std: Matrix  #: standard deviations of its entries (n, m)
    covariance: Stack  #: of the entries of each row (n, m, m)
    orders: tuple[int, ...]  #: n_i
    axes: tuple[str, ...]  #: names of the y (n,)
    actuators: tuple[str, ...]  #: names of the u (m,)
    condition: Vector  #: condition number of the excitation, as each axis shows it (n,)
    total_delay: Vector  #: lag and delay together, of each axis (n,) [s]
    total_delay_std: Vector  #: their standard deviations (n,) [s]
    lag: Vector  #: time constant of the actuators' lag in the best model of each axis (n,) [s]
    lag_std: Vector  #: their standard deviations (n,) [s]
    delay: Vector  #: delay in the best model of each axis (n,) [s]
    delay_std: Vector  #: their standard deviations (n,) [s]
    noise: Vector  #: RMS error of the prediction one sample ahead, of each axis (n,) [y-unit]
    omega_max: Vector  #: frequency up to which the record shows each axis (n,) [rad/s]
    enlarged: Vector  #: factor of the deviations of each axis for an error that is not white (n,)
    white: tuple[bool, ...]  #: whether the error of each axis is white, at 99 %
    independent: tuple[bool, ...]  #: whether it is independent of the u before, at 99 %
    converged: tuple[bool, ...]  #: whether the search of each axis ended at a minimum
    together: tuple[tuple[str, ...], ...]
    """For each axis the actuators that moved together; none up to a condition number of 30."""
    dt: float  #: sample time of the record [s]
    samples: int  #: number of samples of the record

    @property
    def intervals(self) -> Stack:
        """Intervals in which the entries lie with a probability of 95 % each (n, m, 2)."""
        half = _WITHIN_95 * self.std
        return np.stack([self.B0 - half, self.B0 + half], axis=2)

    @property
    def poor(self) -> Any:
        """Whether each entry is not known (n, m), booleans.

        It is known if its interval is within ±30 % of it, or, for a small one, within ±30 % of the
        largest entries of its row and column, where these are scaled to have 1 for the largest.
        Where there are actuators that are ``unseen``, none is known: they may have moved the axes.
        """
        if self.unseen:
            return np.ones(self.B0.shape, dtype=bool)
        half = _WITHIN_95 * self.std
        small = np.abs(_balanced(np.abs(self.B0), half)) > _POOR
        with np.errstate(invalid="ignore"):
            return ~(half < _POOR * np.abs(self.B0)) & ~(np.isfinite(half) & ~small)

    @property
    def unseen(self) -> tuple[str, ...]:
        """Actuators whose u moves no axis, by four deviations: they rested, or are not recorded.

        Actuators that moved together are not among them.
        """
        with np.errstate(invalid="ignore"):
            seen = np.any(np.abs(self.B0) > UNSEEN * self.std, axis=0)
        together = {name for names in self.together for name in names}
        pairs = zip(self.actuators, seen, strict=True)
        return tuple(name for name, moves in pairs if not moves and name not in together)

    @property
    def is_poor(self) -> bool:
        """Whether the excitation is too poor for some entry of B0."""
        return bool(np.any(self.poor))

    @property
    def shortcomings(self) -> tuple[str, ...]:
        """Reasons not to rely on the result; empty for a good one."""
        found, poor, unseen = [], self.poor, self.unseen
        if unseen:
            names, are = " and ".join(unseen), "is" if len(unseen) == 1 else "are"
            found.append(
                f"{names} {are} not seen to move an axis in this record: {are} {names} recorded, "
                "in the right column, as applied? What moves the machine and is not in the record "
                "makes the entries of the other actuators wrong, so no entry of B0 is known; "
                "actuators that rested have to be moved"
            )
        for i, axis in enumerate(self.axes) if not unseen else ():
            mixed = np.array([name in self.together[i] for name in self.actuators]) & poor[i]
            if np.any(mixed):
                found.append(
                    f"axis {axis}: {' and '.join(self.together[i])} moved together (condition "
                    f"number {self.condition[i]:.3g}), so their entries of B0 cannot be told "
                    "apart; excite each actuator at frequencies of its own (quell excite "
                    f"--actuators {len(self.actuators)}), added behind any mixer"
                )
            alone = np.flatnonzero(poor[i] & ~mixed)
            if alone.size:
                low, high = np.moveaxis(self.intervals[i], 1, 0)
                which = "; ".join(
                    f"of {self.actuators[j]} from {low[j]:.4g} to {high[j]:.4g}" for j in alone
                )
                found.append(
                    f"axis {axis}: the record is too poor for the entry {which}; move the actuator "
                    "faster and farther, or for a longer time, and check the order"
                )
        if not found and self.may_be_singular:
            found.append(
                "B0 may be singular within its deviations: there may be a motion that no u "
                "commands; record longer, and check that the actuators act on different axes"
            )
        for i, axis in enumerate(self.axes):
            if not self.converged[i]:
                found.append(
                    f"axis {axis}: the search did not converge; record longer, or check the order"
                )
            if not self.independent[i]:
                found.append(
                    f"axis {axis}: the error depends on past u, so the axis is not of this form "
                    "(order, zeros, friction, limits that the recorded u does not have, a posture "
                    f"that changed): the deviations are enlarged by {self.enlarged[i]:.2g}, and "
                    "may be too small"
                )
            elif self.enlarged[i] >= _MUCH:
                found.append(
                    f"axis {axis}: the error is not white: the deviations are enlarged by "
                    f"{self.enlarged[i]:.2g}, and may be too small"
                )
        return tuple(found)

    @property
    def may_be_singular(self) -> bool:
        """Whether B0 may have a rank below the number of axes, within its deviations."""
        if self.B0.shape[0] > self.B0.shape[1] or not np.all(np.isfinite(self.std)):
            return True
        scaled = _balanced(np.abs(self.B0), self.B0)
        spread = _balanced(np.abs(self.B0), self.std)
        least = float(np.linalg.svd(scaled, compute_uv=False)[-1])
        return least <= _WITHIN_95 * float(np.linalg.norm(spread))

    def describe(self) -> str:
        """Return the report as text."""
        lines, width = [], max(map(len, self.axes))
        for i, axis in enumerate(self.axes):
            entries = zip(self.actuators, self.B0[i], self.std[i], strict=True)
            row = ", ".join(f"{name} {value:.5g} ± {std:.2g}" for name, value, std in entries)
            lines.append(f"B0 of {axis:<{width}}: {row}")
        return "\n".join([*lines, self.describe_rest()])

    def describe_rest(self) -> str:
        """Return the report without B0: lags, delays, the excitation, and lines with NOT."""
        lines = []
        for i, axis in enumerate(self.axes):
            total, std = 1e3 * self.total_delay[i], 1e3 * self.total_delay_std[i]
            lag = time_line("lag", self.lag[i], self.lag_std[i])
            delay = time_line("delay", self.delay[i], self.delay_std[i])
            of_error = ""
            if self.enlarged[i] > 1.0:
                of_error = (
                    f"; deviations enlarged by {self.enlarged[i]:.3g}, as the error is not white"
                )
            lines.append(
                f"{axis}, order {self.orders[i]}: {lag}; {delay}; together {total:.4g} ± {std:.2g} "
                f"ms; shown up to {self.omega_max[i]:.4g} rad/s; condition number of the "
                f"excitation {self.condition[i]:.3g}{of_error}"
            )
        return "\n".join([*lines, *(f"NOT: {text}" for text in self.shortcomings)])

    __str__ = describe

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON; None for numbers that are not finite."""
        from quell.files import nonfinite_to_none

        value = {}
        for name in self.__dataclass_fields__:
            each = getattr(self, name)
            value[name] = each.tolist() if isinstance(each, np.ndarray) else each
        value |= {"intervals_95": self.intervals.tolist(), "shortcomings": self.shortcomings}
        return dict(nonfinite_to_none(value))


def identify_b0_matrix(
    u: Any,
    y: Any,
    dt: float,
    order: int | Sequence[int],
    *,
    max_delay: float | None = None,
    axes: Sequence[str] | None = None,
    actuators: Sequence[str] | None = None,
) -> InputGainMatrix:
    """Find B0 of coupled axes in a record with several u and y.

    Axis i is ``y_i^(n) + … + a_0 y_i = Σ_j B0_ij u_l,j + Σ c_kp y_k^(p) + load``, with u_l the u
    behind one lag and one delay, and the y of the other axes and their derivatives below n as known
    inputs. Each row of B0 is found as ``identify_b0`` finds b0: in an open loop or in that of any
    controller, which need not be known, as the mean over twelve forms of lag, delay and load. The
    actuators need u that differ: each excited at frequencies of its own
    (``interleaved_excitations``), or with sequences of its own, slower than some ten samples, as
    the y of the other axes are taken as smooth between samples. The machine must be linear in the
    record: small motions around a posture, and speeds that do not pass through Coulomb friction.

    Parameters
    ----------
    u
        inputs as they were applied, behind limits and any mixer (N, m) [u-unit]; held between
        samples.
    y
        measured outputs (N, n) [y-unit], each at the time when its u began to act.
    dt
        sample time [s].
    order
        of the axes for ADRC, 1 to 4: u acts on this derivative of y. One for all or one for each.
    max_delay
        longest delay or lag to start the search at [s], as for ``identify_b0``.
    axes, actuators
        names; by default ``axis1`` … and ``u1`` ….

    Raises
    ------
    ValueError
        for an argument out of range, arrays that do not fit, a record that is too short, a y or a
        u that does not move, or an axis for which no model was found.

    Examples
    --------
    >>> import numpy as np
    >>> import quell as ql
    >>> designs = ql.identification.interleaved_excitations(2, (1.0, 40.0), 20.0, 0.01)
    >>> u = np.column_stack([design.u for design in designs])
    >>> y = np.zeros(u.shape)
    >>> for k in range(u.shape[0] - 1):
    ...     y[k + 1] = y[k] + 0.01 * np.array([[2.0, 0.5], [-0.3, 1.0]]) @ u[k]
    >>> ql.identification.identify_b0_matrix(u, y, 0.01, order=1).B0.round(4).tolist()
    [[2.0, 0.5], [-0.3, 1.0]]
    """
    u, y = _signals("u", u), _signals("y", y)
    if y.shape[0] != u.shape[0]:
        raise ValueError(
            f"u has {u.shape[0]} samples, y {y.shape[0]}: must have as many, a row for each sample"
        )
    (samples, m), n = u.shape, y.shape[1]
    dt = checks.positive("dt", dt, "s")
    given: list[Any] = list(order) if checks.is_sequence(order) else [order] * n  # type: ignore[arg-type]
    if len(given) != n:
        raise ValueError(f"order has {len(given)} numbers: must have one, or {n}, one for each y")
    orders = tuple(checks.whole("order", each, 1, 4) for each in given)
    axes, actuators = _names("axes", axes, "axis", n), _names("actuators", actuators, "u", m)
    least = _SAMPLES_PER_PARAMETER * (max(orders) * (n + 2) + m + 5)
    if samples < least:
        raise ValueError(
            f"u has {samples} samples: must have at least {least} for {n} axes and {m} actuators; "
            "record longer"
        )
    for names, table in ((actuators, u), (axes, y)):
        for name, column in zip(names, table.T, strict=True):
            check_motion(name, column)
    most = longest_delay(max_delay, samples, dt)
    before = samples_before(most, samples)
    scale_u, scale_y = np.std(u, axis=0), np.std(y, axis=0)
    # y of the other axes acts between samples: its mean there, from the samples before (the method
    # of Adams and Bashforth of order 3).
    before = max(before, 2)
    now, last, one_before = y[before:], y[before - 1 : -1], y[before - 2 : -2]
    middle = (23.0 * now - 16.0 * last + 5.0 * one_before) / 12.0
    rows = []
    for i in range(n):
        others = np.delete(middle / scale_y, i, axis=1)
        moved = y[before:, i] / scale_y[i]
        with one_blas_thread():
            found = fits(orders[i], most, Inputs(u / scale_u, others), moved)
        usable = [one for one in found if is_usable(one)]
        if not usable:
            raise ValueError(
                f"order = {orders[i]}: no model of {axes[i]} was found; check the order, and that "
                "u belongs to y"
            )
        rows.append(_row(usable, u, dt, scale_u, float(scale_y[i]), actuators))
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    told = ("white", "independent", "converged", "together")
    found_in_all: dict[str, Any] = {
        name: tuple(each) if name in told else np.array(each) for name, each in columns.items()
    }
    return InputGainMatrix(
        **found_in_all, orders=orders, axes=axes, actuators=actuators, dt=dt, samples=samples
    )


def _row(
    found: list[LoopFit], u: Matrix, dt: float, scale_u: Vector, scale_y: float, names: Any
) -> dict[str, Any]:
    """Return a row of B0, the mean of the models, and what the best of them has besides."""
    best, near, weights = weighted(found)
    n, size = best.form.order, best.error.size
    unit = scale_y / scale_u / dt**n
    values = [gains(one) for one in near]
    mean = sum(w * b for w, (b, _) in zip(weights, values, strict=True))
    covariance = sum(
        w * (C + np.outer(b - mean, b - mean)) for w, (b, C) in zip(weights, values, strict=True)
    )
    total, total_std = mixture([total_delay(one) for one in near], weights)
    _, of_rest = physical(best, float(unit[0]), dt)
    spreads = np.sqrt(np.maximum(np.diag(of_rest), 0.0)).tolist()
    lags = min(_LAGS, size // 4)
    # In a loop u depends on the error of its own sample: only u before it counts.
    late = u[u.shape[0] - size : -1]
    tests = [residuals(best.error[1:], column, lags) for column in late.T]
    condition, together = _excitation(_of_u(best), names)
    # Where the model of the noise is not true, its parameters are not either: quantization of slow
    # motions is not white, for instance.
    misfit = max(each.whiteness / each.whiteness_limit for each in tests)
    dependence = max(
        float(np.max(np.abs(each.cross_correlation[each.lags :]))) / each.cross_limit
        for each in tests
    )
    enlarged = math.sqrt(max(1.0, misfit, dependence**2))
    covariance = enlarged**2 * covariance
    return {
        "enlarged": enlarged,
        "B0": unit * mean,
        "std": unit * np.sqrt(np.maximum(np.diag(covariance), 0.0)),
        "covariance": covariance * np.outer(unit, unit),
        "condition": condition,
        "together": together,
        "total_delay": total * dt,
        "total_delay_std": total_std * dt,
        "lag": best.form.lag_of(best.phi) * dt,
        "lag_std": spreads[n + 1],
        "delay": best.form.delay_of(best.phi) * dt,
        "delay_std": spreads[n + 2],
        "noise": scale_y * float(np.sqrt(np.mean(best.error**2))),
        "omega_max": visible_up_to(best, u / scale_u, dt),
        "white": tests[0].white,
        "independent": all(each.independent for each in tests),
        "converged": best.converged,
    }


def _of_u(one: LoopFit) -> Matrix:
    """Return the covariance (m, m) of the gains of u for a given lag and delay."""
    of_times, of_b = one.form.times, one.form.gains_of_u
    sizes = np.sqrt(np.maximum(np.diag(one.covariance), 0.0))
    scaled = one.covariance / np.outer(*2 * [np.where(sizes > 0.0, sizes, 1.0)])
    mixed = scaled[of_b, of_times]
    left = scaled[of_b, of_b] - mixed @ np.linalg.pinv(
        scaled[of_times, of_times], hermitian=True
    ) @ (mixed.T)
    return np.asarray(left * np.outer(sizes[of_b], sizes[of_b]), dtype=np.float64)


def _excitation(covariance: Matrix, names: Sequence[str]) -> tuple[float, tuple[str, ...]]:
    """Return the condition number of the excitation, and the actuators that moved together."""
    sizes = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if len(names) == 1 or not np.all(np.isfinite(covariance)) or not np.all(sizes > 0.0):
        return 1.0, ()
    # The diagonal of the inverse is the information of each u beside the others.
    inverse = np.linalg.pinv(covariance / np.outer(sizes, sizes), hermitian=True)
    own = np.sqrt(np.maximum(np.diag(inverse), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(inverse / np.outer(own, own))
    condition = math.sqrt(values[-1] / max(float(values[0]), values[-1] * _LEAST_SHARE))
    if condition <= _COLLINEAR:
        return condition, ()
    # With ones on the diagonal, an entry of the weakest direction is not above the sum of the
    # others: at least two take part.
    weakest = np.abs(vectors[:, 0])
    taking = weakest > min(_TAKES_PART, 0.9 / (len(names) - 1)) * float(np.max(weakest))
    return condition, tuple(name for name, part in zip(names, taking, strict=True) if part)


def _balanced(size: Matrix, values: Matrix) -> Matrix:
    """Return ``values`` with the scales that give each row and column of ``size`` the largest 1."""
    rows, columns = np.ones((size.shape[0], 1)), np.ones((1, size.shape[1]))
    tiny = np.finfo(float).tiny
    for _ in range(_ROUNDS):
        rows = 1.0 / np.maximum(np.max(size * columns, axis=1, keepdims=True), tiny)
        columns = 1.0 / np.maximum(np.max(size * rows, axis=0, keepdims=True), tiny)
    return values * rows * columns


def _signals(name: str, given: Any) -> Matrix:
    """Return a record (N, number), checked."""
    table = np.asarray(given, dtype=np.float64) if np.ndim(given) == 2 else None
    if table is None or table.shape[1] < 1 or table.shape[0] <= table.shape[1]:
        shape = np.shape(given)
        raise ValueError(
            f"{name} has the shape {shape}: must have a row for each sample and a column for each "
            "signal; a single u and y are for identify_b0"
        )
    if not np.all(np.isfinite(table)):
        at = np.argwhere(~np.isfinite(table))[0]
        raise ValueError(f"{name}[{at[0]}, {at[1]}] = {float(table[tuple(at)])}: must be finite")
    return table


def _names(argument: str, given: Sequence[str] | None, stem: str, count: int) -> tuple[str, ...]:
    if given is None:
        return tuple(f"{stem}{i + 1}" for i in range(count))
    names = tuple(map(str, given))
    if len(names) != count or len(set(names)) != count:
        raise ValueError(f"{argument} = {list(names)!r}: must be {count} different names")
    return names
