"""State feedback as a linear loop, and observers under a bound of M_s."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse_feedback, law_of_feedback, observer_within
from quell.controllers import StateFeedback, quadratic_feedback, state_feedback

from .benchmark_module import benchmark
from .cases import cases
from .test_state_space import AT_LOAD, AT_MOTOR, DT, ENCODERS, JL, JM, NOISE, A

WEIGHT = np.outer(ENCODERS[1], ENCODERS[1])
GAIN = quadratic_feedback(A, AT_MOTOR, WEIGHT, 1.0 / ((JM + JL) ** 2 * 80.0**4), DT)


def of_load(sensors: list[int], **options: Any) -> dict[str, Any]:
    """Return the arguments of an observer of a torque on the load."""
    count = {} if "omega_o" in options else {"noise_variance": [NOISE] * len(sensors)}
    return {
        "A": A, "B": AT_MOTOR, "C": ENCODERS[sensors], "E": AT_LOAD, "dt": DT,
        "accept_zeros": True, **count, **options,
    }  # fmt: skip


def test_the_matrices_are_the_law() -> None:
    """Random references and measurements of a law without limits, sample by sample."""
    observer = ql.ESO.state_space(**of_load([0, 1], drift=[0.1], time_varying=False))
    law = StateFeedback(observer, GAIN, controlled=ENCODERS[1:])
    found, random = law_of_feedback(law), np.random.default_rng(1)
    law.start([0.0, 0.0], [0.0])
    w = np.zeros(observer.estimates)
    for _ in range(200):
        r, y = random.standard_normal(1), 1e-3 * random.standard_normal(2)
        u = found.C @ w + found.D_y @ y + found.D_r @ r
        np.testing.assert_allclose(law.step(r, y), u, rtol=1e-8, atol=1e-8)
        w = found.A @ w + found.B_y @ y + found.B_r @ r


@pytest.mark.parametrize("sensors", [[1], [0, 1]], ids=["load", "both"])
def test_m_s_is_that_of_the_loop_broken_at_u(sensors: list[int]) -> None:
    """As ``benchmarks/second_encoder.py`` calculates it from its own matrices."""
    trial = benchmark("second_encoder")
    given = trial.law_of(tuple(sensors), np.array(AT_LOAD)[:, None], 80.0, 1.0)
    law = StateFeedback(given.observer, given.gain[None, :], controlled=ENCODERS[1:])
    found = analyse_feedback(law).m_s("inputs").value
    assert found == pytest.approx(trial.linear(given).peak_sensitivity, rel=1e-3)


class TestBound:
    """Gains under a bound of M_s."""

    @pytest.mark.parametrize(
        "options", [{"drift": [1.0]}, {"omega_o": 1500.0}], ids=["noise", "poles"]
    )
    def test_gains_that_meet_it_stay(self, options: dict[str, Any]) -> None:
        """The factor is one."""
        found = observer_within(2.5, GAIN, **of_load([0, 1], **options), controlled=ENCODERS[1:])
        assert found.factor == 1.0
        assert found.m_s.value <= 2.5

    @pytest.mark.trial
    @pytest.mark.parametrize(
        ("bound", "options"), [(1.85, {"drift": [0.01]}), (1.6, {"omega_o": 400.0})],
        ids=["noise", "poles"],
    )  # fmt: skip
    def test_the_nearest_gains_that_meet_it_are_taken(
        self, bound: float, options: dict[str, Any]
    ) -> None:
        """A little nearer to what was asked for is beyond the bound."""
        given = of_load([0, 1], **options)
        found = observer_within(bound, GAIN, **given, controlled=ENCODERS[1:])
        assert found.factor != 1.0
        assert found.m_s.value <= bound
        law = StateFeedback(found.observer, GAIN, controlled=ENCODERS[1:])
        assert analyse_feedback(law).m_s("inputs").value == found.m_s.value
        name, value = next(iter(options.items()))
        given[name] = np.multiply(value, found.factor**0.98).tolist()
        near = StateFeedback(ql.ESO.state_space(**given), GAIN, controlled=ENCODERS[1:])
        assert analyse_feedback(near).m_s("inputs").value > bound

    @pytest.mark.trial
    def test_where_no_gain_meets_it_a_line_says_not(self) -> None:
        """With the load's encoder alone the resonance leaves no margin, whatever the observer."""
        with pytest.raises(
            ValueError, match=r"NOT found: no gain has M_s at the inputs of at most 2"
        ):
            observer_within(2.0, GAIN, **of_load([1], drift=[1.0]), controlled=ENCODERS[1:])

    @cases(
        ("wrong", "message"),
        [
            ({"m_s": 1.0}, "m_s = 1.0: must be above 1"),
            ({"at": "motor"}, "at = 'motor'"),
            ({"every": (1, 4)}, r"every = \(1, 4\): the gains of sensors of different rates"),
            ({"drift": [0.0]}, "drift"),
            ({"gain": [[1.0]]}, "gain has shape"),
        ],
    )
    def test_what_does_not_fit_is_named(self, wrong: dict[str, Any], message: str) -> None:
        """The argument, its value and the rule."""
        given = {"m_s": 2.0, "gain": GAIN, **of_load([0, 1], drift=[1.0]), **wrong}
        with pytest.raises(ValueError, match=message):
            observer_within(**given, controlled=ENCODERS[1:])

    def test_another_controller_is_refused(self) -> None:
        """It has other functions."""
        with pytest.raises(ValueError, match="must be a StateFeedback"):
            analyse_feedback(state_feedback(A, AT_MOTOR, 80.0, DT))  # type: ignore[arg-type]
