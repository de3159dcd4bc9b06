"""One gain matrix for several runs, so that v of their axes can be compared.

The u of an axis is ``v = B0 u``, so v of runs with another B0 is in another unit: half of B0 halves
v of the same motors. What is compared between such runs, an effort or a load, is that of ``B u``
with one matrix B for all of them, which depends on the actuators only (``one_gain``). B0 of a run
is that of the least squares ``min ‖V − U B0ᵀ‖`` over its samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.records.record import columns_of
from quell.records.trajectory import Trajectory
from quell.types import Matrix, Vector

# B0 is constant, and one for several runs, if v is B0 u to this share: far above rounding, also of
# single precision, and far below differences that matter. Runs whose B0 follows the state have one
# B0 as far as v shows if one matrix for all of them leaves no more of v than this beyond what one
# for each does. Directions of u count above this share of the largest. All chosen by hand.
_CONSTANT, _SAME, _MOVED = 1e-5, 0.05, 1e-6
# An entry of B0 that makes less than this share of v is zero: that of double precision is 1e-16.
_ROUNDING = 1e-12


def with_gain(run: Trajectory, B: Any) -> Trajectory:
    """Return a record with ``v = B u`` of another matrix B (axes, actuators)."""
    size = columns_of(run.channels, "v"), columns_of(run.channels, "u")
    n, m = (part.stop - part.start for part in size)
    gain = checks.matrix("B", B, n, m)
    log = run.log.copy()
    log[:, size[0]] = run.log[:, size[1]] @ gain.T
    return replace(run, log=log)


def gain_factor(run: Trajectory) -> Matrix:
    """Return a triangle that has all of u and v that ``one_gain`` needs (rows, m + n)."""
    u, v = (run[name].reshape(len(run), -1) for name in "uv")
    both = np.column_stack([u, v])
    both = both[np.all(np.isfinite(both), axis=1)]
    size = float(np.max(np.abs(both[:, : u.shape[1]]), initial=0.0))
    if size == 0.0:
        return np.zeros((0, both.shape[1]))
    both /= size
    both /= float(np.linalg.norm(both[:, : u.shape[1]]))
    factor: Any = np.linalg.qr(both, mode="r")
    return np.asarray(factor, dtype=np.float64)


class OneGain(NamedTuple):
    """How v of several runs can be compared."""

    B: Matrix | None  #: for v = B u of all runs; None where v can be compared as it is
    constant: bool  #: whether B0 of each run is constant

    def describe(self) -> list[str]:
        """Return lines on the u of an axis: with which B it is, or what is not known of it."""
        if self.B is not None:
            rows = "], [".join(", ".join(f"{each:.4g}" for each in row) for row in self.B)
            return [f"u of an axis is B u with B = [[{rows}]] for all, as their B0 differ"]
        if not self.constant:
            return [
                "NOT protected against another B0: it follows the state here, so v = B0 u, the u "
                "of an axis, can be compared if all had one function for B0 or M; keep it"
            ]
        return []


def one_gain(factors: Mapping[str, Matrix], inputs: int) -> OneGain:
    """Return the one matrix B (axes, actuators) with which v of several runs can be compared.

    It is B0 of the first run in which all actuators that any of them uses have moved.

    Parameters
    ----------
    factors
        ``gain_factor`` of each run, by a name for errors.
    inputs
        number of actuators m of all of them.

    Raises
    ------
    ValueError
        where v can't be compared: B0 differ, and follow the state, or no run shows its own in full.
    """
    rows = np.concatenate([*factors.values()])
    size = np.linalg.norm(rows, axis=0)
    size[size == 0.0] = 1.0
    own = {name: _fitted(factor / size, inputs) for name, factor in factors.items()}
    left = np.stack([each[1] for each in own.values()])  # (runs, n), shares of v
    of_each = np.sqrt(np.sum(left**2, axis=0))
    _, of_all, rank = _fitted(rows / size, inputs)
    constant = bool(np.all(of_each <= _CONSTANT))
    beyond = np.sqrt(np.maximum(of_all**2 - of_each**2, 0.0))
    if np.all(beyond <= (_CONSTANT if constant else _SAME)):
        return OneGain(None, constant)
    full = [name for name, each in own.items() if each[2] == rank]
    if not constant or not full:
        why = "follows the state" if not constant else "can't be seen in full in any of them"
        raise ValueError(
            f"B0 of {', '.join(factors)} is not one, and {why}: v = B0 u is in other units, and "
            "can't be compared; take runs with one B0"
        )
    theta = own[full[0]][0]
    theta[np.abs(theta) < _ROUNDING] = 0.0
    gain: Matrix = (theta * size[inputs:] / size[:inputs, None]).T
    return OneGain(gain, constant)


def _fitted(rows: Matrix, inputs: int) -> tuple[Matrix, Vector, int]:
    """Return B0ᵀ (m, n) by least squares, the rest of v (n,), and the rank of u."""
    u, v = rows[:, :inputs], rows[:, inputs:]
    solved: Any = np.linalg.lstsq(u, v, rcond=_MOVED)
    theta, rank = np.asarray(solved[0], dtype=np.float64), int(solved[2])
    left: Vector = np.linalg.norm(v - u @ theta, axis=0)
    return theta, left, rank
