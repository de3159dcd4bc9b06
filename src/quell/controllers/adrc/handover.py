"""What happens around a running ADRC: starting under load, manual operation and back, other bandwidths, an actuator that did otherwise.

A controller starts under load, or follows manual operation, by its observer: told the y and the u there are, it estimates the f there is
(Herbst, "Practical Active Disturbance Rejection Control: Bumpless Transfer, Rate Limitation, and Incremental Algorithm", arXiv
1908.04610). At rest at the reference the law then gives that very u. Where it does not, because the reference is elsewhere or the gains
are new, the gap is added to u and fades as ``exp(−omega_c t)``: the observer is told the sum, so nothing else notices.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from quell import checks
from quell.controllers.adrc.law import (
    BUMPLESS,
    CONSTANT,
    F_LEARNED,
    MANUAL,
    MANUAL_U,
    OFFSET,
    REFERENCED,
    SLOPE,
    STARTED,
    WISHED,
    R,
    U,
    Y,
    unlimited_u,
)
from quell.controllers.base import reset_loop
from quell.controllers.design_checks import warn_if_unwise
from quell.controllers.stateful import StatefulController
from quell.guard import limit
from quell.kernels.dispatch import compiled
from quell.learners.base import NoLearner, predict
from quell.observers.base import acting_control, begin, observe
from quell.observers.delay import without_delay
from quell.observers.eso import ESO
from quell.observers.nonlinear import NonlinearModel
from quell.observers.response import scaled_response
from quell.types import Vector

if TYPE_CHECKING:
    from quell.controllers.adrc.adrc import ADRC

# In units of the observer's lag: after this nothing is left of its initial error.
_SETTLED = 40.0
# Some seconds of calculation.
_MOST_SAMPLES = 100_000_000


class HandOver(StatefulController):
    """What starts, hands over and retunes an ADRC, be it alone or behind a prefilter."""

    @property
    def _law(self) -> ADRC:
        """The ADRC whose gains and running state these are."""
        raise NotImplementedError

    def _rebind(self) -> None:
        """Take note that the parameters are new ones."""
        raise NotImplementedError

    def start(self, y: float, u: float = 0.0, r: float | None = None) -> None:
        """Start where the plant rests at ``y`` under the control signal ``u``: the next ``step`` goes on from there without a bump.

        What was learned is kept. Without it a controller starts at its first sample with f̂ = 0: right for a plant at rest without load, a
        bump for a lift that holds its weight.

        Parameters
        ----------
        y
            measurement now [y-unit].
        u
            control signal that holds the plant there [u-unit]; within the limits, or the next step has to jump to them.
        r
            reference of the next step; ``y`` by default. Where it differs, u goes on from where it is all the same, and the move begins
            with the observer's own dynamics.

        Raises
        ------
        ValueError
            where a value is not finite.
        """
        y, u = checks.finite("y", y), checks.finite("u", u)
        goal = y if r is None else checks.finite("r", r)
        law = self._law
        design, state = law.parameters, law._state
        reset_loop(design, state)
        begin(design.eso, state.z, state.seen, y)
        loop = state.loop
        loop[Y], loop[R], loop[U] = y, goal, u
        loop[STARTED] = loop[REFERENCED] = 1.0
        samples = _samples_to_forget(law.observer)
        _settle(design.eso, state.z, state.seen, y, u, 0.0, samples)
        constant, slope = predict(design.learner, state.learner, state.seen, u)
        constant, slope, _ = limit(design.guard, state.guard, 0.0, constant, slope, u)
        loop[CONSTANT], loop[SLOPE] = constant, slope
        loop[F_LEARNED] = constant + slope * u
        _settle(design.eso, state.z, state.seen, y, u, loop[F_LEARNED], samples)
        loop[BUMPLESS] = 1.0

    def track(self, r: float, y: float, u: float, *derivatives: float) -> float:
        """Take one sample in manual operation: somebody else applies ``u`` until the next one, and the observer is told so.

        Parameters
        ----------
        r, y, derivatives
            as for ``step``.
        u
            what is applied [u-unit]; limits are not applied to it.

        Returns
        -------
        float
            what the controller would have applied; ``hand_over`` closes the gap.

        Raises
        ------
        ValueError
            where u is not finite.
        """
        u = checks.finite("u", u)
        if self._packed is None:
            self.prepare()
        loop = self._law._state.loop
        loop[MANUAL], loop[MANUAL_U] = 1.0, u
        try:
            self.step(r, y, *derivatives)
        finally:
            loop[MANUAL] = 0.0
        return float(loop[WISHED])

    def hand_over(self) -> None:
        """Take over from manual operation: the next ``step`` goes on from the u of the last ``track``, wherever the reference is.

        Raises
        ------
        ValueError
            before the first sample: use ``start`` then.
        """
        loop = self._law._state.loop
        if loop[STARTED] == 0.0:
            raise ValueError(
                "hand_over: there was no sample yet; call track(r, y, u) in manual operation, or start(y, u)"
            )
        loop[BUMPLESS] = 1.0

    def increment(self, r: float, y: float, *derivatives: float) -> float:
        """Take one sample: return by how much the control signal is to change [u-unit], limits of magnitude and rate included.

        For actuators that take increments (steppers, valves, a drive that holds its set point). It is the same law as ``step`` (Herbst,
        arXiv 1908.04610, section IV shows the two to be one), and where the actuator's position is not known, ``start(y)`` takes it for
        zero: f̂ bears the difference. Limits of magnitude then refer to that zero.
        """
        before = float(self._law._state.loop[U])
        return self.step(r, y, *derivatives) - before

    def retune(self, *, omega_c: float | None = None, observer: ESO | None = None) -> None:
        """Change bandwidths while running, without a bump; as often as every sample, so that gains can be scheduled.

        The control signal goes on from where the old gains would have it; the difference fades with the new ``omega_c``. (A quicker
        observer in the middle of a motion moves it for its own reasons.) What was learned is kept. It takes some milliseconds: designs are
        sampled anew.

        Parameters
        ----------
        omega_c
            new controller bandwidth [rad/s]; as it is by default.
        observer
            new observer of the same order, form, structure and sample time, made with another ``omega_o``, ``b0`` or model; as it is by
            default. For a plant with zeros, or with a channel of its own for f, only ``omega_o`` may be another.

        Raises
        ------
        ValueError
            for an observer of another kind, one of another b0 or model where a learner's coefficients or the meaning of the state refer to
            the present one, and for a bandwidth that is not positive; nothing has changed then.
        """
        law = self._law
        old, kept = law.parameters, (law.observer, law.omega_c, law.parameters)
        new_omega_c = (
            law.omega_c if omega_c is None else checks.positive("omega_c", omega_c, "rad/s")
        )
        new_observer = law.observer if observer is None else _checked(law, observer)
        law.observer, law.omega_c = new_observer, new_omega_c
        try:
            law._prepare_design()
            if _structure(law.parameters) != _structure(old):
                raise ValueError(
                    "observer is of another structure than the present one: make a new controller, and start(y, u) it"
                )
        except Exception:
            law.observer, law.omega_c, law.parameters = kept
            raise
        warn_if_unwise(new_observer, new_omega_c)
        state = law._state
        loop, size = state.loop, new_observer.order
        if loop[STARTED] != 0.0:
            before = unlimited_u(old, state, loop[CONSTANT], loop[SLOPE])
            # f is what b0 u and a·x leave: with another b0 or a it is another number.
            acted = acting_control(old.eso, state.z, float(loop[U]))
            change = (kept[0].b0 - new_observer.b0) * acted + (
                new_observer.cancel - kept[0].cancel
            ) @ state.seen[:size]
            state.z[size] += change
            state.seen[size] += change
            loop[OFFSET] += before - unlimited_u(law.parameters, state, loop[CONSTANT], loop[SLOPE])
        self._rebind()


def _checked(law: ADRC, observer: Any) -> ESO:
    """Return an observer that can take the place of the present one, as far as the two tell."""
    old = law.observer
    if not isinstance(observer, ESO):
        raise ValueError(f"observer = {observer!r}: must be an ESO")
    for name in ("order", "degree", "f_degree", "dt", "form", "states"):
        new_value, old_value = getattr(observer, name), getattr(old, name)
        if new_value != old_value:
            raise ValueError(
                f"observer has {name} = {new_value!r}, the present one {old_value!r}: must be the same"
            )
    same_gain = observer.b0 == old.b0
    same_model = all(
        np.array_equal(getattr(observer.plant, name), getattr(old.plant, name)) for name in "aBE"
    )
    if not (same_gain and same_model):
        if (
            old.plant.zeros.size
            or observer.plant.zeros.size
            or not (old.plant.matched and observer.plant.matched)
        ):
            raise ValueError(
                "observer has another model or b0: its states are other ones where the plant has zeros; retune omega_o only"
            )
        if not isinstance(law.learner, NoLearner) and not (
            same_gain and np.array_equal(observer.cancel, old.cancel)
        ):
            raise ValueError(
                f"observer has b0 = {observer.b0!r} and a = {observer.cancel.tolist()}, other than the present one: "
                "what was learned refers to that; retune its omega_o only, or make a new controller"
            )
    return observer


def _structure(value: Any) -> Any:
    """Return what compiled code, and the state's arrays, take for granted of parameters: types and shapes."""
    if isinstance(value, tuple):
        return type(value), tuple(map(_structure, value))
    return value.shape if isinstance(value, np.ndarray) else type(value)


def _samples_to_forget(observer: ESO) -> int:
    """Return after how many samples nothing is left of where an observer began; poles kept at slow zeros count."""
    samples = _SETTLED * observer.lag_time / observer.dt
    if not isinstance(without_delay(observer.model), NonlinearModel):
        slowest = float(np.max(np.abs(np.linalg.eigvals(scaled_response(observer).transition))))
        samples = max(samples, _SETTLED / -math.log(slowest)) if 0.0 < slowest < 1.0 else samples
    return min(round(samples), _MOST_SAMPLES) + observer.states


@compiled
def _settle(
    model: Any, z: Vector, seen: Vector, y: float, u: float, f_learned: float, samples: int
) -> None:
    """Let the observer see the plant at rest until it has forgotten where it began."""
    for _ in range(samples):
        observe(model, z, seen, y, u, f_learned)
