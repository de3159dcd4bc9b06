"""The contracts themselves."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import math
import pickle
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql
from quell import plants as plant_room
from quell.controllers import in_single_precision
from quell.controllers.base import control
from quell.controllers.stateful import named_arrays as _named_arrays
from quell.features import Bias, Input, Polynomial, State
from quell.kernels.dispatch import call_specialised, compiled, dispatcher_for, interpreted, kernel
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    forget,
    lag_memory,
    lag_of,
    lag_push,
    learner_flags,
    predict,
    restart,
)
from quell.observers.design import FORMS
from quell.observers.forms import (
    acting_control,
    begin,
    expected_measurement,
    observe,
    without_delay,
)
from quell.plants import registry
from quell.plants.base import advance, begin_run, measure, measure_all
from quell.simulation.driver import run_block
from tests.cases import cases

from .examples import (
    CHAIN,
    EXTENDED,
    FROM_FILES,
    LEARNERS,
    OBSERVERS,
    PLANTS,
    PYTHON_LEARNERS,
)

SCENARIO = ql.Scenario(
    reference=ql.signals.Sinusoid(omega=1.5),
    disturbances=(0.3 * ql.signals.Step(at=1.0),),
    noise=ql.signals.BandLimitedNoise(1e-8, 0.01),
    duration=3.0,
    rest_at=(2.0,),
)


SHORT = dataclasses.replace(SCENARIO, duration=1.5, rest_at=(1.2,))


class Sample(NamedTuple):
    """Estimates of a sample: an array of known shape, so that kernels are those of the loops."""

    seen: Any


def law_for(plant: Any, b0: float = 1.5, **options: Any) -> ql.ADRC:
    """A controller for a plant of its order."""
    return ql.ADRC(
        ql.ESO.model_free(order=plant.order, b0=b0, omega_o=12.0, dt=0.01), omega_c=1.5, **options
    )


def check_run(plant: Any, controller: ql.ADRC, scenario: ql.Scenario = SCENARIO) -> None:
    """A run is repeatable, compiled once, and the same interpreted."""
    first = ql.simulate(plant, controller, scenario)
    compiled_before = len(run_block.signatures)
    again = ql.simulate(plant, controller, scenario)
    assert len(run_block.signatures) == compiled_before, "the second run compiled again"
    np.testing.assert_array_equal(first.log, again.log)
    assert np.all(np.isfinite(first.log))
    plainly = ql.simulate(plant, controller, scenario, interpret=True)
    # Fused multiply-add rounds otherwise, and a learner remembers it.
    np.testing.assert_allclose(plainly["y"], first["y"], rtol=1e-6, atol=1e-8)


def flat(parameters: Any) -> list[Any]:
    """Return the fields of a NamedTuple, at any depth."""
    return [
        leaf
        for field in parameters
        for leaf in (flat(field) if isinstance(field, tuple) else [field])
    ]


def test_every_plant_has_an_example() -> None:
    """Public functions of plants are registered, and each public class has an instance.

    Plants from files are tested in test_fmu.py, test_fmu_axes.py and test_any_plant.py.
    """
    no_plants = {
        *("Flow", "Plant", "PlantBatch", "batch", "labelled", "linearised", "signals_of"),
        "rotor_levers",
    }
    public = {
        inspect.unwrap(getattr(plant_room, name)) for name in set(plant_room.__all__) - no_plants
    }
    classes = {thing for thing in public if isinstance(thing, type)}
    registered = [*registry.PLANTS.items(), *registry.AXES_PLANTS.items()]
    made = {inspect.unwrap(make) for name, make in registered if name not in FROM_FILES}
    assert public - classes == made - {registry.linear}
    examples = [*PLANTS.values(), *PLANTS_OF_AXES.values()]
    assert classes <= {type(plant) for plant in examples} | {plant_room.FMU}


# Plants with several control signals.
PLANTS_OF_AXES: dict[str, Any] = {
    "arm": plant_room.arm(motor_inertia=0.1, stiffness=(math.inf, 300.0), encoders="both"),
    "quadrotor attitude": plant_room.quadrotor_attitude(),
    "linear": plant_room.LinearPlant(
        [[0.0, 1.0], [-2.0, -0.3]], [[0.0, 0.0], [1.0, 0.5]], np.eye(2)
    ),
    "nonlinear": plant_room.NonlinearPlant(
        lambda t, x, u, w, a: (u[0] - a * x[0] ** 3, u[1] - x[1] + w[0]),
        2, np.eye(2), parameters={"a": 2.0}, inputs=2,
    ),
    "encoded": plant_room.encoded_outputs(plant_room.arm(), 1e-4),
    "delayed": plant_room.delayed_inputs(plant_room.arm(), [0.02, 0.0], 0.01),
}  # fmt: skip


@compiled
def move_all(model: Any, x: Any, scratch: Any, u: Any, w: Any, y: Any) -> None:
    """Move a plant with several signals, with no controller around it."""
    for k in range(u.shape[0]):
        measure_all(model, x, y[k])
        advance(model, x, scratch, 0.01 * k, u[k], w[k])


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.parametrize("name", PLANTS_OF_AXES)
def test_a_plant_of_several_signals_moves_the_same_again_and_interpreted(name: str) -> None:
    """Same input, same output, to the last bit; interpreted = compiled, but for rounding."""
    plant, t = PLANTS_OF_AXES[name], 0.01 * np.arange(100)
    w = np.repeat(0.3 * (t[:, None] >= 0.5), plant.disturbances, axis=1)
    u = np.sin(np.outer(t, 3.0 + np.arange(plant.inputs)))

    def moved(interpret: bool) -> Any:
        model, y = plant.sampled(0.01, interpret), np.empty((t.size, plant.outputs))
        x, scratch = np.zeros(plant.order), np.zeros(6 * plant.order)
        begin_run(model, x, scratch)
        entry = interpreted(move_all) if interpret else partial(call_specialised, move_all)
        entry(model, x, scratch, u, w, y)
        return y

    first = moved(False)
    np.testing.assert_array_equal(moved(False), first)
    assert np.all(np.isfinite(first))
    assert np.all(np.any(first != 0.0, axis=0))
    np.testing.assert_allclose(moved(True), first, rtol=1e-6, atol=1e-7)


@compiled
def move(model: Any, x: Any, scratch: Any, u: Any, w: Any, y: Any) -> None:
    """Move a plant, as a simulation does, with no controller around it."""
    for k in range(u.size):
        y[k] = measure(model, x)
        advance(model, x, scratch, 0.01 * k, u[k], w[k])


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.parametrize("name", PLANTS)
def test_a_plant_moves_the_same_again_and_interpreted(name: str) -> None:
    """Same input, same output, to the last bit; interpreted = compiled, but for rounding."""
    plant, t = PLANTS[name], 0.01 * np.arange(150)
    w = np.repeat(0.3 * (t[:, None] >= 0.5), plant.disturbances, axis=1)

    def moved(interpret: bool) -> Any:
        model, y = plant.sampled(0.01, interpret), np.empty(t.size)
        x, scratch = np.zeros(plant.order), np.zeros(6 * plant.order)
        begin_run(model, x, scratch)
        entry = interpreted(move) if interpret else partial(call_specialised, move)
        entry(model, x, scratch, np.sin(3.0 * t), w, y)
        return y

    first = moved(False)
    np.testing.assert_array_equal(moved(False), first)
    assert np.all(np.isfinite(first))
    assert np.any(first != 0.0)
    np.testing.assert_allclose(moved(True), first, rtol=1e-6, atol=1e-8)


@pytest.mark.trial
@cases("name", PLANTS)
def test_a_plant_changes_nothing_but_its_state(name: str, rng: np.random.Generator) -> None:
    """Parameters and inputs stay; measuring changes nothing."""
    plant = PLANTS[name]
    model = plant.sampled(0.01)
    before = copy.deepcopy(model)
    x, w = rng.normal(size=plant.order), rng.normal(size=plant.disturbances)
    x_before, w_before = x.copy(), w.copy()
    y = measure(model, x)
    np.testing.assert_array_equal(x, x_before)
    advance(model, x, np.zeros(6 * plant.order), 0.0, 0.5, w)
    assert np.any(x != x_before)
    assert np.isfinite(y)
    np.testing.assert_array_equal(w, w_before)
    for one, other in zip(flat(model), flat(before), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", OBSERVERS)
def test_an_observer_estimates_a_constant_disturbance_and_changes_only_its_state(name: str) -> None:
    """On its own model: state and f are found, parameters stay; with more extended states also its derivatives."""
    observer = OBSERVERS[name]
    size, model = observer.estimates, observer.model
    before = copy.deepcopy(model)
    extended = without_delay(model)
    f, u = 0.7, 0.4
    truth = np.zeros(size)
    truth[observer.order] = f
    truth[observer.order + 1 :] = (0.3, -0.05)[: observer.disturbance_order - 1]
    z, seen = np.zeros(observer.states), np.zeros(size)
    begin(model, z, seen, 0.0)
    for _ in range(600):
        truth = extended.transition @ truth + extended.input * u
        observe(model, z, seen, truth[0], u, 0.0)
    scale = 12.0 ** -np.arange(size)
    np.testing.assert_allclose(
        seen * scale, truth * scale, rtol=1e-5, atol=1e-5 * np.max(np.abs(truth * scale))
    )
    for one, other in zip(flat(model), flat(before), strict=True):
        np.testing.assert_array_equal(one, other)


@compiled
def estimate(
    model: Any, z: Any, sample: Sample, lag: Any, shadow: Any, y: Any, u: Any, found: Any
) -> None:
    """Show an observer and its lag filter what is given, as a law does, with no loop around it."""
    begin(model, z, sample.seen, y[0])
    for k in range(1, y.size):
        f_learned = 0.1 * u[k]
        found[k, 0] = expected_measurement(model, z, u[k - 1], f_learned)
        found[k, 1] = acting_control(model, z, u[k - 1])
        observe(model, z, sample.seen, y[k], u[k - 1], f_learned)
        found[k, 2] = lag_push(lag, shadow, 0, f_learned)
        for i in range(sample.seen.size):
            found[k, 3 + i] = sample.seen[i]


# One form for the smallest and the largest order, the others for four; the other observers have
# order two.
TO_COMPILE = [
    name
    for name in OBSERVERS
    if (
        ("order 2" not in name and name not in EXTENDED)
        or name in ("cascade, m = 3", "kalman, m = 2")
    )
    and not ("order 4" in name if "current" in name else "order 1," in name or "order 8" in name)
]


@pytest.mark.trial
@pytest.mark.compiled
@cases("name", TO_COMPILE)
def test_an_observer_estimates_the_same_again_and_interpreted(
    name: str, rng: np.random.Generator
) -> None:
    """Same samples, same estimates, to the last bit; interpreted = compiled."""
    observer = OBSERVERS[name]
    y, u = 0.01 * rng.normal(size=(2, 300)).cumsum(axis=1)
    # A nonlinear observer has no lag filter; any will do.
    lag = lag_of(OBSERVERS["half gain" if "nonlinear" in name else name])

    def estimates(entry: Any) -> Any:
        z, sample = np.zeros(observer.states), Sample(np.zeros(observer.estimates))
        found = np.zeros((y.size, 3 + observer.estimates))
        entry(observer.model, z, sample, lag, lag_memory(lag, 1), y, u, found)
        return found

    first = estimates(partial(call_specialised, estimate))
    np.testing.assert_array_equal(estimates(partial(call_specialised, estimate)), first)
    assert np.all(np.isfinite(first))
    scale = np.max(np.abs(first), axis=0)
    # Fused multiply-add rounds otherwise.
    np.testing.assert_allclose(estimates(interpreted(estimate)) / scale, first / scale, atol=1e-9)


@pytest.mark.parametrize("name", OBSERVERS)
def test_an_observer_runs_the_same_again(name: str) -> None:
    """In a loop: same seed, same output."""
    observer = OBSERVERS[name]
    companion = np.diag(np.ones(observer.order - 1), 1)
    companion[-1] = -observer.a
    ends = np.eye(observer.order)
    plant = ql.plants.LinearPlant(companion, 1.5 * ends[-1], ends[0])
    first, again = (ql.simulate(plant, ql.ADRC(observer, omega_c=1.0), SHORT) for _ in range(2))
    np.testing.assert_array_equal(first.log, again.log)
    assert np.all(np.isfinite(first.log))


@pytest.mark.trial
@pytest.mark.compiled
def test_a_guarded_learner_runs_the_same_again_and_interpreted() -> None:
    """In a loop: same seed, same output; no second compilation; interpreted = compiled.

    So it is without a guard and with other learners, whose functions are compared below. This loop
    is one that other tests of the guard compile.
    """
    plant, learner = ql.plants.two_mass_spring(), LEARNERS["Kalman"]
    guarded = law_for(plant, 1.0, learner=learner, guard=ql.Guard(time=0.5))
    check_run(plant, guarded, SHORT)


@pytest.mark.parametrize("name", LEARNERS)
def test_a_learner_changes_only_its_memory(name: str, rng: np.random.Generator) -> None:
    """What it is shown stays as it was; predicting changes nothing at all."""
    learner = LEARNERS[name]
    design = learner.design(OBSERVERS["model-free, order 2, current"], 1.0)
    memory = learner.memory(design)
    for _ in range(200):
        seen = rng.normal(size=3)
        before = seen.copy()
        adapt(design, memory, seen, seen[0] + 1e-6, 0.3, seen[2])
        commit(design, memory, seen, 0.3, 0.1)
        np.testing.assert_array_equal(seen, before)
    # The first prediction may write to room for calculation.
    first = predict(design, memory, np.ones(3), 0.2)
    frozen = {label: array.copy() for label, array in _named_arrays(memory).items()}
    assert predict(design, memory, np.ones(3), 0.2) == first
    assert np.all(np.isfinite(first))
    for label, array in _named_arrays(memory).items():
        np.testing.assert_array_equal(array, frozen[label], err_msg=label)


def test_every_observer_form_has_examples_with_more_extended_states() -> None:
    """All that make an ``ESO``, all forms, and all options of ``model_free`` and ``model_based``."""
    makers = {maker for maker, _ in inspect.getmembers(ql.ESO, inspect.ismethod) if maker[0] != "_"}
    for m in (2, 3):
        names = [name.removesuffix(f", m = {m}") for name in EXTENDED if name.endswith(str(m))]
        assert makers == {name.partition(",")[0] for name in names}
        shown = {name.partition(", ")[2].partition("=")[0] for name in names} - {""}
        options = set(inspect.signature(ql.ESO.model_based).parameters)
        assert shown == options - {
            *("plant", "omega_o", "dt", "b0", "E", "far", "disturbance_order", "frequencies")
        }
        forms = {name.partition("form=")[2] for name in names} - {""}
        assert forms == set(FORMS)


@pytest.mark.parametrize("name", LEARNERS)
def test_a_learner_does_not_see_the_derivatives_of_f(name: str, rng: np.random.Generator) -> None:
    """With f', … behind f among the estimates it learns and says the same, whatever they are."""
    learner = LEARNERS[name]
    design = learner.design(OBSERVERS["model-free, order 2, current"], 1.0)
    memories = [learner.memory(design) for _ in range(2)]
    said: list[list[Any]] = [[], []]
    for _ in range(100):
        seen = rng.normal(size=3)
        for memory, shown, out in zip(
            memories, (seen, np.append(seen, (1e3, -1e4))), said, strict=True
        ):
            adapt(design, memory, shown, seen[0] + 1e-6, 0.3, seen[2])
            out.append(predict(design, memory, shown, 0.2))
            commit(design, memory, shown, 0.3, 0.1)
    assert said[0] == said[1]


