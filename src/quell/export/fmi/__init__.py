"""FMUs of FMI 3.0: a controller, a plant or a loop as C sources and a binary, with a description.

``sources`` has the C files that every FMU contains: the functions of FMI, and the headers of the
Modelica Association with their licence (BSD, two clauses). May import everything in ``export``.
"""

from quell.export.fmi.fmu import fmu

__all__ = ["fmu"]
