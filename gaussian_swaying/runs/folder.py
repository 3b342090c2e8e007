"""The output folder of a run. This process locks it; an earlier run in it is moved aside and never overwritten."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from gaussian_swaying._files import write_json
from gaussian_swaying.runs.lock import FolderLock

MARKER = "run.json"


def mark(folder: Path) -> None:
    """Mark the folder as made by a run."""
    write_json(folder / MARKER, {"made_by": "gaussian_swaying", "format": 1})


def claim_folder(folder: Path, ours: Iterable[str], remedy: str, in_use: Iterable[Path] = ()) -> FolderLock:
    """Make and lock a folder for a new run; an earlier run in it is moved aside.

    A symbolic link is followed: its target is moved and made again, and the link does not change.

    Args:
        ours: Names in it that a run writes. The folder is refused if something else made one of them.
        remedy: A remedy for the user, for the messages, such as "choose another with --output".
        in_use: Files and folders that the new run reads, which must not be moved.

    Returns:
        The lock, to be released at the end of the run.
    """
    try:
        real = _resolve(folder)
        for _ in range(10):  # another run may move the folder aside at the same time
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
    """Lock the folder of a run that is to be continued; nothing else changes."""
    try:
        return FolderLock(_resolve(folder))
    except OSError as error:
        raise _not_writable(folder, error, remedy) from error


def _not_writable(folder: Path, error: OSError, remedy: str) -> ValueError:
    return ValueError(f"The output folder {folder} cannot be written ({error.strerror or error}): {remedy}.")


def _resolve(folder: Path) -> Path:
    try:
        return folder.resolve()
    except RuntimeError as error:  # Python before 3.13, if the links form a cycle
        raise OSError(str(error)) from error


def _as_named(folder: Path, aside: Path) -> Path:
    beside = not folder.is_symlink() and folder.name == aside.name.rpartition(".")[0]
    return folder.with_name(aside.name) if beside else aside


def _check_free(folder: Path, real: Path, ours: Iterable[str], remedy: str) -> None:
    foreign = [name for name in ours if os.path.lexists(real / name)]
    if foreign:
        raise ValueError(
            f"The output folder {folder} contains {', '.join(foreign)} of something else, which would be "
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
