"""Results of a run: channels, metrics, an xarray dataset, a file, a plot."""

import tempfile
from pathlib import Path

import quell as ql

controller = ql.ADRC(
    ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=5e-3),
    omega_c=1.0,
    learner=ql.learners.Kalman(),
)
scenario = ql.Scenario(
    reference=1.0,
    disturbances=(0.0, ql.signals.Chirp(0.5, 0.1, 1.0, duration=60.0, start=30.0)),
    duration=90.0,
)
run = ql.simulate(ql.plants.two_mass_spring(), controller, scenario)

print("channels:", ", ".join(run.names))
print("step:", {name: round(value, 4) for name, value in run.metrics(0.0, 30.0).items()})
print(
    "coefficients at the end:",
    {name: round(value, 3) for name, value in controller.read(run.final_state).theta.items()},
)

data = run.to_xarray()
print(
    "RMS error by half minute:",
    ((data.r - data.y) ** 2).groupby((data.time // 30).astype(int)).mean().round(6).values,
)

with tempfile.TemporaryDirectory() as folder:
    run.save(Path(folder) / "run.nc")
    again = ql.Trajectory.load(Path(folder) / "run.nc")
    axes = again.plot()
    axes[0].figure.savefig(Path(folder) / "run.png")
    print("written:", sorted(path.name for path in Path(folder).iterdir()))
