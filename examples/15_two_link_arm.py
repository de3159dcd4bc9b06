"""A two-link arm from data to C: excite, identify B0, control both joints, learn, export.

The arm is held by a slow controller whose matrix is 30 % wrong. Small multisines, one for each
joint, on its references give a record from which B0 is identified. The controller made with it
follows fast sines; learners of the joints take most of what is left, and the C of the whole gives
the u of Python.
"""

import math
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import quell as ql
from quell.identification import identify_b0_matrix, interleaved_excitations

DT = 2e-3
POSTURE = np.array([0.5, -1.0])  # [rad]

# The machine: in your laboratory this is the robot, with encoders of 20 bits.
machine = ql.plants.arm(lengths=(0.4, 0.3), masses=(2.0, 1.0), viscous=0.1)
robot = ql.plants.encoded_outputs(machine, math.tau / 2**20)
AT_REST = [*POSTURE, 0.0, 0.0]


def joint(omega_c, omega_o, learner=None, feedforward=False):
    """Return the controller of a joint, with b0 = 1: the gain of the arm is in B0."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=omega_o, dt=DT)
    guard = ql.Guard() if learner else None
    return ql.ADRC(observer, omega_c, learner=learner, guard=guard, feedforward=feedforward)


# 1. A record: the arm holds its posture, and multisines of 0.01 rad move it by a little.
rough = ql.Axes([joint(12.0, 60.0), joint(12.0, 60.0)], M=1.3 * machine.mass_matrix(POSTURE))
multisines = interleaved_excitations(2, (1.0, 60.0), 6.0, DT, u_min=-0.01, u_max=0.01)
references = [q + each.signal for q, each in zip(POSTURE, multisines, strict=True)]
record = ql.simulate(robot, rough, ql.Scenario(references, duration=8.0, x0=AT_REST))
late = record.t >= 2.0

# 2. B0 with deviations.
found = identify_b0_matrix(record["u"][late], record["y_measured"][late], DT, order=2)
print(found)
true = np.linalg.inv(machine.mass_matrix(POSTURE))
print(f"largest error of an entry: {np.max(np.abs(found.B0 / true - 1.0)):.1%}")

# 3. Both joints follow sines about the posture, without and with learners.
sines = [
    ql.signals.Sum((ql.signals.Constant(at), ql.signals.Sinusoid(amplitude, omega)))
    for at, amplitude, omega in zip(POSTURE, (0.4, 0.6), (3.0, 4.5), strict=True)
]
scenario = ql.Scenario(sines, duration=30.0, x0=AT_REST)
errors = {}
for name, learner in (("plain", None), ("learning", ql.learners.Harmonic())):
    joints = {each: joint(10.0, 60.0, learner, True) for each in ("shoulder", "elbow")}
    arm = ql.Axes(joints, B0=found.B0, u_min=-40.0, u_max=40.0, saturation="direction")
    run = ql.simulate(robot, arm, scenario)
    errors[name] = [1e3 * each["rms"] for each in run.metrics(20.0).values()]
    print(f"{name:9} RMS error {errors[name][0]:.2f} mrad, {errors[name][1]:.2f} mrad")
assert max(errors["learning"]) < 0.4 * max(errors["plain"])

# 4. C: the exported axes give the u of Python for the references and measurements of the run.
with tempfile.TemporaryDirectory() as place:
    folder = Path(place) / "firmware"
    ql.export.c(arm, folder, name="robot")
    print("exported:", ", ".join(sorted(each.name for each in folder.rglob("robot.[ch]"))))
    if shutil.which("gcc") is None:
        print("no gcc here: the C was not run")
    else:
        samples = np.hstack([run["r"], run["y_measured"]])[:5000]
        rates = [np.stack([s.derivative()(run.t) for s in sines], axis=1)]
        rates.append(np.stack([s.derivative().derivative()(run.t) for s in sines], axis=1))
        np.savetxt(Path(place) / "samples.txt", np.hstack([samples, *(d[:5000] for d in rates)]))
        (Path(place) / "main.c").write_text(
            """
#include <stdio.h>
#include "robot.h"
int main(void)
{
    static robot_state robot;
    double r[2], y[2], r1[2], r2[2], u[2];
    robot_init(&robot);
    while (scanf("%lf %lf %lf %lf %lf %lf %lf %lf", &r[0], &r[1], &y[0], &y[1], &r1[0], &r1[1],
                 &r2[0], &r2[1]) == 8) {
        robot_step(&robot, r, y, r1, r2, u);
        printf("%.17g %.17g\\n", u[0], u[1]);
    }
    return 0;
}
"""
        )
        program = Path(place) / "main"
        source = next(folder.rglob("robot.c"))
        command = ["gcc", "-O2", "-ffp-contract=off", "-I", source.parent, Path(place) / "main.c"]
        subprocess.run([*command, source, "-lm", "-o", program], check=True)
        with (Path(place) / "samples.txt").open() as given:
            done = subprocess.run([program], stdin=given, capture_output=True, check=True)
        u = np.array(done.stdout.split(), dtype=float).reshape(-1, 2)
        difference = np.max(np.abs(u - run["u"][:5000]))
        print(f"C against Python, 5000 samples: largest difference of u {difference:.1e} N m")
        assert difference < 1e-6
