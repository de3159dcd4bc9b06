"""What a controller knows after a step."""

from __future__ import annotations

import math
from typing import NamedTuple

from quell.guard import Reason
from quell.types import Status, Vector


class Estimate(NamedTuple):
    """What the controller knows after a step."""

    x: Vector
    """(n,): y and its derivatives, less what u and f feed through where the plant has zeros; ``observer.states_of`` maps them back."""
    f: float
    """Total disturbance [y-unit/s^n; with zeros in its way y-unit/s^f_degree]: ``f_learned + f_residual``."""
    f_learned: float
    """The learner's share, f_L."""
    f_residual: float
    """The observer's share, Δf̂."""
    theta: dict[str, float]
    """The learner's coefficients by feature."""
    u: float
    """The control signal applied."""
    status: Status
    """What the step had to report."""
    authority: float = 1.0
    """Share of its output that the guard lets a learner have."""
    error_plain: float = math.nan
    """RMS of what an ESO without learner would have missed of f, as the guard has it [y-unit/s^n]."""
    error_learned: float = math.nan
    """The same had the learner had full authority."""
    reason: Reason = Reason.TRUSTED
    """Why the authority is what it is."""
