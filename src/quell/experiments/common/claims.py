"""A published claim, the measured value, and whether the claim holds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Claim:
    """One claim of a paper, judged by a stated rule; it does not hold without a measured value."""

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
        """Judge a value that must lie within ``tolerance`` of the paper's."""
        holds = measured is not None and abs(measured - paper) <= tolerance
        return cls(claim, paper, measured, holds, f"{paper:g} ± {tolerance:g}", unit)

    @classmethod
    def below_one(cls, claim: str, measured: float | None) -> Claim:
        """Judge a ratio that must be below 1, by at least one per cent."""
        return cls(claim, "below 1", measured, measured is not None and measured <= 0.99, "≤ 0.99")

    @classmethod
    def above_one(cls, claim: str, measured: float | None) -> Claim:
        """Judge a ratio that must be above 1, by at least one per cent."""
        return cls(claim, "above 1", measured, measured is not None and measured >= 1.01, "≥ 1.01")

    @classmethod
    def at_least(cls, claim: str, paper: float, measured: float | None) -> Claim:
        """Judge a value that must reach the paper's, which is rounded: 3 is reached from 2.5 on."""
        least = paper - 0.5
        holds = measured is not None and measured >= least
        return cls(claim, paper, measured, holds, f"≥ {least:g}")

    @classmethod
    def at_most(
        cls, claim: str, paper: str, measured: float | None, most: float | None, unit: str = ""
    ) -> Claim:
        """Judge a value that must not exceed another; the claim holds if there is no other."""
        holds = measured is not None and (most is None or measured <= most * (1.0 + 1e-9))
        return cls(claim, paper, measured, holds, "any" if most is None else f"≤ {most:.5g}", unit)


def ratio(value: float | None, reference: float | None) -> float | None:
    """Return ``value / reference``; None if either is missing or the reference is zero."""
    return None if value is None or not reference else value / reference
