"""``quell tune``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quell.cli.commands.run_rig import exit_code
from quell.cli.commands.tune_sources import (
    RIG_OPTIONS,
    WORKS,
    Asked,
    Rig,
    RigOptions,
    Works,
    from_record,
    from_rig,
    rest_of_model,
    rig_at,
    verified,
    with_rig_table,
)
from quell.cli.exit_codes import ExitCode
from quell.cli.options import (
    MODEL_OPTIONS,
    OUTPUTS,
    READ_OPTIONS,
    ModelOptions,
    Outputs,
    ReadOptions,
    Trust,
    WholeOrNone,
    options_of,
    refuse,
)
from quell.cli.output import Console, check_outputs, print_line, progress_bar, table, write_results

if TYPE_CHECKING:
    from quell.commissioning import Verification
    from quell.tuning import Tuned

_BOUNDS = ("m_s", "m_t", "m_ks", "damping", "noise_std", "resolution")
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
    damping: float | None = None,
    noise: float | None = None,
    resolution: float | None = None,
    feedforward: bool | None = None,
    trials: WholeOrNone = None,
    out: Path | None = None,
    save_record: Path | None = None,
    trust: Trust = False,
    model_order: WholeOrNone = None,
    read: ReadOptions = READ_OPTIONS,
    of_model: ModelOptions = MODEL_OPTIONS,
    works: Works = WORKS,
    rig: RigOptions = RIG_OPTIONS,
    outputs: Outputs = OUTPUTS,
) -> int:
    """Tune a controller for a linear plant: the best load rejection under constraints.

    The plant is that of a setup file, a transfer function, one that a record shows, or that an
    experiment at a rig shows (--device). A record is identified first, and the deviations of gain,
    poles and delay become the set of plants. PI, PID and other structures are tuned under the same
    constraints and shown beside it. If safety ends the verifying step the exit code is 3.

    Parameters
    ----------
    setup
        The file, in TOML, with [plant], and [tune] for all options; docs/tuning. Or a record: a
        recording of quell run-rig (.mcap or .csv), a saved run (.nc), or a table t,u,y in text.
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
        delay, delay-freed, bandwidths-2, bandwidths-3, freed-2, model-based-2, pi, pi-unfiltered,
        pid, p-pi-notch or lqg; by default simplest: the simplest whose objective is within 5 % of
        the best.
    order
        Order of an ADRC without model; 1 and 2 are tried by default.
    objective
        load-iae (integral of |y| after a step of the load), load (integral gain) or tracking;
        load-iae by default. With --trials the name of a metric.
    m_s
        Largest sensitivity; 1.6 by default.
    m_t
        Largest complementary sensitivity; 1.6 by default.
    m_ks
        Largest gain from y to u. By default noise may use 2 % of the range of u if --u-min, --u-max
        and the noise of y are known, else it follows from a PI or PID controller.
    damping
        Least damping of the closed loop's poles; 0.4 by default.
    noise
        Standard deviation of the noise of y in each sample [y-unit]; that of a record, and the
        resolution of a plant's encoder, are known.
    resolution
        Step to which y is rounded [y-unit]: 360/2^16 degrees of a 16-bit encoder.
    feedforward
        Feed the reference forward by the model of the plant; with a setup as its controller does.
    trials
        Of a setup: tune on by simulation in its scenario, with this many candidates and all that
        is not linear in the plant; --objective is then a metric, as iae, which is the default.
    out
        Write a setup file with the tuned controller, for quell run and quell run-rig.
    save_record
        Write the samples of the experiment to this file, as t,u,y.
    model_order
        Poles of a record's model at first, 4 by default; fewer, more, or friction, where the record
        shows it.
    """
    from quell.commissioning.records import is_record
    from quell.files import check_writable
    from quell.tuning.designs import range_of_u
    from quell.tuning.plants import with_known_noise

    named: dict[str, Any] = {
        "structure": structure,
        "order": order,
        "objective": objective,
        "delay": delay,
        "feedforward": feedforward,
        "trials": trials,
    }
    named |= {"m_s": m_s, "m_t": m_t, "m_ks": m_ks, "damping": damping}
    named |= {"noise_std": noise, "resolution": resolution}
    options = {name: value for name, value in named.items() if value is not None}
    files = [file for file in (out, save_record) if file is not None]
    outputs = check_outputs(outputs, ["tuned", "verified"], files)
    for file in files:
        check_writable(file, outputs.overwrite)
    console = Console()
    measured = rig.device is not None or (setup is not None and is_record(setup))
    if trials is not None and (measured or setup is None):
        raise ValueError(f"--trials = {trials}: needs a setup file with a scenario")
    of_rig = {"save_record": (save_record, None)} | options_of(rig, RIG_OPTIONS)
    if not measured:
        unused = {"model_order": (model_order, None)} | options_of(read, READ_OPTIONS)
        unused |= options_of(of_model, MODEL_OPTIONS)
        refuse(unused, "goes with a record or --device, which is identified")
        refuse(of_rig, "goes with --device, an experiment at a rig")
        plant, dt, options, name = _plant(setup, num, den, dt, options, works, trust)
        tuned = _tuned(console, plant, dt, options)
        _print(console, tuned, name)
        _write(console, tuned, out, outputs)
        return ExitCode.DONE
    if num or den or (delay is not None) or (rig.device is not None and setup is not None):
        raise ValueError("setup: a record or --device goes without --num, --den and --delay")
    _bounds(options)
    options |= works.limits()
    place: Rig | None = None
    asked = Asked(dt, read, of_model, model_order)
    if rig.device is not None:
        place = rig_at(rig, works, dt, trust)
        shown = from_rig(console, place, float(dt or 0.0), asked, save_record, outputs.overwrite)
        if shown is None:
            return ExitCode.DONE
        plant, dt, more, model, y_now = shown
        more |= rest_of_model(model, y_now)
    else:
        assert setup is not None
        refuse(of_rig, "goes with --device, an experiment at a rig")
        given_rest = works.rest()
        plant, dt, more, model = from_record(console, setup, asked)
        more |= given_rest or rest_of_model(model)
    options["constraints"] = with_known_noise(options["constraints"], model, range_of_u(options))
    tuned = replace(_tuned(console, plant, dt, options | more), signals=model.signals)
    _print(console, tuned, rig.device or str(setup))
    step = None
    if place is not None:
        tuned = with_rig_table(tuned, place)
        step = verified(console, place, tuned, model, y_now)
    _write(console, tuned, out, outputs, {"model": model.to_json()}, step)
    return ExitCode.DONE if step is None else exit_code(step.run)


def _tuned(console: Console, plant: Any, dt: float, options: dict[str, Any]) -> Tuned:
    from quell.tuning import tune as tuned_for

    with progress_bar(console, "tuning") as report:
        return tuned_for(plant, dt, progress=partial(_progress, report), **options)


def _write(
    console: Console,
    tuned: Tuned,
    out: Path | None,
    outputs: Outputs,
    more: Mapping[str, Any] | None = None,
    step: Verification | None = None,
) -> None:
    """Write setup, figures and results where they are asked for."""
    if out is not None:
        tuned.save(out, outputs.overwrite)
        print_line(console, f"Setup: {out}")
    paths, results = [], tuned.to_json() | dict(more or {})
    if outputs.figures:
        from quell.experiments.common.figures import save_figure

        axes = {"tuned": tuned.plot().flat[0]}
        if step is not None:
            axes["verified"] = step.plot()[0]
        for name, one in axes.items():
            paths += save_figure(one.figure, outputs.figures, name, outputs.overwrite)
    if step is not None:
        results["verification"] = step.to_json()
    write_results(console, results, outputs, paths)


def _bounds(options: dict[str, Any]) -> None:
    """Put the constraints of the command line together."""
    from quell.tuning import Constraints

    bounds = {key: options.pop(key) for key in _BOUNDS if key in options}
    options["constraints"] = Constraints(**bounds)


def _progress(report: Any, part: str, share: float) -> None:
    report(f"tuning {part}", share)


def _plant(
    setup: Path | None,
    num: str,
    den: str,
    dt: float | None,
    options: dict[str, Any],
    works: Works,
    trust: bool,
) -> tuple[Any, float, dict[str, Any], str]:
    """Return the plant, the sample time, the options of ``tune``, and the plant's name."""
    from quell.setup.tuning_task import tuning_task

    if setup is not None:
        if num or den or dt is not None:
            raise ValueError("setup: goes without --num, --den and --dt, which are in the file")
        rest = {"u_rest": (works.u_rest, None), "y_rest": (works.y_rest, None)}
        refuse(rest, "is the operating_point of [plant], and scenario.x0, in a setup")
        task = tuning_task(setup, options, trust, works.limits())
        return task.plant, task.dt, task.options, task.setup.title
    if not num or not den or dt is None:
        raise ValueError(
            "setup: missing; must be a TOML file, or give --num 1 --den 1,3,3,1 --dt 0.01"
        )
    _bounds(options)
    options |= works.limits() | works.rest()
    plant = (_numbers("num", num), _numbers("den", den))
    return plant, dt, options, f"({num})/({den})"


