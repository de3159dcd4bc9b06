"""The relative gain array: how much the axes of a plant act on each other, and what to do.

With G the gains (p, m) of a plant at a frequency, the relative gain of output i and input j is the
gain from u_j to y_i while the other inputs rest, over that while the other inputs hold all other
outputs at rest (Bristol, *IEEE Trans. Automatic Control* 11, 1966)::

    Λ = G ∘ (G⁻¹)ᵀ,        λ_ij = g_ij (G⁻¹)_ji

Rows and columns have the sum 1, and Λ does not depend on the units of inputs and outputs. On the
diagonal, λ_ii = 1 means that axis i does not notice whether the other loops are closed, 2.4 or
1/2.4 that its gain changes by this factor, a negative one that it changes its sign. G becomes
singular if one entry g_ij changes by ``−1/λ_ij`` of itself, so a matrix with large entries of Λ has
to be known that well to be inverted (Skogestad & Postlethwaite, *Multivariable Feedback Control*,
2nd ed. 2005, sections 3.4 and 10.6).

G is taken at rest and at the bandwidth of the loops. A plant that integrates has no gain at rest;
what counts then is *B0*, the gains from u to the first derivative of each y that u reaches, with
``y_i^(n_i) = f_i + (B0 u)_i``. Sampled, these are the first pulses: of row i the first sample in
which any input moves y_i, dead times of the inputs apart.

B0 are the gains far above the dynamics of the plant. With a zero in the right half plane they say
nothing of the gains at rest, and loops that ``u = B0⁻¹ v`` takes apart may be unstable with any
bandwidths: with a plant that is stable and a controller that integrates, all loops together can
only be stable if ``det(G(0) B0⁻¹) > 0`` (the last coefficient of the closed loop's polynomial;
Grosdidier, Morari & Holt, *Ind. Eng. Chem. Fundam.* 24, 1985), and each real zero in the right half
plane turns this sign. No feedback moves such a zero z, and in its direction no loop is faster than
about z/2 (Skogestad & Postlethwaite, sections 5.7 and 6.5). Zeros faster than the samples are those
of sampling, and zeros ten times above the bandwidth do not matter to it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.analysis.margins import Complex, Response
from quell.analysis.matrices import sampled_matrices
from quell.analysis.multivariable import grouped_poles
from quell.lti.canonical import format_roots
from quell.lti.models import ZERO_TOLERANCE, MatrixSystem
from quell.lti.zeros import invariant_zeros
from quell.types import Matrix, Vector

# A gain that changes by less than this factor leaves two loops as they are. Chosen by hand: it is
# within the gain margin of every sensible design.
INDEPENDENT = 1.25
# From this entry on, an error of a tenth makes the matrix singular.
_SENSITIVE = 10.0
# From this entry on, an error of a hundredth does, and nobody knows gains that well.
_SINGULAR = 100.0
# Ratio of singular values, rows and columns balanced, below which a matrix has no inverse.
_RANK_TOLERANCE = 1e-9
# Rounds of balancing rows and columns.
_BALANCING = 30
# Zeros in the right half plane that count: faster than this share of the sampling rate they are
# those of sampling, ten times above the bandwidth they do not matter, and with a damping between
# ±1e-6 they are on the axis, as in ``canonical``.
_OF_SAMPLES, ABOVE_BANDWIDTH, _LEAST_DAMPING = 1.0, 10.0, 1e-6
# An entry below this share of its row and its column, balanced, is no path between two axes.
_NO_PATH = 1e-6


def relative_gains(G: Any) -> Complex:
    """Return the relative gain array (p, m) of gains G (p, m), which may be complex.

    For another number of inputs than outputs it is that of the pseudo-inverse: rows (or columns)
    have the sum 1 only where G has full rank in them.

    Raises
    ------
    ValueError
        for a matrix whose rank is not full, or that has an entry that is not finite.

    Examples
    --------
    >>> relative_gains([[1.0, 0.5], [0.5, 1.0]]).real.round(3).tolist()
    [[1.333, -0.333], [-0.333, 1.333]]
    """
    G = np.asarray(G, dtype=complex)
    if G.ndim != 2 or not np.all(np.isfinite(G)):
        raise ValueError(f"G has shape {G.shape}: must be a matrix of finite gains (p, m)")
    found, ratio = _relative(G)
    if found is None:
        raise ValueError(
            f"G = {G.tolist()}: its rank is not full (ratio of singular values {ratio:.1e}, "
            "balanced): relative gains do not exist"
        )
    return found


class GainsAt(NamedTuple):
    """Gains of a plant in one regime, and their relative gain array."""

    where: str
    """``"at rest"``, ``"B0"`` or ``"at … rad/s"``."""
    G: Complex
    """Gains (axes, axes); of a plant that integrates, the first pulses in place of B0."""
    relative: Complex
    """Λ (axes, axes); NaN where G is singular."""
    ratio: float
    """Smallest over largest singular value of G with balanced rows and columns."""


@dataclass(frozen=True)
class Coupling:
    """How much the axes of a plant act on each other; made by ``coupling``."""

    at: tuple[GainsAt, ...]
    axes: tuple[str, ...]
    zeros: tuple[complex, ...] = ()
    """Invariant zeros in the right half plane, up to ten times the bandwidth [rad/s]."""

    @property
    def decided(self) -> bool:
        """False if the gains are singular, or so close to it that an error of 1 % decides."""
        return not any(_is_singular(gains) for gains in self.at)

    @property
    def factor(self) -> float:
        """Largest factor by which the gain of an axis changes with the other loops closed.

        Infinite if a sign changes, NaN if nothing is decided.
        """
        return (
            max(_changes(gains.relative).max() for gains in self.at) if self.decided else math.nan
        )

    @property
    def advice(self) -> str:
        """One sentence a regime, and what to do; the first word is NOT if nothing is decided.

        A last sentence names the zeros in the right half plane, if there are any.
        """
        lines = [": ".join(filter(None, self._sentence(gains))) for gains in self.at]
        return "\n".join([*lines, *([about_zeros(self.zeros)] if self.zeros else ())])

    @property
    def facts(self) -> str:
        """One sentence a regime, without what to do."""
        return "\n".join(self._sentence(gains)[0] for gains in self.at)

    @property
    def pairing(self) -> tuple[int, ...] | None:
        """The input of each axis by the gains at rest; None for a plant that has none.

        It is also None if no pairs have positive relative gains.
        """
        first = self.at[0]
        if first.where != "at rest" or _is_singular(first):
            return None
        found = _pairing(first.relative)
        sound = np.all(first.relative[np.arange(len(found)), found].real > 0.0)
        return tuple(found) if sound else None

    def __str__(self) -> str:
        lines = []
        for gains in self.at:
            shown = np.abs(gains.relative) if np.any(gains.relative.imag) else gains.relative.real
            table = "; ".join(" ".join(f"{x:.3g}" for x in row) for row in shown)
            kind = (
                "sizes of the relative gains" if np.any(gains.relative.imag) else "relative gains"
            )
            lines.append(f"{kind} {_of(gains.where)}: [{table}]")
        return "\n".join([*lines, self.advice])

    def _sentence(self, gains: GainsAt) -> tuple[str, str]:
        """Return what the gains are like, and what to do."""
        where = _of(gains.where)
        if _is_singular(gains):
            return self._undecided(gains, where), ""
        relative, axes = gains.relative, self.axes
        pairs = _pairing(relative)
        if any(i != j for i, j in enumerate(pairs)):
            text = ", ".join(f"{axes[i]} by input {j + 1}" for i, j in enumerate(pairs) if i != j)
            rest = "" if self.zeros else ", or use B0 (u = B0⁻¹ v)"
            return f"the axes are paired with the wrong inputs {where}", f"move {text}{rest}"
        changes = _changes(relative)
        first = int(np.argmax(changes))
        if changes[first] <= INDEPENDENT:
            return self._independent(gains, where, float(changes[first]))
        others = np.abs(relative[first]) + np.abs(relative[:, first])
        others[first] = -1.0
        pair = sorted((first, int(np.argmax(others))))
        if math.isinf(changes[first]):
            how = f"so strongly that the gain of {axes[first]} changes its sign with the other loop"
        else:
            how = f"by {changes[first]:.2g}"
        largest = float(np.max(np.abs(relative)))
        known = ""
        if largest >= _SENSITIVE:
            known = (
                f", known to much better than {100.0 / largest:.2g} %, an error of which makes it "
                "singular"
            )
        elif largest > 1.0:
            known = f" (an error of {100.0 / largest:.2g} % in one entry would make it singular)"
        fact = f"{axes[pair[0]]} and {axes[pair[1]]} are coupled {how} {where}"
        return fact, "choose other inputs or outputs" if self.zeros else f"use B0{known}"

    def _independent(self, gains: GainsAt, where: str, change: float) -> tuple[str, str]:
        """Return what axes are like that do not notice each other's loops, and what to do."""
        size = np.abs(_balanced(gains.G))
        path = size > _NO_PATH * np.minimum(size.max(axis=0), size.max(axis=1)[:, None])
        for i, j in np.argwhere(path & ~path.T):
            return (
                f"{self.axes[j]} moves {self.axes[i]} {where}, but not the other way",
                "the loops stay stable without B0, and with it this motion is not left to the "
                "observer",
            )
        return (
            f"the axes hardly notice each other {where} (with the other loops closed a gain "
            f"changes by a factor of {change:.3g} at most)",
            "a controller for each axis, with its own b0, is enough",
        )

    def _undecided(self, gains: GainsAt, where: str) -> str:
        if gains.ratio < _RANK_TOLERANCE:
            rank = int(np.linalg.matrix_rank(_balanced(gains.G), tol=_RANK_TOLERANCE))
            return (
                f"NOT decided {where}: the gains are singular, of the rank {rank} for "
                f"{len(self.axes)} axes (ratio of singular values {gains.ratio:.1e}): some "
                "combination of the outputs cannot be moved; choose other inputs or outputs"
            )
        largest = float(np.max(np.abs(gains.relative)))
        return (
            f"NOT decided {where}: the largest relative gain is {largest:.3g}, so an error of "
            f"{100.0 / largest:.1g} % in one gain makes the matrix singular; choose other inputs "
            "or outputs, or control the combinations that the plant moves well"
        )


