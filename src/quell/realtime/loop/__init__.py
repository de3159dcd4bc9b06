"""The real-time loop: cycle, supervisor, safety rules, result of a run, and replay.

May import ``controllers``, ``simulation`` and the other folders of ``realtime`` except ``rig``.
"""
