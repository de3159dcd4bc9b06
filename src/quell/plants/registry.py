"""Plants by name, from the results of an identification, and from files of Python code."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from quell import checks
from quell.files import whole_text
from quell.plants.base import Plant, check_plant
from quell.plants.channels import delayed_inputs, encoded_outputs
from quell.plants.flexible import lagged_two_mass_spring, n_mass, two_mass_spring
from quell.plants.fmu import FMU
from quell.plants.friction import with_friction_and_delay
from quell.plants.linear import LinearPlant, delayed, encoded, lagged
from quell.plants.multibody import arm, quadrotor_attitude
from quell.plants.nonlinear import NonlinearPlant
from quell.plants.testbeds import dc_motor, torsional, torsional_identified
from quell.types import warn

# ---- Plants from the results of an identification ----


def identified(
    path: str | os.PathLike[str] | None = None,
    *,
    dt: float,
    num: Sequence[float] | None = None,
    den: Sequence[float] | None = None,
    delay: float | None = None,
    friction: float | None = None,
    friction_width: float | None = None,
) -> Plant:
    """Return the plant that `quell identify --json` or `quell tune --json` found in a record.

    It is the transfer function with its delay and its dry friction, as
    ``quell.identification.simulated_plant`` has it; designs use its part without friction. The
    constant force is left out. The model is in a file, or its numbers are given in place of one.

    Parameters
    ----------
    path
        the file of results, in JSON; relative to the folder where the command is run.
    dt
        sample time of the loop [s]; with friction the delay is rounded to whole samples.
    num, den
        the transfer function, highest power of s first, in place of ``path``.
    delay
        delay of u [s], beside ``num`` and ``den``.
    friction
        Coulomb friction [u-unit], beside ``num`` and ``den``.
    friction_width
        speed at which three quarters of the friction act [y-unit/s]; goes with ``friction``.

    Raises
    ------
    ValueError
        for a file that can't be read or has no model, for a model with direct feedthrough, and for
        numbers beside a path.
    """
    numbers = {
        "num": num, "den": den, "delay": delay, "friction": friction,
        "friction_width": friction_width,
    }  # fmt: skip
    given = {key: value for key, value in numbers.items() if value is not None}
    if path is None:
        if num is None or den is None:
            raise ValueError("path: missing; give the file of results, or num and den")
        if (friction is None) != (friction_width is None):
            raise ValueError("friction and friction_width go together: give both or none")
        if friction:
            checks.positive("friction_width", friction_width, "y-unit/s")
        name, before = "identified plant", ""
        model: Mapping[str, Any] = dict(given)
    elif not isinstance(path, str | os.PathLike):
        raise ValueError(f"path = {path!r}: must be the path of a file of results")
    elif given:
        raise ValueError(f"{', '.join(given)}: go without path = {os.fspath(path)!r}; give one")
    else:
        name, before, model = f"identified plant ({Path(path).name})", f"{path}: ", _model(path)
    num_s, den_s = (checks.vector(f"{before}{key}", model[key]) for key in ("num", "den"))
    lag = checks.non_negative(f"{before}delay", model.get("delay", 0.0), "s")
    linear = LinearPlant.of((num_s, den_s), name=name)
    force, width = model.get("friction"), model.get("friction_width")
    if force and width:
        force = checks.positive(f"{before}friction", force, "u-unit")
        width = checks.positive(f"{before}friction_width", width, "y-unit/s")
    elif force and "friction_width" not in model:
        text = f"{before}its friction is left out: the file is of an older quell; identify again"
        warn(text)
    dt = checks.positive("dt", dt, "s")
    return with_friction_and_delay(linear, num_s, den_s, force, width, lag, dt)


def _model(path: str | os.PathLike[str]) -> Mapping[str, Any]:
    where = f"path = {os.fspath(path)!r}"
    try:
        text = whole_text(path)
    except OSError as error:
        raise ValueError(f"{where}: can't be read ({error.strerror})") from None
    except ValueError as error:
        raise ValueError(f"{where}: must be a file of results in JSON ({error})") from None
    return identified_numbers(text, where)


IDENTIFIED_NUMBERS = ("num", "den", "delay", "friction", "friction_width")
"""Keys of a file of results that the plant of ``identified`` has."""


def identified_numbers(text: str, where: str) -> Mapping[str, Any]:
    """Return the numbers of the model in the text of a file of results; ``where`` names it.

    Raises
    ------
    ValueError
        for a text that is not JSON, and for one that has no model.
    """
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{where}: must be a file of results in JSON ({reason})") from None
    for found in (content, content.get("model") if isinstance(content, dict) else None):
        if isinstance(found, dict) and {"num", "den"} <= found.keys():
            return found
    raise ValueError(f"{where}: has no model; must be written by quell identify --json")


# ---- Plants from a file of Python code, which is run only if the user trusts it ----

# Modules by path and content: a sweep makes the same plant many times, and the same functions need
# to be compiled only once.
_MODULES: dict[tuple[Path, str], Any] = {}


def python_plant(
    source: str,
    order: int | None = None,
    parameters: Mapping[str, float] | None = None,
    output: str | None = None,
    disturbances: int = 1,
    substeps: int | None = None,
    operating_point: Mapping[str, Any] | None = None,
    trust: bool = False,
) -> Plant:
    """Return the plant of a Python function, ``file.py:name``; this runs the file.

    With ``order`` the function is the equation of a ``NonlinearPlant``, ``f(t, x, u, w, …)``. Else
    it returns a plant, and is called with the parameters; it may also be a plant itself.

    Parameters
    ----------
    source
        file and name with a colon between, `pendulum.py:pendulum`; the file is relative to the
        folder where the command is run.
    order
        number of states of an equation.
    parameters
        numbers by name for the function, `{m = 1.0}`.
    output
        of an equation: name of a function h(x, …) in the same file; the first state by default.
    disturbances
        of an equation: number of disturbance inputs.
    substeps
        of an equation: Runge-Kutta steps in a sample; chosen by default.
    operating_point
        of an equation: `{x = [3.14, 0.0], u = 0.0}`, about which designs take it as linear; zero by
        default, if that is a state of rest.
    trust
        whether the file may be run.

    Raises
    ------
    ValueError
        without trust, for a file that can't be run, a name that it does not have, or a function
        that returns no plant.
    """
    found, module = _named(source, trust)
    numbers = dict(parameters or {})
    only = {"output": output, "substeps": substeps, "operating_point": operating_point}
    if order is None:
        for key, value in only.items():
            if value is not None:
                raise ValueError(f"{key} = {value!r:.60}: is for an equation, which also has order")
        return _made(source, found, numbers)
    point = None
    if operating_point is not None:
        unknown = [key for key in operating_point if key not in ("x", "u")]
        if unknown or "x" not in operating_point:
            raise ValueError(f"operating_point = {operating_point!r}: must have x, and may have u")
        point = operating_point["x"], operating_point.get("u", 0.0)
    return NonlinearPlant(
        found,
        order,
        None if output is None else _attribute(module, output, source),
        disturbances,
        substeps,
        source.rpartition(":")[2],
        numbers or None,
        point,
    )


def _made(text: str, found: Any, numbers: dict[str, float]) -> Plant:
    if callable(found) and not hasattr(found, "sampled"):
        try:
            found = found(**numbers)
        except Exception as error:
            raise ValueError(
                f"source = {text!r}: fails with {type(error).__name__}: {error}; without order "
                "it must return a plant, called with the parameters"
            ) from None
    elif numbers:
        raise ValueError(f"parameters: {text!r} is a plant already; make it a function of them")
    plant: Plant = found
    try:
        check_plant(plant, "it")
    except ValueError:
        raise ValueError(
            f"source = {text!r}: returns {type(plant).__name__}, must return a plant; for an "
            "equation f(t, x, u, w) give order, too"
        ) from None
    return plant


def _named(text: str, trust: bool) -> tuple[Any, Any]:
    """Return what ``file.py:name`` names, and the file's module."""
    path, _, name = text.rpartition(":")
    if not path.endswith(".py") or not name.isidentifier():
        raise ValueError(f"source = {text!r}: must be a file and a name, like motor.py:motor")
    if not trust:
        raise ValueError(
            f"source = {text!r}: would run this Python file; give --trust (in Python trust=True) "
            "if you trust it"
        )
    module = _module(Path(path), text)
    return _attribute(module, name, text), module


