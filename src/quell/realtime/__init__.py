"""Real time: a controller closed around a device at a fixed rate, with a stated safe action for whatever goes wrong."""
