"""Runs of one machine whose signals are in other units: converted to common ones, or refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from quell.quantities import UNKNOWN, AxesSignals, Conversion, Quantity, Signals, in_one_unit
from quell.records.record import columns_of
from quell.records.trajectory import Trajectory

Run = TypeVar("Run", bound=Trajectory)


def runs_in_common_units(
    given: Mapping[str, Run], like: Signals | AxesSignals = UNKNOWN, like_name: str = "the state"
) -> tuple[dict[str, Run], list[str]]:
    """Return runs of the same signals, by their names, in the units of the first that has some.

    References, outputs, control signals, v of several axes, and the estimates of x and f are
    converted. Coefficients of a learner are left out of a run that is converted: their units are
    those of what they multiply.

    Parameters
    ----------
    given
        runs of one y and one u, or all of the same numbers of axes and actuators.
    like
        names and units that come before those of all runs, if they are known.
    like_name
        what has them, for texts.

    Returns
    -------
    tuple
        the runs, and what was converted or assumed.

    Raises
    ------
    ValueError
        for units that do not convert, with the names of columns and units.
    """
    if not given:
        return {}, []
    of_y, of_u = zip(*(_quantities(run) for run in given.values()), strict=True)
    first = next(iter(given.values()))
    axes = first.axis_names or ("",)
    known_y, known_u = _of_signals(like, len(axes), len(of_u[0]))
    notes: list[str] = []

    def common(
        known: Sequence[Quantity], each: Sequence[Sequence[Quantity]], names: Sequence[str]
    ) -> tuple[list[list[Conversion]], list[Quantity]]:
        """Return the conversions of each run, and the common quantities."""
        found: list[list[Conversion]] = [[] for _ in given]
        wanted = []
        for k, name in enumerate(names):
            quantities = dict(zip(given, (one[k] for one in each), strict=True))
            if known and known[k].unit:
                quantities = {like_name: known[k], **quantities}
            into, unit, said = in_one_unit(quantities, name)
            notes.extend(said)
            wanted.append(unit)
            for own, run in zip(found, given, strict=True):
                own.append(into[run])
        return found, wanted

    y_names = [f"y of {axis}," if axis else "y" for axis in axes]
    u_names = [f"u{k + 1}," if len(of_u[0]) > 1 else "u" for k in range(len(of_u[0]))]
    into_y, y = common(known_y, of_y, y_names)
    into_u, u = common(known_u, of_u, u_names)
    found = {}
    for (name, run), own_y, own_u in zip(given.items(), into_y, into_u, strict=True):
        found[name] = _converted(run, own_y, own_u, y, u)
    return found, notes


def _quantities(run: Any) -> tuple[list[Quantity], list[Quantity]]:
    """Return what the y and the u of a run are."""
    widths = [np.atleast_2d(run[name].T).shape[0] for name in ("y", "u")]
    y, u = _of_signals(run.signals, *widths)
    return y or [Quantity()] * widths[0], u or [Quantity()] * widths[1]


def _of_signals(known: Any, outputs: int, inputs: int) -> tuple[list[Quantity], list[Quantity]]:
    """Return the quantities of y and u, an empty list for those that are not known."""
    several = isinstance(known, AxesSignals)
    y, u = ([*known.y], [*known.u]) if several else ([known.y], [known.u])
    return (y if len(y) == outputs else []), (u if len(u) == inputs else [])


def _converted(
    run: Any,
    of_y: Sequence[Conversion],
    of_u: Sequence[Conversion],
    y: Sequence[Quantity],
    u: Sequence[Quantity],
) -> Any:
    """Return a run in other units."""
    if not any(each.changes for each in (*of_y, *of_u)):
        return run
    log = run.log.copy()
    several = run.several
    prefixes = [f"{name}." for name in run.axis_names] if several else [""]
    names = {name for name, _ in run.channels}
    for name in ("r", "y", "y_measured"):
        for k, into in enumerate(of_y):
            at = columns_of(run.channels, name).start + k
            log[:, at] = into.of(log[:, at])
    for name in names & {"u", "u_wished"}:
        for k, into in enumerate(of_u):
            at = columns_of(run.channels, name).start + k
            log[:, at] = into.of(log[:, at])
    for k, (prefix, into) in enumerate(zip(prefixes, of_y, strict=False)):
        if "v" in names:
            log[:, columns_of(run.channels, "v").start + k] *= into.factor
        for name in names & {f"{prefix}{own}" for own in ("x_hat", "f_learned", "f_residual")}:
            columns = columns_of(run.channels, name)
            log[:, columns] *= into.factor
            if name.endswith("x_hat"):
                log[:, columns.start] += into.offset
    kept = [each for each in run.channels if each[0].rpartition(".")[2] != "theta"]
    places = [k for name, _ in kept for k in range(log.shape[1])[columns_of(run.channels, name)]]
    own: dict[str, Any] = {"log": np.ascontiguousarray(log[:, places]), "channels": tuple(kept)}
    if several:
        own |= {"axis_features": ((),) * len(run.axis_names)}
        own |= {"signals": AxesSignals(run.axis_names, tuple(y), tuple(u))}
    else:
        limits = [into.factor * limit + into.offset for into in of_u for limit in run.u_limits]
        own |= {"features": (), "signals": run.signals._replace(y=y[0], u=u[0])}
        own |= {"u_limits": (min(limits), max(limits))}
    return replace(run, **own)
