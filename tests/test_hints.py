"""Wrong calls of users: each message names what to write, in at most three lines."""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell import hints

from .cases import cases

OBSERVER = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=1e-3)
ADRC = ql.ADRC(OBSERVER, omega_c=2.0)
PLANT = ql.plants.LinearPlant.of(([1.0], [1.0, 0.0, 0.0]))
RUN = ql.simulate(PLANT, ADRC, ql.Scenario(reference=1.0, duration=0.005), interpret=True)
ANY: Any = ql


@cases(
    ("call", "said"),
    [
        (lambda: RUN.y, "run['y']"),
        (lambda: RUN.f_hat, "run['f_hat']"),
        (lambda: RUN.time, "run.t"),
        (lambda: RUN.rms, "run.metrics()['rms']"),
        (lambda: RUN.settling_time, "run.metrics()['settling_time']"),
        (lambda: RUN.metrics("rms"), "run.metrics()[name]"),  # type: ignore[arg-type]
        (lambda: RUN.metric(), "metrics"),
        (lambda: RUN["speed"], "must be one of r, y"),
        (lambda: ANY.PID, "quell.baselines.PID"),
        (lambda: ANY.LADRC, "quell.ADRC("),
        (lambda: ANY.Simulator, "quell.simulate(plant, controller, scenario)"),
        (lambda: ANY.tf([1.0], [1.0, 1.0]), "(num, den)"),
        (lambda: ANY.StateSpace, "LinearPlant.of(model)"),
        (lambda: ANY.Kalman, "quell.learners.Kalman"),
        (lambda: ANY.Gaurd, "did you mean Guard?"),
        (lambda: ANY.signals.Sine, "quell.signals.Sinusoid"),
        (lambda: ANY.signals.WhiteNoise, "BandLimitedNoise"),
        (lambda: ANY.signals.Stpe, "did you mean Step?"),
        (lambda: ANY.plants.DCMotor, "quell.plants.dc_motor()"),
        (lambda: ANY.learners.NeuralNetwork, "MLP"),
        (lambda: ANY.learners.ILC, "Repetitive"),
        (lambda: ANY.features.Polynomials, "Polynomial"),
        (lambda: ANY.controllers.Schedules, "Schedule"),
        (lambda: ANY.ESO(order=2, b0=1.0, omega_o=9.0, dt=1e-3), "ESO.model_free(order=2"),
        (lambda: ANY.ESO(2, 1.0, 9.0, 1e-3), "ESO.model_free(order=2"),
        (lambda: ANY.ESO.model_free(2, 1.0, 9.0), "needs dt, too"),
        (lambda: ANY.ESO.model_free(order=2, b=1.0, omega_o=9.0, dt=1e-3), "did you mean b0?"),
        (lambda: ANY.ESO.model_free(order=2, b0=1.0, wo=9.0, dt=1e-3), "did you mean omega_o?"),
        (lambda: ANY.ESO.model_free(order=2, b0=1.0, omega_o=9.0, Ts=1e-3), "did you mean dt?"),
        (lambda: ANY.ESO.model_based(PLANT, omega_0=9.0, dt=1e-3), "did you mean omega_o?"),
        (lambda: ANY.ADRC(order=2, b0=1.0, omega_c=1.0), "quell.ADRC(observer, omega_c=2.0)"),
        (lambda: ANY.ADRC(OBSERVER), "needs omega_c, too"),
        (lambda: ANY.ADRC(OBSERVER, 2.0, limits=(-1, 1)), "did you mean u_min, u_max?"),
        (lambda: ANY.ADRC(OBSERVER, 2.0, umax=1.0), "did you mean u_max?"),
        (lambda: ANY.ADRC(OBSERVER, 2.0, learner="kalman"), "quell.learners.Kalman()"),
        (lambda: ANY.ADRC(OBSERVER, 2.0, guard=True), "quell.Guard()"),
        (lambda: ADRC.update(1.0, 0.0), "controller.step(r, y)"),
        (lambda: ADRC.f_hat, "controller.estimate.f"),
        (lambda: ADRC.omega_o, "controller.observer"),
        (lambda: ADRC.u, "controller.estimate.u"),
        (lambda: ADRC.stpe(1.0, 0.0), "did you mean step?"),
        (lambda: ADRC.step("1", 0.0), "must be numbers"),  # type: ignore[arg-type]
        (lambda: ANY.Scenario(ref=1.0, duration=1.0), "did you mean reference?"),
        (lambda: ANY.Scenario(1.0, 1.0, disturbance=2.0), "did you mean disturbances?"),
        (lambda: ql.simulate(PLANT, ADRC, ANY.Scenario(np.ones(9), 1.0)), "quell.Scenario|Samples|signal"),
        (lambda: ANY.signals.as_signal(np.ones(9), "reference"), "Samples(times, values)"),
        (lambda: ANY.signals.as_signal(lambda t: t, "reference"), "Samples(times, values)"),
        (lambda: ANY.simulate(PLANT, ADRC), "needs scenario, too"),
        (lambda: ANY.simulate(PLANT, ADRC, 10.0), "must be a quell.Scenario"),
        (lambda: ANY.simulate(ADRC, PLANT, ql.Scenario(1.0, 1.0)), "must be a plant"),
        (lambda: ANY.simulate(PLANT, OBSERVER, ql.Scenario(1.0, 1.0)), "must be a controller"),
        (lambda: ANY.simulate(PLANT, ADRC, ql.Scenario(1.0, 1.0), dt=1e-3), "it takes plant"),
        (lambda: ANY.plants.LinearPlant([1.0], [1.0, 0.0]), "LinearPlant.of((num, den))"),
        (lambda: ANY.tune(([1.0], [1.0, 1.0])), "needs dt, too"),
        (lambda: ANY.tune([1.0], [1.0, 1.0], dt=0.1), "quell.tune(([1.0], "),
        (lambda: ANY.analysis.analyse(ADRC), "quell.analysis.analyse(plant, controller)"),
        (lambda: ANY.export.c(ADRC), 'quell.export.c(controller, "folder")'),
        (lambda: ANY.tune(PLANT, dt=0.1, Ms=1.6), "Constraints(m_s=1.6)"),
        (lambda: ANY.tune(PLANT, dt=0.1, robustness=1.6), "help(quell.tune)"),
        (lambda: ANY.identify(np.ones(9), np.ones(9)), "needs dt, too"),
        (lambda: ANY.signals.Sinusoid(1.0, freq=2.0), "did you mean omega?"),
        (lambda: ANY.signals.Step(time=1.0), "did you mean at?"),
        (lambda: ANY.baselines.PID(Kp=1.0, dt=0.1), "did you mean kp?"),
        (lambda: ANY.baselines.PID(1.0, 2.0, 0.1), "needs dt, too"),
        (lambda: ANY.baselines.LQG(PLANT, 1.0, 10.0), "needs dt, too"),
        (lambda: ANY.Guard(limit=3.0), "it takes bound, time"),
        (lambda: ANY.learners.Kalman(forgetting=0.99), "it takes state, bias, u"),
        (lambda: ANY.plants.dc_motor(R=0.5), "did you mean resistance?"),
        (lambda: ANY.plants.n_mass([1.0, 2.0]), "needs stiffnesses, too"),
        (lambda: ANY.plants.delayed(PLANT, 0.1), "needs dt, too"),
    ],
)  # fmt: skip
def test_a_wrong_call_is_told_what_to_write(call: Callable[[], Any], said: str) -> None:
    """Names of other packages, near misses, forgotten arguments, objects in a wrong place."""
    with pytest.raises((AttributeError, TypeError, ValueError)) as found:
        call()
    text = str(found.value)
    assert any(each in text for each in said.split("|")), text
    assert len(text) < 3 * 120
    assert "\n" not in text


