"""Judge a model that was identified and what was tuned: ``model_and_tuning.py MODEL TUNING``."""

import json
import sys
from pathlib import Path

model, tuning = (json.loads(Path(name).read_text()) for name in sys.argv[1:])
assert model["fits"]["held out"] >= 99.0, model["fits"]
print("the twin is found again")
iae = {name: design["measures"]["iae"] for name, design in tuning["designs"].items()}
assert iae["poles"] <= 1.001 * iae["pid"] <= 1.001 * iae["pi"], iae
assert tuning["design"]["measures"]["iae"] <= 1.05 * min(iae.values()), iae
print("poles of their own serve no worse than the optimal PID controller, nor does the default")
