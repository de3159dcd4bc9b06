"""Run the torsional twin with the excitation of a file: ``twin_record.py INPUT RECORD``."""

import sys

import numpy as np

import quell as ql

given, target = sys.argv[1:]
u = np.loadtxt(given, delimiter=",", skiprows=1)[:, 1]
excitation = ql.identification.excitation("prbs", (0.2, 20.0), 60.0, 1e-3, -2.0, 2.0)
record = ql.identification.excited(ql.plants.torsional(), excitation)
assert np.array_equal(record.u, u), "the command and the function give different excitations"
t = np.arange(u.size) * record.dt
columns = np.column_stack([t, record.u, record.y])
np.savetxt(target, columns, delimiter=",", header="t,u,y", comments="")
