"""Results of a search: its candidates, the best one, and the Pareto front of several objectives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from quell.files import nonfinite_to_none
from quell.tuning.simulated.space import Space


@dataclass(frozen=True)
class Candidate:
    """Values of the parameters that were tried, and the objectives that they reached."""

    number: int
    parameters: dict[str, float]
    values: dict[str, float]  #: by name of the objective; empty if it was given up early
    violation: float  #: by how much it violates constraints; it was not simulated then
    finished: bool  #: whether it was simulated on all samples
    reason: str = ""  #: why its values were rejected; empty if they were not

    def dominates(self, other: Candidate) -> bool:
        """Whether no objective of this one is worse, and one is better."""
        pairs = [(value, other.values[name]) for name, value in self.values.items()]
        return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


@dataclass(frozen=True)
class Search:
    """The result of a search by simulation."""

    objectives: Sequence[str]
    space: Space
    candidates: Sequence[Candidate]  #: in the order in which they were tried

    @property
    def front(self) -> list[Candidate]:
        """The finished candidates that no other one dominates, by their first objective.

        Of candidates with equal objectives the first one counts.
        """
        possible = [c for c in self.candidates if c.finished and _is_finite(c)]
        seen: dict[tuple[float, ...], Candidate] = {}
        for one in possible:
            if not any(other.dominates(one) for other in possible):
                seen.setdefault(tuple(one.values.values()), one)
        return [seen[key] for key in sorted(seen)]

    @property
    def best(self) -> Candidate:
        """The candidate with the least objective.

        Raises ``ValueError`` if there are several objectives, of which ``front`` has the best ones,
        or if no candidate was possible.
        """
        if len(self.objectives) > 1:
            names = ", ".join(self.objectives)
            raise ValueError(f"best: there are several objectives ({names}); choose from front")
        found = self.front
        if not found:
            raise ValueError(
                f"none of {len(self.candidates)} candidates is possible: {self._why_none()}"
            )
        return found[0]

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``; None for infinite numbers."""
        rows = [
            {
                "number": c.number,
                "parameters": c.parameters,
                "values": nonfinite_to_none(c.values),
                "violation": c.violation,
                "finished": c.finished,
            }
            for c in self.candidates
        ]
        front = [c.number for c in self.front]
        return {"objectives": list(self.objectives), "candidates": rows, "front": front}

    def _why_none(self) -> str:
        reasons = [c.reason for c in self.candidates if c.reason]
        if len(reasons) == len(self.candidates):
            return f"their values are rejected, the last ones because of: {reasons[-1]}"
        least = min((c.violation for c in self.candidates if c.violation > 0.0), default=math.inf)
        if all(c.violation > 0.0 for c in self.candidates):
            return f"all violate the constraints, the best one by {least:.3g}; widen the ranges"
        return "the others have infinite objectives; widen the ranges or weaken the scenario"


def _is_finite(candidate: Candidate) -> bool:
    return all(map(math.isfinite, candidate.values.values()))
