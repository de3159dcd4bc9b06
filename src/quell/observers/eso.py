"""The extended state observer as users make it; ``design.py`` has the theory of the linear form."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from quell import checks
from quell.checks import text
from quell.hints import explained
from quell.lti.canonical import Canonical, canonical, format_roots, without_far_zeros
from quell.observers import design
from quell.observers.forms import (
    DelayedModel,
    EsoModel,
    NonlinearModel,
    cascade_model,
    delayed_model,
    level_bandwidths,
    nonlinear_model,
    without_delay,
)
from quell.observers.multivariable import MultivariableESO
from quell.types import Vector, warn


@explained("quell.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=1e-3)")
@dataclass(frozen=True, eq=False)
class ESO:
    """An extended state observer of a plant of order 1 to 8.

    Make it with ``model_free`` or ``model_based``; ``kalman``, ``cascade`` and ``nonlinear`` have
    other gains and structures.

    Attributes
    ----------
    plant : Canonical
        the observer's model of the plant; a chain of integrators for a model-free observer.
    b0 : float
        nominal control gain, from u to y^(degree) [y-unit / u-unit / s^degree].
    omega_o : float
        observer bandwidth [rad/s].
    dt : float
        sample time [s].
    form : str
        ``"current"``, ``"predictor"`` or ``"reduced"``.
    model
        parameters of the update, for example an ``EsoModel``: Φ, Γ_u, Γ_f and L.
    has_one_pole : bool
        whether all poles of the response of f̂ to f lie at ``pole``: designed by the bandwidth, at
        full order and gain. Poles kept at zeros do not count, because f does not excite them.
    poles
        the pattern of poles in units of omega_o, or None for one pole.
    disturbance_order : int
        number m of extended states: f̂ follows a polynomial of degree m − 1 without error.
    frequencies : tuple of float
        of sinusoids that f̂ follows without error [rad/s]; two of the m states belong to each.

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
    poles: Any = None
    disturbance_order: int = 1
    frequencies: tuple[float, ...] = ()

    @classmethod
    @explained("quell.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=1e-3)")
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
        poles: Sequence[float | tuple[float, float]] | None = None,
        disturbance_order: int = 1,
        frequencies: Sequence[float] = (),
    ) -> ESO:
        """Design an ESO from the order and nominal gain of the plant only (paper eq. (mfplant)).

        Parameters
        ----------
        order
            order n of the plant, 1 to 8.
        b0
            nominal control gain [y-unit / u-unit / s^n]; a factor of 2 off is usually tolerated,
            the wrong sign is not.
        omega_o
            observer bandwidth [rad/s]; for a good result below about 0.5/dt. ``ADRC`` warns from
            1/dt on; far beyond, all poles are almost at z = 0, and the observer filters nothing.
        dt
            sample time [s].
        form
            ``"current"`` (default), ``"predictor"`` or ``"reduced"``.
        half_gain
            whether to halve the gains; not for the reduced form. It reduces the noise in f̂ by 30 %
            at order 1, by 20 % at order 3, and not at all from order 5 on.
        delay
            time after which u reaches the plant [s], a whole number of samples: give the nearest
            one of a delay with a part of a sample, whose effect is then in f̂.
        poles
            poles in units of omega_o, instead of all at −1: negative numbers, and pairs (real,
            imaginary) for two conjugate ones; order + disturbance_order in all, two more for each
            of ``frequencies``, one less for the reduced form.
        disturbance_order
            number m of extended states f, f', …, 1 to 3: the observer's model of f is a polynomial
            of degree m − 1 in time. With 2 a ramp of f is rejected without error, with 3 a
            parabola, and slow loads better; the loop comes closer to −1 at the same omega_o
            (docs/forms_extended). A ``Guard`` needs 1.
        frequencies
            of sinusoids in the observer's model of f, below pi/dt [rad/s]: it rejects loads of
            these frequencies without error, as an internal model does. Each needs two more
            extended states, which ``disturbance_order`` of the result counts.

        Raises
        ------
        ValueError
            naming the argument, its value and the rule.
        """
        chain = canonical((np.zeros(checks.whole("order", order, 1, 8)), 1.0))
        options = form, half_gain, False, delay, poles, disturbance_order, frequencies
        return cls._design(chain, b0, omega_o, dt, *options)

    @classmethod
    @explained("quell.ESO.model_based(plant, omega_o=20.0, dt=1e-3)")
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
        poles: Sequence[float | tuple[float, float]] | None = None,
        far: float = 10.0,
        disturbance_order: int = 1,
        frequencies: Sequence[float] = (),
    ) -> ESO:
        """Design an ESO from a model of the plant (paper eq. (mbplant)), which may have zeros.

        f enters where u does, zeros included, or through a channel E of its own, which must have
        no zeros. In both cases a constant f is estimated without error.

        Parameters
        ----------
        plant, E
            a linear plant, ``control.StateSpace``, ``control.TransferFunction``, matrices,
            coefficients; see ``canonical``.
        omega_o, dt, form, half_gain, delay, poles, disturbance_order, frequencies
            as for ``model_free``.
        b0
            nominal control gain, from u to y^(relative degree); the model's own by default.
        keep_zeros
            leave poles of the observer at the zeros from f that are stable and slower than omega_o.
            Then f̂ follows f as if there were none, ``(omega_o/(s + omega_o))^(N − zeros)``, which
            is what a learner needs; the state is found no faster than the zeros are. By default all
            N poles lie at ``exp(−omega_o dt)``: state and constant f are found fast, but f̂
            exaggerates changes (docs/zeros).
        far
            zeros from u that are beyond 3 times the fastest pole and beyond ``far`` times omega_o
            are not in the observer's model, and a warning names them: the gain to the derivative
            that they make u move is tiny, and no loop can be built on it. They belong to f, and
            ``analyse`` with the plant as given counts them in the margins. The states of the model
            are then y and its derivatives, and a given ``b0`` is scaled as the model's own is.
            Infinite, or with ``keep_zeros``: all zeros are in the model.

        Raises
        ------
        ValueError
            as for ``canonical``, for more than 8 states, and if a zero at s = 0 hides a constant f.
        """
        far = checks.positive_or_infinite("far", far)
        found = canonical(plant, E)
        keep_zeros = checks.flag("keep_zeros", keep_zeros)
        if found.matched and found.zeros.size and far < math.inf and not keep_zeros:
            near = without_far_zeros(plant, far * checks.positive("omega_o", omega_o, "rad/s"))
            if near.zeros.size:
                whole, found = found, canonical(near.plant)
                b0 = None if b0 is None else b0 * found.b / whole.b
                gain = found.b if b0 is None else b0
                warn(
                    f"the {near} of the plant is not in the observer's model: it is far beyond "
                    f"omega_o = {omega_o!r} rad/s and belongs to f; b0 is {gain:.4g}, from "
                    f"u to derivative {found.degree} of y; analyse(plant, controller) counts it in "
                    "the margins (far=math.inf keeps it)"
                )
        checks.whole("order of the plant", found.a.size, 1, 8)
        if found.matched and np.any(found.zeros == 0.0):
            raise ValueError(
                f"plant has a zero at s = 0 (zeros from u: {format_roots(found.zeros)} rad/s): a "
                "constant f does not show in y and can not be estimated; measure another output"
            )
        b0 = found.b if b0 is None else b0
        options = form, half_gain, keep_zeros, delay, poles, disturbance_order, frequencies
        return cls._design(found, b0, omega_o, dt, *options)

    @classmethod
    def cascade(
        cls,
        order: int,
        b0: float,
        omega_o: float,
        dt: float,
        *,
        levels: int = 2,
        ratio: float = 2.0,
        delay: float = 0.0,
        disturbance_order: int = 1,
    ) -> ESO:
        """Design a cascade of model-free observers (``observers/forms.py``): less noise in u.

        Parameters
        ----------
        order, b0, dt, delay, disturbance_order
            as for ``model_free``.
        omega_o
            bandwidth of the last level, the fastest [rad/s].
        levels
            number p of levels; with one it is the ESO of ``model_free``.
        ratio
            ratio α > 1 of the bandwidths of successive levels; the first level has
            ``omega_o / α^(p−1)``.
        """
        m = disturbance_order
        last = cls.model_free(order, b0, omega_o, dt, disturbance_order=m)
        levels_of = partial(cls.model_free, order, b0, dt=dt, disturbance_order=m)
        bandwidths = level_bandwidths(last.omega_o, levels, ratio)
        models = [levels_of(omega_o=omega).model for omega in bandwidths]
        return last._with_model(cascade_model(models, last.order), delay)

    @classmethod
    def nonlinear(
        cls,
        order: int,
        b0: float,
        omega_o: float,
        dt: float,
        *,
        delta: float,
        alpha: Any = None,
        delay: float = 0.0,
        disturbance_order: int = 1,
    ) -> ESO:
        """Design Han's nonlinear observer (``observers/forms.py``).

        It is linear while ``|y − z⁻_1|`` is below delta and corrects less beyond. It can not be
        combined with a learner or a guard: both need the observer's exact lag.

        Parameters
        ----------
        order, b0, omega_o, dt, delay, disturbance_order
            as for ``model_free``.
        delta
            largest error for which it is linear, δ [y-unit].
        alpha
            the powers α (n + m,) beyond δ, above 0 and at most 1; by default Han's 1, 1/2, 1/4, …
        """
        linear = cls.model_free(order, b0, omega_o, dt, disturbance_order=disturbance_order)
        return linear._with_model(nonlinear_model(linear.model, delta, alpha), delay)

    @classmethod
    def kalman(
        cls,
        order: int,
        b0: float,
        dt: float,
        *,
        noise_variance: float,
        drift: float,
        jitter: float = 0.0,
        form: str = "current",
        delay: float = 0.0,
        disturbance_order: int = 1,
    ) -> ESO:
        """Design a model-free ESO with the steady-state Kalman gain (``observers/design.py``).

        It has the least variance if the densities are right. Its ``omega_o``, which learners and
        guards take for its speed, is the geometric mean of ``|ln z_i|/dt`` over its poles.

        Parameters
        ----------
        order, b0, dt, delay, disturbance_order
            as for ``model_free``.
        noise_variance
            variance of the measurement's noise in each sample [y-unit²].
        drift
            density of the white noise whose integral f is [(y-unit/s^n)²/s]: in the time T, f
            drifts by ``√(drift T)``. With m extended states it drives the m-th derivative of f
            [(y-unit/s^(n+m−1))²/s].
        jitter
            density of white noise in f itself [(y-unit/s^n)² s].
        form
            ``"current"`` or ``"predictor"``.
        """
        n = checks.whole("order", order, 1, 8)
        noise = checks.positive("noise_variance", noise_variance)
        drift, jitter = checks.positive("drift", drift), checks.non_negative("jitter", jitter)
        dt = checks.positive("dt", dt, "s")
        checks.one_of("form", form, ("current", "predictor"))
        m = design.checked_disturbance_order(disturbance_order)
        chain = np.diag(np.ones(n + m - 1), 1)
        gain, omega_o = design.kalman_gain(chain, n, dt, noise, drift, jitter)
        observer = cls.model_free(n, b0, omega_o, dt, form=form, disturbance_order=m)
        return observer._with_model(observer.model._replace(gain=gain), delay)

    @staticmethod
    def state_space(
        A: Any,
        B: Any,
        C: Any,
        E: Any,
        dt: float,
        *,
        omega_o: float | None = None,
        noise_variance: Any = None,
        drift: Any = None,
        jitter: Any = None,
        D: Any = None,
        disturbance_order: int = 1,
        form: str = "current",
        every: Sequence[int] | None = None,
        time_varying: bool | None = None,
        accept_zeros: bool = False,
    ) -> MultivariableESO:
        """Design an observer of a plant with several inputs, outputs and disturbances.

        The plant is ``x' = A x + B u + E d``, ``y = C x + D u``; each d is a polynomial in time as
        far as the observer knows (``observers/multivariable.py``).

        Parameters
        ----------
        A, B, C, E, D
            matrices (n, n), (n, m), (p, n), (n, q) and (p, m), or vectors where there is one
            column or row; D is zero by default.
        dt
            sample time [s].
        omega_o
            gains by poles: all N poles at ``exp(−omega_o dt)`` [rad/s]. They do not know that one
            sensor is better than another one, or faster; gains by noise do.
        noise_variance, drift
            gains by noise, the steady Kalman gain: the variance of the noise of each output in a
            sample (p,) [y-unit²], an encoder's step squared over 12 for example; and for each
            disturbance (q,) the density of the white noise whose integral it is [d-unit²/s]: in
            the time T, d drifts by ``√(drift T)``. With ``disturbance_order`` m it drives the m-th
            derivative [d-unit²/s^(2m−1)].
        jitter
            density (q,) of white noise in d itself [d-unit² s]; none by default.
        disturbance_order
            1 if d is constant, 2 for a ramp, 3 for a parabola.
        form
            ``"current"``, or ``"predictor"``, whose estimates do not use the newest y.
        every
            samples from one measurement of each output to the next, as (1, 4) for a second encoder
            at a quarter of the rate; gains by noise only. Outputs are due together in the first
            sample; what they say in between is ignored.
        time_varying
            gains by noise only: whether to calculate the covariance, and the gain from it, in each
            sample, as by default. False makes the gain a fixed one for each set of sensors, in a
            seventh of the time; samples that are missing may then let the error grow, see
            ``MultivariableESO.rms_decay``.
        accept_zeros
            whether to design an observer although there are invariant zeros from d to y other than
            at s = 0. It finds a constant d, but not one at the frequency of a zero.

        Returns
        -------
        MultivariableESO
            which observes, but is no observer for ``ADRC``.

        Raises
        ------
        ValueError
            if matrices do not fit; if no such observer exists, which names the mode that y does not
            show, or the invariant zero, and says what to do; and naming any other argument.

        Examples
        --------
        A motor and a load behind a coupling, with an encoder of 2²⁰ counts at each side, and a
        torque on each:

        >>> J, L, k, c = 1.2e-4, 0.8e-4, 60.0, 0.005
        >>> A = [[0, 1, 0, 0], [-k/J, -c/J, k/J, c/J], [0, 0, 0, 1], [k/L, c/L, -k/L, -c/L]]
        >>> E = [[0, 0], [1/J, 0], [0, 0], [0, 1/L]]
        >>> count = 2 * math.pi / 2**20
        >>> both = ESO.state_space(
        ...     A, [0, 1/J, 0, 0], [[1, 0, 0, 0], [0, 0, 1, 0]], E, 0.25e-3,
        ...     noise_variance=[count**2 / 12] * 2, drift=[1.0, 1.0],
        ... )
        >>> both
        MultivariableESO(n=4, m=1, p=2, q=2, omega_o=7198.48, dt=0.00025, form='current') [Riccati]
        >>> running = both.estimator()
        >>> estimate = running.step(y=[0.0, 0.0], u=[0.0])
        >>> running.d.tolist()
        [0.0, 0.0]
        """
        return MultivariableESO.design(
            *(A, B, C, E, dt),
            omega_o=omega_o,
            noise_variance=noise_variance,
            drift=drift,
            jitter=jitter,
            D=D,
            disturbance_order=disturbance_order,
            form=form,
            every=every,
            time_varying=time_varying,
            accept_zeros=accept_zeros,
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
        keep_zeros: bool,
        delay: float,
        poles: Any,
        disturbance_order: int,
        frequencies: Any,
    ) -> ESO:
        reason = "it is the gain from u to the first derivative of y that u moves"
        b0 = checks.nonzero("b0", b0, reason)
        omega_o, dt = checks.positive("omega_o", omega_o, "rad/s"), checks.positive("dt", dt, "s")
        options: dict[str, Any] = {"half_gain": half_gain, "keep_zeros": keep_zeros}
        m = options["disturbance_order"] = design.checked_disturbance_order(
            disturbance_order, frequencies, dt
        )
        options["frequencies"] = known = tuple(map(float, frequencies))
        model = design.design_model(plant, b0, omega_o, dt, form=form, poles=poles, **options)
        has_one_pole = form != "reduced" and not half_gain and poles is None
        model = delayed_model(model, delay, dt)
        return cls(plant, b0, omega_o, dt, form, model, has_one_pole, poles, m, known)

    def _with_model(self, model: Any, delay: float) -> ESO:
        model = delayed_model(model, delay, self.dt)
        return replace(self, model=model, has_one_pole=False)

    def __repr__(self) -> str:
        inner = without_delay(self.model)
        kind = type(inner).__name__.removesuffix("Model")
        more = "" if self.poles is None else f", poles={text(self.poles)}"
        polynomial = self.disturbance_order - 2 * len(self.frequencies)
        if polynomial > 1:
            more += f", disturbance_order={polynomial}"
        if self.frequencies:
            more += f", frequencies={text(self.frequencies)}"
        if inner is not self.model:
            more += f", delay={self.model.samples * self.dt:g}"
        return (
            f"ESO(order={self.order}, b0={self.b0:g}, omega_o={self.omega_o:g}, dt={self.dt:g}, "
            f"form={self.form!r}{more}) [{kind}]"
        )

    @property
    def a(self) -> Vector:
        """The plant's coefficients (n,) [1/s^(n−i)].

        Without zeros, ``y^(n) = −a·(y … y^(n−1)) + b0 u + f``.
        """
        return self.plant.a

    @property
    def order(self) -> int:
        """Order n of the plant; the observer has n + ``disturbance_order`` states."""
        return int(self.plant.a.size)

    @property
    def estimates(self) -> int:
        """Number N of estimates: x̂ (n,), f̂ and the ``disturbance_order`` − 1 derivatives of it."""
        return self.order + self.disturbance_order

    @property
    def degree(self) -> int:
        """Relative degree r from u to y, the order of the closed loop; n if there are no zeros."""
        return self.plant.degree

    @property
    def f_degree(self) -> int:
        """Relative degree from f to y: f is in y-unit/s^f_degree."""
        return self.plant.f_degree

    @property
    def cancel(self) -> Vector:
        """The vector by which the controller cancels modelled dynamics, ``cancel · x̂``.

        In y-unit/s^r, from ``y^(n) = −a·z + b u + f``, or from ``y^(r) = z_{r+1} + b u``, plus f if
        that enters where u does.
        """
        return self.plant.a if self.degree == self.order else -np.eye(self.order)[self.degree]

    @property
    def cancel_f(self) -> float:
        """1.0 if f enters where u does; else 0.0, and u cancels only its effect on the state."""
        return 1.0 if self.plant.matched else 0.0

    @property
    def states(self) -> int:
        """Length of the observer's running state."""
        return int(self.model.states)

    @property
    def lag_time(self) -> float:
        """``Σ 1/|p_i|`` over the poles [s]: ``N/omega_o`` if they lie in one place.

        At high sampling rates it is the lag of the estimate behind a slowly varying f. (The lag of
        a cascade is shorter; with further extended states there is none, and it is the observer's
        memory.)
        """
        if self.has_one_pole or isinstance(without_delay(self.model), NonlinearModel):
            return self.estimates / self.omega_o
        return self.dt * design.total_time_constant(
            design.scaled_response(self.model, self.units, self.order)
        )

    @property
    def pole(self) -> float:
        """The poles in the z-plane, ``exp(−omega_o dt)``, except those kept at zeros."""
        return math.exp(-self.omega_o * self.dt)

    @property
    def units(self) -> Vector:
        """Units (N,) of the estimates in the time unit 1/omega_o: ``omega_o^(i−1)``."""
        of_f = self.f_degree + np.arange(self.disturbance_order)
        return self.omega_o ** np.append(np.arange(float(self.order)), of_f)

    def states_of(self, x_hat: Any) -> Vector:
        """Return estimates in the states of the plant the observer was designed for: ``S⁻¹ x̂``.

        Parameters
        ----------
        x_hat
            (n,), as ``controller.estimate.x``, or (samples, n), as ``run["x_hat"]``.

        Returns
        -------
        array
            of the same shape. For a plant given without states it is x̂ itself: y and its
            derivatives, less the feedthrough of u and f.

        Raises
        ------
        ValueError
            if the last axis is not n long.
        """
        x = np.asarray(x_hat, dtype=np.float64)
        if x.ndim == 0 or x.shape[-1] != self.order:
            raise ValueError(
                f"x_hat has shape {x.shape}: the last axis must have the {self.order} states"
            )
        size = np.linalg.norm(self.plant.S, axis=1)
        rows = (x / size).reshape(-1, self.order)
        return np.linalg.solve(self.plant.S / size[:, None], rows.T).T.reshape(x.shape)


