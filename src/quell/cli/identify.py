"""``quell identify``, ``quell b0`` and ``quell excite``: models and experiments."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quell.cli.exit_codes import ExitCode
from quell.cli.options import (
    MODEL_OPTIONS,
    OUTPUTS,
    READ_OPTIONS,
    RESULT_OUTPUTS,
    ModelOptions,
    Outputs,
    Overwrite,
    ReadOptions,
    ResultOutputs,
    Switch,
    Trust,
    Whole,
    WholeOrNone,
    options_of,
    refuse,
)
from quell.cli.output import Console, check_outputs, print_line, table, write_results

if TYPE_CHECKING:
    from quell.identification import Alternative, FrequencyTable, Identified, InputGain, Measured

# ---- quell identify ----

# Fits below which u and y may be swapped, and above which they are [%]: chosen by hand.
_COLLAPSED, _GOOD = 20.0, 60.0
_OF_FREQUENCY = ("f\n[Hz]", "|G|", "|G|\n[dB]", "phase\n[°]", "coherence", "±\n[%]")
# Largest order with a PI or PID controller beside its ADRC.
_SIMPLE = 2
_HEADINGS = ("real\n[rad/s]", "imag\n[rad/s]", "± real", "± imag", "size\n[rad/s]", "damping")


def identify(
    *data: Path,
    order: WholeOrNone = None,
    delay: float | None = None,
    dt: float | None = None,
    horizon: Whole = 10,
    validate: Path | None = None,
    alternatives: bool = True,
    frequencies: Switch = False,
    read: ReadOptions = READ_OPTIONS,
    of_model: ModelOptions = MODEL_OPTIONS,
    outputs: Outputs = OUTPUTS,
) -> None:
    """Fit a continuous transfer function to recorded input and output.

    Of a record in which u rests and y rings the modes are found: their frequency and damping; of
    one in which y decays, as of a heat-up or coast-down, time constant and end. A
    table of frequencies (f, magnitude and phase, or real and imaginary part) is fitted in the same
    way, and the modes of a power spectrum are found.

    Parameters
    ----------
    data
        Records: tables t,u,y in text, recordings of quell run-rig, saved runs (.nc). Several have
        one model, each its own initial state and constant force. A further column of --columns is
        the external input of a closed loop. Two files of times and one channel each, as an
        oscilloscope writes them, are u and y.
    order
        Number of poles, 4 by default; of a table of frequencies the simplest that holds.
    delay
        Delay of u [s]; with --max-delay the shortest one. By default it is searched if needed.
    dt
        Sample time [s] of a record without times; columns are then u,y by default. Of a table of
        frequencies the time for which u was held while it was measured.
    horizon
        Number of samples of the prediction ahead.
    validate
        Another record, with the same columns, on which the model is judged, too.
    alternatives
        Fit other orders, with and without friction, and say what the record decides.
    frequencies
        Fit no model: print the frequency response with its coherence and deviation.
    """
    from quell.commissioning import measured_records
    from quell.identification import alternatives as other_structures
    from quell.identification import identify
    from quell.identification.result import NOTHING_HELD_OUT

    how = read.columns, dt, read.time_unit, read.max_size
    if len(data) == 1 and (table := frequencies_in(data[0], read)) is not None:
        of_time: dict[str, tuple[Any, Any]] = {"horizon": (horizon, 10)}
        of_time |= {"no-alternatives": (alternatives, True), "validate": (validate, None)}
        of_time |= {"frequencies": (frequencies, False)} | only_in_time(read, of_model)
        refuse(of_time, "is for a record in time; this is a table of frequencies")
        structure = order, of_model.zeros, of_model.integrators
        _of_table(table, data[0].name, *structure, delay, dt, outputs)
        return
    records = measured_records(data, *how)
    record, several = records[0], len(records) > 1
    if len(records) < len(data) and validate is not None:
        raise ValueError("--validate: goes with files of u and y, not with one for each channel")
    unused = options_of(of_model, MODEL_OPTIONS)
    unused |= {"order": (order, None), "delay": (delay, None), "validate": (validate, None)}
    unused |= {"horizon": (horizon, 10), "no-alternatives": (alternatives, True)}
    if frequencies:
        refuse(unused, "is for a model; with --frequencies none is fitted")
        if several:
            raise ValueError(f"data: --frequencies goes with one record, not with {len(records)}")
        _frequencies(record, data[0].name, bool(read.columns), outputs)
        return
    if not several and record.u.min() == record.u.max():
        refuse(unused, "is for a u that moves; here it rests, and the free motion of y is found")
        _modes(record, data[0].name, outputs)
        return
    most = of_model.max_delay
    delays: Any = "if needed" if delay is None else delay
    order = 4 if order is None else order
    if most is not None:
        delays = (delay or 0.0, most)
    options: dict[str, Any] = {
        "friction": bool(of_model.friction),
        "held_out": of_model.held_out,
        "horizon": horizon,
        "delay": delays,
        "integrators": of_model.integrators,
        "rest": of_model.rest,
        "signals": record.signals,
    }
    if read.columns:  # a recording of a loop has a reference, which need not be used
        options["reference"] = record.reference
    if validate is not None:
        _, other = measured_records([data[0], validate], *how)
        options["validation"] = other.u, other.y
    outputs = check_outputs(outputs, ["identified"])
    console = Console()
    u, y = [one.u for one in records], [one.y for one in records]
    with console.status("Searching; the first time, code is compiled for some seconds."):
        model = identify(
            u if several else u[0],
            y if several else y[0],
            record.dt,
            order,
            of_model.zeros,
            **options,
        )
    _print(console, model, ", ".join(path.name for path in data))
    if model.held_from == model.y.size and of_model.held_out is None and not several:
        print_line(console, NOTHING_HELD_OUT)
    if not several and _look_swapped(model, order, delays):
        print_line(console, "NOT: u and y look swapped: the reverse fits well; see --columns")
    others: tuple[Alternative, ...] = ()
    if alternatives:
        given: dict[str, Any] = {"integrators": of_model.integrators, "friction": of_model.friction}
        if most is not None:
            given["delay"] = delays
        with console.status("Fitting other structures."):
            others = other_structures(model, **given)
    for line in filter(None, (one.describe(model) for one in others)):
        print_line(console, line)
    paths: list[Path] = []
    if outputs.figures:
        from quell.experiments.common import save_figure

        figure = model.plot()[0].figure
        paths = save_figure(figure, outputs.figures, "identified", outputs.overwrite)
    results = model.to_json() | {"alternatives": [one.to_json() for one in others]}
    write_results(console, results, outputs, paths)
    if model.fails:
        sys.exit(ExitCode.NOT_VALID)


def frequencies_in(path: Path, read: ReadOptions) -> FrequencyTable | None:
    """Return the table of frequencies that a file is; None of another file."""
    from quell.identification import frequency_table

    columns = [name.strip() for name in read.columns.split(",")] if read.columns else []
    return frequency_table(path, columns, max_size=read.max_size)


def only_in_time(read: ReadOptions, of_model: ModelOptions) -> dict[str, tuple[Any, Any]]:
    """Return the options that a table of frequencies does not have, for ``refuse``."""
    of_all = options_of(of_model, MODEL_OPTIONS) | {"time-unit": (read.time_unit, None)}
    return {name: pair for name, pair in of_all.items() if name not in ("zeros", "integrators")}


def _of_table(
    table: FrequencyTable,
    name: str,
    order: int | None,
    zeros: int | None,
    integrators: int | None,
    delay: float | None,
    dt: float | None,
    outputs: Outputs,
) -> None:
    """Print, draw and write the model of a table of frequencies, or the modes of a spectrum."""
    from quell.experiments.common import save_figure
    from quell.identification import identify_frequencies, modes_of_spectrum

    outputs = check_outputs(outputs, ["identified"])
    console = Console()
    found: Any
    if table.response is None:
        assert table.power is not None
        unused: dict[str, tuple[Any, Any]] = {"order": (order, None), "zeros": (zeros, None)}
        unused |= {"integrators": (integrators, None), "delay": (delay, None), "dt": (dt, None)}
        refuse(unused, "is for a table with phase; of this one the modes are found")
        found = modes_of_spectrum(table.omega, table.power)
    else:
        found = identify_frequencies(
            table.omega,
            table.response,
            order,
            zeros,
            integrators=integrators,
            delay=delay,
            deviation=table.deviation,
            dt=dt,
        )
    print_line(console, describe_table(table, name))
    for line in str(found).splitlines():
        print_line(console, line)
    paths: list[Path] = []
    if outputs.figures:
        figure = found.plot()[0].figure
        paths = save_figure(figure, outputs.figures, "identified", outputs.overwrite)
    results = found.to_json() | {"columns": table.columns, "notes": table.notes}
    write_results(console, results, outputs, paths)


def describe_table(table: FrequencyTable, name: str) -> str:
    """Return what a table of frequencies is and what was assumed, as text."""
    low, high = (table.omega[i] / (2.0 * math.pi) for i in (0, -1))
    count = f"{table.omega.size} frequencies, {low:.4g} to {high:.4g} Hz"
    return "\n".join([f"{name}: {count}, of {', '.join(table.columns)}", *table.notes])


def _frequencies(record: Measured, name: str, with_reference: bool, outputs: Outputs) -> None:
    """Print, draw and write the frequency response of a record."""
    import numpy as np

    from quell.experiments.common import save_figure
    from quell.identification import frequency_response

    outputs = check_outputs(outputs, ["identified"])
    console = Console()
    # A recording of a loop has a reference, which need not be used.
    r = record.reference if with_reference else None
    found = frequency_response(record.u, record.y, record.dt, reference=r, method="auto")
    print_line(console, f"{name}: {record.y.size} samples, dt = {record.dt:g} s")
    rows = table("Frequency response", *_OF_FREQUENCY)
    for i in found.rows():
        G = complex(found.response[i])
        size = abs(G)
        numbers = found.frequency[i], size, 20.0 * math.log10(size), np.degrees(np.angle(G))
        cells = (f"{value:.4g}" for value in (*numbers, found.coherence[i]))
        rows.add_row(*cells, f"{100.0 * found.deviation[i]:.2g}")
    console.print(rows)
    print_line(console, found.describe())
    paths: list[Path] = []
    if outputs.figures:
        figure = found.plot()[0].figure
        paths = save_figure(figure, outputs.figures, "identified", outputs.overwrite)
    write_results(console, found.to_json(), outputs, paths)


def _modes(record: Measured, name: str, outputs: Outputs) -> None:
    """Print, draw and write the modes of a free swing, or the time constant of a decay."""
    from quell.experiments.common import save_figure
    from quell.identification import free_swing

    outputs = check_outputs(outputs, ["identified"])
    console = Console()
    u, found = float(record.u[0]), free_swing(record.y, record.dt)
    kind = f"a decay, as u is {u:g} all through" if found.decay else "a free swing, as u rests"
    print_line(console, f"{name}: {kind}: {record.y.size} samples")
    for line in str(found).splitlines():
        print_line(console, line)
    results = found.to_json()
    if found.decay and u != 0.0:
        results["gain_from_rest"] = (found.at_rest - found.begin) / u
        print_line(
            console, f"if u was 0 and y at rest before, the gain is {results['gain_from_rest']:.5g}"
        )
    paths: list[Path] = []
    if outputs.figures:
        figure = found.plot()[0].figure
        paths = save_figure(figure, outputs.figures, "identified", outputs.overwrite)
    write_results(console, results, outputs, paths)


def _look_swapped(model: Identified, order: int, delays: Any) -> bool:
    """Return whether y explains u where u explains nothing of y."""
    from quell.identification import identify

    if model.fits["estimation"] > _COLLAPSED:
        return False
    try:
        other = identify(model.y, model.u, model.dt, order, delay=delays, rest=False, held_out=0.0)
    except ValueError:
        return False
    return other.fits["estimation"] > _GOOD


def _print(console: Console, model: Identified, source: str) -> None:
    from quell.identification.result import percent

    lines = model.describe().splitlines()
    print_line(console, f"{source}: {model.y.size} samples, dt = {model.dt:g} s")
    print_line(console, "\n".join(lines[:2]))
    roots = table("Poles and zeros", "", *_HEADINGS)
    for name, group in (("pole", model.poles), ("zero", model.zeros)):
        for root in group:
            place = (f"{part:.6g}" for part in (root.value.real, root.value.imag))
            spread = (f"{part:.2g}" for part in (root.real_std, root.imag_std))
            damping = "–" if root.value == 0.0 else f"{root.damping:.4f}"
            roots.add_row(name, *place, *spread, f"{root.omega:.6g}", damping)
    console.print(roots)
    fits = table("Fit (NRMSE)", "on", "%")
    for name, value in model.fits.items():
        ahead = f" {model.horizon} samples ahead" if name.endswith("predicted") else ""
        fits.add_row(name + ahead, percent(value))
    console.print(fits)
    rest = lines[next(i for i, line in enumerate(lines) if line.startswith("gain ")) :]
    print_line(console, "\n".join(line for line in rest if not line.startswith("fit, ")))


# ---- quell b0 ----


def b0(
    record: Path,
    *,
    loop: Path | None = None,
    order: WholeOrNone = None,
    dt: float | None = None,
    max_delay: float | None = None,
    phase_margin: float = 60.0,
    ratio: float | None = None,
    by: str | None = None,
    bins: int | None = None,
    axes: str | None = None,
    actuators: str | None = None,
    read: ReadOptions = READ_OPTIONS,
    trust: Trust = False,
    outputs: ResultOutputs = RESULT_OUTPUTS,
) -> None:
    """Find b0, lag and delay in a record of a running loop, and the omega_c for a phase margin.

    With --axes and --actuators it finds the matrix B0 of coupled axes, and no omega_c.

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
    by
        Column of a signal by which b0 changes, such as speed or extension: name or number in a
        table in text. b0 is then found in each bin of it, and no omega_c.
    bins
        Number of bins between the least and the largest value of `--by`; 5 by default.
    axes
        Columns of the y of coupled axes in a table in text, as q1,q2; --columns then names only the
        column of times, t by default. Of a saved run (.nc) the names of its axes.
    actuators
        Columns of their u in a table, as tau1,tau2; a saved run has all u.
    """
    from quell.commissioning import measured
    from quell.identification import identify_b0
    from quell.identification.input_gain import asked_margin

    outputs = check_outputs(outputs)
    asked_margin(phase_margin, ratio)
    if axes is not None or actuators is not None:
        single = {
            "loop": (loop, None),
            "phase_margin": (phase_margin, 60.0),
            "ratio": (ratio, None),
        }
        refuse(
            single | {"by": (by, None), "bins": (bins, None)}, "is for one axis, not for several"
        )
        _print_matrix(record, axes, actuators, order, dt, max_delay, read, outputs)
        return
    samples = measured(record, read.columns, dt, read.time_unit, read.max_size)
    ran = {} if loop is None else _of_loop(loop, samples.dt, trust)
    order = ran.get("order") if order is None else order
    if order is None:
        raise ValueError(
            "order: missing; give --order, or with --loop the setup of an ADRC, which has one"
        )
    console = Console()
    if by is not None:
        if ratio is not None or phase_margin != 60.0:
            raise ValueError("ratio, phase_margin: have no effect with --by; leave them out")
        signal = _column(record, by, read, dt, samples.y.size)
        rows = _print_bins(console, record, samples, signal, by, order, bins, max_delay)
        write_results(console, {"order": order, "by": by, "bins": rows}, outputs)
        return
    if bins is not None:
        raise ValueError(f"bins = {bins!r}: has no effect without --by; give the column, too")
    ratio = ran.get("ratio") if ratio is None else ratio
    with console.status("Searching; the first time, code is compiled for some seconds."):
        found = identify_b0(samples.u, samples.y, samples.dt, order, max_delay=max_delay)
    count = f"{samples.y.size} samples, dt = {samples.dt:g} s"
    print_line(console, f"{record.name}: {count}, order {order}")
    print_line(console, found.describe())
    results: dict[str, Any] = found.to_json() | {"phase_margin": phase_margin}
    if "b0" in ran:
        results["b_over_b0"] = found.b0 / ran["b0"]
        factor, spread = found.b0 / ran["b0"], found.b0_std / abs(ran["b0"])
        deviation = " within this form only" if found.rejected else f" ± {spread:.2g}"
        print_line(
            console, f"the loop ran with b0 = {ran['b0']:.5g}: b/b0 = {factor:.3g}{deviation}"
        )
    results |= _print_bandwidth(console, found, phase_margin, ratio)
    write_results(console, results, outputs)


def _print_matrix(
    record: Path,
    axes: str | None,
    actuators: str | None,
    order: int | None,
    dt: float | None,
    max_delay: float | None,
    read: ReadOptions,
    outputs: ResultOutputs,
) -> None:
    """Find, print and write B0 of several axes."""
    from quell.commissioning import measured_axes
    from quell.identification import identify_b0_matrix

    if order is None:
        raise ValueError("order: missing; give --order, the derivative of y that u acts on")
    of_y, of_u = (None if text is None else _names(text) for text in (axes, actuators))
    how = read.columns, dt, read.time_unit, read.max_size
    samples = measured_axes(record, of_y, of_u, *how)
    console = Console()
    with console.status("Searching; the first time, code is compiled for some seconds."):
        found = identify_b0_matrix(
            samples.u,
            samples.y,
            samples.dt,
            order,
            max_delay=max_delay,
            axes=samples.axes,
            actuators=samples.actuators,
        )
    count = f"{found.samples} samples, dt = {found.dt:g} s"
    print_line(console, f"{record.name}: {count}, order {order}")
    rows = table("B0 ± deviation", "", *found.actuators)
    for name, values, spreads in zip(found.axes, found.B0, found.std, strict=True):
        cells = (f"{value:.5g} ± {std:.2g}" for value, std in zip(values, spreads, strict=True))
        rows.add_row(name, *cells)
    console.print(rows)
    print_line(console, found.describe_rest())
    if not found.is_poor:
        entries = ", ".join(f"[{', '.join(f'{b:.5g}' for b in row)}]" for row in found.B0)
        print_line(console, f"B0 = [{entries}]  # of [axes]")
    write_results(console, found.to_json(), outputs)


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def _column(record: Path, by: str, read: ReadOptions, dt: float | None, size: int) -> Any:
    """Return a further column of a table in text, or a channel of a recording."""
    from quell.commissioning import controlled, measured, recorded_run

    run = recorded_run(record, read.columns, dt, read.time_unit, read.max_size)
    if run is not None:
        widths = dict(run.channels)
        if widths.get(by) != 1:
            one = ", ".join(name for name, width in widths.items() if width == 1)
            raise ValueError(f"by = {by!r}: must be a channel of {record.name}, one of {one}")
        return run[by][controlled(run)]
    columns = [name.strip() for name in (read.columns or ("u,y" if dt else "t,u,y")).split(",")]
    names = ",".join([*columns[:-1], by])
    found = measured(record, names, dt, read.time_unit, read.max_size).y
    if found.size != size:
        raise ValueError(
            f"by = {by!r}: the column has {found.size} samples, u and y have {size}; give "
            "--columns, so that all are read from the same rows"
        )
    return found


def _print_bins(
    console: Console,
    record: Path,
    samples: Measured,
    signal: Any,
    by: str,
    order: int,
    bins: int | None,
    max_delay: float | None,
) -> list[dict[str, Any]]:
    """Find and print b0 in each bin of a signal; return the results, one for each bin."""
    from quell.files import nonfinite_to_none
    from quell.identification import identify_b0_by

    with console.status("Searching; the first time, code is compiled for some seconds."):
        found = identify_b0_by(
            samples.u,
            samples.y,
            signal,
            samples.dt,
            order,
            bins=5 if bins is None else bins,
            max_delay=max_delay,
        )
    count = f"{samples.y.size} samples, dt = {samples.dt:g} s"
    print_line(console, f"{record.name}: {count}, order {order}, by {by}")
    for each in found:
        print_line(console, str(each))
    known = [each for each in found if each.is_known]
    if len(known) > 1:
        points, gains = (
            [f"{x:.4g}" for x in column]
            for column in zip(*((each.mean, each.b0) for each in known), strict=True)
        )
        table = f"points = [{', '.join(points)}], b0 = [{', '.join(gains)}]"
        print_line(console, f"schedule = {{ {table} }}  # of [controller]")
    rows = [each._asdict() | {"interval": each.interval} for each in found]
    return list(nonfinite_to_none(rows))


def _of_loop(path: Path, dt: float, trust: bool) -> dict[str, Any]:
    """Return order, b0 and omega_o over omega_c of a setup's controller, if it has them."""
    from quell.controllers.adrc import ADRC
    from quell.controllers.prefilters import without_prefilters
    from quell.setup import read
    from quell.setup.loading import unchecked

    setup = unchecked(*read(path), trust)
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
    console: Console, found: InputGain, phase_margin: float, ratio: float | None
) -> dict[str, Any]:
    """Print and return the omega_c that keeps the phase margin, if the record shows one."""
    from quell.identification.input_gain import MarginError

    nothing = {"omega_c": None, "omega_c_std": None, "ratio": ratio}
    try:
        with console.status("Searching for the omega_c that keeps the phase margin."):
            reach = found.omega_c(phase_margin, ratio)
            beside = found.beside(reach, phase_margin)
        omega_c, spread, ratio = reach
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
    print_line(
        console,
        f"in it are the lag, the delay of {found.delay:.4g} s, and the hold of {found.dt:.4g} s",
    )
    results: dict[str, Any] = {"beside": None}
    if beside is not None:
        results["beside"] = beside._asdict()
        derivative = f", k_d = {beside.kd:.4g}, tf = {beside.tf:.3g} s" if beside.kd else ""
        print_line(
            console,
            f"a {beside.name} of {beside.phase:.3g}°: k_p = {beside.kp:.4g}, k_i = {beside.ki:.4g}"
            f"{derivative}; its k_i is {beside.over_adrc:.3g} times that of this ADRC: the larger "
            "one rejects a constant load better",
        )
    elif found.order <= _SIMPLE:
        print_line(console, "no PI or PID with T_i = 4 T_d keeps this margin")
    return results | {"omega_c": omega_c, "omega_c_std": spread if known else None, "ratio": ratio}


