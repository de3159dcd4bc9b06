"""Linear models as users give them, converted to state space or a transfer function.

``canonical`` and ``LinearPlant.of`` read models with ``read_model``; whatever takes a linear plant
uses one of the two.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.types import Matrix, Vector

# Leading coefficients of a numerator below this share of the largest one, at the rate of the
# fastest pole, are rounding errors of a conversion. Chosen by hand; not tuned further.
_ROUNDING = 1e-10
# Markov parameters below this share of the bound on their rounding count as zero. Chosen by hand
# above the unit roundoff of 1e-16; not tuned further.
ZERO_TOLERANCE = 1e-9


class StateSpace(NamedTuple):
    """``x' = A x + B u + E w``, ``y = C x``."""

    A: Matrix  # (n, n)
    B: Vector  # (n,)
    C: Vector  # (n,)
    E: Vector | None  # (n,), the input of the disturbance; None if it enters where u does


class TransferFunction(NamedTuple):
    """``y^(n) + a_{n−1} y^(n−1) + … + a_0 y = c_{n−1} u^(n−1) + … + c_0 u``.

    For a sampled model, shifts replace derivatives.
    """

    a: Vector  # (n,)
    c: Vector  # (n,)


def read_model(plant: Any, E: Any = None, dt: float | None = None) -> StateSpace | TransferFunction:
    """Return ``plant`` as a checked model; ``LinearPlant.of`` lists the accepted kinds.

    ``E`` is the input of the disturbance, see ``canonical``. With a sample time ``dt`` [s], a
    discrete-time model that has the same is accepted too.
    """
    if isinstance(plant, list):
        plant = tuple(plant)
    if isinstance(plant, tuple) and len(plant) in (3, 4):
        return _from_matrices(plant, E)
    if all(hasattr(plant, name) for name in "ABC"):
        _check_time(plant, dt)
        D = np.asarray(getattr(plant, "D", 0.0))
        if np.any(D != 0.0):
            raise ValueError(
                f"D = {D.tolist()}: must be zero, the output may not follow the input at once"
            )
        return _state_space(plant.A, plant.B, plant.C, _column(E, getattr(plant, "E", None)))
    if E is not None:
        raise ValueError(
            "E: only a plant with states has an input for the disturbance; leave E out"
        )
    if isinstance(plant, tuple) and len(plant) == 2:
        if not (np.isscalar(plant[1]) or getattr(plant[1], "ndim", 1) == 0):
            return _transfer_function(*plant)
        a = checks.vector("a", plant[0])
        b = checks.nonzero("b", plant[1], "or the input does not reach the plant")
        return TransferFunction(a, np.append(b, np.zeros(a.size - 1)))
    if all(hasattr(plant, name) for name in ("zeros", "poles", "gain", "to_tf")):
        plant = plant.to_tf()  # scipy.signal.ZerosPolesGain
    if hasattr(plant, "num") and hasattr(plant, "den"):
        _check_time(plant, dt)
        if np.ndim(plant.num) == 1:  # scipy.signal
            return _transfer_function(plant.num, plant.den)
        size = len(plant.num), len(plant.num[0])
        if size != (1, 1):
            raise ValueError(f"plant has {size} outputs and inputs: must have one of each")
        return _transfer_function(plant.num[0][0], plant.den[0][0])
    named = repr(getattr(plant, "name", None) or plant)
    raise ValueError(
        f"plant = {named}: must be a linear plant or control.StateSpace (with A, B, C), matrices "
        "(A, B, C) or (A, B, E, C), a control.TransferFunction, (numerator, denominator) or "
        "(a, b); linearise a nonlinear plant first, quell.plants.linearised(plant, x, u); one "
        "without equation, as an FMU, is tuned for from an experiment, quell tune --device "
        "twin:FILE.fmu, or from a record, quell run SETUP --save run.nc and quell tune run.nc"
    )


