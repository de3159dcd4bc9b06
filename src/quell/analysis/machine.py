"""The loop and the certificate of a controller, of one axis or of several.

A loop whose b0 is estimated online has a certificate for the whole interval of b0 and b. The
feedback of an ADRC is 1/b0 times one that does not depend on b0. With the plant's input gain b
the open loop is therefore ``L = (b/b0) L_1``, at any fixed b0. With b0 and b within [low, high] the
ratio is within [low/high, high/low], and the loop is stable for all of them if the range of the
ratio for which it is stable, which the gain margins are, contains that interval.

An arm has another plant and another B0 in each pose. ``analyse`` judges one, in which B0 is a
constant; ``analyse_points`` judges the loop at each point of a set, and tells the worst of every
measure. As with a schedule, these are loops at rest: between the points and in fast motion nothing
is proved.

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
from typing import Any, NamedTuple, overload

import numpy as np

from quell.analysis.certificate import Certificate, certify_axis
from quell.analysis.coupled import CoupledCertificate, certify_axes
from quell.analysis.loop import LoopAnalysis, analyse_axis
from quell.analysis.matrices import estimates_at, gain_at
from quell.analysis.multivariable import MultivariableLoop, analyse_axes
from quell.controllers.adrc import ADRC
from quell.controllers.axes import Axes
from quell.controllers.base import Controller
from quell.controllers.online_gain import OnlineGain
from quell.files import nonfinite_to_none
from quell.hints import explained
from quell.lti.canonical import canonical
from quell.plants.linearise import held_points, linear_part
from quell.types import Matrix, Vector

# ---- Loop and certificate ----


@overload
def analyse(plant: Any, controller: Axes, operating_point: Any = None) -> MultivariableLoop: ...


@overload
def analyse(
    plant: Any,
    controller: Controller,
    operating_point: Any = None,
    *,
    at: Any = None,
    delay: float = 0.0,
    actuator_lag: float = 0.0,
) -> LoopAnalysis: ...


@explained("quell.analysis.analyse(plant, controller)")
def analyse(
    plant: Any,
    controller: Controller | Axes,
    operating_point: Any = None,
    *,
    at: Any = None,
    delay: float = 0.0,
    actuator_lag: float = 0.0,
) -> LoopAnalysis | MultivariableLoop:
    """Analyse the loop of a linear plant and a controller, unlimited, with learners at rest.

    What a learner knows of the plant is a feedback, and its bias and oscillators go on adapting:
    the loop contains both, linearised about rest (``analysis/linearise.py``). What is not in it,
    the summary says. Of several axes, what learners of all axes have learned is not in it, and a B0
    that is a function of the estimates is the one at the operating point (``analyse_points`` judges
    several points). Compensators of several axes are taken with their drives.

    Parameters
    ----------
    plant
        ``LinearPlant``, ``control.StateSpace``, ``control.TransferFunction``, ``(num, den)`` or
        ``(A, B, C)``; one of them delayed or encoded (an encoder is left out); a
        ``NonlinearPlant``, with its operating point. For several axes it has an output for each,
        and may be sampled: a ``control.StateSpace`` with the same dt, or what a ``LinearPlant`` is
        ``sampled`` to.
    controller
        an ``ADRC``, a linear controller, either with a compensator, or a ``Compensator`` alone,
        whose loop is closed around the plant that it sees; a prefilter in front is left out. Or
        ``Axes``.
    operating_point
        state and control signals ``(x, u)`` about which a nonlinear plant is linearised, at rest;
        see ``quell.plants.linearised``.
    at
        of one axis, the instant at which its learner is looked at: a run or state of the controller
        (its end), or an ``Adapting`` from ``adapting(controller, run, t)``; by default the present
        state, which for a new controller has learned nothing. A ``Frozen`` from ``frozen`` in its
        place is a learner that no longer learns.
    delay
        of one axis, additional dead time of the loop [s]; of several, delay the plant.
    actuator_lag
        of one axis, time constant of a first-order lag between u and the plant [s].

    Returns
    -------
    LoopAnalysis or MultivariableLoop
        of one axis, or of several.

    Raises
    ------
    ValueError
        for a nonlinear plant without operating point, a plant with direct feedthrough, sizes that
        do not fit, a controller without a linear law, a delay of more than 200 samples, and options
        of one axis with several.

    Examples
    --------
    >>> import quell as ql
    >>> robot = ql.plants.arm(gravity=0.0)
    >>> observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3)
    >>> joint = ql.ADRC(observer, omega_c=8.0)
    >>> analyse(([1.0], [1.0, 0.2, 0.0]), joint).stable
    True
    >>> pose = ([0.3, 1.2, 0.0, 0.0], [0.0, 0.0])
    >>> loop = analyse(robot, ql.Axes([joint, joint], M=robot.inertia), pose)
    >>> round(loop.disk_margin("inputs").alpha, 2)
    0.84
    """
    if not isinstance(controller, Axes):
        how: dict[str, Any] = {"delay": delay, "actuator_lag": actuator_lag}
        return analyse_axis(plant, controller, at=at, operating_point=operating_point, **how)
    if at is not None:
        raise ValueError("at: of one axis only; analyse its ADRC on the plant that it sees")
    _refuse(delay, actuator_lag)
    return analyse_axes(plant, controller, operating_point)


@overload
def certify(plants: Any, controller: Axes, operating_point: Any = None) -> CoupledCertificate: ...


@overload
def certify(
    plants: Any,
    controller: Controller,
    operating_point: Any = None,
    *,
    delay: float = 0.0,
    actuator_lag: float = 0.0,
) -> Certificate: ...


def certify(
    plants: Any,
    controller: Controller | Axes,
    operating_point: Any = None,
    *,
    delay: float = 0.0,
    actuator_lag: float = 0.0,
) -> Certificate | CoupledCertificate:
    """Compute what guards guarantee for the loops of linear plants, whatever the learners do.

    The loop is the sampled one, without limits, with the form of its observers, delays and lag. Of
    several axes the plant may have other couplings than B0.

    Parameters
    ----------
    plants
        a plant as for ``analyse``; of one axis also a list of plants, or ``{name: plant}``. The
        bounds hold for these plants, not for those between them.
    controller
        an ``ADRC``, or ``Axes``; κ is that of the guard. Without guard or learner κ is that of
        ``Guard()``, and ``condition``, the first line of the text, says that the bounds are not
        those of this loop.
    operating_point
        state and control signals ``(x, u)`` about which nonlinear plants are linearised.
    delay
        of one axis, additional dead time of the loops [s]; of several, delay the plant.
    actuator_lag
        of one axis, time constant of a first-order lag between u and the plants [s].

    Returns
    -------
    Certificate or CoupledCertificate
        of one axis, or of several.

    Raises
    ------
    ValueError
        for a loop that is unstable without learner, another controller, a nonlinear law or
        observer, a nonlinear plant without operating point, and options of one axis with several.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=0.005)
    >>> plants = {f"b = {b}": ([b], [1.0, 0.0, 0.0]) for b in (0.7, 1.0, 1.3)}
    >>> learner, guard = ql.learners.Kalman(), ql.Guard(certified_for=plants)
    >>> controller = ql.ADRC(observer, omega_c=1.0, learner=learner, guard=guard)
    >>> found = certify(plants, controller)
    >>> found.certified, found.worst, round(found.gain, 2)
    (True, 'b = 0.7', 0.52)

    Two axes whose inertia couples them by a third, and whose law does not know it:

    >>> import numpy as np
    >>> A, B = np.kron(np.eye(2), [[0, 1], [0, 0]]), np.kron([[1.2, 0.4], [0.4, 1.2]], [[0], [1]])
    >>> axis = ql.ADRC(observer, omega_c=1.0, learner=learner, guard=ql.Guard())
    >>> found = certify((A, B, np.eye(4)[[0, 2]]), ql.Axes({"x": axis, "y": axis}))
    >>> found.certified, found.gains.round(2).tolist()
    (False, [[0.25, 0.46], [0.46, 0.25]])
    """
    if not isinstance(controller, Axes):
        how: dict[str, Any] = {"delay": delay, "actuator_lag": actuator_lag}
        return certify_axis(plants, controller, operating_point=operating_point, **how)
    _refuse(delay, actuator_lag)
    return certify_axes(plants, controller, operating_point)


def _refuse(delay: float, actuator_lag: float) -> None:
    """Raise a ``ValueError`` for what is added to the plant of one axis only."""
    for name, value in (("delay", delay), ("actuator_lag", actuator_lag)):
        if value != 0.0:
            raise ValueError(
                f"{name} = {value!r}: of one axis only; give Axes a plant with it, as "
                "quell.plants.delayed_inputs makes it"
            )


# ---- The certificate of a loop whose b0 is estimated online ----

# Values of b/b0 at which M_s is calculated, equidistant in its logarithm: between two of them, 3 %
# apart for an interval of 4, it changes by about as much.
_RATIOS = 41
# Frequencies around the peak of the worst one.
_REFINED = 400


class OnlineCertificate(NamedTuple):
    """Bounds that hold for every b0 that an ``OnlineGain`` can find, and every b in its limits."""

    ratio: tuple[float, float]  #: lowest and highest b/b0 of the interval
    stable: tuple[float, float]  #: range of b/b0 for which the frozen loop is stable
    m_s: float  #: largest M_s over the interval; infinite if it is not stable
    m_s_matched: float  #: M_s with b0 = b

    @property
    def holds(self) -> bool:
        """Whether the loop is stable in the whole interval."""
        return self.stable[0] < self.ratio[0] and self.ratio[1] < self.stable[1]

    @property
    def most(self) -> float:
        """The largest high/low for which it would hold."""
        return min(1.0 / self.stable[0] if self.stable[0] > 0.0 else math.inf, self.stable[1])

    def __str__(self) -> str:
        """Return the certificate as a sentence."""
        low, high = self.ratio
        rest = f"b/b0 from {self.stable[0]:.3g} to {self.stable[1]:.3g} is stable"
        asked = f"the limits allow {low:.3g} to {high:.3g}"
        if not self.holds:
            return (
                f"NOT certified: {rest}, and {asked}; narrow them to high/low below "
                f"{self.most:.3g}, or lower omega_c"
            )
        return f"certified: {rest}, {asked}; M_s {self.m_s_matched:.3f}, at most {self.m_s:.3f}"


def certify_online(plant: Any, controller: ADRC, *, delay: float = 0.0) -> OnlineCertificate:
    """Return whether a loop is stable for each b0 of its ``OnlineGain`` and each b in its limits.

    Parameters
    ----------
    plant
        a linear plant, as for ``analyse``; its own b is one of those in the limits, and all others
        have the same poles.
    controller
        an ``ADRC`` with ``schedule=OnlineGain(...)``.
    delay
        of u besides the plant's own [s].

    Raises
    ------
    ValueError
        for a controller without ``OnlineGain``, and for a plant whose b is outside of its limits or
        whose loop is unstable even with b0 = b.

    Examples
    --------
    >>> import quell as ql
    >>> axis = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 2000.0], [1.0, 0.0])
    >>> observer = ql.ESO.model_free(order=2, b0=2000.0, omega_o=300.0, dt=5e-4)
    >>> online = ql.OnlineGain(low=1500.0, high=3000.0)
    >>> certificate = certify_online(axis, ql.ADRC(observer, omega_c=60.0, schedule=online))
    >>> certificate.holds, round(certificate.m_s, 2)
    (True, 2.24)
    """
    online = getattr(controller, "schedule", None)
    if not isinstance(online, OnlineGain):
        raise ValueError(
            f"controller = {controller!r}: must be an ADRC with schedule = OnlineGain(low, high)"
        )
    linear, _ = linear_part(plant, controller.dt, None)
    b = canonical(linear).b
    if not online.low <= b <= online.high:
        raise ValueError(
            f"plant has b = {b:.6g}, outside of low = {online.low!r} … high = {online.high!r}: "
            "the estimate can not find it; give limits that contain it"
        )
    loop = analyse_axis(plant, controller.at(b), delay=delay)
    if not loop.stable:
        raise ValueError(
            "the loop is unstable with b0 = b: lower omega_c or omega_o, no estimate can help"
        )
    low, high = sorted(loop.margins.gain)
    most = online.largest_ratio
    found = OnlineCertificate((1.0 / most, most), (low, high), math.inf, 1.0 / loop.margins.modulus)
    if not found.holds:
        return found
    L = loop.response("L", loop.omega)
    ratios = np.geomspace(1.0 / most, most, _RATIOS)
    least = [np.abs(1.0 + ratio * L) for ratio in ratios]
    worst = int(np.argmin([np.min(each) for each in least]))
    at = int(np.argmin(least[worst]))
    near = loop.omega[max(at - 1, 0)], loop.omega[min(at + 1, loop.omega.size - 1)]
    fine = loop.response("L", np.linspace(*near, _REFINED))
    return found._replace(m_s=1.0 / float(np.min(np.abs(1.0 + ratios[worst] * fine))))


# ---- The loop at several operating points ----

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
        return nonfinite_to_none({"points": rows, "verdicts": self.verdicts()})


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
