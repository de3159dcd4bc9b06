"""Running machines, from their logs: which tuning was best, and what changes over months.

May import ``identification``, ``records``, ``realtime`` and what these import.
"""

from quell.monitoring.rank import Comparison, Ranking, Scores, rank

__all__ = ["Comparison", "Ranking", "Scores", "rank"]
