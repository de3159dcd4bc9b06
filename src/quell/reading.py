"""Text files, read within limits of size."""

from __future__ import annotations

import csv
import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path

MAX_SIZE = 256.0
"""Default limit of what a file may unpack to, as arrays of 64-bit numbers or as text [MB].

About 20 minutes of a loop at 1 kHz with 25 values in a row. A file that is read needs up to three
times as much memory for a moment, which stays below 1 GB. Chosen by hand.
"""
# Limit of a file of settings, a setup or the header of a recording [bytes]: a thousand times as
# long as those that quell writes. Chosen by hand, because each bracket in it becomes an object of
# some hundred bytes.
_MOST_SETTINGS = 1_000_000
# Limit of a line [characters]: a row of 10 000 numbers takes 200 000. Chosen by hand.
_LONGEST_LINE = 1_000_000


class TooLargeError(ValueError):
    """A file that unpacks to more than is permitted."""


def bytes_of(max_size: float) -> int:
    """Return the argument ``max_size`` [MB] in bytes."""
    from quell import checks  # it needs NumPy, which the command line imports only to do something

    return round(1e6 * checks.positive("max_size", max_size, "MB"))


def check_size(size: int, most: int, where: str = "") -> None:
    """Raise a ``TooLargeError`` if a file unpacks to ``size`` bytes, and ``most`` are permitted."""
    if size > most:
        raise TooLargeError(
            f"{where and where + ': '}it unpacks to more than max_size = {1e-6 * most:g} MB; "
            "if that is what it should hold, give a larger max_size (--max-size)"
        )


def check_regular(path: str | os.PathLike[str], where: str) -> None:
    """Check that a file can be read, and is no pipe, which could wait for ever.

    Raises
    ------
    FileNotFoundError
        if there is no such file.
    ValueError
        if it can't be read; the messages begin with ``where``.
    """
    try:
        if not stat.S_ISREG(Path(path).stat().st_mode):
            raise ValueError("it is a folder, a pipe or a device; must be a file")
        with Path(path).open("rb"):
            pass
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{where}: can't be read ({error.strerror})") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"{where}: can't be read ({reason})") from None


def whole_text(path: str | os.PathLike[str]) -> str:
    """Return the text of a file of settings.

    Raises
    ------
    OSError, UnicodeDecodeError
        if it can't be read.
    ValueError
        if it is longer than any such file should be.
    """
    with Path(path).open("rb") as file:
        content = file.read(_MOST_SETTINGS + 1)
    check_settings(len(content))
    return content.decode("utf-8-sig")


def check_settings(size: int) -> None:
    """Raise a ``ValueError`` if settings of ``size`` bytes are too long."""
    if size > _MOST_SETTINGS:
        raise ValueError(f"must have at most {1e-6 * _MOST_SETTINGS:g} MB of settings, has more")


def text_lines(path: str | os.PathLike[str], where: str, most: int) -> Iterator[str]:
    """Yield the lines of a text file; errors begin with ``where``.

    Raises
    ------
    ValueError
        if the file can't be read, has more than ``most`` bytes, or a line is too long.
    """
    try:
        with Path(path).open(encoding="utf-8-sig") as file:
            size = number = 0
            while line := file.readline(_LONGEST_LINE + 1):
                size, number = size + len(line), number + 1
                check_line(len(line), number)
                check_size(size, most)
                yield line
    except UnicodeDecodeError:
        raise ValueError(f"{where}: can't be read as a text file (not UTF-8)") from None
    except OSError as error:
        raise ValueError(f"{where}: can't be read as a text file ({error.strerror})") from None
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def byte_lines(path: Path) -> Iterator[bytes]:
    """Yield the lines of a file that may still grow: without a last one that was cut short.

    Raises
    ------
    OSError
        if the file can't be read.
    ValueError
        if a line is too long.
    """
    with path.open("rb") as file:
        number = 0
        while line := file.readline(_LONGEST_LINE + 1):
            number += 1
            check_line(len(line), number)
            if line.endswith(b"\n"):
                yield line


def check_line(size: int, number: int) -> None:
    """Raise a ``ValueError`` if a line of ``size`` characters is too long to be one."""
    if size > _LONGEST_LINE:
        raise ValueError(f"line {number} has more than {_LONGEST_LINE} characters")


def csv_rows(
    lines: Iterable[str], where: str, delimiter: str = ","
) -> Iterator[tuple[int, list[str]]]:
    """Yield number and stripped cells of each line that is not empty; errors name ``where``."""
    reader = csv.reader(lines, delimiter=delimiter)
    try:
        for row in reader:
            # A quoted cell may have line breaks, which no message should have.
            cells = [" ".join(cell.split()) if "\n" in cell else cell.strip() for cell in row]
            if any(cells):
                yield reader.line_num, cells
    except csv.Error as error:
        raise ValueError(f"{where}: is no CSV file ({error})") from None
