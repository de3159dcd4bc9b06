"""A pendulum given by its differential equation; the observer has no model of friction and load."""

import numpy as np

import quell as ql


def pendulum(t, x, u, w):
    """Return the derivatives of angle and speed, for torque u, load w[0], gravity and friction."""
    return x[1], 8.0 * u + w[0] - 9.81 * np.sin(x[0]) - 0.4 * np.tanh(x[1] / 0.1)


plant = ql.plants.NonlinearPlant(pendulum, order=2, output=[1.0, 0.0], substeps=2, name="pendulum")
scenario = ql.Scenario(
    reference=ql.signals.Sinusoid(amplitude=0.8, omega=2.0).until(
        20.0, then=ql.signals.Constant(0.5)
    ),
    disturbances=(ql.signals.Sinusoid(amplitude=3.0, omega=1.5, start=25.0),),
    duration=60.0,
)
for learner in (None, ql.learners.Kalman()):
    controller = ql.ADRC(
        ql.ESO.model_free(order=2, b0=8.0, omega_o=25.0, dt=2e-3), omega_c=8.0, learner=learner
    )
    run = ql.simulate(plant, controller, scenario)
    loaded = run.metrics(start=30.0)
    print(
        f"{'L-ESO ' if learner else 'MF-ESO'}: error under load, largest "
        f"{loaded['peak_error']:.4f} rad, RMS {loaded['rms']:.4f} rad"
    )
