"""The trial on flexible axes: plants with zeros, and observers that are built on a model.

May import ``experiments.stress`` beside it and what that imports.
"""

from quell.experiments.stress.axes.loops import STRUCTURES, Axis, draw_axis
from quell.experiments.stress.axes.trial import AxesResult, AxisOutcome, run, run_one

__all__ = ["STRUCTURES", "AxesResult", "Axis", "AxisOutcome", "draw_axis", "run", "run_one"]
