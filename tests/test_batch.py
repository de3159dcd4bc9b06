"""Many runs at once."""

from __future__ import annotations

import math
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import quell as ql
from quell.parallel import in_parallel, one_blas_thread
from quell.plants import PlantBatch, batch, two_mass_spring
from quell.plants.linear import sampled_together
from quell.simulation import scenario as scenario_module

from .cases import cases

pytestmark = pytest.mark.compiled

MASSES = np.array([0.9, 1.0, 1.1])
PLANTS = batch(two_mass_spring, m1=MASSES, k=1.0)
SHORT = ql.Scenario(1.0, duration=1.0)


def controller(**options: object) -> ql.ADRC:
    """A model-based ADRC, at 10 ms."""
    return ql.ADRC(
        ql.ESO.model_based(two_mass_spring(), omega_o=10.0, dt=0.01), omega_c=1.0, **options
    )


def diverging() -> ql.ADRC:
    """One with the wrong sign."""
    return ql.ADRC(ql.ESO.model_free(order=4, b0=-1.0, omega_o=10.0, dt=0.01), omega_c=1.0)


def growth(rate: float) -> ql.plants.LinearPlant:
    """A plant that grows as exp(rate t) by itself."""
    return ql.plants.LinearPlant([[rate]], [1e-9], [1.0], name="growth")


def as_it_is() -> ql.ADRC:
    """A controller of the first order that hardly moves ``growth``."""
    return ql.ADRC(ql.ESO.model_free(order=1, b0=1e6, omega_o=1.0, dt=0.01), omega_c=1.0)


