"""The extended state observer: design and update.

Extended model (paper eqs. (eq_2) and (eq.leso)), states ``z = (x̂_1 … x̂_n, Δf̂)``::

    x_i' = x_{i+1},    x_n' = −a·x + b0 u + f_L + Δf,    Δf' = 0

sampled exactly with zero-order hold to ``Φ, Γ_u, Γ_f``. Each sample::

    predict   z⁻ = Φ z + Γ_u u + Γ_f f_L          u: the control signal that was really applied
    correct   z  = z⁻ + L (y − z⁻_1)

All eigenvalues of ``(I − L C) Φ`` lie at ``exp(−omega_o dt)`` (the bandwidth parametrisation of Gao, ACC 2003, in the z-plane as
Miklosovic, Radke & Gao, ACC 2006). The *current* form hands ``z`` to the controller; the *predictor* form hands it ``z⁻``, which
knows y only up to the sample before: one sample of delay more, with the same poles. The *reduced* form is a current one with one of its
poles at z = 0: ``L_1 = 1`` and ``x̂_1 = y``, and the other n are those of the reduced-order observer, at ``exp(−omega_o dt)``.

With *half gain* the correction is L/2: nearly the same loop for half the gain from noise (Herbst, Hempel, Göhrt & Streif, IFAC World
Congress 2020, arXiv 2003.03986; Herbst & Madonski, arXiv 2211.07309). Other forms are in files of their own: ``cascade``, ``nonlinear``,
``kalman_gains``, and ``delay`` for a known delay of u.
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
from quell.observers.cascade import cascade_model
from quell.observers.delay import delayed_model
from quell.observers.discretize import zero_order_hold
from quell.observers.kalman_gains import kalman_gain
from quell.observers.nonlinear import NonlinearModel
from quell.observers.response import response, scaled, settling_samples, without_delay
from quell.types import Matrix, Vector

FORMS = ("current", "predictor", "reduced")
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

    @property
    def states(self) -> int:
        """Length of the running state."""
        return int(self.gain.size)


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
    """An extended state observer of a plant of order 1 to 8.

    Make it with ``model_free`` or ``model_based``; ``kalman``, ``cascade`` and ``nonlinear`` are for other gains and structures.

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
        ``"current"``, ``"predictor"`` or ``"reduced"``.
    model
        parameters of its update, for example an ``EsoModel``: Φ, Γ_u, Γ_f and L.
    tuning : str
        where its gains come from: ``"bandwidth"``, ``"half-gain"``, ``"kalman"``, ``"cascade"`` or ``"nonlinear"``.

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
    model: Any
    tuning: str = "bandwidth"

    @classmethod
    def model_free(
        cls, order: int, b0: float, omega_o: float, dt: float, *, form: str = "current", half_gain: bool = False, delay: float = 0.0
    ) -> ESO:
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
            ``"current"`` (default), ``"predictor"`` or ``"reduced"``.
        half_gain
            whether to halve the gains; not for the reduced form. It takes from the noise in f̂ 30 % at order 1, 20 % at order 3, and nothing
            from order 5 on.
        delay
            after how long u reaches the plant [s], a whole number of samples.

        Raises
        ------
        ValueError
            naming the argument, its value and the rule.
        """
        return cls._design(np.zeros(checks.whole("order", order, 1, 8)), b0, omega_o, dt, form, half_gain, delay)

    @classmethod
    def model_based(
        cls,
        plant: Any,
        omega_o: float,
        dt: float,
        *,
        b0: float | None = None,
        form: str = "current",
        half_gain: bool = False,
        delay: float = 0.0,
    ) -> ESO:
        """Design an ESO that knows a model of the plant (paper eq. (mbplant)).

        Parameters
        ----------
        plant
            a linear plant, ``control.StateSpace``, ``control.TransferFunction`` or ``(a, b)``; see ``canonical``.
        omega_o, dt, form, half_gain, delay
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
        return cls._design(a, b if b0 is None else b0, omega_o, dt, form, half_gain, delay)

    @classmethod
    def cascade(cls, order: int, b0: float, omega_o: float, dt: float, *, levels: int = 2, ratio: float = 2.0, delay: float = 0.0) -> ESO:
        """Design a cascade of model-free observers (``cascade.py``): for the same rejection of disturbances, less noise in u.

        Parameters
        ----------
        order, b0, dt, delay
            as for ``model_free``.
        omega_o
            bandwidth of the last level, the fastest [rad/s].
        levels
            how many, p; with one it is the ESO of ``model_free``.
        ratio
            by how much each is faster than the one before, α; the first has ``omega_o / α^(p−1)``.

        Raises
        ------
        ValueError
            naming the argument, its value and the rule.
        """
        p, ratio = checks.whole("levels", levels, 1, 8), checks.positive("ratio", ratio)
        last = cls.model_free(order, b0, omega_o, dt)
        models = [cls.model_free(order, b0, omega_o / ratio ** (p - 1 - i), dt).model for i in range(p)]
        model = delayed_model(cascade_model(models), delay, dt)
        return cls(last.a, last.b0, last.omega_o, last.dt, "current", model, "cascade")

    @classmethod
    def nonlinear(cls, order: int, b0: float, omega_o: float, dt: float, *, delta: float, alpha: Any = None, delay: float = 0.0) -> ESO:
        """Design Han's nonlinear observer (``nonlinear.py``): the linear one while ``|y − z⁻_1|`` is below delta, gentler beyond.

        A learner or a guard can not be had with it: both need the observer's exact lag.

        Parameters
        ----------
        order, b0, omega_o, dt, delay
            as for ``model_free``.
        delta
            up to which error it is linear, δ [y-unit].
        alpha
            the powers α (n + 1,) beyond, above 0 and at most 1; 1, 1/2, 1/4, … by default, as Han has them.

        Raises
        ------
        ValueError
            naming the argument, its value and the rule.
        """
        linear = cls.model_free(order, b0, omega_o, dt)
        delta = checks.positive("delta", delta, "y-unit")
        powers: Vector = 0.5 ** np.arange(order + 1.0) if alpha is None else checks.vector("alpha", alpha, order + 1)
        if not np.all((powers > 0.0) & (powers <= 1.0)):
            raise ValueError(f"alpha = {alpha!r}: each entry must be above 0 and at most 1")
        known = linear.model
        model = NonlinearModel(known.transition, known.input, known.feed, known.gain, powers, delta)
        return cls(linear.a, linear.b0, linear.omega_o, linear.dt, "current", delayed_model(model, delay, dt), "nonlinear")

    @classmethod
    def kalman(
        cls,
        order: int,
        b0: float,
        dt: float,
        *,
        noise: float,
        drift: float,
        jitter: float = 0.0,
        form: str = "current",
        delay: float = 0.0,
    ) -> ESO:
        """Design a model-free ESO with the steady-state Kalman gain (``kalman_gains.py``): the least variance, if the densities are right.

        Its ``omega_o`` is the geometric mean of its poles, ``|ln z_i|/dt``: what learners and guards take for its speed.

        Parameters
        ----------
        order, b0, dt, delay
            as for ``model_free``.
        noise
            variance of the measurement's noise in each sample [y-unit²].
        drift
            density of the white noise whose integral f is [(y-unit/s^n)²/s]: f moves by ``√(drift T)`` in the time T.
        jitter
            density of white noise in f itself [(y-unit/s^n)² s].
        form
            ``"current"`` or ``"predictor"``.

        Raises
        ------
        ValueError
            naming the argument, its value and the rule.
        """
        n = checks.whole("order", order, 1, 8)
        noise, drift = checks.positive("noise", noise), checks.positive("drift", drift)
        jitter, dt = checks.non_negative("jitter", jitter), checks.positive("dt", dt, "s")
        checks.one_of("form", form, FORMS[:2])
        gain, omega_o = kalman_gain(np.diag(np.ones(n), 1), dt, noise, drift, jitter)
        plain = cls.model_free(n, b0, omega_o, dt, form=form)
        model = delayed_model(plain.model._replace(gain=gain), delay, dt)
        return cls(plain.a, plain.b0, omega_o, dt, form, model, "kalman")

    @classmethod
    def _design(cls, a: Vector, b0: float, omega_o: float, dt: float, form: str, half_gain: bool, delay: float) -> ESO:
        b0 = checks.nonzero("b0", b0, "it is the gain from u to the plant's highest derivative")
        omega_o, dt = checks.positive("omega_o", omega_o, "rad/s"), checks.positive("dt", dt, "s")
        checks.one_of("form", form, FORMS)
        if omega_o * dt >= math.pi:
            raise ValueError(
                f"omega_o = {omega_o!r} rad/s with dt = {dt!r} s: omega_o * dt = {omega_o * dt:.3g} must be below pi, "
                "no sampling can follow a bandwidth above half its rate; lower omega_o or dt"
            )
        if checks.flag("half_gain", half_gain) and form == "reduced":
            raise ValueError(
                "half_gain = True with form = 'reduced': with half its gain it would not be of reduced order; use form='current'"
            )
        model = _sampled_design(a, b0, omega_o, dt, form)
        if half_gain:
            model = model._replace(gain=0.5 * model.gain)
        return cls(a, b0, omega_o, dt, form, delayed_model(model, delay, dt), "half-gain" if half_gain else "bandwidth")

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
        return int(self.model.states)

    @property
    def has_one_pole(self) -> bool:
        """Whether all its poles lie in one place: as designed by the bandwidth, at full gain and full order."""
        return self.tuning == "bandwidth" and self.form != "reduced"

    @property
    def lag_time(self) -> float:
        """How long it takes [s], ``Σ 1/|p_i|`` over its poles: ``N/omega_o`` where they lie in one place.

        By so much the estimate of f trails a slow f, at high sampling rates. (That of a cascade trails it by less.)
        """
        if self.has_one_pole or self.tuning == "nonlinear":
            return (self.order + 1) / self.omega_o
        return self.dt * settling_samples(scaled(response(without_delay(self.model), self.order + 1), self.dt))

    @property
    def pole(self) -> float:
        """What the bandwidth is in the z-plane, ``exp(−omega_o dt)``; where all poles lie, if they lie in one place."""
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
    """Return the variance of each estimate (N,) that white noise of unit variance in y leaves.

    Where the poles lie in one place, it is that of a model-free observer. In continuous time
    ``x̂_i = Σ_{k=i}^{N} C(N, k) ω_o^k s^(N−k+i−1) / (s + ω_o)^N · y``, and sampled white noise has the density dt; so the variance is
    ``dt ω_o^(2i−1) ∫ |·|² dω / 2π`` of what is left at ω_o = 1. Good while ``omega_o dt`` is small. Of other observers it is the diagonal
    of ``C P Cᵀ + d_y d_yᵀ`` with ``P = M P Mᵀ + g_y g_yᵀ`` (``response.py``).
    """
    size = observer.order + 1
    if not observer.has_one_pole:
        return _exact_noise_gains(observer)
    return observer.dt * observer.omega_o ** (2.0 * np.arange(size) + 1.0) * _unit_noise_gains(size)