# ---- quell excite ----


def excite(
    out: Path,
    *,
    kind: str | None = None,
    low: float = 0.5,
    high: float = 60.0,
    duration: float = 60.0,
    dt: float = 1e-3,
    u_min: float = -1.0,
    u_max: float = 1.0,
    seed: Whole = 0,
    actuators: Whole = 1,
    overwrite: Overwrite = False,
) -> None:
    """Design an input that excites a band within limits, for quell identify, and write it as CSV.

    Parameters
    ----------
    out
        CSV file to write, with columns t,u; for several actuators t,u1,u2 and so on.
    kind
        multisine, prbs or chirp; a PRBS by default, and a multisine for several actuators.
    low
        Lowest frequency of the band [rad/s].
    high
        Highest frequency of the band [rad/s].
    duration
        Length of the input [s].
    dt
        Sample time [s].
    u_min
        Lower limit of u.
    u_max
        Upper limit of u.
    seed
        Start of a PRBS, or phases of a multisine.
    actuators
        Number of actuators that move at the same time, each with a multisine of its own
        frequencies, for quell b0 --axes.
    """
    from quell.files import check_writable
    from quell.identification import excitation, interleaved_excitations, save_excitations

    if actuators != 1:
        if kind not in (None, "multisine"):
            raise ValueError(f"kind = {kind!r}: several actuators have multisines; leave it out")
        check_writable(out, overwrite)
        designs = interleaved_excitations(
            actuators, (low, high), duration, dt, u_min, u_max, seed=seed
        )
        save_excitations(designs, out, overwrite)
        console = Console()
        for i, each in enumerate(designs):
            print_line(console, f"u{i + 1}: {each.describe()}")
        names = ",".join(f"u{i + 1}" for i in range(actuators))
        print_line(console, f"Samples: {out}, {designs[0].u.size} of t,{names}")
        return
    kind = "prbs" if kind is None else kind
    if kind == "chirp":
        refuse({"seed": (seed, 0)}, "a chirp has nothing random")
    check_writable(out, overwrite)
    design = excitation(kind, (low, high), duration, dt, u_min, u_max, seed=seed)
    design.save(out, overwrite)
    console = Console()
    print_line(console, design.describe())
    print_line(console, f"Samples: {out}, {design.u.size} of t,u")
