"""Figures of a tuning: Bode diagram, sensitivities, step and load responses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from quell.quantities import Signals
from quell.records.plotting import grid_of_axes, new_figure
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser.laws import law_of
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.optimiser.requirements import sizes
from quell.tuning.optimiser.time_responses import Inputs, response
from quell.tuning.result.design import Design
from quell.types import Vector

# The responses last so many times the radian of the loop's crossover; most samples of them. They
# are drawn until all of them stay within this share of their range, and this much longer.
_LASTS, _MOST, _SETTLED, _LONGER = 40.0, 20_000, 0.02, 1.2
# The lowest frequency that is drawn, in units of the lowest crossover, and the least |L| and |S|.
_LOWEST, _LEAST_LOOP, _LEAST_SENSITIVITY = 3e-3, 1e-4, 1e-2
# Phases are drawn where |L| is above this share: beyond, with a dead time, the grid may miss turns.
_PHASE_FROM = 0.02
# The largest number of plants whose responses are drawn one by one.
_DRAWN = 12
_COLORS = ("black", "#c1440e", "#2a6f97", "#6a994e")


def draw(
    plants: PlantSet,
    designs: Mapping[str, Design],
    constraints: Constraints,
    signals: Signals,
    axes: Any = None,
) -> Any:
    """Draw designs with all plants into four axes, the first design in black; return the axes.

    The phase of L, dashed and for the first plant only, has an axis of its own at the right.
    """
    axes = grid_of_axes(axes, partial(new_figure, 10.0, 7.5), 2, 2)
    bode, sensitivity, step, load = np.ravel(axes)
    phase = bode.twinx()
    omega, shown = plants.omega, range(min(len(plants.plants), _DRAWN))
    lowest, last, largest = math.inf, 0.0, 1.0
    for color, (label, design) in zip(_COLORS, designs.items(), strict=False):
        assert design.solution is not None
        assert design.controller is not None
        C = design.solution.structure.response(design.solution.values[None, :], omega)[0]
        L, dashed = plants.P[0] * C, {"color": color, "linewidth": 0.9, "linestyle": "--"}
        phase.semilogx(omega, np.where(np.abs(L) >= _PHASE_FROM, phase_of(L), np.nan), **dashed)
        crossover = _crossover(L, omega, plants.crossover)
        lowest = min(lowest, crossover)
        law, scaled = law_of(design.controller), plants.scaled()
        count = min(int(_LASTS / crossover / plants.dt) + 2, _MOST)
        unit, none, t = np.ones(count), np.zeros(count), np.arange(count) * plants.dt
        for j in shown:
            text = label if label == design.name else f"{label}: {design.name}"
            name = text if j == 0 else None
            style: dict[str, Any] = {"color": color, "linewidth": 1.2, "label": name}
            style["alpha"] = 1.0 if j == 0 else 0.35
            bode.loglog(omega, np.abs(plants.P[j] * C), **style)
            other = style | {"linestyle": "--", "label": None}
            for kind, look in (("M_s", style), ("M_t", other)):
                size = sizes(kind, plants.P[j], C)
                sensitivity.loglog(omega, size, **look)
                largest = max(largest, float(np.max(size)))
            for axis, inputs in ((step, Inputs(unit, none)), (load, Inputs(none, unit))):
                y = response(scaled[j], law, inputs)
                axis.plot(t, y, **style)
                last = max(last, float(t[_settled(y)]))
    for limit, style_of in ((constraints.m_s, "-"), (constraints.m_t, "--")):
        if limit is not None:
            sensitivity.axhline(limit, color="0.5", linewidth=0.8, linestyle=style_of)
            largest = max(largest, limit)
    bode.axhline(1.0, color="0.5", linewidth=0.8)
    bode.set_ylim(_LEAST_LOOP, None)
    sensitivity.set_ylim(_LEAST_SENSITIVITY, 1.5 * largest)
    phase.set_ylabel("phase of L [°]")
    phase.axhline(-180.0, color="0.5", linewidth=0.8, linestyle="--")
    bode.set(title="loop L, its phase dashed", ylabel="|L|")
    sensitivity.set(title="sensitivities, with their bounds", ylabel="|S|, |T| dashed")
    step.set(title=f"step of r{_by_one(signals.y.unit)}")
    load.set(title=f"step of a load at the plant's input{_by_one(signals.u.unit)}")
    for axis in (bode, sensitivity):
        axis.set_xlabel("ω [rad/s]")
        axis.set_xlim(max(_LOWEST * lowest, float(omega[0])), None)
    for axis in (step, load):
        axis.set(xlabel="t [s]", ylabel=signals.y.label("y"), xlim=(0.0, _LONGER * last))
        axis.grid(alpha=0.3)
    load.legend(loc="upper right")
    return axes


def _by_one(unit: str) -> str:
    """Return the height of a unit step as text; empty for an unknown unit."""
    return f" by 1 {unit}" if unit else ""


def _settled(y: Vector) -> int:
    """Return the index from which on a response stays near its last value."""
    off = np.flatnonzero(np.abs(y - y[-1]) > _SETTLED * np.ptp(y))
    return int(off[-1]) if off.size else 0


def phase_of(L: Any) -> Vector:
    """Return the phase [°] along a grid, from between −360° and 0 at its first frequency on."""
    phase: Vector = np.degrees(np.unwrap(np.angle(L)))
    return phase - 360.0 * math.ceil(phase[0] / 360.0)


def _crossover(L: Any, omega: Vector, otherwise: float) -> float:
    """Return the lowest frequency at which |L| falls to 1."""
    size = np.abs(L)
    falls = np.flatnonzero((size[:-1] >= 1.0) & (size[1:] < 1.0))
    return float(omega[falls[0]]) if falls.size else otherwise
