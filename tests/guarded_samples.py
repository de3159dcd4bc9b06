"""A guard that trusts its learner and keeps its account in each sample, and samples for it without a loop."""

from __future__ import annotations

import numpy as np

import quell as ql
from quell.guard import Guard, assess, limit, record_output
from quell.guard.kernels import PARTS, newest_share, removed_share, update_bounds
from quell.learners.base import lag_push

GUARD = Guard(every=1)
OBSERVER = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=5e-3)


def trusted(e: float = 1.0, b0: float = 1.0) -> tuple[object, object]:
    """A guard that trusts its learner, which has removed half of the squared error: κ_0 = 1.2, the error e, no output before."""
    observer = ql.ESO.model_free(order=4, b0=b0, omega_o=10.0, dt=5e-3)
    design = GUARD.design(observer)
    memory = GUARD.memory(design)
    memory.sample[0].credit = memory.sample[0].share = 1.0
    memory.sample[0].typical_error = memory.sample[0].peak = memory.sample[0].outside = e
    memory.averages[0].missed, memory.averages[0].gained = e**2, 0.5 * e**2
    # At present it explains as much as it adds: neither a wider bound nor a narrower one.
    memory.averages[0].newest_error = memory.averages[0].newest_left = e**2
    return design, memory


def decide(design: object, memory: object, *sample: float) -> tuple[float, float, bool]:
    """What is permitted in a sample that decides, whatever the account has seen."""
    memory.interval[0].part = PARTS
    return limit(design, memory, *sample)


def bounds(design: object, memory: object) -> tuple[float, float]:
    """Least and largest correction."""
    update_bounds(design, memory, removed_share(design, memory), newest_share(design, memory))
    return float(memory.interval[0].least), float(memory.interval[0].largest)


def feed(design: object, memory: object, f: np.ndarray, g: np.ndarray) -> list[float]:
    """Authority in samples in which f does not depend on u, and the learner's output is g."""
    chain, authority = np.zeros((2, 5)), []
    f_plain = f_shown = 0.0
    for disturbance, output in zip(f, g, strict=True):
        assess(design, memory, f_plain)
        f_learned, _, _ = limit(design, memory, f_plain, f_shown, output, 0.0, 0.0)
        record_output(design, memory, f_learned)
        f_plain = lag_push(design.lag, chain, 0, disturbance)
        f_shown = lag_push(design.lag, chain, 1, f_learned)
        authority.append(float(memory.sample[0].authority))
    return authority


def settle(design: object, memory: object, q: float, correction: float, samples: int) -> None:
    """Samples with the same q and the same correction, whatever the guard thinks of it."""
    for _ in range(samples):
        f_plain = q + memory.filtered[0]
        assess(design, memory, f_plain)
        memory.filtered[3] = 0.0
        record_output(design, memory, correction)
