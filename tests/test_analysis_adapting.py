"""Margins of loops whose learner goes on adapting."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import quell as ql
from quell import analysis
from quell.analysis import linearise
from quell.learners import RLS, BatchGradient, Harmonic, Kalman, Repetitive

from .analysed_loops import PLANT, adrc, chain

DT, OMEGA_C = 0.01, 2.0
# Its first disturbance acts as u does.
LOADED = ql.plants.LinearPlant(PLANT.A, PLANT.B, PLANT.C, PLANT.B)


def controller(learner: Any) -> ql.ADRC:
    """Return an ADRC for ``LOADED``."""
    observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=12.0, dt=DT)
    return ql.ADRC(observer, omega_c=OMEGA_C, learner=learner)


def run(learner: Any, omega: float, size: float, level: float = 0.0) -> ql.Trajectory:
    """Return a run with a sinusoid of u from 40 s on, after training and rest at ``level``."""
    t = DT * np.arange(8001)
    r = np.where(t < 20.0, np.sin(t) + np.sin(2.7 * t), level)
    d = np.where(t >= 40.0, size * np.sin(omega * (t - 40.0)), 0.0)
    if isinstance(learner, Harmonic):  # else its oscillator follows the small sinusoid
        d += np.sin(t)
    signals = ql.signals.Samples(t, r), ql.signals.Samples(t, d)
    noise = ql.signals.BandLimitedNoise(power=1e-12, sample_time=DT)
    scenario = ql.Scenario(signals[0], disturbances=(signals[1],), noise=noise, duration=80.0)
    return ql.simulate(LOADED, controller(learner), scenario)


@pytest.mark.trial
@pytest.mark.parametrize(
    ("make", "level"),
    [
        (Kalman, 0.0),
        (Kalman, 1.5),
        (Harmonic, 0.0),
        (lambda: BatchGradient(rate=3e-4), 0.0),
        (lambda: BatchGradient(rate=3e-4, u=False), 0.0),
        # Beside x1 = 1.5 the bias is less than a third of what adapts.
        (lambda: BatchGradient(rate=3e-4, u=False), 1.5),
    ],
)
def test_the_sensitivity_is_that_of_the_running_loop(make: Any, level: float) -> None:
    """``|u/d|`` of a small sinusoid that is added to u after training, at the peak and beside it; the frozen learner's is another one."""
    trained = run(make(), 1.0, 0.0, level)
    loop = analysis.analyse(LOADED, controller(make()), at=trained)
    still = analysis.frozen(controller(make()), trained)
    frozen = analysis.analyse(LOADED, controller(make()), at=still)
    peak = loop.margins.modulus_omega
    for omega in (0.7 * peak, peak):
        size = 1e-4
        one, other = (run(make(), omega, sign * size, level) for sign in (1.0, -1.0))
        late = one.t >= 80.0 - 2.0 * np.pi / omega * int(20.0 * omega / (2.0 * np.pi))
        turned = np.exp(-1j * omega * (one.t[late] - 40.0))
        d = size * np.sin(omega * (one.t[late] - 40.0))
        u = 0.5 * (one["u"] - other["u"])[late]
        measured = abs(1.0 + np.mean(u * turned) / np.mean(d * turned))
        assert abs(loop.response("S", np.array([omega]))[0]) == pytest.approx(measured, rel=0.02)
    assert loop.margins.modulus < frozen.margins.modulus


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_bias_is_an_integrator_beside_the_observers(order: int) -> None:
    """The loop has two of them: S falls with the square of the frequency; without a bias with the frequency."""
    slopes = []
    for learner in (Kalman(state=False), ql.learners.NoLearner()):
        loop = analysis.analyse(chain(order), adrc(order, learner=learner))
        low, high = np.abs(loop.response("S", np.array([1e-4, 1e-3])))
        slopes.append(np.log10(high / low))
    assert slopes == pytest.approx([2.0, 1.0], abs=1e-2)