def _exact_noise_gains(observer: ESO) -> Vector:
    from scipy.linalg import solve_discrete_lyapunov

    found = scaled(response(without_delay(observer.model), observer.order + 1), 1.0 / observer.omega_o)
    g_y, d_y = found.inputs[:, 0], found.through[:, 0]
    P = solve_discrete_lyapunov(found.transition, np.outer(g_y, g_y))
    return np.asarray(np.einsum("ij,jk,ik->i", found.seen, P, found.seen) + d_y**2)


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


def _sampled_design(a: Vector, b0: float, omega_o: float, dt: float, form: str) -> EsoModel:
    """Sample the extended model and place the poles, in the coordinates ``x_i dt^(i−1)`` where all entries are O(1)."""
    size = a.size + 1
    scale = dt ** np.arange(size)
    A = np.diag(np.ones(size - 1), 1)  # f is the last state: it drives x_n through the same superdiagonal
    A[-2, :-1] -= a * dt ** (a.size - np.arange(a.size))
    B = np.zeros((size, 1))
    B[-2] = 1.0  # the effect of f_L; that of u is b0 times it
    with np.errstate(over="ignore", invalid="ignore"):
        phi, (feed,) = zero_order_hold(A, [B], 1.0)
    rises = np.full(size, -math.expm1(-omega_o * dt))
    if form == "reduced":
        rises[0] = 1.0
    gain = _place(phi, rises) if np.all(np.isfinite(phi)) else np.full(size, np.nan)
    if form == "reduced" and np.isfinite(gain[0]):
        gain[0] = 1.0  # as it is, but for rounding
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
        predictor=form == "predictor",
    )


def _place(phi: Matrix, rises: Vector) -> Vector:
    """Return L that puts the eigenvalues of ``(I − L C) Φ`` at ``β_i = 1 − rises_i`` (Ackermann's formula).

    ``L = Π (Φ − β_i I) O⁻¹ e_N`` with the rows ``C Φ (Φ − I)^i`` for O: differences instead of powers leave ``O⁻¹ e_N`` as it is
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
    for rise in rises:
        vector = (difference + rise * np.eye(size)) @ vector
    return vector
