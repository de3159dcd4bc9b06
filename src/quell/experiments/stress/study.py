"""The guard's trial: hostile learners and an honest one in random loops, each beside MF-ESO.

Errors are those of y against the response that the loop is designed for, ``(omega_c/(s +
omega_c))^n`` times r, so that they do not contain the lag of the design. The ratio of a run is its
RMS error divided by that of MF-ESO: over the whole run, and over the 60 s of load.

Random loops: two-mass-spring plants, all controlled by one design without tuning.

Masses in [0.5, 2] kg, stiffness in [0.3, 3] N/m, b0 wrong by a factor in [0.6, 1.6], sample times
of 1, 2 and 5 ms, a load on m2 of 0.1 to 1.5 rad/s and 0.1 to 2 N; omega_c = 1 and omega_o = 10
rad/s for all. From rest the output follows sin t for 60 s, then a unit step; the load acts from 90
s on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from quell import checks
from quell.controllers import ADRC
from quell.experiments.common import quantiles
from quell.experiments.stress.adversaries import KINDS, draw_adversary
from quell.files import nonfinite_to_none
from quell.guard import Guard
from quell.learners import Harmonic, Learner
from quell.observers import ESO
from quell.parallel import in_parallel
from quell.plants import LinearPlant, two_mass_spring
from quell.signals import BandLimitedNoise, Sinusoid, Step
from quell.simulation.driver import Scenario
from quell.simulation.simulate import simulate
from quell.types import Vector

STEP_AT, LOAD_AT, END = 60.0, 90.0, 150.0
"""Start of the step and of the load, end of a run [s]: chosen by hand."""
REFERENCE = Sinusoid().until(STEP_AT, then=Step(at=STEP_AT))


@dataclass(frozen=True)
class Loop:
    """One plant with its sample time, its load and the error of the design's b0."""

    m1: float
    m2: float
    k: float
    gain_error: float  #: b0 / b
    dt: float
    omega: float  #: frequency of the load [rad/s]
    amplitude: float  #: amplitude of the load [N]
    seed: int  #: seed of the noise

    @property
    def plant(self) -> LinearPlant:
        """The plant."""
        return two_mass_spring(self.m1, self.m2, self.k)

    @property
    def scenario(self) -> Scenario:
        """Reference, load and noise."""
        return Scenario(
            reference=REFERENCE,
            disturbances=(0.0, Sinusoid(self.amplitude, self.omega, start=LOAD_AT)),
            noise=BandLimitedNoise(power=1e-12, sample_time=0.01),
            duration=END,
            seed=self.seed,
        )

    def controller(self, learner: Learner | None = None, guard: Guard | None = None) -> ADRC:
        """Return the design that all loops share, with a learner and a guard."""
        b0 = self.gain_error * self.k / (self.m1 * self.m2)
        observer = ESO.model_free(order=4, b0=b0, omega_o=10.0, dt=self.dt)
        return ADRC(observer, omega_c=1.0, learner=learner, guard=guard)


def draw_loops(count: int, rng: np.random.Generator) -> list[Loop]:
    """Return ``count`` random loops."""
    return [
        Loop(
            m1=rng.uniform(0.5, 2.0),
            m2=rng.uniform(0.5, 2.0),
            k=rng.uniform(0.3, 3.0),
            gain_error=rng.uniform(0.6, 1.6),
            dt=float(rng.choice([1e-3, 2e-3, 5e-3])),
            omega=rng.uniform(0.1, 1.5),
            amplitude=rng.uniform(0.1, 2.0),
            seed=int(rng.integers(2**31)),
        )
        for _ in range(count)
    ]


HONEST = "honest"
# Start of the "late" part of the load [s]: chosen by hand, learners have learned the load by then.
_LATE_AT = LOAD_AT + 50.0
# A loop that has to hold 1 m counts as unstable beyond this |y| [m].
_LIMIT = 100.0
# Time between recorded samples [s]: a multiple of all sample times.
_RECORD_DT = 0.02
# Chosen by hand: a trial of a million runs takes hours or days.
_MOST_RUNS = 1_000_000


@dataclass(frozen=True)
class Outcome:
    """The result of one run; ratios are NaN if one of the two loops is unstable."""

    kind: str
    loop: Loop
    learner: str
    plain_unstable: bool
    unstable: bool
    ratio: float  #: ratio over the whole run
    load_ratio: float  #: ratio over the 60 s of load
    late_ratio: float  #: ratio from 50 s after the start of the load