def noise_gains(observer: ESO) -> Vector:
    """Return the variance (n + 1,) that white noise of unit variance in y causes in x̂ and f̂.

    If all poles lie in one place, the formula of a model-free observer is used. In continuous time
    ``x̂_i = Σ_{k=i}^{N} C(N, k) ω_o^k s^(N−k+i−1) / (s + ω_o)^N · y``, and sampled white noise has
    the density dt, so the variance is ``dt ω_o^(2i−1) ∫ |·|² dω / 2π`` with the integrand at
    ω_o = 1. This is accurate for small ``omega_o dt``. With other poles, or if f enters before the
    last integrator, the variance is summed sample by sample instead.
    """
    kept = observer.order + 1
    if observer.f_degree < observer.order or not observer.has_one_pole:
        return _summed_noise_gains(observer)
    unit = _unit_noise_gains(observer.estimates)[:kept]
    return observer.dt * observer.omega_o ** (2.0 * np.arange(kept) + 1.0) * unit


@cache
def _unit_noise_gains(size: int) -> Vector:
    """Return the integrals of ``noise_gains``, which depend only on the number of states."""
    omega = np.geomspace(1e-4, 1e4, 4001)
    s = 1j * omega
    gains = np.empty(size)
    for i in range(1, size + 1):
        powers = (math.comb(size, k) * s ** (size - k + i - 1) for k in range(i, size + 1))
        response = sum(powers) / (s + 1.0) ** size
        gains[i - 1] = np.trapezoid(np.abs(response) ** 2, omega) / math.pi
    gains.flags.writeable = False
    return gains


