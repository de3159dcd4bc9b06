"""Sources of the plant for ``quell tune`` other than a setup file: a record, or a rig."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from cyclopts import Parameter

from quell.cli.confirm import confirm
from quell.cli.options import ModelOptions, ReadOptions, Switch
from quell.cli.output import Console, print_line, progress_bar

if TYPE_CHECKING:
    from quell.commissioning import Limits, Verification
    from quell.identification import Identified, Measured
    from quell.realtime.devices.base import Device
    from quell.tuning import Tuned
    from quell.tuning.record_model import RecordModel

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
    from quell.tuning.record_model import record_model

    options = vars(asked.model) | ({} if asked.order is None else {"order": asked.order})
    with progress_bar(console, "identifying") as report:
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
    from quell.commissioning.records import measured

    read = asked.read
    record = measured(path, read.columns, asked.dt, read.time_unit, read.max_size)
    print_line(console, f"{path.name}: {record.y.size} samples, dt = {record.dt:g} s")
    found = identified(console, record, asked)
    plants, delays = found.plants
    return plants, record.dt, {"delay": delays}, found.model


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
    console: Console,
    rig: Rig,
    dt: float,
    asked: Asked,
    record: Path | None,
    overwrite: bool,
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
