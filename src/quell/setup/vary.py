"""A setup with other values: what sweeps and tuning change of a file."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from quell.controllers.base import Controller
from quell.setup.errors import SetupError
from quell.setup.loading import Setup, made

# A path is written as in the messages: plant.m1, scenario.disturbances[1].height.
_STEP = re.compile(r"\.?([^.\[\]]+)|\[(\d+)\]")
_PATH = re.compile(r"[^.\[\]]+(?:\.[^.\[\]]+|\[\d+\])*")


def varied(setup: Setup, changes: Mapping[str, Any]) -> Setup:
    """Return the setup of the same file with other values.

    Parameters
    ----------
    setup
        from ``load``; it is not changed.
    changes
        values by path: ``{"plant.m1": 0.7, "scenario.disturbances[1].height": 2.0}``. A value may
        be whatever the file may have there: a number, a list, a table (a dictionary), or None to
        leave out an optional table.

    Raises
    ------
    SetupError
        if a path is none of the file's keys, or a value does not fit; it names the path.

    Examples
    --------
    >>> from quell.setup import EXAMPLES, load
    >>> setup = load(EXAMPLES / "two_mass.toml")
    >>> lighter = varied(setup, {"plant.m1": 0.7, "learner": None})
    >>> float(setup.plant.B[2, 0]), float(lighter.plant.B[2, 0])
    (1.0, 1.4285714285714286)
    """
    if not isinstance(setup, Setup):
        raise ValueError(f"setup = {setup!r:.80}: must be a Setup, as quell.setup.load returns it")
    return made(setup.file, changed(setup.file, setup.tables(), changes), setup.trust)


def controllers_of(setup: Setup) -> Callable[[Mapping[str, float]], Controller]:
    """Return a function from values by path to the setup's controller with these values.

    It is the ``build`` of ``quell.tuning.simulated.search``, which so varies any numbers of
    observer, controller, learner and guard; it may be sent to other processes.

    Raises
    ------
    SetupError
        as ``varied``, when it is called.

    Examples
    --------
    >>> from quell.setup import EXAMPLES, load
    >>> build = controllers_of(load(EXAMPLES / "two_mass.toml"))
    >>> build({"observer.omega_o": 9.0, "learner.prior": 1.0}).learner.prior
    1.0
    """
    return partial(_controller, setup.file, setup.tables(), trust=setup.trust)


def _controller(
    name: str, tables: Mapping[str, Any], values: Mapping[str, float], trust: bool
) -> Controller:
    return made(name, changed(name, tables, values), trust).controller


def changed(name: str, data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``data``, the content of the file ``name``, with other values at some paths."""
    result: dict[str, Any] = dict(data)
    for path, value in changes.items():
        result = _with(name, result, steps_of(name, path), value, path)
    return result


def steps_of(name: str, path: str) -> list[str | int]:
    """Return the keys and places in lists that a path goes through."""
    if not isinstance(path, str) or not _PATH.fullmatch(path):
        rule = "must be a path of keys, such as plant.m1 or scenario.disturbances[1].height"
        raise SetupError([f"{name}: {path!r}: {rule}"])
    return [key or int(place) for key, place in _STEP.findall(path)]


def _with(name: str, where: Any, steps: list[str | int], value: Any, path: str) -> Any:
    """Return a copy of ``where`` with ``value`` at the end of the steps."""
    if not steps:
        return value
    step, *rest = steps
    if isinstance(step, int):
        if not isinstance(where, list | tuple):
            raise SetupError(
                [f"{name}: {path}: [{step}] is no place in a list here: {where!r:.60}"]
            )
        if step >= len(where):
            raise SetupError(
                [f"{name}: {path}: [{step}] is beyond the list's {len(where)} entries"]
            )
        parts = list(where)
        parts[step] = _with(name, parts[step], rest, value, path)
        return parts
    if isinstance(where, str):  # a text in place of a table is its kind
        where = {"kind": where}
    if where is None:  # a table that the file does not have
        where = {}
    if not isinstance(where, Mapping):
        raise SetupError([f"{name}: {path}: {step} is no key here, but in {where!r:.60}"])
    return {**where, step: _with(name, where.get(step), rest, value, path)}