def test_an_oscillator_is_a_resonance() -> None:
    """Nothing of a load at its frequency is left, without a bias a constant load leaves as much as without learner."""
    learner = Harmonic(bias=False, omegas=(0.7,))
    loop = analysis.analyse(chain(2), adrc(2, learner=learner))
    S = np.abs(loop.response("S", np.array([0.7 * 0.9, 0.7 * (1.0 + 1e-7), 0.7 * 1.1])))
    assert S[1] < 1e-5 * min(S[0], S[2])


def test_two_oscillators_at_one_frequency_are_one() -> None:
    """Their difference shows nowhere, so it is no pole of the loop on the border of stability."""
    found = []
    for omegas in ((0.7, 0.7), (0.7, 0.7 * (1.0 + 1e-8)), (0.7, 0.7 * (1.0 + 1e-4))):
        loop = analysis.analyse(chain(2), adrc(2, learner=Harmonic(count=2, omegas=omegas)))
        assert loop.stable
        found.append(loop.margins.modulus)
    assert found == pytest.approx([found[0]] * 3, rel=1e-3)


@pytest.mark.parametrize("bandwidth", [0.1, 3.0, 12.0])
def test_the_steady_gain_of_the_bias_follows_its_bandwidth(bandwidth: float) -> None:
    """It is the root of the scalar Riccati equation, ``P² = Q dt (P + 1/dt)``, about λ dt."""
    learner = controller(Kalman(bias_bandwidth=bandwidth))
    Q = bandwidth**2 * DT
    P = 0.5 * (Q + np.sqrt(Q**2 + 4.0 * Q / DT))
    assert analysis.adapting(learner).rates.level == pytest.approx(P / (P + 1.0 / DT), rel=1e-4)


def test_a_guard_without_authority_leaves_the_loop_of_the_observer() -> None:
    """A new guarded learner has none yet."""
    observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=12.0, dt=DT)
    guarded = ql.ADRC(observer, omega_c=OMEGA_C, learner=Kalman(), guard=ql.Guard())
    plain = analysis.analyse(LOADED, ql.ADRC(observer, omega_c=OMEGA_C))
    assert analysis.analyse(LOADED, guarded).margins.modulus == plain.margins.modulus


@pytest.mark.trial
def test_the_authority_is_that_of_the_instant() -> None:
    """Early in a run a guard has granted less of it than at the end; that multiplies the bias, too."""
    observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=12.0, dt=DT)
    guarded = ql.ADRC(observer, omega_c=OMEGA_C, learner=Kalman(), guard=ql.Guard())
    scenario = ql.Scenario(ql.signals.Sinusoid(), duration=20.0)
    recorded = ql.simulate(LOADED, guarded, scenario)
    for t in (1.0, 20.0):
        found = analysis.adapting(guarded, recorded, t).known
        assert found.authority == recorded["authority"][round(t / DT)]
    assert recorded["authority"][round(1.0 / DT)] < recorded["authority"][-1]


