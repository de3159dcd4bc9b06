"""The extended state observer: design and update.

Extended model (paper eqs. (eq_2) and (eq.leso)), states ``z = (x̂_1 … x̂_n, Δf̂)``::

    x_i' = x_{i+1},    x_n' = −a·x + b0 u + f_L + Δf,    Δf' = 0

sampled exactly with zero-order hold to ``Φ, Γ_u, Γ_f``. Each sample::

    predict   z⁻ = Φ z + Γ_u u + Γ_f f_L          u: the control signal that was really applied
    correct   z  = z⁻ + L (y − z⁻_1)

All eigenvalues of ``(I − L C) Φ`` lie at ``exp(−omega_o dt)`` (the bandwidth parametrisation of Gao, ACC 2003, in the z-plane as
Miklosovic, Radke & Gao, ACC 2006). The *current* form hands ``z`` to the controller; the *predictor* form hands it ``z⁻``, which
knows y only up to the sample before: one sample of delay more, with the same poles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.observers.base import begin, observe
from quell.observers.canonical import canonical
from quell.observers.discretize import zero_order_hold
from quell.types import Matrix, Vector

FORMS = ("current", "predictor")
# In the coordinates of the design, where gains are O(1) and below: beyond this no pole is where it was put.
_LARGEST_GAIN = 1e6


class EsoModel(NamedTuple):
    """What the update needs, of order n with N = n + 1 states."""

    transition: Matrix
    """Φ (N, N)."""
    input: Vector
    """Γ_u (N,)."""
    feed: Vector
    """Γ_f (N,)."""
    gain: Vector
    """L (N,)."""
    predictor: bool
    """Whether the controller sees z⁻ rather than z."""


@observe.register(EsoModel)
def _observe(model: EsoModel, z: Vector, seen: Vector, y: float, u: float, f_learned: float) -> None:
    size = z.size
    for i in range(size):
        total = model.input[i] * u + model.feed[i] * f_learned
        for j in range(size):
            total += model.transition[i, j] * z[j]
        seen[i] = total
    error = y - seen[0]
    for i in range(size):
        z[i] = seen[i] + model.gain[i] * error
    if not model.predictor:
        for i in range(size):
            seen[i] = z[i]


@begin.register(EsoModel)
def _begin(model: EsoModel, z: Vector, seen: Vector, y: float) -> None:
    for i in range(z.size):
        z[i] = seen[i] = 0.0
    z[0] = seen[0] = y


@dataclass(frozen=True, eq=False)
class ESO:
    """An extended state observer of a plant of order 1 to 8; make it with ``model_free`` or ``model_based``.

    Attributes
    ----------
    a : (n,) array
        the plant's coefficients known to it, in ``y^(n) = −a·(y … y^(n−1)) + b0 u + f``; zero for a model-free one [1/s^(n−i)].
    b0 : float
        nominal control gain [y-unit / u-unit / s^n].
    omega_o : float
        observer bandwidth [rad/s].
    dt : float
        sample time [s].
    form : str
        ``"current"`` or ``"predictor"``.
    model : EsoModel
        Φ, Γ_u, Γ_f and L.

    Examples
    --------
    >>> observer = ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=1e-3)
    >>> observer.order, round(float(observer.model.gain[0]), 4)
    (4, 0.0488)
    """

    a: Vector
    b0: float
    omega_o: float
    dt: float
    form: str
    model: EsoModel

    @classmethod
    def model_free(cls, order: int, b0: float, omega_o: float, dt: float, *, form: str = "current") -> ESO:
        """Design an ESO that knows of the plant its order and nominal gain only (paper eq. (mfplant)).

        Parameters
        ----------
        order
            order n of the plant, 1 to 8.
        b0
            nominal control gain [y-unit / u-unit / s^n]; a factor of 2 off is usually tolerated, the wrong sign is not.
        omega_o
            observer bandwidth [rad/s]; below π/dt, and for a good result below about 0.5/dt.
        dt
            sample time [s].
        form
            ``"current"`` (default) or ``"predictor"``.

        Raises
        ------
        ValueError
            naming the argument, its value and the rule.
        """
        return cls._design(np.zeros(checks.whole("order", order, 1, 8)), b0, omega_o, dt, form)

    @classmethod
    def model_based(cls, plant: Any, omega_o: float, dt: float, *, b0: float | None = None, form: str = "current") -> ESO:
        """Design an ESO that knows a model of the plant (paper eq. (mbplant)).

        Parameters
        ----------
        plant
            a linear plant, ``control.StateSpace``, ``control.TransferFunction`` or ``(a, b)``; see ``canonical``.
        omega_o, dt, form
            as for ``model_free``.
        b0
            nominal control gain; the model's own by default.

        Raises
        ------
        ValueError
            as for ``model_free``, and where the plant is not observable from y or has zeros from u.
        """
        a, b, _ = canonical(plant)
        checks.whole("order of the plant", a.size, 1, 8)
        return cls._design(a, b if b0 is None else b0, omega_o, dt, form)

    @classmethod
    def _design(cls, a: Vector, b0: float, omega_o: float, dt: float, form: str) -> ESO:
        b0 = checks.nonzero("b0", b0, "it is the gain from u to the plant's highest derivative")
        omega_o, dt = checks.positive("omega_o", omega_o, "rad/s"), checks.positive("dt", dt, "s")
        checks.one_of("form", form, FORMS)
        if omega_o * dt >= math.pi:
            raise ValueError(
                f"omega_o = {omega_o!r} rad/s with dt = {dt!r} s: omega_o * dt = {omega_o * dt:.3g} must be below pi, "
                "no sampling can follow a bandwidth above half its rate; lower omega_o or dt"
            )
        return cls(a, b0, omega_o, dt, form, _sampled_design(a, b0, omega_o, dt, form == "predictor"))

    @property
    def order(self) -> int:
        """Order n of the plant; the observer has n + 1 states."""
        return int(self.a.size)

    @property
    def degree(self) -> int:
        """Relative degree from u to y: so many derivatives of y the controller shapes."""
        return self.order

    @property
    def cancel(self) -> Vector:
        """What the controller adds to cancel the modelled dynamics: ``cancel · x̂`` [y-unit/s^n]."""
        return self.a

    @property
    def cancel_f(self) -> float:
        """1.0 where the total disturbance enters as u does, else 0.0: then u has nothing to cancel but its effect on the state."""
        return 1.0

    @property
    def states(self) -> int:
        """Length of the observer's running state."""
        return self.order + 1

    @property
    def lag_time(self) -> float:
        """By how much the estimate of f trails f, ``N/omega_o`` [s]; at high sampling rates, and for what is slow."""
        return (self.order + 1) / self.omega_o

    @property
    def pole(self) -> float:
        """Where all poles of the observer lie in the z-plane, ``exp(−omega_o dt)``."""
        return math.exp(-self.omega_o * self.dt)


