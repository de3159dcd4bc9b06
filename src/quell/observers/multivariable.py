"""The extended state observer of a plant with several inputs, outputs and disturbances.

The plant has states x (n,), inputs u (m,), measured outputs y (p,) and disturbances d (q,)::

    x' = A x + B u + E d,        y = C x + D u,        d^(order) = unknown

The extended state is ``z = (x, d, d', …)``. Its model is that of the observer of one output
(``design.py``): u and d are held over a sample, and d moves from sample to sample as a polynomial,
``d⁺ = d + dt d' + …``. Sampled exactly::

    predict   z⁻ = Φ z + Γ_u u + Γ_d d_known
    correct   z  = z⁻ + L (y − C z⁻ − D u)

The *current* form returns z, the *predictor* form z⁻; all eigenvalues of ``(I − L C) Φ`` are the
same. y is measured before the new u is applied, so D u is that of the u before.

**Existence.** No observer finds d if a motion of x and d leaves y at zero: (A, C) has to be
observable, and from d to y there may be no invariant zeros (Chen, Gao & Lin, arXiv 2510.01007;
``lti/zeros.py``). For d that is a polynomial in time it is enough if none of them is at s = 0; then
the observer can be made, but a d that moves with the frequency of a zero is not found.

**Gains** put all poles in one place, or are those of a Kalman filter for the noise of each sensor
and the density of the noise that drives each disturbance (``gains.py``). Sensors that are slower
than the loop have a gain of their own in each sample of the common period.

**Missing samples.** What is not a finite number has not been measured, and the others correct.

Gains by noise: the covariance is calculated in each sample, and the gain from it. This is the
Kalman filter for what has been measured, whatever comes or does not come: its covariance is that of
the errors, and it is bounded if in every window of some fixed length what has been measured
observes all (Jazwinski, *Stochastic Processes and Filtering Theory*, 1970, section 7.6). It takes
``N³`` operations a sample in place of ``N²``.

Gains by poles, and by noise with ``time_varying=False``, are fixed: one for each set of sensors,

- that which puts all poles in the same place with these sensors, where they observe all; else the
  columns of the gain of all sensors;
- by noise the steady Kalman gain of an observer without the missing ones. Where the others do not
  observe all, the missing ones count as sensors with 1000 times their noise.

While the same sensors are missing, the poles are known (``poles``). For samples that are missing at
random ``rms_decay`` says whether the error decays: the mean of its square follows from
``E[M ⊗ M]``, ``M = (I − L C) Φ`` (Costa, Fragoso & Marques, *Discrete-Time Markov Jump Linear
Systems*, Springer 2005, chapter 3). Fast observers of a servo lose it: with two torques and a drift
of 1 (N m)²/s the error diverges when half of the load encoder's samples are missing one by one,
whichever fixed gains are taken (``benchmarks/second_encoder.py --part missing``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.kernels import dispatch
from quell.lti.zeros import fitting_matrices
from quell.observers.design import checked_disturbance_order
from quell.observers.gains import (
    ExtendedModel,
    MultivariableDesign,
    check_existence,
    extended_model,
    rates_of,
    sets_of,
    settle,
)
from quell.observers.multivariable_forms import (
    GainModel,
    RiccatiModel,
    begin_signals,
    observe_record,
    observe_sample,
)
from quell.types import Matrix, Vector


@dataclass(frozen=True, eq=False)
class MultivariableESO:
    """An extended state observer of n states, m inputs, p outputs and q disturbances.

    ``ESO.state_space`` makes it. There are ``N = n + q · disturbance_order`` estimates: x̂ (n,), d̂
    (q,), and derivatives of d̂ if ``disturbance_order`` is above 1.

    Attributes
    ----------
    A, B, C, E, D : array
        the plant, ``x' = A x + B u + E d``, ``y = C x + D u``.
    dt : float
        sample time [s].
    disturbance_order : int
        order of the polynomial that d is, from 1 (constant).
    form : str
        ``"current"`` or ``"predictor"``.
    every : tuple
        for each output, the number of samples from one measurement to the next.
    omega_o : float
        bandwidth [rad/s]: the place of the poles, or with gains by noise the geometric mean of
        ``|ln z_i|/dt`` over the poles.
    model
        parameters of the update, ``GainModel`` or ``RiccatiModel``.
    covariance : array or None
        covariance (N, N) of the errors of the estimates in the steady state, in the last sample of
        a period; None for gains by poles.
    gains : array
        L (K, N, p) in each of the K samples of a period if nothing is missing.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    E: Matrix
    D: Matrix
    dt: float
    disturbance_order: int
    form: str
    every: tuple[int, ...]
    omega_o: float
    model: GainModel | RiccatiModel
    covariance: Matrix | None
    gains: NDArray[np.float64]
    _table: GainModel  # the gains for what is missing; ``model`` itself unless time_varying

    @classmethod
    def design(
        cls,
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
        every: Any = None,
        time_varying: bool | None = None,
        accept_zeros: bool = False,
    ) -> MultivariableESO:
        """Design the observer; ``ESO.state_space`` has the parameters and errors."""
        A, B, C, D = fitting_matrices(A, B, C, D)
        _, E, _, _ = fitting_matrices(A, E, C, None, "E", "disturbances")
        dt, order = checks.positive("dt", dt, "s"), checked_disturbance_order(disturbance_order)
        checks.one_of("form", form, ("current", "predictor"))
        rates, due = rates_of(every, C.shape[0])
        check_existence(A, E, C, checks.flag("accept_zeros", accept_zeros))
        by_poles = noise_variance is None and drift is None and jitter is None
        if by_poles == (omega_o is None):
            raise ValueError(
                f"omega_o = {omega_o!r}, noise_variance = {noise_variance!r}, drift = {drift!r}, "
                f"jitter = {jitter!r}: give omega_o for gains by poles, or noise_variance and "
                "drift for gains by noise"
            )
        model = MultivariableDesign(A, B, C, E, D, dt, order, form == "predictor", due)
        common = A, B, C, E, D, dt, order, form, rates
        if by_poles:
            omega = checks.positive("omega_o", omega_o, "rad/s")
            if due.shape[0] > 1 or time_varying is not None:
                late = due.shape[0] > 1
                what = f"every = {rates}" if late else f"time_varying = {time_varying!r}"
                raise ValueError(
                    f"{what} with omega_o: only gains by noise know what a sample is worth; give "
                    "noise_variance and drift in place of omega_o"
                )
            table, gains = model.by_poles(omega)
            return cls(*common, omega, table, None, gains, table)
        found = model.by_noise(noise_variance, drift, jitter)
        is_fixed = time_varying is not None and not checks.flag("time_varying", time_varying)
        used = found.table if is_fixed else found.riccati
        return cls(*common, found.omega, used, found.covariance, found.gains, found.table)

    def __repr__(self) -> str:
        (n, q), m, p = self.E.shape, self.B.shape[1], self.C.shape[0]
        more = f", every={self.every}" if max(self.every) > 1 else ""
        if self.disturbance_order > 1:
            more += f", disturbance_order={self.disturbance_order}"
        return (
            f"MultivariableESO(n={n}, m={m}, p={p}, q={q}, omega_o={self.omega_o:.6g}, "
            f"dt={self.dt:g}, form={self.form!r}{more}) [{type(self.model).__name__[:-5]}]"
        )

    @property
    def order(self) -> int:
        """Number n of the plant's states."""
        return int(self.A.shape[0])

    @property
    def estimates(self) -> int:
        """Number N of estimates."""
        return int(self.order + self.E.shape[1] * self.disturbance_order)

    def estimator(self) -> Estimator:
        """Return a running observer, which takes one sample after the other."""
        return Estimator(self)

    def at_rest(self, y: Any, u: Any = None) -> Vector:
        """Return the estimates (N,) of a plant that rests with the measurements y under u.

        ``C x + D u = y``, and ``A x + B u + E d`` is zero, or as small as y allows. Where both
        leave a choice, d is the smallest, then x. The derivatives of d are zero.

        Parameters
        ----------
        y
            measurements (p,) [y-units]; NaN where there is none.
        u
            control signals (m,) [u-units]; zero by default.
        """
        y, u = self._measurements("y", y), self._inputs("u", u, self.B.shape[1])
        (n, q), known = self.E.shape, np.isfinite(y)
        units = self._scaled.units[: n + q]
        shown = np.hstack([self.C[known], np.zeros((int(known.sum()), q))])
        size = np.linalg.norm(shown * units, axis=1)
        stages = [  # each decides what those before it leave open
            (shown / size[:, None], (y - self.D @ u)[known] / size),
            (np.hstack([self.A, self.E]) / units[:n, None], -(self.B @ u) / units[:n]),
            (np.eye(n + q)[n:] / units[n:, None], np.zeros(q)),
            (np.eye(n + q)[:n] / units[:n, None], np.zeros(n)),
        ]
        found = settle(stages, units)
        return np.append(found, np.zeros(self.estimates - n - q))

    def filter(self, y: Any, u: Any, d_known: Any = None, start: Any = None) -> Matrix:
        """Return the estimates (K, N) for a record of K samples.

        Parameters
        ----------
        y
            measurements (K, p) [y-units]; NaN where there is none.
        u
            control signals (K, m) [u-units]; ``u[k]`` was applied from ``y[k − 1]`` to ``y[k]``.
        d_known
            known part (K, q) of the disturbances; zero by default.
        start
            estimates (N,) before the first sample; by default those of ``at_rest`` at the first
            one, which is then taken as a start.
        """
        p, m, q = self.C.shape[0], self.B.shape[1], self.E.shape[1]
        y = np.ascontiguousarray(np.asarray(y, dtype=np.float64).reshape(-1, p))
        u = checks.matrix("u", np.reshape(u, (-1, m)), y.shape[0], m)
        d = np.zeros((y.shape[0], q)) if d_known is None else d_known
        d = checks.matrix("d_known", np.reshape(d, (-1, q)), y.shape[0], q)
        running, found = Estimator(self), np.empty((y.shape[0], self.estimates))
        first = 0
        if start is None:
            while first < y.shape[0] and not running.is_started:
                found[first] = running.step(y[first], u[first], d[first])
                first += 1
        else:
            running.set(start)
        running.step_record(y[first:], u[first:], d[first:], found[first:])
        return found

    def poles(self, missing: Any = ()) -> NDArray[np.complex128]:
        """Return the poles z_i (N,) of the error, per sample, while some sensors are missing.

        They are the eigenvalues of the product of ``(I − L C) Φ`` over a period, to the power of
        one over its length. If the largest ``|z_i|`` is 1 or above, the error of what is left does
        not decay, as when it does not observe an integrator. With ``time_varying`` they are those
        of the gains in the steady state.

        Parameters
        ----------
        missing
            numbers of the outputs that are missing, from 0.
        """
        p, due = self.C.shape[0], self.model.due > 0.0
        gone = [checks.whole("missing", j, 0, p - 1) for j in missing]
        left, error = ~np.isin(np.arange(p), gone), np.eye(self.estimates)
        for k, row in enumerate(due):
            error = self._error(k, row & left) @ error
        found: NDArray[np.complex128] = np.linalg.eigvals(error).astype(complex)
        return np.asarray(found ** (1.0 / due.shape[0]))

    def rms_decay(self, missing: Any) -> float:
        """Return the factor by which the RMS error decays in a sample, with samples missing.

        From 1 on, the error grows without bound.

        Parameters
        ----------
        missing
            for each output (p,) the share of its samples that are missing, each one by chance and
            independently of all others.

        Raises
        ------
        ValueError
            for ``time_varying`` gains, which are made for what is missing.
        """
        if isinstance(self.model, RiccatiModel):
            raise ValueError(
                "the gain is calculated for what is missing in each sample: no fixed factor is "
                "known, and the covariance of an Estimator says what is left"
            )
        shares = checks.vector("missing", missing, self.C.shape[0])
        if not np.all((shares >= 0.0) & (shares <= 1.0)):
            raise ValueError(f"missing = {missing!r}: each entry must be from 0 to 1")
        total = np.eye(self.estimates**2)
        for k, due in enumerate(self.model.due > 0.0):
            mean = np.zeros_like(total)
            for on in sets_of(shares.size):
                if np.any(on & ~due):
                    continue
                chance = np.prod(np.where(on, 1.0 - shares, shares)[due])
                error = self._error(k, on)
                mean += chance * np.kron(error, error)
            total = mean @ total
        largest = float(np.max(np.abs(np.linalg.eigvals(total))))
        return largest ** (0.5 / self.model.due.shape[0])

    def _error(self, phase: int, on: NDArray[np.bool_]) -> Matrix:
        """Return ``(I − L C) Φ`` in scaled coordinates, if the outputs ``on`` are measured."""
        table, scale, size = self._table, self._scaled.units, self.estimates
        row = phase * 2**on.size + int(np.sum(2 ** np.flatnonzero(on)))
        gain = table.gains[row].reshape(size, on.size) / scale[:, None]
        phi = table.transition * scale[None, :] / scale[:, None]
        return (np.eye(size) - gain @ (table.output * scale)) @ phi

    @property
    def standard_deviations(self) -> Vector:
        """Standard deviations (N,) of the errors of the estimates in the steady state.

        Raises
        ------
        ValueError
            for gains by poles, which know no noise.
        """
        if self.covariance is None:
            raise ValueError(
                "the gains are by poles, which know no noise: give noise_variance and drift"
            )
        return np.sqrt(np.diag(self.covariance))

    @property
    def _scaled(self) -> ExtendedModel:
        sizes = np.ones(self.C.shape[0])
        if isinstance(self.model, RiccatiModel):
            sizes = np.sqrt(self.model.noise)
        return extended_model(
            *(self.A, self.B, self.C, self.E, self.disturbance_order, self.dt),
            *(self.omega_o, sizes),
        )

    def _measurements(self, name: str, y: Any) -> Vector:
        p = self.C.shape[0]
        try:
            array = np.asarray(y, dtype=np.float64).reshape(-1)
        except (TypeError, ValueError):
            raise ValueError(f"{name} = {y!r}: must be {p} numbers, NaN if missing") from None
        if array.size != p:
            raise ValueError(f"{name} has {array.size} entries: must have {p}, one for each output")
        return array

    def _inputs(self, name: str, value: Any, count: int) -> Vector:
        return np.zeros(count) if value is None else checks.vector(name, value, count)


