"""Common parts of the speed benchmarks: the two-mass loop in C (``reference.c``), timing, table."""

from __future__ import annotations

import ctypes
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.experiments import two_mass_spring as study

SOURCE = Path(__file__).with_name("reference.c")


def c_reference(
    folder: Path, settings: study.Settings, duration: float = study.END, learns: bool = True
) -> Callable[[bool], np.ndarray]:
    """Build ``reference.c``; return a function that runs the study's L-ESO in it.

    Without ``learns`` it is MF-ESO, the same loop without learner. The function returns the log if
    its argument is true. Design and noise are computed in advance, so only the loop itself is
    timed.
    """
    library = folder / ("reference.so" if learns else "plain.so")
    command = [
        "gcc",
        "-O3",
        "-march=native",
        "-std=gnu11",
        "-shared",
        "-fPIC",
        "-o",
        str(library),
        str(SOURCE),
        "-lm",
        *(() if learns else ("-DPLAIN",)),
    ]
    subprocess.run(command, check=True)
    run = ctypes.CDLL(str(library)).run
    run.restype = ctypes.c_double
    pointer = ctypes.c_void_p
    numbers = c_design(settings)
    samples, hold = round(duration / settings.dt) + 1, round(0.01 / settings.dt)
    noise = study.scenario(settings).noise.seeded(settings.seed)(
        np.arange(samples // hold + 1) * 0.01
    )

    def reference(record: bool) -> np.ndarray:
        log = np.empty((samples, 22 if learns else 17) if record else 0)
        run(
            *(
                numbers.ctypes.data_as(pointer),
                ctypes.c_size_t(samples),
                ctypes.c_double(study.STEP_AT),
            ),
            *(
                noise.ctypes.data_as(pointer),
                ctypes.c_size_t(hold),
                log.ctypes.data_as(pointer) if record else None,
            ),
        )
        return log

    return reference


def c_design(settings: study.Settings) -> np.ndarray:
    """Return the numbers of ``design_t`` in ``reference.c`` for the study's L-ESO."""
    design = study.controllers(settings)[study.L].parameters
    kalman, plant = design.learner, ql.plants.two_mass_spring().sampled(settings.dt)
    return np.concatenate(
        [
            [settings.dt],
            *(field.ravel() for field in plant),
            *(field.ravel() for field in design.eso[:4]),
            design.law,
            [design.b0, kalman.lag.pole, kalman.lag.rise],
            kalman.lag.taps,
            kalman.scale[:4],
            kalman.threshold,
            [
                kalman.walk[-1],
                kalman.forget,
                kalman.lag_time,
                kalman.prior[0],
                kalman.fastest,
                kalman.f_noise,
            ],
        ]
    )


def best(*candidates: Callable[[], object], trials: int) -> list[float]:
    """Time the candidates in turn ``trials`` times; return the best thread time of each [s]."""
    found = [float("inf")] * len(candidates)
    for _ in range(trials):
        for i, candidate in enumerate(candidates):
            began = time.thread_time()
            candidate()
            found[i] = min(found[i], time.thread_time() - began)
    return found


def row(what: str, ratio: float, bar: str, times: str, **more: float) -> dict[str, object]:
    """Return a row of the table; ``more`` are figures that it does not show as numbers."""
    return {"what": what, "ratio": ratio, "bar": bar, "times": times, **more}


def show(rows: Sequence[dict[str, object]], title: str | None = None) -> dict[str, object]:
    """Print a table; return its figures by their names."""
    table = Table("what", "measured", "bar", "times", title=title)
    for line in rows:
        table.add_row(
            str(line["what"]), f"{line['ratio']:.2f}", str(line["bar"]), str(line["times"])
        )
    Console().print(table)
    return {
        str(line["what"]): {key: line[key] for key in line if key not in ("what", "bar")}
        for line in rows
    }
