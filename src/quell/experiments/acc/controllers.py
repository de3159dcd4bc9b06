"""Controllers for the ACC benchmark: ours, each fixed for all plants, and the published ones.

Ours have one rule. The impulse gives m2 a momentum of 1 N s; u = ±0.5 N takes at least 2 s to
absorb it, and as long again to bring the masses back. That leaves a linear law about ten of the
fifteen seconds. Four poles at ``omega_c`` go from 1 to 0.1 in ``6.7/omega_c``, so ``omega_c = 1
rad/s`` takes seven of them and leaves room for a plant slower than nominal. The observer is ten
times as fast. ``b0`` is 1.5 times the nominal gain ``k/(m1 m2) = 1``: a loop with light masses or a
strong actuator, whose gain is above nominal, is lost sooner than one whose gain is below.
``docs/acc`` shows how little the failure rate changes around these values, and on which plants they
were chosen: drawn ones, up to three times as uncertain as the published.

``FREED`` is an MF-ESO whose law and observer have poles of their own, found by simulation for a box
of plants (``acc.box``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from quell.controllers import ADRC, Controller
from quell.experiments.compare.benchmark import controller
from quell.guard import Guard
from quell.learners import Harmonic, Kalman
from quell.observers import ESO
from quell.plants import two_mass_spring

MF, MB, L = OURS = "MF-ESO", "MB-ESO", "L-ESO"
OMEGA_C, OMEGA_O, B0 = 1.0, 10.0, 1.5
FREED = "MF-ESO, own poles"
# Found by ``python benchmarks/acc_box.py --tune 900 --plants 400``, rounded to four digits.
_FREED_B0, _FREED_OMEGA_C, _FREED_OMEGA_O = 1.817, 1.010, 17.82
_FREED_LAW = ((-0.9649, 0.7789), (-0.7764, 0.2179))
_FREED_OBSERVER = (-1.210, -1.768, -0.2115, (-0.4683, 1.411))
MOST_U = 0.5  # limit of ``|u|`` [N], of Rocchetta, Crespo & Kenny (DSCC 2019)
DT = 0.01  # sample time [s]: chosen by hand, omega_o dt = 0.1

BASELINES = {
    "PID": "pid",
    "PI with notch": "pi-notch",
    "LQG": "lqg",
    "resonance ratio": "resonance-ratio",
}
"""Controllers of ``quell compare``, for the nominal plant; not tuned for this benchmark."""


class TransferFunction(NamedTuple):
    """``u = −num(s)/den(s) y``, highest power first."""

    num: tuple[float, ...]
    den: tuple[float, ...]


PUBLISHED = {
    "published nominal": TransferFunction(
        (-0.1324, 0.3533, 0.6005, 0.0728), (0.5503, 1.4175, 2.6531, 2.4802, 1.0)
    ),
    "published SP1(0.05)": TransferFunction(
        (-0.02764507, 0.61323392, 0.52830290, 0.07321506),
        (0.58586517, 1.35042413, 2.51075570, 2.17663966, 0.82701801),
    ),
    "published SP2": TransferFunction(
        (-0.08314553, 0.63578454, 0.77522224, 0.09814777),
        (0.76003349, 1.94907798, 3.04966829, 2.73439891, 1.05935063),
    ),
}
"""Rocchetta, Crespo & Kenny (DSCC 2019): the nominal design, two by scenario optimisation."""


def designs(
    dt: float = DT,
    omega_c: float = OMEGA_C,
    omega_o: float = OMEGA_O,
    b0: float = B0,
    *,
    most_u: float = MOST_U,
    load: float | None = None,
) -> dict[str, Controller]:
    """Return baselines and our controllers by name, with sample time ``dt`` and ``|u| <= most_u``.

    MF-ESO knows the plant's order and gain, MB-ESO the nominal masses and spring. L-ESO knows as
    much as MF-ESO and learns during control, with a guard. None knows the actuator's lag. The
    three numbers are not those of ``FREED``. With a sinusoidal ``load`` of known frequency [rad/s]
    L-ESO learns the load too, and has no guard: after a load that begins with a jolt, the guard
    would keep it from learning for more than a minute.
    """
    model_free = ESO.model_free(order=4, b0=b0, omega_o=omega_o, dt=dt)
    model_based = ESO.model_based(two_mass_spring(), omega_o=omega_o, dt=dt, b0=b0)
    learner = Kalman() if load is None else Harmonic(omegas=(load,), bias_bandwidth=2.0)
    guard = Guard() if load is None else None
    limits: dict[str, Any] = {"u_min": -most_u, "u_max": most_u}
    baselines = {name: controller(key, dt, most_u) for name, key in BASELINES.items()}
    return baselines | {
        MF: ADRC(model_free, omega_c, **limits),
        MB: ADRC(model_based, omega_c, **limits),
        L: ADRC(model_free, omega_c, learner=learner, guard=guard, **limits),
        FREED: freed(dt, most_u),
    }


def freed(dt: float = DT, most_u: float = MOST_U) -> ADRC:
    """Return the MF-ESO with poles of its own, tuned by simulation for the box of plants."""
    bandwidth = (_FREED_B0, _FREED_OMEGA_O)
    observer = ESO.model_free(4, *bandwidth, dt, poles=_FREED_OBSERVER)
    limits: dict[str, Any] = {"u_min": -most_u, "u_max": most_u}
    return ADRC(observer, _FREED_OMEGA_C, law_poles=_FREED_LAW, **limits)
