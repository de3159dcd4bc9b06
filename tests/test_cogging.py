"""The scenarios of a servo with measured cogging (benchmarks/cogging.py); ``.ci/run`` judges what is learned in them."""

from __future__ import annotations

import numpy as np

from .benchmark_module import benchmark


def test_a_reference_of_new_speeds_has_the_derivatives_it_says() -> None:
    """By differences; the speed is reached half a second after each change."""
    speeds = benchmark("cogging").Speeds
    signal = speeds((1.0, -2.0, 0.5))
    t = np.arange(0.0, 15.0, 1e-3)
    for _ in range(2):
        slope = np.gradient(signal(t), t)
        away = np.min(np.abs(t[:, None] - np.array([0.0, 0.5, 5.0, 5.5, 10.0, 10.5])), axis=1)
        smooth = away > 2e-3
        np.testing.assert_allclose(slope[smooth], signal.derivative()(t)[smooth], atol=1e-6)
        signal = signal.derivative()
    assert speeds((1.0, -2.0, 0.5)).derivative()(np.array([4.0, 5.5, 9.0])).tolist() == [
        1.0,
        -2.0,
        -2.0,
    ]