@pytest.mark.trial
@pytest.mark.parametrize("learner", [None, ql.learners.Kalman()])
def test_each_run_of_a_batch_is_the_run_alone(
    learner: object, two_mass_scenario: ql.Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit for bit, in all channels, with rests, noise, a thinned record, and segments of any length."""
    law = controller(learner=learner, guard=ql.Guard() if learner else None)
    monkeypatch.setattr(scenario_module, "_SEGMENT", 1001)
    runs = ql.simulate(PLANTS, law, two_mass_scenario, record="all", record_every=7, workers=2)
    monkeypatch.undo()
    assert runs["y"].shape == (3, len(runs.t))
    assert runs["x"].shape == (3, len(runs.t), 4)
    for i, plant in enumerate(PLANTS):
        alone, mine = ql.simulate(plant, law, two_mass_scenario, record_every=7), runs.run(i)
        assert mine.names == alone.names
        np.testing.assert_array_equal(mine.log, alone.log)
        np.testing.assert_array_equal(mine.t, alone.t)
        for name in ("status", "ended", "limit", "plant", "features", "message"):
            assert getattr(mine, name) == getattr(alone, name)
        assert law.read(mine.final_state).u == law.read(alone.final_state).u


def test_how_many_threads_share_a_batch_leaves_no_trace(two_mass_scenario: ql.Scenario) -> None:
    """Nor does the place of a run in the batch."""
    many = batch(two_mass_spring, m1=np.linspace(0.8, 1.2, 40))
    shortly = replace(two_mass_scenario, duration=22.0)
    one, three = (ql.simulate(many, controller(), shortly, workers=workers) for workers in (1, 3))
    np.testing.assert_array_equal(one.log, three.log)
    backwards = ql.simulate(list(many)[::-1], controller(), shortly)
    np.testing.assert_array_equal(backwards["y"], one["y"][::-1])


def test_only_what_is_asked_for_is_recorded() -> None:
    """By default r, y and u; f_hat brings its two shares."""
    assert ql.simulate(PLANTS, controller(), SHORT).names == ("r", "y", "u")
    some = ql.simulate(PLANTS, controller(), SHORT, record=["f_hat", "x_hat"])
    assert some.names == ("x_hat", "f_residual", "f_learned", "f_hat")
    assert ql.simulate(PLANTS, controller(), SHORT, record="y").log.shape == (3, 101, 1)
    assert some["x_hat"].shape == (3, 101, 4)
    np.testing.assert_array_equal(some["f_hat"], some["f_residual"])


@pytest.mark.lost
def test_a_run_that_diverges_ends_alone() -> None:
    """The others go on; it is NaN from its end, which is where exp(rate t) passes the limit."""
    rates = np.array([0.0, 5.0, 0.1, 20.0])
    runs = ql.simulate(
        batch(growth, rate=rates),
        as_it_is(),
        ql.Scenario(duration=4.0, x0=[1.0]),
        limit=100.0,
        interpret=True,
    )
    np.testing.assert_array_equal(runs.diverged, [False, True, False, True])
    np.testing.assert_array_equal(runs.status & ql.Status.DIVERGED != 0, runs.diverged)
    for i in (1, 3):
        end = math.ceil(math.log(100.0) / rates[i] / 0.01)
        assert runs.ended[i] == pytest.approx(0.01 * end)
        assert runs.lengths[i] == len(runs.run(i)) == end
        assert np.all(np.isfinite(runs["y"][i, :end]))
        assert np.all(np.isnan(runs["y"][i, end:]))
    whole = ~runs.diverged
    assert np.all(np.isfinite(runs.log[whole]))
    np.testing.assert_array_equal(runs.ended[whole], 4.0)
    assert np.all(np.isnan(np.max(np.abs(runs["y"]), axis=1)) == runs.diverged)
    assert "2 of 4 runs: The loop diverged" in runs.message
    assert "first to diverge was run 3, at 0.24 s" in runs.message


@pytest.mark.lost
def test_metrics_are_arrays_that_miss_what_ended_before() -> None:
    """Each entry is that of the run alone; what diverged before the window is NaN."""
    runs = ql.simulate(
        [two_mass_spring()] * 3,
        [controller(), diverging(), controller(u_max=0.1)],
        ql.Scenario(1.0, duration=60.0),
    )
    np.testing.assert_array_equal(runs.diverged, [False, True, False])
    found = runs.metrics(50.0, target=1.0)
    assert all(values.shape == (3,) for values in found.values())
    for i in (0, 2):
        for name, value in runs.run(i).metrics(50.0, target=1.0).items():
            np.testing.assert_array_equal(found[name][i], value)
    assert all(np.isnan(values[1]) for values in found.values())
    assert found.missing["rms"] == {
        1: f"the run diverged at {runs.ended[1]:.6g} s, before the window"
    }
    assert found.missing["rise_time"].keys() == {1, *np.flatnonzero(np.isnan(found["rise_time"]))}
    assert "in the window" in runs.metrics().missing["overshoot"][1]
    assert runs.metrics()["peak_error"][1] > 1e5  # judged by what there is of it
    with pytest.raises(ValueError, match="the window must hold at least one sample"):
        runs.metrics(70.0)


@pytest.mark.lost
def test_metrics_of_a_batch_that_diverged_as_a_whole_say_so() -> None:
    """Rather than return nothing."""
    runs = ql.simulate(PLANTS, diverging(), ql.Scenario(1.0, duration=200.0))
    assert np.all(runs.diverged)
    with pytest.raises(ValueError, match="start = 150.0, .*the record ends at"):
        runs.metrics(150.0)


def test_any_part_of_the_loop_may_differ_from_run_to_run() -> None:
    """Controllers, or the seeds of the noise, or the plants, with the others fixed."""
    tuned = [controller(), controller(u_max=0.5)]
    runs = ql.simulate(two_mass_spring(), tuned, SHORT)
    assert runs.parameters == {}
    np.testing.assert_array_equal(
        runs["u"][1], ql.simulate(two_mass_spring(), tuned[1], SHORT)["u"]
    )
    noise = ql.signals.BandLimitedNoise(power=1e-6, sample_time=0.01)
    noisy = ql.Scenario(1.0, duration=1.0, noise=noise)
    same = ql.simulate(PLANTS, controller(), noisy, record="all")
    np.testing.assert_array_equal(same["y_measured"][0, 0], same["y_measured"][2, 0])
    other = ql.simulate(
        PLANTS, controller(), [replace(noisy, seed=i) for i in range(3)], record="all"
    )
    assert len(set(other["y_measured"][:, 0].tolist())) == 3
    alone = ql.simulate(PLANTS[2], controller(), replace(noisy, seed=2))
    np.testing.assert_array_equal(other.run(2).log, alone.log)


@pytest.mark.trial
def test_a_controller_that_feeds_derivatives_forward_may_be_one_of_a_batch() -> None:
    """Each run is given the derivatives that its controller wants, of the one reference."""
    laws = [controller(feedforward=on) for on in (True, False, True)]
    moving = ql.Scenario(ql.signals.Sinusoid(omega=0.5), duration=5.0)
    runs = ql.simulate(PLANTS, laws, moving, interpret=True)
    alone = [
        ql.simulate(plant, law, moving, interpret=True)["u"]
        for plant, law in zip(PLANTS, laws, strict=True)
    ]
    np.testing.assert_array_equal(runs["u"], alone)
    assert np.any(runs["u"][0] != ql.simulate(PLANTS[0], laws[1], moving, interpret=True)["u"])


def test_scenarios_of_a_batch_may_rest_at_different_times() -> None:
    """Each run is still the run alone."""
    scenarios = [
        replace(SHORT, rest_at=times, x0=[0.0, 0.1, 0.0, 0.0]) for times in ((), (0.3,), (0.5, 0.7))
    ]
    runs = ql.simulate(PLANTS, controller(), scenarios, record="all", record_every=4)
    for i, scenario in enumerate(scenarios):
        np.testing.assert_array_equal(
            runs.run(i).log, ql.simulate(PLANTS[i], controller(), scenario, record_every=4).log
        )


@pytest.mark.trial
@pytest.mark.lost
def test_nonlinear_plants_run_in_batches_compiled_and_as_python() -> None:
    """One that Numba can't compile too, and where its function leaves the numbers, that run diverges alone."""

    def pendulum(strength: float, compilable: bool) -> ql.plants.NonlinearPlant:
        odd = None if compilable else {"strength": object()}

        def rate(t, x, u, w):  # type: ignore[no-untyped-def]
            return x[1], u + strength * math.exp(x[0])

        def python_rate(t, x, u, w):  # type: ignore[no-untyped-def]
            return x[1], u + strength * math.exp(x[0]) + 0.0 * len(str(odd))

        return ql.plants.NonlinearPlant(
            rate if compilable else python_rate, order=2, name="pendulum"
        )

    law = ql.ADRC(
        ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01),
        omega_c=2.0,
        u_min=-5.0,
        u_max=5.0,
    )
    with pytest.warns(ql.DesignWarning, match="pendulum: f or output returns a number that is not"):
        compiled = ql.simulate([pendulum(s, True) for s in (0.1, 500.0)], law, SHORT)
    with (
        pytest.warns(UserWarning, match="can't be compiled"),
        pytest.warns(ql.DesignWarning, match="f or output returns a number that is not finite"),
    ):
        python = ql.simulate([pendulum(s, False) for s in (0.1, 500.0)], law, SHORT)
    for runs in (compiled, python):
        np.testing.assert_array_equal(runs.diverged, [False, True])
    # Sums in compiled code are ordered otherwise.
    np.testing.assert_allclose(python["y"][0], compiled["y"][0], rtol=1e-9, atol=1e-12)


