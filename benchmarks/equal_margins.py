"""What learning gives at equal margins, beside linear and adaptive control that is tuned as well.

    python benchmarks/equal_margins.py [--plant axis] [--m-ks 100] [--seeds 5] [--figure FILE]

The plant is an axis with viscous friction, ``y'' = −2 y' + 100 (u + w)``, sampled at 500 Hz, or one
of ``MACHINES``. For each class of load there are three controllers, all with M_s ≤ 2 and M_ks ≤ the
argument, their adaptation at the end of each run included (``analyse``):

- the best *linear* one, of the structures in ``STRUCTURES``, tuned by ``quell.tune`` for the
  spectrum of the class (``LoadSpectrum``), with a damping of 0.3;
- the best classical *adaptive* one, ``AdaptiveNotch``: a Kalman filter of the plant with a bias and
  oscillators, whose frequencies are found from a spectrum and followed by a phase-locked loop, or
  that turn with a known pitch; on the feedback and filter that ``tune`` finds for LQG;
- the best *learner* with the guard, on an ADRC of free poles that leaves it its margin.

Settings are chosen on seeds 101 and 102 (frequencies, phases, steps, noise), and judged on seeds 1
to 5. The last three loads are of no class that anybody was told: there the controllers for two
sinusoids are judged, or in the linear column the ADRC of free poles that is tuned for a step, if
that is better under this load. The error is that of y, less what the same loop does in the same
motion without the load; *late* is its RMS in the last fifth of 300 s, *whole* that of the whole
run, *after* the time until its RMS in windows of 2 s stays below a tenth of that of an ADRC of free
poles that is tuned for a step, and *largest* its largest size.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.stats import t as student

import quell as ql
from quell.analysis import analyse
from quell.controllers.baselines import AdaptiveNotch
from quell.features import Bias, Periodic, Polynomial, State
from quell.learners import RLS, Harmonic, Kalman
from quell.tuning import Constraints, LoadSpectrum

DT, LAST, M_S = 2e-3, 300.0, 2.0
# b, and a_0, a_1, … of y^(n) = −a_0 y − a_1 y' − … + b (u + w).
MACHINES = {
    "axis": (100.0, (0.0, 2.0)),
    "hanging": (100.0, (25.0, 2.0)),
    "lagged": (5000.0, (0.0, 100.0, 52.0)),
}
# With adaptation M_s and M_ks may exceed the bound by this share.
TOLERANCE = 0.01
# Poles of linear controllers are bounded by M_ks alone; a learner needs the observer's lag.
FASTEST = 4.5
# Seeds on which settings are chosen.
TUNING_SEEDS = (101, 102)
# Frequencies that sinusoids may have [rad/s], and the wave of the cogging [rad/y-unit].
BAND, WAVE = (0.5, 5.5), 20.0
KNOWN = 3.0
LEARNERS: dict[str, Callable[[], Any]] = {
    "Kalman()": Kalman,
    "Kalman, bias of 1 rad/s": lambda: Kalman(bias_bandwidth=1.0),
    "Harmonic(count=2, bias=False)": lambda: Harmonic(
        count=2, bias=False, pair_bandwidth=10.0, limits=(0.5, 15.0)
    ),
    "RLS(Periodic)": lambda: RLS(
        Periodic(period=math.tau / WAVE, orders=(1,)) + Bias(), bias_bandwidth=0.0
    ),
    "RLS(Polynomial)": lambda: RLS(State() + Polynomial(3, states=(1,)), bias_bandwidth=0.0),
}
# M_s of the loop without learner or oscillators: the first that leaves enough is taken.
WITHOUT = (1.9, 1.75, 1.6, 1.45, 1.3)


class Class(NamedTuple):
    """A class of load, and what is tried for it."""

    told: tuple[str, str, str]  # what linear, adaptive and learning controllers were told
    structures: tuple[str, ...]
    notches: tuple[tuple[int, tuple[float, ...]], ...]  # numbers of sinusoids, and waves
    learners: tuple[str, ...]
    frequencies: tuple[float, ...] = ()  # known ones


ANY_LEARNER = ("Kalman()", "Kalman, bias of 1 rad/s", "Harmonic(count=2, bias=False)")
CLASSES = {
    "sinusoid": Class(
        ("band", "band, one sinusoid", "limits, at most two sinusoids"),
        ("resonator-2", "resonator-3"),
        ((1, ()),),
        ("Harmonic(count=2, bias=False)",),
    ),
    "known sinusoid": Class(
        ("frequency", "frequency", "limits, at most two sinusoids"),
        ("resonator",),
        ((1, ()),),
        ("Harmonic(count=2, bias=False)",),
        (KNOWN,),
    ),
    "two sinusoids": Class(
        ("band", "band, two sinusoids", "limits, two sinusoids"),
        ("resonator-2", "resonator-3"),
        ((2, ()),),
        ("Harmonic(count=2, bias=False)",),
    ),
    "cogging": Class(
        ("spectrum", "pitch", "pitch"),
        ("resonator-2",),
        ((0, (WAVE,)),),
        ("RLS(Periodic)",),
    ),
    "spring": Class(
        ("spectrum", "nothing", "that it is a polynomial of y"),
        ("poles-3", "resonator"),
        ((1, ()), (2, ())),
        ("RLS(Polynomial)",),
    ),
    "steps": Class(
        ("spectrum", "nothing", "nothing"), ("poles", "resonator"), ((1, ()),), ANY_LEARNER
    ),
    "noise": Class(
        ("spectrum", "nothing", "nothing"), ("poles", "resonator"), ((1, ()),), ANY_LEARNER
    ),
}
# Loads of no class that was told: judged with the controllers for two sinusoids.
UNTOLD = ("drifting", "changing", "pulses")
FOR_UNTOLD = "two sinusoids"
KINDS = ("linear", "adaptive", "learner")


def rate(machine: str, waves: float, hardness: float) -> Callable[..., Any]:
    """Return the derivatives of the state; ``waves`` sin(20 y) and −``hardness`` y³ act as u."""
    b, a = MACHINES[machine]
    a_0, a_1, a_2 = (*a, 0.0)[:3]

    def second(t: float, x: Any, u: float, w: Any) -> tuple[float, float]:
        total = u + w[0] + waves * np.sin(20.0 * x[0]) - hardness * x[0] ** 3
        return x[1], -a_0 * x[0] - a_1 * x[1] + b * total

    def third(t: float, x: Any, u: float, w: Any) -> tuple[float, float, float]:
        total = u + w[0] + waves * np.sin(20.0 * x[0]) - hardness * x[0] ** 3
        return x[1], x[2], -a_0 * x[0] - a_1 * x[1] - a_2 * x[2] + b * total

    return second if len(a) == 2 else third


def signals(t: np.ndarray, seed: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the reference and the load of each case, drawn by a seed."""
    rng, none = np.random.default_rng(seed), np.zeros(t.size)
    phase = rng.uniform(0.0, math.tau, 6)
    one = rng.uniform(1.0, 5.0)
    slow, fast = rng.uniform(1.0, 2.5), rng.uniform(3.5, 5.4)
    steps, at, value = none.copy(), 0, 1.0
    while at < t.size:
        length = int(rng.uniform(1.0, 5.0) / DT)
        steps[at : at + length] = value
        at, value = at + length, -value
    pole = np.exp(-DT / 0.5)
    noise = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], rng.normal(size=t.size))
    motion = np.sin(0.5 * t + phase[0]) + 0.3 * np.sin(0.23 * t + phase[1])
    single = np.sin(one * t + phase[2])
    double = np.sin(slow * t + phase[3]) + 0.7 * np.sin(fast * t + phase[4])
    pulses = (np.mod(t + phase[5], rng.uniform(2.0, 3.0)) < 0.5).astype(float)
    third = np.minimum(np.floor(3.0 * t / (t[-1] + DT)), 2.0)
    return {
        "sinusoid": (none, single),
        "known sinusoid": (none, np.sin(KNOWN * t + phase[2])),
        "two sinusoids": (none, double),
        "cogging": (motion, none),
        "spring": (motion, none),
        "steps": (none, steps),
        "noise": (none, noise),
        "drifting": (none, np.sin(one * t * (1.0 + 0.005 * t / 60.0) + phase[2])),
        "changing": (none, np.choose(third.astype(int), [single, steps, double])),
        "pulses": (none, pulses),
    }