def coupling(
    plant: Any,
    dt: float,
    bandwidth: float | None = None,
    axes: Any = None,
    operating_point: Any = None,
) -> Coupling:
    """Compute the relative gains of a plant with as many inputs as outputs, and advise.

    Parameters
    ----------
    plant
        a plant with several inputs and outputs, as for ``analyse``; output i and input i are
        axis i.
    dt
        sample time of the loops [s].
    bandwidth
        bandwidth of the loops [rad/s], at which the gains are looked at as well; none by default.
    axes
        names of the axes; ``"axis 1"``, … by default.
    operating_point
        (x, u) at which a nonlinear plant is linearised.

    Raises
    ------
    ValueError
        for a plant that ``analyse`` refuses, other numbers of inputs than of outputs, a
        bandwidth of more than half the sampling rate, or an output that no input moves.

    Examples
    --------
    Two arms that move each other, each an integrator of second order:

    >>> import numpy as np
    >>> B0 = np.linalg.inv([[2.0, 1.0], [1.0, 0.9]])
    >>> A, B = np.kron(np.eye(2), [[0, 1], [0, 0]]), np.kron(B0, [[0], [1]])
    >>> found = coupling((A, B, np.eye(4)[[0, 2]]), 1e-3, axes=("shoulder", "elbow"))
    >>> print(found.advice.partition(" (")[0], round(found.factor, 3))
    shoulder and elbow are coupled by 2.2 in B0: use B0 2.25
    """
    dt = checks.positive("dt", dt, "s")
    A, B, C = sampled_matrices(plant, dt, operating_point)
    m, p = B.shape[1], C.shape[0]
    if m != p:
        raise ValueError(
            f"B has shape {B.shape} and C has shape {C.shape}: an axis is an output and an input; "
            f"choose as many of the {m} inputs as of the {p} outputs, or take relative_gains(G)"
        )
    names = tuple(f"axis {i + 1}" for i in range(p)) if axes is None else tuple(map(str, axes))
    if len(names) != p or len(set(names)) != p:
        raise ValueError(f"axes = {axes!r}: must be {p} different names")
    N = A - np.eye(A.shape[0])
    integrates = any(abs(pole.z - 1.0) <= pole.error for pole in grouped_poles(N))
    if integrates:
        found = [_gains_at("B0", _first_pulses(A, B, C).astype(complex))]
    else:
        found = [_gains_at("at rest", -C @ np.linalg.solve(N, B).astype(complex))]
    if bandwidth is not None:
        bandwidth = checks.positive("bandwidth", bandwidth, "rad/s")
        if bandwidth > math.pi / dt:
            raise ValueError(
                f"bandwidth = {bandwidth!r} rad/s: must be at most half the sampling rate, "
                f"{math.pi / dt:.6g} rad/s"
            )
        response = Response(MatrixSystem(N, B, C, np.zeros((p, m))))
        found.append(_gains_at(f"at {bandwidth:.4g} rad/s", response([bandwidth], dt)[0]))
    limit = _OF_SAMPLES / dt if bandwidth is None else ABOVE_BANDWIDTH * bandwidth
    return Coupling(tuple(found), names, unstable_zeros(N, B, C, dt, limit))


