"""A controller as a linear law with limits, for simulations that need not run its own kernels.

``linear_form`` is registered for the type of a controller's parameters, where a controller with
them is a linear law except for its limits. What such a law can't represent is left to the
controller's own kernels: measurements and references that are held, hand-over, overflow.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch
from typing import Any, NamedTuple

import numpy as np

from quell.checks import LARGEST_SIGNAL
from quell.controllers.limits import Limits, largest_wish
from quell.controllers.linear.law import LinearLaw
from quell.controllers.linear.linear import LinearDesign
from quell.types import Matrix, Vector


class LinearForm(NamedTuple):
    """A law of m states, with what it needs to start, to end and to be recorded.

    ::

        e        = y − x_1 if the law predicts y as x_1, else e = y
        u_wished = C x + D_r r + D_d (r', r'', …) + D_y e,      u = limited(u_wished)
        x⁺       = A x + B_r r + B_y e + B_u u(k − delay),      x_0 = start y_0

    ``y_0`` is the first measurement; before the first sample u was zero. An observer's law needs e:
    with y and x_1 apart, their rounding errors would be amplified by the observer's gain.
    """

    law: LinearLaw
    predicts: float  # 1 if x_1 is the predicted y, else 0
    derivatives: Vector  # D_d (d,), if the controller feeds them forward
    start: Vector  # (m,)
    delay: int  # samples after which u acts on the law's state
    limits: Limits
    largest_wish: float  # beyond this |u_wished| the controller starts anew
    channels: Mapping[str, Matrix]  # recorded channels as rows (width, m + 1) times (x, e)


@singledispatch
def linear_form(parameters: Any) -> LinearForm | None:
    """Return the linear form of a controller with ``parameters``; None if there is none."""
    return None


@linear_form.register
def _of_linear_controller(design: LinearDesign) -> LinearForm:
    wish = min(largest_wish(design.limits), LARGEST_SIGNAL)
    return LinearForm(design.law, 0.0, np.zeros(0), design.start, 0, design.limits, wish, {})
