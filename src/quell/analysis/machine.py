"""The loop and the certificate of a controller, of one axis or of several.

A loop whose b0 is estimated online has a certificate for the whole interval of b0 and b. The
feedback of an ADRC is 1/b0 times one that does not depend on b0. With the plant's input gain b
the open loop is therefore ``L = (b/b0) L_1``, at any fixed b0. With b0 and b within [low, high] the
ratio is within [low/high, high/low], and the loop is stable for all of them if the range of the
ratio for which it is stable, which the gain margins are, contains that interval.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, overload

import numpy as np

from quell.analysis.certificate import Certificate, certify_axis
from quell.analysis.coupled import CoupledCertificate, certify_axes
from quell.analysis.loop import LoopAnalysis, analyse_axis
from quell.analysis.multivariable import MultivariableLoop, analyse_axes
from quell.controllers.adrc import ADRC
from quell.controllers.axes import Axes
from quell.controllers.base import Controller
from quell.controllers.online_gain import OnlineGain
from quell.hints import explained
from quell.lti.canonical import canonical
from quell.plants.linearise import linear_part

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
