"""The guard as users make it; ``kernels.py`` has its equations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

import quell.guard.kernels  # noqa: F401  (registers the functions for ``GuardDesign``)
from quell import checks
from quell.guard.certified import certified_bound
from quell.guard.correction import check_one_state_of_f, is_invertible
from quell.guard.credit import withdraw_authority
from quell.guard.state import GuardAverages, GuardDesign, GuardMemory, GuardSample
from quell.learners.lag import lag_memory, lag_of
from quell.observers.eso import ESO
from quell.types import Vector

# These values were chosen by hand on tuning seeds of `quell stress`, which judges them as a set on
# other seeds (docs/theory). Times are in lags N/omega_o of the observer.
# T of the averages:
_AVERAGING_LAGS = 15.0
# T_C/T: a learner that explains a part of a sinusoidal load has full authority after 25 lags.
_CREDIT_TIME = 2.0 / 3.0
# P follows a growing |q| within this many lags, and decays over this many.
_RISE_LAGS, _DECAY_LAGS = 0.7, 200.0
# e grows by a factor of 2.7 in this time while the learner acts.
_GROWTH_LAGS = 5.0
# Memory of c_L, the learner's newest largest correction.
_OWN_LAGS = 10.0
# β̄ follows β over this time.
_SMOOTHING_LAGS = 30.0
# The target returns to f_L over this time, where the bound keeps them apart.
_LEAK_LAGS = 7.0
# A target that is far from β̄g approaches it by e in this time, which has almost no effect.
_HOME_LAGS = 1000.0
# Memory of the account.
_ACCOUNT_LAGS = 300.0
# Time over which ε compares p with q, over T: a learner that turns is seen within five lags.
_MATCH_TIME = 0.1
# κ_0, for learners that leave a good part of the error. With 1 a perfect one is clipped at its
# peaks, because e is a little less than those of what the plain observer misses.
_USUAL_BOUND = 1.2
# After a learner has lost its authority, what it has done to y is taken back in this time.
_CLOSING_LAGS = 2.0 / 3.0
# It is taken back for at most so long: from then on a learner without authority moves nothing.
_TAKING_BACK_LAGS = 10.0
# After the filters were emptied in mid-run, q is wrong for this time.
_SETTLING_LAGS = 3.0


@dataclass(frozen=True)
class Guard:
    """Limits a learner to the authority that it has earned: ``ADRC(…, learner=…, guard=Guard())``.

    ``kernels.py`` has the equations. They do not depend on the units of y and u. The observer must
    have one extended state, ``disturbance_order=1``: of a learner's output that moves nothing the
    guard lets a constant leak away, and an observer with f' lets it be a ramp.

    Parameters
    ----------
    bound
        largest correction of the plain observer's estimate, in units of that estimate's error e: κ.
        Only a learner that explains nearly all of the error has it. The others have 1.2, or κ if
        that is less (``kernels.py``).
        After a jump of the disturbance a perfect learner needs more than 2.
    time
        time T [s] over which a learner is judged; by default 15 lags ``(n + 1)/omega_o`` of the
        observer.
    certified_for
        a linear plant, a list of plants or ``{name: plant}``, for which κ is made small enough that
        no learner can make q larger than ten times what it is without learner: κΓ ≤ 0.9, see
        ``quell.analysis.certify``. A retune computes it again, in about 50 ms a plant.

    Raises
    ------
    ValueError
        for a parameter that is not positive.
    """

    bound: float = 3.0
    time: float | None = None
    certified_for: Any = None

    def __post_init__(self) -> None:
        checks.positive("bound", self.bound)
        if self.time is not None:
            checks.positive("time", self.time, "s")

    def design(self, observer: ESO, law: Vector | None = None) -> GuardDesign:
        """Return the parameters for an observer and the gains k of the law (n,).

        ``certified_for`` needs the gains.

        Raises
        ------
        ValueError
            for a loop of ``certified_for`` that is unstable without learner, or without gains;
            for an observer with ``disturbance_order`` above 1.
        """
        check_one_state_of_f(observer)
        bound = float(self.bound)
        if self.certified_for is not None:
            if law is None:
                raise ValueError("law = None: certified_for needs the gains k of the law")
            bound = certified_bound(bound, self.certified_for, observer, law)
        dt, lag_time = observer.dt, observer.lag_time
        time = _AVERAGING_LAGS * lag_time if self.time is None else self.time
        # b0 + ∂f_L/∂u stays between b0/2 and 2 b0, as with the default gain_interval of Kalman.
        least_slope, largest_slope = sorted([-0.5 * observer.b0, observer.b0])

        def share(lags: float) -> float:
            """Return the share of its distance that a first-order lag covers in a sample."""
            return -math.expm1(-dt / (lags * lag_time))

        # y responds to f with the law's poles, as many as the relative degree: of a plant with
        # zeros the other gains are zero. Without a law y is taken to be as slow as f̂.
        degree = observer.degree
        omega_c = 1.0 / lag_time if law is None else float(law[0]) ** (1.0 / degree)
        lag, invertible = lag_of(observer), is_invertible(observer)
        return GuardDesign(
            lag=lag,
            forget=-math.expm1(-dt / time),
            earn=dt / (_CREDIT_TIME * time),
            stages=degree,
            respond=-math.expm1(-omega_c * dt),
            closing=share(_CLOSING_LAGS),
            taking_back=_TAKING_BACK_LAGS * lag_time / dt if degree == observer.order else 0.0,
            forget_account=dt / (_ACCOUNT_LAGS * lag_time),
            forget_match=-math.expm1(-dt / (_MATCH_TIME * time)),
            rise=share(_RISE_LAGS),
            decay=share(_DECAY_LAGS),
            growth=share(_GROWTH_LAGS),
            bound=bound,
            usual_bound=min(bound, _USUAL_BOUND),
            own_decay=1.0 - share(_OWN_LAGS),
            within_lag=share(1.0),
            smooth=share(_SMOOTHING_LAGS),
            leak=share(_LEAK_LAGS),
            home=share(_HOME_LAGS),
            settling=_SETTLING_LAGS * lag_time / dt,
            invertible=invertible,
            fed_lag=lag if invertible else _lag_of_a_chain(observer),
            least_slope=least_slope,
            largest_slope=largest_slope,
        )

    def memory(self, parameters: GuardDesign) -> GuardMemory:
        """Return the state before the first sample, without authority."""
        fed = lag_memory(parameters.fed_lag, 0 if parameters.invertible else 1)
        filters = lag_memory(parameters.lag, 3), fed, np.zeros(4)
        effects = np.zeros((3, parameters.stages))
        memory = GuardMemory(*filters, effects, GuardAverages.zeros(), GuardSample.zeros())
        withdraw_authority(memory)
        return memory


def _lag_of_a_chain(observer: ESO) -> Any:
    """Return the lag filter of the model-free observer of the same order and bandwidth."""
    return lag_of(ESO.model_free(observer.order, observer.b0, observer.omega_o, observer.dt))
