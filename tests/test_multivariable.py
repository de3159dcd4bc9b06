"""Loops of several inputs and outputs: sensitivities, margins, disk margins, poles."""

from __future__ import annotations

import itertools
from typing import Any

import control
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import quell as ql
from quell import analysis
from quell.analysis.disk import best_scales, worst_change
from quell.analysis.multivariable import MultivariableLoop
from quell.features import AllAxes, Bias, State
from quell.kernels.dispatch import as_python
from quell.lti.models import zero_order_hold

DT = 1e-3


def lqg(rng: np.random.Generator, m: int, p: int, n: int = 4, delay: int = 0) -> MultivariableLoop:
    """Return a random stable loop: a sampled plant, its inputs late by samples, and LQG with r."""
    A = rng.normal(size=(n, n)) * 3.0 - np.eye(n)
    B, C = rng.normal(size=(n, m)), rng.normal(size=(p, n))
    A, (B,) = zero_order_hold(A, [B], 0.01)
    for _ in range(delay):
        k = A.shape[0]
        A = np.block([[A, B], [np.zeros((m, k + m))]])
        B, C = np.vstack([np.zeros((k, m)), np.eye(m)]), np.hstack([C, np.zeros((p, m))])
    k = A.shape[0]
    X = solve_discrete_are(A, B, C.T @ C + 1e-6 * np.eye(k), 0.01 * np.eye(m))
    F = np.linalg.solve(0.01 * np.eye(m) + B.T @ X @ B, B.T @ X @ A)
    Y = solve_discrete_are(A.T, C.T, B @ B.T + 1e-6 * np.eye(k), 1e-4 * np.eye(p))
    L = A @ Y @ C.T @ np.linalg.inv(C @ Y @ C.T + 1e-4 * np.eye(p))
    law = (A - B @ F - L @ C, L, B, -F, np.zeros((m, p)), np.eye(m))
    return MultivariableLoop((A, B, C), law, 0.01)


def in_control(loop: MultivariableLoop) -> tuple[Any, Any]:
    """Return plant and C_y of a loop as systems of python-control; u = −C_y y."""
    N, B, C, D = loop.plant
    plant = control.ss(N + np.eye(N.shape[0]), B, C, D, loop.dt)
    law = loop.law
    return plant, control.ss(law.A, law.B_y, -law.C, -law.D_y, loop.dt)


@pytest.mark.trial
@pytest.mark.parametrize("seed", range(8))
def test_sensitivities_are_those_of_python_control_and_of_a_dense_grid(seed: int) -> None:
    """S and T at both places to 1e-8; the largest singular value of S to 1e-6 of a dense grid."""
    rng = np.random.default_rng([61, seed])
    m, p, delay = (int(rng.integers(*limits)) for limits in ((1, 4), (1, 4), (0, 7)))
    loop = lqg(rng, m, p, delay=delay)
    plant, C_y = in_control(loop)
    dense = np.geomspace(1e-3, np.pi / loop.dt * (1 - 1e-9), 6_000)
    for name, L, size in (("S_o", plant * C_y, p), ("S_i", C_y * plant, m)):
        S = control.feedback(control.ss([], [], [], np.eye(size), loop.dt), L)
        few = dense[::800]
        expected = np.moveaxis(S(np.exp(1j * few * loop.dt), squeeze=False), -1, 0)
        np.testing.assert_allclose(loop.response(name, few), expected, atol=1e-8)
        np.testing.assert_allclose(
            loop.response(name.replace("S", "T"), few), np.eye(size) - expected, atol=1e-8
        )
        theirs = control.singular_values_response(S, dense).magnitude
        theirs = theirs.reshape(-1, dense.size)[0]
        found = loop.peak(name)
        assert np.max(theirs) * (1.0 - 1e-9) <= found.value
        at = control.singular_values_response(S, np.array([found.omega])).magnitude.max()
        assert found.value == pytest.approx(at, rel=1e-6)
        near = dense[np.argmax(theirs)] * np.linspace(0.999, 1.001, 4_001)
        near = near[near * loop.dt <= np.pi]
        own = np.linalg.svd(loop.response(name, near), compute_uv=False)[:, 0]
        assert found.value == pytest.approx(max(np.max(own), np.max(theirs)), rel=1e-6)


