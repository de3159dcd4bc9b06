"""Plants from physical parameters: the ECP 205 torsional testbed and a DC motor.

The ECP 205 torsional plant, the paper's testbed (section V): two disks on a shaft with a motor.

The motor drives the lower disk (1) by a belt; the angle of the upper disk (2) is measured. With the
angles θ and speeds ω::

    J1 θ1'' = τ − k (θ1 − θ2) − d (ω1 − ω2) − c1 ω1 − F1 + w1          J1 = J_lower + N² J_motor
    J2 θ2'' =     k (θ1 − θ2) + d (ω1 − ω2) − c2 ω2 − F2 + w2          τ = N k_t i,  |i| ≤ i_max
    i = k_a q(u),  |u| ≤ 10 V                                y = θ2 as counted by the encoder

q rounds to the converter's steps. F is Coulomb friction with sticking: ``F = C sign(ω)`` while a
disk turns; while it stands, F is the torque that keeps it standing, up to C.

*Solution.* Over a sub-step h the friction torques are constant. They are such that at its end each
disk either turns against its ``C`` or stands with less than that (Moreau's time-stepping: Acary &
Brogliato, *Numerical Methods for Nonsmooth Dynamical Systems*, 2008, section 10.1)::

    x⁺ = Φ x + Γ u + Γ_w (w − F),      F_i = C_i sign(ω_i⁺)  or  ω_i⁺ = 0, |F_i| ≤ C_i

Φ and Γ are exact, so without friction the solution has no error, and one sub-step suffices. The two
conditions are solved alternately, three times, because within a sub-step the disks are only weakly
coupled. A disk that sticks stays where it is and does not creep. If a disk starts or stops, the
error is of order h.

A DC motor with friction, cogging, a voltage limit and an encoder, from physical parameters.

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
time-stepping). The linear motor is solved exactly. The error is of order h²,
and of order h where the motor stops or starts. A motor that sticks does not creep.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.checks import Described
from quell.hints import explained
from quell.kernels.dispatch import kernel
from quell.kernels.sized import Buffer
from quell.plants.base import Flow, advance, labelled, measure
from quell.plants.flexible import chain_matrices
from quell.plants.linear import (
    DelayedPlantModel,
    EncodedPlantModel,
    LinearModel,
    LinearPlant,
    quantized,
)
from quell.quantities import Signals
from quell.types import Vector

# Longest sub-step [s]: short against the period of the disks' mode at about 6.5 Hz. Chosen by hand.
_SUBSTEP = 1e-4
# Longest sample with dry friction [s]: six periods of that mode, which no loop can control.
_LONGEST_SAMPLE = 1.0
# Each iteration reduces the error of the two friction torques by six digits, the square of the
# disks' coupling within a sub-step.
_ITERATIONS = 3
_TORQUES = ("torque on the lower disk [N m]", "torque on the upper disk [N m]")
_SIGNALS = Signals.of("angle [rad]", "voltage [V]", _TORQUES)
# The converter's range in both directions [V] (module docstring).
_RANGE = 10.0


class TorsionalModel(NamedTuple):
    """The disks and their drive, sampled at a sub-step."""

    disks: LinearModel  # disks without Coulomb friction; disturbances are torques on them [N m]
    substeps: int
    coulomb: Vector  # C of the lower and the upper disk [N m] (2,)
    u_max: float  # limit of u by the converter or the current limit [V]
    step: float  # step of the converter [V]; 0.0 for no rounding


@measure.register(TorsionalModel)
def _measure(plant: TorsionalModel, x: Vector) -> float:
    return measure(plant.disks, x)


@advance.register(TorsionalModel)
def _advance(
    plant: TorsionalModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    applied = quantized(u, plant.step) if plant.step > 0.0 else u
    applied = min(max(applied, -plant.u_max), plant.u_max)
    for _ in range(plant.substeps):
        advance(plant.disks, x, scratch, t, applied, w)
        _apply_coulomb_friction(plant, x)


@kernel
def _apply_coulomb_friction(plant: TorsionalModel, x: Vector) -> None:
    """Add the effect of Coulomb friction to the state at the end of a sub-step without it."""
    gamma = plant.disks.disturbance
    lower = upper = 0.0
    for _ in range(_ITERATIONS):
        lower = _stopping_torque(x[2] + gamma[2, 1] * upper, gamma[2, 0], plant.coulomb[0])
        upper = _stopping_torque(x[3] + gamma[3, 0] * lower, gamma[3, 1], plant.coulomb[1])
    for i in range(gamma.shape[0]):
        x[i] += gamma[i, 0] * lower + gamma[i, 1] * upper


@kernel
def _stopping_torque(speed: float, gain: float, largest: float) -> float:
    """Return the torque that stops a disk of this ``speed``, limited to ±``largest``."""
    return min(max(-speed / gain, -largest), largest)


@dataclass(frozen=True, eq=False, repr=False)
class TorsionalPlant(Described):
    """Two disks with friction, drive and encoder; ``torsional`` makes it.

    Its states are those of ``linear``, followed by the delayed values of u.
    """

    linear: LinearPlant  #: disks with viscous friction alone, from u [V] to the angle: for design
    coulomb: tuple[float, float]  # Coulomb friction of the lower and the upper disk [N m]
    u_max: float  # limit of u [V]
    step: float  # rounding of u [V]; 0.0 for none
    counts: int | None
    late: int  # delay of u in samples
    name: str = "torsional plant"
    compiled = True
    signals = _SIGNALS

    @property
    def order(self) -> int:
        """Number of states, including the delayed values of u."""
        return self.linear.order + self.late

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs: torques on the lower and the upper disk [N m]."""
        return self.linear.disturbances

    @property
    def resolution(self) -> float:
        """Angle of one count of the encoder [rad]; 0.0 without an encoder."""
        return 0.0 if self.counts is None else math.tau / self.counts

    def sampled(
        self, dt: float, interpret: bool = False
    ) -> TorsionalModel | DelayedPlantModel | EncodedPlantModel:
        """Return the parameters for a sample time ``dt`` [s]: disks, in a delay, in an encoder."""
        dry = any(c > 0.0 for c in self.coulomb)
        if checks.positive("dt", dt, "s") > _LONGEST_SAMPLE and dry:
            raise ValueError(
                f"dt = {dt!r} s: must be at most {_LONGEST_SAMPLE} s with dry friction"
            )
        substeps = math.ceil(dt / _SUBSTEP - 1e-9) if dry else 1
        disks = self.linear.sampled(dt / substeps)
        model: TorsionalModel | DelayedPlantModel = TorsionalModel(
            disks, substeps, np.array(self.coulomb), self.u_max, self.step
        )
        if self.late:
            model = DelayedPlantModel(model, self.linear.order)
        return model if self.counts is None else EncodedPlantModel(model, self.resolution)


