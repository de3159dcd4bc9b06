"""Batches of linear runs over lanes, against the exact loop."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis.linearise import linear_law
from quell.controllers import baselines
from quell.controllers.linear.form import LinearForm, linear_form
from quell.kernels.dispatch import compiled
from quell.kernels.lanes import LANES, lane_zeros, set_products
from quell.lti.discretize import zero_order_holds
from quell.plants import batch, two_mass_spring
from quell.simulation import sampled_scenario
from quell.simulation.lane_groups import linear_runs
from quell.simulation.sampled_scenario import SampledScenario
from quell.types import Vector

from .contracts.examples import OBSERVERS

pytestmark = pytest.mark.compiled

DT = 0.01
# Of a channel's range, for the stable loops here; benchmarks/lanes.py has what others deviate by.
TOLERANCE = 1e-9
NOISY = ql.Scenario(
    reference=ql.signals.Step(at=0.2),
    disturbances=(0.0, ql.signals.Sinusoid(amplitude=0.05, omega=1.0)),
    noise=ql.signals.BandLimitedNoise(power=1e-10, sample_time=DT),
    duration=8.0,
    seed=3,
)


class BegunBefore(ql.ADRC):
    """A controller that does not begin from rest."""

    def initial_state(self) -> Any:
        """Return the state of a loop that has run already."""
        return copy.deepcopy(self._state)


@dataclass(frozen=True)
class Gap(ql.signals.Signal):
    """A signal that is not a number for a while."""

    def evaluate(self, t: Vector) -> Vector:
        """Return the values at the times ``t``."""
        return np.where(abs(t - 3.0) < 0.1, np.nan, 0.1)


def controller(**options: Any) -> ql.ADRC:
    """A model-based ADRC, at 10 ms."""
    observer = ql.ESO.model_based(two_mass_spring(), omega_o=10.0, dt=DT)
    return ql.ADRC(observer, omega_c=1.0, **options)


def chain(mass: float) -> ql.plants.LinearPlant:
    """A mass with a spring and a damper."""
    return ql.plants.LinearPlant([[0.0, 1.0], [-2.0 / mass, -0.3]], [0.0, 1.0 / mass], [1.0, 0.0])


def masses(runs: int) -> Any:
    """So many two-mass plants."""
    return batch(two_mass_spring, m1=np.linspace(0.8, 1.25, runs), k=1.1)


def compare(
    plants: Any, law: Any, scenario: Any, *, interpret: bool = False, **options: Any
) -> ql.BatchTrajectory:
    """Run both ways, with everything recorded; return the runs over lanes.

    ``interpret`` is for the exact loop: a few short runs take less time than its compilation.
    """
    options = {"record": "all"} | options
    exact = ql.simulate(plants, law, scenario, interpret=interpret, **options)
    lanes = ql.simulate(plants, law, scenario, exact=False, **options)
    assert exact.final_states
    assert not lanes.final_states
    assert lanes.names == exact.names
    for name in exact.names:
        scale = np.nanmax(np.abs(exact[name])) if np.any(exact.lengths) else 0.0
        np.testing.assert_allclose(lanes[name], exact[name], rtol=0.0, atol=TOLERANCE * scale)
    for name in ("status", "ended", "limit", "lengths"):
        np.testing.assert_array_equal(getattr(lanes, name), getattr(exact, name))
    return lanes


@pytest.mark.parametrize("name", [name for name in OBSERVERS if "nonlinear" not in name])
def test_the_linear_form_of_an_adrc_is_the_law_that_its_kernels_are(name: str) -> None:
    """The same impulse responses from r and y to u, of any observer, as the law measured by unit vectors."""
    law = ql.ADRC(OBSERVERS[name], omega_c=1.5)
    form, measured = linear_form(law.parameters), linear_law(law)
    assert isinstance(form, LinearForm)
    for r, y in ((1.0, 0.0), (0.0, 1.0)):
        found, expected = np.zeros((2, 60))
        x, other = np.zeros(form.law.C.size), np.zeros(measured.C.size)
        waiting = [0.0] * form.delay
        for k in range(60):
            at, to = (r, y) if k == 0 else (0.3 * r, 0.3 * y)
            error = to - form.predicts * x[0]
            found[k] = form.law.C @ x + form.law.D_r * at + form.law.D_y * error
            expected[k] = measured.C @ other + measured.D_r * at + measured.D_y * to
            waiting.append(found[k])
            arriving = form.law.B_y * error + form.law.B_r * at + form.law.B_u * waiting.pop(0)
            x = form.law.A @ x + arriving
            other = measured.A @ other + measured.B_y * to + measured.B_u * expected[k]
        scale = np.max(np.abs(expected))
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12 * scale)


def test_lanes_give_the_runs_of_the_exact_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """More runs than lanes, starts from rest, an initial state, a thinned record, segments of any length."""
    monkeypatch.setattr(sampled_scenario, "_SEGMENT", 301)
    scenario = replace(NOISY, x0=[0.1, 0.0, 0.0, -0.2], rest_at=(2.5, 6.0))
    lanes = compare(masses(LANES + 3), controller(), scenario, record_every=7)
    assert np.all(lanes.status == 0)


def test_one_run_and_a_choice_of_channels() -> None:
    """The rest of the lanes stays empty."""
    for record in (("f_hat", "x_hat"), "y", ["status", "w", "r", "y_measured"]):
        compare(masses(1), controller(), NOISY, record=record)


def test_limits_act_over_lanes_as_in_the_exact_loop() -> None:
    """Of size and rate, different ones in each lane, with their flags in every sample, and from rest."""
    laws = [
        controller(u_min=-high, u_max=high, rate_limit=rate)
        for high, rate in ((0.2, math.inf), (0.3, 1.0), (math.inf, (-0.5, 2.0)), (0.05, 0.1))
    ]
    lanes = compare(masses(4), laws, replace(NOISY, duration=3.0, rest_at=(1.5,)))
    saturated, slow = int(ql.Status.SATURATED), int(ql.Status.RATE_LIMITED)
    assert [int(s) & (saturated | slow) for s in lanes.status] == [
        saturated, saturated | slow, slow, saturated | slow
    ]  # fmt: skip
    assert np.any(lanes["status"] == 0.0)


def test_controllers_of_different_kinds_and_sizes_share_a_batch() -> None:
    """Each size is a group of its own; derivatives of the reference are fed forward where wanted."""
    moving = ql.Scenario(ql.signals.Sinusoid(omega=0.5), duration=5.0)
    laws = [controller(feedforward=on) for on in (True, False, True)]
    compare(masses(3), laws, moving, interpret=True)
    pid = baselines.PID(4.0, 2.0, 1.0, tf=0.05, b=0.7, dt=DT, u_min=-2.0, u_max=3.0)
    lqg = baselines.LQG(chain(1.0), 3.0, 12.0, DT, rate_limit=60.0)
    plants = [chain(mass) for mass in (0.5, 1.0, 2.0)]
    compare(plants, [pid, lqg, pid], replace(NOISY, disturbances=(0.4,)), interpret=True)


def test_each_run_may_have_its_own_scenario() -> None:
    """Seeds, signals, and times at which it starts from rest."""
    scenarios = [
        replace(NOISY, seed=i, rest_at=times, reference=float(i))
        for i, times in enumerate(((), (0.3,), (0.5, 4.0)))
    ]
    compare(masses(3), controller(), scenarios)


def test_delays_of_plant_and_observer() -> None:
    """The plant's u is on its way at the start, and is recorded with its state."""
    late = [ql.plants.delayed(chain(mass), 0.03, DT) for mass in (0.8, 1.0, 1.2)]
    observer = ql.ESO.model_free(2, b0=1.0, omega_o=12.0, dt=DT, delay=0.02)
    scenario = replace(
        NOISY, disturbances=(0.4,), x0=[0.1, 0.0, 0.5, -0.5, 1.0], rest_at=(3.0,), duration=5.0
    )
    compare(late, ql.ADRC(observer, omega_c=1.5), scenario, interpret=True)


