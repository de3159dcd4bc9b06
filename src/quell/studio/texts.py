"""A setup as a TOML file and as a Python script, and from the text of a file."""

from __future__ import annotations

import pprint
from collections.abc import Mapping
from typing import Any

from quell.setup.description import parsed
from quell.studio.messages import MOST_BYTES, Granted, checked
from quell.studio.runs import NAME
from quell.tuning.result.setup_file import toml_text

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


def toml_of(tables: Mapping[str, Any]) -> str:
    """Return the tables as a setup file."""
    return toml_text(_without_none(tables))


def python_of(tables: Mapping[str, Any], title: str, is_whole: bool, delay: float) -> str:
    """Return a script that builds the same objects, runs them and draws the run.

    A plant that ``is_whole`` is analysed as it is, others by their part ``linear`` and a ``delay``
    [s].
    """
    literal = pprint.pformat(_without_none(tables), indent=1, width=92, sort_dicts=False)
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


def tables_of_text(text: Any, granted: Granted) -> dict[str, Any]:
    """Return the tables of the text of a setup file; raise a ``SetupError`` or ``ValueError``."""
    if not isinstance(text, str) or len(text) > MOST_BYTES:
        raise ValueError(f"text: must be the content of a TOML file, at most {MOST_BYTES} bytes")
    return checked(parsed(NAME, text), granted)


def _without_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_none(part) for key, part in value.items() if part is not None}
    if isinstance(value, list | tuple):
        return [_without_none(part) for part in value]
    return value
