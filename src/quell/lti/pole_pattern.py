"""Poles of a design in units of its bandwidth, as users give them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell import checks

# Relative difference up to which two complex numbers count as conjugates. Chosen by hand, above the
# rounding of numbers that a file stores with ten digits.
_CONJUGATE = 1e-9


def pole_pattern(name: str, value: Any, count: int) -> NDArray[np.complex128]:
    """Return ``count`` poles in the left half plane, checked, in units of a bandwidth.

    Parameters
    ----------
    name
        name of the argument, for errors.
    value
        entries that are negative numbers; pairs (real, imaginary), which stand for two conjugate
        poles each; or complex numbers, which come with their conjugates.
    count
        number of poles that the design has.

    Raises
    ------
    ValueError
        for another number of poles, a pole that is not in the left half plane, or a complex number
        without its conjugate.

    Examples
    --------
    >>> pole_pattern("poles", [-1.0, (-0.6, 0.8)], 3).tolist()
    [(-1+0j), (-0.6+0.8j), (-0.6-0.8j)]
    """
    if not checks.is_sequence(value) and not isinstance(value, np.ndarray):
        raise ValueError(f"{name} = {value!r}: must be a list of poles, for example [-1, [-2, 1]]")
    found: list[complex] = []
    for i, entry in enumerate(value):
        where = f"{name}[{i}]"
        if checks.is_sequence(entry) or (isinstance(entry, np.ndarray) and entry.ndim):
            real, imag = checks.vector(where, entry, 2).tolist()
            found += [complex(real, abs(imag)), complex(real, -abs(imag))]
        elif isinstance(entry, complex | np.complexfloating):
            found.append(complex(entry))
        else:
            found.append(complex(checks.finite(where, entry)))
    poles = np.array(found, dtype=np.complex128)
    if poles.size != count:
        raise ValueError(
            f"{name} = {value!r}: has {poles.size} poles, must have {count}; a pair [real, "
            "imaginary] counts as two"
        )
    if not np.all(np.isfinite(poles)) or not np.all(poles.real < 0.0):
        raise ValueError(f"{name} = {value!r}: the real part of each pole must be below zero")
    upper, lower = (np.sort_complex(poles[sign * poles.imag > 0.0]) for sign in (1.0, -1.0))
    conjugate = np.sort_complex(np.conj(lower))
    if upper.size != lower.size or not np.allclose(upper, conjugate, rtol=_CONJUGATE, atol=0.0):
        raise ValueError(
            f"{name} = {value!r}: complex poles must come in conjugate pairs; [real, imaginary] "
            "stands for both"
        )
    return poles
