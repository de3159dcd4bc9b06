"""Bounds on a guarded loop that are proved for any learner.

A guard limits the correction to ``|e_L| ≤ κ e``, where e never exceeds the largest |q| so far. With
the peak-to-peak gains Γ from e_L to q and Γ_y from e_L to y of the loop without learner, by the
small-gain theorem::

    sup |q| ≤ sup |q_0| / (1 − κΓ)  if κΓ < 1,        sup |y − y_0| ≤ Γ_y κ sup |q_0| / (1 − κΓ)

q_0 and y_0 are those of the same loop, loads and noise without learner. docs/certificate has the
proof and its assumptions.

The error q of the plain observer in a record: what certificates are about.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quell import checks
from quell.controllers.adrc import ADRC
from quell.controllers.base import Controller
from quell.controllers.law import LinearFeedback
from quell.controllers.prefilters import without_prefilters
from quell.files import as_json
from quell.guard import Guard, UnguardedDesign
from quell.guard.guard import CorrectionGains, gains_of, named_plants
from quell.learners.base import NoLearner
from quell.observers.design import f_learned_response, response
from quell.observers.forms import state_for, without_delay
from quell.plants.channels import DelayedInputs, EncodedOutputs
from quell.plants.flexible import CubicSpringPlant
from quell.plants.linear import DelayedPlant, EncodedPlant, sampled_plant
from quell.plants.linearise import linear_part
from quell.plants.nonlinear import NonlinearPlant
from quell.records.trajectory import Trajectory
from quell.types import Vector


@dataclass(frozen=True)
class Certificate:
    """Bounds that are proved for a guarded controller and a set of plants, for any learner."""

    kappa: float  #: κ of the guard
    gains: dict[str, CorrectionGains]  #: Γ and Γ_y [s^n], by name of the plant
    excluded: tuple[str, ...] = ()  #: what the bounds do not cover
    condition: str = ""  #: why they do not hold for the controller as it is; empty if they do

    @property
    def worst(self) -> str:
        """Name of the plant with the largest Γ."""
        return max(self.gains, key=lambda name: self.gains[name].error)

    @property
    def gain(self) -> float:
        """Γ, the largest of all plants."""
        return self.gains[self.worst].error

    @property
    def output_gain(self) -> float:
        """Γ_y, the largest of all plants [s^n]."""
        return max(gains.output for gains in self.gains.values())

    @property
    def certified(self) -> bool:
        """Whether κΓ < 1 for all plants."""
        return self.kappa * self.gain < 1.0

    @property
    def largest_kappa(self) -> float:
        """Limit 1/Γ below which κ is certified."""
        return math.inf if self.gain == 0.0 else 1.0 / self.gain

    @property
    def error_factor(self) -> float:
        """Bound on ``sup |q|`` over ``sup |q_0|``, 1/(1 − κΓ); infinite if there is none."""
        return 1.0 / (1.0 - self.kappa * self.gain) if self.certified else math.inf

    @property
    def output_factor(self) -> float:
        """Bound on ``sup |y − y_0|`` over ``sup |q_0|`` [s^n], the largest of all plants."""
        if not self.certified:
            return math.inf
        return max(
            gains.output * self.kappa / (1.0 - self.kappa * gains.error)
            for gains in self.gains.values()
        )

    def error_bound(self, q_0: float) -> float:
        """Return the bound on ``sup |q|`` for ``sup |q_0| = q_0`` [y-unit/s^n]."""
        return checks.non_negative("q_0", q_0) * self.error_factor

    def output_bound(self, q_0: float) -> float:
        """Return the bound on ``sup |y − y_0|`` [y-unit] for ``sup |q_0| = q_0`` [y-unit/s^n]."""
        return checks.non_negative("q_0", q_0) * self.output_factor

    def __str__(self) -> str:
        several = f" (the worst of {len(self.gains)} plants: {self.worst})"
        product = (
            f"κΓ = {self.kappa:.3g} · {self.gain:.3g} = {self.kappa * self.gain:.3g}"
            f"{several * (len(self.gains) > 1)}"
        )
        lines = [f"not certified: {product} must be below 1, so κ below {self.largest_kappa:.3g}"]
        if self.certified:
            lines = [
                f"certified: {product}; κ may be up to {self.largest_kappa:.3g}",
                f"with any learner |q| stays below {self.error_factor:.3g} max |q_0|, "
                f"and |y − y_0| below {self.output_factor:.3g} max |q_0|",
            ]
        if self.condition:
            lines.insert(0, self.condition)
        if self.excluded:
            lines.append(f"not covered: {'; '.join(self.excluded)}")
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries for ``json.dump``; None for what is infinite."""
        bounds = ("certified", "kappa", "gain", "output_gain", "largest_kappa", "error_factor")
        names = (*bounds, "output_factor", "worst", "excluded", "condition")
        return as_json(self, *names, plants=self.gains)


