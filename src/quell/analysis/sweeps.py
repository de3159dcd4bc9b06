"""A loop at several instants of a run, and a design at several bandwidths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from quell import checks
from quell.analysis.adapting_learner import adapting
from quell.analysis.loop import LoopAnalysis, analyse
from quell.controllers.base import Controller
from quell.records.trajectory import Trajectory
from quell.simulation import Scenario, simulate


def loops_over_time(
    plant: Any, controller: Controller, run: Any, times: Any, **options: Any
) -> list[LoopAnalysis]:
    """Analyse the loop with its learner as it was at several instants.

    Each is the loop that would follow if the plant came to rest there (``analyse``). That all of
    them are stable does not prove that the loop with a learner that learns is stable
    (docs/analysis). Raises
    ``ValueError`` as ``frozen`` and ``analyse`` do, for a time outside of the run, and for a
    scenario in which the loop diverges before it.

    Parameters
    ----------
    plant, controller
        as for ``analyse``; with a scenario the plant must be one that can be simulated.
    run
        a ``Trajectory``, whose record holds the learner's coefficients; or the ``Scenario`` of a
        run, which is simulated up to each instant and works for every learner.
    times
        instants [s].
    options
        ``delay``, ``actuator_lag`` and ``operating_point``, as for ``analyse``.
    """
    instants = checks.vector("times", times).tolist()
    if isinstance(run, Trajectory):
        return [
            analyse(plant, controller, at=adapting(controller, run, t), **options) for t in instants
        ]
    if not isinstance(run, Scenario):
        raise ValueError(f"run = {run!r}: must be a Trajectory or a Scenario")
    loops = []
    for t in instants:
        if not 0.0 < t <= run.duration:
            raise ValueError(f"times has {t!r}: must lie within (0, duration = {run.duration!r}] s")
        until = replace(run, duration=t, rest_at=tuple(at for at in run.rest_at if at < t))
        # Only the final state is used.
        record = simulate(plant, controller, until, record_every=10**9)
        if record.diverged:
            raise ValueError(f"times has {t!r}: the loop diverged at {record.ended:.6g} s")
        loops.append(analyse(plant, controller, at=record, **options))
    return loops


def loops_over_omega_o(
    plant: Any, make_controller: Callable[[float], Controller], omegas: Any, **options: Any
) -> list[LoopAnalysis]:
    """Analyse designs with several observer bandwidths.

    Parameters
    ----------
    plant
        as for ``analyse``.
    make_controller
        returns the controller for an omega_o [rad/s].
    omegas
        the bandwidths [rad/s], at least one.
    options
        ``delay``, ``actuator_lag`` and ``operating_point``, as for ``analyse``.

    Raises
    ------
    ValueError
        for a bandwidth that is not greater than zero; as ``analyse``.
    """
    bandwidths = checks.positive_vector("omegas", omegas)
    if bandwidths.size == 0:
        raise ValueError(f"omegas = {omegas!r}: must hold at least one bandwidth")
    return [analyse(plant, make_controller(omega_o), **options) for omega_o in bandwidths.tolist()]
