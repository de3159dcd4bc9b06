"""Sampled plants and laws of several inputs and outputs, as matrices."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.analysis.linearise import linear_law, within_noise
from quell.controllers.allocation import update_gain
from quell.controllers.axes import Axes
from quell.controllers.linear import LinearLaw
from quell.plants.channels import DelayedInputs, EncodedOutputs
from quell.plants.linear import LinearModelOfMany, LinearPlant
from quell.plants.linearise import linearised
from quell.plants.nonlinear import NonlinearPlant, checked_point
from quell.types import Matrix

# A gain that is smaller, as a share of the terms whose sum it is, is their rounding.
_CANCELLED = 1e-6


class MatrixLaw(NamedTuple):
    """A sampled linear controller: ``x⁺ = A x + B_y y + B_r r``, ``u = C x + D_y y + D_r r``."""

    A: Matrix  # (k, k)
    B_y: Matrix  # (k, p)
    B_r: Matrix  # (k, number of references)
    C: Matrix  # (m, k)
    D_y: Matrix  # (m, p)
    D_r: Matrix  # (m, number of references)


def sampled_matrices(
    plant: Any, dt: float, operating_point: Any = None
) -> tuple[Matrix, Matrix, Matrix]:
    """Return A, B, C of a plant with several inputs and outputs, sampled, with delays as states.

    Parameters
    ----------
    plant
        a ``LinearPlant`` or what it is made ``of``, (A, B, C) in continuous time; one
        behind delays or encoders, which are left out; a ``NonlinearPlant``, linearised
        at the operating point; a sampled plant: what a ``LinearPlant`` of several signals is
        ``sampled`` to, or a system with A, B, C
        and the same ``dt``.
    dt
        sample time [s].
    operating_point
        (x, u) of a nonlinear plant.

    Raises
    ------
    ValueError
        for another plant, one of another sample time, a nonlinear one without operating point.
    """
    if isinstance(plant, LinearModelOfMany):
        return plant_matrices((plant.transition, plant.input, plant.output))
    if getattr(plant, "A", None) is not None and getattr(plant, "dt", None):
        if plant.dt is True or not math.isclose(plant.dt, dt, rel_tol=1e-9):
            raise ValueError(
                f"plant is sampled with dt = {plant.dt!r} s, the controller with {dt!r} s: must be "
                "the same"
            )
        return plant_matrices(plant)
    linear, waiting = linear_part_of(plant, dt, operating_point)
    A, B, C = linear.sampled_matrices(dt)[:3]
    for j, samples in enumerate(waiting):
        for _ in range(samples):
            n, m = B.shape
            A = np.block([[A, B[:, j : j + 1]], [np.zeros((1, n + 1))]])
            B, C = np.vstack([B, np.zeros((1, m))]), np.hstack([C, np.zeros((C.shape[0], 1))])
            B[:, j] = np.eye(n + 1)[n]
    return plant_matrices((A, B, C))


def linear_part_of(
    plant: Any, dt: float, operating_point: Any = None
) -> tuple[LinearPlant, tuple[int, ...]]:
    """Return a plant without delays and encoders, in continuous time, and the delays [samples].

    There is a delay for each input. Plants and errors are those of ``sampled_matrices``, but for
    sampled plants, which have no model in continuous time.
    """
    waiting: Any = 0
    while isinstance(plant, DelayedInputs | EncodedOutputs):
        if isinstance(plant, DelayedInputs):
            plant.sampled(dt)  # made for this dt
            waiting = waiting + np.array(plant.samples)
        plant = plant.plant
    if isinstance(plant, NonlinearPlant):
        if operating_point is None:
            raise ValueError(
                f"plant = {plant.name!r} is nonlinear: give the point at which it is linearised, "
                "operating_point=(x, u)"
            )
        plant = linearised(plant, *checked_point(operating_point))
    linear = LinearPlant.of(plant)
    return linear, tuple(np.broadcast_to(waiting, linear.inputs).tolist())


def high_gains(A: Matrix, B: Matrix, C: Matrix) -> tuple[Matrix, list[int]]:
    """Return the gains from u to the first derivative of each y that u reaches, and its order."""
    found, degrees = np.zeros((C.shape[0], B.shape[1])), []
    for i, row in enumerate(C):
        bound, degree = np.abs(row), 1
        while degree < A.shape[0]:
            found[i] = row @ B
            if np.any(np.abs(found[i]) > _CANCELLED * (bound @ np.abs(B))):
                break
            row, bound, degree = row @ A, bound @ np.abs(A), degree + 1
        degrees.append(degree)
    return found, degrees


def gain_at(axes: Axes, x: Any = None) -> tuple[Matrix, Matrix]:
    """Return B0 (n, m) and B0⁺ (m, n) of axes, for the estimates ``x[axis, derivative]``.

    Where B0 is a function, x is zero by default. Raises ``ValueError`` if it has no value there.
    """
    state = axes.initial_state()
    point = state.x if x is None else np.asarray(x, dtype=np.float64)
    if update_gain(axes.parameters.gain, state.gain, point):
        raise ValueError(f"B0 at x = {point.tolist()!r}: is not finite, or has no inverse")
    return axes.b0[:, None] * state.gain.B, state.gain.inverse / axes.b0


def estimates_at(axes: Axes, plant: Any, operating_point: Any) -> Matrix | None:
    """Return the estimates of axes at rest at an operating point: y, with derivatives of zero."""
    if operating_point is None:
        return None
    while isinstance(plant, DelayedInputs | EncodedOutputs):
        plant = plant.plant
    if not isinstance(plant, NonlinearPlant):
        return None
    state = checks.vector("x", checked_point(operating_point)[0], plant.order)
    model: Any = plant.sampled(axes.dt, interpret=True)
    y = checks.vector("output", model.output(state), axes.outputs)
    estimates = axes.initial_state().x
    estimates[:, 0] = y
    return estimates


def gain_ratios(plant: Any, axes: Axes, operating_point: Any = None) -> Any:
    """Return the eigenvalues of ``B B0⁺`` (n,), with the gains B of a plant.

    There are none for a plant that was given sampled, and where u first reaches other derivatives
    of y than the axes assume.
    """
    if isinstance(plant, LinearModelOfMany) or getattr(plant, "dt", None):
        return np.zeros(0)
    linear = linear_part_of(plant, axes.dt, operating_point)[0]
    B, degrees = high_gains(linear.A, linear.B, linear.C)
    if degrees != [axis.observer.degree for axis in axes.axes]:
        return np.zeros(0)
    return np.linalg.eigvals(B @ gain_at(axes, estimates_at(axes, plant, operating_point))[1])


def law_of_axes(axes: Axes, x: Any = None, noise_hides: bool = False) -> MatrixLaw:
    """Return the linear law of axes without limits, learners at rest, B0 as in ``gain_at``.

    With ``noise_hides`` it is that of motions which the learners' gates take for noise.

    The references are those of the axes; of compensators without drives u_0 (m,) takes their
    place. With drives the law is that of drives and compensators together. Raises ``ValueError``
    for a drive without a linear law.
    """
    B0, inverse = gain_at(axes, x)
    learners = [within_noise(axis) if noise_hides else None for axis in axes.axes]
    found = (linear_law(axis, at) for axis, at in zip(axes.axes, learners, strict=True))
    laws = [_asking(law, b0, axes.compensates) for law, b0 in zip(found, axes.b0, strict=True)]
    law = joined(laws, inverse)
    if not axes.compensates:
        return law
    # Each compensator is asked for (B0 u_0)_i; what B0 does not see of u_0 passes (more actuators
    # than axes).
    passes = np.eye(B0.shape[1]) - inverse @ B0
    law = law._replace(B_r=law.B_r @ B0, D_r=law.D_r @ B0 + passes)
    return _behind(_law_of_drives(axes), law) if axes.drives else law


def _asking(law: LinearLaw, b0: float, compensates: bool) -> LinearLaw:
    """Return a law of u that asks for ``v = b0 u``; the reference of a compensator is in v, too."""
    asked = law._replace(C=b0 * law.C, D_r=b0 * law.D_r, D_y=b0 * law.D_y, B_u=law.B_u / b0)
    return asked._replace(B_r=law.B_r / b0, D_r=law.D_r) if compensates else asked


def _law_of_drives(axes: Axes) -> MatrixLaw:
    """Return the law of the drives, from y and r to u_0."""
    laws = []
    for name, drive in zip(axes.names, axes.drives, strict=True):
        try:
            laws.append(linear_law(drive))
        except ValueError as error:
            raise ValueError(f"drives: {name}: NOT judged, it has no linear law: {error}") from None
    return joined(laws, np.eye(len(laws)))


def _behind(drives: MatrixLaw, law: MatrixLaw) -> MatrixLaw:
    """Return the law with drives whose u_0 takes the place of its references."""
    k = drives.A.shape[0]
    return MatrixLaw(
        A=np.block([[drives.A, np.zeros((k, law.A.shape[0]))], [law.B_r @ drives.C, law.A]]),
        B_y=np.vstack([drives.B_y, law.B_y + law.B_r @ drives.D_y]),
        B_r=np.vstack([drives.B_r, law.B_r @ drives.D_r]),
        C=np.hstack([law.D_r @ drives.C, law.C]),
        D_y=law.D_y + law.D_r @ drives.D_y,
        D_r=law.D_r @ drives.D_r,
    )


def axes_law(laws: Sequence[LinearLaw], B0: Any) -> MatrixLaw:
    """Return the law of several axes, ``u = B0⁻¹ v``, with the v of a law for each axis.

    Raises ``ValueError`` for a B0 that is not square or has no inverse.

    Parameters
    ----------
    laws
        the law of each axis, from y_i and r_i to v_i (``linear_law`` of a controller with b0 = 1).
    B0
        gain matrix (axes, axes), ``y_i^(n_i) = f_i + (B0 u)_i``.
    """
    laws = list(laws)
    axes = len(laws)
    if not axes or not all(isinstance(law, LinearLaw) for law in laws):
        raise ValueError(f"laws = {laws!r}: must have a quell.controllers.LinearLaw for each axis")
    B0 = checks.matrix("B0", B0)
    if B0.shape != (axes, axes):
        raise ValueError(
            f"B0 has shape {B0.shape}: must be ({axes}, {axes}), a row for each of the {axes} axes "
            "and a column for each actuator"
        )
    if np.linalg.matrix_rank(B0) < axes:
        raise ValueError(f"B0 = {B0.tolist()!r}: must have an inverse, u = B0⁻¹ v")
    return joined(laws, np.linalg.inv(B0))


def joined(laws: Sequence[LinearLaw], inverse: Matrix) -> MatrixLaw:
    """Return the law of axes with ``u = inverse v``."""
    from scipy.linalg import block_diag

    def whole(of: Callable[[LinearLaw], Any]) -> Matrix:
        return block_diag(*(of(law) for law in laws))

    return MatrixLaw(
        A=whole(lambda law: law.A + np.outer(law.B_u, law.C)),
        B_y=whole(lambda law: (law.B_y + law.B_u * law.D_y)[:, None]),
        B_r=whole(lambda law: (law.B_r + law.B_u * law.D_r)[:, None]),
        C=inverse @ whole(lambda law: law.C[None]),
        D_y=inverse @ np.diag([law.D_y for law in laws]),
        D_r=inverse @ np.diag([law.D_r for law in laws]),
    )


def plant_matrices(plant: Any) -> tuple[Matrix, Matrix, Matrix]:
    """Return A (n, n), B (n, m), C (p, n) of a sampled plant, checked.

    Raises ``ValueError`` for other objects, matrices that do not fit, or direct feedthrough.
    """
    parts = plant
    if all(hasattr(plant, name) for name in "ABC"):
        parts = (plant.A, plant.B, plant.C, getattr(plant, "D", None))
    if not isinstance(parts, tuple | list) or len(parts) not in (3, 4):
        raise ValueError(
            f"plant = {plant!r}: must be sampled matrices (A, B, C), or an object that has them"
        )
    A, B, C = parts[:3]
    A = checks.matrix("A", A)
    n = A.shape[0]
    if A.shape != (n, n):
        raise ValueError(f"A has shape {A.shape}: must be square, a row for each state")
    B, C = checks.matrix("B", B), checks.matrix("C", C)
    if B.shape[0] != n:
        raise ValueError(
            f"B has shape {B.shape} and A has shape {A.shape}: B must have a row for each of the "
            f"{n} states, and a column for each control signal"
        )
    if C.shape[1] != n:
        raise ValueError(
            f"C has shape {C.shape} and A has shape {A.shape}: C must have a row for each output, "
            f"and a column for each of the {n} states"
        )
    if len(parts) == 4 and parts[3] is not None and np.any(parts[3]):
        raise ValueError(
            f"D = {np.asarray(parts[3]).tolist()}: must be zero, the outputs may not follow the "
            "control signals at once; add the delay of the sensors as states"
        )
    return A, B, C


def law_matrices(law: Any, m: int, p: int) -> MatrixLaw:
    """Return a law with checked shapes, for m control signals and p measurements."""
    parts = tuple(law) if isinstance(law, tuple | list) else None
    if parts is None or len(parts) not in (4, 6):
        raise ValueError(
            f"law = {law!r}: must be a MatrixLaw, matrices (A, B_y, B_r, C, D_y, D_r), or "
            "(A, B_y, C, D_y) without references"
        )
    if len(parts) == 4:
        A, B_y, C, D_y = parts
        parts = (A, B_y, np.zeros((np.shape(A)[0], 0)), C, D_y, np.zeros((m, 0)))
    found = MatrixLaw(*map(checks.matrix, MatrixLaw._fields, parts))
    k, references = found.A.shape[0], found.B_r.shape[1]
    what = {
        "A": ((k, k), "a row and a column for each state of the law"),
        "B_y": ((k, p), f"a row for each state of the law, a column for each of the {p} outputs"),
        "B_r": ((k, references), "a row for each state of the law, a column for each reference"),
        "C": ((m, k), f"a row for each of the {m} control signals, a column for each state"),
        "D_y": ((m, p), f"a row for each of the {m} control signals, a column for each output"),
        "D_r": (
            (m, references),
            f"a row for each of the {m} control signals, as many columns as B_r",
        ),
    }
    for name, (shape, meaning) in what.items():
        if getattr(found, name).shape != shape:
            raise ValueError(
                f"law: {name} has shape {getattr(found, name).shape}, with A of shape "
                f"{found.A.shape}: must be {shape}, {meaning}"
            )
    return found
