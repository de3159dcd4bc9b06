"""Sums that lose nothing to rounding (Kahan, *Communications of the ACM* 8, 1965).

In single precision a small increment loses most of its digits when it is added to a large number,
or all of them. Here what rounding takes is carried over to the next sample, in a second half of the
array: the sum is as good as one of twice the digits.
"""

from __future__ import annotations

from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single
from quell.types import Vector


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
