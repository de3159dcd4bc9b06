"""The plan of a sweep: the parameters, seed and name of each run."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.sweeping.values import Distribution, as_values, labels, latin_hypercube
from quell.types import Matrix

SAMPLINGS = ("latin-hypercube", "random")
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")
# More runs would need days and a design of gigabytes; it is most likely a mistake. By hand.
_MOST_RUNS = 10**9
# Words of the seed of each draw: 63 bits, so that two of 1e6 draws are equal with probability 5e-8.
_SEEDS_BELOW = 2**63


def name_of(run: int, values: Mapping[str, Any], seed: int) -> str:
    """Return the name of a run from its parameters, numbers or texts."""
    parts = [
        f"{name} = {value}" if isinstance(value, str) else f"{name} = {value:.6g}"
        for name, value in values.items()
    ]
    return f"run {run}: {', '.join([*parts, f'seed {seed}'])}"


class Part(NamedTuple):
    """The runs of a plan from ``first`` to before ``last``."""

    first: int
    last: int
    lists: Mapping[str, tuple[Any, ...]]  # parameters with all their values
    drawn: Mapping[str, NDArray[np.float64]]  # parameters that are drawn (draws,), of this part
    seeds: NDArray[np.int64]  # (draws,)

    @property
    def combinations(self) -> int:
        """Number of runs of each draw."""
        return math.prod(map(len, self.lists.values()))

    def places(self, runs: NDArray[np.int64]) -> tuple[NDArray[np.int64], dict[str, Any]]:
        """Return the draw of some runs within this part, and their places in each list."""
        draws, rest = np.divmod(runs, self.combinations)
        found = {}
        for name, values in reversed([*self.lists.items()]):
            rest, found[name] = np.divmod(rest, len(values))
        return draws - self.first // self.combinations, found

    def values(self, run: int) -> dict[str, Any]:
        """Return the parameters of a run."""
        draw, places = self.places(np.array(run))
        values = {name: column[draw].item() for name, column in self.drawn.items()}
        return values | {name: self.lists[name][int(places[name])] for name in self.lists}

    def seed(self, run: int) -> int:
        """Return the seed of a run."""
        return int(self.seeds[run // self.combinations - self.first // self.combinations])

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return each parameter of all runs: numbers, or places in the list if it has others."""
        draws, places = self.places(np.arange(self.first, self.last))
        columns: dict[str, NDArray[Any]] = {k: v[draws] for k, v in self.drawn.items()}
        for name, values in self.lists.items():
            numbers = labels(values) is None
            columns[name] = np.array(values, np.float64)[places[name]] if numbers else places[name]
        return columns


@dataclass(frozen=True, eq=False)
class Plan:
    """Which runs a sweep consists of.

    Each draw is combined with all values of all lists and of ranges with steps; the last of these
    parameters changes first from run to run. Without a distribution among the parameters, one draw
    is a full grid.

    Parameters
    ----------
    parameters
        values by name: a ``Range``, a ``Normal`` or another distribution with a method ``ppf``
        (``scipy.stats``), a list of values of any type, or a single value.
    draws
        number of draws. Each has a seed of its own, which all its combinations share: controllers
        that are compared get the same noise.
    sampling
        how distributions are drawn: ``latin-hypercube``, which covers each range evenly (McKay,
        Beckman & Conover, *Technometrics* 21, 1979), or ``random``, independently.
    seed
        seed of draws and noise.

    Raises
    ------
    ValueError
        for an argument out of range, and values that are no finite numbers where they are drawn.
    """

    parameters: Mapping[str, Any]
    draws: int = 1
    sampling: str = SAMPLINGS[0]
    seed: int = 0
    _lists: dict[str, tuple[Any, ...]] = field(init=False, repr=False)
    _distributions: dict[str, Distribution] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        checks.whole("draws", self.draws, 1)
        checks.one_of("sampling", self.sampling, SAMPLINGS)
        checks.whole("seed", self.seed, 0)
        given: Any = self.parameters
        if not isinstance(given, Mapping):
            rule = "must be a dictionary of values by name"
            raise ValueError(f"parameters = {given!r:.60}: {rule}")
        found = {name: as_values(name, each) for name, each in given.items()}
        lists = {name: each for name, each in found.items() if isinstance(each, tuple)}
        drawn = {name: each for name, each in found.items() if not isinstance(each, tuple)}
        object.__setattr__(self, "_lists", lists)
        object.__setattr__(self, "_distributions", drawn)
        if self.runs > _MOST_RUNS:
            raise ValueError(
                f"parameters: {self.runs:.3g} runs, draws × all combinations of lists and steps: "
                f"must be at most {_MOST_RUNS:.0e}"
            )

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.draws) * math.prod(map(len, self._lists.values()))

    @property
    def lists(self) -> Mapping[str, tuple[Any, ...]]:
        """All values of the parameters that are not drawn."""
        return self._lists

    @cached_property
    def drawn(self) -> dict[str, NDArray[np.float64]]:
        """Values of the parameters that are drawn (draws,)."""
        shares = self._shares()
        found = {}
        for (name, each), column in zip(self._distributions.items(), shares.T, strict=True):
            values = np.array(each.ppf(column), np.float64)
            if values.shape != column.shape or not np.all(np.isfinite(values)):
                rule = "ppf must return a finite number for each share between 0 and 1"
                raise ValueError(f"parameters[{name!r}] = {each!r}: {rule}")
            found[name] = values
        return found

    @cached_property
    def seeds(self) -> NDArray[np.int64]:
        """Seed of each draw (draws,)."""
        return np.random.default_rng([self.seed, 1]).integers(0, _SEEDS_BELOW, self.draws)

    def part(self, first: int, last: int) -> Part:
        """Return the runs from ``first`` to before ``last``."""
        each = self.runs // self.draws
        draws = slice(first // each, (last - 1) // each + 1)
        drawn = {name: values[draws] for name, values in self.drawn.items()}
        return Part(first, last, self._lists, drawn, self.seeds[draws])

    def values(self, run: int) -> dict[str, Any]:
        """Return the parameters of a run."""
        return self.part(run, run + 1).values(run)

    def describe(self, run: int) -> str:
        """Return the name of a run: its number, its parameters, its seed."""
        part = self.part(run, run + 1)
        places = part.places(np.array(run))[1]
        values = part.values(run)
        for name, each in self._lists.items():
            texts = labels(each)
            values[name] = values[name] if texts is None else texts[int(places[name])]
        return name_of(run, {name: values[name] for name in self.parameters}, part.seed(run))

    def digest(self) -> str:
        """Return a hash of all values and seeds."""
        found = hashlib.sha256(f"{self.runs} {self.seed} {self.draws}".encode())
        for name, column in self.drawn.items():
            found.update(name.encode() + b"\0" + column.tobytes())
        for name, values in self._lists.items():
            # Objects without a text of their own have their address in it.
            found.update(f"{name}\0{_ADDRESS.sub('', repr(values))}\0".encode())
        return found.hexdigest()

    def _shares(self) -> Matrix:
        """Return draws (draws, distributions) from the unit cube, without its faces."""
        rng, size = np.random.default_rng([self.seed, 0]), len(self._distributions)
        random = self.sampling == "random"
        shares = (
            rng.random((self.draws, size)) if random else latin_hypercube(rng, self.draws, size)
        )
        return np.clip(shares, np.finfo(np.float64).tiny, 1.0 - np.finfo(np.float64).epsneg)
