"""Feedforward by a model of the plant, which the observer knows.

The control signal that moves a plant along the reference is the inverse of its model. For a linear
model ``y = G(s) e^(−sT) u`` it is, as a series in derivatives of the reference::

    u_ff(t) = c_0 r + c_1 r' + … + c_m r^(m) at t + T
            + F sign(r') + u_0,                           Σ c_i s^i = 1/G(s)

with Coulomb friction F and a constant u_0, such as gravity. Without zeros 1/G is a polynomial: y is
a flat output, and the series ends (Fliess, Lévine, Martin & Rouchon, *Int. J. Control* 61, 1995).
With zeros the series converges for moves that are slow against the slowest zero; cut off after the
rigid part it is the feedforward of inertia and friction that drives have. u is held for a sample,
so it acts half a sample late: T is the delay plus dt/2, and the derivatives of r give r(t + T).

With zeros, ``G = n(s)/d(s)`` with n(0) = 1, an exact inverse takes r for the flat output z in the
place of y: ``u_ff = d(s) z`` and ``y = n(s) z``, both polynomials. Of a motor that drives a load
through a spring, with its encoder at the motor, z is the position of the load: a move of z that is
smooth enough leaves neither of them swinging, however quick it is, as long as u keeps within its
limits. Below, r and its derivatives are then those of ``n(s) z``.

**The observer** models the plant with its own b_0 and a, ``y^(n) = −a·(y … y^(n−1)) + b_0 u + f``,
and b_0 is a number for robustness, not the gain of the plant. On the reference, with u = u_ff, the
model of the feedforward and that of the observer together say what f is::

    f_m = D(s) r − b_0 u_ff,             D(s) = s^n + a_{n−1} s^(n−1) + … + a_0

(for a model with zeros D is the series of its inverse, times b). f_m is fed to the observer as a
known part of f, as the output of a learner is, so it is not in Δf̂. The law is that of
``controllers/law.py`` with f_m as a part of f̂::

    u = ( k_1 (r − x̂_1) + … + k_n (r^(n−1) − x̂_n) + r^(n) + a·x̂ − f_L − Δf̂ − f_m ) / b_0
      = u_ff + ( Σ k_i (r^(i−1) − x̂_i) + a·(x̂ − (r … r^(n−1))) − f_L − Δf̂ ) / b_0

If the model is exact, y = r is a solution with ``x̂ = (r, r', …)`` and ``Δf̂ = 0``, so u = u_ff: the
feedback part is zero for every b_0. In the errors ``y − r`` and ``u − u_ff`` the loop is the one
without feedforward: stability, margins and the answer to loads do not depend on it. What the model
has wrong is a disturbance at the plant's input, and the observer finds it.

In the sampled loop f_m of the sample that begins is ``D r`` in its middle less b_0 times the u_ff
that acts then; an observer that knows the delay gets the one of the same time.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.law import ModelFeedforward, ReferenceOnly
from quell.lti.canonical import Canonical, canonical, format_roots
from quell.observers.eso import ESO
from quell.observers.forms import DelayedModel
from quell.plants.friction import FrictionPlant
from quell.plants.linear import DelayedPlant, EncodedPlant
from quell.plants.linearise import linear_model
from quell.signals.shapes import Signal
from quell.types import Vector

# The highest derivative of the reference: a move knows no more with sense, and the numbers of an
# observer of order 8 need no more. Chosen by hand.
_MOST = 10


@dataclass(frozen=True)
class Feedforward:
    """The feedforward of a model of the plant, for ``ADRC(..., feedforward=...)``.

    ``rigid`` makes it from an inertia, ``of`` from a linear or identified plant. It does not depend
    on b0, and the observer knows it; with a table of b0 the inertia is that for the observer's b0,
    and follows 1/b0. The docstring of this module has the equations.

    Parameters
    ----------
    coefficients
        c_0, c_1, … of ``u_ff = c_0 r + c_1 r' + c_2 r'' + …`` [u-unit s^i/y-unit], 1 to 11 of them:
        of an inertia J with viscous friction c they are 0, c, J.
    coulomb
        Coulomb friction F, ``F sign(r')`` [u-unit]; negative where a positive u moves y down.
    coulomb_speed
        speed below which it is in proportion to r' [y-unit/s]; by default it jumps with the sign.
    constant
        constant u_0 [u-unit], such as gravity.
    delay
        time from u to the plant [s], which is compensated by higher derivatives; by default the one
        that the observer knows. Half a sample for the hold of u is added.
    derivatives
        highest derivative of the reference that is used; by default one more than the highest
        coefficient's, so that delay and hold are compensated in the highest term, too: with it the
        error that they leave was a hundredth in the trials.
    numerator
        1, n_1, n_2, … of ``y = r + n_1 r' + n_2 r'' + …`` [s^i]: where y goes while the reference
        is that of a flat output, as the load behind a spring; by default y = r.

    Raises
    ------
    ValueError
        naming the argument, its value and the rule.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=4000.0, omega_o=500.0, dt=2.5e-4)
    >>> axis = Feedforward.rigid(1.27e-3, coulomb=0.02)
    >>> controller = ql.ADRC(observer, omega_c=100.0, feedforward=axis)
    >>> round(controller.step(0.0, 0.0, 0.0, 100.0), 6)  # J r'' + F, half a sample ahead
    0.147
    """

    coefficients: Sequence[float]
    coulomb: float = 0.0
    coulomb_speed: float = 0.0
    constant: float = 0.0
    delay: float | None = None
    derivatives: int | None = None
    numerator: Sequence[float] = (1.0,)

    def __post_init__(self) -> None:
        found = checks.vector("coefficients", self.coefficients)
        if not 1 <= found.size <= _MOST + 1:
            raise ValueError(
                f"coefficients has {found.size} numbers: must have 1 to {_MOST + 1}, of r, r', …"
            )
        object.__setattr__(self, "coefficients", tuple(found.tolist()))
        of_y = checks.vector("numerator", self.numerator)
        if not 1 <= of_y.size <= _MOST + 1 or of_y[0] != 1.0:
            raise ValueError(
                f"numerator = {self.numerator!r}: must begin with 1, as y is r at rest, and have "
                f"at most {_MOST + 1} numbers"
            )
        object.__setattr__(self, "numerator", tuple(of_y.tolist()))
        checks.finite("coulomb", self.coulomb)
        checks.non_negative("coulomb_speed", self.coulomb_speed, "y-unit/s")
        checks.finite("constant", self.constant)
        if self.coulomb_speed > 0.0 and self.coulomb == 0.0:
            raise ValueError(
                f"coulomb_speed = {self.coulomb_speed!r} without coulomb: has no effect; give the "
                "Coulomb friction, too, or leave it out"
            )
        checks.optional(checks.non_negative, "delay", self.delay, "s")
        if self.derivatives is not None:
            checks.whole("derivatives", self.derivatives, 1, _MOST)

    @classmethod
    def rigid(
        cls,
        inertia: float,
        *,
        viscous: float = 0.0,
        coulomb: float = 0.0,
        coulomb_speed: float = 0.0,
        constant: float = 0.0,
        delay: float | None = None,
        derivatives: int | None = None,
    ) -> Feedforward:
        """Return the feedforward of a rigid axis, ``J y'' = u − c y' − F sign(y') − u_0``.

        Parameters
        ----------
        inertia
            J, of all that moves [u-unit s²/y-unit]: the reciprocal of the rigid gain.
        viscous
            viscous friction c [u-unit s/y-unit].
        coulomb, coulomb_speed, constant, delay, derivatives
            as for ``Feedforward``.
        """
        inertia = checks.nonzero("inertia", inertia, "or u does not move the axis")
        friction = checks.finite("viscous", viscous)
        return cls((0.0, friction, inertia), coulomb, coulomb_speed, constant, delay, derivatives)

    @classmethod
    def of(
        cls,
        plant: Any,
        *,
        terms: int | None = None,
        coulomb: float | None = None,
        coulomb_speed: float | None = None,
        constant: float = 0.0,
        delay: float | None = None,
        derivatives: int | None = None,
        flat: bool = False,
    ) -> Feedforward:
        """Return the feedforward of a plant: the series of its inverse.

        Parameters
        ----------
        plant
            a linear plant of any kind that ``LinearPlant.of`` accepts, or one with a linear part,
            such as that of an identification; its delay and its dry friction are used, an encoder
            has no effect.
        terms
            highest power of s of the series; by default the plant's order. It is exact from there
            on for a plant without zeros. For one with zeros, 2 is the rigid part of an axis, and
            each further term comes closer for moves that are slow against the slowest zero.
        coulomb, coulomb_speed, delay
            as for ``Feedforward``; by default those of the plant.
        constant, derivatives
            as for ``Feedforward``.
        flat
            whether the reference is that of the flat output, with which the inverse of a plant with
            zeros is exact: ``numerator`` is then that of the plant.

        Raises
        ------
        ValueError
            also for a plant with a zero at s = 0, whose output can't follow a constant, and for
            ``terms`` of a flat output.

        Examples
        --------
        >>> [round(c, 9) for c in Feedforward.of(([2.0], [1.0, 0.6, 0.0])).coefficients]
        [0.0, 0.3, 0.5]
        """
        late, friction, width = 0.0, 0.0, 0.0
        while isinstance(plant, DelayedPlant | EncodedPlant):
            late += plant.delay if isinstance(plant, DelayedPlant) else 0.0
            plant = plant.plant
        if isinstance(plant, FrictionPlant):
            friction, width = plant.signed_force, plant.width
        model = canonical(linear_model(plant))
        if flat and terms is not None:
            raise ValueError(f"terms = {terms!r}: the inverse of a flat output ends; leave it out")
        highest = model.a.size if terms is None else checks.whole("terms", terms, 1, _MOST)
        friction = friction if coulomb is None else coulomb
        if coulomb_speed is None:
            coulomb_speed = width if friction != 0.0 else 0.0
        if delay is None and late > 0.0:
            delay = late
        of_y: Sequence[float] = (1.0,)
        if flat:
            denominator, numerator = polynomials(model, highest)
            series = denominator / (model.b * numerator[0])
            of_y = (numerator / numerator[0])[: model.zeros.size + 1].tolist()
        else:
            series = inverse_series(model, highest) / model.b
        rest = friction, coulomb_speed, constant, delay, derivatives, of_y
        return cls(tuple(series.tolist()), *rest)

    @property
    def order(self) -> int:
        """The highest derivative of the reference that is used."""
        highest = min(len(self.coefficients), _MOST)
        return highest if self.derivatives is None else self.derivatives

    def series(self, highest: int) -> Vector:
        """Return c_0, c_1, … up to a power (highest + 1,), zero where there are no more."""
        found = np.zeros(highest + 1)
        given = np.asarray(self.coefficients, dtype=np.float64)[: found.size]
        found[: given.size] = given
        return found

    def fixed(self, observer: ESO) -> tuple[Vector, Vector]:
        """Return the coefficients of forces that stay where b0 follows the inertia, (m + 1,) each.

        They are those below r^(n), for the time when u acts and for the u that acts in the sample;
        see ``controllers/schedule.py``.
        """
        model = self.design(observer)
        own = self.series(model.control.size - 1)
        own[observer.degree :] = 0.0
        return shifted(own, model.lead), shifted(own, model.lead_acting)

    def with_inertia(self, ratio: float, degree: int) -> Feedforward:
        """Return it for ``ratio`` times the inertia of a plant of relative degree ``degree``."""
        own = self.coefficients
        heavier = tuple(ratio * c if i >= degree else c for i, c in enumerate(own))
        return replace(self, coefficients=heavier)

    def with_gain(self, ratio: float) -> Feedforward:
        """Return it for an actuator that moves the plant ``ratio`` times as much for the same u."""
        own = tuple(c / ratio for c in self.coefficients)
        coulomb, constant = self.coulomb / ratio, self.constant / ratio
        return replace(self, coefficients=own, coulomb=coulomb, constant=constant)

    def linear_part(self, reference: Signal, t: Vector, dt: float) -> tuple[Vector, Vector]:
        """Return y, and u_ff without friction and constant, at times (k,) [s].

        The derivatives of the reference give u_ff of a sampled controller at the time when u acts,
        half a sample and ``delay`` later.
        """
        y, u, lead = np.zeros(t.shape), np.zeros(t.shape), (self.delay or 0.0) + 0.5 * dt
        series = shifted(self.series(self.order), lead).tolist()
        for of_y, of_u in itertools.zip_longest(self.numerator, series, fillvalue=0.0):
            values = reference(t)
            y, u, reference = y + of_y * values, u + of_u * values, reference.derivative()
        return y, u

    def describe(self) -> str:
        """Return u_ff as a formula."""
        names = ["r" + "'" * i if i < 4 else f"r^({i})" for i in range(len(self.coefficients))]
        terms = [f"{c:.4g} {name}" for c, name in zip(self.coefficients, names, strict=True) if c]
        terms += [f"{self.coulomb:.4g} sign(r')"] if self.coulomb else []
        terms += [f"{self.constant:.4g}"] if self.constant else []
        late = "the delay that the observer knows" if self.delay is None else f"{self.delay:g} s"
        total = " + ".join(terms).replace("+ -", "- ") or "0"
        if len(self.numerator) > 1:
            total += f" for y = r + … + {self.numerator[-1]:.4g} r^({len(self.numerator) - 1})"
        return f"u = {total}, ahead by half a sample and {late}"

    def table(self) -> dict[str, Any]:
        """Return it as a table of a setup file."""
        found: dict[str, Any] = {"kind": "series", "coefficients": list(self.coefficients)}
        defaults = Feedforward((0.0,))
        for name in ("coulomb", "coulomb_speed", "constant", "delay", "derivatives", "numerator"):
            value = getattr(self, name)
            if value != getattr(defaults, name):
                found[name] = list(value) if isinstance(value, tuple) else value
        return found

    def design(self, observer: ESO, law: Sequence[float] = ()) -> ModelFeedforward:
        """Return the parameters for an observer, and the gains of the law (n,).

        Raises ``ValueError`` for an observer whose f enters elsewhere than u.
        """
        plant, degree = observer.plant, observer.degree
        if not plant.matched:
            raise ValueError(
                "feedforward is a model, and the observer's f enters through E, not where u does: "
                "what the model knows can't be told to it; leave E out"
            )
        m = max(self.order, degree)
        model = observer.model
        known = model.samples * observer.dt if isinstance(model, DelayedModel) else 0.0
        half = 0.5 * observer.dt
        lead = (known if self.delay is None else self.delay) + half
        own = self.series(m)
        inverse = self._of_y(inverse_series(plant, m))
        errors, wish = np.zeros(m + 1), np.zeros(m + 1)
        errors[:degree] = law[:degree] if len(law) else 0.0
        wish[degree] = 1.0
        # The law adds its gains times the reference's own derivatives; y has those of n(s) r.
        wish = self._of_y(errors + wish) - errors
        acting = shifted(own, lead - known)
        return ModelFeedforward(
            control=shifted(own, lead),
            wish=wish - inverse,
            share=shifted(inverse, half) - observer.b0 * acting,
            b0=observer.b0,
            coulomb=float(self.coulomb),
            full_speed=float(self.coulomb_speed),
            constant=float(self.constant),
            lead=lead,
            lead_acting=lead - known,
        )

    def _of_y(self, series: Vector) -> Vector:
        """Return a series in derivatives of y as one in those of r, up to the same power."""
        return np.convolve(series, self.numerator)[: series.size]


def polynomials(plant: Canonical, highest: int) -> tuple[Vector, Vector]:
    """Return d(s) and n(s)/b of ``G = n/d``, lowest power first, d (highest + 1,) or longer.

    Raises ``ValueError`` for a zero at s = 0.
    """
    n = plant.a.size
    if np.any(plant.zeros == 0.0):
        raise ValueError(
            f"plant has a zero at s = 0 (zeros: {format_roots(plant.zeros)} rad/s): no u makes its "
            "output follow a constant; feed nothing forward, or measure another output"
        )
    numerator = np.zeros(max(n, highest + 1))
    for k in range(n):  # from the Markov parameters B
        numerator[n - 1 - k] = sum(plant.a[n - j] * plant.B[k - j] for j in range(1, k + 1))
        numerator[n - 1 - k] += plant.B[k]
    denominator = np.zeros(max(n, highest) + 1)
    denominator[: n + 1] = np.append(plant.a, 1.0)
    return denominator, numerator / plant.b


def inverse_series(plant: Canonical, highest: int) -> Vector:
    """Return the series of ``b/G(s)`` about s = 0 up to a power (highest + 1,), lowest first.

    Raises ``ValueError`` for a zero at s = 0.
    """
    denominator, numerator = polynomials(plant, highest)
    series = np.zeros(highest + 1)
    for i in range(highest + 1):
        rest = sum(series[j] * numerator[i - j] for j in range(i))
        series[i] = (denominator[i] - rest) / numerator[0]
    return series


def shifted(series: Vector, lead: float) -> Vector:
    """Return the series of ``Σ c_i s^i e^(s lead)`` up to the same power."""
    found = np.zeros(series.size)
    power = 1.0
    for j in range(series.size):
        found[j:] += power * series[: series.size - j]
        power *= lead / (j + 1)
    return found


def checked_feedforward(feedforward: Any) -> bool | Feedforward:
    """Return ``feedforward`` if it is a flag or the feedforward of a model."""
    if isinstance(feedforward, Feedforward):
        return feedforward
    if isinstance(feedforward, bool | np.bool_):
        return bool(feedforward)
    raise ValueError(
        f"feedforward = {feedforward!r}: must be true or false, or quell.Feedforward, for example "
        "Feedforward.rigid(inertia) or Feedforward.of(plant)"
    )


def feedforward_design(feedforward: bool | Feedforward, observer: ESO, law: Vector) -> Any:
    """Return the parameters of the feedforward, also without a model, beside a law (n,)."""
    if isinstance(feedforward, Feedforward):
        return feedforward.design(observer, law.tolist())
    return ReferenceOnly()


def derivatives_used(feedforward: bool | Feedforward, degree: int) -> int:
    """Return the number of derivatives of the reference that a controller uses."""
    if isinstance(feedforward, Feedforward):
        return max(feedforward.order, degree)
    return degree if feedforward else 0
