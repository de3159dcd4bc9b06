"""What a user may give for a plant, brought to one of two shapes: matrices, or a polynomial over a polynomial.

The only place that knows: ``canonical`` and ``LinearPlant.of`` read with it, and all that takes a linear plant reads with one of the two.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.types import Matrix, Vector

# A leading coefficient of a numerator that is below this share of the others, at the plant's own rate, is the rounding of a conversion.
_ROUNDING = 1e-10
# Markov parameters below this share of their own bound count as zero.
ZERO_TOLERANCE = 1e-9


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


class TransferFunction(NamedTuple):
    """``y^(n) + a_{n−1} y^(n−1) + … + a_0 y = c_{n−1} u^(n−1) + … + c_0 u``; for a sampled model shifts in place of derivatives."""

    a: Vector
    """(n,)."""
    c: Vector
    """(n,)."""


def read_model(plant: Any, E: Any = None, dt: float | None = None) -> StateSpace | TransferFunction:
    """Return what ``plant`` is, checked.

    Parameters
    ----------
    plant
        see ``LinearPlant.of`` for what it may be.
    E
        where the disturbance enters, if that is not where u does; see ``canonical``.
    dt
        a model in discrete time may be given too, if this is its sample time [s]; by default none may.

    Raises
    ------
    ValueError
        naming what does not fit.
    """
    if isinstance(plant, list):
        plant = tuple(plant)
    if isinstance(plant, tuple) and len(plant) in (3, 4):
        A, B, C = plant[0], plant[1], plant[-1]
        if len(plant) == 3:
            return _state_space(A, B, C, None if E is None else _channel(E, None))
        if E is not None:
            raise ValueError(
                "E is given twice: in plant = (A, B, E, C) and as an argument; leave one out"
            )
        _check_four(A, C)
        return _state_space(A, B, C, _channel(plant[2], None))
    if all(hasattr(plant, name) for name in "ABC"):
        _check_time(plant, dt)
        if hasattr(plant, "D") and np.any(np.asarray(plant.D) != 0.0):
            raise ValueError(
                f"D = {np.asarray(plant.D).tolist()}: must be zero, the output may not follow the input at once"
            )
        return _state_space(
            plant.A, plant.B, plant.C, None if E is None else _channel(E, getattr(plant, "E", None))
        )
    if E is not None:
        raise ValueError(
            "E: only a plant with states, given by matrices, has a place for a disturbance of its own; leave E out"
        )
    if isinstance(plant, tuple) and len(plant) == 2:
        if np.ndim(plant[1]) == 0:
            a = checks.vector("a", plant[0])
            b = checks.nonzero("b", plant[1], "or the input does not reach the plant")
            return TransferFunction(a, np.append(b, np.zeros(a.size - 1)))
        return _transfer_function(*plant)
    if all(
        hasattr(plant, name) for name in ("zeros", "poles", "gain", "to_tf")
    ):  # scipy.signal.ZerosPolesGain
        plant = plant.to_tf()
    if hasattr(plant, "num") and hasattr(plant, "den"):
        _check_time(plant, dt)
        if np.ndim(plant.num) == 1:  # as scipy.signal has them
            return _transfer_function(plant.num, plant.den)
        outputs, inputs = len(plant.num), len(plant.num[0])
        if (outputs, inputs) != (1, 1):
            raise ValueError(
                f"plant has {(outputs, inputs)} outputs and inputs: must have one of each"
            )
        return _transfer_function(plant.num[0][0], plant.den[0][0])
    raise ValueError(
        f"plant = {plant!r}: must be a linear plant or control.StateSpace (with A, B, C), matrices (A, B, C) or (A, B, E, C), "
        "a control.TransferFunction, (numerator, denominator) or (a, b); a nonlinear one has to be linearised first"
    )


def to_state_space(model: TransferFunction) -> StateSpace:
    """Return a transfer function with states, in observable companion form; its coefficients are taken as they are, so nothing is rounded.

    Without zeros y and its derivatives, ``x_i' = x_{i+1}``, ``x_n' = −a·x + c_0 u``. With zeros, where those would jump with u,
    ``x_1 = y`` and ``x_i' = x_{i+1} − a_{n−i} x_1 + c_{n−i} u``. The z of ``canonical`` would be rounded here: its Markov parameters hold
    the slow zeros of a plant with a pole at 10000 rad/s as differences of numbers 1e8 times as large.
    """
    a, c = model
    n = a.size
    A = np.diag(np.ones(n - 1), 1)
    if not np.any(c[1:]):
        A[-1] = -a
        B = np.append(np.zeros(n - 1), c[0])
    else:
        A[:, 0] -= a[::-1]
        B = c[::-1].copy()
    return StateSpace(A, B, np.eye(n)[0], None)


def is_linear_model(value: Any) -> bool:
    """Return whether ``value`` is of a kind that ``read_model`` knows: an object with matrices or polynomials, or numbers in a tuple or list."""
    if isinstance(value, tuple | list):
        return len(value) > 0 and isinstance(
            value[0], int | float | np.number | np.ndarray | tuple | list
        )
    return not isinstance(value, type) and any(
        all(hasattr(value, name) for name in names)
        for names in (("A", "B", "C"), ("num", "den"), ("zeros", "poles", "gain"))
    )


def leading_gain(A: Matrix, column: Matrix, C: Matrix) -> tuple[float, int] | None:
    """Return the first Markov parameter that is not zero, ``b = C A^(ν−1) column``, and the relative degree ν.

    Parameters
    ----------
    A
        (n, n), in 1/s.
    column
        (n, 1), where the input enters: B, or a column of E.
    C
        (1, n).

    Returns
    -------
    tuple or None
        b in y-unit / input-unit / s^ν, and ν from 1 to n; None where the input does not reach y. What is below 1e-9 of
        ``|C| |A|^(ν−1) |column|`` is the rounding of sums that cancel.
    """
    row, bound = C[0], np.abs(C[0])
    for degree in range(1, A.shape[0] + 1):
        gain = float(row @ column[:, 0])
        if abs(gain) > ZERO_TOLERANCE * float(bound @ np.abs(column[:, 0])):
            return gain, degree
        row, bound = row @ A, bound @ np.abs(A)
    return None


def check_matrices(A: Any, B: Any, C: Any) -> tuple[Matrix, Matrix, Matrix]:
    """Return A (n, n), B (n, 1) and C (1, n), checked; B and C may be given as vectors."""
    A = checks.matrix("A", A)
    n = A.shape[0]
    checks.matrix("A", A, n, n)
    B = checks.matrix("B", np.reshape(B, (-1, 1)) if np.ndim(B) == 1 else B, n, 1)
    C = checks.matrix("C", np.reshape(C, (1, -1)) if np.ndim(C) == 1 else C, 1, n)
    return A, B, C


def _state_space(A: Any, B: Any, C: Any, E: Any) -> StateSpace:
    A, B, C = check_matrices(A, B, C)
    n = A.shape[0]
    if E is not None:
        E = checks.matrix("E", E, n, 1)[:, 0]
        if not np.any(E):
            raise ValueError("E is zero: the disturbance must enter somewhere")
    return StateSpace(A, B[:, 0], C[0], E)


def _channel(E: Any, columns: Any) -> Any:
    """Return ``E`` as a column; an index counts the plant's own disturbance inputs ``columns``."""
    if isinstance(E, int | np.integer) and not isinstance(E, bool):
        if columns is None:
            raise ValueError(
                f"E = {E!r}: this plant has no disturbance inputs of its own to count; give the column (n,)"
            )
        return np.asarray(columns)[:, [checks.whole("E", E, 0, np.shape(columns)[1] - 1)]]
    return np.reshape(E, (-1, 1)) if np.ndim(E) == 1 else E


