"""Sums that lose nothing to rounding (Kahan, *Communications of the ACM* 8, 1965).

In single precision a small increment loses most of its digits when it is added to a large number,
or all of them. Here what rounding takes is carried over to the next sample, in a second half of the
array: the sum is as good as one of twice the digits.
"""

from __future__ import annotations

from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single
from quell.types import Matrix, Vector


@kernel
def add_with_carry(values: Vector, count: int, i: int, increment: float) -> None:
    """Add to entry ``i`` of ``count`` an increment with its carry, ``values[count + i]``, in it."""
    before = values[i]
    values[i] = before + increment
    values[count + i] = increment - (values[i] - before)


@kernel
def add_small(values: Vector, count: int, i: int, increment: float) -> None:
    """Add an increment to entry ``i``: in double precision (count,), else with carries (2 count,).

    For averages that move by so little in a sample that rounding would stop them.
    """
    if is_single(values[i]):
        add_with_carry(values, count, i, increment + values[count + i])
    else:
        values[i] += increment


@kernel
def add_to_diagonal(matrix: Matrix, i: int, increment: float) -> None:
    """Add to a diagonal entry: in double precision of a matrix (p, p), else of one (p, p + 1).

    The last column has the carries. A covariance that shrinks by 1e-7 of itself in a sample would
    stand still without, and its learner would go on as quickly as before.
    """
    if is_single(increment):
        last, before = matrix.shape[1] - 1, matrix[i, i]
        increment += matrix[i, last]
        matrix[i, i] = before + increment
        matrix[i, last] = increment - (matrix[i, i] - before)
    else:
        matrix[i, i] += increment
