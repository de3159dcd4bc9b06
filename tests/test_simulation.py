"""The driver."""

from __future__ import annotations

import numpy as np
import pytest

import quell as ql
from quell.plants.linear import DelayedPlantModel
from quell.plants.nonlinear import PythonNonlinear
from quell.simulation import scenario as scenario_module
from quell.simulation.integration import LARGEST_ERROR, IntegrationCheck, Samples, chosen_samples

from .cases import cases

PLANT = ql.plants.two_mass_spring()


def controller(dt: float = 5e-3, **options: object) -> ql.ADRC:
    """The study's controller, a little coarser."""
    return ql.ADRC(ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=dt), omega_c=1.0, **options)


@pytest.mark.compiled
def test_the_same_seed_gives_the_same_bits(two_mass_scenario: ql.Scenario) -> None:
    """And another seed gives others."""
    runs = [ql.simulate(PLANT, controller(), two_mass_scenario) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].log, runs[1].log)
    other = ql.Scenario(**{**vars(two_mass_scenario), "seed": 1})
    assert np.any(ql.simulate(PLANT, controller(), other)["y_measured"] != runs[0]["y_measured"])


@pytest.mark.compiled
def test_the_segment_length_changes_nothing(
    two_mass_scenario: ql.Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Signals are made in pieces, the record is one."""
    whole = ql.simulate(PLANT, controller(), two_mass_scenario)
    monkeypatch.setattr(scenario_module, "_SEGMENT", 77)
    np.testing.assert_array_equal(
        ql.simulate(PLANT, controller(), two_mass_scenario).log, whole.log
    )


@pytest.mark.compiled
@pytest.mark.parametrize("every", [2, 10, 333])
def test_a_thinned_record_holds_every_so_many_th_sample(
    two_mass_scenario: ql.Scenario, every: int
) -> None:
    """And no more memory than that."""
    whole = ql.simulate(PLANT, controller(), two_mass_scenario)
    thin = ql.simulate(PLANT, controller(), two_mass_scenario, record_every=every)
    np.testing.assert_array_equal(thin.log, whole.log[::every])
    np.testing.assert_allclose(thin.t, whole.t[::every])
    assert thin.log.nbytes == whole.log[::every].nbytes


@pytest.mark.trial
def test_the_loop_starts_from_rest_when_the_scenario_says_so() -> None:
    """Plant at x0, observer at its first measurement, θ as learned."""
    scenario = ql.Scenario(
        reference=ql.signals.Sinusoid(), duration=10.5, x0=[0.1, 0.1, 0.0, 0.0], rest_at=(10.0,)
    )
    run = ql.simulate(PLANT, controller(learner=ql.learners.Kalman()), scenario)
    k = run.window(10.0, 10.1).start
    np.testing.assert_array_equal(run["x"][k], [0.1, 0.1, 0.0, 0.0])
    np.testing.assert_array_equal(run["x_hat"][k], [0.1, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(run["theta"][k], run["theta"][k - 1])
    assert abs(run["theta"][k][2]) > 1.0


@pytest.mark.lost
def test_a_run_that_diverges_ends_early_and_keeps_what_it_has() -> None:
    """The status says that it did, when, and what to do; nothing recorded is NaN."""
    wrong = ql.ADRC(ql.ESO.model_free(order=4, b0=-1.0, omega_o=10.0, dt=5e-3), omega_c=1.0)
    run = ql.simulate(PLANT, wrong, ql.Scenario(reference=1.0, duration=200.0))
    assert run.diverged
    assert "beyond limit = 1e+06" in run.message
    assert "b0" in run.message
    assert 0.0 < run.ended < 200.0
    assert len(run) == round(run.ended / 5e-3)
    assert np.all(np.isfinite(run.log))
    with pytest.raises(ValueError, match="the record ends at"):
        run.metrics(150.0)


def drag(t: float, x: np.ndarray, u: float, w: np.ndarray) -> tuple[float, float]:
    """A mass in syrup: stiff, with an eigenvalue of −1e5 1/s."""
    return x[1], u - 1e5 * x[1]


def interpreted_run(
    f: object, b0: float = 1.0, seconds: float = 0.1, **plant: int
) -> ql.Trajectory:
    """A nonlinear plant of order 2 under control, interpreted: that compiles nothing."""
    law = ql.ADRC(ql.ESO.model_free(order=2, b0=b0, omega_o=40.0, dt=1e-3), omega_c=8.0)
    return ql.simulate(
        ql.plants.NonlinearPlant(f, order=2, name="mass", **plant),
        law,
        ql.Scenario(reference=1.0, duration=seconds),
        interpret=True,
    )


@pytest.mark.lost
def test_too_few_substeps_are_the_cause_that_is_named() -> None:
    """Not b0; the warning has a number of sub-steps, and with it the run does not diverge."""
    with pytest.warns(ql.DesignWarning, match="mass: with 1 .* at least substeps = 64"):
        run = interpreted_run(drag, substeps=1)
    assert run.status == ql.Status.DIVERGED | ql.Status.POORLY_INTEGRATED
    assert "raise the plant's substeps" in run.message
    assert "b0" not in run.message
    better = interpreted_run(drag, substeps=64, seconds=0.02)
    assert better.status == ql.Status.OK
    exact = ql.simulate(
        ql.plants.LinearPlant([[0.0, 1.0], [0.0, -1e5]], [0.0, 1.0], [1.0, 0.0]),
        ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=40.0, dt=1e-3), omega_c=8.0),
        ql.Scenario(reference=1.0, duration=0.02),
        interpret=True,
    )
    chosen = interpreted_run(drag, seconds=0.02)  # by default as many as the plant needs
    np.testing.assert_allclose(chosen["y"], exact["y"], rtol=1e-2, atol=1e-9)


@pytest.mark.lost
def test_a_loop_that_diverges_is_the_cause_though_its_integration_fails_at_last() -> None:
    """The force grows the faster, the further it goes: the repetition with more sub-steps tells."""
    escape = interpreted_run(lambda t, x, u, w: (x[1], u + 500.0 * np.exp(x[0])), b0=-1.0)
    assert escape.status == ql.Status.DIVERGED
    assert "The loop diverged" in escape.message
    assert "b0" in escape.message


def test_stiff_friction_that_is_not_resolved_is_reported() -> None:
    """Of width 1e-4 at 1 ms: the run goes on, and says that its states are wrong."""
    rub = lambda t, x, u, w: (x[1], u - 60.0 * np.tanh(x[1] / 1e-4))  # noqa: E731
    with pytest.warns(ql.DesignWarning, match="a state has an error of .* % of its range"):
        run = interpreted_run(rub, substeps=1)
    assert run.status == ql.Status.POORLY_INTEGRATED
    assert "too few sub-steps" in run.message
    assert interpreted_run(rub, substeps=600, seconds=0.003).status == ql.Status.OK


def runge_kutta(z: float) -> float:
    """What a classical Runge-Kutta step makes of ``x' = −λ x`` with ``h λ = z``."""
    return 1.0 - z + z**2 / 2.0 - z**3 / 6.0 + z**4 / 24.0


def mode_check(*, bad: float = 2.0) -> tuple[IntegrationCheck, Samples]:
    """A check of ``x' = −bad x, z' = −z/10`` with steps of 1 s, and three samples of it."""
    model = PythonNonlinear(lambda t, x, u, w: (-bad * x[0], -0.1 * x[1]), None, 1.0, 1)
    x = np.array([[0.5, 3.0], [-4.0, 1.0], [1.0, 2.0]])
    return IntegrationCheck(model, as_python=True), Samples(
        np.arange(3.0), np.zeros((3, 1)), np.zeros((3, 0)), x
    )


def test_the_estimated_error_of_a_mode_is_the_difference_of_two_steps_and_one() -> None:
    """As a share of the largest value; the number of sub-steps that is enough follows from it."""
    check, samples = mode_check()
    check.add(samples, all_of_them=True)
    assert check.error == pytest.approx(abs(runge_kutta(2.0) - runge_kutta(1.0) ** 2))
    assert check.poor
    assert abs(runge_kutta(1.0) - runge_kutta(0.5) ** 2) < LARGEST_ERROR
    assert check.enough == 2
    worse, samples = mode_check(bad=3.0)
    worse.add(samples, all_of_them=True)
    assert worse.enough == 4
    worse.add(Samples(*(part[:1] * 1e-3 for part in samples)), all_of_them=True)  # fine by then
    assert worse.enough == 4
    fine, samples = mode_check(bad=1.0)
    fine.add(samples, all_of_them=True)
    assert (fine.poor, fine.enough) == (False, 0)
    assert fine.error == pytest.approx(abs(runge_kutta(1.0) - runge_kutta(0.5) ** 2))


def test_the_estimated_error_is_a_share_whatever_the_unit() -> None:
    """Of the largest value before or after the step; what overflows is an error of 1."""
    wild, samples = mode_check(bad=6.0)
    wild.add(samples, all_of_them=True)
    once, twice = runge_kutta(6.0), runge_kutta(3.0) ** 2
    assert wild.error == pytest.approx((once - twice) / once)
    small, samples = mode_check()
    samples.x[:] *= 1e-9
    small.add(samples, all_of_them=True)
    assert small.error == pytest.approx(abs(runge_kutta(2.0) - runge_kutta(1.0) ** 2))
    beyond, samples = mode_check(bad=1e200)
    beyond.add(samples, all_of_them=True)
    assert (beyond.error, beyond.enough) == (1.0, 0)


def test_behind_a_delay_the_check_takes_the_u_that_arrives() -> None:
    """The oldest, at the end of the state: here it is the rate of decay."""
    inner = PythonNonlinear(lambda t, x, u, w: (-u * x[0],), None, 1.0, 1)
    check = IntegrationCheck(DelayedPlantModel(inner, 1), as_python=True)
    x = np.array([[1.0, 0.1, 0.2, 2.0]])  # the plant's state, and three values of u on their way
    check.add(Samples(np.zeros(1), np.array([[0.3]]), np.zeros((1, 0)), x), all_of_them=True)
    assert check.error == pytest.approx(abs(runge_kutta(2.0) - runge_kutta(1.0) ** 2))


def test_samples_without_numbers_are_left_out_of_the_check() -> None:
    """A state that y does not show may overflow first."""
    check, samples = mode_check(bad=1.0)
    samples.x[1, 0] = np.nan
    check.add(samples, all_of_them=True)
    assert 0.0 < check.error < LARGEST_ERROR
    check, samples = mode_check()
    samples.x[:] = np.inf
    check.add(samples, all_of_them=True)
    assert check.error == 0.0


def test_samples_are_checked_all_over_a_segment_and_where_states_turn() -> None:
    """Sixteen of each; a small state counts as much as a large one."""
    x = np.zeros((1000, 2))
    x[:, 0] = 1e6 * np.linspace(0.0, 1.0, 1000)
    x[345, 1] = 1e-3  # its corners are at 344, 345 and 346
    chosen = chosen_samples(x, np.max(np.abs(x), axis=0)).tolist()
    assert {0, 999, 344, 345, 346} <= set(chosen)
    assert 24 <= len(chosen) <= 32
    assert max(np.diff(chosen)) < 1000 / 15 + 1
    assert chosen_samples(x[:32], np.ones(2)) == slice(None)
    assert len(chosen_samples(x[:33], np.ones(2))) <= 32


@pytest.mark.lost
def test_the_check_gets_the_samples_that_are_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Times, u, w and states, over all segments of a thinned record; only the usual range of a run that diverged."""
    monkeypatch.setattr(scenario_module, "_SEGMENT", 10)
    seen: list[Samples] = []
    monkeypatch.setattr(
        IntegrationCheck, "add", lambda self, samples, all_of_them: seen.append(samples)
    )
    plant = ql.plants.NonlinearPlant(
        lambda t, x, u, w: (x[1], u + w[0] + 2.0 * w[1]), order=2, disturbances=2
    )
    law = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=40.0, dt=1e-3), omega_c=8.0)
    scenario = ql.Scenario(1.0, duration=0.05, disturbances=(ql.signals.Ramp(), 0.5))
    run = ql.simulate(plant, law, scenario, record_every=3, interpret=True)
    whole = Samples(*map(np.concatenate, zip(*seen, strict=True)))
    np.testing.assert_allclose(whole.t, run.t, atol=1e-12)
    for part, channel in ((whole.u[:, 0], "u"), (whole.w, "w"), (whole.x, "x")):
        np.testing.assert_array_equal(part, run[channel])
    monkeypatch.setattr(scenario_module, "_SEGMENT", 10_000)
    seen.clear()
    wild = interpreted_run(lambda t, x, u, w: (x[1], u), b0=-1.0, seconds=2.0)
    usual = np.abs(wild["y"]) <= 10.0
    assert wild.diverged
    assert not usual.all()
    assert sum(part.t.size for part in seen) == usual.sum()


@pytest.mark.lost
def test_the_integration_is_checked_behind_a_delay_and_an_encoder() -> None:
    """With the u that arrives."""
    plant = ql.plants.NonlinearPlant(drag, order=2, substeps=1)
    seen = ql.plants.encoded(ql.plants.delayed(plant, 2e-3, 1e-3), 1000)
    law = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=40.0, dt=1e-3), omega_c=8.0)
    with pytest.warns(ql.DesignWarning, match="substeps = 64"):
        run = ql.simulate(seen, law, ql.Scenario(1.0, duration=0.05), interpret=True)
    assert ql.Status.POORLY_INTEGRATED in run.status


def test_nothing_given_to_the_driver_is_changed(two_mass_scenario: ql.Scenario) -> None:
    """The controller keeps its own state; the scenario's x0 stays."""
    x0 = np.array([0.1, 0.2, 0.3, 0.4])
    law = controller(learner=ql.learners.Kalman())
    law.step(1.0, 0.5)
    before = law.state
    ql.simulate(PLANT, law, ql.Scenario(reference=1.0, duration=1.0, x0=x0))
    np.testing.assert_array_equal(x0, [0.1, 0.2, 0.3, 0.4])
    for name, array in law.state.items():
        np.testing.assert_array_equal(array, before[name])


@pytest.mark.lost
def test_disturbances_that_are_not_given_are_zero_and_the_rest_are_in_order() -> None:
    """w1 then w2, as the plant has them."""
    run = ql.simulate(PLANT, controller(), ql.Scenario(duration=0.1, disturbances=(2.0,)))
    np.testing.assert_array_equal(run["w"], np.tile([2.0, 0.0], (len(run), 1)))


@pytest.mark.compiled
def test_progress_is_told_and_ends_at_one() -> None:
    """Shares grow."""
    shares: list[float] = []
    ql.simulate(PLANT, controller(1e-3), ql.Scenario(duration=30.0), progress=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


@pytest.mark.compiled
def test_a_run_of_ten_million_samples_needs_the_memory_of_its_record() -> None:
    """``record_every`` thins it: a hundred rows here, whatever the length."""
    run = ql.simulate(PLANT, controller(), ql.Scenario(duration=10_000.0), record_every=20_000)
    assert len(run) == 101
    owner = run.log
    while isinstance(owner.base, np.ndarray):  # a view would keep all that it is part of
        owner = owner.base
    assert owner.base is None
    assert owner.nbytes < 50_000


@pytest.mark.lost
def test_the_limit_follows_the_size_of_what_is_asked_for() -> None:
    """A loop in encoder counts is not taken for one that diverges."""
    plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0])
    law = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01), omega_c=4.0)
    run = ql.simulate(plant, law, ql.Scenario(reference=2e6, duration=10.0))
    assert not run.diverged
    assert run["y"][-1] == pytest.approx(2e6)
    assert ql.simulate(plant, law, ql.Scenario(reference=2e6, duration=10.0), limit=1e6).diverged