@pytest.mark.lost
def test_poor_integration_is_told_apart_from_loops_that_diverge() -> None:
    """Each run has its own check: one is stiff with one sub-step, one loop is unstable, one is fine."""
    stiff = lambda t, x, u, w: (x[1], u - 1e5 * x[1])  # noqa: E731
    free = lambda t, x, u, w: (x[1], u)  # noqa: E731
    laws = [
        ql.ADRC(ql.ESO.model_free(order=2, b0=b0, omega_o=40.0, dt=1e-3), omega_c=8.0)
        for b0 in (1.0, -1.0, 1.0)
    ]
    plants = [ql.plants.NonlinearPlant(f, order=2, substeps=1) for f in (stiff, free, free)]
    with pytest.warns(ql.DesignWarning, match="in 1 of 3 runs.* substeps = 64"):
        runs = ql.simulate(plants, laws, ql.Scenario(1.0, duration=1.0), interpret=True)
    poor, diverged = ql.Status.POORLY_INTEGRATED, ql.Status.DIVERGED
    assert runs.status.tolist() == [poor | diverged, diverged, 0]
    assert "1 of 3 runs: The loop diverged" in runs.message
    assert "1 of 3 runs: The integration of the plant diverged" in runs.message


def test_parameters_of_a_batch_are_arrays_and_read_only() -> None:
    """A number counts for every plant; a part of a batch keeps its part of them."""
    assert (len(PLANTS), PLANTS.order, PLANTS.disturbances, PLANTS.name) == (
        3,
        4,
        2,
        "two-mass-spring",
    )
    np.testing.assert_array_equal(PLANTS.parameters["k"], [1.0, 1.0, 1.0])
    np.testing.assert_array_equal(PLANTS[1].A, two_mass_spring(m1=1.0).A)
    part = PLANTS[1:]
    assert isinstance(part, PlantBatch)
    np.testing.assert_array_equal(part.parameters["m1"], MASSES[1:])
    with pytest.raises(ValueError, match="read-only"):
        PLANTS.parameters["m1"][0] = 2.0
    with pytest.raises(TypeError):
        PLANTS.parameters["m1"] = MASSES  # type: ignore[index]
    assert len(batch(two_mass_spring, m1=1.0)) == 1
    np.testing.assert_array_equal(ql.simulate(PLANTS, controller(), SHORT).parameters["m1"], MASSES)


