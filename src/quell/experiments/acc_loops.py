"""Linear loops of the benchmark's controllers while no limit holds: poles and margins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers import ADRC
from quell.controllers.linear import LinearLaw
from quell.plants import CubicSpringPlant, LinearPlant
from quell.types import Matrix


class Margins(NamedTuple):
    """Of a stable loop; zero for one that is not."""

    gain: tuple[float, float]
    """Between which factors the plant's gain may lie."""
    phase: float
    """[degrees]."""
    modulus: float
    """Least distance of the loop's frequency response from −1, ``1/max |S|``."""


def law_of(controller: ADRC) -> LinearLaw:
    """Return the law of an ADRC with nothing learned, in the observer's predicted state z⁻.

    ``z = z⁻ + L (y − z⁻_1)``, ``u = −K z + r k_1/b0`` with ``b0 K = (k − a, 1)``, ``z⁻ ⁺ = Φ z + Γ u``.
    """
    design = controller.parameters
    model = design.eso
    K = np.append(design.law - design.cancel, 1.0) / design.b0
    corrected = np.eye(K.size)
    corrected[:, 0] -= model.gain
    seen, fed = (np.eye(K.size), np.zeros(K.size)) if model.predictor else (corrected, model.gain)
    return LinearLaw(
        A=model.transition @ corrected,
        B_r=np.zeros(K.size),
        B_y=model.transition @ model.gain,
        B_u=model.input,
        C=-K @ seen,
        D_r=float(design.law[0] / design.b0),
        D_y=float(-K @ fed),
    )


def closed_loop(plant: LinearPlant, controller: ADRC, gain: float = 1.0) -> Matrix:
    """Return the sampled loop's matrix, the plant's states first, with the plant's gain multiplied by ``gain``."""
    law, sampled = law_of(controller), plant.sampled(controller.dt)
    B = gain * sampled.input
    return np.block(
        [
            [sampled.transition + law.D_y * np.outer(B, sampled.output), np.outer(B, law.C)],
            [np.outer(law.B_y + law.B_u * law.D_y, sampled.output), law.A + np.outer(law.B_u, law.C)],
        ]
    )


def stable(plant: LinearPlant, controller: ADRC, gain: float = 1.0) -> bool:
    """Tell whether all poles of the sampled loop lie inside of the unit circle."""
    return bool(np.max(np.abs(np.linalg.eigvals(closed_loop(plant, controller, gain)))) < 1.0)


def unstable(plants: Sequence[LinearPlant | CubicSpringPlant], controller: ADRC) -> NDArray[np.bool_]:
    """Tell for each plant whether its loop is unstable at rest, where a cubic spring does not show."""
    linear = [plant.linear if isinstance(plant, CubicSpringPlant) else plant for plant in plants]
    loops = np.array([closed_loop(plant, controller) for plant in linear])
    return np.asarray(np.max(np.abs(np.linalg.eigvals(loops)), axis=1) >= 1.0)


def margins(plant: LinearPlant, controller: ADRC) -> Margins:
    """Return the margins of the sampled loop, broken at u."""
    if not stable(plant, controller):
        return Margins((1.0, 1.0), 0.0, 0.0)
    law, sampled = law_of(controller), plant.sampled(controller.dt)
    omega = np.geomspace(1e-3, 0.999 * np.pi / controller.dt, 4000)
    z = np.exp(1j * omega * controller.dt)[:, None]
    A = law.A + np.outer(law.B_u, law.C)
    from_u = np.linalg.solve(z[:, :, None] * np.eye(plant.order) - sampled.transition, sampled.input[:, None])[:, :, 0] @ sampled.output
    from_y = np.linalg.solve(z[:, :, None] * np.eye(A.shape[0]) - A, (law.B_y + law.B_u * law.D_y)[:, None])[:, :, 0] @ law.C + law.D_y
    L = -from_u * from_y
    crossing = np.flatnonzero(np.diff(np.sign(np.abs(L) - 1.0)))
    phase = float(np.degrees(np.min(np.abs(np.angle(-L[crossing]))))) if crossing.size else np.inf
    return Margins((_edge(plant, controller, 0.5), _edge(plant, controller, 2.0)), phase, float(np.min(np.abs(1.0 + L))))


def _edge(plant: LinearPlant, controller: ADRC, factor: float) -> float:
    """Return the gain at which the loop stops to be stable, away from 1 in the direction of ``factor``."""
    inside, outside = 1.0, factor
    while stable(plant, controller, outside):
        inside, outside = outside, outside * factor
        if not 1e-6 < outside < 1e6:
            return outside
    for _ in range(40):
        middle = (inside * outside) ** 0.5
        inside, outside = (middle, outside) if stable(plant, controller, middle) else (inside, middle)
    return inside