def test_a_plant_that_varies_in_time_gets_the_time_of_each_sample(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """``x' = t`` gives ``t²/2``, within a block of samples and over its end; Runge-Kutta is exact there."""
    monkeypatch.setattr(scenario_module, "_SEGMENT", 7)
    plant = ql.plants.NonlinearPlant(lambda t, x, u, w: (t,), order=1)
    law = ql.ADRC(ql.ESO.model_free(order=1, b0=1.0, omega_o=1.0, dt=0.5), omega_c=1.0)
    run = ql.simulate(plant, law, ql.Scenario(duration=10.0), interpret=True)
    np.testing.assert_allclose(run["y"], 0.5 * run.t**2, rtol=1e-12)


@pytest.mark.lost
def test_an_output_that_is_no_number_ends_the_run_at_its_sample() -> None:
    """``√(0.25 − t)`` from 0.3 s on; what is recorded is finite; a warning names time and state."""
    plant = ql.plants.NonlinearPlant(
        lambda t, x, u, w: (1.0,), order=1, output=lambda x: np.sqrt(0.25 - x[0])
    )
    law = ql.ADRC(ql.ESO.model_free(order=1, b0=1.0, omega_o=1.0, dt=0.1), omega_c=1.0)
    message = r"f or output returns a number that is not finite; .* t = 0.3 s.* state was \[0.2\]"
    with pytest.warns(ql.DesignWarning, match=message):
        run = ql.simulate(plant, law, ql.Scenario(duration=1.0), interpret=True)
    assert run.diverged
    assert (len(run), run.ended) == (3, pytest.approx(0.3))
    assert np.all(np.isfinite(run.log))


def test_a_duration_between_two_samples_is_reported() -> None:
    """The run ends at the sample before; a duration that is a multiple but for rounding is fine."""
    law = ql.ADRC(ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=0.03), omega_c=1.0)
    with pytest.warns(ql.DesignWarning, match=r"duration = 0.1 s with dt = 0.03 .* 0.12 s is the"):
        run = ql.simulate(PLANT, law, ql.Scenario(duration=0.1), interpret=True)
    assert run.t[-1] == pytest.approx(0.09)
    assert len(ql.simulate(PLANT, law, ql.Scenario(duration=0.03 * 7), interpret=True)) == 8


