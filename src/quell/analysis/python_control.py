"""A loop's parts as systems of python-control, an optional extra."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from quell import checks
from quell.analysis.frequency_response import System
from quell.optional import import_extra
from quell.types import Matrix, Vector

if TYPE_CHECKING:
    from quell.analysis.loop import LoopAnalysis

_CLOSED = {
    "closed_loop": ("r", "y"),
    "PS": ("d", "y"),
    "CS": ("n", "u"),
    "S": ("n", "y"),
    "T": ("n", "y"),
}
# Least coefficient of a polynomial, of its largest.
_ROUNDING = 1e-13
_PARTS = ("P", "C_r", "C_y", "L")


def state_space(loop: LoopAnalysis, name: str) -> Any:
    """Return a part of the loop as a ``control.StateSpace``; see ``LoopAnalysis.system``."""
    N, B, C, D = _named(loop, name)
    return import_extra("control", "control", "a python-control system").ss(
        N + np.eye(N.shape[0]), B[:, None], C[None, :], D, loop.dt
    )


def transfer_function(loop: LoopAnalysis, name: str) -> Any:
    """Return a part of the loop as a ``control.TransferFunction``; see ``LoopAnalysis.transfer_function``.

    The denominator is ``det(zI − A)``; the numerator is its product with the impulse response D, CB, CAB, …, which has the numerator's
    own size: the difference of two characteristic polynomials would lose it to their rounding.
    """
    N, B, C, D = System.balanced(*_named(loop, name))
    denominator = np.real(np.poly(1.0 + np.linalg.eigvals(N)))
    pulse, x = [D], B
    for _ in range(N.shape[0]):
        pulse.append(float(C @ x))
        x = x + N @ x
    numerator = np.convolve(denominator, pulse)[: denominator.size]
    # What is a pole at z = 0 in both is u of the sample before, counted twice.
    while denominator.size > 1 and all(
        abs(part[-1]) < _ROUNDING * np.max(np.abs(part)) for part in (numerator, denominator)
    ):
        numerator, denominator = numerator[:-1], denominator[:-1]
    return import_extra("control", "control", "a python-control system").tf(
        np.trim_zeros(numerator, "f") if np.any(numerator) else [0.0], denominator, loop.dt
    )


def _named(loop: LoopAnalysis, name: str) -> System:
    if "→" in name:
        source, _, target = (part.strip() for part in name.partition("→"))
        return loop.closed_loop(source, target)
    checks.one_of("name", name, (*_PARTS, *_CLOSED, "source → target"))
    if name in _PARTS:
        return _part(loop, name)
    N, B, C, D = loop.closed_loop(*_CLOSED[name])
    if name == "S":  # from noise to what is measured
        return System(N, B, C, 1.0)
    return System(N, B, -C, -D) if name in ("CS", "T") else System(N, B, C, D)


def _part(loop: LoopAnalysis, name: str) -> System:
    P, law = loop.plant, loop.law
    if name == "P":
        return System(P.N, P.B, P.C, 0.0)
    N = law.A - np.eye(law.A.shape[0]) + np.outer(law.B_u, law.C)
    if name == "C_r":
        return System(N, law.B_r + law.B_u * law.D_r, law.C, law.D_r)
    C_y = System(N, law.B_y + law.B_u * law.D_y, -law.C, -law.D_y)
    if name == "C_y":
        return C_y
    n, m = P.N.shape[0], N.shape[0]
    # The loop broken at the plant's input: into P, and what comes out of C_y.
    big: Matrix = np.block([[P.N, np.zeros((n, m))], [np.outer(C_y.B, P.C), N]])
    into: Vector = np.concatenate([P.B, np.zeros(m)])
    return System(big, into, np.concatenate([C_y.D * P.C, C_y.C]), 0.0)
