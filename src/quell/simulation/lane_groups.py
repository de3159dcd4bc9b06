"""Groups of linear runs for the loop over lanes: which runs qualify, and their coefficients.

A run qualifies if its plant is a ``LinearPlant``, delayed or not, and its controller has a linear
form (``controllers/linear/form.py``). Runs of equal sizes form groups of ``LANES``; the lanes that
the last group has too many are zero.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import quell.controllers.adrc.linear_form  # noqa: F401  registers the form of an ADRC
from quell.controllers.adrc.adrc import ADRC
from quell.controllers.base import Controller
from quell.controllers.linear.form import LinearForm, linear_form
from quell.controllers.linear.linear import LinearController
from quell.kernels.lanes import LANES, lane_zeros
from quell.lti.discretize import Stack, zero_order_holds
from quell.plants.base import Plant
from quell.plants.delay import DelayedPlant
from quell.plants.linear import LinearPlant
from quell.simulation.lanes import Lanes, Rows
from quell.simulation.sampled_scenario import SampledScenario
from quell.types import Matrix

# A form begins from rest. A subclass of these controllers may begin otherwise.
_FROM_REST = (ADRC.initial_state, LinearController.initial_state)


class LinearRun(NamedTuple):
    """A run that qualifies."""

    place: int  # in the batch
    plant: LinearPlant
    delay: int  # samples after which u reaches the plant
    form: LinearForm
    scenario: SampledScenario
    signals: int  # equal for scenarios of equal signals

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of x, w, p and v, and of samples of the delays to plant and law."""
        states, inputs = self.form.start.size, 1 + len(self.scenario.derivatives)
        plant = self.plant
        return plant.order, plant.disturbances, states, inputs, self.delay, self.form.delay


class Group(NamedTuple):
    """Runs that share the lanes of a loop."""

    runs: Sequence[LinearRun]
    lanes: Lanes
    x0: Matrix  # initial state of the plants, with their delayed u (…, LANES)
    channels: NDArray[np.int64]  # row of ``lanes.values`` for each row of the log


def linear_runs(
    plants: Sequence[Plant], controllers: Sequence[Controller], scenarios: Sequence[SampledScenario]
) -> list[LinearRun]:
    """Return the runs that qualify."""
    distinct = {id(controller): controller for controller in controllers}
    forms = {
        key: linear_form(each.parameters) if type(each).initial_state in _FROM_REST else None
        for key, each in distinct.items()
    }
    numbers: dict[Hashable, int] = {}
    keys = {
        key: numbers.setdefault(_signals_key(scenario), len(numbers))
        for key, scenario in {id(scenario): scenario for scenario in scenarios}.items()
    }
    found = []
    for i, plant in enumerate(plants):
        form, scenario, delay = forms[id(controllers[i])], scenarios[i], 0
        # A delay that was made for another sample time is left to the plant's own check.
        # One with a part of a sample takes two steps in each: it is run by the exact loop, too.
        while isinstance(plant, DelayedPlant) and plant.dt == scenario.dt and plant.late == 0.0:
            delay, plant = delay + plant.samples, plant.plant
        if form is not None and type(plant) is LinearPlant:
            found.append(LinearRun(i, plant, delay, form, scenario, keys[id(scenario)]))
    return found


def _signals_key(scenario: SampledScenario) -> Hashable:
    signals = scenario.signals, scenario.derivatives
    try:
        hash(signals)
    except TypeError:  # a signal that holds an array
        return id(scenario)
    return signals


def groups_of(runs: Sequence[LinearRun], recorded: Sequence[tuple[str, int]]) -> Iterator[Group]:
    """Return groups of runs of equal sizes; runs whose plant can't be sampled are left out.

    ``recorded`` has the channel and the place in it of each row of the log.
    """
    alike: dict[tuple[int, ...], list[LinearRun]] = {}
    for run in runs:
        alike.setdefault(run.sizes, []).append(run)
    for (n, w, p, v, *delays), members in alike.items():
        estimates = [(name, j) for name, j in recorded if name in members[0].form.channels]
        rows = Rows(
            *accumulate((0, p, 1, v, 1, n, w, 1, 1, 1, 1, 1, 1, 1, len(estimates), *delays))
        )
        channels = np.array([_row(rows, n, estimates, *channel) for channel in recorded])
        plant, output = _plant_matrices(members)
        finite = np.flatnonzero(np.all(np.isfinite(plant), axis=(1, 2)))
        members = [members[i] for i in finite]
        parts = [plant[finite], output[finite], *_law_matrices(members, v, estimates)]
        parts.append(np.array([run.scenario.x0 for run in members]))
        for g, (*coefficients, x0) in enumerate(zip(*map(_over_lanes, parts), strict=True)):
            some = members[g * LANES : (g + 1) * LANES]
            lanes = _lanes(rows, coefficients)
            lanes.ended[: len(some)] = -1
            yield Group(some, lanes, x0, channels)


