"""Long tasks of the page: tuning, comparison with tuned PID and LQG, runs over a set of plants.

Exported controllers as files that the browser saves: C files in a ZIP archive, and FMUs.

They are what ``quell export`` writes. The files are made in a temporary folder, which is removed.

Tasks that messages of the page ask for: iterators of frames that run in a thread.
"""

from __future__ import annotations

import dataclasses
import io
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.axes import Axes
from quell.controllers.prefilters import without_prefilters
from quell.experiments.compare import tuned as tuned_references
from quell.setup.loading import Setup
from quell.simulation import simulate
from quell.studio.messages import Columns, Granted, columns, file_frame, frame, number, setup_tables
from quell.studio.records import PageRecord, record_frames
from quell.studio.runs import (
    Maker,
    Report,
    Stale,
    StoppedError,
    delay_beside,
    python_of,
    run_frames,
    stoppable,
    tables_of_text,
    toml_of,
    verdict,
    watched,
)
from quell.tuning import Constraints, tune
from quell.tuning.designs import SIMPLEST
from quell.tuning.structures.registry import FEEDING_FORWARD
from quell.tuning.written import Written

# ---- Long tasks of the page ----

# Structures that a page may ask for, and the bounds of M_s in the trade-off. Chosen by hand.
STRUCTURES = (
    *(SIMPLEST, "poles", "bandwidths", "model-based", "model-based-poles"),
    *("p-pi-notch", "pid", "pi"),
)
_TRADEOFF = (1.2, 1.3, 1.4, 1.6, 1.8, 2.0)
_COMPARED = {"tuned-pid": "PID", "tuned-lqg": "LQG"}
_LIMITS = ("u_min", "u_max", "rate_limit")
_WITH_OPTIONS = re.compile(r" \(--[^)]*\)")  # in a text for the command line
# Plants of a band, and the most that their parameters change [%]. Chosen by hand: 24 runs take a
# quarter of a second.
_PLANTS, _MOST_PERCENT = 24, 50.0
# Keys that do not change: whole numbers, or lists with some; delays, which must be whole samples;
# weights of the measurement; and where a plant starts or is linearised.
_EXACT = (
    *("counts", "dac_bits", "late", "order", "substeps", "max_size", "cogging", "delay"),
    *("kind", "uncertain", "c1", "c2", "start", "operating_point", "sensor", "loads"),
)


def tuned_frames(
    setup: Setup,
    record: PageRecord,
    message: Mapping[str, Any],
    stale: Stale,
    report: Report,
    make: Maker,
) -> Iterator[bytes]:
    """Yield the tuned controller's tables, and then the trade-off between M_s and load rejection.

    In between are run and loop of the setup as it was and of the tuned one, and a verdict: what
    of the tuned one is worse.

    The message has ``structure``, ``m_s``, ``m_t`` and, if noise is bounded, ``m_ks``, or the noise
    of y: ``noise_std`` and ``resolution``. A controller that feeds forward is tuned with the
    feedforward of the plant's model, or with its own model's.
    """
    structure = checks.one_of("structure", message.get("structure", SIMPLEST), STRUCTURES)
    bounds = _bounds(message)
    dt = float(setup.controller.dt)
    plant, delay = record.plants(setup, message)
    options: dict[str, Any] = {"delay": delay, "progress": stoppable(report, stale)}
    limits = _limits(setup)
    bounds = record.with_noise(bounds, limits, setup, message)
    first: dict[str, Any] = {"structure": structure, "constraints": bounds, **limits}
    first |= {"compare": None if structure == SIMPLEST else (), "in_use": setup.controller}
    given = getattr(without_prefilters(setup.controller), "feedforward", False)
    if structure in (SIMPLEST, *FEEDING_FORWARD):
        first["feedforward"] = given or None
    file: Any = True
    if setup.plant is not None and setup.scenario is not None:
        file = Written(setup.plant, setup.scenario, dt)
    best = tune(plant, dt, written=file, **first, **options)
    design = best.design
    structure = next(name for name, each in best.designs.items() if each is design)
    tables = setup.tables() | {key: dict(table) for key, table in best.tables.items()}
    if limits:
        tables["controller"] = tables["controller"] | limits
    if "observer" not in design.tables:
        for key in ("observer", "learner", "guard"):
            tables.pop(key, None)
    yield frame(
        {
            "kind": "tuned",
            "id": message["id"],
            "setup": tables,
            "name": design.name,
            "values": dict(design.values),
            "measures": dict(design.measures),
            "k_i": design.k_i,
            "active": list(best.active),
            "constraints": str(best.constraints),
            "noise_bound": _WITH_OPTIONS.sub("", best.noise_bound),
            "step": _sentence("; ".join(str(best.judged or "").splitlines())),
            "plants": len(best.plants.plants),
        }
    )
    wide = columns(message)
    told: list[dict[str, dict[str, Any]]] = [{}, {}]
    pairs = zip(told, (("before tuning", setup), ("tuned", make(tables))), strict=True)
    for numbers, (pin, each) in pairs:
        yield from run_frames(each, wide, {"id": message["id"], "pin": pin}, stale, told=numbers)
    yield frame({"kind": "verdict", "id": message["id"], "worse": verdict(*told)})
    for at in sorted({*_TRADEOFF, bounds.m_s or _TRADEOFF[0]}):
        other = dataclasses.replace(best.constraints, m_s=at)
        try:
            one = tune(plant, dt, structure=structure, constraints=other, compare=(), **options)
        except ValueError:
            continue  # no loop satisfies these bounds: the curve has no point there
        point = {"m_s": at, "k_i": one.design.k_i, "iae": one.design.measures.get("iae")}
        yield frame({"kind": "tradeoff", "id": message["id"], **point})


