"""Single precision: the delta form, thresholds, counters, ranges, and compiled code."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql
from quell.controllers import in_single_precision
from quell.controllers import single as single_module
from quell.controllers.linear import delta_law
from quell.controllers.single import SinglePrecision, single_design
from quell.controllers.stateful import named_arrays
from quell.features import Bias, Custom, State
from quell.kernels import dispatch, functions
from quell.kernels.dispatch import is_finite
from quell.kernels.functions import is_single
from quell.kernels.single import add_small, add_symmetrically, in_single
from quell.learners.base import adapt, commit, grown
from quell.learners.frequency_search import ENTRIES, advance_search
from quell.learners.rls import multiply_lower, reduce_row
from quell.observers.forms import begin, delta_form, expected_measurement, observe

from .cases import cases

DT = 0.01
ORDER_2 = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.1, dt=DT)
CHAIN = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [1.0, 0.0])
SCENARIO = ql.Scenario(
    reference=ql.signals.Sinusoid(omega=1.5),
    disturbances=(0.3 * ql.signals.Step(at=1.0),),
    noise=ql.signals.BandLimitedNoise(1e-8, 0.01),
    duration=4.0,
    rest_at=(3.0,),
)
OBSERVERS = {
    "current": ORDER_2,
    "predictor": ql.ESO.model_free(2, 1.5, 12.1, DT, form="predictor"),
    "reduced": ql.ESO.model_free(2, 1.5, 12.1, DT, form="reduced"),
    "half gain": ql.ESO.model_free(2, 1.5, 12.1, DT, half_gain=True),
    "with a zero": ql.ESO.model_based(([1.5, 6.0], [1.0, 0.5, 2.0, 1.0]), omega_o=12.1, dt=DT),
    "Kalman": ql.ESO.kalman(2, 1.5, DT, noise_variance=1e-6, drift=3e-2),
    "cascade": ql.ESO.cascade(2, 1.5, 12.1, DT, levels=3),
    "nonlinear": ql.ESO.nonlinear(2, 1.5, 12.1, DT, delta=0.05),
    "delay": ql.ESO.model_free(2, 1.5, 12.1, DT, delay=0.03),
}


def rms(values: Any) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


class Some(NamedTuple):
    """Parameters of several kinds."""

    whole: Any
    first: Any
    count: int
    number: float


@cases("name", OBSERVERS)
def test_the_delta_form_is_the_same_observer(name: str, rng: np.random.Generator) -> None:
    """In double precision, where nothing is lost, all estimates agree but for rounding; so does the expected measurement."""
    model = OBSERVERS[name].model
    delta = delta_form(model)
    assert type(delta) is not type(model) or name == "delay"
    size = OBSERVERS[name].order + 1
    z, other = np.zeros(model.states), np.zeros(delta.states)
    seen, also = np.zeros(size), np.zeros(size)
    begin(model, z, seen, 0.4)
    begin(delta, other, also, 0.4)
    for k in range(300):
        y, u, f = 0.4 + 0.01 * rng.normal(), rng.normal(), 0.1 * rng.normal()
        if k == 200:
            y = 1e13  # a nonlinear observer begins again
        expected = expected_measurement(model, z, u, f)
        assert expected_measurement(delta, other, u, f) == pytest.approx(expected, rel=1e-9)
        observe(model, z, seen, y, u, f)
        observe(delta, other, also, y, u, f)
        np.testing.assert_allclose(also, seen, rtol=1e-9, atol=1e-9 * np.max(np.abs(seen)))


def test_carried_sums_lose_nothing() -> None:
    """An integrator of increments a ten-millionth of its state gains what it should, and stands still without the carries."""
    observer = ql.ESO.model_free(1, b0=1.0, omega_o=1.0, dt=1e-4)
    model = in_single(delta_form(observer.model))
    z, seen = np.zeros(4, np.float32), np.zeros(2, np.float32)
    one, plain = np.float32(1.0), np.float32(16.0)
    begin(model, z, seen, plain)
    step = np.float32(1e-3)  # u dt = 1e-7, a tenth of the last digit of 16
    for _ in range(1000):
        expected = expected_measurement(model, z, step, np.float32(0.0))
        observe(model, z, seen, expected, step, np.float32(0.0))
        plain += step * np.float32(1e-4) * one
    assert float(z[0]) + float(z[2]) == pytest.approx(16.0 + 1e-4, abs=2e-6)
    assert plain == 16.0


def test_slow_averages_reach_their_goal() -> None:
    """Where an increment is below the last digit: means and variances with their carries, and the sum of weights."""
    mean = np.array([0.0, 1.0, 0.0, 0.0], np.float32)
    for _ in range(20_000):
        add_small(mean, 2, 1, np.float32(1e-3) * (np.float32(1.0 + 1e-5) - mean[1]))
    assert float(mean[1]) + float(mean[3]) == pytest.approx(1.0 + 1e-5, abs=3e-7)
    double = np.array([1.0])
    add_small(double, 1, 0, 0.5)
    assert double.tolist() == [1.5]
    P = np.ones((2, 3), np.float32) * np.float32([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    for _ in range(10_000):
        for i, j in ((0, 0), (1, 0), (1, 1)):
            add_symmetrically(P, i, j, np.float32(-1e-8))
    entries, carries = P[[0, 1, 1], [0, 0, 1]], P[[0, 0, 1], [1, 2, 2]]
    np.testing.assert_allclose(entries.astype(float) + carries, 1.0 - 1e-4, atol=1e-9)
    weight, usual = np.float32(0.0), 0.0
    for _ in range(20_000):
        weight = np.float32(grown(weight, np.float32(1e-3)))
        usual = grown(usual, 1e-3)
    assert weight == 1.0
    assert 0.0 < 1.0 - usual < 1e-8


def test_a_pi_controller_integrates_what_is_below_its_last_digit() -> None:
    """Its law is in delta form: a small steady error moves u as it does in double precision."""
    controller = ql.baselines.PID(kp=1.0, ki=0.02, dt=1e-4)
    assert delta_law(controller.law).difference.shape == controller.law.A.shape
    single = in_single_precision(controller)
    u = []
    for law in (controller, single):
        state = law.initial_state()
        control = ql.controllers.base.control
        for k in range(2000):
            value = control(law.parameters, state, 1.0 if k else 10.0, 1.0 - 1e-3)
        u.append(float(value))
    assert u[1] - u[0] == pytest.approx(0.0, abs=1e-6)


def test_functions_keep_the_precision_of_their_argument() -> None:
    """Single stays single, rounded from the right value; double has the bits of ``math``."""
    for name in ("sqrt", "sin", "cos", "tanh", "exp", "log2"):
        function = getattr(functions, name)
        for value in (0.3, 1.0, 2.7):
            assert function(value) == getattr(math, name)(value)
            assert type(function(value)) is float
            single = np.float32(value)
            found = function(single)
            assert type(found) is np.float32
            assert abs(found - getattr(math, name)(float(single))) <= np.spacing(abs(found))
    assert type(functions.copysign(np.float32(2.0), np.float32(-1.0))) is np.float32
    assert functions.copysign(2.0, -1.0) == -2.0
    assert is_single(np.float32(1.0))
    assert not is_single(1.0)
    assert not is_finite(np.float32(np.inf))
    assert is_finite(np.float32(3e38))


def test_rounded_parameters_keep_shared_memory_and_kinds() -> None:
    """Views stay views of one array; integers stay; what single precision can't hold is named."""
    values = np.arange(6.0)
    rounded = in_single(Some(values, values[2:5], 3, 0.1))
    rounded.whole[3] = 7.0
    assert rounded.first[1] == 7.0
    assert (rounded.whole.dtype, rounded.count, type(rounded.number)) == (np.float32, 3, np.float32)
    for wrong, message in (
        (Some(values, np.array([1e39]), 3, 0.1), r"largest entry of p.first = 1e\+39"),
        (Some(values, values, 3, -1e39), r"p.number = -1e\+39: above the range"),
        (Some(values, values, 3, 1e-39), "p.number = 1e-39: below the range"),
    ):
        with pytest.raises(ValueError, match=message):
            in_single(wrong, "p")
    assert in_single(Some(values, np.array([1e-39]), 3, math.inf)).first[0] == 0.0


