"""Lock of a campaign's folder, against other processes and against older campaigns of this one."""

import errno
import os
import threading
import warnings
import weakref
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Self

from filelock import FileLock, SoftFileLock, Timeout

from trustbo.errors import TrustboError, warn

LOCK = ".lock"
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)
"""Errors of file systems without locks, such as some network shares."""

_OPEN: "weakref.WeakValueDictionary[tuple[int, int], FolderLock]" = weakref.WeakValueDictionary()
"""Locks that this process holds, keyed by the device and the inode of the folder."""


class FolderLock:
    """Lock of a folder until `release`; it works from every thread of one process.

    Attributes:
        path: Absolute path of the folder.
        turn: Lock between threads, held by a campaign during each operation.
    """

    def __init__(
        self,
        path: Path,
        *,
        take_over: bool = False,
        turn: AbstractContextManager[Any] | None = None,
    ) -> None:
        """Lock an existing folder.

        Args:
            path: Folder.
            take_over: Whether to release the lock of an older campaign of this process, as when a
                cell of a notebook is run again.
            turn: Lock of a campaign that other threads use already; by default, a new one.

        Raises:
            TrustboError: Another campaign uses the folder, or the folder cannot be written.
        """
        self.path = path.absolute()
        self.turn = threading.RLock() if turn is None else turn
        self._why_released = ""
        self._process = os.getpid()
        self._folder = _identity(self.path)

        older = _OPEN.get(self._folder)
        if older is not None and take_over:
            with older.turn:  # waits for the end of an operation in another thread
                older.release("it was opened again by a newer campaign of this process")

        self._lock = self._acquire()
        self._file = None if self._lock is None else _identity(self.path / LOCK)
        _OPEN[self._folder] = self

    def _acquire(self) -> FileLock | None:
        """Lock the file `.lock`; returns None, with a warning, if the file system has no locks."""
        lock = FileLock(self.path / LOCK, timeout=0, thread_local=False)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # filelock's own warning about missing locks
                lock.acquire()
        except Timeout:
            # On ENOSYS, filelock becomes a lock that mistakes any copied `.lock` for a live one.
            if not isinstance(lock, SoftFileLock):
                raise TrustboError(
                    f"another campaign is using {str(self.path)!r}; close it first "
                    "(campaign.close()), or give another folder."
                ) from None
        except (OSError, NotImplementedError) as error:
            code = getattr(error, "errno", errno.ENOSYS)
            if code not in _NO_LOCKS:
                reason = getattr(error, "strerror", None) or error
                raise TrustboError(f"cannot write in {str(self.path)!r}: {reason}.") from None

        if lock.is_locked and not isinstance(lock, SoftFileLock):
            return lock

        lock.release(force=True)
        warn(
            f"the file system of {str(self.path)!r} has no locks. Make sure that no other process "
            "uses this folder at the same time."
        )
        return None

    def require(self) -> Path:
        """Return the folder's path.

        Raises:
            TrustboError: The lock was released, this process is a copy of the one that opened the
                folder, or the folder or its lock was moved, deleted or replaced.
        """
        where = repr(str(self.path))
        if self._why_released:
            raise TrustboError(
                f"the campaign in {where} was closed: {self._why_released}. Continue it with "
                "Campaign.load."
            )

        if os.getpid() != self._process:
            raise TrustboError(
                f"the campaign in {where} belongs to the process that opened it, and this process "
                "is a copy (fork) of it; only the first one can record missions."
            )

        if _identity(self.path) != self._folder:
            raise TrustboError(
                f"the folder {where} was moved, deleted or replaced while the campaign was open, "
                "so nothing was recorded. Move it back, or write the campaign to another folder "
                "with Campaign.save."
            )

        if self._lock is not None and _identity(self.path / LOCK) != self._file:
            self._lock.release(force=True)
            self._lock = self._acquire()  # refused if another process has opened the folder
            self._file = _identity(self.path / LOCK)
        return self.path

    def release(self, reason: str = "close() was called, or its `with` block ended") -> None:
        """Release the lock; further calls have no effect."""
        if self._why_released:
            return
        self._why_released = reason
        if self._lock is not None and os.getpid() == self._process:
            self._lock.release(force=True)

        if _OPEN.get(self._folder) is self:
            del _OPEN[self._folder]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.release()


def _identity(path: Path) -> tuple[int, int]:
    """Return the device and the inode of a file or folder; (0, 0) if there is none."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0
    return found.st_dev, found.st_ino
