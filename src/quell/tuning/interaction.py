"""How axes that are tuned together act on each other, as a part of a ``Tuned``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from quell.analysis.coupling import INDEPENDENT, Coupling, about_zeros
from quell.analysis.multivariable import MultivariableLoop
from quell.tuning.optimiser.requirements import Active
from quell.tuning.report import ACTIVE

TOLERANCE = 1e-3
"""A bound counts as kept up to this share beyond it, on the exact response."""
PLACES = ("inputs", "outputs")
"""Where disk margins are bounded."""


class Reached(NamedTuple):
    """A bound, and what the loops have."""

    name: str  #: with the channel, as ``M_s of x``
    value: float  #: NaN where it has none, as stability
    limit: float
    ratio: float  #: above 1 if the bound is exceeded; of a damping ζ it is (1 − ζ)/(1 − limit)
    least: bool = False  #: whether the value must be at least the limit

    def __str__(self) -> str:
        """Return the bound as text."""
        if not math.isfinite(self.value):
            return self.name
        end = "least" if self.least else "most"
        return f"{self.name} is {self.value:.4g}, at {end} {self.limit:.4g} is asked for"


class GivenB0(NamedTuple):
    """The B0 that axes were given, compared with the plant."""

    is_of_plant: bool
    """Whether its rows are those of the plant to about 1 %, each to a factor."""
    is_other_better: bool | None
    """Whether that of the plant decouples the axes and leaves loops stable; None if not known."""
    is_turned: bool
    """Whether no bandwidths are stable with it: gains at rest behind it have the wrong sign."""
    zeros: tuple[complex, ...]
    """Zeros in the right half plane, up to ten times the bandwidth of the axes alone [rad/s]."""
    pairing: tuple[int, ...] | None
    """The input of each axis by the gains at rest, if B0 has other entries, too."""


@dataclass(frozen=True, eq=False)
class Interaction:
    """How axes that are tuned together act on each other.

    Attributes
    ----------
    names : tuple of str
        of the axes.
    loops : tuple of MultivariableLoop
        the loop at each operating point, and with the errors of B0 that are the worst; without
        learners, the nominal one first.
    disk : float
        the least disk margin that was asked for.
    reached : tuple of Reached
        what the loops have of M_s, M_t, M_ks, disk margin and damping, the worst of all channels
        and plants.
    B0_off, points, plants
        the share by which B0 may be off, and how many operating points and plants there are.
    left : Coupling or None
        relative gains behind B0: how much the axes notice each other through it.
    of_plant : Coupling or None
        those of the plant without B0; None if there are more actuators than axes.
    given : GivenB0
        whether B0 is that of the plant, and whether another one would be better.
    with_learners : MultivariableLoop or None
        the nominal loop with learners at rest.
    """

    names: tuple[str, ...]
    loops: tuple[MultivariableLoop, ...]
    disk: float
    reached: tuple[Reached, ...]
    B0_off: float
    points: int
    plants: int
    left: Coupling | None
    of_plant: Coupling | None
    given: GivenB0
    with_learners: MultivariableLoop | None = None

    bounded = " of each channel, all others closed"
    drawn = 2

    @property
    def excess(self) -> float:
        """The largest ratio to a bound, less one; 0 if none is exceeded."""
        return excess(self.reached)

    @property
    def met(self) -> bool:
        """Whether all bounds hold."""
        return self.excess <= TOLERANCE

    @property
    def active(self) -> list[Active]:
        """The bounds at their limits."""
        return [
            Active(each.name, each.value, each.limit, math.nan, 0)
            for each in self.reached
            if 1.0 - ACTIVE <= each.ratio <= 1.0 + TOLERANCE
        ]

    @cached_property
    def disk_margins(self) -> tuple[float, float]:
        """Least disk margins of all inputs, and of all outputs, over the plants."""
        found = [[loop.disk_margin(at).alpha for loop in self.loops] for at in PLACES]
        return min(found[0]), min(found[1])

    @cached_property
    def m_s(self) -> float:
        """The largest singular value of S at the outputs, over the plants; it has units."""
        return max(loop.m_s("outputs").value for loop in self.loops)

    def lines(self, tuned: Any) -> list[str]:
        """Return what holds of a controller's loops, what does not, and what is not known."""
        controller = tuned.controller
        inputs, outputs = self.disk_margins
        lines = [
            f"disk margin {inputs:.3f} of all inputs, {outputs:.3f} of all outputs at once; "
            f"at least {self.disk:.3f} is asked for; max σ(S) {self.m_s:.3f} at the outputs"
        ]
        if not self.met:
            missed = "; ".join(str(each) for each in self.reached if each.ratio > 1.0 + TOLERANCE)
            lines.append(
                f"NOT met with the best bandwidths that were found: {missed}; {self._remedy()}"
            )
        lines += self._advice()
        if self.B0_off == 0.0:
            lines.append(
                "NOT known for another B0 than this one: give the share by which it may be off, "
                "B0_off"
            )
        if callable(controller.B0) or callable(controller.M):
            if self.points == 1:
                lines.append(
                    "NOT judged away from this operating point, where B0 is another: give several, "
                    "operating_points=[x, …]"
                )
            lines.append(
                "NOT proved for fast motion: margins are those of B0 held at each operating point"
            )
        if controller.learning.learns:
            lines.append(
                "NOT in any margin: what learners learn from the states of other axes; simulate "
                "with them"
            )
        loop = self.with_learners
        if loop is not None:
            if not loop.stable:
                lines.append("NOT stable with the learners at rest: lower their bias or rate")
            else:
                d = min(loop.disk_margin(at).alpha for at in PLACES)
                lines.append(
                    f"with the learners at rest the disk margin is {d:.3f}, which no bound is for"
                )
            told = loop.remark.splitlines()
            lines += [line for line in told if line.startswith("NOT in these margins")]
        return lines

    @property
    def _is_coupled(self) -> bool:
        left = self.left
        return left is None or not left.decided or left.factor > INDEPENDENT

    def _remedy(self) -> str:
        """Return what to do where the bounds are not met."""
        given = self.given
        if given.is_turned or self._is_coupled:
            if given.is_other_better:
                return (
                    "the axes are coupled through this B0: give the B0 of the machine (quell b0 "
                    "--axes finds it in a record), or looser bounds"
                )
            if given.is_turned or given.zeros or given.is_other_better is False:
                return self._without_other()
            return (
                "the axes are coupled through this B0: give the B0 of the machine, if this is not "
                "it (quell b0 --axes finds it in a record), or looser bounds"
            )
        if self.B0_off > 0.0:
            share = f"{100.0 * self.B0_off:.3g} %"
            return f"B0 has to be known better than to {share}, or the bounds be looser"
        zeros = f"{about_zeros(given.zeros)}; " if given.zeros else ""
        return f"{zeros}give looser bounds, less delay or faster samples"

    def _without_other(self) -> str:
        """Return why another B0 of all entries is no remedy, and what may be one."""
        given, causes, remedies = self.given, [], []
        if given.is_turned:
            causes.append(
                "no bandwidths are stable with this B0, as the gains at rest behind it have a "
                "determinant of the wrong sign"
            )
        if given.zeros:
            causes.append(about_zeros(given.zeros))
        if not causes:
            return (
                "the dynamics of the plant couple the axes at these bandwidths, and a constant B0 "
                "does not undo it: give looser bounds, less delay or faster samples"
            )
        if given.pairing is not None:
            names = self.names
            pairs = ", ".join(f"{names[i]} with input {j + 1}" for i, j in enumerate(given.pairing))
            remedies.append(f"pair by the gains at rest, {pairs}, with a B0 of these entries only")
        remedies.append("choose other inputs or outputs")
        if not given.is_turned:
            remedies.append("give looser bounds")
        return f"{'; '.join(causes)}. To be tried: {', or '.join(remedies)}"

    def _advice(self) -> list[str]:
        lines, given = [], self.given
        if self.of_plant is not None:
            # That B0 is to be used is said only if it is not done, and helps.
            done = given.is_other_better is False or given.zeros
            told = self.of_plant.facts if done else self.of_plant.advice
            lines.append(f"of the plant: {told.splitlines()[0]}")
        left = self.left
        if left is None:
            return lines
        if not left.decided:
            return [*lines, f"behind B0: {left.advice.splitlines()[0]}"]
        changes = f"behind it a gain changes by a factor of {left.factor:.3g}"
        closed = "with the other loops closed"
        if left.factor <= INDEPENDENT:
            return [*lines, f"decoupled by this B0: {changes} at most {closed}"]
        if given.is_other_better:
            rest = "give the B0 of the machine"
        elif given.zeros:
            rest = about_zeros(given.zeros)
        elif given.is_other_better is None:
            rest = "give the B0 of the machine, if this is not it"
        else:
            rest = "the dynamics of the plant couple the axes at these bandwidths"
        whose = ", which is that of the plant" if given.is_of_plant else ""
        # What to do stands in the line before where the bounds are not met.
        rest = f"; {rest}" if self.met else ""
        return [*lines, f"NOT decoupled by this B0{whose}: {changes} {closed}{rest}"]

    def to_json(self) -> dict[str, Any]:
        """Return it as a table."""
        inputs, outputs = self.disk_margins
        return {
            "disk": self.disk,
            "met": self.met,
            "excess": self.excess,
            "bounds": [each._asdict() for each in self.reached],
            "disk_margin": {"inputs": inputs, "outputs": outputs},
            "max_singular_value": self.m_s,
            "B0_off": self.B0_off,
            "operating_points": self.points,
            "coupled": {
                "plant": None if self.of_plant is None else self.of_plant.factor,
                "behind_B0": None if self.left is None else self.left.factor,
                "given_B0": {
                    **self.given._asdict(),
                    "zeros": [[zero.real, zero.imag] for zero in self.given.zeros],
                },
            },
        }

    def plot(self, m_s: float | None, axes: Any = None) -> Any:
        """Draw the sensitivities of all channels, with their bound, and the singular values of S.

        Lines are of the nominal plant, grey ones of the others. Returns the two matplotlib axes.
        """
        from quell.records.plotting import grid_of_axes, new_figure

        drawn = grid_of_axes(axes, lambda: new_figure(6.4, 5.6), 2, sharex=True)
        first, second = drawn[:, 0]
        for j, loop in reversed([*enumerate(self.loops)]):
            omega = loop.omega[1:]
            grey = {"color": "0.8", "linewidth": 0.8}
            S = np.abs(np.einsum("kii->ki", loop.response("S_o", omega)))
            for k, name in enumerate(self.names):
                how: dict[str, Any] = {"label": f"|S| of {name}"} if j == 0 else grey
                first.loglog(omega, S[:, k], **how)
            sigma = loop.singular_values("S_o", omega)[:, 0]
            second.loglog(omega, sigma, **({"label": "max σ(S)"} if j == 0 else grey))
        if m_s is not None:
            first.axhline(m_s, color="black", linestyle="--", label="bound")
        for each in (first, second):
            each.grid(True, alpha=0.3)
            each.legend()
        second.set_xlabel("frequency [rad/s]")
        return drawn[:, 0]


def excess(reached: Sequence[Reached]) -> float:
    """Return the largest ratio to a bound, less one, or 0."""
    return max(max(each.ratio for each in reached) - 1.0, 0.0)
