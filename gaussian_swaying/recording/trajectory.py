"""Arrays of the frames of a run, packed into one file at its end.

``trajectory.npz`` has arrays ``position_00000`` and ``F_00000`` per frame, ``nodes.npz`` those of :mod:`.nodes`.
"""

from __future__ import annotations

import os
import shutil
import threading
import zipfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._files import atomic
from gaussian_swaying._inputs import check_archive


def pack_trajectory(shards: Path, target: Path, frames: int) -> None:
    """Join the frames into one .npz, copying their arrays one by one.

    Args:
        shards: Folder with an .npz per frame, ``00000.npz`` ...; removed at the end.
        target: The file; frames that are only in an existing file with this name are kept.
    """
    wanted = {f"{index:05d}" for index in range(frames)}
    own = sorted(shards.glob("[0-9]*.npz"), reverse=True)  # they replace those of the earlier run
    with atomic(target) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as out:
        done: set[str] = set()
        for source in [*own, target] if target.exists() else own:
            try:
                with zipfile.ZipFile(source) as archive:
                    for name in archive.namelist():
                        if name.rsplit("_", 1)[1][:5] in wanted and name not in done:
                            done.add(name)
                            out.writestr(name, archive.read(name))
            except zipfile.BadZipFile as error:
                raise ValueError(f"{source} is damaged ({error}): remove it, and resume the run.") from error
    if shards.exists():  # if not closed before
        shutil.rmtree(shards)


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
