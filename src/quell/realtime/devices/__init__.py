"""Devices: what a loop reads y from and writes u to, and how a URL names one.

May import ``plants``, ``simulation``, and ``realtime.system``.
"""
