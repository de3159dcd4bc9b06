"""``quell run``, ``quell sweep``, ``quell export`` and ``quell studio``: what a setup is for."""

from __future__ import annotations

import math
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from quell.cli.exit_codes import ExitCode, exit_if_diverged
from quell.cli.options import (
    RUN_OUTPUTS,
    Overwrite,
    RunOutputs,
    Switch,
    Trust,
    Whole,
    WholeOrNone,
    options_of,
    refuse,
)
from quell.cli.output import (
    COMPILING,
    Console,
    check_outputs,
    print_line,
    progress_bar,
    write_record,
    write_results,
)
from quell.cli.report import (
    print_run,
    print_summary,
    save_run_figure,
    stored_alike,
    summary,
    windowed_metrics,
)

if TYPE_CHECKING:
    from quell.export import Comparison, Exported
    from quell.setup import Setup
    from quell.sweeping import Sweep

# ---- quell run ----


def run(
    setup: Path | None = None,
    *,
    example: Switch = False,
    trust: Trust = False,
    outputs: RunOutputs = RUN_OUTPUTS,
) -> None:
    """Simulate the plant, controller and scenario of a setup file, of one axis or several.

    If the run diverges, or y runs away from r, the exit code is 4; what was run is recorded and
    drawn.

    Parameters
    ----------
    setup
        The file, in TOML; docs/setup_keys has all keys.
    example
        Print such a file, and do no more.
    """
    from quell.setup import EXAMPLES, SetupError, made, read
    from quell.setup.axes import signals_in
    from quell.setup.description import is_of_axes
    from quell.simulation import simulate
    from quell.types import Status

    if example:
        unused = {"setup": (setup, None)} | options_of(outputs, RUN_OUTPUTS)
        refuse(unused, "has no effect beside --example, which only prints a file")
        print((EXAMPLES / "two_mass.toml").read_text(encoding="utf-8"), end="")
        return
    if setup is None:
        raise ValueError("setup: missing; must be a TOML file, and quell run --example prints one")
    name, data = read(setup)
    given = made(name, data, trust)
    plant, scenario = given.needed("plant"), given.needed("scenario")
    outputs = check_outputs(outputs, [setup.stem])
    console = Console()
    with progress_bar(console, COMPILING) as report:
        progress = partial(report, COMPILING)
        try:
            result = simulate(plant, given.controller, scenario, progress=progress)
        except ValueError as error:
            raise SetupError([f"{given.file}: {error}"]) from None
    if is_of_axes(data) and (signals := signals_in(given.description, given.controller)).known:
        result = replace(result, signals=signals)
    title = f"{given.title}: {result.plant}, dt = {result.dt:g} s"
    scores, learned = print_run(console, result, given, title)
    paths = save_run_figure(result, given.title, outputs, setup.stem)
    write_record(console, result, outputs, "Record")
    alone = _without_learner(console, given, data, result)
    results = {
        "title": given.title,
        "plant": result.plant,
        "dt": result.dt,
        "status": result.status.name or "OK",
        "diverged": result.diverged,
        "ran_away": Status.RAN_AWAY in result.status,
        "metrics": scores,
        "learned": learned,
        "setup": given.as_json(),
    }
    if alone:
        results["without_learner"] = alone
    write_results(console, results, outputs, paths)
    exit_if_diverged([result])


# With more than this share of the error without learner, a learner makes it worse.
_WORSE = 1.01
_ALONE = "simulating without the learner, to compare"