def test_noise_far_quicker_than_the_samples_is_reported() -> None:
    """Wherever it is in a sum; noise that is twice as quick, or has no power, is not."""
    law = ql.ADRC(ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=0.01), omega_c=1.0)
    quick = ql.signals.BandLimitedNoise(1e-12, 1e-5)
    for signals, name in (
        ({"noise": quick + ql.signals.Sinusoid()}, "noise"),
        ({"disturbances": (0.0, 2.0 * quick)}, "disturbances"),
    ):
        message = f"{name}: sample_time = 1e-05 s is far below dt = 0.01 s"
        with pytest.warns(ql.DesignWarning, match=message):
            ql.simulate(PLANT, law, ql.Scenario(duration=0.02, **signals), interpret=True)
    for fine in (ql.signals.BandLimitedNoise(1e-12, 5e-3), ql.signals.BandLimitedNoise(0.0, 1e-5)):
        ql.simulate(PLANT, law, ql.Scenario(duration=0.02, noise=fine), interpret=True)


class Gap(ql.signals.Signal):
    """A sensor that fails for one sample."""

    def evaluate(self, t: np.ndarray) -> np.ndarray:
        """NaN at 0.5 s."""
        return np.where(np.abs(t - 0.5) < 1e-9, np.nan, 0.0)


