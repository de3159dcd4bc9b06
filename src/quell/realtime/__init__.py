"""Closing the loop at a fixed rate: devices, the loop itself, and what it tells while it runs."""
