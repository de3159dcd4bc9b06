"""``quell b0``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from quell.cli.options import READ_OPTIONS, Overwrite, ReadOptions, Trust, WholeOrNone
from quell.cli.output import Console, print_line


def b0(
    record: Path,
    *,
    loop: Path | None = None,
    order: WholeOrNone = None,
    dt: float | None = None,
    max_delay: float | None = None,
    phase_margin: float = 60.0,
    ratio: float | None = None,
    read: ReadOptions = READ_OPTIONS,
    json: Path | None = None,
    trust: Trust = False,
    overwrite: Overwrite = False,
) -> None:
    """Find b0, lag and delay in a record of a running loop, and the omega_c for a phase margin.

    Parameters
    ----------
    record
        The record: a recording of `quell run-rig` (.mcap or .csv), a run that was saved (.nc), or a
        table of t,u,y in text, where u is what reached the plant.
    loop
        Setup, in TOML, of the controller that ran: it tells the order, omega_o over omega_c, and
        which b0 it had. Without one the controller may be any.
    order
        Order of the plant for ADRC: u acts on this derivative of y. That of the loop by default.
    dt
        Sample time [s] of a table without times; columns are then u,y by default.
    max_delay
        Longest delay or lag to look for [s]; 20 samples by default.
    phase_margin
        Phase margin that omega_c is to keep [degrees].
    ratio
        omega_o over omega_c; that of the loop by default, or without one the ratio from 3 to 100
        that allows the largest omega_c, nearly.
    json
        Write the results to this file, for programs.
    """
    from quell.commissioning.records import measured
    from quell.files import check_writable, write_json
    from quell.identification import identify_b0

    if json is not None:
        check_writable(json, overwrite)
    samples = measured(record, read.columns, dt, read.time_unit, read.max_size)
    ran = {} if loop is None else _of_loop(loop, samples.dt, trust)
    order = ran.get("order") if order is None else order
    if order is None:
        raise ValueError(
            "order: missing; give --order, or with --loop the setup of an ADRC, which has one"
        )
    ratio = ran.get("ratio") if ratio is None else ratio
    console = Console()
    with console.status("Searching; the first time, code is compiled for some seconds."):
        found = identify_b0(samples.u, samples.y, samples.dt, order, max_delay=max_delay)
    count = f"{samples.y.size} samples, dt = {samples.dt:g} s"
    print_line(console, f"{record.name}: {count}, order {order}")
    print_line(console, found.describe())
    results: dict[str, Any] = found.to_json() | {"phase_margin": phase_margin}
    if "b0" in ran:
        results["b_over_b0"] = found.b0 / ran["b0"]
        factor, spread = found.b0 / ran["b0"], found.b0_std / abs(ran["b0"])
        print_line(
            console, f"the loop ran with b0 = {ran['b0']:.5g}: b/b0 = {factor:.3g} ± {spread:.2g}"
        )
    results |= _print_bandwidth(console, found, phase_margin, ratio)
    if json is not None:
        write_json(json, results, overwrite)
        print_line(console, f"Results: {json}")


def _of_loop(path: Path, dt: float, trust: bool) -> dict[str, Any]:
    """Return order, b0 and omega_o over omega_c of a setup's controller, if it has them."""
    from quell.controllers.adrc.adrc import ADRC
    from quell.controllers.prefilters.prefilter import without_prefilters
    from quell.setup import load

    setup = load(path, trust)
    controller = without_prefilters(setup.controller)
    if abs(controller.dt - dt) > 1e-3 * dt:
        rule = f"must be the sample time of the record, {dt:g} s"
        raise ValueError(f"{setup.file}: dt = {controller.dt:g} s: {rule}")
    if not isinstance(controller, ADRC):
        return {}
    observer = controller.observer
    found: dict[str, Any] = {"order": observer.degree, "b0": float(observer.b0)}
    if observer.omega_o is not None:
        found["ratio"] = float(observer.omega_o) / float(controller.omega_c)
    return found


def _print_bandwidth(
    console: Console, found: Any, phase_margin: float, ratio: float | None
) -> dict[str, Any]:
    """Print and return the omega_c that keeps the phase margin, if b0 is known well enough."""
    from quell.identification.input_gain import MarginError

    nothing = {"omega_c": None, "omega_c_std": None, "ratio": ratio}
    if found.is_poor:
        print_line(console, "omega_c: not computed, as b0 is not known")
        return nothing
    try:
        with console.status("Searching for the omega_c that keeps the phase margin."):
            omega_c, spread, ratio = found.omega_c(phase_margin, ratio)
    except MarginError as error:
        print_line(console, f"NOT: {error}")
        return nothing | {"best_phase_margin": error.phase_margin}
    beyond = ""
    if ratio * omega_c > found.omega_max:
        beyond = (
            f"; omega_o is beyond {found.omega_max:.4g} rad/s, up to where the record shows the "
            "plant: approach it in steps"
        )
    if ratio * omega_c * found.dt > 0.499:
        beyond = f"; omega_o is at 0.5/dt, the most for this sample time{beyond}"
    known = math.isfinite(spread)
    deviation = f" ± {spread:.2g}" if known else " (within the deviations no omega_c may keep it)"
    print_line(
        console,
        f"omega_c = {omega_c:.4g}{deviation} rad/s keeps {phase_margin:g}° of phase margin "
        f"with omega_o = {ratio:.3g} omega_c and this b0{beyond}",
    )
    return {"omega_c": omega_c, "omega_c_std": spread if known else None, "ratio": ratio}
