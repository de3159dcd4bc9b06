"""A DC motor with friction, cogging, a voltage limit and an encoder, from physical parameters.

With the angle θ, the speed ω and the current i::

    J ω' = k_t i − c ω − F − T(θ + w2) + w1          L i' = v − R i − k_t ω,  |v| ≤ v_max
    y = θ as counted by the encoder                  i = (v − k_t ω)/R without inductance

(A brushless motor with field-oriented control is the same in its q axis.) T is the cogging torque
over a revolution: the torque that holds the motor at an angle. F is dry friction with sticking and
the Stribeck effect (Armstrong-Hélouvry, Dupont & Canudas de Wit, *A survey of models, analysis
tools and compensation methods for the control of machines with friction*, Automatica 30 (1994), eq.
(3))::

    F = sign(ω) (C + (S − C) exp(−(ω/ω_s)²))       while the motor turns

and while it stands, F is the torque that keeps it standing, up to S.

*Solution.* Over a sub-step h all torques are constant: T is that at the angle ``θ + ω h/2`` (the
exponential midpoint rule: Hochbruck & Ostermann, *Exponential integrators*, Acta Numerica 19
(2010), section 2), F is such that at the end the motor either turns against it or stands (Moreau's
time-stepping, see ``torsional.py``). The linear motor is solved exactly. The error is of order h²,
and of order h where the motor stops or starts. A motor that sticks does not creep.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.described import Described
from quell.kernels.dispatch import kernel
from quell.kernels.sized import Buffer
from quell.plants.base import advance, measure
from quell.plants.encoder import EncodedPlantModel
from quell.plants.labelled import labelled
from quell.plants.linear import LinearModel, LinearPlant
from quell.quantities import Signals
from quell.types import Vector

# Longest sub-step [s]: 84 cogging waves a revolution at 2 revolutions a second then pass in 60 of
# them. Chosen by hand.
_SUBSTEP = 1e-4
# Longest sample with friction or cogging [s]: far above that of any servo.
_LONGEST_SAMPLE = 1.0
# Points of the table for given orders, at least, and for each wave of the highest order: its cubic
# interpolation has an error of 2e-4 of the amplitude.
_POINTS, _POINTS_A_WAVE = 4096, 32
_HIGHEST_ORDER = 10_000
_SIGNALS = Signals.of("angle [rad]", "voltage [V]", ("torque [N m]", "shift of the cogging [rad]"))


class DcMotorModel(NamedTuple):
    """A motor, sampled at a sub-step."""

    linear: LinearModel  # the motor without friction and cogging; its disturbance is a torque
    substeps: int
    u_max: float  # largest voltage [V]
    coulomb: float  # C [N m]
    stiction: float  # S [N m]
    stribeck: float  # ω_s [rad/s]
    half: float  # half of a sub-step [s]
    cogging: Buffer  # T at equal steps of a revolution [N m]


@measure.register(DcMotorModel)
def _measure(plant: DcMotorModel, x: Vector) -> float:
    return x[0]


@advance.register(DcMotorModel)
def _advance(
    plant: DcMotorModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    applied = min(max(u, -plant.u_max), plant.u_max)
    for _ in range(plant.substeps):
        speed = abs(x[1]) / plant.stribeck
        friction = plant.coulomb + (plant.stiction - plant.coulomb) * math.exp(-speed * speed)
        torque = -cogging_torque(plant.cogging, x[0] + plant.half * x[1] + w[1])
        advance(plant.linear, x, scratch, t, applied, w[:1])
        gain = plant.linear.disturbance  # of a torque
        torque += min(max(-x[1] / gain[1, 0] - torque, -friction), friction)
        for i in range(gain.shape[0]):
            x[i] += gain[i, 0] * torque


@kernel
def cogging_torque(table: Vector, angle: float) -> float:
    """Return the torque at an ``angle`` [rad]: cubic interpolation in a revolution's ``table``.

    Keys, *Cubic convolution interpolation for digital image processing*, IEEE Trans. Acoustics,
    Speech and Signal Processing 29 (1981), eq. (15) with a = −1/2.
    """
    size = table.size
    place = angle / (2.0 * math.pi)
    place = (place - math.floor(place)) * size
    if not 0.0 <= place < size:  # not finite, or rounded up to a revolution
        place = 0.0
    i = int(place)
    s = place - i
    a, b = table[i - 1 if i > 0 else size - 1], table[i]
    c = table[i + 1 if i + 1 < size else i + 1 - size]
    d = table[i + 2 if i + 2 < size else i + 2 - size]
    return b + 0.5 * s * (
        c - a + s * (2.0 * a - 5.0 * b + 4.0 * c - d + s * (3.0 * (b - c) + d - a))
    )


@dataclass(frozen=True, eq=False, repr=False)
class DcMotor(Described):
    """A motor with friction, cogging and encoder; ``dc_motor`` makes it.

    Its states are the angle [rad], the speed [rad/s] and, with inductance, the current [A].
    """

    linear: LinearPlant  #: the motor without friction and cogging, from the voltage to the angle
    coulomb: float  # C [N m]
    stiction: float  # S [N m]
    stribeck: float  # ω_s [rad/s]
    cogging: Vector  # T at equal steps of a revolution [N m]
    u_max: float  # largest voltage [V]
    counts: int | None
    name: str = "DC motor"
    compiled = True
    signals = _SIGNALS

    @property
    def order(self) -> int:
        """Number of states."""
        return self.linear.order

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs: a torque [N m], a shift of the cogging [rad]."""
        return 2

    @property
    def resolution(self) -> float:
        """Angle of one count of the encoder [rad]; 0.0 without an encoder."""
        return 0.0 if self.counts is None else math.tau / self.counts

    def sampled(self, dt: float, interpret: bool = False) -> DcMotorModel | EncodedPlantModel:
        """Return the parameters for a sample time ``dt`` [s]: a motor, in an encoder."""
        nonlinear = self.stiction > 0.0 or bool(np.any(self.cogging != 0.0))
        if checks.positive("dt", dt, "s") > _LONGEST_SAMPLE and nonlinear:
            rule = f"must be at most {_LONGEST_SAMPLE} s with friction or cogging"
            raise ValueError(f"dt = {dt!r} s: {rule}")
        substeps = math.ceil(dt / _SUBSTEP - 1e-9) if nonlinear else 1
        step = dt / substeps
        model = DcMotorModel(
            linear=self.linear.sampled(step),
            substeps=substeps,
            u_max=self.u_max,
            coulomb=self.coulomb,
            stiction=self.stiction,
            stribeck=self.stribeck,
            half=0.5 * step,
            cogging=self.cogging,
        )
        return model if self.counts is None else EncodedPlantModel(model, self.resolution)


