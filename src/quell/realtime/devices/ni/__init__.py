"""Cards of National Instruments: the driver and its errors, tasks and channels, and the device."""
