"""``tune``: the best controller of a structure for a plant or a set of plants."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from quell import checks
from quell.analysis.loop import analyse
from quell.parallel import one_blas_thread
from quell.tuning.constraints import Constraints
from quell.tuning.plants import given_plants, model_of, plant_set
from quell.tuning.requirements import bounds_of
from quell.tuning.search import Problem, Solution, search, starts
from quell.tuning.structures.registry import STRUCTURES, make_structure, orders_of
from quell.tuning.tuned import Design, Tuned
from quell.types import Progress


def tune(
    plant: Any,
    dt: float,
    *,
    structure: str = "freed",
    order: int | None = None,
    objective: str = "load",
    constraints: Constraints | None = None,
    compare: Sequence[str] = ("pi", "pid", "bandwidths"),
    delay: Any = 0.0,
    actuator_lag: float = 0.0,
    b_range: Sequence[float] = (1.0, 1.0),
    operating_point: Any = None,
    progress: Progress | None = None,
    **limits: Any,
) -> Tuned:
    """Return the controller of a structure with the best objective under constraints."""
    dt = checks.positive("dt", dt, "s")
    checks.one_of("structure", structure, STRUCTURES)
    constraints = constraints or Constraints()
    given = given_plants(
        plant,
        dt,
        delay=delay,
        actuator_lag=actuator_lag,
        b_range=b_range,
        operating_point=operating_point,
    )
    plants = plant_set(given, dt)
    model = model_of(given, plants, constraints)
    problem = Problem(plants, bounds_of(constraints), (), _load)
    designs = {}
    with one_blas_thread():
        for name in dict.fromkeys([*compare, structure]):
            best: Solution | None = None
            for each in orders_of(name, model, order):
                made = make_structure(name, model, each)
                rows = starts(problem, made, np.zeros((0, len(made.parameters))), 3)
                for row in rows:
                    found = search(problem, made, row)
                    if found is not None and found.feasible:
                        best = found if best is None or found.cost < best.cost else best
            if best is None:
                raise ValueError(f"no {name} controller stabilises the plant under {constraints}")
            names = [parameter.name for parameter in best.structure.parameters]
            designs[name] = Design(
                best.structure.name,
                best.structure.controller(best.values, **limits),
                dict(zip(names, best.values.tolist(), strict=True)),
                float(np.exp(-best.cost)),
                {"k_i": float(np.exp(-best.cost))},
                best.structure.tables(best.values),
            )
    chosen = designs[structure]
    assert chosen.controller is not None
    analysis = analyse(
        given.linear[0],
        chosen.controller,
        delay=float(given.delays[0]),
        actuator_lag=actuator_lag,
    )
    return Tuned(chosen, designs, analysis, constraints)


def _load(structure: Any, values: Any) -> Any:
    return -np.log(structure.integral_gain(values))
