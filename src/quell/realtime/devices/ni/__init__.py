"""Cards of National Instruments: the driver with its errors, its tasks, and the device.

May import ``realtime.devices`` (base file only) and ``realtime.system``.
"""
