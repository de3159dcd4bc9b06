"""Python objects that do not do as a learner should: late, broken, of the wrong size, or not there."""

from __future__ import annotations

import math
import sys
import threading
import time
import warnings
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.types import Status

from .cases import cases
from .commands import run_python
from .contracts.python_models import (
    CHAIN,
    SHORT,
    Broken,
    LeastMeanSquares,
    Sleeper,
    has,
    jax_mlp,
    law,
)

PythonModel = ql.learners.PythonModel


def test_a_late_model_is_told_of_and_not_waited_for() -> None:
    """Its answers are taken when they come; the loop is not held up for the time it takes."""
    learner = PythonModel(Sleeper(0.2), period=5, budget=1e-3)
    controller = law(learner)
    controller.prepare()
    started = time.perf_counter()
    flags = Status.OK
    for k in range(400):
        controller.step(1.0, 0.5 * math.sin(0.01 * k))
        flags |= controller.estimate.status
    assert time.perf_counter() - started < 0.2 * 400 / 5 / 2, "the loop waited for the model"
    assert Status.LEARNER_LATE in flags
    assert "budget" in flags.message
    assert learner.last_problem == ""
    until = time.monotonic() + 30.0
    while controller.estimate.f_learned == 0.0:  # it is asked again once it has answered
        assert time.monotonic() < until
        time.sleep(0.02)
        controller.step(1.0, 0.5)
    assert learner.trained(controller._state.learner).theta.size == 2


@pytest.mark.trial
@pytest.mark.parametrize("interpret", [pytest.param(False, marks=pytest.mark.compiled), True])
@pytest.mark.parametrize("budget", [None, 30.0])
@pytest.mark.parametrize(
    ("then", "says"),
    [
        (ValueError("no more"), "raised ValueError: no more"),
        (SystemExit(3), "raised SystemExit: 3"),
        (math.nan, "one finite number"),
        (math.inf, "one finite number"),
        (np.zeros(3), "one finite number"),
        (None, "one finite number"),
        ("2", "one finite number"),
    ],
)
def test_a_model_that_fails_is_said_to_and_the_loop_goes_on(
    then: Any, says: str, budget: float | None, interpret: bool
) -> None:
    """Nothing leaves the callback, the output stays a number near where it was, and the reason is kept."""
    learner = PythonModel(Broken(5, then), budget=budget)
    with pytest.warns(RuntimeWarning, match="learner Broken raised"):
        run = ql.simulate(CHAIN, law(learner), SHORT, interpret=interpret)
    assert Status.LEARNER_FAILED in run.status
    assert says in learner.last_problem
    assert not run.diverged
    assert np.all(np.isfinite(run.log))
    assert np.max(np.abs(run["y"])) < 2.0


@pytest.mark.trial
def test_a_model_starts_anew_after_a_failure_and_is_disabled_after_three_in_a_row() -> None:
    """One that fails at its sixth call each time goes on for ever; one that always fails is asked three times."""
    again, never = PythonModel(Broken(5, math.nan)), PythonModel(Broken(2, math.nan))
    with pytest.warns(RuntimeWarning):
        run = ql.simulate(CHAIN, law(again), ql.Scenario(ql.signals.Sinusoid(), duration=10.0))
    assert "disabled" not in again.last_problem
    assert run["status"][-1] in (
        0,
        Status.LEARNER_FAILED,
        Status.LEARNER_FAILED | Status.OVERFLOWED,
    )

    controller = law(never)  # tried, and found good
    never._source.well = 0
    with pytest.warns(RuntimeWarning) as told:
        run = ql.simulate(CHAIN, controller, ql.Scenario(ql.signals.Sinusoid(), duration=20.0))
    assert ["disabled" in str(warning.message) for warning in told] == [False, True]
    assert Status(int(run["status"][-1])) == Status.LEARNER_FAILED
    assert np.max(np.abs(run["y"])) < 2.0
    np.testing.assert_array_equal(run["f_learned"][-1000:], 0.0)


