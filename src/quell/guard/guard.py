"""``Guard`` as users make it (``kernels.py`` has its equations), and its certified bound.

Effect of a learner's correction on the loop of a linear plant and the plain observer.

A learner's feedforward f_L changes the estimates of the observer by s, their response to
f_L (``learners/base.py``); without f_L, the same y and u give the plain estimates x̂, f_plain. In
the law the learner changes ``b0 u`` by −w,

    w = c_f (f_L + s_N) + Σ (k_i − a_i) s_i = c_f e_L + Σ (k_i − a_i) s_i,      e_L = f_L − f_L^F

and nothing else, as the observer is told of u (c_f is 1 if f enters where u does, else 0). So the
loop is the plain one with the input w, in which ``q = f_plain − f_plain^F``. With the input e_L,
f_L is ``(1 − F)⁻¹ e_L``: its constant part is free, but the first n entries of s, the ones in w, do
not depend on it (``state_path``). For an ESO in the current form they are

    s_x⁺ = (I − L_x C)(Φ_x s_x + Γ_x e_L)

with the poles ``((s + omega_o)^N − omega_o^N)/s`` in continuous time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

import quell.guard.kernels  # noqa: F401  (registers the functions for ``GuardDesign``)
from quell import checks
from quell.checks import Described
from quell.guard.kernels import (
    PARTS,
    SETTLING_LAGS,
    GuardAverages,
    GuardDesign,
    GuardInterval,
    GuardMemory,
    GuardSample,
    GuardSuspect,
    GuardTrial,
    withdraw_authority,
)
from quell.hints import explained
from quell.learners.base import lag_memory, lag_of
from quell.lti.models import System, peak_gain
from quell.observers.design import f_learned_response, response, scaled_response
from quell.observers.eso import ESO
from quell.observers.forms import without_delay
from quell.plants.linear import SampledPlant, sampled_plant
from quell.plants.linearise import linear_part
from quell.types import Matrix, Vector

# ---- Effect of a learner's correction on the loop of a linear plant and the plain observer ----

# Largest length of the state of an observer with a delay; the computation costs its cube. As for
# the plant, chosen by hand.
_MOST_STATES = 250
# A pole that is closer to the unit circle counts as on it: the cascade has two at z = 1, which
# rounding moves by its square root. Slower poles than 0.03 per million samples do not occur.
_MARGINAL = 3e-8


class CorrectionGains(NamedTuple):
    """Peak-to-peak gains of a correction."""

    error: float  #: Γ, from e_L to q
    output: float  #: Γ_y, from e_L to y [s^n]


def correction_gains(
    plant: SampledPlant, observer: ESO, law: Vector, every: int = 1
) -> CorrectionGains:
    """Return Γ and Γ_y of the loop of a sampled plant.

    Raises ``ValueError`` for an unstable loop, a nonlinear observer, or one that models more of f
    than a constant.

    Parameters
    ----------
    plant
        the plant with its delay and lag, from ``plants.sampled.sampled_plant``.
    observer
        the observer, of any linear form.
    law
        gains k of the law (n,).
    every
        number m of samples in one of the guard's account.
    """
    check_one_state_of_f(observer)
    path = state_path(observer, law)
    to_error, to_output = plain_loop(plant, observer, law, every)
    check_stable(to_error, "the loop without learner")
    check_stable(path, "the observer's answer to a correction")
    return CorrectionGains(peak_gain(path.then(to_error)), peak_gain(path.then(to_output)))


def check_one_state_of_f(observer: ESO) -> None:
    """Raise a ``ValueError`` for an observer whose model of f is more than a constant."""
    m = observer.disturbance_order
    if m > 1:
        free = "a ramp" if m == 2 else "a parabola"
        raise ValueError(
            f"guard with disturbance_order = {m}: a guard bounds the correction e_L = f_L − f_L^F, "
            "what the observer does not take back through f, and lets the part of f_L that moves "
            f"nothing leak away; with this observer {free} of f_L moves nothing, grows without "
            "bound, and would have to leak away, too, which no guard does; use an observer with "
            "disturbance_order=1, or no guard"
        )


def check_stable(system: System, what: str) -> None:
    """Raise a ``ValueError`` for an unstable system; ``what`` names it."""
    pole = system.largest_pole
    if pole >= 1.0:
        raise ValueError(f"{what} is unstable, with a pole at |z| = {pole:.9g}: nothing is certain")


def is_invertible(observer: ESO) -> bool:
    """Return whether a bounded e_L moves the states by a bounded amount.

    That is, whether ``(1 − F)⁻¹`` is stable but for its free constant. Of the designs of ``ESO``
    these are all with coincident poles or Kalman gains, except for ``half_gain`` at high order and
    low sampling rate; not a cascade, and not an observer of a plant with slow zeros that does not
    keep them.
    """
    return state_path(observer, np.zeros(observer.order)).largest_pole < 1.0 - _MARGINAL


def lag_between_samples(observer: ESO, every: int = 1) -> tuple[Matrix, Vector, Vector, float]:
    """Return ``(M, g, c, d)`` of F, ``s⁺ = M s + g φ`` with ``c·s + d φ`` a sample later.

    With ``every`` = m F takes each m-th sample only, whichever is the first: the state has what
    comes out of the filter of these samples in the next m ones, and q is that of the guard in each
    sample in which its account has one.
    """
    plain = response(without_delay(observer.model), observer.estimates, observer.order)
    M, g, c, d = f_learned_response(plain, every)
    if every == 1:
        return M, g, c, d
    inner, size = M.shape[0], every * (M.shape[0] + 1) - 1
    shift, given = np.zeros((size, size)), np.zeros(size)
    newest, shown = slice((every - 1) * inner, every * inner), every * inner
    shift[inner:shown, : shown - inner] = np.eye(shown - inner)
    shift[shown + 1 :, shown:-1] = np.eye(every - 2)
    shift[:inner, newest], given[:inner] = M, g
    shift[shown, newest], given[shown] = c, d
    return shift, given, np.eye(size)[-1], 0.0


def plain_loop(
    plant: SampledPlant, observer: ESO, law: Vector, every: int = 1
) -> tuple[System, System]:
    """Return the loop of the plain observer, from w to q and from w to y."""
    if observer.states > _MOST_STATES:
        raise ValueError(
            f"observer has {observer.states} states with its delay: must have at most "
            f"{_MOST_STATES}; take a longer dt"
        )
    n, estimates = observer.order, observer.estimates
    whole = response(observer.model, estimates, n)
    M, g, c, d = lag_between_samples(observer, every)
    # The state: plant, observer, u before, lag filter of f_plain, and its output f_plain^F.
    sizes = (plant.B.size, whole.transition.shape[0], 1, M.shape[0], 1)
    edges = [0, *np.cumsum(sizes).tolist()]
    x, z, before, lag, filtered = (slice(*edge) for edge in pairwise(edges))
    y = np.zeros(edges[-1])
    y[x] = plant.C
    rows = np.outer(whole.feedthrough[:, 0], y)
    rows[:, z] += whole.output
    rows[:, before] += whole.feedthrough[:, 1:2]
    f_plain = rows[n]
    u = np.append(observer.cancel - law, -observer.cancel_f) @ rows[: n + 1] / observer.b0
    N, B = -np.eye(edges[-1]), np.zeros(edges[-1])
    N[x, x] = plant.N
    N[x] += np.outer(plant.B, u)
    B[x] = plant.B
    N[z, z] += whole.transition
    N[z] += np.outer(whole.input[:, 0], y)
    N[z, before] += whole.input[:, 1:2]
    N[before] += u
    B[before] = 1.0
    N[lag, lag] += M
    N[lag] += np.outer(g, f_plain)
    N[filtered, lag] += c
    N[filtered] += d * f_plain
    q = f_plain.copy()
    q[filtered] -= 1.0
    into = -B / observer.b0
    return System(N, into, q, 0.0), System(N, into, y, 0.0)


def state_path(observer: ESO, law: Vector) -> System:
    """Return the path from e_L to w."""
    size = observer.order + 1
    found = scaled_response(observer.model, observer.units, observer.order)
    m = found.transition.shape[0]
    # The state: s, and the estimates that it causes, of which the last is −f_L^F.
    A, B = np.zeros((m + size, m + size)), np.zeros(m + size)
    A[:m, :m], A[m:, :m] = found.transition, found.output
    B[:m], B[m:] = found.input[:, 2], found.feedthrough[:, 2]
    A[:, -1] -= B  # f_L = e_L + f_L^F
    w = np.zeros(m + size)
    w[m:-1] = law - observer.cancel
    N = A - np.eye(m + size)
    # A constant f_L is taken out of f̂ again, and moves nothing else.
    at_rest = np.linalg.solve(np.eye(m) - found.transition, found.input[:, 2])
    constant = np.concatenate([at_rest, np.zeros(observer.order), [-1.0]])
    return _without_constant(System(N, B, w, observer.cancel_f), constant)


def _without_constant(system: System, constant: Vector) -> System:
    """Return a system without a state v of rest that its output does not show: N v = 0, C v = 0.

    The last entry of the state is removed; the others become those less their share of v.
    """
    N, B, C, D = system
    share = constant[:-1] / constant[-1]
    return System(N[:-1, :-1] - np.outer(share, N[-1, :-1]), B[:-1] - share * B[-1], C[:-1], D)


# ---- The bound of a guard that is certified for a set of plants ----

# Largest κΓ of a certified guard: no learner can then make q larger than ten times the largest q
# without learner. In random two-mass loops an honest learner loses more with 0.7.
_LARGEST_PRODUCT = 0.9


def certified_bound(bound: float, plants: Any, observer: ESO, law: Vector, every: int = 1) -> float:
    """Return ``bound``, or less if κΓ would exceed 0.9 for one of the plants.

    Raises ``ValueError`` for an unstable loop, and for a plant that is not linear.

    Parameters
    ----------
    bound
        the largest κ.
    plants
        a plant or several, as ``named_plants`` takes them, behind delays and encoders if need be.
    observer
        the observer, of any linear form.
    law
        gains k of the law (n,).
    every
        number m of samples in one of the guard's account.
    """
    largest = bound
    for name, plant in named_plants(plants).items():
        linear, delay = linear_part(plant, observer.dt)
        gains = gains_of(name, sampled_plant(linear, observer.dt, delay), observer, law, every)
        largest = min(largest, _LARGEST_PRODUCT / gains.error)
    return largest


def gains_of(
    name: str, plant: SampledPlant, observer: ESO, law: Vector, every: int = 1
) -> CorrectionGains:
    """Return Γ and Γ_y of the loop of a plant; errors begin with the plant's name."""
    try:
        return correction_gains(plant, observer, law, every)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def named_plants(plants: Any) -> dict[str, Any]:
    """Return plants by name, from one plant, ``{name: plant}``, or a list or tuple of plants.

    A list or tuple of numbers and arrays is one plant, as in ``([1.0], [1.0, 0.0])``.
    """
    if isinstance(plants, Mapping):
        named = {str(name): plant for name, plant in plants.items()}
    elif isinstance(plants, list | tuple) and not any(map(_is_part_of_a_plant, plants)):
        named = {f"plant {i + 1}": plant for i, plant in enumerate(plants)}
    else:
        return {"plant": plants}
    if not named:
        raise ValueError(f"plants = {plants!r}: must have at least one plant")
    return named


