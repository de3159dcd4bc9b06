"""Verdict on finished runs: whether their integration is poor, or why a run diverged.

A loop that diverges for its own reasons often becomes too fast for its sub-steps at last. So a run
that diverged is repeated with enough sub-steps: only if it does not diverge then, the integration
was the cause. A run whose state is suddenly no number has met a function of the user that is not
defined there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quell.plants.base import measure
from quell.simulation.driver import Loop
from quell.simulation.integration import LARGEST_ERROR, with_substeps
from quell.simulation.sampled_scenario import segment_bounds
from quell.warn import warn


def judge_integration(plant: str, loops: Sequence[Loop]) -> None:
    """Find the cause of divergence, and warn of runs whose integration is poor.

    Afterwards ``Loop.result_status`` has ``POORLY_INTEGRATED`` only where that stands. ``plant`` is
    the plants' name.
    """
    for loop in loops:
        _warn_of_undefined_functions(plant, loop)
        if loop.integration.poor and loop.diverged and _diverges_anyway(loop):
            loop.integration.acquit()
    poor = [loop.integration for loop in loops if loop.integration.poor]
    if not poor:
        return
    worst = max(poor, key=lambda check: check.error)
    runs = f" in {len(poor)} of {len(loops)} runs" if len(loops) > 1 else ""
    remedy = (
        f"give at least substeps = {max(check.enough for check in poor)}, or a lower dt"
        if all(check.enough for check in poor)
        else "it is stiff, or f jumps: make f smoother, or give many more substeps"
    )
    warn(
        f"{plant}: with {worst.model.substeps} sub-steps in a sample a state has an error of "
        f"{100.0 * worst.error:.2g} % of its range in one sample{runs}, more than "
        f"{100.0 * LARGEST_ERROR:g} %: {remedy}"
    )


def _warn_of_undefined_functions(plant: str, loop: Loop) -> None:
    """Warn if a function of the user returned NaN or infinity while y was in its usual range."""
    if not (loop.diverged and loop.integration.needed):
        return
    row, first = loop.last_row, 4 + loop.plant.disturbances
    before = loop.x0 if row is None else row[first : first + loop.x.size]
    usual = loop.ended == 0 if row is None else abs(row[1]) <= loop.scenario.range
    with np.errstate(all="ignore"):
        defined = bool(np.all(np.isfinite([*loop.x, measure(loop.model, loop.x)])))
    if defined or not usual:
        return
    warn(
        f"{plant}: f or output returns a number that is not finite; the run ended at t = "
        f"{loop.ended * loop.scenario.dt:.9g} s. The last recorded state was "
        f"{[float(f'{value:.4g}') for value in before]}: both must be defined wherever the "
        "plant goes"
    )


def _diverges_anyway(loop: Loop) -> bool:
    """Return whether a run that diverged leaves its usual range with enough sub-steps, too."""
    if not loop.integration.enough:
        return True
    scenario = replace(loop.scenario, limit=loop.scenario.range)
    model = with_substeps(loop.model, loop.integration.enough)
    again = Loop(loop.plant, model, loop.controller, scenario, loop.interpret)
    again.integration.needed = False
    samples = loop.ended + 1
    log, every = np.empty((1, loop.width)), samples
    for first, last in segment_bounds(samples, (k for k in scenario.rest_samples if k < samples)):
        again.run(scenario.segment(first, last), log, 0, every)
        if again.diverged:
            return True
    return False
