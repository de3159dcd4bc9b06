"""Bounds on several guarded axes that act on each other, proved for any learners.

Every axis i has an uncertain part with the input q_i and the output e_i: the correction of a
guarded learner, ``|e_i| ≤ κ_i max |q_i|``, or a coupling that was not modelled. In general it is
known of them that::

    sup |e_i| ≤ Σ_j K_ij sup |q_j|,        K (axes, axes) ≥ 0; diag(κ_1, …) for guards alone

The rest is linear and known, with the peak-to-peak gains Γ_ij from e_j to q_i. Then, entry by
entry, ``sup |q| ≤ sup |q_0| + Γ K sup |q|``. If the spectral radius ρ(Γ K) is below one, the
inverse ``(I − Γ K)⁻¹`` is the sum of the powers of Γ K, which is not negative, and::

    sup |q| ≤ (I − Γ K)⁻¹ sup |q_0|,        sup |y − y_0| ≤ Γ_y K (I − Γ K)⁻¹ sup |q_0|

For one axis this is ``analysis/certificate``. ρ < 1 is the condition of Khammash & Pearson (*IEEE
Trans. Automatic Control* 36, 1991), which is also necessary if nothing else is known of the
uncertain parts. docs/certificate has the proof.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from quell import checks
from quell.analysis import certificate
from quell.analysis.matrices import estimates_at, gain_at, sampled_matrices
from quell.controllers.adrc import ADRC
from quell.controllers.axes import Axes
from quell.files import as_json
from quell.guard.guard import check_one_state_of_f, check_stable, lag_between_samples, state_path
from quell.lti.models import MatrixSystem, System, peak_gain
from quell.observers.design import response
from quell.types import Matrix, Vector


@dataclass(frozen=True)
class CoupledCertificate:
    """Bounds for axes that act on each other; made by ``certify_coupled`` and ``certify``."""

    gains: Matrix
    """Peak-to-peak gains Γ (axes, axes) from e_j to q_i."""
    output_gains: Matrix | None
    """Peak-to-peak gains Γ_y (outputs, axes) from e_j to y_i; None without ``to_output``."""
    uncertain: Matrix
    """Bounds K (axes, axes) of the uncertain parts, κ of the guards on the diagonal."""
    axes: tuple[str, ...]
    excluded: tuple[str, ...] = ()
    """The parts of the loop that the bounds do not cover."""
    condition: str = ""
    """Why the bounds do not hold for the axes as they are; empty if they do."""

    @property
    def spectral_radius(self) -> float:
        """ρ(Γ K), which must be below one."""
        return float(np.max(np.abs(np.linalg.eigvals(self.gains @ self.uncertain))))

    @property
    def certified(self) -> bool:
        """Whether ρ(Γ K) < 1."""
        return self.spectral_radius < 1.0 - _ROUNDING

    @property
    def largest_factor(self) -> float:
        """Factor below which all uncertain parts may grow together, 1/ρ(Γ K)."""
        rho = self.spectral_radius
        return math.inf if rho == 0.0 else 1.0 / rho

    @property
    def weakest(self) -> str:
        """Name of the axis whose κ, or part, lowers ρ most if it is made smaller."""
        product = self.gains @ self.uncertain
        right, left = (_perron(M) for M in (product, product.T))
        return self.axes[int(np.argmax(right * left))]

    @property
    def error_factors(self) -> Matrix:
        """Bounds (axes, axes) on ``sup |q_i|`` for ``sup |q_0j| = 1``; infinite without proof."""
        size = len(self.axes)
        if not self.certified:
            return np.full((size, size), math.inf)
        found = np.linalg.inv(np.eye(size) - self.gains @ self.uncertain)
        return np.asarray(
            np.maximum(found, 0.0), dtype=np.float64
        )  # rounding may leave −1e-17 where no path leads

    def error_bound(self, q_0: Any) -> Vector:
        """Return the bounds (axes,) on ``sup |q|`` for ``sup |q_0|`` (axes,) [y-unit/s^n]."""
        return self._bound(self.error_factors, q_0)

    def output_bound(self, q_0: Any) -> Vector:
        """Return the bounds (outputs,) on ``sup |y − y_0|`` [y-unit] for ``sup |q_0|`` (axes,).

        Raises ``ValueError`` if the certificate has no gains to y.
        """
        if self.output_gains is None:
            raise ValueError("output_bound: certify with to_output, the systems from e to y")
        if not self.certified:
            return np.full(self.output_gains.shape[0], math.inf)
        return self._bound(self.output_gains @ self.uncertain @ self.error_factors, q_0)

    def _bound(self, factors: Matrix, q_0: Any) -> Vector:
        q_0 = checks.vector("q_0", q_0, len(self.axes))
        if np.any(q_0 < 0.0):
            raise ValueError(f"q_0 = {q_0.tolist()!r}: must not be negative, it is a supremum")
        if not self.certified:
            return np.full(factors.shape[0], math.inf)
        return factors @ q_0

    def __str__(self) -> str:
        rho = f"ρ(ΓK) = {self.spectral_radius:.3g}"
        rest = f"\nnot covered: {'; '.join(self.excluded)}" if self.excluded else ""
        begin = f"{self.condition}\n" if self.condition else ""
        if not self.certified:
            return (
                f"{begin}not certified: {rho} must be below 1: multiply all κ by less than "
                f"{self.largest_factor:.3g}, or lower that of {self.weakest} most{rest}"
            )
        largest = self.error_factors.sum(axis=1)
        bounds = ", ".join(
            f"{x:.3g} for {name}" for name, x in zip(self.axes, largest, strict=True)
        )
        return (
            f"{begin}certified: {rho}; all κ may be multiplied by up to "
            f"{self.largest_factor:.3g}\n"
            f"with any learners |q| stays below these multiples of the largest |q_0|: {bounds}"
            f"{rest}"
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries for ``json.dump``; None for what is infinite."""
        known = ("certified", "axes", "spectral_radius", "largest_factor", "weakest")
        matrices = ("gains", "output_gains", "uncertain", "error_factors")
        return as_json(self, *known, *matrices, "excluded", "condition")


