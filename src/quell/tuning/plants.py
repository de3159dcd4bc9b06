"""The plants that a tuning is for: given, identified, or those of a record.

The plants that a tuning is for: one, a list, a batch, with a range of their gain.

The set of plants that an identified model stands for: its deviations as plants of their own.

The coefficients θ of the model have a covariance P. With 95 % all of them together are in the
ellipsoid ``(θ' − θ)ᵀ P⁻¹ (θ' − θ) ≤ k²``, k² being the 95 % quantile of χ² with as many degrees of
freedom as there are coefficients. The set has the model itself, and the points of the ellipsoid
that are farthest in the direction of each coefficient and of the gain K::

    θ ± k P c/√(cᵀ P c),     c = e_i for each coefficient, and ∂K/∂θ

so that each coefficient and the gain have their whole joint interval in the set (Scheffé's
intervals: Seber & Lee, *Linear Regression Analysis*, 2nd ed. 2003, sec. 5.1.1). A delay that was
searched is one of the coefficients: a longer one goes with faster poles. Other models that the
record does not tell apart from it are plants of the set, too.

The model of a record, those that the record does not tell apart from it, plants to tune for.

``quell tune RECORD`` and the studio identify records in this way.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.identification import FrequencyModel, Measured, identify, not_told_apart
from quell.identification.result import NOTHING_HELD_OUT, Identified, percent
from quell.identification.structures import fits_better, lag_in_delay
from quell.lti.canonical import canonical
from quell.parallel import part_of
from quell.plants.base import PlantBatch
from quell.plants.linear import DelayedPlant, LaggedPlant, SampledPlant, sampled_plant
from quell.plants.linearise import linear_part
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.structures.base import Model
from quell.types import Vector

# ---- The plants that a tuning is for ----

# A zero with a real part above this share of its size is in the right half plane.
_RIGHT = 1e-9


class Given(NamedTuple):
    """Plants as given, without delays and encoders, and their delays."""

    linear: tuple[Any, ...]
    delays: Vector  # [s]
    actuator_lag: float
    factors: Vector  # factors of the gain, for each plant
    sign: float  # sign of the gain that integral action needs
    degree: int
    b: float  # gain of the first plant from u to y^(degree)


def as_list(plant: Any) -> list[Any]:
    """Return the plants of a ``PlantBatch`` or of a list of plants; or one plant in a list.

    A list holds plants: objects, or tuples (numerator, denominator) and the like. A tuple is one
    plant.
    """
    if isinstance(plant, PlantBatch):
        return list(plant)
    if isinstance(plant, list) and plant:
        inner = (list, np.ndarray, float, int, np.number)
        if not any(isinstance(entry, inner) for entry in plant):
            return plant
    return [plant]


def with_known_noise(
    given: Constraints, plant: Any, limits: tuple[float, float], noise: float = 0.0
) -> Constraints:
    """Return the constraints with the noise of y that is known, if nothing bounds it yet.

    A plant with an encoder tells of its resolution, the model of a record of ``noise_std``, and a
    scenario of ``noise``, a standard deviation [y-unit]. Each is of use between finite ``limits``
    of u [u-unit], a share of which noise may take.
    """
    bounded = given.noise or given.m_ks or given.u_std or given.noise_over_pi is None
    if bounded or not math.isfinite(limits[1] - limits[0]):
        return given
    while isinstance(plant, DelayedPlant | LaggedPlant):
        plant = plant.plant
    std, step = (getattr(plant, name, None) or 0.0 for name in ("noise_std", "resolution"))
    if std > 0.0:  # rounding is part of it
        return replace(given, noise_std=math.hypot(std, noise))
    known = {"noise_std": noise, "resolution": step}
    return replace(given, **{name: value for name, value in known.items() if value > 0.0})


def given_plants(
    plant: Any,
    dt: float,
    *,
    delay: Any = 0.0,
    actuator_lag: float = 0.0,
    b_range: Sequence[float] = (1.0, 1.0),
    operating_point: Any = None,
) -> Given:
    """Return the plants, checked: the same sign of the gain.

    Raises ``ValueError`` for a plant with a zero at s = 0, on which integral action has no effect.
    """
    plants = as_list(plant)
    more = np.broadcast_to(np.asarray(delay, dtype=np.float64), (len(plants),))
    parts = [linear_part(each, dt, operating_point) for each in plants]
    delays = np.array([own for _, own in parts]) + more
    low, high = checks.vector("b_range", b_range, 2).tolist()
    if not 0.0 < low <= high:
        raise ValueError(f"b_range = {b_range!r}: must be two positive factors of b, low and high")
    forms = [canonical(linear) for linear, _ in parts]
    for i, form in enumerate(forms):
        if np.any(form.zeros == 0.0):
            raise ValueError(
                f"plant[{i}] has a zero at s = 0: integral action has no effect on its output; "
                "measure another output"
            )
    signs = [_sign(form.b, form.zeros) for form in forms]
    for i, sign in enumerate(signs):
        if sign != signs[0]:
            raise ValueError(
                f"plant[{i}] has the other sign of the gain than plant[0]: no controller with "
                "integral action stabilises both; check the direction of u"
            )
    linear = tuple(part for part, _ in parts)
    factors = np.unique([low, 1.0, high]) if (low, high) != (1.0, 1.0) else np.ones(1)
    return Given(linear, delays, actuator_lag, factors, signs[0], forms[0].degree, forms[0].b)


def _sign(b: float, zeros: Vector) -> float:
    """Return the sign that k_i needs: that of the numerator at s = 0.

    The closed loop's polynomial ``D s + N k_i`` must have the same sign at 0 and at infinity.
    """
    right = int(np.sum((zeros.real > _RIGHT * np.abs(zeros)) & (zeros.imag == 0.0)))
    return float(np.sign(b)) * (-1.0) ** right


def plant_set(given: Given, dt: float, own: Vector | None = None) -> PlantSet:
    """Return the set: each plant with each factor of the gain; the nominal one is the first.

    ``own`` has one factor for each plant instead.
    """
    sampled: list[SampledPlant] = []
    for linear, delay in zip(given.linear, given.delays.tolist(), strict=True):
        sampled.append(sampled_plant(linear, dt, delay, given.actuator_lag))
    if own is not None:
        return PlantSet(sampled, own, dt)
    order = np.argsort(np.abs(np.log(given.factors)), kind="stable")  # the factor 1 first
    factors = np.repeat(given.factors[order], len(sampled))
    return PlantSet(sampled * given.factors.size, factors, dt)


def model_of(given: Given, plants: PlantSet, constraints: Constraints) -> Model:
    """Return what structures may know: the first plant."""
    omega = plants.crossover
    # Beside the crossover, where an undamped resonance may be.
    beside = np.abs(plants.responses(omega * np.array([0.8, 1.25]))[0])
    gain = float(np.sqrt(beside[0] * beside[1]))
    return Model(
        plant=given.linear[0],
        delay=float(given.delays[0]),
        dt=plants.dt,
        sign=given.sign,
        degree=given.degree,
        b=abs(given.b),
        omega=omega,
        gain=gain,
        constraints=constraints,
    )


# A pair of poles above this share of half the sampling rate is hardly controllable by samples.
_NEAR_HALF = 0.9


def beyond_control(plants: PlantSet) -> str:
    """Return which pair of poles decides stability but can't be damped at dt; empty without one.

    At half the sampling rate a pair is sampled in the same place of each half turn: u moves one of
    its two states, and y shows one (Kalman, Ho & Narendra, *Contributions to Differential
    Equations* 1, 1963, pp. 189–213: control is lost where ``Im(s_i − s_j) = 2 π k/dt``). Near it
    the phase that would damp the pair depends on less of the delay than is known of any plant. The
    pair decides stability if it is unstable, or if |P| there is that at the crossover or more.
    """
    top = math.pi / plants.dt
    for i, plant in enumerate(plants.plants):
        poles = plants.s_poles(plant)
        for s in poles[poles.imag >= _NEAR_HALF * top].tolist():
            if s.real < 0.0:
                at = np.array([plants.crossover, min(s.imag, float(plants.omega[-1]))])
                usual, there = np.abs(plants.responses_of(at, np.array([i, i])))
                if there < usual:
                    continue
            return (
                f"plant[{i}] has a pair of poles with a damping of {-s.real / abs(s):.2g} at "
                f"{s.imag:.4g} rad/s, {s.imag / top:.3g} of half the sampling rate: it decides "
                f"whether loops are stable, but samples at dt = {plants.dt:g} s can't damp it; "
                f"sample with a dt of {0.5 * math.pi / s.imag:.2g} s at most, or leave the pair out"
            )
    return ""


# ---- The set of plants that an identified model stands for ----

# Probability of the ellipsoid.
_INSIDE = 0.95


def identified_plants(
    found: Identified | FrequencyModel, others: Sequence[Identified] = ()
) -> tuple[list[tuple[Vector, Vector]], list[float]]:
    """Return the plants ``(num, den)`` that a model stands for, itself first, and their delays [s].

    Parameters
    ----------
    found
        result of ``identify``, or of ``identify_frequencies``.
    others
        further models of the record, as ``not_told_apart`` returns them behind the first.

    Raises
    ------
    ValueError
        for direct feedthrough, or what the record does not decide of sign and size of the gain, the
        start at rest and the delay.
    """
    from scipy.stats import chi2

    _ = found.plant  # says why not, for direct feedthrough
    if found.undecided:
        raise ValueError(f"found: {'; '.join(found.undecided)}")
    free = found.den.size - 1 - found.integrators
    theta = np.concatenate(
        [found.den[::-1][found.integrators : -1], found.num[::-1], [found.delay]]
    )
    size = theta.size - 1
    P = np.zeros((theta.size, theta.size))
    P[:size, :size], P[size], P[:, size] = found.covariance, *[found.delay_covariance] * 2
    if not np.all(np.isfinite(P)):
        raise ValueError("found: its deviations are not finite; identify with a lower order")
    directions = list(np.eye(theta.size))
    if free and theta[0] != 0.0:
        of_gain = np.zeros(theta.size)
        of_gain[free], of_gain[0] = 1.0 / theta[0], -theta[free] / theta[0] ** 2
        directions.append(of_gain)
    known = int(np.sum(np.diag(P) > 0.0))
    k = float(np.sqrt(chi2.ppf(_INSIDE, known))) if known else 0.0
    points = [theta]
    for c in directions:
        spread = float(np.sqrt(max(float(c @ P @ c), 0.0)))
        if spread > 0.0:
            step = k * (P @ c) / spread
            points += [_moved(theta, step, size), _moved(theta, -step, size)]
    plants = []
    for point in points:
        den = np.concatenate([[1.0], point[:free][::-1], np.zeros(found.integrators)])
        plants.append((point[free:size][::-1].copy(), den))
    delays = [max(float(point[size]), 0.0) for point in points]
    for other in others:
        plants.append((other.num, other.den))
        delays.append(other.delay)
    return plants, delays


def _moved(theta: Vector, step: Vector, size: int) -> Vector:
    """Return θ after a step, ``θ exp(step/θ)`` if else the sign of the highest b would change.

    Then a fast pole is uncertain, which changes all coefficients by the same factor.
    """
    point = theta + step
    if point[size - 1] * theta[size - 1] <= 0.0:
        known = theta[:size] != 0.0
        part = np.where(known, theta[:size], 1.0)
        point[:size] = np.where(known, part * np.exp(step[:size] / part), point[:size])
    return point


# ---- The model of a record, those that the record does not tell apart from it ----


def doubts(model: Identified) -> tuple[str, ...]:
    """Return why margins that hold for a model may not hold for its plant; empty for a good one."""
    found = model.shortcomings
    return found if model.converged else (*found, "the search did not converge; record longer")


# Poles of the model at first: a flexible axis has four.
_ORDER = 4


@dataclass(frozen=True, eq=False)
class RecordModel:
    """The model of a record, and the models that the record does not tell apart from it."""

    model: Identified
    others: tuple[Identified, ...]
    held_out: float | None  #: share of the record that was to be held out; None: by itself
    larger: Identified | None = None  #: a model with more poles that does not hold
    fast: tuple[Identified, ...] = ()  #: others with poles that samples at dt can't damp

    @property
    def lines(self) -> list[str]:
        """The report; lines that begin with NOT say what the record does not show."""
        model = self.model
        found = model.describe().splitlines()
        if model.held_from == model.y.size and self.held_out is None:
            found.append(NOTHING_HELD_OUT)
        if self.larger is not None:
            key = "held out" if "held out" in model.fits else "estimation"
            found.append(
                f"order {self.larger.den.size - 1} has a fit of "
                f"{percent(self.larger.fits[key], 1)} instead of {percent(model.fits[key], 1)} % "
                f"({key}), but does not hold: {_why_not(self.larger)}"
            )
        for other in self.others:
            found.append(f"the record does not tell it from {other!r}, which is tuned for, too")
        for other in self.fast:
            found.append(f"{other!r} is not tuned for: {_beyond_control(other)}")
        return found

    @property
    def refusal(self) -> str:
        """Why no controller should be tuned for the model, and what to do; empty if there is none.

        The reasons are faults of the model, what the record does not decide, and a y that is early
        against u, which a larger model shows that is not taken.
        """
        found, larger = [*self.model.faults, *self.model.undecided], self.larger
        if larger is not None and larger.early and fits_better(self.model, larger):
            found.append(larger.early_text)
        if not found and (fast := _beyond_control(self.model)):
            found.append(fast)
        return "; ".join(found)

    @cached_property
    def plants(self) -> tuple[list[Any], list[float]]:
        """The plants ``(num, den)`` to tune for, the model first, and their delays [s].

        Raises
        ------
        ValueError
            if there is a ``refusal``, and for direct feedthrough.
        """
        if self.refusal:
            raise ValueError(f"record: no plant to tune for: {self.refusal}")
        return identified_plants(self.model, self.others)


def _why_not(model: Identified) -> str:
    """Return why a model does not hold; empty if it does."""
    found = [*model.faults, *model.undecided]
    if not found and (fast := _beyond_control(model)):
        found.append(fast)
    worse = ["it is worse than the mean of y on samples that were not fitted"] * model.fails
    search = ["its search did not converge"] * (not model.converged)
    return next(iter([*found, *worse, *search]), "")


def _beyond_control(model: Identified) -> str:
    """Return ``beyond_control`` of a model without faults."""
    if all(pole.value.imag < _NEAR_HALF * math.pi / model.dt for pole in model.poles):
        return ""
    try:
        given = given_plants((model.num, model.den), model.dt, delay=max(model.delay, 0.0))
    except ValueError:  # no plant for a loop: ``plants`` says why
        return ""
    found = beyond_control(plant_set(given, model.dt))
    return found.replace("plant[0]", "the model").replace("leave the pair out", "use a lower order")


def record_model(
    record: Measured,
    order: int = _ORDER,
    zeros: int | None = None,
    *,
    integrators: int | None = None,
    friction: bool | None = None,
    rest: bool | None = None,
    max_delay: float | None = None,
    held_out: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> RecordModel:
    """Identify a record with a first order, and take the structure that the record supports.

    Where that has a fault, or does not decide the gain, orders from 1 on are tried, and the
    simplest model that holds is taken, until a larger one that holds fits better.

    Parameters
    ----------
    record
        of one experiment.
    order, zeros, integrators, rest, held_out
        as for ``identify``; fewer or more poles are taken where the record shows them.
    friction
        whether there is Coulomb friction; None: where it fits better.
    max_delay
        longest delay [s] that is searched; None: as long as the longest one is the best.
    progress
        called with a share of the work that is done; an exception in it ends the work.

    Raises
    ------
    ValueError
        as ``identify``.
    """
    delay = None if max_delay is None else (0.0, max_delay)

    def fitted(poles: int, friction: bool, share: tuple[float, float]) -> Identified:
        return identify(
            record.u,
            record.y,
            record.dt,
            poles,
            None if zeros is None else min(zeros, poles - (zeros < order)),
            delay=delay,
            integrators=integrators,
            friction=friction,
            rest=rest,
            held_out=held_out,
            signals=record.signals,
            progress=part_of(progress, *share, 1.0),
        )

    first = fitted(order, bool(friction), (0.0, 0.5))
    how: dict[str, Any] = {"integrators": integrators, "friction": friction}
    model, *others = not_told_apart(first, delay, **how, progress=part_of(progress, 0.5, 0.8, 1.0))
    judged = [(each, bool(_beyond_control(each))) for each in others]
    slow = tuple(each for each, is_fast in judged if not is_fast)
    fast = tuple(each for each, is_fast in judged if is_fast)
    if not _why_not(model):
        return RecordModel(model, slow, held_out, fast=fast)
    tried = [(k, bool(friction)) for k in range(1, order)]
    if friction is None and order > 1:
        tried[1:1] = [(1, True), (2, True)]
    models = []
    for i, (fewer, rubs) in enumerate(tried):
        ends = 0.8 + 0.2 * i / len(tried), 0.8 + 0.2 * (i + 1) / len(tried)
        with contextlib.suppress(ValueError):  # no such model: more integrators than poles
            models.append(fitted(fewer, rubs, ends))
    held: Identified | None = None
    for one in [*models, first]:
        if friction is None and one.friction is not None and not one.rubs:
            continue
        # Friction on a speed hides an offset: it must be better than a model without, not alone.
        alone = held is None and not (
            one.den.size == 2 and one.friction is not None and not friction
        )
        better = held is not None and (fits_better(held, one) or bool(lag_in_delay(held, one)))
        if not _why_not(one) and (alone or better):
            held = one
    if held is None:
        return RecordModel(model, slow, held_out, fast=fast)
    return RecordModel(held, (), held_out, model)
