"""A model from a record: excite the torsional twin, fit a transfer function, design an observer."""

import quell as ql
from quell.identification import excitation, excited

DT = 1e-3

twin = ql.plants.torsional()
design = excitation("prbs", band=(0.2, 20.0), duration=60.0, dt=DT, u_min=-2.0, u_max=2.0)
record = excited(twin, design)  # u, and y as measured by the encoder

found = ql.identify(record.u, record.y, DT, order=4, friction=True)
print(found)

observer = ql.ESO.model_based(found.plant, omega_o=90.0, dt=DT)
controller = ql.ADRC(observer, omega_c=20.0, u_min=-5.0, u_max=5.0)
move = ql.signals.SmoothMove(distance=1.0, duration=0.5, start=0.1)
run = ql.simulate(twin, controller, ql.Scenario(reference=move, duration=2.0))
print(f"y at the end of the move: {run['y'][-1]:.4f} rad")
