"""Controllers whose ``step`` runs as Python, for types that no other test of a file compiles."""

from __future__ import annotations

from typing import Any

from quell.controllers.base import control


def interpreted(controller: Any) -> Any:
    """Return the controller with a ``step`` that is not compiled: the same kernels as Python."""
    controller._packed = controller
    controller._step = lambda this, r, y: control(this.parameters, this._state, r, y)
    return controller