def test_slow_oscillators_take_longer_steps_to_the_same_gains(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The equation is one of densities; steps a tenth as many as the samples change the gains by less than 2 %."""
    learner = controller(Harmonic(omegas=(0.5,)))
    fine = analysis.adapting(learner).rates
    monkeypatch.setattr(linearise, "_MOST_STEPS", 400)
    linearise._averaged_gains.cache_clear()
    coarse = analysis.adapting(learner).rates
    linearise._averaged_gains.cache_clear()
    assert coarse.level == pytest.approx(fine.level, rel=0.02)
    assert not np.array_equal(coarse.drive, fine.drive)
    np.testing.assert_allclose(coarse.drive, fine.drive, atol=0.03 * np.max(np.abs(fine.drive)))


def test_a_learner_whose_adaptation_is_not_known_is_named() -> None:
    """A line begins with NOT; a frozen one is what was asked for."""
    repetitive = controller(Repetitive(period=1.0))
    assert "NOT in these margins: how Repetitive adapts" in repr(
        analysis.analyse(LOADED, repetitive)
    )
    still = analysis.frozen(repetitive)
    assert "NOT" not in repr(analysis.analyse(LOADED, repetitive, at=still))


@pytest.mark.trial
def test_advise_tells_what_a_bias_takes_of_the_margin() -> None:
    """With the bandwidth that it names M_s is at its limit; below the limit nothing is said."""
    plant = ql.plants.two_mass_spring()
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=1e-3)

    def found(learner: Any) -> list[analysis.Finding]:
        every = analysis.advise(ql.ADRC(observer, omega_c=1.0, learner=learner), plant)
        return [each for each in every if each.subject == "learner"]

    (finding,) = found(Kalman())
    assert finding.value == pytest.approx(4.03, abs=0.01)
    named = float(finding.message.split("bias_bandwidth = ")[1].split()[0])
    slow = ql.ADRC(observer, omega_c=1.0, learner=Kalman(bias_bandwidth=named))
    assert 1.0 / analysis.analyse(plant, slow).margins.modulus == pytest.approx(
        finding.limit, rel=2e-3
    )
    assert found(Kalman(bias_bandwidth=0.9 * named)) == []
    assert found(ql.learners.NoLearner()) == []


def trained(law: Any) -> Any:
    """Return a controller of one axis or two after 15 s on a plant for each, sample by sample."""
    count = getattr(law, "outputs", 1)
    x, B = np.zeros((count, 2)), np.ravel(PLANT.B)
    for k in range(1500):
        r = np.sin(DT * k) + np.sin(2.7 * DT * k)
        u = np.atleast_1d(law.step([r] * 2, x[:, 0]) if count == 2 else law.step(r, x[0, 0]))
        x = x + DT * (x @ np.asarray(PLANT.A).T + np.outer(u, B))
    return law


def test_the_summary_says_what_it_assumes_of_a_learner_with_a_gate_of_noise() -> None:
    """And the margin without: that of a loop whose learner feeds back nothing that it learned; not for one that has learned nothing, and not for ``Kalman``."""
    law = trained(controller(RLS()))
    found = analysis.adapting(law)
    assert np.any(found.known.gain)
    nothing = linearise.Frozen(np.zeros(3), 0.0, 0.0)
    alone = analysis.analyse(LOADED, law, at=found._replace(known=nothing))
    said = analysis.analyse(LOADED, law).summary()
    assert "assumed of RLS: all signals move by more than the noise." in said
    assert f"the modulus margin is {alone.margins.modulus:.3f}" in said
    for other in (controller(RLS()), controller(Kalman())):
        assert "assumed" not in analysis.analyse(LOADED, other).summary()
    assert "assumed" not in analysis.analyse(LOADED, law, at=analysis.frozen(law)).summary()
    assert "assumed" not in alone.summary()


@pytest.mark.trial
def test_the_summary_of_several_axes_says_it_of_each() -> None:
    """With M_s of the whole loop without what the axes have learned."""
    A, B = np.kron(np.eye(2), PLANT.A), np.kron(np.eye(2), np.reshape(PLANT.B, (2, 1)))
    plant = ql.plants.LinearPlant(A, B, np.eye(4)[::2])

    def joint() -> ql.ADRC:
        observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=12.0, dt=DT)
        return ql.ADRC(observer, omega_c=OMEGA_C, learner=RLS())

    axes = ql.Axes({"x": joint(), "y": joint()}, B0=2.0 * np.eye(2))
    assert "assumed" not in analysis.analyse(plant, axes).remark
    said = analysis.analyse(plant, trained(axes)).remark
    assert "assumed of RLS of x, RLS of y: all signals move by more than the noise." in said
    alone = analysis.analyse(LOADED, trained(controller(RLS()))).without_learned
    assert alone is not None
    assert f"M_s is {1.0 / alone[1].margins.modulus:.2f}" in said
