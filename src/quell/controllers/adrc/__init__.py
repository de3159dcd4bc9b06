"""Active disturbance rejection control: the control law around an observer, its estimate, and hand-over.

May import ``controllers`` (base files only), ``guard``, ``learners``, ``observers`` and what they
import.
"""
