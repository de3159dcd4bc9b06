"""Without a guard, hostile learners make loops unstable."""

import math

from quell.experiments import stress

found = [one for seed in range(3) for one in stress.run(10, 0, seed=seed, guard=None).outcomes]
assert {one.kind for one in found} == set(stress.KINDS[:10])
counts = stress.summary(found, stress.Errors)
assert counts["lost"] >= 8, counts
assert all(math.isinf(one.guarded.whole) == one.lost for one in found)
print("without guard, loops are lost")
