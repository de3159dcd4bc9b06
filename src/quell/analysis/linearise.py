"""The exact linear law in discrete time that a controller is without limits.

It is measured, not derived: without limits a controller is a linear map from its state, r and y to
its next state and u, so unit vectors through its own ``control`` give the matrices, for any form of
observer. The unit is 2⁻⁶⁰: scaling by it is exact for a linear map, and it is small enough for a
map that is linear for small errors only. State entries that do not reach u, or that nothing reaches
(records, filters for learning), are left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.analysis.frozen_learner import Frozen, copy_state, frozen
from quell.controllers.adrc.adrc import ADRC
from quell.controllers.base import Controller, control
from quell.controllers.limits import NO_LIMITS
from quell.controllers.linear.law import LinearLaw
from quell.controllers.stateful import named_arrays
from quell.guard import UnguardedDesign, UnguardedMemory
from quell.learners.base import NoLearnerMemory
from quell.types import Matrix, Vector

_UNIT = 2.0**-60


def linear_law(controller: Controller, at: Any = None) -> LinearLaw:
    """Return the linear law of a controller, its learner frozen.

    It equals the controller without limits, except for a constant feedforward of the learner, and
    except for a first sample with y ≠ 0, at which an ADRC takes the measurement as its state.
    Raises ``ValueError`` for a controller without a linear law, or with one that changes from
    sample to sample.

    Parameters
    ----------
    controller
        an ``ADRC``, or a linear controller, whose own law is returned.
    at
        instant at which the learner is frozen: a ``Frozen``, a run or a state of the controller
        (its end); by default the present state.
    """
    if hasattr(controller, "law"):
        given: LinearLaw = controller.law
        return given
    if not isinstance(controller, ADRC):
        raise ValueError(f"controller = {controller!r}: must be an ADRC or a linear controller")
    learner = at if isinstance(at, Frozen) else frozen(controller, at)
    design = controller.parameters._replace(learner=learner, guard=UnguardedDesign())
    design, nothing = design._replace(limits=NO_LIMITS), np.zeros(0)
    nothing_learned, unguarded = NoLearnerMemory(nothing), UnguardedMemory(nothing)
    state = controller.initial_state()._replace(learner=nothing_learned, guard=unguarded)
    control(design, state, 0.0, 0.0)
    law = _measured_law(design, state)
    control(design, state, 0.0, 0.0)
    pairs = zip(law, _measured_law(design, state), strict=True)
    if not all(np.array_equal(np.asarray(one), np.asarray(other)) for one, other in pairs):
        raise ValueError(f"controller = {controller!r}: its law changes from sample to sample")
    if not all(np.all(np.isfinite(part)) for part in law):
        raise ValueError(f"controller = {controller!r}: b0 + ∂f_L/∂u is zero with this learner")
    return law


def _measured_law(design: Any, origin: Any) -> LinearLaw:
    """Return the law around a state ``origin`` that no limit and no flag is about to change."""
    fixed_u = [design._replace(limits=NO_LIMITS._replace(low=u, high=u)) for u in (0.0, _UNIT)]
    # Entries that are not zero are flags and the like, which do not change any more.
    is_zero = {name: array == 0.0 for name, array in named_arrays(origin).items()}
    places = [(name, at) for name, zero in is_zero.items() for at in np.argwhere(zero)]

    def respond(design: Any, place: Any = None, r: float = 0.0, y: float = 0.0) -> Any:
        """Return the next state and u, in units, for one entry of the state, r or y."""
        state = copy_state(origin)
        arrays = named_arrays(state)
        if place is not None:
            arrays[place[0]][tuple(place[1])] = _UNIT
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u = control(design, state, r, y)
        moved = np.concatenate([arrays[name][zero] for name, zero in is_zero.items()])
        return moved / _UNIT, u / _UNIT

    # The next state is measured with u fixed at zero by the limits, u without limits.
    A = np.array([respond(fixed_u[0], place)[0] for place in places]).T
    C = np.array([respond(design, place)[1] for place in places])
    B_r, D_r = respond(fixed_u[0], r=_UNIT)[0], respond(design, r=_UNIT)[1]
    B_y, D_y = respond(fixed_u[0], y=_UNIT)[0], respond(design, y=_UNIT)[1]
    B_u = respond(fixed_u[1])[0]
    keep = np.flatnonzero(_reached(A.T, C) & _reached(A, np.abs(B_r) + np.abs(B_y) + np.abs(B_u)))
    kept_A = np.ascontiguousarray(A[np.ix_(keep, keep)])
    return LinearLaw(kept_A, B_r[keep], B_y[keep], B_u[keep], C[keep], D_r, D_y)


def _reached(A: Matrix, start: Vector) -> NDArray[np.bool_]:
    """Return which states those in ``start`` reach along A; with A transposed, which reach them."""
    found: NDArray[np.bool_] = start != 0.0
    while True:
        more = found | np.any(A[:, found] != 0.0, axis=1)
        if np.array_equal(more, found):
            return found
        found = more
