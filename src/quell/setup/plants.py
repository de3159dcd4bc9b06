"""Plants from tables: the one place where a plant is made of what a user wrote.

Setup files, rigs, twins and the command line all use it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field, ValidationError

from quell import checks
from quell.plants import registry as plants
from quell.plants.base import Plant as AnyPlant
from quell.setup.build import Builder
from quell.setup.errors import SetupError, from_validation
from quell.setup.schema import CallTable, Table, call_table, one_of
from quell.setup.toml_file import immutable, parsed, read


class SignalNames(Table):
    """Names and units: ``angle [rad]``."""

    y: str = Field("", description="output.")
    u: str = Field("", description="control signal.")
    w: tuple[str, ...] = Field((), description="disturbances.")


_BESIDE = {
    "uncertain": (
        dict[str, tuple[float, float]] | None,
        Field(None, description="ranges [low, high] of its keys, for `quell tune` and sweeps."),
    ),
    "signals": (
        SignalNames | None,
        Field(
            None,
            description="names and units, `{y = 'angle [rad]', u = 'voltage [V]', w = ['load "
            "[N m]']}`, for plots, tables and files.",
        ),
    ),
}
# A plant may contain a plant: its type is a name until all tables exist.
_TYPES = {
    "plant": "Plant",
    "path": str,
    "start": dict[str, float | int | bool | str] | None,
    "parameters": dict[str, float] | None,
    "operating_point": dict[str, Any] | None,
}
PLANTS: dict[str, type[CallTable]] = {
    kind: call_table(kind, function, types=_TYPES, beside=_BESIDE)
    for kind, function in plants.PLANTS.items()
}
if TYPE_CHECKING:
    Plant = CallTable
else:
    Plant: Any = one_of(PLANTS)
for _model in PLANTS.values():
    _model.model_rebuild(_types_namespace={"Plant": Plant})


# Keys of plants that name a file, by kind.
_FILES = {"python": "source", "identified": "path", "fmu": "path"}


class _File(Table):
    plant: Plant


def plant_of(
    table: Mapping[str, Any] | str, dt: float, *, name: str = "plant", trust: bool = False
) -> AnyPlant:
    """Return the plant that a table describes, as ``[plant]`` of a setup file does.

    Parameters
    ----------
    table
        ``{"kind": "two-mass", "m1": 2.0}``, with a name of ``PLANTS`` and its keys; or the name.
    dt
        sample time of the loop [s], for delays.
    name
        of the file, for messages.
    trust
        whether Python files that the table names may be run.

    Raises
    ------
    SetupError
        with a line for each error.

    Examples
    --------
    >>> plant_of({"kind": "linear", "num": [50.0], "den": [1.0, 22.0, 40.0, 0.0]}, dt=1e-3).order
    3
    """
    values = immutable({"plant": table})
    try:
        found = _File.model_validate(values)
    except ValidationError as error:
        raise from_validation(name, error, values) from None
    builder = Builder(name, trust)
    dt = builder.attempt("", (), checks.positive, "dt", dt, "s")
    made: AnyPlant = builder.build(found.plant, "plant", dt=dt)
    return made


def contents_of(tables: Any) -> Iterator[tuple[str, str]]:
    """Yield the files that plants in some tables are made of, and hashes of their contents."""
    if isinstance(tables, Mapping):
        key = _FILES.get(str(tables.get("kind")))
        text = tables.get(key) if key else None
        if isinstance(text, str):
            with suppress(OSError):
                content = Path(text.rpartition(":")[0] if key == "source" else text).read_bytes()
                yield text, hashlib.sha256(content).hexdigest()
    if isinstance(tables, Mapping | list | tuple):
        for part in tables.values() if isinstance(tables, Mapping) else tables:
            yield from contents_of(part)


def plant_given(text: str, dt: float, *, argument: str = "plant", trust: bool = False) -> AnyPlant:
    """Return the plant that a text on the command line stands for.

    Parameters
    ----------
    text
        one of

        * the name of a plant: ``torsional``,
        * a setup file with a table ``[plant]``: ``setup.toml``,
        * a file of ``quell identify --json``: ``model.json``,
        * an FMU: ``motor.fmu``,
        * a Python function that returns a plant: ``motor.py:motor``, only with ``trust``,
        * the table itself: ``{kind = "linear", num = [1.0], den = [1.0, 1.0]}``.
    dt
        sample time [s].
    argument
        what messages call the text.
    trust
        as for ``plant_of``.

    Raises
    ------
    ValueError
        for any other text, and as ``plant_of``.
    """
    table: Any = text
    name, suffix = argument, Path(text).suffix
    if text.lstrip().startswith("{"):
        table = parsed(argument, f"plant = {text}").get("plant")
    elif suffix == ".toml":
        name, data = read(text)
        if "plant" not in data:
            raise SetupError([f"{name}: plant: missing; give a table [plant]"])
        table = data["plant"]
    elif suffix in (".json", ".fmu"):
        table = {"kind": "identified" if suffix == ".json" else "fmu", "path": text}
    elif ".py:" in text:
        table = {"kind": "python", "source": text}
    elif text not in PLANTS:
        raise ValueError(
            f"{argument} = {text!r}: must be one of {', '.join(plants.TESTBEDS)}, a setup file "
            "(.toml), an identified model (.json), an FMU (.fmu), file.py:name, or a table "
            "{kind = ...}"
        )
    return plant_of(table, dt, name=name, trust=trust)
