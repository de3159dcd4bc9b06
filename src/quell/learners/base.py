"""What the controller asks of a learner.

A learner is an immutable description (``Kalman(...)``). ``design(observer, omega_c)`` turns it into a NamedTuple of parameters, and
``memory`` of those into a NamedTuple of arrays, its whole state. For the type of the parameters the functions below are registered;
each sample the controller calls, in this order:

1. ``adapt`` with what the observer has just seen;
2. ``predict``, for the feedforward ``f_L = constant + slope · u``: affine in u, so that a learner with u among its features is cancelled
   exactly, not a sample late;
3. ``commit`` with the u that was really applied.

``restart`` is called where the loop starts anew from rest, ``coefficients`` where a run is recorded, ``trouble`` after ``adapt``.

A learner whose memory stands for something outside of it, a Python object say, also has ``external_fields``, the names of the fields that do so,
``snapshot(memory)``, which returns copies of what they stand for by name, and ``recall(memory, snapshots)``, which puts copies of those in
its place or says that they do not fit. The state that a controller shows has the snapshots instead of those fields.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from quell.kernels import validation
from quell.kernels.dispatch import generic
from quell.observers.eso import ESO
from quell.types import Vector


class Learner(Protocol):
    """A description of a learner."""

    def design(self, observer: ESO, omega_c: float) -> Any:
        """Return the parameters (a NamedTuple) for an observer and a controller's bandwidth [rad/s]."""

    def memory(self, parameters: Any) -> Any:
        """Return the state before anything was learned: a NamedTuple of arrays."""

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return what each entry of θ multiplies, for a plant of order ``order``."""


@generic
def adapt(
    learner: Any, memory: Any, seen: Vector, y: float, u_before: float, f_plain: float
) -> None:
    """Learn from ``seen = (x̂_1 … x̂_n, Δf̂)``, the measurement it follows from and the control signal applied before it.

    ``f_plain = Δf̂ + f_L^F`` is what an ESO without learner would have estimated: f, as the observer shows it (``lag.py``).
    """
    raise TypeError


@generic
def predict(learner: Any, memory: Any, seen: Vector, u_before: float) -> tuple[float, float]:
    """Return ``(constant, slope)`` of the feedforward ``f_L = constant + slope · u`` [y-unit/s^n]."""
    raise TypeError


@generic
def commit(learner: Any, memory: Any, seen: Vector, u: float, f_learned: float) -> None:
    """Take note of the ``u`` that was applied and of the ``f_learned`` that the observer is fed, which a guard may have reduced."""
    raise TypeError


@generic
def restart(learner: Any, memory: Any) -> None:
    """Forget what belongs to the moment (filters); keep what was learned, unless it is not finite: then learn from the beginning."""
    raise TypeError


@generic
def coefficients(learner: Any, memory: Any, theta: Vector) -> None:
    """Write θ into ``theta`` (p,), in the plant's units: ``f_L = θ · features``."""
    raise TypeError


@generic
def trouble(learner: Any, memory: Any) -> int:
    """Return the ``Status`` flags that the learner has to add to the step's: none, unless it says otherwise."""
    raise TypeError


@trouble.register(object)
def _no_trouble(learner: Any, memory: Any) -> int:
    return 0


def validated_design(learner: Any, observer: ESO, omega_c: float) -> Any:
    """Return ``learner.design(observer, omega_c)``; a learner of the user's own has to take one sample, interpreted.

    Raises
    ------
    ValueError
        that names the learner's class and the rule, for whatever is wrong.
    """
    if not validation.is_user_defined(learner):
        return learner.design(observer, omega_c)
    name, order = type(learner).__name__, observer.order
    what = f"{name}.design(observer, {omega_c:g})"
    parameters = validation.attempt(
        what, "design takes (observer, omega_c)", learner.design, observer, omega_c
    )
    validation.check_named_tuple(what, parameters, "numbers and arrays")
    validation.check_registered(name, parameters, adapt, predict, commit, restart, coefficients)
    memory = validation.attempt(
        f"{name}.memory(...)", "memory takes (parameters)", learner.memory, parameters
    )
    validation.check_arrays(f"{name}.memory", memory, nested=True)
    names = validation.attempt(
        f"{name}.feature_names({order})",
        "feature_names takes the plant's order",
        learner.feature_names,
        order,
    )
    if not isinstance(names, tuple) or not all(isinstance(label, str) for label in names):
        raise ValueError(
            f"{name}.feature_names({order}) returns {names!r}: must return a tuple with a name for each coefficient"
        )
    seen, rule = validation.sample_values(order + 1), "docs/extend says what it is given"
    validation.attempt_kernel(
        f"{name}: adapt", rule, adapt, parameters, memory, seen, 0.9, 0.5, 0.1
    )
    predicted = validation.attempt_kernel(
        f"{name}: predict", rule, predict, parameters, memory, seen, 0.5
    )
    if predicted is not validation.UNKNOWN:
        if not (isinstance(predicted, tuple) and len(predicted) == 2):
            raise ValueError(
                f"{name}: predict returns {predicted!r}: must return (constant, slope), two numbers"
            )
        for label, value in zip(("constant", "slope"), predicted, strict=True):
            validation.check_number(f"{name}: predict, {label},", value)
    validation.attempt_kernel(f"{name}: commit", rule, commit, parameters, memory, seen, 0.5, 0.1)
    validation.attempt_kernel(
        f"{name}: coefficients",
        f"it has {len(names)} names",
        coefficients,
        parameters,
        memory,
        np.zeros(len(names)),
    )
    validation.attempt_kernel(f"{name}: restart", rule, restart, parameters, memory)
    return parameters


class NoLearner:
    """The learner that has nothing to say: it makes an L-ESO a plain ESO."""

    def design(self, observer: ESO, omega_c: float) -> NoLearnerDesign:
        """Return no parameters."""
        return NoLearnerDesign()

    def memory(self, parameters: NoLearnerDesign) -> NoLearnerMemory:
        """Return a state without content."""
        return NoLearnerMemory(np.zeros(0))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names."""
        return ()


class NoLearnerDesign(NamedTuple):
    """Parameters of ``NoLearner``: none."""


class NoLearnerMemory(NamedTuple):
    """State of ``NoLearner``."""

    theta: Vector
    """(0,)."""


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


@restart.register(NoLearnerDesign)
def _restart(learner: NoLearnerDesign, memory: NoLearnerMemory) -> None:
    pass


@coefficients.register(NoLearnerDesign)
def _coefficients(learner: NoLearnerDesign, memory: NoLearnerMemory, theta: Vector) -> None:
    pass
