"""A transfer function with the dry friction and the delay that an identification found."""

from __future__ import annotations

from quell.plants.base import Plant
from quell.plants.delay import delayed
from quell.plants.linear import LinearPlant
from quell.plants.nonlinear.friction import FrictionPlant
from quell.types import Vector


def with_friction_and_delay(
    linear: LinearPlant,
    num: Vector,
    den: Vector,
    force: float | None,
    width: float | None,
    delay: float,
    dt: float,
) -> Plant:
    """Return the plant ``linear`` for simulations, as identified.

    Parameters
    ----------
    linear
        the plant without friction and delay.
    num, den
        its transfer function, highest power of s first.
    force, width
        Coulomb friction [u-unit] and the speed at which three quarters of it act [y-unit/s]; None
        or zero for none.
    delay
        [s]; with friction rounded to a whole number of samples.
    dt
        sample time of the loop [s].
    """
    plant: Plant = linear
    if force and width:
        plant = FrictionPlant(linear, num, den, force, width, linear.name)
    if plant is not linear:
        delay = round(delay / dt) * dt
    return delayed(plant, delay, dt) if delay > 0.0 else plant
