"""The trial of the guard on flexible axes, on coupled joints, and near rest.

Random flexible axes: a motor and one or two inertias, the encoder at either end.

J_motor is 1e-4 to 1e-3 kg m², J_load/J_motor 0.3 to 10. The load swings against a held motor at 15
to 90 Hz, with a damping of 0, 0.005 or 0.03 (not 0 where a design would invert it); a third
inertia, 0.3 J_motor, sits in between on a coupling that is twice as stiff. 4 kHz, torque a sample
late. A torque of 0.1 to 1 N m at 1 to 16 Hz acts on the load after 30 to 60 lags of the observer;
the encoder's noise is 2π/2¹⁶ to 2π/2²³ rad.

``STRUCTURES`` are the observers. *Model-free*: order 2 with the encoder at the motor, 4 at the
load, b0 that of the rigid axis or of the chain. The others have a model, exact in half of the
loops; in the other half the inertias behind the motor are 30 % off. With the encoder at the load
it leaves out the damping of the couplings, whose zero at −k/c no loop sees.

omega_o is 3 to 8 omega_c, and omega_c as large as the modulus margin of 0.45 to 0.7 that a loop
draws allows: M_s is 1.4 to 2.2.

The trial on axes: honest learners beside no learner, in means over draws of the noise.

There are three parts: random flexible axes; for every fourth of them an arm whose two joints are
coupled (``arm``), with a right b0 and with one that is too small; and for every eighth a draw of
the features in the trial of settling near rest (``near_rest``).

On flexible axes the error is y, as the reference is zero. Measures are the RMS errors from the
start of the load on, and of the second half of that time (*late*), each the mean over draws of the
noise; ``study`` says how loops are judged by means, and what chance is.

Every axis has ``Harmonic()`` or ``Kalman()`` in turn, every joint of an arm ``Harmonic()``. A run
is *lost* if it diverges or leaves |y| = 100 rad where the loop without learner does not. The ratios
of an arm are those of the joint that loses more.

Two coupled axes: a rigid two-link arm, each joint with a controller of its own.

The links are uniform rods (``plants.arm``). γ is 9.81 m/s² in half of the arms, which move in a
vertical plane, else 0.

Each joint has an ADRC of order 2 for the chain of integrators, omega_c = 8 and omega_o = 60 rad/s,
that takes all of the coupling for a disturbance. Its b0 is the gain from its torque to its
acceleration at the middle of the motion, (M⁻¹)_ii, or 2.4 times less. So the learner of a joint
acts on the other joint, whose guard sees that as a disturbance from outside.

At a fixed q the linearised loop without gravity is, for each eigenvalue λ of ``M⁻¹ diag(1/b0)``,
the loop of one joint with b/b0 = λ. The *margin* of an arm is the least modulus margin of these
loops over its motion. Arms of at least 0.35 are drawn, with b0 2.4 times too small of at least 0.2.

The joints follow sinusoids. Errors are those of y against the response that the design asks for,
omega_c²/(s + omega_c)² times r.

Settling near rest: a learner whose features change with every small motion.

On the paper's study (``experiments.two_mass_spring``) MF-ESO takes a unit step from rest, after
110 s of training. The learner is ``RLS`` with 30 random Fourier features of the state. Near rest q
is small, and an authority that changes can shake a loop that would come to rest: no RMS error
shows that. Settling time (to ±0.2 %) and overshoot are each the mean over the draws of the noise.
The guarded loop is compared with the *better* of the loops without learner and without guard, for
each of the two measures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from quell.analysis import analyse
from quell.controllers import ADRC, Axes
from quell.experiments import two_mass_spring as setup
from quell.experiments.common import step_scores
from quell.experiments.stress.adversaries import log_uniform
from quell.experiments.stress.general import HONEST
from quell.experiments.stress.loops import Table
from quell.experiments.stress.study import (
    OTHERS,
    USUAL,
    Bar,
    Judged,
    bars_of,
    check_numbers,
    compare,
    mean_errors,
    ratios,
    summary,
)
from quell.features import RandomFourier
from quell.files import as_json
from quell.guard import Guard
from quell.learners import RLS, Harmonic, Learner
from quell.observers import ESO
from quell.parallel import in_parallel
from quell.plants import LinearPlant, arm, delayed, n_mass, two_mass_spring
from quell.plants.linear import DelayedPlant
from quell.simulation.scenario import Scenario
from quell.simulation.simulate import simulate
from quell.types import Matrix, Vector

# ---- Random flexible axes ----

Rng = np.random.Generator

STRUCTURES = ("model-free", "model-based", "zeros kept", "own poles")
DT = 2.5e-4
"""Sample time, and delay of the torque [s]."""
# Lags of the observer, and periods of the load, that a run lasts at least.
_RUN_LAGS, _PERIODS = 300.0, 12.0
# Fastest observer that is drawn, in 1/dt, beyond which ``ADRC`` warns.
_FASTEST = 0.3
# omega_c is lowered by this factor until the margin suffices, or it is below the slowest [rad/s].
_LOWER, _SLOWEST = 0.8, 6.0
_MOST_TRIES = 1000
_PATTERN = (-0.8, 0.6)  # two poles of "own poles" in units of omega_o; the others lie at −1


@dataclass(frozen=True, eq=False)
class Axis:
    """A flexible axis, its controller without learner, and what acts on it."""

    structure: str  #: one of ``STRUCTURES``
    sensor: str  #: "motor" or "load"
    inertias: tuple[float, ...]  #: from the motor on [kg m²]
    stiffnesses: tuple[float, ...]  #: [N m/rad]
    damping: float  #: of each coupling [N m s/rad]
    wrong: float  #: factor of the model's inertias behind the motor
    omega_c: float
    omega_o: float
    margin: float  #: modulus margin without learner
    frequency: float  #: of the load [Hz]
    amplitude: float  #: of the load [N m]
    noise: float  #: standard deviation of the encoder's noise [rad]
    seed: int

    @property
    def linear(self) -> Any:
        """The axis without its delay."""
        return self._chain_of(1.0, self.damping)

    @property
    def plant(self) -> DelayedPlant:
        """The axis, the torque a sample late."""
        return delayed(self.linear, DT, DT)

    def _chain_of(self, wrong: float, damping: float) -> Any:
        """Return the axis with other inertias behind the motor and another damping."""
        inertias = (self.inertias[0], *(wrong * J for J in self.inertias[1:]))
        sensor = 1 if self.sensor == "motor" else len(inertias)
        dampings = [damping] * len(self.stiffnesses)
        return n_mass(inertias, self.stiffnesses, dampings, sensor=sensor)

    @cached_property
    def observer(self) -> ESO:
        """The observer."""
        if self.structure == "model-free":
            return ESO.model_free(*self._chain, self.omega_o, DT, delay=DT)
        model = self._chain_of(self.wrong, self.damping if self.sensor == "motor" else 0.0)
        own: list[float | tuple[float, float]] = [_PATTERN, *[-1.0] * (2 * len(self.inertias) - 1)]
        poles = own if self.structure == "own poles" else None
        kept = self.structure == "zeros kept"
        return ESO.model_based(model, self.omega_o, DT, keep_zeros=kept, poles=poles, delay=DT)

    @property
    def _chain(self) -> tuple[int, float]:
        """Order and b0 of a design without model."""
        if self.sensor == "motor":
            return 2, 1.0 / sum(self.inertias)
        stiffness = 1.0 / sum(1.0 / k for k in self.stiffnesses)
        return 4, stiffness / (self.inertias[0] * self.inertias[-1])

    def controller(self, learner: Learner | None = None, guard: Guard | None = None) -> ADRC:
        """Return the controller, with a learner and a guard."""
        return ADRC(self.observer, self.omega_c, learner=learner, guard=guard)

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return max(_RUN_LAGS * self.observer.lag_time, _PERIODS / self.frequency)

    @property
    def load_at(self) -> float:
        """Start of the load [s]."""
        return float(np.random.default_rng(self.seed).uniform(30.0, 60.0) * self.observer.lag_time)

    def scenario(self, draw: int) -> Scenario:
        """Return load and noise; ``draw`` is the number of the draw of the noise."""
        t = DT * np.arange(round((self.load_at + self.duration) / DT) + 1, dtype=np.float64)
        since = np.maximum(t - self.load_at, 0.0)
        load = self.amplitude * np.sin(2.0 * np.pi * self.frequency * since)
        rng = np.random.default_rng([self.seed, draw])
        noise = Table(self.noise * rng.standard_normal(t.size), DT)
        return Scenario(0.0, float(t[-1]), (Table(load, DT),), noise)

    def describe(self) -> str:
        """Return what a table shows of it."""
        right = "" if self.wrong == 1.0 or self.structure == "model-free" else ", model 30 % off"
        return (
            f"{len(self.inertias)} inertias, ratio {self.inertias[-1] / self.inertias[0]:.2g}, "
            f"encoder at the {self.sensor}, {self.structure}{right}, {self.frequency:.2g} Hz, "
            f"margin {self.margin:.2f}, seed {self.seed}"
        )


def draw_axis(rng: Rng, structure: str | None = None) -> Axis:
    """Return a random axis, with an observer of the ``structure`` if it is given."""
    for _ in range(_MOST_TRIES):
        found = _slow_enough(_draw(rng, structure), rng.uniform(0.45, 0.7))
        if found is not None:
            return found
    raise ValueError(f"structure = {structure!r}: no axis with a margin was found")


def _draw(rng: Rng, structure: str | None) -> Axis:
    motor, ratio = log_uniform(rng, 1e-4, 1e-3), log_uniform(rng, 0.3, 10.0)
    load, swing = ratio * motor, 2.0 * np.pi * log_uniform(rng, 15.0, 90.0)
    stiffness = load * swing**2
    kind = str(rng.choice(STRUCTURES)) if structure is None else structure
    sensor = str(rng.choice(["motor", "load"]))
    # A design that inverts zeros without damping is refused.
    inverts = sensor == "motor" and kind != "model-free"
    damping = float(rng.choice([0.005, 0.03] if inverts else [0.0, 0.005, 0.03]))
    three = rng.random() < 0.25
    omega_c = log_uniform(rng, 30.0, 300.0)
    return Axis(
        structure=kind,
        sensor=sensor,
        inertias=(motor, 0.3 * motor, load) if three else (motor, load),
        stiffnesses=(2.0 * stiffness, stiffness) if three else (stiffness,),
        damping=2.0 * damping * math.sqrt(stiffness * load),
        wrong=float(rng.choice([1.0, 1.0, 0.7, 1.3])),
        omega_c=omega_c,
        omega_o=rng.uniform(3.0, 8.0) * omega_c,
        margin=0.0,
        frequency=log_uniform(rng, 1.0, 16.0),
        amplitude=log_uniform(rng, 0.1, 1.0),
        noise=2.0 * np.pi / 2.0 ** rng.uniform(16.0, 23.0),
        seed=int(rng.integers(2**31)),
    )


def _slow_enough(axis: Axis, margin: float) -> Axis | None:
    """Return the axis with bandwidths as large as the margin allows; None if none are."""
    while axis.omega_c > _SLOWEST:
        if axis.omega_o * DT <= _FASTEST:
            found = analyse(axis.linear, axis.controller(), delay=DT)
            if found.stable and found.margins.modulus >= margin:
                return replace(axis, margin=float(found.margins.modulus))
        axis = replace(axis, omega_c=_LOWER * axis.omega_c, omega_o=_LOWER * axis.omega_o)
    return None


# ---- Two coupled axes ----

ARM_DT = 1e-3
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

    @cached_property
    def plant(self) -> Any:
        """The arm, with a torque at each joint."""
        return arm(self.lengths, self.masses, gravity=self.gravity, substeps=1)

    def inertia(self, elbow: float) -> Matrix:
        """Return M at q_2 = ``elbow`` [kg m²]."""
        return self.plant.mass_matrix([0.0, elbow])

    @property
    def b0(self) -> Vector:
        """The b0 of the two controllers [rad/s² per N m]."""
        return np.diag(np.linalg.inv(self.inertia(self.elbow))) / self.too_small

    def gains(self) -> Vector:
        """Return the eigenvalues λ over the motion."""
        angles = self.elbow + self.amplitudes[1] * np.linspace(-1.0, 1.0, 21)
        found = [np.linalg.solve(self.inertia(q), np.diag(1.0 / self.b0)) for q in angles]
        return np.real(np.linalg.eigvals(np.array(found))).ravel()

    def controller(self, learner: Learner | None, guard: Guard | None) -> Axes:
        """Return the controllers of the joints."""
        observers = [ESO.model_free(2, float(b0), OMEGA_O, ARM_DT) for b0 in self.b0]
        return Axes([ADRC(each, OMEGA_C, learner=learner, guard=guard) for each in observers])

    def reference(self) -> tuple[Matrix, Matrix]:
        """Return the references of the joints, and the response that the design asks for."""
        from scipy.signal import lsim

        t = ARM_DT * np.arange(round(_DURATION / ARM_DT) + 1)
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


def draw_arm(rng: np.random.Generator, too_small: float = 1.0) -> Arm:
    """Return a random arm of at least ``LEAST_MARGIN``."""
    for _ in range(_MOST_TRIES):
        drawn = _draw_arm(rng, too_small)
        gains = drawn.gains()
        margin = min(_margin(round(float(each), 3)) for each in (gains.min(), gains.max()))
        if margin >= LEAST_MARGIN[too_small]:
            return replace(drawn, margin=margin)
    raise ValueError(f"too_small = {too_small!r}: no arm with such a margin was found")


def _draw_arm(rng: np.random.Generator, too_small: float) -> Arm:
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
    controller = ADRC(ESO.model_free(2, 1.0, OMEGA_O, ARM_DT), OMEGA_C)
    found = analyse(LinearPlant.of(([gain], [1.0, 0.0, 0.0])), controller)
    return float(found.margins.modulus) if found.stable else 0.0


def arm_errors(
    drawn: Arm, learner: Learner | None, guard: Guard | None, draws: range
) -> JointErrors:
    """Return the errors of the joints, over these draws of the noise."""
    r, asked = drawn.reference()
    controller = drawn.controller(learner, guard)

    def once(draw: int) -> JointErrors:
        noise = _NOISE * np.random.default_rng([drawn.seed, draw]).standard_normal(r.shape)
        follow, seen = ([Table(each, ARM_DT) for each in table.T] for table in (r, noise))
        x0 = [0.0, drawn.elbow, 0.0, 0.0]
        run = simulate(
            drawn.plant, controller, Scenario(follow, _DURATION, noise=seen, x0=x0), limit=_LIMIT
        )
        if run.diverged:
            return JointErrors(np.full(2, np.inf), np.full(2, np.inf))
        square = ((run["y"] - asked) ** 2)[round(_JUDGED_AT / ARM_DT) :]
        late = square[square.shape[0] // 2 :]
        return JointErrors(np.sqrt(square.mean(axis=0)), np.sqrt(late.mean(axis=0)))

    return mean_errors(once, draws)


# ---- Settling near rest ----

FEATURES = 30
"""Number of random Fourier features."""


class Settling(NamedTuple):
    """How a step ends, in means over draws of the noise."""

    time: float  #: settling time [s]; infinite if one of the runs does not settle
    overshoot: float  #: as a fraction of the step


class RestOutcome(NamedTuple):
    """The steps with one draw of the features."""

    features: int  #: seed of the features
    guarded: Settling
    unguarded: Settling
    plain: Settling  #: without learner
    other_noise: Settling  #: the same, with other draws of the noise

    @property
    def longer(self) -> float:
        """Settling time of the guarded loop over that of the better of the two others."""
        return self.guarded.time / min(self.unguarded.time, self.plain.time)

    @property
    def further(self) -> float:
        """Overshoot of the guarded loop less that of the better of the two others."""
        return self.guarded.overshoot - min(self.unguarded.overshoot, self.plain.overshoot)


def settle(learner: Learner | None, guard: Guard | None, draws: range) -> Settling:
    """Return how the step ends, in the mean over these draws of the noise."""

    def once(seed: int) -> Settling:
        settings = setup.Settings(seed=seed)
        observer = setup.controller(settings).observer
        controller = ADRC(observer, settings.omega_c, learner=learner, guard=guard)
        scenario = replace(setup.scenario(settings), duration=setup.FORCE_AT)
        run = simulate(two_mass_spring(), controller, scenario, record_every=10)
        if run.diverged:
            return Settling(math.inf, math.inf)
        part = run.window(*setup.STEP_WINDOW)
        scores = step_scores(run.t[part], run["y"][part], 1.0, setup.BAND)
        pair = scores["settling_time"], scores["overshoot"]
        return Settling(*(math.inf if value is None else value for value in pair))

    return mean_errors(once, draws)


def run_near_rest(features: int, guard: Guard | None) -> RestOutcome:
    """Run the steps with the features of a seed."""
    learner = RLS(features=RandomFourier(FEATURES, seed=features))
    unguarded = settle(learner, None, USUAL)
    return RestOutcome(
        features=features,
        guarded=unguarded if guard is None else settle(learner, guard, USUAL),
        unguarded=unguarded,
        plain=settle(None, None, USUAL),
        other_noise=settle(None, None, OTHERS),
    )


# ---- The trial on axes ----

_AXES_PER_ARM, _AXES_PER_STEP = 4, 8
# Overshoot [fraction of the step] that a guard may add near rest: half of the settling band.
_FURTHER = 0.001
_WORST_LISTED = 10
# What a bar is over, what it measures, where that is in a ``summary``, and the bar.
_BARS = (
    ("all", "lost", "lost", 0.0),
    ("axes", "RMS, guarded over no learner, largest", "rms max", 1.02),
    ("axes", "late, guarded over no learner, largest", "late max", 1.02),
)
_ARM_BAR = ("RMS, guarded over no learner, largest of the worse joints", "rms max", 1.0)


class AxisErrors(NamedTuple):
    """RMS errors, means over draws of the noise, or their ratios; infinite if a run is lost."""

    rms: float  #: from the start of the load on
    late: float  #: of the second half of that time


@dataclass(frozen=True)
class AxisOutcome(Judged):
    """The ratios of one loop."""

    learner: str
    loop: str
    structure: str
    sensor: str
    guarded: AxisErrors  #: over no learner
    unguarded: AxisErrors  #: over no learner
    chance: AxisErrors  #: no learner with other draws of the noise, over no learner

    @property
    def over_unguarded(self) -> AxisErrors:
        """The guarded loop over the unguarded one; zero where that is lost."""
        return AxisErrors(*(a / b for a, b in zip(self.guarded, self.unguarded, strict=True)))


@dataclass(frozen=True)
class AxesResult:
    """All loops of the trial."""

    settings: dict[str, Any]
    outcomes: Sequence[AxisOutcome]  #: of the flexible axes
    arms: Sequence[AxisOutcome] = ()
    rest: Sequence[RestOutcome] = ()

    @property
    def by_structure(self) -> dict[str, list[AxisOutcome]]:
        """The axes of each kind of observer, and the arms of each b0."""
        found: dict[str, list[AxisOutcome]] = {}
        for outcome in (*self.outcomes, *self.arms):
            found.setdefault(outcome.structure, []).append(outcome)
        return found

    def bars(self) -> list[Bar]:
        """Return the figures that have a bar."""
        every = [*self.outcomes, *self.arms]
        rows = bars_of(_BARS, AxisErrors, {"all": every, "axes": self.outcomes})
        if self.outcomes:
            found = summary(self.outcomes, AxisErrors, "over_unguarded")
            median = "guarded over unguarded, median"
            rows += [
                Bar(f"axes, {name}", median, found[key]["median"], 1.15)
                for name, key in (("RMS", "rms"), ("late", "late"))
            ]
        for kind, outcomes in self.by_structure.items():
            if outcomes[0] in self.arms:
                rows += bars_of([(kind, *_ARM_BAR)], AxisErrors, {kind: outcomes})
        return rows + self._rest_bars()

    def _rest_bars(self) -> list[Bar]:
        if not self.rest:
            return []
        beside = "guarded, and better of no learner and unguarded"
        noise = [o.other_noise for o in self.rest]
        plain = [o.plain for o in self.rest]
        longer = max(a.time / b.time for a, b in zip(noise, plain, strict=True))
        further = max(a.overshoot - b.overshoot for a, b in zip(noise, plain, strict=True))
        slowest, most = max(o.longer for o in self.rest), max(o.further for o in self.rest)
        return [
            Bar("near rest", f"ratio of settling times, {beside}, largest", slowest, 1.05, longer),
            Bar("near rest", f"difference of overshoots, {beside}", most, _FURTHER, further),
        ]

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``."""
        counted = [o for o in (*self.outcomes, *self.arms) if not o.plain_lost]
        worst = sorted(counted, key=lambda o: -o.guarded.rms)[:_WORST_LISTED]
        return {
            "settings": self.settings,
            "bars": [{**bar._asdict(), "met": bar.met} for bar in self.bars()],
            "honest": summary(self.outcomes, AxisErrors),
            "honest_other_noise": summary(self.outcomes, AxisErrors, "chance"),
            "honest_over_unguarded": summary(self.outcomes, AxisErrors, "over_unguarded"),
            "near_rest": [as_json(outcome, *outcome._fields) for outcome in self.rest],
            "structures": {
                name: summary(each, AxisErrors) for name, each in self.by_structure.items()
            },
            "worst": [outcome.to_json() for outcome in worst],
        }