def test_where_warnings_are_errors_a_failure_still_stays_inside(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The text goes to stderr then."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = ql.simulate(CHAIN, law(PythonModel(Broken(5, math.nan))), SHORT)
    assert not run.diverged
    assert "learner Broken raised" in capsys.readouterr().err


@pytest.mark.trial
def test_an_interrupted_model_interrupts_the_simulation() -> None:
    """Control-C while the model runs comes out of ``simulate``, once the loop can be left."""
    script = """
import signal, time, warnings
import quell as ql

signal.signal(signal.SIGINT, signal.default_int_handler)  # shells ignore it in the background

class Model:
    calls = 0
    def learn(self, features, targets): ...
    def predict(self, features):
        self.calls += 1
        if self.calls > 5:
            raise KeyboardInterrupt  # what Python does to it
        return 0.0

warnings.simplefilter("ignore")
controller = ql.ADRC(ql.ESO.model_free(2, 1.0, 15.0, 5e-3), 4.0, learner=ql.learners.PythonModel(Model()))
try:
    plant, scenario = ql.plants.LinearPlant([[0, 1], [0, 0]], [0, 1], [1, 0]), ql.Scenario(ql.signals.Sinusoid(), 1e5)
    ql.simulate(plant, controller, scenario, record_every=1000)
    time.sleep(60.0)
except KeyboardInterrupt:
    print("interrupted")
"""
    shown = run_python(script, timeout=120)
    assert shown.stdout.strip() == "interrupted"


@cases(
    ("make", "message"),
    [
        (lambda: PythonModel(3.0), r"model = 3.0: must be an object with learn"),
        (lambda: PythonModel(LeastMeanSquares), "must be an object with learn"),
        (
            lambda: PythonModel(LeastMeanSquares(), period=0),
            "period = 0: must be a whole number of at least 1",
        ),
        (
            lambda: PythonModel(LeastMeanSquares(), budget=0.0),
            "budget = 0.0: must be finite and greater than zero",
        ),
        (
            lambda: PythonModel(LeastMeanSquares(), features=3),
            "features = 3: must be made of blocks",
        ),
        (
            lambda: PythonModel(_with_lock()),
            "LeastMeanSquares: must be something copy.deepcopy can copy",
        ),
        (
            lambda: law(PythonModel(Broken(0, np.zeros(2)))),
            "Broken: predict fails .* one finite number",
        ),
        (lambda: law(PythonModel(Broken(0, None))), "Broken: predict fails .* one finite number"),
        (
            lambda: law(PythonModel(Broken(0, math.nan))),
            "Broken: predict fails .* one finite number",
        ),
        (
            lambda: law(PythonModel(Broken(0, KeyError("x")))),
            r"Broken: predict fails .* KeyError.*2 features \(x1, x2\)",
        ),
        (
            lambda: law(PythonModel(LeastMeanSquares(), features=ql.features.State(3))),
            "count = 3: a plant of order 2",
        ),
        (lambda: ql.learners.SklearnModel(LeastMeanSquares()), "must have partial_fit and predict"),
        (lambda: ql.learners.RiverModel(LeastMeanSquares()), "must have learn_one and predict_one"),
    ],
)
def test_a_mistake_is_named(make: Any, message: str) -> None:
    """At construction, with what is wrong and the rule."""
    with pytest.raises(ValueError, match=message):
        make()


def _with_lock() -> LeastMeanSquares:
    model = LeastMeanSquares()
    model.lock = threading.Lock()  # type: ignore[attr-defined]
    return model


@pytest.mark.skipif(not has("torch"), reason="torch is not installed")
def test_mistakes_with_torch_are_named() -> None:
    """A wrong width, two outputs, an optimiser on something else."""
    import torch

    for module in (torch.nn.Linear(5, 1), torch.nn.Linear(2, 2)):
        with pytest.raises(
            ValueError, match=r"Linear: learn fails on a trial .* 2 features \(x1, x2\)"
        ):
            law(ql.learners.TorchModel(module))
    with pytest.raises(ValueError, match="must be on the parameters of the module"):
        ql.learners.TorchModel(
            torch.nn.Linear(2, 1), torch.optim.SGD(torch.nn.Linear(2, 1).parameters(), lr=0.1)
        )
    with pytest.raises(ValueError, match=r"must be a torch.nn.Module"):
        ql.learners.TorchModel(LeastMeanSquares())
    with pytest.raises(ValueError, match="must be a torch optimiser"):
        ql.learners.TorchModel(torch.nn.Linear(2, 1), 0.1)


@pytest.mark.skipif(
    not has("jax", "equinox", "optax"), reason="jax, equinox or optax is not installed"
)
def test_mistakes_with_jax_are_named() -> None:
    """A wrong width, two outputs, something that is no module."""
    import equinox
    import jax

    for sizes in ((5, "scalar"), (2, 2)):
        with pytest.raises(
            ValueError, match=r"Linear: learn fails on a trial .* 2 features \(x1, x2\)"
        ):
            law(ql.learners.JaxModel(equinox.nn.Linear(*sizes, key=jax.random.key(0))))
    with pytest.raises(ValueError, match=r"must be an equinox.Module"):
        ql.learners.JaxModel(LeastMeanSquares())
    with pytest.raises(ValueError, match="must be an optax optimiser"):
        ql.learners.JaxModel(jax_mlp(), 0.1)


def test_a_missing_library_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error says what to install."""
    for module, extra, make in (
        ("torch", "torch", ql.learners.TorchModel),
        ("jax", "jax", ql.learners.JaxModel),
    ):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ImportError, match=rf"pip install 'quell-control\[{extra}\]'"):
            make(object())
