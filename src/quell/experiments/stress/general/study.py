"""The whole trial in general loops: random runs and named cases, beside MF-ESO."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

from quell.experiments.stress.general import trial
from quell.experiments.stress.general.loops import loop as loops
from quell.experiments.stress.general.named import run_named
from quell.experiments.stress.general.result import GeneralResult
from quell.experiments.stress.study import check_numbers
from quell.guard import Guard
from quell.parallel import part_of


def run(
    runs: int,
    honest: int,
    seed: int,
    *,
    guard: Guard | None,
    progress: Callable[[float], None] | None = None,
) -> GeneralResult:
    """Run a trial in general loops, with the guard or without (None), and the named cases.

    There are ``runs`` runs with hostile learners and ``honest`` with honest ones, all kinds in
    turn. Seeds below 10 000 are for tuning, from 1 000 000 on for judging. The named cases compare
    with the loop without guard, so they need one. ``progress`` is called with the finished share.
    """
    check_numbers(runs, honest, seed)
    outcomes = trial.run_all(runs, honest, seed, guard=guard, progress=part_of(progress, 0, 9, 10))
    cases = [] if guard is None else run_named(guard, seed)
    if progress is not None:
        progress(1.0)
    settings = {
        "runs": runs,
        "honest": honest,
        "seed": seed,
        "guard": None if guard is None else asdict(guard),
        "learners": {name: repr(learner) for name, learner in trial.HONEST.items()},
        "loops": loops.__doc__,
        "ratios": trial.__doc__,
    }
    return GeneralResult(settings, outcomes, cases)
