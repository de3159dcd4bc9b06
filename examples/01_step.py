"""Step response of a flexible drive: an observer without model, with model, and with a learner."""

import quell as ql

DT = 2e-3
plant = ql.plants.two_mass_spring(m1=1.0, m2=0.5, k=2.0)
gain = ql.canonical(plant).b
observers = {
    "MF-ESO": (ql.ESO.model_free(order=4, b0=gain, omega_o=12.0, dt=DT), None),
    "MB-ESO": (ql.ESO.model_based(plant, omega_o=12.0, dt=DT), None),
    "L-ESO": (ql.ESO.model_free(order=4, b0=gain, omega_o=12.0, dt=DT), ql.learners.Kalman()),
}
scenario = ql.Scenario(
    reference=ql.signals.Sinusoid(omega=0.8).until(60.0, then=ql.signals.Step(at=60.0)),
    disturbances=(0.0, ql.signals.Step(height=0.5, at=90.0)),
    noise=ql.signals.BandLimitedNoise(power=1e-12, sample_time=0.01),
    duration=120.0,
    rest_at=(60.0,),
)

for name, (observer, learner) in observers.items():
    run = ql.simulate(plant, ql.ADRC(observer, omega_c=1.2, learner=learner), scenario)
    step, load = run.metrics(60.0, 90.0), run.metrics(90.0)
    print(
        f"{name}: overshoot {100 * step['overshoot']:.2f} %, settles in "
        f"{step['settling_time']:.1f} s, "
        f"error under load {load['peak_error']:.3f} m"
    )
