"""State feedback with a multivariable ESO: a loop of several signals that follows and rejects."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

import quell as ql
from quell.controllers import StateFeedback, quadratic_feedback, state_feedback
from quell.controllers.several import control_all
from quell.kernels.dispatch import as_python

from .cases import cases
from .in_c import InC, built, needs_gcc

JM, JL, K, C, DT = 1.2e-4, 0.8e-4, 60.0, 0.005, 0.25e-3
A = np.array(
    [
        [0, 1, 0, 0],
        [-K / JM, -C / JM, K / JM, C / JM],
        [0, 0, 0, 1],
        [K / JL, C / JL, -K / JL, -C / JL],
    ]
)
AT_MOTOR, AT_LOAD = np.array([0, 1 / JM, 0, 0]), np.array([0, 0, 0, 1 / JL])
E = np.column_stack([AT_MOTOR, AT_LOAD])
ENCODERS = np.eye(4)[[0, 2]]
NOISE = (2 * np.pi / 2**20) ** 2 / 12


def drive() -> ql.plants.LinearPlant:
    """Return a servo with a flexible coupling, an encoder and a disturbance at each side."""
    return ql.plants.LinearPlant(A, AT_MOTOR[:, None], ENCODERS, E)


def controller(**limits: object) -> StateFeedback:
    """Return state feedback for the load's angle."""
    observer = ql.ESO.state_space(
        A, AT_MOTOR, ENCODERS, E, DT, noise_variance=[NOISE] * 2, drift=[1.0, 1.0]
    )
    Q = np.outer(ENCODERS[1], ENCODERS[1])
    gain = quadratic_feedback(A, AT_MOTOR, Q, 1.0 / ((JM + JL) ** 2 * 80.0**4), DT)
    return StateFeedback(observer, gain, controlled=ENCODERS[1:], **limits)  # type: ignore[arg-type]


class TestLoop:
    """A servo with a second encoder."""

    @pytest.mark.trial
    def test_the_load_stands_under_constant_torques_on_both_sides(self) -> None:
        """Z comes to r whatever constant torques act, and the estimates are these torques."""
        torques = (ql.signals.Step(0.2, 0.2), ql.signals.Step(-0.3, 0.4))
        scenario = ql.Scenario(0.5, duration=1.5, disturbances=torques)
        run = ql.simulate(drive(), controller(), scenario)
        assert run["y"][-1, 1] == pytest.approx(0.5, abs=1e-9)
        np.testing.assert_allclose(run["d_hat"][-1], [0.2, -0.3], atol=1e-6)
        np.testing.assert_allclose(run["u"][-1], 0.1, atol=1e-6)
        # Encoders of 20 bits: within two counts, and the torque at the motor is a noisy estimate.
        counted = ql.plants.encoded_outputs(drive(), 2 * np.pi / 2**20)
        run = ql.simulate(counted, controller(), scenario)
        late = run.t > 1.0
        assert np.max(np.abs(run["y"][late, 1] - 0.5)) < 2 * 6e-6
        np.testing.assert_allclose(run["d_hat"][late].mean(axis=0), [0.2, -0.3], atol=3e-3)

    @pytest.mark.trial
    def test_limits_do_not_reach_the_estimates(self) -> None:
        """The observer receives the torque that was applied, so its d stays zero."""
        run = ql.simulate(drive(), controller(u_min=-0.4, u_max=0.4), ql.Scenario(1.0, 0.3))
        assert ql.Status.SATURATED in run.status
        assert np.max(np.abs(run["u"])) <= 0.4
        assert np.max(np.abs(run["d_hat"])) < 1e-6

    def test_interpreted_is_compiled(self) -> None:
        """The same functions as Python give the same run."""
        scenario = ql.Scenario(0.5, duration=0.05, disturbances=(0.1, 0.1), noise=1e-5)
        one = ql.simulate(drive(), controller(u_max=0.5), scenario)
        other = ql.simulate(drive(), controller(u_max=0.5), scenario, interpret=True)
        np.testing.assert_allclose(one.log, other.log, rtol=1e-6, atol=1e-9)

    @pytest.mark.trial
    def test_a_missing_encoder_is_flagged_and_the_other_corrects(self) -> None:
        """Half a second without the load's encoder keeps the loop at its reference."""
        law = controller()
        plant, x, y = drive().sampled(DT, interpret=True), np.zeros(4), np.zeros(2)
        for k in range(4000):
            np.matmul(ENCODERS, x, out=y)
            measured = np.array([y[0], np.nan if 1000 < k < 3000 else y[1]])
            u = law.step([0.3], measured)
            assert (ql.Status.MEASUREMENT_HELD in law.status) == (1000 < k < 3000)
            x = plant.transition @ x + plant.input @ u
        assert x[2] == pytest.approx(0.3, abs=1e-6)

    @pytest.mark.trial
    def test_a_record_is_plotted_and_saved(self, tmp_path) -> None:  # type: ignore[no-untyped-def]
        """It has outputs, control signals and disturbances, but no axes."""
        run = ql.simulate(drive(), controller(), ql.Scenario(0.5, duration=0.1))
        run.save(tmp_path / "run.nc")
        found = ql.Trajectory.load(tmp_path / "run.nc")
        assert np.array_equal(found["d_hat"], run["d_hat"])
        assert run.plot().size == 3
        with pytest.raises(ValueError, match="has no axes"):
            run.axis(0)