def test_one_input_and_one_output_have_the_margins_of_their_loop() -> None:
    """All numbers of ``analyse``: gain, phase, modulus, delay, disk, at the input and the output."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=40.0, dt=DT)
    plant = ql.plants.delayed(ql.plants.LinearPlant.of(([1.3], [1.0, 0.4, 0.0])), 0.012, DT)
    single = analysis.analyse(plant, ql.ADRC(observer, omega_c=8.0))
    N, B, C = single.plant.N, single.plant.B, single.plant.C
    law = analysis.axes_law([single.law], [[1.0]])
    loop = MultivariableLoop((N + np.eye(N.shape[0]), B[:, None], C[None]), law, DT)
    for channel in ("u1", "y1"):
        found = loop.channel_margins(channel)
        for ours, theirs in zip(found, single.margins, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    for at in ("inputs", "outputs"):
        disk = loop.disk_margin(at)
        assert disk.alpha == pytest.approx(single.margins.disk, rel=1e-8)
        assert disk.unstructured == pytest.approx(single.margins.disk, rel=1e-8)
        np.testing.assert_allclose(disk.gain, single.margins.disk_gain, rtol=1e-8)
        assert disk.phase == pytest.approx(single.margins.disk_phase, rel=1e-8)
        assert 1.0 / loop.m_s(at).value == pytest.approx(single.margins.modulus, rel=1e-8)
    omega = np.array([0.3, 8.0, 90.0])
    for name, other in (("PS", "PS"), ("CS", "CS"), ("T_o", "T"), ("S_i", "S")):
        np.testing.assert_allclose(
            loop.response(name, omega)[:, 0, 0], single.response(other, omega), rtol=1e-7
        )


def satellite() -> MultivariableLoop:
    """Return the spinning satellite with a = 10, ``T = [1, a; −a, 1]/(s + 1)``, sampled fast.

    From Skogestad & Postlethwaite, section 3.7.1, and Seiler, Packard & Gahinet, whose loops are in
    continuous time.
    """
    a, dt = 10.0, 1e-5
    A, (B,) = zero_order_hold(np.array([[0.0, a], [-a, 0.0]]), [np.eye(2)], dt)
    return MultivariableLoop(
        (A, B, np.array([[1.0, a], [-a, 1.0]])),
        (np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), -np.eye(2)),
        dt,
    )


@pytest.mark.trial
def test_the_spinning_satellite_has_margins_in_each_channel_and_none_in_both() -> None:
    """Closed forms: each channel 1/s; M_s = √(1 + a²), α = 4/(2a + √(4a² + 4)) for both."""
    loop = satellite()
    one = loop.channel_margins("u1")
    assert one.phase == pytest.approx(90.0, abs=0.1)
    assert one.gain[0] == 0.0
    assert one.gain[1] > 1e3
    assert one.disk == pytest.approx(2.0, rel=1e-3)
    for at in ("inputs", "outputs"):
        assert loop.m_s(at).value == pytest.approx(np.sqrt(101.0), rel=1e-3)
        assert loop.disk_margin(at).alpha == pytest.approx(4.0 / (20.0 + np.sqrt(404.0)), rel=1e-3)
        assert loop.disk_margin(at).omega == pytest.approx(0.05, rel=0.01)
    assert "all inputs at once: disk margin 0.100, gains 0.905 … 1.1 or phases ±5.7°" in str(loop)


@pytest.mark.trial
@pytest.mark.parametrize("seed", range(3))
def test_disk_margins_hold_and_their_factors_put_a_pole_on_the_unit_circle(seed: int) -> None:
    """With the factors that are given the loop has a pole at ω; inside of α it is stable."""
    rng = np.random.default_rng([62, seed])
    loop = lqg(rng, 2, 2, delay=int(rng.integers(0, 3)))
    A, (m, p) = loop.plant.N + np.eye(loop.plant.N.shape[0]), (2, 2)
    law = loop.law
    for at, skew in itertools.product(("inputs", "outputs", "both"), (0.0, 1.0, -0.6)):
        disk = loop.disk_margin(at, skew)
        assert disk.unstructured <= disk.alpha * (1.0 + 1e-9)
        assert disk.alpha <= disk.lost_at * (1.0 + 1e-9)
        if at != "both":
            assert disk.lost_at == pytest.approx(disk.alpha, rel=1e-4)
        channels = {"inputs": [0, 1], "outputs": [2, 3], "both": [0, 1, 2, 3]}[at]

        def poles(factors: Any, channels: Any = channels) -> Any:
            f = np.ones(m + p, dtype=complex)
            f[channels] = factors
            B, C = loop.plant.B * f[:m], loop.plant.C * f[m:, None]
            rows = [np.hstack([A + B @ law.D_y @ C, B @ law.C]), np.hstack([law.B_y @ C, law.A])]
            return np.linalg.eigvals(np.vstack(rows))

        on_circle = np.exp(1j * disk.omega * loop.dt)
        assert np.min(np.abs(poles(disk.factors) - on_circle)) < 1e-6
        for _ in range(30):
            size = disk.alpha * (1.0 - 1e-6) * np.sqrt(rng.uniform(size=len(channels)))
            delta = size * np.exp(2j * np.pi * rng.uniform(size=len(channels)))
            f = (1 + 0.5 * (1 - skew) * delta) / (1 - 0.5 * (1 + skew) * delta)
            assert np.max(np.abs(poles(f))) < 1.0
        for gains in itertools.product(*[disk.gain] * len(channels)):
            if np.all(np.isfinite(gains)):
                inside = 1.0 + (np.array(gains) - 1.0) * (1.0 - 1e-6)
                assert np.max(np.abs(poles(inside))) < 1.0
        for signs in itertools.product((-1.0, 1.0), repeat=len(channels)):
            turn = np.exp(1j * np.radians(disk.phase) * np.array(signs) * (1.0 - 1e-6))
            assert np.max(np.abs(poles(turn))) < 1.0


@pytest.mark.trial
def test_structured_margins_do_not_depend_on_units_and_singular_values_on_the_sizes_given() -> None:
    """Newtons and millinewton metres, metres and microradians: what is given, is taken out."""
    loop = lqg(np.random.default_rng(5), 2, 2)
    u, y = np.array([1.0, 1e3]), np.array([1e-6, 1e3])
    N, B, C, _ = loop.plant
    law = loop.law
    other = MultivariableLoop(
        (N + np.eye(4), B / u, C * y[:, None]),
        (law.A, law.B_y / y, law.C * u[:, None], law.D_y * u[:, None] / y),
        loop.dt,
        u_size=u,
        y_size=y,
    )
    for name in ("S_i", "S_o", "T_o", "S_b"):
        assert other.peak(name).value == pytest.approx(loop.peak(name).value, rel=1e-8)
    raw = MultivariableLoop(
        (N + np.eye(4), B / u, C * y[:, None]),
        (law.A, law.B_y / y, law.C * u[:, None], law.D_y * u[:, None] / y),
        loop.dt,
    )
    assert raw.m_s("outputs").value > 100.0 * loop.m_s("outputs").value
    for at in ("inputs", "outputs", "both"):
        assert raw.disk_margin(at).alpha == pytest.approx(loop.disk_margin(at).alpha, rel=1e-6)


@pytest.mark.trial
@pytest.mark.parametrize("c", [1, 2, 3, 4, 6])
def test_the_bound_on_mu_is_attained_for_up_to_three_channels(c: int) -> None:
    """Both bounds agree in any units; for more channels the upper one is above the lower one."""
    rng = np.random.default_rng(c)
    for _ in range(5):
        units = 10.0 ** rng.uniform(-5.0, 5.0, c)
        M = rng.normal(size=(c, c)) + 1j * rng.normal(size=(c, c))
        M = M * units[:, None] / units
        upper, D = best_scales(M)
        assert upper == pytest.approx(np.linalg.norm(D[:, None] * M / D, 2), rel=1e-9)
        alpha, delta = worst_change(M)
        assert np.max(np.abs(delta)) <= alpha * (1.0 + 1e-9)
        left = np.linalg.svd(np.eye(c) - D[:, None] * M / D * delta, compute_uv=False)[-1]
        assert left < 1e-6
        assert alpha * upper >= 1.0 - 1e-9
        if c <= 3:
            assert alpha * upper == pytest.approx(1.0, rel=1e-6)


def test_a_repeated_pole_is_one_with_its_multiplicity() -> None:
    """Five poles at 0.9998, which eigenvalues scatter beyond the unit circle, are one."""
    z = 0.9998
    A = z * np.eye(5) + np.diag(np.ones(4), 1)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(5, 5)))[0]
    A = turn @ A @ turn.T
    assert np.max(np.abs(np.linalg.eigvals(A))) > 1.0
    none = (np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.zeros((1, 1)))
    loop = MultivariableLoop((A, np.eye(5)[:, :1], np.eye(5)[:1]), none, DT)
    (pole,) = loop.poles
    assert pole.multiplicity == 5
    assert pole.z == pytest.approx(z, abs=1e-9)
    assert loop.stable


def test_poles_that_differ_stay_apart_and_delays_are_counted_at_zero() -> None:
    """A pair, a single pole and three samples of delay in a chain."""
    A = np.zeros((6, 6))
    A[:2, :2] = [[0.9, 0.1], [-0.1, 0.9]]
    A[2, 2], A[4, 3], A[5, 4] = 0.95, 1.0, 1.0
    none = (np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.zeros((1, 1)))
    loop = MultivariableLoop((A, np.ones((6, 1)), np.ones((1, 6))), none, DT)
    found = sorted((p.multiplicity, round(p.z.real, 9), round(p.z.imag, 9)) for p in loop.poles)
    assert found == [(1, 0.9, -0.1), (1, 0.9, 0.1), (1, 0.95, 0.0), (3, 0.0, 0.0)]


def test_a_pole_on_the_unit_circle_is_not_called_stable() -> None:
    """An integrator that nothing controls, single or double: a line that begins with NOT."""
    none = (np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.zeros((1, 1)))
    for A in (np.diag([1.0, 0.5]), np.array([[1.0, DT], [0.0, 1.0]])):
        loop = MultivariableLoop((A, np.ones((2, 1)), np.ones((1, 2))), none, DT)
        assert not loop.stable
        assert loop.summary().splitlines()[-1].startswith("NOT certain to be stable: a pole at")


def test_an_unstable_loop_has_no_margins_and_says_why() -> None:
    """Zeros, and infinite peaks."""
    loop = satellite()
    A = loop.plant.N + np.eye(2)
    law = (np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), np.eye(2))
    wrong = MultivariableLoop((A, loop.plant.B, loop.plant.C), law, loop.dt)
    assert wrong.m_s("inputs").value == np.inf
    assert wrong.disk_margin().alpha == 0.0
    assert wrong.channel_margins("y2").modulus == 0.0
    assert wrong.summary().startswith("unstable: a pole at |z| = 1.00001")


def test_the_closed_loop_is_that_of_a_simulation() -> None:
    """From r, d and n to y, u and e, sample by sample."""
    rng = np.random.default_rng(9)
    loop = lqg(rng, 2, 3, delay=1)
    N, B, C, _ = loop.plant
    law = loop.law
    law = law._replace(D_r=rng.normal(size=(2, 2)))
    loop = MultivariableLoop((N + np.eye(N.shape[0]), B, C), law, loop.dt)
    given = {"r": rng.normal(size=(30, 2)), "d": rng.normal(size=(30, 2))}
    given["n"] = rng.normal(size=(30, 3))
    x, xi = np.zeros(N.shape[0]), np.zeros(law.A.shape[0])
    y, u = np.zeros((30, 3)), np.zeros((30, 2))
    for k in range(30):
        y[k] = C @ x
        seen = y[k] + given["n"][k]
        u[k] = law.C @ xi + law.D_y @ seen + law.D_r @ given["r"][k]
        x = x + N @ x + B @ (u[k] + given["d"][k])
        xi = law.A @ xi + law.B_y @ seen + law.B_r @ given["r"][k]
    for target, expected in (("y", y), ("u", u)):
        total = np.zeros_like(expected)
        for source, signal in given.items():
            S = loop.closed_loop(source, target)
            state = np.zeros(S.N.shape[0])
            for k in range(30):
                total[k] += S.C @ state + S.D @ signal[k]
                state = state + S.N @ state + S.B @ signal[k]
        np.testing.assert_allclose(total, expected, atol=1e-9)
    with pytest.raises(ValueError, match="the law has 2 references for 3 outputs"):
        loop.closed_loop("r", "e")


def test_a_dead_time_of_each_channel_costs_no_states() -> None:
    """Responses through chains of delays equal those of the whole matrices."""
    loop = lqg(np.random.default_rng(3), 2, 2, delay=6)
    omega = np.array([0.1, 3.0, 50.0, 300.0])
    N, B, C, D = loop._broken()
    z = np.exp(1j * omega * loop.dt)
    expected = [C @ np.linalg.solve((w - 1) * np.eye(N.shape[0]) - N, B) + D for w in z]
    found = loop.response("S_b", omega) - np.eye(4)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_matrices_that_do_not_fit_are_refused_with_both_shapes() -> None:
    """The error says what rows and columns stand for."""
    A, B, C = np.eye(3) * 0.5, np.ones((3, 2)), np.ones((2, 3))
    none = (np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), np.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"B has shape \(2, 2\) and A has shape \(3, 3\)"):
        MultivariableLoop((A, B[:2], C), none, DT)
    with pytest.raises(ValueError, match=r"C has shape \(2, 2\) and A has shape \(3, 3\)"):
        MultivariableLoop((A, B, C[:, :2]), none, DT)
    with pytest.raises(ValueError, match=r"D = .*must be zero"):
        MultivariableLoop((A, B, C, np.ones((2, 2))), none, DT)
    with pytest.raises(ValueError, match=r"law: D_y has shape \(2, 3\).*must be \(2, 2\)"):
        MultivariableLoop((A, B, C), (*none[:3], np.zeros((2, 3))), DT)
    with pytest.raises(ValueError, match="u_size has 3 entries: must have 2"):
        MultivariableLoop((A, B, C), none, DT, u_size=[1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match=r"inputs = \['a', 'a'\]: must be 2 different names"):
        MultivariableLoop((A, B, C), none, DT, inputs=["a", "a"])
    loop = MultivariableLoop((A, B, C), none, DT, inputs=["yaw", "pitch"])
    with pytest.raises(ValueError, match="channel = 'u1': must be one of yaw, pitch, y1, y2"):
        loop.channel_margins("u1")
    with pytest.raises(ValueError, match=r"skew = 2.0: must be from -1 to 1"):
        loop.disk_margin(skew=2.0)
    observer = ql.ESO.model_free(order=1, b0=1.0, omega_o=10.0, dt=DT)
    single = analysis.linear_law(ql.ADRC(observer, omega_c=1.0))
    with pytest.raises(ValueError, match=r"B0 has shape \(1, 2\): must be \(1, 1\), a row for"):
        analysis.axes_law([single], [[1.0, 2.0]])
    with pytest.raises(ValueError, match="must have an inverse"):
        analysis.axes_law([single, single], [[1.0, 2.0], [2.0, 4.0]])


def joint(omega_o: float = 60.0) -> ql.ADRC:
    """Return the controller of a joint."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=omega_o, dt=DT)
    return ql.ADRC(observer, omega_c=8.0)


