"""The real-time loop around a twin in this process, its record, and a replay with another observer.

For a twin in another process run ``quell rig --device udp://127.0.0.1:5005`` in another terminal,
and open that URL here.
"""

import tempfile
from pathlib import Path

import quell as ql
from quell.realtime import Safety, load, open_device, replay, run_rig

DT = 5e-3


def controller(omega_o: float) -> ql.ADRC:
    """Return an ADRC with a model-free observer."""
    return ql.ADRC(
        ql.ESO.model_free(order=4, b0=4.6e4, omega_o=omega_o, dt=DT),
        omega_c=10.0,
        u_min=-5.0,
        u_max=5.0,
    )


with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "run.csv"
    device = open_device("twin:torsional", DT)
    safety = Safety(most_error=3.0, settle_time=0.25)
    run = run_rig(
        device,
        controller(60.0),
        ql.signals.Sinusoid(omega=2.0),
        duration=2.0,
        safety=safety,
        telemetry=[path],
    )
    print(run.text())
    again = replay(load(path), controller(30.0))

apart = again["x_hat"][:, 1] - run.record["x_hat"][:, 1]
print(f"speed estimated with half the bandwidth: difference up to {abs(apart).max():.3f} rad/s")
