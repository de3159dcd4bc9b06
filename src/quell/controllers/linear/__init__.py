"""Sampled linear controllers: state space, transfer functions, anti-windup.

May import ``controllers`` (base files only), ``lti`` and ``kernels``.
"""
