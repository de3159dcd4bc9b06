"""The extended state observer: design and update.

Extended model (paper eqs. (eq_2) and (eq.leso)), states ``z = (x̂_1 … x̂_n, Δf̂)``::

    x_i' = x_{i+1},    x_n' = −a·x + b0 u + f_L + Δf,    Δf' = 0

and for any other plant, zeros and all, its observable canonical form ``z' = Ā z + B̄ u + Ē (f_L + Δf)`` (``canonical.py``), in place of the
first two. It is sampled exactly with zero-order hold to ``Φ, Γ_u, Γ_f``. Each sample::

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
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.lti.canonical import Canonical, canonical, format_roots
from quell.lti.discretize import zero_order_hold
from quell.observers.base import begin, begin_at, observe, predict_state
from quell.observers.delay import delayed_model, without_delay
from quell.observers.forms import OtherForms
from quell.observers.nonlinear import NonlinearModel
from quell.observers.placement import place_poles, sampled_zeros
from quell.observers.response import scaled_response, total_time_constant
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
def _observe(
    model: EsoModel, z: Vector, seen: Vector, y: float, u: float, f_learned: float
) -> None:
    predict_state(model, z, seen, u, f_learned)
    error = y - seen[0]
    for i in range(z.size):
        z[i] = seen[i] + model.gain[i] * error
    if not model.predictor:
        for i in range(z.size):
            seen[i] = z[i]


@begin.register(EsoModel)
def _begin(model: EsoModel, z: Vector, seen: Vector, y: float) -> None:
    begin_at(z, seen, y)


@dataclass(frozen=True, eq=False)
class ESO(OtherForms):
    """An extended state observer of a plant of order 1 to 8.

    Make it with ``model_free`` or ``model_based``; ``kalman``, ``cascade`` and ``nonlinear`` are for other gains and structures.

    Attributes
    ----------
    plant : Canonical
        the plant as it is known to it; a chain of integrators for a model-free one.
    b0 : float
        nominal control gain, from u to y^(degree) [y-unit / u-unit / s^degree].
    omega_o : float
        observer bandwidth [rad/s].
    dt : float
        sample time [s].
    form : str
        ``"current"``, ``"predictor"`` or ``"reduced"``.
    model
        parameters of its update, for example an ``EsoModel``: Φ, Γ_u, Γ_f and L.
    has_one_pole : bool
        whether all poles with which it answers f lie in one place, ``pole``: as designed by the bandwidth, at full order and gain. Poles
        kept at zeros do not count: f does not move them.

    Examples
    --------
    >>> observer = ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=1e-3)
    >>> observer.order, round(float(observer.model.gain[0]), 4)
    (4, 0.0488)
    """

    plant: Canonical
    b0: float
    omega_o: float
    dt: float
    form: str
    model: Any
    has_one_pole: bool = True

    @classmethod
    def model_free(
        cls,
        order: int,
        b0: float,
        omega_o: float,
        dt: float,
        *,
        form: str = "current",
        half_gain: bool = False,
        delay: float = 0.0,
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
        chain = canonical((np.zeros(checks.whole("order", order, 1, 8)), 1.0))
        return cls._design(chain, b0, omega_o, dt, form, half_gain, delay)

    @classmethod
    def model_based(
        cls,
        plant: Any,
        omega_o: float,
        dt: float,
        *,
        b0: float | None = None,
        E: Any = None,
        form: str = "current",
        keep_zeros: bool = False,
        half_gain: bool = False,
        delay: float = 0.0,
    ) -> ESO:
        """Design an ESO that knows a model of the plant (paper eq. (mbplant)), which may have zeros.

        f enters where u does, zeros included, or through a channel E of its own, which must have none. In both cases a constant f is
        estimated without error.

        Parameters
        ----------
        plant, E
            a linear plant, ``control.StateSpace``, ``control.TransferFunction``, matrices, coefficients; see ``canonical``.
        omega_o, dt, form, half_gain, delay
            as for ``model_free``.
        b0
            nominal control gain, from u to y^(relative degree); the model's own by default.
        keep_zeros
            leave poles of the observer at the zeros from f that are stable and slower than omega_o. Then f̂ follows f as if there
            were none, ``(omega_o/(s + omega_o))^(N − zeros)``, which is what a learner needs; the state is found no faster than the
            zeros are. By default all N poles lie at ``exp(−omega_o dt)``: state and constant f are found fast, but f̂ exaggerates what
            changes (docs/design).

        Raises
        ------
        ValueError
            as for ``model_free`` and ``canonical``, for a plant of more than 8 states, and where a zero at s = 0 hides a constant f.
        """
        found = canonical(plant, E)
        checks.whole("order of the plant", found.a.size, 1, 8)
        if found.matched and np.any(found.zeros == 0.0):
            raise ValueError(
                f"plant has a zero at s = 0 (zeros from u: {format_roots(found.zeros)} rad/s): a constant f leaves no trace in y and can not be "
                "estimated; measure another output"
            )
        return cls._design(
            found,
            found.b if b0 is None else b0,
            omega_o,
            dt,
            form,
            half_gain,
            delay,
            checks.flag("keep_zeros", keep_zeros),
        )

    @classmethod
    def _design(
        cls,
        plant: Canonical,
        b0: float,
        omega_o: float,
        dt: float,
        form: str,
        half_gain: bool,
        delay: float,
        keep_zeros: bool = False,
    ) -> ESO:
        b0 = checks.nonzero(
            "b0", b0, "it is the gain from u to the first derivative of y that u moves"
        )
        omega_o, dt = checks.positive("omega_o", omega_o, "rad/s"), checks.positive("dt", dt, "s")
        checks.one_of("form", form, FORMS)
        if omega_o * dt >= math.pi:
            raise ValueError(
                f"omega_o = {omega_o!r} rad/s with dt = {dt!r} s: omega_o * dt = {omega_o * dt:.3g} must be below pi, "
                "no sampling can follow a bandwidth above half its rate; lower omega_o or dt"
            )
        if checks.flag("half_gain", half_gain) and form == "reduced":
            raise ValueError(
                "half_gain = True with form = 'reduced': half its gain is not of reduced order; use form='current'"
            )
        kept = (
            plant.zeros[(plant.zeros.real > -omega_o) & (plant.zeros.real < 0.0)]
            if keep_zeros and plant.matched
            else np.zeros(0)
        )
        model = _sampled_design(plant, b0, omega_o, dt, form, kept)
        if half_gain:
            model = model._replace(gain=0.5 * model.gain)
        return cls(
            plant,
            b0,
            omega_o,
            dt,
            form,
            delayed_model(model, delay, dt),
            form != "reduced" and not half_gain,
        )

    def __repr__(self) -> str:
        kind = type(self.model).__name__.removesuffix("Model")
        return f"ESO(order={self.order}, b0={self.b0:g}, omega_o={self.omega_o:g}, dt={self.dt:g}, form={self.form!r}) [{kind}]"

    @property
    def a(self) -> Vector:
        """The plant's coefficients (n,), in ``y^(n) = −a·(y … y^(n−1)) + b0 u + f`` where there are no zeros [1/s^(n−i)]."""
        return self.plant.a

    @property
    def order(self) -> int:
        """Order n of the plant; the observer has n + 1 states."""
        return int(self.plant.a.size)

    @property
    def degree(self) -> int:
        """Relative degree r from u to y: so many derivatives of y the controller shapes; n unless the plant has zeros."""
        return self.plant.degree

    @property
    def f_degree(self) -> int:
        """Relative degree from f to y: f is in y-unit/s^f_degree."""
        return self.plant.f_degree

    @property
    def cancel(self) -> Vector:
        """What the controller adds to cancel the modelled dynamics: ``cancel · x̂`` [y-unit/s^r].

        From ``y^(n) = −a·z + b u + f``, or from ``y^(r) = z_{r+1} + b u``, plus f where that enters as u does.
        """
        return self.plant.a if self.degree == self.order else -np.eye(self.order)[self.degree]

    @property
    def cancel_f(self) -> float:
        """1.0 where the total disturbance enters as u does, else 0.0: then u has nothing to cancel but its effect on the state."""
        return 1.0 if self.plant.matched else 0.0

    @property
    def states(self) -> int:
        """Length of the observer's running state."""
        return int(self.model.states)

    @property
    def lag_time(self) -> float:
        """How long it takes [s], ``Σ 1/|p_i|`` over its poles: ``N/omega_o`` where they lie in one place.

        By so much the estimate of f trails a slow f, at high sampling rates. (That of a cascade trails it by less.)
        """
        if self.has_one_pole or isinstance(without_delay(self.model), NonlinearModel):
            return (self.order + 1) / self.omega_o
        return self.dt * total_time_constant(scaled_response(self))

    @property
    def pole(self) -> float:
        """Where the poles of the observer lie in the z-plane, ``exp(−omega_o dt)``, but for those kept at zeros."""
        return math.exp(-self.omega_o * self.dt)

    def states_of(self, x_hat: Any) -> Vector:
        """Return estimates in the states of the plant that the observer was designed for: ``S⁻¹ x̂``.

        Parameters
        ----------
        x_hat
            (n,), as ``controller.estimate.x``, or (samples, n), as ``run["x_hat"]``.

        Returns
        -------
        array
            of the same shape. For a plant given without states it is x̂ itself: y and its derivatives, less what u and f feed through.

        Raises
        ------
        ValueError
            where the last axis is not n long.
        """
        x = np.asarray(x_hat, dtype=np.float64)
        if x.ndim == 0 or x.shape[-1] != self.order:
            raise ValueError(
                f"x_hat has shape {x.shape}: the last axis must have the {self.order} states"
            )
        S = self.plant.S
        size = np.linalg.norm(S, axis=1)
        mapped: Vector = np.linalg.solve(
            S / size[:, None], (x / size).reshape(-1, self.order).T
        ).T.reshape(x.shape)
        return mapped


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


