"""FMUs of FMI 3.0: a controller, a plant or a loop as C sources and a binary, with a description.

``sources`` has the C files that every FMU contains: the functions of FMI. The headers of the
Modelica Association come from the installed FMPy (extra ``fmi``). May import everything in
``export``.
"""

from quell.export.fmi.fmu import fmu

__all__ = ["fmu"]
