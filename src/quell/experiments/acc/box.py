"""Tuning for the box of uncertain plants: an MF-ESO whose law and observer have poles of their own.

The loop is nonlinear, because u is limited and the spring has a cubic part, and what counts is the
benchmark's criterion; so the ten parameters are found by simulation (``quell.tuning.simulated``),
from the MF-ESO of ``acc.controllers`` on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quell.analysis import analyse
from quell.controllers import Controller
from quell.experiments.acc.controllers import B0, DT, MF, MOST_U, OMEGA_C, OMEGA_O, designs
from quell.experiments.acc.criteria import MOST_Y, judge
from quell.experiments.acc.samples import plant
from quell.experiments.acc.stability import unstable
from quell.experiments.acc.study import records
from quell.plants import two_mass_spring
from quell.tuning import Constraints
from quell.tuning.by_simulation import Build, tune_structure
from quell.tuning.simulated import Mean, Problem, Search
from quell.tuning.structures.base import Model
from quell.tuning.structures.registry import make_structure
from quell.types import Matrix, Vector

# Largest gain from noise in y to u, in units of that of MF-ESO. The benchmark has no noise, and
# without a bound the observer's poles become as fast as the sampling allows. Chosen by hand.
_MOST_NOISE = 10.0
# Weight of the size of |y| beside the failures, and the decades of |y| over 0.1 m in which it
# counts: it ranks candidates with equally many failures. Chosen by hand.
_WEIGHT, _DECADES = 0.03, (-0.3, 0.5)
# Ranges of the search: a factor either way around MF-ESO.
_FACTOR = 6.0
ORDER = 4


def build() -> Build:
    """Return the structure, an ADRC of order 4 with freed poles and ``|p| dt <= 0.5``."""
    # Scales of the bounds only: the nominal plant has b = 1 and |P| = 1 near 1 rad/s.
    scales: dict[str, Any] = {"b": 1.0, "omega": 1.0, "gain": 1.0}
    bounds = Constraints(damping=None)
    loop = Model(None, delay=0.0, dt=DT, sign=1.0, degree=ORDER, constraints=bounds, **scales)
    return Build(make_structure("freed", loop, ORDER), {"u_min": -MOST_U, "u_max": MOST_U})


def start(made: Build) -> dict[str, float]:
    """Return the values with which the structure is the MF-ESO of ``designs``."""
    structure: Any = made.structure
    row = structure.rows_of(B0, np.full(ORDER, -OMEGA_C), np.full(ORDER + 1, -OMEGA_O))
    return dict(zip((p.name for p in structure.parameters), row.tolist(), strict=True))


def scores(controller: Controller, samples: Sequence[Vector]) -> Matrix:
    """Return (1, samples): 1 for a plant with cubic spring that fails, and a share for its |y|."""
    plants = [plant(sample, cubic=True) for sample in samples]
    lost = unstable(plants, controller)
    late, fails = np.full(len(plants), np.inf), np.ones(len(plants))
    kept = np.flatnonzero(~lost).tolist()
    if kept:  # an unstable loop fails, whatever its run shows
        speeds = np.array([1.0 / samples[i][1] for i in kept])
        recorded = records(controller, [plants[i] for i in kept], speeds, workers=1)
        judged = judge(*recorded, lost[kept])
        late[kept], fails[kept] = judged.late_peak, judged.fails
    decades = np.log10(np.maximum(late, 1e-9) / MOST_Y)
    return np.array([fails + _WEIGHT * np.clip(decades, *_DECADES)])


class TooMuchNoise:
    """By how much noise moves u more than allowed, as a logarithm; zero or less if it does not."""

    def __init__(self) -> None:
        self._most = _MOST_NOISE * noise_gain(designs(DT)[MF])

    def __call__(self, controller: Controller) -> float:
        """Return the logarithm of the gain over the largest one; infinite if it is unstable."""
        return float(np.log(noise_gain(controller) / self._most))


def noise_gain(controller: Controller) -> float:
    """Return the RMS of u per RMS of white noise in y, in the nominal loop [N/m]."""
    loop = analyse(two_mass_spring(), controller)
    return loop.noise_to_control if loop.stable else float("inf")


def tune(samples: Matrix, **options: Any) -> tuple[Search, Controller]:
    """Tune for samples (count, 6); ``options`` as for ``quell.tuning.simulated.search``."""
    made = build()
    problem = Problem(list(samples), scores, {"failures": Mean()})
    options = {"factor": _FACTOR, "violation": TooMuchNoise(), **options}
    found = tune_structure(made, problem, start(made), **options)
    best: Mapping[str, float] = found.best.parameters
    return found, made(best)