def test_axes_around_a_plant_are_the_loop_that_a_run_shows() -> None:
    """Poles and the closed loop of ``analyse`` are those of ``ql.simulate``, delays included."""
    true = np.array([[2.0, -0.9], [-0.9, 1.5]])
    plant = ql.plants.LinearPlant(
        np.kron(np.eye(2), [[0.0, 1.0], [0.0, -0.3]]),
        np.kron(true, [[0.0], [1.0]]),
        np.kron(np.eye(2), [[1.0, 0.0]]),
    )
    late = ql.plants.encoded_outputs(ql.plants.delayed_inputs(plant, [0.002, 0.004], DT), 0.0)
    axes = ql.Axes({"x": joint(), "y": joint(40.0)}, B0=1.2 * true)
    loop = analysis.analyse(late, axes)
    assert loop.stable
    assert loop.outputs == ("x", "y")
    run = ql.simulate(late, axes, ql.Scenario([0.3, -0.1], duration=0.2), interpret=True)
    system = loop.closed_loop("r", "y")
    x, y = np.zeros(system.N.shape[0]), []
    for _ in range(200):
        y.append(system.C @ x)
        x = x + system.N @ x + system.B @ [0.3, -0.1]
    np.testing.assert_allclose(run["y"][:200], y, atol=1e-9)


