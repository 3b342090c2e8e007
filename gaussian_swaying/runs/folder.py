"""The folder that a run writes to: held by this process alone, an earlier run in it moved aside, never overwritten."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

from gaussian_swaying._files import check_not_taken, kind_of, write_json
from gaussian_swaying.runs.lock import FolderLock

MARKER = "run.json"


def mark(folder: Path) -> None:
    """Write down that a run made the folder."""
    write_json(folder / MARKER, {"made_by": "gaussian_swaying", "format": 1})


def claim_folder(folder: Path, ours: Iterable[str], remedy: str, in_use: Iterable[Path] = ()) -> FolderLock:
    """Make a folder for a new run and hold it; an earlier run found there is moved aside.

    A symbolic link is followed: what it points to is moved and made anew, and the link stays as it is.

    Args:
        folder: The folder.
        ours: Names in it that a run writes to, and that nobody else may have made.
        remedy: What to choose instead, for the messages, such as "choose another with --output".
        in_use: Files and folders that the new run reads, which must not be moved.

    Returns:
        The lock, to be released at the end of the run.

    Raises:
        FolderLocked: If another run writes there.
        ValueError: If the folder cannot be written or moved, or holds something else of a name in ``ours``.
    """
    try:
        real = _resolve(folder)
        for _ in range(10):  # another run may move the folder aside in between
            real.mkdir(parents=True, exist_ok=True)
            try:
                lock = FolderLock(real)
            except FileNotFoundError:
                continue
            try:
                if not os.path.lexists(real / MARKER):
                    _check_free(folder, real, ours, remedy)
                    mark(real)
                    return lock
                aside = _move_aside(folder, real, remedy, in_use)
                lock.moved(aside)
                print(f"An earlier run in {folder} was moved to {_as_named(folder, aside)}.")
            except BaseException:
                lock.release()
                raise
            lock.release()
    except OSError as error:
        raise _not_writable(folder, error, remedy) from error
    raise ValueError(f"The output folder {folder} is being moved by other runs: {remedy}.")


def hold_folder(folder: Path, remedy: str) -> FolderLock:
    """Hold a folder in which a run is to be continued; nothing else is changed.

    Raises:
        FolderLocked: If another run writes there.
        ValueError: If the folder cannot be written.
    """
    try:
        return FolderLock(_resolve(folder))
    except OSError as error:
        raise _not_writable(folder, error, remedy) from error


def _not_writable(folder: Path, error: OSError, remedy: str) -> ValueError:
    return ValueError(f"The output folder {folder} cannot be written ({error.strerror or error}): {remedy}.")


def _resolve(folder: Path) -> Path:
    try:
        return folder.resolve()
    except RuntimeError as error:  # Python before 3.13, where links go round in a circle
        raise OSError(str(error)) from error


def _as_named(folder: Path, aside: Path) -> Path:
    """Where an earlier run is now, relative if the folder was named so."""
    beside = not folder.is_symlink() and folder.name == aside.name.rpartition(".")[0]
    return folder.with_name(aside.name) if beside else aside


def _check_free(folder: Path, real: Path, ours: Iterable[str], remedy: str) -> None:
    foreign = [name for name in ours if os.path.lexists(real / name)]
    if foreign:
        raise ValueError(
            f"The output folder {folder} holds {', '.join(foreign)} of something else, which would be "
            f"overwritten: {remedy}."
        )


def _move_aside(folder: Path, real: Path, remedy: str, in_use: Iterable[Path]) -> Path:
    if Path.cwd().is_relative_to(real):
        raise ValueError(
            f"The output folder {folder} holds an earlier run, which cannot be moved aside because you are in that "
            f"folder: {remedy}, or start from another folder."
        )
    needed = [path for path in in_use if _resolve(path).is_relative_to(real)]
    if needed:
        raise ValueError(
            f"The output folder {folder} holds an earlier run, which cannot be moved aside because {needed[0]} is in "
            f"it and is needed now: {remedy}."
        )
    aside = _free_name(real)
    real.rename(aside)
    return aside


def _free_name(path: Path) -> Path:
    number = 1
    while os.path.lexists(candidate := path.with_name(f"{path.name}.{number}")):
        number += 1
    return candidate


_FRAME = re.compile(r"\d{5,}(\.[a-z]+)+")


def check_names(folder: Path, files: Iterable[str], folders: Iterable[str]) -> None:
    """Raise ValueError if something of another kind bears the name of a file or folder that the run will write.

    Args:
        folder: The folder of the run.
        files: Names of files in it.
        folders: Names of folders in it, whose entries are files.
    """
    for name in folders:
        kind = kind_of(folder / name)
        if kind not in (None, "folder"):
            raise ValueError(f"Expected {folder / name} to be a folder, but it is a {kind}: move it away.")
        for path in (folder / name).iterdir() if kind else ():
            if _FRAME.fullmatch(path.name):
                check_not_taken(path)
    for name in files:
        check_not_taken(folder / name)
