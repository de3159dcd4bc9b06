"""The guard: the learner has no authority until it has been right for some time."""

import matplotlib.pyplot as plt

import quell as ql

plant = ql.plants.two_mass_spring(m1=1.0, m2=1.0, k=1.0)
observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=1e-3)
controller = ql.ADRC(observer, omega_c=1.0, learner=ql.learners.Harmonic(), guard=ql.Guard())
scenario = ql.Scenario(
    reference=ql.signals.Sinusoid(),
    disturbances=(0.0, ql.signals.Sinusoid(omega=0.3, start=60.0)),
    noise=ql.signals.BandLimitedNoise(power=1e-12, sample_time=0.01),
    duration=120.0,
)
ql.simulate(plant, controller, scenario, record_every=20).plot()
plt.show()