def dc_motor(
    resistance: float = 0.5,
    inductance: float | None = None,
    torque_constant: float = 0.05,
    inertia: float = 2e-4,
    viscous: float = 1e-4,
    coulomb: float = 0.01,
    stiction: float | None = None,
    stribeck_speed: float = 0.5,
    cogging: Sequence[Sequence[float]] = (),
    cogging_map: Sequence[float] | None = None,
    counts: int | None = 8192,
    voltage_limit: float = 24.0,
) -> DcMotor:
    """Return a DC motor as a servo's plant, from physical parameters.

    States: the angle [rad], the speed [rad/s] and, with ``inductance``, the current [A]. The
    control signal u is the voltage [V]. The disturbances are a torque on the shaft
    [N m], and the angle [rad] by which the encoder's zero has moved against the cogging. Output:
    the encoder's angle [rad], not wrapped. Without friction, cogging and inductance it is
    ``θ'' = −(c + k_t²/R)/J θ' + k_t/(R J) u``, so ``b0 = k_t/(R J)``.

    The defaults are those of a small servo motor of 24 V: chosen for size, not of a certain
    product.

    Parameters
    ----------
    resistance
        R of the winding [ohm].
    inductance
        L of the winding [H]; by default none, so that the current follows the voltage at once.
    torque_constant
        k_t [N m/A], also the constant of the voltage that the motion induces [V s/rad].
    inertia
        J of the motor and what it drives [kg m²].
    viscous
        viscous friction c [N m s/rad].
    coulomb
        Coulomb friction C [N m].
    stiction
        S, the torque at which the standing motor breaks away [N m]; ``coulomb`` by default.
    stribeck_speed
        ω_s, the speed over which friction falls from ``stiction`` to ``coulomb`` [rad/s].
    cogging
        pairs (order, amplitude), or triples (order, amplitude, phase): ``T = Σ amplitude sin(order
        θ + phase)``, with orders in waves a revolution, amplitudes in N m, phases in rad.
    cogging_map
        in place of ``cogging``, the torque [N m] that holds the motor at each of at least four
        equal steps of a revolution, from angle zero on: for example a measured current times
        ``torque_constant``.
    counts
        of the encoder a revolution; None for the angle itself.
    voltage_limit
        largest voltage [V].

    Raises
    ------
    ValueError
        for a resistance, inductance, torque constant, inertia, Stribeck speed or limit that is not
        positive, a friction below zero, a stiction below ``coulomb``, or orders, a map or counts
        out of range.

    Examples
    --------
    >>> motor = dc_motor(cogging=((7, 0.02), (28, 0.01)))
    >>> motor.order, motor.disturbances
    (2, 2)
    """
    R = checks.positive("resistance", resistance, "ohm")
    L = checks.optional(checks.positive, "inductance", inductance, "H")
    k = checks.positive("torque_constant", torque_constant, "N m/A")
    J = checks.positive("inertia", inertia, "kg m²")
    c = checks.non_negative("viscous", viscous, "N m s/rad")
    dry = checks.non_negative("coulomb", coulomb, "N m")
    most = dry if stiction is None else checks.non_negative("stiction", stiction, "N m")
    if most < dry:
        raise ValueError(f"stiction = {stiction!r}: must be at least coulomb = {coulomb!r} [N m]")
    if L is None:
        A, B = [[0.0, 1.0], [0.0, -(c + k * k / R) / J]], [0.0, k / (R * J)]
    else:
        A = [[0.0, 1.0, 0.0], [0.0, -c / J, k / J], [0.0, -k / L, -R / L]]
        B = [0.0, 0.0, 1.0 / L]
    n = len(B)
    ends = np.eye(n)
    linear = LinearPlant(A, B, ends[0], ends[:, 1:2] / J, name="DC motor without friction")
    linear = labelled(linear, _SIGNALS.y, _SIGNALS.u, _SIGNALS.w[:1])
    return DcMotor(
        linear=linear,
        coulomb=dry,
        stiction=most,
        stribeck=checks.positive("stribeck_speed", stribeck_speed, "rad/s"),
        cogging=_table(cogging, cogging_map),
        u_max=checks.positive("voltage_limit", voltage_limit, "V"),
        counts=checks.optional(checks.whole, "counts", counts, 1),
    )