class TestOperation:
    """Sample by sample."""

    def test_start_under_load_has_no_bump(self) -> None:
        """Two encoders at rest tell the torque that winds the coupling up."""
        law = controller()
        law.start(y=[0.2 + 0.3 / K, 0.2], u=[0.3])
        assert law.step([0.2], [0.2 + 0.3 / K, 0.2])[0] == pytest.approx(0.3, abs=1e-6)
        assert law.estimate[1] == pytest.approx([0.0, -0.3], abs=1e-6)

    def test_nothing_happens_before_all_is_measured(self) -> None:
        """U is that of rest until each encoder has given a number."""
        law = controller()
        assert law.step([1.0], [0.1, np.nan]).tolist() == [0.0]
        assert ql.Status.MEASUREMENT_HELD in law.status
        assert law.step([0.1], [0.1, 0.1])[0] == pytest.approx(0.0, abs=1e-9)

    def test_a_reference_that_is_no_number_is_the_last(self) -> None:
        """The flag says so."""
        law, other = controller(), controller()
        for each in (law, other):
            each.step([0.1], [0.0, 0.0])
        assert law.step([np.nan], [0.0, 0.0])[0] == other.step([0.1], [0.0, 0.0])[0]
        assert ql.Status.REFERENCE_HELD in law.status

    def test_one_input_and_output_is_the_law_of_adrc(self) -> None:
        """A double integrator with poles of observer and law at one place each."""
        chain, b, c = [[0.0, 1.0], [0.0, 0.0]], [0.0, 2.0], [1.0, 0.0]
        observer = ql.ESO.state_space(chain, b, [c], [0.0, 1.0], 1e-4, omega_o=40.0)
        gain = state_feedback(chain, b, 8.0, 1e-4)
        law = StateFeedback(observer, gain, u_max=5.0, u_min=-5.0)
        adrc = ql.ADRC(ql.ESO.model_free(2, 2.0, 40.0, 1e-4), 8.0, u_max=5.0, u_min=-5.0)
        for k in range(2000):
            y = 0.01 * np.sin(0.01 * k)
            assert law.step([0.05], [y])[0] == pytest.approx(adrc.step(0.05, y), rel=2e-3, abs=2e-3)


