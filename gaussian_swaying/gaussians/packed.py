"""Common to the small formats: quaternions without their largest component, opacities in steps, the last checks."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.ply import check_places, check_sizes_and_rotations, reject

FIELDS = ("means", "quats", "scales", "opacities", "sh")
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # places of the small ones for each of the largest
_PLACES = np.array([[3, 0, 1, 2], [0, 3, 1, 2], [0, 1, 3, 2], [0, 1, 2, 3]])  # where 3 stands for the largest


def smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit quaternions without their largest component, which is made positive.

    Args:
        quats: Quaternions of any length above zero and in any order of components, shape (N, 4).

    Returns:
        The other components, at most 1 / sqrt(2) in size, shape (N, 3), and the place of the largest, shape (N,).
    """
    place = np.abs(quats).argmax(-1)
    largest = np.take_along_axis(quats, place[:, None], -1)
    unit = quats / (np.linalg.norm(quats, axis=-1, keepdims=True) * np.where(largest < 0, -1, 1))
    return np.take_along_axis(unit, _OTHERS[place], -1), place


def with_largest(small: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Unit quaternions (N, 4) from the three smaller components (N, 3) and the place of the largest (N,)."""
    largest = np.sqrt(np.clip(1 - np.square(small).sum(-1), 0, None))
    quats: np.ndarray = np.take_along_axis(np.concatenate([small, largest[:, None]], -1), _PLACES[place], -1)
    return quats


def floats(tensor: Tensor) -> np.ndarray:
    """A tensor as a float32 array."""
    array: np.ndarray = tensor.detach().to("cpu", torch.float32).numpy()
    return array


def logits(opacities: np.ndarray, steps: int) -> np.ndarray:
    """Logits of opacities from 0 to 1 in so many steps; those at the ends move inwards by half a step."""
    inside = np.clip(opacities.astype(np.float64), 0.5 / steps, 1 - 0.5 / steps)
    values: np.ndarray = np.log(inside / (1 - inside))
    return values


def warn_antialiased(path: Path) -> None:
    """Warn that a splat was trained with antialiasing, called by what a reader calls."""
    warnings.warn(
        f"{path} was trained with antialiasing, without which it is drawn here: what is thin or far looks thicker.",
        UserWarning,
        stacklevel=3,
    )


def cloud_of(path: Path, **columns: np.ndarray) -> GaussianCloud:
    """The Gaussians of a file as float32 tensors.

    Args:
        path: The file, for messages.
        columns: The fields of :class:`GaussianCloud` but normals, with their shapes and units.
    """
    with np.errstate(over="ignore"):
        columns = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in columns.items()}
    for name, value in columns.items():
        if name != "scales":
            bad = ~np.isfinite(value).reshape(len(value), -1).all(-1)
            reject(path, bad, f"property `{name}` is NaN or infinite", "remove them or export the scene again")
    check_places(path, columns["means"])
    check_sizes_and_rotations(path, columns["scales"], columns["quats"])
    tensors: dict[str, Any] = {name: torch.from_numpy(value) for name, value in columns.items()}
    return GaussianCloud(**tensors)