def test_a_measurement_that_is_no_number_does_not_end_the_run() -> None:
    """The record shows it, the status reports it, and u goes on."""
    run = ql.simulate(PLANT, controller(), ql.Scenario(1.0, duration=1.0, noise=Gap()))
    assert run.status == ql.Status.MEASUREMENT_HELD
    assert np.flatnonzero(np.isnan(run["y_measured"])).tolist() == [100]
    assert np.all(np.isfinite(run["u"]))
    assert len(run) == 201


def test_the_status_of_a_run_has_what_any_step_reported() -> None:
    """Also of samples that were not recorded."""
    law = controller(u_min=-0.1, u_max=0.1)
    run = ql.simulate(PLANT, law, ql.Scenario(reference=1.0, duration=2.0), record_every=399)
    assert run.status == ql.Status.SATURATED


def test_the_last_sample_is_there_whatever_the_sample_time() -> None:
    """Rounding of duration / dt does not lose it."""
    plant = ql.plants.LinearPlant([[0.0]], [1.0], [1.0])
    for dt in (0.1, 0.3, 1e-3 / 3.0, 7e-4):
        law = ql.ADRC(ql.ESO.model_free(order=1, b0=1.0, omega_o=1.0, dt=dt), omega_c=1.0)
        run = ql.simulate(plant, law, ql.Scenario(1.0, duration=400 * dt), record_every=10)
        np.testing.assert_allclose(run.t, 10 * dt * np.arange(41), rtol=1e-12)
        assert run.ended == pytest.approx(400 * dt, rel=1e-12)


