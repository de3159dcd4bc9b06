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
def add_symmetrically(matrix: Matrix, i: int, j: int, increment: float) -> None:
    """Add to entry (i, j), j <= i, of a symmetric matrix (p, p), or with carries of one (p, p + 1).

    With carries the lower triangle has the entries, and what is above has the carries, that of
    (i, j) at (j, i + 1). All entries have one: if the diagonal alone went on where the rest stands
    still, a covariance would become indefinite.
    """
    if matrix.shape[1] > matrix.shape[0]:
        before = matrix[i, j]
        increment += matrix[j, i + 1]
        matrix[i, j] = before + increment
        matrix[j, i + 1] = increment - (matrix[i, j] - before)
    else:
        matrix[i, j] += increment