def test_progress_is_told_and_ends_at_one() -> None:
    """Shares grow, from job to job."""
    shares: list[float] = []
    ql.simulate(
        batch(two_mass_spring, m1=np.linspace(0.9, 1.1, 50)),
        controller(),
        SHORT,
        progress=shares.append,
    )
    assert shares == sorted(shares)
    assert len(shares) > 1
    assert shares[-1] == 1.0


@pytest.mark.trial
@pytest.mark.lost
def test_a_saved_batch_is_loaded_back_whole(tmp_path: Path) -> None:
    """Channels, parameters, also one that is called as a channel, and each run's status."""

    def lag(r: float, k: float) -> ql.plants.LinearPlant:
        return ql.plants.LinearPlant([[r]], [k], [1.0], name="lag")

    plants = batch(lag, r=np.array([0.1, 9.0]), k=1e-9)
    runs = ql.simulate(
        plants,
        as_it_is(),
        ql.Scenario(duration=1.0, x0=[1.0]),
        limit=100.0,
        record=("y", "x"),
        interpret=True,
    )
    assert list(runs.diverged) == [False, True]
    data = runs.to_xarray()
    assert dict(data.sizes) == {"run": 2, "time": 101, "x_index": 1}
    assert float(data["y"].isel(time=0).sel(run=1)) == 1.0
    np.testing.assert_array_equal(data["k"], [1e-9, 1e-9])
    runs.save(tmp_path / "runs.nc")
    again = ql.BatchTrajectory.load(tmp_path / "runs.nc")
    np.testing.assert_array_equal(again.log, runs.log)
    for name in ("status", "ended", "limit", "lengths", "t", "diverged"):
        np.testing.assert_array_equal(getattr(again, name), getattr(runs, name))
    assert (again.channels, again.plant, again.message, again.features) == (
        runs.channels,
        runs.plant,
        runs.message,
        runs.features,
    )
    assert {name: list(values) for name, values in again.parameters.items()} == {
        "r": [0.1, 9.0],
        "k": [1e-9, 1e-9],
    }
    runs.run(0).save(tmp_path / "one.nc")
    with pytest.raises(ValueError, match="it was not written by BatchTrajectory.save"):
        ql.BatchTrajectory.load(tmp_path / "one.nc")
    with pytest.raises(ValueError, match="it was not written by Trajectory.save"):
        ql.Trajectory.load(tmp_path / "runs.nc")


