"""A published claim, what we measure, and whether it holds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Claim:
    """One claim of a paper, judged by a stated rule; what could not be measured does not hold."""

    claim: str
    paper: float | str
    measured: float | None
    holds: bool
    rule: str
    unit: str = ""

    @classmethod
    def near(
        cls, claim: str, paper: float, measured: float | None, tolerance: float, unit: str = ""
    ) -> Claim:
        """Judge a figure: it holds within ``tolerance``."""
        holds = measured is not None and abs(measured - paper) <= tolerance
        return cls(claim, paper, measured, holds, f"{paper:g} ± {tolerance:g}", unit)

    @classmethod
    def below_one(cls, claim: str, measured: float | None) -> Claim:
        """Judge a ratio that should be below 1: by a part in a hundred at least."""
        return cls(claim, "below 1", measured, measured is not None and measured <= 0.99, "≤ 0.99")

    @classmethod
    def above_one(cls, claim: str, measured: float | None) -> Claim:
        """Judge a ratio that should be above 1: by a part in a hundred at least."""
        return cls(claim, "above 1", measured, measured is not None and measured >= 1.01, "≥ 1.01")

    @classmethod
    def at_least(cls, claim: str, paper: float, measured: float | None) -> Claim:
        """Judge a rounded figure that should be reached: 3 holds from 2.5 on."""
        return cls(
            claim,
            paper,
            measured,
            measured is not None and measured >= paper - 0.5,
            f"≥ {paper - 0.5:g}",
        )

    @classmethod
    def at_most(
        cls, claim: str, paper: str, measured: float | None, most: float | None, unit: str = ""
    ) -> Claim:
        """Judge a figure against another that was measured; where that could not be, there is nothing to exceed."""
        holds = measured is not None and (most is None or measured <= most * (1.0 + 1e-9))
        return cls(claim, paper, measured, holds, "any" if most is None else f"≤ {most:.5g}", unit)