class TestC:
    """The same law in C; ``tests/contracts`` has each option of law and observer."""

    @pytest.mark.trial
    @needs_gcc
    @pytest.mark.parametrize("precision", ["double", "single"])
    def test_the_c_code_repeats_the_kernels_bit_for_bit(
        self, tmp_path: Path, precision: str
    ) -> None:
        """With a covariance in each sample, sensors that are missing, limits, and a restart."""
        given = controller(u_min=-0.5, u_max=0.5, rate_limit=2000.0)
        ql.export.c(given, tmp_path / "out", name="servo", precision=precision, accept=True)
        sources = (tmp_path / "out/test_servo.c", tmp_path / "out/src/servo.c")
        program = built(tmp_path / "test", sources, "-O2", "-I", tmp_path / "out/src")
        done = subprocess.run([program, "0"], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout
        assert "largest difference 0 ulp" in done.stdout

    @pytest.mark.trial
    @needs_gcc
    def test_a_run_with_missing_encoders_is_that_of_python(self, tmp_path: Path) -> None:
        """In a loop in which each encoder is away for a while, and an image is handed over."""
        law, names = controller(u_max=0.5), ("r", "y", "u")
        code = InC(ql.export.c_source(law, "servo"), tmp_path)
        plant, x, random = (
            drive().sampled(DT, interpret=True),
            np.zeros(4),
            np.random.default_rng(1),
        )
        with np.errstate(all="ignore"), as_python():
            for k in range(1200):
                y = ENCODERS @ x + 1e-6 * random.standard_normal(2)
                y[0] = np.nan if 300 < k < 330 or k < 2 else y[0]
                y[1] = np.nan if 600 < k < 900 else y[1]
                u, in_c = (
                    np.zeros(1),
                    dict(zip(names, (np.array([0.3]), y, np.zeros(1)), strict=True)),
                )
                control_all(law.parameters, law._state, in_c["r"], y, u)
                code.run("step", *in_c.values())
                assert in_c["u"][0] == u[0]
                x = plant.transition @ x + plant.input @ u
        assert x[2] == pytest.approx(0.3, abs=1e-4)
        image, other = law.memory(), controller(u_max=0.5)
        other.restore(image, running=True)
        assert np.array_equal(other._state.estimates, law._state.estimates)

    def test_a_start_keeps_references_for_steps_without_them(self) -> None:
        """As the r of ``NAME_start`` in C."""
        law = controller()
        law.start([0.2, 0.2], [0.0], [0.2])
        assert law.step([np.nan], [0.2, 0.2])[0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.trial
@cases(
    ("wrong", "message"),
    [
        (lambda: StateFeedback(3, [1.0]), "observer = 3: must be one of"),
        (lambda: StateFeedback(controller().observer, [[1.0, 2.0]]), r"must be \(1, 4\)"),
        (lambda: StateFeedback(controller().observer, np.ones(4), controlled=ENCODERS),
         "no u keeps d2 from the outputs z = C x: there are 1 inputs for 2"),
        (lambda: controller().step([1.0, 2.0], [0.0, 0.0]), "must have 1 and 2 numbers"),
        (lambda: controller().step(0.1, [0.0, 0.0]), "must have 1 and 2 numbers"),
        (lambda: StateFeedback(controller().observer, "k"), "gain"),
        (lambda: controller(u_min=1.0, u_max=-1.0), r"u\[0\]: u_min"),
        (lambda: ql.simulate(drive(), controller(), ql.Scenario((1.0, 2.0))),
         "reference has 2 signals"),
        (lambda: ql.export.c_source(controller(), resolution=1e-6), "StateFeedback takes y in its"),
        (lambda: ql.export.c(controller(), "firmware", precision="single"), "needs plant"),
        (lambda: ql.analysis.analyse(drive(), controller()), "1 control signal and 2 outputs, here there is one of each; several: quell.Axes"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_named(wrong, message: str) -> None:  # type: ignore[no-untyped-def]
    """Errors name the argument and the rule."""
    with pytest.raises(ValueError, match=message):
        wrong()
