"""Manual operation and back, without and with ``hand_over``: a lift under load."""

import matplotlib.pyplot as plt
import numpy as np

import quell as ql

DT = 2e-3
observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=40.0, dt=DT)
figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7.5, 4.2), layout="constrained")
for hand_over in (False, True):
    controller, y, speed, rows = ql.ADRC(observer, omega_c=4.0), 0.0, 0.0, []
    for k in range(2500):
        if k < 1000:
            u = 3.0 + 0.4 * np.sin(0.01 * k)  # the operator's
            controller.track(1.0, y, u)
        else:
            if k == 1000 and hand_over:
                controller.hand_over()
            u = controller.step(1.0, y)
        rows.append((k * DT, y, u))
        speed += DT * (2.0 * (u - 3.0) - 0.6 * speed)
        y += DT * speed
    t, height, control = np.transpose(rows)
    axes[0].plot(t, height, label="with hand_over" if hand_over else "without")
    axes[1].plot(t, control)
axes[0].set_ylabel("height [m]"), axes[1].set_ylabel("u [V]"), axes[1].set_xlabel("t [s]")
axes[0].legend()
plt.show()