def run(
    count: int, seed: int, *, guard: Guard | None, progress: Callable[[float], None] | None = None
) -> AxesResult:
    """Run the trial on ``count`` flexible axes, with the guard or without (None).

    There are also a fourth as many arms of each kind, and an eighth as many steps near rest.

    Seeds below 10 000 are for tuning, from 1 000 000 on for judging. ``progress`` is called with
    the finished share.
    """
    check_numbers(0, count, seed)
    of_arms, steps = math.ceil(count / _AXES_PER_ARM), math.ceil(count / _AXES_PER_STEP)
    jobs: list[Callable[[], Any]] = [partial(run_one, seed, i, guard) for i in range(count)]
    for too_small in (1.0, TOO_SMALL):
        jobs += [partial(run_arm, seed, i, too_small, guard) for i in range(of_arms)]
    jobs += [partial(run_near_rest, seed + i, guard) for i in range(steps)]
    settings = {
        "honest": count,
        "seed": seed,
        "guard": None if guard is None else asdict(guard),
        "learners": {name: repr(learner) for name, learner in HONEST.items()},
        "loops": __doc__,
        "arms": __doc__,
        "near_rest": __doc__,
        "ratios": __doc__,
    }
    found = in_parallel(jobs, progress)
    last = count + 2 * of_arms
    return AxesResult(settings, found[:count], found[count:last], found[last:])


