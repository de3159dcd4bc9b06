"""``tune`` with a model of slow and fast poles reaches the optimum that a grid shows."""

import numpy as np

import quell as ql

# Poles at 1, 11 and 2400 s; k_i is that of the best of 50 searches from a grid of bandwidths.
den = np.polymul([1.0, 1.0], np.polymul([11.23, 1.0], [2390.0, 1.0]))
bounds = ql.tuning.Constraints(m_s=1.6, m_t=None)
found = ql.tune(
    ([1.0], den.tolist()), 0.067, structure="model-based", constraints=bounds, compare=()
)
assert abs(found.design.k_i / 39.64 - 1.0) < 0.02, found.design.k_i
print("a model of slow and fast poles reaches the optimum that a grid shows")
