"""Arrays of the frames of a run, packed into one file at its end.

``trajectory.npz`` has arrays ``position_00000`` and ``F_00000`` per frame, ``nodes.npz`` those of :mod:`.nodes`.
"""

from __future__ import annotations

import os
import re
import shutil
import threading
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._files import atomic, check_not_taken
from gaussian_swaying._inputs import check_archive

_MEMBER = re.compile(r"([A-Za-z]+)_(\d{5})\.npy")

TRAJECTORY: dict[str, tuple[tuple[int, ...], type, bool]] = {
    "position": ((3,), np.float32, True),
    "F": ((3, 3), np.float16, True),
}
"""The arrays of a frame in ``trajectory.npz``: shape of a row, type, and whether every frame has as many rows."""


def pack_trajectory(shards: Path, target: Path, frames: int) -> None:
    """Join the frames into one .npz, copying their arrays one by one.

    Args:
        shards: Folder with an .npz per frame, ``00000.npz`` ...; removed at the end.
        target: The file; frames that are only in an existing file with this name are kept.
        frames: Number of frames to keep.
    """
    wanted = {f"{index:05d}" for index in range(frames)}
    with atomic(target) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as out:
        done: set[str] = set()
        for source in _sources(shards, target):
            with zipfile.ZipFile(source) as archive:
                for name in archive.namelist():
                    if name.rsplit("_", 1)[1][:5] in wanted and name not in done:
                        done.add(name)
                        out.writestr(name, archive.read(name))
    if shards.exists():  # if not closed before
        shutil.rmtree(shards)


def _sources(shards: Path, target: Path) -> Iterator[Path]:
    """The files with frames; frames of a resumed run replace those of the earlier run."""
    yield from sorted(shards.glob("[0-9]*.npz"), reverse=True)
    if target.exists():
        yield target


def check_trajectory(
    shards: Path,
    target: Path,
    frames: int,
    particles: int | None = None,
    arrays: Mapping[str, tuple[tuple[int, ...], type, bool]] = TRAJECTORY,
) -> set[int]:
    """Check the files that :func:`pack_trajectory` would join, with the checksum of every array.

    Args:
        shards: Folder with an .npz per frame.
        target: The joined file of an earlier part, if any.
        frames: Number of frames that were recorded.
        particles: Number of particles that each must have; None for any.
        arrays: The arrays of a frame.

    Returns:
        The frames that have all arrays.
    """
    frames_of: dict[str, set[int]] = {name: set() for name in arrays}
    for source in _sources(shards, target):
        check_not_taken(source)
        try:
            with zipfile.ZipFile(source) as archive:
                for member in archive.infolist():
                    name = _MEMBER.fullmatch(member.filename)
                    if name is None or name[1] not in arrays:
                        raise ValueError(f"it contains {member.filename}, which no run writes")
                    with archive.open(member) as stream:
                        sizes, kind, fixed = arrays[name[1]]
                        _check_array(stream, sizes, kind, particles if fixed else None)
                        while stream.read(1 << 20):  # up to the end, where its checksum is compared
                            pass
                    if int(name[2]) < frames:
                        frames_of[name[1]].add(int(name[2]))
        except Exception as error:
            why = re.sub(r"\s+", " ", str(error)).rstrip(".") or type(error).__name__
            raise ValueError(
                f"{source} is damaged ({why}): remove it to go on without its frames, or start again without --resume."
            ) from error
    return set.intersection(*frames_of.values())


def _check_array(stream: IO[bytes], sizes: tuple[int, ...], kind: type, particles: int | None) -> None:
    """Read the header of an array and check its shape and type."""
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("an array has another format")
    shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    if shape[1:] != sizes or dtype != kind or (particles is not None and shape[0] != particles):
        raise ValueError(f"an array of {dtype} {shape} is not from this run")


_PARSING = threading.Lock()
"""Held while NumPy parses headers: Python 3.11 raises a SystemError where two threads parse at once."""


def load_trajectory(path: str | os.PathLike[str], frame: int) -> tuple[Tensor, Tensor]:
    """Position [m, z up] (P, 3) and F (P, 3, 3) of the simulated particles at one recorded frame.

    Args:
        path: ``trajectory.npz`` of a run.
        frame: Frame number from 0.

    Raises:
        ValueError: If the frame is not in the file.
    """
    with np.load(check_archive(path, "the run")) as arrays:
        name = f"{frame:05d}"
        if f"position_{name}" not in arrays:
            raise ValueError(f"{path} has no frame {frame}: it has {len(arrays.files) // 2} frames.")
        with _PARSING:
            position, F = arrays[f"position_{name}"], arrays[f"F_{name}"]
        return torch.from_numpy(position), torch.from_numpy(F).float()