def test_a_run_does_not_depend_on_its_place_neighbours_or_threads() -> None:
    """Bit for bit, also beside runs that diverge until nothing is a number."""
    plants = list(masses(40))
    law = controller()
    runs = ql.simulate(plants, law, NOISY, exact=False, record="all", workers=3)
    backwards = ql.simulate(plants[::-1], law, NOISY, exact=False, record="all", workers=1)
    np.testing.assert_array_equal(backwards.log[::-1], runs.log)
    wild = ql.plants.LinearPlant(
        900.0 * np.eye(4), np.ones(4), [1.0, 0, 0, 0], np.ones((4, 2)), name=plants[0].name
    )
    mixed = [wild if i % 2 else plants[i] for i in range(40)]
    among = ql.simulate(mixed, law, NOISY, exact=False, record="all", limit=1e300)
    np.testing.assert_array_equal(among.diverged, np.arange(40) % 2 == 1)
    np.testing.assert_array_equal(among.log[::2], runs.log[::2])


def test_a_lane_that_diverges_ends_alone() -> None:
    """At the same sample, with the same record and flags, as in the exact loop."""
    wrong = ql.ADRC(ql.ESO.model_free(order=4, b0=-1.0, omega_o=10.0, dt=DT), omega_c=1.0)
    laws = [controller(), wrong, controller(u_max=0.1), wrong]
    lanes = compare(masses(4), laws, replace(NOISY, duration=20.0), limit=30.0, record_every=3)
    np.testing.assert_array_equal(lanes.diverged, [False, True, False, True])
    assert np.all(np.isnan(lanes["y"][1, lanes.lengths[1] :]))


