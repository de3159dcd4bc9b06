"""``quell identify`` and ``quell excite``: read or design, print, write."""

from __future__ import annotations

from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from quell.cli.output import check_places, write_results
from quell.experiments.common.figures import make_folder, save_figure
from quell.files import check_writable
from quell.identification.excitation import excitation
from quell.identification.identify import identify
from quell.identification.measured import read_record
from quell.identification.result import Identified, Root, percent


def run_identify(
    *,
    data: Path,
    order: int,
    zeros: int,
    integrators: int | None,
    columns: str,
    dt: float | None,
    delay: float,
    max_delay: float | None,
    friction: bool,
    held_out: float,
    horizon: int,
    json_file: Path | None,
    figures: Path | None,
) -> None:
    """Identify a transfer function from a file, print its tables, write what was asked for.

    Raises
    ------
    ValueError
        for a file that is no record, settings out of range, or a place that can't be written to.
    """
    names = (
        tuple(name.strip() for name in columns.split(","))
        if columns
        else (("u", "y") if dt is not None else ("t", "u", "y"))
    )
    record = read_record(data, names, dt)
    check_places(json_file, figures)
    console = Console()
    with console.status("Searching; the first time of a version some seconds to compile."):
        found = identify(
            record.u,
            record.y,
            record.dt,
            order,
            zeros,
            integrators=integrators,
            delay=delay if max_delay is None else (delay, max_delay),
            friction=friction,
            held_out=held_out,
            horizon=horizon,
            reference=record.reference,
        )
    _print(console, found, data.name)
    paths = _drawn(found, figures) if figures is not None else []
    write_results(console, found.to_json(), json_file, paths, figures)


def run_excite(
    *,
    kind: str,
    low: float,
    high: float,
    duration: float,
    dt: float,
    u_min: float,
    u_max: float,
    seed: int,
    out: Path,
) -> None:
    """Design an excitation, print what it is, write it as CSV.

    Raises
    ------
    ValueError
        for settings out of range, or a file that can't be written.
    """
    check_writable(out)
    design = excitation(kind, (low, high), duration, dt, u_min, u_max, seed=seed)
    design.save(out)
    console = Console()
    console.print(escape(design.describe()), soft_wrap=True)
    console.print(f"Samples: {escape(str(out))}, {design.u.size} of t,u", soft_wrap=True)


def _drawn(found: Identified, folder: Path) -> list[Path]:
    import matplotlib.pyplot as plt

    axes = found.plot()
    try:
        return save_figure(axes[0].figure, make_folder(folder), "identified")
    finally:
        plt.close(axes[0].figure)


def _print(console: Console, found: Identified, source: str) -> None:
    told = found.describe().splitlines()
    console.print(f"{escape(source)}: {found.y.size} samples, dt = {found.dt:g} s", soft_wrap=True)
    console.print(escape("\n".join(told[:2])), soft_wrap=True)
    roots = Table(title="Poles and zeros", title_justify="left", box=SIMPLE_HEAD)
    roots.add_column("")
    for heading in (
        "real\n[rad/s]",
        "imag\n[rad/s]",
        "± real",
        "± imag",
        "size\n[rad/s]",
        "damping",
    ):
        roots.add_column(escape(heading), justify="right", no_wrap=True)
    for what, which in (("pole", found.poles), ("zero", found.zeros)):
        for root in which:
            roots.add_row(what, *_cells(root))
    console.print(roots)
    fits = Table(title="Fit (NRMSE)", title_justify="left", box=SIMPLE_HEAD)
    fits.add_column("on")
    fits.add_column("%", justify="right")
    for name, value in found.fits.items():
        ahead = f" {found.horizon} samples ahead" if name.endswith("predicted") else ""
        fits.add_row(name + ahead, percent(value))
    console.print(fits)
    rest = told[next(i for i, line in enumerate(told) if line.startswith("constant force")) :]
    console.print(
        escape("\n".join(line for line in rest if not line.startswith("fit, "))), soft_wrap=True
    )


def _cells(root: Root) -> tuple[str, ...]:
    damping = "–" if root.value == 0.0 else f"{root.damping:.4f}"
    return (
        f"{root.value.real:.6g}",
        f"{root.value.imag:.6g}",
        f"{root.real_std:.2g}",
        f"{root.imag_std:.2g}",
        f"{root.omega:.6g}",
        damping,
    )
