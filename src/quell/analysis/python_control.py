"""Conversion of sampled systems to systems of python-control, an optional extra."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell.lti.system import System
from quell.optional import import_extra

# Trailing coefficients below this share of the largest one count as rounding errors of a zero, some
# hundred times the unit roundoff.
_ROUNDING = 1e-13


def state_space(system: System, dt: float) -> Any:
    """Return a system as a ``control.StateSpace`` of sample time ``dt`` [s]."""
    N, B, C, D = system
    return _control().ss(N + np.eye(N.shape[0]), B[:, None], C[None, :], D, dt)


def transfer_function(system: System, dt: float) -> Any:
    """Return a system as a ``control.TransferFunction`` of sample time ``dt`` [s].

    The denominator is ``det(zI − A)``. The numerator is its product with the impulse response D,
    CB, CAB, …, which is as small as the numerator itself; in the difference of two characteristic
    polynomials it would be lost to their rounding errors.
    """
    N, B, C, D = System.balanced(*system)
    denominator = np.real(np.poly(1.0 + np.linalg.eigvals(N)))
    impulse_response, x = [D], B
    for _ in range(N.shape[0]):
        impulse_response.append(float(C @ x))
        x = x + N @ x
    numerator = np.convolve(denominator, impulse_response)[: denominator.size]
    # Cancel poles and zeros at z = 0: the last u may be a state of both plant and controller.
    while denominator.size > 1 and all(
        abs(part[-1]) < _ROUNDING * np.max(np.abs(part)) for part in (numerator, denominator)
    ):
        numerator, denominator = numerator[:-1], denominator[:-1]
    return _control().tf(
        np.trim_zeros(numerator, "f") if np.any(numerator) else [0.0], denominator, dt
    )


def _control() -> Any:
    return import_extra("control", "control", "conversion to python-control")
