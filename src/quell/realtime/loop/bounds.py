"""Default bounds of y, derived from the reference and from what the control signal can do."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quell.controllers import ADRC
from quell.controllers.base import Controller

# Default distance from the reference's range to a bound of y, in units of that range plus the reach
# of u. In 1500 random stable loops with loads of up to 0.9 of u's limit, y left the range by at
# most 6.5 of these units (two seeds of benchmarks/direction.py).
_MARGIN = 10.0
# The same without a known b0, times the largest of 1 and |r|: as the limit of ``simulate``.
_MARGIN_WITHOUT_MODEL = 1e6


def reach(controller: Controller, low: float, high: float) -> float:
    """Return the error at which the law ``k1 e / b0`` alone puts u to its limit [y-unit].

    With all poles at −omega_c it is ``b0 max|u| / omega_c^m``. It is the scale of motions of y that
    are within the power of u: a load that u can hold moves y by a part of it. NaN for a controller
    that is not an ADRC, possibly behind prefilters.
    """
    adrc = inner_adrc(controller)
    if adrc is None:
        return float("nan")
    design = adrc.parameters
    return float(abs(design.b0) * max(abs(low), abs(high)) / design.law[0])


def inner_adrc(controller: Any) -> ADRC | None:
    """Return the ADRC behind all prefilters; None for another controller."""
    while not isinstance(controller, ADRC):
        controller = getattr(controller, "controller", None)
        if controller is None:
            return None
    return controller


def plausible_range(reference: ArrayLike, reach: float) -> tuple[float, float]:
    """Return bounds of y that a good run does not come near to [y-unit].

    ``reference`` are the samples of the reference, and ``reach`` is that of ``reach``. Zero counts
    as a value of the reference because a run usually begins there.
    """
    r = np.append(np.asarray(reference, dtype=float), 0.0)
    low, high = float(np.min(r)), float(np.max(r))
    if np.isfinite(reach):
        margin = _MARGIN * (high - low + reach)
    else:
        margin = _MARGIN_WITHOUT_MODEL * max(1.0, -low, high)
    return low - margin, high + margin
