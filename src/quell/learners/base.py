"""The contract between a controller and its learner.

A learner is an immutable description (``Kalman(...)``). ``design(observer, omega_c)`` returns its
parameters (a NamedTuple), and ``memory(parameters)`` its whole state (a NamedTuple of arrays). The
functions below are registered for the type of the parameters. In each sample the controller calls

1. ``adapt`` with the newest estimates of the observer, then ``trouble``;
2. ``predict`` for the feedforward ``f_L = constant + slope · u``, which is affine in u so that a
   learner with u among its features is compensated exactly, not one sample late;
3. ``commit`` with the u that was applied.

``restart`` is called when the loop starts from rest, ``forget`` when the learner has lost its
numbers (``recovery.py``), ``coefficients`` when a run is recorded.

A learner whose memory refers to objects outside of its arrays, for example to a Python model, has
three more members: ``external_fields``, the names of the fields that refer to them;
``snapshot(memory)``, which returns copies of the objects by name; and ``recall(memory,
snapshots)``, which replaces the objects by copies of the snapshots, or raises an error if they do
not fit. A controller's ``state`` contains the snapshots in place of these fields.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from quell.described import Described
from quell.kernels import validation
from quell.kernels.dispatch import generic, generic_with_default
from quell.observers.eso import ESO
from quell.types import Vector


class Learner(Protocol):
    """A description of a learner."""

    def design(self, observer: ESO, omega_c: float) -> Any:
        """Return the parameters for an observer and the controller's bandwidth [rad/s]."""

    def memory(self, parameters: Any) -> Any:
        """Return the state before anything is learned (a NamedTuple of arrays)."""

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return the names of the features that θ multiplies, for a plant of order ``order``."""


@generic
def adapt(
    learner: Any, memory: Any, seen: Vector, y: float, u_before: float, f_plain: float
) -> None:
    """Learn from the observer's estimates ``seen = (x̂_1 … x̂_n, Δf̂, Δf̂', …)``.

    They follow from the measurement ``y`` and from the u applied before it. An ESO without a
    learner would have estimated ``f_plain = Δf̂ + f_L^F`` (``lag.py``).
    """
    raise TypeError


@generic
def predict(learner: Any, memory: Any, seen: Vector, u_before: float) -> tuple[float, float]:
    """Return ``(constant, slope)`` of ``f_L = constant + slope · u`` [y-unit/s^n]."""
    raise TypeError


@generic
def commit(learner: Any, memory: Any, seen: Vector, u: float, f_learned: float) -> None:
    """Store the ``u`` that was applied and the ``f_learned`` that the observer is given.

    A guard may have reduced ``f_learned``.
    """
    raise TypeError


@generic
def restart(learner: Any, memory: Any) -> None:
    """Reset the filters; keep what was learned if it is finite, else start from the beginning."""
    raise TypeError


@generic_with_default
def forget(learner: Any, memory: Any) -> None:
    """Return to the state before anything was learned; by default only ``restart``."""
    restart(learner, memory)


@generic
def coefficients(learner: Any, memory: Any, theta: Vector) -> None:
    """Write θ into ``theta`` (p,), in the plant's units: ``f_L = θ · features``."""
    raise TypeError


@generic_with_default
def trouble(learner: Any, memory: Any) -> int:
    """Return the learner's ``Status`` flags for this sample; by default none."""
    return 0


def checked_design(learner: Learner, observer: ESO, omega_c: float) -> Any:
    """Return ``learner.design(observer, omega_c)``; check a user-defined learner first.

    All functions of the contract are called once, interpreted, on a memory that is discarded.
    """
    if not validation.is_user_defined(learner):
        return learner.design(observer, omega_c)
    name, order = type(learner).__name__, observer.order
    what = f"{name}.design(observer, {omega_c:g})"
    rule = "design takes (observer, omega_c)"
    parameters = validation.attempt(what, rule, learner.design, observer, omega_c)
    validation.check_named_tuple(what, parameters, "numbers and arrays")
    validation.check_registered(name, parameters, adapt, predict, commit, restart, coefficients)
    what = f"{name}.memory(...)"
    memory = validation.attempt(what, "memory takes (parameters)", learner.memory, parameters)
    validation.check_arrays(f"{name}.memory", memory, nested=True)
    what = f"{name}.feature_names({order})"
    rule = "feature_names takes the plant's order"
    names = validation.attempt(what, rule, learner.feature_names, order)
    if not isinstance(names, tuple) or not all(isinstance(label, str) for label in names):
        rule = "must return a tuple with a name for each coefficient"
        raise ValueError(f"{what} returns {names!r}: {rule}")

    def call(
        function: Any, *arguments: Any, rule: str = "docs/extend describes its arguments"
    ) -> Any:
        what = f"{name}: {function.__name__}"
        return validation.attempt_kernel(what, rule, function, parameters, memory, *arguments)

    seen = validation.sample_values(order + 1)
    call(adapt, seen, 0.9, 0.5, 0.1)
    predicted = call(predict, seen, 0.5)
    if predicted is not validation.UNKNOWN:
        if not (isinstance(predicted, tuple) and len(predicted) == 2):
            rule = "must return (constant, slope), two numbers"
            raise ValueError(f"{name}: predict returns {predicted!r}: {rule}")
        for label, value in zip(("constant", "slope"), predicted, strict=True):
            validation.check_number(f"{name}: predict, {label},", value)
    call(commit, seen, 0.5, 0.1)
    call(coefficients, np.zeros(len(names)), rule=f"it has {len(names)} names")
    call(restart)
    return parameters


class NoLearner(Described):
    """The absence of a learner: the L-ESO is a plain ESO."""

    def design(self, observer: ESO, omega_c: float) -> NoLearnerDesign:
        """Return no parameters."""
        return NoLearnerDesign()

    def memory(self, parameters: NoLearnerDesign) -> NoLearnerMemory:
        """Return an empty state."""
        return NoLearnerMemory(np.zeros(0))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names."""
        return ()


class NoLearnerDesign(NamedTuple):
    """Parameters of ``NoLearner``: none."""


class NoLearnerMemory(NamedTuple):
    """State of ``NoLearner``."""

    theta: Vector  # (0,)


@adapt.register(NoLearnerDesign)
def _adapt(
    learner: NoLearnerDesign,
    memory: NoLearnerMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    pass


@predict.register(NoLearnerDesign)
def _predict(
    learner: NoLearnerDesign, memory: NoLearnerMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    return 0.0, 0.0


@commit.register(NoLearnerDesign)
def _commit(
    learner: NoLearnerDesign, memory: NoLearnerMemory, seen: Vector, u: float, f_learned: float
) -> None:
    pass


def nothing_to_restart(learner: Any, memory: Any) -> None:
    """Do nothing: ``restart`` of a learner that keeps nothing of a run."""


def no_coefficients(learner: Any, memory: Any, theta: Vector) -> None:
    """Write nothing: ``coefficients`` of a learner without features."""


restart.register(NoLearnerDesign)(nothing_to_restart)
coefficients.register(NoLearnerDesign)(no_coefficients)
