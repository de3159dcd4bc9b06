"""Peak-to-peak gains of learned corrections, beside those of an independent program."""

from __future__ import annotations

import pytest

import quell as ql
from quell.analysis import certify
from quell.guard.guard import plain_loop
from quell.lti.models import peak_gain
from quell.plants.linear import sampled_plant
from tests.cases import cases

# From a correction that is added in the law alone, at b/b0 = 0.7, 1.1, 1.3 and 1.6.
LAW_ALONE = {
    1: ("0.36", "0.10", "0.27", "0.47"),
    2: ("0.44", "0.12", "0.32", "0.57"),
    4: ("0.64", "0.13", "0.37", "1.0"),
}
# From one that is fed through the observer, by order and b/b0.
THROUGH_OBSERVER = {(1, 1.3): "0.28", (2, 1.3): "0.37", (4, 1.3): "0.66", (4, 0.7): "1.21"}


def chain(order: int, b: float) -> tuple[list[float], list[float]]:
    """Return a chain of integrators with the gain b; b0 is 1."""
    return [b], [1.0] + [0.0] * order


def design(order: int) -> ql.ADRC:
    """Return the controller of the table: omega_o = 10, omega_c = 1, 5 ms."""
    observer = ql.ESO.model_free(order=order, b0=1.0, omega_o=10.0, dt=0.005)
    return ql.ADRC(observer, omega_c=1.0)


@pytest.mark.parametrize("order", LAW_ALONE)
def test_gains_in_the_law_alone_are_the_ones_of_the_table(order: int) -> None:
    """To all digits that it gives; at 1 ms one would be 0.36 instead of 0.37."""
    controller = design(order)
    for b, given in zip((0.7, 1.1, 1.3, 1.6), LAW_ALONE[order], strict=True):
        plant = sampled_plant(chain(order, b), controller.dt)
        to_error, _ = plain_loop(plant, controller.observer, controller.parameters.law)
        digits = len(given) - 2
        assert f"{peak_gain(to_error):.{digits}f}" == given


@cases(("order", "b"), THROUGH_OBSERVER)
def test_gains_through_the_observer_are_the_ones_of_the_table(order: int, b: float) -> None:
    """The estimates of the state move, too, which costs little at orders 1 and 2."""
    found = certify(chain(order, b), design(order))
    assert f"{found.gain:.2f}" == THROUGH_OBSERVER[order, b]
