"""The public function."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell import checks
from quell.identification.closed_loop import instrumental
from quell.identification.friction import free_run
from quell.identification.result import Identified, Root
from quell.identification.search import Fit, fit, root_covariance
from quell.identification.structure import Structure
from quell.identification.validation import Predictor, nrmse, residuals, simulated
from quell.parallel import one_blas_thread
from quell.types import Matrix, Vector

_METHODS = (
    "output error, started by refined instrumental variables",
    "instrumental variables from the reference, started by output error",
)
_LAGS = 50
_SAMPLES_A_PARAMETER = 10


def identify(
    u: Any,
    y: Any,
    dt: float,
    order: int = 4,
    zeros: int = 0,
    *,
    integrators: int | None = None,
    delay: float | tuple[float, float] = 0.0,
    bias: bool = True,
    friction: bool = False,
    held_out: float = 0.3,
    horizon: int = 10,
    reference: Any = None,
) -> Identified:
    """Fit a continuous transfer function to recorded input and output.

    It is the model of least output error, ``min Σ (y − ŷ)²`` with ŷ simulated from u alone, exact at the samples for a u that is held
    between them. The search starts at an ARX model in continuous time, least squares on filtered signals, made free of bias by refined
    instrumental variables, and goes on with Levenberg and Marquardt's method (``quell.identification``: ``start``, ``output_error`` and
    ``structure`` have equations and sources).

    Parameters
    ----------
    u
        what the plant was told (N,) [u-unit]; held between samples.
    y
        what was measured (N,) [y-unit], as it was when each u began to act; noise and an encoder's steps are taken for white.
    dt
        sample time [s].
    order
        number of poles n, 1 to 8.
    zeros
        number of zeros, less than n.
    integrators
        how many poles lie at s = 0; by default one is put there where the slowest can't be told from it: it is within three of its
        standard deviations, or slower than ten times the record; two, where that holds of two at once.
    delay
        how late u is [s], a whole number of samples; or the smallest and largest to look through, for the best.
    bias
        whether a constant force acts besides u, as an offset of u does.
    friction
        whether Coulomb friction acts. The sign of the model's own speed is then a second input, with a numerator of its own of degree n −
        2.
    held_out
        the share of the record, its end, that is not used for the fit but to judge it; 0 to 0.9.
    horizon
        how many samples ahead is predicted for the fits of prediction.
    reference
        what was sent into the loop from outside (N,), of data from a closed loop, where it is known: the part of u that answers to it is
        found first, and the model is fitted to that (see Notes).

    Returns
    -------
    Identified

    Raises
    ------
    ValueError
        for records that differ in length, hold a number that is not finite, are too short for so many parameters or do not move; and for
        an order, a number of zeros, a delay or a share that is out of range.

    Notes
    -----
    *Closed loop.* u then answers to the noise in y. The output-error fit stays free of bias as long as what is measured wrongly is white,
    as an encoder's rounding nearly is (Ljung 1999, th. 8.3 and sec. 13.4); forces on the plant, and friction that is not modelled, are
    not. With ``reference`` the estimate uses only what was sent in from outside.

    Examples
    --------
    >>> import numpy as np
    >>> import quell as ql
    >>> t = np.arange(4000) * 0.01
    >>> u = np.sign(np.sin(0.2 * t**1.5))
    >>> y = np.zeros(t.size)
    >>> for k in range(t.size - 1):
    ...     y[k + 1] = np.exp(-0.02) * y[k] + 1.5 * (1.0 - np.exp(-0.02)) * u[k]
    >>> found = ql.identify(u, y, dt=0.01, order=1)
    >>> found.num.round(6).tolist(), found.den.round(6).tolist()
    ([3.0], [1.0, 2.0])
    """
    u, y = checks.vector("u", u), checks.vector("y", y)
    checks.vector("y", y, u.size)
    if reference is not None:
        reference = checks.vector("reference", reference, u.size)
        if np.ptp(reference) == 0.0:
            raise ValueError(
                f"reference is {reference[0]:g} all through: must move; without one leave it out"
            )
    dt = checks.positive("dt", dt, "s")
    order = checks.whole("order", order, 1, 8)
    zeros = checks.whole("zeros", zeros, 0, order - 1)
    if integrators is not None:
        integrators = checks.whole("integrators", integrators, 0, order)
    bias, friction = checks.flag("bias", bias), checks.flag("friction", friction)
    late = _range_of_delays(delay, dt)
    horizon = checks.whole("horizon", horizon, 1)
    held_from = _split(u, y, order, zeros, friction, held_out, horizon, late[1])
    with one_blas_thread():
        found = fit(u[:held_from], y[:held_from], order, zeros, integrators, late, bias, friction)
        if reference is not None:
            v = found.inputs(u[:held_from])
            v = free_run(found.structure, found.found.theta, v, own_friction=True)[1]
            found = found._replace(
                found=instrumental(
                    found.structure, found.found.theta, v, y[:held_from], reference[:held_from]
                )
            )
        return _judged(found, u, y, reference, dt, held_from, horizon)


def _judged(
    found: Fit,
    u: Vector,
    y: Vector,
    reference: Vector | None,
    dt: float,
    held_from: int,
    horizon: int,
) -> Identified:
    structure = found.structure
    a, numerators, covariance = _in_seconds(
        structure, found.found.theta, found.found.covariance, dt
    )
    v, fitted, held = found.inputs(u), slice(0, held_from), slice(held_from, y.size)
    model = simulated(found, v[fitted])
    error, judged_on = y[fitted] - model, u[fitted]
    predictor = Predictor.fitted(error, horizon, structure.order + 1)
    fits = {
        "estimation": nrmse(y[fitted], model),
        "estimation, predicted": predictor.fit_percent(y[fitted], error),
    }
    if held_from < y.size:
        fresh = simulated(found, v[held], y[held])
        model, error, judged_on = np.append(model, fresh), y[held] - fresh, u[held]
        fits |= {
            "held out": nrmse(y[held], fresh),
            "held out, predicted": predictor.fit_percent(y[held], error),
        }
    b = numerators[0, : structure.degrees[0] + 1]
    gain = b[0] if b[0] != 0.0 else np.nan
    rubs = len(structure.rubbing)
    rubbed = numerators[-rubs:] if rubs else np.zeros((0, structure.order))
    free = structure.free
    return Identified(
        num=b[::-1].copy(),
        den=np.append(1.0, a[::-1]),
        covariance=covariance[: free + b.size, : free + b.size],
        poles=_poles(a, covariance, structure),
        zeros=_zeros(b, covariance[free : free + b.size, free : free + b.size]),
        integrators=structure.integrators,
        delay=found.late * dt,
        bias=float(numerators[1, 0] / gain) if found.bias else 0.0,
        friction=float(np.sum(rubbed[:, 0]) / gain) if rubs else None,
        dt=dt,
        horizon=horizon,
        fits=fits,
        residuals=residuals(error, judged_on, min(_LAGS, error.size // 4)),
        resolution=_resolution(y),
        held_from=held_from,
        u=u,
        y=y,
        simulated=model,
        reference=reference,
        converged=found.found.converged,
        method=_METHODS[reference is not None],
    )


def _in_seconds(
    structure: Structure, theta: Vector, covariance: Matrix, dt: float
) -> tuple[Vector, Matrix, Matrix]:
    """Return a, the numerators and the covariance with time in seconds in place of samples."""
    powers = 1.0 / structure.powers(dt)
    scaled = theta * powers
    return (
        structure.denominator(scaled),
        structure.numerators(scaled),
        covariance * np.outer(powers, powers),
    )


def _poles(a: Vector, covariance: Matrix, structure: Structure) -> tuple[Root, ...]:
    free = a[structure.integrators :]
    part = covariance[: free.size, : free.size]
    found = [_root(free, part, value) for value in np.roots(np.append(1.0, free[::-1])).tolist()]
    return tuple(
        sorted(
            [*[Root(0j, 0.0, 0.0)] * structure.integrators, *found],
            key=lambda root: (root.omega, -root.value.imag),
        )
    )


def _zeros(b: Vector, covariance: Matrix) -> tuple[Root, ...]:
    """Return the roots of the numerator, whose covariance is taken relative to its leading coefficient."""
    if b.size < 2:
        return ()
    monic = b[:-1] / b[-1]
    slope = np.column_stack([np.eye(monic.size), -monic]) / b[-1]
    part = slope @ covariance @ slope.T
    return tuple(_root(monic, part, value) for value in np.roots(b[::-1]).tolist())


def _root(a: Vector, covariance: Matrix, value: complex) -> Root:
    real, imag = root_covariance(a, covariance, value)
    return Root(
        complex(value),
        float(np.sqrt(max(real, 0.0))),
        float(np.sqrt(max(imag, 0.0))) if complex(value).imag else 0.0,
    )


def _resolution(y: Vector) -> float:
    """Return the step that y is rounded to, 0.0 where there is none."""
    steps = np.abs(np.diff(y))
    steps = steps[steps > 1e-9 * np.max(np.abs(y))]
    if steps.size == 0:
        return 0.0
    # The mean of the smallest: a file has their last digits rounded.
    step = float(np.mean(steps[steps < 1.5 * np.min(steps)]))
    counts = steps[steps < 50.0 * step] / step
    # Of numbers that are not rounded the smallest difference is no measure of the others.
    return (
        step
        if counts.size > 0.01 * y.size and np.all(np.abs(counts - np.round(counts)) < 0.1)
        else 0.0
    )


def _range_of_delays(delay: Any, dt: float) -> tuple[int, int]:
    if np.ndim(delay) == 0:
        samples = checks.samples("delay", delay, dt)
        return samples, samples
    low, high = (
        checks.samples("delay", value, dt) for value in checks.vector("delay", delay, 2).tolist()
    )
    if low > high:
        raise ValueError(f"delay = {delay!r}: the smallest comes first")
    return low, high


def _split(
    u: Vector,
    y: Vector,
    order: int,
    zeros: int,
    friction: bool,
    held_out: float,
    horizon: int,
    late: int,
) -> int:
    share = checks.non_negative("held_out", held_out)
    if share > 0.9:
        raise ValueError(
            f"held_out = {held_out!r}: must be from 0 to 0.9, the share of the record that is not used for the fit"
        )
    held_from = u.size - int(share * u.size)
    least = max(_SAMPLES_A_PARAMETER * (3 * order + zeros + 2), 3 * horizon * (order + 1), 4 * late)
    if held_from < least:
        raise ValueError(
            f"u has {u.size} samples, {held_from} of them for the fit: must have at least {least} for order {order}; record longer"
        )
    if 0 < u.size - held_from < 3 * horizon * (order + 1):
        raise ValueError(
            f"held_out = {held_out!r}: of {u.size} samples these are {u.size - held_from}, must be at least "
            f"{3 * horizon * (order + 1)} to be judged on; record longer, lower horizon, or hold none out"
        )
    for name, value in (("u", u), ("y", y)):
        if np.ptp(value[:held_from]) == 0.0:
            raise ValueError(
                f"{name} is {value[0]:g} all through the samples for the fit: must move, or nothing can be learned from it"
            )
        if held_from < u.size and np.ptp(value[held_from:]) == 0.0:
            raise ValueError(
                f"held_out = {held_out!r}: {name} is {value[-1]:g} all through these samples, must move to be judged on; "
                "hold fewer out, or none, or cut the record where it rests"
            )
    return held_from
