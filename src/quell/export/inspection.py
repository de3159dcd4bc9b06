"""The parts of a controller that exports look at, in double or single precision."""

from __future__ import annotations

from typing import Any

from quell.controllers.limits import Limits
from quell.controllers.single import SinglePrecision


def in_double_precision(controller: Any) -> Any:
    """Return the controller, or the one in double precision that it was made from."""
    return controller.controller if isinstance(controller, SinglePrecision) else controller


def parameters_of(controller: Any) -> Any:
    """Return the parameters of the kernels, in the controller's precision."""
    parameters = controller.parameters
    return parameters.controller if isinstance(controller, SinglePrecision) else parameters


def limits_path(controller: Any) -> str:
    """Return where the parameters have the limits of u, as ``controller.limits``; or nothing."""
    parameters, path = parameters_of(controller), ""
    while True:
        fields = getattr(parameters, "_fields", ())
        for name in fields:
            if isinstance(getattr(parameters, name), Limits):
                return f"{path}{name}"
        if "controller" not in fields:
            return ""
        parameters, path = parameters.controller, f"{path}controller."


def at_path(parameters: Any, path: str) -> Any:
    """Return the part of nested parameters at a path such as ``controller.limits``."""
    for name in path.split("."):
        parameters = getattr(parameters, name)
    return parameters
