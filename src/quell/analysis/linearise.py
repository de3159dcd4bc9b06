"""The linear law that a controller is while no limit holds, in discrete time and exact.

It is not derived but asked for: a controller without limits is a linear map from its state, r and y to its next state and u, so unit
vectors through its own ``control`` give the matrices, whatever the form of its observer. The unit is 2⁻⁶⁰, which is the same to the last
bit for what is linear, and small enough for what is linear for small errors only. Entries of the state that never reach u, or that
nothing reaches (records, filters for learning), are left out.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.analysis.frozen_learner import Frozen, copied, frozen
from quell.controllers.base import control
from quell.controllers.limits import Limits
from quell.controllers.linear.law import LinearLaw
from quell.guard import UnguardedDesign, UnguardedMemory
from quell.learners.base import NoLearnerMemory
from quell.types import Matrix, Vector

_UNIT = 2.0**-60
_FREE = Limits(-math.inf, math.inf, math.inf)


def linear_law(controller: Any, at: Any = None) -> LinearLaw:
    """Return the linear law of a controller, its learner frozen.

    Parameters
    ----------
    controller
        an ``ADRC``, or a linear controller, which has its law already.
    at
        when the learner is frozen: a ``Frozen``, a run or a state of the controller (then at its end); by default as it is now.

    Returns
    -------
    LinearLaw
        without limits it does what the controller does, but for a constant feedforward of the learner and for the first sample, at which an
        ADRC takes the measurement for its state: they agree from ``y = 0`` on.

    Raises
    ------
    ValueError
        for something that has no linear law, or one that changes from sample to sample.
    """
    if hasattr(controller, "law"):
        law: LinearLaw = controller.law
        return law
    if not (hasattr(controller, "observer") and hasattr(controller, "initial_state")):
        raise ValueError(f"controller = {controller!r}: must be an ADRC or a linear controller")
    learner = at if isinstance(at, Frozen) else frozen(controller, at)
    design = controller.parameters._replace(learner=learner, guard=UnguardedDesign(), limits=_FREE)
    nothing = np.zeros(0)
    state = controller.initial_state()._replace(
        learner=NoLearnerMemory(nothing), guard=UnguardedMemory(nothing)
    )
    control(design, state, 0.0, 0.0)
    law = _asked(design, state)
    control(design, state, 0.0, 0.0)
    again = _asked(design, state)
    if not all(
        np.array_equal(np.asarray(one), np.asarray(other))
        for one, other in zip(law, again, strict=True)
    ):
        raise ValueError(
            f"controller = {controller!r}: its law changes from sample to sample, so there is no linear one"
        )
    if not all(np.all(np.isfinite(part)) for part in law):
        raise ValueError(
            f"controller = {controller!r}: the gain b0 + ∂f_L/∂u is zero with this learner, so its law is not finite"
        )
    return law


def closed_loop_matrix(A: Matrix, B: Vector, C: Vector, law: LinearLaw, inner: Matrix) -> Matrix:
    """Return a sampled plant and the law around it, which no limit cuts, as one matrix; the plant's states first.

    ``inner`` is ``law.A + B_u C``, the law with what it wishes applied. A and it are both as they are, or both less the unit matrix.
    """
    return np.block(
        [
            [A + law.D_y * np.outer(B, C), np.outer(B, law.C)],
            [np.outer(law.B_y + law.B_u * law.D_y, C), inner],
        ]
    )


def _asked(design: Any, origin: Any) -> LinearLaw:
    """Return the law around a state ``origin`` that no limit and no flag is about to change."""
    held = [design._replace(limits=Limits(u, u, math.inf)) for u in (0.0, _UNIT)]
    places = [
        (i, where)
        for i, array in enumerate(_arrays(origin))
        for where in np.ndindex(array.shape)
        if array[where] == 0.0
    ]

    def respond(
        design: Any, place: Any = None, r: float = 0.0, y: float = 0.0
    ) -> tuple[Vector, float]:
        state = copied(origin)
        arrays = _arrays(state)
        if place is not None:
            arrays[place[0]][place[1]] = _UNIT
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u = control(design, state, r, y)
        return np.array([arrays[i][where] for i, where in places]) / _UNIT, u / _UNIT

    # What the state becomes is asked with u held at zero, what u would be without a limit.
    A = np.array([respond(held[0], place)[0] for place in places]).T
    C = np.array([respond(design, place)[1] for place in places])
    B_r, D_r = respond(held[0], r=_UNIT)[0], respond(design, r=_UNIT)[1]
    B_y, D_y = respond(held[0], y=_UNIT)[0], respond(design, y=_UNIT)[1]
    B_u = respond(held[1])[0]
    keep = np.flatnonzero(_reached(A.T, C) & _reached(A, np.abs(B_r) + np.abs(B_y) + np.abs(B_u)))
    return LinearLaw(
        np.ascontiguousarray(A[np.ix_(keep, keep)]),
        B_r[keep],
        B_y[keep],
        B_u[keep],
        C[keep],
        D_r,
        D_y,
    )


def _reached(A: Matrix, start: Vector) -> NDArray[np.bool_]:
    """Return which states are ever reached along A from those that ``start`` drives; with A transposed, which ever reach them."""
    found: NDArray[np.bool_] = start != 0.0
    while True:
        more = found | np.any(A[:, found] != 0.0, axis=1)
        if np.array_equal(more, found):
            return found
        found = more


def _arrays(state: Any) -> list[Vector]:
    """Return the arrays of a nested NamedTuple."""
    return (
        [array for value in state for array in _arrays(value)]
        if isinstance(state, tuple)
        else [state]
    )
