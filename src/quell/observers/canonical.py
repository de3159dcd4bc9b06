"""From a state-space model to the chain of integrators that an ESO is built on."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.types import Matrix, Vector

# Below this ratio of singular values the balanced observability matrix counts as rank deficient.
_RANK_TOLERANCE = 1e-10
# Markov parameters below this share of their own bound count as zero.
_ZERO_TOLERANCE = 1e-9


class Canonical(NamedTuple):
    """``y^(n) = −a_0 y − … − a_{n−1} y^(n−1) + b u``, and the map ``S`` from the model's own state to (y, y', …)."""

    a: Vector
    b: float
    S: Matrix


def canonical(model: Any) -> Canonical:
    """Bring a model to observable canonical form (paper, eq. (transform): ``S = [C; C A; …; C A^(n−1)]``).

    Parameters
    ----------
    model
        a plant with ``A`` (n, n), ``B`` (n, 1), ``C`` (1, n) (so also ``control.StateSpace``), a ``control.TransferFunction``, or
        the pair ``(a, b)`` itself with ``a = (a_0 … a_{n−1})``.

    Returns
    -------
    Canonical
        the coefficients ``a`` (n,) [1/s^(n−i)], the gain ``b`` [y-unit / u-unit / s^n] and ``S`` (n, n).

    Raises
    ------
    ValueError
        where the model is not of one input and one output, is not observable from y (assumption 1 of the paper), or has a relative
        degree other than its order (the input then enters before the last integrator and the model has zeros).
    """
    if isinstance(model, tuple) and len(model) == 2:
        return _from_pair(*model)
    if hasattr(model, "num") and hasattr(model, "den"):
        return _from_transfer_function(model)
    if all(hasattr(model, name) for name in "ABC"):
        return _from_state_space(model)
    raise ValueError(
        f"plant = {model!r}: must be a linear plant or control.StateSpace (with A, B, C), a control.TransferFunction, or a pair (a, b)"
    )


def _from_pair(a: Any, b: Any) -> Canonical:
    coefficients = checks.vector("a", a)
    gain = checks.nonzero("b", b, "or the input does not reach the plant")
    return Canonical(coefficients, gain, np.eye(coefficients.size))


def _from_transfer_function(model: Any) -> Canonical:
    if np.shape(model.num)[:2] != (1, 1):
        raise ValueError(f"plant has {np.shape(model.num)[:2]} outputs and inputs: an ESO needs one of each")
    numerator, denominator = np.trim_zeros(model.num[0][0], "f"), np.trim_zeros(model.den[0][0], "f")
    _check_continuous(model)
    if numerator.size == 0:
        raise ValueError("plant has a numerator of zero: the input must reach the output")
    if numerator.size != 1:
        raise ValueError(
            f"plant has a numerator of degree {numerator.size - 1}: its relative degree must equal its order, that is no zeros"
        )
    a = denominator[:0:-1] / denominator[0]
    return _from_pair(np.array(a, dtype=float), float(numerator[0] / denominator[0]))


def _from_state_space(model: Any) -> Canonical:
    A = checks.matrix("A", model.A)
    n = A.shape[0]
    checks.matrix("A", A, n, n)
    B, C = checks.matrix("B", model.B, n, 1), checks.matrix("C", model.C, 1, n)
    _check_continuous(model)
    if hasattr(model, "D") and np.any(np.asarray(model.D) != 0.0):
        raise ValueError(f"D = {np.asarray(model.D).tolist()}: must be zero, the output may not follow the input at once")
    S = np.empty((n, n))
    S[0] = C[0]
    for i in range(1, n):
        S[i] = S[i - 1] @ A
    # Rows of one size, whatever the unit of time.
    size = np.maximum(np.linalg.norm(S, axis=1), np.finfo(float).tiny)
    balanced = S / size[:, None]
    singular = np.linalg.svd(balanced, compute_uv=False)
    if not singular[-1] > _RANK_TOLERANCE * singular[0]:
        rank = int(np.sum(singular > _RANK_TOLERANCE * singular[0]))
        raise ValueError(
            f"plant is not observable from y: its observability matrix has rank {rank}, not {n} "
            f"(smallest over largest singular value {singular[-1] / max(singular[0], 1e-300):.1e}); "
            "measure another output or reduce the model"
        )
    markov = S @ B[:, 0]
    bound = size * np.linalg.norm(B)
    early = np.flatnonzero(np.abs(markov[:-1]) > _ZERO_TOLERANCE * bound[:-1])
    if early.size:
        raise ValueError(
            f"plant has relative degree {early[0] + 1} but order {n}: the input must reach y through all {n} integrators; "
            "this model has zeros, use ESO.model_free(order=relative degree)"
        )
    b = checks.nonzero("b = C A^(n-1) B", float(markov[-1]), "or the input does not reach the output")
    if abs(b) <= _ZERO_TOLERANCE * bound[-1]:
        raise ValueError(f"b = C A^(n-1) B = {b!r}: must not be zero, or the input does not reach the output")
    # Row n of the companion matrix: C A^n = −a S. What is no more than its rounding is zero.
    a = -np.linalg.solve(balanced.T, S[-1] @ A) / size
    rounding = 1e-13 * np.linalg.cond(balanced) * size[-1] * np.linalg.norm(A, 2)
    a[np.abs(a) * size <= rounding] = 0.0
    return Canonical(a, b, S)


def _check_continuous(model: Any) -> None:
    if getattr(model, "dt", None):
        raise ValueError(f"plant has a sample time, dt = {model.dt!r}: must be a continuous-time model (the ESO is sampled by its own dt)")
