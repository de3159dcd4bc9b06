"""Margins of two masses and a spring, and noise in u, over the bandwidth of the observer."""

import matplotlib.pyplot as plt
import numpy as np

import quell as ql

plant = ql.plants.two_mass_spring()


def design(omega_o):
    """Return a controller with an observer of this bandwidth [rad/s]."""
    return ql.ADRC(ql.ESO.model_free(order=4, b0=1.0, omega_o=omega_o, dt=1e-3), omega_c=1.0)


ql.analysis.plot_margins_against_omega_o(plant, design, np.geomspace(2.5, 100.0, 40))
plt.show()