# A spectral radius this close to one is one: the gains are that precise.
_ROUNDING = 1e-12


def _perron(M: Matrix) -> Vector:
    """Return the sizes of the eigenvector of the largest eigenvalue of a matrix ≥ 0."""
    values, vectors = np.linalg.eig(M)
    return np.abs(vectors[:, np.argmax(np.abs(values))])


def certify_coupled(
    to_error: Any, uncertain: Any, to_output: Any = None, axes: Sequence[str] | None = None
) -> CoupledCertificate:
    """Compute what is guaranteed for axes that act on each other, from their systems.

    Parameters
    ----------
    to_error
        the known part of the loop, from the outputs e of the uncertain parts to their inputs q: a
        ``MatrixSystem``, or blocks, a row of ``System`` for each q, with None where e_j does not
        reach q_i.
    uncertain
        K (axes, axes), or its diagonal (axes,), the κ of the guards: entry ij bounds the
        peak-to-peak gain from q_j to e_i of a part that is not known.
    to_output
        the same from e to y, for bounds on y; None leaves them out.
    axes
        names; ``"axis 1"``, … by default.

    Raises
    ------
    ValueError
        for blocks or matrices that do not fit, negative or infinite bounds, or an unstable system.
    """
    gains = _peak_gains("to_error", to_error)
    size = gains.shape[0]
    if gains.shape[1] != size:
        raise ValueError(
            f"to_error has {gains.shape[0]} outputs and {gains.shape[1]} inputs: must have one q "
            "and one e for each axis"
        )
    K = checks.matrix("uncertain", np.diag(uncertain) if np.ndim(uncertain) == 1 else uncertain)
    if K.shape != (size, size):
        raise ValueError(
            f"uncertain has shape {np.shape(uncertain)}: must be ({size}, {size}), or a κ for each "
            f"of the {size} axes of to_error"
        )
    if np.any(K < 0.0):
        raise ValueError(f"uncertain = {K.tolist()!r}: must not be negative, it has bounds")
    output_gains = None if to_output is None else _peak_gains("to_output", to_output)
    if output_gains is not None and output_gains.shape[1] != size:
        raise ValueError(
            f"to_output has {output_gains.shape[1]} inputs: must have one e for each of the {size} "
            "axes of to_error"
        )
    names = tuple(f"axis {i + 1}" for i in range(size)) if axes is None else tuple(map(str, axes))
    if len(names) != size or len(set(names)) != size:
        raise ValueError(f"axes = {axes!r}: must be {size} different names")
    return CoupledCertificate(gains, output_gains, K, names)


def _peak_gains(name: str, systems: Any) -> Matrix:
    """Return the peak-to-peak gains of a system, or of blocks."""
    blocks: list[list[Any]]
    if isinstance(systems, MatrixSystem):
        p, m = systems.D.shape
        blocks = [[systems.entry(i, j) for j in range(m)] for i in range(p)]
    elif checks.is_sequence(systems) and all(checks.is_sequence(row) for row in systems):
        blocks = [list(row) for row in systems]
    else:
        raise ValueError(f"{name} = {systems!r}: must be a MatrixSystem, or rows of System or None")
    widths = {len(row) for row in blocks}
    if len(widths) != 1 or widths == {0}:
        raise ValueError(f"{name} has rows of {sorted(widths)} blocks: must all have as many")
    found = np.zeros((len(blocks), len(blocks[0])))
    for i, row in enumerate(blocks):
        for j, block in enumerate(row):
            if block is None:
                continue
            if not isinstance(block, System):
                raise ValueError(f"{name}[{i}][{j}] = {block!r}: must be a System or None")
            check_stable(block, f"{name}[{i}][{j}]")
            found[i, j] = peak_gain(block)
    return found


# ---- The loop of several axes ----


