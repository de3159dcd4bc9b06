"""The controller bandwidth for a given settling time."""

from __future__ import annotations

from quell import checks


def omega_c_for(settling_time: float, order: int, band: float = 0.02) -> float:
    """Return the controller bandwidth [rad/s] with which the ideal loop settles in a given time.

    The unit step response of the ideal loop ``omega_c^n / (s + omega_c)^n`` is the regularised
    incomplete gamma function ``P(n, omega_c t)``. It rises without overshoot, so the loop settles
    when ``P(n, omega_c t) = 1 − band``. For 2 % and n = 1, 2 that is 3.91/t and 5.83/t, which
    Herbst (*Electronics* 2, 2013) rounds to 4/t and 6/t. A real loop, with an observer and a plant
    that differs from its model, settles in another time.

    Parameters
    ----------
    settling_time
        time after which y stays in the band [s].
    order
        order n of the plant.
    band
        half width of the band, as a fraction of the step.

    Raises
    ------
    ValueError
        for a time that is not positive, an order below 1, or a band outside of (0, 1).

    Examples
    --------
    >>> round(omega_c_for(settling_time=2.0, order=2), 3)
    2.917
    """
    from scipy.special import gammainccinv

    settling_time = checks.positive("settling_time", settling_time, "s")
    order = checks.whole("order", order, 1)
    if not checks.positive("band", band) < 1.0:
        raise ValueError(f"band = {band!r}: must be below 1, it is a fraction of the step")
    return float(gammainccinv(order, band)) / settling_time
