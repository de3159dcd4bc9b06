"""The time that a change of bandwidths takes in the loop: ``retune``, and one that is prepared.

    python benchmarks/retune.py

prints the median and the 99 % quantile of a step, of ``retune``, and of the function that
``prepare_retune`` returned: for an ADRC of order 2 with and without ``Kalman`` and a guard, and for
wrappers.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from measured import options_of, parser_of, write

import quell as ql

DT = 1e-3


def times(call: Callable[[], Any], between: Callable[[], Any], count: int) -> dict[str, float]:
    """Return median and 99 % quantile of a call [µs], with another call in between."""
    found = np.empty(count)
    for i in range(count):
        began = time.perf_counter()
        call()
        found[i] = time.perf_counter() - began
        between()
    median, most = 1e6 * np.quantile(found, [0.5, 0.99])
    return {"median": median, "99 %": most}


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--calls", type=int, default=1000)
    options = options_of(parser, calls=20)
    figures: dict[str, dict[str, float]] = {}

    def show(name: str, call: Callable[[], Any], between: Callable[[], Any]) -> None:
        figures[name] = times(call, between, options.calls)
        print(f"{name:28}{figures[name]['median']:8.1f} {figures[name]['99 %']:8.1f}")

    print(f"{'':28}{'median':>8} {'99 %':>8}  [µs]")
    slow = ql.ESO.model_free(order=2, b0=5.0, omega_o=100.0, dt=DT)
    fast = ql.ESO.model_free(order=2, b0=5.0, omega_o=120.0, dt=DT)
    kinds: dict[str, dict[str, Any]] = {
        "ADRC": {},
        "ADRC, Kalman, guard": {"learner": ql.learners.Kalman(), "guard": ql.Guard()},
    }
    for name, parts in kinds.items():
        controller = ql.ADRC(slow, omega_c=20.0, u_min=-5.0, u_max=5.0, **parts)
        prepared = controller.prepare_retune(omega_c=25.0, observer=fast)

        def step(controller: Any = controller) -> float:
            return float(controller.step(1.0, 0.5))

        def retune(controller: Any = controller) -> None:
            controller.retune(omega_c=20.0, observer=slow)

        for what, call in (("step", step), ("retune", retune), ("prepared", prepared)):
            show(f"{name}: {what}", call, step)
    law = ql.ADRC(slow, omega_c=20.0, u_min=-5.0, u_max=5.0)
    pid = ql.baselines.PID(kp=9.0, ki=5.0, kd=1.0, tf=0.01, dt=DT, u_min=-5.0, u_max=5.0)
    wrappers: dict[str, Any] = {
        "prefiltered": ql.controllers.Prefiltered(law, ql.controllers.ReferenceModel(30.0)),
        "compensated PID": ql.Compensated(pid, ql.Compensator(slow)),
        "in single precision": ql.controllers.in_single_precision(law),
    }
    for name, controller in wrappers.items():
        prepared = controller.prepare_retune(observer=fast)

        def step_of(controller: Any = controller) -> float:
            return float(controller.step(1.0, 0.5))

        def retune_of(controller: Any = controller) -> None:
            controller.retune(observer=slow)

        for what, call in (("step", step_of), ("retune", retune_of), ("prepared", prepared)):
            show(f"{name}: {what}", call, step_of)
    write(options, figures)


if __name__ == "__main__":
    main()
