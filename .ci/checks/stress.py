"""``quell stress``: no loop is lost or harmed, honest learners are heard. Argument: JSON file."""

import json
import sys
from pathlib import Path

result = json.loads(Path(sys.argv[1]).read_text())
found, honest = result["adversarial"], result["honest"]
assert found["runs"] == 120 and found["unstable_where_plain_is_stable"] == 0
assert found["ratio"]["p99"] <= 1.1 and found["ratio"]["max"] <= 1.5, found["ratio"]
assert found["load_ratio"]["p99"] <= 1.5, found["load_ratio"]
assert honest["unstable"] == 0 and honest["load_ratio"]["median"] <= 0.20, honest["load_ratio"]
assert honest["load_ratio"]["p99"] <= 1.05 and honest["load_ratio"]["max"] <= 1.2, honest[
    "load_ratio"
]
assert honest["late_ratio"]["median"] <= 0.02, honest["late_ratio"]
print("no loop is lost or harmed, and honest learners are heard")