@pytest.mark.trial
@pytest.mark.parametrize(
    ("learner", "rests"),
    [
        *[(None, True), (None, False), (ql.learners.Kalman(), True), (ql.learners.Kalman(), False)],
        *[(ql.learners.RLS(), False), (ql.learners.MLP(hidden=3), False)],
    ],
)
def test_bad_samples_do_what_they_do_in_double_precision(learner: Any, rests: bool) -> None:
    """Measurements that are missing, infinite or absurd, on a motionless signal and in motion: the state stays finite, and u follows that of double precision."""
    guard = None if learner is None else ql.Guard()
    double = ql.ADRC(ORDER_2, 1.5, learner=learner, guard=guard, u_min=-20.0, u_max=20.0)
    single = in_single_precision(double)
    # What is beyond 1e12 counts as missing in single precision.
    bad = {200: math.nan, 201: math.nan, 202: math.nan, 300: 1e38, 301: -math.inf, 400: 1e11}
    for k in range(900):
        r, y = (0.0, 0.0) if rests else (math.sin(0.02 * k), 0.9 * math.sin(0.02 * k - 0.1))
        given = bad.get(k, y)
        u = single.step(r, given)
        wanted = double.step(r, math.nan if given == 1e38 else given)
        assert u == pytest.approx(wanted, rel=1e-2, abs=1e-2)
    assert all(np.all(np.isfinite(array)) for array in single.state.values())


