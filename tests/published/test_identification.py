"""Peers: nfoursid (subspace identification) and jax-sysid find the same plant in the same record."""

from __future__ import annotations

import numpy as np
import pytest

import quell as ql
from quell.identification import excitation
from tests.test_identification import answer

pytestmark = pytest.mark.compiled

DT = 0.02
PLANT = ([2.0], [1.0, 0.6, 9.0])
POLE = -0.3 + np.sqrt(9.0 - 0.09) * 1j


@pytest.fixture(scope="module")
def record() -> tuple[np.ndarray, np.ndarray]:
    """A minute of a resonance with white noise, a hundredth of a unit."""
    u = excitation("prbs", (0.3, 40.0), 60.0, DT).u
    return u, answer(PLANT, u, DT) + 0.01 * np.random.default_rng(3).standard_normal(u.size)


def continuous(A: np.ndarray) -> complex:
    """Return the pole in the upper half plane of a sampled model."""
    poles = np.log(np.linalg.eigvals(A).astype(complex)) / DT
    return complex(poles[np.argmax(poles.imag)])


@pytest.mark.trial
def test_nfoursid_finds_the_same_pole_and_gain(record: tuple[np.ndarray, np.ndarray]) -> None:
    """Within 1 %; output error is the nearer one, as it should be with white noise, and within its own deviations of the truth."""
    pandas = pytest.importorskip("pandas")
    nfoursid = pytest.importorskip("nfoursid.nfoursid")
    u, y = record
    peer = nfoursid.NFourSID(
        pandas.DataFrame({"u": u, "y": y}),
        output_columns=["y"],
        input_columns=["u"],
        num_block_rows=20,
    )
    peer.subspace_identification()
    theirs, _ = peer.system_identification(rank=2)
    found = ql.identify(u, y, DT, order=2, held_out=0.0)
    ours = found.poles[0]
    pole = continuous(theirs.a)
    assert abs(pole - ours.value) < 0.01 * abs(POLE)
    assert abs(ours.value - POLE) < abs(pole - POLE)
    assert abs(ours.value.real - POLE.real) < 4.0 * ours.real_std
    assert abs(ours.value.imag - POLE.imag) < 4.0 * ours.imag_std
    gain = float((theirs.c @ np.linalg.solve(np.eye(2) - theirs.a, theirs.b) + theirs.d)[0, 0])
    assert gain == pytest.approx(found.num[-1] / found.den[-1], rel=0.02)


def test_jax_sysid_finds_the_same_pole(record: tuple[np.ndarray, np.ndarray]) -> None:
    """Within 1 %, by its L-BFGS search in discrete time."""
    models = pytest.importorskip("jax_sysid.models")
    u, y = record
    peer = models.LinearModel(2, 1, 1)
    peer.loss(rho_x0=1e-6, rho_th=1e-8)
    peer.optimization(lbfgs_epochs=2000)
    peer.fit(y[:, None], u[:, None])
    assert abs(
        continuous(np.asarray(peer.ssdata()[0])) - ql.identify(u, y, DT, order=2).poles[0].value
    ) < 0.01 * abs(POLE)