def torsional(
    lower_inertia: float = 0.0187,
    upper_inertia: float = 0.0019,
    motor_inertia: float = 0.0005 / 9.0,
    belt: float = 3.0,
    stiffness: float = 2.908,
    shaft_damping: float = 0.0,
    lower_viscous: float = 0.02122,
    upper_viscous: float = 0.001512,
    lower_coulomb: float = 0.01,
    upper_coulomb: float = 0.001,
    torque_constant: float = 0.09617,
    amplifier: float = 2.0,
    current_limit: float = 10.0,
    dac_bits: int | None = 16,
    counts: int | None = 16_000,
    late: int = 0,
) -> TorsionalPlant:
    """Return the ECP 205 torsional plant with two disks, from physical parameters.

    States: angles of the lower and the upper disk [rad], their speeds [rad/s], then the delayed
    values of u [V]. The control signal u [V] is the amplifier's input; the disturbances are torques
    on the lower and the upper disk [N m]. Output: the encoder's angle of the upper disk [rad].

    Defaults are published values if there are any. The free ones are chosen so that the plant
    without Coulomb friction has the transfer function that the paper identified, except for its
    ``0.1032``: an integrator replaces a pole at −5.7e-5 rad/s. The other coefficients agree to
    0.01 %.

    Parameters
    ----------
    lower_inertia
        of the lower disk [kg m²]: the bare disk, as the upper one, and four weights of 0.5 kg and
        5 cm diameter at 9 cm from the axis [1]_.
    upper_inertia
        of the upper disk [kg m²]: 0.0103 with two such weights [2]_, less the weights.
    motor_inertia
        of the motor and the parts that turn with it [kg m²]: 0.0005 at the disk [1]_, so less by
        ``belt²``.
    belt
        speed reduction N from the motor to the lower disk: 3 (paper, section V; [1]_).
    stiffness
        of the shaft between the disks [N m/rad]: 1.37 for its whole length [2]_, twice that for
        half of it, another place for a disk [1]_. Here 6 % more than twice, which gives the
        resonance of the paper.
    shaft_damping
        d [N m s/rad]: none in the published models; assumed zero.
    lower_viscous, upper_viscous
        viscous friction of the disks [N m s/rad]: published 0.007 and 0.001 [2]_. The defaults
        follow from the paper's transfer function: 1.5 times the published value for the upper disk,
        three times for the lower one (identification takes some Coulomb friction for viscous).
    lower_coulomb, upper_coulomb
        Coulomb friction of the disks [N m]: assumed. Friction is said to dominate free swings of
        less than 0.04 rad [1]_; 0.01 is a tenth of the spring's torque there. The upper disk has
        only its bearings and gets a tenth of that.
    torque_constant
        of the motor k_t [N m/A]: about 0.1 [1]_; here such as to give the paper's gain.
        ``k_a k_t N`` is then 0.58 N m/V; 0.70 is published [2]_.
    amplifier
        its gain k_a [A/V]: about 2 [1]_.
    current_limit
        of the amplifier [A]: assumed.
    dac_bits
        of the converter, over ±10 V: 16 (NI PCI-6221 data sheet); None for no rounding.
    counts
        of the encoder a turn: 16000 [1]_; None for the angle itself.
    late
        delay of u in samples: assumed 0, as if the computer answers within the sample.

    Raises
    ------
    ValueError
        for an inertia, stiffness, belt, torque constant, amplifier or current limit that is not
        positive, a friction or damping below zero, or bits, counts or samples out of range.

    References
    ----------
    .. [1] *Torsional Pendulum*, laboratory manual for the ECP Model 205a in a public repository:
       weights, inertia of the drive, "hardware gains", range of amplitudes.
    .. [2] Course work on the Model 205a (ELEC 481, tasks 1 to 3) in a public repository: J, c and k
       of two disks with two weights each.

    Examples
    --------
    >>> twin = torsional()
    >>> twin.order, twin.u_max
    (4, 5.0)
    """
    j1 = checks.positive("lower_inertia", lower_inertia, "kg m²")
    j2 = checks.positive("upper_inertia", upper_inertia, "kg m²")
    ratio = checks.positive("belt", belt)
    k = checks.positive("stiffness", stiffness, "N m/rad")
    k_t = checks.positive("torque_constant", torque_constant, "N m/A")
    k_a = checks.positive("amplifier", amplifier, "A/V")
    i_max = checks.positive("current_limit", current_limit, "A")
    j1 += ratio**2 * checks.non_negative("motor_inertia", motor_inertia, "kg m²")
    d = checks.non_negative("shaft_damping", shaft_damping, "N m s/rad")
    c1 = checks.non_negative("lower_viscous", lower_viscous, "N m s/rad")
    c2 = checks.non_negative("upper_viscous", upper_viscous, "N m s/rad")
    dry_lower = checks.non_negative("lower_coulomb", lower_coulomb, "N m")
    dry_upper = checks.non_negative("upper_coulomb", upper_coulomb, "N m")
    bits = checks.optional(checks.whole, "dac_bits", dac_bits, 2, 32)
    step = 0.0 if bits is None else 2.0 * _RANGE / 2**bits
    counts = checks.optional(checks.whole, "counts", counts, 1)
    late = checks.whole("late", late, 0, 1000)
    A, E = chain_matrices((j1, j2), (k,), (d,), (c1, c2))
    B, C = ratio * k_t * k_a * E[:, 0], [0.0, 1.0, 0.0, 0.0]
    linear = labelled(
        LinearPlant(A, B, C, E, name="torsional plant without friction"), *_SIGNALS[:3]
    )
    u_max = min(_RANGE, i_max / k_a)
    return TorsionalPlant(linear, (dry_lower, dry_upper), u_max, step, counts, late)


