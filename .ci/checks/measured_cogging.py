"""A servo learns measured cogging under the guard. Argument: the record of the map."""

import sys
from math import pi
from pathlib import Path

import numpy as np

import quell as ql

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from cogging import LEARNERS, error, motor, moving_rms, rms, turning

record = sys.argv[1]
moved = (0.0, ql.signals.Step(pi, at=30.0))  # the map, by half a turn
learner = LEARNERS["the same, relearn=4"]
found, plain = (
    np.asarray(error(motor(record), each, ql.Guard() if each else None, turning(0.1), 60.0, moved))
    for each in (learner, None)
)


def part(run, start, end):
    """Return a part of a run, with times in seconds."""
    return run[round(start * 1000) : round(end * 1000)]


share = rms(part(found, 15.0, 30.0)) / rms(part(plain, 15.0, 30.0))
assert share <= 0.2, share
window, other = (np.nanmax(moving_rms(part(run, 29.0, 60.0), 0.2)) for run in (found, plain))
before = rms(part(found, 20.0, 30.0))
assert 3.0 * before < window <= 1.5 * other, (before, window, other)
assert rms(part(found, 50.0, 60.0)) <= 1.2 * before
print(f"waves in position are learned under the guard ({share:.3f} of the error),")
print("and again where the map is shifted")
