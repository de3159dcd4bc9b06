"""Parts of a loop, open and closed, as sampled systems of one input and one output."""

from __future__ import annotations

import numpy as np

from quell import checks
from quell.controllers.linear.law import LinearLaw
from quell.lti.system import System
from quell.plants.sampled import SampledPlant
from quell.types import Matrix

# Source and target, a letter each, of the closed-loop responses that have a name.
_CLOSED = {"closed_loop": "ry", "PS": "dy", "CS": "nu", "S": "ny", "T": "ny"}
_OPEN = ("P", "C_r", "C_y", "L")


def closed_loop_matrix(A: Matrix, B: Matrix, C: Matrix, law: LinearLaw, inner: Matrix) -> Matrix:
    """Return the matrix of a sampled plant in closed loop with a law, the plant's states first.

    ``inner`` is ``law.A + B_u C``, the law with its own output applied. Pass A and ``inner`` both
    as they are, or both less the unit matrix.
    """
    plant_rows = [A + law.D_y * np.outer(B, C), np.outer(B, law.C)]
    return np.block([plant_rows, [np.outer(law.B_y + law.B_u * law.D_y, C), inner]])


def law_matrix(law: LinearLaw) -> Matrix:
    """Return ``A + B_u C − I``: the law with its own output applied, less the unit matrix."""
    return law.A - np.eye(law.A.shape[0]) + np.outer(law.B_u, law.C)


def subsystem(plant: SampledPlant, law: LinearLaw, name: str) -> System:
    """Return the part ``name`` of the loop; see ``LoopAnalysis.system``."""
    if "→" in name:
        source, _, target = (part.strip() for part in name.partition("→"))
        return closed_loop(plant, law, source, target)
    checks.one_of("name", name, (*_OPEN, *_CLOSED, "source → target"))
    if name in _OPEN:
        return _open_loop(plant, law, name)
    N, B, C, D = closed_loop(plant, law, *_CLOSED[name])
    if name == "S":  # from noise to the measured y + n
        return System(N, B, C, 1.0)
    return System(N, B, -C, -D) if name in ("CS", "T") else System(N, B, C, D)


def _open_loop(plant: SampledPlant, law: LinearLaw, name: str) -> System:
    if name == "P":
        return System(plant.N, plant.B, plant.C, 0.0)
    N = law_matrix(law)
    if name == "C_r":
        return System(N, law.B_r + law.B_u * law.D_r, law.C, law.D_r)
    C_y = System(N, law.B_y + law.B_u * law.D_y, -law.C, -law.D_y)
    if name == "C_y":
        return C_y
    n, m = plant.N.shape[0], N.shape[0]
    # L: the loop is broken at the plant's input, from which it leads through the plant to C_y.
    A: Matrix = np.block([[plant.N, np.zeros((n, m))], [np.outer(C_y.B, plant.C), N]])
    return System(A, np.append(plant.B, np.zeros(m)), np.concatenate([C_y.D * plant.C, C_y.C]), 0.0)


def closed_loop(plant: SampledPlant, law: LinearLaw, source: str, target: str) -> System:
    """Return the closed loop from an input to an output; see ``LoopAnalysis.closed_loop``."""
    disturbances = (f"w{i + 1}" for i in range(plant.E.shape[1]))
    checks.one_of("source", source, ("r", "d", "n", *disturbances))
    checks.one_of("target", target, ("y", "u", "e"))
    A = closed_loop_matrix(plant.N, plant.B, plant.C, law, law_matrix(law))
    m = law.A.shape[0]
    u_direct = {"r": law.D_r, "n": law.D_y}.get(source, 0.0)
    if source in ("r", "n"):
        into = law.B_r if source == "r" else law.B_y
        B = np.concatenate([plant.B * u_direct, into + law.B_u * u_direct])
    else:
        B = np.append(plant.B if source == "d" else plant.E[:, int(source[1:]) - 1], np.zeros(m))
    if target == "u":
        return System(A, B, np.concatenate([law.D_y * plant.C, law.C]), u_direct)
    C = np.append(plant.C, np.zeros(m))
    return System(A, B, C if target == "y" else -C, float(target == "e" and source == "r"))
