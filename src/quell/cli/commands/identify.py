"""``quell identify``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from quell.cli.options import OUTPUTS, MaxSize, Outputs, Whole, WholeOrNone
from quell.cli.output import Console, check_outputs, print_line, table, write_results
from quell.reading import MAX_SIZE

if TYPE_CHECKING:
    from quell.identification import Alternative, Identified, Root

_HEADINGS = ("real\n[rad/s]", "imag\n[rad/s]", "± real", "± imag", "size\n[rad/s]", "damping")


def identify(
    data: Path,
    *,
    order: Whole = 4,
    zeros: Whole = 0,
    integrators: WholeOrNone = None,
    columns: str = "",
    dt: float | None = None,
    time_unit: str | None = None,
    delay: float = 0.0,
    max_delay: float | None = None,
    friction: bool = False,
    held_out: float = 0.3,
    horizon: Whole = 10,
    validate: Path | None = None,
    alternatives: bool = True,
    max_size: MaxSize = MAX_SIZE,
    outputs: Outputs = OUTPUTS,
) -> None:
    """Fit a continuous transfer function to recorded input and output.

    Parameters
    ----------
    data
        CSV file of the record, with or without a line of names; commas, semicolons or tabs between.
    order
        Number of poles.
    zeros
        Number of zeros; as many as poles if u acts on y at once.
    integrators
        Number of poles at s = 0; by default one if the slowest pole cannot be
        distinguished from it.
    columns
        Names or numbers (from 1 on) of the columns: t,u,y by default, or t,u,y,r with the external
        input of a closed loop.
    dt
        Sample time [s] of a record without times; columns are then u,y by default.
    time_unit
        Unit of the times of the record: s, ms, us or ns; s by default.
    delay
        Delay of u [s].
    max_delay
        Search the delay from --delay up to this [s].
    friction
        Estimate Coulomb friction, too.
    held_out
        Share of the record, at its end, on which the model is judged.
    horizon
        Number of samples of the prediction ahead.
    validate
        CSV file of another record, with the same columns, on which the model is judged, too.
    alternatives
        Fit other orders, with and without friction, and say what the record decides.
    """
    from quell.identification import alternatives as other_structures
    from quell.identification import identify, read_record

    names = tuple(name.strip() for name in columns.split(",")) if columns else ("t", "u", "y")
    if dt is not None and not columns:
        names = ("u", "y")
    record = read_record(data, names, dt, time_unit=time_unit, max_size=max_size)
    delays = delay if max_delay is None else (delay, max_delay)
    options: dict[str, Any] = {"friction": friction, "held_out": held_out, "horizon": horizon}
    options |= {"delay": delays, "integrators": integrators, "reference": record.reference}
    if validate is not None:
        other = read_record(validate, names, dt, time_unit=time_unit, max_size=max_size)
        if abs(other.dt - record.dt) > 1e-6 * record.dt:
            rule = f"must be that of {data.name}, {record.dt:g} s"
            raise ValueError(f"validate = {str(validate)!r}: dt = {other.dt:g} s: {rule}")
        options["validation"] = other.u, other.y
    outputs = check_outputs(outputs, ["identified"])
    console = Console()
    with console.status("Searching; the first time, code is compiled for some seconds."):
        model = identify(record.u, record.y, record.dt, order, zeros, **options)
    _print(console, model, data.name)
    others: tuple[Alternative, ...] = ()
    if alternatives:
        with console.status("Fitting other structures."):
            others = other_structures(model, delays if isinstance(delays, tuple) else None)
    for line in filter(None, (one.describe(model) for one in others)):
        print_line(console, line)
    paths: list[Path] = []
    if outputs.figures:
        from quell.experiments.common.figures import save_figure

        figure = model.plot()[0].figure
        paths = save_figure(figure, outputs.figures, "identified", outputs.overwrite)
    results = model.to_json() | {"alternatives": [one.to_json() for one in others]}
    write_results(console, results, outputs, paths)


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
    rest = lines[next(i for i, line in enumerate(lines) if line.startswith("constant force")) :]
    print_line(console, "\n".join(line for line in rest if not line.startswith("fit, ")))


def _cells(root: Root) -> tuple[str, ...]:
    place = (f"{part:.6g}" for part in (root.value.real, root.value.imag))
    spread = (f"{part:.2g}" for part in (root.real_std, root.imag_std))
    damping = "–" if root.value == 0.0 else f"{root.damping:.4f}"
    return (*place, *spread, f"{root.omega:.6g}", damping)
