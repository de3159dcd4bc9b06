"""The files of shared memory: opened safely in a folder where every user may create files.

In ``/dev/shm`` another user can create a file, or a link to somebody's file, under the name that a
rig is going to use. Therefore a new file is created with ``O_EXCL`` and mode 600, an existing one
is opened without following a symbolic link, and before it is locked or changed it must be a regular
file with one name that belongs to this user and that nobody else may write. The checks look at the
open file, not at its name, so it can't be exchanged between check and use. See D. Wheeler, Secure
Programming HOWTO, section 7.10 (temporary files in shared folders).
"""

from __future__ import annotations

import errno
import fcntl
import os
import pwd
import stat
from contextlib import suppress
from pathlib import Path

_FLAGS = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
_PRIVATE = 0o600
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class RefusedMailboxError(Exception):
    """A file that can't be trusted; the text says why."""


class Mailbox:
    """A file in memory with one writer.

    Parameters
    ----------
    path
        its name.
    size
        its size [bytes]; ``enlarge`` gives it to the file.
    create
        whether to create it if there is none.

    Raises
    ------
    FileNotFoundError
        if there is none.
    RefusedMailboxError
        if it is a link or not a regular file, belongs to another user, or others may write it.
    """

    def __init__(self, path: Path, size: int, create: bool = False) -> None:
        self._size = size
        self.file = -1
        try:
            self.file = _opened(path, create)
            _check(path, os.fstat(self.file))
        except OSError as error:
            self.close()
            if isinstance(error, FileNotFoundError):
                raise
            raise RefusedMailboxError(_reason(path, error)) from None
        except RefusedMailboxError:
            self.close()
            raise

    def lock(self) -> bool:
        """Become its writer; return False if another process, or another object here, is."""
        try:
            fcntl.flock(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def enlarge(self) -> None:
        """Extend a new file to its size; the contents of an existing one stay."""
        os.ftruncate(self.file, self._size)

    def word(self, offset: int) -> int:
        """Return the word at ``offset`` [bytes]; 0 if the file is too short."""
        return int.from_bytes(os.pread(self.file, 8, offset), "little", signed=True)

    def close(self) -> None:
        """Close the file and give its lock back."""
        if self.file >= 0:
            with suppress(OSError):  # a forked process may still have the file, and so its lock
                fcntl.flock(self.file, fcntl.LOCK_UN)
            os.close(self.file)
            self.file = -1


def _opened(path: Path, create: bool) -> int:
    """Return the open file; create it if wanted, but never open a new name of something else."""
    if create:
        try:
            return os.open(path, _FLAGS | os.O_CREAT | os.O_EXCL, _PRIVATE)
        except FileExistsError:
            pass
    return os.open(path, _FLAGS)


def _check(path: Path, found: os.stat_result) -> None:
    """Refuse a file that another user could have planted, or could write."""
    if not stat.S_ISREG(found.st_mode) or found.st_nlink != 1:
        raise RefusedMailboxError(
            f"{path} is not a regular file with one name, but {_about(found)}"
        )
    if found.st_uid != os.geteuid() or found.st_mode & _OTHERS_WRITE:
        raise RefusedMailboxError(
            f"{path} is {_about(found)}: it must belong to user {_user(os.geteuid())}, "
            "and group and others must not have the right to write it"
        )


def _reason(path: Path, error: OSError) -> str:
    if error.errno == errno.ELOOP:
        return f"{path} is a symbolic link, which is not followed"
    try:
        return f"{path} can't be opened ({error.strerror}): it is {_about(path.lstat())}"
    except OSError:
        return f"{path} can't be opened ({error.strerror})"


def _about(found: os.stat_result) -> str:
    """Return kind, owner and mode."""
    return (
        f"{stat.filemode(found.st_mode)} (mode {stat.S_IMODE(found.st_mode):o}), "
        f"owned by user {_user(found.st_uid)}, with {found.st_nlink} names"
    )


def _user(number: int) -> str:
    try:
        return f"{number} ({pwd.getpwuid(number).pw_name})"
    except KeyError:
        return str(number)