def continuous_gain(a: Vector, omega_o: float) -> Vector:
    """Return the gain ``l`` (N,) of the continuous-time ESO whose poles all lie at ``−omega_o``.

    With ``α_i`` the coefficients of ``(s + omega_o)^N`` and ``y^(n) + a_{n−1} y^(n−1) + … = f``, comparing powers of s in
    ``det(sI − A + lC)`` gives, with ``l_0 = 1``::

        l_i = α_i − Σ_{j<i} a_{n−i+j} l_j   for i = 1 … n,        l_N = omega_o^N

    The paper's Table I has another ``l_5`` (docs/theory, errata). Designs are sampled and do not use it; it is the limit that
    their gains ``L/dt`` must approach.
    """
    n = a.size
    ell = np.ones(n + 2)
    for i in range(1, n + 1):
        ell[i] = math.comb(n + 1, i) * omega_o**i - sum(a[n - i + j] * ell[j] for j in range(i))
    ell[n + 1] = omega_o ** (n + 1)
    return ell[1:]


def noise_gains(observer: ESO) -> Vector:
    """Return the variance of each estimate (N,) that white noise of unit variance in y leaves, as for a model-free observer.

    In continuous time ``x̂_i = Σ_{k=i}^{N} C(N, k) ω_o^k s^(N−k+i−1) / (s + ω_o)^N · y``, and sampled white noise has the density dt; so
    the variance is ``dt ω_o^(2i−1) ∫ |·|² dω / 2π`` of what is left at ω_o = 1. Good while ``omega_o dt`` is small.
    """
    size = observer.order + 1
    return observer.dt * observer.omega_o ** (2.0 * np.arange(size) + 1.0) * _unit_noise_gains(size)


