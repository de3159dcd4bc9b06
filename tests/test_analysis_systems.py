"""Parts of a loop as systems of python-control, against the simulated loop."""

from __future__ import annotations

import importlib
from typing import Any

import control
import numpy as np
import pytest

import quell as ql
from quell import analysis
from tests.analysed_loops import LEARNED, PLANT, Held, adrc, chain

CASES = [
    (order, form, model, learner)
    for order in (1, 2, 3, 4)
    for form in ("current", "predictor")
    for model, learner in (
        (False, None),
        (True, None),
        (False, Held(LEARNED)),
        (False, Held(LEARNED, 0.1, 0.3)),
    )
]


@pytest.mark.parametrize(("order", "form", "model", "learner"), CASES)
def test_exported_systems_answer_as_the_simulated_loop_does(
    order: int, form: str, model: bool, learner: Any
) -> None:
    """To 1e-9 of the answer: the closed loop, and python-control's own interconnection of plant and both degrees of freedom."""
    controller = adrc(order, form, model=model, learner=learner)
    run = ql.simulate(
        chain(order),
        controller,
        ql.Scenario(
            reference=1.0, duration=3.0, disturbances=(ql.signals.Step(height=0.5, at=1.5),)
        ),
    )
    loop = analysis.analyse(chain(order), controller)
    w = np.array(run["w"][:, 0])

    def answer(system: Any, source: np.ndarray) -> np.ndarray:
        return control.forced_response(system, run.t, source).outputs

    for target in ("y", "u"):
        told = answer(loop.system(f"r → {target}"), run["r"]) + answer(
            loop.system(f"w1 → {target}"), w
        )
        np.testing.assert_allclose(
            told, run[target], rtol=0.0, atol=1e-9 * np.max(np.abs(run[target]))
        )
    P, C_r, C_y = (loop.system(name) for name in ("P", "C_r", "C_y"))
    told = answer(control.feedback(P, C_y) * C_r, run["r"]) + answer(control.feedback(P, C_y), w)
    np.testing.assert_allclose(told, run["y"], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_transfer_functions_answer_as_the_simulated_loop_does(order: int) -> None:
    """Closed by python-control, the plant and the controller's two: to 1e-9. The closed loop as one fraction loses more."""
    controller = adrc(order)
    run = ql.simulate(chain(order), controller, ql.Scenario(reference=1.0, duration=12.0))
    loop = analysis.analyse(chain(order), controller)
    fractions = [loop.transfer_function(name) for name in ("P", "C_r", "C_y")]
    assert all(isinstance(fraction, control.TransferFunction) for fraction in fractions)
    np.testing.assert_array_equal(fractions[1].den[0][0], fractions[2].den[0][0])
    assert fractions[2].den[0][0].size == order + 2
    P, C_r, C_y = map(control.ss, fractions)
    y = control.forced_response(control.feedback(P, C_y) * C_r, run.t, run["r"]).outputs
    np.testing.assert_allclose(y, run["y"], rtol=0.0, atol=1e-9)
    y = control.forced_response(loop.transfer_function("closed_loop"), run.t, run["r"]).outputs
    np.testing.assert_allclose(y, run["y"], rtol=0.0, atol=(1e-11, 1e-8, 1e-5)[order - 1])


def test_responses_are_those_of_the_exported_systems() -> None:
    """All that have a name."""
    loop = analysis.analyse(PLANT, adrc(2))
    omega = np.array([0.1, 1.0, 10.0, 100.0])
    for name in ("P", "C_r", "C_y", "L", "S", "T", "PS", "CS", "closed_loop"):
        np.testing.assert_allclose(
            loop.system(name)(np.exp(1j * omega * 0.01)), loop.response(name, omega), rtol=1e-8
        )


def test_without_python_control_all_but_its_systems_is_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And the error says which extra brings it."""
    real = importlib.import_module

    def missing(name: str, *rest: Any) -> Any:
        if name == "control":
            raise ImportError("No module named 'control'")
        return real(name, *rest)

    monkeypatch.setattr(importlib, "import_module", missing)
    loop = analysis.analyse(PLANT, adrc(2))
    assert loop.margins.phase > 0.0
    with pytest.raises(ImportError, match=r"pip install 'quell-control\[control\]'"):
        loop.system("L")
