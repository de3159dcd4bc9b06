"""A guarded learner in single precision is the same compiled, interpreted and step by step."""

import numpy as np

import quell as ql

plant = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [1.0, 0.0])
scenario = ql.Scenario(
    ql.signals.Sinusoid(omega=1.5),
    4.0,
    (0.3 * ql.signals.Step(at=1.0),),
    ql.signals.BandLimitedNoise(1e-8, 0.01),
    rest_at=(3.0,),
)
observer = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.1, dt=0.01)
law = ql.ADRC(observer, 1.5, learner=ql.learners.Kalman(), guard=ql.Guard(), u_max=9.0)
run, plain = (
    ql.simulate(plant, law, scenario, precision="single", interpret=on) for on in (False, True)
)
stepped = ql.controllers.in_single_precision(law)
u = [stepped.step(r, y) for r, y in zip(run["r"], run["y_measured"], strict=True)]
size = np.sqrt(np.mean(plain["u"] ** 2))
assert np.sqrt(np.mean((run["u"] - plain["u"]) ** 2)) < 1e-5 * size
assert np.max(np.abs(u[:300] - run["u"][:300])) < 1e-6 * size
assert np.array_equal(run["u"], run["u"].astype(np.float32))
print("a guarded learner computes in single precision")
