"""Without a guard, hostile learners make loops unstable."""

import math

from quell.experiments import stress

found = [one for seed in range(3) for one in stress.run(10, 0, seed=seed, guard=None).outcomes]
assert {one.kind for one in found} == set(stress.KINDS[:10])
assert stress.summary(found)["unstable_where_plain_is_stable"] >= 8, stress.summary(found)
assert all(math.isnan(one.ratio) == one.unstable for one in found)
print("without guard, loops are lost")
