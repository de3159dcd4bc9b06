"""Atomic loads and stores of int64 words that two threads or two processes share.

The writer stores data first and then, as a *release*, a word that announces it. A reader that loads
this word as an *acquire* and finds the new value also finds the data.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import types as nb_types
from numba.core.cgutils import get_item_pointer
from numba.extending import intrinsic, overload
from numpy.typing import NDArray


def load_acquire(words: NDArray[np.int64], index: int) -> int:
    """Read ``words[index]``, which another thread writes with ``store_release``.

    Interpreted it is a plain read: there the interpreter's lock keeps the order.
    """
    return int(words[index])


def store_release(words: NDArray[np.int64], index: int, value: int) -> None:
    """Write ``words[index]``, which another thread reads with ``load_acquire``."""
    words[index] = value


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    return get_item_pointer(
        context, builder, kind, context.make_array(kind)(context, builder, array), [index]
    )


@intrinsic
def _load_acquire(typing_context: Any, words: Any, index: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        word = _address(context, builder, signature.args[0], values[0], values[1])
        return builder.load_atomic(word, "acquire", align=8)

    return nb_types.int64(words, nb_types.int64), generate


@intrinsic
def _store_release(typing_context: Any, words: Any, index: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        word = _address(context, builder, signature.args[0], values[0], values[1])
        builder.store_atomic(values[2], word, "release", align=8)
        return context.get_dummy_value()

    return nb_types.void(words, nb_types.int64, nb_types.int64), generate


@overload(load_acquire, strict=False)
def _compiled_load(words: Any, index: Any) -> Any:
    return lambda words, index: _load_acquire(words, index)


@overload(store_release, strict=False)
def _compiled_store(words: Any, index: Any, value: Any) -> Any:
    return lambda words, index, value: _store_release(words, index, value)
