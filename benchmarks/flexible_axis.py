"""Flexible axes: what each structure reaches, and what the resonance does to an ADRC of order 2.

Chains of two and three inertias with damped couplings, encoder at the motor or at the load, ratios
J_load/J_motor of 0.3 to 10 (the axis: J_motor = 3.2e-4 kg m², k = 180 N m/rad, c = 0.02 N m s/rad,
4 kHz, torque a sample late; the third inertia, 0.3 J_motor, sits between on 300 N m/rad). For each
axis the tuned cascade of servo drives (p-pi-notch, M_s and M_t at most 1.6) is the reference; the
others are tuned with the same bounds and with the M_ks that the cascade has, so that noise costs
the same. The figure is the integral gain over that of the cascade, k_i being that of a loop that is
checked to be stable with the whole plant. With --free M_ks has no bound for any of them, with
--ringing the damping of poles has none.

The first two tables are M_s of an ADRC of order 2 with omega_o = 4 omega_c, the encoder at the
motor: b0 = 1/(J_m + J_l), and then 1/J_m.

Usage: python benchmarks/flexible_axis.py [--free] [--ringing]
"""

from __future__ import annotations

import statistics
import time
import warnings
from typing import Any, NamedTuple

from measured import options_of, parser_of, write

import quell as ql
from quell.tuning import Constraints

DT = LATE = 2.5e-4  # s
MOTOR, STIFFNESS = 3.2e-4, 180.0  # kg m², N m/rad
BOUND = 1.6  # M_s and M_t
REFERENCE = "p-pi-notch"
OTHERS = ("bandwidths", "poles", "model-based", "model-based-poles")
RATIOS = (0.3, 1.0, 3.0, 10.0)
BANDWIDTHS = (20.0, 40.0, 80.0, 160.0)  # rad/s


class Axis(NamedTuple):
    """A case of the trial."""

    inertias: int
    sensor: str
    ratio: float
    damping: float

    def plant(self) -> Any:
        """Return the chain of inertias."""
        J, k, c = [MOTOR, self.ratio * MOTOR], [STIFFNESS], self.damping
        if self.inertias == 3:
            J, k = [MOTOR, 0.3 * MOTOR, self.ratio * MOTOR], [300.0, STIFFNESS]
        at = 1 if self.sensor == "motor" else len(J)
        return ql.plants.n_mass(J, k, [c] * len(k), sensor=at)


def axes(quick: bool) -> list[Axis]:
    """Return the cases: sensor, number of inertias and ratio; more damping at the load."""
    if quick:
        return [Axis(2, "motor", 1.0, 0.02)]
    ratios = RATIOS
    found = [Axis(n, s, r, 0.02) for n in (2, 3) for s in ("motor", "load") for r in ratios]
    return found + [Axis(2, "load", ratio, 0.1) for ratio in ratios]


def tuned(
    axis: Axis, free: bool, others: tuple[str, ...] = OTHERS, damping: float | None = 0.4
) -> dict[str, Any]:
    """Return k_i, M_s and M_ks of each structure, or why there is none."""
    plant, how = axis.plant(), {"dt": DT, "delay": LATE}
    given = {"m_s": BOUND, "m_t": BOUND, "damping": damping}
    bounds = Constraints(**given, noise_over_pi=None)
    first = ql.tune(plant, structure=REFERENCE, compare=(), constraints=bounds, **how)
    if not free:
        m_ks = 1.001 * first.design.measures["M_ks"]
        bounds = Constraints(**given, m_ks=m_ks)
    found = {REFERENCE: _row(plant, first.design, 0.0)}
    for name in others:
        begun = time.perf_counter()
        try:
            design = ql.tune(plant, structure=name, compare=(), constraints=bounds, **how).design
        except ValueError as error:
            found[name] = {"reason": str(error)}
            continue
        found[name] = _row(plant, design, time.perf_counter() - begun)
    return found


def _row(plant: Any, design: Any, seconds: float) -> dict[str, Any]:
    loop = ql.analysis.analyse(plant, design.controller, delay=LATE)
    measures = {"m_s": 1.0 / loop.margins.modulus if loop.stable else None, "k_i": design.k_i}
    rest = {key: design.measures[key] for key in ("M_ks", "iae")}
    return {"name": design.name, "seconds": seconds} | measures | rest


