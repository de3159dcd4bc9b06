"""A loop of a linear plant and a controller at one instant: poles, margins, what noise does to u, sensitivity functions.

In discrete time, at the controller's samples, with d a load at the plant's input, n the noise of the measurement and w the plant's
disturbances::

    u = C_r r − C_y (y + n)        y = P (u + d) + P_w w        L = P C_y        S = 1/(1 + L),  T = 1 − S

so that the responses are ``r → y: P C_r S``, ``d → y: P S``, ``n → u: −C_y S``, ``n → y: −T``, ``w → y: P_w S``.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np

from quell import checks
from quell.analysis.frequency_response import Complex, System, frequencies, in_s_plane, response
from quell.analysis.linearise import closed_loop_matrix, linear_law
from quell.analysis.margins import Margins, least, margins
from quell.analysis.sampled_plant import SampledPlant, sampled_plant
from quell.controllers.linear.law import LinearLaw
from quell.controllers.prefilters.prefilter import Prefiltered
from quell.types import Matrix, Vector


def analyse(
    plant: Any, controller: Any, *, at: Any = None, delay: float = 0.0, actuator_lag: float = 0.0
) -> LoopAnalysis:
    """Analyse the loop of a linear plant and a controller, while no limit holds, its learner frozen.

    Parameters
    ----------
    plant
        a ``LinearPlant``, ``control.StateSpace``, ``control.TransferFunction``, or ``(num, den)`` in powers of s.
    controller
        an ``ADRC``, or a linear controller; one behind a prefilter is analysed without that.
    at
        when its learner is frozen: a ``Frozen`` from ``frozen(controller, run, t)``, or a run or state of the controller (then at its end);
        by default as the controller is now, which for a new one is with nothing learned.
    delay
        dead time that the loop has besides [s].
    actuator_lag
        time constant of a first-order lag between u and the plant [s].

    Returns
    -------
    LoopAnalysis
        calculated where it is asked for.

    Raises
    ------
    ValueError
        for a plant that is not linear or answers at once, a controller without linear law, a delay of more than 200 samples.
    """
    while isinstance(controller, Prefiltered):  # what comes before the loop is not in it
        controller = controller.controller
    if not (
        hasattr(controller, "dt")
        and (hasattr(controller, "law") or hasattr(controller, "observer"))
    ):
        raise ValueError(f"controller = {controller!r}: must be an ADRC or a linear controller")
    dt = float(controller.dt)
    sampled = sampled_plant(plant, dt, delay, actuator_lag)
    return LoopAnalysis(
        sampled,
        linear_law(controller, at),
        dt,
        _b_over_b0(sampled, getattr(controller, "observer", None)),
    )


def _b_over_b0(plant: SampledPlant, observer: Any) -> float | None:
    """Return the plant's gain over the nominal one, where both are gains to the same derivative of y."""
    if observer is None or observer.degree not in plant.b:
        return None
    return plant.b[observer.degree] / float(observer.b0)


