"""The PID controller that is equivalent to a linear ADRC.

In continuous time, an ESO of order n in closed loop with its own law is a linear system from (r, y)
to u. With ``k_i`` the law's gains, and the ESO model-free with all poles at ω_o, elimination of its
state gives (Herbst, *Control Theory and Technology* 19, 2021, arXiv 2011.01044; Zhong, Huang & Guo,
*Science China Information Sciences* 63, 2020, derive the reverse, from PID to ADRC)::

    n = 1    b_0 U = ( k_1 (s + ω_o)² R − (β_1 s + β_0) Y ) / ( s (s + α_0) )
             α_0 = 2ω_o + k_1,      β_1 = ω_o² + 2 k_1 ω_o,      β_0 = k_1 ω_o²

    n = 2    b_0 U = ( k_1 (s + ω_o)³ R − (β_2 s² + β_1 s + β_0) Y ) / ( s (s² + α_1 s + α_0) )
             α_1 = 3ω_o + k_2,      α_0 = 3ω_o² + 3ω_o k_2 + k_1
             β_2 = ω_o³ + 3ω_o² k_2 + 3ω_o k_1,      β_1 = ω_o³ k_2 + 3ω_o² k_1,      β_0 = k_1 ω_o³

From y to u this is exactly a PI controller with a filter of first order, or a PID controller with
one of second order; from r to u it is the same controller with a prefilter of the reference, here
the ``setpoint`` polynomial. The sampled ADRC and the PID controller sampled by Tustin's rule agree
to first order in dt, as long as no limit is reached.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quell.controllers.adrc.adrc import ADRC
from quell.controllers.baselines.pid import PID
from quell.learners.base import NoLearner
from quell.observers.eso import ESO


def equivalent_pid(controller: ADRC, **options: Any) -> PID:
    """Return the PID controller that a linear ADRC of order 1 (PI) or 2 is in continuous time.

    Raises ``ValueError`` for an ADRC with another order or observer, a learner or feedforward, or
    another type.

    Parameters
    ----------
    controller
        an ``ADRC`` without learner around a model-free ESO of order 1 or 2.
    **options
        limits and name; by default the limits of ``controller``, except its rate limit.
    """
    _check_linear(controller)
    observer, gains = controller.observer, controller.parameters.law.tolist()
    w, b0 = observer.omega_o, observer.b0
    if observer.order == 1:
        (k1,) = gains
        alpha, beta = [2.0 * w + k1], [k1 * w**2, w**2 + 2.0 * k1 * w, 0.0]
        tf = (1.0 / alpha[0], 0.0)
    else:
        k1, k2 = gains
        alpha = [3.0 * w**2 + 3.0 * w * k2 + k1, 3.0 * w + k2]
        beta = [k1 * w**3, w**3 * k2 + 3.0 * w**2 * k1, w**3 + 3.0 * w**2 * k2 + 3.0 * w * k1]
        tf = (alpha[1] / alpha[0], 1.0 / alpha[0])
    ki, kp, kd = (value / (alpha[0] * b0) for value in beta)
    setpoint = k1 / (alpha[0] * b0) * np.poly([-w] * (observer.order + 1))
    limits = controller.parameters.limits
    name = f"PID equivalent to ADRC of order {observer.order}"
    settings: dict[str, Any] = {"u_min": limits.low, "u_max": limits.high, "name": name} | options
    return PID(kp, ki, kd, tf=tf, setpoint=setpoint.tolist(), dt=controller.dt, **settings)


def _check_linear(controller: Any) -> None:
    """Raise a ``ValueError`` for a controller without an equivalent."""
    if not isinstance(controller, ADRC):
        raise ValueError(f"controller = {controller!r}: must be an ADRC")
    observer = controller.observer
    if not isinstance(controller.learner, NoLearner):
        raise ValueError(
            f"controller has a learner, {type(controller.learner).__name__}: only a linear ADRC, "
            "without one, has an equivalent"
        )
    if controller.feedback is not None:
        raise ValueError("controller has a nonlinear feedback law: only a linear one is a PID")
    if observer.order > 2:
        raise ValueError(
            f"controller is of order {observer.order}: must be of order 1 (PI) or 2 (PID); an ADRC "
            "of order n has n zeros from y, a PID controller two at most"
        )
    if observer.disturbance_order > 1:
        raise ValueError(
            f"observer has disturbance_order = {observer.disturbance_order}: its feedback has so "
            "many integrators, and that of a PID controller has one; use disturbance_order = 1"
        )
    design = (observer.order, observer.b0, observer.omega_o, observer.dt)
    usual = ESO.model_free(*design, form=observer.form).model
    if (
        observer.form == "reduced"
        or type(observer.model) is not type(usual)
        or not all(map(np.array_equal, observer.model, usual))
    ):
        raise ValueError("controller has an observer with a model: it must be from ESO.model_free")
    if controller.derivatives:
        raise ValueError(
            "controller has feedforward: a PID controller has no derivatives of the reference; "
            "use feedforward=False"
        )
