"""What learning gives at equal margins: late errors with M_s and M_ks the same for all.

    python benchmarks/equal_margins.py [--plant axis] [--m-ks 100] [--base poles] [--figure FILE]

The plant is an axis with viscous friction, ``y'' = −2 y' + 100 (u + w)``, sampled at 500 Hz, or one
of ``MACHINES``: a hanging mass, ``y'' = −2 y' − 25 y + …``, or an axis behind a drive with a lag of
20 ms. Linear controllers are tuned for the least IAE after a step of the load with M_s ≤ 2 and
M_ks ≤ the argument; one more, with free poles, is tuned for each load (``TunedForLoad``). Learners
stand on an ADRC, of free poles by default, tuned with the M_s that leaves M_s ≤ 2 with the
learner's adaptation (``analyse``), and the same M_ks. The loads are

- a sinusoid of 3 rad/s, and two of 2 and 5.3 rad/s, which no controller knows;
- cogging, ``0.3 sin(20 y)``, and a hardening spring, ``−0.3 y³``, in a slow motion;
- steps at random times, and coloured noise with a correlation time of 0.5 s.

The error is that of y, less what the same loop does in the same motion without the load, in RMS
over the last fifth of 300 s (``--last``); the noise of y is the same.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.optimize import minimize
from scipy.signal import lfilter

import quell as ql
from quell.analysis import analyse
from quell.controllers.linear import LinearController, LinearLaw
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
FOR_LOAD = "free poles, tuned for the load"
# With a learner M_s may exceed the bound by this share.
TOLERANCE = 0.01
LEARNERS: dict[str, Callable[[], Any]] = {
    "Kalman()": Kalman,
    "Kalman, bias of 1 rad/s": lambda: Kalman(bias_bandwidth=1.0),
    "Harmonic(count=2, bias=False)": lambda: Harmonic(
        count=2, bias=False, pair_bandwidth=10.0, limits=(0.5, 15.0)
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

    def __init__(self, name: str, interpret: bool = False) -> None:
        self.interpret = interpret
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
        run = self.simulated(load, controller, scenario)
        if run.diverged:
            return np.inf, run
        y = run["y"].copy()
        if np.any(r):
            alone = self.without_learner(controller)
            y -= self.simulated("steps", alone, scenario)["y"]
        late = y[-t.size // 5 :]
        return float(np.sqrt(np.mean(late**2))), run

    def simulated(self, load: str, controller: Any, scenario: ql.Scenario) -> Any:
        """Return a run of the plant of a load."""
        return ql.simulate(self.plants[load], controller, scenario, interpret=self.interpret)

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


# ---- A linear controller that is tuned for the load ----

# Frequencies [rad/s] that the sinusoids may have: those of both loads are among them.
BAND = (0.5, 5.5)
# Starts of the search for plants of order 2 and 3: (log ω, damping) of pairs, log of single poles,
# of the law and of the observer; the first keeps the bounds of the axis.
STARTS = {
    2: (3.39, 0.3, 2.97, 0.35, 4.28, 0.64, 7.64),
    3: (3.39, 0.3, 4.50, 2.97, 0.35, 4.28, 0.64, 6.00, 1.00),
}


class TunedForLoad:
    """The controller of free poles that leaves the least error under a load.

    A predictor of the plant and of the load w, w' and w'', sampled exactly, with free poles, gives
    ``u = −K x̂ − ŵ`` with a law of free poles. Poles of this kind make PI and lead controllers, and
    such with a broad notch where the load is. All that is known of the load is its spectrum.
    """

    def __init__(self, plant: str, m_s: float, m_ks: float) -> None:
        b, a = MACHINES[plant]
        n = self.order = len(a)
        self.m_s, self.m_ks = m_s, m_ks
        self.starts: tuple[np.ndarray, ...] = (np.array(STARTS[n]),)
        A = np.diag(np.ones(n + 2), 1)
        A[n - 1, :n] = -np.array(a)
        A[n - 1, n] = b
        B = np.zeros((n + 3, 1))
        B[n - 1] = b
        whole = expm(DT * np.block([[A, B], [np.zeros((1, n + 4))]]))
        self.F, self.G = whole[:-1, :-1], whole[:-1, -1]
        self.P, self.g = self.F[:n, :n], self.G[:n]
        self.c = np.eye(n + 3)[0]
        # In units of the sample time nothing is a small difference of large numbers.
        self.unit = DT ** np.arange(n + 3.0)
        self.scaled = self.F * self.unit[:, None] / self.unit
        rows = [self.c @ self.scaled]
        for _ in range(n + 2):
            rows.append(rows[-1] @ (self.scaled - np.eye(n + 3)))
        self.last = np.linalg.solve(np.array(rows), np.eye(n + 3)[-1])
        columns = [np.linalg.matrix_power(self.P, i) @ self.g for i in range(n)]
        self.first = np.linalg.solve(np.array(columns), np.eye(n)[-1])
        self.omega = np.geomspace(5e-3, 0.9999 * np.pi / DT, 500)
        self.of_plant = self.plant_at(self.omega)
        sizes = (n, n + 3)
        kinds = [[1, 2] * (size // 2) + [1] * (size % 2) for size in sizes]
        self.is_damping = np.array(kinds[0] + kinds[1]) == 2

    def plant_at(self, omega: np.ndarray) -> np.ndarray:
        """Return the frequency response of the sampled plant."""
        z = np.exp(1j * omega * DT)[:, None, None]
        given = np.broadcast_to(self.g[:, None], (omega.size, self.order, 1))
        return np.linalg.solve(z * np.eye(self.order) - self.P, given)[:, 0, 0]

    def gains(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return K and L (n + 3,) for the poles of the law and of the observer."""
        at, products = 0, []
        for M in (self.P, self.scaled):
            product = np.eye(len(M), dtype=complex)
            left = len(M)
            while left > 1:
                omega, damping = np.exp(x[at]), x[at + 1]
                for pole in np.roots([1.0, 2.0 * damping * omega, omega**2]):
                    product = product @ (M - np.exp(DT * pole) * np.eye(len(M)))
                at, left = at + 2, left - 2
            if left:
                product = product @ (M - np.exp(-DT * np.exp(x[at])) * np.eye(len(M)))
                at += 1
            products.append(product.real)
        K = np.append(self.first @ products[0], [1.0, 0.0, 0.0])
        return K, products[1] @ self.last / self.unit

    def feedback(self, x: np.ndarray, omega: np.ndarray) -> np.ndarray:
        """Return the frequency response of the controller, from −y to u."""
        K, L = self.gains(x)
        size = K.size
        M = (np.eye(size) - np.outer(L, self.c)) @ (self.F - np.outer(self.G, K))
        z = np.exp(1j * omega * DT)[:, None, None]
        return np.linalg.solve(z * np.eye(size) - M, z * L[:, None])[..., 0] @ K

    def controller(self, x: np.ndarray) -> LinearController:
        """Return the controller of the error r − y."""
        K, L = self.gains(x)
        W = np.eye(K.size) - np.outer(L, self.c)
        law = LinearLaw(
            self.F @ W, -self.F @ L, self.F @ L, self.G, -K @ W, float(K @ L), float(-K @ L)
        )
        return LinearController(law, DT)

    def tuned(
        self, omega: np.ndarray, power: np.ndarray, evaluations: int = 600
    ) -> LinearController:
        """Return the controller that leaves least of a load with ``power`` at ``omega`` [rad/s]."""
        plant = self.plant_at(omega)

        def cost(x: np.ndarray) -> float:
            inside = np.where(self.is_damping, np.clip(x, 0.3, 3.0), np.clip(x, -3.0, 8.5))
            with np.errstate(all="ignore"):
                C = self.feedback(inside, self.omega)
                S = 1.0 / (1.0 + self.of_plant * C)
                left = plant / (1.0 + plant * self.feedback(inside, omega))
                value = 0.5 * np.log(np.sum(power * np.abs(left) ** 2))
            over = max(np.max(np.abs(S)) / self.m_s - 1.0, 0.0)
            over += max(np.max(np.abs(C * S)) / self.m_ks - 1.0, 0.0)
            value += 100.0 * min(over, 10.0) + 10.0 * np.sum(np.abs(x - inside))
            return float(value) if np.isfinite(value) else 1e3

        ends = []
        for x in self.starts:
            for size in (0.2, 0.1, 0.1, 0.05):
                simplex = np.vstack([x, x + size * np.eye(x.size)])
                how = {"initial_simplex": simplex, "maxfev": evaluations, "adaptive": True}
                how |= {"xatol": 1e-4, "fatol": 1e-5}
                end = minimize(cost, x, method="Nelder-Mead", options=how)
                x = end.x
            ends.append(end)
        x = min(ends, key=lambda end: end.fun).x
        self.starts = (self.starts[0], x)  # the next load may be alike
        return self.controller(np.where(self.is_damping, np.clip(x, 0.3, 3.0), x))