@cases(
    ("make", "message"),
    [
        (
            lambda: ql.Scenario(duration=-1.0),
            "duration = -1.0: must be finite and greater than zero",
        ),
        (
            lambda: ql.Scenario(duration=10.0, rest_at=(5.0, 3.0)),
            r"rest_at = \(5.0, 3.0\): must increase",
        ),
        (lambda: ql.Scenario(duration=10.0, rest_at=(10.0,)), "must increase and lie within"),
        (lambda: ql.Scenario(seed=-1), "seed = -1: must be a whole number"),
        (
            lambda: ql.simulate(PLANT, controller(), ql.Scenario(x0=[1.0])),
            r"x0 has shape \(1,\): must be a vector of 4",
        ),
        (
            lambda: ql.simulate(PLANT, controller(), ql.Scenario(disturbances=(0, 0, 0))),
            "disturbances has 3 signals: the plant has 2",
        ),
        (
            lambda: ql.simulate(PLANT, controller(), ql.Scenario(), record_every=0),
            "record_every = 0: must be a whole number",
        ),
        (
            lambda: ql.simulate(PLANT, controller(), ql.Scenario(), limit=-1.0),
            "limit = -1.0: must be finite and greater",
        ),
        (lambda: ql.Scenario(reference="sine"), "reference = 'sine': must be a number"),
        (
            lambda: ql.simulate(None, controller(), ql.Scenario()),
            "plant = None: must be a plant, for example",
        ),
        (
            lambda: ql.simulate(PLANT, ql.ADRC, ql.Scenario()),
            "controller = .*: must be a controller, for example",
        ),
        (lambda: ql.simulate(PLANT, controller(), 3.0), "scenario = 3.0: must be a quell.Scenario"),
        (
            lambda: ql.Scenario(disturbances=1.0),
            "disturbances = 1.0: must be a sequence of signals or numbers",
        ),
        (
            lambda: ql.Scenario(disturbances=(0.0, "wind")),
            r"disturbances\[1\] = 'wind': must be a number",
        ),
        (
            lambda: ql.simulate(PLANT, controller(), ql.Scenario(duration=1e15)),
            "duration = 1000000000000000.0 s with dt = 0.005 s",
        ),
    ],
)
def test_a_mistake_is_named(make: object, message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


def wrong_sign(b0: float = -50.0) -> ql.ADRC:
    """A controller of a motor 50/(s² + 4 s) with limits; b0 = 50 is right."""
    observer = ql.ESO.model_free(order=2, b0=b0, omega_o=20.0, dt=0.01)
    return ql.ADRC(observer, omega_c=4.0, u_min=-10.0, u_max=10.0)


def test_a_loop_that_runs_away_says_so_at_the_line_of_the_user() -> None:
    """Once, in the status, in the message and in what is missing; the loop that works says nothing."""
    motor = ql.plants.LinearPlant.of(([50.0], [1.0, 4.0, 0.0]))
    step = ql.Scenario(reference=ql.signals.Step(at=0.5), duration=4.0)
    with pytest.warns(
        ql.DesignWarning, match="The output ran away from r: .* sign and size of b0"
    ) as seen:
        run = ql.simulate(motor, wrong_sign(), step)
    assert [each.filename for each in seen] == [__file__]
    assert ql.Status.RAN_AWAY in run.status
    assert run.lost
    assert not run.diverged
    found = run.metrics(start=0.5)
    assert np.isnan([found["overshoot"], found["settling_time"], found["rise_time"]]).all()
    assert not ql.simulate(motor, wrong_sign(50.0), step).lost
    with pytest.warns(ql.DesignWarning, match="1 of 2 runs: The output ran away") as seen:
        runs = ql.simulate(motor, [wrong_sign(50.0), wrong_sign()], step)
    assert [each.filename for each in seen] == [__file__]
    assert runs.lost.tolist() == [False, True]
    assert runs.run(1).status == run.status


def test_an_axis_that_runs_away_says_so() -> None:
    """One of two; the status is that of the whole run."""
    plant = ql.plants.LinearPlant(-np.eye(2), np.eye(2), np.eye(2))
    made = [
        ql.ADRC(ql.ESO.model_free(order=1, b0=1.0, omega_o=20.0, dt=0.01), omega_c=4.0)
        for _ in range(2)
    ]
    step = ql.Scenario(reference=(ql.signals.Step(at=0.5), 0.0), duration=4.0)
    limits = {"u_min": [-10.0, -10.0], "u_max": [10.0, 10.0]}
    assert not ql.simulate(plant, ql.Axes(made, np.eye(2), **limits), step).lost
    away = ql.Axes(made, np.diag([-1.0, 1.0]), **limits)
    with pytest.warns(ql.DesignWarning, match="The output ran away from r"):
        run = ql.simulate(plant, away, step)
    assert ql.Status.RAN_AWAY in run.status
    assert np.isnan(run.metrics(start=0.5)["axis1"]["overshoot"])


def test_a_run_that_diverges_warns() -> None:
    """With the message of the run."""
    plant = ql.plants.LinearPlant.of(([1.0], [1.0, 0.0, 0.0]))
    observer = ql.ESO.model_free(order=2, b0=-1.0, omega_o=60.0, dt=0.01)
    with pytest.warns(ql.DesignWarning, match="went beyond limit = 1e"):
        run = ql.simulate(plant, ql.ADRC(observer, omega_c=20.0), ql.Scenario(1.0, 3.0))
    assert run.diverged