def test_parameters_out_of_range_are_named() -> None:
    """Order 6 at 5000 rad/s: the variance of noise in f̂ is above 3.4e38."""
    observer = ql.ESO.model_free(6, 1.0, 5000.0, 5e-5)
    with pytest.raises(ValueError, match="learner.f_noise = .*above the range of single precision"):
        in_single_precision(ql.ADRC(observer, 500.0, learner=ql.learners.Kalman()))


def test_averages_that_would_stand_still_are_named() -> None:
    """A sample time a hundred thousandth of the observer's lag: an average moves by less than its last digit."""
    observer = ql.ESO.model_free(2, 1.0, 1.0, 1e-6)
    controller = ql.ADRC(observer, 0.2, learner=ql.learners.Kalman(), guard=ql.Guard())
    with pytest.raises(ValueError, match=r"forget = .* a sample: must be at least .* raise dt"):
        in_single_precision(controller)
    names = ("forget", "earn", "forget_account", "rise", "growth", "smooth")
    rates = dict.fromkeys(names, 2.0**-21)
    fine = controller.parameters.guard._replace(**rates, decay=2.0**-23)
    single_design(fine)
    for name, value in (("rise", 2.0**-22), ("decay", 2.0**-24)):
        with pytest.raises(ValueError, match=rf"{name} = {value:.3g} a sample: must be at least"):
            single_design(fine._replace(**{name: value}))


def test_functions_of_the_user_are_refused_by_name() -> None:
    """They are called by address, with double arrays."""
    features = State() + Custom(lambda x, u: (x[0] ** 3,), names=("cube",)) + Bias()
    controller = ql.ADRC(ORDER_2, 1.5, learner=ql.learners.NLMS(features=features))
    with pytest.raises(ValueError, match=r"first.second is features.Custom"):
        in_single_precision(controller)


