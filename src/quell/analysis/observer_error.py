"""The error q of the plain observer in a record: what certificates are about."""

from __future__ import annotations

import numpy as np

from quell.controllers.adrc.adrc import ADRC
from quell.controllers.base import Controller
from quell.controllers.prefilters.prefilter import without_prefilters
from quell.observers.delay import without_delay
from quell.observers.response import f_learned_response, response
from quell.observers.start import state_for
from quell.records.trajectory import Trajectory
from quell.types import Vector


def observer_error(controller: Controller, run: Trajectory) -> Vector:
    """Return ``q = f_plain − f_plain^F`` (samples,) [y-unit/s^n] of a run, from its y and u alone.

    f_plain is what the observer would estimate without learner. Of a run without learner the
    largest ``|q|`` is the ``q_0`` of a ``Certificate``.

    Parameters
    ----------
    controller
        the ``ADRC`` of the run.
    run
        a run of it from the start, with every sample recorded and no measurement missing.

    Raises
    ------
    ValueError
        for another controller, a nonlinear observer, a record that lacks samples.
    """
    controller = without_prefilters(controller)
    if not isinstance(controller, ADRC):
        raise ValueError(f"controller = {controller!r}: must be an ADRC")
    y, u = run["y_measured"], run["u"]
    if run.every != 1 or not np.all(np.isfinite(y)):
        raise ValueError(
            f"run has every = {run.every!r}: all samples must be recorded, with finite y_measured"
        )
    observer = controller.observer
    n, estimates = observer.order, observer.estimates
    plain = response(observer.model, estimates, n)
    M, g, c, d = f_learned_response(response(without_delay(observer.model), estimates, n))
    z = state_for(observer.model, np.append(y[0], np.zeros(n - 1)), np.zeros(1), 0.0)
    lag, shown, q = np.zeros(M.shape[0]), 0.0, np.zeros(y.size)
    for k in range(1, y.size):
        given = np.array([y[k], u[k - 1], 0.0])
        f_plain = float(plain.output[n] @ z + plain.feedthrough[n] @ given)
        z = plain.transition @ z + plain.input @ given
        q[k] = f_plain - shown
        shown = float(c @ lag + d * f_plain)
        lag = M @ lag + g * f_plain
    return q
