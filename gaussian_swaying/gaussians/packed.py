"""Common to the small formats: damaged files, quaternions without their largest component, opacities in steps."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import one_line
from gaussian_swaying._inputs import check_unpacked

_PEAK = 5  # memory while a file is read, in sizes of its Gaussians
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # places of the small ones for each of the largest
_PLACES = np.array([[3, 0, 1, 2], [0, 3, 1, 2], [0, 1, 3, 2], [0, 1, 2, 3]])  # where 3 stands for the largest


@contextmanager
def usable(path: Path, kind: str) -> Iterator[None]:
    """Turn what goes wrong while a damaged file is read into a sentence that names it, unless it is one already."""
    try:
        yield
    except (FileNotFoundError, ImportError, MemoryError):
        raise
    except Exception as error:
        if str(path) in str(error):
            raise
        what = f"it has no `{error.args[0]}`" if isinstance(error, KeyError) else one_line(error).rstrip(".")
        raise ValueError(f"{path} is not a usable {kind} ({what}); export it again.") from error


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


def check_count(path: Path, count: int, harmonics: int, size: int | None = None) -> None:
    """Raise ValueError if reading as many Gaussians as a file announces would take more memory than its size allows.

    Args:
        size: Size of all files that hold them [bytes]; that of the file if None.
    """
    check_unpacked(path, _PEAK * count * (44 + 12 * harmonics), f"a `count` of {count:,} Gaussians", size)


def size_logarithms(sizes: np.ndarray, name: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Logarithms of sizes (N, 3), and the fault of those that are negative (see ``faults`` in ``repair.py``)."""
    what = f"{name} is negative (store the size itself, not its logarithm)"
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(sizes), {what: sizes.min(axis=1) < 0}


def warn_antialiased(path: Path) -> None:
    """Warn that a splat was trained with antialiasing; for helpers of readers, as it sets the stack level."""
    warnings.warn(
        f"{path} was trained with antialiasing, without which it is drawn here: what is thin or far looks thicker.",
        UserWarning,
        stacklevel=3,
    )
