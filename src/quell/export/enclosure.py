"""The closed loop of an exact law and a plant: an enclosure of its spectral radius.

**The plant** x' = F x + G u(t − τ), y = H x is sampled by the exponential of a matrix, in ball
arithmetic (F. Johansson, *Arb: efficient arbitrary-precision midpoint-radius interval arithmetic*,
IEEE Trans. Computers 66, 2017; python-flint): each number is a midpoint and a radius that holds the
rounding error. The u of a sample acts until the next one; a delay of q samples and a part σ of one
has the last q + 1 values of u as states.

**The enclosure.** For any K the spectral radius ρ of the closed loop's matrix M of N states obeys
(I. Gelfand, *Normierte Ringe*, 1941; the trace is the sum of the eigenvalues)::

    (|tr M^K| / N)^(1/K)  ≤  ρ  ≤  ‖M^K‖^(1/K)                                                  (2)

With K = 2⁴⁴, by squaring, and three times that, both ends agree to 1e-11 whatever the condition of
the eigenvalues is, also where they are multiple; the balls get more digits until they are narrow.
If the upper end is below one, the loop is stable. No step is rounded the wrong way: it is a proof.

**A set of plants.** With a ``spread`` s each coefficient of the transfer function, the numerator as
a whole, lies anywhere within a share s of its value. With the polynomials of the
sampled plant, κ b/a, and of the controller, n/d, in γ = (z − 1)/dt, no plant of the set has an
eigenvalue on the unit circle if::

    a(γ) d(γ) ≠ κ b(γ) n(γ),      or  a d/(b n) is outside of [1 − s, 1 + s]                     (3)

for all z = e^(iθ) and all a of the set. Then all have as many inside as the plant in the middle:
zero exclusion (J. Ackermann, *Robust Control*, 1993). (3) is tested with balls for arcs of the
circle and parts of the set, which are divided where it does not hold yet. An unstable corner ends
it, and ``MOST_PARTS`` that do not suffice decide nothing.
"""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.several import inputs_of, outputs_of
from quell.export.exact import ExactLaw
from quell.plants.linear import DelayedPlant, EncodedPlant, LinearPlant

MOST_PARTS = 20_000
"""Parts of a set of plants after which it is undecided."""

# Binary digits of ball arithmetic: at first, and at most.
DIGITS, _MOST_DIGITS = 128, 8192
# K of (2) is two to the power of it.
_SQUARINGS = 44
# Width of the enclosure for one plant.
_NARROW = 1e-9

# ---- The plant and the loop ----


class Plant(NamedTuple):
    """A linear plant behind a delay, as rational numbers."""

    F: list[list[Fraction]]
    G: list[list[Fraction]]
    H: list[list[Fraction]]
    samples: int  # whole samples of the delay
    late: Fraction  # the rest of it [s]


def plant_of(plant: Any, controller: Any) -> Plant:
    """Return a plant as rational numbers; a ``ValueError`` where it does not fit a controller."""
    samples, late, given = 0, 0.0, plant
    while isinstance(given, EncodedPlant | DelayedPlant):
        if isinstance(given, DelayedPlant):
            samples, late = given.samples, given.late
            if abs(given.dt - controller.dt) > 1e-9 * given.dt:
                raise ValueError(
                    f"plant = {plant!r}: its delay is for dt = {given.dt!r} s, the controller has "
                    f"{controller.dt!r} s; make it for this dt"
                )
        given = given.plant
    try:
        linear: Any = LinearPlant.of(given)
    except ValueError:
        raise ValueError(
            f"plant = {plant!r:.60}: must be linear, perhaps behind quell.plants.delayed; "
            "linearise it (quell.plants.linearised)"
        ) from None
    wanted = inputs_of(controller), outputs_of(controller)
    if (linear.inputs, linear.outputs) != wanted:
        raise ValueError(
            f"plant = {linear.name}: has {linear.inputs} inputs and {linear.outputs} outputs, the "
            f"controller {wanted[0]} and {wanted[1]}: must be the same"
        )
    F, G, H = ([[Fraction(float(each)) for each in row] for row in part]
               for part in (linear.A, linear.B, linear.C))  # fmt: skip
    return Plant(F, G, H, samples, Fraction(late))


def _coefficients(plant: Plant, flint: Any) -> tuple[list[Fraction], list[Fraction]]:
    """Return a_0 … a_{n−1} and c_0 … c_{n−1} of ``(Σ c_k s^k)/(s^n + Σ a_k s^k)``, exactly."""
    n = len(plant.F)
    whole = [_fraction(each) for each in _fmpq_matrix(plant.F, flint).charpoly().coeffs()]
    F, G, H = (np.array(part, dtype=object) for part in (plant.F, plant.G, plant.H))
    markov, column = [], G[:, 0]
    for _ in range(n):
        markov.append((H @ column)[0])
        column = F @ column
    c = [sum((whole[n - j] * markov[k - j] for j in range(k + 1)), Fraction(0)) for k in range(n)]
    return whole[:n], c[::-1]


