"""``benchmarks/equal_margins.py``: the linear controller that is tuned for a load keeps the bounds of all others."""

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


def peaks_of(search: Any, x: Any) -> tuple[float, float]:
    """Return M_s and M_ks of the search's own responses."""
    C = search.feedback(x, search.omega)
    S = 1.0 / (1.0 + search.of_plant * C)
    return float(np.max(np.abs(S))), float(np.max(np.abs(C * S)))


@pytest.mark.parametrize("plant", ["axis", "lagged"])
def test_the_responses_of_the_search_are_those_of_its_controller(module: Any, plant: str) -> None:
    """M_s and M_ks agree with ``analyse``, which knows the controller's matrices alone."""
    search = module.TunedForLoad(plant, 2.0, 100.0)
    x = np.array(module.STARTS[search.order])
    loop = analyse(module.Machine(plant).linear, search.controller(x))
    m_s, m_ks = peaks_of(search, x)
    assert loop.stable
    assert 1.0 / loop.margins.modulus == pytest.approx(m_s, rel=1e-3)
    assert loop.noise_to_control_peak == pytest.approx(m_ks, rel=1e-3)


@pytest.mark.trial
@pytest.mark.parametrize("load", ["sinusoid", "spring", "noise"])
def test_it_keeps_the_bounds_and_leaves_less_of_the_load_than_its_start(
    module: Any, load: str
) -> None:
    """For the axis; the response to the load is that of ``analyse``'s loop."""
    t = module.DT * np.arange(20_001)
    omega, power = module.spectrum(load, *module.signals(t)[load])
    search = module.TunedForLoad("axis", 2.0, 100.0)
    start = search.controller(np.array(module.STARTS[2]))
    found = search.tuned(omega, power)
    plant = module.Machine("axis").linear
    left = []
    for controller in (start, found):
        loop = analyse(plant, controller)
        response = loop.response("PS", omega)
        left.append(np.sum(power * np.abs(response) ** 2))
    assert 1.0 / loop.margins.modulus <= 2.002
    assert loop.noise_to_control_peak <= 100.1
    assert left[1] < left[0]
