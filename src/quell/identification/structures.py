"""Other structures for the same record, and whether the record decides between them.

Where the larger of two models explains the response to u (``Identified.explained``), the ratio of
likelihoods decides. With both errors whitened by the noise model of the larger one's error,

    L = N (log Σ w² − log Σ w'²)

is χ² with as many degrees of freedom as it has more parameters, p, if the smaller one is true
(Ljung, *System Identification*, 2nd ed. 1999, sec. 16.4). This holds also where all information is
in a few samples, as in the record of one step. A needless pole is put where it explains most of the
noise: of some N frequencies, dampings and delays that is χ² of 2 log N and more. So L has to exceed
Schwarz's ``p log N`` (*Annals of Statistics* 6, 1978) and 2 log N besides, too.

Where neither model is true, as with most machines, a needless pole always explains something. Then
two models are compared by their errors e and e' of simulation, over blocks of the record::

    D_i = log(Σ e²) − log(Σ e'²) in block i,     z = mean(D) √B / std(D),     i = 1 … B

The second is better if z is above zero by more than chance explains: for equal models it is
Student's t with B − 1 degrees of freedom, as in the test of Diebold & Mariano (*J. Business &
Economic Statistics* 13, 1995), with logarithms, so that a block of large errors does not decide
alone, and blocks, because errors of simulation are correlated over long times. A larger model
always fits a little better where it was fitted; this is a bias to its favour, so the test says
little where a larger model is just better, and much where it is not.

A delay may stand for a lag τ, as ``1/(1 + jωτ) = exp(−jωτ) (1 − (ωτ)²/2 + …)``: a model with one
lag less and a delay that is longer by about τ explains nearly the same, and its interval of the
delay does not hold the truth, while that of the larger model, with both, does. Here no frequency is
searched for: of a lag that may be zero L is half of χ² with one degree of freedom (Self & Liang,
*J. American Statistical Association* 82, 1987, case 5), and the lag is kept from ``L = 2`` on
(Akaike, *IEEE Trans. Automatic Control* 19, 1974), which one without a lag exceeds by chance in 8 %
of the records.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from quell.identification.given_records import Records
from quell.identification.identify import (
    LEAST_WITH_ZEROS,
    ZEROS,
    Options,
    identified,
    known_of,
    ratio_of_models,
)
from quell.identification.result import Identified
from quell.parallel import part_of

# Blocks: each should be longer than the correlation of the errors, and there should be enough of
# them for their variance. Chosen by hand.
_BLOCKS = 12
# Share of y's power that counts as no error: a fit of 99.9999 %, beyond any real record.
_EXACT = 1e-12
# Probability that equal models are taken for different.
_LEVEL = 0.01
# L of a lag against a delay, from Akaike's criterion, and the deviation of the lag's pole, as a
# share of it, up to which it is known, by hand.
_LAG, _KNOWN = 2.0, 1.5
# Logarithm of a ratio of squared errors that counts as none: 1 % of the error. With many samples a
# needless pole explains some noise in every block.
_EQUAL = 0.02
# Share of the limit from which on z is a hint. Chosen by hand.
_HINT = 0.5
# The structure of a mass with friction.
_RIGID = "order 2 with friction"
# Least and largest order that ``identify`` fits, and least order in which friction has a place.
_LEAST_ORDER, _MOST_ORDER, _LEAST_WITH_FRICTION = 1, 8, 2


OF_MODEL: Literal["of model"] = "of model"
"""Stands for the delay of the model at hand."""

Delay = tuple[float, float] | float | None | Literal["of model"]


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another structure for a record, compared with the model at hand."""

    name: str  #: what is different, for example ``"order 3"`` or ``"Coulomb friction"``
    smaller: bool  #: whether it has fewer parameters
    gain: float  #: mean of D: how much smaller the logarithm of its squared error is
    #: above zero where it is better: L with that sign where the larger model explains the response,
    #: else z; see ``quell.identification.alternatives``
    z: float
    limit: float  #: |z| from which on the record decides, at 99 %
    by_likelihood: bool  #: whether L decides
    model: Identified  #: its fit
    options: str  #: what to give to ``quell identify`` for it
    in_delay: float = 0.0  #: lag that its delay stands for, which the record shows [s]; 0: none

    @property
    def verdict(self) -> str:
        """``"better"``, ``"worse"``, or ``"undecided"`` if the record does not decide."""
        too_small = abs(self.gain) < _EQUAL and not self.by_likelihood
        if abs(self.z) < self.limit or too_small:
            return "undecided"
        return "better" if self.z > 0.0 else "worse"

    @property
    def may_be_as_good(self) -> bool:
        """Whether there is no hint that it is worse."""
        if self.in_delay:
            return False
        if self.by_likelihood:
            return self.z > -self.limit
        return self.z > -_HINT * self.limit or self.gain > -_EQUAL

    @property
    def usable(self) -> bool:
        """Whether its model converged, has no ``faults``, and nothing is ``undecided``."""
        return not self._why_not

    @property
    def _why_not(self) -> str:
        """Why its model is of no use, whatever its fit; empty if it may be."""
        if not self.model.converged:
            return "its search did not converge"
        return next(iter([*self.model.faults, *self.model.undecided]), "")

    @property
    def _measure(self) -> str:
        """The measure that decides, and its limit."""
        name = "likelihood ratio" if self.by_likelihood else "z"
        return f"{name} {abs(self.z) if self.by_likelihood else self.z:.1f}, limit {self.limit:.1f}"

    def describe(self, than: Identified) -> str:
        """Return a line of text that compares it with ``than``, empty if it is of no use."""
        key = "held out" if "held out" in than.fits else "estimation"
        fits = f"{self.model.fits[key]:.2f} instead of {than.fits[key]:.2f} % ({key})"
        known = "no friction" if than.friction is None else "friction"
        here = f"order {than.den.size - 1}" if self.name.startswith("order") else known
        if self.name == _RIGID:
            here = f"{here} without friction"
        if self.verdict == "better":
            text = f"{self.name} ({self.options}) fits better: {fits}, {self._measure}"
            if self._why_not:
                return f"{text}; but do NOT take it: {self._why_not}"
            if self.model.shortcomings:
                return (
                    f"NOT: {text}; it is nearer, but NOT good either: {self.model.shortcomings[0]}"
                )
            return f"NOT: {text}; take it"
        hinted = "friction" in self.name and self.z > _HINT * self.limit
        if self.verdict == "worse" or not (self.smaller or hinted):
            return ""
        if self.in_delay:
            return (
                f"{self.name} ({self.options}) has a longer delay in place of a lag of "
                f"{self.in_delay:.3g} s, which the record shows: {fits}; take {here}"
            )
        taken = f"{self.name} ({self.options})" if self.smaller else here
        return (
            f"the record cannot decide between {here} and {self.name}: {fits}, {self._measure}; "
            f"take {taken}, which has fewer parameters, or record more"
        )

    def to_json(self) -> dict[str, Any]:
        """Return name, verdict and fits for JSON."""
        names = ("name", "options", "smaller", "gain", "z", "limit", "by_likelihood", "verdict")
        return {name: getattr(self, name) for name in names} | {"fits": self.model.fits}


