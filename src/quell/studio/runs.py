"""A run of a setup and the analysis of its loop, as frames for the page."""

from __future__ import annotations

import math
import pprint
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from quell import checks
from quell.analysis import LoopAnalysis, analyse
from quell.analysis.margins import Margins
from quell.controllers.axes import Axes
from quell.kernels.cache import compile_time
from quell.plants.base import PlantWrapper
from quell.plants.linearise import held_at, linear_model, linear_part
from quell.plants.nonlinear import NonlinearPlant
from quell.records.metrics import worsened
from quell.records.record import describe
from quell.records.trajectory import Trajectory
from quell.setup import made
from quell.setup.description import is_of_axes, parsed
from quell.setup.loading import Known, Setup
from quell.simulation import simulate
from quell.studio import messages
from quell.tuning.report import toml_text
from quell.types import Vector

NAME = "studio"
"""Stands for the name of the file in messages about a setup."""

LONGEST = 20.0
"""Longest time of a run, of all runs of a band, and of any task of a large setup, without what is
compiled [s]; chosen by hand: a run of the longest duration takes 0.3 s, with a large learner
some seconds."""
_CHANNELS = ("r", "y", "u", "f_hat", "f_learned", "authority")
_MARGIN_FREQUENCIES = 400  # of the Bode diagram, chosen by hand: a point for each second pixel


Stale = Callable[[], bool]
Report = Callable[[str, float], None]


class StoppedError(Exception):
    """The run was stopped: a newer message came, or the page is gone."""


def stoppable(report: Report, stale: Stale) -> Report:
    """Return a report of progress that ends the work when nobody waits for it."""

    def progress(part: str, share: float) -> None:
        if stale():
            raise StoppedError
        report(part, share)

    return progress


_CATCHING = threading.Lock()  # Python's filters of warnings belong to all threads


@contextmanager
def caught_warnings() -> Iterator[list[str]]:
    """Yield a list that has the texts of all warnings at the end, each once."""
    texts: list[str] = []
    with _CATCHING, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield texts
        texts += sorted({" ".join(str(each.message).split()) for each in caught})


class Maker:
    """Builds setups from tables, and builds again only what changed since the last one.

    ``warnings`` has the texts of the warnings of the last setup.
    """

    def __init__(self, name: str = NAME, trust: bool = False) -> None:
        self.name, self.trust = name, trust
        self.warnings: list[str] = []
        self._known: Known = {}

    def __call__(self, tables: Mapping[str, Any]) -> Setup:
        """Return the setup; raise a ``SetupError`` for tables that do not fit."""
        with caught_warnings() as self.warnings:
            setup = made(self.name, tables, self.trust, self._known)
        if self.warnings:
            self._known = {}  # what is not built again would not warn again
        for table in ("plant", "scenario"):
            setup.needed(table)
        return setup


