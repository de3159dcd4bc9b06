"""``quell stress``: no loop is lost or harmed, honest learners are heard. Argument: JSON file."""

import json
import sys
from pathlib import Path

result = json.loads(Path(sys.argv[1]).read_text())
assert (result["hostile"]["loops"], result["honest"]["loops"]) == (30, 60)
assert len(result["bars"]) == 8
missed = [bar for bar in result["bars"] if not bar["met"]]
assert not missed, missed
print("no loop is lost or harmed, and honest learners are heard")