@cases("name", LEARNERS)
def test_a_learner_names_its_coefficients(name: str) -> None:
    """Each once, and as many as it writes."""
    learner = LEARNERS[name]
    for order in (
        (2,) if name in PYTHON_LEARNERS else (1, 4)
    ):  # a network has inputs of its own, here two
        design = learner.design(OBSERVERS[f"model-free, order {order}, current"], 1.0)
        names = learner.feature_names(order)
        theta = np.full(len(names) + 1, np.nan)
        coefficients(design, learner.memory(design), theta[: len(names)])
        assert len(names) == len(set(names))
        np.testing.assert_array_equal(theta, [*[0.0] * len(names), np.nan])


class SmallLoop(NamedTuple):
    """A plant, its observer and their states: arrays of known shape, so that kernels are those of loops."""

    plant: Any
    eso: Any
    lag: Any
    shadow: Any
    z: Any
    seen: Any
    x: Any
    scratch: Any
    w: Any


def small_loop() -> SmallLoop:
    """Return a loop at rest."""
    observer = OBSERVERS["model-free, order 2, current"]
    lag = lag_of(observer)
    states = tuple(map(np.zeros, (observer.states, 3, 2, 12, CHAIN.disturbances)))
    return SmallLoop(CHAIN.sampled(0.01), observer.model, lag, lag_memory(lag, 1), *states)