def _sampled_design(
    plant: Canonical, b0: float, omega_o: float, dt: float, form: str, kept: Vector
) -> EsoModel:
    """Sample the extended model, in the coordinates ``x_i dt^(i−1)`` and ``f dt^q`` where all entries are O(1), and place the poles.

    That is done in the coordinates ``x_i/omega_o^(i−1)``, ``f/omega_o^q``: over a sample hardly anything happens there, but it is known
    to full precision, because ``Φ − I`` is taken as the integral ``∫ e^(A t) A dt``, not as a difference.
    """
    n, q = plant.a.size, plant.f_degree
    size = n + 1
    power = np.append(np.arange(n), q)
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        A = np.diag(np.ones(size - 1), 1)
        A[-2, :-1] -= plant.a * dt ** (n - np.arange(n))
        A[:-1, -1] = plant.E * dt ** (np.arange(n) + 1.0 - q)
        inputs = np.zeros((size, 2))
        inputs[:-1, 0] = plant.B / plant.b * dt ** (np.arange(n) + 1.0 - plant.degree)
        inputs[:, 1] = A[:, -1]
        phi, (difference, gammas) = zero_order_hold(A, [A, inputs], 1.0)
        step = omega_o * dt
        slow = step ** (power[None, :] - power[:, None])
        gain = np.full(size, np.nan)
        if np.all(np.isfinite(phi)):
            difference *= slow
            rises = np.full(size, -math.expm1(-step), dtype=complex)
            rises[: kept.size] = sampled_zeros(difference, kept, dt)
            if form == "reduced":
                rises[-1] = 1.0
            gain = place_poles(difference, rises) * step**power
            if form == "reduced" and np.isfinite(gain[0]):
                gain[0] = 1.0  # as it is, but for rounding
    if not np.all(np.abs(gain) < _LARGEST_GAIN):
        fastest = np.max(np.abs(np.roots([1.0, *plant.a[::-1]])), initial=0.0)
        zeros = f" or its zeros at {format_roots(plant.zeros)} rad/s" if plant.zeros.size else ""
        raise ValueError(
            f"dt = {dt!r} s: too long (or omega_o = {omega_o!r} rad/s too small) for the plant's fastest pole of {fastest:.3g} rad/s"
            f"{zeros}; sampled, the model cannot be observed"
        )
    # Back to the plant's coordinates; an input enters with the power of dt of its relative degree.
    scale = dt**power
    return EsoModel(
        transition=np.ascontiguousarray(phi * scale[None, :] / scale[:, None]),
        input=b0 * (gammas[:, 0] * dt**plant.degree / scale),
        feed=gammas[:, 1] * dt**q / scale,
        gain=gain / scale,
        predictor=form == "predictor",
    )
