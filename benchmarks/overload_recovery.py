"""Recovery from an overload: tuned files beside a cascade tuned by hand, on three servos.

The servos have the numbers of data sheets: a motor of 750 W with a 20-bit encoder, a belt axis
measured at its motor, and a linear stage with a scale. Each is tuned by the command ``quell tune``
from a setup with limits of u, noise and a step of the load, and no further option. The file's
controller and the cascade then run in a loop of NumPy: exact zero-order hold, delay in samples,
encoder, limits. A load of 1.4 times the limit of u acts for 0.1 s; the recovery is the time from
its end until the error stays within 2 % of its largest value.

The cascade is the one of drives: P for the position, PI for the speed, u limited, the integral held
while u is. With T the delays of the speed loop, T = T_d + dt + dt/2, its gains are those of the
symmetrical optimum with a = 2.5 (Kessler 1958): ω_v = 1/(a T), K_v = J ω_v, T_i = a/ω_v, and
K_p = ω_v/4; for the belt axis ω_v is at most a third of its mode. ``--factors`` tries K_p and ω_v
with these factors as well, and takes the quickest.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from drawn_tunings import SETUP
from measured import parser_of, write
from scipy.signal import cont2discrete, tf2ss

from quell.setup import load


def servos() -> dict[str, dict[str, Any]]:
    """Return the three servos: plant in SI units, sample time, delay in samples, limit, encoder."""
    motor, late = 1.1e-4, 0.9e-4  # inertias of a motor of 750 W and of its load [kg m²]
    omega = 2.0 * np.pi * 60.0  # of the belt axis, whose load is four times its motor
    m, M = 2e-4, 8e-4
    k = omega**2 * m * M / (m + M)
    c = 0.04 * k / omega
    pair = [1.0, c * (m + M) / (m * M), k * (m + M) / (m * M)]
    return {
        "motor of 750 W": {
            "num": [1.0 / (motor + late)], "den": [1.0, 0.5, 0.0], "inertia": motor + late,
            "dt": 2.5e-4, "samples": 1, "u_max": 7.1, "step": 2.0 * np.pi / 2**20, "size": 1.0,
        },
        "belt axis": {
            "num": (np.array([M, c, k]) / (m * M)).tolist(),
            "den": np.polymul([1.0, 0.0, 0.0], pair).tolist(), "inertia": m + M, "mode": omega,
            "dt": 5e-4, "samples": 1, "u_max": 7.1, "step": 2.0 * np.pi / 2**17, "size": 3.0,
        },
        "linear stage": {
            "num": [1.0 / 12.0], "den": [1.0, 20.0 / 12.0, 0.0], "inertia": 12.0,
            "dt": 5e-4, "samples": 2, "u_max": 500.0, "step": 1e-7, "size": 0.3,
        },
    }  # fmt: skip


class Cascade:
    """P for the position and PI for the speed, with limits of u."""

    def __init__(self, of: dict[str, Any], position: float = 1.0, speed: float = 1.0) -> None:
        late, a = (of["samples"] + 1.5) * of["dt"], 2.5
        omega = speed / (a * late)
        if "mode" in of:
            omega = min(omega, speed * of["mode"] / 3.0)
        self.k_v, self.t_i, self.k_p = of["inertia"] * omega, a / omega, position * omega / 4.0
        self.dt, self.u_max = of["dt"], of["u_max"]
        self.integral, self.y = 0.0, 0.0

    def step(self, r: float, y: float) -> float:
        """Return u of a sample."""
        error = self.k_p * (r - y) - (y - self.y) / self.dt
        self.y = y
        wanted = self.k_v * error + self.integral
        u = min(max(wanted, -self.u_max), self.u_max)
        if u == wanted:
            self.integral += self.k_v * error * self.dt / self.t_i
        return u


def recovery(of: dict[str, Any], controller: Any) -> float:
    """Return the time from the end of the overload until y is back [s]; infinite if it is not."""
    A, B, C, _ = tf2ss(of["num"], of["den"])
    dt = of["dt"]
    Phi, Gamma, *_ = cont2discrete((A, B, C, np.zeros((1, 1))), dt)
    begin, end, count = (round(t / dt) for t in (0.05, 0.15, 4.0))
    x, waiting, y = np.zeros(A.shape[0]), [0.0] * of["samples"], np.zeros(count)
    for i in range(count):
        y[i] = float(C[0] @ x)
        u = controller.step(0.0, of["step"] * round(y[i] / of["step"]))
        waiting.append(min(max(u, -of["u_max"]), of["u_max"]))
        load_now = 1.4 * of["u_max"] if begin <= i < end else 0.0
        x = Phi @ x + Gamma[:, 0] * (waiting.pop(0) + load_now)
    away = np.flatnonzero(np.abs(y) > 0.02 * np.max(np.abs(y)))
    return float("inf") if away[-1] >= count - 5 else (away[-1] + 1 - end) * dt


def tuned(name: str, of: dict[str, Any]) -> tuple[Any, str]:
    """Return the controller of the file that ``quell tune`` writes, and its structure."""
    numbers = {key: of[key] for key in ("dt", "num", "den", "size")}
    numbers |= {"low": -of["u_max"], "high": of["u_max"], "late": of["samples"] * of["dt"]}
    numbers |= {"load": 0.3 * of["u_max"], "load_at": 1.5, "last": 3.0, "kind": name, "at": 0.05}
    power = of["step"] ** 2 / 12.0 * of["dt"]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "setup.toml")
        file.write_text(SETUP.format(power=power, **numbers))
        words = "tune setup.toml --out tuned.toml --no-figures"
        command = [sys.executable, "-m", "quell", *words.split()]
        shown = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
        structure = shown.stdout.splitlines()
        made = load(Path(folder, "tuned.toml"))
    lines = [line for line in structure if line.startswith(("NOT", "Tuned", "overload"))]
    return made.controller, "; ".join(lines)


def main() -> None:
    """Print for each servo the recovery of the tuned file, that of the cascade, and their ratio."""
    parser = parser_of(__doc__)
    parser.add_argument("--factors", action="store_true", help="the best of nine hand tunings")
    given = parser.parse_args()
    factors = [(1.0, 1.0)]
    if given.factors:
        factors = list(itertools.product((0.6, 1.0, 1.6), (0.7, 1.0, 1.4)))
    figures = {}
    for name, of in list(servos().items())[: 1 if given.quick else None]:
        controller, said = tuned(name, of)
        own = recovery(of, controller)
        by_hand = min(recovery(of, Cascade(of, *each)) for each in factors)
        print(f"{name}: tuned {own:.3f} s, cascade {by_hand:.3f} s, ratio {own / by_hand:.2f}")
        print(f"    {said}", flush=True)
        figures[name] = {"tuned": own, "cascade": by_hand, "ratio": own / by_hand}
    write(given, figures)


if __name__ == "__main__":
    main()
