"""Setup files of any number of axes: reading one builds the objects that it describes.

A file with tables ``[[axis]]`` has several coupled axes (``setup/axes.py``), another one a single
axis (``setup/loading.py``).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from quell.setup.axes import AxesDescription, assembled_axes
from quell.setup.description import describe, is_of_axes
from quell.setup.loading import Known, Setup, assembled, check_windows
from quell.setup.schema import Builder, read
from quell.setup.sweeps import sweep_of
from quell.signals import as_signal
from quell.simulation.scenario import check_schedule


def load(path: str | os.PathLike[str], trust: bool = False) -> Setup:
    r"""Read a TOML file and build the objects that it describes.

    A plant of the kind ``python`` runs a Python file, which is refused without ``trust``. A
    ``SetupError`` has a line for each error: file, path of the key, value and rule, or the
    nearest known name. The ``controller`` of a file with several axes is a ``quell.Axes``.

    Examples
    --------
    >>> from quell.setup import EXAMPLES
    >>> load(EXAMPLES / "arm.toml").controller.names
    ('shoulder', 'elbow')
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> text = "dt = 0.01\ncontroller = {omega_c = 2.0}\n"
    >>> text += "observer = {kind = 'model-free', order = 2, b0 = 1.0, omega_0 = 9.0}"
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "rig.toml"
    ...     _ = path.write_text(text)
    ...     load(path)
    Traceback (most recent call last):
        ...
    quell.setup.schema.SetupError: rig.toml: observer.omega_0: unknown; did you mean omega_o?
    """
    return made(*read(path), trust)


def made(
    name: str, data: Mapping[str, Any], trust: bool = False, known: Known | None = None
) -> Setup:
    """Build the objects that ``data`` describes: the content of a TOML file called ``name``.

    ``known`` has parts of an earlier call, which are not built again if their tables are the same.

    Raises
    ------
    SetupError
        as ``load``.
    """
    if is_of_axes(data):
        setup = assembled_axes(name, data, trust, known)
    else:
        setup = assembled(name, describe(name, data), known, trust)
    _check_together(setup)
    return setup


def _check_together(setup: Setup) -> None:
    """Check windows, signals and sweep of a setup; raise a ``SetupError`` if they can't be used.

    A part alone cannot know these rules. ``assembled`` does not check them: tuning and sweeps build
    setups with another controller, in which only the parts matter.
    """
    check_windows(setup)
    scenario, tables = setup.scenario, setup.description
    is_of_one = not isinstance(tables, AxesDescription)
    if scenario is not None and setup.plant is not None and is_of_one:
        builder = Builder(setup.file, setup.trust)
        derivative: Any = scenario.reference
        for _ in range(int(getattr(setup.controller, "derivatives", 0))):
            next_one = as_signal(derivative).derivative
            derivative = builder.attempt("scenario", ("reference",), next_one)
        # A device gives the signals that a schedule follows, too; a tuning has yet to make it.
        if "schedule" not in (setup.tune or {}) and not (setup.rig or {}).get("channels"):
            builder.attempt("", (), check_schedule, scenario, setup.controller)
    if tables.sweep is not None:
        sweep_of(setup)
