"""Start under load, manual operation and retuning, without a jump of the control signal."""

import quell as ql

DT = 2e-3
WEIGHT, U_HOLD = -3.0, 3.0  # a load, and the control signal that holds it
controller = ql.ADRC(
    ql.ESO.model_free(order=2, b0=2.0, omega_o=40.0, dt=DT), omega_c=4.0, u_min=-10.0, u_max=10.0
)
height = speed = largest_jump = 0.0
u = U_HOLD

for k in range(4000):
    if k < 500:
        before, u = u, U_HOLD + 0.001 * (k % 250)  # manual operation
        controller.track(r=1.0, y=height, u=u)
        jump = 0.0
    else:
        if k == 500:
            controller.hand_over()
        if k == 1200:
            controller.retune(omega_c=8.0)
        if k == 3000:
            controller.start(height, u)  # switched off and on again
        before, u = u, controller.step(r=1.0, y=height)
        jump = abs(u - before)
    largest_jump = max(largest_jump, jump)
    speed += DT * (2.0 * (u + WEIGHT) - 0.6 * speed)
    height += DT * speed

print(f"height {height:.4f}, largest jump of u in one sample {largest_jump:.3f}")
