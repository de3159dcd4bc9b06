"""Prefilters of the reference: reference models, tracking differentiator, input shaping.

May import ``controllers`` (base files only), ``lti`` and ``kernels``.
"""