def to_state_space(model: TransferFunction) -> StateSpace:
    """Return ``model`` in observable companion form, with its coefficients unchanged.

    Without zeros the states are y and its derivatives: ``x_i' = x_{i+1}``, ``x_n' = −a·x + c_0 u``.
    With zeros, where derivatives would jump with u, ``x_1 = y`` and
    ``x_i' = x_{i+1} − a_{n−i} x_1 + c_{n−i} u``. The z of ``canonical`` would add rounding errors:
    its Markov parameters contain the slow zeros of a plant with a pole at 10000 rad/s as
    differences of numbers 1e8 times as large.
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
    """Return whether ``value`` looks like a model for ``read_model``: by attributes or numbers."""
    if isinstance(value, tuple | list):
        first = value[0] if value else None
        return isinstance(first, int | float | np.number | np.ndarray | tuple | list)
    kinds = (("A", "B", "C"), ("num", "den"), ("zeros", "poles", "gain"))
    return not isinstance(value, type) and any(
        all(hasattr(value, name) for name in names) for names in kinds
    )


def leading_gain(A: Matrix, column: Matrix, C: Matrix) -> tuple[float, int] | None:
    """Return the first nonzero Markov parameter, ``b = C A^(ν−1) column``, and its ν from 1 to n.

    ``column`` (n, 1) is the input: B, or a column of E. b is in y-unit / input-unit / s^ν. None if
    the input does not reach y. Values below 1e-9 of ``|C| |A|^(ν−1) |column|`` are rounding errors.
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


def _from_matrices(plant: tuple[Any, ...], E: Any) -> StateSpace:
    """Read ``(A, B, C)`` or ``(A, B, E, C)``."""
    A, B, C = plant[0], plant[1], plant[-1]
    if len(plant) == 4:
        if E is not None:
            raise ValueError(
                "E is given twice: in plant = (A, B, E, C) and as an argument; leave one out"
            )
        # scipy and python-control have (A, B, C, D); then C has another shape or is a zero D.
        fits = np.size(C) == checks.matrix("A", A).shape[0]
        if not fits or not np.any(C):
            what = "is zero" if fits else f"has shape {np.shape(C)}"
            raise ValueError(
                f"C, the last of four, {what}: four entries are (A, B, E, C), not (A, B, C, D); "
                "D must be zero, leave it out"
            )
        E = plant[2]
    return _state_space(A, B, C, _column(E, None))


def _state_space(A: Any, B: Any, C: Any, E: Any) -> StateSpace:
    A, B, C = check_matrices(A, B, C)
    if E is not None:
        E = checks.matrix("E", E, A.shape[0], 1)[:, 0]
        if not np.any(E):
            raise ValueError("E is zero: the disturbance must enter somewhere")
    return StateSpace(A, B[:, 0], C[0], E)


def _column(E: Any, columns: Any) -> Any:
    """Return ``E`` as a column; an index selects one of the plant's disturbance ``columns``."""
    if isinstance(E, int | np.integer) and not isinstance(E, bool):
        if columns is None:
            raise ValueError(
                f"E = {E!r}: this plant has no disturbance inputs of its own; give a column (n,)"
            )
        return np.asarray(columns)[:, [checks.whole("E", E, 0, np.shape(columns)[1] - 1)]]
    return np.reshape(E, (-1, 1)) if np.ndim(E) == 1 else E


def _transfer_function(numerator: Any, denominator: Any) -> TransferFunction:
    """Read coefficients in descending powers of s."""
    num = np.trim_zeros(checks.vector("numerator", numerator), "f")
    den = np.trim_zeros(checks.vector("denominator", denominator), "f")
    if num.size == 0:
        raise ValueError("numerator is zero: the input must reach the output")
    if den.size < 2:
        raise ValueError(
            f"denominator has degree {max(den.size - 1, 0)}: must be at least 1, for a state"
        )
    num = _without_rounding(num, den)
    if num.size > den.size:
        raise ValueError(
            f"transfer function is improper: its numerator has degree {num.size - 1}, its "
            f"denominator {den.size - 1}; no plant differentiates its input"
        )
    if num.size == den.size:
        raise ValueError(
            f"transfer function is biproper: numerator and denominator have degree {den.size - 1}, "
            "so y follows u at once; model the lag of the actuator or the sensor too"
        )
    c = np.zeros(den.size - 1)
    c[: num.size] = num[::-1] / den[0]
    return TransferFunction(den[:0:-1] / den[0], c)


def _without_rounding(num: Vector, den: Vector) -> Vector:
    """Return ``num`` without leading coefficients left over by a conversion from state space."""
    rate = np.max(np.abs(np.roots(den)))
    if rate == 0.0:
        return num
    size = np.abs(num) * rate ** np.arange(num.size - 1.0, -1.0, -1.0)
    return num[int(np.argmax(size > _ROUNDING * np.max(size))) :]


def _check_time(plant: Any, dt: float | None) -> None:
    own = getattr(plant, "dt", None)
    if not own:
        return
    if dt is None:
        raise ValueError(
            f"plant has a sample time, dt = {own!r}: must be in continuous time; quell samples it"
        )
    if own is True or not math.isclose(own, dt, rel_tol=1e-9):
        raise ValueError(
            f"plant has a sample time of {own!r}: must be in continuous time, or sampled at the "
            f"controller's dt = {dt!r} s"
        )
