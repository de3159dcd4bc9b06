"""What a user may give for a plant, brought to one of two shapes: matrices, or a polynomial over a polynomial."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.types import Matrix, Vector

# A leading coefficient of a numerator that is below this share of the others, at the plant's own rate, is the rounding of a conversion.
_ROUNDING = 1e-10


class StateSpace(NamedTuple):
    """``x' = A x + B u + E w``, ``y = C x``."""

    A: Matrix
    """(n, n)."""
    B: Vector
    """(n,)."""
    C: Vector
    """(n,)."""
    E: Vector | None
    """(n,): where the disturbance enters; None: where u does."""


class Fraction(NamedTuple):
    """``y^(n) + a_{n−1} y^(n−1) + … + a_0 y = c_{n−1} u^(n−1) + … + c_0 u``."""

    a: Vector
    """(n,)."""
    c: Vector
    """(n,)."""


def read(plant: Any, E: Any = None) -> StateSpace | Fraction:
    """Return what ``plant`` is, checked; see ``canonical`` for what it may be.

    Raises
    ------
    ValueError
        naming what does not fit.
    """
    if isinstance(plant, tuple) and len(plant) in (3, 4):
        A, B, C = plant[0], plant[1], plant[-1]
        if len(plant) == 4 and E is not None:
            raise ValueError("E is given twice: in plant = (A, B, E, C) and as an argument; leave one out")
        return _state_space(A, B, C, None if len(plant) == 3 else _channel(plant[2], None))
    if all(hasattr(plant, name) for name in "ABC"):
        _check_continuous(plant)
        if hasattr(plant, "D") and np.any(np.asarray(plant.D) != 0.0):
            raise ValueError(f"D = {np.asarray(plant.D).tolist()}: must be zero, the output may not follow the input at once")
        return _state_space(plant.A, plant.B, plant.C, None if E is None else _channel(E, getattr(plant, "E", None)))
    if E is not None:
        raise ValueError("E: only a plant with states, given by matrices, has a place for a disturbance of its own; leave E out")
    if isinstance(plant, tuple) and len(plant) == 2:
        if np.ndim(plant[1]) == 0:
            a = checks.vector("a", plant[0])
            b = checks.nonzero("b", plant[1], "or the input does not reach the plant")
            return Fraction(a, np.append(b, np.zeros(a.size - 1)))
        return _fraction(*plant)
    if hasattr(plant, "num") and hasattr(plant, "den"):
        _check_continuous(plant)
        if np.ndim(plant.num) == 1:  # as scipy.signal has them
            return _fraction(plant.num, plant.den)
        outputs, inputs = len(plant.num), len(plant.num[0])
        if (outputs, inputs) != (1, 1):
            raise ValueError(f"plant has {(outputs, inputs)} outputs and inputs: an ESO needs one of each")
        return _fraction(plant.num[0][0], plant.den[0][0])
    raise ValueError(
        f"plant = {plant!r}: must be a linear plant or control.StateSpace (with A, B, C), matrices (A, B, C) or (A, B, E, C), "
        "a control.TransferFunction, (numerator, denominator) or (a, b)"
    )


def _state_space(A: Any, B: Any, C: Any, E: Any) -> StateSpace:
    A = checks.matrix("A", A)
    n = A.shape[0]
    checks.matrix("A", A, n, n)
    B = checks.matrix("B", np.reshape(B, (-1, 1)) if np.ndim(B) == 1 else B, n, 1)
    C = checks.matrix("C", np.reshape(C, (1, -1)) if np.ndim(C) == 1 else C, 1, n)
    if E is not None:
        E = checks.matrix("E", E, n, 1)[:, 0]
        if not np.any(E):
            raise ValueError("E is zero: the disturbance must enter somewhere")
    return StateSpace(A, B[:, 0], C[0], E)


def _channel(E: Any, columns: Any) -> Any:
    """Return ``E`` as a column; an index counts the plant's own disturbance inputs ``columns``."""
    if isinstance(E, int | np.integer) and not isinstance(E, bool):
        if columns is None:
            raise ValueError(f"E = {E!r}: this plant has no disturbance inputs of its own to count; give the column (n,)")
        return np.asarray(columns)[:, [checks.whole("E", E, 0, np.shape(columns)[1] - 1)]]
    return np.reshape(E, (-1, 1)) if np.ndim(E) == 1 else E


def _fraction(numerator: Any, denominator: Any) -> Fraction:
    """Read coefficients in descending powers of s."""
    num, den = np.trim_zeros(checks.vector("numerator", numerator), "f"), np.trim_zeros(checks.vector("denominator", denominator), "f")
    if num.size == 0:
        raise ValueError("numerator is zero: the input must reach the output")
    if den.size < 2:
        raise ValueError(f"denominator has degree {max(den.size - 1, 0)}: must be at least 1, or the plant has no state")
    num = _without_rounding(num, den)
    if num.size > den.size:
        raise ValueError(
            f"transfer function is improper: its numerator has degree {num.size - 1}, its denominator {den.size - 1}; "
            "no plant differentiates its input"
        )
    if num.size == den.size:
        raise ValueError(
            f"transfer function is biproper: numerator and denominator have degree {den.size - 1}, so y follows u at once; "
            "model the lag of the actuator or the sensor too"
        )
    c = np.zeros(den.size - 1)
    c[: num.size] = num[::-1] / den[0]
    return Fraction(den[:0:-1] / den[0], c)


def _without_rounding(num: Vector, den: Vector) -> Vector:
    """Return the numerator without leading coefficients that only a conversion from state space has left there."""
    rate = np.max(np.abs(np.roots(den)))
    if rate == 0.0:
        return num
    size = np.abs(num) * rate ** np.arange(num.size - 1.0, -1.0, -1.0)
    return num[int(np.argmax(size > _ROUNDING * np.max(size))) :]


def _check_continuous(plant: Any) -> None:
    if getattr(plant, "dt", None):
        raise ValueError(f"plant has a sample time, dt = {plant.dt!r}: must be a continuous-time model (the ESO is sampled by its own dt)")