class Estimator:
    """A running ``MultivariableESO``.

    Before the first sample, and after ``reset``, it waits for a measurement, from which it starts
    at rest.

    Parameters
    ----------
    observer
        a ``MultivariableESO``.
    """

    def __init__(self, observer: MultivariableESO) -> None:
        self.observer = observer
        self._z = np.zeros(observer.model.states)
        self._estimate = np.zeros(observer.estimates)
        self._nothing = np.zeros(observer.E.shape[1])
        self.is_started = False

    def __repr__(self) -> str:
        return f"Estimator({self.observer!r})"

    def step(self, y: Any, u: Any, d_known: Any = None) -> Vector:
        """Take one sample; return the estimates (N,), x̂, d̂ and the derivatives of d̂.

        Parameters
        ----------
        y
            measurements (p,) [y-units]. What is NaN, infinite, or above 1e60 is missing.
        u
            control signals (m,) that were applied, after all limits, over the sample that ends with
            y [u-units].
        d_known
            known part (q,) of the disturbances over the same sample, such as what a model or a
            learner says; d̂ is then the rest. Zero by default.

        Raises
        ------
        ValueError
            if u or d_known is not finite, or a size does not fit.
        """
        observer = self.observer
        y = observer._measurements("y", y)
        u = observer._inputs("u", u, observer.B.shape[1])
        d = (
            self._nothing
            if d_known is None
            else checks.vector("d_known", d_known, self._nothing.size)
        )
        if not self.is_started:
            self._start(y, u, takes_sample=True)
        else:
            _entry(observe_sample)(observer.model, self._z, self._estimate, y, u, d)
        return self._estimate.copy()

    def step_record(self, y: Matrix, u: Matrix, d_known: Matrix, found: Matrix) -> None:
        """Take samples, one in each row; write the estimates into ``found`` (K, N)."""
        running = self._z, self._estimate
        _entry(observe_record)(self.observer.model, *running, y, u, d_known, found)

    def start(self, y: Any, u: Any = None) -> None:
        """Start at rest at measurements y (p,), under control signals u (m,); see ``at_rest``.

        The next ``step`` is the first sample after that, and the first of a period of ``every``.
        """
        y = self.observer._measurements("y", y)
        if not np.any(np.isfinite(y)):
            raise ValueError(f"y = {y.tolist()}: at least one output must have been measured")
        self._start(y, self.observer._inputs("u", u, self.observer.B.shape[1]), takes_sample=False)

    def set(self, estimate: Any) -> None:
        """Start with given estimates (N,)."""
        self._estimate[:] = checks.vector("estimate", estimate, self.observer.estimates)
        begin_signals(self.observer.model, self._z, self._estimate)
        self.is_started = True

    def reset(self) -> None:
        """Forget everything: the next measurement is a start at rest."""
        self._z[:] = self._estimate[:] = 0.0
        self.is_started = False

    @property
    def estimate(self) -> Vector:
        """The estimates (N,) of the last sample."""
        return self._estimate.copy()

    @property
    def x(self) -> Vector:
        """The estimated states (n,)."""
        return self._estimate[: self.observer.order].copy()

    @property
    def d(self) -> Vector:
        """The estimated disturbances (q,), without what was known of them."""
        n = self.observer.order
        return self._estimate[n : n + self._nothing.size].copy()

    @property
    def innovations(self) -> Vector:
        """Innovations (p,) of the last sample, each measurement less its prediction; 0 if missing.

        In a sensor that works they are noise without a mean.
        """
        size = self._estimate.size
        return self._z[size + 1 : size + 1 + self.observer.C.shape[0]].copy()

    @property
    def covariance(self) -> Matrix:
        """Covariance (N, N) of the errors of the last estimates.

        With ``time_varying`` it depends on what has been measured, else it is the steady one.
        """
        model, fixed = self.observer.model, self.observer.covariance
        if fixed is None:
            raise ValueError(
                "the gains are by poles, which know no noise: give noise_variance and drift"
            )
        if not isinstance(model, RiccatiModel):
            return fixed.copy()
        size = self._estimate.size
        at = size + 1 + self.observer.C.shape[0]
        P: Matrix = self._z[at : at + size * size].reshape(size, size)
        return P * np.outer(model.units, model.units)

    def _start(self, y: Vector, u: Vector, takes_sample: bool) -> None:
        """Start at rest if there is a measurement; wait otherwise."""
        if not np.any(np.isfinite(y)):
            return
        self.set(self.observer.at_rest(y, u))
        if takes_sample:
            self._z[self._estimate.size] = 1.0 % self.observer.model.period


def _entry(function: Any) -> Any:
    """Return an entry point for arrays of any shape, or plain Python where all runs as such."""
    return function.plain if dispatch.interpret_all else function
