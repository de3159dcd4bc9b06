"""State feedback of plants with several inputs, and the rejection of disturbances by u.

With the estimates of ``ESO.state_space`` the law is::

    u = U r + Γ d̂ − K (x̂ − X r − Π d̂)

K places the poles. Π and Γ say where the state and u have to be, so that the controlled outputs
``z = C x`` stay at zero under d: they solve the *regulator equations* (Francis, *SIAM J. Control
and Optimization* 15, 1977; Francis & Wonham, *Automatica* 12, 1976). For a constant d::

    A Π + B Γ + E = 0,      C Π = 0

and for ``w = (d, d', …)``, of which d is a polynomial, with ``w' = S w``::

    A Π + B Γ + (E, 0, …) = Π S,      C Π = 0

If d enters where u does (it is *matched*), Π = 0 and ``B Γ = −E``: u cancels d at its place. If
not, the state has to move, as a spring is wound up before it carries a load. With d alone z is zero
for a constant d, and each further derivative adds what its change needs. X and U are the same for
the reference: ``A X + B U = 0``, ``C X = I``.

``state_feedback`` puts all poles of ``Φ − Γ_u K`` at ``exp(−omega_c dt)``, ``quadratic_feedback``
minimises a quadratic cost: the gains of observers of the transposed system
(``observers/gains.py``). A flexible mode far above omega_c is better left where it is, which the
second one does; to move it costs large gains.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.lti.models import zero_order_hold
from quell.lti.zeros import fitting_matrices
from quell.observers import gains
from quell.types import Matrix

# An equation that is left with more than this share of its terms has no solution. Chosen by hand.
_SOLVED = 1e-8


class Regulator(NamedTuple):
    """Where state and control signal have to be for given disturbances and references."""

    Pi: Matrix  #: Π (n, q · disturbance_order), states for (d, d', …)
    Gamma: Matrix  #: Γ (m, q · disturbance_order), control signals for (d, d', …)
    X: Matrix  #: states for r (n, outputs)
    U: Matrix  #: control signals for r (m, outputs)


def regulator(A: Any, B: Any, C: Any, E: Any, disturbance_order: int = 1) -> Regulator:
    """Return the solution of the regulator equations of ``x' = A x + B u + E d``, ``z = C x``.

    Parameters
    ----------
    A, B, C, E
        matrices (n, n), (n, m), (outputs, n) and (n, q), or vectors where there is one column or
        row. C has the outputs that are controlled; they need not be those that are measured.
    disturbance_order
        number of d, d', … that are compensated, as in ``ESO.state_space``.

    Returns
    -------
    Regulator
        with more inputs than outputs the one with the least squares of Γ and U, in units of u.

    Raises
    ------
    ValueError
        for matrices that do not fit, and naming the disturbance that no u keeps from z, or the
        output that no u moves to a constant r.

    Examples
    --------
    A torque of 1 N m on the load of two inertias of 2 kg m² with a spring of 10 N m/rad: u
    carries it through the spring, and the motor stands 0.1 rad behind.

    >>> A = [[0, 1, 0, 0], [-5, 0, 5, 0], [0, 0, 0, 1], [5, 0, -5, 0]]
    >>> found = regulator(A, [0, 0.5, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0.5])
    >>> found.Gamma.round(9).tolist(), found.Pi[0].round(9).tolist()
    ([[-1.0]], [-0.1])
    """
    A, B, C, _ = fitting_matrices(A, B, C)
    _, E, _, _ = fitting_matrices(A, E, C, None, "E", "disturbances")
    order = checks.whole("disturbance_order", disturbance_order, 1, 3)
    (n, m), (outputs, _) = B.shape, C.shape
    columns, rows = _equilibrated(np.block([[A, B], [C, np.zeros((outputs, m))]]))

    def solved(of_state: Matrix, of_output: Matrix, names: list[str]) -> Matrix:
        found = []
        for wanted, name in zip(np.vstack([of_state, of_output]).T, names, strict=True):
            whole = np.block([[A, B], [C, np.zeros((outputs, m))]])
            solution = gains.settle(
                [
                    (whole * rows[:, None], wanted * rows),
                    (np.eye(n + m)[n:], np.zeros(m)),
                    (np.eye(n + m)[:n] / columns[:n, None], np.zeros(n)),
                ],
                columns,
            )
            left = np.abs(whole @ solution - wanted)
            size = np.abs(whole) @ np.abs(solution) + np.abs(wanted)
            if np.max(left * rows) > _SOLVED * np.max(size * rows):
                short = f": there are {m} inputs for {outputs} outputs" if m < outputs else ""
                raise ValueError(
                    f"{name}{short}; from u to z there must be no invariant zero at s = 0, and "
                    "at least as many inputs as outputs: control other outputs, or add an actuator"
                )
            found.append(solution)
        return np.array(found).T

    zero = np.zeros((outputs, E.shape[1]))
    before, parts = np.zeros((n, E.shape[1])), []
    for i in range(order):
        names = [
            f"no u keeps d{c + 1}{chr(39) * i} from the outputs z = C x" for c in range(E.shape[1])
        ]
        parts.append(solved(before - (E if i == 0 else 0.0), zero, names))
        before = parts[-1][:n]
    whole = np.hstack(parts)
    names = [f"no u moves z{j + 1} to a constant r" for j in range(outputs)]
    given = solved(np.zeros((n, outputs)), np.eye(outputs), names)
    return Regulator(whole[:n], whole[n:], given[:n], given[n:])


def state_feedback(A: Any, B: Any, omega_c: float, dt: float) -> Matrix:
    """Return K (m, n) of ``u = −K x``, with all poles of the sampled loop at ``exp(−omega_c dt)``.

    Parameters
    ----------
    A, B
        matrices (n, n) and (n, m), or a vector (n,) for one input.
    omega_c
        bandwidth of the loop [rad/s].
    dt
        sample time [s]; u is held over a sample.

    Raises
    ------
    ValueError
        if u does not move all states, or the poles can not be placed in double precision.

    Examples
    --------
    >>> state_feedback([[0.0, 1.0], [0.0, 0.0]], [0.0, 2.0], 10.0, 1e-6).round(2).tolist()
    [[50.0, 10.0]]
    """
    A, B, _, _ = fitting_matrices(A, B, np.eye(np.shape(A)[0]))
    omega, dt = checks.positive("omega_c", omega_c, "rad/s"), checks.positive("dt", dt, "s")
    units = gains.units_of(A.T, B.T, omega)
    scaled = A / units[None, :] * units[:, None]
    _, (difference, inputs) = zero_order_hold(scaled, [scaled, B * units[:, None]], dt)
    gain = gains.place_equal_poles(difference.T, inputs.T, -math.expm1(-omega * dt))
    if gain is None:
        raise ValueError(
            f"omega_c = {omega_c!r} rad/s with dt = {dt!r} s: the poles can not be placed; u must "
            "move all states (leave out those that it does not), and dt must not be a period of "
            "an undamped mode"
        )
    found: Matrix = gain.T * units[None, :]
    return found


def quadratic_feedback(A: Any, B: Any, state_weight: Any, control_weight: Any, dt: float) -> Matrix:
    """Return K (m, n) of ``u = −K x`` with the least ``Σ xᵀ Q x + uᵀ R u`` over the samples.

    Parameters
    ----------
    A, B
        matrices (n, n) and (n, m), or a vector (n,) for one input.
    state_weight
        Q (n, n), symmetric, without negative eigenvalues. ``C.T @ C`` weighs the outputs ``C x``.
    control_weight
        the diagonal of R (m,), above zero. An inertia J with the weight 1 on its angle and
        ``1/(J² omega_c⁴)`` on the torque has poles of the radius omega_c, with a damping of 0.7.
    dt
        sample time [s]; u is held over a sample.

    Raises
    ------
    ValueError
        for weights that do not fit; if u does not stabilise all states, or the cost does not see
        an unstable one.

    Examples
    --------
    >>> A, B, Q = [[0.0, 1.0], [0.0, 0.0]], [0.0, 2.0], [[1.0, 0.0], [0.0, 0.0]]
    >>> quadratic_feedback(A, B, Q, 4.0 / 10.0**4, 1e-5).round(2).tolist()
    [[50.0, 7.07]]
    """
    A, B, _, _ = fitting_matrices(A, B, np.eye(np.shape(A)[0]))
    n, m = B.shape
    dt = checks.positive("dt", dt, "s")
    Q = checks.weight("state_weight", state_weight, n)
    R = checks.vector("control_weight", control_weight, m)
    if not np.all(R > 0.0):
        raise ValueError(f"control_weight = {control_weight!r}: each entry must be above zero")
    phi, (gamma,) = zero_order_hold(A, [B], dt)
    units = gains.units_of(A.T, B.T / np.sqrt(R)[:, None], 0.1 / dt)
    transition, inputs = phi.T * units[None, :] / units[:, None], gamma.T * units[None, :]
    cost = Q / (units[:, None] * units[None, :])
    found = gains.predicted_covariances(transition, cost, inputs, R, np.ones((1, m)))
    if found is None:
        raise ValueError(
            f"control_weight = {R.tolist()!r} with dt = {dt!r} s: no gain is stable and has the "
            "least cost; u must move all states that do not decay, and state_weight must see them"
        )
    # The filter's gain L corrects after the prediction; the law acts before it: K = (Φᵀ L)ᵀ.
    gain = transition @ gains.kalman_gain_of(found[0], inputs, R, np.ones(m, dtype=bool))
    law: Matrix = (gain * units[:, None]).T
    return law


def _equilibrated(matrix: Matrix) -> tuple[Matrix, Matrix]:
    """Return factors of columns and rows that bring their largest entries close to one."""
    columns, rows = np.ones(matrix.shape[1]), np.ones(matrix.shape[0])
    for _ in range(20):
        scaled = np.abs(matrix) * rows[:, None] * columns[None, :]
        sizes = np.max(scaled, axis=1), np.max(scaled, axis=0)
        rows /= np.sqrt(np.where(sizes[0] > 0.0, sizes[0], 1.0))
        columns /= np.sqrt(np.where(sizes[1] > 0.0, sizes[1], 1.0))
    return np.exp2(np.round(np.log2(columns))), np.exp2(np.round(np.log2(rows)))
