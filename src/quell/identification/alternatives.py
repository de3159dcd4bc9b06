"""Other structures for the same record, and whether the record decides between them.

Two models are compared by their errors e and e' of simulation, over blocks of the record::

    D_i = log(Σ e²) − log(Σ e'²) in block i,     z = mean(D) √B / std(D),     i = 1 … B

The second is better if z is above zero by more than chance explains: for equal models it is
Student's t with B − 1 degrees of freedom, as in the test of Diebold & Mariano (*J. Business &
Economic Statistics* 13, 1995), with logarithms, so that a block of large errors does not decide
alone, and blocks, because errors of simulation are correlated over long times. A larger model
always fits a little better where it was fitted; this is a bias to its favour, so the test says
little where a larger model is just better, and much where it is not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from quell.identification.identify import identify
from quell.identification.result import Identified

# Blocks: each should be longer than the correlation of the errors, and there should be enough of
# them for their variance. Chosen by hand.
_BLOCKS = 12
# Share of y's power that counts as no error: a fit of 99.9999 %, beyond any real record.
_EXACT = 1e-12
# Probability that equal models are taken for different.
_LEVEL = 0.01
# Logarithm of a ratio of squared errors that counts as none: 1 % of the error. With many samples a
# needless pole explains some noise in every block.
_EQUAL = 0.02
# Share of the limit from which on z is a hint. Chosen by hand.
_HINT = 0.5
# The structure of a mass with friction.
_RIGID = "order 2 with friction"
# Least and largest order that ``identify`` fits, and least order in which friction has a place.
_LEAST_ORDER, _MOST_ORDER, _LEAST_WITH_FRICTION = 1, 8, 2


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another structure for a record, compared with the model at hand."""

    name: str  #: what is different, for example ``"order 3"`` or ``"Coulomb friction"``
    smaller: bool  #: whether it has fewer parameters
    gain: float  #: mean of D: how much smaller the logarithm of its squared error is
    z: float  #: above zero where it is better; see ``quell.identification.alternatives``
    limit: float  #: |z| from which on the record decides, at 99 %
    model: Identified  #: its fit
    options: str  #: what to give to ``quell identify`` for it

    @property
    def verdict(self) -> str:
        """``"better"``, ``"worse"``, or ``"undecided"`` if the record does not decide."""
        if abs(self.z) < self.limit or abs(self.gain) < _EQUAL:
            return "undecided"
        return "better" if self.z > 0.0 else "worse"

    @property
    def may_be_as_good(self) -> bool:
        """Whether there is no hint that it is worse."""
        return self.z > -_HINT * self.limit or self.gain > -_EQUAL

    def describe(self, than: Identified) -> str:
        """Return a line of text that compares it with ``than``, empty if it is of no use."""
        key = "held out" if "held out" in than.fits else "estimation"
        fits = f"{self.model.fits[key]:.2f} instead of {than.fits[key]:.2f} % ({key})"
        known = "no friction" if than.friction is None else "friction"
        here = f"order {than.den.size - 1}" if self.name.startswith("order") else known
        if self.name == _RIGID:
            here = f"{here} without friction"
        if self.verdict == "better":
            return f"SUGGESTION: {self.name} ({self.options}) fits better: {fits}, z = {self.z:.1f}"
        hinted = "friction" in self.name and self.z > _HINT * self.limit
        if self.verdict == "worse" or not (self.smaller or hinted):
            return ""
        taken = f"{self.name} ({self.options})" if self.smaller else here
        return (
            f"the record cannot decide between {here} and {self.name}: {fits}, z = {self.z:.1f}, "
            f"limit {self.limit:.1f}; take {taken}, which has fewer parameters, or record more"
        )

    def to_json(self) -> dict[str, Any]:
        """Return name, verdict and fits for JSON."""
        names = ("name", "options", "smaller", "gain", "z", "limit", "verdict")
        return {name: getattr(self, name) for name in names} | {"fits": self.model.fits}


