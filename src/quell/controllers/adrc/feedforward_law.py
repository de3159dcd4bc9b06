"""The feedforward's part of the control law, sample by sample; see ``feedforward.py``."""

from __future__ import annotations

from typing import Any, NamedTuple

from quell.kernels.dispatch import generic_with_default, kernel
from quell.types import Vector


class ReferenceOnly(NamedTuple):
    """The law with ``r^(n)/b0`` in place of a model's feedforward, or without derivatives."""


class ModelFeedforward(NamedTuple):
    """Parameters of the feedforward by a model, with m derivatives of the reference."""

    control: Vector  # c (m + 1,): u_ff from r, r', …, at the time when u acts
    wish: Vector  # (m + 1,): of r^(n) − D r in the numerator of the law, from r, r', …
    share: Vector  # (m + 1,): f_m from r, r', …
    b0: float
    coulomb: float
    full_speed: float  # |r'| from which Coulomb friction is whole
    constant: float
    lead: float  # time from now until u acts [s]
    lead_acting: float  # the same from the u that the observer receives in this sample


@generic_with_default
def reference_part(feedforward: Any, law: Vector, r: float, reference: Vector) -> float:
    """Return what the numerator of the law takes from the reference and its derivatives."""
    total = law[0] * r
    if reference.size > 0:
        for i in range(1, reference.size):
            total += law[i] * reference[i - 1]
        total += reference[reference.size - 1]
    return total


@reference_part.register(ModelFeedforward)
def _by_model(feedforward: ModelFeedforward, law: Vector, r: float, reference: Vector) -> float:
    total = law[0] * r
    for i in range(1, law.size):
        if i <= reference.size:
            total += law[i] * reference[i - 1]
    control = control_by_model(feedforward, r, reference)
    return total + _series(feedforward.wish, r, reference) + feedforward.b0 * control


@generic_with_default
def known_share(feedforward: Any, r: float, reference: Vector) -> float:
    """Return f_m: the part of f that the model knows for the sample that begins."""
    return 0.0


@known_share.register(ModelFeedforward)
def _share_of_model(feedforward: ModelFeedforward, r: float, reference: Vector) -> float:
    force = _force(feedforward, reference, feedforward.lead_acting)
    return _series(feedforward.share, r, reference) - feedforward.b0 * force


@generic_with_default
def control_by_model(feedforward: Any, r: float, reference: Vector) -> float:
    """Return u_ff."""
    return 0.0


@control_by_model.register(ModelFeedforward)
def _control_by_model(feedforward: ModelFeedforward, r: float, reference: Vector) -> float:
    force = _force(feedforward, reference, feedforward.lead)
    return _series(feedforward.control, r, reference) + force


@generic_with_default
def write_feedforward(feedforward: Any, r: float, reference: Vector, row: Vector) -> int:
    """Write u_ff into ``row`` if there is a model; return how many numbers were written."""
    return 0


@write_feedforward.register(ModelFeedforward)
def _write_control(feedforward: ModelFeedforward, r: float, reference: Vector, row: Vector) -> int:
    row[0] = control_by_model(feedforward, r, reference)
    return 1


@kernel
def _series(coefficients: Vector, r: float, reference: Vector) -> float:
    total = coefficients[0] * r
    for i in range(reference.size):
        total += coefficients[i + 1] * reference[i]
    return total


@kernel
def _force(feedforward: ModelFeedforward, reference: Vector, lead: float) -> float:
    """Return Coulomb friction at the speed after a time ``lead``, and the constant."""
    speed, direction = reference[0], 0.0
    if reference.size > 1:
        speed += lead * reference[1]
    if abs(speed) >= feedforward.full_speed:
        if speed > 0.0:
            direction = 1.0
        elif speed < 0.0:
            direction = -1.0
    else:
        direction = speed / feedforward.full_speed
    return feedforward.coulomb * direction + feedforward.constant


def without_forces(design: Any) -> Any:
    """Return the parameters without friction and constant: what remains is linear."""
    if isinstance(design, ModelFeedforward):
        return design._replace(coulomb=0.0, constant=0.0)
    return design