def _attribute(module: Any, name: str, text: str) -> Any:
    known = [key for key in vars(module) if not key.startswith("_")]
    if name not in known:
        raise ValueError(f"source = {text!r}: {name} is not in it; {checks.nearest(name, known)}")
    return getattr(module, name)


def _module(path: Path, text: str) -> Any:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f"source = {text!r}: can't be read ({error.strerror})") from None
    key = path.resolve(), hashlib.sha256(content).hexdigest()
    if key in _MODULES:
        return _MODULES[key]
    name = f"quell_plant_{path.stem}_{key[1][:12]}"
    spec = importlib.util.spec_from_file_location(name, key[0])
    if spec is None or spec.loader is None:
        raise ValueError(f"source = {text!r}: can't be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        if not isinstance(error, Exception | SystemExit):
            raise
        lines = [each.lineno for each in traceback.extract_tb(error.__traceback__)]
        line = getattr(error, "lineno", None) or lines[-1]
        raise ValueError(
            f"source = {text!r}: {path.name} fails in line {line} with "
            f"{type(error).__name__}: {' '.join(str(error).split())}"
        ) from None
    _MODULES[key] = module
    return module


# ---- The plants that setup files, rigs and twins know by name ----


def linear(
    num: Any = None, den: Any = None, A: Any = None, B: Any = None, C: Any = None, E: Any = None
) -> LinearPlant:
    """Return a linear plant: a transfer function ``num/den``, or matrices.

    Parameters
    ----------
    num, den
        coefficients of the transfer function, highest power of s first.
    A, B, C
        in place of num and den, matrices as lists of rows; B and C may be lists of numbers.
    E
        how disturbances enter, with a column for each; as u does by default.
    """
    values = {"num": num, "den": den, "A": A, "B": B, "C": C, "E": E}
    for name, value in values.items():
        checks.optional(checks.vector if name in ("num", "den") else checks.numbers, name, value)
    given = [name for name, value in values.items() if value is not None and name != "E"]
    if given == ["num", "den"]:
        return LinearPlant.of((num, den), E)
    if given == ["A", "B", "C"]:
        return LinearPlant(A, B, C, E)
    raise ValueError(f"given: {', '.join(given) or 'nothing'}; must be num and den, or A, B and C")


TESTBEDS: Mapping[str, Callable[[], Plant]] = {
    "torsional": torsional,
    "torsional-identified": torsional_identified,
    "two-mass": two_mass_spring,
}
"""Plants of testbeds, which are made without arguments."""

PLANTS: Mapping[str, Callable[..., Plant]] = {
    **TESTBEDS,
    "dc-motor": dc_motor,
    "lagged-two-mass": lagged_two_mass_spring,
    "linear": linear,
    "n-mass": n_mass,
    "delayed": delayed,
    "lagged": lagged,
    "encoded": encoded,
    "fmu": FMU,
    "identified": identified,
    "python": python_plant,
}
"""Plants that a setup file can have, by their ``kind``."""

AXES_PLANTS: Mapping[str, Callable[..., Any]] = {
    "arm": arm,
    "linear": linear,
    "multivariable-linear": linear,  # its name in setup files of earlier releases
    "quadrotor-attitude": quadrotor_attitude,
    "encoded-outputs": encoded_outputs,
    "delayed-inputs": delayed_inputs,
    "fmu": FMU,
    "python": python_plant,
}
"""Plants with several signals that a setup of several axes can have, by their ``kind``."""

RUN_CODE: tuple[Callable[..., Plant], ...] = (FMU,)
"""Plants that are programs: a setup file can only have them if the user trusts it."""
