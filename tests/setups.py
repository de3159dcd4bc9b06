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
