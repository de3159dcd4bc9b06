"""The three design cases of Wie & Bernstein (*J. Guidance, Control, and Dynamics* 15, 1992).

Masses of 1 kg, no actuator lag, u on m1, y = x2:

1. a unit impulse on m2; stable for all 0.5 < k < 2, and settled by 15 s at k = 1;
2. the same, and stable for m1, m2 and k as far from 1 as possible, all at once;
3. a sinusoid of 0.5 rad/s and unknown phase on m2, rejected within 20 s for all 0.5 < k < 2.

The controllers in the first two cases are those of ``acc.controllers``. In the third u has no
limit, as a load of 1 N on m2 needs more than 0.5 N.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from quell.analysis import analyse
from quell.analysis.margins import Margins
from quell.controllers import Controller
from quell.experiments.acc.controllers import DT, OURS, designs
from quell.experiments.acc.criteria import MOST_Y
from quell.experiments.acc.stability import law_before_learning, unstable, unstable_under
from quell.files import nonfinite_to_none
from quell.parallel import in_parallel
from quell.plants import two_mass_spring
from quell.records.trajectory import Trajectory
from quell.signals import Sinusoid
from quell.simulation import Scenario, simulate

STIFFNESSES = np.linspace(0.5, 2.0, 13)
"""Stiffnesses of cases 1 and 3 [N/m]: the problem's range, in steps chosen by hand."""
LOAD = 0.5  # frequency of the load in case 3 [rad/s]
# Phases of the load [rad]: a start with no force, and with the full one.
_PHASES = (0.0, 0.5 * np.pi)
# Duration of the runs [s]: four times those that the problem gives for the impulse and the load.
_IMPULSE_TIME, _LOAD_TIME = 60.0, 80.0


@dataclass(frozen=True)
class CaseResult:
    """Results of a controller in the three cases."""

    margins: Margins  #: margins of the nominal loop
    settled_at: float  #: time after which ``|y| < 0.1`` m, at k = 1 [s]; infinite beyond 60 s
    settled_at_worst: float  #: that time at the worst k [s]
    stable_from: float  #: least k of the interval around k = 1 in which the loop is stable [N/m]
    stable_to: float  #: largest k of that interval
    parameter_bound: float  #: largest p with a stable loop for all m1, m2, k in [1 − p, 1 + p]
    load_peak: float  #: largest ``|y|`` from 20 s on, worst k and phase [m]; infinite if unstable
    load_remains: float  #: largest ``|y|`` over the last period of 80 s [m]

    def to_json(self) -> dict[str, Any]:
        """Return numbers for ``json.dump``; None for infinite ones."""
        plain = asdict(self) | {"margins": self.margins._asdict()}
        return dict(nonfinite_to_none(plain))


def study_cases() -> dict[str, CaseResult]:
    """Return the results of each of our controllers."""
    loaded = designs(DT, most_u=np.inf, load=LOAD)
    return {
        name: _study(controller, loaded[name])
        for name, controller in designs(DT).items()
        if name in OURS
    }


def _study(controller: Controller, loaded: Controller) -> CaseResult:
    impulses = in_parallel([partial(_impulse, controller, k) for k in (1.0, *STIFFNESSES)])
    settled = [_settled_at(run) for run in impulses]
    cases = product(STIFFNESSES, _PHASES)
    loads = in_parallel([partial(_load, loaded, k, phase) for k, phase in cases])
    lost = any(unstable([two_mass_spring(k=k) for k in STIFFNESSES], loaded))
    period = 2.0 * np.pi / LOAD
    return CaseResult(
        margins=analyse(two_mass_spring(), controller).margins,
        settled_at=settled[0],
        settled_at_worst=max(settled[1:]),
        stable_from=_edge(controller, 1.0 / 1.01),
        stable_to=_edge(controller, 1.01),
        parameter_bound=_parameter_bound(controller),
        load_peak=math.inf if lost else max(_peak(run, 20.0) for run in loads),
        load_remains=math.inf if lost else max(_peak(run, _LOAD_TIME - period) for run in loads),
    )


def _impulse(controller: Controller, k: float) -> Trajectory:
    scenario = Scenario(duration=_IMPULSE_TIME, x0=[0.0, 0.0, 0.0, 1.0])
    return simulate(two_mass_spring(k=k), controller, scenario)


def _load(controller: Controller, k: float, phase: float) -> Trajectory:
    scenario = Scenario(duration=_LOAD_TIME, disturbances=(0.0, Sinusoid(1.0, LOAD, phase)))
    return simulate(two_mass_spring(k=k), controller, scenario)


def _settled_at(run: Trajectory) -> float:
    outside = np.flatnonzero(np.abs(run["y"]) > MOST_Y)
    if run.diverged or outside[-1] == len(run) - 1:
        return np.inf
    return float(run.t[outside[-1] + 1])


def _peak(run: Trajectory, start: float) -> float:
    return np.inf if run.diverged else float(np.max(np.abs(run["y"][run.t >= start])))


def _edge(controller: Controller, factor: float) -> float:
    """Return the last stable k on the way from 1 in steps of ``factor``, up to 0.01 or 100 N/m."""
    stiffnesses = factor ** np.arange(math.ceil(math.log(100.0) / abs(math.log(factor))))
    lost = unstable([two_mass_spring(k=k) for k in stiffnesses], controller)
    return float(stiffnesses[max(int(np.argmax(lost)) - 1, 0) if np.any(lost) else -1])


def _parameter_bound(controller: Controller) -> float:
    """Return p, to 0.005, from the corners and middles of the box of m1, m2 and k."""
    law = law_before_learning(controller)
    for step in range(1, 199):
        p = 0.005 * step
        box = (1.0 - p, 1.0, 1.0 + p)
        plants = [two_mass_spring(*corner) for corner in product(box, repeat=3)]
        if any(unstable_under(plants, law, controller.dt)):
            return 0.005 * (step - 1)
    return 0.99