@pytest.mark.trial
def test_parameters_may_be_called_as_channels_and_coordinates_are(tmp_path: Path) -> None:
    """They are told apart by a prefix."""
    runs = ql.simulate(
        batch(lambda limit, time, run: growth(limit), limit=[0.1, 0.2], time=1.0, run=3),
        as_it_is(),
        SHORT,
        interpret=True,
    )
    runs.save(tmp_path / "runs.nc")
    again = ql.BatchTrajectory.load(tmp_path / "runs.nc")
    assert set(again.parameters) == {"limit", "time", "run"}
    np.testing.assert_array_equal(again.parameters["limit"], [0.1, 0.2])
    np.testing.assert_array_equal(again.limit, runs.limit)


@pytest.mark.parametrize("law", [controller(), diverging()])
@pytest.mark.lost
def test_a_plot_has_two_axes_and_draws_into_given_ones(law: ql.ADRC) -> None:
    """With bands of the runs that went through, also where none did."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    runs = ql.simulate(PLANTS, law, ql.Scenario(1.0, duration=200.0))
    assert len(runs.plot()[0].collections) == (0 if np.all(runs.diverged) else 3)
    _, mine = plt.subplots(2, 1)
    assert runs.plot(mine) is mine
    plt.close("all")


@cases(
    ("make", "message"),
    [
        (
            lambda: batch(two_mass_spring, m1=[1.0, 2.0], m2=[1.0, 1.0, 1.0]),
            "m1 has 2 entries, m2 3: must be numbers or vectors of one",
        ),
        (lambda: batch(two_mass_spring, m1=[]), "m1 has 0 entries"),
        (
            lambda: batch(two_mass_spring, m1=[1.0, 1.0, -1.0]),
            r"run 2: m1 = -1.0: must be finite and greater than zero \[kg\]",
        ),
        (
            lambda: batch(two_mass_spring, m3=[1.0]),
            "parameters = m3: the factory can't be called with them: 'm3' is unknown, must be one of m1, m2",
        ),
        (
            lambda: batch(two_mass_spring, m1=np.ones((2, 2))),
            r"m1 has shape \(2, 2\): must be a number or a vector of numbers",
        ),
        (
            lambda: batch(two_mass_spring, m1=[1.0, [2.0]]),
            "m1: must be a number or a vector of numbers",
        ),
        (
            lambda: batch(two_mass_spring, m1="heavy"),
            "m1: must be a number or a vector of numbers, one for each run, got .heavy",
        ),
        (
            lambda: ql.simulate([growth(0.0), two_mass_spring()], controller(), SHORT),
            r"plant\[1\] has order 4, plant\[0\] 1: must be the same",
        ),
        (
            lambda: PlantBatch(
                [growth(0.0), ql.plants.NonlinearPlant(lambda t, x, u, w: (u,), order=1)]
            ),
            r"plant\[1\] has kind NonlinearPlant, plant\[0\] LinearPlant",
        ),
        (
            lambda: PlantBatch([growth(0.0)], {"rate": [1.0, 2.0]}),
            r"parameters\['rate'\] has shape \(2,\): must be \(1,\)",
        ),
        (
            lambda: ql.simulate([], controller(), SHORT),
            "plant has no entries: a batch must have at least one run",
        ),
        (
            lambda: ql.simulate([two_mass_spring(), 3.0], controller(), SHORT),
            r"plant\[1\] = 3.0: must be a plant, for example",
        ),
        (
            lambda: ql.simulate(PLANTS, [controller()] * 2, SHORT),
            "controller has 2 entries, plant 3: must be one for all runs, or one",
        ),
        (
            lambda: ql.simulate(PLANTS, controller(), [SHORT, SHORT, 1.0]),
            r"scenario\[2\] = 1.0: must be a quell.Scenario",
        ),
        (
            lambda: ql.simulate(PLANTS, controller(), [SHORT, SHORT, replace(SHORT, duration=2.0)]),
            r"scenario\[2\] has duration = 2.0 s, scenario\[0\] 1.0 s: must be the same in all runs",
        ),
        (
            lambda: ql.simulate(
                PLANTS,
                [controller(), controller(), controller(learner=ql.learners.Kalman())],
                SHORT,
            ),
            r"controller\[2\] has channels = .*: must be the same; run them as two batches",
        ),
        (
            lambda: ql.simulate(
                PLANTS[:2],
                [controller(), ql.ADRC(ql.ESO.model_free(4, 1.0, 10.0, 0.02), 1.0)],
                SHORT,
            ),
            r"controller\[1\] has dt = 0.02, controller\[0\] 0.01: must be the same",
        ),
        (
            lambda: ql.simulate(PLANTS, controller(), SHORT, record=["y", "z"]),
            "record = 'z': must be one of r, y, y_measured, u, w, x, x_hat",
        ),
        (
            lambda: ql.simulate(PLANTS, controller(), SHORT, record=[]),
            r"record = \[\]: must name at least one channel",
        ),
        (
            lambda: ql.simulate(PLANTS, controller(), SHORT, workers=0),
            "workers = 0: must be a whole number of at least 1",
        ),
        (
            lambda: ql.simulate(PLANTS[0], controller(), SHORT, workers=2),
            "workers = 2: is for a batch",
        ),
        (
            lambda: ql.simulate(PLANTS[0], controller(), SHORT, record=("y",)),
            r"record = \('y',\): is for a batch",
        ),
        (
            lambda: ql.simulate(PLANTS, controller(), replace(SHORT, x0=[1.0])),
            r"x0 has shape \(1,\): must be a vector of 4",
        ),
        (
            lambda: ql.simulate(PLANTS, controller(), [SHORT, SHORT, replace(SHORT, x0=[1.0])]),
            r"^scenario\[2\]: x0 has shape \(1,\): must be a vector of 4",
        ),
        (
            lambda: ql.simulate("servo", controller(), SHORT),
            "^plant = 'servo': must be a plant, for example",
        ),
        (
            lambda: ql.simulate("servo", [controller()] * 2, SHORT),
            "^plant = 'servo': must be a plant, for example",
        ),
        (
            lambda: ql.simulate(PLANTS, "adrc", SHORT),
            "^controller = 'adrc': must be a controller",
        ),
        (
            lambda: ql.simulate(PLANTS[0], controller(), "step"),
            "^scenario = 'step': must be a quell.Scenario",
        ),
        (
            lambda: ql.Scenario(disturbances="step"),
            "^disturbances = 'step': must be a sequence of signals or numbers",
        ),
        (lambda: PlantBatch("servo"), "^plants = 'servo': must be a sequence of plants"),
        (lambda: PlantBatch(1.0), "^plants = 1.0: must be a sequence of plants"),  # type: ignore[arg-type]
        (
            lambda: ql.simulate([([1.0], [1.0, 1.0, 0.0])] * 2, controller(), SHORT),
            "must be an array of numbers, got ",
        ),
        (
            lambda: ql.simulate(PLANTS, controller(), SHORT).run(3),
            "i = 3: must be a whole number from 0 to 2",
        ),
        (
            lambda: ql.simulate(PLANTS, controller(), SHORT)["x"],
            r"channel = 'x': was not recorded; .*, and with simulate\(…, record='all'\)",
        ),
        (
            lambda: ql.simulate(PLANTS, controller(), SHORT).plot([None]),
            "axes: must be two matplotlib axes, got 1",
        ),
    ],
)
def test_a_mistake_is_named(make: object, message: str) -> None:
    """With the argument, its value, the run and the rule."""
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


def test_what_goes_wrong_in_a_plant_of_the_user_s_is_told_with_its_run() -> None:
    """A fault, other than one of numbers out of range, ends the batch."""

    def faulty(at: float) -> ql.plants.NonlinearPlant:
        def rate(t, x, u, w):  # type: ignore[no-untyped-def]
            if t > at:
                raise ValueError("broken")
            return (u,)

        return ql.plants.NonlinearPlant(rate, order=1)

    law = ql.ADRC(ql.ESO.model_free(order=1, b0=1.0, omega_o=5.0, dt=0.01), omega_c=1.0)
    plants = [faulty(9.0), faulty(0.5)]
    with pytest.raises(ValueError, match="run 1: broken"):
        ql.simulate(plants, law, SHORT, interpret=True)


def test_of_several_faults_the_first_job_s_is_told_whichever_came_first() -> None:
    """A batch with two faulty runs names the same one on every machine."""
    began, ended = threading.Event(), threading.Event()

    def slow() -> None:
        began.set()
        ended.wait(10.0)
        raise ValueError("run 0")

    def quick() -> None:
        began.wait(10.0)
        threading.Timer(0.05, ended.set).start()
        raise ValueError("run 1")

    with pytest.raises(ValueError, match="run 0"):
        in_parallel([slow, quick], workers=2)


def test_blas_has_one_thread_until_the_last_of_several_blocks_ends() -> None:
    """They may be nested, and in several threads end in any order."""

    def threads() -> set[int]:
        return {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}

    with threadpool_limits(2, user_api="blas"):
        first, second = one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert threads() == {1}
        second.__exit__(None, None, None)
        assert threads() == {2}


def test_blas_has_one_thread_in_any_thread_whichever_had_a_block_before() -> None:
    """Threadpoolctl would let only the first of them set it."""

    def threads() -> set[int]:
        with one_blas_thread():
            return {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}

    before = threadpool_info()
    assert threads() == {1}
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(1) as other:
        assert one.submit(threads).result() == {1}
        assert other.submit(threads).result() == {1}
        assert threads() == {1}
    assert threadpool_info() == before


def test_a_number_as_a_channel_of_a_batch_names_the_run() -> None:
    """Runs are no entries of the record."""
    plants = ql.plants.batch(ql.plants.two_mass_spring, m1=[1.0, 1.5])
    controller = ql.ADRC(ql.ESO.model_free(4, 1.0, 10.0, 0.01), 1.0)
    runs = ql.simulate(plants, controller, ql.Scenario(duration=0.1))
    with pytest.raises(ValueError, match=r"run number 1 is runs\.run\(1\)"):
        runs[1]
    assert runs.run(1)["y"].shape == runs["y"][1].shape


def test_plants_that_are_sampled_together_have_the_bits_of_each_alone() -> None:
    """Of any size, stiffness and number of signals."""
    rng = np.random.default_rng(5)
    plants = []
    for _ in range(60):
        n, (m, p), scale = rng.integers(1, 6), rng.integers(1, 3, 2), 10.0 ** rng.uniform(-2.0, 3.0)
        matrices = rng.normal(size=(n, n)) * scale, rng.normal(size=(n, m)), rng.normal(size=(p, n))
        plants.append(ql.plants.LinearPlant(*matrices, rng.normal(size=(n, 2))))
    for plant, together in zip(plants, sampled_together(plants, 0.01), strict=True):
        alone = plant.sampled(0.01)
        assert type(together) is type(alone)
        assert [part.tobytes() for part in together] == [part.tobytes() for part in alone]


def test_a_plant_that_cannot_be_sampled_with_others_is_named() -> None:
    """By its own error, as it is alone."""
    plants = [
        ql.plants.LinearPlant([[a]], [1.0], [1.0], name=name)
        for a, name in ((1.0, "slow"), (1e6, "fast"))
    ]
    with pytest.raises(ValueError, match="fast can't be sampled"):
        ql.simulate(
            plants, ql.ADRC(ql.ESO.model_free(1, 1.0, 5.0, dt=0.01), 1.0), ql.Scenario(duration=0.1)
        )
