"""What a compensator leaves of the error of a controller that stays as it is.

    python benchmarks/compensator.py [--part axis|joint]

*Axis*: two inertias (3.2e-4 and 9.5e-4 kg m², 180 N m/rad, 0.02 N m s/rad), encoder of 2²⁰ counts
at the motor, 4 kHz, torque one sample late, a load of 0.4 N m at several frequencies on the load
side. A PID controller tuned to M_s 1.6 stays; ``tune_compensator`` finds the observer (bounds: M_s
2, three times the PID's M_ks). With the model 30 % wrong the same compensator meets inertias that
are 0.7 and 1.3 times those of the model.

*Joint*: a velocity-controlled joint of an arm (inner loop of 12 N m s/rad without integral action,
friction, gravity), a payload of 2 kg that is taken up in the run, an outer P controller with speed
feedforward at 500 Hz (the setting of arXiv 2512.05292). The band for the position is 0.85 rad, the
reference goes to 1.0 rad.

*PID tuned anew* has the bounds of the loop with the compensator. RMS errors over the last third of
the runs, relative to the controller alone.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.controllers.linear import realised, sampled_law

MOTOR, LOAD, STIFFNESS, DAMPING, DT = 3.2e-4, 9.5e-4, 180.0, 0.02, 2.5e-4
CONSOLE = Console(width=100)


def axis(share: float = 1.0) -> Any:
    """Return the axis with inertias of ``share`` times the nominal ones."""
    return ql.plants.n_mass([share * MOTOR, share * LOAD], [STIFFNESS], [DAMPING], loads=[2])


def on_the_axis(quick: bool) -> dict[str, Any]:
    """Print the error of PID, compensator and learners under loads of several frequencies."""
    nominal = axis()
    limits = {"u_min": -3.5, "u_max": 3.5}
    pid = ql.tune(nominal, DT, structure="pid", delay=DT, compare=(), **limits).design.controller
    found = ql.tuning.tune_compensator(nominal, pid, delay=DT)
    CONSOLE.print(str(found))
    observer = found.controller.compensator.observer
    learners: dict[str, Any] = {
        "no learner": {},
        "Kalman, guarded": {"learner": ql.learners.Kalman(), "guard": ql.Guard()},
        "Harmonic, guarded": {"learner": ql.learners.Harmonic(bias=False), "guard": ql.Guard()},
    }
    bounds = ql.tuning.Constraints(
        m_s=found.constraints.m_s, m_t=found.constraints.m_t, m_ks=found.constraints.m_ks,
        damping=None,
    )  # fmt: skip
    how: dict[str, Any] = {"structure": "pid", "delay": DT, "compare": (), **limits}
    anew = ql.tune(nominal, DT, constraints=bounds, **how).design.controller
    headings = ("plant", "load", "PID tuned anew", *learners)
    table = Table(*headings, title="Error over that of the PID alone")
    figures: dict[str, Any] = {
        "M_s of the tuned compensator": found.details.after.m_s,
    }
    for share in (1.0,) if quick else (1.0, 0.7, 1.3):
        plant = ql.plants.delayed(ql.plants.encoded(axis(share), 2**20), DT, DT)
        for frequency in (10.0,) if quick else (1.0, 4.0, 10.0):
            load = ql.signals.Sinusoid(0.4, 2.0 * math.pi * frequency)
            scenario = ql.Scenario(duration=0.15 if quick else 6.0, disturbances=[load])

            def late(controller: Any, plant: Any = plant, scenario: Any = scenario) -> float:
                y = ql.simulate(plant, controller, scenario, interpret=quick)["y"]
                return float(np.sqrt(np.mean(y[2 * y.size // 3 :] ** 2)))

            alone = late(pid)
            ratios = {"PID tuned anew": late(anew) / alone}
            for name, options in learners.items():
                more = {"omega_c": 60.0, **options} if options else {}
                both = ql.Compensated(pid, ql.Compensator(observer, **more))
                ratios[name] = late(both) / alone
            row = [f"{ratio:.3f}" for ratio in ratios.values()]
            table.add_row(f"inertias × {share:g}", f"{frequency:g} Hz", *row)
            figures[f"inertias times {share:g}, {frequency:g} Hz"] = ratios
    CONSOLE.print(table)
    return figures


KV, J0, LENGTH, LINK, G = 12.0, 0.9, 0.45, 1.5, 9.81


def joint(t: float, x: Any, u: float, w: Any) -> tuple[float, float]:
    """Return the derivatives of angle and speed; u is the commanded speed, w the payload [kg]."""
    inertia = J0 + w[0] * LENGTH**2
    weight = (0.5 * LINK + w[0]) * G * LENGTH
    torque = KV * (u - x[1]) - weight * math.cos(x[0]) - 0.6 * math.tanh(x[1] / 0.02)
    return x[1], torque / inertia


def on_the_joint(quick: bool) -> dict[str, Any]:
    """Print the tracking error with and without compensator, and what the safe set keeps."""
    end = 3.0 if quick else 60.0
    dt, kp, tf = 2e-3, 4.0, 0.02
    plant = ql.plants.NonlinearPlant(joint, order=2, substeps=4, name="joint")
    from_r = np.polyadd(kp * np.array([tf, 1.0]), [1.0, 0.0])
    system = realised([from_r.tolist(), (-kp * np.array([tf, 1.0])).tolist()], [tf, 1.0])
    outer = ql.controllers.LinearController(sampled_law(system, dt), dt, u_min=-4.0, u_max=4.0)
    payload = ql.signals.Samples([0.0, end / 3.0, end / 3.0 + 0.5, end], [0.0, 0.0, 2.0, 2.0])

    def errors(controller: Any, amplitude: float) -> tuple[float, float, float, Any]:
        reference = ql.signals.Sinusoid(amplitude, 2.0 * math.pi * 0.25)
        scenario = ql.Scenario(reference, end, disturbances=[payload])
        run = ql.simulate(plant, controller, scenario, interpret=quick)
        error, half = run["r"] - run["y"], len(run) // 3
        late = [
            float(np.sqrt(np.mean(part**2)))
            for part in (error[half // 4 : half], error[2 * half :])
        ]
        return late[0], late[1], float(np.max(np.abs(run["y"][200:]))), run.status

    observer = ql.ESO.model_free(order=1, b0=1.0, omega_o=30.0, dt=dt)
    rows = {
        "outer controller alone": outer,
        "compensator": ql.Compensated(outer, ql.Compensator(observer)),
        "with Kalman, guarded": ql.Compensated(
            outer,
            ql.Compensator(observer, omega_c=kp, learner=ql.learners.Kalman(), guard=ql.Guard()),
        ),
    }
    table = Table(
        "", "without payload", "with payload", "over alone", "max |y| at r = 1.0",
        title="Joint: RMS error [rad]",
    )  # fmt: skip
    alone = errors(outer, 0.8)
    figures: dict[str, Any] = {}
    for name, controller in rows.items():
        light, heavy, _, _ = errors(controller, 0.8)
        ratio = f"{light / alone[0]:.3f}; {heavy / alone[1]:.3f}"
        most = errors(controller, 1.0)[2]
        table.add_row(name, f"{light:.4f}", f"{heavy:.4f}", ratio, f"{most:.3f}")
        figures[name] = joint_figures(light, heavy, alone, most)
    b0 = 0.5 * (KV / J0 + KV / (J0 + 2.0 * LENGTH**2))
    model = ql.ESO.model_based(([b0], [1.0, b0, 0.0]), 80.0, dt)
    band = ql.SafeSet(-0.85, 0.85, alpha=8.0, f_rate=100.0, gain_error=0.2)
    safe = ql.Compensated(outer, ql.Compensator(model, u_min=-4.0, u_max=4.0, safe_set=band))
    light, heavy, _, _ = errors(safe, 0.5)
    plain = errors(outer, 0.5)
    _, _, most, status = errors(safe, 1.0)
    ratio = f"{light / plain[0]:.3f}; {heavy / plain[1]:.3f}"
    name = "model-based, with a safe set, r = 0.5"
    table.add_row(name, f"{light:.4f}", f"{heavy:.4f}", ratio, f"{most:.3f} ({status.name})")
    CONSOLE.print(table)
    return figures | {name: joint_figures(light, heavy, plain, most)}


def joint_figures(light: float, heavy: float, alone: Any, most: float) -> dict[str, float]:
    """Return the figures of a controller of the joint."""
    return {
        "RMS without payload [rad]": light,
        "RMS with payload [rad]": heavy,
        "without payload, over alone": light / alone[0],
        "with payload, over alone": heavy / alone[1],
        "max |y| at r = 1.0": most,
    }


PARTS = {"axis": on_the_axis, "joint": on_the_joint}


def main() -> None:
    """Measure both, or one of them."""
    parser = parser_of(__doc__)
    parser.add_argument("--part", choices=PARTS, action="append")
    options = options_of(parser)
    write(options, {name: PARTS[name](options.quick) for name in options.part or PARTS})


if __name__ == "__main__":
    main()