def _row(rows: Rows, n: int, estimates: list[tuple[str, int]], name: str, j: int) -> int:
    """Return the row that entry j of a channel is in."""
    if name == "x":
        return rows.x + j if j < n else rows.plant_delay + j - n
    if (name, j) in estimates:
        return rows.estimates + estimates.index((name, j))
    return int(getattr(rows, {"r": "v"}.get(name, name))) + j


def _plant_matrices(runs: Sequence[LinearRun]) -> tuple[Stack, Stack]:
    """Return the matrices from (x, w, u) to x⁺ and from x to y; equal plants are sampled once."""
    distinct = {id(run.plant): run.plant for run in runs}
    place = {key: i for i, key in enumerate(distinct)}
    A, B, C, E = (
        np.array([getattr(plant, name) for plant in distinct.values()]) for name in "ABCE"
    )
    # B before E, as a plant alone is sampled: its Φ and Γ then have the same bits.
    with np.errstate(over="ignore", invalid="ignore"):
        phi, gamma = zero_order_holds(A, np.concatenate([B, E], axis=2), runs[0].scenario.dt)
    plant = np.concatenate([phi, gamma[:, :, 1:], gamma[:, :, :1]], axis=2)
    which = [place[id(run.plant)] for run in runs]
    return plant[which], C[which]


def _law_matrices(
    runs: Sequence[LinearRun], inputs: int, estimates: Sequence[tuple[str, int]]
) -> list[Stack]:
    """Return the coefficients of the laws and the limits, in the order of ``_lanes``."""
    distinct = {id(run.form): run.form for run in runs}
    place = {key: i for i, key in enumerate(distinct)}
    stacks: list[list[Matrix]] = [[], [], [], [], []]
    for form in distinct.values():
        law, limits = form.law, form.limits
        from_r = np.zeros((law.C.size, inputs))
        from_r[:, 0] = law.B_r
        wish = [*law.C, law.D_y, law.D_r, *form.derivatives[: inputs - 1]]
        shown = [form.channels[name][j] for name, j in estimates]
        stacks[0].append(np.array([wish]))
        stacks[1].append(np.column_stack([law.A, law.B_y, from_r, law.B_u]))
        stacks[2].append(np.reshape(shown, (len(shown), law.C.size + 1)))
        stacks[3].append(form.start)
        stacks[4].append(np.array([*limits, form.largest_wish, form.predicts]))
    which = [place[id(run.form)] for run in runs]
    limit = np.array([run.scenario.limit for run in runs])
    return [*(np.array(stack)[which] for stack in stacks), limit]


def _over_lanes(part: Stack) -> NDArray[np.float64]:
    """Return the numbers of runs by group (groups, …, LANES)."""
    runs, *shape = part.shape
    groups = -(-runs // LANES)
    filled = np.zeros((groups * LANES, *shape))
    filled[:runs] = part
    lanes = lane_zeros(groups, *shape)
    lanes[...] = np.moveaxis(filled.reshape(groups, LANES, *shape), 1, -1)
    return lanes


def _lanes(rows: Rows, parts: Sequence[NDArray[np.float64]]) -> Lanes:
    """Return the lanes of runs that have not begun; each is marked as ended."""
    plant, output, wish, law, estimates, start, limits, limit = parts
    low, high, most_change, least_change, largest_wish, predicts = limits
    return Lanes(
        rows=rows,
        output=output,
        wish=wish,
        law=law,
        plant=plant,
        estimates=estimates,
        predicts=predicts,
        start=start,
        low=low,
        high=high,
        most_change=most_change,
        least_change=least_change,
        largest_wish=largest_wish,
        limit=limit,
        values=lane_zeros(rows.end),
        next=lane_zeros(plant.shape[0] + law.shape[0]),
        starting=lane_zeros(),
        seen=lane_zeros(2),
        ended=np.zeros(LANES, dtype=np.int64),
        lengths=np.zeros(LANES, dtype=np.int64),
        irregular=np.zeros(LANES, dtype=np.int64),
    )
