"""Files that are written whole or not at all, and replace no other file unless asked to.

The rule of all outputs: an existing file is replaced only where the caller asks for it, with
``overwrite=True`` or ``--overwrite``, and that is checked before the work begins.
"""

from __future__ import annotations

import atexit
import codecs
import csv
import io
import itertools
import json
import math
import os
import re
import shutil
import stat
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple


def check_writable(path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Check that ``written_atomically`` can write ``path``; a file there is not changed.

    Raises
    ------
    ValueError
        if the file exists and is not to be replaced, or can't be written.
    """
    check_free(path, overwrite)
    _new_file_beside(Path(path)).unlink()


def check_free(path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Check that no file would be replaced, or only a regular one that may be."""
    target = Path(path)
    if target.is_dir() or not os.path.lexists(target):
        return
    if not overwrite:
        raise ValueError(
            f"path = {str(target)!r}: the file exists; choose another name, or ask to replace it "
            "(--overwrite on the command line, overwrite=True in Python)"
        )
    if target.exists() and not target.is_file():
        raise ValueError(f"path = {str(target)!r}: must be a file, is a device or a pipe")


@contextmanager
def written_atomically(path: str | os.PathLike[str], overwrite: bool = False) -> Iterator[Path]:
    """Yield a path to write to; at the end it becomes ``path``, or is removed after an error.

    A ``ValueError`` says that ``path`` exists and is not to be replaced, also if it came into being
    meanwhile; an ``OSError`` names it and the reason, such as a full disk.
    """
    target = Path(path)
    check_free(target, overwrite)
    part = _new_file_beside(target)
    try:
        yield part
        if overwrite:
            part.replace(target)
        else:
            try:
                os.link(part, target)
            except FileExistsError:
                check_free(target)
            except OSError:  # a file system without hard links
                check_free(target)
                part.replace(target)
    except OSError as error:  # of a library, its text may be a page
        if error.errno is None:
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(target)) from None
    finally:
        part.unlink(missing_ok=True)


class GrowingFile:
    """A file to which whole lines are added; after a failure it ends with the last whole one.

    What was added is with the operating system, where it outlives this process.

    Parameters
    ----------
    path
        a new file, or a device like ``/dev/null``.

    Attributes
    ----------
    lines : int
        number of whole lines that are in the file.
    """

    def __init__(self, path: Path) -> None:
        self._raw = path.open("wb" if path.exists() else "xb", buffering=0)
        self._size = self.lines = 0

    @property
    def closed(self) -> bool:
        """Whether the file is closed."""
        return self._raw.closed

    def add(self, text: str) -> None:
        """Add lines, each with its end.

        An ``OSError`` says why not all of them are in the file, such as a full disk; a line of
        which only a part was written is taken out of it.
        """
        data = text.encode()
        written = 0
        try:
            while written < len(data):
                written += self._raw.write(data[written:])
        finally:
            whole = data[:written].rfind(b"\n") + 1
            if whole < written:
                with suppress(OSError):  # a device has no end
                    self._raw.truncate(self._size + whole)
                    self._raw.seek(self._size + whole)
            self._size += whole
            self.lines += data.count(b"\n", 0, whole)

    def close(self) -> None:
        """Close the file."""
        self._raw.close()


def write_folder(
    path: str | os.PathLike[str], files: Mapping[str, str], overwrite: bool = False
) -> tuple[Path, ...]:
    """Write text files into a folder, all of them or none; return their paths.

    Parameters
    ----------
    path
        the folder; it is created if its parent exists. With files in it, it needs ``overwrite``.
    files
        text by path inside the folder, as ``src/servo.c``.
    overwrite
        whether to replace files of these names; others in the folder are left alone.

    Raises
    ------
    ValueError
        if the folder is a file, has files and is not to be changed, or can't be written.
    """
    target = Path(path)
    check_folder(target, overwrite)
    part = target.with_name(f".{target.name}-{uuid.uuid4().hex[:12]}")
    try:
        for name, text in files.items():
            (part / name).parent.mkdir(parents=True, exist_ok=True)
            (part / name).write_text(text, encoding="utf-8", newline="\n")
        if target.exists() and any(target.iterdir()):
            _move_into(part, target, files)
        else:
            if target.exists():
                target.rmdir()
            part.rename(target)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ValueError(f"path = {str(target)!r}: can't be written ({reason})") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return tuple(target / name for name in files)


