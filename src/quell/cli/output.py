"""What all commands do around their work: places are looked at before it, told of while it goes on, written to after it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, ProgressColumn, TextColumn
from rich.progress import Progress as ProgressBar

from quell.controllers import Controller
from quell.experiments.common.figures import make_folder
from quell.files import check_writable, write_json
from quell.kernels.dispatch import compilations
from quell.plants import Plant
from quell.simulation import Scenario, simulate
from quell.simulation.driver import run_block
from quell.types import Progress


def check_places(json_file: Path | None, figures: Path | None, record: Path | None = None) -> None:
    """Say what can't be written to before the work is done; make the folder.

    Raises
    ------
    ValueError
        for a file that can't be written, or a folder that can't be made.
    """
    for file in (json_file, record):
        if file is not None:
            check_writable(file)
    if figures is not None:
        make_folder(figures)


def compile_loops(console: Console, loops: Sequence[tuple[Plant, Controller]]) -> None:
    """Compile the loops that a study needs, or load them; where that takes long, say so and how long it took."""
    began = time.perf_counter()
    with console.status(
        "Compiling what is not in the cache: some ten seconds, once for this version."
    ):
        for plant, controller in loops:
            simulate(
                plant,
                controller,
                Scenario(duration=10 * controller.dt, rest_at=(5 * controller.dt,)),
            )
    compiled = compilations(run_block)
    if compiled:
        console.print(
            f"First run of this version: {compiled} loops compiled in {time.perf_counter() - began:.1f} s, and kept for later runs."
        )


@contextmanager
def progress_bar(
    console: Console, first: str = "simulating", *more: ProgressColumn, width: int = 0
) -> Iterator[Progress]:
    """Show a bar while the work goes on; ``first`` stands at it until something is told, in ``width`` places at least."""
    with ProgressBar(
        TextColumn(f"{{task.description:<{width}}}"),
        BarColumn(),
        *more,
        console=console,
        transient=True,
    ) as bar:
        task = bar.add_task(first, total=1.0)
        yield lambda what, share: bar.update(task, description=what, completed=share)


def write_results(
    console: Console,
    value: Any,
    json_file: Path | None,
    paths: Sequence[Path],
    figures: Path | None,
) -> None:
    """Write the results, where they are wanted, and say where they and the figures ``paths`` are."""
    if paths:
        names = sorted({path.stem for path in paths})
        noun = "Figures" if len(names) > 1 else "Figure"
        console.print(
            f"{noun}: {', '.join(names)} (PNG and SVG) in {escape(str(figures))}/", soft_wrap=True
        )
    if json_file is not None:
        write_json(json_file, value)
        console.print(f"Results: {escape(str(json_file))}", soft_wrap=True)
