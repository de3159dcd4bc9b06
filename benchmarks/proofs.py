"""Proofs of exported controllers: which are proved, what is open, how long it takes.

    python benchmarks/proofs.py [--only TEXT] [--precision double] [--results FILE]

Every row of ``exported.py`` and ``exported_axes.py``, and state feedback, is exported in double and
in single precision with ``proof=True`` and proved by Frama-C (docs/target_proof). One that is not
proved, nor in ``OPEN``, ends the script with 1. All rows take hours of a core: ``--results`` names
a file to which each row is added when it is ready, and whose rows are not run again. ``--part I/N``
takes each N-th row from the I-th on.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

from exported import chosen_rows, shown_rows
from exported_axes import cases, feedback
from measured import check_present, options_of, parser_of, part_of, write

import quell as ql
from quell.export import TranslationError

HEADS = ("controller", "precision", "proved", "alarms", "time [s]", "passes of a step")

# Rows that are not proved, and why.
OPEN: dict[str, str] = {}


def row_of(name: str, controller: Any, precision: str) -> list[str]:
    """Return a row of the table."""
    with tempfile.TemporaryDirectory() as place:
        try:
            folder = Path(place) / "c"
            done = ql.export.c(
                controller, folder, name="servo", precision=precision, accept=True, proof=True
            )
        except (TranslationError, ValueError) as error:  # a learner in Python
            return [name, precision, "refused", "", "", str(error)[:60]]
    proof = done.proof
    assert proof is not None
    passes = proof.structure.passes.get("servo_step")
    first = f": {proof.open[0][:100]}" if proof.open else ""
    cells = ["yes" if proof.proved else f"NOT{first}", f"{len(proof.alarms)}"]
    seconds = f"{proof.findings.seconds:.0f}"
    return [name, precision, *cells, seconds, "by data" if passes is None else f"{passes}"]


def main() -> None:
    """Prove the rows."""
    parser = parser_of(__doc__)
    parser.add_argument("--only", default="", help="controllers whose name has this text")
    parser.add_argument("--precision", choices=("double", "single"), help="one precision only")
    parser.add_argument("--part", type=part_of, default="1/1", help="K/N: each N-th row from K on")
    parser.add_argument("--results", type=Path, help="file of rows that are ready")
    options = options_of(parser, only="PID", precision="double", part="1/100")
    check_present(options, ["frama-c"])
    warnings.simplefilter("ignore")
    several = [*(cases() | feedback()).items()]
    rows = chosen_rows(options.only, options.part, options.precision, several)
    done = shown_rows(rows, HEADS, row_of, options.results)
    bad = any(cells[2] not in ("yes", "refused") and cells[0] not in OPEN for cells in done)
    figures: dict[str, Any] = {"rows": len(done)}
    for verdict in ("yes", "refused", "NOT"):
        figures[verdict] = sum(cells[2].startswith(verdict) for cells in done)
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