def torsional_identified() -> LinearPlant:
    """Return the testbed as identified in the paper (section V, System Model).

    ``4.6e4 / (s⁴ + 1.901 s³ + 1683 s² + 1812 s + 0.1032)``. States: the upper disk's angle [rad]
    and its derivatives [rad/s, …]. There is one disturbance, which enters as u [V] does.
    """
    model = [4.6e4], [1.0, 1.901, 1683.0, 1812.0, 0.1032]
    plant = LinearPlant.of(model, name="torsional plant as identified")
    return labelled(plant, _SIGNALS.y, _SIGNALS.u, w=_SIGNALS.u)


# Longest sub-step [s]: 84 cogging waves a revolution at 2 revolutions a second then pass in 60 of
# them. Chosen by hand.
# Longest sample with friction or cogging [s]: far above that of any servo.
# Points of the table for given orders, at least, and for each wave of the highest order: its cubic
# interpolation has an error of 2e-4 of the amplitude.
_POINTS, _POINTS_A_WAVE = 4096, 32
_HIGHEST_ORDER = 10_000
_SIGNALS_DC_MOTOR = Signals.of(
    "angle [rad]", "voltage [V]", ("torque [N m]", "shift of the cogging [rad]")
)


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
def _measure_dc_motor(plant: DcMotorModel, x: Vector) -> float:
    return x[0]


@advance.register(DcMotorModel)
def _advance_dc_motor(
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
    flow: Flow  # the current [A]
    name: str = "DC motor"
    compiled = True
    signals = _SIGNALS_DC_MOTOR

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


@explained("quell.plants.dc_motor(resistance=0.5, inertia=2e-4)")
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
    current = Flow((0.0, -k / R), 1.0 / R) if L is None else Flow((0.0, 0.0, 1.0))
    most_u = checks.positive("voltage_limit", voltage_limit, "V")
    n = len(B)
    ends = np.eye(n)
    linear = LinearPlant(A, B, ends[0], ends[:, 1:2] / J, name="DC motor without friction")
    linear = labelled(linear, _SIGNALS_DC_MOTOR.y, _SIGNALS_DC_MOTOR.u, _SIGNALS_DC_MOTOR.w[:1])
    return DcMotor(
        linear=linear,
        coulomb=dry,
        stiction=most,
        stribeck=checks.positive("stribeck_speed", stribeck_speed, "rad/s"),
        cogging=_table(cogging, cogging_map),
        u_max=most_u,
        counts=checks.optional(checks.whole, "counts", counts, 1),
        flow=current._replace(largest=most_u),
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
