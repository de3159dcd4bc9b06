"""The guard: how much a learner may say."""

from __future__ import annotations

from typing import Any, NamedTuple

from quell.dispatch import generic
from quell.types import Vector


@generic
def watch(guard: Any, memory: Any, f_plain: float) -> None:
    """Take note of what an ESO without learner would have estimated."""
    raise TypeError


@generic
def permit(guard: Any, memory: Any, f_plain: float, constant: float, slope: float) -> tuple[float, float]:
    """Return what is left of the learner's ``constant + slope · u``."""
    raise TypeError


@generic
def note(guard: Any, memory: Any, u: float, f_learned: float) -> None:
    """Take note of the ``u`` that was applied and of the ``f_learned`` that the observer will be fed."""
    raise TypeError


class UnguardedDesign(NamedTuple):
    """Parameters of no guard: none."""


class UnguardedMemory(NamedTuple):
    """State of no guard."""

    nothing: Vector
    """(0,)."""


@watch.register(UnguardedDesign)
def _watch(guard: UnguardedDesign, memory: UnguardedMemory, f_plain: float) -> None:
    pass


@permit.register(UnguardedDesign)
def _permit(guard: UnguardedDesign, memory: UnguardedMemory, f_plain: float, constant: float, slope: float) -> tuple[float, float]:
    return constant, slope


@note.register(UnguardedDesign)
def _note(guard: UnguardedDesign, memory: UnguardedMemory, u: float, f_learned: float) -> None:
    pass
