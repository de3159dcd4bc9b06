"""The sweep of a setup: the runs that its table ``[sweep]`` describes, of one axis or several."""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping
from functools import cached_property
from typing import Any, get_type_hints

import numpy as np
from pydantic import TypeAdapter, ValidationError

from quell import checks
from quell.files import nonfinite_to_none
from quell.setup.axes import assembled_axes
from quell.setup.description import Description, describe, is_of_axes
from quell.setup.loading import Setup, assembled, changed, steps_of
from quell.setup.registry import CASE
from quell.setup.schema import SetupError, contents_of, immutable
from quell.sweeping.measures import Measure, as_measures
from quell.sweeping.runs import Job, Plan, as_values, check_draws, hash_of

# Tables that a simulated run does not use.
_NOT_USED = ("sweep", "rig", "metrics", "title")
# The same, and other keys that change no run, with what to do where that is not plain.
_NOT_SWEPT: Mapping[str, str] = {
    r"(sweep|rig|metrics|title|tune)\b": "",
    r"plant\.(.+\.)?(uncertain|signals)\b": "",
    r"axis\[\d+\]\.(name|signal)$": "",
    r"axes\.actuators\b": "",
    r"scenario\.seed$": "seed and draws of [sweep] are what seeds the runs; ",
}


def sweep_of(setup: Setup) -> dict[str, Any]:
    """Return the arguments of ``quell.sweep`` for a setup, except the folder.

    Of several axes each measure is taken of each, as ``elbow.rms``; a limit of ``rms`` holds for
    all.

    Raises
    ------
    SetupError
        if the setup has no table ``[sweep]``, plant or scenario, or if a path or value in it is
        none of the setup's.
    """
    for needed in ("plant", "scenario", "sweep"):
        setup.needed(needed)
    table: dict[str, Any] = dict(setup.sweep or {})
    build = Variation(setup.file, setup.tables(), table.pop("cases"), setup.trust)
    swept = {f"cases.{name}": each for name, each in build.cases.items()}
    for where, paths in {**swept, "parameters": table["parameters"]}.items():
        for path in paths:
            _check_used(build, f"sweep.{where}", path)
    for name in build.cases:
        _attempt(build, f"sweep.cases.{name}", {CASE: name})
    for path, given in table["parameters"].items():
        if path != CASE:
            _check_parameter(build, path, given)
    measures = _measures(setup, table.pop("metrics"))
    table["limits"] = _limits(setup.file, table["limits"], measures)
    try:
        as_measures(measures)
        plan = Plan(**{key: table[key] for key in ("parameters", "draws", "sampling", "seed")})
        check_draws(plan, Job(build, measures, (), takes_seed=False))
    except ValueError as error:
        raise SetupError([f"{setup.file}: sweep.{error}"]) from None
    return {"build": build, **table, "metrics": measures}


def _check_used(build: Variation, where: str, path: str) -> None:
    """Raise a ``SetupError`` for a path that changes no run."""
    for pattern, hint in _NOT_SWEPT.items():
        if re.match(pattern, path):
            swept = ", ".join(key for key in build.data if not re.match(r"tune\b", key))
            rule = f"no run uses it; {hint}sweep keys of {swept}, as plant.m1 or learner.prior"
            raise SetupError([f"{build.name}: {where}: {path}: {rule}"])


def _check_parameter(build: Variation, path: str, given: Any) -> None:
    """Check that the setup has a parameter, in all cases."""
    where = "sweep.parameters"
    try:
        values = as_values(path, given)
    except ValueError as error:
        raise SetupError([f"{build.name}: {where}: {error}"]) from None
    value = values[0] if isinstance(values, tuple) else float(values.ppf(np.array([0.5]))[0])
    if not build.cases:
        _attempt(build, where, {path: value})
    lacking: list[SetupError] = []
    having = []
    for case in build.cases:
        try:
            _attempt(build, f"{where}, case {case}", {CASE: case, path: value})
            having.append(case)
        except SetupError as error:
            lacking.append(error)
    if not lacking:
        return
    first = list(lacking[0].mistakes)
    if having:
        first[-1] += (
            f"; {path} fits the case {having[0]}, but a parameter must fit all cases: sweep those "
            "that it fits apart from the others"
        )
    raise SetupError(first)