def test_the_margins_of_axes_with_the_true_b0_are_those_of_one_axis() -> None:
    """Whatever the inertia: one loop with b0 = 1, at every channel and for all at once."""
    true = np.array([[2.0, -0.9], [-0.9, 1.5]])
    A, B = np.kron(np.eye(2), [[0.0, 1.0], [0.0, 0.0]]), np.kron(true, [[0.0], [1.0]])
    loop = analysis.analyse((A, B, np.eye(4)[[0, 2]]), ql.Axes([joint(), joint()], true))
    single = analysis.analyse(([1.0], [1.0, 0.0, 0.0]), joint()).margins
    assert loop.disk_margin("inputs").alpha == pytest.approx(single.disk, rel=1e-6)
    assert loop.m_s("outputs").value == pytest.approx(1.0 / single.modulus, rel=1e-6)
    assert loop.channel_margins("u2").delay == pytest.approx(single.delay, rel=1e-6)


@pytest.mark.parametrize("b0", [2.0, -0.02])
def test_what_an_axis_has_learned_of_itself_is_in_its_margins(b0: float) -> None:
    """M_s is that of one controller that has learned the same, and not that of a new one."""
    A, B, C = np.array([[0.0, 1.0], [-40.0, -3.0]]), np.array([[0.0], [1.2 * b0]]), np.eye(2)[:1]
    Ad, (Bd,) = zero_order_hold(A, [B], 2e-3)

    def made() -> ql.ADRC:
        observer = ql.ESO.model_free(2, b0, 50.0, 2e-3)
        return ql.ADRC(observer, 10.0, learner=ql.learners.RLS())

    one, machine = made(), ql.Axes([made()])
    x, z = np.zeros(2), np.zeros(2)
    with as_python():
        for k in range(500):
            r = float(np.sin(0.006 * k) + 0.3 * np.sin(0.014 * k))
            x = Ad @ x + Bd.ravel() * one.step(r, float(x[0]))
            z = Ad @ z + Bd.ravel() * machine.step([r], z[:1])[0]
    learned = analysis.analyse((A, B, C), machine).m_s("inputs").value
    alone = analysis.analyse((A, B, C), one).margins.modulus
    new = analysis.analyse((A, B, C), ql.Axes([made()])).m_s("inputs").value
    assert learned == pytest.approx(1.0 / alone, rel=1e-6)
    assert abs(learned - new) > 0.01