def test_what_is_meant_exists() -> None:
    """Each name of quell in the tables is a public one, and each argument one of a class."""
    known = {**hints.OF_MODULES, **hints.OF_CONTROLLERS}
    for text in set(known.values()):
        for path in re.findall(r"\bquell((?:\.\w+)+)", text):
            value: Any = ql
            for name in path[1:].split("."):
                value = getattr(value, name)
    for text in set(hints.OF_CONTROLLERS.values()):
        for name in re.findall(r"\bcontroller\.(\w+)", text):
            assert hasattr(ADRC, name)
    for name in re.findall(r"\.(\w+)", " ".join(hints.OF_CONTROLLERS.values())):
        assert name.islower() or name[0].isupper()


def test_looking_for_an_attribute_stays_cheap_and_errors_travel() -> None:
    """The text is found when it is asked for; an error of a property is its own; pickles work."""
    assert not hasattr(ADRC, "inputs")
    assert getattr(RUN, "missing", 3) == 3
    with pytest.raises(AttributeError) as found:
        ADRC.omega_o  # noqa: B018
    again = pickle.loads(pickle.dumps(found.value))
    assert (type(again), str(again)) == (AttributeError, str(found.value))

    class Broken(hints.Hinted):
        @property
        def value(self) -> int:
            raise AttributeError("inside")

    with pytest.raises(AttributeError, match="^inside$"):
        Broken().value  # noqa: B018


def test_an_error_inside_of_a_call_stays_as_it_is() -> None:
    """Only a call that does not fit is explained, not a TypeError of the work."""

    @hints.explained("work(1)")
    def work(number: int) -> int:
        return number + "1"  # type: ignore[operator]

    with pytest.raises(TypeError, match="unsupported operand"):
        work(1)
    with pytest.raises(TypeError, match=r"work needs number, too; write work\(1\)$"):
        work()  # type: ignore[call-arg]
