"""Averages over the fits of several forms: means, physical units, the visible frequencies."""

from __future__ import annotations

import math

import numpy as np

from quell.identification.running_loop.fit import LoopFit
from quell.identification.running_loop.model import responses
from quell.types import Matrix, Vector

# Least ratio of the power that u causes in y to that of noise, by frequency, that shows the plant.
_VISIBLE = 1.0
# Parts of the record over which spectra are averaged: chosen by hand.
_SEGMENTS = 16


def _places(one: LoopFit) -> list[int]:
    """Return the places of a, b, τ and T in the covariance of a fit; −1 for what it has not."""
    form = one.form
    first = form.times.start
    lag, delay = first if form.lag else -1, form.size - 1 if form.delay else -1
    return [*range(form.order), form.size, lag, delay]


def physical(one: LoopFit, unit: float, dt: float) -> tuple[Vector, Matrix]:
    """Return the units of a (ascending), b, τ, T, and their covariance with a descending."""
    n = one.form.order
    scale = np.concatenate([dt ** (np.arange(float(n)) - n), [unit, dt, dt]])
    places = _places(one)
    known = np.array([place >= 0 for place in places])
    covariance = one.covariance[np.ix_(places, places)] * np.outer(known, known)
    order = np.r_[np.arange(n)[::-1], n : n + 3]
    return scale, (covariance * np.outer(scale, scale))[np.ix_(order, order)]


def gain(one: LoopFit) -> tuple[float, float]:
    """Return b and its deviation, in units of a sample."""
    place = one.form.size
    return float(one.beta[0]), math.sqrt(max(float(one.covariance[place, place]), 0.0))


def total_delay(one: LoopFit) -> tuple[float, float]:
    """Return τ + T and its deviation [samples]."""
    if one.form.share is not None:
        place = one.form.times.start
        return float(one.phi[place]), math.sqrt(max(float(one.covariance[place, place]), 0.0))
    places = [place for place in _places(one)[-2:] if place >= 0]
    variance = float(np.sum(one.covariance[np.ix_(places, places)]))
    total = one.form.lag_of(one.phi) + one.form.delay_of(one.phi)
    return total, math.sqrt(max(variance, 0.0))


def mean(estimates: list[tuple[float, float]], weights: Vector) -> tuple[float, float]:
    """Return mean and deviation of the mixture of values with deviations."""
    values, spreads = np.array(estimates).T
    mean = float(weights @ values)
    return mean, math.sqrt(float(weights @ (spreads**2 + (values - mean) ** 2)))


def visible_up_to(best: LoopFit, u: Vector, dt: float) -> float:
    """Return the frequency up to which u moves y by more than the noise does [rad/s].

    It compares the spectrum of u behind the plant with that of the error behind the noise's model,
    whose gains hold for an unstable plant, too.
    """
    from scipy.signal import welch

    length = min(max(64, u.size // _SEGMENTS), best.error.size)
    frequency, moving = welch(u, nperseg=length)
    _, disturbing = welch(best.error, nperseg=length)
    omega = 2.0 * math.pi * frequency[1:]
    of_u, of_error = responses(best.form, best.phi, best.error.size, omega)
    with np.errstate(all="ignore"):
        moved = (best.beta[0] * of_u) ** 2 * moving[1:]
        seen = np.flatnonzero(moved > _VISIBLE * of_error**2 * disturbing[1:])
    return float(omega[seen[-1]]) / dt if seen.size else 0.0
