"""Public records: model, fit, and what a tuned ADRC would achieve, beside PI and PID.

    python benchmarks/real_data.py [FOLDER] [--only RECORD]

FOLDER has emps.csv and cascaded_tanks.csv (nonlinear benchmarks), buck.csv (sysidentpy) and
robot_arm.csv (DaISy). Each is identified from an order at first (``decided`` then takes fewer
poles, or friction, where the record shows it), and tuned for the model and its deviations under
M_s = M_t = 1.6. A step of the load, of 1 in u, is simulated with the nominal model.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measured import check_present, options_of, parser_of, shared_data, write

import quell as ql
from quell.identification import Identified, Measured, alternatives, decided, read_record
from quell.identification import simulated_plant as plant_of
from quell.tuning.plants import identified_plants

STRUCTURES = ("pi", "pid", "bandwidths", "poles")
# Columns, sample time [s], poles at first, zeros, and longest delay in samples, of each record.
RECORDS: dict[str, tuple[tuple[str, ...], float | None, int, int, int]] = {
    "emps": (("t", "u", "y", "r"), None, 2, 0, 0),
    "cascaded_tanks": (("uEst", "yEst"), 4.0, 2, 0, 3),
    "buck": (("input", "y"), 1e-5, 2, 0, 5),
    "robot_arm": (("u", "y"), 1.0, 4, 4, 0),
}


def identified(record: Measured, order: int, zeros: int, most: int) -> Identified:
    """Return the model that the record supports, and print what it decides."""
    delay = (0.0, most * record.dt) if most else 0.0
    first = ql.identify(record.u, record.y, record.dt, order, zeros, delay=delay)
    for one in alternatives(first):
        fit = one.model.fits.get("held out", one.model.fits["estimation"])
        measure = "likelihood ratio" if one.by_likelihood else "z"
        print(f"  against {one.name}: {one.verdict}, {measure} {one.z:.1f}, fit {fit:.2f} %")
    return decided(first)


def tuned(model: Identified, structures: Sequence[str], **options: Any) -> Any:
    """Return the tuned controllers for a model and its deviations; the last one is the design."""
    plants, delays = identified_plants(model)
    how = {"delay": delays, "objective": "load"} | options
    *others, design = structures
    return ql.tune(plants, model.dt, structure=design, compare=others, **how)


def load_step(model: Identified, controller: Any, duration: float) -> tuple[float, float]:
    """Return the largest |y| and the integral of |y| after a step of the load of 1 in u."""
    scenario = ql.Scenario(duration=duration, disturbances=[ql.signals.Step()])
    run = ql.simulate(model.plant, controller, scenario)
    return float(np.max(np.abs(run["y"]))), float(np.sum(np.abs(run["y"]))) * model.dt


def emps(model: Identified, record: Measured, structures: Sequence[str]) -> dict[str, Any]:
    """Print and return the tracking errors of EMPS: as recorded, and as simulated with friction."""
    assert record.reference is not None
    # Its controller is u = k_v (k_p e − y'): k_v k_p from the record, by least squares.
    slope = np.gradient(record.y, record.dt)
    error = record.reference - record.y
    gains = np.linalg.lstsq(np.column_stack([error, slope]), record.u, rcond=None)[0]
    print(f"  recorded loop: u = {gains[0]:.0f} e {gains[1]:+.0f} y'")
    errors = {"recorded PD": _errors("recorded PD", error)}
    t = np.arange(record.y.size) * record.dt
    scenario = ql.Scenario(
        reference=ql.signals.Samples(t, record.reference), duration=float(t[-1]) - record.dt
    )
    bounds = ql.tuning.Constraints(m_ks=abs(float(gains[0])))
    found = tuned(model, structures, constraints=bounds, u_min=-10.0, u_max=10.0)
    for name in structures:
        controller = found.designs[name].controller
        if controller is None:
            print(f"  {name}: {found.designs[name].reason}")
            continue
        for what, plant in (("with friction", plant_of(model)), ("without", model.plant)):
            run = ql.simulate(plant, controller, scenario)
            label = f"{found.designs[name].name}, {what}"
            errors[label] = _errors(label, run["r"] - run["y"])
    return errors


def _errors(name: str, error: Any) -> dict[str, float]:
    rms, most = 1e3 * float(np.sqrt(np.mean(error**2))), 1e3 * float(np.max(np.abs(error)))
    print(f"  {name}: r − y {rms:.3f} mm RMS, {most:.3f} mm at most")
    return {"rms [mm]": rms, "most [mm]": most}


def main() -> None:
    """Identify and tune all records."""
    parser = parser_of(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=shared_data(""))
    parser.add_argument("--only", choices=RECORDS)
    parser.add_argument("--structures", nargs="+", choices=STRUCTURES, default=STRUCTURES)
    arguments = options_of(parser, only="buck", structures=["pi"])
    figures: dict[str, Any] = {}
    warnings.simplefilter("ignore", UserWarning)
    for name, (columns, dt, order, zeros, most) in RECORDS.items():
        if arguments.only not in (None, name):
            continue
        check_present(arguments, files=[arguments.folder / f"{name}.csv"])
        began = time.process_time()
        record = read_record(arguments.folder / f"{name}.csv", columns, dt)
        print(f"{name}: {record.y.size} samples, dt = {record.dt:g} s")
        # The reference of EMPS is for the comparison of loops, not for instruments.
        model = identified(record._replace(reference=None), order, zeros, most)
        print("  " + "\n  ".join(model.describe().splitlines()), flush=True)
        found_of: dict[str, Any] = {"fits": model.fits, "gain": model.gain, "delay": model.delay}
        found_of["poles"] = [[each.value.real, each.value.imag] for each in model.poles]
        figures[name] = found_of
        if model.num.size == model.den.size:
            print("  y is an acceleration (direct feedthrough): no plant for an observer")
        elif name == "emps":
            found_of |= emps(model, record, arguments.structures)
        else:
            found = tuned(model, arguments.structures)
            duration = 100.0 / found.analysis.margins.phase_omega
            for one in arguments.structures:
                design = found.designs[one]
                if design.controller is None:
                    print(f"  {design.name}: {design.reason}")
                    continue
                peak, area = load_step(model, design.controller, duration)
                measures = f"peak {peak:.4g}, ∫|y| {area:.4g}"
                print(f"  {design.name}: k_i {design.objective:.4g}; load of 1: {measures}")
                found_of[one] = {"k_i": design.objective, "peak": peak, "IAE": area}
            print("  " + "\n  ".join(found.summary().splitlines()[-12:]))
        print(f"  processor time {time.process_time() - began:.1f} s", flush=True)
    write(arguments, figures)


if __name__ == "__main__":
    main()
