"""Running machines, from their logs: which tuning was best, and what changes over months.

May import ``commissioning``, ``identification``, ``records``, ``realtime`` and what these import.
"""

from quell.lazy import public_names
from quell.monitoring.rank import Comparison, Ranking, Scores, rank
from quell.monitoring.watch import Alarm, Machine, Watch, WatchSink
from quell.monitoring.windows import Signals, features_of, windows_of

__all__ = [
    "Alarm", "Comparison", "Machine", "Ranking", "Scores", "Signals", "Watch", "WatchSink",
    "features_of", "rank", "windows_of"
]  # fmt: skip

__dir__ = public_names(__name__)
