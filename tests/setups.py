"""Setup files that several tests begin with."""

TWO_MASS = """
dt = 0.01
[plant]
kind = "two-mass"
[observer]
kind = "model-free"
order = 4
b0 = 1.0
omega_o = 10.0
[controller]
omega_c = 1.0
"""

GANTRY = """
dt = 1e-3
plant = { kind = "linear", A = [[0, 1, 0, 0], [0, -2, 0, 0], [0, 0, 0, 1], [0, 0, 0, -3]], B = [[0, 0], [5, 0.5], [0, 0], [0.4, 6]], C = [[1, 0, 0, 0], [0, 0, 1, 0]] }
axes = { B0 = "plant", u_max = [20.0, 30.0], u_min = -25.0 }
scenario = { duration = 0.5, disturbances = [0.0, { kind = "step", at = 0.2 }], seed = 3 }
[[axis]]
name = "x"
observer = { kind = "model-free", order = 2, omega_o = 60.0 }
controller = { omega_c = 8.0 }
reference = { kind = "step", height = 0.1 }
[[axis]]
name = "y"
observer = { kind = "model-free", order = 2, omega_o = 60.0 }
controller = { omega_c = 8.0 }
noise = { kind = "noise", power = 1e-12, sample_time = 1e-3 }
[[metrics]]
start = 0.1
"""
