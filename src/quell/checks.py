"""Checks of arguments: each error names the argument, its value and the rule.

``repr`` of objects: the class, and the arguments that it was made with.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import math
import unicodedata
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, TypeVar

import numpy as np

from quell.lazy import install
from quell.types import Matrix, Vector

# ---- Checks of arguments ----

T = TypeVar("T")

LARGEST = float(np.finfo(np.float64).max)
FINITE = {"minimum": -LARGEST, "maximum": LARGEST}
"""The rule of a finite number."""


def broken(message: str, name: str, **rule: Any) -> ValueError:
    """Return an error whose ``rule`` is a pair: the argument's name, and its rule in JSON Schema.

    So the schema of setup files (``quell.setup.json_schema``) has the rules that arguments are
    checked by.
    """
    error = ValueError(message)
    error.__dict__["rule"] = name, rule
    return error


def optional(check: Callable[..., T], name: str, value: Any, *rule: Any) -> T | None:
    """Return ``check(name, value, *rule)``, or None if ``value`` is None."""
    return None if value is None else check(name, value, *rule)


def finite(name: str, value: Any) -> float:
    """Return ``value`` as a finite float."""
    number = _number(name, value)
    if not math.isfinite(number):
        raise broken(f"{name} = {value!r}: must be a finite number", name, **FINITE)
    return number


# No quantity is so large in any unit: the observable universe is 1e62 Planck lengths wide.
LARGEST_SIGNAL = 1e60


def signal(name: str, value: Any) -> float:
    """Return ``value`` as a float that can be a reference, a measurement or a control signal."""
    number = finite(name, value)
    if abs(number) > LARGEST_SIGNAL:
        limits = {"minimum": -LARGEST_SIGNAL, "maximum": LARGEST_SIGNAL}
        raise broken(f"{name} = {value!r}: must be within ±{LARGEST_SIGNAL:g}", name, **limits)
    return number


def positive(name: str, value: Any, unit: str = "") -> float:
    """Return ``value`` as a float above zero."""
    number, unit = _number(name, value), unit and f" [{unit}]"
    if not (math.isfinite(number) and number > 0.0):
        message = f"{name} = {value!r}: must be finite and greater than zero{unit}"
        raise broken(message, name, exclusiveMinimum=0, maximum=LARGEST)
    return number


def positive_or_infinite(name: str, value: Any, unit: str = "") -> float:
    """Return ``value`` as a float above zero; it may be infinite."""
    number, unit = _number(name, value), unit and f" [{unit}]"
    if not number > 0.0:
        raise broken(
            f"{name} = {value!r}: must be greater than zero{unit}", name, exclusiveMinimum=0
        )
    return number


def time_constant(name: str, value: Any) -> float:
    """Return ``value`` [s] as a float above zero; it may be infinite."""
    return positive_or_infinite(name, value, "s")


def non_negative(name: str, value: Any, unit: str = "") -> float:
    """Return ``value`` as a float of at least zero."""
    number, unit = _number(name, value), unit and f" [{unit}]"
    if not (math.isfinite(number) and number >= 0.0):
        message = f"{name} = {value!r}: must be finite and not negative{unit}"
        raise broken(message, name, minimum=0, maximum=LARGEST)
    return number


def nonzero(name: str, value: Any, why: str) -> float:
    """Return ``value`` as a finite float other than zero; ``why`` completes the message."""
    number = finite(name, value)
    if number == 0.0:
        rule = {**FINITE, "not": {"const": 0}}
        raise broken(f"{name} = {value!r}: must not be zero, {why}", name, **rule)
    return number


def whole(name: str, value: Any, least: int, most: int | None = None) -> int:
    """Return ``value`` as an int between ``least`` and ``most``."""
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_whole or value < least or (most is not None and value > most):
        range_ = f"of at least {least}" if most is None else f"from {least} to {most}"
        rule = {"minimum": least} | ({} if most is None else {"maximum": most})
        message = f"{name} = {value!r}: must be a whole number {range_}"
        raise broken(message, name, type="integer", **rule)
    return int(value)


def flag(name: str, value: Any) -> bool:
    """Return ``value`` if it is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise broken(f"{name} = {value!r}: must be True or False", name, type="boolean")
    return bool(value)


