"""The three design cases of Wie & Bernstein (*Benchmark Problems for Robust Control Design*, ACC 1990–92; AIAA J. Guidance 15, 1992).

Masses 1 kg, no actuator lag, u on m1, y = x2:

1. a unit impulse on m2; stable for all 0.5 < k < 2, and settled by 15 s at k = 1;
2. the same, and stable for m1, m2 and k as far from 1 as can be, all at once;
3. a sinusoid of 0.5 rad/s on m2, of unknown amplitude and phase, rejected with 20 s to settle, for all 0.5 < k < 2.

The first two with the controllers of ``acc.controllers`` as they are; in the third u has no limit, as a load of 1 N at m2 asks more than 0.5 N.
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
from quell.experiments.acc.controllers import DT, OURS, designs
from quell.experiments.acc.criteria import MOST_Y
from quell.experiments.acc.loops import unstable
from quell.files import nonfinite_to_none
from quell.parallel import in_parallel
from quell.plants import two_mass_spring
from quell.records.trajectory import Trajectory
from quell.signals import Sinusoid
from quell.simulation import Scenario, simulate

STIFFNESSES = np.linspace(0.5, 2.0, 13)
LOAD = 0.5
"""[rad/s]."""
_PHASES = (0.0, 0.5 * np.pi)
_LOAD_TIME = 80.0


@dataclass(frozen=True)
class CaseResult:
    """What a controller makes of the three cases."""

    margins: Margins
    """Of the nominal loop."""
    settled_at: float
    """When ``|y|`` has come below 0.1 m for good after an impulse on m2, at k = 1 [s]; infinite where it does not within 60 s."""
    settled_at_worst: float
    """The same for the worst k."""
    stable_from: float
    """Least and largest k between which the loop is stable around k = 1 [N/m]."""
    stable_to: float
    parameter_bound: float
    """Largest p such that the loop is stable for every m1, m2, k in [1 − p, 1 + p]."""
    load_peak: float
    """Largest ``|y|`` from 20 s on under a sinusoid of 1 N on m2, for the worst k and phase [m]; infinite where a loop is unstable."""
    load_remains: float
    """The same over the last period of 80 s."""

    def to_json(self) -> dict[str, Any]:
        """Return numbers for ``json.dump``; what is infinite is None."""
        plain = asdict(self) | {"margins": self.margins._asdict()}
        return dict(nonfinite_to_none(plain))


def study_cases() -> dict[str, CaseResult]:
    """Return what each of our controllers makes of the cases."""
    loaded = designs(DT, most_u=np.inf, load=LOAD)
    return {
        name: _study(controller, loaded[name])
        for name, controller in designs(DT).items()
        if name in OURS
    }


def _study(controller: Any, loaded: Any) -> CaseResult:
    impulses = in_parallel([partial(_impulse, controller, k) for k in (1.0, *STIFFNESSES)])
    settled = [_settled_at(run) for run in impulses]
    loads = in_parallel(
        [partial(_load, loaded, k, phase) for k, phase in product(STIFFNESSES, _PHASES)]
    )
    lost = bool(np.any(unstable([two_mass_spring(k=k) for k in STIFFNESSES], loaded)))
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


def _impulse(controller: Any, k: float) -> Trajectory:
    return simulate(
        two_mass_spring(k=k), controller, Scenario(duration=60.0, x0=[0.0, 0.0, 0.0, 1.0])
    )


def _load(controller: Any, k: float, phase: float) -> Trajectory:
    return simulate(
        two_mass_spring(k=k),
        controller,
        Scenario(duration=_LOAD_TIME, disturbances=(0.0, Sinusoid(1.0, LOAD, phase))),
    )


def _settled_at(run: Trajectory) -> float:
    outside = np.flatnonzero(np.abs(run["y"]) > MOST_Y)
    if run.diverged or outside[-1] == len(run) - 1:
        return np.inf
    return float(run.t[outside[-1] + 1])


def _peak(run: Trajectory, start: float) -> float:
    return np.inf if run.diverged else float(np.max(np.abs(run["y"][run.t >= start])))


def _edge(controller: Any, factor: float) -> float:
    """Return the last k, going from 1 in steps of ``factor``, at which the loop is stable; not beyond 0.01 and 100 N/m."""
    stiffnesses = factor ** np.arange(math.ceil(math.log(100.0) / abs(math.log(factor))))
    lost = unstable([two_mass_spring(k=k) for k in stiffnesses], controller)
    return float(stiffnesses[max(int(np.argmax(lost)) - 1, 0) if np.any(lost) else -1])


def _parameter_bound(controller: Any) -> float:
    """Return p to 0.005, looked for on corners and middles of the box of m1, m2 and k."""
    for step in range(1, 199):
        p = 0.005 * step
        box = (1.0 - p, 1.0, 1.0 + p)
        if np.any(
            unstable([two_mass_spring(*corner) for corner in product(box, box, box)], controller)
        ):
            return 0.005 * (step - 1)
    return 0.99
