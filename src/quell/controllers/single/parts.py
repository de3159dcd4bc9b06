"""Parameters and states of controllers in single precision."""

from __future__ import annotations

from functools import singledispatch
from typing import Any

import numpy as np

from quell.controllers.adrc.law import AdrcDesign
from quell.controllers.linear.delta import delta_law
from quell.controllers.linear.linear import LinearDesign
from quell.controllers.prefilters.prefilter import PrefilteredDesign
from quell.kernels.single import in_single
from quell.observers.delta import delta_form


def single_design(design: Any) -> Any:
    """Return a controller's parameters in single precision, designed in double.

    Observers and linear laws are in delta form. Raises ``ValueError`` for what is out of the range
    of single precision, or works in double only.
    """
    return in_single(_in_delta_form(design))


def single_state(design: Any, state: Any) -> Any:
    """Return the state for ``design``, which ``single_design`` returned.

    ``state`` is that of the controller in double precision before the first sample.
    """
    return in_single(_with_carries(design, state))


@singledispatch
def _in_delta_form(design: Any) -> Any:
    return design


@_in_delta_form.register
def _of_adrc(design: AdrcDesign) -> AdrcDesign:
    return design._replace(eso=delta_form(design.eso))


@_in_delta_form.register
def _of_law(design: LinearDesign) -> LinearDesign:
    return design._replace(law=delta_law(design.law))


@_in_delta_form.register
def _of_prefiltered(design: PrefilteredDesign) -> PrefilteredDesign:
    return design._replace(controller=_in_delta_form(design.controller))


def _with_carries(design: Any, state: Any) -> Any:
    """Return the state with room for what the delta form of the observer needs."""
    if isinstance(design, AdrcDesign):
        return state._replace(z=np.zeros(design.eso.states))
    if isinstance(design, PrefilteredDesign):
        return state._replace(controller=_with_carries(design.controller, state.controller))
    return state
