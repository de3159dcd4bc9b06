"""Families of controllers with free parameters, by name.

May import what ``tuning`` may. Each kind has a file; ``base`` says what a structure is.
"""

from __future__ import annotations

from quell.tuning.structures.base import Model, Parameter, Structure
from quell.tuning.structures.registry import STRUCTURES, make_structure

__all__ = ["STRUCTURES", "Model", "Parameter", "Structure", "make_structure"]