def _fraction(number: Any) -> Fraction:
    return Fraction(int(number.p), int(number.q))


def _fmpq(number: Fraction, flint: Any) -> Any:
    return flint.fmpq(number.numerator, number.denominator)


def _fmpq_matrix(rows: list[list[Fraction]], flint: Any) -> Any:
    entries = [_fmpq(each, flint) for row in rows for each in row]
    return flint.fmpq_mat(len(rows), len(rows[0]), entries)


def _balls(rows: Any, flint: Any) -> Any:
    """Return a matrix of balls: of numbers, or of pairs (middle, radius)."""
    return flint.arb_mat(_rows(rows, flint))


def _ball(number: Any, flint: Any) -> Any:
    if isinstance(number, tuple):
        middle, radius = (flint.arb(_fmpq(each, flint)) for each in number)
        return middle + radius * flint.arb(0, 1)
    return flint.arb(_fmpq(number, flint))


def held(plant: Plant, dt: float, flint: Any) -> tuple[Any, Any, Any]:
    """Return Φ, and Γ for the u of this sample and for the one before, or None, which ends late.

    Entries of F and G may be pairs (middle, radius).
    """
    n, m = len(plant.F), len(plant.G[0])

    def after(time: Fraction) -> tuple[Any, Any]:
        """Return e^(F t) and ∫ e^(F s) ds G."""
        rows = [[*row, *own] for row, own in zip(plant.F, plant.G, strict=True)]
        rows += [[Fraction(0)] * (n + m) for _ in range(m)]
        both = (_balls(rows, flint) * flint.arb(_fmpq(time, flint))).exp()
        return (
            [[both[i, j] for j in range(n)] for i in range(n)],
            [[both[i, n + j] for j in range(m)] for i in range(n)],
        )

    phi, now = after(Fraction(dt) - plant.late)
    if plant.late == 0:
        return phi, now, None
    own, first = after(plant.late)
    return _product(phi, own, flint), now, _product(phi, first, flint)


def loop_rows(law: ExactLaw, plant: Plant, dt: float, flint: Any) -> list[list[Any]]:
    """Return the rows of the closed loop's matrix, for the states x, past values of u, and ξ.

    Entries of F, G and H may be pairs (middle, radius).
    """
    n, m, p = len(plant.F), len(plant.G[0]), len(plant.H)
    zero, r = flint.arb(0), law.D.shape[1] - p

    phi, now, before = held(plant, dt, flint)
    depth = plant.samples + (before is not None)
    D_y, B_y = law.D[:, r:], law.B[:, r:]
    C, A, H = (_rows(part, flint) for part in (law.C, law.A, plant.H))
    D_H, B_H = _product(_rows(D_y, flint), H, flint), _product(_rows(B_y, flint), H, flint)
    k = len(A)
    # u now, as a row of the states, then the past ones, the latest first
    past = [[[zero] * (n + m * depth + k) for _ in range(m)] for _ in range(depth + 1)]
    for i in range(m):
        past[0][i][:n] = D_H[i]
        if k:
            past[0][i][n + m * depth :] = C[i]
        for q in range(depth):
            past[q + 1][i][n + m * q + i] = flint.arb(1)
    acting = [(now, past[plant.samples])]
    if before is not None:
        acting.append((before, past[plant.samples + 1]))
    rows = [[*row, *([zero] * (m * depth + k))] for row in phi]
    for gains, source in acting:
        for i, add in enumerate(_product(gains, source, flint)):
            rows[i] = [one + other for one, other in zip(rows[i], add, strict=True)]
    for q in range(depth):
        rows += past[q]
    for i in range(k):
        rows.append([*B_H[i], *([zero] * (m * depth)), *A[i]])
    return rows


def _rows(rows: Any, flint: Any) -> list[list[Any]]:
    return [[_ball(each, flint) for each in row] for row in rows]


def _product(one: list[list[Any]], other: list[list[Any]], flint: Any) -> list[list[Any]]:
    if not one or not other:
        return [[flint.arb(0)] * (len(other[0]) if other else 0) for _ in one]
    both = flint.arb_mat(one) * flint.arb_mat(other)
    return [[both[i, j] for j in range(both.ncols())] for i in range(both.nrows())]


# ---- The enclosure ----


