"""Figures of a tuning: Bode diagram, sensitivities, step and load responses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from quell.records.plotting import grid_of_axes, new_figure
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.optimiser.requirements import sizes
from quell.tuning.optimiser.time_responses import Inputs, law_of, responses
from quell.tuning.result.design import Design
from quell.types import Vector

# The responses last so many times the radian of the loop's crossover; most samples of them.
_LASTS, _MOST = 40.0, 20_000
# Phases are drawn where |L| is above this share: beyond, with a dead time, the grid may miss turns.
_PHASE_FROM = 0.02
# The largest number of plants whose responses are drawn one by one.
_DRAWN = 12
_COLORS = ("black", "#c1440e", "#2a6f97", "#6a994e")


def draw(
    plants: PlantSet, designs: Mapping[str, Design], constraints: Constraints, axes: Any = None
) -> Any:
    """Draw designs with all plants into four axes, the first design in black; return the axes.

    The phase of L, dashed and for the first plant only, has an axis of its own at the right.
    """
    axes = grid_of_axes(axes, partial(new_figure, 10.0, 7.5), 2, 2)
    bode, sensitivity, step, load = np.ravel(axes)
    phase = bode.twinx()
    omega, shown = plants.omega, range(min(len(plants.plants), _DRAWN))
    crossover = plants.crossover
    for color, (label, design) in zip(_COLORS, designs.items(), strict=False):
        assert design.solution is not None
        assert design.controller is not None
        C = design.solution.structure.response(design.solution.values[None, :], omega)[0]
        L, dashed = plants.P[0] * C, {"color": color, "linewidth": 0.9, "linestyle": "--"}
        seen = np.abs(L) >= _PHASE_FROM
        phase.semilogx(omega[seen], phase_of(L)[seen], **dashed)
        crossover = _crossover(L, omega, plants.crossover)
        law, scaled = law_of(design.controller), plants.scaled()
        count = min(int(_LASTS / crossover / plants.dt) + 2, _MOST)
        unit, none, t = np.ones(count), np.zeros(count), np.arange(count) * plants.dt
        for j in shown:
            text = label if label == design.name else f"{label}: {design.name}"
            name = text if j == 0 else None
            style: dict[str, Any] = {"color": color, "linewidth": 1.2, "label": name}
            style["alpha"] = 1.0 if j == 0 else 0.35
            bode.loglog(omega, np.abs(plants.P[j] * C), **style)
            sensitivity.loglog(omega, sizes("M_s", plants.P[j], C), **style)
            other = style | {"linestyle": "--", "label": None}
            sensitivity.loglog(omega, sizes("M_t", plants.P[j], C), **other)
            step.plot(t, responses(scaled[j], law, Inputs(unit, none)).y, **style)
            load.plot(t, responses(scaled[j], law, Inputs(none, unit)).y, **style)
    for limit, style_of in ((constraints.m_s, "-"), (constraints.m_t, "--")):
        if limit is not None:
            sensitivity.axhline(limit, color="0.5", linewidth=0.8, linestyle=style_of)
    bode.axhline(1.0, color="0.5", linewidth=0.8)
    sensitivity.set_ylim(1e-2, None)
    phase.set_ylabel("phase [°]")
    phase.axhline(-180.0, color="0.5", linewidth=0.8, linestyle="--")
    titles = ("|L|, phase dashed", "|S|, |T| dashed, with their bounds", "y after a step of r")
    for axis, title in zip((bode, sensitivity, step), titles, strict=True):
        axis.set_title(title)
    load.set_title("y after a step of the load at the plant's input")
    for axis in (bode, sensitivity):
        axis.set_xlabel("ω [rad/s]")
    for axis in (step, load):
        axis.set_xlabel("t [s]")
        axis.grid(alpha=0.3)
    bode.legend()
    return axes


def phase_of(L: Any) -> Vector:
    """Return the phase [°] along a grid, from between −360° and 0 at its first frequency on."""
    phase: Vector = np.degrees(np.unwrap(np.angle(L)))
    return phase - 360.0 * math.ceil(phase[0] / 360.0)


def _crossover(L: Any, omega: Vector, otherwise: float) -> float:
    """Return the lowest frequency from which on |L| is below 1."""
    above = np.flatnonzero(np.abs(L) >= 1.0)
    if above.size == 0 or not math.isfinite(float(omega[above[-1]])):
        return otherwise
    return float(omega[above[-1]])
