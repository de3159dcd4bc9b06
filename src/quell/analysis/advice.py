"""Findings about a design, with numbers: sampling, bandwidths, lags, noise, too little margin."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quell import checks
from quell.analysis.linearise import Adapting, Frozen, adapting
from quell.analysis.loop import LoopAnalysis, analyse_axis, durations
from quell.analysis.margins import eigenvalues
from quell.controllers.adrc import ADRC, Finding, known_samples, sampling_findings
from quell.controllers.base import Controller
from quell.learners.base import NoLearner
from quell.observers.eso import ESO
from quell.plants.linear import LinearPlant
from quell.plants.linearise import linear_part

# RMS of u as a share of its range: six standard deviations are then 30 % of it. Chosen by hand.
_NOISE = 0.05
# Between loops of four integrators with omega_o = 10 omega_c, 0.41, and with 3 omega_c, 0.24.
_LEAST_MODULUS = 0.3
# M_s that a learner may cause by its adaptation, a modulus margin of 0.4: beyond it a loop rings.
# Up to the second number times M_s without the learner it is not the learner's doing.
_LEARNED_M_S, _RAISED = 2.5, 1.1
# Steps of the bisection for the bandwidth that keeps it.
_BISECTIONS = 12
# Factor between b and b0 from which on b0 is blamed for too little margin. Chosen by hand: a factor
# of 2 takes a chain of four integrators with omega_o = 10 omega_c from 0.41 to 0.08 or less.
_WRONG_GAIN = 1.3
# A plant with a pole beyond is unstable; integrators, to rounding of coinciding ones, are not.
_RUNS_AWAY = 1.0 + 1e-5
# Share of the modulus margin that a lag must leave. Chosen by hand.
_LAG_LEAVES = 0.8
# Largest omega_c over omega_o. On chains of 1 to 3 integrators whose gain is 20 % below b0 the step
# settles at a ratio of 1/3 in 0.8 to 1.1 times the law's time, of 1 in 1.9 to 2.3, of 10 in 5.6 to
# 11: from 1 on it is the observer's time.
_FASTEST_LAW = 1.0
# Unstated delay that every loop must survive [samples]: a controller that reads, calculates and
# then writes acts a sample late (``realtime``).
_CALCULATION = 1


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

    They are in the order sampling, bandwidth, margin, learner, lag, noise. Times within one message
    have the same unit. Raises ``ValueError`` as ``analyse`` does, and without a plant for a
    controller that assumes none.

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
        that the observer assumes. If none is stated, a loop that a delay of one sample makes
        unstable is a finding.
    at
        instant at which the learner is looked at; see ``analyse``. By default its adaptation is
        judged with full authority of a guard.
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
        found += _judge_bandwidths(controller)
    options = {"at": at, "operating_point": operating_point}
    loop = analyse_axis(plant, controller, delay=known_delay, **options)
    if not loop.stable:
        lost = _lost_by_delay(loop, plant, controller, known_delay, options)
        if lost is None:
            lost = _unstable(loop, "with this plant", _remedy(loop, controller, found))
        return [*found, lost]
    found += _judge_margin(loop, controller, found)
    found += _judge_learner(plant, controller, known_delay, options)
    if actuator_lag > 0.0 or delay > 0.0:
        lags: dict[str, Any] = {"delay": known_delay + delay, "actuator_lag": actuator_lag}
        late = analyse_axis(plant, controller, **lags, **options)
        found += _judge_lag(loop, late, actuator_lag, delay, observer)
        loop = late
    if delay == 0.0 and loop.stable:
        found += _judge_calculation(loop, observer)
    if noise_std is not None and loop.stable:
        found += _judge_noise(loop, controller, checks.non_negative("noise_std", noise_std))
    return found


def _assumed_plant(observer: ESO) -> tuple[LinearPlant, float]:
    """Return the plant that an observer assumes, with the gain b0, and its input delay [s]."""
    known = observer.plant
    A = np.diag(np.ones(observer.order - 1), 1)
    A[-1] = -known.a
    B, C = known.B * (observer.b0 / known.b), np.eye(observer.order)[0]
    return LinearPlant(A, B, C, known.E[:, None]), observer.dt * known_samples(observer)


def _unstable(loop: LoopAnalysis, when: str, what_to_do: str) -> Finding:
    size = float(max(abs(loop.poles)))
    message = f"the loop is unstable {when}, with a pole at |z| = {size:.6g}: {what_to_do}"
    return Finding("stability", size, 1.0, message)


def _remedy(loop: LoopAnalysis, controller: Controller, found: list[Finding]) -> str:
    """Return what to do about a loop with too little margin or none."""
    if not isinstance(controller, ADRC):
        return "change its gains"
    observer, ratio = controller.observer, loop.b_over_b0
    if ratio is None and loop.plant.b:
        ((reached, _),) = loop.plant.b.items()
        return (
            f"u reaches the derivative {reached} of y first, and the observer assumes "
            f"{observer.degree}: take an observer of order {reached}, or lower omega_o and omega_c "
            "together"
        )
    if ratio is not None and ratio < 0.0:
        b = ratio * observer.b0
        return f"the plant's gain b = {b:.3g} and b0 = {observer.b0:.3g} differ in sign: correct b0"
    if ratio is not None and not 1.0 / _WRONG_GAIN <= ratio <= _WRONG_GAIN:
        return f"b/b0 = {ratio:.3g}: take b0 = {ratio * observer.b0:.3g}, or identify the plant"
    subjects = [finding.subject for finding in found]
    if "sampling" in subjects:
        return "sample faster, or lower omega_o and omega_c together"
    if "lag" in subjects:
        return "lower omega_c"
    if np.any(np.abs(1.0 + eigenvalues(loop.plant.N)) > _RUNS_AWAY):
        return "raise omega_o (noise permitting): the plant itself is unstable"
    return "raise omega_o (noise permitting) or lower omega_c"


def _lost_by_delay(
    loop: LoopAnalysis, plant: Any, controller: Controller, delay: float, options: dict[str, Any]
) -> Finding | None:
    """Return the finding about a plant whose own delay the observer does not know and must."""
    if not isinstance(controller, ADRC):
        return None
    linear, own = linear_part(plant, loop.dt, options["operating_point"])
    stated = loop.dt * known_samples(controller.observer)
    if own + delay <= stated + 0.5 * loop.dt:
        return None
    prompt = analyse_axis(linear, controller, delay=stated, at=options["at"])
    if not prompt.stable:
        return None
    late, margin, known = durations(own + delay, stated + prompt.margins.delay, stated)
    assumed = f"a delay of {known}" if stated > 0.0 else "none"
    what_to_do = (
        f"the observer assumes {assumed}, and the loop is stable up to {margin}; "
        f"let the observer know of the delay, and {_slower(controller.observer)}"
    )
    return _unstable(loop, f"with the plant's delay of {late}", what_to_do)


def _judge_bandwidths(controller: ADRC) -> list[Finding]:
    omega_c, omega_o = controller.omega_c, controller.observer.omega_o
    ratio = omega_c / omega_o
    if ratio <= _FASTEST_LAW:
        return []
    message = (
        f"omega_c = {omega_c:.3g} rad/s is {ratio:.3g} times omega_o = {omega_o:.3g} rad/s: the "
        "law is faster than the observer, so with a load or a gain other than b0 the loop settles "
        "in the observer's time, with more noise in u; "
        f"lower omega_c to {_FASTEST_LAW * omega_o:.3g} rad/s or less, or raise omega_o to "
        f"{omega_c / _FASTEST_LAW:.3g} rad/s or more"
    )
    return [Finding("bandwidth", ratio, _FASTEST_LAW, message)]


def _judge_calculation(loop: LoopAnalysis, observer: ESO | None) -> list[Finding]:
    """Judge a delay that was not stated: the calculation alone may take a sample."""
    unstated = _CALCULATION * loop.dt
    if loop.margins.delay > unstated:
        return []
    margin, late = durations(loop.margins.delay, unstated)
    message = (
        f"the delay margin of {margin} is below one sample of {late}, which the calculation of u "
        "takes on most rigs; the loop would be unstable: state the delay, and "
        f"{_slower(observer)}"
    )
    return [Finding("lag", loop.margins.delay, unstated, message)]


def _judge_margin(
    loop: LoopAnalysis, controller: Controller, found: list[Finding]
) -> list[Finding]:
    margins = loop.margins
    if margins.modulus >= _LEAST_MODULUS:
        return []
    message = (
        f"modulus margin {margins.modulus:.3g} is below {_LEAST_MODULUS:g} "
        f"(phase margin {margins.phase:.1f}°, worst at {margins.modulus_omega:.3g} rad/s): "
        f"{_remedy(loop, controller, found)}"
    )
    return [Finding("margin", margins.modulus, _LEAST_MODULUS, message)]


def _judge_learner(
    plant: Any, controller: Controller, delay: float, options: dict[str, Any]
) -> list[Finding]:
    """Judge what a learner's adaptation takes of the modulus margin."""
    if not isinstance(controller, ADRC) or isinstance(controller.learner, NoLearner):
        return []
    at = options["at"]
    learner = at if isinstance(at, Frozen | Adapting) else adapting(controller, at)
    if isinstance(learner, Frozen) or not learner.rates.acts:
        return []
    if at is None:
        learner = learner._replace(known=learner.known._replace(authority=1.0))
    rates = learner.rates

    def m_s(part: Any) -> float:
        loop = analyse_axis(plant, controller, delay=delay, **{**options, "at": part})
        return 1.0 / loop.margins.modulus if loop.stable else math.inf

    none = m_s(learner.known._replace(gain=0.0 * learner.known.gain, before=0.0, slope=0.0))
    value, limit = m_s(learner), max(_LEARNED_M_S, _RAISED * none)
    if value <= limit:
        return []

    def m_s_at(share: float) -> float:
        return m_s(learner._replace(rates=rates._replace(level=share * rates.level)))

    message = f"the learner's adaptation raises M_s from {none:.3g} to {value:.3g}: "
    if rates.level > 0.0 and m_s_at(0.0) <= limit:
        low, high = 0.0, 1.0
        for _ in range(_BISECTIONS):
            share = 0.5 * (low + high)
            low, high = (share, high) if m_s_at(share) <= limit else (low, share)
        bandwidth = low * rates.level / controller.dt
        message += (
            f"its bias is an integrator beside the observer's; with bias_bandwidth = "
            f"{bandwidth:.3g} rad/s M_s is {limit:.3g}"
        )
    else:
        message += "take fewer oscillators, lower frequencies, or a lower pair_bandwidth"
    return [Finding("learner", value, limit, message)]


