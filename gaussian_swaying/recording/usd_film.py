"""The animated USD file of a run: one .npz for each frame while it runs, joined into ``animation.usdc`` at its end."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gaussian_swaying._files import atomic
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.export import UsdFilm, read_usd_frame, usd_arrays
from gaussian_swaying.geometry.frame import SimFrame


def write_usd_frame(path: Path, cloud: GaussianCloud, frame: SimFrame) -> None:
    """Write one frame as .npz, completely or not at all.

    Args:
        path: The .npz file.
        cloud: The Gaussians, in scene units.
        frame: Scene units to metres with z up.
    """
    arrays: dict[str, Any] = usd_arrays(cloud)
    rotation = frame.direction_to_sim(torch.eye(3, dtype=torch.float64)).mT.numpy()
    with atomic(path) as temporary:
        np.savez(temporary, **arrays, metres_per_unit=frame.metres_per_unit, rotation=rotation)


def pack_usd(shards: Path, target: Path, wanted: Iterable[int], fps: float) -> None:
    """Join the frames into one film. Frames of an earlier part of a resumed run come from the film of that part.

    Without new frames the film does not change.

    Args:
        shards: Folder with an .npz for each frame, ``00000.npz`` ...; removed at the end.
        target: The film.
        wanted: The frames of the film.
        fps: Frames per second.
    """
    files = {int(file.stem): file for file in shards.glob("[0-9]*.npz")}
    wanted = list(wanted)
    if not any(index in files for index in wanted):
        return
    with np.load(files[min(files)]) as shard:
        scale, rotation = float(shard["metres_per_unit"]), torch.from_numpy(shard["rotation"])
    film = UsdFilm(fps, scale, rotation)
    for index in wanted:
        if index in files:
            with np.load(files[index]) as shard:
                film.add(index, {k: shard[k] for k in shard.files if k not in ("metres_per_unit", "rotation")})
        elif target.exists():
            film.add(index, read_usd_frame(target, index))
    film.save(target)
    shutil.rmtree(shards)
