"""What all benchmarks share: the options ``--quick`` and ``--json``, and the file of their figures.

A benchmark collects its figures, the numbers that pages and README cite, in one dictionary, and
ends with ``write``. With ``--quick`` it does the same work on so few runs that it takes seconds:
the gate starts each benchmark so and looks whether its figures are numbers. Without it the file
that ``--json`` names is the source of the pages (``docs/figures``).
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import shutil
import sys
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn

from quell import __version__
from quell.files import write_json


def parser_of(documentation: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options that all benchmarks have; ``documentation`` is its help."""
    parser = argparse.ArgumentParser(
        description=documentation, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a few runs only: does it work?")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    return parser


def options_of(parser: argparse.ArgumentParser, **quick: Any) -> argparse.Namespace:
    """Read the command line; with ``--quick`` options that are not given are those of ``quick``."""
    if "--quick" in sys.argv[1:]:
        parser.set_defaults(**quick)
    return parser.parse_args()


def part_of(text: str) -> slice:
    """Return the places that ``K/N`` takes: each N-th from the K-th on. A ``type`` of argparse."""
    first, _, step = text.partition("/")
    if not (first.isdigit() and step.isdigit() and 1 <= int(first) <= int(step)):
        raise argparse.ArgumentTypeError(f"{text!r} must be K/N with K from 1 to N")
    return slice(int(first) - 1, None, int(step))


def shared_data(name: str) -> Path:
    """Return the path of a file of measured data, which lies beside the repository."""
    return Path(__file__).resolve().parents[2] / "shared" / "data" / name


def check_present(
    options: argparse.Namespace, tools: Iterable[str] = (), files: Iterable[Path] = ()
) -> None:
    """End the program if a tool or a file is missing here: it says so, and has no figures.

    With ``--quick`` its exit code is 0, as the gate runs on machines without some of the tools.
    """
    missing = [tool for tool in tools if shutil.which(tool) is None]
    missing += [str(file) for file in files if not file.is_file()]
    if missing:
        not_run(options, f"{', '.join(missing)}: not here")


def not_run(options: argparse.Namespace, reason: str) -> NoReturn:
    """End the program with the reason why it can't measure; with ``--quick`` this is no failure."""
    print(f"NOT run: {reason}")
    sys.exit(0 if options.quick else 1)


def write(options: argparse.Namespace, figures: dict[str, Any]) -> None:
    """Check that the figures are numbers, and write them where ``--json`` says so.

    Parameters
    ----------
    options
        What the parser of ``parser_of`` has read.
    figures
        Numbers and texts, in dictionaries and lists at any depth. A figure that could not be
        measured is a text with the reason.

    Raises
    ------
    ValueError
        If there is no number, or one is NaN or infinite.
    """
    plain = json.loads(json.dumps(figures, default=float))
    numbers = dict(numbers_of(plain))
    if not numbers:
        raise ValueError(f"{Path(sys.argv[0]).name} has measured no number")
    bad = [f"{name} = {value}" for name, value in numbers.items() if not math.isfinite(value)]
    if bad:
        raise ValueError(
            f"figures must be numbers, or texts that say why there is none; these are not finite: "
            f"{', '.join(bad)}"
        )
    if options.json is not None:
        program = Path(sys.argv[0])
        program_and_options = [
            f"{program.parent.name}/{program.name}",
            *_without_json(sys.argv[1:]),
        ]
        content = {
            "command": shlex.join(["python", *program_and_options]),
            "quell": __version__,
            "date": f"{datetime.now(UTC):%Y-%m-%d}",
            "figures": plain,
        }
        write_json(options.json, content, overwrite=True)


def numbers_of(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield the numbers in dictionaries and lists at any depth, with their places."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from numbers_of(each, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        for i, each in enumerate(value):
            yield from numbers_of(each, f"{name}[{i}]")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield name, value


def _without_json(arguments: list[str]) -> Iterator[str]:
    """Leave ``--json FILE`` out of the arguments: where the figures went is no part of them."""
    skip = False
    for each in arguments:
        if skip:
            skip = False
        elif each == "--json":
            skip = True
        elif not each.startswith("--json="):
            yield each
