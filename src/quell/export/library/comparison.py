"""Single precision compared with double, in a scenario."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.prefilters.prefilter import without_prefilters
from quell.export.inspection import in_double_precision
from quell.learners.online.gaussian_process import SINGLE_NOVELTY, GaussianProcess
from quell.plants.base import Plant
from quell.simulation.scenario import Scenario
from quell.simulation.simulate import simulate

# Largest RMS difference of u that is accepted, relative to the RMS of u. Rounding acts on
# u as noise does. One per cent of it is what a 6-bit converter adds, and does not show in y
# (a torsional axis: at 8 % the tracking error moves by 0.0035 %). The delta form stays below 0.2 %
# unless the rounding of y itself, times omega_o^(n+1), is too much for u.
LIMIT = 0.01


class Comparison(NamedTuple):
    """RMS differences in a scenario, relative to the RMS of the signal in double precision.

    Attributes
    ----------
    u, y
        of a run in single precision.
    u_noise, y_noise
        of a run in double precision without measurement noise; None if the scenario has none.
    diverged
        whether the run in single precision diverged, and that in double did not.
    """

    u: float
    y: float
    u_noise: float | None
    y_noise: float | None
    diverged: bool

    def check(self, controller: Any) -> None:
        """Raise a ``ValueError`` if single precision differs too much for ``controller``."""
        if not self.diverged and self.u <= LIMIT:
            return
        what = "diverges" if self.diverged else f"changes u by {100 * self.u:.2g} % RMS"
        raise ValueError(
            f"precision = 'single': {what} in this scenario, and {100 * LIMIT:g} % is the limit; "
            f"{_remedy(controller)}, or double precision would help; accept=True (--accept) "
            "writes it all the same"
        )


def _remedy(controller: Any) -> str:
    """Return what makes rounding smaller: of the learner's points, or else of y."""
    learner = getattr(without_prefilters(in_double_precision(controller)), "learner", None)
    if isinstance(learner, GaussianProcess) and learner.model.novelty < SINGLE_NOVELTY:
        return (
            f"novelty={SINGLE_NOVELTY:g} of GaussianProcess (points so close that the inverse of "
            "their covariance loses its digits are then not stored)"
        )
    return (
        "a lower omega_o, y as a difference of encoder counts (NAME_step_counts, with "
        "resolution=, --resolution)"
    )


def compared(plant: Plant, controller: Any, scenario: Scenario) -> Comparison:
    """Return what single precision changes in a scenario, and what the measurement noise does."""
    controller = in_double_precision(controller)
    double = simulate(plant, controller, scenario)
    single = simulate(plant, controller, scenario, precision="single")
    u_noise = y_noise = None
    if not (isinstance(scenario.noise, int | float) and scenario.noise == 0.0):
        quiet = simulate(plant, controller, replace(scenario, noise=0.0))
        u_noise, y_noise = (_difference(double, quiet, name) for name in ("u", "y"))
    return Comparison(
        _difference(double, single, "u"),
        _difference(double, single, "y"),
        u_noise,
        y_noise,
        single.diverged and not double.diverged,
    )


def _difference(reference: Any, other: Any, name: str) -> float:
    """Return the RMS difference, relative to the RMS of the reference."""
    count = min(len(reference), len(other))
    one, two = reference[name][:count], other[name][:count]
    size, change = (float(np.sqrt(np.mean(np.square(each)))) for each in (one, two - one))
    if change == 0.0:
        return 0.0
    return change / size if size > 0.0 else math.inf