def counted(count: int, what: str) -> str:
    """Return a number with the things of it, as a message has them: ``1 signal``, ``2 signals``."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def interval(low_name: str, low: Any, high_name: str, high: Any) -> tuple[float, float]:
    """Return two limits in order; either may be infinite, neither NaN."""
    low_value, high_value = _number(low_name, low), _number(high_name, high)
    if not low_value < high_value:
        limits = f"{low_name} = {low!r}, {high_name} = {high!r}"
        raise ValueError(f"{limits}: {low_name} must be less than {high_name}")
    return low_value, high_value


def samples(name: str, value: Any, dt: float, remedy: str = "") -> int:
    """Return the time ``value`` [s] as a whole number of samples of ``dt`` [s].

    ``remedy`` ends the message for other times.
    """
    time = non_negative(name, value, "s")
    count = round(time / dt)
    if abs(time / dt - count) > 1e-6:  # far above rounding errors; chosen by hand
        below = math.floor(time / dt)
        raise ValueError(
            f"{name} = {value!r} s with dt = {dt!r} s: must be a whole number of samples; "
            f"the nearest are {below * dt:.9g} and {(below + 1) * dt:.9g} s{remedy}"
        )
    return count


def nearest(name: str, known: Sequence[str]) -> str:
    """Return ``did you mean …?`` with the nearest of the known names, or all of them."""
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]}?" if near else f"must be one of {', '.join(known)}"


def is_sequence(value: Any) -> bool:
    """Return whether ``value`` is a sequence of items; a text is one item."""
    return isinstance(value, Sequence) and not isinstance(value, str | bytes | bytearray)


def vector(name: str, value: Any, size: int | None = None) -> Vector:
    """Return ``value`` as a finite, contiguous float vector, of ``size`` entries if given."""
    array = numbers(name, value)
    if array.ndim == 0:
        array = array.reshape(1)
    if array.ndim != 1 or (size is not None and array.size != size):
        wanted = "a vector" if size is None else f"a vector of {size}"
        raise ValueError(f"{name} has shape {array.shape}: must be {wanted}")
    return array


def positive_vector(name: str, value: Any) -> Vector:
    """Return ``value`` as a vector whose entries are greater than zero."""
    array = vector(name, value)
    if not np.all(array > 0.0):
        rule = {"items": {"exclusiveMinimum": 0, "maximum": LARGEST}}
        raise broken(f"{name} = {value!r}: must be positive", name, **rule)
    return array


def around_one(name: str, value: Any) -> tuple[float, float]:
    """Return ``value = (low, high)``, an interval of positive numbers around 1."""
    low, high = vector(name, value, 2).tolist()
    if not 0.0 < low <= 1.0 <= high:
        message = f"{name} = {value!r}: must be (low, high) with 0 < low <= 1 <= high"
        low_rule, high_rule = {"exclusiveMinimum": 0, "maximum": 1}, {**FINITE, "minimum": 1}
        raise broken(message, name, items=[low_rule, high_rule])
    return low, high


def matrix(name: str, value: Any, rows: int | None = None, columns: int | None = None) -> Matrix:
    """Return ``value`` as a finite, contiguous float matrix, with so many rows and columns."""
    array = numbers(name, value)
    wanted = (rows, columns)
    if array.ndim != 2 or any(w not in (None, n) for n, w in zip(array.shape, wanted, strict=True)):
        shape = ", ".join("any" if w is None else str(w) for w in wanted)
        raise ValueError(f"{name} has shape {array.shape}: must be a matrix of shape ({shape})")
    return array


def weight(name: str, value: Any, size: int) -> Matrix:
    """Return ``value`` as a symmetric matrix (size, size) without negative eigenvalues."""
    array = matrix(name, value, size, size)
    # Both tolerances are far above rounding errors; chosen by hand.
    if not np.allclose(array, array.T, rtol=1e-9, atol=0.0):
        raise ValueError(f"{name}: must be symmetric")
    least, most = np.linalg.eigvalsh(array)[[0, -1]].tolist()
    if least < -1e-9 * abs(most):
        raise ValueError(f"{name} has the eigenvalue {least:.3g}: must have none below zero")
    return array


def printable(name: str, value: str) -> str:
    """Return a text without control characters and halves of surrogate pairs.

    No line of a terminal, and no file of TOML, XML, CSV, C or Python can hold them in a name.
    """
    bad = sorted({each for each in value if unicodedata.category(each) in ("Cc", "Cs")})
    if bad:
        codes = ", ".join(f"U+{ord(each):04X}" for each in bad[:5])
        raise ValueError(f"{name} = {value!a:.60}: must have no control characters ({codes})")
    return value


def one_of(name: str, value: Any, choices: Sequence[str]) -> str:
    """Return ``value`` if it is one of ``choices``."""
    if value not in choices:
        message = f"{name} = {value!r}: must be one of {', '.join(choices)}"
        raise broken(message, name, enum=list(choices))
    return str(value)


def _number(name: str, value: Any) -> float:
    if isinstance(value, str | bytes | bool):
        raise ValueError(f"{name} = {value!r}: must be a number")
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} = {value!r}: must be a number") from None
    except OverflowError:
        raise ValueError(f"{name} = {value!r:.20}…: must be a number up to 1.8e308") from None


NUMBERS: dict[str, Any] = {"type": ["number", "array"]}
for _ in "vector", "matrix":
    NUMBERS = {"type": ["number", "array"], "items": NUMBERS}
"""The rule of a number, or of numbers in lists."""


def numbers(name: str, value: Any) -> Vector:
    """Return ``value`` as a finite, contiguous float array."""
    try:
        if _has_other(value):
            raise TypeError
        array = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError):
        got = type(value).__name__
        raise broken(f"{name}: must be an array of numbers, got {got}", name, **NUMBERS) from None
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        entry = float(array[where])
        raise ValueError(f"{name}: entry {where} is {entry!r}; every entry must be finite")
    return array


def _has_other(value: Any) -> bool:
    """Return whether there are flags or texts among numbers, which NumPy would convert."""
    if isinstance(value, list | tuple):
        return any(map(_has_other, value))
    return isinstance(value, bool | str | bytes)


# ---- Import of packages that only extras of quell install ----


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Return a third-party module; an ``ImportError`` names the ``extra`` that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{purpose} needs {module}, which can't be imported ({error}): {install(extra)}"
        ) from error


# ---- repr of objects ----

# Longest array that is printed with its numbers, and digits of a number.
_MOST, _DIGITS = 64, 6


class Described:
    """A base class of objects that print their class and the numbers that they were made with."""

    def __repr__(self) -> str:
        parts = (f"{name}={text(value)}" for name, value in self.described().items())
        return f"{type(self).__name__}({', '.join(parts)})"

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints, by name: arguments that differ from their defaults.

        An argument is found by its name among the attributes.
        """
        found = {}
        cls: Any = type(self)
        for name, default in _arguments(cls).items():
            value = getattr(self, name, default)
            if not _same(value, default):
                found[name] = value
        return found


