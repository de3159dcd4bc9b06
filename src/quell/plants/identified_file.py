"""Plants from the results of an identification."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from quell import checks
from quell.plants.base import Plant
from quell.plants.friction_and_delay import with_friction_and_delay
from quell.plants.linear import LinearPlant
from quell.reading import whole_text
from quell.warn import warn


def identified(path: str | os.PathLike[str], dt: float) -> Plant:
    """Return the plant that `quell identify --json` or `quell tune --json` found in a record.

    It is the transfer function with its delay and its dry friction, as
    ``quell.identification.simulated_plant`` has it; designs use its part without friction. The
    constant force is left out.

    Parameters
    ----------
    path
        the file of results, in JSON; relative to the folder where the command is run.
    dt
        sample time of the loop [s]; with friction the delay is rounded to whole samples.

    Raises
    ------
    ValueError
        for a file that can't be read or has no model, and for a model with direct feedthrough.
    """
    found = _model(path)
    numbers: dict[str, Any] = {}
    for name in ("num", "den"):
        numbers[name] = checks.vector(f"{path}: {name}", found[name])
    delay = checks.non_negative(f"{path}: delay", found.get("delay", 0.0), "s")
    name = f"identified plant ({Path(path).name})"
    linear = LinearPlant.of((numbers["num"], numbers["den"]), name=name)
    force, width = found.get("friction"), found.get("friction_width")
    if force and width:
        force = checks.positive(f"{path}: friction", force, "u-unit")
        width = checks.positive(f"{path}: friction_width", width, "y-unit/s")
    elif force and "friction_width" not in found:
        text = f"{path}: its friction is left out: the file is of an older quell; identify again"
        warn(text)
    dt = checks.positive("dt", dt, "s")
    return with_friction_and_delay(linear, **numbers, force=force, width=width, delay=delay, dt=dt)


def _model(path: str | os.PathLike[str]) -> Mapping[str, Any]:
    where = f"path = {os.fspath(path)!r}"
    try:
        content = json.loads(whole_text(path))
    except OSError as error:
        raise ValueError(f"{where}: can't be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{where}: must be a file of results in JSON ({reason})") from None
    for found in (content, content.get("model") if isinstance(content, dict) else None):
        if isinstance(found, dict) and {"num", "den"} <= found.keys():
            return found
    raise ValueError(f"{where}: has no model; must be written by quell identify --json")
