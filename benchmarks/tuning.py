"""Integral gains of tuned controllers on the test batch of Astrom and Hagglund.

    python benchmarks/tuning.py                    all plants, M_s = 1.4 and 2: some 12 minutes
    python benchmarks/tuning.py --every 11         each eleventh plant
    python benchmarks/tuning.py --m-s 2            one M_s

The nine families are those of K. J. Astrom and T. Hagglund, "Revisiting the Ziegler-Nichols step
response method for PID control", J. Process Control 14, 2004, and "Advanced PID Control", ISA
2006, section 7.2; the lists printed there have 133 members, although 134 are spoken of. For each
plant and M_s the PI controller with the largest integral gain k_i is the unit, and its M_ks the
limit of all others: PI and PID with filter, ADRC by bandwidths, ADRC with poles of its own. The
excess of M_s and M_ks is that on a grid 100 times as fine as the optimiser's.
"""

from __future__ import annotations

import time
import warnings

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.tuning import Constraints
from quell.tuning.optimiser.requirements import sizes

# Sample time in radians of the plant's phase crossover, and the longest dead time in samples.
STEP, MOST = 0.02, 190
DEAD = (0.01, 0.02, 0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
NAMES = ("pi", "pid", "bandwidths", "poles")


def batch() -> list[tuple[str, list[float], list[float], float]]:
    """Return name, numerator, denominator and dead time [s] of each plant."""
    found = []

    def add(name: str, num: object, factors: list[list[float]], delay: float = 0.0) -> None:
        den = np.array([1.0])
        for factor in factors:
            den = np.polymul(den, factor)
        found.append((name, list(num), den.tolist(), delay))  # type: ignore[call-overload]

    first = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.3, 1.5, 2, 4, 6, 8, 10, 20, 50, 100, 200)
    for T in (*first, 500, 1000):
        add(f"1: e^-s/(1+{T:g}s)", [1.0], [[T, 1]], 1.0)
    for T in (0.01, *first, 500):
        add(f"2: e^-s/(1+{T:g}s)^2", [1.0], [[T, 1], [T, 1]], 1.0)
    for T in (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 2, 5, 10):
        add(f"3: 1/((s+1)(1+{T:g}s)^2)", [1.0], [[1, 1], [T, 1], [T, 1]])
    for n in range(3, 9):
        add(f"4: 1/(s+1)^{n}", [1.0], [[1, 1]] * n)
    for a in np.arange(1, 10) / 10:
        add(f"5: alpha = {a:g}", [1.0], [[a**k, 1] for k in range(4)])
    for L in DEAD:
        add(f"6: L = {L:g}", [1.0], [[1, 0], [1 - L, 1]] if L < 1 else [[1, 0]], L)
    for T in (1, 2, 5, 10):
        for L in DEAD:
            add(f"7: T = {T:g}, L = {L:g}", [T], [[T, 1], [1 - L, 1]] if L < 1 else [[T, 1]], L)
    for a in np.arange(1, 12) / 10:
        add(f"8: (1-{a:g}s)/(s+1)^3", [-a, 1.0], [[1, 1]] * 3)
    for T in np.arange(1, 11) / 10:
        add(f"9: T = {T:g}", [1.0], [[1, 1], [T * T, 1.4 * T, 1]])
    return found


def sample_time(num: list[float], den: list[float], delay: float) -> float:
    """Return a sample time that is short for the plant, and divides its dead time."""
    omega = np.geomspace(1e-4, 1e5, 20000)
    s = 1j * omega
    phase = np.unwrap(np.angle(np.polyval(num, s) / np.polyval(den, s))) - omega * delay
    phase -= 2 * np.pi * round((phase[0] + np.pi / 4) / (2 * np.pi))
    dt = STEP / omega[np.flatnonzero(phase <= -np.pi)[0]]
    return delay / min(max(round(delay / dt), 2), MOST) if delay else dt


def excess(tuned: ql.Tuned, limits: dict[str, float]) -> float:
    """Return the largest share by which a limit is exceeded on a grid 100 times as fine."""
    plants, solution = tuned.plants, tuned.design.solution
    x = np.log(plants.omega)
    share = np.linspace(0.0, 1.0, 100, endpoint=False)
    fine = np.exp((x[:-1, None] + np.diff(x)[:, None] * share).ravel())
    worst = 0.0
    for part in np.array_split(fine, 40):
        C = solution.structure.response(solution.values[None, :], part)[0]
        P = plants.responses(part)
        for kind, limit in limits.items():
            worst = max(worst, float(np.max(sizes(kind, P, C))) / limit - 1.0)
    return worst


