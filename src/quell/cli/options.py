"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, Token

from quell.files import MAX_SIZE


def whole_number(kind: Any, tokens: Sequence[Token]) -> int:
    """Return the whole number in an option; the parser's own conversion would round 1.5 to 2."""
    text = tokens[0].value
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"{tokens[0].keyword} = {text!r}: must be a whole number") from None


Whole = Annotated[int, Parameter(converter=whole_number)]
WholeOrNone = Annotated[int | None, Parameter(converter=whole_number)]
Trust = Annotated[
    bool,
    Parameter(
        negative="",
        help="Run the Python file that a plant names (file.py:name), with all your rights.",
    ),
]
MaxSize = Annotated[
    float,
    Parameter(name="--max-size", help="Limit of what the file that is read may unpack to [MB]."),
]
Switch = Annotated[bool, Parameter(negative="")]
Overwrite = Annotated[
    bool, Parameter(negative="", help="Replace files that exist; they are refused otherwise.")
]


def options_of(given: Any, default: Any) -> dict[str, tuple[Any, Any]]:
    """Return the options of a group by name, each with its value and its default."""
    return {name: (value, getattr(default, name)) for name, value in vars(given).items()}


def refuse(options: Mapping[str, tuple[Any, Any]], rule: str) -> None:
    """Raise ``ValueError`` for options that would have no effect and are not at their defaults.

    ``options`` are pairs of value and default by name; ``rule`` says what they go with.
    """
    names = [name for name, (value, default) in options.items() if value != default]
    if names:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in names)
        raise ValueError(f"{flags}: {rule}")


FIGURES = Path("quell-figures")
"""Folder for figures if none is named; if it exists, the new one gets a number."""


@Parameter(name="*")
@dataclass(frozen=True)
class ResultOutputs:
    """The file that a command writes which draws nothing.

    Parameters
    ----------
    json
        Write the results to this file, for programs.
    """

    json: Annotated[Path | None, Parameter(name="--json")] = None
    overwrite: Overwrite = False


@Parameter(name="*")
@dataclass(frozen=True)
class Outputs(ResultOutputs):
    """Files that a command writes.

    Parameters
    ----------
    json
        Write all results and settings to this file, for programs.
    figures
        Put the figures into this folder, as PNG, SVG and PDF; by default into quell-figures, or
        quell-figures-2 and so on if that exists.
    """

    figures: Annotated[Path | None, Parameter(negative_none="no-", show_default=False)] = FIGURES


@Parameter(name="*")
@dataclass(frozen=True)
class RunOutputs(Outputs):
    """Files that a command writes which runs a setup.

    Parameters
    ----------
    json
        Write metrics, events and settings to this file, for programs.
    figures
        Put the figures into this folder, as PNG, SVG and PDF; by default into quell-figures, or
        quell-figures-2 and so on if that exists.
    save
        Write the whole record to this file. One that ends in .nc is NetCDF, which `Trajectory.load`
        reads; one in .csv is text with names and units.
    """

    save: Path | None = None


RESULT_OUTPUTS, OUTPUTS, RUN_OUTPUTS = ResultOutputs(), Outputs(), RunOutputs()


@Parameter(name="*")
@dataclass(frozen=True)
class ReadOptions:
    """How a record is read.

    Parameters
    ----------
    columns
        Names or numbers (from 1 on) of a table's columns: t,u,y by default.
    time_unit
        Unit of its times: s, ms, us, ns, min, h or d; s by default.
    max_size
        Limit of what a file that is read may unpack to [MB].
    """

    columns: str = ""
    time_unit: str | None = None
    max_size: MaxSize = MAX_SIZE


@Parameter(name="*")
@dataclass(frozen=True)
class ModelOptions:
    """Structure and search of the model of a record.

    Parameters
    ----------
    zeros
        Number of zeros; as many as poles if u acts on y at once. By default none, or two from order
        4 on where the record shows a resonance with them.
    integrators
        Number of poles at s = 0; by default as many as the record shows.
    friction
        Whether there is Coulomb friction.
    rest
        Whether the plant was at rest before the record; by default this is assumed where the gain
        is not known without it and the first samples support it.
    max_delay
        Longest delay of u to search [s].
    held_out
        Share of the record, at its end, on which the model is judged; by default 0.3, or none
        where u does not move there.
    """

    zeros: WholeOrNone = None
    integrators: WholeOrNone = None
    friction: bool | None = None
    rest: bool | None = None
    max_delay: float | None = None
    held_out: float | None = None


READ_OPTIONS, MODEL_OPTIONS = ReadOptions(), ModelOptions()
