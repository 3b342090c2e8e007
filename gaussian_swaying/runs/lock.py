"""One writer per folder: a file lock that ends with its process, and says whose it is."""

from __future__ import annotations

import json
import os
import platform
import weakref
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, Timeout

LOCK = ".gaussian_swaying.lock"


class FolderLocked(ValueError):  # noqa: N818
    """Another run writes to the folder; the message says which one and what to do."""


class FolderLock:
    """Locks a folder for this process until :meth:`release`, the end of the process, or garbage collection of the lock.

    Args:
        folder: The folder, which must exist.

    Raises:
        FolderLocked: If another run, in this process or another one, has locked it.
        OSError: If the lock cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        path = folder / LOCK
        lock = FileLock(path, blocking=False, thread_local=False)
        try:
            lock.acquire()
        except Timeout:
            raise FolderLocked(
                f"Another run{_who(path)} is writing to {folder}: wait until it ends, stop it, or choose another "
                "folder."
            ) from None
        with suppress(OSError):  # only for the message of others
            path.write_text(json.dumps({"pid": os.getpid(), "host": platform.node()}), "utf-8")
        self._place = [folder]
        self._end = weakref.finalize(self, _release, lock, self._place, os.getpid())

    def moved(self, folder: Path) -> None:
        self._place[0] = folder

    def release(self) -> None:
        self._end()


def _who(path: Path) -> str:
    with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        held = json.loads(path.read_bytes())
        place = "this host" if held["host"] == platform.node() else f"the host {held['host']!s:.100}"
        return f" (process {int(held['pid'])} on {place})"
    return ""


def _release(lock: FileLock, place: list[Path], owner: int) -> None:
    if os.getpid() != owner:  # a forked copy, whose end does not end the run
        return
    with suppress(OSError):
        (place[0] / LOCK).unlink()
    lock.release()
