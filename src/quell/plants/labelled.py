"""Plants with names and units for their signals."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, TypeVar

from quell.plants.base import check_plant
from quell.quantities import UNKNOWN, Quantity, Signals

P = TypeVar("P")


def labelled(
    plant: P,
    y: str | Quantity = "",
    u: str | Quantity = "",
    w: str | Sequence[str | Quantity] = (),
) -> P:
    """Return a plant whose output, input and disturbances have names and units.

    Plots, tables, files and telemetry of its runs show them. The numbers are the same.

    Parameters
    ----------
    plant
        any plant; it is not changed.
    y, u
        name and unit of output and control signal: ``angle [rad]``; one of both may be left out.
    w
        name and unit of each disturbance.

    Raises
    ------
    ValueError
        for a text that is not like ``name [unit]``, and more names than disturbances.

    Examples
    --------
    >>> import quell as ql
    >>> motor = ql.plants.LinearPlant.of(([50.0], [1.0, 22.0, 40.0, 0.0]))
    >>> motor = ql.plants.labelled(motor, y="angle [rad]", u="voltage [V]")
    >>> str(ql.plants.signals_of(motor).y)
    'angle [rad]'
    """
    check_plant(plant)
    signals = Signals.of(y, u, w)
    count = plant.disturbances  # type: ignore[attr-defined]
    if len(signals.w) > count:
        raise ValueError(f"w has {len(signals.w)} names: the plant has {count} disturbances")
    made = copy.copy(plant)
    object.__setattr__(made, "signals", signals)
    return made


def signals_of(plant: Any) -> Signals:
    """Return names and units of a plant's signals, also behind delays and encoders."""
    while plant is not None:
        found = getattr(plant, "signals", None)
        if isinstance(found, Signals):
            return found
        plant = getattr(plant, "plant", None)
    return UNKNOWN