def certify_axes(plant: Any, axes: Axes, operating_point: Any = None) -> CoupledCertificate:
    """Return the certificate of several axes; see ``analysis.certify``.

    κ of each axis is that of its guard, or of ``Guard()`` if it has none; ``condition`` names the
    axes that learn without guard, for which the bounds do not hold.
    """
    adrcs = [certificate.linear_adrc(each) for each in axes.unit_axes]
    matrices = sampled_matrices(plant, axes.dt, operating_point)
    inverse = gain_at(axes, estimates_at(axes, plant, operating_point))[1]
    to_error, to_output = coupled_loop(matrices, adrcs, inverse)
    kappa = [certificate.guard_bound(adrc) for adrc in adrcs]
    found = certify_coupled(to_error, kappa, to_output, axes.names)
    condition = certificate.condition_of(dict(zip(axes.names, adrcs, strict=True)))
    excluded = certificate.not_covered(plant, axes.limits)
    if callable(axes.B0) or callable(axes.M):
        excluded.append("changes of B0 with the estimates")
    return replace(found, excluded=tuple(excluded), condition=condition)


def coupled_loop(
    plant: tuple[Matrix, Matrix, Matrix], adrcs: Sequence[ADRC], inverse: Matrix
) -> tuple[MatrixSystem, MatrixSystem]:
    """Return the loop of several plain observers, from the corrections e_L to q and to y.

    ``plant`` is sampled, and ``u = inverse v``.
    """
    A, B, C = plant
    n, axes = A.shape[0], len(adrcs)
    if C.shape[0] != axes or B.shape[1] != inverse.shape[0]:
        raise ValueError(
            f"plant has {B.shape[1]} inputs and {C.shape[0]} outputs: must have an output for each "
            f"of the {axes} axes, and an input for each of the {inverse.shape[0]} actuators of B0"
        )
    B = B @ inverse
    parts = [_axis(adrc) for adrc in adrcs]
    edges = [n, *(n + np.cumsum([part.N.shape[0] for part in parts])).tolist()]
    N, into = np.zeros((edges[-1], edges[-1])), np.zeros((edges[-1], axes))
    q = np.zeros((axes, edges[-1]))
    N[:n, :n] = A - np.eye(n)
    for i, (part, (first, last)) in enumerate(zip(parts, pairwise(edges), strict=True)):
        own = slice(first, last)
        # The inputs of a part are y_i and e_i; its outputs are v_i and q_i.
        N[own, own] = part.N
        N[own, :n] = np.outer(part.B[:, 0], C[i])
        into[own, i] = part.B[:, 1]
        N[:n, own] = np.outer(B[:, i], part.C[0])
        N[:n, :n] += np.outer(B[:, i], part.D[0, 0] * C[i])
        into[:n, i] = B[:, i] * part.D[0, 1]
        q[i, own] = part.C[1]
        q[i, :n] = part.D[1, 0] * C[i]
    nothing = np.zeros((axes, axes))
    y = np.hstack([C, np.zeros((axes, edges[-1] - n))])
    return MatrixSystem(N, into, q, nothing), MatrixSystem(N, into, y, nothing)


def _axis(adrc: ADRC) -> MatrixSystem:
    """Return an axis without its learner, from y and the correction e_L to v and q.

    e_L reaches v through the path of the states that it moves (``guard.state_path``), after that
    ``w = path(e_L)`` is taken off ``b0 v``; this is ``guard.plain_loop`` without the plant.
    """
    observer, law = adrc.observer, adrc.parameters.law
    check_one_state_of_f(observer)
    n, estimates = observer.order, observer.estimates
    whole = response(observer.model, estimates, n)
    M, g, c, d = lag_between_samples(observer, certificate.guard_samples(adrc))
    path = state_path(observer, law)
    check_stable(path, "the observer's answer to a correction")
    # The state: observer, v before, lag filter of f_plain, its output f_plain^F, path of e_L.
    sizes = (whole.transition.shape[0], 1, M.shape[0], 1, path.N.shape[0])
    edges = [0, *np.cumsum(sizes).tolist()]
    z, before, lag, shown, moved = (slice(*edge) for edge in pairwise(edges))
    size = edges[-1]
    # Rows over (state, y, e_L).
    seen = np.zeros((whole.output.shape[0], size + 2))
    seen[:, z], seen[:, before] = whole.output, whole.feedthrough[:, 1:2]
    seen[:, size] = whole.feedthrough[:, 0]
    f_plain = seen[n]
    w = np.zeros(size + 2)
    w[moved], w[size + 1] = path.C, path.D
    v = (np.append(observer.cancel - law, -observer.cancel_f) @ seen[: n + 1] - w) / observer.b0
    rows = np.zeros((size, size + 2))
    rows[:, :size] = -np.eye(size)
    rows[z, z] += whole.transition
    rows[z, before] += whole.input[:, 1:2]
    rows[z, size] += whole.input[:, 0]
    rows[before] += v
    rows[lag, lag] += M
    rows[lag] += np.outer(g, f_plain)
    rows[shown, lag] += c
    rows[shown] += d * f_plain
    rows[moved, moved] = path.N
    rows[moved, size + 1] = path.B
    q = f_plain.copy()
    q[shown] -= 1.0
    out = np.vstack([v, q])
    return MatrixSystem(rows[:, :size], rows[:, size:], out[:, :size], out[:, size:])