def _is_part_of_a_plant(value: Any) -> bool:
    """Return whether a value is a number or an array, such as a coefficient or a matrix."""
    if isinstance(value, tuple):
        return all(map(np.isscalar, value))
    return isinstance(value, list | np.ndarray) or bool(np.isscalar(value))


# ---- The guard as users make it ----

# Chosen by hand on tuning seeds of `quell stress`, which judges them as a set on other seeds
# (studies/notes/guard_parts.md). Times are in lags N/omega_o of the observer.
_AVERAGING_LAGS = 15.0  # T of the averages
_CREDIT_TIME = 2.0 / 3.0  # T_C/T: who explains a part of a sinusoid has full authority in 25 lags
_RISE_LAGS, _DECAY_LAGS = 0.7, 200.0  # of P
_GROWTH_LAGS = 5.0  # e grows by a factor of 2.7 in this time while the learner acts
_OWN_LAGS = 10.0  # memory of c_L, the learner's newest largest correction
_SMOOTHING_LAGS = 30.0  # β̄ follows β over this time
_LEAK_LAGS = 7.0  # the target returns to f_L over this time, where the bound keeps them apart
_HOME_LAGS = 1000.0  # a target that is far from β̄g approaches it by e in this time
_ACCOUNT_LAGS = 300.0  # memory of the account
_MATCH_TIME = 0.1  # time over which ε compares p with q, over T
_USUAL_BOUND = 1.2  # κ_0: with 1 a perfect learner is clipped at its peaks
_CLOSING_LAGS = 2.0 / 3.0  # what a learner has done to y is taken back in this time
_TAKING_BACK_LAGS = 10.0  # for at most so long: then one without authority moves nothing
# Samples of the account in a lag, or in T/15 where that is less, and most samples of the loop
# between two of them: from there on what is left of the price is that of each sample.
_ACCOUNTS, _MOST_EVERY = 8.0, 16


