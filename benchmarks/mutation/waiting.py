"""How long a process waited for a core, so that a limit of time holds on a busy machine, too."""

from __future__ import annotations

from pathlib import Path


def waited(process: int | str = "self") -> float:
    """Return how long the first thread of a process could run and did not [s].

    It is 0 where the system does not tell (Linux does), and where the process has ended.
    """
    try:
        return float(Path(f"/proc/{process}/schedstat").read_text().split()[1]) * 1e-9
    except (OSError, IndexError):
        return 0.0
