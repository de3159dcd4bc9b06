"""``quell identify``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from quell.cli.options import (
    MODEL_OPTIONS,
    OUTPUTS,
    READ_OPTIONS,
    ModelOptions,
    Outputs,
    ReadOptions,
    Whole,
)
from quell.cli.output import Console, check_outputs, print_line, table, write_results

if TYPE_CHECKING:
    from quell.identification import Alternative, Identified, Root

# Fits below which u and y may be swapped, and above which they are [%]: chosen by hand.
_COLLAPSED, _GOOD = 20.0, 60.0
_HEADINGS = ("real\n[rad/s]", "imag\n[rad/s]", "± real", "± imag", "size\n[rad/s]", "damping")


def identify(
    *data: Path,
    order: Whole = 4,
    delay: float = 0.0,
    dt: float | None = None,
    horizon: Whole = 10,
    validate: Path | None = None,
    alternatives: bool = True,
    read: ReadOptions = READ_OPTIONS,
    of_model: ModelOptions = MODEL_OPTIONS,
    outputs: Outputs = OUTPUTS,
) -> None:
    """Fit a continuous transfer function to recorded input and output.

    Parameters
    ----------
    data
        Records: tables t,u,y in text, recordings of quell run-rig, saved runs (.nc). Several have
        one model, each its own initial state and constant force. A further column of --columns is
        the external input of a closed loop.
    order
        Number of poles.
    delay
        Delay of u [s]; with --max-delay the shortest one.
    dt
        Sample time [s] of a record without times; columns are then u,y by default.
    horizon
        Number of samples of the prediction ahead.
    validate
        Another record, with the same columns, on which the model is judged, too.
    alternatives
        Fit other orders, with and without friction, and say what the record decides.
    """
    from quell.commissioning.records import measured_records
    from quell.identification import alternatives as other_structures
    from quell.identification import identify

    how = read.columns, dt, read.time_unit, read.max_size
    records = measured_records(data, *how)
    record, several = records[0], len(records) > 1
    most = of_model.max_delay
    delays = delay if most is None else (delay, most)
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
        print_line(console, "nothing is held out: u does not move at the end of the record")
    if not several and _look_swapped(model, order, delays):
        print_line(console, "NOT: u and y look swapped: the reverse fits well; see --columns")
    others: tuple[Alternative, ...] = ()
    if alternatives:
        given: dict[str, Any] = {
            "integrators": of_model.integrators,
            "friction": of_model.friction,
        }
        if most is not None:
            given["delay"] = delays
        with console.status("Fitting other structures."):
            others = other_structures(model, **given)
    for line in filter(None, (one.describe(model) for one in others)):
        print_line(console, line)
    paths: list[Path] = []
    if outputs.figures:
        from quell.experiments.common.figures import save_figure

        figure = model.plot()[0].figure
        paths = save_figure(figure, outputs.figures, "identified", outputs.overwrite)
    results = model.to_json() | {"alternatives": [one.to_json() for one in others]}
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
            roots.add_row(name, *_cells(root))
    console.print(roots)
    fits = table("Fit (NRMSE)", "on", "%")
    for name, value in model.fits.items():
        ahead = f" {model.horizon} samples ahead" if name.endswith("predicted") else ""
        fits.add_row(name + ahead, percent(value))
    console.print(fits)
    rest = lines[next(i for i, line in enumerate(lines) if line.startswith("gain ")) :]
    print_line(console, "\n".join(line for line in rest if not line.startswith("fit, ")))


def _cells(root: Root) -> tuple[str, ...]:
    place = (f"{part:.6g}" for part in (root.value.real, root.value.imag))
    spread = (f"{part:.2g}" for part in (root.real_std, root.imag_std))
    damping = "–" if root.value == 0.0 else f"{root.damping:.4f}"
    return (*place, *spread, f"{root.omega:.6g}", damping)