def check_folder(path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Check that ``write_folder`` can write; raise a ``ValueError`` if not."""
    target = Path(path).absolute()
    if os.path.lexists(target) and not target.is_dir():
        raise ValueError(f"path = {str(path)!r}: must be a folder, is a file")
    if not target.parent.is_dir():
        raise ValueError(f"path = {str(path)!r}: the folder {str(target.parent)!r} must exist")
    found = next(target.iterdir(), None) if target.is_dir() else None
    if found is not None and not overwrite:
        raise ValueError(
            f"path = {str(path)!r}: the folder has files ({found.name}); choose another folder, or "
            "ask to replace files of the same names (--overwrite on the command line, "
            "overwrite=True in Python)"
        )


def _move_into(part: Path, target: Path, names: Iterable[str]) -> None:
    """Move files into a folder, over those of the same names, after a check that all can be."""
    for name in names:
        for place in [target / name, *(target / name).parents]:
            if place == target:
                break
            if os.path.lexists(place) and place.is_dir() == (place == target / name):
                raise ValueError(f"path = {str(place)!r}: is in the way of a file to write")
    for name in names:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (part / name).replace(target / name)


def new_folder(path: str | os.PathLike[str]) -> Path:
    """Create and return the first of ``path``, ``path-2``, ``path-3`` … that does not exist.

    A folder that exists is not taken even if it is empty: another program may be about to write
    into it. If the new folder is still empty when this program ends, it is removed.
    """
    first = Path(path)
    first.parent.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        folder = first if number == 1 else first.with_name(f"{first.name}-{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            remove_if_empty_at_exit(folder)
            return folder
    raise AssertionError


def remove_if_empty_at_exit(folder: Path) -> None:
    """Remove a folder when this program ends, if it is empty then."""
    atexit.register(_remove_if_empty, folder.absolute())


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


def write_json(path: str | os.PathLike[str], value: Any, overwrite: bool = False) -> None:
    """Write dictionaries, lists, strings and finite numbers to a JSON file, whole or not at all."""
    with written_atomically(path, overwrite) as part:
        text = json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False)
        part.write_text(text + "\n", encoding="utf-8")


def nonfinite_to_none(value: Any) -> Any:
    """Return a value for ``write_json``: non-finite numbers become None, and tuples lists."""
    if isinstance(value, dict):
        return {key: nonfinite_to_none(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return [nonfinite_to_none(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_json(result: Any, *names: str, **more: Any) -> dict[str, Any]:
    """Return attributes of a result, and ``more`` values, by name for ``write_json``.

    Arrays and tuples become lists, results in them dictionaries, and non-finite numbers None.
    """
    values = {name: getattr(result, name) for name in names} | more
    return {name: _as_json(value) for name, value in values.items()}


def _as_json(value: Any) -> Any:
    for method in ("to_json", "_asdict", "tolist"):
        if hasattr(value, method):
            return _as_json(getattr(value, method)())
    if isinstance(value, Mapping):
        return {key: _as_json(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return [_as_json(part) for part in value]
    return nonfinite_to_none(value)


def _new_file_beside(target: Path) -> Path:
    if not target.parent.is_dir():
        raise ValueError(f"path = {str(target)!r}: the folder {str(target.parent)!r} must exist")
    if target.is_dir():
        raise ValueError(f"path = {str(target)!r}: must be a file, is a folder")
    part = target.with_name(f".{target.stem}-{uuid.uuid4().hex[:12]}{target.suffix}")
    try:
        part.touch(exist_ok=False)
    except OSError as error:
        raise ValueError(f"path = {str(target)!r}: can't be written ({error.strerror})") from None
    return part


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
# Bytes at the begin of a file that tell what it is: a block of Python's file buffer.
_BEGIN = 8192
# Share of zeros among the upper bytes of a text in UTF-16 without a mark; chosen by hand: the
# characters of tables are ASCII.
_UTF_16 = 0.7


class Kind(NamedTuple):
    """A kind of binary file."""

    what: str  #: with its article
    remedy: str  #: how its content becomes a record


_EXPORT = "export the columns of time, input and output as text (CSV)"
# First bytes of files, by the file formats' own specifications.
_KINDS = (
    (b"PK\x03\x04", Kind("a spreadsheet (xlsx, ods) or a ZIP archive", "save its sheet as CSV")),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", Kind("a spreadsheet (xls)", "save its sheet as CSV")),
    (b"MATLAB 5.0 MAT", Kind("a MATLAB file", "in MATLAB, writematrix([t u y], 'record.csv')")),
    (
        b"\x89HDF\r\n\x1a\n",
        Kind(
            "an HDF5 file (NetCDF, or MATLAB 7.3)",
            "a run that Trajectory.save wrote is read by the commands if its name ends in .nc, "
            "without --columns, --dt and --time-unit; of another file " + _EXPORT,
        ),
    ),
    (
        b"\x89MCAP0\r\n",
        Kind(
            "an MCAP file",
            "a recording of quell run-rig is read by the commands if its name ends in .mcap, "
            "without --columns, --dt and --time-unit; of another file " + _EXPORT,
        ),
    ),
    (b"CDF\x01", Kind("a NetCDF file", _EXPORT)),
    (b"\x93NUMPY", Kind("a NumPy file", "in Python, numpy.savetxt('record.csv', ...)")),
    (b"\x80\x04", Kind("a pickled object of Python", "in Python, " + _EXPORT)),
    (b"PAR1", Kind("a Parquet file", _EXPORT)),
    (b"TDSm", Kind("a TDMS file of LabVIEW", _EXPORT)),
    (b"ULog\x01", Kind("a log of PX4 (ULog)", "convert it with ulog2csv")),
    (b"\xa3\x95", Kind("a log of ArduPilot", "convert it with mavlogdump.py --format csv")),
    (b"H Product:Blackbox", Kind("a log of a blackbox", "convert it with blackbox_decode")),
    (b"\x1f\x8b", Kind("a compressed file (gzip)", "unpack it")),
    (b"BZh91AY", Kind("a compressed file (bzip2)", "unpack it")),
    (b"\xfd7zXZ", Kind("a compressed file (xz)", "unpack it")),
    (b"\x28\xb5\x2f\xfd", Kind("a compressed file (zstd)", "unpack it")),
    (b"\x89PNG", Kind("an image (PNG)", "give the numbers that it shows")),
    (b"\xff\xd8\xff", Kind("an image (JPEG)", "give the numbers that it shows")),
    (b"GIF8", Kind("an image (GIF)", "give the numbers that it shows")),
    (b"%PDF", Kind("a PDF document", "give the numbers that it shows")),
    (b"\x7fELF", Kind("a program", "give a record")),
    (b'{"', Kind("a JSON file", _EXPORT)),
    (b"{\n", Kind("a JSON file", _EXPORT)),
    (b"<?xml", Kind("an XML file", _EXPORT)),
    (b"<!DOCTYPE", Kind("a page (HTML)", "give the table of its numbers as text (CSV)")),
    (b"<html", Kind("a page (HTML)", "give the table of its numbers as text (CSV)")),
)


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


def begin_of(path: str | os.PathLike[str]) -> bytes:
    """Return the first bytes of a file; none if it can't be read."""
    try:
        with Path(path).open("rb") as file:
            return file.read(_BEGIN)
    except (OSError, ValueError):
        return b""


def kind_of(begin: bytes) -> Kind | None:
    """Return what a file is that begins with these bytes; None if it seems to be text."""
    found = next((kind for mark, kind in _KINDS if begin.startswith(mark)), None)
    if found is not None or encoding_of(begin) != "utf-8":
        return found
    # Loggers that lose their power leave zeros at the end.
    text = begin.rstrip(b"\0")
    if begin and (not text or b"\0" in text):
        what = "a binary file" if text else "a file of zero bytes"
        return Kind(what, _EXPORT if text else "take another copy of it")
    return None


def encoding_of(begin: bytes) -> str:
    """Return the encoding of a text that begins with these bytes: UTF-8, UTF-16 or UTF-32."""
    if begin.startswith((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE)):
        return "utf-32"
    if begin.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if begin.startswith(codecs.BOM_UTF8):
        return "utf-8-sig"
    for encoding, upper, lower in (("utf-16-le", 1, 0), ("utf-16-be", 0, 1)):
        zeros = begin[upper::2].count(0)
        if zeros > _UTF_16 * len(begin[upper::2]) and not begin[lower::2].count(0):
            return encoding
    return "utf-8"


def _windows_1252(error: UnicodeError) -> tuple[str, int]:
    """Return the text of bytes that are not UTF-8, as programs on Windows write it."""
    if not isinstance(error, UnicodeDecodeError) or not error.encoding.startswith("utf-8"):
        raise error
    try:
        return error.object[error.start : error.end].decode("cp1252"), error.end
    except UnicodeDecodeError:
        raise error from None


codecs.register_error("quell.windows-1252", _windows_1252)


def text_lines(path: str | os.PathLike[str], where: str, most: int) -> Iterator[str]:
    """Yield the lines of a text file; errors begin with ``where``.

    The text is UTF-8, UTF-16 or UTF-32, as its first bytes tell; bytes that are not UTF-8 are
    characters of Windows-1252.

    Raises
    ------
    ValueError
        if the file can't be read, is a binary file, has more than ``most`` bytes, or a line is too
        long.
    """
    try:
        with Path(path).open("rb") as binary:
            begin = binary.peek(_BEGIN)[:_BEGIN]
            if (kind := kind_of(begin)) is not None:
                raise ValueError(f"is {kind.what}, not a table in text; {kind.remedy}")
            encoding = encoding_of(begin)
            file = io.TextIOWrapper(binary, encoding, errors="quell.windows-1252")
            size = number = 0
            while line := file.readline(_LONGEST_LINE + 1):
                size, number = size + len(line), number + 1
                check_line(len(line), number)
                check_size(size, most)
                yield line
    except UnicodeError as error:
        remedy = "export it as text (CSV) in UTF-8"
        name = getattr(error, "encoding", "utf-8")
        known = "UTF-8 or Windows-1252" if name.startswith("utf-8") else name.upper()
        raise ValueError(f"{where}: can't be read as a text file (not {known}); {remedy}") from None
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
    lines: Iterable[str], where: str, delimiter: str | None = ",", before: int = 0
) -> Iterator[tuple[int, list[str]]]:
    """Yield number and stripped cells of each line that is not empty; errors name ``where``.

    Without ``delimiter`` there is white space between the cells. ``before`` lines of the file are
    not among the ``lines``.
    """
    if delimiter is None:
        for number, line in enumerate(lines, start=before + 1):
            if cells := words_of(line):
                yield number, cells
        return
    reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    last = 0
    try:
        for row in reader:
            cells = [*map(str.strip, row)]
            if reader.line_num != last + 1:  # a quoted cell has line breaks; no message should
                cells = [" ".join(cell.split()) for cell in row]
            last = reader.line_num
            if any(cells):
                yield before + last, cells
    except csv.Error as error:
        reason = f"{error}; is there a quotation mark without a second one?"
        raise ValueError(f"{where}: is no CSV file ({reason})") from None


# A word, a text in quotation marks, and a word with a unit in brackets behind it.
_WORD = re.compile(r"\"([^\"]*)\"|([^\s\"]+(?:[ \t]+[\[(][^\s\[\]()]*[\])])?)|\"")


def words_of(line: str) -> list[str]:
    """Return the words of a line; ``time [s]`` is one, and so is what has quotation marks."""
    if '"' not in line and "[" not in line and "(" not in line:
        return line.split()
    return [found[1] or found[2] or "" for found in _WORD.finditer(line)]
