"""``quell tune``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from quell.cli.options import OUTPUTS, Outputs, WholeOrNone
from quell.cli.output import check_outputs, print_line, progress_bar, table, write_results

if TYPE_CHECKING:
    from quell.tuning import Tuned

_HEADINGS = ("M_s", "M_t", "M_ks", "delay\nmargin")


def tune(
    setup: Path | None = None,
    *,
    num: str = "",
    den: str = "",
    dt: float | None = None,
    delay: float | None = None,
    structure: str | None = None,
    order: WholeOrNone = None,
    objective: str | None = None,
    m_s: float | None = None,
    m_t: float | None = None,
    m_ks: float | None = None,
    out: Path | None = None,
    outputs: Outputs = OUTPUTS,
) -> None:
    """Tune a controller for a linear plant: the best load rejection under constraints.

    The plant is that of a setup file, or a transfer function. PI, PID and other structures are
    tuned under the same constraints and shown beside it.

    Parameters
    ----------
    setup
        The file, in TOML, with [plant], and [tune] for all options; docs/tuning.
    num
        Numerator of the transfer function, highest power of s first: 1 or 2,1.
    den
        Denominator: 1,3,3,1.
    dt
        Sample time [s].
    delay
        Dead time of the plant [s].
    structure
        bandwidths, freed, half-gain, half-gain-law, reduced, model-based, model-based-freed,
        delay, delay-freed, pi, pi-unfiltered or pid; freed by default.
    order
        Order of an ADRC without model; 1 and 2 are tried by default.
    objective
        load (integral gain), load-iae or tracking; load by default.
    m_s
        Largest sensitivity; 1.6 by default.
    m_t
        Largest complementary sensitivity; 1.6 by default.
    m_ks
        Largest gain from y to u; ten times that of the optimal PI controller by default.
    out
        Write a setup file with the tuned controller, for quell run and quell run-rig.
    """
    from quell.files import check_writable
    from quell.tuning import tune as tuned_for

    named: dict[str, Any] = {
        "structure": structure,
        "order": order,
        "objective": objective,
        "delay": delay,
    }
    named |= {"m_s": m_s, "m_t": m_t, "m_ks": m_ks}
    options = {name: value for name, value in named.items() if value is not None}
    plant, dt, options, name = _plant(setup, num, den, dt, options)
    outputs = check_outputs(outputs, ["tuned"], [] if out is None else [out])
    if out is not None:
        check_writable(out, outputs.overwrite)
    console = Console()
    with progress_bar(console, "tuning") as report:
        tuned = tuned_for(plant, dt, progress=partial(_progress, report), **options)
    _print(console, tuned, name)
    if out is not None:
        tuned.save(out, outputs.overwrite)
        print_line(console, f"Setup: {out}")
    paths = _save_figure(tuned, outputs.figures, outputs.overwrite) if outputs.figures else []
    write_results(console, tuned.to_json(), outputs, paths)


def _progress(report: Any, part: str, share: float) -> None:
    report(f"tuning {part}", share)


def _plant(
    setup: Path | None, num: str, den: str, dt: float | None, options: dict[str, Any]
) -> tuple[Any, float, dict[str, Any], str]:
    """Return the plant, the sample time, the options of ``tune``, and the plant's name."""
    from quell.setup.tuning_task import tuning_task
    from quell.tuning import Constraints

    if setup is not None:
        if num or den or dt is not None:
            raise ValueError("setup: goes without --num, --den and --dt, which are in the file")
        task = tuning_task(setup, options)
        return task.plant, task.dt, task.options, task.setup.title
    if not num or not den or dt is None:
        raise ValueError(
            "setup: missing; must be a TOML file, or give --num 1 --den 1,3,3,1 --dt 0.01"
        )
    bounds = {key: options.pop(key) for key in ("m_s", "m_t", "m_ks") if key in options}
    options["constraints"] = Constraints(**bounds)
    plant = (_numbers("num", num), _numbers("den", den))
    return plant, dt, options, f"({num})/({den})"


def _numbers(name: str, text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{name} = {text!r}: must be numbers with commas, as 1,3,3,1") from None


def _save_figure(tuned: Tuned, folder: Path, overwrite: bool) -> list[Path]:
    from quell.experiments.common.figures import save_figure

    figure = tuned.plot().flat[0].figure
    return save_figure(figure, folder, "tuned", overwrite)


def _print(console: Console, tuned: Tuned, name: str) -> None:
    from quell.tuning.result import report

    print_line(console, f"{name}, dt = {tuned.plants.dt:g} s, {len(tuned.plants.plants)} plants")
    print_line(console, f"constraints: {tuned.constraints}")
    if tuned.noise_bound:
        print_line(console, tuned.noise_bound)
    quantity = report.quantity(tuned.objective)
    rows = table("Optima under these constraints", "structure", quantity, *_HEADINGS)
    reasons = []
    for label, *cells, reason in report.rows(tuned.designs, tuned.objective):
        rows.add_row(f"[bold]{label}[/]" if label == tuned.design.name else label, *cells)
        reasons += [f"{label}: {reason}"] if reason else []
    console.print(rows)
    for line in (*reasons, f"active: {', '.join(tuned.active) or 'no constraint'}", *tuned.costs):
        print_line(console, line)
    for line in report.tradeoff_lines(tuned.tradeoff, tuned.objective):
        print_line(console, f"with {line}")
    if tuned.check is not None:
        print_line(console, str(tuned.check))
    values = ", ".join(f"{key} = {value:.5g}" for key, value in tuned.design.values.items())
    print_line(console, f"{tuned.design.name}: {values}")
