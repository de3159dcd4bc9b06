"""Proofs of exported controllers: which are proved, what is open, how long it takes.

    python benchmarks/proofs.py [--drawn 40 --seed 1] [--only TEXT] [--precision double]
                                [--longest 3600] [--part K/N] [--results FILE]

Every row of ``exported.py`` and ``exported_axes.py``, and state feedback, is exported in double and
in single precision and proved by Frama-C (docs/target_proof). With ``--drawn`` as many controllers
are drawn by chance instead: their observers, laws, limits, prefilters, schedules, safe sets,
learners and guards are combined as nobody has chosen them (``tests/golden``). A row that is not
proved, nor in ``OPEN``, ends the script with 1; so does one whose analysis has not ended after
``--longest`` seconds. All rows take hours of a core: ``--results`` names a file to which each row
is added when it is ready, and whose rows are not run again. ``--part K/N`` takes each N-th row from
the K-th on.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import exported
import exported_axes
from measured import check_present, options_of, parser_of, part_of, write

import quell as ql
from quell.export import CSource, TranslationError
from quell.export.proof import proof_files, prove

HEADS = ("controller", "precision", "proved", "alarms", "time [s]", "passes of a step")

# Rows that are not proved, and why.
OPEN: dict[str, str] = {}


def known() -> Iterator[tuple[str, Any]]:
    """Yield name and controller of the rows that are no draw."""
    yield from exported.cases()
    yield from exported_axes.cases().items()
    yield from exported_axes.feedback().items()


def drawn(count: int, seed: int) -> Iterator[tuple[str, Any]]:
    """Yield name and controller of a draw, a third of those with an ADRC with a learner.

    What quell refuses is drawn again: one ADRC of combined parts after another, and some other
    controllers, several axes and state feedback between them.
    """
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from tests.golden.corpus import made
    from tests.golden.draw import LEARNERS, Bag
    from tests.golden.draw_axes import DrawAxes

    draw = DrawAxes(seed)
    draw.learners = Bag(draw.random, [*[None] * 2 * len(LEARNERS), *LEARNERS])
    ways = Bag(draw.random, [*["one"] * 14, *["other"] * 4, "axes", "state_feedback"])
    for number in range(1, count + 1):
        way, controller = ways(), None
        while controller is None:
            name, case = getattr(draw, way)()
            try:
                controller = made(case["controller"])
            except (ValueError, TypeError, AttributeError):
                continue  # parts that contradict each other
        yield f"{seed}.{number:02d} {name.removesuffix(', single')}", controller


def write_proof(folder: Path, controller: Any, source: CSource) -> None:
    """Write the code of a controller and the files of its proof."""
    code = {"src/servo.h": source.header, "src/servo.c": source.source}
    for path, text in (code | proof_files(controller, source)).items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text, encoding="utf-8")


def row_of(name: str, controller: Any, precision: str, longest: float = 3600.0) -> list[str]:
    """Return a row of the table."""
    with tempfile.TemporaryDirectory() as place:
        try:
            source = ql.export.c_source(controller, "servo", precision=precision)
            write_proof(Path(place), controller, source)
        except (TranslationError, ValueError) as error:  # a learner in Python
            return [name, precision, "refused", "", "", str(error)[:60]]
        proof = prove(Path(place), source, longest=longest)
    passes = proof.structure.passes.get("servo_step")
    first = f": {proof.open[0][:100]}" if proof.open else ""
    cells = ["yes" if proof.proved else f"NOT{first}", f"{len(proof.alarms)}"]
    seconds = f"{proof.findings.seconds:.0f}"
    return [name, precision, *cells, seconds, "by data" if passes is None else f"{passes}"]


def main() -> None:
    """Prove the rows."""
    parser = parser_of(__doc__)
    parser.add_argument("--drawn", type=int, default=0, help="so many controllers by chance")
    parser.add_argument("--seed", type=int, default=1, help="of the draw")
    parser.add_argument("--only", default="", help="controllers whose name has this text")
    parser.add_argument("--precision", choices=("double", "single"), help="one precision only")
    parser.add_argument("--longest", type=float, default=3600.0, help="time of a proof [s]")
    parser.add_argument("--part", type=part_of, default="1/1", help="K/N: each N-th row from K on")
    parser.add_argument("--results", type=Path, help="file of rows that are ready")
    options = options_of(parser, only="PID", precision="double", part="1/100")
    check_present(options, ["frama-c"])
    warnings.simplefilter("ignore")
    several = drawn(options.drawn, options.seed) if options.drawn else known()
    rows = exported.chosen_rows(several, options.only, options.part, options.precision)
    work = partial(row_of, longest=options.longest)
    done = exported.shown_rows(rows, HEADS, work, options.results)
    bad = any(cells[2] not in ("yes", "refused") and cells[0] not in OPEN for cells in done)
    figures: dict[str, Any] = {"rows": len(done)}
    for verdict in ("yes", "refused", "NOT"):
        figures[verdict] = sum(cells[2].startswith(verdict) for cells in done)
    figures["controllers"] = len({cells[0] for cells in done})
    figures["alarms"] = sum(int(cells[3] or 0) for cells in done)
    times = [float(cells[4]) for cells in done if cells[4]]
    figures |= {"median": median(times), "longest": max(times)} if times else {}
    figures["each"] = {
        f"{cells[0]}, {cells[1]}": dict(zip(HEADS[2:], map(_number, cells[2:]), strict=True))
        for cells in done
    }
    write(options, figures)
    sys.exit(1 if bad else 0)


def _number(text: str) -> float | str:
    return float(text) if text.isdigit() else text


if __name__ == "__main__":
    main()
