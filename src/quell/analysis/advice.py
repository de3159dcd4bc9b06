"""Findings about a design, with numbers: sampling, noise, lags, and too little margin."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quell import checks
from quell.analysis.loop import LoopAnalysis, analyse
from quell.controllers.adrc.adrc import ADRC
from quell.controllers.base import Controller
from quell.controllers.design_checks import Finding, sampling_findings
from quell.observers.eso import ESO
from quell.plants.linear import LinearPlant

# RMS of u as a share of its range: six standard deviations are then 30 % of it. Chosen by hand.
_NOISE = 0.05
# Between loops of four integrators with omega_o = 10 omega_c, 0.41, and with 3 omega_c, 0.24.
_LEAST_MODULUS = 0.3
# Share of the modulus margin that a lag must leave. Chosen by hand.
_LAG_LEAVES = 0.8


def advise(
    controller: Controller,
    plant: Any = None,
    *,
    noise_std: float | None = None,
    actuator_lag: float = 0.0,
    delay: float = 0.0,
    at: Any = None,
    operating_point: Any = None,
) -> list[Finding]:
    """Return the weak points of a design, each with its number, the limit, and what to do.

    They are in the order sampling, margin, lag, noise. Raises ``ValueError`` as ``analyse``
    does, and without a plant for a controller that assumes none.

    Parameters
    ----------
    controller
        an ``ADRC`` or a linear controller.
    plant
        linear plant to control (see ``analyse``); by default the plant that an ADRC's observer
        assumes, with the delay that it knows, which is the most favourable one.
    noise_std
        standard deviation of the measurement noise, assumed white [y-unit]. It is judged by its
        effect on u as a share of ``u_max − u_min``; without limits it is not judged.
    actuator_lag
        time constant of the actuator [s], if the plant does not include it.
    delay
        dead time of actuator, transport and calculation [s]; without a plant it adds to the one
        that the observer assumes.
    at
        instant at which the learner is frozen; see ``analyse``.
    operating_point
        state and control signal (x, u) about which a nonlinear plant is linearised.
    """
    observer = controller.observer if isinstance(controller, ADRC) else None
    known_delay, found = 0.0, []
    if plant is None:
        if observer is None:
            raise ValueError("plant = None: this controller does not know its plant; give one")
        plant, known_delay = _assumed_plant(observer)
    actuator_lag = checks.non_negative("actuator_lag", actuator_lag, "s")
    delay = checks.non_negative("delay", delay, "s")
    if isinstance(controller, ADRC):
        found = sampling_findings(controller.observer, controller.omega_c)
    options = {"at": at, "operating_point": operating_point}
    loop = analyse(plant, controller, delay=known_delay, **options)
    if not loop.stable:
        what_to_do = "check b0, raise omega_o or lower omega_c"
        return [*found, _unstable(loop, "with this plant", what_to_do)]
    found += _judge_margin(loop, observer)
    if actuator_lag > 0.0 or delay > 0.0:
        lags: dict[str, Any] = {"delay": known_delay + delay, "actuator_lag": actuator_lag}
        late = analyse(plant, controller, **lags, **options)
        found += _judge_lag(loop, late, actuator_lag, delay)
        loop = late
    if noise_std is not None and loop.stable:
        found += _judge_noise(loop, controller, checks.non_negative("noise_std", noise_std))
    return found


def _assumed_plant(observer: ESO) -> tuple[LinearPlant, float]:
    """Return the plant that an observer assumes, with the gain b0, and its input delay [s]."""
    known = observer.plant
    A = np.diag(np.ones(observer.order - 1), 1)
    A[-1] = -known.a
    B, C = known.B * (observer.b0 / known.b), np.eye(observer.order)[0]
    delay = observer.dt * getattr(observer.model, "samples", 0)
    return LinearPlant(A, B, C, known.E[:, None]), delay


def _unstable(loop: LoopAnalysis, when: str, what_to_do: str) -> Finding:
    size = float(max(abs(loop.poles)))
    message = f"the loop is unstable {when}, with a pole at |z| = {size:.6g}: {what_to_do}"
    return Finding("stability", size, 1.0, message)


def _judge_margin(loop: LoopAnalysis, observer: ESO | None) -> list[Finding]:
    margins = loop.margins
    if margins.modulus >= _LEAST_MODULUS:
        return []
    what_to_do = "detune it"
    if observer is not None:
        what_to_do = "raise omega_o (noise permitting) or lower omega_c"
    message = (
        f"modulus margin {margins.modulus:.3g} is below {_LEAST_MODULUS:g} "
        f"(phase margin {margins.phase:.1f}°, worst at {margins.modulus_omega:.3g} rad/s): "
        f"{what_to_do}"
    )
    return [Finding("margin", margins.modulus, _LEAST_MODULUS, message)]


def _judge_lag(
    loop: LoopAnalysis, late: LoopAnalysis, actuator_lag: float, delay: float
) -> list[Finding]:
    parts = (("an actuator lag", actuator_lag), ("a delay", delay))
    cause = " and ".join(f"{what} of {1e3 * time:.3g} ms" for what, time in parts if time > 0.0)
    before, after = loop.margins, late.margins
    if not late.stable:
        margin = f"its delay margin is {1e3 * before.delay:.3g} ms"
        what_to_do = "shorten it, or lower omega_o and omega_c together"
        return [_unstable(late, f"with {cause}", f"{margin}; {what_to_do}")]
    if after.modulus >= _LAG_LEAVES * before.modulus:
        return []
    # Without a crossover the phase margin is infinite, and there is no angle to lose.
    at = before.phase_omega
    cost = math.degrees(math.atan(at * actuator_lag) + at * delay)
    angle = "" if math.isnan(at) else f", {cost:.1f}° at the crossover of {at:.3g} rad/s,"
    message = (
        f"{cause}{angle} leaves a phase margin of {after.phase:.1f}° of {before.phase:.1f}°, "
        f"a modulus margin of {after.modulus:.3g} of {before.modulus:.3g}: "
        "shorten it, let the controller know of it, or lower omega_o and omega_c together"
    )
    return [Finding("lag", after.modulus, _LAG_LEAVES * before.modulus, message)]


def _judge_noise(loop: LoopAnalysis, controller: Controller, noise: float) -> list[Finding]:
    limits = getattr(controller.parameters, "limits", None)
    u_range = math.inf if limits is None else limits.high - limits.low
    rms = noise * loop.noise_to_control
    share = rms / u_range
    if share <= _NOISE:
        return []
    what_to_do = "lower the gains"
    if isinstance(controller, ADRC):
        observer = controller.observer
        # Noise in f̂ grows with the power n + 1/2 of omega_o.
        lower = observer.omega_o * (_NOISE / share) ** (1.0 / (observer.order + 0.5))
        what_to_do = f"lower omega_o to about {lower:.2g} rad/s and omega_c, or measure better"
    message = (
        f"noise of {noise:.3g} RMS in y makes u move by {rms:.3g} RMS, "
        f"{100.0 * share:.3g} % of its range of {u_range:.3g}; "
        f"{100.0 * _NOISE:g} % is about what an actuator tolerates: {what_to_do}"
    )
    return [Finding("noise", share, _NOISE, message)]
