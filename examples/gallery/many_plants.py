"""Two hundred drives whose masses and springs differ, and one controller."""

import matplotlib.pyplot as plt
import numpy as np

import quell as ql

draw = np.random.default_rng(0)
plants = ql.plants.batch(
    ql.plants.two_mass_spring, m2=draw.uniform(0.8, 1.2, 200), k=draw.uniform(0.8, 1.4, 200)
)
controller = ql.ADRC(ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=5e-3), omega_c=1.0)
load = ql.signals.Step(height=0.2, at=20.0)
runs = ql.simulate(
    plants, controller, ql.Scenario(reference=1.0, disturbances=(0.0, load), duration=40.0)
)
runs.plot()
plt.show()