@kernel
def show(loop: SmallLoop, seen: Any, k: int, y: float, f: float, u: float, f_learned: float) -> Any:
    """Estimate what a learner sees: what is given, or the loop's; return the measurement and f_plain."""
    if seen.shape[0] > 0:
        for i in range(loop.seen.size):
            loop.seen[i] = seen[k, i]
        return y, f
    measured = measure(loop.plant, loop.x) + y
    shown = lag_push(loop.lag, loop.shadow, 0, f_learned)
    observe(loop.eso, loop.z, loop.seen, measured, u, f_learned)
    return measured, loop.seen[2] + shown


@kernel
def act(loop: SmallLoop, k: int, constant: float, slope: float) -> Any:
    """Move the loop's plant by a law without limits, at the reference 0.5; return u and f_learned."""
    force = 2.25 * (0.5 - loop.seen[0]) - 3.0 * loop.seen[1] - loop.seen[2]
    u = (force - constant) / (1.5 + slope)
    advance(loop.plant, loop.x, loop.scratch, 0.01 * k, u, loop.w)
    return u, constant + slope * u


@compiled
def drive(
    design: Any,
    memory: Any,
    loop: SmallLoop,
    seen: Any,
    y: Any,
    u: Any,
    f: Any,
    said: Any,
    theta: Any,
) -> None:
    """Show a learner what is given; if no estimates are, ``y`` is noise in a loop around it.

    What is shown estimates forgets halfway, after its θ was read, and restarts after three
    quarters. What does not depend on the learner's type is in ``show`` and ``act``, compiled once.
    """
    given = seen.shape[0] > 0
    applied = f_learned = 0.0
    for k in range(y.size):
        if given:
            applied = u[k]
        measured, f_plain = show(loop, seen, k, y[k], f[k], applied, f_learned)
        adapt(design, memory, loop.seen, measured, applied, f_plain)
        constant, slope = predict(design, memory, loop.seen, applied)
        said[k, 0], said[k, 1], said[k, 2] = constant, slope, learner_flags(design, memory)
        said[k, 3] = measured
        if not given:
            applied, f_learned = act(loop, k, constant, slope)
        commit(design, memory, loop.seen, applied, f_learned)
        if given and 4 * k == 2 * y.size:
            coefficients(design, memory, theta)
            forget(design, memory)
        if given and 4 * k == 3 * y.size:
            restart(design, memory)


