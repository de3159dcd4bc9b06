"""Random loops of the trial: plants, references, loads, margins.

May import ``experiments.stress.general.program`` and what that imports.
"""

from quell.experiments.stress.general.loops.loop import GeneralLoop, draw_loop
from quell.experiments.stress.general.loops.plant import GeneralPlant
from quell.experiments.stress.general.loops.random_plants import FAMILIES

__all__ = ["FAMILIES", "GeneralLoop", "GeneralPlant", "draw_loop"]
