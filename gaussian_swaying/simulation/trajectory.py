"""The trajectory of a run, ``trajectory.npz``: arrays ``position_00000`` and ``F_00000`` per frame."""

from __future__ import annotations

import os
import shutil
import zipfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._inputs import check_archive
from gaussian_swaying.simulation.files import atomic


def pack_trajectory(shards: Path, target: Path, frames: int) -> None:
    """Join the frames into one .npz, copying their arrays without unpacking all of them at once.

    Args:
        shards: Folder with an .npz per frame, ``00000.npz`` ...; removed at the end.
        target: The file; frames that only an earlier one of this name holds are kept.
        frames: Number of frames to keep.
    """
    wanted = {f"{index:05d}" for index in range(frames)}
    with atomic(target) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as out:
        sources = [target] if target.exists() else []
        done: set[str] = set()
        # frames of a resumed run replace those of the run before it
        for source in [*sorted(shards.glob("[0-9]*.npz"), reverse=True), *sources]:
            with zipfile.ZipFile(source) as archive:
                for name in archive.namelist():
                    if name.rsplit("_", 1)[1][:5] in wanted and name not in done:
                        done.add(name)
                        out.writestr(name, archive.read(name))
    if shards.exists():  # if not closed before
        shutil.rmtree(shards)


def load_trajectory(path: str | os.PathLike[str], frame: int) -> tuple[Tensor, Tensor]:
    """Position [m, z up] (P, 3) and F (P, 3, 3) of the simulated particles at one recorded frame.

    Args:
        path: ``trajectory.npz`` of a run.
        frame: Frame number from 0.

    Raises:
        ValueError: If the file does not hold the frame.
    """
    with np.load(check_archive(path, "the run")) as arrays:
        name = f"{frame:05d}"
        if f"position_{name}" not in arrays:
            raise ValueError(f"{path} holds no frame {frame}: it has {len(arrays.files) // 2} frames.")
        return torch.from_numpy(arrays[f"position_{name}"]), torch.from_numpy(arrays[f"F_{name}"]).float()
