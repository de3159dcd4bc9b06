"""Two coupled axes: a rigid two-link arm, each joint with a controller of its own.

With the joint angles q (the second relative to the first link) and the torques u,

    M(q) q'' + c(q, q') + g(q) = u

    M = [[a_1 + 2 a_2 cos q_2, a_3 + a_2 cos q_2], [a_3 + a_2 cos q_2, a_3]]
    c = a_2 sin q_2 [−2 q_1' q_2' − q_2'², q_1'²]
    g = [b_1 cos q_1 + b_2 cos(q_1 + q_2), b_2 cos(q_1 + q_2)]

(Spong, Hutchinson & Vidyasagar, *Robot Modeling and Control*, the planar elbow manipulator). For
uniform rods of lengths l and masses m, with moments of inertia ``m l²/3`` about their ends,

    a_1 = m_1 l_1²/3 + m_2 (l_1² + l_2²/3),   a_2 = m_2 l_1 l_2/2,   a_3 = m_2 l_2²/3
    b_1 = (m_1/2 + m_2) l_1 γ,                b_2 = m_2 l_2 γ/2

γ is 9.81 m/s² in half of the arms, which move in a vertical plane, else 0.

Each joint has an ADRC of order 2 for the chain of integrators, omega_c = 8 and omega_o = 60 rad/s,
that takes all of the coupling for a disturbance. Its b0 is the gain from its torque to its
acceleration at the middle of the motion, (M⁻¹)_ii, or 2.4 times less. So the learner of a joint
acts on the other joint, whose guard sees that as a disturbance from outside.

At a fixed q the linearised loop without gravity is, for each eigenvalue λ of ``M⁻¹ diag(1/b0)``,
the loop of one joint with b/b0 = λ. The *margin* of an arm is the least modulus margin of these
loops over its motion. Arms of at least 0.35 are drawn, with b0 2.4 times too small of at least 0.2.

The joints follow sinusoids. Errors are those of y against the response that the design asks for,
omega_c²/(s + omega_c)² times r.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from quell.analysis import analyse
from quell.controllers import ADRC
from quell.controllers.base import control
from quell.experiments.stress.adversaries import log_uniform
from quell.guard import Guard
from quell.kernels import dispatch
from quell.kernels.dispatch import call_specialised, compiled_loop
from quell.learners import Harmonic, Learner
from quell.observers import ESO
from quell.plants import LinearPlant, NonlinearPlant
from quell.plants.base import advance
from quell.types import Matrix, Vector

DT = 1e-3
"""Sample time [s]."""
OMEGA_C, OMEGA_O = 8.0, 60.0
"""Bandwidths of each joint's controller [rad/s]."""
TOO_SMALL = 2.4
"""Factor by which b0 is too small in the second set of arms."""
LEAST_MARGIN = {1.0: 0.35, TOO_SMALL: 0.2}
"""Least modulus margin of the arms that are drawn, by the factor of b0."""
LEARNER = Harmonic()
_GRAVITY = 9.81  # γ [m/s²]
# Length of a run, and start of what is judged [s].
_DURATION, _JUDGED_AT = 60.0, 5.0
_NOISE = 2.0 * math.pi / 2**20  # standard deviation of the encoders' noise [rad]
_LIMIT = 100.0  # |q| beyond which a run counts as lost [rad]
_MOST_TRIES = 1000