class LoopAnalysis:
    """What can be said of a loop of a sampled plant and a linear law; made by ``analyse``.

    Attributes
    ----------
    plant : SampledPlant
        P, with P_w.
    law : LinearLaw
        C_r and C_y.
    dt : float
        sample time [s].
    b_over_b0 : float or None
        the plant's gain over the b0 of the controller; None where there is no b0, where the plant was given sampled, and where u does not
        reach the derivative of y first that the controller takes for it.
    """

    def __init__(
        self, plant: SampledPlant, law: LinearLaw, dt: float, b_over_b0: float | None = None
    ) -> None:
        self.plant, self.law, self.dt, self.b_over_b0 = plant, law, dt, b_over_b0
        self._N = law.A - np.eye(law.A.shape[0]) + np.outer(law.B_u, law.C)
        self._P = System.balanced(plant.N, plant.B, plant.C, 0.0)
        self._C_y = System.balanced(self._N, law.B_y + law.B_u * law.D_y, -law.C, -law.D_y)
        self._C_r = System.balanced(self._N, law.B_r + law.B_u * law.D_r, law.C, law.D_r)

    def __repr__(self) -> str:
        return f"LoopAnalysis of {self.plant.N.shape[0]} + {self.law.A.shape[0]} states at dt = {self.dt:g} s:\n{self.summary()}"

    def summary(self) -> str:
        """Return what matters in a few lines."""
        if not self.stable:
            return f"unstable: a pole at |z| = {np.max(np.abs(self.poles)):.6g}"
        m, (noise, peak) = self.margins, (self.noise_to_control, self.noise_to_control_peak)
        low, high = self.b_range
        what, unit = ("a gain", " times what it is") if self.b_over_b0 is None else ("b/b0", "")
        least_gain, most_gain = m.disk_gain
        return "\n".join(
            [
                f"gain margin {m.gain[0]:.3g} … {m.gain[1]:.3g}, phase margin {m.phase:.1f}° at {m.phase_omega:.3g} rad/s",
                f"modulus margin {m.modulus:.3f}, delay margin {1e3 * m.delay:.3g} ms",
                f"disk margin {m.disk:.3f}: gain {least_gain:.3g} … {most_gain:.3g} or phase ±{m.disk_phase:.1f}°, or some of both",
                f"stable for {what} from {low:.3g} to {high:.3g}{unit}",
                f"white noise of 1 in y makes u move by {noise:.3g} RMS, at most by a factor of {peak:.3g} at one frequency",
            ]
        )

    # ---- poles

    def closed_loop_matrix(self, gain: float = 1.0) -> Matrix:
        """Return ``A − I`` of the closed loop, the plant's states first, with the plant's gain multiplied by ``gain``."""
        return closed_loop_matrix(
            self.plant.N, gain * self.plant.B, self.plant.C, self.law, self._N
        )

    def _shifted_poles(self, gain: float = 1.0) -> Complex:
        poles: Complex = np.linalg.eigvals(self.closed_loop_matrix(gain)).astype(np.complex128)
        return poles

    def _stable_with(self, gain: float) -> bool:
        shifted = self._shifted_poles(gain)
        return bool(np.all(2.0 * shifted.real + np.abs(shifted) ** 2 < 0.0))  # |z|² − 1

    @cached_property
    def poles(self) -> Complex:
        """Closed-loop poles in the z-plane, the slowest first."""
        shifted = self._shifted_poles()
        poles: Complex = 1.0 + shifted[np.argsort(np.abs(shifted), kind="stable")]
        return poles

    @cached_property
    def s_poles(self) -> Complex:
        """The same as ``log(z)/dt`` [rad/s], to compare with a design in continuous time; a pole at z = 0 is at −inf."""
        shifted = self._shifted_poles()
        return in_s_plane(shifted[np.argsort(np.abs(shifted), kind="stable")], self.dt)

    @cached_property
    def stable(self) -> bool:
        """Whether all poles lie inside of the unit circle."""
        return self._stable_with(1.0)

    # ---- frequency responses

    @cached_property
    def omega(self) -> Vector:
        """Frequencies [rad/s] at which to draw, up to half the sampling rate; dense where poles are."""
        loose = [
            in_s_plane(np.linalg.eigvals(N).astype(np.complex128), self.dt)
            for N in (self.plant.N, self._N)
        ]
        return frequencies(np.concatenate([self.s_poles, *loose]), self.dt)

    def response(self, name: str, omega: Any) -> Complex:
        """Return a frequency response.

        Parameters
        ----------
        name
            ``"P"``, ``"C_r"``, ``"C_y"``, ``"L"``, ``"S"``, ``"T"``, ``"PS"`` (load to y), ``"CS"`` (noise to −u) or ``"closed_loop"`` (r
            to y).
        omega
            frequencies [rad/s] (k,).

        Returns
        -------
        (k,) complex array

        Raises
        ------
        ValueError
            for another name.
        """
        checks.one_of("name", name, ("P", "C_r", "C_y", "L", "S", "T", "PS", "CS", "closed_loop"))
        if name in ("P", "C_r", "C_y"):
            return response(
                {"P": self._P, "C_r": self._C_r, "C_y": self._C_y}[name], omega, self.dt
            )
        L = self._loop(omega)
        if name == "L":
            return L
        S: Complex = 1.0 / (1.0 + L)
        if name == "S":
            return S
        if name == "T":
            return L * S
        return (
            S
            * {
                "PS": lambda: self.response("P", omega),
                "CS": lambda: self.response("C_y", omega),
                "closed_loop": lambda: self.response("P", omega) * self.response("C_r", omega),
            }[name]()
        )

    def _loop(self, omega: Any) -> Complex:
        return response(self._P, omega, self.dt) * response(self._C_y, omega, self.dt)

    # ---- margins

    @cached_property
    def margins(self) -> Margins:
        """Gain, phase, modulus, disk and delay margin, each with its frequency."""
        return margins(self._loop, self.omega, self.dt, self._stable_with)

    @cached_property
    def b_range(self) -> tuple[float, float]:
        """Between which values of b/b0 the loop is stable, b being the plant's input gain, its dynamics as they are.

        Where ``b_over_b0`` is None, it is in units of the gain that the plant has.
        """
        relative = 1.0 if self.b_over_b0 is None else self.b_over_b0
        low, high = sorted(relative * factor for factor in self.margins.gain)
        return low, high

    # ---- noise

    @cached_property
    def noise_to_control(self) -> float:
        """Standard deviation of u for white measurement noise of standard deviation 1 in every sample; infinite for an unstable loop."""
        if not self.stable:
            return math.inf
        N, B, C, D = self.closed_loop("n", "u")
        return math.sqrt(_h2_squared(System.balanced(N, B, C, D)))

    @cached_property
    def noise_to_control_peak(self) -> float:
        """Largest factor by which a sinusoid in the measurement is seen in u; infinite for an unstable loop."""
        if not self.stable:
            return math.inf
        inverse, _ = least(
            lambda w: 1.0 / np.abs(self.response("CS", w)),
            self.omega,
            1.0 / np.abs(self.response("CS", self.omega)),
        )
        top = float(np.abs(self.response("CS", [math.pi / self.dt]))[0])
        return max(1.0 / inverse, top)

    # ---- state space

    def closed_loop(self, source: str, target: str) -> System:
        """Return the closed loop from an input to an output.

        Parameters
        ----------
        source
            ``"r"``, ``"d"`` (load at the plant's input), ``"n"`` (noise), or ``"w1"``, ``"w2"``, … (the plant's disturbances).
        target
            ``"y"``, ``"u"`` or ``"e"``, which is r − y.

        Returns
        -------
        System
            A − I, B, C and D, the plant's states first.

        Raises
        ------
        ValueError
            for another source or target.
        """
        P, law = self.plant, self.law
        sources = ("r", "d", "n", *(f"w{i + 1}" for i in range(P.E.shape[1])))
        checks.one_of("source", source, sources)
        checks.one_of("target", target, ("y", "u", "e"))
        m = law.A.shape[0]
        u_direct = {"r": law.D_r, "n": law.D_y}.get(source, 0.0)
        if source in ("r", "n"):
            into = law.B_r if source == "r" else law.B_y
            B = np.concatenate([P.B * u_direct, into + law.B_u * u_direct])
        else:
            B = np.concatenate([P.B if source == "d" else P.E[:, int(source[1:]) - 1], np.zeros(m)])
        if target == "u":
            return System(
                self.closed_loop_matrix(), B, np.concatenate([law.D_y * P.C, law.C]), u_direct
            )
        C = np.concatenate([P.C, np.zeros(m)])
        return System(
            self.closed_loop_matrix(),
            B,
            C if target == "y" else -C,
            float(target == "e" and source == "r"),
        )

    def system(self, name: str) -> Any:
        """Return a part of the loop, or a closed loop, as a ``control.StateSpace`` in discrete time.

        Parameters
        ----------
        name
            ``"P"``, ``"C_r"``, ``"C_y"``, ``"L"``, ``"S"``, ``"T"``, ``"PS"``, ``"CS"``, ``"closed_loop"`` (r to y), or ``"source →
            target"`` as for ``closed_loop``, for example ``"w2 → y"``.

        Raises
        ------
        ImportError
            where python-control is missing.
        """
        from quell.analysis.python_control import state_space

        return state_space(self, name)

    def transfer_function(self, name: str) -> Any:
        """Return the same as a ``control.TransferFunction``: polynomials in z.

        Good to read. Poles that lie together near z = 1 are not to be had from coefficients in double precision: with omega_o dt = 0.12 the
        step response of P, C_r and C_y, closed by python-control in state space, is right to 1e-9 up to order 3 and to 3e-8 for order 4;
        that of the closed loop as one fraction to 1e-9, 1e-6 and 3e-3 for orders 2, 3 and 4. ``system`` is right for all.
        """
        from quell.analysis.python_control import transfer_function

        return transfer_function(self, name)


def _h2_squared(system: System) -> float:
    """Return the sum of the squared impulse response, by doubling: ``X ← X + M X Mᵀ``, ``M ← M²`` (Smith 1968).

    Only positive terms are added, so nothing cancels; after k rounds 2ᵏ samples are summed.
    """
    M, X = system.N + np.eye(system.N.shape[0]), np.outer(system.B, system.B)
    for _ in range(64):
        more = M @ X @ M.T
        X = X + more
        if np.max(np.abs(more)) <= 1e-16 * np.max(np.abs(X)):
            break
        M = M @ M
    return float(system.C @ X @ system.C) + system.D**2