def run_frames(
    setup: Setup,
    columns: int,
    about: Mapping[str, Any],
    stale: Callable[[], bool],
    design_warnings: Sequence[str] = (),
    axis: int = 0,
    told: dict[str, dict[str, Any]] | None = None,
) -> Iterator[bytes]:
    """Yield two frames for a setup: the run, and the analysis of its loop.

    Of several axes they have one, with the control signals of all actuators, and its loop with all
    other loops closed.

    Parameters
    ----------
    setup
        with plant and scenario.
    columns
        pixels across a plot; a curve gets two points for each.
    about
        added to the headers.
    stale
        returns whether nobody waits for the result any more; ``StoppedError`` is raised then.
    design_warnings
        warnings of the setup, which stand before those of the run.
    axis
        number of the axis, from 0, of a setup of several.
    told
        gets the measures of the frames for a verdict: ``loop``, and ``run.0`` of the first window.
    """
    began, compiled = time.perf_counter(), compile_time.seconds
    plant, scenario = setup.needed("plant"), setup.needed("scenario")
    with caught_warnings() as caught:
        whole = simulate(plant, setup.controller, scenario, progress=watched(stale))
    run, actuators = whole, {}
    if whole.axis_names:
        run = whole.axis(checks.whole("axis", axis, 0, len(whole.axis_names) - 1))
        actuators = {f"u_{k + 1}": u for k, u in enumerate(whole["u"].T)}
    header: dict[str, Any] = {
        "kind": "run",
        "plant": run.plant,
        "status": int(run.status),
        "diverged": bool(run.lost),
        "ran_away": bool(run.lost and not run.diverged),
        "message": run.message if run.status else "",
        "warnings": [*design_warnings, *caught],
        "metrics": _metrics(run, setup),
        "signals": {"y": str(run.signals.y), "u": str(run.signals.u)},
        "units": {name: describe(name, run.signals)[1] for name in _CHANNELS},
        "seconds": time.perf_counter() - began,
        "compiled": compile_time.seconds - compiled,
        "axes": list(getattr(whole, "axis_names", ())),
    }
    yield messages.frame(header | dict(about), _curves(run, columns, actuators))
    if told is not None:
        told |= {f"run.{i}": dict(each) for i, each in enumerate(header["metrics"])}
    if stale():
        raise StoppedError
    began = time.perf_counter()
    try:
        if isinstance(setup.controller, Axes):
            numbers, curves = _analysis_of_axis(setup, axis)
        else:
            numbers, curves = _analysis(loop_of(setup))
    except (ValueError, ArithmeticError) as error:
        numbers, curves = {"reason": " ".join(str(error).split())}, {}
    if told is not None:
        told["loop"] = dict(numbers)
    more = {"kind": "loop", "loop": numbers, "seconds": time.perf_counter() - began}
    yield messages.frame(more | dict(about), curves)


def loop_of(setup: Setup) -> LoopAnalysis:
    """Return the analysis of the loop of a setup: the linear part of its plant."""
    plant, delay = linear_of(setup)
    return analyse(plant, setup.controller, delay=delay)


def linear_of(setup: Setup) -> tuple[Any, float]:
    """Return the linear part of the plant of a setup, and the delay [s] of its input."""
    plant, delay = linear_part(linear_model(setup.plant), float(setup.controller.dt))
    return plant, delay + delay_beside(setup)


def delay_beside(setup: Setup) -> float:
    """Return the delay [s] of u that the plant of a setup has beside its part ``linear``."""
    return float(setup.controller.dt) * int(getattr(setup.plant, "late", 0) or 0)


def watched(stale: Callable[[], bool]) -> Callable[[float], None]:
    """Return a callback for progress that ends a run which takes too long or is not needed."""
    began: list[float] = []

    def progress(_: float) -> None:
        now = time.monotonic()
        if not began:  # what compiles does so before the first call
            began.append(now)
        if stale():
            raise StoppedError
        if now - began[0] > LONGEST:
            raise ValueError(
                f"the run took more than {LONGEST:g} s: shorten scenario.duration, or take a "
                "smaller learner"
            )

    return progress


def _curves(run: Trajectory, columns: int, actuators: Mapping[str, Vector]) -> dict[str, Vector]:
    """Return the curves of a run for a plot of some columns of pixels.

    The control signals of ``actuators`` stand in place of u, if there are any.
    """
    names = [name for name in _CHANNELS if name in run.names and not (actuators and name == "u")]
    t = np.asarray(run.t, dtype=np.float64)
    cut = messages.Columns(len(run), columns)
    curves = {name: run[name] for name in names} | dict(actuators)
    return {"t": cut.times(t)} | {name: cut.points(each) for name, each in curves.items()}


def _metrics(run: Trajectory, setup: Setup) -> list[dict[str, Any]]:
    """Return the metrics of the windows of a setup; of the whole run by default."""
    found = []
    for window in setup.windows or ({},):
        try:
            numbers = run.metrics(**window)
        except ValueError as error:
            found.append({**window, "reason": " ".join(str(error).split())})
            continue
        found.append({**window, **dict(numbers), "missing": dict(numbers.missing)})
    return found