def _table(cogging: Any, cogging_map: Any) -> Vector:
    """Return the cogging torque at equal steps of a revolution [N m]."""
    if not checks.is_sequence(cogging):
        raise ValueError(f"cogging = {cogging!r}: must be pairs (order, amplitude)")
    if cogging_map is not None:
        if len(cogging) > 0:
            raise ValueError("cogging and cogging_map: give one of them")
        table = checks.vector("cogging_map", cogging_map)
        if table.size < 4:
            rule = "must have at least 4, over a whole revolution"
            raise ValueError(f"cogging_map has {table.size} torques: {rule}")
        return table
    waves = []
    for i, wave in enumerate(cogging):
        row = checks.vector(f"cogging[{i}]", wave)
        whole = row.size in (2, 3) and row[0] == round(row[0])
        if not (whole and 1 <= row[0] <= _HIGHEST_ORDER):
            rule = "must be (order, amplitude) or (order, amplitude, phase), order a whole number"
            raise ValueError(f"cogging[{i}] = {wave!r}: {rule} from 1 to {_HIGHEST_ORDER}")
        waves.append([*row.tolist(), 0.0][:3])
    if not waves:
        return np.zeros(4)
    points = max(_POINTS, _POINTS_A_WAVE * int(max(wave[0] for wave in waves)))
    angle = math.tau * np.arange(points) / points
    parts = [amplitude * np.sin(order * angle + phase) for order, amplitude, phase in waves]
    return np.asarray(np.sum(parts, axis=0))