def trial(plant: tuple[str, list[float], list[float], float], m_s: float) -> dict[str, object]:
    """Return k_i of all structures over that of the optimal PI controller."""
    name, num, den, delay = plant
    dt = sample_time(num, den, delay)
    began = time.process_time()
    free = Constraints(m_s=m_s, m_t=None, noise_over_pi=None, damping=None)
    how = {"objective": "load", "delay": delay}
    pi = ql.tune((num, den), dt, structure="pi-unfiltered", constraints=free, compare=(), **how)
    m_ks = pi.design.measures["M_ks"]
    bounds = Constraints(m_s=m_s, m_t=None, m_ks=m_ks, damping=None)
    tuned = ql.tune((num, den), dt, structure="poles", constraints=bounds, compare=NAMES, **how)
    row: dict[str, object] = {"plant": name, "m_s": m_s, "m_ks": m_ks, "k_i": pi.design.k_i}
    for key, design in tuned.designs.items():
        row[key] = design.k_i / pi.design.k_i
    row["excess"] = excess(tuned, {"M_s": m_s, "M_ks": m_ks})
    row["form"] = tuned.design.name
    row["stable"] = tuned.analysis.stable
    row["cpu"] = time.process_time() - began
    return row


def main() -> None:
    """Print a row for each plant and the shares that reach the bars."""
    parser = parser_of(__doc__)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--m-s", type=float, nargs="+", default=[1.4, 2.0])
    given = options_of(parser, first=53, every=1000, m_s=[2.0])
    figures: dict[str, object] = {}
    warnings.simplefilter("ignore")
    console, rows, plants = Console(), [], batch()[given.first :: given.every]
    table = Table(title=f"k_i over that of the optimal PI controller; {len(batch())} plants in all")
    for heading in ("plant", "M_s", *NAMES, "poles/pid", "excess", "CPU s"):
        table.add_column(heading)
    for m_s in given.m_s:
        for plant in plants:
            row = trial(plant, m_s)
            rows.append(row)
            numbers = [f"{row[name]:.3f}" for name in NAMES]
            ratio = row["poles"] / row["pid"]  # type: ignore[operator]
            rest = (f"{ratio:.3f}", f"{row['excess']:.1e}", f"{row['cpu']:.1f}")
            table.add_row(str(row["plant"]), f"{m_s:g}", *numbers, *rest)
            print(row["plant"], m_s, *numbers, *rest, row["form"], flush=True)
    console.print(table)
    for m_s in given.m_s:
        part = [row for row in rows if row["m_s"] == m_s]
        poles = np.array([row["poles"] for row in part], dtype=float)
        pid = np.array([row["pid"] for row in part], dtype=float)
        bandwidths = np.array([row["bandwidths"] for row in part], dtype=float)
        console.print(
            f"M_s = {m_s:g}, {len(part)} plants: poles over PI at least {np.min(poles):.3f}, over "
            f"PID at least 0.97 for {100 * np.mean(poles >= 0.97 * pid):.0f} % (least "
            f"{np.min(poles / pid):.3f}, median {np.median(poles / pid):.3f}); bandwidths over PI "
            f"{np.min(bandwidths):.3f} to {np.max(bandwidths):.3f}, median "
            f"{np.median(bandwidths):.3f}; excess at most "
            f"{max(row['excess'] for row in part):.1e}; "
            f"stable: {all(row['stable'] for row in part)}"
        )
        figures[f"M_s = {m_s:g}"] = {
            "plants": len(part),
            "poles over PI, least": np.min(poles),
            "poles over PID at least 0.97 [%]": 100.0 * np.mean(poles >= 0.97 * pid),
            "poles over PID, least": np.min(poles / pid),
            "poles over PID, median": np.median(poles / pid),
            "bandwidths over PI, least": np.min(bandwidths),
            "bandwidths over PI, most": np.max(bandwidths),
            "bandwidths over PI, median": np.median(bandwidths),
            "excess": max(row["excess"] for row in part),
            "stable": sum(bool(row["stable"]) for row in part),
            "cpu of a plant": np.mean([row["cpu"] for row in part]),
        }
    write(given, figures | {"rows": rows})


if __name__ == "__main__":
    main()
