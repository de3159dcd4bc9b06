"""The exact linear law in discrete time that a controller is without limits.

It is measured, not derived: without limits a controller is a linear map from its state, r and y to
its next state and u, so unit vectors through its own ``control`` give the matrices, for any form of
observer. The unit is 2⁻⁶⁰: scaling by it is exact for a linear map, and it is small enough for a
map that is linear for small errors only. State entries that do not reach u, or that nothing reaches
(records, filters for learning), are left out. The next sample must have the same law: from a state
of random numbers it must go where the matrices say.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.analysis.adapting_learner import Adapting, adaptation_memory, adapting
from quell.analysis.frozen_learner import Frozen, copy_state
from quell.controllers.adrc.adrc import ADRC
from quell.controllers.adrc.feedforward_law import without_forces
from quell.controllers.base import Controller, control
from quell.controllers.limits import NO_LIMITS
from quell.controllers.linear.law import LinearLaw
from quell.controllers.stateful import named_arrays
from quell.guard import UnguardedDesign, UnguardedMemory
from quell.learners.base import NoLearnerMemory
from quell.types import Matrix, Vector

_UNIT = 2.0**-60
# Share of its terms by which a prediction may miss: far above rounding errors, far below any change
# of a law that matters. Chosen by hand.
_SAME = 1e-9


def linear_law(controller: Controller, at: Any = None) -> LinearLaw:
    """Return the linear law of a controller, its learner as it adapts at rest.

    It equals the controller without limits, except for what the learner learns in motion, and
    except for a first sample with y ≠ 0, at which an ADRC takes the measurement as its state.
    Raises ``ValueError`` for a controller without a linear law, or with one that changes from
    sample to sample.

    Parameters
    ----------
    controller
        an ``ADRC``, or a linear controller, whose own law is returned.
    at
        instant at which the learner is looked at: an ``Adapting`` or a ``Frozen``, a run or a state
        of the controller (its end); by default the present state.
    """
    if hasattr(controller, "law"):
        given: LinearLaw = controller.law
        return given
    if not isinstance(controller, ADRC):
        raise ValueError(f"controller = {controller!r}: must be an ADRC or a linear controller")
    learner = at if isinstance(at, Frozen | Adapting) else adapting(controller, at)
    design = controller.parameters._replace(learner=learner, guard=UnguardedDesign())
    forward = without_forces(design.feedforward)
    design, nothing = design._replace(limits=NO_LIMITS, feedforward=forward), np.zeros(0)
    nothing_learned: Any = NoLearnerMemory(nothing)
    if isinstance(learner, Adapting):
        nothing_learned = adaptation_memory(learner)
    unguarded = UnguardedMemory(nothing)
    state = controller.initial_state()._replace(learner=nothing_learned, guard=unguarded)
    control(design, state, 0.0, 0.0)
    measured = _measured(_Sample(design, state))
    law = measured.law()
    if not all(np.all(np.isfinite(part)) for part in law):
        raise ValueError(f"controller = {controller!r}: b0 + ∂f_L/∂u is zero with this learner")
    control(design, state, 0.0, 0.0)
    if not measured.predicts(_Sample(design, state)):
        raise ValueError(f"controller = {controller!r}: its law changes from sample to sample")
    return law


class _Sample:
    """One sample of a design from states near ``origin``, where no limit and no flag acts.

    Entries of the origin that are not zero are flags and the like; the others are the state x.
    """

    def __init__(self, design: Any, origin: Any) -> None:
        self._design, self._state = design, copy_state(origin)
        self._origin, self._arrays = named_arrays(origin), named_arrays(self._state)
        self._free = {name: array == 0.0 for name, array in self._origin.items()}
        entries = ((name, at) for name, free in self._free.items() for at in np.argwhere(free))
        self._places = [(name, tuple(at)) for name, at in entries]
        self.size = len(self._places)

    def __call__(
        self, x: Mapping[int, float], r: float = 0.0, y: float = 0.0, u: float | None = None
    ) -> tuple[Vector, float]:
        """Return the next state and u, all in units; limits fix u if it is given."""
        for name, array in self._arrays.items():
            array[...] = self._origin[name]
        for i, value in x.items():
            name, at = self._places[i]
            self._arrays[name][at] = value * _UNIT
        design = self._design
        if u is not None:
            design = design._replace(limits=NO_LIMITS._replace(low=u * _UNIT, high=u * _UNIT))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u = control(design, self._state, r * _UNIT, y * _UNIT)
        moved = np.concatenate([self._arrays[name][free] for name, free in self._free.items()])
        return moved / _UNIT, u / _UNIT


class _Measured(NamedTuple):
    """Matrices of the entries ``at`` of a state, all that r, y and u reach."""

    at: NDArray[np.intp]
    A: Matrix
    B: Matrix  # from r, y and u, in columns
    C: Vector
    D: Vector  # from r, y and u

    def reaching(self) -> NDArray[np.bool_]:
        """Return which entries reach u."""
        found: NDArray[np.bool_] = self.C != 0.0
        while True:
            more = found | np.any(self.A[found] != 0.0, axis=0)
            if np.array_equal(more, found):
                return found
            found = more

    def law(self) -> LinearLaw:
        """Return the law of the entries that reach u."""
        kept = self.reaching()
        A = np.ascontiguousarray(self.A[np.ix_(kept, kept)])
        B_r, B_y, B_u = (np.ascontiguousarray(column) for column in self.B[kept].T)
        return LinearLaw(A, B_r, B_y, B_u, self.C[kept], float(self.D[0]), float(self.D[1]))

    def predicts(self, sample: _Sample) -> bool:
        """Return whether a sample from a state of random numbers goes where the law says."""
        inputs = np.random.default_rng(0).uniform(0.5, 1.0, self.at.size + 3)
        state, (r, y, u) = dict(zip(self.at.tolist(), inputs, strict=False)), inputs[-3:]
        moved, wished = sample(state, r, y, u)[0][self.at], sample(state, r, y)[1]
        kept = self.reaching()
        rows = np.vstack([np.hstack([self.A, self.B])[kept], [*self.C, *self.D]])
        missed = np.abs(np.append(moved[kept], wished) - rows @ inputs)
        return bool(np.all(missed <= _SAME * (np.abs(rows) @ inputs)))


def _measured(sample: _Sample) -> _Measured:
    """Measure one entry after the other, with u fixed at zero, and without limits for u itself."""
    from_r, from_y, from_u = sample({}, r=1.0, u=0.0), sample({}, y=1.0, u=0.0), sample({}, u=1.0)
    D = np.array([sample({}, r=1.0)[1], sample({}, y=1.0)[1], 0.0])
    B = np.array([from_r[0], from_y[0], from_u[0]]).T
    columns: dict[int, Vector] = {}
    new = np.flatnonzero(np.any(B != 0.0, axis=1))
    while new.size:
        columns |= {i: sample({i: 1.0}, u=0.0)[0] for i in new.tolist()}
        reached = np.any([column != 0.0 for column in columns.values()], axis=0)
        new = np.setdiff1d(np.flatnonzero(reached), [*columns])
    at = np.array(sorted(columns), dtype=np.intp)
    A = np.array([columns[i][at] for i in at.tolist()]).reshape(at.size, at.size).T
    C = np.array([sample({i: 1.0})[1] for i in at.tolist()])
    return _Measured(at, A, B[at], C, D)