def _transfer_function(numerator: Any, denominator: Any) -> TransferFunction:
    """Read coefficients in descending powers of s."""
    num, den = (
        np.trim_zeros(checks.vector("numerator", numerator), "f"),
        np.trim_zeros(checks.vector("denominator", denominator), "f"),
    )
    if num.size == 0:
        raise ValueError("numerator is zero: the input must reach the output")
    if den.size < 2:
        raise ValueError(
            f"denominator has degree {max(den.size - 1, 0)}: must be at least 1, or the plant has no state"
        )
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
    return TransferFunction(den[:0:-1] / den[0], c)


def _without_rounding(num: Vector, den: Vector) -> Vector:
    """Return the numerator without leading coefficients that only a conversion from state space has left there."""
    rate = np.max(np.abs(np.roots(den)))
    if rate == 0.0:
        return num
    size = np.abs(num) * rate ** np.arange(num.size - 1.0, -1.0, -1.0)
    return num[int(np.argmax(size > _ROUNDING * np.max(size))) :]


def _check_four(A: Any, C: Any) -> None:
    """Check that four matrices end with C: scipy's and python-control's order ends with D."""
    n = checks.matrix("A", A).shape[0]
    if np.size(C) != n or not np.any(C):
        what = "is zero" if np.size(C) == n else f"has shape {np.shape(C)}"
        raise ValueError(
            f"C, the last of four, {what}: four entries are (A, B, E, C), not (A, B, C, D); D must be zero, leave it out"
        )


def _check_time(plant: Any, dt: float | None) -> None:
    own = getattr(plant, "dt", None)
    if not own:
        return
    if dt is None:
        raise ValueError(
            f"plant has a sample time, dt = {own!r}: must be a continuous-time model; it is sampled here"
        )
    if own is True or not math.isclose(own, dt, rel_tol=1e-9):
        raise ValueError(
            f"plant has a sample time of {own!r}: must be in continuous time, or sampled at the controller's dt = {dt!r} s"
        )
