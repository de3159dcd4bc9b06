"""Linear plants, sampled exactly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.described import Described
from quell.lti.discretize import zero_order_hold
from quell.lti.models import TransferFunction, check_matrices, read_model, to_state_space
from quell.plants.base import advance, measure
from quell.types import Matrix, Vector


class LinearModel(NamedTuple):
    """A sampled linear plant: ``x⁺ = Φ x + Γ u + Γ_w w``, ``y = C x``."""

    transition: Matrix  # Φ (n, n)
    input: Vector  # Γ (n,)
    disturbance: Matrix  # Γ_w (n, m)
    output: Vector  # C (n,)


@measure.register(LinearModel)
def _measure(plant: LinearModel, x: Vector) -> float:
    y = 0.0
    for i in range(plant.output.size):
        y += plant.output[i] * x[i]
    return y


@advance.register(LinearModel)
def _advance(plant: LinearModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector) -> None:
    # The sizes of a model's arrays are known to the compiler, those of x and w are not.
    size, inputs = plant.disturbance.shape
    for i in range(size):
        total = 0.0
        for j in range(inputs):
            total += plant.disturbance[i, j] * w[j]
        for j in range(size):
            total += plant.transition[i, j] * x[j]
        scratch[i] = total + plant.input[i] * u  # u last: it is calculated meanwhile
    for i in range(size):
        x[i] = scratch[i]


@dataclass(frozen=True, eq=False, repr=False)
class LinearPlant(Described):
    """A linear plant ``x' = A x + B u + E w``, ``y = C x`` of any size with one input and output.

    Parameters
    ----------
    A
        (n, n).
    B
        (n,) or (n, 1).
    C
        (n,) or (1, n).
    E
        (n, m), m ≥ 0 disturbance inputs; by default the disturbance enters as u does.
    name
        for tables and plots.

    Raises
    ------
    ValueError
        if shapes do not fit or an entry is not finite.
    """

    A: Any
    B: Any
    C: Any
    E: Any = None
    name: str = "linear plant"
    compiled = True

    def __post_init__(self) -> None:
        A, B, C = check_matrices(self.A, self.B, self.C)
        E = B if self.E is None else checks.matrix("E", self.E, A.shape[0])
        for name, value in (("A", A), ("B", B), ("C", C), ("E", E)):
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, model: Any, E: Any = None, *, name: str = "linear plant") -> LinearPlant:
        """Return the plant that ``model`` describes, of any kind that functions of quell accept.

        Parameters
        ----------
        model
            one of

            * matrices ``(A, B, C)``, or ``(A, B, E, C)`` as in the paper's eq. (1), in a tuple or a
              list; B, E and C may be vectors,
            * a transfer function ``(numerator, denominator)``, sequences in descending powers of s,
            * ``(a, b)`` with a number b: ``y^(n) = −a_0 y − … − a_{n−1} y^(n−1) + b u``,
            * a continuous-time ``control.StateSpace`` or ``control.TransferFunction``, of one input
              and output, with D = 0,
            * the same of scipy.signal: ``StateSpace``, ``TransferFunction``, ``ZerosPolesGain``,
            * a ``LinearPlant``, which is returned as it is, or anything else with A, B and C.
        E
            input of the disturbance: a column (n,) or (n, 1), or the index of one of the plant's
            own disturbance inputs. By default a plant keeps its own, and in other models the
            disturbance enters where u does.
        name
            for tables and plots.

        Returns
        -------
        LinearPlant
            with the model's own states. For a transfer function
            ``(c_{n−1} s^(n−1) + … + c_0)/(s^n + a_{n−1} s^(n−1) + … + a_0)`` the states
            [y-unit/s^(i−1)] are y and its derivatives without zeros, and ``x_1 = y``,
            ``x_{i+1} = x_i' + a_{n−i} y − c_{n−i} u`` with zeros.

        Raises
        ------
        ValueError
            if shapes do not fit, an entry is not finite, y follows u at once, the model is of
            discrete time, or it is no linear model.

        Examples
        --------
        >>> motor = LinearPlant.of(([50.0], [1.0, 22.0, 40.0, 0.0]))
        >>> motor.order, motor.B[:, 0].tolist()
        (3, [0.0, 0.0, 50.0])
        """
        if isinstance(model, cls) and E is None:
            return model
        found = read_model(model, E)
        if isinstance(found, TransferFunction):
            found = to_state_space(found)
        column = getattr(model, "E", None) if found.E is None else found.E[:, None]
        return cls(found.A, found.B, found.C, column, name=name)

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs."""
        return int(self.E.shape[1])

    def sampled(self, dt: float, interpret: bool = False) -> LinearModel:
        """Return the plant sampled at ``dt`` [s] with zero-order hold on u and w."""
        inputs = [self.B, self.E]
        phi, (gamma, gamma_w) = zero_order_hold(self.A, inputs, checks.positive("dt", dt, "s"))
        if not all(np.isfinite(part).all() for part in (phi, gamma, gamma_w)):
            raise ValueError(
                f"dt = {dt!r} s: {self.name} can't be sampled with it, exp(A dt) is beyond all "
                "numbers; check the units of dt and of the plant"
            )
        return LinearModel(phi, gamma[:, 0].copy(), gamma_w, self.C[0].copy())