def about_zeros(zeros: Sequence[complex]) -> str:
    """Return what zeros in the right half plane [rad/s] mean for the loops."""
    what = "a zero" if len(zeros) == 1 else "zeros"
    return (
        f"the plant has {what} in the right half plane, at {format_roots(np.array(zeros))} rad/s, "
        "which no B0 moves: at least one loop has to stay slower than about half of it"
    )


def is_turned(N: Matrix, B: Matrix, C: Matrix) -> bool:
    """Return whether no controllers that integrate, one for each input, are stable together.

    ``N`` is Φ − I of a sampled plant. With loops of positive gains the closed loop's polynomial
    has at z = 1 the sign of ``det(−N) det(C (−N)⁻¹ B)``, which must be that of all other z beyond
    its zeros. It is that of one matrix, whether the plant integrates or not.
    """
    whole = np.block([[-N, B], [-C, np.zeros((C.shape[0], B.shape[1]))]])
    rows, columns = balancing(whole)
    whole = whole * rows * columns
    sizes = np.linalg.svd(whole, compute_uv=False)
    return bool(sizes[-1] > _RANK_TOLERANCE * sizes[0] and np.linalg.slogdet(whole)[0] < 0.0)


def unstable_zeros(N: Matrix, B: Matrix, C: Matrix, dt: float, limit: float) -> tuple[complex, ...]:
    """Return the zeros in the right half plane of a sampled plant, up to a limit [rad/s].

    ``N`` is Φ − I, so that zeros near z = 1 are exact. Zeros at rest, and those that are faster
    than the samples, are left out.
    """
    found = invariant_zeros(N, B, C)
    if not found.full_rank:
        return ()
    zeros = np.log1p(found.values.astype(complex)) / dt
    size = np.abs(zeros)
    kept = (zeros.real > _LEAST_DAMPING * size) & (size <= min(limit, _OF_SAMPLES / dt))
    return tuple(zeros[kept][np.argsort(size[kept])].tolist())