def _judge_lag(
    loop: LoopAnalysis, late: LoopAnalysis, actuator_lag: float, delay: float, observer: ESO | None
) -> list[Finding]:
    *times, margin = durations(actuator_lag, delay, loop.margins.delay)
    parts = zip(("an actuator lag", "a delay"), times, (actuator_lag, delay), strict=True)
    cause = " and ".join(f"{what} of {text}" for what, text, time in parts if time > 0.0)
    shorter = "shorten it"
    if observer is not None and delay > 0.0 and known_samples(observer) == 0:
        shorter += ", let the observer know of the delay"
    before, after = loop.margins, late.margins
    if not late.stable:
        what_to_do = f"its delay margin is {margin}; {shorter}, or {_slower(observer)}"
        return [_unstable(late, f"with {cause}", what_to_do)]
    if after.modulus >= _LAG_LEAVES * before.modulus:
        return []
    # Without a crossover the phase margin is infinite, and there is no angle to lose.
    at = before.phase_omega
    cost = math.degrees(math.atan(at * actuator_lag) + at * delay)
    angle = "" if math.isnan(at) else f", {cost:.1f}° at the crossover of {at:.3g} rad/s,"
    message = (
        f"{cause}{angle} leaves a phase margin of {after.phase:.1f}° of {before.phase:.1f}°, "
        f"a modulus margin of {after.modulus:.3g} of {before.modulus:.3g}: "
        f"{shorter}, or {_slower(observer)}"
    )
    return [Finding("lag", after.modulus, _LAG_LEAVES * before.modulus, message)]


def _slower(observer: ESO | None) -> str:
    return "lower its gains" if observer is None else "lower omega_o and omega_c together"


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