@pytest.mark.trial
@pytest.mark.compiled
def test_an_arm_is_linearised_at_its_pose_and_b0_taken_there() -> None:
    """With M(q) the loop is that of one axis in every pose; with that of one pose it is not."""
    robot = ql.plants.arm(gravity=0.0)
    single = analysis.analyse(([1.0], [1.0, 0.0, 0.0]), joint()).margins
    follows = ql.Axes([joint(), joint()], M=robot.inertia)
    fixed = ql.Axes([joint(), joint()], M=robot.mass_matrix([0.0, 0.2]))
    for elbow in (0.2, 1.5, 2.8):
        pose = ([0.4, elbow, 0.0, 0.0], [0.0, 0.0])
        exact = analysis.analyse(robot, follows, pose)
        assert exact.disk_margin("inputs").alpha == pytest.approx(single.disk, rel=1e-4)
        off = analysis.analyse(robot, fixed, pose).disk_margin("inputs").alpha
        assert (off == pytest.approx(single.disk, rel=1e-4)) == (elbow == 0.2)
        found = analysis.coupling(robot, DT, operating_point=pose)
        M = robot.mass_matrix([0.4, elbow])
        assert found.factor == pytest.approx((M * np.linalg.inv(M).T)[0, 0], rel=1e-4)
    with pytest.raises(
        ValueError, match=r"is nonlinear: give the point .* operating_point=\(x, u\)"
    ):
        analysis.analyse(robot, follows)