def test_all_lanes_may_diverge() -> None:
    """Then the rest of the samples is skipped."""
    wrong = ql.ADRC(ql.ESO.model_free(order=4, b0=-1.0, omega_o=10.0, dt=DT), omega_c=1.0)
    lanes = compare(masses(2), wrong, ql.Scenario(1.0, duration=200.0))
    assert np.all(lanes.diverged)


@pytest.mark.parametrize("signal", ["noise", "reference"])
def test_runs_with_missing_samples_are_exact(signal: str) -> None:
    """Bit for bit: what is held, no linear law describes; the other runs of the group are not disturbed."""
    scenarios = [NOISY, replace(NOISY, **{signal: Gap()}), NOISY]
    exact = ql.simulate(masses(3), controller(), scenarios, record="all")
    lanes = ql.simulate(masses(3), controller(), scenarios, record="all", exact=False)
    np.testing.assert_array_equal(lanes.run(1).log, exact.run(1).log)
    np.testing.assert_array_equal(lanes.status, exact.status)
    assert lanes.status[1] != 0
    undisturbed = ql.simulate(masses(3), controller(), NOISY, record="all", exact=False)
    np.testing.assert_array_equal(lanes.log[::2], undisturbed.log[::2])


def test_what_is_not_linear_is_left_to_the_exact_loop() -> None:
    """Learners, guards, nonlinear laws, observers and plants, encoders, prefilters, other starts."""
    plant, han = two_mass_spring(), ql.controllers.NonlinearFeedback((0.5,) * 4, 0.1)
    nonlinear = ql.ESO.nonlinear(4, 1.0, 10.0, DT, delta=0.1)
    own = controller()
    own.__class__ = BegunBefore
    pairs = [
        (plant, controller()),
        (plant, own),
        (plant, controller(learner=ql.learners.Kalman())),
        (plant, controller(learner=ql.learners.Kalman(), guard=ql.Guard())),
        (plant, controller(feedback=han)),
        (plant, ql.ADRC(nonlinear, 1.0)),
        (plant, ql.controllers.Prefiltered(controller(), baselines.ZV(1.4))),
        (ql.plants.encoded(plant, 4000), controller()),
        (ql.plants.lagged_two_mass_spring(k_cubic=0.1), controller()),
    ]
    scenarios = [SampledScenario.of(ql.Scenario(), *pair, None) for pair in pairs]
    found = linear_runs(*zip(*pairs, strict=True), scenarios)  # type: ignore[arg-type]
    assert [run.place for run in found] == [0]


def test_a_plant_that_can_not_be_sampled_is_told_as_in_the_exact_loop() -> None:
    """With the same message."""
    plants = [two_mass_spring(), two_mass_spring(k=1e300)]
    for exact in (True, False):
        with pytest.raises(ValueError, match="can't be sampled with it"):
            ql.simulate(plants, controller(), NOISY, exact=exact)


def test_progress_over_lanes_ends_at_one() -> None:
    """Also if some runs of the batch are left to the exact loop."""
    for laws in (controller(), [controller()] * 39 + [controller(feedback=None, u_max=1.0)]):
        shares: list[float] = []
        ql.simulate(masses(40), laws, NOISY, exact=False, progress=shares.append)
        assert shares == sorted(shares)
        assert shares[-1] == 1.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ql.simulate(masses(1)[0], controller(), NOISY, exact=False), "is for a batch"),
        (lambda: ql.simulate(masses(2), controller(), NOISY, exact="no"), "exact = 'no'"),
    ],
)
def test_a_mistake_is_named(call: Any, message: str) -> None:
    """A single run is exact, and the option is True or False."""
    with pytest.raises(ValueError, match=message):
        call()


def test_products_over_lanes_are_those_of_numpy(rng: np.random.Generator) -> None:
    """Compiled and interpreted, into the array that the values come from."""

    @compiled
    def products(coefficients: Any, values: Any) -> int:
        set_products(values, 6, coefficients, values, 1)
        return 0

    coefficients, values = lane_zeros(3, 5), lane_zeros(9)
    coefficients[...], values[...] = rng.normal(size=(3, 5, LANES)), rng.normal(size=(9, LANES))
    expected = np.einsum("ijl,jl->il", coefficients, values[1:6])
    interpreted = values.copy()
    products(coefficients, values)
    products.py_func(coefficients, interpreted)
    for found in (values, interpreted):
        np.testing.assert_allclose(found[6:], expected, rtol=0.0, atol=1e-14)
    np.testing.assert_array_equal(found[:6], values[:6])


def test_many_plants_are_sampled_as_one_is() -> None:
    """Bit for bit, so that only sums in the loop differ."""
    plants = list(masses(5))
    A, B, E = (np.array([getattr(plant, name) for plant in plants]) for name in "ABE")
    phi, gamma = zero_order_holds(A, np.concatenate([B, E], axis=2), DT)
    for i, plant in enumerate(plants):
        model = plant.sampled(DT)
        np.testing.assert_array_equal(phi[i], model.transition)
        np.testing.assert_array_equal(gamma[i], np.column_stack([model.input, model.disturbance]))