def _without_learner(
    console: Console, given: Setup, data: Mapping[str, Any], run: Any
) -> dict[str, Any]:
    """Return the RMS of r − y of the same run without learners; say it where they make it worse.

    The figures are those of the last window, with a learner and without, for each axis by its name;
    there are none where the run or the window has none, where each learner has a guard, which
    judges that itself, and without learner.
    """
    from quell.setup import SetupError, made
    from quell.simulation import simulate

    tables = [data, data.get("axes", {}), *data.get("axis", ())]
    present = [{key for key, value in table.items() if value != "none"} for table in tables]
    if not any("learner" in keys and "guard" not in keys for keys in present):
        return {}
    others = ("sweep", "tune", "rig")
    parts = {key: value for key, value in _unlearned(data).items() if key not in others}
    if "axes" in parts:
        parts["axes"] = _unlearned(parts["axes"])
    if "axis" in parts:
        parts["axis"] = [_unlearned(table) for table in parts["axis"]]
    try:
        controller = made(given.file, parts, given.trust).controller
    except SetupError as error:
        print_line(console, f"NOT compared with the run without a learner: {error}")
        return {}
    plant, scenario = given.needed("plant"), given.needed("scenario")
    with progress_bar(console, _ALONE) as report, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it is not the run that was asked for
        plain = simulate(plant, controller, scenario, progress=partial(report, _ALONE))
    if run.lost and not plain.lost:
        print_line(
            console,
            "NOT with this learner: without it the run goes on to its end; give it a guard, or "
            "leave it out (docs/choose).",
        )
    found = {}
    for name in run.axis_names or ("",):
        pair = (one.axis(name) if name else one for one in (run, plain))
        learned, alone = (windowed_metrics(each, given)[-1].get("rms") for each in pair)
        if learned is None or alone is None:
            continue
        found[name or "y"] = {"rms": learned, "rms_without": alone}
        if learned > _WORSE * alone:
            of = f" of {name}" if name else ""
            print_line(
                console,
                f"NOT better than without a learner: the RMS of r − y{of} is {learned:.4g} in the "
                f"last window, {alone:.4g} without; give it a guard, or leave it out "
                "(docs/choose).",
            )
    return found


