"""``benchmarks/equal_margins.py`` and ``independent_linear.py``: what they compare is what they say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from quell.analysis import analyse

from .benchmark_module import BENCHMARKS, benchmark

pytestmark = pytest.mark.skipif(
    not BENCHMARKS.is_dir(), reason="benchmarks are in the repository, not in what is built of it"
)


@pytest.fixture(scope="module")
def module() -> Any:
    """The benchmark."""
    return benchmark("equal_margins")


def test_all_learners_can_be_made(module: Any) -> None:
    """Those of the classes are among them."""
    named = {label for each in module.CLASSES.values() for label in each.learners}
    assert named <= set(module.LEARNERS)
    for make in module.LEARNERS.values():
        make()


def test_a_seed_draws_its_loads_and_another_one_others(module: Any) -> None:
    """The judging seeds are none of the tuning seeds; what changes does so at thirds of the run."""
    t = module.DT * np.arange(3_000)
    one, same, other = (module.signals(t, seed) for seed in (1, 1, 2))
    assert set(one) == {*module.CLASSES, *module.UNTOLD}
    assert not set(module.TUNING_SEEDS) & set(range(1, 6))
    for load, (r, w) in one.items():
        np.testing.assert_array_equal(w, same[load][1])
        assert np.any(w != other[load][1]) or np.any(r != other[load][0])
    _, changing = one["changing"]
    np.testing.assert_array_equal(changing[:999], one["sinusoid"][1][:999])
    np.testing.assert_array_equal(changing[-999:], one["two sinusoids"][1][-999:])


def test_what_a_run_left_is_measured_as_the_page_says(module: Any) -> None:
    """Of an error that decays: late is the last fifth, after the end of the last window above a tenth."""
    machine = module.Machine("axis", 100.0, 20.0)
    y = np.exp(-machine.t / 4.0)
    machine.error = lambda load, controller, seed: (y, None)
    machine.reference = lambda load, seed: 1.0
    machine.peaks = lambda controller, run=None: (1.5, 50.0)
    found = machine.result("steps", None, 1)
    assert found.late == pytest.approx(np.sqrt(np.mean(y[-2000:] ** 2)), rel=1e-2)
    # exp(−t/4) is 0.1 at 9.2 s, and the window from 8 s to 10 s is above that.
    assert found.after == pytest.approx(10.0)
    assert found.largest == 1.0
    assert machine.keeps([found])
    assert not machine.keeps([found, found._replace(m_s=2.03)])


@pytest.mark.parametrize(("plant", "integrators"), [("axis", 1), ("axis", 3), ("lagged", 2)])
def test_the_responses_of_the_independent_designer_are_those_of_its_controller(
    module: Any, plant: str, integrators: int
) -> None:
    """M_s and M_ks agree with ``analyse``, which knows the controller's matrices alone."""
    search = benchmark("independent_linear").FreePoles(plant, integrators)
    starts = {"axis": (3.4, 0.7, 3.4, 0.7, 4.3), "lagged": (3.4, 0.7, 4.0, 3.4, 0.7, 4.3, 0.7)}
    rest = {1: (), 3: (0.7, 5.0), 2: (5.0,)}[integrators]
    x = np.array([*starts[plant], *rest])
    loop = analyse(module.Machine(plant, 100.0, 1.0).linear, search.controller(x))
    C = search.feedback(x, search.omega)
    S = 1.0 / (1.0 + search.of_plant * C)
    assert loop.stable
    assert 1.0 / loop.margins.modulus == pytest.approx(np.max(np.abs(S)), rel=2e-3)
    assert loop.noise_to_control_peak == pytest.approx(np.max(np.abs(C * S)), rel=2e-3)
