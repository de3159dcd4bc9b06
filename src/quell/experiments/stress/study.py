"""The guard's trial: learners that mean no good, and one that does, in random loops, each beside plain MF-ESO on the same seed.

Errors are those of y against what the loop is designed to do, the response of ``(omega_c/(s + omega_c))^n`` to r, so that the design's own
lag hides nothing. A run's ratio is its RMS error over that of MF-ESO: over the whole run, and over the 60 s of load.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from quell import checks
from quell.experiments.stress import adversaries, random_loops
from quell.experiments.stress.random_loops import END, LOAD_AT, Loop
from quell.files import nonfinite_to_none
from quell.guard import Guard
from quell.learners import Harmonic, Learner
from quell.parallel import in_parallel
from quell.simulation.simulate import simulate
from quell.types import Vector

HONEST = "honest"
# From here on "late" counts [s].
LATE_AT = LOAD_AT + 50.0
# Beyond this |y| a loop that has to hold 1 m counts as unstable [m].
LIMIT = 100.0
# Every so many seconds a sample is kept.
_KEEP = 0.02
_MOST_RUNS = 1_000_000


@dataclass(frozen=True)
class Outcome:
    """What came of one run; ratios are NaN where one of the two loops is unstable."""

    kind: str
    loop: Loop
    learner: str
    plain_unstable: bool
    unstable: bool
    ratio: float
    """Over the whole run."""
    load_ratio: float
    """Over the 60 s of load."""
    late_ratio: float
    """From 50 s after the load began."""


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
        """All but the honest ones."""
        return [outcome for outcome in self.outcomes if outcome.kind != HONEST]

    @property
    def kinds(self) -> list[str]:
        """The kinds of learners there are, in order."""
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
    """Return counts, and quantiles of the ratios (None where there are none)."""
    found: dict[str, Any] = {
        "runs": len(outcomes),
        "unstable": sum(o.unstable for o in outcomes),
        "plain_unstable": sum(o.plain_unstable for o in outcomes),
        "unstable_where_plain_is_stable": sum(
            o.unstable and not o.plain_unstable for o in outcomes
        ),
    }
    for name in ("ratio", "load_ratio", "late_ratio"):
        values = np.array([getattr(o, name) for o in outcomes])
        values = values[np.isfinite(values)]
        shares = {"median": 0.5, "p90": 0.9, "p99": 0.99, "max": 1.0}
        found[name] = {
            key: float(np.quantile(values, share)) if values.size else None
            for key, share in shares.items()
        }
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
    """Run a trial.

    Parameters
    ----------
    runs
        how many adversarial runs; all kinds in turn.
    honest
        how many runs with ``learner``.
    seed
        of all that is random.
    guard
        the guard; None to see what happens without.
    learner
        the honest learner, ``Harmonic()`` by default.
    progress
        called with the share that is done.

    Raises
    ------
    ValueError
        for numbers out of range, or where there is nothing to run.
    """
    checks.whole("runs", runs, 0, _MOST_RUNS)
    checks.whole("honest", honest, 0, _MOST_RUNS)
    checks.whole("seed", seed, 0)
    if runs + honest == 0:
        raise ValueError(
            "runs = 0, honest = 0: at least one must be positive, or there is nothing to run"
        )
    rng = np.random.default_rng(seed)
    kinds = [adversaries.KINDS[i % len(adversaries.KINDS)] for i in range(runs)]
    jobs = [
        partial(one, kind, loop, adversaries.draw(kind, rng), guard)
        for kind, loop in zip(kinds, random_loops.draw(runs, rng), strict=True)
    ]
    good = Harmonic() if learner is None else learner
    jobs += [partial(one, HONEST, loop, good, guard) for loop in random_loops.draw(honest, rng)]
    settings = {
        "runs": runs,
        "honest": honest,
        "seed": seed,
        "guard": None if guard is None else asdict(guard),
        "learner": repr(good),
        "loops": random_loops.__doc__,
        "ratios": __doc__,
    }
    return Result(settings, in_parallel(jobs, progress))


def one(kind: str, loop: Loop, learner: Learner, guard: Guard | None) -> Outcome:
    """Run one loop with a learner, and without."""
    plain, learned = errors(loop, None, None), errors(loop, learner, guard)
    ratios = (
        (np.nan,) * 3
        if plain is None or learned is None
        else tuple(float(a / b) for a, b in zip(learned, plain, strict=True))
    )
    return Outcome(kind, loop, repr(learner), plain is None, learned is None, *ratios)


def errors(
    loop: Loop, learner: Learner | None, guard: Guard | None
) -> tuple[float, float, float] | None:
    """Return the RMS errors over the whole run, under load and late; None where the loop is unstable."""
    every = round(_KEEP / loop.dt)
    done = simulate(
        loop.plant, loop.controller(learner, guard), loop.scenario, record_every=every, limit=LIMIT
    )
    if done.diverged:
        return None
    away = done["y"] - _ideal(len(done))
    windows = (slice(None), done.window(LOAD_AT, END + _KEEP), done.window(LATE_AT, END + _KEEP))
    whole, load, late = (float(np.sqrt(np.mean(away[window] ** 2))) for window in windows)
    return whole, load, late


@cache
def _ideal(samples: int) -> Vector:
    """Return the response of four poles at −1 rad/s to the scenario's reference."""
    from scipy.signal import lsim

    t = np.arange(samples) * _KEEP
    reference = random_loops.REFERENCE(t)
    return np.asarray(lsim(([1.0], [1.0, 4.0, 6.0, 4.0, 1.0]), reference, t)[1])