def _unlearned(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table of a setup without its learner and guard."""
    return {key: value for key, value in table.items() if key not in ("learner", "guard")}


# ---- quell sweep ----

_WORST = 5
_LABEL = "simulating (the first runs compile for some seconds)"


def sweep(
    setup: Path,
    *,
    folder: Path | None = None,
    dask: Annotated[str | None, Parameter(show_default=False)] = None,
    workers: WholeOrNone = None,
    repeat: WholeOrNone = None,
    worst: Whole = _WORST,
    trust: Trust = False,
    outputs: RunOutputs = RUN_OUTPUTS,
) -> None:
    """Do the runs of a setup's table [sweep], and store their measures.

    A sweep that was interrupted or killed goes on where it stopped when the command is given again.
    Failing runs are recorded and do not stop it; the exit code is then not 0, but for runs that
    are only beyond a limit.

    Parameters
    ----------
    setup
        The file, in TOML; docs/setup_keys has all keys, docs/scale an example.
    folder
        Where the results are; by default the setup's name with -sweep.
    dask
        Address tcp://HOST:PORT of a Dask scheduler, whose workers do the runs; docs/scale_cluster.
    workers
        Number of processes on this machine; the number of cores by default.
    repeat
        Only repeat the run of this number, with its table of metrics and figure.
    worst
        Number of worst runs to print.
    """
    from quell.setup import made, read
    from quell.setup.sweeps import sweep_of

    given = made(*read(setup), trust)
    plan = sweep_of(given)
    where = Path(f"{setup.stem}-sweep") if folder is None else folder
    console = Console()
    if repeat is not None:
        many = {"dask": (dask, None), "workers": (workers, None), "worst": (worst, _WORST)}
        refuse(many, "is for many runs; --repeat does one")
        _repeat(console, given, plan, repeat, where, outputs)
        return
    if outputs.save is not None:
        raise ValueError("--save is for the record of one run; give its number with --repeat")
    from quell.sweeping import sweep as run_sweep

    varied = [name for name, each in plan["parameters"].items() if _varies(each)]
    figures = {name: f"{setup.stem}-{_slug(name)}" for name in varied}
    outputs = check_outputs(outputs, list(figures.values()))
    # One process does no more than one thread of this one, and takes longer to start.
    if dask is not None and "://" not in dask:
        raise ValueError(f"dask = {dask!r}: must be the address of a scheduler, tcp://HOST:PORT")
    if dask is not None:
        refuse({"workers": (workers, None)}, "is for this machine; --dask names other workers")
    executor = dask or ("threads" if workers == 1 else "processes")
    with _progress(console) as report:
        try:
            found = run_sweep(
                **plan, folder=where, executor=executor, workers=workers, progress=report
            )
        except KeyboardInterrupt:
            print_line(console, f"The same command goes on with what is done, in {where}/.")
            raise
    results = summary(found, worst)
    where_option = "" if folder is None else f" --folder {folder}"
    print_summary(console, given.title, found, results, f"quell sweep {setup}{where_option}")
    results["notes"] = _notes(given, plan, varied)
    for note in results["notes"]:
        print_line(console, note)
    paths = _save_figures(found, figures, outputs)
    write_results(console, {**results, "setup": given.as_json()}, outputs, paths)
    if results["errors"]:
        sys.exit(ExitCode.RUNS_FAILED)
    if results["diverged"] or results["ran_away"]:
        sys.exit(ExitCode.DIVERGED)


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[float], None]]:
    """Show a progress bar with the time that remains; return the callback for the share done."""
    from rich.progress import TaskProgressColumn, TimeRemainingColumn

    with progress_bar(console, _LABEL, TaskProgressColumn(), TimeRemainingColumn()) as report:
        yield partial(report, _LABEL)


def _varies(given: Any) -> bool:
    from quell.sweeping.runs import as_values

    values = as_values("", given)
    return not isinstance(values, tuple) or len(values) > 1


def _notes(given: Setup, plan: Mapping[str, Any], varied: Sequence[str]) -> list[str]:
    """Return lines with NOT about what the measures of a sweep can not be compared over."""
    from quell.records.metrics import OF_U

    cases = plan["build"].cases.values()
    paths = [*varied, *(path for case in cases for path in case)]
    dt = float(given.controller.dt)
    notes = []
    if "dt" in varied or len({float(case.get("dt", dt)) for case in cases}) > 1:
        notes.append(
            "NOT comparable over dt: measures are of samples and change with dt by themselves, as "
            "what y does between samples is in none; compare runs of one dt"
        )
    of_plant = given.tables().get("axes", {}).get("B0") == "plant"
    gains = ("axes.B0", "axes.M", *(["plant."] if of_plant else []))
    of_u = [
        name
        for name, each in plan["metrics"].items()
        if getattr(each, "axis", "") and each.name in OF_U
    ]
    by = [path for path in paths if path == "axes" or path.startswith(gains)]
    if of_u and by:
        notes.append(
            f"NOT comparable over {', '.join(by)}: {', '.join(of_u)}: u of an axis is v = B0 u, "
            "which is in another unit for each B0; compare runs of one B0"
        )
    return notes


def _slug(name: str) -> str:
    return re.sub(r"[^\w]+", "-", name).strip("-")


def _save_figures(found: Sweep, figures: dict[str, str], outputs: RunOutputs) -> list[Path]:
    """Save the figure of each parameter; return the paths of the files."""
    from quell.experiments.common import save_figure

    if outputs.figures is None:
        return []
    paths = []
    for parameter, name in figures.items():
        paths += save_figure(found.plot(parameter), outputs.figures, name, outputs.overwrite)
    return paths


def _repeat(
    console: Console,
    given: Setup,
    arguments: dict[str, Any],
    number: int,
    folder: Path,
    outputs: RunOutputs,
) -> None:
    """Repeat a run alone, print and draw it, and compare it with the stored measures."""
    from quell.simulation import simulate
    from quell.sweeping.sweep import parts_of

    name = f"{given.file.removesuffix('.toml')}-run-{number}"
    text, parts = parts_of(number, arguments)
    outputs = check_outputs(outputs, [name])
    with progress_bar(console, COMPILING) as report:
        run = simulate(*parts, progress=partial(report, COMPILING))
    title = f"{given.title}, {text}"
    of_run = replace(given, scenario=parts.scenario, plant=parts.plant, title=title)
    scores, learned = print_run(console, run, of_run, title)
    same = stored_alike(folder, number, text, run, arguments["metrics"])
    if same is not None:
        print_line(console, f"In {folder}/: {'the same, bit for bit' if same else 'other values'}.")
    paths = save_run_figure(run, f"{given.title}, run {number}", outputs, name)
    write_record(console, run, outputs, "Record")
    results = {"run": text, "status": run.status.name or "OK", "metrics": scores}
    write_results(console, {**results, "as_stored": same, "learned": learned}, outputs, paths)
    exit_if_diverged([run])


# ---- quell export ----


def export(
    setup: Path,
    *,
    to: Literal["c", "fmu", "ros2", "st"] = "c",
    out: Path,
    name: str | None = None,
    precision: Literal["double", "single"] = "double",
    what: Literal["controller", "plant", "loop"] = "controller",
    fmi: Literal["3.0", "2.0"] = "3.0",
    resolution: float | None = None,
    memory: Path | None = None,
    accept: Switch = False,
    prove: Switch = False,
    spread: float = 0.0,
    trust: Trust = False,
    overwrite: Overwrite = False,
) -> None:
    """Write the controller of a setup for another machine: C, an FMU, ROS 2, Structured Text.

    The C files (C99) are a library for CMake, Arduino, PlatformIO and ESP-IDF with golden vectors
    and a README. In single precision the scenario of the setup is simulated in both precisions
    before, and nothing is written if they differ too much.

    Parameters
    ----------
    setup
        The file, in TOML; docs/setup_keys has all keys.
    to
        c; fmu, which is an FMU for co-simulation; ros2, a package with a chainable controller of
        ros2_control; or st, a function block in Structured Text for a PLC.
    out
        The folder, or the file .fmu.
    name
        Begins all names; controller by default, and for an FMU the name of the file.
    precision
        Of the code: double, or single for a processor that has no double precision.
    what
        Of an FMU: controller, plant or loop.
    fmi
        Of an FMU: the version of FMI; 2.0 for tools that do not read 3.0.
    resolution
        Of an encoder [y-unit per count]: adds NAME_step_counts to the C code, which takes r and y
        as integers.
    memory
        File of `quell run-rig --memory`, or bytes of NAME_save: the exported controller begins with
        what was learned.
    accept
        Write in single precision even if it differs too much, or can't be compared.
    prove
        Write the folder proof beside the C code, and prove with Frama-C that no behaviour is
        undefined and u is always a number within its limits. What is not proved is printed, and the
        exit code is not 0. With a linear plant in the setup, without limits and learner: whether
        the loop is stable with the numbers of the code, and how much rounding changes u.
    spread
        With --prove: share of each coefficient of the plant and of its gain within which the loop
        shall be stable, too.
    """
    from quell.export import c
    from quell.setup import made, read

    if to != "c":
        refuse({"resolution": (resolution, None), "prove": (prove, False)}, "only with --to c")
    if not prove:
        refuse({"spread": (spread, 0.0)}, "goes with --prove")
    if to in ("fmu", "ros2"):
        single = {"precision": (precision, "double"), "accept": (accept, False)}
        refuse(single, f"only with --to c or --to st; --to {to} is in double")
    elif precision == "double":
        refuse({"accept": (accept, False)}, "goes with --precision single, which it accepts")
    if to != "fmu":
        refuse({"what": (what, "controller")}, f"is for --to fmu; {to} is of the controller")
        refuse({"fmi": (fmi, "3.0")}, "is for --to fmu")
    if what == "plant":
        refuse({"memory": (memory, None)}, "is of a controller; a plant has none")
    given = made(*read(setup), trust)
    controller = _learned(given.controller, memory, precision)
    if to == "fmu":
        _to_fmu(given, what, out, name or "", fmi, overwrite)
        return
    if to == "ros2":
        _to_ros2(controller, given.title, out, name or "controller", overwrite)
        return
    # Single precision is compared with double in a simulated run.
    if precision == "single" and not accept:
        given.needed("plant")
        given.needed("scenario")
    loop: dict[str, Any] = {"plant": given.plant, "scenario": given.scenario}
    if precision == "double" or None in loop.values():
        loop = {"plant": given.plant} if prove else {}
    if to == "st":
        options: dict[str, Any] = loop | {"accept": accept, "overwrite": overwrite}
        _to_st(controller, given.title, precision, out, name or "controller", options)
        return
    exported = c(
        controller,
        out,
        name=name or "controller",
        precision=precision,
        resolution=resolution,
        accept=accept,
        proof=prove,
        spread=spread,
        overwrite=overwrite,
        **loop,
    )
    _print(given.title, exported)
    stable = exported.stability
    if exported.proof is not None and not (
        exported.proof.proved and (stable is None or stable.stable)
    ):
        sys.exit(ExitCode.NOT_PROVED)


def _learned(controller: Any, memory: Path | None, precision: str) -> Any:
    """Return a controller with what is in a memory image, in double or in the given precision."""
    from quell.controllers import in_single_precision
    from quell.controllers.memory import HEADER, file_content

    if memory is None:
        return controller
    try:
        image = file_content(memory)
        if not hasattr(controller, "restore"):
            raise ValueError(f"{type(controller).__name__} has no memory image; leave it out")
        is_single = len(image) >= HEADER.size and HEADER.unpack_from(image)[2] == 4
        if is_single and precision == "single":
            controller = in_single_precision(controller)
        controller.restore(image)
    except ValueError as error:
        raise ValueError(f"--memory {memory}: {error}") from None
    return controller


def _to_fmu(given: Setup, what: str, out: Path, name: str, fmi: str, overwrite: bool) -> None:
    from quell.export import fmu

    controller, dt = given.controller, given.controller.dt
    part = controller if what == "controller" else given.needed("plant")
    if what == "loop":
        part = part, controller
    scenario = given.scenario
    x0 = None if what == "controller" or scenario is None else scenario.x0
    fmu(part, out, name=name, dt=dt, x0=x0, version=fmi, overwrite=overwrite)
    print_line(Console(), f"FMU of the {what}: {out}")


def _to_ros2(controller: Any, title: str, out: Path, name: str, overwrite: bool) -> None:
    from quell.export import ros2

    ros2(controller, out, name=name, overwrite=overwrite)
    print_line(Console(), f"{title}: package {name} of ROS 2 Jazzy in {out}")
    print_line(Console(), "NOT built with ROS here: run colcon build and colcon test")


def _to_st(
    controller: Any, title: str, precision: str, out: Path, name: str, options: dict[str, Any]
) -> None:
    from quell.export import st

    done = st(controller, out, name=name, precision=precision, **options)
    print_line(Console(), f"{title}: function block {name} in {out}/{name}.st")
    _print_comparison(Console(), done.comparison)
    print_line(Console(), "NOT tried on a PLC: compare a record of it with a simulated one")


def _print(title: str, exported: Exported) -> None:
    """Print what was written, the differences of the precisions, and the sizes."""
    source, folder = exported.source, exported.folder
    name = source.name
    console = Console()
    print_line(console, f"{title}: {folder}/src/{name}.h and .c, in {source.precision} precision")
    _print_comparison(console, exported.comparison)
    print_line(console, _sizes(exported))
    if exported.proof is not None:
        print_line(console, exported.proof.summary)
        for line in exported.proof.open:
            print_line(console, f"NOT proved: {line}")
        for line in [] if exported.stability is None else exported.stability.lines:
            print_line(console, line)
        print_line(console, f"Report: {folder}/proof/REPORT.md; again: {folder}/proof/prove.sh")
    print_line(console, f"Test: {folder}/test_{name}.c; how to use it: {folder}/README.md")


def _print_comparison(console: Console, comparison: Comparison | None) -> None:
    """Print what single precision changes, where it was compared."""
    for line in [] if comparison is None else _differences(comparison):
        print_line(console, line)


def _differences(found: Comparison) -> list[str]:
    """Return lines about single precision, next to the effect of the noise."""
    if found.diverged:
        return ["Single precision: the run diverges; in double precision it does not"]
    lines = []
    for each in found.signals:
        if each.single is None:
            lines.append(f"NOT compared: {each.name}, {each.reason}")
            continue
        text = f"Single precision changes {each.name} by {100 * each.single:.2g} % RMS"
        if each.noise is not None:
            text += f"; the measurement noise changes it by {100 * each.noise:.2g} %"
        lines.append(text)
    if math.isfinite(found.error + found.activity):
        lines.append(
            f"Single precision changes the RMS error of y by {100 * found.error:+.2g} %, the "
            f"activity of u by {100 * found.activity:+.2g} %"
        )
    return lines


def _sizes(exported: Exported) -> str:
    """Return a line with the sizes, or with the reason why there are none."""
    from quell.export import NoCompilerError

    try:
        sizes = exported.sizes()
    except NoCompilerError as error:
        return f"Sizes of code, state and stack: not measured, {error}"
    stack = "not measured (gcc 10 can)" if sizes.stack is None else f"{sizes.stack} B"
    return (
        f"{sizes.processor} ({sizes.compiler} -O2): code {sizes.code} B, constants "
        f"{sizes.constants} B, state {sizes.state} B, stack {stack}; without the C library"
    )


# ---- quell studio ----


def studio(
    setup: Path | None = None, *, port: Whole = 8770, browser: bool = True, trust: Trust = False
) -> None:
    """Open a page in the browser that simulates a setup while its sliders move.

    The page shows response, estimates, Bode and Nyquist diagrams and margins, tunes, compares,
    exports, and watches a running quell run-rig. It is served at this computer only, at an address
    with a random token, until Ctrl-C.

    Parameters
    ----------
    setup
        A setup file in TOML to begin with; an example by default.
    port
        TCP port; 0 takes a free one.
    browser
        Open the page in the browser; otherwise only print its address.
    """
    from quell.setup import read
    from quell.studio.messages import Granted, checked, files_of, with_models
    from quell.studio.runs import Maker
    from quell.studio.server import serve

    tables = None
    if setup is not None:
        name, data = read(setup)
        data = with_models(data)
        tables = checked(data, Granted(files_of(data), trust))
        tables.setdefault("title", name.removesuffix(".toml").replace("_", " "))
        Maker(name, trust)(tables)

    def ready(url: str) -> None:
        print(f"Studio: {url} (Ctrl-C ends it)", flush=True)
        if browser:
            import webbrowser

            webbrowser.open(url)

    serve(tables, port, ready, trust)