@cache
def _arguments(cls: Any) -> dict[str, Any]:
    """Return the arguments of a class by name, with their defaults.

    Where ``__init__`` forwards ``**options``, the keyword-only ones of the base class follow.
    """
    found: dict[str, Any] = {}
    for depth, each in enumerate(c for c in cls.__mro__ if "__init__" in vars(c)):
        parameters = [*inspect.signature(vars(each)["__init__"]).parameters.values()][1:]
        for parameter in parameters:
            if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
                continue
            if depth == 0 or parameter.kind is parameter.KEYWORD_ONLY:
                found.setdefault(parameter.name, parameter.default)
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            break
    return found


def _same(value: Any, default: Any) -> bool:
    if value is default:
        return True
    plain = (bool, int, float, str, tuple)
    return isinstance(value, plain) and type(value) is type(default) and bool(value == default)


def text(value: Any) -> str:
    """Return a value in one line, numbers with six digits, long arrays by their shape."""
    if isinstance(value, float | np.floating):
        return f"{float(value):.{_DIGITS}g}"
    if isinstance(value, np.ndarray):
        if value.size > _MOST:
            return f"<array {value.shape}>"
        return text(value.tolist())
    if isinstance(value, list):
        return f"[{', '.join(map(text, value))}]"
    if isinstance(value, tuple):
        fields = getattr(value, "_fields", None)
        if fields is not None:
            named = (f"{name}={text(part)}" for name, part in zip(fields, value, strict=True))
            return f"{type(value).__name__}({', '.join(named)})"
        inside = ", ".join(map(text, value))
        return f"({inside},)" if len(value) == 1 else f"({inside})"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key!r}: {text(part)}" for key, part in value.items()) + "}"
    if isinstance(value, partial):
        named = (f"{name}={text(part)}" for name, part in value.keywords.items())
        return f"partial({', '.join([text(value.func), *map(text, value.args), *named])})"
    if inspect.isroutine(value) or isinstance(value, type):
        return str(getattr(value, "__qualname__", type(value).__name__))
    kind: Any = type(value)
    if kind.__repr__ is object.__repr__:  # an address says nothing
        return f"{kind.__name__}()"
    return " ".join(repr(value).split())
