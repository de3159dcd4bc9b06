"""M_s of loops with a learner that goes on adapting: analysed against measured.

    python benchmarks/margins_with_learner.py [--loops 20] [--seed 1] [--learner NAME]

Each loop has a drawn plant (poles with a damping of 0 to 1, two to four integrations), a drawn
observer, model-free or model-based, and the learners. It is trained by a sinusoid of the reference,
comes to rest, and then a small sinusoid is added to u. For ``Harmonic`` a sinusoidal load keeps the
oscillator busy meanwhile: else the small sinusoid is what it learns. The same run with the opposite
sign, and the same noise, gives the response to the sinusoid: ``|S| = |u/d|`` at the frequency where
``analyse`` has its largest ``|S|``, and half an octave to either side.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from measured import options_of, parser_of, write

import quell as ql
from quell.analysis import LoopAnalysis, analyse
from quell.learners import NLMS, RLS, BatchGradient, Harmonic, Kalman

LEARNERS: dict[str, Callable[[], Any]] = {
    "Kalman": Kalman,
    "bias only": lambda: Kalman(state=False),
    "Harmonic": Harmonic,
    "RLS": RLS,
    "NLMS": NLMS,
    "Algorithm 1": lambda: BatchGradient(rate=1e-6),
}
# A learner's M_s is right within this share of the measured one.
BAR = 0.02
# Size of the load that keeps an oscillator busy, at half of omega_c [u-unit].
LOAD = 1.0
# The sinusoid takes this share of the training's u: small against what the learner has seen.
SMALL = 1e-4


def drawn(rng: np.random.Generator) -> tuple[ql.plants.LinearPlant, Callable[[Any], ql.ADRC]]:
    """Return a plant whose first disturbance acts as u does, and what makes its controller."""
    order = int(rng.integers(2, 5))
    omega_c = float(np.exp(rng.uniform(np.log(0.5), np.log(5.0))))
    poles = [0.0] * (order % 2)
    for _ in range(order // 2):
        size, damping = omega_c * float(rng.uniform(0.1, 1.5)), float(rng.uniform(0.0, 1.0))
        pair = size * (-damping + 1j * np.sqrt(1.0 - damping**2))
        poles += [pair, np.conj(pair)]
    den = np.real(np.poly(poles))
    b = float(np.exp(rng.uniform(-2.0, 2.0)))
    chain = ql.plants.LinearPlant.of(([b], den))
    plant = ql.plants.LinearPlant(chain.A, chain.B, chain.C, chain.B)
    ratio, dt = float(rng.uniform(4.0, 10.0)), float(rng.uniform(0.005, 0.05)) / omega_c
    has_model = bool(rng.integers(2))

    def make(learner: Any) -> ql.ADRC:
        omega_o = ratio * omega_c
        if has_model:
            observer = ql.ESO.model_based(chain, omega_o=omega_o, dt=dt)
        else:
            observer = ql.ESO.model_free(order=order, b0=b, omega_o=omega_o, dt=dt)
        return ql.ADRC(observer, omega_c=omega_c, learner=learner or ql.learners.NoLearner())

    return plant, make


def run(plant: Any, controller: ql.ADRC, omega: float, size: float) -> tuple[ql.Trajectory, float]:
    """Return a run with a sinusoid of u from the time that is returned, after training and rest."""
    dt, omega_c = controller.dt, controller.omega_c
    trained, begins = 40.0 / omega_c, 80.0 / omega_c
    last = begins + max(40.0 / omega_c, 60.0 / omega)
    t = dt * np.arange(round(last / dt) + 1)
    r = np.where(t < trained, np.sin(omega_c * t), 0.0)
    d = np.where(t >= begins, size * np.sin(omega * (t - begins)), 0.0)
    if isinstance(controller.learner, Harmonic):
        d += LOAD * np.sin(0.5 * omega_c * t)
    noise = ql.signals.BandLimitedNoise(power=1e-16 * dt, sample_time=dt)
    scenario = ql.Scenario(
        reference=ql.signals.Samples(t, r),
        disturbances=(ql.signals.Samples(t, d),),
        noise=noise,
        duration=float(t[-1]),
    )
    return ql.simulate(plant, controller, scenario), begins


def measured(plant: Any, controller: ql.ADRC, omega: float, size: float) -> float:
    """Return ``|S|`` at a frequency, from two runs."""
    (one, begins), (other, _) = (run(plant, controller, omega, sign * size) for sign in (1.0, -1.0))
    difference = (one["u"] - other["u"]) / (2.0 * size)
    turns = int(0.6 * (one.t[-1] - begins) * omega / (2.0 * np.pi))
    late = one.t >= one.t[-1] - 2.0 * np.pi * turns / omega
    turned = np.exp(-1j * omega * (one.t[late] - begins))
    d = np.sin(omega * (one.t[late] - begins))
    return float(abs(1.0 + np.mean(difference[late] * turned) / np.mean(d * turned)))


def peak(loop: LoopAnalysis) -> tuple[float, float]:
    """Return M_s and its frequency [rad/s]."""
    return 1.0 / loop.margins.modulus, loop.margins.modulus_omega


def main() -> None:
    """Print a row for each loop and learner, and the largest difference of each learner."""
    parser = parser_of(__doc__)
    parser.add_argument("--loops", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--learner", choices=LEARNERS)
    given = options_of(parser, loops=1, learner="Kalman")
    warnings.simplefilter("ignore")
    names = [given.learner] if given.learner else [*LEARNERS]
    missed: dict[str, list[float]] = {name: [] for name in names}
    for i in range(given.loops):
        plant, make = drawn(np.random.default_rng([given.seed, i]))
        without, _ = peak(analyse(plant, make(None)))
        for name in names:
            controller = make(LEARNERS[name]())
            trained, _ = run(plant, controller, 1.0, 0.0)
            if trained.diverged:
                print(f"{i:3d} {name:12} diverges in training")
                continue
            loop = analyse(plant, controller, at=trained)
            frozen, _ = peak(analyse(plant, controller, at=ql.analysis.frozen(controller, trained)))
            if not loop.stable:
                print(f"{i:3d} {name:12} is unstable at rest")
                continue
            m_s, omega = peak(loop)
            size = SMALL * float(np.sqrt(np.mean(trained["u"] ** 2)))
            sizes = [measured(plant, controller, omega * f, size) for f in (0.84, 1.0, 1.19)]
            missed[name].append(m_s / max(sizes) - 1.0)
            print(
                f"{i:3d} {name:12} M_s without {without:.3f}, frozen {frozen:.3f}, adapting "
                f"{m_s:.3f}, measured {max(sizes):.3f} ({100.0 * missed[name][-1]:+.2f} %)",
                flush=True,
            )
    figures: dict[str, object] = {}
    for name, each in missed.items():
        within = sum(abs(value) <= BAR for value in each)
        most = max(map(abs, each), default=0.0)
        figures[name] = {
            "loops": len(each),
            "within 2 %": within,
            "largest difference [%]": 100.0 * most,
            "median difference [%]": 100.0 * float(np.median(np.abs(each))) if each else "no loop",
        }
        print(
            f"{name:12} {within} of {len(each)} within {100.0 * BAR:.0f} %, largest difference "
            f"{100.0 * most:.2f} %"
        )
    write(given, figures)


if __name__ == "__main__":
    main()
