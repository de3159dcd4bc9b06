"""What an object says of itself when it is printed."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from typing import Any

import pytest

import quell as ql
from quell import controllers as controller_room
from quell import learners as learner_room
from quell import observers as observer_room
from quell import plants as plant_room
from quell.controllers import baselines as baseline_room
from quell.controllers.single import in_single_precision
from tests.cases import cases

from .examples import LEARNERS, OBSERVERS, PLANTS
from .test_controllers import CONTROLLERS, SEVERAL

_DEAD_TIME = controller_room.dead_time_tuning(2.0, 1.0, 0.25)
OTHERS: dict[str, Any] = {
    "Canonical": OBSERVERS["half gain"].plant,
    "PlantBatch": ql.plants.batch(ql.plants.two_mass_spring, m1=[1.0, 1.25]),
    "DeadTimeTuning": _DEAD_TIME,
    "HeldPlant": ql.HeldPlant(noise=1.5),
    "SafeSet": ql.SafeSet(y_max=1.5, alpha=4.0),
    "OnlineGain": ql.OnlineGain(0.5, 5.0),
    "Schedule": ql.Schedule((0.0, 1.0), b0=(5.0, 0.5)),
    "Feedforward": ql.Feedforward.rigid(2.25, viscous=0.75),
    "LinearLaw": CONTROLLERS["LinearController"].law,
    "NonlinearFeedback": controller_room.NonlinearFeedback((0.75, 1.25), 0.05),
    "PidEqual": controller_room.equal_to_pid(2.25, 1.0, dt=0.01),
    "ProfileGenerator": controller_room.ProfileGenerator(1.0, 2.25, 30.0),
    "ReferenceModel": controller_room.ReferenceModel(3.25),
    "TrackingDifferentiator": controller_room.TrackingDifferentiator(2.25),
    "Notch": baseline_room.Notch.at(9.25),
    "ZV": baseline_room.ZV(3.25),
    "ZVD": baseline_room.ZVD(3.25),
    "MZV": baseline_room.MZV(3.25),
    "EI": baseline_room.EI(3.25, humps=2),
    "Shaper": baseline_room.Shaper([0.0, 0.25], [0.5, 0.5]),
    "in single precision": in_single_precision(CONTROLLERS["PID"]),
    "guard": ql.Guard(bound=2.25),
    "Arm": plant_room.arm(),
    "Flow": plant_room.Flow((0.0, 1.25)),
    "Craft": plant_room.quadrotor_attitude(),
    "LinearPlant": plant_room.LinearPlant([[-1.25]], [[2.0, 3.0]], [[1.0]]),
    "Axes": ql.Axes({"x": ql.ADRC(ql.ESO.model_free(2, 1.0, 12.0, 0.01), 1.75)}, [[2.25]]),
    "StateFeedback": SEVERAL["StateFeedback"],
    "MultivariableESO": SEVERAL["StateFeedback"].observer,
    "Estimator": SEVERAL["StateFeedback"].observer.estimator(),
}
PARTS: dict[str, Mapping[str, Any]] = {
    "plant": PLANTS,
    "learner": LEARNERS,
    "observer": OBSERVERS,
    "controller": CONTROLLERS,
    "other": OTHERS,
}
# By name: to make a learner of another library imports that.
EXAMPLES = [(part, name) for part, things in PARTS.items() for name in things]
ROOMS = (controller_room, baseline_room, observer_room, plant_room, learner_room)
# Interfaces; an estimate and a regulator's matrices belong to a running loop, and an FMU and models of other libraries to
# files and packages that are not here.
_WITHOUT = {*("Estimate", "FMU", "GainEstimate", "JaxModel", "Regulator", "TorchModel")}


def public_classes() -> set[str]:
    """Return the names of all public classes that someone can make."""
    public = [getattr(room, name) for room in ROOMS for name in room.__all__]
    classes = [each for each in public if inspect.isclass(each)]
    return {each.__name__ for each in classes if not getattr(each, "_is_protocol", False)}


def test_every_public_class_has_an_example() -> None:
    """Of controllers, observers, plants and learners; so a new one is in the next test."""
    things = [PARTS[part][name] for part, name in EXAMPLES]
    shown = {base.__name__ for thing in things for base in type(thing).__mro__}
    made = {
        name for name in OTHERS if name in ("ZV", "ZVD", "MZV", "EI")
    }  # functions that return a Shaper
    assert public_classes() - _WITHOUT - made <= shown


@cases(("part", "name"), EXAMPLES)
def test_an_object_prints_its_numbers_and_no_address(part: str, name: str) -> None:
    """In one line, with the name of its class."""
    thing = PARTS[part][name]
    shown = repr(thing)
    assert " at 0x" not in shown
    assert "\n" not in shown
    assert type(thing).__name__ in shown
    assert str(thing) == shown


def test_the_numbers_are_those_the_object_was_made_with() -> None:
    """Gains, filter, limits, and what differs from its default; not what is as by default."""
    pid = baseline_room.PID(4.25, 2.5, 1.125, tf=0.05, dt=0.01, u_max=3.5)
    for part in ("kp=4.25", "ki=2.5", "kd=1.125", "tf=0.05", "dt=0.01", "u_max=3.5"):
        assert part in repr(pid)
    assert not re.search("u_min|rate_limit|setpoint", repr(pid))
    adrc = ql.ADRC(
        ql.ESO.model_free(2, -1.5, 12.0, 0.01, delay=0.02), 1.75, learner=ql.learners.MLP()
    )
    for part in ("b0=-1.5", "omega_o=12", "delay=0.02", "omega_c=1.75", "MLP(", "hidden=10"):
        assert part in repr(adrc)


@cases("name", [name for name in learner_room.__all__ if name not in _WITHOUT])
def test_features_are_the_first_argument_of_every_learner_that_takes_them(name: str) -> None:
    """By the name ``features``; behind the model where a learner is made of one."""
    thing = getattr(learner_room, name)
    if not inspect.isclass(thing):
        return
    parameters = [*inspect.signature(thing).parameters]
    if "features" in parameters:
        assert parameters.index("features") == (1 if parameters[0] == "model" else 0)


def test_arguments_in_the_old_order_are_told_apart_and_warn() -> None:
    """The number before the features; what no order explains is an error."""
    features = ql.features.State() + ql.features.Bias()
    with pytest.warns(DeprecationWarning, match=r"hidden = 5 came first: .* give hidden="):
        learner = ql.learners.MLP(5, features)
    assert (learner.model.hidden, learner.features) == (5, features)
    with pytest.warns(DeprecationWarning, match="budget = 20 came first"):
        assert ql.learners.GaussianProcess(20).model.budget == 20
    with pytest.warns(DeprecationWarning, match="rate = None came first"):
        assert ql.learners.NLMS(None, features).features is features
    for wrong in (
        lambda: ql.learners.MLP(5, hidden=3),
        lambda: ql.learners.BatchGradient(1e-6, 10),
    ):
        with pytest.raises(ValueError, match="features = .*: must be made of blocks"):
            wrong()
