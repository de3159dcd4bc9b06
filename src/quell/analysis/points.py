"""Loops of several axes at a set of operating points, and the worst of them.

An arm has another plant and another B0 in each pose. ``analyse`` judges one, in which B0 is a
constant; here the loop is judged at each point of a set, and the worst of every measure is told. As
with a schedule, these are loops at rest: between the points and in fast motion nothing is proved.

**B0 while a load is held.** At a point that v_0 holds, as an arm against gravity, a change of the
estimates changes ``u = B0(x̂)⁻¹ v`` even if v does not change. It acts like a stiffness between the
axes,

    K = B0 ∂(B0⁻¹ v_0)/∂x̂        [1/s^n]

which is not in the loops. At the frequency ω of the peak of S it changes the loop by about K/ω^n;
where that is more than a tenth, a line says so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from quell.analysis.matrices import estimates_at, gain_at
from quell.analysis.multivariable import MultivariableLoop, analyse_axes
from quell.controllers.axes import Axes
from quell.files import nonfinite_to_none
from quell.plants.linearise import held_points
from quell.types import Matrix, Vector

# Step of the estimates for the derivative of B0, and the share of s^n at the peak of S from which
# on the stiffness of a held load is told. By hand: margins move by about this share.
_STEP, _NOTABLE = 1e-5, 0.1


@dataclass(frozen=True, eq=False)
class LoopsAtPoints:
    """The loops of axes at several operating points; made by ``analyse_points``.

    Attributes
    ----------
    points : tuple
        the operating points, (x, u) each.
    loops : tuple of MultivariableLoop
        the loop at each of them.
    stiffness : Vector
        largest entry of K at each point, over ω^n at the peak of S (points,).
    varies : bool
        whether B0 is a function of the estimates.
    """

    points: tuple[tuple[Vector, Vector], ...]
    loops: tuple[MultivariableLoop, ...]
    stiffness: Vector
    varies: bool

    @cached_property
    def stable(self) -> bool:
        """Whether the loops of all points are stable."""
        return all(loop.stable for loop in self.loops)

    def disk_margin(self, at: str = "inputs") -> tuple[float, int]:
        """Return the least disk margin of all points, and the number of its point, from 0.

        ``at`` as for ``MultivariableLoop.disk_margin``.
        """
        found = [loop.disk_margin(at).alpha for loop in self.loops]
        worst = int(np.argmin(found))
        return found[worst], worst

    def m_s(self, at: str = "outputs") -> tuple[float, int]:
        """Return the largest M_s of all points, and the number of its point."""
        found = [loop.m_s(at).value for loop in self.loops]
        worst = int(np.argmax(found))
        return found[worst], worst

    def channel_m_s(self) -> tuple[float, str, int]:
        """Return the largest M_s of a single channel, the others closed, its name and its point."""
        rows = [
            (1.0 / loop.channel_margins(name).modulus if loop.stable else math.inf, name, i)
            for i, loop in enumerate(self.loops)
            for name in (*loop.inputs, *loop.outputs)
        ]
        return max(rows, key=lambda row: row[0])

    def summary(self) -> str:
        """Return a line for each point, the worst of all, and what is not known."""
        lines = []
        for i, ((x, _), loop) in enumerate(zip(self.points, self.loops, strict=True)):
            where = f"point {i + 1}, x = {_listed(x)}"
            if not loop.stable:
                lines.append(f"{where}: unstable")
                continue
            both = [loop.disk_margin(at).alpha for at in ("inputs", "outputs", "both")]
            m_s = loop.m_s("outputs").value
            lines.append(
                f"{where}: M_s {m_s:.3f} at the outputs, disk margin {both[0]:.3f} of all inputs, "
                f"{both[1]:.3f} of all outputs, {both[2]:.3f} of both at once"
            )
            lines += [loop.note] if loop.note else []
        return "\n".join([*lines, *self.verdicts()])

    def verdicts(self) -> list[str]:
        """Return the worst of all points, and what is not known, as lines."""
        lines = []
        if not self.stable:
            bad = [str(i + 1) for i, loop in enumerate(self.loops) if not loop.stable]
            lines.append(f"NOT stable at point {', '.join(bad)}: use slower axes or a better B0")
        else:
            value, name, i = self.channel_m_s()
            least, j = min(self.disk_margin(at) for at in ("inputs", "outputs"))
            lines.append(
                f"worst of {len(self.points)} points: M_s {value:.3f} of {name} with the others "
                f"closed at point {i + 1}, disk margin {least:.3f} at point {j + 1}"
            )
        if self.varies:
            if len(self.points) == 1:
                lines.append(
                    "NOT judged away from this point, where B0 is another: give several points"
                )
            lines.append(
                "NOT proved between the points and in fast motion: B0 is held at each point; "
                "simulate the fastest motion"
            )
        largest = float(np.max(self.stiffness))
        if largest > _NOTABLE:
            i = int(np.argmax(self.stiffness))
            lines.append(
                f"NOT in these margins: B0 changes with the estimates under the load held at point "
                f"{i + 1}, a stiffness that changes the loop at the peak of S by about "
                f"{100.0 * largest:.3g} %; simulate small steps there"
            )
        told = self.loops[0].remark.splitlines()  # of learners and drives: the same at all points
        return lines + [line for line in told if line.startswith("NOT in these margins")]

    def __repr__(self) -> str:
        return f"LoopsAtPoints of {len(self.points)} points:\n{self.summary()}"

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries for ``json.dump``; None for what is infinite."""
        places, rows = ("inputs", "outputs", "both"), []
        for (x, u), loop, stiffness in zip(self.points, self.loops, self.stiffness, strict=True):
            margins = {at: loop.disk_margin(at).alpha for at in places}
            about = {"x": x.tolist(), "u": u.tolist(), "stable": loop.stable}
            about |= {"m_s": loop.m_s("outputs").value, "disk_margin": margins}
            rows.append({**about, "stiffness": float(stiffness)})
        found: dict[str, Any] = nonfinite_to_none({"points": rows, "verdicts": self.verdicts()})
        return found