def run_one(seed: int, index: int, guard: Guard | None) -> AxisOutcome:
    """Run the loop with this number."""
    axis = draw_axis(np.random.default_rng([seed, index]))
    kind = list(HONEST)[index % len(HONEST)]
    of_axis, learner = partial(errors, axis), HONEST[kind]
    return AxisOutcome(
        kind, axis.describe(), axis.structure, axis.sensor, *_beside(of_axis, learner, guard)
    )


def run_arm(seed: int, index: int, too_small: float, guard: Guard | None) -> AxisOutcome:
    """Run the arm with this number, with a b0 that is so many times too small."""
    drawn = draw_arm(np.random.default_rng([seed, index]), too_small)
    found = _beside(partial(arm_errors, drawn), LEARNER, guard)
    name = type(LEARNER).__name__
    return AxisOutcome(name, drawn.describe(), drawn.kind, "each joint", *found)


def _beside(
    errors: Callable[[Learner | None, Guard | None, range], Any],
    learner: Learner | None,
    guard: Guard | None,
) -> tuple[AxisErrors, AxisErrors, AxisErrors]:
    """Return the ratios to the loop without learner: guarded, unguarded, and by chance."""
    plain, guarded, chance = compare(errors, learner, guard)
    unguarded = guarded if guard is None else ratios(errors(learner, None, USUAL), plain)
    return AxisErrors(*guarded), AxisErrors(*unguarded), AxisErrors(*chance)


def errors(
    axis: Axis, learner: Learner | None, guard: Guard | None, draws: Iterable[int]
) -> AxisErrors:
    """Return the errors of a loop, over these draws of the noise."""
    controller = axis.controller(learner, guard)

    def once(draw: int) -> AxisErrors:
        run = simulate(axis.plant, controller, axis.scenario(draw), limit=_LIMIT)
        if run.diverged:
            return AxisErrors(math.inf, math.inf)
        square = run["y"][run.t >= axis.load_at] ** 2
        late = square[square.size // 2 :]
        return AxisErrors(math.sqrt(np.mean(square)), math.sqrt(np.mean(late)))

    return mean_errors(once, draws)


__all__ = ["STRUCTURES", "AxesResult", "Axis", "AxisOutcome", "draw_axis", "run", "run_one"]