def summary(results: list[tuple[Axis, dict[str, Any]]]) -> dict[str, Any]:
    """Return the ratios of the best structure of each axis, and of each structure."""
    best, each = [], {name: [] for name in OTHERS}
    for _, found in results:
        reference = found[REFERENCE]["k_i"]
        ratios = {
            name: row["k_i"] / reference
            for name, row in found.items()
            if name != REFERENCE and row.get("m_s") is not None and row["m_s"] <= 1.002 * BOUND
        }
        for name, ratio in ratios.items():
            each[name].append(ratio)
        best.append(max(ratios.values(), default=0.0))
    return {
        "axes": len(results),
        "none": sum(ratio == 0.0 for ratio in best),
        "least": min(best),
        "median": statistics.median(best),
        "each": {
            name: (len(values), min(values, default=0.0), statistics.median(values or [0.0]))
            for name, values in each.items()
        },
    }


def model_free(ratio: float, omega_c: float, inertia: float) -> float | None:
    """Return M_s of an ADRC of order 2 at the motor, b0 = 1/inertia; None if it is not stable."""
    plant = Axis(2, "motor", ratio, 0.02).plant()
    b0 = 1.0 / inertia
    observer = ql.ESO.model_free(2, b0, 4.0 * omega_c, DT)
    loop = ql.analysis.analyse(plant, ql.ADRC(observer, omega_c), delay=LATE)
    return 1.0 / loop.margins.modulus if loop.stable else None


def main() -> None:
    """Run the trial and print its tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--free", action="store_true", help="no bound of M_ks")
    parser.add_argument("--ringing", action="store_true", help="no bound of damping")
    options = options_of(parser)
    at_motor: dict[str, Any] = {}
    warnings.simplefilter("ignore")
    for of in ("both inertias", "the motor alone"):
        print(f"ADRC of order 2 at the motor, omega_o = 4 omega_c, b0 of {of}: M_s")
        print("J_l/J_m  " + "".join(f"omega_c = {w:<6g}" for w in BANDWIDTHS))
        for ratio in RATIOS:
            inertia = MOTOR * (1.0 + ratio) if of == "both inertias" else MOTOR
            cells = [model_free(ratio, w, inertia) for w in BANDWIDTHS]
            at_motor[f"b0 of {of}, J_l/J_m {ratio:g}"] = {
                f"omega_c = {w:g}": "unstable" if m_s is None else m_s
                for w, m_s in zip(BANDWIDTHS, cells, strict=True)
            }
            text = "".join(f"{'unstable' if m is None else f'{m:.2f}':16s}" for m in cells)
            print(f"{ratio:<9g}{text}")
    results = []
    print(f"\nk_i over that of the tuned {REFERENCE}, M_s and M_t <= {BOUND:g}", end="")
    print(", no bound of M_ks" if options.free else ", its M_ks")
    for axis in axes(options.quick):
        found = tuned(
            axis,
            options.free,
            others=("bandwidths",) if options.quick else OTHERS,
            damping=None if options.ringing else 0.4,
        )
        results.append((axis, found))
        reference = found[REFERENCE]
        cells = [
            f"{name} " + (f"{row['k_i'] / reference['k_i']:.2f}" if "k_i" in row else "none")
            for name, row in found.items()
            if name != REFERENCE
        ]
        at = f"{axis.inertias} inertias, {axis.sensor}, ratio {axis.ratio:g}, c {axis.damping:g}"
        print(f"{at}: k_i {reference['k_i']:.0f}; " + ", ".join(cells), flush=True)
    figures = summary(results)
    print(f"best of all: least {figures['least']:.2f}, median {figures['median']:.2f}", end="")
    print(f" of {figures['axes']} axes, none found for {figures['none']}")
    for name, (count, least, median) in figures["each"].items():
        print(f"  {name}: found for {count}, least {least:.2f}, median {median:.2f}")
    rows = [{**axis._asdict(), "found": found} for axis, found in results]
    write(options, {"M_s at the motor": at_motor, "axes": rows, "summary": figures})


if __name__ == "__main__":
    main()
