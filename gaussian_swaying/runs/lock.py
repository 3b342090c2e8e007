"""One writer per folder: a lock file that names the process and the host that write there.

The file appears with its content in one step, so of two processes that start at the same moment one gets it. One whose
process is gone is taken over; whether a process of another host lives cannot be known, so its lock has to be removed by
hand.
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
    """Holds a folder for this process until :meth:`release`, its end, or until nobody refers to the object.

    Args:
        folder: The folder, which must exist.

    Raises:
        FolderLocked: If another run, of this process or another one, holds it.
        OSError: If the lock cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        mine = _describe()
        _acquire(folder, mine)
        self._place = [folder]
        self._end = weakref.finalize(self, _release, self._place, mine, os.getpid())

    def moved(self, folder: Path) -> None:
        """Say that the folder has another name now."""
        self._place[0] = folder

    def release(self) -> None:
        """Let the folder go; once more does nothing."""
        self._end()


def _describe() -> bytes:
    """This process, as the content of a lock."""
    return json.dumps({"pid": os.getpid(), "begun": _begun(os.getpid()), **_here()}).encode()


def _here() -> dict[str, str]:
    """Where process numbers have one meaning: the host, and on Linux the container."""
    try:
        space = os.readlink("/proc/self/ns/pid")
    except OSError:
        space = ""
    return {"host": platform.node(), "space": space}


def _begun(pid: int) -> str:
    """When a process began, on Linux, so that a number given to another process is seen; "" elsewhere or if gone."""
    try:
        state, *rest = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except (OSError, ValueError):
        return ""
    return "" if state in "ZX" else f"{boot} {rest[18]}"  # ended, but its parent has not asked yet


def _alive(pid: int, begun: str) -> bool:
    """Whether a process of this host still runs; True where that cannot be known."""
    if os.name == "nt":  # where signal 0 would end it
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
    for _ in range(10):  # a lock that is released meanwhile is tried for again
        if _create(lock, mine):
            return
        check_not_taken(lock)
        try:
            theirs = lock.read_bytes()
        except FileNotFoundError:
            continue
        _check_stale(folder, theirs)
        # only one of those who found the same stale lock may replace it, and only if it is that one still
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
        f"Another run is just starting in {folder}: choose another folder, or wait; if there is none, remove "
        f"{lock} and {LOCK}.taken."
    )


def _create(path: Path, content: bytes) -> bool:
    """Make a file with its content in one step; False if there is one."""
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
            "file if none does."
        ) from None
    if not here:
        raise FolderLocked(
            f"A run on the host {host} (process {pid}) is writing to {folder}, or was stopped by force: choose another "
            f"folder, or remove {lock} if it runs no more."
        )
    if _alive(pid, begun):
        raise FolderLocked(
            f"Another run (process {pid} on this host) is writing to {folder}: wait for its end, stop it, or choose "
            "another folder."
        )


def _release(place: list[Path], mine: bytes, owner: int) -> None:
    if os.getpid() != owner:  # a copy of the process, which does not end the run
        return
    lock = place[0] / LOCK
    with suppress(OSError):
        if lock.read_bytes() == mine:
            lock.unlink()


__all__ = ["LOCK", "FolderLock", "FolderLocked"]