def _radius(rows: list[list[Any]], flint: Any) -> tuple[float, float]:
    """Return the enclosure (2) of the spectral radius of a matrix of balls."""
    size = len(rows)
    power = flint.arb_mat(rows)
    for _ in range(_SQUARINGS):
        power = power * power
    low, high = 0.0, math.inf
    for factor, matrix in ((1, power), (3, power * power * power)):
        exponent = factor * 2**_SQUARINGS
        entries = [matrix[i, j] for i in range(size) for j in range(size)]
        norm = sum((each * each for each in entries), flint.arb(0)).sqrt().abs_upper()
        trace = (sum((matrix[i, i] for i in range(size)), flint.arb(0)) / size).abs_lower()
        if norm == 0:
            return 0.0, 0.0
        if norm.is_finite():
            high = min(high, float((norm.log() / exponent).exp().upper()))
        if trace > 0:
            low = max(low, float((trace.log() / exponent).exp().lower()))
    # To float is to nearest: one step more is outwards.
    return max(math.nextafter(low, -1.0), 0.0), math.nextafter(high, math.inf)


def radius_of(law: ExactLaw, plant: Plant, dt: float, flint: Any) -> tuple[float, float]:
    """Return the enclosure for one plant, with as many digits as it needs."""
    digits, found = DIGITS, (0.0, math.inf)
    while digits <= _MOST_DIGITS:
        with flint.ctx.workprec(digits):
            found = _radius(loop_rows(law, plant, dt, flint), flint)
        if found[1] - found[0] <= _NARROW and not found[0] < 1.0 <= found[1]:
            break
        digits *= 2
    return found


def _polynomials(rows: list[list[Any]], columns: list[Any], row: list[Any], zero: Any) -> Any:
    """Return ``det(γI − A)`` and, for each column, ``C adj(γI − A) B``: Faddeev and LeVerrier.

    Coefficients stand in ascending powers of γ.
    """
    n = len(rows)
    A = np.array(rows, dtype=object).reshape(n, n)
    whole, adjugates = [zero + 1], []
    N = np.array([[zero + int(i == j) for j in range(n)] for i in range(n)], dtype=object)
    for k in range(1, n + 1):
        through = [N @ column for column in columns]
        adjugates.append([sum((c * each for c, each in zip(row, own, strict=True)), zero)
                          for own in through])  # fmt: skip
        N = A @ N
        whole.append(-sum((N[i, i] for i in range(n)), zero) / k)
        for i in range(n):
            N[i, i] = N[i, i] + whole[-1]
    return whole[::-1], [[each[c] for each in reversed(adjugates)] for c in range(len(columns))]


def _at(coefficients: list[Any], gamma: Any, zero: Any) -> Any:
    total = zero
    for each in reversed(coefficients):
        total = total * gamma + each
    return total


Coefficients = tuple[tuple[Fraction, Fraction], ...]


