"""Plants from FMU files: the archive, the variables, running instances, and the plant itself.

May import ``lti``, ``kernels`` and what stands before them, and ``plants.base``. FMPy, which reads
and calls FMUs, is imported where it is used: the extra ``fmi`` installs it.
"""
