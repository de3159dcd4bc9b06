"""The best controllers of three structures under the same bounds, on 1/(s + 1)³."""

import matplotlib.pyplot as plt

import quell as ql

ql.tune(([1.0], [1.0, 3.0, 3.0, 1.0]), dt=0.02, compare=("pi", "pid")).plot()
plt.show()