class PlantSet:
    """The transfer functions whose coefficients lie within a share of their values."""

    def __init__(self, law: ExactLaw, plant: Plant, dt: float, spread: float, flint: Any) -> None:
        self.law, self.plant, self.dt, self.flint = law, plant, dt, flint
        self.a, self.c = _coefficients(plant, flint)
        share = Fraction(spread)
        self.places = [k for k, each in enumerate(self.a) if each]
        one = Fraction(1) - share, Fraction(1) + share
        self.whole: Coefficients = (one,) * (len(self.places) + 1)
        self.parts = 0
        self._known: dict[Coefficients, Any] = {}

    def plant_at(self, factors: Coefficients) -> Plant:
        """Return the plant, in the observable form, for ranges of the coefficients' factors."""
        n = len(self.a)
        gain, *others = [((high + low) / 2, (high - low) / 2) for low, high in factors]
        a: list[Any] = [Fraction(0)] * n
        for k, (middle, radius) in zip(self.places, others, strict=True):
            a[k] = -self.a[k] * middle, abs(self.a[k]) * radius
        F: list[list[Any]] = [[Fraction(int(j == i + 1)) for j in range(n)] for i in range(n)]
        for i in range(n):
            F[i][0] = a[n - 1 - i] if a[n - 1 - i] else F[i][0]
        G: list[list[Any]] = [[(each * gain[0], abs(each) * gain[1])] for each in reversed(self.c)]
        H = [[Fraction(int(j == 0)) for j in range(n)]]
        return self.plant._replace(F=F, G=G, H=H)

    def decided(self) -> tuple[bool | None, float, Coefficients]:
        """Return the verdict, the largest radius at the corners and in the middle, and where."""
        middle: Coefficients = tuple(((a + b) / 2, (a + b) / 2) for a, b in self.whole)
        largest, worst = 0.0, middle
        for corner in (middle, *product(*(((a, a), (b, b)) for a, b in self.whole))):
            rows = self.plant_at(corner)
            low, high = radius_of(self.law, rows, self.dt, self.flint)
            if low > largest:
                largest, worst = low, corner
            if low >= 1.0:
                return False, low, corner
            if corner is middle and high >= 1.0:
                return None, low, corner
        return self._excludes_zero(), largest, worst

    def _excludes_zero(self) -> bool | None:
        """Return whether (3) holds; None where the parts do not suffice."""
        flint = self.flint
        with flint.ctx.workprec(DIGITS):
            count = len(self.law.A)
            step = Fraction(self.dt)
            A = [[(self.law.A[i, j] - int(i == j)) / step for j in range(count)]
                 for i in range(count)]  # fmt: skip
            B = np.array([each / step for each in self.law.B[:, -1]], dtype=object)
            d, (own,) = _polynomials(A, [B], list(self.law.C[0]), Fraction(0))
            through = [*own, *([Fraction(0)] * (len(d) - len(own)))]
            n = [each + self.law.D[0, -1] * other for each, other in zip(through, d, strict=True)]
            d, n = ([flint.acb(_fmpq(each, flint)) for each in part] for part in (d, n))
            parts = [(0.0, math.pi, self.whole[1:])]
            while parts:
                begin, end, factors = parts.pop()
                self.parts += 1
                if self._is_apart(begin, end, factors, d, n):
                    continue
                if self.parts >= MOST_PARTS:
                    return None
                middle = 0.5 * (begin + end)
                if not factors or self._is_apart(middle, middle, factors, d, n):
                    parts += [(begin, middle, factors), (middle, end, factors)]
                    continue
                widest = max(range(len(factors)), key=lambda i: factors[i][1] - factors[i][0])
                low, high = factors[widest]
                for half in ((low, (low + high) / 2), ((low + high) / 2, high)):
                    divided = (*factors[:widest], half, *factors[widest + 1 :])
                    parts.append((begin, end, divided))
        return True

    def _is_apart(
        self, begin: float, end: float, factors: Coefficients, d: list[Any], n: list[Any]
    ) -> bool:
        """Return whether (3) holds on an arc for a part of the set."""
        flint, (least, most) = self.flint, self.whole[0]
        middle, half = (flint.arb(end) + flint.arb(begin)) / 2, (flint.arb(end) - begin) / 2
        theta = middle + half * flint.arb(0, 1)
        z = flint.acb(theta.cos(), theta.sin())
        # z − 1 = 2i sin(θ/2) e^(iθ/2) has no cancellation near z = 1.
        turned = theta / 2
        sine = 2 * turned.sin()
        gamma = flint.acb(-sine * turned.sin(), sine * turned.cos()) / flint.arb(
            _fmpq(Fraction(self.dt), flint)
        )
        a, b = self._sampled(factors)
        zero = flint.acb(0)
        left = _at(a, gamma, zero) * _at(d, gamma, zero)
        right = _at(b[0], gamma, zero)
        if len(b) > 1:
            left, right = left * z, right * z + _at(b[1], gamma, zero)
        left, right = left * z**self.plant.samples, right * _at(n, gamma, zero)
        gain = _ball(((least + most) / 2, (most - least) / 2), flint)
        if not (left - gain * right).contains(0):
            return True
        if right.contains(0):
            return False
        ratio = left / right
        return bool(not ratio.imag.contains(0) or not ratio.real.overlaps(gain))

    def _sampled(self, factors: Coefficients) -> tuple[list[Any], list[list[Any]]]:
        """Return a, and b from the u of this sample and the one before, without the gain."""
        if factors not in self._known:
            flint, one = self.flint, (Fraction(1), Fraction(1))
            plant = self.plant_at((one, *factors))
            phi, now, before = held(plant, self.dt, flint)
            step = flint.arb(_fmpq(Fraction(self.dt), flint))
            n = len(phi)
            A = [[(phi[i][j] - int(i == j)) / step for j in range(n)] for i in range(n)]
            inputs = [now] if before is None else [now, before]
            columns = [np.array([each[0] / step for each in part], dtype=object) for part in inputs]
            row = [flint.arb(int(j == 0)) for j in range(n)]
            a, b = _polynomials(A, columns, row, flint.arb(0))
            self._known[factors] = a, b
        return self._known[factors]

    def described(self, factors: Coefficients) -> str:
        """Return a plant of the set in words."""
        gain, *others = [float((low + high) / 2) for low, high in factors]
        parts = [f"gain × {gain:.4g}"]
        parts += [f"a_{k} × {each:.4g}" for k, each in zip(self.places, others, strict=True)]
        return ", ".join(parts)
