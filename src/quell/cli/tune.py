"""``quell tune``.

Sources of the plant for ``quell tune`` other than a setup file: a record, or a rig.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from cyclopts import Parameter

from quell.cli.exit_codes import ExitCode, confirm
from quell.cli.identify import describe_table, frequencies_in, only_in_time
from quell.cli.options import (
    MODEL_OPTIONS,
    OUTPUTS,
    READ_OPTIONS,
    ModelOptions,
    Outputs,
    ReadOptions,
    Switch,
    Trust,
    WholeOrNone,
    options_of,
    refuse,
)
from quell.cli.output import Console, check_outputs, print_line, progress_bar, table, write_results
from quell.cli.rig import exit_code

if TYPE_CHECKING:
    from quell.commissioning import Limits, Verification
    from quell.controllers import Controller
    from quell.identification import FrequencyModel, FrequencyTable, Identified, Measured
    from quell.realtime.devices import Device
    from quell.setup import Setup
    from quell.tuning import Tuned
    from quell.tuning.plants import RecordModel

# The verifying step's length in units of 1/(frequency of the phase margin), chosen by hand.
_STEP_LENGTH = 60.0
# Safe actions for twins in this process: nothing is lost if a deadline is, as no plant moves.
_TWIN = {"hold": 10_000, "most_overruns": 10_000}


class Asked(NamedTuple):
    """How a record is read and identified."""

    dt: float | None
    read: ReadOptions
    model: ModelOptions
    order: int | None


@Parameter(name="*")
@dataclass(frozen=True)
class Works:
    """Where the loop works: limits of u, and the operating point.

    Parameters
    ----------
    u_min
        Least u, of the controller and of an experiment.
    u_max
        Largest u.
    u_rest
        u at the operating point; of a record, as its model has it at the mean of y.
    y_rest
        y there. The scenario of the tuned file begins at rest at this point, by default at zero.
    """

    u_min: float | None = None
    u_max: float | None = None
    u_rest: float | None = None
    y_rest: float | None = None

    def limits(self) -> dict[str, float]:
        """Return the limits that are given, as ``tune`` takes them."""
        known = {"u_min": self.u_min, "u_max": self.u_max}
        return {name: value for name, value in known.items() if value is not None}

    def rest(self) -> dict[str, tuple[float, float]]:
        """Return the operating point that is given, as ``tune`` takes it; refuse half of one."""
        if (self.u_rest is None) != (self.y_rest is None):
            raise ValueError("--u-rest and --y-rest: go together, they are one operating point")
        if self.u_rest is None or self.y_rest is None:
            return {}
        return {"rest": (self.u_rest, self.y_rest)}


WORKS = Works()


def of_rest(works: Works) -> dict[str, tuple[Any, Any]]:
    """Return the options of the operating point and their defaults, for ``refuse``."""
    return {"u_rest": (works.u_rest, None), "y_rest": (works.y_rest, None)}


def rest_of_model(model: Identified, y: float | None = None) -> dict[str, tuple[float, float]]:
    """Return the operating point of a model: u at the mean of y, or at ``y``."""
    import numpy as np

    y = float(np.mean(model.y)) if y is None else y
    u = -model.bias
    if not model.integrators:
        u += y * float(model.den[-1] / model.num[-1])
    return {"rest": (u, y)} if np.isfinite(u) else {}


@Parameter(name="*")
@dataclass(frozen=True)
class RigOptions:
    """An experiment at a rig, and its limits.

    Parameters
    ----------
    device
        Device for an experiment, as for quell run-rig; then no file is read.
    y_min
        Least y during the experiment; beyond it u is ramped to zero.
    y_max
        Largest y during the experiment.
    seconds
        Duration of the experiment [s].
    excite
        prbs, relay, or auto: a relay where the plant drifts.
    yes
        Start experiment and verifying step without asking.
    """

    device: str | None = None
    y_min: float | None = None
    y_max: float | None = None
    seconds: float = 30.0
    excite: Annotated[str, Parameter(name="--excite")] = "auto"
    yes: Switch = False


RIG_OPTIONS = RigOptions()


def identified(console: Console, record: Measured, asked: Asked) -> RecordModel:
    """Identify a record; print the model, and return it with the plants for tuning.

    Raises ``ValueError`` for a model with faults that no controller should be tuned for, and for
    what the record does not decide.
    """
    from rich.progress import TimeRemainingColumn

    from quell.tuning.plants import record_model

    options = vars(asked.model) | ({} if asked.order is None else {"order": asked.order})
    with progress_bar(console, "identifying", TimeRemainingColumn()) as report:
        progress = partial(report, "identifying")
        found = record_model(record, **options, progress=progress)
    print_line(console, "\n".join(found.lines))
    if found.refusal:
        raise ValueError(f"record: no plant to tune for: {found.refusal}; or give --model-order")
    return found


def from_record(
    console: Console, path: Path, asked: Asked
) -> tuple[list[Any], float, dict[str, Any], Identified]:
    """Return the plants that a record shows, its sample time, options of ``tune``, the model."""
    from quell.commissioning import measured

    read = asked.read
    record = measured(path, read.columns, asked.dt, read.time_unit, read.max_size)
    print_line(console, f"{path.name}: {record.y.size} samples, dt = {record.dt:g} s")
    found = identified(console, record, asked)
    plants, delays = found.plants
    return plants, record.dt, {"delay": delays}, found.model


def from_frequencies(
    console: Console, path: Path, table: FrequencyTable, asked: Asked
) -> tuple[list[Any], dict[str, Any], FrequencyModel]:
    """Return the plants that a table of frequencies shows, options of ``tune``, and the model."""
    from quell.identification import identify_frequencies
    from quell.tuning import identified_plants

    print_line(console, describe_table(table, path.name))
    if table.response is None:
        raise ValueError(
            f"{path.name}: has no phase, from which no controller follows; quell identify has its "
            "modes; for a controller measure size and phase from u to y, or record u and y"
        )
    if asked.dt is None:
        raise ValueError(f"{path.name}: has no sample time; give that of the controller (--dt)")
    of_time = only_in_time(asked.read, asked.model)
    refuse(of_time, "is for a record in time; this is a table of frequencies")
    found = identify_frequencies(
        table.omega,
        table.response,
        asked.order,
        asked.model.zeros,
        integrators=asked.model.integrators,
        deviation=table.deviation,
    )
    for line in str(found).splitlines():
        print_line(console, line)
    reasons = [*found.faults, *found.undecided]
    if found.is_poor:
        reasons = list(found.shortcomings)
    if reasons:
        raise ValueError(f"{path.name}: no plant to tune for: {'; '.join(reasons)}")
    print_line(
        console,
        "what hold and computing add to the phase of the table is in the delay: the loop keeps "
        "its margins with a little more",
    )
    plants, delays = identified_plants(found)
    return plants, {"delay": delays}, found


@dataclass(frozen=True)
class Rig:
    """A rig at a URL, and how it may be used."""

    url: str
    limits: Limits
    options: RigOptions
    open: Callable[[], Device]
    how: dict[str, Any]  # further arguments of ``experiment`` and ``verify``


def rig_at(options: RigOptions, at: Works, dt: float | None, trust: bool) -> Rig:
    """Return the rig of the options, all of them checked.

    Raises ``ValueError`` for limits that are missing.
    """
    from quell.commissioning import Limits
    from quell.realtime import TwinDevice, open_device

    values = {"u_min": at.u_min, "u_max": at.u_max, "y_min": options.y_min, "y_max": options.y_max}
    missing = [name for name, value in values.items() if value is None]
    missing += ["dt"] if dt is None else []
    if missing:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in missing)
        raise ValueError(f"device = {options.device!r}: an experiment also needs {flags}")
    if at.y_rest is not None:
        raise ValueError(f"--y-rest = {at.y_rest!r}: goes without --device, which is measured")
    bounds: dict[str, Any] = values
    limits = Limits(**bounds, duration=options.seconds, u_rest=at.u_rest or 0.0)
    url = str(options.device)
    first = open_device(url, float(dt or 0.0), trust)
    if isinstance(first, TwinDevice):  # it keeps its state between the parts
        return Rig(url, limits, options, lambda: first, {"safety": dict(_TWIN), "priority": 0})
    first.close()
    return Rig(url, limits, options, lambda: open_device(url, float(dt or 0.0), trust), {})


def from_rig(
    console: Console, rig: Rig, dt: float, asked: Asked, record: Path | None, overwrite: bool
) -> tuple[list[Any], float, dict[str, Any], Identified, float] | None:
    """Run the experiment; return what ``from_record`` does, and where y is; None if not wanted.

    The samples are written to the file ``record``, if any.
    """
    import numpy as np

    from quell.commissioning import experiment
    from quell.files import written_atomically

    print_line(console, f"Experiment at {rig.url}, dt = {dt:g} s: {rig.limits}.")
    print_line(console, "Beyond the limits of y, after faults and on Ctrl-C u is ramped to zero.")
    if not confirm(console, "Start it?", rig.options.yes):
        return None
    with console.status("The experiment runs."):
        done = experiment(rig.open, dt, rig.limits, kind=rig.options.excite, **rig.how)
    print_line(console, done.describe())
    u, y = done.measured.u, done.measured.y
    if record is not None:
        table = np.column_stack([np.arange(u.size) * dt, u, y])
        with written_atomically(record, overwrite) as part:
            np.savetxt(part, table, delimiter=",", header="t,u,y", comments="", fmt="%.10g")
        print_line(console, f"Record: {record}")
    found = identified(console, done.measured, asked)
    (plants, delays), model = found.plants, found.model
    last = float(done.runs[-1].record["y"][-1])
    y_now = last if model.integrators else done.y_rest
    return plants, dt, {"delay": delays}, model, y_now


def verified(
    console: Console, rig: Rig, tuned: Tuned, model: Identified, y_now: float
) -> Verification | None:
    """Run the verifying step, if it is wanted; print how it went."""
    from quell.commissioning import verify

    margins = tuned.analysis.margins
    duration = _STEP_LENGTH / margins.phase_omega
    print_line(console, f"Verifying step at {rig.url} with {tuned.design.name}, {duration:.3g} s.")
    if not confirm(console, "Apply the controller?", rig.options.yes):
        return None
    with console.status("The tuned controller runs."):
        done = verify(rig.open, tuned.controller, model, rig.limits, y_now, duration, **rig.how)
    print_line(console, done.describe())
    return done


def with_rig_table(tuned: Tuned, rig: Rig) -> Tuned:
    """Return the result with a table for the rig in its setup file."""
    limits = rig.limits
    safety = {"y_min": limits.y_min, "y_max": limits.y_max}
    table = {"device": rig.url, "safety": safety}
    return replace(tuned, setup={**tuned.setup, "rig": table})


_BOUNDS = ("m_s", "m_t", "m_ks", "damping", "noise_std", "resolution")


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

    Of a setup with a [compensator] that is tuned, and its controller stays as it is. With
    [tune.schedule], a list of operating points, the gains of the controller follow a signal. Of
    several axes, a table [[axis]] each, all bandwidths are tuned for the coupled loop.

    The plant is that of a setup file, a transfer function, one that a record shows, or that an
    experiment at a rig shows (--device). A record, or a table of frequencies, is identified first,
    and the deviations of gain, poles and delay become the set of plants. PI, PID and other
    structures are tuned under the same constraints and shown beside it. If safety ends the
    verifying step the exit code is 3.

    Parameters
    ----------
    setup
        The file, in TOML, with [plant], and [tune] for all options; docs/tuning. Or a record: a
        recording of quell run-rig (.mcap or .csv), a saved run (.nc), or a table t,u,y in text; or
        a table of frequencies with size and phase, or real and imaginary part.
    num
        Numerator of the transfer function, highest power of s first: 1 or 2,1.
    den
        Denominator: 1,3,3,1.
    dt
        Sample time [s].
    delay
        Dead time of the plant [s].
    structure
        bandwidths, poles, half-gain, half-gain-law, reduced, model-based, model-based-poles,
        delay, delay-poles, bandwidths-2, bandwidths-3, poles-2, poles-3, resonator, resonator-2,
        resonator-3, model-based-2, pi, pi-unfiltered, pid, p-pi-notch, lqg or adaptive-notch; by
        default simplest: the simplest whose objective is within 5 % of the best.
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
    from quell.commissioning import is_record
    from quell.files import check_writable
    from quell.setup.description import is_of_axes
    from quell.setup.points import has_schedule
    from quell.setup.schema import read as tables_of
    from quell.tuning.designs import range_of_u
    from quell.tuning.plants import doubts, with_known_noise

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
        if setup is not None and not (num or den or dt):
            tables = tables_of(setup)[1]
            if is_of_axes(tables):
                refuse(options_of(works, WORKS), "is for one axis, not for several")
                return _tune_axes(console, setup, options, trust, out, outputs)
            if has_schedule(tables):
                limits = works.limits()
                refuse(of_rest(works), "is the operating_point of a plant, in a setup")
                return _tune_schedule(console, setup, options, limits, trust, out, outputs)
            if "compensator" in tables:
                return _tune_compensator(console, setup, options, trust, out, outputs)
        plant, dt, options, name = _plant(setup, num, den, dt, options, works, trust)
        tuned = _tuned(console, plant, dt, options)
        return _shown(console, tuned, name, out, outputs)
    if num or den or (delay is not None) or (rig.device is not None and setup is not None):
        raise ValueError("setup: a record or --device goes without --num, --den and --delay")
    _bounds(options)
    options |= works.limits()
    place: Rig | None = None
    model: Any
    asked = Asked(dt, read, of_model, model_order)
    if rig.device is not None or setup is None:
        place = rig_at(rig, works, dt, trust)
        shown = from_rig(console, place, float(dt or 0.0), asked, save_record, outputs.overwrite)
        if shown is None:
            return ExitCode.DONE
        plant, dt, more, model, y_now = shown
        more |= rest_of_model(model, y_now)
    elif (table := frequencies_in(setup, read)) is not None:
        refuse(of_rig, "goes with --device, an experiment at a rig")
        plant, more, model = from_frequencies(console, setup, table, asked)
        more |= works.rest()
    else:
        refuse(of_rig, "goes with --device, an experiment at a rig")
        given_rest = works.rest()
        plant, dt, more, model = from_record(console, setup, asked)
        more |= given_rest or rest_of_model(model)
    options["constraints"] = with_known_noise(options["constraints"], model, range_of_u(options))
    tuned = _tuned(console, plant, float(dt or 0.0), options | more)
    tuned = replace(tuned, signals=model.signals, doubts=doubts(model))
    _print(console, tuned, rig.device or str(setup))
    step = None
    if place is not None:
        tuned = with_rig_table(tuned, place)
        step = verified(console, place, tuned, model, y_now)
    _write(console, tuned, out, outputs, {"model": model.to_json()}, step)
    return ExitCode.DONE if step is None else exit_code(step.run)


def _tune_compensator(
    console: Console,
    path: Path,
    options: dict[str, Any],
    trust: bool,
    out: Path | None,
    outputs: Outputs,
) -> int:
    """Tune the compensator of a setup; its controller stays as it is."""
    from quell.controllers.compensated import Compensated
    from quell.controllers.prefilters import without_prefilters
    from quell.setup import load, varied
    from quell.setup.loading import unchecked
    from quell.simulation import Scenario
    from quell.tuning import Constraints, tune_compensator
    from quell.tuning.tables import late_tables
    from quell.tuning.written import Written

    usable = {"m_s", "m_t", "m_ks", "delay"}
    rule = "is for a controller; of the compensator in this file m_s, m_t, m_ks and delay count"
    refuse({name: (value, None) for name, value in options.items() if name not in usable}, rule)
    setup = load(path, trust)
    plant, both = setup.needed("plant"), without_prefilters(setup.controller)
    assert isinstance(both, Compensated)
    delay = options.pop("delay", 0.0)
    bounds = Constraints(**{"m_s": 2.0, "m_t": 2.0, "damping": None} | options)

    def file_with(observer: Mapping[str, Any]) -> Setup:
        """Return the file that is written with an observer."""
        tables = varied(setup, {"observer": observer}).tables()
        return unchecked(setup.file, late_tables(tables, plant, both.dt, delay), trust)

    def loop_of(observer: Mapping[str, Any]) -> tuple[Controller, Written]:
        file = file_with(observer)
        scenario = file.scenario or Scenario(0.0, duration=both.dt)
        return file.controller, Written(file.plant, scenario, both.dt)

    with console.status("tuning the compensator"):
        how: dict[str, Any] = {"constraints": bounds, "delay": delay, "file": loop_of}
        tuned = tune_compensator(plant, both.controller, **how)
    tables = file_with(tuned.design.tables["observer"]).tables()
    return _shown(console, replace(tuned, setup=tables), setup.title, out, outputs)


def _tune_schedule(
    console: Console,
    path: Path,
    options: dict[str, Any],
    limits: dict[str, float],
    trust: bool,
    out: Path | None,
    outputs: Outputs,
) -> int:
    """Tune one controller with a schedule for the operating points of a setup."""
    from quell.setup.points import schedule_task
    from quell.tuning import tune_schedule

    task = schedule_task(path, options, trust, limits)
    with progress_bar(console, "tuning") as bar:
        progress = partial(_progress, bar)
        tuned = tune_schedule(task.plant, task.dt, progress=progress, **task.options)
    return _shown(console, tuned, task.setup.title, out, outputs)


def _tune_axes(
    console: Console,
    path: Path,
    options: dict[str, Any],
    trust: bool,
    out: Path | None,
    outputs: Outputs,
) -> int:
    """Tune the bandwidths of all axes of a setup, for the coupled loop."""
    from quell.setup.axes import axes_task
    from quell.tuning.written import Written

    usable = {"m_s", "m_t", "m_ks", "damping", "objective"}
    rule = "is for one axis; of several m_s, m_t, m_ks, damping and objective count, and [tune]"
    refuse({name: (value, None) for name, value in options.items() if name not in usable}, rule)
    setup, how = axes_task(path, options, trust)
    plant, axes = setup.needed("plant"), setup.controller
    if setup.scenario is not None:
        how["written"] = Written(plant, setup.scenario, axes.dt)
    tuned = _tuned(console, plant, None, how | {"controller": axes})
    return _shown(console, tuned, setup.title, out, outputs)


def _tuned(console: Console, plant: Any, dt: float | None, options: dict[str, Any]) -> Tuned:
    from rich.progress import TimeRemainingColumn

    from quell.tuning import tune as tuned_for

    with progress_bar(console, "tuning", TimeRemainingColumn()) as report:
        tuned = tuned_for(plant, dt, progress=partial(_progress, report), **options)
        _progress(report, "at other limits", 1.0)
        _ = tuned.tradeoff, tuned.noise_curve, tuned.judged  # kept, for what is printed
        return tuned


def _shown(console: Console, tuned: Tuned, name: str, out: Path | None, outputs: Outputs) -> int:
    """Print a result and write what is asked for; return the exit code."""
    _print(console, tuned, name)
    _write(console, tuned, out, outputs)
    return ExitCode.DONE


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
        from quell.experiments.common import save_figure

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
    from quell.setup.loading import tuning_task

    if setup is not None:
        if num or den or dt is not None:
            raise ValueError("setup: goes without --num, --den and --dt, which are in the file")
        refuse(of_rest(works), "is the operating_point of [plant], and scenario.x0, in a setup")
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
    plants = "1 plant" if tuned.count == 1 else f"{tuned.count} plants"
    axes = f", {len(tuned.axes)} axes" if len(tuned.axes) > 1 else ""
    print_line(console, f"{name}, dt = {tuned.controller.dt:g} s{axes}, {plants}")
    for line in (tuned.bounds, *tuned.noise):
        print_line(console, line)
    # With so little white space 80 columns hold all names.
    tight: dict[str, Any] = {"padding": (0, 1, 0, 0), "pad_edge": False}
    headings, entries = tuned.rows()
    headings = [each.replace("delay ", "delay\n").replace("over ", "over\n") for each in headings]
    rows = table("Optima under these constraints", *headings, **tight)
    chosen, reasons = {design.name for design in tuned.axes}, []
    for label, *cells, reason in entries:
        bold = len(entries) > len(chosen) and label in chosen
        rows.add_row(f"[bold]{label}[/]" if bold else label, *cells)
        reasons += [f"{label}: {reason}"] if reason else []
    console.print(rows)
    for line in (*reasons, *tuned.lines()):
        print_line(console, line)
    for design in tuned.axes:
        values = ", ".join(f"{key} = {value:.5g}" for key, value in design.values.items())
        print_line(console, f"{design.name}: {values}")
