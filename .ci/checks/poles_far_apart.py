"""``tune`` with a model of slow and fast poles reaches the optimum that a grid shows."""

import numpy as np

import quell as ql

# Poles at 1, 11 and 2400 s; k_i is that of the best of 50 searches from a grid of bandwidths.
den = np.polymul([1.0, 1.0], np.polymul([11.23, 1.0], [2390.0, 1.0]))
# M_ks is ten times that of the optimal PI controller.
bounds = ql.tuning.Constraints(m_s=1.6, m_t=None, noise_over_pi=None)
how = {"structure": "pi-unfiltered", "objective": "load", "constraints": bounds, "compare": ()}
pi = ql.tune(([1.0], den.tolist()), 0.067, **how).design
bounds = ql.tuning.Constraints(m_s=1.6, m_t=None, m_ks=10.0 * pi.measures["M_ks"])
how = {"structure": "model-based", "objective": "load", "constraints": bounds, "compare": ()}
found = ql.tune(([1.0], den.tolist()), 0.067, **how)
assert abs(found.design.k_i / 39.64 - 1.0) < 0.02, found.design.k_i
print("a model of slow and fast poles reaches the optimum that a grid shows")
