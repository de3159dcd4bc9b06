"""FMU files as ZIP archives, unpacked within limits."""

from __future__ import annotations

import shutil
import stat
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path, PurePosixPath

from quell.reading import check_regular, check_size

# An FMU of a large tool has some hundred files. Chosen by hand.
_MOST_FILES = 10_000
# What the library raises for archives that are damaged.
_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, LookupError, OSError),
    *(NotImplementedError, RuntimeError, UnicodeError),
)
_ENCRYPTED = 1  # bit of a file's flags (ZIP specification, 4.4.4)


def unpack(path: Path, folder: Path, most: int, wanted: Callable[[str], bool]) -> list[str]:
    """Unpack the wanted files of an FMU into ``folder``, and return the names of all its files.

    Nothing is written outside of ``folder``, and nothing at all if the archive is bad.

    Parameters
    ----------
    path
        the FMU.
    folder
        an empty folder.
    most
        largest number of bytes that the wanted files unpack to.
    wanted
        whether a file is unpacked, by its name in the archive.

    Raises
    ------
    FileNotFoundError
        if there is no such file.
    ValueError
        if it is no ZIP archive, is damaged, is too large, or has names that lead out of ``folder``.
    """
    where = path.name
    check_regular(path, str(path))
    try:
        with zipfile.ZipFile(path) as archive:
            entries = [each for each in archive.infolist() if not each.filename.endswith("/")]
            _check(entries, where)
            chosen = [entry for entry in entries if wanted(entry.filename)]
            _check_once([entry.filename for entry in chosen], where)
            check_size(sum(entry.file_size for entry in chosen), most, where)
            for entry in chosen:
                target = folder / entry.filename
                target.parent.mkdir(parents=True, exist_ok=True)
                # Reading ends at the size that was checked, even if the data goes on.
                with archive.open(entry) as source, target.open("xb") as file:
                    shutil.copyfileobj(source, file)
            return [entry.filename for entry in entries]
    except _DAMAGE as error:
        raise ValueError(f"{where}: is no FMU, or is damaged ({error})") from None


def _check(entries: list[zipfile.ZipInfo], where: str) -> None:
    """Raise a ``ValueError`` for entries that must not be unpacked."""
    if len(entries) > _MOST_FILES:
        raise ValueError(f"{where}: has {len(entries)} files; at most {_MOST_FILES} are permitted")
    for entry in entries:
        name = entry.filename
        parts = PurePosixPath(name).parts
        leads_out = not parts or parts[0] == "/" or ".." in parts
        if leads_out or "\\" in name or ":" in name or stat.S_ISLNK(entry.external_attr >> 16):
            raise ValueError(f"{where}: contains {name!r}, a link or a path out of its folder")
        if entry.flag_bits & _ENCRYPTED:
            raise ValueError(f"{where}: {name!r} is encrypted; must be readable")


def _check_once(names: list[str], where: str) -> None:
    """Raise a ``ValueError`` if a name is there twice: it is not clear which file is meant."""
    name, count = Counter(names).most_common(1)[0] if names else ("", 0)
    if count > 1:
        raise ValueError(f"{where}: contains {name!r} twice")