def test_what_is_no_loop_of_axes_is_refused() -> None:
    """Options of one axis, sizes that do not fit, a plant of another sample time."""
    plant = (np.diag([-1.0, -2.0]), np.eye(2), np.eye(2))
    axes = ql.Axes([joint(), joint()])
    with pytest.raises(ValueError, match="delay = 0.01: of one axis only; give Axes a plant with"):
        analysis.analyse(plant, axes, delay=0.01)
    with pytest.raises(ValueError, match="actuator_lag = 0.1: of one axis only"):
        analysis.certify(plant, axes, actuator_lag=0.1)
    with pytest.raises(ValueError, match="at: of one axis only"):
        analysis.analyse(plant, axes, at=1.0)
    with pytest.raises(ValueError, match="plant has 2 inputs and 2 outputs: the controller has 1"):
        analysis.analyse(plant, ql.Axes([joint()]))
    sampled = control.ss(0.5 * np.eye(2), np.eye(2), np.eye(2), 0.0 * np.eye(2), 0.01)
    with pytest.raises(ValueError, match=r"plant is sampled with dt = 0.01 s, the controller with"):
        analysis.analyse(sampled, ql.Axes([joint(), joint()]))


DOUBLE = (np.kron(np.eye(2), [[0.0, 1.0], [0.0, 0.0]]), np.kron(np.eye(2), [[0.0], [1.0]]))


