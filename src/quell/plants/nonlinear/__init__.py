"""Plants whose equations the user writes as Python functions.

May import ``lti``, ``kernels`` and what stands before them, and ``plants.base`` and
``plants.labelled``.
"""