def alternatives(
    found: Identified, delay: tuple[float, float] | None = None
) -> tuple[Alternative, ...]:
    """Fit other structures to the record of a model, and compare them with it.

    They are: one pole less, and one zero less; if the error is not white, also the opposite of the
    given assumption on Coulomb friction, and for a larger model without friction that of a mass
    with friction, unless friction would drive the plant; and one pole more, if the error depends on
    past u and the model has no ``shortcomings``. A structure that cannot be fitted is left out.

    Parameters
    ----------
    found
        result of ``identify``.
    delay
        least and largest delay to search [s]; that of the model by default. With fewer poles
        another delay may be the best.
    """
    order, zeros, rubs = found.den.size - 1, found.num.size - 1, found.friction is not None
    direct = zeros == order
    tried: list[tuple[str, bool, dict[str, Any]]] = []
    if order > _LEAST_ORDER:
        fewer = {"order": order - 1, "zeros": min(zeros, order - 1) - (not direct and zeros > 0)}
        tried.append((f"order {order - 1}", True, fewer))
    if not found.residuals.white:
        if order >= _LEAST_WITH_FRICTION and not direct and found.reference is None:
            name = "no friction" if rubs else "Coulomb friction"
            tried.append((name, rubs, {"friction": not rubs}))
            if order > _LEAST_WITH_FRICTION and not rubs:
                tried.append((_RIGID, True, {"order": 2, "zeros": 0, "friction": True}))
        if order < _MOST_ORDER and not found.residuals.independent and not found.shortcomings:
            more = {"order": order + 1, "zeros": zeros + direct}
            tried.append((f"order {order + 1}", False, more))
    options: dict[str, Any] = {"order": order, "zeros": zeros, "friction": rubs}
    options |= {
        "delay": found.delay if delay is None else delay,
        "held_out": 1.0 - found.held_from / found.y.size,
    }
    options |= {"reference": found.reference, "horizon": found.horizon, "signals": found.signals}
    models = []
    for name, smaller, change in tried:
        try:
            model = identify(found.u, found.y, found.dt, **(options | change))
        except ValueError:  # too short a record for it, or no such model
            continue
        if model.friction is not None and model.friction <= 0.0:  # it would drive the plant
            continue
        flags = _options(change)
        models.append(Alternative(name, smaller, *_compared(found, model), model, flags))
    return tuple(models)


def decided(found: Identified, delay: tuple[float, float] | None = None) -> Identified:
    """Return the model that the record supports: with friction if it fits better, of least order.

    First a better alternative is taken, then, one after the other, smaller ones without a hint that
    they are worse. ``delay`` is that of ``alternatives``.
    """
    for _ in range(_MOST_ORDER):
        others = alternatives(found, delay)
        better = [one for one in others if one.verdict == "better" and one.model.converged]
        smaller = [one for one in others if one.smaller and one.may_be_as_good]
        if not better and not smaller:
            break
        found = max(better or smaller, key=lambda one: one.z).model
    return found


def _options(change: dict[str, Any]) -> str:
    """Return a change of arguments as options of the command line."""
    friction = []
    if "friction" in change:
        friction = ["--friction" if change["friction"] else "--no-friction"]
    numbers = [f"--{name} {change[name]}" for name in ("order", "zeros") if change.get(name)]
    return " ".join([*numbers, *friction])


def _compared(first: Identified, second: Identified) -> tuple[float, float, float]:
    """Return the mean of D, z, above zero if the second model is better, and the limit of z."""
    from scipy.stats import t

    powers = [
        [float(np.sum(part**2)) for part in np.array_split(one.y - one.simulated, _BLOCKS)]
        for one in (first, second)
    ]
    # Without any error, as in exact records, no model is better.
    least = _EXACT * float(np.sum((first.y - np.mean(first.y)) ** 2))
    gain = np.log(np.array(powers[0]) + least) - np.log(np.array(powers[1]) + least)
    spread = float(np.std(gain, ddof=1)) / np.sqrt(_BLOCKS)
    limit = float(t.isf(0.5 * _LEVEL, _BLOCKS - 1))
    mean = float(np.mean(gain))
    return mean, (mean / spread if spread > 0.0 else 0.0), limit
