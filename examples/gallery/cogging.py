"""A servo swings over its cogging: the learner finds the waves in position."""

import matplotlib.pyplot as plt
import numpy as np

import quell as ql

motor = ql.plants.dc_motor(coulomb=0.0, cogging=((7, 0.02), (28, 0.01)))
observer = ql.ESO.model_free(order=2, b0=500.0, omega_o=100.0, dt=1e-3)
waves = ql.features.State() + ql.features.Periodic(orders=(7, 28)) + ql.features.Bias()
move = ql.signals.Sinusoid(amplitude=np.pi, omega=1.0)
figure, axes = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
for name, learner in (("MF-ESO", None), ("L-ESO", ql.learners.RLS(waves))):
    guard = ql.Guard() if learner else None
    controller = ql.ADRC(
        observer, 30.0, learner=learner, guard=guard, feedforward=True, u_min=-24.0, u_max=24.0
    )
    run = ql.simulate(motor, controller, ql.Scenario(reference=move, duration=40.0))
    axes.plot(run.t, np.degrees(run["r"] - run["y"]).ravel(), label=name, linewidth=0.7)
axes.set_xlabel("t [s]"), axes.set_ylabel("r − y [°]")
axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
plt.show()
