"""Start-up time: import, help, first step, second run of the study. Best of several processes.

python benchmarks/startup.py
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time

from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

# Prints the time of the first step [s].
FIRST_STEP = """
import time
import quell as ql
controller = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=0.01), omega_c=2.0)
began = time.perf_counter()
controller.step(1.0, 0.0)
print(time.perf_counter() - began)
"""


def best(command: list[str], trials: int) -> float:
    """Return the shortest time a command took [s]."""
    found = float("inf")
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(trials):
            began = time.perf_counter()
            subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
            found = min(found, time.perf_counter() - began)
    return found


def first_step(trials: int) -> float:
    """Return the shortest time of a first step; only the first process may compile [s]."""
    command = [sys.executable, "-c", FIRST_STEP]
    return min(float(subprocess.check_output(command)) for _ in range(trials))


def main() -> None:
    """Time all of them and print one table."""
    parser = parser_of(__doc__)
    parser.add_argument("--trials", type=int, default=7, help="of which the best counts")
    options = options_of(parser, trials=1)
    trials = options.trials
    python = [sys.executable, "-c"]
    bare = best([*python, "pass"], trials)
    rows = [
        ("import quell", best([*python, "import quell"], trials) - bare, 0.3),
        ("first step of an ADRC of order 2, cache warm", first_step(trials), 0.3),
        ("quell --help", best([sys.executable, "-m", "quell", "--help"], trials), 0.6),
        (
            "quell reproduce two-mass, cache warm, with figures",
            best([sys.executable, "-m", "quell", "reproduce", "two-mass"], min(trials, 4)),
            5.0,
        ),
    ]
    table = Table("what", "measured [s]", "bar [s]")
    for what, took, bar in rows:
        table.add_row(what, f"{took:.3f}", f"≤ {bar:g}")
    Console().print(table)
    write(options, {f"{what} [s]": took for what, took, _ in rows})


if __name__ == "__main__":
    main()
