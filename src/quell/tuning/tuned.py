"""The result of a tuning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from quell.analysis.loop import LoopAnalysis
from quell.controllers.base import Controller
from quell.tuning.constraints import Constraints
from quell.tuning.requirements import Active


@dataclass(frozen=True, eq=False)
class Design:
    """A structure tuned under the constraints, or why it could not be.

    Attributes
    ----------
    name : str
        name of the structure.
    controller : Controller or None
        the controller; None if ``reason`` says why there is none.
    values : Mapping
        the free parameters by name.
    objective : float
        value of the objective; k_i for load rejection [u-unit/(y-unit s)].
    measures : Mapping
        ``M_s``, ``M_t``, ``M_ks``, ``u_std``, ``k_i``, … over all plants.
    tables : Mapping
        the tables of a setup file that describe the controller.
    reason : str
        why there is no controller; empty otherwise.
    """

    name: str
    controller: Controller | None
    values: Mapping[str, float]
    objective: float
    measures: Mapping[str, float]
    tables: Mapping[str, Mapping[str, Any]]
    active: tuple[Active, ...] = ()
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Tuned:
    """The controller of a structure with the best objective under constraints.

    Attributes
    ----------
    design : Design
        the chosen structure's design.
    designs : Mapping
        all designs by name: the references PI and PID, and the other structures.
    analysis : LoopAnalysis
        ``analyse`` of the first plant with the controller.
    constraints : Constraints
        the bounds.
    """

    design: Design
    designs: Mapping[str, Design]
    analysis: LoopAnalysis
    constraints: Constraints

    @property
    def controller(self) -> Controller:
        """The tuned controller."""
        assert self.design.controller is not None
        return self.design.controller
