"""Scenarios of episodes: one that is fixed, or one that is drawn for each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers.base import Controller
from quell.plants.base import Plant
from quell.simulation.sampled_scenario import SampledScenario
from quell.simulation.scenario import Scenario, check_scenario
from quell.types import Vector

Draw = Callable[[np.random.Generator], Scenario]
# Seeds of the scenarios of episodes are below this: any 31 bits do.
_SEEDS = 2**31


class Episode(NamedTuple):
    """An episode's signals and the plant's initial state."""

    table: NDArray[np.float64]  # r, noise, derivatives of r, w (samples, …)
    x0: Vector


class Episodes:
    """The episodes of an environment.

    Parameters
    ----------
    scenario
        a ``Scenario``, whose noise gets a new seed in each episode, or a function that draws a
        scenario from a ``numpy.random.Generator``.
    plant, controller
        of the loop.
    """

    def __init__(self, scenario: Scenario | Draw, plant: Plant, controller: Controller) -> None:
        if not callable(scenario):
            check_scenario(scenario)
        self._scenario, self._plant, self._controller = scenario, plant, controller
        #: an episode that does not depend on the seed of the environment
        self.example = self._sampled(self._drawn(np.random.default_rng(0)))
        self._shared = None if self._is_random() else self._tabulated(self.example)

    @property
    def are_equal(self) -> bool:
        """True if all episodes have the same signals."""
        return self._shared is not None

    def draw(self, rng: np.random.Generator) -> Episode:
        """Return the next episode."""
        if self._shared is not None:
            return self._shared
        return self._tabulated(self._sampled(self._drawn(rng)))

    def _drawn(self, rng: np.random.Generator) -> Scenario:
        if not callable(self._scenario):
            return replace(self._scenario, seed=int(rng.integers(_SEEDS)))
        drawn = self._scenario(rng)
        check_scenario(drawn, "scenario(rng)")
        return drawn

    def _sampled(self, scenario: Scenario) -> SampledScenario:
        if len(scenario.rest_at):
            raise ValueError(
                f"rest_at = {scenario.rest_at!r}: must be empty, each episode starts from rest"
            )
        found = SampledScenario.of(scenario, self._plant, self._controller, None)
        if found.samples < 2:
            raise ValueError(
                f"duration = {scenario.duration!r} s with dt = {found.dt!r} s: must be at least "
                "one sample"
            )
        example = getattr(self, "example", found)
        if found.samples != example.samples:
            raise ValueError(
                f"scenario(rng) has duration = {scenario.duration!r} s, another one "
                f"{(example.samples - 1) * found.dt:.9g} s: must be the same in all episodes"
            )
        return found

    def _tabulated(self, scenario: SampledScenario) -> Episode:
        whole = scenario.segment(0, scenario.samples)
        parts: list[Any] = [whole.r, whole.noise, whole.derivatives, whole.w]
        return Episode(np.column_stack(parts), scenario.x0)

    def _is_random(self) -> bool:
        """Return whether episodes differ, or may differ."""
        if callable(self._scenario):
            return True
        seeds = (replace(self._scenario, seed=seed) for seed in (0, 1))
        first, second = (each.seeded_signals(self._plant.disturbances) for each in seeds)
        try:
            return bool(first != second)
        except ValueError:  # signals that hold arrays
            return True