def _gains_at(where: str, G: Complex) -> GainsAt:
    relative, ratio = _relative(G)
    return GainsAt(where, G, np.full(G.shape, np.nan + 0j) if relative is None else relative, ratio)


def _relative(G: Complex) -> tuple[Complex | None, float]:
    """Return Λ, or None if G is singular, and the ratio of its singular values, balanced."""
    scaled = _balanced(G)
    values = np.linalg.svd(scaled, compute_uv=False)
    ratio = float(values[-1] / values[0]) if values[0] > 0.0 else 0.0
    if not ratio >= _RANK_TOLERANCE:
        return None, ratio
    return scaled * np.linalg.pinv(scaled).T, ratio


def _balanced(G: Complex) -> Complex:
    """Return G with rows and columns scaled to sizes of one, which leaves Λ as it is."""
    rows, columns = balancing(G)
    return G * rows * columns


def balancing(G: Any) -> tuple[Matrix, Matrix]:
    """Return factors of the rows (p, 1) and of the columns (1, m) that scale their sizes to one."""
    factors = [np.ones((G.shape[0], 1)), np.ones((1, G.shape[1]))]
    for _ in range(_BALANCING):
        for axis in (1, 0):
            scaled = G * factors[0] * factors[1]
            size: NDArray[np.float64] = np.linalg.norm(scaled, axis=axis, keepdims=True)
            factors[1 - axis] = factors[1 - axis] / np.where(size > 0.0, size, 1.0)
    return factors[0], factors[1]


