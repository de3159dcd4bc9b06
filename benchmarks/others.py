"""Run quell beside other packages on one step with a load.

``pip install pyadrc adrc``, then ``python benchmarks/others.py``. A motor, y'' = 2 u − 0.5 y' + w,
is sampled at 100 Hz; r steps to 1 at the start, a load w = −1 comes at 5 s, and u is within ±3.
All controllers have b0 = 2, omega_c = 4 rad/s and omega_o = 20 rad/s. The table has the largest
difference of u from quell's, the overshoot, the largest error under the load, and the time of a
step, the least of many. The page docs/beside.md has the results with the versions that were tried.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import sys
import timeit
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from measured import options_of, parser_of, write

import quell as ql

DT, B0, OMEGA_C, OMEGA_O, U_MAX = 0.01, 2.0, 4.0, 20.0, 3.0
SAMPLES, LOAD_AT, CALLS = 1000, 500, 100
Step = Callable[[float, float], float]  # (r, y) → u


def ours() -> Step:
    """Return a step of quell's ADRC."""
    observer = ql.ESO.model_free(order=2, b0=B0, omega_o=OMEGA_O, dt=DT)
    controller = ql.ADRC(observer, omega_c=OMEGA_C, u_min=-U_MAX, u_max=U_MAX)
    controller.prepare()
    return controller.step


def pyadrc(form: str) -> Callable[[], Step]:
    """Return what makes a step of pyadrc's controller of a form, with the limits that it takes."""

    def make() -> Step:
        form_of = getattr(importlib.import_module("pyadrc"), form)
        limits = {} if form == "TransferFunction" else {"m_lim": (-U_MAX, U_MAX)}
        theirs, before = form_of(2, DT, B0, OMEGA_C, OMEGA_O / OMEGA_C, **limits), 0.0

        def step(r: float, y: float) -> float:
            nonlocal before
            u = theirs(y, before, r) if form == "StateSpace" else theirs(y, r)
            before = min(max(float(u), -U_MAX), U_MAX)
            return before

        return step

    return make


def adrc() -> Step:
    """Return a step of the package ``adrc``, which takes omega_c as a settling time, 6/omega_c."""
    # Version 1.0.3 imports its second module by a name of the top level.
    spec = importlib.util.find_spec("adrc")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("No module named 'adrc'")
    sys.path.insert(0, str(Path(spec.origin).parent))
    theirs = importlib.import_module("ADRC").ADRC(2)
    theirs.initialize(6.0 / OMEGA_C, OMEGA_O / OMEGA_C, B0, -U_MAX, U_MAX, DT)
    return lambda r, y: float(theirs.step(r, y))


def euler() -> Step:
    """Return the observer by Euler's rule, as ESP++ 1.4.5 and many sketches compute it."""
    z = [0.0, 0.0, 0.0]
    before = 0.0

    def step(r: float, y: float) -> float:
        nonlocal before
        error = z[0] - y
        z[0] += DT * (z[1] - 3.0 * OMEGA_O * error)
        z[1] += DT * (z[2] - 3.0 * OMEGA_O**2 * error + B0 * before)
        z[2] += DT * (-(OMEGA_O**3) * error)
        u = (OMEGA_C**2 * (r - z[0]) - 2.0 * OMEGA_C * z[1] - z[2]) / B0
        before = min(max(u, -U_MAX), U_MAX)
        return before

    return step


def run(step: Step) -> tuple[np.ndarray, np.ndarray]:
    """Return y and u of the loop, sample by sample."""
    plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, -0.5]], [0.0, B0], [1.0, 0.0], [[0.0], [1.0]])
    sampled = plant.sampled(DT)
    x, y, u = np.zeros(2), np.zeros(SAMPLES), np.zeros(SAMPLES)
    for k in range(SAMPLES):
        y[k] = x[0]
        u[k] = step(1.0, float(y[k]))
        load = -1.0 if k >= LOAD_AT else 0.0
        x = sampled.transition @ x + np.ravel(sampled.input) * u[k]
        x = x + np.ravel(sampled.disturbance) * load
    return y, u


def main() -> None:
    """Print the table; what is not installed is named."""
    parser = parser_of(__doc__)
    parser.add_argument("--repeat", type=int, default=300, help="times, of which the least counts")
    options = options_of(parser, repeat=5)
    figures: dict[str, object] = {}
    others: dict[str, Callable[[], Step]] = {"quell": ours}
    forms = ("StateSpace", "TransferFunction", "FeedbackTF")
    others |= {f"pyadrc, {form}": pyadrc(form) for form in forms}
    others |= {"adrc": adrc, "Euler's rule": euler}
    for name in ("pyadrc", "adrc"):
        try:
            print(name, importlib.metadata.version(name))
        except importlib.metadata.PackageNotFoundError:
            print(f"{name} is not here: pip install {name}")
    _, reference = run(ours())
    print(f"{'':32} {'u differs':>10} {'overshoot':>10} {'load [m]':>9} {'step [µs]':>9}")
    for name, make in others.items():
        try:
            y, u = run(make())
        except ModuleNotFoundError as error:
            print(f"{name:32} NOT run: {error}")
            figures[name] = f"NOT run: {error}"
            continue
        step = make()
        time = (
            min(timeit.repeat(partial(step, 1.0, 0.5), number=CALLS, repeat=options.repeat)) / CALLS
        )
        peak = np.max(np.abs(y[LOAD_AT:] - 1.0))
        over = max(0.0, np.max(y[:LOAD_AT]) - 1.0)
        differs = np.max(np.abs(u - reference))
        print(f"{name:32} {differs:10.1e} {100 * over:9.2f}% {peak:9.4f} {1e6 * time:9.2f}")
        figures[name] = {
            "u differs": differs,
            "overshoot [%]": 100.0 * over,
            "load [m]": peak,
            "step [us]": 1e6 * time,
        }
    write(options, figures)


if __name__ == "__main__":
    main()
