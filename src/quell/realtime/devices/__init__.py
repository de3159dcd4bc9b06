"""Devices: what the loop reads y from and writes u to, and the table of their URLs.

May import ``plants`` and ``realtime.system``.
"""
