"""What of a kernel has no counterpart in C is refused, with the kernel and the rule."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from quell.export.translate.text import TranslationError

from .cases import cases
from .test_translate import Design, State, added, fill, new_design, new_state, source_of, two

# Kernels as text would hide their lines from the translator: each is a function of its own.
_WORD: Any = "a word"
_CUBE: Any = np.zeros((2, 2, 2))


def text(design: Design, state: State, a: float, b: float) -> float:
    """Use a text."""
    return "a"  # type: ignore[return-value]


def unset(design: Design, state: State, a: float, b: float) -> float:
    """Use a name without a value."""
    return nowhere  # type: ignore[name-defined] # noqa: F821


def word(design: Design, state: State, a: float, b: float) -> float:
    """Use a text of the module."""
    return a + _WORD


def cube(design: Design, state: State, a: float, b: float) -> float:
    """Use an array of three dimensions."""
    return a + _CUBE[0, 0, 0]


def field(design: Design, state: State, a: float, b: float) -> float:
    """Use a field that there is not."""
    return design.nothing  # type: ignore[attr-defined,no-any-return]


def inverted(design: Design, state: State, a: float, b: float) -> float:
    """Use another operator of one number."""
    return ~int(a)


def shifted(design: Design, state: State, a: float, b: float) -> float:
    """Use another operator of two numbers."""
    return design.gain @ state.x  # type: ignore[no-any-return]


def second(design: Design, state: State, a: float, b: float) -> float:
    """Use another index of a record."""
    return state.count[1].total


def entry(design: Design, state: State, a: float, b: float) -> float:
    """Use an index of a number."""
    return a[0]  # type: ignore[index,no-any-return]


def stepped(design: Design, state: State, a: float, b: float) -> float:
    """Use a slice with a step."""
    fill(state.x[0:3:2], a)
    return b


def half(design: Design, state: State, a: float, b: float) -> float:
    """Use an index that is no integer."""
    return state.x[a]  # type: ignore[call-overload,no-any-return]


def chained(design: Design, state: State, a: float, b: float) -> float:
    """Call a function in the middle of a chained comparison."""
    return 1.0 if a < added(state, a) < b else 0.0


def by_name(design: Design, state: State, a: float, b: float) -> float:
    """Call a function with a named argument."""
    return added(state, a=b)


def method(design: Design, state: State, a: float, b: float) -> float:
    """Call a method."""
    return state.x.sum()  # type: ignore[no-any-return]


def builtin(design: Design, state: State, a: float, b: float) -> float:
    """Call a function of Python."""
    return sum((a, b))


def special(design: Design, state: State, a: float, b: float) -> float:
    """Call a function of math that is not known."""
    return math.gamma(a)


def excepted(design: Design, state: State, a: float, b: float) -> float:
    """Raise an error."""
    if a > b:
        raise ValueError
    return a


def iterated(design: Design, state: State, a: float, b: float) -> float:
    """Go through an array."""
    for x in state.x:
        a += x
    return a


def packed(design: Design, state: State, a: float, b: float) -> float:
    """Use a tuple as one value."""
    both = two(a, b)
    return both[0]


def unpacked(design: Design, state: State, a: float, b: float) -> float:
    """Unpack a number."""
    x, y = a  # type: ignore[misc]
    return x + y


def whole(design: Design, state: State, a: float, b: float) -> float:
    """Assign to an array as a whole."""
    state.x = a  # type: ignore[misc,assignment]
    return b


@cases(
    ("function", "rule"),
    [
        (text, "only numbers can be translated"),
        (unset, "has no value here"),
        (
            word,
            "is str; only numbers, and arrays of them with one or two dimensions, can be constants",
        ),
        (cube, "is ndarray; only numbers, and arrays of them with one or two dimensions, can be"),
        (field, "has no such field"),
        (inverted, "only 'not' and '-' can be translated"),
        (shifted, "arithmetic is for numbers"),
        (second, "a record has only the index 0"),
        (entry, "is not an array"),
        (stepped, "a slice must be without a step"),
        (half, "an index must be an integer"),
        (chained, "a call in the middle of a chained comparison"),
        (by_name, "arguments must be given by position"),
        (method, "this call can not be translated"),
        (builtin, "can not be translated"),
        (special, "math.gamma can not be translated"),
        (excepted, "C has no exceptions"),
        (iterated, "only 'for … in range(…)' can be translated"),
        (packed, "a tuple must be unpacked"),
        (unpacked, "is not a tuple"),
        (whole, "only numbers can be assigned"),
    ],
)
def test_what_has_no_counterpart_in_c_is_refused_with_the_rule(
    function: Callable[..., Any], rule: str
) -> None:
    """Texts, arrays as wholes, methods, exceptions: the message has the name of the kernel."""
    with pytest.raises(TranslationError) as caught:
        source_of(function, new_design(), new_state())
    assert rule in str(caught.value)
    assert re.search(rf"\b{function.__name__}\b", str(caught.value))
