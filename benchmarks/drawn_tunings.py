"""Tuned files in an independent simulation, beside what the report prints.

Draws motors, ovens and flexible axes with limits of u, noise, dead time and a scenario, tunes each
by the command ``quell tune``, and runs the controller of the written file in a loop of NumPy and
SciPy: exact zero-order hold, delay in samples, noise, limits. Counts

- figures that are off: the overshoot by more than 3 points, or the settling time by more than 3 %;
- loops that do not settle in their own scenario, or cycle at a limit;

each only where the report has no line that begins with NOT. Of motors and flexible axes it also
takes the settling time over that of the fastest move of the rigid axis, 2 √(h J/u_max).
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from measured import parser_of, write
from scipy.signal import cont2discrete, tf2ss

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
        command = [sys.executable, "-m", "quell", *words.split()]
        shown = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if shown.returncode:
            return {"kind": kind, "seed": seed, "refused": shown.stderr[-200:]}
        told = json.loads((folder / "tuned.json").read_text())
        controller = load(folder / "tuned.toml").controller
    y, u = run_alone(of, controller, seed)
    part, step = y[of["at"] : of["load_at"]] / of["size"], told["reference_step"]
    outside = np.flatnonzero(~(np.abs(part - 1.0) <= step["band"]))
    settling = (outside[-1] + 1) * of["dt"] if outside.size else 0.0
    never = bool(outside.size and outside[-1] >= part.size - 5)
    end = u[-u.size // 5 :]
    at_limit = float(np.mean((end <= of["u"][0]) | (end >= of["u"][1])))
    said = step["settling"] if step["settling"] is not None else np.nan
    over = abs(step["overshoot"] - max(float(np.nanmax(part)) - 1.0, 0.0))
    return {
        "kind": kind,
        "seed": seed,
        "warned": bool(told["not"]),
        "overshoot": step["overshoot"],
        "off": bool(over > 0.03 or abs(settling - said) > max(0.03 * settling, 2.0 * of["dt"])),
        "never": never or not np.all(np.isfinite(y)),
        "cycles": kind != "oven" and at_limit > 0.2,
        "over_fastest": settling / of["fastest"] if of["fastest"] else None,
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
    figures["warned"] = sum(row["warned"] for row in tuned)
    for kind in ("motor", "flexible"):
        ratios = [row["over_fastest"] for row in tuned if row["kind"] == kind]
        if ratios:
            figures[kind] = {"median": float(np.median(ratios)), "largest": float(np.max(ratios))}
    print(figures)
    write(given, figures)


if __name__ == "__main__":
    main()
