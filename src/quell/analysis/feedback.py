"""State feedback with a multivariable ESO as a linear loop, and gains under a bound of M_s.

With z the estimates (x̂, d̂, …), L the steady gain, and ``u = F r − K_z z``, the controller is::

    w⁺ = (I − L C)((Φ − Γ_u K_z)(w + L y) + Γ_u F r),      u = F r − K_z (w + L y)

where ``w = z − L y`` is the part of the estimates that is known before y. Without limits it is the
law of ``controllers.StateFeedback``, and what ``MultivariableLoop`` says of it holds: M_s is the
largest singular value of the sensitivity.

An observer by poles or by noise knows nothing of M_s: where the law has to act on what the sensors
hardly show, no gain of the observer gives a margin. ``observer_within`` looks for the gains that do
and are nearest to those that are asked for.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.analysis.matrices import MatrixLaw, sampled_matrices
from quell.analysis.multivariable import MultivariableLoop, Peak
from quell.controllers.state_space import StateFeedback
from quell.lti.models import zero_order_hold
from quell.observers.eso import ESO
from quell.observers.multivariable import MultivariableESO

# Factors that are tried, from the one nearest to 1: a third of a decade apart, and how far they go.
# omega_o is a speed, the drift a density, whose observer has the speed of its 2N-th root.
_STEP, _MOST_SPEED, _MOST_DRIFT = 10.0 ** (1.0 / 3.0), 30.0, 1e8
_HALVINGS = 12  # of the logarithm of a factor between a gain that holds and one that does not


def law_of_feedback(controller: StateFeedback) -> MatrixLaw:
    """Return state feedback as a sampled linear controller, without limits.

    Raises
    ------
    ValueError
        for another controller, and for sensors of different rates, whose gains are periodic.
    """
    if not isinstance(controller, StateFeedback):
        raise ValueError(f"controller = {controller!r:.60}: must be a StateFeedback")
    observer, design = controller.observer, controller.parameters
    if observer.gains.shape[0] > 1:
        raise ValueError(
            f"every = {observer.every}: the gains of sensors of different rates are periodic, "
            "which the loop's matrices are not; analyse it with every sensor in each sample"
        )
    table, L = observer._table, observer.gains[0]
    K = np.hstack([design.gain, -design.of_disturbance])
    rest = np.eye(observer.estimates) - L @ table.output
    inner = rest @ (table.transition - table.input @ K)
    F = design.of_reference
    return MatrixLaw(inner, inner @ L, rest @ table.input @ F, -K, -K @ L, F)


def analyse_feedback(
    controller: StateFeedback, plant: Any = None, *, u_size: Any = None, y_size: Any = None
) -> MultivariableLoop:
    """Analyse the loop of state feedback with a plant, unlimited, with all sensors measured.

    Parameters
    ----------
    controller
        the law with its observer; gains that follow the covariance are those of the steady state.
    plant
        as for ``analyse``; by default the one that the observer is made for.
    u_size, y_size
        size of each control signal and of each output, as for ``MultivariableLoop``.

    Raises
    ------
    ValueError
        for another controller or plant, sizes that do not fit, and sensors of different rates.

    Examples
    --------
    >>> import numpy as np
    >>> from quell.controllers import state_feedback
    >>> A = [[0, 1, 0, 0], [-5, 0, 5, 0], [0, 0, 0, 1], [5, 0, -5, 0]]
    >>> B, E, encoders = [0, 0.5, 0, 0], [0, 0, 0, 0.5], np.eye(4)[[0, 2]]
    >>> observer = ESO.state_space(A, B, encoders, E, dt=1e-3, omega_o=20.0)
    >>> law = StateFeedback(observer, state_feedback(A, B, 3.0, 1e-3), controlled=encoders[1:])
    >>> round(analyse_feedback(law).m_s("inputs").value, 2)
    1.51
    """
    law, observer = law_of_feedback(controller), controller.observer
    if plant is None:
        phi, (gamma,) = zero_order_hold(observer.A, [observer.B], observer.dt)
        matrices = phi, gamma, observer.C
    else:
        matrices = sampled_matrices(plant, observer.dt)
    return MultivariableLoop(matrices, law, observer.dt, u_size=u_size, y_size=y_size)


class BoundedObserver(NamedTuple):
    """An observer whose loop has M_s within a bound."""

    observer: MultivariableESO
    factor: float  #: by which omega_o, or the drift of all disturbances, was multiplied
    m_s: Peak  #: of the loop


def observer_within(
    m_s: float,
    gain: Any,
    A: Any,
    B: Any,
    C: Any,
    E: Any,
    dt: float,
    *,
    controlled: Any = None,
    at: str = "inputs",
    u_size: Any = None,
    y_size: Any = None,
    omega_o: float | None = None,
    drift: Any = None,
    **options: Any,
) -> BoundedObserver:
    """Design an observer of ``ESO.state_space`` whose loop with state feedback has M_s in a bound.

    Where the gains that are asked for do not meet it, omega_o (gains by poles) or the drift of all
    disturbances together (gains by noise) is multiplied by the factor nearest to 1 that does:
    omega_o by at most 30 or 1/30, the drift by 10^8 or 10^-8.

    Parameters
    ----------
    m_s
        most ``max σ̄(S)``, above 1; 2 is usual.
    gain, controlled
        of ``controllers.StateFeedback``.
    A, B, C, E, dt, omega_o, drift, options
        as for ``ESO.state_space``.
    at
        ``"inputs"`` or ``"outputs"``: where the loop is broken.
    u_size, y_size
        size of each control signal and of each output, as for ``MultivariableLoop``.

    Raises
    ------
    ValueError
        beginning with NOT, with the least M_s that was found, if no gain meets the bound; and as
        ``ESO.state_space`` and ``StateFeedback`` for what does not fit.

    Examples
    --------
    >>> import numpy as np
    >>> from quell.controllers import state_feedback
    >>> A = [[0, 1, 0, 0], [-5, 0, 5, 0], [0, 0, 0, 1], [5, 0, -5, 0]]
    >>> B, E, encoders = [0, 0.5, 0, 0], [0, 0, 0, 0.5], np.eye(4)[[0, 2]]
    >>> gain = state_feedback(A, B, 3.0, 1e-3)
    >>> found = observer_within(
    ...     1.4, gain, A, B, encoders, E, 1e-3, controlled=encoders[1:], omega_o=20.0
    ... )
    >>> found.observer.omega_o > 20.0, round(found.m_s.value, 3)
    (True, 1.4)
    """
    bound = checks.finite("m_s", m_s)
    if bound <= 1.0:
        raise ValueError(f"m_s = {m_s!r}: must be above 1, which no loop with feedback is below")
    checks.one_of("at", at, ("inputs", "outputs"))
    by_poles = omega_o is not None
    most = _MOST_SPEED if by_poles else _MOST_DRIFT

    def made(factor: float) -> BoundedObserver:
        """Return the observer for a factor, with its M_s."""
        asked: dict[str, Any] = {"drift": drift}
        if omega_o is not None:
            asked = {"omega_o": factor * checks.positive("omega_o", omega_o, "rad/s")}
        elif drift is not None:
            asked = {"drift": factor * checks.vector("drift", drift, np.size(drift))}
        observer = ESO.state_space(A, B, C, E, dt, **asked, **options)
        law = StateFeedback(observer, gain, controlled=controlled)
        loop = analyse_feedback(law, u_size=u_size, y_size=y_size)
        return BoundedObserver(observer, factor, loop.m_s(at))

    first = made(1.0)  # its errors are those of what was given
    if first.m_s.value <= bound:
        return first
    least, before, factor = first.m_s.value, (1.0, 1.0), 1.0
    while factor < most * (1.0 - 1e-9):
        factor = min(factor * _STEP, most)
        found = []
        for side, at_factor in enumerate((factor, 1.0 / factor)):
            try:
                tried = made(at_factor)
            except ValueError:  # poles or a steady state out of the reach of double precision
                continue
            least = min(least, tried.m_s.value)
            if tried.m_s.value <= bound:
                found.append(_nearest(made, tried, before[side], bound))
        if found:
            return min(found, key=lambda each: abs(math.log(each.factor)))
        before = factor, 1.0 / factor
    what = "omega_o" if by_poles else "drift"
    raise ValueError(
        f"NOT found: no gain has M_s at the {at} of at most {bound:g} with {what} up to {most:g} "
        f"times above or below; the least is {least:.3g}. Give the law a lower bandwidth, leave "
        "flexible modes where they are (quadratic_feedback), or measure more"
    )


def _nearest(made: Any, found: BoundedObserver, outside: float, bound: float) -> BoundedObserver:
    """Return the observer next to a factor ``outside`` that still meets the bound."""
    for _ in range(_HALVINGS):
        try:
            tried = made(math.sqrt(found.factor * outside))
        except ValueError:
            outside = math.sqrt(found.factor * outside)
            continue
        if tried.m_s.value <= bound:
            found = tried
        else:
            outside = tried.factor
    return found
