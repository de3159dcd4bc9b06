"""What learning gives at equal margins: late errors with M_s and M_ks the same for all.

    python benchmarks/equal_margins.py [--plant axis] [--m-ks 100] [--base poles] [--json FILE]
        [--figure FILE]

The plant is an axis with viscous friction, ``y'' = −2 y' + 100 (u + w)``, sampled at 500 Hz, or one
of ``MACHINES``: a hanging mass, ``y'' = −2 y' − 25 y + …``, or an axis behind a drive with a lag of
20 ms. Linear controllers are tuned for the least IAE after a step of the load with M_s ≤ 2 and
M_ks ≤ the argument. Learners stand on an ADRC, of free poles by default, tuned with the M_s that
leaves M_s ≤ 2 with the learner's adaptation (``analyse``), and the same M_ks. The loads are

- a sinusoid of 3 rad/s, and two of 2 and 5.3 rad/s, which no controller knows;
- cogging, ``0.3 sin(20 y)``, and a hardening spring, ``−0.3 y³``, in a slow motion;
- steps at random times, and coloured noise with a correlation time of 0.5 s.

The error is that of y, less what the same loop does in the same motion without the load, in RMS
over the last fifth of 300 s; the noise of y is the same.
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

import quell as ql
from quell.analysis import analyse
from quell.features import Bias, Periodic, Polynomial, State
from quell.learners import RLS, Harmonic, Kalman
from quell.tuning import Constraints

DT, LAST, M_S = 2e-3, 300.0, 2.0
# b, and a_0, a_1, … of y^(n) = −a_0 y − a_1 y' − … + b (u + w).
MACHINES = {
    "axis": (100.0, (0.0, 2.0)),
    "hanging": (100.0, (25.0, 2.0)),
    "lagged": (5000.0, (0.0, 100.0, 52.0)),
}
LINEAR = ("pid", "lqg", "model-based", "bandwidths", "bandwidths-2", "bandwidths-3", "poles")
LINEAR += ("poles-2",)
# With a learner M_s may exceed the bound by this share.
TOLERANCE = 0.01
LEARNERS: dict[str, Callable[[], Any]] = {
    "Kalman()": Kalman,
    "Kalman, bias of 1 rad/s": lambda: Kalman(bias_bandwidth=1.0),
    "Harmonic(count=2, bias=False)": lambda: Harmonic(
        count=2, bias=False, bias_bandwidth=10.0, pair_bandwidth=10.0, limits=(0.5, 15.0)
    ),
    "RLS(Periodic)": lambda: RLS(
        Periodic(period=0.1 * np.pi, orders=(1,)) + Bias(), bias_bandwidth=0.0
    ),
    "RLS(Polynomial)": lambda: RLS(State() + Polynomial(3, states=(1,)), bias_bandwidth=0.0),
}


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


class Machine:
    """A plant, and what is made for it."""

    def __init__(self, name: str) -> None:
        b, a = MACHINES[name]
        self.linear = ql.plants.LinearPlant.of(([b], [1.0, *a[::-1]]))
        self.order = len(a)
        self.feedforward = ql.Feedforward.of(self.linear)
        linear = self.linear
        loaded = ql.plants.LinearPlant(linear.A, linear.B, linear.C, linear.B)
        # The plant of each load, with an input w beside u.
        self.plants: dict[str, Any] = dict.fromkeys(
            ("sinusoid", "two sinusoids", "steps", "noise"), loaded
        )
        for load, shape in (("cogging", (0.3, 0.0)), ("spring", (0.0, 0.3))):
            law = rate(name, *shape)
            self.plants[load] = ql.plants.NonlinearPlant(law, order=self.order, disturbances=1)

    def late_error(self, load: str, controller: Any, t: Any, r: Any, w: Any) -> tuple[float, Any]:
        """Return the RMS error over the last fifth, and the run."""
        scenario = ql.Scenario(
            reference=ql.signals.Samples(t, r, hold="spline"),
            disturbances=(ql.signals.Samples(t, w),),
            noise=ql.signals.BandLimitedNoise(power=1e-12 * DT, sample_time=DT),
            duration=float(t[-1]),
        )
        run = ql.simulate(self.plants[load], controller, scenario)
        if run.diverged:
            return np.inf, run
        y = run["y"].copy()
        if np.any(r):
            alone = self.without_learner(controller)
            y -= ql.simulate(self.plants["steps"], alone, scenario)["y"]
        late = y[-t.size // 5 :]
        return float(np.sqrt(np.mean(late**2))), run

    def without_learner(self, controller: Any) -> Any:
        """Return the controller with what is linear of it."""
        if not isinstance(controller, ql.ADRC):
            return controller
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

    def tuned(self, structure: str, m_s: float, m_ks: float) -> Any:
        """Return the controller of a structure with the least IAE within the bounds."""
        bounds = Constraints(m_s=m_s, m_t=None, m_ks=m_ks, damping=0.3)
        order = {"order": self.order} if structure.startswith(("bandwidths", "poles")) else {}
        return ql.tune(
            self.linear, DT, structure=structure, compare=(), constraints=bounds, **order
        ).controller

    def peaks(self, controller: Any, run: Any = None) -> tuple[float, float]:
        """Return M_s and M_ks of a loop; infinite for an unstable one."""
        loop = analyse(self.linear, controller, at=run)
        if not loop.stable:
            return np.inf, np.inf
        return 1.0 / loop.margins.modulus, loop.noise_to_control_peak


def signals(t: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the reference and the load of each case."""
    rng, none = np.random.default_rng(5), np.zeros(t.size)
    steps, at, value = none.copy(), 0, 1.0
    while at < t.size:
        length = int(rng.uniform(1.0, 5.0) / DT)
        steps[at : at + length] = value
        at, value = at + length, -value
    pole = np.exp(-DT / 0.5)
    noise = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], rng.normal(size=t.size))
    motion = np.sin(0.5 * t) + 0.3 * np.sin(0.23 * t)
    return {
        "sinusoid": (none, np.sin(3.0 * t)),
        "two sinusoids": (none, np.sin(2.0 * t) + 0.7 * np.sin(5.3 * t)),
        "cogging": (motion, none),
        "spring": (motion, none),
        "steps": (none, steps),
        "noise": (none, noise),
    }


