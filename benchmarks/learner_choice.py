"""Which learner suits which disturbance: the table and the pictures of docs/learners.

    python benchmarks/learner_choice.py [--guard] [--figures FOLDER] [--only TEXT]

The plant is ``y'' = u − y'/2 + f(y, y') + w(t)``; the loop has dt = 5 ms, a model-free ESO of 20
rad/s with b0 = 1, omega_c = 4 rad/s, and noise of 1e-12 held for 10 ms. The reference is the sum of
two sinusoids, whose frequencies have no common period, so position and speed change all the time.
Each run takes 120 s, with ``--quick`` 2 s, as Python. The figures are the RMS of y minus the
response of the ideal loop without disturbance ``omega_c²/(s + omega_c)²``, over the second half,
over that of MF-ESO. Learners have their defaults except for the features named. They get no guard,
unless ``--guard``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table
from scipy import signal

import quell as ql
from quell.features import RBF, Bias, Friction, Periodic, Polynomial, State
from quell.kernels import dispatch
from quell.kernels.user_functions import jit_user_function
from quell.learners import MLP, RLS, GaussianProcess, Harmonic, Kalman
from quell.types import Vector

DT, OMEGA_C, OMEGA_O = 5e-3, 4.0, 20.0
s = ql.signals
REFERENCE = s.Sinusoid(omega=1.0) + 0.5 * s.Sinusoid(omega=2.3)
WAVE = 4.0 * math.tau  # of the force that is periodic in position: 4 waves in a unit of y


def nothing(x: Vector) -> float:
    """Return no force."""
    return 0.0


def spring(x: Vector) -> float:
    """Return the force of a linear spring."""
    return -6.0 * x[0]


def hard_spring(x: Vector) -> float:
    """Return the force of a spring that hardens."""
    return -6.0 * x[0] - 8.0 * x[0] ** 3


def friction(x: Vector) -> float:
    """Return dry friction."""
    return -3.0 * math.tanh(x[1] / 0.05)


def cogging(x: Vector) -> float:
    """Return a force that is periodic in position, of orders 1 and 3."""
    return 4.0 * math.sin(WAVE * x[0]) + 2.0 * math.cos(3.0 * WAVE * x[0])


def square(omega: float) -> ql.signals.Signal:
    """Return a square wave, the sum of its first twenty harmonics."""
    wave = s.Sinusoid(omega=omega)
    for k in range(3, 41, 2):
        wave = wave + (1.0 / k) * s.Sinusoid(omega=k * omega)
    return (4.0 / math.pi) * wave


Force = Callable[[Vector], float]
DISTURBANCES: dict[str, tuple[Force, Any]] = {
    "load: constant, and a step": (nothing, 5.0 + 5.0 * s.Step(at=40.0)),
    "load: sinusoid": (nothing, 3.0 * s.Sinusoid(omega=1.7)),
    "load: two sinusoids": (nothing, 2.0 * s.Sinusoid(omega=1.7) + 2.0 * s.Sinusoid(omega=3.1)),
    "load: square wave": (nothing, 3.0 * square(0.7)),
    "load: noise of 1 s": (nothing, s.BandLimitedNoise(power=4.0, sample_time=1.0)),
    "linear spring": (spring, 0.0),
    "spring that hardens": (hard_spring, 0.0),
    "dry friction": (friction, 0.0),
    "periodic in position": (cogging, 0.0),
}
POLYNOMIAL = State() + Polynomial() + Bias()
RUBS = State() + Friction(speed=0.05) + Bias()
WAVES = State() + Periodic(period=0.25, highest=4) + Bias()
LEARNERS: dict[str, Any] = {
    "none": None,
    "Kalman": Kalman(),
    "Harmonic": Harmonic(),
    "Harmonic(3)": Harmonic(count=3),
    "RLS, Polynomial": RLS(POLYNOMIAL),
    "RLS, Friction": RLS(RUBS),
    "RLS, Periodic": RLS(WAVES),
    "RLS, RBF(40)": RLS(State() + RBF(40) + Bias()),
    "MLP": MLP(),
    "Gaussian process": GaussianProcess(),
}
PICTURES = {
    "load: sinusoid": ("none", "Kalman", "Harmonic"),
    "spring that hardens": ("none", "Kalman", "RLS, Polynomial", "Gaussian process"),
    "dry friction": ("none", "Kalman", "RLS, Friction"),
    "periodic in position": ("none", "Kalman", "Harmonic(3)", "RLS, Periodic"),
}


def plant(force: Force) -> ql.plants.NonlinearPlant:
    """Return the plant with a ``force`` of the state."""
    compiled: Any = jit_user_function(force)
    return ql.plants.NonlinearPlant(
        lambda t, x, u, w: (x[1], u - 0.5 * x[1] + compiled(x) + w[0]), order=2, substeps=4
    )


def error(subject: Any, load: Any, learner: Any, guard: Any, seconds: float) -> Vector:
    """Return y minus the ideal response in each sample; infinite after divergence."""
    controller = ql.ADRC(
        ql.ESO.model_free(order=2, b0=1.0, omega_o=OMEGA_O, dt=DT),
        omega_c=OMEGA_C,
        learner=learner,
        guard=guard,
    )
    noise = s.BandLimitedNoise(1e-12, 0.01)
    run = ql.simulate(subject, controller, ql.Scenario(REFERENCE, seconds, (load,), noise=noise))
    found = np.full(round(seconds / DT) + 1, np.inf)
    ideal = signal.lsim(([OMEGA_C**2], [1.0, 2.0 * OMEGA_C, OMEGA_C**2]), run["r"], run.t)[1]
    found[: run.t.size] = run["y"] - ideal
    return found


def rms(values: Vector) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def draw(errors: dict[tuple[str, str], Vector], path: Path) -> None:
    """Draw the RMS error of the last two seconds over time, a panel for each of PICTURES."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    width = round(2.0 / DT)
    figure, axes = plt.subplots(2, 2, figsize=(9.0, 5.6), sharex=True, layout="constrained")
    for axis, (name, labels) in zip(axes.flat, PICTURES.items(), strict=True):
        for label in labels:
            squares = np.convolve(errors[name, label] ** 2, np.full(width, 1.0 / width), "valid")
            t = DT * (np.arange(squares.size) + width)
            axis.semilogy(t[::20], np.sqrt(squares[::20]), label=label, linewidth=1.2)
        axis.set_title(name)
        low, high = axis.get_ylim()
        axis.set_ylim(low * (low / high) ** 0.35, high)  # room for the legend
        axis.legend(loc="lower left", fontsize="small", ncols=2)
        axis.grid(alpha=0.3)
    figure.supxlabel("t [s]")
    figure.supylabel("RMS error of the last two seconds [units of y]")
    figure.savefig(path, dpi=85)
    plt.close(figure)


