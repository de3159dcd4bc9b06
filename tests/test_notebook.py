"""What a notebook shows: a short text and a small figure, of one axis and of several."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse

DT = 0.02
PLANT = ql.plants.LinearPlant.of(([2.0], [1.0, 1.0, 0.0]))
OBSERVER = ql.ESO.model_free(order=2, b0=2.0, omega_o=15.0, dt=DT)


def controller() -> ql.ADRC:
    """Return a controller of the plant."""
    return ql.ADRC(OBSERVER, omega_c=3.0, u_min=-4.0, u_max=4.0)


def run_of_one() -> Any:
    """Return a run of one axis."""
    scenario = ql.Scenario(reference=1.0, duration=2.0)
    return ql.simulate(PLANT, controller(), scenario, interpret=True)


def run_of_axes() -> Any:
    """Return a run of two axes."""
    machine = ql.plants.LinearPlant(np.zeros((2, 2)), np.eye(2), np.eye(2))
    axis = ql.ADRC(ql.ESO.model_free(order=1, b0=1.0, omega_o=15.0, dt=DT), omega_c=3.0)
    scenario = ql.Scenario(reference=(1.0, 0.5), duration=0.6)
    return ql.simulate(machine, ql.Axes([axis, axis]), scenario, interpret=True)


@pytest.mark.parametrize("made", [run_of_one, run_of_axes], ids=["one", "axes"])
def test_a_run_is_a_line_and_a_figure(made: Any) -> None:
    """Its numbers are not printed; the drawing is an SVG of its own, with y, r and u."""
    run = made()
    assert len(repr(run)) < 300
    assert repr(run).startswith("Trajectory(")
    assert f"{len(run)} samples, 0.02 s apart" in repr(run)
    shown = run._repr_html_()
    assert re.match(r"<pre [^>]*>Trajectory\(", shown)
    assert shown.count("<svg") == shown.count("</svg>") == 1
    assert "time [s]" in shown


@pytest.mark.trial
def test_an_analysis_is_its_summary_and_a_figure() -> None:
    """The text is escaped."""
    loop = analyse(PLANT, controller())
    shown = loop._repr_html_()
    assert "<svg" in shown
    assert "&" in shown.partition("<svg")[0] or "<" not in repr(loop)


@pytest.mark.trial
def test_a_batch_a_model_and_a_tuning_are_texts_and_figures() -> None:
    """In few lines, and without a window of pyplot."""
    import matplotlib.pyplot as plt

    before = plt.get_fignums()
    scenarios = [ql.Scenario(reference=size, duration=1.0) for size in (0.5, 1.0)]
    batch = ql.simulate(PLANT, controller(), scenarios)
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([-1.0, 1.0], 60), 8)
    y = np.zeros(u.size)
    for k in range(u.size - 1):
        y[k + 1] = 0.95 * y[k] + 0.1 * u[k]
    model = ql.identify(y + 1e-3 * rng.normal(size=y.size), u, 0.05, order=1)
    tuned = ql.tune(([1.0], [1.0, 1.0]), dt=0.05, structure="pi", compare=())
    for each in (batch, model, tuned):
        shown: str = each._repr_html_()
        assert shown.count("<svg") == 1
        assert len(repr(each)) < 3000
    assert len(repr(batch)) < 300
    assert plt.get_fignums() == before


@pytest.mark.parametrize(
    "made",
    [
        ql.learners.Kalman(),
        ql.learners.Harmonic(count=2, u=True),
        ql.learners.Repetitive(period=0.5),
        ql.learners.BatchGradient(),
        ql.Guard(bound=2.0),
        ql.Scenario(reference=ql.signals.Step(at=1.0), duration=3.0, seed=2),
    ],
    ids=lambda made: type(made).__name__,
)
def test_what_a_loop_is_made_of_prints_as_a_short_call(made: Any) -> None:
    """Only what differs from the defaults; the text makes the same object again."""
    names: dict[str, Any] = {"Guard": ql.Guard, "Scenario": ql.Scenario, "Step": ql.signals.Step}
    names |= {name: getattr(ql.learners, name) for name in ql.learners.__all__}
    assert len(repr(made)) < 80
    assert eval(repr(made), names) == made
