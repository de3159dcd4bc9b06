"""The certificate of a loop whose b0 is estimated online: for the whole interval of b0 and b.

The feedback of an ADRC is 1/b0 times one that does not depend on b0. With the plant's input gain b
the open loop is therefore ``L = (b/b0) L_1``, at any fixed b0. With b0 and b within [low, high] the
ratio is within [low/high, high/low], and the loop is stable for all of them if the range of the
ratio for which it is stable, which the gain margins are, contains that interval.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell.analysis.loop import analyse_axis
from quell.controllers.adrc import ADRC
from quell.controllers.online_gain import OnlineGain
from quell.lti.canonical import canonical
from quell.plants.linearise import linear_part

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