def draw_table(shares: dict[tuple[str, str], float], path: Path) -> None:
    """Draw the table as a map of colours."""
    import matplotlib.pyplot as plt
    from matplotlib.colors import LogNorm

    labels = [label for label in LEARNERS if label != "none"]
    values = np.array([[shares[name, label] for label in labels] for name in DISTURBANCES])
    figure, axis = plt.subplots(figsize=(9.0, 4.6), layout="constrained")
    colours = axis.imshow(values, cmap="RdYlGn_r", norm=LogNorm(0.003, 3.0), aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        ink = "white" if not 0.01 < value < 1.0 else "black"
        axis.text(j, i, f"{value:.2g}", ha="center", va="center", fontsize="small", color=ink)
    figure.colorbar(colours, label="RMS error over that without learner")
    axis.set_xticks(range(len(labels)), labels, rotation=30, ha="right")
    axis.set_yticks(range(len(DISTURBANCES)), [*DISTURBANCES])
    figure.savefig(path, dpi=85)
    plt.close(figure)


def main() -> None:
    """Print the table, and draw it."""
    parser = parser_of(__doc__)
    parser.add_argument("--guard", action="store_true", help="with a guard")
    parser.add_argument("--figures", type=Path, help="folder for the pictures; it must exist")
    parser.add_argument("--seconds", type=float, default=120.0, help="duration of a run")
    parser.add_argument("--only", default="", help="disturbances whose name contains this")
    options = options_of(parser, seconds=2.0, only="spring")
    dispatch.interpret_all |= options.quick  # nine plants of a user take longer to compile
    late_half = slice(round(0.5 * options.seconds / DT), None)
    if options.only and options.figures:
        parser.error("the pictures need all disturbances: leave out --only, or --figures")
    guard = ql.Guard() if options.guard else None
    table = Table("disturbance", *LEARNERS, title="RMS error over MF-ESO's; of that, in mm")
    errors: dict[tuple[str, str], Vector] = {}
    shares: dict[tuple[str, str], float] = {}
    figures: dict[str, dict[str, float | str]] = {}
    for name, (force, load) in DISTURBANCES.items():
        if options.only not in name:
            continue
        subject = plant(force)
        for label, learner in LEARNERS.items():
            found = error(
                subject, load, learner, guard if learner is not None else None, options.seconds
            )
            errors[name, label] = found
            late = rms(found[late_half])
            shares[name, label] = late / rms(errors[name, "none"][late_half])
        plain = 1e3 * rms(errors[name, "none"][late_half])
        rest = {label: shares[name, label] for label in LEARNERS if label != "none"}
        figures[name] = {"none [mm]": plain} | {
            label: share if math.isfinite(share) else "diverged" for label, share in rest.items()
        }
        table.add_row(name, f"{plain:.2f}", *(f"{share:.3f}" for share in rest.values()))
    Console(width=170).print(table)
    if options.figures is not None:
        draw(errors, options.figures / "learners_time.png")
        draw_table(shares, options.figures / "learners_table.png")
    write(options, figures)


if __name__ == "__main__":
    main()
