"""A servo whose encoder has no index pulse finds its map of cogging again after a restart.

    python benchmarks/lost_index.py [FILE] [--starts 12] [--seed 1] [--speed 0.1] [--only LEARNER]

FILE is the record of ``cogging.py``, and so are motor and gains. A drive turns and learns for a
minute, and its memory is saved. Then the power is off: another controller takes the memory over,
and the encoder counts from an angle by chance, at which the axis stands. Judged is the RMS error of
the position over that of MF-ESO in the same parts: the last revolution before the stop, the first
one after the start, its second half, and the second one. ``anew`` is the same learner without
recall. ``another`` motor has the same amplitudes with other phases from the start on: the map must
not be used. For it the figures are over MF-ESO's on that motor.

Before that, how often chance fits: maps with the same amplitudes and random phases, judged as the
learner does, after a quarter and after half of a revolution.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from cogging import DRY, DT, HIGHEST, OMEGA_C, OMEGA_O, ORDERS, TORQUE_CONSTANT, rms
from measured import check_present, options_of, parser_of, shared_data, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.features import Bias, Periodic
from quell.learners import RLS
from quell.realtime import TwinDevice
from quell.types import Vector

REVOLUTIONS = 3.0  # after the start
LEARNERS: dict[str, Any] = {
    "7 orders": Periodic(orders=ORDERS) + DRY + Bias(),
    "all orders to 90": Periodic(highest=HIGHEST) + DRY + Bias(),
}


def controller(plant: Any, learner: Any, guard: Any) -> Any:
    """Return the controller of ``cogging.py``."""
    b0 = float(plant.linear.B[1, 0])
    observer = ql.ESO.model_free(order=2, b0=b0, omega_o=OMEGA_O, dt=DT)
    return ql.ADRC(observer, OMEGA_C, learner=learner, guard=guard, feedforward=True)


def measured(file: Path | str) -> Vector:
    """Return the map of a record [N m], without its mean."""
    current = np.genfromtxt(file, delimiter=",", names=True)["current"]
    return np.asarray(TORQUE_CONSTANT * (current - current.mean()))


def other_phases(cogging: Vector, rng: np.random.Generator) -> Vector:
    """Return a map with the same amplitudes and random phases."""
    spectrum = np.fft.rfft(cogging)
    turned = spectrum * np.exp(1j * rng.uniform(0.0, math.tau, spectrum.size))
    turned[0] = spectrum[0]
    return np.asarray(np.fft.irfft(turned, cogging.size))


def drive(plant: Any, law: Any, seconds: float, speed: float, start: float = 0.0) -> Vector:
    """Turn the axis from the angle ``start`` [rad], which the encoder shows as 0; return r − y."""
    twin = TwinDevice(plant, DT, np.append(start, np.zeros(plant.order - 1)))
    zero, slope = twin.read(), math.tau * speed
    e = np.empty(round(seconds / DT))
    for k in range(e.size):
        r, y = slope * k * DT, twin.read() - zero
        e[k] = r - y
        twin.write(law.step(r, y, slope, 0.0))
    return e


def motor(cogging: Vector) -> Any:
    """Return the motor with a map [N m]."""
    return ql.plants.dc_motor(cogging_map=cogging, torque_constant=TORQUE_CONSTANT)


def parts(before: Vector, after: Vector, speed: float) -> dict[str, float]:
    """Return the RMS errors of the parts that are judged [rad]."""
    turn = round(1.0 / speed / DT)
    return {
        "before": rms(before[-turn:]),
        "first": rms(after[:turn]),
        "second half of it": rms(after[turn // 2 : turn]),
        "second": rms(after[turn : 2 * turn]),
    }


def restarted(
    first: Any, second: Any, learner: Any, guard: Any, starts: Vector, options: Any
) -> list[dict[str, float]]:
    """Return the errors for each angle of a start on ``second`` after learning on ``first``."""
    law, speed = controller(first, learner, guard), options.speed
    before, found = drive(first, law, options.learning, speed), []
    image = law.memory()
    for start in starts.tolist():
        again = controller(second, learner, guard)
        again.restore(image)
        after = drive(second, again, REVOLUTIONS / speed, speed, start)
        found.append(parts(before, after, speed))
    return found


def chance(cogging: Vector, draws: int, rng: np.random.Generator) -> dict[float, Vector]:
    """Return what the best shift leaves of maps by chance, by the share of a revolution."""
    orders, n = np.array(ORDERS), cogging.size
    known = 2.0 * np.fft.rfft(cogging)[orders] / n
    shifts = np.linspace(0.0, math.tau, 16 * int(orders[-1]), endpoint=False)
    turned = known * np.exp(-1j * np.outer(shifts, orders))
    theta = np.concatenate([turned.real, -turned.imag], axis=1)
    found = {}
    for span in (0.25, 0.5):
        x = math.tau * np.arange(round(span * n)) / n
        waves = np.exp(1j * np.outer(x, orders))
        psi = np.concatenate([waves.real, waves.imag], axis=1)
        psi -= psi.mean(axis=0)
        moments = psi.T @ psi
        own = np.einsum("gi,ij,gj->g", theta, moments, theta)
        left = np.empty(draws)
        for i in range(draws):
            drawn = np.abs(known) * np.exp(1j * rng.uniform(0.0, math.tau, orders.size))
            other = np.concatenate([drawn.real, -drawn.imag])
            squares = other @ moments @ other
            left[i] = np.min(squares - 2.0 * theta @ (moments @ other) + own) / squares
        found[span] = left
    return found


def main() -> None:
    """Print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "file", type=Path, nargs="?", default=shared_data("cogging_a.csv"),
        help="record with columns count and current",
    )  # fmt: skip
    parser.add_argument("--starts", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--speed", type=float, default=0.1, help="[rev/s]")
    parser.add_argument("--only", choices=[*LEARNERS], help="this learner alone")
    parser.add_argument("--learning", type=float, default=60.0, help="before the stop [s]")
    parser.add_argument("--draws", type=int, default=4000, help="maps by chance")
    options = options_of(parser, starts=1, learning=2.0, speed=2.0, draws=20, only="7 orders")
    check_present(options, files=[options.file])
    figures: dict[str, Any] = {}
    rng, cogging = np.random.default_rng(options.seed), measured(options.file)
    for span, left in chance(cogging, options.draws, rng).items():
        quantiles = ", ".join(f"{q:g} %: {np.percentile(left, q):.4f}" for q in (0.1, 1.0, 10.0))
        passed = int(np.sum(left <= 0.02))
        print(f"chance after {span:g} revolutions: {quantiles}; {passed} of {left.size} below 0.02")
        figures[f"chance after {span:g} revolutions"] = {
            "draws": left.size,
            "below 0.02": passed,
            **{f"{q:g} %": np.percentile(left, q) for q in (0.1, 1.0, 10.0)},
        }
    starts = rng.uniform(0.0, math.tau, options.starts)
    other = motor(other_phases(cogging, rng))
    first = motor(cogging)
    names = list(parts(np.ones(10**5), np.ones(10**5), 0.1))
    table = Table(
        "learner", "guard", "motor", *names, title="RMS error over MF-ESO's: median / worst"
    )
    for motor_name, second in (("the same", first), ("another", other)):
        plain = restarted(first, second, None, None, starts, options)
        for name, features in LEARNERS.items():
            if options.only and options.only != name:
                continue
            for recall in (True, False):
                learner = RLS(features, relearn=4.0, recall=recall)
                label = f"{name}, {'recall' if recall else 'anew'}"
                for guard in (None, ql.Guard()):
                    runs = restarted(first, second, learner, guard, starts, options)
                    pairs = [*zip(runs, plain, strict=True)]
                    ratios = {each: [run[each] / own[each] for run, own in pairs] for each in names}
                    cells = [f"{np.median(r):.3f} / {max(r):.3f}" for r in ratios.values()]
                    row = f"{label}{', guard' if guard else ''}, {motor_name} motor"
                    figures[row] = {
                        each: {"median": np.median(r), "worst": max(r)}
                        for each, r in ratios.items()
                    }
                    table.add_row(label, "yes" if guard else "no", motor_name, *cells)
    Console(width=140).print(table)
    write(options, figures)


if __name__ == "__main__":
    main()
