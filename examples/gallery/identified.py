"""A model of a resonant drive from a record with noise, beside the empirical frequency response."""

import matplotlib.pyplot as plt
import numpy as np

import quell as ql

plant = ql.plants.torsional_identified()
excitation = ql.identification.excitation("prbs", (0.2, 20.0), 60.0, 5e-3, -2.0, 2.0)
record = ql.identification.excited(plant, excitation)
y = record.y + 1e-3 * np.random.default_rng(0).standard_normal(record.y.shape)
ql.identify(record.u, y, record.dt, order=4).plot()
plt.show()
