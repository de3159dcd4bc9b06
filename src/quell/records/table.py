"""A record as a table: a column for each number of a sample, for CSV and data frames."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from quell.files import check_writable, written_atomically
from quell.records.channels import units_of
from quell.records.record import Record
from quell.types import Matrix

# Rows that are converted to text at once; chosen by hand.
_BLOCK = 10_000


def columns(run: Record) -> tuple[list[str], list[str], Matrix]:
    """Return names, units and numbers (samples, columns) of a run; the first column is the time."""
    names, units, parts = ["time"], ["s"], [run.t[:, None]]
    for name in run.names:
        values = np.asarray(run[name])
        if values.ndim == 1:
            values, own = values[:, None], [name]
        else:
            labels = run.features if name == "theta" else ()
            entries = range(values.shape[1])
            own = [f"{name}[{labels[i] if i < len(labels) else i}]" for i in entries]
        names += own
        units += units_of(name, len(own), run.signals)
        parts.append(values)
    return names, units, np.hstack(parts)


def to_pandas(run: Record) -> Any:
    """Return a ``pandas.DataFrame`` over the time, with units in ``attrs["units"]``."""
    from quell.optional import import_extra

    pandas = import_extra("pandas", "pandas", "a data frame")
    names, units, values = columns(run)
    index = pandas.Index(values[:, 0], name="time")
    frame = pandas.DataFrame(values[:, 1:], index=index, columns=names[1:])
    frame.attrs["units"] = dict(zip(names[1:], units[1:], strict=True))
    return frame


def write_csv(run: Record, path: str | os.PathLike[str], overwrite: bool) -> None:
    """Write a run as CSV: names, with units where they are known, then a line for each sample."""
    check_writable(path, overwrite)
    names, units, values = columns(run)
    heads = [
        f"{name} [{unit}]" if unit != "1" and "-unit" not in unit else name
        for name, unit in zip(names, units, strict=True)
    ]
    with written_atomically(path, overwrite) as part, part.open("w", encoding="utf-8") as file:
        file.write(",".join(_cell(head) for head in heads) + "\n")
        for first in range(0, len(values), _BLOCK):
            rows = values[first : first + _BLOCK].tolist()
            file.write("".join(",".join(map(repr, row)) + "\n" for row in rows))


def _cell(text: str) -> str:
    quoted = text.replace('"', '""')
    return f'"{quoted}"' if set(text) & set(',"\n') else text