@dataclass(frozen=True)
class Arm:
    """An arm, its motion, and the b0 of its controllers."""

    lengths: tuple[float, float]  #: [m]
    masses: tuple[float, float]  #: [kg]
    gravity: float  #: γ [m/s²]
    elbow: float  #: q_2 at the middle of the motion [rad]
    amplitudes: tuple[float, float]  #: [rad]
    frequencies: tuple[float, float]  #: [rad/s]
    too_small: float  #: factor by which b0 is too small
    margin: float  #: least modulus margin over the motion
    seed: int

    @property
    def parameters(self) -> dict[str, float]:
        """The numbers a_1, a_2, a_3 [kg m²], b_1, b_2 [N m]."""
        (l1, l2), (m1, m2), g = self.lengths, self.masses, self.gravity
        return {
            "a1": m1 * l1**2 / 3.0 + m2 * (l1**2 + l2**2 / 3.0),
            "a2": m2 * l1 * l2 / 2.0,
            "a3": m2 * l2**2 / 3.0,
            "b1": (m1 / 2.0 + m2) * l1 * g,
            "b2": m2 * l2 * g / 2.0,
        }

    @property
    def plant(self) -> NonlinearPlant:
        """The arm: its u is the torque of the first joint, its disturbance that of the second."""
        return _PLANT.with_parameters(**self.parameters)

    def inertia(self, elbow: float) -> Matrix:
        """Return M at q_2 = ``elbow`` [kg m²]."""
        a1, a2, a3 = (self.parameters[name] for name in ("a1", "a2", "a3"))
        c = a2 * math.cos(elbow)
        return np.array([[a1 + 2.0 * c, a3 + c], [a3 + c, a3]])

    @property
    def b0(self) -> Vector:
        """The b0 of the two controllers [rad/s² per N m]."""
        return np.diag(np.linalg.inv(self.inertia(self.elbow))) / self.too_small

    def gains(self) -> Vector:
        """Return the eigenvalues λ over the motion."""
        angles = self.elbow + self.amplitudes[1] * np.linspace(-1.0, 1.0, 21)
        found = [np.linalg.solve(self.inertia(q), np.diag(1.0 / self.b0)) for q in angles]
        return np.real(np.linalg.eigvals(np.array(found))).ravel()

    def controllers(self, learner: Learner | None, guard: Guard | None) -> list[ADRC]:
        """Return the controllers of the joints."""
        observers = [ESO.model_free(2, float(b0), OMEGA_O, DT) for b0 in self.b0]
        return [ADRC(each, OMEGA_C, learner=learner, guard=guard) for each in observers]

    def reference(self) -> tuple[Matrix, Matrix]:
        """Return the references of the joints, and the response that the design asks for."""
        from scipy.signal import lsim

        t = DT * np.arange(round(_DURATION / DT) + 1)
        sines = np.array(self.amplitudes) * np.sin(np.outer(t, self.frequencies))
        design = ([OMEGA_C**2], [1.0, 2.0 * OMEGA_C, OMEGA_C**2])
        asked = np.stack([lsim(design, sine, t)[1] for sine in sines.T], axis=1)
        middle = np.array([0.0, self.elbow])
        return sines + middle, asked + middle

    @property
    def kind(self) -> str:
        """What the trial calls arms with this b0."""
        return "arm" if self.too_small == 1.0 else f"arm, b0 {self.too_small:g} times too small"

    def describe(self) -> str:
        """Return what a table shows of it."""
        plane = "vertical" if self.gravity else "horizontal"
        return f"{self.kind}, {plane} plane, margin {self.margin:.2f}, seed {self.seed}"


class JointErrors(NamedTuple):
    """RMS errors of the joints [rad], means over draws of the noise; infinite if a run is lost."""

    rms: Vector  #: from 5 s on (2,)
    late: Vector  #: in the second half of that time (2,)

    def worst(self, other: JointErrors) -> tuple[float, float]:
        """Return the ratios to those of another loop, the larger of the two joints'."""
        rms, late = (float(np.max(a / b)) for a, b in zip(self, other, strict=True))
        return rms, late


def draw_arm(rng: np.random.Generator, too_small: float = 1.0) -> Arm:
    """Return a random arm of at least ``LEAST_MARGIN``."""
    for _ in range(_MOST_TRIES):
        arm = _draw(rng, too_small)
        gains = arm.gains()
        margin = min(_margin(round(float(each), 3)) for each in (gains.min(), gains.max()))
        if margin >= LEAST_MARGIN[too_small]:
            return replace(arm, margin=margin)
    raise ValueError(f"too_small = {too_small!r}: no arm with such a margin was found")