def test_counts_of_samples_end_before_single_precision_does() -> None:
    """After 2²³ samples of a run the count stays, and what waits for a number of samples still comes."""
    learner = ql.learners.NLMS()
    single = in_single_precision(ql.ADRC(ORDER_2, 1.5, learner=learner))
    design, memory = single.parameters.controller.learner, single.initial_state().learner
    loop, seen = memory.loop[0], np.zeros(3, np.float32)
    loop.samples, loop.learn_after = 2.0**23, 2.0**23 + 3.0
    zero = np.float32(0.0)
    waited = 0
    while loop.samples <= loop.learn_after:
        commit(design, memory, seen, zero, zero)
        waited += 1
    assert (waited, loop.samples) == (4, 2.0**23)


def test_a_search_for_frequencies_counts_its_entries_without_end() -> None:
    """Its count goes back by whole rings before it exceeds 2²⁴; the ring does not notice."""
    harmonic = ql.learners.Harmonic(search=True)
    single = in_single_precision(ql.ADRC(ORDER_2, 1.5, learner=harmonic))
    design, memory = single.parameters.controller.learner.search, single.initial_state().learner
    design = design._replace(follow=np.float32(1.0))
    loop, state = memory.search.loop[0], np.zeros(2, np.float32)
    start = 8192.0 * ENTRIES - 2.0
    loop.stage, loop.entries, loop.newest, loop.window = 1.0, start, start - 8.0, 32.0
    written = []
    for k in range(4):
        for _ in range(int(design.spacing)):
            advance_search(
                design, memory.search, np.float32(1.0 + k), state, np.float32(0.0), memory.omega
            )
        width = memory.search.late.size
        written.append(float(memory.search.past[(int(start) + k) % ENTRIES * width]))
    assert written == [1.0, 2.0, 3.0, 4.0]
    assert loop.entries == start + 4.0 - 4096.0 * ENTRIES


def test_the_lower_triangle_of_a_covariance_counts() -> None:
    """In single precision, with carries and without; what is above changes nothing but sums."""
    gain, product = np.array([0.5, 1.0], np.float32), np.zeros(2, np.float32)
    for above in ([7.0], [0.0, 0.0]):
        P = np.array([[1.0, *above], [3.0, 4.0, *[0.0] * (len(above) - 1)]], np.float32)
        multiply_lower(P, gain, product)
        assert product.tolist() == [3.5, 5.5]
        for i in range(2):
            reduce_row(P, i, gain[i], gain)
        assert P[[0, 1, 1], [0, 0, 1]].tolist() == [0.75, 2.5, 3.0]


def test_the_covariance_has_carries_where_it_moves_slowly() -> None:
    """At a twentieth of the sample time."""
    for dt, width in ((1e-3, 3), (5e-5, 4)):
        observer = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.1, dt=dt)
        single = in_single_precision(ql.ADRC(observer, 1.5, learner=ql.learners.Kalman()))
        assert single.initial_state().learner.covariance.shape == (3, width)


def test_coefficients_learn_below_their_last_digit() -> None:
    """With a P of a learner that has averaged for hours: θ changes as in double precision."""
    moved = []
    for precision in ("double", "single"):
        law = ql.ADRC(ORDER_2, 1.5, learner=ql.learners.Kalman())
        single = in_single_precision(law) if precision == "single" else law
        design, state = single.parameters, single.initial_state().learner
        design = getattr(design, "controller", design).learner
        number = np.float32 if precision == "single" else float
        state.theta[:] = [-2.0, -0.5, 0.3]
        state.averages["time"], state.averages["weight"] = 1e6, 1.0
        state.averages["noise"], state.variance[:] = 1e-12, 1.0
        for _ in range(3000):
            state.covariance[:, :3] = 1e-7 * np.eye(3)
            state.filtered[:] = [0.7, -0.3, 1.0]
            adapt(design, state, np.zeros(2, number), number(1e-6), number(0.0), number(-0.8))
        moved.append(state.theta[:2].astype(float) - [-2.0, -0.5])
    assert 1e-5 < np.max(np.abs(moved[0])) < 3000 * 2.0**-24  # all, and less than a last digit each
    np.testing.assert_allclose(moved[1], moved[0], atol=2.0**-21)


