"""Cards of National Instruments: the driver with its errors, its tasks, and the device."""
