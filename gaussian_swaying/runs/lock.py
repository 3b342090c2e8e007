"""One writer per folder: a lock file with the process and the host that write to it.

The file appears with its content in one step, so if two processes start at the same moment, only one gets the lock. A
lock whose process has ended is taken over. Whether a process on another host is still running cannot be known, so its
lock must be removed by hand.
"""

from __future__ import annotations

import json
import os
import platform
import weakref
from contextlib import suppress
from pathlib import Path

from gaussian_swaying._files import check_not_taken, temporary_name

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
        mine = _describe()
        _acquire(folder, mine)
        self._place = [folder]
        self._end = weakref.finalize(self, _release, self._place, mine, os.getpid())

    def moved(self, folder: Path) -> None:
        """Tell the lock that the folder has been renamed."""
        self._place[0] = folder

    def release(self) -> None:
        """Unlock the folder; a second call does nothing."""
        self._end()


def _describe() -> bytes:
    """A description of this process, the content of a lock."""
    return json.dumps({"pid": os.getpid(), "begun": _begun(os.getpid()), **_here()}).encode()


def _here() -> dict[str, str]:
    """The host, and on Linux the container, within which process numbers are unique."""
    try:
        space = os.readlink("/proc/self/ns/pid")
    except OSError:
        space = ""
    return {"host": platform.node(), "space": space}


def _begun(pid: int) -> str:
    """When a process started, on Linux, to notice a reused process number; "" on other systems or if it has ended."""
    try:
        state, *rest = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except (OSError, ValueError):
        return ""
    return "" if state in "ZX" else f"{boot} {rest[18]}"  # ended, but not yet reaped by its parent


def _alive(pid: int, begun: str) -> bool:
    """True if a process of this host is still running, or if that cannot be known."""
    if os.name == "nt":  # signal 0 would end it there
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return not begun or _begun(pid) == begun


def _acquire(folder: Path, mine: bytes) -> None:
    lock = folder / LOCK
    for _ in range(10):  # try again if the lock is released meanwhile
        if _create(lock, mine):
            return
        check_not_taken(lock)
        try:
            theirs = lock.read_bytes()
        except FileNotFoundError:
            continue
        _check_stale(folder, theirs)
        # of several processes that find the same stale lock only one may replace it, and only if it has not changed
        guard = lock.with_name(f"{LOCK}.taken")
        if not _create(guard, mine):
            break
        try:
            if lock.read_bytes() == theirs:
                lock.unlink()
        except FileNotFoundError:
            pass
        finally:
            guard.unlink(missing_ok=True)
    raise FolderLocked(
        f"Another run is just starting in {folder}: choose another folder, or wait; if no run is starting, remove "
        f"{lock} and {LOCK}.taken."
    )


def _create(path: Path, content: bytes) -> bool:
    """Make a file with its content in one step; False if it exists."""
    temporary = temporary_name(path)
    try:
        temporary.write_bytes(content)
        try:
            os.link(temporary, path)
        except FileExistsError:
            return False
        except OSError:  # a file system without links
            try:
                with path.open("xb") as file:
                    file.write(content)
            except FileExistsError:
                return False
        return True
    finally:
        temporary.unlink(missing_ok=True)


def _check_stale(folder: Path, content: bytes) -> None:
    """Raise FolderLocked unless the process that wrote a lock is known to be gone."""
    lock = folder / LOCK
    try:
        held = json.loads(content)
        pid, host, begun = int(held["pid"]), str(held["host"]), str(held["begun"])
        here = {"host": host, "space": str(held["space"])} == _here()
    except (ValueError, TypeError, KeyError, RecursionError):
        raise FolderLocked(
            f"{lock} cannot be read, so another run may be writing to {folder}: choose another folder, or remove that "
            "file if no run does."
        ) from None
    if not here:
        raise FolderLocked(
            f"A run on the host {host} (process {pid}) is writing to {folder}, or was killed: choose another "
            f"folder, or remove {lock} if it is not running any more."
        )
    if _alive(pid, begun):
        raise FolderLocked(
            f"Another run (process {pid} on this host) is writing to {folder}: wait until it ends, stop it, or choose "
            "another folder."
        )


def _release(place: list[Path], mine: bytes, owner: int) -> None:
    if os.getpid() != owner:  # a forked copy, whose end does not end the run
        return
    lock = place[0] / LOCK
    with suppress(OSError):
        if lock.read_bytes() == mine:
            lock.unlink()


__all__ = ["LOCK", "FolderLock", "FolderLocked"]
