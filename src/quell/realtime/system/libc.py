"""Functions of the C library, called from Python and from compiled code alike.

Compiled code refers to them by name, so that it can be cached on disk; Python calls them through
``ctypes``. Pointers are passed as addresses: ``array.ctypes.data`` of an array that lives at least
as long as the call.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any

from numba.core import types as nb_types
from numba.extending import overload

_KINDS = {
    "int": (ctypes.c_int, nb_types.int32),
    "long": (ctypes.c_int64, nb_types.int64),
    "address": (ctypes.c_void_p, nb_types.uintp),
}


def external(name: str, returns: str, *arguments: str) -> Callable[..., int]:
    """Return the C library's function ``name``; a call raises an ``OSError`` if there is none.

    The types of the arguments and of the result are ``"int"``, ``"long"`` or ``"address"``.
    """

    @cache
    def found() -> Any:
        try:
            function = getattr(ctypes.CDLL(None, use_errno=True), name)
        except (AttributeError, TypeError):
            raise OSError(
                f"{name}: the C library has no such function; the real-time loop needs Linux"
            ) from None
        function.restype = _KINDS[returns][0]
        function.argtypes = [_KINDS[argument][0] for argument in arguments]
        return function

    def call(*values: int) -> int:
        return int(found()(*values))

    symbol = nb_types.ExternalFunction(
        name, _KINDS[returns][1](*[_KINDS[argument][1] for argument in arguments])
    )

    @overload(call, strict=False)
    def _compiled(*values: Any) -> Any:
        return lambda *values: symbol(*values)

    return call