def compared_frames(
    setup: Setup, record: PageRecord, message: Mapping[str, Any], stale: Stale, report: Report
) -> Iterator[bytes]:
    """Yield runs and loops of PID and LQG controllers that were tuned for the same plant.

    The bounds ``m_s``, ``m_t`` and ``m_ks`` are the message's.
    """
    bounds = _bounds(message)
    wide, dt = columns(message), float(setup.controller.dt)
    plant, delay = record.plants(setup, message)
    entries, _ = tuned_references(
        plant,
        dt,
        tuple(_COMPARED),
        bounds,
        limits=_limits(setup),
        delay=delay,
        progress=stoppable(report, stale),
    )
    for name, entry in entries.items():
        label = _COMPARED[name]
        if entry.controller is None:
            text = f"{label}: {entry.reason}"
            yield frame({"kind": "note", "id": message["id"], "text": text})
            continue
        other = dataclasses.replace(setup, controller=entry.controller)
        about = {"id": message["id"], "pin": label, "values": dict(entry.values)}
        yield from run_frames(other, wide, about, stale)


def band_frames(
    setup: Setup, tables: Mapping[str, Any], message: Mapping[str, Any], stale: Stale
) -> Iterator[bytes]:
    """Yield the range of y and u over plants whose parameters differ by up to ``percent``.

    Ranges ``plant.uncertain`` of the setup are used in place of the percentage, if it has them.
    """
    percent = number(message, "percent", 20.0, 0.0, _MOST_PERCENT)
    make, wide, scenario = Maker(trust=setup.trust), columns(message), setup.needed("scenario")
    random = np.random.default_rng(0)
    ranges = tables["plant"].get("uncertain") if isinstance(tables["plant"], dict) else None
    found: dict[str, list[Any]] = {"y": [], "u": []}
    cut, t = None, np.zeros(0)
    diverged, progress = 0, watched(stale)
    for _ in range(_PLANTS):
        if stale():
            raise StoppedError
        other = {**tables, "plant": varied(tables["plant"], percent, ranges, random)}
        plant = make(other).needed("plant")
        run = simulate(plant, setup.controller, scenario, progress=progress)
        if run.lost:
            diverged += 1
            continue
        if cut is None:
            cut = Columns(len(run), wide)
            t = cut.times(np.asarray(run.t, dtype=np.float64))
        for name, ends in found.items():
            ends.append((cut.low(run[name]), cut.high(run[name])))
    curves = {"t": t}
    for name, ends in found.items():
        if ends:
            curves[f"{name}_low"] = np.min([low for low, _ in ends], axis=0)
            curves[f"{name}_high"] = np.max([high for _, high in ends], axis=0)
    about = {"plants": _PLANTS, "diverged": diverged, "percent": percent}
    yield frame({"kind": "band", "id": message["id"], **about}, curves)


def varied(plant: Any, percent: float, ranges: Any, random: np.random.Generator) -> Any:
    """Return the table of a plant with other parameters."""

    def other(value: Any) -> Any:
        if isinstance(value, float | int) and not isinstance(value, bool):
            return float(value) * (1.0 + 0.01 * percent * random.uniform(-1.0, 1.0))
        if isinstance(value, list | tuple):
            return [other(part) for part in value]
        if isinstance(value, Mapping):  # parameters of a Python function
            return {key: other(part) for key, part in value.items()}
        return value

    if not isinstance(plant, Mapping):
        return plant
    table = dict(plant)
    if ranges:
        return table | {
            key: float(random.uniform(low, high)) for key, (low, high) in ranges.items()
        }
    for key, value in plant.items():
        if key == "plant":
            table[key] = varied(value, percent, None, random)
        elif key not in _EXACT:
            table[key] = other(value)
    return table


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _limits(setup: Setup) -> dict[str, Any]:
    """Return the limits of u of the setup's controller."""
    table = setup.tables().get("controller", {})
    given = table if isinstance(table, Mapping) else {}
    return {key: given[key] for key in _LIMITS if given.get(key) is not None}


