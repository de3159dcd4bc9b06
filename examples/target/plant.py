"""The numbers of a linear plant that is simulated on the target, for ``plant.c``."""

from __future__ import annotations

from typing import Any

import numpy as np


def plant_numbers(plant: Any, dt: float) -> str:
    """Return ``plant_numbers.h`` for a ``quell.plants.LinearPlant`` with one disturbance."""
    model = plant.sampled(dt)
    parts = {
        "TRANSITION": model.transition,
        "INPUT": model.input,
        "DISTURBANCE": model.disturbance[:, 0],
        "OUTPUT": model.output,
    }
    lines = [f"#define PLANT_{name} {_initialiser(values)}" for name, values in parts.items()]
    return "\n".join([f"#define PLANT_ORDER {model.input.size}", *lines, ""])


def _initialiser(values: Any) -> str:
    """Return an array in C, bit for bit."""
    items = (_initialiser(v) if np.ndim(v) else float(v).hex() for v in values)
    return f"{{{', '.join(items)}}}"
