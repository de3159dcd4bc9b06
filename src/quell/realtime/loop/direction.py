"""A check of the signs of y, u and b0 by the first motion after the controller takes over.

With one of the signs wrong the loop has positive feedback: y leaves its place of rest against the
push of u, and ``|r − y|`` grows by a factor e in about 1/omega_c. A load, a zero in the right half
plane and noise move y against u as well, but not so far. So the run ends only if

1. y first moves (beyond its noise before the run, and 2 % of the reach of u) against the sum of
   ``sign(b0) u`` so far, while the reference already goes the other way and is further away from
   the place of rest than y. A load that moves y before the reference moves ends the check. So
   does a first motion in the right direction: signs do not change during a run;
2. y then goes on to twice the largest of three distances: the reference's distance from the
   place of rest, the reach of u (``quell.realtime.loop.bounds.reach``), and ten times the noise;
   while u pushes the other way with at least half of its limit.

The numbers come from random honest loops with loads, friction, delays, zeros in the right half
plane and learners, and the same loops with a wrong sign: ``benchmarks/direction.py``.
"""

from __future__ import annotations

from quell.kernels.dispatch import kernel
from quell.realtime.loop.state import Memory, Rules

OFF, ARMED, SUSPECT = 0, 1, 2
"""Values of ``Memory.watching``: no check, no motion so far, y first moved against u."""

# Shares of the reach of u that count as a motion, and as a motion in the right direction later on.
_MOTION, _RIGHT = 0.02, 0.05
# Range of y before the run, times this, is noise: ten times what was seen in that short time.
_NOISE = 10.0
# Twice the largest distance: honest loops came to 1.07 of it, under a load of half of u's limit.
_FAR = 2.0
_STRONG = 0.5  # share of a limit of u


@kernel
def runs_away(rules: Rules, memory: Memory, r: float) -> bool:
    """Return whether y runs away against u, in a sample of RUN with the reference ``r``.

    ``memory.u`` is the u that acted until this sample.
    """
    if memory.watching == OFF:
        return False
    push = rules.direction * memory.u
    memory.pushed += push
    moved, wanted = memory.y - memory.y_began, r - memory.y_began
    against = moved * memory.pushed < 0.0
    noise = _NOISE * (memory.y_rest_high - memory.y_rest_low)
    if memory.watching == ARMED and abs(moved) > max(noise, _MOTION * rules.reach):
        first = against and wanted * memory.pushed > 0.0 and abs(wanted) >= abs(moved)
        memory.watching = SUSPECT if first else OFF
    if memory.watching != SUSPECT or push * memory.pushed <= 0.0:
        return False
    if not against:
        if abs(moved) > max(noise, _RIGHT * rules.reach):
            memory.watching = OFF
        return False
    limit = rules.high if memory.u > 0.0 else -rules.low
    far = _FAR * max(abs(wanted), rules.reach, noise)
    return abs(memory.u) >= _STRONG * limit and abs(moved) > far
