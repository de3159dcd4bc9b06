"""Prefilters of the reference: reference models, tracking differentiator, input shaping.

May import ``controllers`` (base files, ``adrc``), ``lti`` and ``kernels``.
"""