@dataclass(frozen=True)
class Result:
    """All runs of a trial."""

    settings: Mapping[str, Any]
    outcomes: Sequence[Outcome]

    def of(self, kind: str) -> list[Outcome]:
        """Return the outcomes of one kind of learner."""
        return [outcome for outcome in self.outcomes if outcome.kind == kind]

    @property
    def hostile(self) -> list[Outcome]:
        """Outcomes of all learners but the honest one."""
        return [outcome for outcome in self.outcomes if outcome.kind != HONEST]

    @property
    def kinds(self) -> list[str]:
        """The kinds of learners in the trial, in order."""
        return list(dict.fromkeys(outcome.kind for outcome in self.outcomes))

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``."""
        worst = sorted(
            self.hostile, key=lambda o: -np.inf if np.isnan(o.load_ratio) else o.load_ratio
        )[-5:][::-1]
        return {
            "settings": dict(self.settings),
            "adversarial": summary(self.hostile),
            "honest": summary(self.of(HONEST)),
            "kinds": {kind: summary(self.of(kind)) for kind in self.kinds if kind != HONEST},
            "worst": [nonfinite_to_none(asdict(outcome)) for outcome in worst],
        }


def summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return counts, and quantiles of the ratios; None for the quantiles of no numbers."""
    lost = [o for o in outcomes if o.unstable and not o.plain_unstable]
    found: dict[str, Any] = {
        "runs": len(outcomes),
        "unstable": sum(o.unstable for o in outcomes),
        "plain_unstable": sum(o.plain_unstable for o in outcomes),
        "unstable_where_plain_is_stable": len(lost),
    }
    for name in ("ratio", "load_ratio", "late_ratio"):
        found[name] = quantiles(getattr(outcome, name) for outcome in outcomes)
    return found


def run(
    runs: int,
    honest: int,
    seed: int,
    *,
    guard: Guard | None,
    learner: Learner | None = None,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Run a trial, with the guard or without (None).

    There are ``runs`` runs with hostile learners, all kinds in turn, and ``honest`` runs with
    ``learner``, ``Harmonic()`` by default. ``progress`` is called with the finished share, 0 to 1.
    """
    check_numbers(runs, honest, seed)
    rng = np.random.default_rng(seed)
    kinds = [KINDS[i % len(KINDS)] for i in range(runs)]
    jobs = [
        partial(run_one, kind, loop, draw_adversary(kind, rng), guard)
        for kind, loop in zip(kinds, draw_loops(runs, rng), strict=True)
    ]
    good = Harmonic() if learner is None else learner
    jobs += [partial(run_one, HONEST, loop, good, guard) for loop in draw_loops(honest, rng)]
    counts = {"runs": runs, "honest": honest, "seed": seed}
    parts = {"guard": None if guard is None else asdict(guard), "learner": repr(good)}
    about = {"loops": __doc__, "ratios": __doc__}
    return Result(counts | parts | about, in_parallel(jobs, progress))


def check_numbers(runs: int, honest: int, seed: int) -> None:
    """Raise a ``ValueError`` unless these are numbers of runs of a trial and its seed."""
    checks.whole("runs", runs, 0, _MOST_RUNS)
    checks.whole("honest", honest, 0, _MOST_RUNS)
    checks.whole("seed", seed, 0)
    if runs + honest == 0:
        raise ValueError("runs = 0, honest = 0: at least one must be positive")


def run_one(kind: str, loop: Loop, learner: Learner, guard: Guard | None) -> Outcome:
    """Run one loop with a learner, and without."""
    plain, learned = errors(loop, None, None), errors(loop, learner, guard)
    ratios = [np.nan] * 3
    if plain is not None and learned is not None:
        ratios = [float(a / b) for a, b in zip(learned, plain, strict=True)]
    return Outcome(kind, loop, repr(learner), plain is None, learned is None, *ratios)


def errors(
    loop: Loop, learner: Learner | None, guard: Guard | None
) -> tuple[float, float, float] | None:
    """Return the RMS errors of the whole run, under load, and late; None if unstable."""
    every, controller = round(_RECORD_DT / loop.dt), loop.controller(learner, guard)
    run = simulate(loop.plant, controller, loop.scenario, record_every=every, limit=_LIMIT)
    if run.diverged:
        return None
    error, end = run["y"] - _ideal(len(run)), END + _RECORD_DT
    windows = (slice(None), run.window(LOAD_AT, end), run.window(_LATE_AT, end))
    whole, load, late = (float(np.sqrt(np.mean(error[window] ** 2))) for window in windows)
    return whole, load, late


@cache
def _ideal(samples: int) -> Vector:
    """Return the response of four poles at −1 rad/s to the scenario's reference."""
    from scipy.signal import lsim

    t = np.arange(samples) * _RECORD_DT
    return np.asarray(lsim(([1.0], [1.0, 4.0, 6.0, 4.0, 1.0]), REFERENCE(t), t)[1])
