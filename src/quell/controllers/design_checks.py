"""Design rules for the sample time and a known delay, judged from the design alone.

An observer places its poles in the z-plane, so it is stable at any sample time, but slow sampling
reduces the margins. Measured on the loop with the plant that the design assumes, a chain of n = 1 …
4 integrators, with omega_o 3 and 10 times omega_c (docs/analysis): compared with fast sampling the
modulus margin is 8 to 16 % smaller at ``omega_o dt = 1`` for the current form, and 9 to 14 % at 0.3
for the predictor form, which has one more sample of delay. The law's gains are those of continuous
time: with omega_o = omega_c, the loops of order 3 and 4 are stable at ``omega_c dt = 0.5`` and
unstable at 0.7. The observer takes account of a known delay of u, but the delay stays in the loop:
with omega_o 3 to 10 times omega_c, the chains have modulus margins of about 0.39, 0.33, 0.28 and
0.22 at ``n omega_c delay = 0.5``, and become unstable between 1.2 and 1.6.
"""

from __future__ import annotations

import math
import warnings
from typing import NamedTuple

from quell.lti.canonical import format_roots
from quell.observers.eso import ESO
from quell.types import DesignWarning
from quell.warn import warn

# Limits of omega_o dt by the form of the observer, of omega_c dt, and of order times omega_c times
# a known delay of u; measured as described above.
_OBSERVER_LIMIT = {"current": 1.0, "predictor": 0.3}
_LAW_LIMIT = 0.5
_DELAY_LIMIT = 0.5
# A product that rounding alone puts above its limit keeps to it, as that of a tuner which ends at
# the limit.
_ROUNDING = 1.0 + 1e-9


class Finding(NamedTuple):
    """A weak point of a design."""

    subject: str  #: "sampling", "bandwidth", "margin", "learner", "lag", "noise" or "stability"
    value: float
    limit: float
    message: str  # the weak point, with both numbers, and what to do

    def __str__(self) -> str:
        return self.message


def known_samples(observer: ESO) -> int:
    """Return the delay of u that an observer knows [samples]."""
    return int(getattr(observer.model, "samples", 0))


def sampling_findings(observer: ESO, omega_c: float) -> list[Finding]:
    """Return the findings about the sample time and about a delay that the observer knows."""
    dt, form = observer.dt, observer.form
    found = []
    value, limit = observer.omega_o * dt, _OBSERVER_LIMIT.get(form, _OBSERVER_LIMIT["current"])
    if value > _ROUNDING * limit:
        current_helps = form == "predictor" and value <= _OBSERVER_LIMIT["current"]
        cost = "there sampling costs up to a sixth of the modulus margin, beyond it more"
        if value >= math.pi:
            cost = (
                f"with its poles at z = {observer.pole:.2g} the observer follows every sample of "
                "y, noise included"
            )
        message = (
            f"omega_o * dt = {value:.3g} is above {limit:g}: {cost}; "
            f"sample every {limit / observer.omega_o:.3g} s or faster, "
            f"lower omega_o to {limit / dt:.3g} rad/s{', or take the current form' * current_helps}"
        )
        found.append(Finding("sampling", value, limit, message))
    value = omega_c * dt
    if value > _ROUNDING * _LAW_LIMIT:
        message = (
            f"omega_c * dt = {value:.3g} is above {_LAW_LIMIT:g}: the law's gains are made for "
            "faster sampling, the loop may be unstable; "
            f"sample every {_LAW_LIMIT / omega_c:.3g} s or faster, "
            f"or lower omega_c to {_LAW_LIMIT / dt:.3g} rad/s"
        )
        found.append(Finding("sampling", value, _LAW_LIMIT, message))
    delay = dt * known_samples(observer)
    value = observer.degree * omega_c * delay
    if value > _ROUNDING * _DELAY_LIMIT:
        message = (
            f"order * omega_c * delay = {value:.3g} is above {_DELAY_LIMIT:g}: the delay stays in "
            "the loop, which becomes unstable soon after 1; "
            f"lower omega_c to {_DELAY_LIMIT / (observer.degree * delay):.3g} rad/s"
        )
        found.append(Finding("lag", value, _DELAY_LIMIT, message))
    return found


def warn_if_unwise(observer: ESO, omega_c: float, stacklevel: int | None = None) -> None:
    """Issue a ``DesignWarning`` for each finding.

    Its source is the nearest line outside of quell, or the one ``stacklevel`` frames above.
    """
    for finding in sampling_findings(observer, omega_c):
        if stacklevel is None:
            warn(finding.message)
        else:
            warnings.warn(finding.message, DesignWarning, stacklevel=stacklevel)


def check_zeros(observer: ESO) -> None:
    """Check that the plant's inverse is stable: the zeros from u become poles of u."""
    unstable = observer.plant.unstable_zeros
    if unstable.size:
        raise ValueError(
            f"observer: the plant has zeros from u at {format_roots(unstable)} rad/s, not in the "
            "left half plane; ADRC inverts the plant, so u would grow or oscillate while "
            "y looks well; control another output, or use a controller that does not invert the "
            "plant (linear-quadratic, for instance)"
        )
