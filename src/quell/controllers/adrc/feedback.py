"""Han's nonlinear feedback of the errors in place of their weighted sum.

Han ("From PID to active disturbance rejection control", *IEEE Trans. Industrial Electronics* 56,
2009, on the nonlinear feedback combination) replaces ``u_0 = Σ k_i e_i`` with ``e_1 = r − x̂_1``,
``e_2 = r' − x̂_2``, … by::

    u_0 = Σ β_i fal(e_i, α_i, δ_i)
    fal(e, α, δ) = e / δ^(1−α) for |e| ≤ δ,  |e|^α sign e beyond

usually with ``0 < α_1 < 1 < α_2``: for the same u at an error of one, small errors get more,
and large errors less. Here ``β_i = k_i δ_i^(1−α_i)``, so that within ±δ_i the law
is the linear one with all poles at −omega_c, and continuous at ±δ_i; with α = 1 it is linear
everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.kernels.dispatch import generic_with_default
from quell.observers.nonlinear import fal
from quell.types import Vector

# The largest power: with more, a large error demands a u that no actuator has. Chosen by hand.
_LARGEST_POWER = 2.0


class LinearFeedback(NamedTuple):
    """The weighted sum of the errors."""


class FalFeedback(NamedTuple):
    """Parameters of the nonlinear law, for a plant of relative degree m."""

    alpha: Vector  # α (m,)
    delta: Vector  # δ (m,) [y-unit/s^(i−1)]


@generic_with_default
def nonlinear_part(
    feedback: Any, law: Vector, seen: Vector, r: float, reference: Vector, linear: float
) -> float:
    """Return ``linear``, the control law's numerator, with the nonlinear law in place of its sum.

    ``reference`` holds r', r'', …, as far as they are fed forward.
    """
    return linear


@nonlinear_part.register(FalFeedback)
def _fal_part(
    feedback: FalFeedback, law: Vector, seen: Vector, r: float, reference: Vector, linear: float
) -> float:
    total = linear
    for i in range(feedback.alpha.size):
        wished = r if i == 0 else 0.0
        if reference.size > 0 and 0 < i <= reference.size:
            wished = reference[i - 1]
        error, alpha, delta = wished - seen[i], feedback.alpha[i], feedback.delta[i]
        if abs(error) > delta:
            total += law[i] * (delta ** (1.0 - alpha) * fal(error, alpha, delta) - error)
    return total


@dataclass(frozen=True)
class NonlinearFeedback:
    """Han's nonlinear feedback law for ``ADRC(..., feedback=...)``.

    Parameters
    ----------
    alpha
        the powers α_1, α_2, … of the errors of y and its derivatives, above 0 and at most 2, one
        for each derivative up to the plant's relative degree. 1 is linear.
    delta
        error of y up to which the law is linear, δ_1 [y-unit]; that of the i-th derivative is then
        ``δ_1 omega_c^(i−1)``. Or one for each error [y-unit/s^(i−1)].

    Raises
    ------
    ValueError
        for a power or an error out of range.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01)
    >>> han = NonlinearFeedback(alpha=(0.75, 1.25), delta=0.01)
    >>> round(ql.ADRC(observer, omega_c=2.0, feedback=han).step(r=1.0, y=0.0), 4)
    1.2649
    """

    alpha: tuple[float, ...]
    delta: float | tuple[float, ...]

    def __post_init__(self) -> None:
        alpha = checks.positive_vector("alpha", self.alpha)
        if not np.all(alpha <= _LARGEST_POWER):
            raise ValueError(
                f"alpha = {self.alpha!r}: each must be above 0 and at most {_LARGEST_POWER:g}"
            )
        checks.positive_vector("delta", self.delta)

    def design(self, degree: int, omega_c: float) -> FalFeedback:
        """Return the parameters for a plant of relative degree m and a bandwidth [rad/s]."""
        alpha = checks.vector("feedback.alpha", self.alpha, degree)
        if np.ndim(self.delta) == 0:
            delta = checks.positive("feedback.delta", self.delta) * omega_c ** np.arange(degree)
        else:
            delta = checks.vector("feedback.delta", self.delta, degree)
        return FalFeedback(alpha, np.asarray(delta, dtype=np.float64))


def checked_feedback(feedback: Any) -> NonlinearFeedback | None:
    """Return ``feedback`` if it is a nonlinear law or None."""
    if feedback is None or isinstance(feedback, NonlinearFeedback):
        return feedback
    example = "quell.controllers.NonlinearFeedback(alpha=(0.75, 1.25), delta=0.01)"
    raise ValueError(f"feedback = {feedback!r}: must be {example}, or None")


def feedback_design(feedback: NonlinearFeedback | None, degree: int, omega_c: float) -> Any:
    """Return the parameters of the law, also of the linear one."""
    return LinearFeedback() if feedback is None else feedback.design(degree, omega_c)
