"""The model of a record, those that the record does not tell apart from it, plants to tune for.

``quell tune RECORD`` and the studio identify records in this way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from quell.identification import Identified, Measured, identify, not_told_apart
from quell.parallel import part_of
from quell.tuning.identified import identified_plants

# Poles of the model at first: a flexible axis has four.
_ORDER = 4


@dataclass(frozen=True, eq=False)
class RecordModel:
    """The model of a record, and the models that the record does not tell apart from it."""

    model: Identified
    others: tuple[Identified, ...]
    held_out: float | None  #: share of the record that was to be held out; None: by itself

    @property
    def lines(self) -> list[str]:
        """The report; lines that begin with NOT say what the record does not show."""
        model = self.model
        found = model.describe().splitlines()
        if model.held_from == model.y.size and self.held_out is None:
            found.append("nothing is held out: u does not move at the end of the record")
        for other in self.others:
            found.append(f"the record does not tell it from {other!r}, which is tuned for, too")
        return found

    @property
    def refusal(self) -> str:
        """Why no controller should be tuned for the model, and what to do; empty if there is none.

        The reasons are faults of the model, and what the record does not decide.
        """
        return "; ".join([*self.model.faults, *self.model.undecided])

    @cached_property
    def plants(self) -> tuple[list[Any], list[float]]:
        """The plants ``(num, den)`` to tune for, the model first, and their delays [s].

        Raises
        ------
        ValueError
            if there is a ``refusal``, and for direct feedthrough.
        """
        if self.refusal:
            raise ValueError(f"record: no plant to tune for: {self.refusal}")
        return identified_plants(self.model, self.others)


def record_model(
    record: Measured,
    order: int = _ORDER,
    zeros: int = 0,
    *,
    integrators: int | None = None,
    friction: bool | None = None,
    rest: bool | None = None,
    max_delay: float | None = None,
    held_out: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> RecordModel:
    """Identify a record with a first order, and take the structure that the record supports.

    Parameters
    ----------
    record
        of one experiment.
    order, zeros, integrators, rest, held_out
        as for ``identify``; fewer or more poles are taken where the record shows them.
    friction
        whether there is Coulomb friction; None: where it fits better.
    max_delay
        longest delay [s] that is searched; None: as long as the longest one is the best.
    progress
        called with a share of the work that is done; an exception in it ends the work.

    Raises
    ------
    ValueError
        as ``identify``.
    """
    delay = None if max_delay is None else (0.0, max_delay)
    first = identify(
        record.u,
        record.y,
        record.dt,
        order,
        zeros,
        delay=delay,
        integrators=integrators,
        friction=bool(friction),
        rest=rest,
        held_out=held_out,
        signals=record.signals,
        progress=part_of(progress, 0.0, 0.5, 1.0),
    )
    model, *others = not_told_apart(
        first,
        delay,
        integrators=integrators,
        friction=friction,
        progress=part_of(progress, 0.5, 1.0, 1.0),
    )
    return RecordModel(model, tuple(others), held_out)
