"""Active disturbance rejection control: an ESO, the law around it (``law.py``) and, where there is one, a learner."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.adrc.estimate import Estimate
from quell.controllers.adrc.handover import HandOver
from quell.controllers.adrc.law import F_LEARNED, LOOP, STATUS, AdrcDesign, AdrcState, U, law_gains
from quell.controllers.base import set_reference_derivatives
from quell.controllers.compiled_step import pack
from quell.controllers.design_checks import warn_if_unwise
from quell.controllers.limits import checked_limits
from quell.guard import (
    GUARD_CHANNELS,
    Guard,
    Reason,
    UnguardedDesign,
    UnguardedMemory,
    write_channels,
)
from quell.learners.base import Learner, NoLearner, coefficients, validated_design
from quell.learners.lag import NO_LAG, lag_memory, lag_of
from quell.lti.canonical import format_roots
from quell.observers.eso import ESO
from quell.types import Status


class ADRC(HandOver):
    """Active disturbance rejection control around an ESO, with or without a learner.

    The object is immutable in all but its running state: ``step`` moves that on, ``simulate`` leaves it alone and uses a state of its own.

    Parameters
    ----------
    observer
        model-free or model-based; it brings order, b0 and dt.
    omega_c
        controller bandwidth [rad/s]: all poles of the ideal loop lie at −omega_c.
    learner
        what feeds f forward; none by default.
    guard
        what gives a learner the authority it has earned; none by default: then a learner has all of it.
    feedforward
        whether the reference's derivatives are fed forward: ``simulate`` takes them from the signal, ``step`` from its caller. The ideal
        loop then follows the reference without lag.
    u_min, u_max
        limits of the control signal [u-unit].
    rate_limit
        how fast it may move, in either direction [u-unit/s].
    half_gain
        whether to halve the gains k of the law, reference included, not the cancellation of f: half the gain from noise in x̂, a loop that
        settles to 2 % in 2.0, 1.4, 1.2 and 1.0 times the time for orders 1 to 4 (Herbst, Hempel, Göhrt & Streif 2020, arXiv 2003.03986).

    Raises
    ------
    ValueError
        for a bandwidth that is not positive, limits in the wrong order, a rate limit that is not positive; for an observer of a plant with
        zeros that are not in the left half plane.

    Examples
    --------
    >>> from quell.observers import ESO
    >>> controller = ADRC(ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01), omega_c=2.0, u_min=-1.0, u_max=1.0)
    >>> controller.step(r=1.0, y=0.0)
    1.0
    >>> controller.estimate.status
    <Status.SATURATED: 4>
    """

    def __init__(
        self,
        observer: ESO,
        omega_c: float,
        *,
        learner: Learner | None = None,
        guard: Guard | None = None,
        feedforward: bool = False,
        u_min: float = -math.inf,
        u_max: float = math.inf,
        rate_limit: float = math.inf,
        half_gain: bool = False,
    ) -> None:
        if not isinstance(observer, ESO):
            raise ValueError(
                f"observer = {observer!r}: must be an ESO, from ESO.model_free or ESO.model_based"
            )
        self.observer = observer
        _check_zeros(observer)
        self.omega_c = checks.positive("omega_c", omega_c, "rad/s")
        self.guard = guard
        self.learner: Learner = NoLearner() if learner is None else learner
        if isinstance(self.learner, type) or not all(
            hasattr(self.learner, name) for name in ("design", "memory", "feature_names")
        ):
            raise ValueError(
                f"learner = {learner!r}: must be a learner, for example quell.learners.Kalman(), or None"
            )
        if guard is not None and not isinstance(guard, Guard):
            raise ValueError(f"guard = {guard!r}: must be a quell.Guard(), or None")
        self.feedforward = checks.flag("feedforward", feedforward)
        self.half_gain = checks.flag("half_gain", half_gain)
        self._learned_at = self.omega_c
        self._limits = checked_limits(u_min, u_max, rate_limit, observer.dt)
        self._begin()
        warn_if_unwise(observer, self.omega_c)

    @property
    def _law(self) -> ADRC:
        return self

    def _rebind(self) -> None:
        if self._packed is not None:
            self._packed = pack(self.parameters, self._state)

    def _prepare_design(self) -> None:
        observer = self.observer
        law = law_gains(observer.degree, self.omega_c) * (0.5 if self.half_gain else 1.0)
        self.parameters = AdrcDesign(
            eso=observer.model,
            law=np.append(law, np.zeros(observer.order - observer.degree)),
            cancel=observer.cancel,
            cancel_f=observer.cancel_f,
            fade=math.exp(-self.omega_c * observer.dt),
            b0=observer.b0,
            limits=self._limits,
            learner=validated_design(
                self.learner, observer, self._learned_at
            ),  # its scales stay, whatever the loop is retuned to
            lag=NO_LAG if isinstance(self.learner, NoLearner) else lag_of(observer),
            guard=UnguardedDesign() if self.guard is None else self.guard.design(observer),
        )
        self.features = self.learner.feature_names(observer.order)

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.observer.dt

    @property
    def derivatives(self) -> int:
        """How many derivatives of the reference are fed forward."""
        return self.observer.degree if self.feedforward else 0

    @property
    def channels(self) -> tuple[tuple[str, int], ...]:
        """Name and width of what ``report`` writes, in order."""
        return (
            ("x_hat", self.observer.order),
            ("f_residual", 1),
            ("f_learned", 1),
            ("status", 1),
            *(() if self.guard is None else GUARD_CHANNELS),
            ("theta", len(self.features)),
        )

    def initial_state(self) -> AdrcState:
        """Return a state before the first sample, with nothing learned."""
        order = self.observer.order
        return AdrcState(
            z=np.zeros(self.observer.states),
            seen=np.zeros(order + 1),
            reference=np.zeros(self.derivatives),
            loop=np.zeros(LOOP),
            learner=self.learner.memory(self.parameters.learner),
            shadow=lag_memory(self.parameters.lag, 1),
            guard=UnguardedMemory(np.zeros(0))
            if self.guard is None
            else self.guard.memory(self.parameters.guard),
        )

    def step(self, r: float, y: float, *derivatives: float) -> float:
        """Take one sample: return the control signal [u-unit] for the reference ``r`` and the measurement ``y`` [y-unit].

        With ``feedforward``, r', r'', … may follow [y-unit/s^i]; those not given, or not finite, are zero.

        In the place of a measurement that is not finite stands the one that the observer expects, in that of a reference the last good
        one; ``estimate.status`` says so. The observer takes the returned value for applied; limits belong in ``u_min``, ``u_max`` and
        ``rate_limit``, not behind the controller; else see ``applied``.

        The first call compiles, or loads; ``prepare`` does that beforehand.

        Raises
        ------
        ValueError
            for derivatives that there is no use for.
        TypeError
            for a value that is no number.
        """
        if self._packed is None:
            self.prepare()
        if self.feedforward:
            self._feed(derivatives)
        elif derivatives:
            raise ValueError(
                f"step was given {len(derivatives)} derivatives of the reference: make the controller with feedforward=True"
            )
        try:
            return self._step(self._packed, r, y)
        except TypeError:
            raise TypeError(f"r = {r!r}, y = {y!r}: must be numbers") from None

    def _feed(self, derivatives: tuple[float, ...]) -> None:
        if len(derivatives) > self.observer.degree:
            raise ValueError(
                f"step was given {len(derivatives)} derivatives of the reference: there is use for {self.observer.degree} at most"
            )
        set_reference_derivatives(
            self.parameters, self._state, np.array(derivatives, dtype=np.float64)
        )

    @property
    def _outside(self) -> tuple[str, ...]:
        return tuple(f"learner.{name}" for name in getattr(self.learner, "external_fields", ()))

    def _snapshots(self, state: AdrcState) -> dict[str, Any]:
        if not self._outside:
            return {}
        snapshot = self.learner.snapshot(state.learner)  # type: ignore[attr-defined]
        return {f"learner.{name}": value for name, value in snapshot.items()}

    def _recall(self, state: AdrcState, snapshots: Mapping[str, Any]) -> None:
        named = {name.removeprefix("learner."): value for name, value in snapshots.items()}
        self.learner.recall(state.learner, named)  # type: ignore[attr-defined]

    @property
    def estimate(self) -> Estimate:
        """What the controller knows after its last step."""
        return self.read(self._state)

    def read(self, state: AdrcState) -> Estimate:
        """Return what is known in ``state``."""
        order = self.observer.order
        theta = np.zeros(len(self.features))
        coefficients(self.parameters.learner, state.learner, theta)
        learned, residual = float(state.loop[F_LEARNED]), float(state.seen[order])
        return Estimate(
            x=state.seen[:order].copy(),
            f=learned + residual,
            f_learned=learned,
            f_residual=residual,
            theta=dict(zip(self.features, theta.tolist(), strict=True)),
            u=float(state.loop[U]),
            status=Status(int(state.loop[STATUS])),
            **self._guard_report(state),
        )

    def _guard_report(self, state: AdrcState) -> dict[str, Any]:
        told = np.zeros(len(GUARD_CHANNELS))
        if write_channels(self.parameters.guard, state.guard, told) == 0:
            return {}
        named = dict(zip([name for name, _ in GUARD_CHANNELS], told.tolist(), strict=True))
        return named | {"reason": Reason(int(named["reason"]))}


def _check_zeros(observer: ESO) -> None:
    """Refuse a plant whose zeros the law must not cancel: u makes y^(r) what it should be, and the zeros from u are poles of u."""
    unstable = observer.plant.unstable_zeros
    if unstable.size:
        raise ValueError(
            f"observer: the plant has zeros from u at {format_roots(unstable)} rad/s, not in the left half plane; ADRC inverts the plant, "
            "so that u would grow, or swing, without end while y looks well; control another output, or take a controller that does not "
            "invert the plant (linear-quadratic, for instance)"
        )
