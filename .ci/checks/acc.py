"""Designs in drawn, uncertain and published plants. Arguments: JSON file, file of the latter."""

import json
import sys
from pathlib import Path

import numpy as np

from quell.experiments import acc
from quell.experiments.acc import study
from quell.experiments.acc.loops import FREE_POLES, MB, MF, OURS, L

found, published = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
ours = {name: controller for name, controller in acc.designs().items() if name in OURS}
wide = acc.generated(60, 3.0, seed=5)
for spring, cubic in acc.SPRINGS.items():
    assert found[spring]["published nominal"]["failure_rate"] > 0.3
    best = min(
        np.mean(acc.judge_published(design, wide, cubic).fails) for design in acc.PUBLISHED.values()
    )
    assert best > 0.4, (spring, best)
    for name, controller in ours.items():
        assert found[spring][name]["failure_rate"] <= {"linear": 0.005, "cubic": 0.02}[spring], (
            spring,
            name,
        )
        rate = np.mean(acc.judge_sampled(controller, wide, cubic).fails)
        assert rate < 0.5 * best, (spring, name, rate, best)
        if published.is_file():
            rate = np.mean(acc.judge_sampled(controller, acc.read(published), cubic).fails)
            assert rate <= {"linear": 0.005, "cubic": 0.01}[spring], (spring, name, rate)
print(
    "ours fail less than the published ones",
    "" if published.is_file() else f"(no samples at {published})",
)

boxed, rates = acc.boxed(60, 9), []
for name in (MF, FREE_POLES):
    controller = acc.designs()[name]
    judged = acc.judge_sampled(controller, boxed, cubic=True)
    (scores,) = study.scores(controller, list(boxed))
    assert np.array_equal(np.round(scores), judged.fails)
    settled = ~judged.fails
    assert np.all(np.diff(scores[settled][np.argsort(judged.late_peak[settled])]) >= -1e-12)
    rates.append(np.mean(judged.fails))
assert rates[1] < 0.7 * rates[0], rates
print("poles of their own fail less in a box of plants")

cases = found["cases"]
for name in OURS:
    case = cases[name]
    assert case["stable_from"] < (0.6 if name == MB else 0.5) and case["stable_to"] > 2.0, (
        name,
        case,
    )
    assert case["settled_at"] < 15.0 and case["margins"]["modulus"] > 0.4, (name, case)
learned, mf = cases[L], cases[MF]
assert (
    learned["load_peak"] < 0.11 < 0.4 < mf["load_peak"]
    and learned["load_remains"] < 0.005 < 0.4 < mf["load_remains"]
), cases
print("the design cases of the original problem are met")
