"""The check that a controller may take y as counts from an origin that moves."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell import checks
from quell.controllers.base import control
from quell.export import operations
from quell.export.inspection import in_double_precision
from quell.export.translate.values import TranslationError

# Samples of the trial, and the largest change of u that is rounding, relative to the largest u.
_SAMPLES, _ROUNDING = 200, 1e-6


def check_counts(controller: Any, resolution: float) -> None:
    """Check that another origin of y and r does not change a controller.

    The origin is moved in each sample of a trial, in double precision, and u is compared with that
    of the controller whose origin stays.

    Raises
    ------
    TranslationError
        if u changes: for a model with a position in it, such as a spring; for a learner; and for
        controllers whose origin can't be moved.
    """
    checks.positive("resolution", resolution, "y-unit per count")
    controller = in_double_precision(controller)
    design = controller.parameters
    if type(design) not in operations.move_origin.implementations:
        raise TranslationError(
            f"resolution = {resolution!r}: {type(controller).__name__} can't take y as counts; an "
            "ADRC without prefilter can"
        )
    fixed, moved = controller.initial_state(), controller.initial_state()
    random, origin, y = np.random.default_rng(1), 0.0, 0.0
    u = np.empty((_SAMPLES, 2))
    with np.errstate(all="ignore"):
        for k in range(_SAMPLES):
            r = float(np.sin(0.05 * k))
            y += 0.1 * (r - y) + 0.01 * float(random.standard_normal())
            u[k, 0] = control(design, fixed, r, y)
            operations.move_origin(design, moved, y - origin)
            origin = y
            u[k, 1] = control(design, moved, r - y, 0.0)
    same = np.max(np.abs(u[:, 1] - u[:, 0])) <= _ROUNDING * np.max(np.abs(u[:, 0]))
    if design.learns or not same:  # what is learned acts much later than in this trial
        raise TranslationError(
            f"resolution = {resolution!r}: this controller needs the position itself, for a model "
            "with a spring or for a learner; hand over y in its unit (NAME_step)"
        )