@pytest.mark.trial
@pytest.mark.compiled
def test_compiled_code_computes_in_single_precision_too() -> None:
    """It is the interpreted run but for fused operations, in a loop and by steps; ``.ci/run`` has it with a guarded learner."""
    controller = ql.ADRC(ORDER_2, 1.5, u_max=9.0)
    run = ql.simulate(CHAIN, controller, SCENARIO, precision="single")
    plain = ql.simulate(CHAIN, controller, SCENARIO, precision="single", interpret=True)
    size = rms(plain["u"])
    assert rms(run["u"] - plain["u"]) < 1e-5 * size
    assert np.array_equal(run["u"], run["u"].astype(np.float32))
    for array in named_arrays(run.final_state).values():
        assert array.dtype == np.float32
    stepped = in_single_precision(controller)
    again = [stepped.step(r, y) for r, y in zip(run["r"], run["y_measured"], strict=True)]
    before_rest = round(3.0 / DT)
    np.testing.assert_allclose(again[:before_rest], run["u"][:before_rest], atol=1e-6 * size)


def test_start_manual_operation_and_retuning_are_those_of_double_precision() -> None:
    """The same calls give the same u, but for rounding; the state can be saved, restored and copied."""
    double = ql.ADRC(ORDER_2, 1.5, u_min=-20.0, u_max=20.0)
    single = in_single_precision(double)
    for one in (double, single):
        one.start(2.0, 0.5, 2.0)
    faster = ql.ESO.model_free(order=2, b0=1.4, omega_o=20.0, dt=DT)
    u: dict[Any, list[float]] = {id(double): [], id(single): []}
    for one in (double, single):
        for k in range(300):
            r, y = 2.0 + math.sin(0.02 * k), 2.0 + 0.9 * math.sin(0.02 * k - 0.1)
            if 50 <= k < 100:
                u[id(one)].append(one.track(r, y, 1.5))
                continue
            if k == 100:
                one.hand_over()
            if k == 200:
                one.retune(omega_c=2.0, observer=faster)
            if k == 250:
                one.set_limits(u_max=1.0)
            u[id(one)].append(one.step(r, y))
    np.testing.assert_allclose(u[id(single)], u[id(double)], rtol=1e-4, atol=1e-4)
    assert single.estimate.x == pytest.approx(double.estimate.x, rel=1e-4)
    saved = single.state
    following = single.step(1.0, 1.0)
    single.state = saved
    assert single.step(1.0, 1.0) == following
    assert double.omega_c == 2.0
    assert isinstance(in_single_precision(single), SinglePrecision)


def test_batches_run_in_single_precision() -> None:
    """Each run is, bit for bit, that of ``simulate`` alone; another precision is refused by name."""
    controller = ql.ADRC(ORDER_2, 1.5)
    alone = ql.simulate(CHAIN, controller, SCENARIO, precision="single")
    batch = ql.simulate([CHAIN] * 2, controller, SCENARIO, precision="single")
    for run in batch["u"]:
        np.testing.assert_array_equal(run, alone["u"])
    with pytest.raises(ValueError, match="precision = 'half'"):
        ql.simulate(CHAIN, controller, SCENARIO, precision="half")


def test_a_numba_that_would_calculate_in_double_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without our compiler's pass, literals would make compiled code double; interpreted runs work."""
    monkeypatch.setattr(single_module, "KERNEL_OPTIONS", {})
    monkeypatch.setattr(dispatch, "interpret_all", False)
    plant = ql.plants.LinearPlant([[-1.0]], [1.0], [1.0])
    controller = ql.baselines.PID(1.0, dt=0.01)
    scenario = ql.Scenario(duration=0.05, reference=1.0)
    with pytest.raises(ValueError, match="is compiled with Numba 0.68 only"):
        ql.simulate(plant, controller, scenario, precision="single")
    with pytest.raises(ValueError, match="is compiled with Numba 0.68 only"):
        ql.controllers.in_single_precision(controller).step(1.0, 0.0)
    assert len(ql.simulate(plant, controller, scenario, precision="single", interpret=True)) == 6