def _numbers(name: str, text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{name} = {text!r}: must be numbers with commas, as 1,3,3,1") from None


def _print(console: Console, tuned: Tuned, name: str) -> None:
    from quell.tuning.result import report

    count = len(tuned.plants.plants)
    plants = "1 plant" if count == 1 else f"{count} plants"
    print_line(console, f"{name}, dt = {tuned.plants.dt:g} s, {plants}")
    print_line(console, f"constraints: {tuned.constraints}")
    if tuned.noise_bound:
        print_line(console, tuned.noise_bound)
    quantity = report.quantity(tuned.objective)
    headings = ("structure", quantity, report.second_quantity(tuned.objective), *_HEADINGS)
    # With so little white space 80 columns hold all names.
    tight: dict[str, Any] = {"padding": (0, 1, 0, 0), "pad_edge": False}
    rows = table("Optima under these constraints", *headings, **tight)
    reasons = []
    for label, *cells, reason in report.rows(tuned.designs, tuned.objective):
        rows.add_row(f"[bold]{label}[/]" if label == tuned.design.name else label, *cells)
        reasons += [f"{label}: {reason}"] if reason else []
    console.print(rows)
    for line in (*reasons, f"active: {', '.join(tuned.active) or 'no constraint'}", *tuned.costs):
        print_line(console, line)
    for line in report.tradeoff_lines(tuned.tradeoff, tuned.objective):
        print_line(console, f"with {line}")
    print_line(console, tuned.damping)
    print_line(console, str(tuned.reference_step))
    if tuned.check is not None:
        print_line(console, str(tuned.check))
    values = ", ".join(f"{key} = {value:.5g}" for key, value in tuned.design.values.items())
    print_line(console, f"{tuned.design.name}: {values}")