def main() -> None:
    """Print a row for each controller, and the ratio of the best learner to the best linear one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plant", choices=MACHINES, default="axis")
    parser.add_argument("--m-ks", type=float, default=100.0)
    parser.add_argument("--base", choices=("poles", "bandwidths", "model-based"), default="poles")
    parser.add_argument("--json", type=Path, help="file for the rows")
    parser.add_argument("--figure", type=Path, help="file for a figure of the best of each kind")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    t = DT * np.arange(round(LAST / DT) + 1)
    cases, machine = signals(t), Machine(given.plant)
    rows: dict[str, dict[str, Any]] = {}
    for structure in LINEAR:
        try:
            controller = machine.tuned(structure, M_S, given.m_ks)
        except ValueError as error:
            print(f"{structure}: {error}")
            continue
        m_s, m_ks = machine.peaks(controller)
        controller = machine.without_learner(controller)
        errors = {
            name: machine.late_error(name, controller, t, *case)[0] for name, case in cases.items()
        }
        if not isinstance(controller, ql.ADRC):  # without feedforward its motion is another one
            errors |= {"cogging": np.nan, "spring": np.nan}
        rows[structure] = {"m_s": m_s, "m_ks": m_ks, **errors}
        show(structure, rows[structure])
    # The bound of M_ks that is left with the learner is found together with that of M_s.
    bases = {}
    for m in (2.0, 1.9, 1.8, 1.7, 1.6, 1.5, 1.4):
        try:
            bases[m] = machine.tuned(given.base, m, 0.97 * given.m_ks)
        except ValueError as error:
            print(f"{given.base}, M_s {m}: {error}")
    for label, make in LEARNERS.items():
        row: dict[str, Any] = {"m_s": 0.0, "m_ks": 0.0}
        guarded = dict(row)
        for name, case in cases.items():
            row[name] = guarded[name] = np.nan
            for base in bases.values():
                controller = machine.with_learner(base, make)
                error, run = machine.late_error(name, controller, t, *case)
                m_s, m_ks = machine.peaks(machine.with_learner(base, make), run)
                if m_s <= M_S * (1.0 + TOLERANCE) and m_ks <= given.m_ks * (1.0 + TOLERANCE):
                    row[name] = error
                    row["m_s"], row["m_ks"] = max(row["m_s"], m_s), max(row["m_ks"], m_ks)
                    safe = machine.with_learner(base, make, ql.Guard())
                    guarded[name], _ = machine.late_error(name, safe, t, *case)
                    break
        rows[label], rows[f"{label}, guarded"] = (
            row,
            guarded
            | {
                "m_s": row["m_s"],
                "m_ks": row["m_ks"],
            },
        )
        show(label, row)
        show("  guarded", rows[f"{label}, guarded"])
    for name in cases:
        linear = np.nanmin([rows[structure][name] for structure in LINEAR if structure in rows])
        learned = {label: linear / row[name] for label, row in rows.items() if label not in LINEAR}
        best = max(learned, key=lambda label: np.nan_to_num(learned[label]))
        print(f"{name:14} {best}: {learned[best]:.3g} times as good as the best linear controller")
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    if given.figure is not None:
        draw(rows, [*cases], given.figure)


def draw(rows: dict[str, dict[str, Any]], cases: list[str], path: Path) -> None:
    """Draw the smallest error of linear controllers and of guarded learners for each load."""
    import matplotlib.pyplot as plt

    kinds = {
        "best linear controller": [each for each in rows if each in LINEAR],
        "best learner, guarded": [each for each in rows if each.endswith(", guarded")],
    }
    with plt.rc_context(ql.style(columns=2)):
        figure, axes = plt.subplots(figsize=(7.16, 2.8))
        for i, (label, names) in enumerate(kinds.items()):
            sizes = [np.nanmin([rows[name][case] for name in names]) for case in cases]
            at = np.arange(len(cases)) + 0.38 * i - 0.19
            bars = axes.bar(at, sizes, 0.36, label=label)
            axes.bar_label(bars, [f"{size:.1e}" for size in sizes], fontsize=6)
        axes.axhline(1e-6, color="0.5", linestyle=":", label="noise of y")
        axes.set_xticks(np.arange(len(cases)), cases)
        axes.set(yscale="log", ylabel="late RMS error of y")
        axes.grid(axis="x", visible=False)
        axes.legend(loc="upper center", ncols=3)
        axes.set_ylim(top=0.3)
        figure.savefig(path, dpi=160)


def show(label: str, row: dict[str, Any]) -> None:
    """Print a row."""
    cells = "  ".join(f"{name} {row[name]:.1e}" for name in row if not name.startswith("m_"))
    print(f"{label:30} M_s {row['m_s']:.2f} M_ks {row['m_ks']:5.1f}  {cells}", flush=True)


if __name__ == "__main__":
    main()
