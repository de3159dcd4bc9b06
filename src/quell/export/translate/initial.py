"""C statements that set a state to its initial value, which is zero except for some arrays."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from quell.export.translate.layout import wrapped
from quell.export.translate.structs import Structs
from quell.export.translate.values import Array, Struct, Value

# An array with at most so many values that are not zero is set by one statement for each.
_MOST_STATEMENTS = 4


def initial_lines(structs: Structs, owner: Value, state: Any, tables: list[str]) -> list[str]:
    """Return the statements for a state whose memory is zero.

    Arrays of many different numbers are copied from tables, whose definitions are appended to
    ``tables``.
    """
    lines: list[str] = []
    done: set[int] = set()
    for value, array in _arrays(structs, owner, state):
        address = array.__array_interface__["data"][0]
        if address not in done and np.any(array != 0):
            lines += _array_lines(structs, value, array, tables)
        done.add(address)
    return [line for each in lines for line in wrapped(each)]


def _arrays(structs: Structs, owner: Value, state: Any) -> Iterator[tuple[Value, Any]]:
    layout = structs.layouts[owner.kind.name]
    names = [name for name in layout.members if name not in layout.shared[1:]]
    for name in names:
        value, part = structs.field(owner, name), getattr(state, name)
        if value is None:
            raise AssertionError
        if isinstance(value.kind, Array):
            yield value, part
        elif isinstance(part, tuple):
            yield from _arrays(structs, value, part)
        elif isinstance(value.kind, Struct):  # a record
            for member in structs.layouts[value.kind.name].members:
                field = structs.field(value, member)
                if field is not None and not field.is_constant:
                    yield field, np.asarray(part[member])


def _array_lines(structs: Structs, value: Value, array: Any, tables: list[str]) -> list[str]:
    write, flat = structs.literals.write, array.ravel()
    if array.dtype.names is None and array.shape == (1,) and not isinstance(value.kind, Array):
        return [f"    {value.code} = {write(flat[0])};"]
    if flat.size > _MOST_STATEMENTS and np.all(flat == flat[0]):
        return _loops(array.shape, value.code, write(flat[0]))
    if array.ndim == 2 and array.shape[0] == array.shape[1] > _MOST_STATEMENTS:
        diagonal = np.diag(array)
        if np.array_equal(array, np.diag(diagonal)) and np.all(diagonal == diagonal[0]):
            head = f"    for (int i = 0; i < {diagonal.size}; i++) {{"
            return [head, f"        {value.code}[i][i] = {write(diagonal[0])};", "    }"]
    if np.count_nonzero(flat) <= _MOST_STATEMENTS:
        places = [tuple(int(i) for i in place) for place in np.argwhere(array)]
        return [
            f"    {value.code}{''.join(f'[{i}]' for i in place)} = {write(array[place])};"
            for place in places
        ]
    name = f"initial_{len(tables) + 1}"
    numbers = ", ".join(map(write, flat))
    kind = structs.number(value.kind.element)
    tables.append(f"static const {kind} {name}[{flat.size}] = {{{numbers}}}; /* {value.code} */")
    return [f"    (void)memcpy({value.code}, {name}, sizeof {name});"]


def _loops(shape: tuple[int, ...], code: str, number: str) -> list[str]:
    lines, pad = [], "    "
    for name, length in zip("ij", shape, strict=False):
        lines.append(f"{pad}for (int {name} = 0; {name} < {length}; {name}++) {{")
        code, pad = f"{code}[{name}]", pad + "    "
    lines.append(f"{pad}{code} = {number};")
    for depth in range(len(shape), 0, -1):
        lines.append(f"{'    ' * depth}}}")
    return lines
