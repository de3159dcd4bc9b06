"""Stability of an exported linear loop, and the effect of rounding, from the numbers of its C code.

The law is that of ``exact.py``, the enclosure of the spectral radius that of ``enclosure.py``.

**Rounding.** Each operation of a step changes its result by at most ε of its size, ε = 2⁻⁵³ or
2⁻²⁴. The same kernel runs with magnitudes in place of numbers, which gives a bound e_i of what
rounding in one sample adds to each ξ_i, and to u (J. H. Wilkinson, *Rounding Errors in Algebraic
Processes*, 1963: running error analysis). With the l1 norm g_i of the closed loop from there to u,
the sum of the magnitudes of its pulse response, at no time do all of them change u by more than::

    Σ_i g_i e_i        for  |r| ≤ the given size, from rest, without limits                     (4)

What a compensated sum loses is in its carry, so it acts for one sample. r and y are rounded, too.
The magnitudes of the states are bounded by l1 norms from r. Norms are computed in double
precision, so (4) is a bound up to its own digits, not a proof. A compiler that fuses a product and
a sum rounds less often.

What is not in it: limits of u, learners, derivatives of r that are fed forward, quantised
measurements, and a plant that is not linear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from quell import checks
from quell.export import exact
from quell.export.enclosure import DIGITS, Plant, PlantSet, held, loop_rows, plant_of, radius_of
from quell.types import Matrix, Vector

# Samples after which a pulse response has to be small for an l1 norm.
_LONGEST = 20_000_000

# ---- Rounding ----


class _Closed:
    """The closed loop with one plant in double precision, for l1 norms."""

    def __init__(
        self, law: exact.ExactLaw, plant: Plant, dt: float, radius: float, flint: Any
    ) -> None:
        with flint.ctx.workprec(DIGITS):
            self.M = _middle(loop_rows(law, plant, dt, flint))
            _, now, before = held(plant, dt, flint)
            self._now = _middle(now)
        self.law, depth = law, plant.samples + (before is not None)
        self._direct = plant.samples == 0
        self.n, self.m = self._now.shape
        self._past = self.n + self.m * min(depth, 1)
        self.at = self.n + self.m * depth  # where ξ begins
        self.H, self.C, D = (_floats(part) for part in (plant.H, law.C, law.D))
        outputs = self.H.shape[0]
        self.D_r = D[:, : D.shape[1] - outputs]
        self.D_y = D[:, D.shape[1] - outputs :]
        zeros = np.zeros((self.m, self.at - self.n))
        self.u_row = np.hstack([self.D_y @ self.H, zeros, self.C])
        # A pulse response has decayed to 1e-12 of what it was after so many samples.
        self.samples = math.ceil(-30.0 / math.log(radius)) + self.M.shape[0] if radius > 0 else 1

    def injected(self, xi: Matrix, u: Matrix) -> Matrix:
        """Return the states after a sample in which ``xi`` was added to ξ and ``u`` to u."""
        found = np.zeros((self.M.shape[0], u.shape[1]))
        if self._direct:
            found[: self.n] = self._now @ u
        found[self.n : self._past] = u[: self._past - self.n]
        found[self.at :] = xi
        return found

    def norms(self, rows: Matrix, states: Matrix) -> Matrix:
        """Return Σ_k |rows M^k states|, the l1 norms (rows, columns of states)."""
        block = min(self.samples, 256)
        powers, row = [], rows
        for _ in range(block):
            powers.append(row)
            row = row @ self.M
        stack, leap = np.vstack(powers), np.linalg.matrix_power(self.M, block)
        total = np.zeros((rows.shape[0], states.shape[1]))
        for _ in range(math.ceil(self.samples / block)):
            total += np.abs(stack @ states).reshape(block, *total.shape).sum(axis=0)
            states = leap @ states
        return total


def _middle(rows: list[list[Any]]) -> Matrix:
    return np.array([[float(each.mid()) for each in row] for row in rows], dtype=float)


def _floats(part: Any) -> Matrix:
    array = np.array(part, dtype=object)
    return np.array([float(each) for each in array.ravel()]).reshape(array.shape)


def _rounding(
    sample: exact.Sample, law: exact.ExactLaw, closed: _Closed, size: float, unit: float
) -> Vector:
    """Return the bound (4) of the change of each u (m,)."""
    k, m, r = len(law.A), closed.m, sample.references
    # Magnitudes of x, ξ and y for references of the given size, with what r does at once.
    from_r = closed.injected(_floats(law.B[:, :r]), closed.D_r)
    states = np.sum(closed.norms(np.eye(closed.M.shape[0]), from_r), axis=1) * size
    y = np.abs(closed.H) @ states[: closed.n]
    xi = states[closed.at :]
    places = {name: i for i, (_, _, name) in enumerate(sample.places)}
    entries = [places[name] for name in law.names]
    given = [exact.Bounded(size, 0.0, unit)] * r
    given += [exact.Bounded(float(each), 0.0, unit) for each in y]
    moved, u = sample.moved(
        {at: exact.Bounded(float(each), 0.0, unit) for at, each in zip(entries, xi, strict=True)},
        dict(enumerate(given)),
    )
    place = {i: j for j, i in enumerate(sample.free)}
    errors = np.array([getattr(moved[place[at]], "error", 0.0) for at in entries])
    of_u = np.array([getattr(each, "error", 0.0) for each in u])
    total = np.zeros(m)
    for i, (extra, used) in _carries(sample, law, entries).items():
        row = np.abs(_floats(law.A[i]) - np.eye(k)[i])
        step = float(row @ xi + np.abs(_floats(law.B[i])) @ [*[size] * r, *y])
        kept = unit * (xi[i] + step)
        errors[i] = max(errors[i] - kept, 0.0) + unit * step
        at_once = np.eye(closed.M.shape[0])[:, closed.at + i : closed.at + i + 1]
        first = closed.u_row @ at_once - used
        after = closed.M @ at_once - closed.injected(extra, used)
        total += (np.abs(first) + closed.norms(closed.u_row, after))[:, 0] * kept
    into = closed.injected(np.hstack([np.eye(k), np.zeros((k, m))]),
                           np.hstack([np.zeros((m, k)), np.eye(m)]))  # fmt: skip
    total += closed.norms(closed.u_row, into) @ [*errors, *of_u] + of_u
    # r and y become numbers of the precision, too.
    D = np.hstack([closed.D_r, closed.D_y])
    gains = closed.norms(closed.u_row, closed.injected(_floats(law.B), D)) + np.abs(D)
    return total + gains @ (unit * np.array([*[size] * r, *y]))


def _carries(
    sample: exact.Sample, law: exact.ExactLaw, entries: list[int]
) -> dict[int, tuple[Matrix, Matrix]]:
    """Return entries whose sums are compensated, with what a carry of 1 does to ξ and to u.

    What such a sum loses is in its carry, exactly where the increment is smaller than the sum
    (T. J. Dekker, *Numerische Mathematik* 18, 1971). With rational numbers a carry is always zero.
    """
    one, found = Fraction(1, 2**60), {}
    still, rest = sample.moved({}, {})
    place = {i: j for j, i in enumerate(sample.free)}
    for at in sample.free:
        if at in entries:
            continue
        moved, u = sample.moved({at: exact.Exact(one)}, {})
        change = [(moved[place[each]] - still[place[each]]) / one for each in entries]
        if any(change) and moved[place[at]] == still[place[at]]:
            of_u = [(exact.as_rational(each) - exact.as_rational(own)) / one
                    for each, own in zip(u, rest, strict=True)]  # fmt: skip
            i = max(range(len(entries)), key=lambda j: change[j] == 1)
            found[i] = _floats(change)[:, None], _floats(of_u)[:, None]
    return found


# ---- The result ----


@dataclass(frozen=True)
class Stability:
    """What is certain of the stability of an exported loop; make it with ``stability``.

    Attributes
    ----------
    plant
        its name.
    precision
        of the exported code.
    radius
        ends of the enclosure of the closed loop's spectral radius, with the plant as it is.
    spread
        share by which coefficients of the plant may differ; 0 for the plant alone.
    stable
        whether the loop is stable, with all plants of the set; None if it is undecided.
    largest, where
        the largest spectral radius at the corners of the set and in its middle, and the plant.
    parts
        into which the set and the unit circle were divided.
    size
        of the references [y-unit] for which ``rounding`` is.
    rounding
        bound of what rounding changes in each u (m,) [u-unit]; empty for a loop that is not stable,
        and for one that decays too slowly.
    without_learner
        whether the controller has a learner, which was left out.
    """

    plant: str
    precision: str
    radius: tuple[float, float]
    spread: float
    stable: bool | None
    largest: float
    where: str
    parts: int
    size: float
    rounding: tuple[float, ...]
    without_learner: bool

    @property
    def lines(self) -> list[str]:
        """The result in sentences; what is not certain begins with NOT."""
        low, high = self.radius
        loop = f"the loop with {self.plant}{' and without the learner' * self.without_learner}"
        which = f"in {self.precision} precision and without limits of u"
        ends = f"the spectral radius is between {low:.9f} and {high:.9f}"
        if low >= 1.0:
            found = [f"NOT stable: {loop} {which}: {ends}"]
        elif high >= 1.0:
            found = [f"NOT decided whether {loop} is stable {which}: {ends}"]
        else:
            found = [f"Stable: {loop} {which}: {ends}"]
        if self.spread and high < 1.0:
            around = f"{100.0 * self.spread:g} % around each coefficient of the plant"
            if self.stable:
                found.append(f"Stable with all plants within {around} ({self.parts} parts)")
            elif self.stable is None:
                found.append(
                    f"NOT decided for all plants within {around}: {self.parts} parts do not "
                    f"suffice; the largest radius found is {self.largest:.6f}; take less"
                )
            else:
                found.append(
                    f"NOT stable within {around}: with {self.where} the spectral radius is at "
                    f"least {self.largest:.6f}"
                )
        if self.rounding:
            changes = ", ".join(f"{each:.2g}" for each in self.rounding)
            found.append(
                f"Rounding changes u by at most {changes} at any time, from rest with references "
                f"up to {self.size:g}"
            )
        elif high < 1.0:
            found.append("NOT bounded: the effect of rounding, as the loop decays too slowly")
        return found


def stability(
    controller: Any,
    plant: Any,
    *,
    precision: str = "double",
    spread: float = 0.0,
    size: float = 1.0,
) -> Stability:
    """Return what is certain of a loop with the exported code of a controller.

    The extra ``proof`` installs python-flint, whose ball arithmetic it needs.

    Parameters
    ----------
    controller
        linear but for limits, prefilters and learners, which are left out.
    plant
        linear, of any kind that ``LinearPlant.of`` takes, perhaps behind ``quell.plants.delayed``.
    precision
        of the exported code, ``"double"`` or ``"single"``.
    spread
        share, below 1, within which each coefficient of the plant's transfer function may differ,
        and its gain; of plants with one input and one output.
    size
        of the references [y-unit].

    Raises
    ------
    ValueError
        for a controller without a linear law, a plant that does not fit, and a spread of a plant
        with several signals.
    ImportError
        without python-flint.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=1, b0=2.0, omega_o=20.0, dt=0.01)
    >>> controller = ql.ADRC(observer, omega_c=4.0)
    >>> found = stability(controller, ([2.0], [1.0, 1.0]), spread=0.2)
    >>> found.stable, f"{found.radius[0]:.6f}"
    (True, '0.965139')
    """
    flint = checks.import_extra("flint", "proof", "an enclosure of the spectral radius")
    share = checks.non_negative("spread", spread)
    if share >= 1.0:
        raise ValueError(f"spread = {spread!r}: must be below 1, a share of each coefficient")
    size = checks.positive("size", size, "y-unit")
    sample = exact.sample_of(controller, precision)
    law, found = exact.law_of(sample), plant_of(plant, controller)
    dt = float(controller.dt)
    radius = radius_of(law, found, dt, flint)
    stable: bool | None = radius[1] < 1.0 or (False if radius[0] >= 1.0 else None)
    largest, where, parts = radius[0], "the plant as it is", 1
    if share > 0.0 and stable:
        if law.D.shape != (1, sample.references + 1):
            raise ValueError(f"spread = {spread!r}: is for plants with one input and one output")
        plants = PlantSet(law, found, dt, share, flint)
        stable, largest, worst = plants.decided()
        where, parts = plants.described(worst), plants.parts
    rounding: tuple[float, ...] = ()
    if radius[1] < 1.0:
        closed = _Closed(law, found, dt, radius[1], flint)
        if closed.samples <= _LONGEST:
            bound = _rounding(sample, law, closed, size, exact.PRECISIONS[precision])
            rounding = tuple(bound.tolist())
    name = getattr(plant, "name", "") or "the plant"
    return Stability(
        *(name, precision, radius, share, stable, largest, where, parts, size, rounding),
        exact.learns(controller),
    )


__all__ = ["Stability", "stability"]
