"""Prefilters of the reference: reference models, moves within limits, input shaping and others.

May import ``controllers`` (base files, ``adrc``), ``lti``, ``signals`` and ``kernels``.
"""