def two_masses(B: Any = None) -> ql.plants.LinearPlant:
    """Return two masses, which the matrix B couples."""
    inputs = DOUBLE[1] if B is None else np.kron(B, [[0.0], [1.0]])
    return ql.plants.LinearPlant(DOUBLE[0], inputs, np.eye(4)[[0, 2]])


def of_all(**parts: Any) -> Any:
    """Return a learner that sees all axes and has a bias."""
    return ql.learners.RLS(AllAxes(State()) + Bias(), **parts)


@pytest.mark.parametrize("each", [False, True])
def test_the_bias_of_a_learner_of_all_axes_is_in_the_margins(each: bool) -> None:
    """As that of a learner of the own axis: M_s is 2.07, and 1.53 without a bias."""
    observer = joint().observer
    own = ql.ADRC(observer, 8.0, learner=ql.learners.RLS(State() + Bias()))
    known = analysis.analyse(two_masses(), ql.Axes([own, own])).m_s("outputs").value
    learner = [of_all(), of_all()] if each else of_all()
    loop = analysis.analyse(two_masses(), ql.Axes([joint(), joint()], learner=learner))
    assert known == pytest.approx(2.067, abs=1e-3)
    assert loop.m_s("outputs").value == pytest.approx(known, rel=1e-9)
    assert not loop.remark


@pytest.mark.trial
@pytest.mark.parametrize("each", [False, True])
def test_a_learner_of_all_axes_at_rest_is_the_loop_that_a_run_shows(each: bool) -> None:
    """One that may learn no θ: the closed loop is that of ``ql.simulate``, the bias included."""
    true = np.array([[2.0, -0.9], [-0.9, 1.5]])
    learner = [of_all(prior=1e-9), of_all(prior=1e-9)] if each else of_all(prior=1e-9)
    axes = ql.Axes([joint(), joint()], 1.2 * true, learner=learner)
    scenario = ql.Scenario([ql.signals.Step(0.3, 0.5), ql.signals.Step(-0.1, 0.5)], duration=1.2)
    run = ql.simulate(two_masses(true), axes, scenario, interpret=True)
    system = analysis.analyse(two_masses(true), axes).closed_loop("r", "y")
    x, y = np.zeros(system.N.shape[0]), []
    for k in range(1200):
        y.append(system.C @ x)
        x = x + system.N @ x + system.B @ np.array([0.3, -0.1]) * (k >= 500)
    np.testing.assert_allclose(run["y"][:1200], y, atol=1e-6)


