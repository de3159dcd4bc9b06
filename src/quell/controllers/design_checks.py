"""What makes a design unwise though it is possible, as far as the design alone tells.

An observer places its poles in the z-plane, so it is stable at any sample time; what slow sampling takes is margin. Measured on the loop
with the plant that the design assumes, a chain of n = 1 … 4 integrators, with omega_o 3 and 10 times omega_c (docs/analysis): the modulus
margin is 8 to 16 % smaller than with fast sampling at ``omega_o dt = 1`` for the current form, and 9 to 14 % at 0.3 for the predictor
form, which has a sample of delay more. The law's gains are those of continuous
time: beyond ``omega_c dt = 0.5`` loops of orders 3 and 4 are lost suddenly (with omega_o = omega_c
all are at 0.7, none at 0.5). A known delay of u is not in the observer's way, but stays in the loop: with omega_o 3 to 10 times omega_c,
the chains have modulus margins of about 0.39, 0.33, 0.28 and 0.22 at ``n omega_c delay = 0.5``, and are lost between 1.2 and 1.6.
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

from quell.types import DesignWarning

# omega_o dt by the form of the observer, and omega_c dt.
_OBSERVER_LIMIT = {"current": 1.0, "predictor": 0.3}
_LAW_LIMIT = 0.5
# Order times omega_c times a known delay of u.
_DELAY_LIMIT = 0.5


class Finding(NamedTuple):
    """Something that makes a design unwise."""

    subject: str
    """``"sampling"``, ``"noise"``, ``"lag"``, ``"margin"`` or ``"stability"``."""
    value: float
    limit: float
    message: str
    """What it is, with both numbers, and what to do."""

    def __str__(self) -> str:
        return self.message


def sampling_findings(observer: Any, omega_c: float) -> list[Finding]:
    """Return what an observer's sample time, and a delay that it knows of, make unwise."""
    dt, form = observer.dt, getattr(observer, "form", "current")
    found = []
    value, limit = observer.omega_o * dt, _OBSERVER_LIMIT.get(form, _OBSERVER_LIMIT["current"])
    if value > limit:
        other = (
            ", or take the current form"
            if form == "predictor" and value <= _OBSERVER_LIMIT["current"]
            else ""
        )
        found.append(
            Finding(
                *("sampling", value, limit),
                f"omega_o * dt = {value:.3g} is above {limit:g}: there sampling costs up to a sixth of the modulus margin, beyond it more; "
                f"sample every {limit / observer.omega_o:.3g} s or faster, lower omega_o to {limit / dt:.3g} rad/s{other}",
            )
        )
    value = omega_c * dt
    if value > _LAW_LIMIT:
        found.append(
            Finding(
                *("sampling", value, _LAW_LIMIT),
                f"omega_c * dt = {value:.3g} is above {_LAW_LIMIT:g}: the law's gains are made for faster sampling, the loop may be lost; "
                f"sample every {_LAW_LIMIT / omega_c:.3g} s or faster, or lower omega_c to {_LAW_LIMIT / dt:.3g} rad/s",
            )
        )
    delay = dt * getattr(observer.model, "samples", 0)
    value = observer.degree * omega_c * delay
    if value > _DELAY_LIMIT:
        found.append(
            Finding(
                *("lag", value, _DELAY_LIMIT),
                f"order * omega_c * delay = {value:.3g} is above {_DELAY_LIMIT:g}: the delay stays in the loop, lost soon after 1; "
                f"lower omega_c to {_DELAY_LIMIT / (observer.degree * delay):.3g} rad/s",
            )
        )
    return found


def warn_if_unwise(observer: Any, omega_c: float, stacklevel: int = 3) -> None:
    """Issue a ``DesignWarning`` for each thing that makes a design unwise, on behalf of the caller's caller."""
    for finding in sampling_findings(observer, omega_c):
        warnings.warn(finding.message, DesignWarning, stacklevel=stacklevel)
