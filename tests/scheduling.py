"""Which worker runs which test files: files that compile run in as few processes as possible."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from xdist.scheduler import LoadFileScheduling

# Files that compile the same loops run in one process.
GROUPS = {
    "two masses": (
        "published/test_two_mass_study",
        "test_batch",
        "test_guarded_loops",
        "test_harmonic",
        "test_sized",
    ),
    "fits": (
        "test_identification",
        "test_identification_parts",
        "test_running_loop_parts",
        "test_short_records",
        "test_small_identifications",
        "test_spectral_parts",
        "test_step_records",
        "test_tests_of_errors",
    ),
    "Python models": ("contracts/test_contracts", "test_adapters"),
}
_GROUP_OF = {f"tests/{file}.py": name for name, files in GROUPS.items() for file in files}


def compiled_first(items: list[pytest.Item]) -> None:
    """Sort the tests by the share of compiled tests in their files; the order in a file stays."""
    tests = Counter(item.path for item in items)
    marked = Counter(item.path for item in items if item.get_closest_marker("compiled"))
    items.sort(key=lambda item: -marked[item.path] / tests[item.path])


class FromBothEnds(LoadFileScheduling):
    """Give whole files to the workers, from the first on and from the last on in turn.

    A process compiles each kernel once. With ``compiled_first`` the workers that begin at the front
    compile most of the kernels, and the others run the tests that compile none, until they meet.
    """

    def _split_scope(self, nodeid: str) -> str:
        """Return the name of what a test is handed out with: its file, or a group of files."""
        file = super()._split_scope(nodeid)
        return _GROUP_OF.get(file, file)

    def _assign_work_unit(self, node: Any) -> None:
        """Give a worker the next file: for every second one of them, that is the last."""
        if self.nodes.index(node) % 2:
            self.workqueue.move_to_end(next(reversed(self.workqueue)), last=False)
        super()._assign_work_unit(node)
