"""From a rig to a tuned controller: an experiment within limits, and a verifying step.

``records`` reads input and output from files of any kind, recordings and saved runs included.

May import ``realtime``, ``tuning``, ``identification`` and what they import.
"""

from quell.commissioning.experiment import Experiment, experiment
from quell.commissioning.limits import Limits
from quell.commissioning.verification import Verification, verify

__all__ = ["Experiment", "Limits", "Verification", "experiment", "verify"]
