"""Sums of products for many independent runs at once, one run in each lane of a vector.

Arrays have the lanes as their last axis. Numba's own loops over lanes come out several times
slower than the processor allows (24 instead of 7 ns for a loop of 4 + 5 states), because LLVM
keeps the sums in memory: it does not know that they share none with their summands. So this one
operation is written as vector instructions.

The last column comes first, and all lanes get the same instructions: the bits of a lane do not
depend on its place, nor on its neighbours. Interpreted, each product is rounded before it is added;
processors with fused operations do not round it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from quell.types import Matrix

LANES = 32
"""Runs that are advanced together: enough that the loops' own cost is small, few enough that the
coefficients of a loop stay in the processor's fastest memory. Measured at 8 to 64."""

# Numbers in a vector: 64 bytes, the widest registers; LLVM splits it where they are narrower.
_WIDTH = 8
_ALIGNMENT = 64  # bytes; vectors that cross a line of the processor's cache take twice as long


def lane_zeros(*shape: int) -> NDArray[Any]:
    """Return zeros of the given shape, with the lanes as one more axis, aligned for vectors."""
    size = int(np.prod(shape)) * LANES * 8
    memory = np.zeros(size + _ALIGNMENT, dtype=np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    return memory[start : start + size].view(np.float64).reshape(*shape, LANES)


def set_products(
    target: Matrix, row: int, coefficients: NDArray[np.float64], values: Matrix, first: int
) -> None:
    """Set ``target[row + i] = Σ_j coefficients[i, j] · values[first + j]`` in each lane.

    Parameters
    ----------
    target, values
        (rows, LANES); they may be the same array if the rows differ.
    row, first
        the first row of the results, and of the values.
    coefficients
        (results, values, LANES).
    """
    for i in range(coefficients.shape[0]):
        total = np.zeros(LANES)
        for j in range(coefficients.shape[1] - 1, -1, -1):
            total += coefficients[i, j] * values[first + j]
        target[row + i] = total


@overload(set_products, strict=False)
def _compiled_products(target: Any, row: Any, coefficients: Any, values: Any, first: Any) -> Any:
    return lambda target, row, coefficients, values, first: _vector_products(
        target, row, coefficients, values, first
    )


@intrinsic
def _vector_products(
    typing: Any, target: Any, row: Any, coefficients: Any, values: Any, first: Any
) -> Any:
    signature = types.void(target, types.intp, coefficients, values, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number, lanes = context.get_value_type(types.intp), LANES
        vector = ir.VectorType(ir.DoubleType(), _WIDTH)

        def array(i: int) -> Any:
            return context.make_array(signature.args[i])(context, builder, arguments[i])

        def places(base: Any, at: Any) -> list[Any]:
            """Return pointers to the vectors of the lanes at an index, in rows of lanes."""
            start = builder.mul(at, number(lanes))
            return [
                builder.bitcast(
                    builder.gep(base, [builder.add(start, number(part))]), vector.as_pointer()
                )
                for part in range(0, lanes, _WIDTH)
            ]

        results, factors, summands = array(0), array(2), array(3)
        count, columns, _ = cgutils.unpack_tuple(builder, factors.shape, 3)
        with cgutils.for_range(builder, count) as rows:
            totals = [cgutils.alloca_once(builder, vector) for _ in range(lanes // _WIDTH)]
            for total in totals:
                builder.store(ir.Constant(vector, None), total)
            start = builder.mul(rows.index, columns)
            with cgutils.for_range(builder, columns) as inner:
                column = builder.sub(builder.sub(columns, number(1)), inner.index)
                a = places(factors.data, builder.add(start, column))
                b = places(summands.data, builder.add(arguments[4], column))
                for total, factor, value in zip(totals, a, b, strict=True):
                    product = builder.fmul(
                        builder.load(factor, align=8), builder.load(value, align=8)
                    )
                    builder.store(builder.fadd(builder.load(total), product), total)
            written = places(results.data, builder.add(arguments[1], rows.index))
            for total, place in zip(totals, written, strict=True):
                builder.store(builder.load(total), place, align=8)
        return context.get_dummy_value()

    return signature, generate