def _first_pulses(A: Matrix, B: Matrix, C: Matrix) -> Matrix:
    """Return the first pulse of each output to each input, the inputs' dead times apart.

    Entry ij is that of sample ``r_i + δ_j``, with r_i the first sample in which any input moves
    output i, and δ_j the dead time of input j beyond the others'.
    """
    p, m = C.shape[0], B.shape[1]
    pulses, first = [], np.full((p, m), -1)
    row, bound = C, np.abs(C)
    for k in range(2 * A.shape[0]):
        pulse = row @ B
        pulse[np.abs(pulse) <= ZERO_TOLERANCE * (bound @ np.abs(B))] = 0.0
        pulses.append(pulse)
        first[(first < 0) & (pulse != 0.0)] = k
        row, bound = row @ A, bound @ np.abs(A)
    for what, silent in (("output", np.all(first < 0, axis=1)), ("input", np.all(first < 0, 0))):
        if np.any(silent):
            which = int(np.flatnonzero(silent)[0]) + 1
            moves = "no input moves it" if what == "output" else "it moves no output"
            raise ValueError(f"{what} {which} of the plant: {moves}, so it has no axis")
    never = len(pulses)
    start = np.where(first < 0, never, first)
    rows = start.min(axis=1)
    late = (start - rows[:, None]).min(axis=0)
    at = np.minimum(rows[:, None] + late, never - 1)
    return np.array([[pulses[at[i, j]][i, j] for j in range(m)] for i in range(p)])


def _is_singular(gains: GainsAt) -> bool:
    return gains.ratio < _RANK_TOLERANCE or bool(np.max(np.abs(gains.relative)) >= _SINGULAR)


def _changes(relative: Complex) -> Vector:
    """Return the factors (axes,) by which gains change; infinite where the sign does."""
    own = np.diag(relative)
    with np.errstate(divide="ignore"):
        size = np.maximum(np.abs(own), 1.0 / np.abs(own))
    return np.where(own.real > 0.0, size, math.inf)


def _pairing(relative: Complex) -> list[int]:
    """Return for each output the input with which its relative gains are closest to one.

    Other pairs than those of the diagonal only if the diagonal does not work at all.
    """
    from scipy.optimize import linear_sum_assignment

    own = np.diag(relative)
    if np.all(own.real > 0.5 / relative.shape[0]):
        return list(range(own.size))
    _, columns = linear_sum_assignment(np.abs(relative - 1.0))
    if np.all(relative[np.arange(own.size), columns].real > 0.0):
        return [int(j) for j in columns]
    return list(range(own.size))


def _of(where: str) -> str:
    return f"in {where}" if where == "B0" else where
