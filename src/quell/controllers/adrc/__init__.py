"""Active disturbance rejection control: law around an observer, estimate, hand-over.

May import ``controllers`` (base files only), ``guard``, ``learners``, ``observers`` and what they
import.
"""
