"""How to make the observers that are not of the plain kind: what each does stands in the file of its model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from quell import checks
from quell.observers.cascade import cascade_model
from quell.observers.delay import delayed_model
from quell.observers.kalman_gains import kalman_gain
from quell.observers.nonlinear import NonlinearModel
from quell.types import Vector

if TYPE_CHECKING:
    from quell.observers.eso import ESO


class OtherForms:
    """What ``ESO`` can be made as, besides ``model_free`` and ``model_based``."""

    @classmethod
    def cascade(
        cls: Any,
        order: int,
        b0: float,
        omega_o: float,
        dt: float,
        *,
        levels: int = 2,
        ratio: float = 2.0,
        delay: float = 0.0,
    ) -> ESO:
        """Design a cascade of model-free observers (``cascade.py``): for the same rejection of disturbances, less noise in u.

        Parameters
        ----------
        order, b0, dt, delay
            as for ``model_free``.
        omega_o
            bandwidth of the last level, the fastest [rad/s].
        levels
            how many, p; with one it is the ESO of ``model_free``.
        ratio
            by how much each is faster than the one before, α > 1; the first has ``omega_o / α^(p−1)``.

        Raises
        ------
        ValueError
            naming the argument, its value and the rule.
        """
        p, ratio = checks.whole("levels", levels, 1, 8), checks.positive("ratio", ratio)
        if ratio <= 1.0:
            raise ValueError(
                f"ratio = {ratio!r}: must be above 1, each level is faster than the one before"
            )
        last = cls.model_free(order, b0, omega_o, dt)
        models = [
            cls.model_free(order, b0, omega_o / ratio ** (p - 1 - i), dt).model for i in range(p)
        ]
        model = delayed_model(cascade_model(models), delay, dt)
        made: ESO = cls(last.plant, last.b0, last.omega_o, last.dt, "current", model, False)
        return made

    @classmethod
    def nonlinear(
        cls: Any,
        order: int,
        b0: float,
        omega_o: float,
        dt: float,
        *,
        delta: float,
        alpha: Any = None,
        delay: float = 0.0,
    ) -> ESO:
        """Design Han's nonlinear observer (``nonlinear.py``): the linear one while ``|y − z⁻_1|`` is below delta, gentler beyond.

        A learner or a guard can not be had with it: both need the observer's exact lag.

        Parameters
        ----------
        order, b0, omega_o, dt, delay
            as for ``model_free``.
        delta
            up to which error it is linear, δ [y-unit].
        alpha
            the powers α (n + 1,) beyond, above 0 and at most 1; 1, 1/2, 1/4, … by default, as Han has them.

        Raises
        ------
        ValueError
            naming the argument, its value and the rule.
        """
        linear = cls.model_free(order, b0, omega_o, dt)
        delta = checks.positive("delta", delta, "y-unit")
        powers: Vector = (
            0.5 ** np.arange(order + 1.0)
            if alpha is None
            else checks.vector("alpha", alpha, order + 1)
        )
        if not np.all((powers > 0.0) & (powers <= 1.0)):
            raise ValueError(f"alpha = {alpha!r}: each entry must be above 0 and at most 1")
        known = linear.model
        model = NonlinearModel(known.transition, known.input, known.feed, known.gain, powers, delta)
        made: ESO = cls(
            linear.plant,
            linear.b0,
            linear.omega_o,
            linear.dt,
            "current",
            delayed_model(model, delay, dt),
            False,
        )
        return made

    @classmethod
    def kalman(
        cls: Any,
        order: int,
        b0: float,
        dt: float,
        *,
        noise_variance: float,
        drift: float,
        jitter: float = 0.0,
        form: str = "current",
        delay: float = 0.0,
    ) -> ESO:
        """Design a model-free ESO with the steady-state Kalman gain (``kalman_gains.py``): the least variance, if the densities are right.

        Its ``omega_o`` is the geometric mean of its poles, ``|ln z_i|/dt``: what learners and guards take for its speed.

        Parameters
        ----------
        order, b0, dt, delay
            as for ``model_free``.
        noise_variance
            variance of the measurement's noise in each sample [y-unit²].
        drift
            density of the white noise whose integral f is [(y-unit/s^n)²/s]: f moves by ``√(drift T)`` in the time T.
        jitter
            density of white noise in f itself [(y-unit/s^n)² s].
        form
            ``"current"`` or ``"predictor"``.

        Raises
        ------
        ValueError
            naming the argument, its value and the rule.
        """
        n = checks.whole("order", order, 1, 8)
        noise, drift = (
            checks.positive("noise_variance", noise_variance),
            checks.positive("drift", drift),
        )
        jitter, dt = checks.non_negative("jitter", jitter), checks.positive("dt", dt, "s")
        checks.one_of("form", form, ("current", "predictor"))
        gain, omega_o = kalman_gain(np.diag(np.ones(n), 1), dt, noise, drift, jitter)
        plain = cls.model_free(n, b0, omega_o, dt, form=form)
        model = delayed_model(plain.model._replace(gain=gain), delay, dt)
        made: ESO = cls(plain.plant, plain.b0, omega_o, dt, form, model, False)
        return made
