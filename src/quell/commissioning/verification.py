"""A verifying step: the tuned loop at the rig beside its prediction from the identified model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from quell import checks
from quell.commissioning.experiment import Open
from quell.commissioning.limits import Limits
from quell.controllers.base import Controller
from quell.files import nonfinite_to_none
from quell.identification.friction_plant import simulated_plant
from quell.identification.result import Identified
from quell.identification.validation import nrmse
from quell.realtime.loop.result import RigRun
from quell.realtime.loop.run import run_rig
from quell.realtime.loop.safety import Safety
from quell.records.plotting import given_axes, grid_of_axes, new_figure
from quell.records.trajectory import Trajectory
from quell.signals import Step
from quell.simulation.scenario import Scenario
from quell.simulation.simulate import simulate
from quell.types import Vector

# Share of the run before the step, in which the loop settles. Chosen by hand.
_BEFORE = 0.25
# The step, as a share of y's room, and of the y that u can hold at rest. Chosen by hand.
_STEP, _HELD = 0.4, 0.5


@dataclass(frozen=True, eq=False)
class Verification:
    """A step of the tuned loop, measured and predicted, relative to where y was before it."""

    run: RigRun  #: the measured run
    predicted: Trajectory  #: the simulated one
    height: float  #: of the step [y-unit]
    at: float  #: time of the step [s]
    y: Vector  #: measured y, from the value before the step on (N,)
    u: Vector  #: u, the same (N,)

    @property
    def fit(self) -> float:
        """Fit of the prediction to the measured y from the step on, NRMSE in %."""
        begin = round(self.at / self.predicted.dt)
        size = min(self.y.size, len(self.predicted))
        return nrmse(self.y[begin:size], self.predicted["y"][begin:size])

    def describe(self) -> str:
        """Return how the run ended, and both steps in numbers."""
        rows = [f"verifying step of {self.height:.4g}: {self.run.verdict}"]
        for name, record in (("measured", self.run.trajectory), ("predicted", self.predicted)):
            found = record.metrics(start=self.at)
            settling = found.get("settling_time", math.nan)
            overshoot = 100.0 * found.get("overshoot", math.nan)
            settled = f"settling time {settling:.3g} s" if settling < math.inf else "not settled"
            rows.append(f"{name}: overshoot {overshoot:.1f} %, {settled}")
        return "\n".join([*rows, f"fit of the prediction {self.fit:.1f} %"])

    def to_json(self) -> dict[str, Any]:
        """Return numbers of both steps for JSON."""
        runs = {"measured": self.run.trajectory, "predicted": self.predicted}
        scores = {name: dict(record.metrics(start=self.at)) for name, record in runs.items()}
        about: dict[str, Any] = {"height": self.height, "at": self.at, "fit": self.fit}
        about |= {"completed": self.run.completed, "verdict": self.run.verdict}
        return dict(nonfinite_to_none(about | scores))

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw y and u, measured and predicted, into two axes; return them."""
        make = partial(new_figure, 8.0, 6.0)
        axes = grid_of_axes(given_axes(axes, ax), make, 2, sharex=True)[:, 0]
        t = np.arange(self.y.size) * self.predicted.dt
        reference = np.where(t >= self.at, self.height, 0.0)
        axes[0].plot(t, reference, color="0.6", linewidth=1.0, label="reference")
        signals = self.run.trajectory.signals
        for name, each, value, known in (
            ("y", axes[0], self.y, signals.y),
            ("u", axes[1], self.u, signals.u),
        ):
            each.plot(t, value, label="measured")
            each.plot(self.predicted.t, self.predicted[name], "--", label="predicted")
            each.set_ylabel(f"{known.label(name)}\nfrom its value before the step on")
            each.grid(alpha=0.3)
        axes[0].legend()
        axes[1].set_xlabel("time [s]")
        return axes


def verify(
    open_device: Open,
    controller: Controller,
    model: Identified,
    limits: Limits,
    y_start: float,
    duration: float,
    **options: Any,
) -> Verification:
    """Run a step of the tuned loop at the rig, and simulate the same with the model.

    The reference first stays at ``y_start``, then steps to the side with more room, by a part of
    that room or of what u can hold. The model is simulated without its constant force, relative to
    the state before the step.

    Parameters
    ----------
    open_device
        returns the device.
    controller
        the tuned controller.
    model
        the identified model.
    limits
        of u and y, and the operating point.
    y_start
        where y is [y-unit].
    duration
        of the run [s].
    **options
        of ``run_rig``, and ``safety``, a dictionary of further arguments of ``Safety``.

    Raises
    ------
    ValueError
        for a run that was stopped before the step.
    """
    dt, duration = controller.dt, checks.positive("duration", duration, "s")
    up = limits.y_max - y_start >= y_start - limits.y_min
    room = (limits.y_max - y_start) if up else (y_start - limits.y_min)
    if room <= 0.0:
        raise ValueError(f"y_start = {y_start!r}: must be between y_min and y_max")
    height = _STEP * room
    if model.integrators == 0:
        gain = abs(float(model.num[-1] / model.den[-1]))
        height = min(height, _HELD * gain * limits.u_room)
    height = height if up else -height
    at = round(_BEFORE * duration / dt) * dt
    safety: dict[str, Any] = {"y_min": limits.y_min, "y_max": limits.y_max}
    safety |= limits.of_u | dict(options.pop("safety", {}))
    reference = Step(y_start) + Step(height, at=at)
    given: dict[str, Any] = {"duration": duration, "safety": Safety(**safety), "approach": 0.5 * at}
    given |= options
    run = run_rig(open_device(), controller, reference, **given)
    part = run.trajectory
    before = round(at / dt)
    if len(part) <= before + 1:
        raise ValueError(f"the verifying step was not reached: {run.verdict}")
    scenario = Scenario(reference=Step(height, at=at), duration=(len(part) - 1) * dt)
    predicted = simulate(simulated_plant(model), controller, scenario)
    few = slice(max(before - max(before // 5, 1), 0), before)
    y, u = part["y"] - y_start, part["u"] - float(np.mean(part["u"][few]))
    return Verification(run, predicted, height, at, y, u)