def _analysis_of_axis(setup: Setup, axis: int) -> tuple[dict[str, Any], dict[str, Vector]]:
    """Return the numbers and the curves of the loop of an axis, the others closed.

    A nonlinear plant is linearised at the start of the scenario, under the control signals that
    hold it there; it has no margins if none do.
    """
    plant: Any = setup.needed("plant")
    controller: Any = setup.controller
    scenario = setup.needed("scenario")
    inner = plant
    while isinstance(inner, PlantWrapper):
        inner = inner.plant
    point = None
    if isinstance(inner, NonlinearPlant):
        start = np.zeros(plant.order) if scenario.x0 is None else np.asarray(scenario.x0)
        point = held_at(plant, start[: inner.order])
    loop = analyse(plant, controller, point)
    name = controller.names[axis]
    omega = _shown(loop.omega[1:], loop.dt)
    S = loop.response("S_o", omega)[:, axis, axis]
    curves = _diagrams(omega, 1.0 / S - 1.0, S)
    numbers: dict[str, Any] = {"stable": loop.stable}
    numbers["largest_pole"] = max(abs(each.z) for each in loop.poles)
    numbers["remark"] = " ".join(filter(None, [loop.note, loop.remark]))
    if loop.stable:
        numbers |= _margins(loop.channel_margins(name))
        numbers["gains_at_once"] = list(loop.disk_margin("inputs").gain)
    return numbers, curves


def _shown(omega: Vector, dt: float) -> Vector:
    """Return the frequencies [rad/s] of a plot.

    At half the sampling rate L is real, and its phase jumps: the curves end just below.
    """
    omega = omega[omega < 0.97 * math.pi / dt]
    return omega[:: max(1, math.ceil(omega.size / _MARGIN_FREQUENCIES))]


def _diagrams(omega: Vector, L: Any, S: Any) -> dict[str, Vector]:
    """Return the curves of an open loop and its sensitivity.

    The phase starts within one turn, so that the curve of one design lies on that of another.
    """
    phase = np.degrees(np.unwrap(np.angle(L)))
    with np.errstate(divide="ignore"):
        return {
            "omega": omega,
            "gain": 20.0 * np.log10(np.abs(L)),
            "phase": phase - math.floor((float(phase[0]) + 360.0) / 360.0) * 360.0,
            "S": 20.0 * np.log10(np.abs(S)),
            "T": 20.0 * np.log10(np.abs(L * S)),
            "re": np.real(L),
            "im": np.imag(L),
        }


def _margins(m: Margins) -> dict[str, Any]:
    """Return the margins of a loop for the header of a frame."""
    return {
        "m_s": 1.0 / m.modulus,
        "m_s_omega": m.modulus_omega,
        "gain_margin": list(m.gain),
        "phase_margin": m.phase,
        "phase_omega": m.phase_omega,
        "delay_margin": m.delay,
        "disk_margin": m.disk,
    }


def _analysis(loop: LoopAnalysis) -> tuple[dict[str, Any], dict[str, Vector]]:
    """Return the numbers and the curves of a loop."""
    omega = _shown(loop.omega, loop.dt)
    L = loop.response("L", omega)
    curves = _diagrams(omega, L, 1.0 / (1.0 + L))
    largest = float(np.abs(loop.poles).max())
    numbers: dict[str, Any] = {"stable": loop.stable, "largest_pole": largest}
    if loop.stable:
        numbers |= _margins(loop.margins) | {
            "m_t": 10.0 ** (0.05 * float(np.max(curves["T"]))),
            "b_range": list(loop.b_range),
            "b_over_b0": loop.b_over_b0,
            "noise_to_control": loop.noise_to_control,
        }
    return numbers, curves


