"""Effect of a learner's correction on the loop of a linear plant and the plain observer.

A learner's feedforward f_L changes the estimates of the observer by the shadow s, its response to
f_L (``learners/lag.py``); without f_L, the same y and u give the plain estimates x̂, f_plain. In
the law the learner changes ``b0 u`` by −w,

    w = c_f (f_L + s_N) + Σ (k_i − a_i) s_i = c_f e_L + Σ (k_i − a_i) s_i,      e_L = f_L − f_L^F

and nothing else, as the observer is told of u (c_f is 1 if f enters where u does, else 0). So the
loop is the plain one with the input w, in which ``q = f_plain − f_plain^F``. Seen from e_L, f_L is
``(1 − F)⁻¹ e_L``: its constant part is free, but the first n entries of s, the ones in w, do not
depend on it (``state_path``). For an ESO in the current form they are

    s_x⁺ = (I − L_x C)(Φ_x s_x + Γ_x e_L)

with the poles ``((s + omega_o)^N − omega_o^N)/s`` in continuous time.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from quell.lti.norms import peak_gain
from quell.lti.system import System
from quell.observers.delay import without_delay
from quell.observers.eso import ESO
from quell.observers.response import f_learned_response, response, scaled_response
from quell.plants.sampled import SampledPlant
from quell.types import Vector

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


def correction_gains(plant: SampledPlant, observer: ESO, law: Vector) -> CorrectionGains:
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
    """
    check_one_state_of_f(observer)
    path = state_path(observer, law)
    to_error, to_output = plain_loop(plant, observer, law)
    _check_stable(to_error, "the loop without learner")
    _check_stable(path, "the observer's answer to a correction")
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


def _check_stable(system: System, what: str) -> None:
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


def plain_loop(plant: SampledPlant, observer: ESO, law: Vector) -> tuple[System, System]:
    """Return the loop of the plain observer, from w to q and from w to y."""
    if observer.states > _MOST_STATES:
        raise ValueError(
            f"observer has {observer.states} states with its delay: must have at most "
            f"{_MOST_STATES}; take a longer dt"
        )
    n, estimates = observer.order, observer.estimates
    whole = response(observer.model, estimates, n)
    M, g, c, d = f_learned_response(response(without_delay(observer.model), estimates, n))
    # The state: plant, observer, u before, lag filter of f_plain, and its output f_plain^F.
    sizes = (plant.B.size, whole.transition.shape[0], 1, M.shape[0], 1)
    edges = [0, *np.cumsum(sizes).tolist()]
    x, z, before, lag, shown = (slice(*edge) for edge in pairwise(edges))
    y = np.zeros(edges[-1])
    y[x] = plant.C
    seen = np.outer(whole.feedthrough[:, 0], y)
    seen[:, z] += whole.output
    seen[:, before] += whole.feedthrough[:, 1:2]
    f_plain = seen[n]
    u = np.append(observer.cancel - law, -observer.cancel_f) @ seen[: n + 1] / observer.b0
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
    N[shown, lag] += c
    N[shown] += d * f_plain
    q = f_plain.copy()
    q[shown] -= 1.0
    into = -B / observer.b0
    return System(N, into, q, 0.0), System(N, into, y, 0.0)


def state_path(observer: ESO, law: Vector) -> System:
    """Return the path from e_L to w."""
    size = observer.order + 1
    found = scaled_response(observer.model, observer.units, observer.order)
    m = found.transition.shape[0]
    # The state: the shadow, and the estimates that it causes, of which the last is −f_L^F.
    A, B = np.zeros((m + size, m + size)), np.zeros(m + size)
    A[:m, :m], A[m:, :m] = found.transition, found.output
    B[:m], B[m:] = found.input[:, 2], found.feedthrough[:, 2]
    A[:, -1] -= B  # f_L = e_L + f_L^F
    w = np.zeros(m + size)
    w[m:-1] = law - observer.cancel
    N = A - np.eye(m + size)
    # A constant f_L is taken out of f̂ again, and moves nothing else.
    shadow = np.linalg.solve(np.eye(m) - found.transition, found.input[:, 2])
    constant = np.concatenate([shadow, np.zeros(observer.order), [-1.0]])
    return _without_constant(System(N, B, w, observer.cancel_f), constant)


def _without_constant(system: System, constant: Vector) -> System:
    """Return a system without a state v of rest that its output does not show: N v = 0, C v = 0.

    The last entry of the state is removed; the others become those less their share of v.
    """
    N, B, C, D = system
    share = constant[:-1] / constant[-1]
    return System(N[:-1, :-1] - np.outer(share, N[-1, :-1]), B[:-1] - share * B[-1], C[:-1], D)