def alternatives(
    found: Identified,
    delay: Delay = OF_MODEL,
    *,
    integrators: int | None = None,
    friction: bool | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[Alternative, ...]:
    """Fit other structures to the record of a model, and compare them with it.

    They are: one pole less, and one zero less; if the error is not white, also the opposite of the
    given assumption on Coulomb friction, and for a larger model without friction that of a mass
    with friction, unless friction would drive the plant or may be none; and one pole more, if the
    model does not explain the response to u or leaves something ``undecided``, and has no
    ``faults``; and two zeros from order 4 on, if the model has fewer and does not explain the
    response to u or has ``faults``: a motor with its encoder before a flexible coupling has them.
    A structure that cannot be fitted is left out.

    Parameters
    ----------
    found
        result of ``identify``.
    delay
        least and largest delay to search [s], or None to search all; that of the model by default.
        With fewer poles another delay may be the best.
    integrators, friction
        what all alternatives have: number of poles at s = 0, and whether there is friction; by
        default both are open.
    progress
        gets the share of the structures that are fitted; an exception in it ends the work.
    """
    order, zeros, rubs = found.den.size - 1, found.num.size - 1, found.friction is not None
    direct = zeros == order
    tried: list[tuple[str, bool, dict[str, Any]]] = []
    if order > _LEAST_ORDER:
        fewer = {"order": order - 1, "zeros": min(zeros, order - 1) - (not direct and zeros > 0)}
        tried.append((f"order {order - 1}", True, fewer))
    if not found.residuals.white:
        open_to_friction = friction is None and found.reference is None
        if order >= _LEAST_WITH_FRICTION and not direct and open_to_friction:
            name = "no friction" if rubs else "Coulomb friction"
            tried.append((name, rubs, {"friction": not rubs}))
            if order > _LEAST_WITH_FRICTION and not rubs:
                tried.append((_RIGID, True, {"order": 2, "zeros": 0, "friction": True}))
    doubtful = not found.explained or bool(found.undecided)
    if order < _MOST_ORDER and doubtful and not found.faults:
        tried.append((f"order {order + 1}", False, {"order": order + 1, "zeros": zeros + direct}))
    if order >= LEAST_WITH_ZEROS and zeros < ZEROS and (not found.explained or found.faults):
        name = f"order {order} with {ZEROS} zeros"
        tried.append((name, False, {"order": order, "zeros": ZEROS}))
    held_out = None if found.samples else 1.0 - found.held_from / found.y.size
    same = Options(
        order,
        zeros,
        integrators,
        found.delay if delay is OF_MODEL else delay,
        True,
        rubs,
        None,
        held_out,
        found.horizon,
    )
    records, models = Records(found.u, found.y, found.samples), []
    for i, (name, smaller, change) in enumerate(tried):
        options = same._replace(**change)
        options = options._replace(rest=_rest(found, smaller, options.friction))
        known = known_of(found) if options.order == order - 1 and not options.friction else None
        given = found.reference, None, found.signals
        share = part_of(progress, i, i + 1, len(tried))
        try:
            model = identified(records, found.dt, options, *given, known, share)
            nearer = model.fits["estimation"] > found.fits["estimation"]
            if nearer and not (model.converged or model.faults or options.friction):
                # Far better, perhaps, and only not confirmed: the search goes on from there.
                model = identified(records, found.dt, options, *given, known_of(model), share)
        except ValueError:  # too short a record for it, or no such model
            continue
        model = replace(model, rest_given=found.rest_given)
        if model.friction is not None and not model.rubs:
            continue
        flags = _options(change)
        nested = name != _RIGID
        measures = _compared(found, model, smaller) if nested else _by_blocks(found, model)
        in_delay = lag_in_delay(model, found) if smaller and nested else 0.0
        models.append(Alternative(name, smaller, *measures, model, flags, in_delay))
    return tuple(models)


def _rest(found: Identified, smaller: bool, friction: bool) -> bool | None:
    """Return the assumption on the start for another structure; None if it is to be tested again.

    A smaller model is compared under the same assumption, if that has decided the gain.
    """
    if found.rest_given or (smaller and found.rest):
        return not friction
    return False if smaller and not found.undecided else None


def decided(found: Identified, delay: Delay = OF_MODEL, **given: Any) -> Identified:
    """Return the model that the record supports: with friction if it fits better, of least order.

    First a better alternative is taken, then, one after the other, smaller ones that may be as
    good, or that replace a model with ``faults`` at hardly any loss. ``delay`` and ``given`` are
    arguments of ``alternatives``.
    """
    return not_told_apart(found, delay, **given)[0]


def not_told_apart(
    found: Identified,
    delay: Delay = OF_MODEL,
    *,
    progress: Callable[[float], None] | None = None,
    **given: Any,
) -> tuple[Identified, ...]:
    """Return the model that ``decided`` returns, and those that the record does not tell from it.

    These are the larger models from which a smaller one was taken because it may be as good, if
    they have no ``faults``. A smaller one with faults is a step to the next smaller one that is
    as good, and not the result. ``progress`` gets the share of the work that is done, about.
    """
    kept: list[Identified] = []
    for step in range(_MOST_ORDER):
        # The share that is done after each step: a half, two thirds, three quarters, …
        first, last = (k / (k + 1.0) for k in (step, step + 1))
        others = alternatives(found, delay, progress=part_of(progress, first, last, 1.0), **given)
        better = [one for one in others if one.verdict == "better" and one.model.converged]
        better = [one for one in better if one.usable] or (better if found.faults else [])
        doubtful = bool(found.faults) or not found.converged
        smaller = [
            one
            for one in others
            if one.smaller
            and (one.may_be_as_good or (doubtful and not kept and one.gain > -_EQUAL))
        ]
        if not better and not smaller:
            break
        kept = [] if better else kept if doubtful else [*kept, found]
        found = max(better or smaller, key=lambda one: one.z).model
    kept = [one for one in kept if not one.faults]
    return (kept.pop(), *kept) if found.faults and kept else (found, *kept)


def _options(change: dict[str, Any]) -> str:
    """Return a change of arguments as options of the command line."""
    friction = []
    if "friction" in change:
        friction = ["--friction" if change["friction"] else "--no-friction"]
    numbers = [f"--{name} {change[name]}" for name in ("order", "zeros") if change.get(name)]
    return " ".join([*numbers, *friction])


def _compared(
    found: Identified, model: Identified, smaller: bool
) -> tuple[float, float, float, bool]:
    """Return the mean of D, L or z (above zero if ``model`` is better), the limit, if it is L."""
    from scipy.stats import chi2

    gain, z, limit, _ = _by_blocks(found, model)
    larger, less = (found, model) if smaller else (model, found)
    if not larger.explained:
        return gain, z, limit, False
    ratio, count = ratio_of_models(less, larger, _EXACT)
    more = max(larger.parameters - less.parameters, 1)
    limit = max(float(chi2.isf(_LEVEL, more)), (more + 2) * float(np.log(count)))
    return gain, -ratio if smaller else ratio, limit, True


def lag_in_delay(less: Identified, larger: Identified) -> float:
    """Return the lag of a model for which the longer delay of a smaller one stands [s]; 0: none.

    The record has to show it, and the larger model to hold, with lags alone.
    """
    if not (larger.converged and less.delay > larger.delay and less.den.size < larger.den.size):
        return 0.0
    lag = max(larger.poles, key=lambda pole: pole.omega)
    known = all(pole.value.imag == 0.0 for pole in larger.poles) and (
        lag.deviation <= _KNOWN * lag.omega
    )
    if not known or larger.faults or larger.undecided:
        return 0.0
    return 1.0 / lag.omega if ratio_of_models(less, larger, _EXACT)[0] > _LAG else 0.0


def fits_better(first: Identified, second: Identified) -> bool:
    """Return whether a second model has the smaller errors, by more than chance explains."""
    gain, z, limit, _ = _by_blocks(first, second)
    return z >= limit and gain >= _EQUAL


def _by_blocks(first: Identified, second: Identified) -> tuple[float, float, float, bool]:
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
    return mean, (mean / spread if spread > 0.0 else 0.0), limit, False
