"""What happens around a running ADRC: starting under load, manual operation and back, other bandwidths, an actuator that did otherwise.

A controller starts under load, or follows manual operation, by its observer: told the y and the u there are, it estimates the f there is
(Herbst, "Practical Active Disturbance Rejection Control: Bumpless Transfer, Rate Limitation, and Incremental Algorithm", arXiv
1908.04610). At rest at the reference the law then gives that very u. Where it does not, because the reference is elsewhere or the gains
are new, the gap is added to u and fades as ``exp(−omega_c t)``: the observer is told the sum, so nothing else notices.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from quell import checks
from quell.controllers.base import rest
from quell.controllers.handle import bind
from quell.controllers.law import (
    BUMPLESS,
    CONSTANT,
    F_LEARNED,
    MANUAL,
    MANUAL_U,
    REFERENCED,
    SLOPE,
    STARTED,
    WISHED,
    AdrcDesign,
    AdrcState,
    R,
    U,
    Y,
)
from quell.dispatch import compiled
from quell.guard import permit
from quell.learners.base import NoLearner, predict
from quell.observers.base import acting, begin, observe
from quell.observers.eso import ESO
from quell.types import Vector

if TYPE_CHECKING:
    from quell.learners.base import Learner

# In units of the observer's lag: after this nothing is left of its initial error.
_SETTLED = 40.0


class HandOver:
    """The part of ``ADRC`` that starts, hands over and retunes."""

    observer: ESO
    omega_c: float
    learner: Learner
    parameters: AdrcDesign
    _state: AdrcState
    _handle: Any

    def step(self, r: float, y: float, *derivatives: float) -> float:
        """See ``ADRC``."""
        raise NotImplementedError

    def _prepare_design(self) -> None:
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
            control signal that holds the plant there [u-unit].
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
        design, state = self.parameters, self._state
        rest(design, state)
        begin(design.eso, state.z, state.seen, y)
        loop = state.loop
        loop[Y], loop[R], loop[U] = y, goal, u
        loop[STARTED] = loop[REFERENCED] = 1.0
        samples = round(_SETTLED * self.observer.lag_time / self.observer.dt) + self.observer.states
        _settle(design.eso, state.z, state.seen, y, u, 0.0, samples)
        constant, slope = predict(design.learner, state.learner, state.seen, u)
        constant, slope, _ = permit(design.guard, state.guard, 0.0, constant, slope, u)
        loop[CONSTANT], loop[SLOPE] = constant, slope
        loop[F_LEARNED] = constant + slope * u
        _settle(design.eso, state.z, state.seen, y, u, loop[F_LEARNED], samples)
        loop[BUMPLESS] = 1.0

    def track(self, r: float, y: float, u: float) -> float:
        """Take one sample in manual operation: somebody else applies ``u`` until the next one, and the observer is told so.

        Parameters
        ----------
        r, y
            as for ``step``.
        u
            what is applied [u-unit]; limits are not applied to it.

        Returns
        -------
        float
            what the controller would have applied; ``hand_over`` closes the gap.
        """
        u = checks.finite("u", u)
        loop = self._state.loop
        if self._handle is None:
            self.prepare()  # type: ignore[attr-defined]
        loop[MANUAL], loop[MANUAL_U] = 1.0, u
        try:
            self.step(r, y)
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
        if self._state.loop[STARTED] == 0.0:
            raise ValueError("hand_over: there was no sample yet; call track(r, y, u) in manual operation, or start(y, u)")
        self._state.loop[BUMPLESS] = 1.0

    def applied(self, u: float) -> None:
        """Say what was really applied [u-unit] since the last ``step``, where something behind the controller changed it.

        To be called before the next ``step``. Limits that are known beforehand belong in ``u_min``, ``u_max`` and ``rate_limit``.
        """
        self._state.loop[U] = checks.finite("u", u)

    def increment(self, r: float, y: float) -> float:
        """Take one sample: return by how much the control signal is to change [u-unit], limits of magnitude and rate included.

        For actuators that take increments (steppers, valves, a drive that holds its set point). It is the same law as ``step`` (Herbst,
        arXiv 1908.04610, section IV shows the two to be one), and where the actuator's position is not known, ``start(y)`` takes it for
        zero: f̂ bears the difference. Limits of magnitude then refer to that zero.
        """
        before = float(self._state.loop[U])
        return self.step(r, y) - before

    def retune(self, *, omega_c: float | None = None, observer: ESO | None = None) -> None:
        """Change bandwidths while running, without a bump.

        The control signal goes on from where it is. What was learned is kept. It takes some milliseconds: designs are sampled anew.

        Parameters
        ----------
        omega_c
            new controller bandwidth [rad/s]; as it is by default.
        observer
            new observer, of the same order, form and sample time: another ``omega_o``, ``b0`` or model; as it is by default.

        Raises
        ------
        ValueError
            for an observer of another kind, one of another b0 or model where a learner's coefficients refer to the present one, and for a
            bandwidth that is not positive; nothing has changed then.
        """
        new_omega_c = self.omega_c if omega_c is None else checks.positive("omega_c", omega_c, "rad/s")
        new_observer = self.observer if observer is None else self._checked(observer)
        kept = self.observer, self.omega_c, self.parameters
        self.observer, self.omega_c = new_observer, new_omega_c
        try:
            self._prepare_design()
        except ValueError:
            self.observer, self.omega_c, self.parameters = kept
            raise
        if self._handle is not None:
            self._handle = bind(self.parameters, self._state)
        loop, size = self._state.loop, new_observer.order
        if loop[STARTED] != 0.0:
            # f is what b0 u and a·x leave: with another b0 or a it is another number.
            acted = acting(kept[0].model, self._state.z, float(loop[U]))
            change = (kept[0].b0 - new_observer.b0) * acted + (new_observer.cancel - kept[0].cancel) @ self._state.seen[:size]
            self._state.z[size] += change
            self._state.seen[size] += change
            loop[BUMPLESS] = 1.0

    def _checked(self, observer: Any) -> ESO:
        """Return an observer that can take the place of the present one."""
        old = self.observer
        if not isinstance(observer, ESO):
            raise ValueError(f"observer = {observer!r}: must be an ESO")
        for name in ("order", "degree", "dt", "form", "states", "has_one_pole"):
            if getattr(observer, name) != getattr(old, name):
                raise ValueError(
                    f"observer has {name} = {getattr(observer, name)!r}, the present one {getattr(old, name)!r}: must be the same"
                )
        if type(observer.model) is not type(old.model):
            raise ValueError("observer is of another kind than the present one: make a new controller, and start(y, u) it")
        if old.degree < old.order and not (observer.b0 == old.b0 and np.array_equal(observer.plant.a, old.plant.a)):
            raise ValueError(
                "observer has another model or b0, and the plant has zeros: its states are other ones then; retune omega_o only"
            )
        if not isinstance(self.learner, NoLearner) and (observer.b0 != old.b0 or (observer.cancel != old.cancel).any()):
            raise ValueError(
                f"observer has b0 = {observer.b0!r} and a = {observer.cancel.tolist()}, other than the present one: "
                "what was learned refers to that; retune its omega_o only, or make a new controller"
            )
        return observer


@compiled
def _settle(model: Any, z: Vector, seen: Vector, y: float, u: float, f_learned: float, samples: int) -> None:
    """Let the observer see the plant at rest until it has forgotten where it began."""
    for _ in range(samples):
        observe(model, z, seen, y, u, f_learned)
