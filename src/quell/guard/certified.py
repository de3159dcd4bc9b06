"""The bound of a guard that is certified for a set of plants."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from quell.guard.correction import CorrectionGains, correction_gains
from quell.observers.eso import ESO
from quell.plants.linear_part import linear_part
from quell.plants.sampled import SampledPlant, sampled_plant
from quell.types import Vector

# Largest κΓ of a certified guard: no learner can then make q larger than ten times the largest q
# without learner. In random two-mass loops an honest learner loses more with 0.7 (docs/theory).
_LARGEST_PRODUCT = 0.9


def certified_bound(bound: float, plants: Any, observer: ESO, law: Vector) -> float:
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
    """
    largest = bound
    for name, plant in named_plants(plants).items():
        linear, delay = linear_part(plant, observer.dt)
        gains = gains_of(name, sampled_plant(linear, observer.dt, delay), observer, law)
        largest = min(largest, _LARGEST_PRODUCT / gains.error)
    return largest


def gains_of(name: str, plant: SampledPlant, observer: ESO, law: Vector) -> CorrectionGains:
    """Return Γ and Γ_y of the loop of a plant; errors begin with the plant's name."""
    try:
        return correction_gains(plant, observer, law)
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