@explained("quell.Guard()")
@dataclass(frozen=True, repr=False)
class Guard(Described):
    """Limits a learner to the authority that it has earned: ``ADRC(…, learner=…, guard=Guard())``.

    ``kernels.py`` has the equations. They do not depend on the units of y and u. The observer must
    have one extended state, ``disturbance_order=1``: of a learner's output that moves nothing the
    guard lets a constant leak away, and an observer with f' lets it be a ramp.

    Parameters
    ----------
    bound
        largest correction of the plain observer's estimate, in units of that estimate's error e: κ.
        Only a learner that explains nearly all of the error has it. The others have 1.2, or κ if
        that is less (``kernels.py``).
        After a jump of the disturbance a perfect learner needs more than 2.
    time
        time T [s] over which a learner is judged; by default 15 lags ``(n + 1)/omega_o`` of the
        observer.
    every
        number m of samples of the loop in one of the guard's account. With None it is an eighth of
        a lag, 1 at least and 16 at most, and 1 for an observer in predictor form. Corrections are
        bounded in each sample of the loop.
    certified_for
        a linear plant, a list of plants or ``{name: plant}``, for which κ is made small enough that
        no learner can make q larger than ten times what it is without learner: κΓ ≤ 0.9, see
        ``quell.analysis.certify``. A retune computes it again, in about 50 ms a plant.

    Raises
    ------
    ValueError
        for a parameter that is not positive.
    """

    bound: float = 3.0
    time: float | None = None
    certified_for: Any = None
    every: int | None = 1

    def __post_init__(self) -> None:
        checks.positive("bound", self.bound)
        if self.time is not None:
            checks.positive("time", self.time, "s")
        if self.every is not None:
            checks.whole("every", self.every, 1)

    def design(self, observer: ESO, law: Vector | None = None) -> GuardDesign:
        """Return the parameters for an observer and the gains k of the law (n,).

        ``certified_for`` needs the gains.

        Raises
        ------
        ValueError
            for a loop of ``certified_for`` that is unstable without learner, or without gains;
            for an observer with ``disturbance_order`` above 1; for ``every`` above half of a lag.
        """
        check_one_state_of_f(observer)
        dt, lag_time = observer.dt, observer.lag_time
        time = _AVERAGING_LAGS * lag_time if self.time is None else self.time
        lag = min(lag_time, time / _AVERAGING_LAGS)
        # The filter of each m-th sample of a predictor is no chain, and needs a larger state.
        longest = 1 if observer.form == "predictor" else _MOST_EVERY
        every = self.every or min(max(int(lag / (_ACCOUNTS * dt)), 1), longest)
        bound, step = float(self.bound), every * dt
        if every > 1 and step > 0.5 * lag:
            raise ValueError(
                f"every = {every}: must be at most {max(int(0.5 * lag / dt), 1)}, the samples in "
                "half of the observer's lag, or of time/15 where that is less; or leave it to the "
                "guard with every=None"
            )
        if self.certified_for is not None:
            if law is None:
                raise ValueError("law = None: certified_for needs the gains k of the law")
            bound = certified_bound(bound, self.certified_for, observer, law, every)
        # b0 + ∂f_L/∂u stays between b0/2 and 2 b0, as with the default gain_interval of Kalman.
        least_slope, largest_slope = sorted([-0.5 * observer.b0, observer.b0])

        def share(lags: float) -> float:
            """Return the share of its distance that a first-order lag covers in the step."""
            return -math.expm1(-step / (lags * lag_time))

        # y responds to f with the law's poles, as many as the relative degree: of a plant with
        # zeros the other gains are zero. Without a law y is taken to be as slow as f̂.
        degree = observer.degree
        omega_c = 1.0 / lag_time if law is None else float(law[0]) ** (1.0 / degree)
        filter_, invertible = lag_of(observer, every), is_invertible(observer)
        chain = ESO.model_free(observer.order, observer.b0, observer.omega_o, dt)
        return GuardDesign(
            every=float(every),
            spread=every > 1,
            turns=-(-PARTS // every),
            lag=filter_,
            forget=-math.expm1(-step / time),
            earn=step / (_CREDIT_TIME * time),
            stages=degree,
            respond=-math.expm1(-omega_c * step),
            closing=share(_CLOSING_LAGS),
            taking_back=_TAKING_BACK_LAGS * lag_time / dt if degree == observer.order else 0.0,
            forget_account=step / (_ACCOUNT_LAGS * lag_time),
            forget_match=-math.expm1(-step / (_MATCH_TIME * time)),
            rise=share(_RISE_LAGS),
            decay=share(_DECAY_LAGS),
            growth=share(_GROWTH_LAGS),
            bound=bound,
            usual_bound=min(bound, _USUAL_BOUND),
            own_decay=1.0 - share(_OWN_LAGS),
            within_lag=share(1.0),
            smooth=share(_SMOOTHING_LAGS),
            leak=share(_LEAK_LAGS),
            home=share(_HOME_LAGS),
            settling=SETTLING_LAGS * lag_time / dt,
            invertible=invertible,
            fed_lag=filter_ if invertible else lag_of(chain),
            least_slope=least_slope,
            largest_slope=largest_slope,
        )

    def memory(self, parameters: GuardDesign) -> GuardMemory:
        """Return the state before the first sample, without authority."""
        fed = lag_memory(parameters.fed_lag, 0 if parameters.invertible else 1)
        filters = lag_memory(parameters.lag, 3), fed, np.zeros(4)
        effects = np.zeros((3, parameters.stages))
        records = GuardAverages.zeros(), GuardSample.zeros(), GuardTrial.zeros()
        later = GuardInterval.zeros(), GuardSuspect.zeros()
        memory = GuardMemory(*filters, effects, *records, *later)
        withdraw_authority(memory)
        memory.interval[0].part = PARTS
        return memory
