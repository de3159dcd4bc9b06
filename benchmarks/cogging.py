"""A servo with the measured cogging of a real motor: learners over time and over position.

    python benchmarks/cogging.py [FILE] [--only LEARNER] [--share 1]

FILE, ``../shared/data/cogging_a.csv`` by default, is a record of the current that holds a motor at
each encoder count over a revolution, with columns count and current [A] (gchenfc/ODrive,
analysis/cogging_torque, MIT). Its orders 7, 28, 14, 36, 12 and 84 hold 99.6 % of the power. The
motor is ``plants.dc_motor`` with its defaults, torque constant 0.05 N m/A, so up to 0.1 N m of
cogging beside 0.01 N m of Coulomb friction and J = 2e-4 kg m². The loop: dt = 1 ms, model-free ESO
of 150 rad/s, omega_c = 30 rad/s, feedforward of the reference's derivatives, encoder of 8192
counts. Scenarios, with the time that is judged:

=============  ====================================================================================
0.03 rev/s     100 s, from 50 s on
0.1 rev/s      60 s, from 30 s on
1 rev/s        20 s, from 10 s on
new speeds     ±0.03 to 0.3 rev/s, another one every five seconds: 120 s, from 30 s on
shift          0.1 rev/s, the map shifted by half a turn at 60 s: the worst window of ten observer
               lags after it, over MF-ESO's; and the revolutions until the RMS of the last
               revolution is within 10 % of that before
restart        the same, by a restart: at 60 s the motor stands at angle zero, where the encoder
               now shows half a turn; the controller starts from rest with what it has learned
=============  ====================================================================================

All figures are RMS errors of the position over that of MF-ESO (learner none, in mrad), with and
without guard. ``--share`` makes all runs shorter by this factor, 0.3 at least.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from measured import check_present, options_of, parser_of, shared_data, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.features import Bias, Friction, Periodic
from quell.learners import RLS, Harmonic, Kalman
from quell.types import Vector

DT, OMEGA_C, OMEGA_O, TORQUE_CONSTANT = 1e-3, 30.0, 150.0, 0.05
ORDERS = (7, 12, 14, 28, 36, 60, 84)
SHIFT_AT, SHIFT_SPEED, END = 60.0, 0.1, 100.0
LAG = 3.0 / OMEGA_O
HIGHEST = 90
DRY = Friction(speed=0.05)
LEARNERS: dict[str, Any] = {
    "none": None,
    "Kalman": Kalman(),
    "Harmonic(3)": Harmonic(count=3),
    "Periodic": RLS(Periodic(orders=ORDERS) + Bias()),
    "Periodic + Friction": RLS(Periodic(orders=ORDERS) + DRY + Bias()),
    "the same, relearn=4": RLS(Periodic(orders=ORDERS) + DRY + Bias(), relearn=4.0),
    "Periodic to 90 + Friction": RLS(Periodic(highest=HIGHEST) + DRY + Bias()),
    "the same, strongest=16": RLS(Periodic(highest=HIGHEST) + DRY + Bias(), strongest=16),
}


@dataclass(frozen=True)
class Speeds(ql.signals.Signal):
    """A position whose speed changes every five seconds, within half a second.

    ``order`` is that of a derivative.
    """

    speeds: tuple[float, ...]  # [rad/s]
    order: int = 0

    def evaluate(self, t: Vector) -> Vector:
        """Return the position [rad] or its derivative."""
        v = np.append(0.0, self.speeds)
        k = np.clip((t // 5.0).astype(int), 0, len(self.speeds) - 1)
        since = t - 5.0 * k
        changing, rate = np.minimum(since, 0.5), (v[k + 1] - v[k]) / 0.5
        if self.order > 1:
            return np.where(since < 0.5, rate, 0.0) if self.order == 2 else np.zeros_like(t)
        if self.order == 1:
            return np.asarray(v[k] + rate * changing)
        begins = np.append(0.0, np.cumsum(5.0 * v[1:] - 0.25 * np.diff(v)))
        ramp = v[k] * changing + 0.5 * rate * changing**2
        return np.asarray(begins[k] + ramp + v[k + 1] * (since - changing))

    def derivative(self) -> ql.signals.Signal:
        """Return the derivative in time."""
        return replace(self, order=self.order + 1)


def new_speeds(seconds: float, seed: int = 1) -> Speeds:
    """Return a reference with random speeds in either direction."""
    rng = np.random.default_rng(seed)
    count = round(seconds / 5.0)
    signed = rng.uniform(0.03, 0.3, count) * rng.choice([-1.0, 1.0], count)
    return Speeds(tuple((math.tau * signed).tolist()))


def turning(speed: float) -> ql.signals.Signal:
    """Return a reference of constant ``speed`` [rev/s]."""
    return ql.signals.Ramp(slope=math.tau * speed)


def motor(file: Path | str, **parameters: Any) -> Any:
    """Return the motor with the measured map; the mean of the record is no cogging."""
    current = np.genfromtxt(file, delimiter=",", names=True)["current"]
    cogging = TORQUE_CONSTANT * (current - current.mean())
    return ql.plants.dc_motor(cogging_map=cogging, torque_constant=TORQUE_CONSTANT, **parameters)


def error(
    plant: Any, learner: Any, guard: Any, reference: Any, seconds: float, w: Any, **scenario: Any
) -> Vector:
    """Return the error of the measured position in each sample [rad], after the run."""
    b0 = float(plant.linear.B[1, 0])
    controller = ql.ADRC(
        ql.ESO.model_free(order=2, b0=b0, omega_o=OMEGA_O, dt=DT),
        omega_c=OMEGA_C,
        learner=learner,
        guard=guard,
        feedforward=True,
    )
    run = ql.simulate(plant, controller, ql.Scenario(reference, seconds, w, **scenario))
    if run.diverged:
        return np.full(round(seconds / DT) + 1, np.inf)
    return np.asarray(run["r"] - run["y_measured"])


def rms(values: Vector) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def moving_rms(values: Vector, seconds: float) -> Vector:
    """Return the RMS of the last ``seconds`` at each sample; NaN before there are so many."""
    width = round(seconds / DT)
    total = np.cumsum(np.append(0.0, values**2))
    start = np.full(width - 1, np.nan)
    return np.append(start, np.sqrt(np.maximum(total[width:] - total[:-width], 0.0) / width))


STEADY = {
    "0.03 rev/s": (turning(0.03), 100.0, 50.0),
    "0.1 rev/s": (turning(0.1), 60.0, 30.0),
    "1 rev/s": (turning(1.0), 20.0, 10.0),
    "new speeds": (new_speeds(120.0), 120.0, 30.0),
}


def steady(plant: Any, learner: Any, guard: Any, name: str, share: float = 1.0) -> float:
    """Return the RMS error of a scenario without shift [rad]."""
    reference, seconds, since = STEADY[name][0], *(share * t for t in STEADY[name][1:])
    return rms(error(plant, learner, guard, reference, seconds, ())[round(since / DT) :])


def shifted(
    plant: Any, learner: Any, guard: Any, restart: bool, share: float = 1.0
) -> tuple[float, float]:
    """Return the worst window after the shift [rad], and the revolutions until as good as before.

    These are infinite if it is never as good within the run.
    """
    at, end = share * SHIFT_AT, share * END
    moved, reference = ql.signals.Step(math.pi, at=at), turning(SHIFT_SPEED)
    if restart:
        again = ql.signals.Ramp(slope=math.tau * SHIFT_SPEED, start=at)
        reference = reference.until(at, then=math.pi + again)
        options: dict[str, Any] = {"noise": moved, "rest_at": (at,)}
        e = error(plant, learner, guard, reference, end, (), **options)
    else:
        e = error(plant, learner, guard, reference, end, (0.0, moved))
    first, revolution = round(at / DT), 1.0 / SHIFT_SPEED
    worst = float(np.max(moving_rms(e, 10.0 * LAG)[first:]))
    last = moving_rms(e, revolution)
    good = np.flatnonzero(last[first + round(revolution / DT) :] <= 1.1 * last[first - 1])
    return worst, 1.0 + good[0] * DT / revolution if good.size else math.inf


def ratio(value: float, plain: float, learner: Any) -> float:
    """Return an error over that of MF-ESO; without learner, in mrad."""
    return 1e3 * value if learner is None else value / plain


def shown(value: float, plain: float, learner: Any) -> str:
    """Return the same as a text."""
    return f"{ratio(value, plain, learner):.{1 if learner is None else 3}f}"


def main() -> None:
    """Print a table."""
    parser = parser_of(__doc__)
    measured = shared_data("cogging_a.csv")
    parser.add_argument("file", nargs="?", type=Path, default=measured, help="count and current")
    parser.add_argument("--only", choices=[*LEARNERS], help="this learner and none alone")
    parser.add_argument("--share", type=float, default=1.0, help="of the length of the runs")
    options = options_of(parser, only="the same, relearn=4", share=0.3)
    if not 0.3 <= options.share <= 1.0:
        parser.error(f"--share {options.share}: must be from 0.3 to 1")
    check_present(options, files=[options.file])
    plant = motor(options.file)
    title = "RMS error over MF-ESO's; for it, in mrad"
    shifts = {"shift": False, "restart": True}
    columns = [name for shift in shifts for name in (f"{shift}: worst", "revolutions")]
    table = Table("learner", "guard", *STEADY, *columns, title=title)
    plain: dict[str, float] = {}
    figures: dict[str, dict[str, Any]] = {}
    for label, learner in LEARNERS.items():
        if options.only and label not in ("none", options.only):
            continue
        for guard in (None, ql.Guard()) if learner is not None else (None,):
            found = {n: steady(plant, learner, guard, n, options.share) for n in STEADY}
            worst = {
                name: shifted(plant, learner, guard, restart, options.share)
                for name, restart in shifts.items()
            }
            plain = plain or found | {n: value for n, (value, _) in worst.items()}
            cells = [shown(value, plain[name], learner) for name, value in found.items()]
            row = {name: ratio(value, plain[name], learner) for name, value in found.items()}
            figures[f"{label}, guarded" if guard else label] = row
            for name, (value, revolutions) in worst.items():
                row[f"{name}: worst"] = ratio(value, plain[name], learner)
                row[f"{name}: revolutions"] = (
                    revolutions if math.isfinite(revolutions) else "not within the run"
                )
                cells += [shown(value, plain[name], learner), f"{revolutions:.1f}"]
            table.add_row(label, "yes" if guard else "no", *cells)
    Console(width=170).print(table)
    write(options, figures)


if __name__ == "__main__":
    main()
