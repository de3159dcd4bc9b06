"""L-ESO keeps what it promises at the torsional testbed. Arguments: the study's JSON files."""

import json
import sys
from pathlib import Path

for file in sys.argv[1:]:
    cases = {
        (case["omega_c"], case["omega_o"]): case
        for case in json.loads(Path(file).read_text())["cases"]
    }
    assert list(cases) == [(90.0, 40.0), (40.0, 90.0), (20.0, 90.0)], list(cases)
    for each in (part for case in cases.values() for part in (case, case["linear"])):
        assert list(each["controllers"]) == [
            "MF-ESO",
            "MB-ESO",
            "L-ESO",
            "MB-ESO (10 % off)",
            "L-ESO (guarded)",
        ]
        for score in each["controllers"].values():
            assert set(score) >= {"overshoot", "settling_time", "control_variation"}, score
        assert all(
            set(claim) >= {"claim", "paper", "measured", "holds"} for claim in each["claims"]
        )
    friction, linear = (
        {at: part["controllers"] for at, part in each.items()}
        for each in (cases, {at: case["linear"] for at, case in cases.items()})
    )
    # docs/torsional, within a count and a half of the encoder, and 20 ms
    for name, overshoot, settling in (
        ("MF-ESO", 0.0066, 3.84),
        ("MB-ESO", 0.0001, 2.26),
        ("L-ESO", 0.0003, 2.26),
    ):
        found = linear[20.0, 90.0][name]
        assert abs(found["overshoot"] - overshoot) <= 1.5 * 2.0 / 16_000, (name, found)
        assert abs(found["settling_time"] - settling) <= 0.02, (name, found)
    for plant in (friction, linear):
        learned, mf, off = (
            plant[20.0, 90.0][name] for name in ("L-ESO", "MF-ESO", "MB-ESO (10 % off)")
        )
        assert learned["overshoot"] <= 0.001 and learned["settling_time"] <= 2.4, learned
        for key in ("overshoot", "settling_time"):
            assert learned[key] < mf[key] and learned[key] <= off[key], (key, learned, mf, off)
        assert learned["control_variation"] <= 0.9 * mf["control_variation"]
        for at, asked in (((90.0, 40.0), 1.995), ((40.0, 90.0), 2.073)):
            learned = plant[at]["L-ESO"]
            assert (
                abs(learned["settling_time"] - asked) <= 0.01 and learned["overshoot"] <= 0.0015
            ), (at, learned)
    # On the linear plant most of what the guard sees is encoder noise: the guarded learner does not
    # settle from all starts with all seeds (docs/torsional), so its overshoot alone is judged.
    for plant, keys in ((friction, ("overshoot", "settling_time")), (linear, ("overshoot",))):
        free, guarded, plain = (
            plant[20.0, 90.0][name] for name in ("L-ESO", "L-ESO (guarded)", "MF-ESO")
        )
        for key in keys:
            half = free[key] + 0.5 * (plain[key] - free[key])
            assert guarded[key] is not None and guarded[key] < half, (file, key, guarded)
print("L-ESO keeps what it promises at the testbed")
