"""Tuned files in an independent simulation, beside what the report prints.

Draws motors, ovens and flexible axes with limits of u, noise, dead time and a scenario, tunes each
by the command ``quell tune``, and runs the controller of the written file in a loop of NumPy and
SciPy: exact zero-order hold, delay in samples, noise, limits. Counts

- figures that are off: the overshoot by more than 3 points, or the settling time by more than 3 %,
  beyond the range over draws of the noise where the report prints one;
- loops that do not settle in their own scenario, or cycle at a limit;

each only where the report has no line that begins with NOT. Of motors and flexible axes it also
takes the settling time over that of the fastest move of the rigid axis, 2 √(h J/u_max), and over
the least one of the axis itself: a linear program finds the u within its limits with which y is
within 2 % first, never 5 % beyond its end, and comes to rest.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from measured import parser_of, write
from scipy.optimize import linprog
from scipy.signal import cont2discrete, tf2ss

from quell.cli import main as quell
from quell.setup import load

# The loop that is tuned; also for other benchmarks.
SETUP = """title = "{kind}"
dt = {dt}
[plant]
kind = "delayed"
delay = {late}
plant = {{ kind = "linear", num = {num}, den = {den} }}
[controller]
u_min = {low}
u_max = {high}
[scenario]
duration = {last}
reference = {{ kind = "step", height = {size}, at = {at} }}
disturbances = [{{ kind = "step", height = {load}, at = {load_at} }}]
noise = {{ kind = "noise", power = {power}, sample_time = {dt} }}
"""


def drawn(kind: str, rng: np.random.Generator) -> dict[str, Any]:
    """Return the numbers of a loop."""

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    if kind == "oven":
        gain, slow, fast, late = (
            between(0.3, 3.0), between(80.0, 800.0), between(8.0, 80.0), int(rng.integers(3, 40))
        )  # fmt: skip
        found = {
            "num": [gain],
            "den": np.polymul([slow, 1.0], [fast, 1.0]).tolist(),
            "u": (0.0, 100.0),
            "size": gain * rng.uniform(15.0, 60.0),
            "load": -10.0,
            "last": 8.0 * (slow + fast + late),
            "fastest": 0.0,
        }
        return found | {"dt": 1.0, "samples": late, "noise": between(0.02, 0.2)}
    if kind == "motor":
        dt, gain, pole = float(rng.choice([1e-3, 5e-4])), between(5.0, 5000.0), between(0.3, 20.0)
        most, fastest, last = between(0.5, 20.0), between(0.02, 0.3), 3.0
        num, den, samples = [gain], [1.0, pole, 0.0], int(rng.integers(1, 3))
    else:
        motor, dt, last, samples = between(2e-5, 5e-4), 2.5e-4, 2.0, 1
        load, omega = between(0.5, 6.0) * motor, 2.0 * np.pi * between(30.0, 150.0)
        k = omega**2 * motor * load / (motor + load)
        c = 0.03 * k / omega
        gain, most, fastest = 1.0 / (motor + load), between(0.5, 8.0) * motor / 3e-4, 0.0
        fastest = between(0.03, 0.2)
        num = (np.array([load, c, k]) / (motor * load)).tolist()
        pair = [1.0, c * (motor + load) / (motor * load), k * (motor + load) / (motor * load)]
        den = np.polymul([1.0, 0.0, 0.0], pair).tolist()
    size = fastest**2 / 4.0 * gain * most
    found = {"num": num, "den": den, "u": (-most, most), "size": size, "load": 0.3 * most}
    found |= {"dt": dt, "samples": samples, "noise": size * between(1e-6, 1e-4)}
    return found | {"last": last, "fastest": fastest}


def run_alone(of: dict[str, Any], controller: Any, seed: int) -> tuple[Any, Any]:
    """Return y and u of the loop, simulated here."""
    A, B, C, _ = tf2ss(of["num"], of["den"])
    Phi, Gamma, *_ = cont2discrete((A, B, C, np.zeros((1, 1))), of["dt"])
    count, rng = int(of["last"] / of["dt"]), np.random.default_rng(seed)
    x, waiting = np.zeros(A.shape[0]), [0.0] * of["samples"]
    y, u, (low, high) = np.full(count, np.nan), np.zeros(count), of["u"]
    for k in range(count):
        y[k] = float(C[0] @ x)
        r = of["size"] if k >= of["at"] else 0.0
        u[k] = min(max(controller.step(r, y[k] + of["noise"] * rng.standard_normal()), low), high)
        waiting.append(u[k])
        load = of["load"] if k >= of["load_at"] else 0.0
        x = Phi @ x + Gamma[:, 0] * (waiting.pop(0) + load)
        if not np.all(np.abs(x) < 1e12):
            break
    return y, u


def least_settling(of: dict[str, Any], pieces: int = 240) -> float | None:
    """Return the least settling time of the axis [s], with u constant in so many pieces."""
    A, B, C, _ = tf2ss(of["num"], of["den"])
    last = of["fastest"] + 2.5 * 2.0 * np.pi / np.max(np.abs(np.roots(of["den"])))
    last = min(last, 4.0 * of["fastest"])
    dt, n = last / pieces, A.shape[0]
    Phi, Gamma, *_ = cont2discrete((A, B, C, np.zeros((1, 1))), dt)
    states = np.array([np.linalg.matrix_power(Phi, k) @ Gamma[:, 0] for k in range(pieces)])
    first = np.append(states @ C[0], 0.0) / of["size"]
    at = np.subtract.outer(np.arange(pieces), np.arange(pieces))
    y = np.where(at >= 0, first[np.maximum(at, -1)], 0.0)
    scale = np.max(np.abs(states), axis=0)
    rest = np.linalg.lstsq(np.vstack([A, C]), np.append(np.zeros(n), of["size"]), rcond=None)[0]

    def possible(k: int) -> bool:
        most = np.where(np.arange(pieces) >= k, 1.02, 1.05)
        found = linprog(
            np.zeros(pieces),
            A_ub=np.vstack([y, -y[k:]]),
            b_ub=np.append(most, np.full(pieces - k, -0.98)),
            A_eq=(states[::-1] / scale).T,
            b_eq=rest / scale,
            bounds=[of["u"]] * pieces,
        )
        return bool(found.status == 0)

    low, high = 0, pieces - 1
    if not possible(high):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if possible(middle) else (middle, high)
    return float((high + 1) * dt + of["samples"] * of["dt"])


def outside_of(step: dict[str, Any], name: str, value: float) -> float:
    """Return how far a value is from what the report prints, a number or a range."""
    ends = step.get(f"{name}s") or (step[name], step[name])
    low, high = (np.inf if end is None else end for end in ends)  # y does not settle
    return float(max(low - value, value - high, 0.0))


def trial(kind: str, seed: int) -> dict[str, Any]:
    """Tune a drawn loop and compare."""
    of = drawn(kind, np.random.default_rng(seed))
    of["at"], of["load_at"] = (round(share * of["last"] / of["dt"]) for share in (0.1, 0.55))
    numbers = {key: of[key] for key in ("dt", "num", "den", "size", "load", "last")}
    numbers |= {"low": of["u"][0], "high": of["u"][1], "late": of["samples"] * of["dt"]}
    numbers |= {key: of[key] * of["dt"] for key in ("at", "load_at")}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        text = SETUP.format(kind=kind, power=of["noise"] ** 2 * of["dt"], **numbers)
        (folder / "setup.toml").write_text(text)
        words = "tune setup.toml --out tuned.toml --json tuned.json --no-figures"
        # In this process, so that compiled code is loaded once.
        errors, said = io.StringIO(), io.StringIO()
        command = mock.patch.object(sys, "argv", ["quell", *words.split()])
        with contextlib.chdir(folder), contextlib.redirect_stdout(said), command:
            try:
                with contextlib.redirect_stderr(errors):
                    quell()
            except SystemExit as ending:
                if ending.code:
                    return {"kind": kind, "seed": seed, "refused": errors.getvalue()[-200:]}
        told = json.loads((folder / "tuned.json").read_text())
        controller = load(folder / "tuned.toml").controller
    y, u = run_alone(of, controller, seed)
    part, step = y[of["at"] : of["load_at"]] / of["size"], told["reference_step"]
    outside = np.flatnonzero(~(np.abs(part - 1.0) <= step["band"]))
    settling = (outside[-1] + 1) * of["dt"] if outside.size else 0.0
    never = bool(outside.size and outside[-1] >= part.size - 5)
    end = u[-u.size // 5 :]
    at_limit = float(np.mean((end <= of["u"][0]) | (end >= of["u"][1])))
    over = outside_of(step, "overshoot", max(float(np.nanmax(part)) - 1.0, 0.0))
    late = outside_of(step, "settling", settling)
    least = least_settling(of) if of["fastest"] else None
    return {
        "kind": kind,
        "seed": seed,
        "warned": told["not"],
        "overshoot": step["overshoot"],
        "really": float(np.nanmax(part)) - 1.0,
        "off": bool(over > 0.03 or late > max(0.03 * settling, 2.0 * of["dt"])),
        "settles": (float(settling), step["settling"], step.get("settlings")),
        "never": never or not np.all(np.isfinite(y)),
        "cycles": kind != "oven" and at_limit > 0.2,
        "over_fastest": float(settling / of["fastest"]) if of["fastest"] else None,
        "over_least": float(settling / least) if least else None,
    }


def main() -> None:
    """Print a line for each loop, and the counts."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rows = []
    for i in range(3 if given.quick else given.count):
        rows.append(trial(("motor", "oven", "flexible")[i % 3], given.seed * 1000 + i))
        print(rows[-1], flush=True)
    tuned = [row for row in rows if "refused" not in row]
    figures: dict[str, Any] = {"loops": len(rows), "refused": len(rows) - len(tuned)}
    for name in ("off", "never", "cycles"):
        figures[name] = sum(row[name] and not row["warned"] for row in tuned)
    figures["warned"] = sum(bool(row["warned"]) for row in tuned)
    for kind in ("motor", "flexible"):
        for name in ("over_fastest", "over_least"):
            of_kind = [row[name] for row in tuned if row["kind"] == kind]
            ratios = [ratio for ratio in of_kind if ratio is not None]
            if ratios:
                median, largest = float(np.median(ratios)), float(np.max(ratios))
                figures[f"{kind} {name}"] = {"median": median, "largest": largest}
    print(figures)
    write(given, figures)


if __name__ == "__main__":
    main()