def _summed_noise_gains(observer: ESO) -> Vector:
    """Return the diagonal of ``C P Cᵀ + d dᵀ``, ``P = Σ M^k g gᵀ M^kᵀ``, by doubling."""
    found = design.scaled_response(observer.model, observer.units, observer.order)
    gain, feedthrough, transition = found.input[:, 0], found.feedthrough[:, 0], found.transition
    total = np.outer(gain, gain)
    for _ in range(64):
        total += transition @ total @ transition.T
        transition = transition @ transition
        if np.max(np.abs(transition)) < 1e-12:
            break
    variances: Vector = np.einsum("ij,jk,ik->i", found.output, total, found.output)
    return (variances + feedthrough**2)[: observer.order + 1]


# ---- Other gains of an observer that is there ----


def redesign(observer: ESO) -> Callable[[float], Vector]:
    """Return the gain L (N,) of an observer as a function of omega_o.

    Raises ``ValueError`` for observers whose gain does not follow from omega_o.
    """
    model = without_delay(observer.model)
    refusal = ValueError(
        f"schedule.omega_o: the gain of {observer!r} does not follow from omega_o, or its "
        "correction is of another kind; take ESO.model_free or ESO.model_based in the form "
        "'current' or 'predictor', without keep_zeros"
    )
    if type(model) is not EsoModel or observer.form == "reduced":
        raise refusal

    def gain(omega_o: float, half_gain: bool = False) -> Vector:
        how: dict[str, Any] = {"form": observer.form, "half_gain": half_gain}
        how |= {"poles": observer.poles, "disturbance_order": observer.disturbance_order}
        how["frequencies"] = observer.frequencies
        plant, b0, dt = observer.plant, observer.b0, observer.dt
        return design.design_model(plant, b0, omega_o, dt, keep_zeros=False, **how).gain

    for half in (False, True):
        if np.allclose(gain(observer.omega_o, half), model.gain, rtol=1e-9, atol=0.0):
            return lambda omega_o: gain(omega_o, half)
    raise refusal


def with_gains(observer: ESO, b0: float, omega_o: float) -> ESO:
    """Return an observer with another b0 and bandwidth."""
    delayed = observer.model
    model = without_delay(delayed)
    if omega_o != observer.omega_o:
        model = model._replace(gain=redesign(observer)(omega_o))
    model = model._replace(input=model.input * (b0 / observer.b0))
    made = delayed._replace(inner=model) if isinstance(delayed, DelayedModel) else model
    return replace(observer, b0=b0, omega_o=omega_o, model=made)