@cache
def _unit_noise_gains(size: int) -> Vector:
    """Return the integrals of ``noise_gains``, which depend on the number of states only."""
    omega = np.geomspace(1e-4, 1e4, 4001)
    s = 1j * omega
    gains = np.empty(size)
    for i in range(1, size + 1):
        response = sum(math.comb(size, k) * s ** (size - k + i - 1) for k in range(i, size + 1)) / (s + 1.0) ** size
        gains[i - 1] = np.trapezoid(np.abs(response) ** 2, omega) / math.pi
    gains.flags.writeable = False
    return gains


def _sampled_design(a: Vector, b0: float, omega_o: float, dt: float, predictor: bool) -> EsoModel:
    """Sample the extended model and place the poles, in the coordinates ``x_i dt^(i−1)`` where all entries are O(1)."""
    size = a.size + 1
    scale = dt ** np.arange(size)
    A = np.diag(np.ones(size - 1), 1)  # f is the last state: it drives x_n through the same superdiagonal
    A[-2, :-1] -= a * dt ** (a.size - np.arange(a.size))
    B = np.zeros((size, 1))
    B[-2] = 1.0  # the effect of f_L; that of u is b0 times it
    with np.errstate(over="ignore", invalid="ignore"):
        phi, (feed,) = zero_order_hold(A, [B], 1.0)
    gain = _place(phi, -math.expm1(-omega_o * dt)) if np.all(np.isfinite(phi)) else np.full(size, np.nan)
    if not np.all(np.abs(gain) < _LARGEST_GAIN):
        fastest = np.max(np.abs(np.roots([1.0, *a[::-1]])), initial=0.0)
        raise ValueError(
            f"dt = {dt!r} s: too long (or omega_o = {omega_o!r} rad/s too small) for the plant's fastest pole of {fastest:.3g} rad/s; "
            "sampled, the model cannot be observed"
        )
    # Back to the plant's coordinates: x = scaled / scale; an input enters with the n-th power of dt.
    feed = feed[:, 0] * dt**a.size / scale
    return EsoModel(
        transition=np.ascontiguousarray(phi * scale[None, :] / scale[:, None]),
        input=b0 * feed,
        feed=feed,
        gain=gain / scale,
        predictor=predictor,
    )


def _place(phi: Matrix, one_minus_pole: float) -> Vector:
    """Return L that puts all eigenvalues of ``(I − L C) Φ`` at ``1 − one_minus_pole`` (Ackermann's formula for repeated poles).

    ``L = (Φ − βI)^N O⁻¹ e_N`` with the rows ``C Φ (Φ − I)^i`` for O: differences instead of powers leave ``O⁻¹ e_N`` as it is
    and make O triangular for a chain of integrators, where powers would be nearly parallel.
    """
    size = phi.shape[0]
    difference = phi - np.eye(size)
    rows = np.empty((size, size))
    rows[0] = phi[0]
    for i in range(1, size):
        rows[i] = rows[i - 1] @ difference
    try:
        vector = np.linalg.solve(rows, np.eye(size)[-1])
    except np.linalg.LinAlgError:
        return np.full(size, np.nan)
    shifted = difference + one_minus_pole * np.eye(size)
    for _ in range(size):
        vector = shifted @ vector
    return vector