def verdict(
    before: Mapping[str, Mapping[str, Any]], now: Mapping[str, Mapping[str, Any]]
) -> list[dict[str, str]]:
    """Return what of a design is worse than of the one before: key and text of each number.

    ``before`` and ``now`` are what ``run_frames`` told of both.
    """
    found = []
    for part, own in now.items():
        old = before.get(part, {})
        if part == "loop" and not own.get("stable"):
            if old.get("stable") and "reason" not in own:
                found.append({"key": "loop.stable", "text": "the loop, which is unstable"})
            continue
        where = ""
        if part != "loop" and len(now) > 2:
            where = f" (from {own.get('start', 0.0):g} s on)"
        for each in worsened(_numbers(old), _numbers(own)):
            key = each.name.replace("gain_reduction", "gain_margin")
            found.append({"key": f"{part}.{key}", "text": each.text + where})
    return found


def _numbers(told: Mapping[str, Any]) -> dict[str, Any]:
    """Return the single numbers among measures, with both gain margins apart."""
    found = {name: each for name, each in told.items() if isinstance(each, int | float)}
    if "gain_margin" in told:
        low, high = told["gain_margin"]
        found |= {"gain_margin": high, "gain_reduction": math.inf if low == 0.0 else 1.0 / low}
    return found


_SCRIPT = '''"""{title}: simulated, analysed and drawn."""

import matplotlib.pyplot as plt

import quell as ql

setup = ql.setup.made("{name}", {tables})
run = ql.simulate(setup.plant, setup.controller, setup.scenario)
print(run.metrics())
print(ql.analysis.analyse({plant}, setup.controller{delay}).summary())
run.plot()
plt.show()
'''


_SCRIPT_OF_AXES = '''"""{title}: simulated and drawn."""

import matplotlib.pyplot as plt

import quell as ql

setup = ql.setup.made("{name}", {tables})
run = ql.simulate(setup.plant, setup.controller, setup.scenario)
for axis, metrics in run.metrics().items():
    print(axis, metrics)
run.plot()
plt.show()
'''


def toml_of(tables: Mapping[str, Any]) -> str:
    """Return the tables as a setup file."""
    return toml_text(_without_none(tables))


def python_of(tables: Mapping[str, Any], title: str, is_whole: bool, delay: float) -> str:
    """Return a script that builds the same objects, runs them and draws the run.

    A plant that ``is_whole`` is analysed as it is, others by their part ``linear`` and a ``delay``
    [s].
    """
    literal = pprint.pformat(_without_none(tables), indent=1, width=92, sort_dicts=False)
    if is_of_axes(tables):
        about = _in_docstring(title) or "A setup"
        return _SCRIPT_OF_AXES.format(title=about, name=NAME, tables=literal)
    return _SCRIPT.format(
        title=_in_docstring(title) or "A setup",
        name=NAME,
        tables=literal,
        plant="setup.plant" if is_whole else "setup.plant.linear",
        delay="" if delay == 0.0 else f", delay={delay!r}",
    )


def _in_docstring(title: str) -> str:
    """Return a title for the first line of a script: without quotes and control characters."""
    plain = "".join(each if each.isprintable() else " " for each in title)
    return " ".join(plain.replace('"', "'").replace("\\", "/").split())


def tables_of_text(text: Any, granted: messages.Granted, models: Any = None) -> dict[str, Any]:
    """Return the tables of the text of a setup file; raise a ``SetupError`` or ``ValueError``.

    ``models`` has the texts of files of identified models by name.
    """
    if not isinstance(text, str) or len(text) > messages.MOST_BYTES:
        raise ValueError(
            f"text: must be the content of a TOML file, at most {messages.MOST_BYTES} bytes"
        )
    texts = models or {}
    if not isinstance(texts, Mapping) or not all(isinstance(each, str) for each in texts.values()):
        raise ValueError("models: must be texts of files by name")
    tables = parsed(NAME, text)
    if not messages.files_of(tables) <= granted.files:
        tables = messages.with_models(tables, texts)
    return messages.checked(tables, granted)


def _without_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_none(part) for key, part in value.items() if part is not None}
    if isinstance(value, list | tuple):
        return [_without_none(part) for part in value]
    return value