def spectrum(load: str, r: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies [rad/s] and the power of a load there, in bands of a hundredth.

    Forces that depend on y are taken along the reference. Of sinusoids the band alone is known.
    """
    if "sinusoid" in load:
        omega = np.linspace(*BAND, 60)
        return omega, np.full(omega.size, 0.5 / omega.size)
    w = {"cogging": 0.3 * np.sin(20.0 * r), "spring": -0.3 * r**3}.get(load, w)
    power = np.abs(np.fft.rfft(w * np.hanning(w.size))) ** 2
    omega = 2.0 * np.pi * np.fft.rfftfreq(w.size, DT)
    kept = (power > 1e-9 * np.max(power)) & (omega > 0.0)
    power, omega = power[kept], omega[kept]
    _, band = np.unique(np.round(100.0 * np.log(omega)), return_inverse=True)
    total = np.bincount(band, power)
    return np.bincount(band, power * omega) / total, total / np.sum(total)


# ---- The comparison ----


def main() -> None:
    """Print a row for each controller, and the ratio of the best learner to the best linear one."""
    # Here, so that the module can be loaded from other folders.
    from measured import options_of, parser_of, write

    parser = parser_of(__doc__)
    parser.add_argument("--plant", choices=MACHINES, default="axis")
    parser.add_argument("--m-ks", type=float, default=100.0)
    parser.add_argument("--base", choices=("poles", "bandwidths", "model-based"), default="poles")
    parser.add_argument("--last", type=float, default=LAST, help="length of the runs [s]")
    parser.add_argument("--figure", type=Path, help="file for a figure of the best of each kind")
    given = options_of(parser, last=0.1, base="bandwidths")
    warnings.simplefilter("ignore")
    t = DT * np.arange(round(given.last / DT) + 1)
    cases, machine = signals(t), Machine(given.plant, interpret=given.quick)
    rows: dict[str, dict[str, Any]] = {}
    for structure in ("pid", "bandwidths") if given.quick else LINEAR:
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
    rows[FOR_LOAD] = {"m_s": 0.0, "m_ks": 0.0}
    search = TunedForLoad(given.plant, M_S, given.m_ks)
    for name, case in cases.items():
        fitted = search.tuned(*spectrum(name, *case), 10 if given.quick else 600)
        rows[FOR_LOAD][name], _ = machine.late_error(name, fitted, t, *case)
        for key, peak in zip(("m_s", "m_ks"), machine.peaks(fitted), strict=True):
            rows[FOR_LOAD][key] = max(rows[FOR_LOAD][key], peak)
    show(FOR_LOAD, rows[FOR_LOAD])
    # The bound of M_ks that is left with the learner is found together with that of M_s.
    bases = {}
    for m in (1.4,) if given.quick else (2.0, 1.9, 1.8, 1.7, 1.6, 1.5, 1.4):
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
    figures: dict[str, Any] = {"best": {}}
    for name in cases:
        best = {}
        for kind, labels in kinds(rows).items():
            errors = {label: rows[label][name] for label in labels}
            found = {label: error for label, error in errors.items() if not np.isnan(error)}
            label = min(found, key=lambda each: found[each], default="none keeps the margins")
            best[kind] = {"controller": label, "error": found.get(label, "there is none")}
        figures["best"][name] = best
        linear, guarded = (each["error"] for each in best.values())
        if isinstance(guarded, str):
            best["ratio"] = guarded
            print(f"{name:14} no learner keeps the margins")
            continue
        best["ratio"] = linear / guarded
        print(
            f"{name:14} {label}: {linear / guarded:.3g} times as good as the best linear controller"
        )
    for label, row in rows.items():
        why = "its motion is another one" if label in LINEAR else "no base keeps the margins"
        figures[label] = {name: why if np.isnan(each) else each for name, each in row.items()}
    write(given, figures)
    if given.figure is not None:
        draw(rows, [*cases], given.figure)


def kinds(rows: dict[str, dict[str, Any]]) -> dict[str, list[str]]:
    """Return the rows of linear controllers and those of guarded learners."""
    return {
        "best linear controller": [each for each in rows if each in (*LINEAR, FOR_LOAD)],
        "best learner, guarded": [each for each in rows if each.endswith(", guarded")],
    }


def draw(rows: dict[str, dict[str, Any]], cases: list[str], path: Path) -> None:
    """Draw the smallest error of linear controllers and of guarded learners for each load."""
    import matplotlib.pyplot as plt

    with plt.rc_context(ql.style(columns=2)):
        figure, axes = plt.subplots(figsize=(7.16, 2.8))
        for i, (label, names) in enumerate(kinds(rows).items()):
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