def certify_axis(
    plants: Any,
    controller: Controller,
    *,
    delay: float = 0.0,
    actuator_lag: float = 0.0,
    operating_point: Any = None,
) -> Certificate:
    """Return the certificate of one axis; see ``analysis.certify``."""
    adrc = linear_adrc(controller)
    gains: dict[str, CorrectionGains] = {}
    excluded: list[str] = []
    for name, plant in named_plants(plants).items():
        linear, own_delay = linear_part(plant, adrc.dt, operating_point)
        sampled = sampled_plant(linear, adrc.dt, own_delay + delay, actuator_lag)
        gains[name] = gains_of(
            name, sampled, adrc.observer, adrc.parameters.law, guard_samples(adrc)
        )
        excluded += not_covered(plant, adrc.parameters.limits)
    without = tuple(dict.fromkeys(excluded))
    return Certificate(guard_bound(adrc), gains, without, condition_of({"": adrc}))


def linear_adrc(controller: Controller) -> ADRC:
    """Return the ADRC of a controller that may be certified; ``ValueError`` for another one."""
    controller = without_prefilters(controller)
    if not isinstance(controller, ADRC):
        raise ValueError(f"controller = {controller!r}: must be an ADRC, which may have a guard")
    if not isinstance(controller.parameters.feedback, LinearFeedback):
        raise ValueError(
            f"controller = {controller!r}: its law is nonlinear; "
            "only loops with a linear law can be certified, without feedback="
        )
    return controller


def guard_samples(controller: ADRC) -> int:
    """Return the samples in one of the account of a controller's guard, or of ``Guard()``."""
    design = controller.parameters.guard
    if isinstance(design, UnguardedDesign):
        design = Guard().design(controller.observer)
    return int(design.every)


def guard_bound(controller: ADRC) -> float:
    """Return κ of a controller's guard, or that of ``Guard()``."""
    design = controller.parameters.guard
    return Guard().bound if isinstance(design, UnguardedDesign) else float(design.bound)


def condition_of(axes: Mapping[str, ADRC]) -> str:
    """Return why bounds with ``guard_bound`` are not those of these axes; empty if they are."""
    learning = {
        name: axis for name, axis in axes.items() if not isinstance(axis.learner, NoLearner)
    }
    if not learning:
        return "no learner: nothing to certify; this holds with a learner and guard=Guard()"
    free = [name for name, axis in learning.items() if axis.guard is None]
    if not free:
        return ""
    return f"NOT guarded{': ' * any(free)}{', '.join(free)}: holds with guard=Guard()"


def not_covered(plant: Any, limits: Iterable[ArrayLike]) -> list[str]:
    """Return what of the loop of ``plant``, as the user gave it, is not covered.

    ``limits`` are those of the control signals, of their sizes and of their rates.
    """
    limited = any(np.any(np.isfinite(part)) for part in limits)
    found = ["times when u is limited"] if limited else []
    while isinstance(plant, DelayedPlant | DelayedInputs | EncodedPlant | EncodedOutputs):
        if isinstance(plant, EncodedPlant | EncodedOutputs):
            found.append("the encoder's steps (they count as noise, the same in both loops)")
        plant = plant.plant
    if isinstance(plant, NonlinearPlant | CubicSpringPlant):
        found.append("large motions (the plant is linearised)")
    return found


def observer_error(controller: Controller, run: Trajectory) -> Vector:
    """Return ``q = f_plain − f_plain^F`` (samples,) [y-unit/s^n] of a run, from its y and u alone.

    f_plain is what the observer would estimate without learner. Of a run without learner the
    largest ``|q|`` is the ``q_0`` of a ``Certificate``.

    Parameters
    ----------
    controller
        the ``ADRC`` of the run.
    run
        a run of it from the start, with every sample recorded and no measurement missing.

    Raises
    ------
    ValueError
        for another controller, a nonlinear observer, a record that lacks samples.
    """
    controller = without_prefilters(controller)
    if not isinstance(controller, ADRC):
        raise ValueError(f"controller = {controller!r}: must be an ADRC")
    y, u = run["y_measured"], run["u"]
    if run.every != 1 or not np.all(np.isfinite(y)):
        raise ValueError(
            f"run has every = {run.every!r}: all samples must be recorded, with finite y_measured"
        )
    observer = controller.observer
    n, estimates = observer.order, observer.estimates
    plain = response(observer.model, estimates, n)
    M, g, c, d = f_learned_response(response(without_delay(observer.model), estimates, n))
    z = state_for(observer.model, np.append(y[0], np.zeros(n - 1)), np.zeros(1), 0.0)
    lag, shown, q = np.zeros(M.shape[0]), 0.0, np.zeros(y.size)
    for k in range(1, y.size):
        given = np.array([y[k], u[k - 1], 0.0])
        f_plain = float(plain.output[n] @ z + plain.feedthrough[n] @ given)
        z = plain.transition @ z + plain.input @ given
        q[k] = f_plain - shown
        shown = float(c @ lag + d * f_plain)
        lag = M @ lag + g * f_plain
    return q