def spectrum(load: str, r: np.ndarray, w: np.ndarray) -> LoadSpectrum:
    """Return what is known of a load; of sinusoids the band alone.

    Forces that depend on y are taken along the reference.
    """
    if "sinusoid" in load:
        return LoadSpectrum.band(*BAND)
    along = {"cogging": 0.3 * np.sin(WAVE * r), "spring": -0.3 * r**3}
    return LoadSpectrum.of_record(along.get(load, w), DT)


class Result(NamedTuple):
    """What a run left."""

    late: float
    whole: float
    after: float
    largest: float
    m_s: float
    m_ks: float


class Machine:
    """A plant, and what is made for it."""

    def __init__(self, name: str, m_ks: float, last: float, interpret: bool = False) -> None:
        self.interpret, self.m_ks = interpret, m_ks
        self.t = DT * np.arange(round(last / DT) + 1)
        b, a = MACHINES[name]
        self.linear = ql.plants.LinearPlant.of(([b], [1.0, *a[::-1]]))
        self.order = len(a)
        self.feedforward = ql.Feedforward.of(self.linear)
        linear = self.linear
        # The plant of each load, with an input w beside u.
        self.loaded = ql.plants.LinearPlant(linear.A, linear.B, linear.C, linear.B)
        self.plants: dict[str, Any] = {}
        for load, shape in (("cogging", (0.3, 0.0)), ("spring", (0.0, 0.3))):
            law = rate(name, *shape)
            self.plants[load] = ql.plants.NonlinearPlant(law, order=self.order, disturbances=1)
        self.tunings: dict[tuple[str, str], Any] = {}
        self.references: dict[tuple[str, int], float] = {}
        self.cases: dict[int, dict[str, tuple[np.ndarray, np.ndarray]]] = {}

    def case(self, load: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the reference and the load."""
        if seed not in self.cases:
            self.cases[seed] = signals(self.t, seed)
        return self.cases[seed][load]

    def error(self, load: str, controller: Any, seed: int) -> tuple[np.ndarray, Any]:
        """Return the error over time, infinite for a run that diverged, and the run."""
        r, w = self.case(load, seed)
        scenario = ql.Scenario(
            reference=ql.signals.Samples(self.t, r, hold="spline"),
            disturbances=(ql.signals.Samples(self.t, w),),
            noise=ql.signals.BandLimitedNoise(power=1e-12 * DT, sample_time=DT, seed=seed),
            duration=float(self.t[-1]),
        )
        how = {"interpret": self.interpret}
        run = ql.simulate(self.plants.get(load, self.loaded), controller, scenario, **how)
        if run.diverged:
            return np.full(self.t.size, np.inf), run
        y = run["y"].copy()
        if np.any(r):
            alone = self.alone(controller)
            y -= ql.simulate(self.loaded, alone, scenario, **how)["y"]
        return y, run

    def alone(self, controller: Any) -> Any:
        """Return the controller with what is linear of it."""
        if isinstance(controller, AdaptiveNotch):
            return controller.base
        return self.with_learner(controller, lambda: None)

    def with_learner(self, base: Any, make: Callable[[], Any], guard: Any = None) -> ql.ADRC:
        """Return an ADRC, with its own poles of the law, with a learner and the feedforward."""
        return ql.ADRC(
            base.observer,
            omega_c=base.omega_c,
            law_poles=base.law_poles,
            learner=make(),
            guard=guard,
            feedforward=self.feedforward,
        )

    def bounds(self, m_s: float, share: float = 1.0) -> Constraints:
        """Return the constraints of a loop."""
        return Constraints(m_s=m_s, m_t=None, m_ks=share * self.m_ks, damping=0.3)

    def tuned(self, structure: str, bounds: Constraints, **how: Any) -> Any:
        """Return the tuning of a structure, or None where nothing keeps the bounds."""
        if structure.startswith(("bandwidths", "poles", "resonator")):
            how["order"] = self.order
        try:
            return ql.tune(
                self.linear, DT, structure=structure, compare=(), constraints=bounds, **how
            )
        except ValueError as error:
            print(f"{structure}: {error}")
            return None

    def linear_for(self, structure: str, load: str, known: LoadSpectrum) -> Any:
        """Return the tuning of a structure for a class of load, or None."""
        key = structure, load.replace("two sinusoids", "sinusoid")  # the same is known of both
        if key not in self.tunings:
            objective: dict[str, Any] = {"objective": known}
            if CLASSES[load].frequencies:
                objective = {"objective": "load-iae", "frequencies": CLASSES[load].frequencies}
            bounds = replace(self.bounds(M_S), omega_o_dt=FASTEST)
            self.tunings[key] = self.tuned(structure, bounds, **objective)
            print(f"{structure} for {load}: tuned", flush=True)
        return self.tunings[key]

    def peaks(self, controller: Any, run: Any = None) -> tuple[float, float]:
        """Return M_s and M_ks of a loop; infinite for an unstable one."""
        try:
            loop = analyse(self.linear, controller, at=run)
        except ValueError:
            return np.inf, np.inf
        if not loop.stable:
            return np.inf, np.inf
        return 1.0 / loop.margins.modulus, loop.noise_to_control_peak

    def reference(self, load: str, seed: int) -> float:
        """Return the RMS error of the first ADRC, which is tuned for a step."""
        key = load, seed
        if key not in self.references:
            y, _ = self.error(load, self.first, seed)
            self.references[key] = rms(y)
        return self.references[key]

    first: Any

    def result(self, load: str, controller: Any, seed: int, looked_at: Any = None) -> Result:
        """Run a controller; its margins are those of ``looked_at``, without guard."""
        y, run = self.error(load, controller, seed)
        at = None if looked_at is None else run
        if looked_at is not None and looked_at is not controller:
            # The margins are those with all of the learner's authority.
            _, at = self.error(load, looked_at, seed)
        m_s, m_ks = self.peaks(controller if looked_at is None else looked_at, at)
        if not np.all(np.isfinite(y)):
            return Result(*[np.inf] * 4, m_s, m_ks)
        width = min(round(2.0 / DT), y.size)
        windows = y[: y.size // width * width].reshape(-1, width)
        large = np.sqrt(np.mean(windows**2, axis=1)) >= 0.1 * self.reference(load, seed)
        after = DT * width * (np.flatnonzero(large)[-1] + 1) if np.any(large) else 0.0
        late = rms(y[-self.t.size // 5 :])
        return Result(late, rms(y), after, float(np.max(np.abs(y))), m_s, m_ks)

    def keeps(self, results: list[Result]) -> bool:
        """Whether M_s and M_ks are kept."""
        m_s, m_ks = M_S * (1.0 + TOLERANCE), self.m_ks * (1.0 + TOLERANCE)
        return all(each.m_s <= m_s and each.m_ks <= m_ks for each in results)


def rms(y: np.ndarray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(y**2)))


# ---- The candidates of each column ----

Candidate = tuple[str, Any, Any]  # label, controller, what its margins are those of


class Bases(NamedTuple):
    """Loops without learner and without oscillators, by their M_s."""

    poles: list[Any]
    lqg: list[tuple[Any, float, float]]  # plant of the design, bandwidths


def linear(machine: Machine, load: str, quick: bool) -> list[list[Candidate]]:
    """Return the linear controllers that are tuned for a class, each a group of its own."""
    found: list[list[Candidate]] = []
    if quick:
        return [[("bandwidths", machine.first, None)]]
    known = spectrum(load, *machine.case(load, TUNING_SEEDS[0]))
    for structure in CLASSES[load].structures:
        tuned = machine.linear_for(structure, load, known)
        if tuned is not None:
            controller = machine.with_learner(tuned.design.controller, lambda: None)
            found.append([(structure, controller, None)])
    return found


def adaptive(machine: Machine, load: str, bases: Bases, quick: bool) -> list[list[Candidate]]:
    """Return notches of each kind, from loops with large to small M_s."""
    known, found = CLASSES[load], list[list[Candidate]]()
    for count, waves in known.notches:
        for bandwidth in (0.3,) if quick else (0.3, 1.0):
            for listening in (30.0,) if quick or not count else (10.0, 30.0):
                group: list[Candidate] = []
                for base in bases.lqg:
                    how: dict[str, Any] = {"bandwidth": bandwidth, "listening": listening}
                    how |= {"count": count, "waves": waves, "band": (0.5, 15.0)}
                    how |= {"frequencies": known.frequencies}
                    notch = AdaptiveNotch(*base, DT, **how)
                    label = f"AdaptiveNotch(bandwidth={bandwidth:g}, listening={listening:g})"
                    group.append((label, notch, notch))
                found.append(group)
    return found


def learning(machine: Machine, load: str, bases: Bases) -> list[list[Candidate]]:
    """Return guarded learners of each kind, on loops with large to small M_s."""
    found = []
    for label in CLASSES[load].learners:
        make = LEARNERS[label]
        pairs = [
            (machine.with_learner(base, make, ql.Guard()), machine.with_learner(base, make))
            for base in bases.poles
        ]
        found.append([(label, guarded, plain) for guarded, plain in pairs])
    return found


def chosen(
    machine: Machine, load: str, groups: list[list[Candidate]], by_whole: bool = False
) -> Candidate | None:
    """Return the best on the tuning seeds, of the first of each group that keep the margins.

    Of those whose late error is within 1.2 times the least it is the one with the least error in
    the whole run; ``by_whole`` of all.
    """
    kept: list[tuple[float, float, Candidate]] = []
    for group in groups:
        for candidate in group:
            _, controller, looked_at = candidate
            results = [machine.result(load, controller, seed, looked_at) for seed in TUNING_SEEDS]
            if machine.keeps(results):
                late, whole = (
                    rms(np.array([getattr(r, key) for r in results])) for key in ("late", "whole")
                )
                kept.append((late, whole, candidate))
                break
    least = min((late for late, _, _ in kept), default=np.inf)
    near = [each for each in kept if by_whole or each[0] <= 1.2 * least]
    return min(near, key=lambda each: each[1])[2] if near else None


# ---- The comparison ----


def judged(
    machine: Machine, load: str, candidate: Candidate | None, seeds: range
) -> dict[str, Any]:
    """Return what a controller leaves on the judging seeds: means and half widths of 95 %."""
    if candidate is None:
        return {"controller": "none keeps the margins"}
    label, controller, looked_at = candidate
    results = [machine.result(load, controller, seed, looked_at) for seed in seeds]
    found: dict[str, Any] = {"controller": label}
    for key in ("late", "whole", "after", "largest"):
        values = np.array([getattr(each, key) for each in results])
        if not np.all(np.isfinite(values)):
            found[key] = "a run diverged"
            continue
        found[key] = float(np.mean(values))
        if len(seeds) > 1:
            scale = student.ppf(0.975, len(seeds) - 1) / math.sqrt(len(seeds))
            found[f"{key} ±"] = float(scale * np.std(values, ddof=1))
    for key in ("m_s", "m_ks"):
        worst = max(getattr(each, key) for each in results)
        found[key] = worst if math.isfinite(worst) else "unstable"
    return found


def main() -> None:
    """Print a row for each load and controller."""
    # Here, so that the module can be loaded from other folders.
    from measured import options_of, parser_of, write

    parser = parser_of(__doc__)
    parser.add_argument("--plant", choices=MACHINES, default="axis")
    parser.add_argument("--m-ks", type=float, default=100.0)
    parser.add_argument("--last", type=float, default=LAST, help="length of the runs [s]")
    parser.add_argument("--seeds", type=int, default=5, help="judging seeds")
    parser.add_argument("--loads", help="only these, by names with commas")
    parser.add_argument("--figure", type=Path, help="file for a figure of the late errors")
    given = options_of(parser, last=0.1, seeds=1, loads="steps,pulses")
    warnings.simplefilter("ignore")
    machine = Machine(given.plant, given.m_ks, given.last, interpret=given.quick)
    names = [*CLASSES, *UNTOLD] if given.loads is None else given.loads.split(",")
    structure, without = ("bandwidths", WITHOUT[-1:]) if given.quick else ("poles", WITHOUT)
    machine.first = machine.tuned(structure, machine.bounds(M_S)).design.controller
    bases = Bases([], [])
    # Oscillators cost M_ks, too: more of it is left with less M_s.
    for m_s in without:
        tuned = machine.tuned(structure, machine.bounds(m_s, 0.97))
        if tuned is not None:
            bases.poles.append(tuned.design.controller)
        tuned = (
            None
            if given.quick or m_s < 1.6
            else machine.tuned("lqg", machine.bounds(m_s, 0.5 * m_s))
        )
        if tuned is not None:
            factor, *bandwidths = tuned.design.values.values()
            model = (machine.linear.A, factor * machine.linear.B, machine.linear.C)
            bases.lqg.append((ql.plants.LinearPlant(*model), *bandwidths))
    if given.quick:
        bases.lqg.append((machine.linear, 10.0, 20.0))
    seeds, rows = range(1, given.seeds + 1), dict[str, dict[str, Any]]()
    found: dict[str, dict[str, Candidate | None]] = {}
    for load in names:
        of = FOR_UNTOLD if load in UNTOLD else load
        if of not in found:
            found[of] = {
                "linear": chosen(machine, of, linear(machine, of, given.quick)),
                "adaptive": chosen(machine, of, adaptive(machine, of, bases, given.quick)),
                "learner": chosen(machine, of, learning(machine, of, bases)),
            }
        own = dict(found[of])
        if load in UNTOLD and not given.quick:
            for_step = ("poles, for a step", machine.alone(machine.first), None)
            known = [[each] for each in (own["linear"], for_step) if each is not None]
            own["linear"] = chosen(machine, load, known, by_whole=True)
        rows[load] = {kind: judged(machine, load, own[kind], seeds) for kind in KINDS}
        for kind, told in zip(KINDS, CLASSES[of].told, strict=True):
            as_before = f"as for {FOR_UNTOLD}" if kind != "linear" else "the better of two"
            rows[load][kind]["told"] = as_before if load in UNTOLD else told
        rows[load] |= ratios(rows[load])
        show(load, rows[load])
    write(given, rows)
    if given.figure is not None:
        draw(rows, given.figure)


def ratios(row: dict[str, Any]) -> dict[str, Any]:
    """Return the errors of the best other column over those of the learner."""
    found: dict[str, Any] = {}
    for key in ("late", "whole"):
        others = [row[kind].get(key, "none") for kind in ("linear", "adaptive")]
        best = min((each for each in others if not isinstance(each, str)), default=math.nan)
        own = row["learner"].get(key, "none keeps the margins")
        found[f"{key}, best other over learner"] = own if isinstance(own, str) else best / own
    return found


def show(load: str, row: dict[str, Any]) -> None:
    """Print the rows of a load."""
    for kind in KINDS:
        each = row[kind]
        numbers = [
            f"{key} {value:.3g}" for key, value in each.items() if not isinstance(value, str)
        ]
        print(f"{load:15} {kind:9} {each['controller']:44} {'  '.join(numbers)}", flush=True)


def draw(rows: dict[str, dict[str, Any]], path: Path) -> None:
    """Draw the late errors of each load."""
    import matplotlib.pyplot as plt

    with plt.rc_context(ql.style(columns=2)):
        figure, axes = plt.subplots(figsize=(7.16, 2.8))
        for i, kind in enumerate(KINDS):
            found = [rows[load][kind].get("late", math.nan) for load in rows]
            sizes = [math.nan if isinstance(each, str) else each for each in found]
            at = np.arange(len(rows)) + 0.28 * i - 0.28
            bars = axes.bar(at, sizes, 0.26, label=kind)
            axes.bar_label(bars, [f"{size:.0e}" for size in sizes], fontsize=5)
        axes.axhline(1e-6, color="0.5", linestyle=":", label="noise of y")
        axes.set_xticks(np.arange(len(rows)), [load.replace(" ", "\n") for load in rows])
        axes.set(yscale="log", ylabel="late RMS error of y")
        axes.grid(axis="x", visible=False)
        axes.legend(loc="upper center", ncols=4)
        axes.set_ylim(top=0.5)
        figure.savefig(path, dpi=160)


if __name__ == "__main__":
    main()