def driven(entry: Any, name: str, seen: Any, y: Any, u: Any, f: Any) -> tuple[Any, Any, Any]:
    """Return what a learner of order 2 said (and y), its θ halfway, and its memory."""
    learner = OTHERWISE.get(name, LEARNERS[name])
    design = learner.design(OBSERVERS["model-free, order 2, current"], 1.0)
    memory, said = learner.memory(design), np.empty((y.size, 4))
    theta = np.zeros(len(learner.feature_names(2)))
    entry(design, memory, small_loop(), seen, y, u, f, said, theta)
    return said, theta, memory


compiled_drive = partial(call_specialised, drive)

# One selects among the features of "RLS with u", the other has u among its features.
OTHERWISE = {
    "RLS on the strongest": ql.learners.RLS(State() + Polynomial() + Bias() + Input(), strongest=5),
    "Harmonic with search": ql.learners.Harmonic(u=True, count=2, orders=(1, 3), search=True),
}

# The code of the first three is a part of that of Harmonic with search and u (test_harmonic has its
# long runs), that of the fourth one of that of the other RLS learners; the features of the others
# are compiled in test_features, and their learners are here with other features.
LESS = (
    *("Kalman", "Kalman with u", "Harmonic", "RLS with u"),
    *("NLMS on random features", "gradient on radial features"),
)
TO_DRIVE = [name for name in LEARNERS if name not in LESS]
# All kinds of learners, each with one set of features.
OTHER_FEATURES = ("with u", "on the strongest", "radial features", "random features")
IN_LOOPS = [name for name in LEARNERS if not name.endswith(OTHER_FEATURES)]


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.parametrize("name", TO_DRIVE)
def test_a_learner_says_the_same_interpreted(name: str, rng: np.random.Generator) -> None:
    """Of a motion and its f, for a while after it has begun to learn: interpreted = compiled."""
    t = 0.01 * np.arange(400)
    seen = np.column_stack([np.sin(3.0 * t), 3.0 * np.cos(3.0 * t), -2.0 * np.sin(3.0 * t)])
    y, u = seen[:, 0] + 1e-3 * rng.normal(size=t.size), np.sin(5.0 * t)
    shown = (name, seen, y, u, seen[:, 2].copy())
    (said, theta, _), (plainly, plain_theta, _) = (
        driven(entry, *shown) for entry in (compiled_drive, interpreted(drive))
    )
    assert name == "NoLearner" or np.any(said[:, :2] != 0.0)
    # Fused multiply-add rounds otherwise, and a learner remembers it.
    np.testing.assert_allclose(plainly, said, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(plain_theta, theta, rtol=1e-6, atol=1e-8)


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.parametrize("name", TO_DRIVE)
def test_a_learner_stays_bounded_without_excitation(name: str, rng: np.random.Generator) -> None:
    """A constant reference for 1e5 samples: nothing winds up, drifts or leaves the numbers."""
    noise, none = 1e-4 * rng.normal(size=100_000), np.empty((0, 3))
    said, _, memory = driven(compiled_drive, name, none, noise, noise, noise)
    assert np.max(np.abs(said[10_000:, 3] - 0.5)) < 1e-2
    for label, array in _named_arrays(memory).items():
        assert np.all(np.abs(array) < 1e6), label


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.parametrize("name", TO_DRIVE)
def test_a_learner_stays_bounded_whatever_it_is_shown(name: str, rng: np.random.Generator) -> None:
    """1e5 finite samples of very different size: state and output stay finite and repeatable."""
    # Models that are Python objects take their time.
    samples = 2_000 if name in PYTHON_LEARNERS else 100_000
    # From rest to wild and back, in blocks, with spikes.
    size = np.repeat(10.0 ** rng.uniform(-6.0, 3.0, 100), samples // 100) * np.where(
        rng.random(samples) < 1e-3, 1e3, 1.0
    )
    seen, u, f = (
        rng.normal(size=(samples, 3)) * size[:, None],
        rng.normal(size=samples) * size,
        rng.normal(size=samples) * size,
    )
    y = seen[:, 0] + 1e-3 * size * rng.normal(size=samples)
    said = []
    for _ in range(2):
        found, _, memory = driven(compiled_drive, name, seen, y, u, f)
        said.append(found)
        for label, array in _named_arrays(memory).items():
            assert np.all(np.abs(array) < 1e30), label
    assert np.all(np.abs(said[0][:, :2]) < 1e20)
    np.testing.assert_array_equal(said[0], said[1])


@pytest.mark.trial(cases="MLP")
@pytest.mark.parametrize("name", [name for name in LEARNERS if name != "NoLearner"])
def test_a_learner_that_forgets_is_a_new_one(name: str, rng: np.random.Generator) -> None:
    """Whatever it was shown before: from there on it predicts what a new one does."""
    learner = LEARNERS[name]
    design = learner.design(OBSERVERS["model-free, order 2, current"], 1.0)
    one, other = learner.memory(design), learner.memory(design)

    def show(memory: Any, seen: Any, y: float) -> Any:
        adapt(design, memory, seen, y, 0.3, seen[2])
        said = predict(design, memory, seen, 0.3)
        commit(design, memory, seen, 0.3, 0.1)
        return said

    for size in np.repeat([1e8, 1e3], 50):
        seen = size * rng.normal(size=3)
        show(one, seen, seen[0] + 1e-6)
    forget(design, one)
    again = []
    for _ in range(200):
        seen = rng.normal(size=3)
        again.append(show(one, seen, seen[0] + 1e-6))
        assert show(other, seen, seen[0] + 1e-6) == again[-1]
    assert any(said != (0.0, 0.0) for said in again)


@pytest.mark.parametrize(
    ("name", "guard"),
    [(name, None) for name in LEARNERS if name != "NoLearner"] + [("Kalman", ql.Guard())],
)
def test_a_learner_starts_again_after_measurements_beyond_its_numbers(
    name: str, guard: ql.Guard | None
) -> None:
    """Ten of 1e19, and soon it holds nothing of their size, f̂ is right, and the status said so."""
    observer = ql.ESO.model_free(order=2, b0=1.5, omega_o=80.0, dt=0.01)
    law = ql.ADRC(observer, 6.0, learner=LEARNERS[name], guard=guard, u_min=-5.0, u_max=5.0)
    model, x, started_again = CHAIN.sampled(0.01), np.zeros(2), []
    for k in range(350):
        y = measure(model, x)
        lies = 60 <= k < 70
        with np.errstate(over="ignore", invalid="ignore"):
            u = control(law.parameters, law._state, 0.5, 1e19 * math.sin(k) if lies else y)
        if ql.Status.OVERFLOWED in law.estimate.status:
            started_again.append(k)
        if k >= 300:
            assert abs(law.estimate.f - (-2.0 * x[0] - 0.3 * x[1])) < 1.5
        advance(model, x, np.zeros(12), 0.0, u, np.zeros(CHAIN.disturbances))
    assert 70 <= started_again[-1] < 300
    for label, array in _named_arrays(law._state).items():
        assert np.all(np.abs(array) < 1e12), label


@pytest.mark.parametrize("name", [name for name in LEARNERS if name != "NoLearner"])
def test_a_guarded_learner_goes_on_without_a_trace(name: str) -> None:
    """Saved and restored by named arrays, copied or pickled: the same bits of u and of all states follow, interpreted."""

    def step(law: ql.ADRC, y: float) -> float:
        return control(law.parameters, law._state, 0.5, y)

    one, other = (
        law_for(CHAIN, learner=LEARNERS[name], guard=ql.Guard(time=0.5)) for _ in range(2)
    )
    ys = (np.sin(0.02 * np.arange(140)) + 0.1 * np.sin(0.31 * np.arange(140))).tolist()
    for y in ys[:120]:
        step(one, y)
    other.state = one.state
    others = (other, copy.deepcopy(one), pickle.loads(pickle.dumps(one)))
    expected = [step(one, y) for y in ys[120:]]
    state = _named_arrays(one._state)
    if name in PYTHON_LEARNERS:
        del state["learner.model"]  # the number of the Python object, which is a copy, too
    for copied in others:
        assert [step(copied, y) for y in ys[120:]] == expected
        # The guard may not have let the learner act on u yet: what it holds is compared, too.
        arrays = _named_arrays(copied._state)
        for label, array in state.items():
            np.testing.assert_array_equal(arrays[label], array, err_msg=label)


@pytest.mark.trial(cases="MLP")
@pytest.mark.parametrize("name", IN_LOOPS)
@pytest.mark.parametrize("form", ["current", "predictor"])
def test_a_learner_serves_either_form_of_observer(name: str, form: str) -> None:
    """The loop is stable and ends where it should."""
    observer = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=0.025, form=form)
    run = ql.simulate(
        CHAIN,
        ql.ADRC(observer, omega_c=1.5, learner=LEARNERS[name]),
        ql.Scenario(reference=1.0, duration=10.0),
    )
    assert run["y"][-1] == pytest.approx(1.0, abs=1e-2)


@cases("name", PYTHON_LEARNERS)
def test_a_model_in_python_is_refused_by_name_in_single_precision(name: str) -> None:
    """Its functions take double arrays by address."""
    observer = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=0.01)
    controller = ql.ADRC(observer, 1.5, learner=PYTHON_LEARNERS[name])
    with pytest.raises(ValueError, match="learner is a model in Python"):
        in_single_precision(controller)


def test_the_interpreted_driver_is_the_same_function() -> None:
    """There is one algorithm, not two: what is compiled is the code that runs interpreted."""
    plain = interpreted(run_block)
    assert plain is not run_block
    for entry in (run_block, dispatcher_for(run_block, object())):
        assert entry.py_func.__code__ is plain.__code__
    assert interpreted(plain) is plain