@pytest.mark.trial
@pytest.mark.parametrize("each", [False, True])
def test_what_was_learned_of_other_axes_is_named_as_not_in_the_margins(each: bool) -> None:
    """A learner that has learned nothing is all in them; after motion the summary says what lacks."""
    learner = [of_all(), None] if each else of_all()
    axes = ql.Axes({"x": joint(), "y": joint()}, 1.2 * np.eye(2), learner=learner)
    assert not analysis.analyse(two_masses(), axes).remark
    x = np.zeros(4)
    with as_python():
        for k in range(800):
            u = axes.step([0.3 * np.sin(0.01 * k), 0.2 * np.sin(0.013 * k)], x[[0, 2]])
            x[[0, 2]] += DT * x[[1, 3]]
            x[[1, 3]] += DT * (u - 20.0 * x[[2, 0]])
    loop = analysis.analyse(two_masses(), axes)
    named = "in x;" if each else "in x, y;"
    assert "NOT in these margins: what learners have learned from states of all axes" in loop.remark
    assert named in loop.summary()
    single = analysis.analyse(([1.0], [1.0, 0.0, 0.0]), axes.axes[0])
    assert "NOT in these margins: what the learner has learned from states" in single.summary()


def drive() -> ql.baselines.PID:
    """Return a drive of an axis."""
    return ql.baselines.PID(kp=200.0, ki=100.0, kd=20.0, tf=0.002, dt=DT)


def model_based() -> ql.Compensator:
    """Return a compensator that knows ``1/(s² + 20 s + 100)``."""
    observer = ql.ESO.model_based(([1.0], [1.0, 20.0, 100.0]), omega_o=60.0, dt=DT)
    return ql.Compensator(observer)


def test_drives_are_in_the_margins_of_axes() -> None:
    """Each loop is that of ``Compensated``; without drives the summary says that they lack."""
    lag = (np.kron(np.eye(2), [[0.0, 1.0], [-100.0, -20.0]]), DOUBLE[1], np.eye(4)[[0, 2]])
    single = analysis.analyse(
        ([1.0], [1.0, 20.0, 100.0]), ql.Compensated(drive(), model_based())
    ).margins
    parts = [model_based(), model_based()]
    loop = analysis.analyse(lag, ql.Axes(parts, drives=[drive(), drive()]))
    assert loop.m_s("inputs").value == pytest.approx(1.0 / single.modulus, rel=1e-6)
    assert not loop.remark
    alone = analysis.analyse(lag, ql.Axes(parts))
    assert abs(alone.m_s("inputs").value - loop.m_s("inputs").value) > 0.05
    assert "NOT in these margins: the loop that u_0 closes" in alone.summary()


@pytest.mark.parametrize("given", [True, False])
def test_axes_with_drives_are_the_loop_that_a_run_shows(given: bool) -> None:
    """With a B0 that is not diagonal; and from u_0 with three actuators for two axes."""
    true = np.array([[2.0, -0.9], [-0.9, 1.5]])
    observer = joint().observer
    if given:
        axes = ql.Axes([ql.Compensator(observer)] * 2, 1.2 * true, drives=[drive(), drive()])
    else:
        true = np.hstack([true, [[0.4], [0.3]]])
        axes = ql.Axes([ql.Compensator(observer)] * 2, 1.2 * true)
    r = np.array([0.3, -0.1] if given else [0.3, -0.1, 0.2])
    plant = two_masses(true)
    run = ql.simulate(plant, axes, ql.Scenario(r.tolist(), duration=0.2), interpret=True)
    system = analysis.analyse(plant, axes).closed_loop("r", "y")
    x, y = np.zeros(system.N.shape[0]), []
    for _ in range(200):
        y.append(system.C @ x)
        x = x + system.N @ x + system.B @ r
    np.testing.assert_allclose(run["y"][:200], y, atol=1e-9)


def test_a_drive_without_a_linear_law_is_not_judged() -> None:
    """A controller of a user, in whose place an ADRC that changes its b0 stands here."""
    axes = ql.Axes([model_based()] * 2, drives=[drive(), drive()])
    changing = ql.ADRC(joint().observer, 8.0, schedule=ql.OnlineGain(0.5, 2.0))
    axes.drives = (axes.drives[0], changing)
    with pytest.raises(ValueError, match="drives: axis2: NOT judged, it has no linear law"):
        analysis.analyse(two_masses(), axes)