def _draw(rng: np.random.Generator, too_small: float) -> Arm:
    def two(low: float, high: float) -> tuple[float, float]:
        return float(rng.uniform(low, high)), float(rng.uniform(low, high))

    first = log_uniform(rng, 0.5, 4.0)
    return Arm(
        lengths=two(0.3, 0.6),
        masses=two(0.5, 2.0),
        gravity=_GRAVITY * float(rng.integers(2)),
        elbow=float(rng.uniform(0.25 * math.pi, 0.75 * math.pi)),
        amplitudes=two(0.2, 1.0),
        # Joints of the same frequency are the hardest to tell from each other.
        frequencies=(first, first if rng.random() < 0.3 else log_uniform(rng, 0.5, 4.0)),
        too_small=too_small,
        margin=0.0,
        seed=int(rng.integers(2**31)),
    )


@cache
def _margin(gain: float) -> float:
    """Return the modulus margin of a joint with b/b0 = ``gain``; 0 if it is unstable."""
    controller = ADRC(ESO.model_free(2, 1.0, OMEGA_O, DT), OMEGA_C)
    found = analyse(LinearPlant.of(([gain], [1.0, 0.0, 0.0])), controller)
    return float(found.margins.modulus) if found.stable else 0.0


def errors(arm: Arm, learner: Learner | None, guard: Guard | None, draws: range) -> JointErrors:
    """Return the errors of the joints, over these draws of the noise."""
    (r, asked), found = arm.reference(), []
    plant = arm.plant.sampled(DT, dispatch.interpret_all)
    one, other = arm.controllers(learner, guard)
    for draw in draws:
        rng, q = np.random.default_rng([arm.seed, draw]), np.empty_like(r)
        noise = _NOISE * rng.standard_normal(r.shape)
        loops = (one.parameters, one.initial_state(), other.parameters, other.initial_state())
        x, scratch = np.array([0.0, arm.elbow, 0.0, 0.0]), np.zeros(6 * 4 + 1)
        done = call_specialised(run_joints, plant, x, scratch, *loops, r, noise, q)
        if done < r.shape[0]:
            return JointErrors(np.full(2, np.inf), np.full(2, np.inf))
        square = ((q - asked) ** 2)[round(_JUDGED_AT / DT) :]
        late = square[square.shape[0] // 2 :]
        found.append(np.sqrt([square.mean(axis=0), late.mean(axis=0)]))
    return JointErrors(*np.mean(found, axis=0))


@compiled_loop("plant", "design1", "design2", "r", "noise")
def run_joints(
    plant: Any,
    x: Vector,
    scratch: Vector,
    design1: Any,
    state1: Any,
    design2: Any,
    state2: Any,
    r: Matrix,
    noise: Matrix,
    q: Matrix,
) -> int:
    """Run two controllers on the joints, and write the angles q; return the number of samples.

    The second torque is the plant's disturbance input.
    """
    torque = scratch[24:]
    for k in range(r.shape[0]):
        for j in range(2):
            q[k, j] = x[j]
            if not abs(x[j]) <= _LIMIT:
                return k
        u = control(design1, state1, r[k, 0], x[0] + noise[k, 0])
        torque[0] = control(design2, state2, r[k, 1], x[1] + noise[k, 1])
        advance(plant, x, scratch, 0.0, u, torque)
    return r.shape[0]


def _motion(
    t: float,
    x: Vector,
    u: float,
    w: Vector,
    a1: float,
    a2: float,
    a3: float,
    b1: float,
    b2: float,
) -> tuple[float, float, float, float]:
    """Return (q', q'') of the equations of the module, for the torques u and w."""
    c, s = a2 * math.cos(x[1]), a2 * math.sin(x[1])
    m11, m12, m22 = a1 + 2.0 * c, a3 + c, a3
    weight = b2 * math.cos(x[0] + x[1])
    free1 = u + s * (2.0 * x[2] + x[3]) * x[3] - b1 * math.cos(x[0]) - weight
    free2 = w[0] - s * x[2] * x[2] - weight
    det = m11 * m22 - m12 * m12
    return x[2], x[3], (m22 * free1 - m12 * free2) / det, (m11 * free2 - m12 * free1) / det


_PLANT = NonlinearPlant(
    _motion,
    order=4,
    substeps=1,
    name="two-link arm",
    parameters={"a1": 2.0, "a2": 0.5, "a3": 1.0, "b1": 0.0, "b2": 0.0},
)