def _attempt(build: Variation, where: str, values: Mapping[str, Any]) -> None:
    """Build a setup; the place in the table stands in front of its errors."""
    try:
        build(**values)
    except SetupError as error:
        begin = f"{build.name}: "
        lines = [line.removeprefix(begin) for line in error.mistakes]
        raise SetupError([f"{begin}{where}: {line}" for line in lines]) from None


def _measures(setup: Setup, names: Any) -> dict[str, Measure]:
    """Return the measures in each window of a setup; of several windows they are numbered."""
    rests = setup.scenario.rest_at if setup.scenario is not None else ()
    windows = setup.windows or ({"start": float(rests[-1]) if len(rests) else 0.0},)
    if not checks.is_sequence(names):
        raise SetupError([f"{setup.file}: sweep.metrics = {names!r:.60}: must be a list of names"])
    try:
        return {
            f"{axis}.{name}"[not axis :] + ("" if len(windows) == 1 else f"_{i}"): Measure(
                name, **window, axis=axis
            )
            for i, window in enumerate(windows, 1)
            for axis in getattr(setup.controller, "names", ("",))
            for name in names
        }
    except ValueError as error:
        raise SetupError([f"{setup.file}: sweep.{error}"]) from None


def _limits(file: str, limits: Any, measures: Mapping[str, Measure]) -> dict[str, float]:
    """Return the limit of each measure; that of a name holds in all windows."""
    if not isinstance(limits, Mapping):
        raise SetupError([f"{file}: sweep.limits = {limits!r:.60}: must be a table of numbers"])
    found: dict[str, float] = {}
    for name, value in limits.items():
        which = [key for key, each in measures.items() if name in (key, each.name)]
        if not which:
            hint = checks.nearest(name, [*measures])
            raise SetupError([f"{file}: sweep.limits.{name}: is none of the metrics, {hint}"])
        try:
            found |= dict.fromkeys(which, checks.finite(f"sweep.limits.{name}", value))
        except ValueError as error:
            raise SetupError([f"{file}: {error}"]) from None
    return found


class Variation:
    """A function of values by path that returns a setup with these values.

    Parts that are the same as in the last call are not built again.
    """

    def __init__(
        self,
        name: str,
        data: Mapping[str, Any],
        cases: Mapping[str, Mapping[str, Any]],
        trust: bool = False,
    ) -> None:
        self.name, self.cases, self.trust = name, cases, trust
        self.data = {key: value for key, value in data.items() if key not in _NOT_USED}

    def __getstate__(self) -> tuple[Any, ...]:
        return self.name, self.data, self.cases, self.trust

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.name, self.data, self.cases, self.trust = state

    @property
    def identity(self) -> Any:
        """Name and contents of this function, for the folder of a sweep."""
        told = nonfinite_to_none([self.data, self.cases])
        found = {"setup": told[0], "cases": told[1], "hash": hash_of([self.data, self.cases])}
        files = {name: digest for part in told for name, digest in contents_of(part)}
        return {**found, "files": files} if files else found

    def __call__(self, **values: Any) -> Setup:
        """Return the setup; values are by path, and ``case`` is the name of a case."""
        case = values.pop(CASE, None)
        changes = {**({} if case is None else self.cases[case]), **values}
        data = changed(self.name, self.data, changes)
        if is_of_axes(data):
            return assembled_axes(self.name, data, self.trust)
        tables = self._described(data, {str(steps_of(self.name, path)[0]) for path in changes})
        known: dict[str, Any] = self._local.__dict__.setdefault("known", {})
        return assembled(self.name, tables, known, self.trust)

    def _described(self, data: dict[str, Any], keys: set[str]) -> Description:
        """Return the tables of ``data``, of which only some keys were changed."""
        try:
            found = {key: _READERS[key].validate_python(immutable(data[key])) for key in keys}
        except (KeyError, ValidationError):
            return describe(self.name, data)  # which says what is wrong
        return self._base.model_copy(update=found)

    @cached_property
    def _base(self) -> Description:
        return describe(self.name, self.data)

    @cached_property
    def _local(self) -> threading.local:
        return threading.local()


# Readers of the tables of a file by their key; other keys are read with all tables.
_READERS: dict[str, Any] = {
    key: TypeAdapter(kind)
    for key, kind in get_type_hints(Description, include_extras=True).items()
    if key in Description.model_fields and kind not in (float, str)
}