def analyse_points(plant: Any, axes: Axes, points: Sequence[Any]) -> LoopsAtPoints:
    """Analyse the loop of a plant and several axes at each of a set of operating points.

    Parameters
    ----------
    plant
        a nonlinear plant with an output for each axis, such as ``plants.arm()``; also behind delays
        or encoders.
    axes
        the controller; a B0 that is a function has its value at each point.
    points
        operating points at rest: states x, for which the u that holds them is found, or (x, u).

    Raises
    ------
    ValueError
        as ``analyse``; for a state that no u holds at rest, and without any point.

    Examples
    --------
    >>> import quell as ql
    >>> robot = ql.plants.arm()
    >>> observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3)
    >>> joint = ql.ADRC(observer, omega_c=8.0)
    >>> poses = [[0.0, q, 0.0, 0.0] for q in (0.0, 1.5, 3.0)]
    >>> found = analyse_points(robot, ql.Axes([joint, joint], M=robot.inertia), poses)
    >>> found.stable, round(found.disk_margin("inputs")[0], 1)
    (True, 0.8)
    """
    given = held_points("points", plant, points)
    loops = tuple(analyse_axes(plant, axes, point) for point in given)
    stiffness = np.array(
        [_stiffness(axes, plant, each, loop) for each, loop in zip(given, loops, strict=True)]
    )
    return LoopsAtPoints(given, loops, stiffness, callable(axes.B0) or callable(axes.M))


def _stiffness(
    axes: Axes, plant: Any, point: tuple[Vector, Vector], loop: MultivariableLoop
) -> float:
    """Return the largest entry of K over ω^n of its axis at the peak of S."""
    if not (callable(axes.B0) or callable(axes.M)) or not loop.stable:
        return 0.0
    x = estimates_at(axes, plant, point)
    if x is None:
        return 0.0
    B0, _ = gain_at(axes, x)
    v = B0 @ point[1]
    peak = loop.m_s("outputs").omega
    own = np.array([peak**axis.observer.order for axis in axes.axes])
    largest = 0.0
    for i in range(x.shape[0]):
        moved: list[Matrix] = []
        for sign in (1.0, -1.0):
            near = x.copy()
            near[i, 0] += sign * _STEP
            moved.append(gain_at(axes, near)[1])
        column = B0 @ ((moved[0] - moved[1]) @ v) / (2.0 * _STEP)
        largest = max(largest, float(np.max(np.abs(column) / own)))
    return largest


def _listed(x: Vector) -> str:
    return f"[{', '.join(f'{value:.4g}' for value in x.tolist())}]"
