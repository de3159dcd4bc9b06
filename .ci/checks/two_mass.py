"""The figures of ``quell reproduce two-mass`` are within their bars. Argument: its JSON file."""

import json
import sys
from pathlib import Path

result = json.loads(Path(sys.argv[1]).read_text())
names = [
    "MF-ESO",
    "MB-ESO",
    "L-ESO",
    "L-ESO (Algorithm 1)",
    "MF-ESO (3x bandwidth)",
    "MB-ESO (3x bandwidth)",
    "MF-ESO m = 2",
    "MB-ESO m = 2",
    "L-ESO, guarded",
]
keys = {"overshoot", "settling_time", "disturbance_peak", "disturbance_rms", "control_variation"}
assert list(result["controllers"]) == names, list(result["controllers"])
scores = result["controllers"]
assert all(keys <= set(score) for score in scores.values())
assert all(isinstance(score[key], float) for score in scores.values() for key in keys)
assert all({"claim", "paper", "measured", "holds"} <= set(claim) for claim in result["claims"])
mf, mb, mf3 = (scores[name] for name in ("MF-ESO", "MB-ESO", "MF-ESO (3x bandwidth)"))
assert 0.004 <= mf["overshoot"] <= 0.005 and 16.4 <= mf["settling_time"] <= 16.8
assert mb["overshoot"] <= 0.0005 and 12.0 <= mb["settling_time"] <= 12.4
for learned in (scores["L-ESO"], scores["L-ESO, guarded"]):
    assert learned["overshoot"] <= 0.001 and learned["settling_time"] <= 12.3
    assert learned["disturbance_peak"] <= mf3["disturbance_peak"]
    assert learned["control_variation"] <= 1.1 * mf["control_variation"]
print("the study's figures are within their bars")
