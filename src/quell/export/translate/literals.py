"""Numbers as C writes them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quell.export.translate.values import TranslationError


class Literals:
    """Writer of numbers in double or in single precision.

    Parameters
    ----------
    single
        whether real numbers are ``float``, not ``double``.
    """

    def __init__(self, single: bool) -> None:
        self.single = single
        self.real = "float" if single else "double"

    def write_real(self, value: Any) -> str:
        """Return a real number; Raises ``TranslationError`` if it is out of range."""
        number = float(value)
        if math.isnan(number):
            return "NAN"
        if math.isinf(number):
            return "INFINITY" if number > 0.0 else "-INFINITY"
        if not self.single:
            return repr(number)
        with np.errstate(over="ignore", under="ignore"):
            rounded = np.float32(number)
        if not np.isfinite(rounded) or (rounded == 0.0) != (number == 0.0):
            raise TranslationError(f"{number!r} is out of the range of single precision")
        text = str(rounded)
        return f"{text}f" if any(sign in text for sign in ".e") else f"{text}.0f"

    def write(self, value: Any) -> str:
        """Return any number."""
        if isinstance(value, bool | np.bool_):
            return "true" if value else "false"
        if isinstance(value, int | np.integer):
            return str(int(value))
        return self.write_real(value)

    def math_function(self, name: str) -> str:
        """Return the name of a function of <math.h>."""
        return f"{name}f" if self.single else name
