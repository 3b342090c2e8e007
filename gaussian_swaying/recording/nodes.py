"""The displacement of nodes in a file: two bytes a number, and four for the few nodes that swing far.

A node at the border of a body has almost no mass. It may swing far, even by thousands of times the size of the body,
while its effect on the particles nearly cancels. So such nodes need more than float16.
"""

from __future__ import annotations

import os

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._inputs import check_archive

NODES: dict[str, tuple[tuple[int, ...], type]] = {"displacement": ((3,), np.float16), "far": ((4,), np.int32)}
"""The arrays of a frame in ``nodes.npz``: shape of a row, and type."""


def split_far(displacement: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Displacements in float16, and those of the nodes that moved farther than a limit.

    Args:
        displacement: Displacement of the nodes [m], float32, shape (N, 3).
        limit: Longest displacement that float16 may round [m].

    Returns:
        The displacements, float16, shape (N, 3), zero for the far nodes; and index and displacement of the far ones,
        the latter as the bits of float32, int32, shape (L, 4).
    """
    far = ~(np.abs(displacement).max(axis=1, initial=0) <= min(limit, 65504.0))
    index = far.nonzero()[0].astype(np.int32)
    rows = np.concatenate([index[:, None], displacement[far].astype(np.float32).view(np.int32)], axis=1)
    return np.where(far[:, None], 0, displacement).astype(np.float16), rows


def join_far(near: np.ndarray, far: np.ndarray) -> np.ndarray:
    """The displacements that :func:`split_far` split, float32, shape (N, 3)."""
    displacement = near.astype(np.float32)
    displacement[far[:, 0]] = np.ascontiguousarray(far[:, 1:]).view(np.float32)
    return displacement


def load_nodes(path: str | os.PathLike[str]) -> Tensor:
    """Displacement of the recorded nodes [m, z up] in all frames, float32, shape (frames, nodes, 3).

    The nodes are those of :meth:`~gaussian_swaying.mpm.embedded.EmbeddedPoints.nodes`.
    """
    with np.load(check_archive(path, "the run")) as arrays:
        count = len(arrays.files) // len(NODES)
        names = {f"{name}_{index:05d}" for index in range(count) for name in NODES}
        if not count or names != set(arrays.files):
            raise ValueError(f"{path} lacks frames: run the simulation again, without --resume.")
        try:
            frames = [_joined(arrays[f"displacement_{k:05d}"], arrays[f"far_{k:05d}"]) for k in range(count)]
            displacement = torch.from_numpy(np.stack(frames))
        except (IndexError, ValueError) as error:
            raise ValueError(f"{path} is damaged ({error}): run the simulation again, without --resume.") from error
    bad = (~torch.isfinite(displacement)).flatten(1).any(1).nonzero()
    if len(bad):
        raise ValueError(
            f"{path} is damaged (frame {int(bad[0])} has a displacement that is NaN or infinite): run the simulation "
            "again, without --resume."
        )
    return displacement


def _joined(near: np.ndarray, far: np.ndarray) -> np.ndarray:
    for array, (shape, kind) in zip((near, far), NODES.values(), strict=True):
        if array.dtype != kind or array.shape[1:] != shape:
            raise ValueError(f"an array of {array.dtype} has the shape {array.shape}")
    if len(far) and int(far[:, 0].min()) < 0:
        raise ValueError(f"there is no node {int(far[:, 0].min())}")
    return join_far(near, far)
