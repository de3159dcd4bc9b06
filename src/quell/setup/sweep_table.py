"""The table ``[sweep]`` of a setup file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from quell.sweeping.values import Normal, Range

CASE = "case"
"""Name of the parameter that is the case."""


def sweep_table(
    parameters: Mapping[str, Any] | None = None,
    cases: Mapping[str, Mapping[str, Any]] | None = None,
    draws: int = 1,
    sampling: str = "latin-hypercube",
    seed: int = 0,
    metrics: Sequence[str] = ("peak_error", "iae", "control_variation"),
    limits: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Return the arguments of ``quell.sweep`` that a table gives.

    Parameters
    ----------
    parameters
        values by path, such as `"plant.m1"`: `{low = 0.6, high = 1.4}` is drawn, uniformly or with
        `log = true` on a logarithmic scale; with `steps = 5` it is a list of as many values.
        `{mean = 1.0, std = 0.1}` is drawn from a normal distribution. A list has all values, also
        texts and tables.
    cases
        tables of values by path, by the name of the case; all are combined with all else:
        `pid = {controller = {kind = "pid", kp = 2.0}, observer = "none"}`.
    draws
        number of draws; each is combined with all values of all lists.
    sampling
        how ranges are drawn: `latin-hypercube` or `random`.
    seed
        seed of draws and noise.
    metrics
        measures that are stored, in each window of `[[metrics]]`.
    limits
        largest value of some measures; a run with more fails.
    """
    given = _flat(parameters or {})
    if cases is not None:
        if not isinstance(cases, Mapping) or not all(
            isinstance(c, Mapping) for c in cases.values()
        ):
            raise ValueError("cases: must be tables of values by path, by name of the case")
        if not cases:
            raise ValueError("cases is empty: must have at least one case")
        given[CASE] = tuple(cases)
    if not given and draws == 1:
        raise ValueError("parameters: missing; give a value to vary, a case, or several draws")
    options: dict[str, Any] = {"draws": draws, "sampling": sampling, "seed": seed}
    return {
        "parameters": given,
        "cases": cases or {},
        "metrics": metrics,
        "limits": limits or {},
    } | options


def _flat(given: Any, path: str = "") -> dict[str, Any]:
    """Return values by path: ``{"plant": {"m1": …}}`` and ``{"plant.m1": …}`` are the same."""
    if not isinstance(given, Mapping):
        raise ValueError(f"parameters = {given!r:.60}: must be a table of values by path")
    found: dict[str, Any] = {}
    for key, value in given.items():
        where = f"{path}.{key}" if path else str(key)
        kind = next((each for each, needed in _KINDS.items() if _is_of(value, needed)), None)
        if kind is not None:
            try:
                found[where] = kind(**value)
            except (ValueError, TypeError) as error:
                raise ValueError(f"parameters.{where}: {error}") from None
        elif isinstance(value, Mapping):
            found |= _flat(value, where)
        else:
            found[where] = value
    return found


# The keys that tell a distribution from a table of the setup.
_KINDS: Mapping[Any, set[str]] = {Range: {"low", "high"}, Normal: {"mean", "std"}}


def _is_of(value: Any, needed: set[str]) -> bool:
    return isinstance(value, Mapping) and bool(needed & value.keys())