def _bounds(message: Mapping[str, Any]) -> Constraints:
    """Return the constraints that a message asks for."""
    m_ks = None if message.get("m_ks") is None else number(message, "m_ks", 1.0, 1e-9, 1e12)
    m_s, m_t = (number(message, name, 1.6, 1.05, 5.0) for name in ("m_s", "m_t"))
    noise = {
        name: number(message, name, 0.0, 1e-15, 1e12)
        for name in ("noise_std", "resolution")
        if message.get(name) is not None
    }
    return Constraints(m_s=m_s, m_t=m_t, m_ks=m_ks, **noise)


# ---- Exported controllers as files that the browser saves ----

C_NAME = "controller"
"""Begins the names of the files and functions, as by default on the command line."""

# The least date that a ZIP archive can have: the same setup gives the same bytes.
_DATE = (1980, 1, 1, 0, 0, 0)


def exported(setup: Setup, message: Mapping[str, Any]) -> tuple[str, bytes]:
    """Return name and content of the file that a message asks for with ``to`` and ``precision``."""
    to = checks.one_of("to", message.get("to"), ("c", "fmu"))
    precision = checks.one_of("precision", message.get("precision", "double"), ("double", "single"))
    with TemporaryDirectory(prefix="quell-studio-") as folder:
        if to == "fmu":
            return _fmu(setup, Path(folder))
        return _c(setup, Path(folder) / C_NAME, precision)


def _fmu(setup: Setup, folder: Path) -> tuple[str, bytes]:
    from quell.export import fmu

    path = folder / f"{C_NAME}.fmu"
    fmu(setup.controller, path, dt=setup.controller.dt)
    return path.name, path.read_bytes()


def _c(setup: Setup, folder: Path, precision: str) -> tuple[str, bytes]:
    from quell.export import c

    # Single precision is compared with double in a run.
    run: dict[str, Any] = {}
    if precision == "single":
        run = {"plant": setup.plant, "scenario": setup.scenario}
    found = c(setup.controller, folder, name=C_NAME, precision=precision, **run)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
        for path in sorted(found.files):
            name = f"{C_NAME}/{path.relative_to(folder).as_posix()}"
            entry = zipfile.ZipInfo(name, _DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            packed.writestr(entry, path.read_bytes())
    return f"{C_NAME}.zip", archive.getvalue()


# ---- Tasks that messages of the page ask for ----

_OF_ONE_AXIS = {
    "band": "the band of uncertain plants is drawn for one axis",
    "compare": "the comparison with PID and LQG is of one axis",
    "tune": "the page tunes one axis; choose omega_c and omega_o by the margins of each axis",
}

LONG = ("compare", "tune", "export", "record")
"""Tasks that take seconds: they have a thread of their own, so that sliders go on moving."""


def frames_for(
    message: Mapping[str, Any],
    make: Maker,
    granted: Granted,
    record: PageRecord,
    stale: Callable[[], bool],
    report: Callable[[str, float], None],
) -> Iterator[bytes]:
    """Yield the frames that answer a message of ``messages.parsed``.

    Raises
    ------
    ValueError
        for a message that asks for what cannot be.
    StoppedError
        if ``stale`` returns that nobody waits any more.
    """
    task, about = message["do"], {"id": message["id"]}
    if task == "open":
        tables = tables_of_text(message.get("text"), granted, message.get("models"))
        make(tables)
        yield frame({"kind": "opened", "setup": tables, **about})
        return
    if task == "record":
        yield from record_frames(record, message, stale, report)
        return
    tables = setup_tables(message, granted)
    setup = make(tables)
    if isinstance(setup.controller, Axes) and task in _OF_ONE_AXIS:
        raise ValueError(f"NOT for several axes: {_OF_ONE_AXIS[task]}")
    if task == "run":
        axis = checks.whole("axis", message.get("axis", 0), 0)
        yield from run_frames(setup, columns(message), about, stale, make.warnings, axis)
    elif task == "band":
        yield from band_frames(setup, tables, message, stale)
    elif task in ("compare", "tune"):
        if task == "compare":
            yield from compared_frames(setup, record, message, stale, report)
        else:
            yield from tuned_frames(setup, record, message, stale, report, make)
        yield frame({"kind": "done", **about})
    elif task == "export":
        name, content = exported(setup, message)
        yield file_frame({"kind": "file", "name": name, **about}, content)
    else:
        is_whole = not hasattr(setup.plant, "linear")
        delay = 0.0 if isinstance(setup.controller, Axes) else delay_beside(setup)
        script = python_of(tables, setup.title, is_whole, delay)
        yield frame({"kind": "texts", "toml": toml_of(tables), "python": script, **about})
