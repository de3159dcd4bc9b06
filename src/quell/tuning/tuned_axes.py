"""What ``tune_axes`` returns: bandwidths of coupled axes, their figures, and what is not known."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quell.analysis.coupling import INDEPENDENT, Coupling, about_zeros
from quell.analysis.multivariable import MultivariableLoop
from quell.controllers.axes import Axes
from quell.files import nonfinite_to_none, written_atomically
from quell.tuning.acceptance import Judged, prefilter_table
from quell.tuning.constraints import Constraints
from quell.tuning.report import toml_text
from quell.tuning.tuned import Tuned

TOLERANCE = 1e-3
"""A bound counts as kept up to this share beyond it, on the exact response."""
PLACES = ("inputs", "outputs")
"""Where disk margins are bounded."""


class AxisResult(NamedTuple):
    """One axis of a result."""

    name: str
    omega_c: float  #: [rad/s]
    omega_o: float  #: [rad/s]
    cost: float  #: integral of ``|y|`` after a unit step of v, the largest over the plants
    alone: float  #: the same of the axis alone, tuned for itself
    m_s: float  #: the largest M_s at its output with the other loops closed
    m_t: float
    m_ks: float  #: from y to v [1/s^n]

    @property
    def ratio(self) -> float:
        """The cost over that of the axis alone: what the coupling takes."""
        return self.cost / self.alone


class AxesBound(NamedTuple):
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


class AxesCheck(NamedTuple):
    """A result on drawn errors of B0."""

    samples: int
    unstable: int
    violating: int
    interval: tuple[float, float]  #: 95 % interval of the share that violates

    def __str__(self) -> str:
        """Return the check as a sentence."""
        low, high = (100.0 * end for end in self.interval)
        return (
            f"{self.samples} drawn errors of B0: {self.violating} exceed a bound, {self.unstable} "
            f"of them unstable; a share of {low:.2g} to {high:.2g} % (95 % interval)"
        )


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
class TunedAxes:
    """Tuned axes; from ``tune_axes``.

    Attributes
    ----------
    controller : Axes
        axes with the bandwidths, at their start: the kinds of learners, guards and limits are as
        they were, what was learned before is not in them.
    axes : tuple of AxisResult
        bandwidths and figures of each axis.
    loops : tuple of MultivariableLoop
        the loop at each operating point, and with the errors of B0 that are the worst; without
        learners, the nominal one first.
    alone : Mapping
        the tuning of each axis by itself, by name.
    constraints : Constraints
        the bounds of each channel.
    disk : float
        the least disk margin that was asked for.
    met : bool
        whether all bounds hold.
    excess : float
        the largest ratio to a bound, less one; 0 if none is exceeded.
    bounds : tuple of AxesBound
        what the loops have of M_s, M_t, M_ks, disk margin and damping, the worst of all channels
        and plants.
    left : Coupling or None
        relative gains behind B0: how much the axes notice each other through it.
    of_plant : Coupling or None
        those of the plant without B0; None if there are more actuators than axes.
    given : GivenB0
        whether B0 is that of the plant, and whether another one would be better.
    check : AxesCheck or None
        drawn errors of B0, if it may be off.
    setup : Mapping
        tables of a setup file that ``toml`` completes; empty without.
    judged : Judged or None
        what the axes do in the file, each and after overloads, if actuators have limits.
    told : tuple
        lines on axes that are left out, and on the least gain of the channels.
    """

    controller: Axes
    axes: tuple[AxisResult, ...]
    loops: tuple[MultivariableLoop, ...]
    alone: Mapping[str, Tuned]
    constraints: Constraints
    disk: float
    met: bool
    excess: float
    bounds: tuple[AxesBound, ...]
    B0_off: float
    points: int
    plants: int
    objective: str
    left: Coupling | None
    of_plant: Coupling | None
    given: GivenB0
    check: AxesCheck | None = None
    with_learners: MultivariableLoop | None = None
    setup: Mapping[str, Any] = field(default_factory=dict)
    judged: Judged | None = None
    told: tuple[str, ...] = ()

    @cached_property
    def disk_margins(self) -> tuple[float, float]:
        """Least disk margins of all inputs, and of all outputs, over the plants."""
        found = [[loop.disk_margin(at).alpha for loop in self.loops] for at in PLACES]
        return min(found[0]), min(found[1])

    @cached_property
    def m_s(self) -> float:
        """The largest singular value of S at the outputs, over the plants; it has units."""
        return max(loop.m_s("outputs").value for loop in self.loops)

    def rows(self) -> list[tuple[str, ...]]:
        """Return a row for each axis: name, bandwidths, cost, its ratio, M_s, M_t, M_ks."""
        return [
            (
                each.name,
                f"{each.omega_c:.4g}",
                f"{each.omega_o:.4g}",
                f"{each.cost:.4g}",
                f"{each.ratio:.3f}",
                f"{each.m_s:.3f}",
                f"{each.m_t:.3f}",
                f"{each.m_ks:.4g}",
            )
            for each in self.axes
        ]

    def verdicts(self) -> list[str]:
        """Return what holds, what does not, and what is not known, as lines."""
        inputs, outputs = self.disk_margins
        lines = [
            f"disk margin {inputs:.3f} of all inputs, {outputs:.3f} of all outputs at once; "
            f"at least {self.disk:.3f} is asked for; max σ(S) {self.m_s:.3f} at the outputs"
        ]
        if not self.met:
            missed = "; ".join(str(each) for each in self.bounds if each.ratio > 1.0 + TOLERANCE)
            lines.append(
                f"NOT met with the best bandwidths that were found: {missed}; {self._remedy()}"
            )
        lines += self._advice()
        if self.check is not None:
            lines.append(str(self.check))
        elif self.B0_off == 0.0:
            lines.append(
                "NOT known for another B0 than this one: give the share by which it may be off, "
                "B0_off"
            )
        if callable(self.controller.B0) or callable(self.controller.M):
            if self.points == 1:
                lines.append(
                    "NOT judged away from this operating point, where B0 is another: give several, "
                    "operating_points=[x, …]"
                )
            lines.append(
                "NOT proved for fast motion: margins are those of B0 held at each operating point"
            )
        lines += [*self.told, *([] if self.judged is None else str(self.judged).splitlines())]
        if self.controller.learning.learns:
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
            names = self.controller.names
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

    def summary(self) -> str:
        """Return bandwidths, figures and verdicts as lines."""
        lines = [f"constraints: {self.constraints} of each channel, all others closed"]
        for name, omega_c, omega_o, cost, ratio, m_s, m_t, m_ks in self.rows():
            lines.append(
                f"{name}: omega_c {omega_c}, omega_o {omega_o}, {quantity(self.objective)} "
                f"{cost}, {ratio} of alone, M_s {m_s}, M_t {m_t}, M_ks {m_ks}"
            )
        return "\n".join([*lines, *self.verdicts()])

    def __repr__(self) -> str:
        return f"TunedAxes of {len(self.axes)} axes:\n{self.summary()}"

    def toml(self) -> str:
        """Return the setup file that was given with these bandwidths.

        Raises ``ValueError`` without one.
        """
        if "axis" not in self.setup:
            raise ValueError("toml: there is no setup to complete; give tune_axes its tables")
        tables = dict(self.setup)
        entries = []
        made = self.controller
        parts = zip(tables["axis"], self.axes, made.axes, made.prefilters, strict=True)
        for table, axis, own, shaper in parts:
            observer = {**table["observer"], "omega_o": axis.omega_o}
            law = table["controller"]
            law = {**({"kind": law} if isinstance(law, str) else law), "omega_c": axis.omega_c}
            if own.feedforward is True:
                law["feedforward"] = True
            entries.append({**table, "observer": observer, "controller": law})
            if shaper is not None and "prefilter" not in table:
                entries[-1]["prefilter"] = prefilter_table(shaper)
        tables["axis"] = entries
        found = "\n".join(self.verdicts())
        return toml_text(tables, f"axes tuned by quell\nconstraints: {self.constraints}\n{found}")

    def save(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write ``toml()`` into a file, whole or not at all; an existing one is not replaced."""
        text = self.toml()
        with written_atomically(Path(path), overwrite) as part:
            part.write_text(text, encoding="utf-8")

    def to_json(self) -> dict[str, Any]:
        """Return all results for ``quell.files.write_json``; infinite numbers become None."""
        inputs, outputs = self.disk_margins
        found: dict[str, Any] = nonfinite_to_none(
            {
                "objective": self.objective,
                "constraints": dict(vars(self.constraints)),
                "disk": self.disk,
                "met": self.met,
                "excess": self.excess,
                "bounds": [each._asdict() for each in self.bounds],
                "axes": [each._asdict() | {"ratio": each.ratio} for each in self.axes],
                "disk_margin": {"inputs": inputs, "outputs": outputs},
                "max_singular_value": self.m_s,
                "B0_off": self.B0_off,
                "operating_points": self.points,
                "plants": self.plants,
                "coupled": {
                    "plant": None if self.of_plant is None else self.of_plant.factor,
                    "behind_B0": None if self.left is None else self.left.factor,
                    "given_B0": {
                        **self.given._asdict(),
                        "zeros": [[zero.real, zero.imag] for zero in self.given.zeros],
                    },
                },
                "check": None
                if self.check is None
                else {**self.check._asdict(), "interval": list(self.check.interval)},
                "verdicts": self.verdicts(),
                **({} if self.judged is None else self.judged.to_json()),
            }
        )
        return found

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw the singular values of S at the outputs and the sensitivities of all channels.

        Lines are of the nominal plant, grey ones of the others. Returns the two matplotlib axes;
        ``axes`` or ``ax`` are those to draw into, new ones by default.
        """
        from quell.records.plotting import given_axes, grid_of_axes, new_figure

        drawn = grid_of_axes(given_axes(axes, ax), lambda: new_figure(6.4, 5.6), 2, sharex=True)
        first, second = drawn[:, 0]
        for j, loop in reversed([*enumerate(self.loops)]):
            omega = loop.omega[1:]
            grey = {"color": "0.8", "linewidth": 0.8}
            S = np.abs(np.einsum("kii->ki", loop.response("S_o", omega)))
            for k, name in enumerate(self.controller.names):
                how: dict[str, Any] = {"label": f"|S| of {name}"} if j == 0 else grey
                first.loglog(omega, S[:, k], **how)
            sigma = loop.singular_values("S_o", omega)[:, 0]
            second.loglog(omega, sigma, **({"label": "max σ(S)"} if j == 0 else grey))
        if self.constraints.m_s is not None:
            first.axhline(self.constraints.m_s, color="black", linestyle="--", label="bound")
        for each in (first, second):
            each.grid(True, alpha=0.3)
            each.legend()
        second.set_xlabel("frequency [rad/s]")
        return drawn[:, 0]


def quantity(objective: str) -> str:
    """Return what the cost of an axis is, as text."""
    return "∫|y|" if objective == "load-iae" else "1/k_i"
