"""The empirical frequency response: local polynomials, periods, closed loops; quell identify --frequencies."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from quell.identification import excitation, frequency_response

from .commands import Shown

DT = 1e-3
TURN = 2.0 * np.pi
# A motor with its encoder before a flexible load: integrator, zeros at 60 Hz, poles at 80 Hz.
NUM = [1.0 / (TURN * 60.0) ** 2, 0.008 / (TURN * 60.0), 1.0]
DEN = np.polymul([1e-3, 1e-3, 0.0], [1.0 / (TURN * 80.0) ** 2, 0.008 / (TURN * 80.0), 1.0])
B, A, _ = cont2discrete((NUM, DEN), DT)


def exact(omega: Any) -> Any:
    """Return the response at the samples."""
    z = np.exp(1j * omega * DT)
    return np.polyval(B.ravel(), z) / np.polyval(A, z)


def answer(u: Any, noise: float = 1e-6, seed: int = 0) -> Any:
    """Return y with noise."""
    return lfilter(B.ravel(), A, u) + noise * np.random.default_rng(seed).standard_normal(u.size)


def values(count: int, of: int = 3) -> Any:
    """Return u of random signs."""
    return np.repeat(np.sign(np.random.default_rng(9).standard_normal(count // of + 1)), of)[:count]


def test_local_polynomials_show_a_resonance_and_an_integrator_that_averaged_spectra_blur() -> None:
    """Errors are of the size of the deviations, and the peak is at 80 Hz, also in a short record."""
    u = values(6000)
    y = answer(u)
    welch, local = (frequency_response(u, y, DT, method=method) for method in ("welch", "local"))
    error, blurred = (np.abs(one.response / exact(one.omega) - 1.0) for one in (local, welch))
    known = local.known & (local.frequency < 300.0)
    assert np.median((error / local.deviation)[known]) == pytest.approx(1.18, abs=0.3)
    near = np.abs(local.frequency - 80.0) < 4.0
    peak = local.frequency[near][np.argmax(np.abs(local.response[near]))]
    assert peak == pytest.approx(80.0, abs=0.2)
    assert np.median(error[near]) < 0.1 * np.median(blurred[np.abs(welch.frequency - 80.0) < 4.0])
    assert np.median(error[local.frequency < 2.0]) < 0.05


def test_periods_are_found_and_free_of_the_transient_of_the_start() -> None:
    """By ``auto``; at the lines of the multisine, with errors of the size of the deviations."""
    design = excitation("multisine", (6.0, 1200.0), 1.05, DT)
    u = np.tile(design.u, 6)[:-100]
    found = frequency_response(u, answer(u), DT, method="auto")
    assert found.method == "periods"
    error = np.abs(found.response / exact(found.omega) - 1.0)
    assert np.quantile(error, 0.9) < 0.02
    assert np.median(error / found.deviation) == pytest.approx(1.18, abs=0.4)
    with pytest.raises(ValueError, match="does not repeat itself three times"):
        frequency_response(values(3000), values(3000), DT, method="periods")


@pytest.mark.parametrize("periodic", [False, True])
def test_a_response_that_noise_hides_in_a_closed_loop_is_not_known(periodic: bool) -> None:
    """There the ratio is minus the inverse of the controller; what is known is right."""
    rng, count, a = np.random.default_rng(1), 6000, 0.98
    r = values(1000, 10) if periodic else values(count, 10)
    r = np.tile(r, count // r.size)
    x, v, u, y = 0.0, 0.0, np.zeros(count), np.zeros(count)
    for k in range(count):
        v = 0.9 * v + 0.1 * rng.standard_normal()
        y[k] = x + v
        u[k] = 3.0 * (r[k] - y[k])
        x = a * x + 0.02 * u[k]
    found = frequency_response(u, y, 0.01, reference=r, method="auto")
    assert found.method == ("periods" if periodic else "local")
    error = np.abs(found.response / (0.02 / (np.exp(0.01j * found.omega) - a)) - 1.0)
    assert 10 < np.sum(found.known) < 0.6 * found.omega.size
    assert np.quantile((error / found.deviation)[found.known], 0.9) < 4.0


def test_one_step_tells_no_response_from_the_transient() -> None:
    """It is refused, with what to record."""
    u = np.zeros(2000)
    u[100:] = 1.0
    with pytest.raises(ValueError, match="no frequency is told apart"):
        frequency_response(u, answer(u), DT, method="local")
    with pytest.raises(ValueError, match="must have at least 106"):
        frequency_response(u[:100], u[:100], DT, method="local", segments=2)


def test_the_command_prints_draws_and_writes_it(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """Options of a model are refused beside it."""
    u = values(3000)
    rows = np.column_stack([np.arange(u.size) * DT, u, answer(u)])
    np.savetxt(tmp_path / "axis.csv", rows, delimiter=",", header="t,u,y", comments="")
    shown = quell("identify", "axis.csv", "--frequencies", "--json", "g.json", "--figures", "seen")
    assert shown.code == 0, shown.err
    assert "coherence" in shown.out
    assert "by local polynomials" in shown.out
    assert (tmp_path / "g.json").is_file()
    assert (tmp_path / "seen" / "identified.png").is_file()
    refused = quell("identify", "axis.csv", "--frequencies", "--order", "2", "--no-figures")
    assert refused.code == 2
    assert "--order: is for a model" in refused.err
