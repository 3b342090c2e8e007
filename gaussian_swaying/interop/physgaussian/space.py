"""Rotations of PhysGaussian's normalised space."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_vector
from gaussian_swaying.geometry.rotations import rotation_from_z

CENTER = (1.0, 1.0, 1.0)
"""Centre of the simulated part in the normalised space."""


def rotation_matrix(degrees: Sequence[float], axes: Sequence[int]) -> Tensor:
    """Successive rotations by each angle about its axis.

    Args:
        degrees: Angles [degrees].
        axes: 0, 1 or 2 for x, y or z, as many as angles.

    Returns:
        Scene axes to turned axes in float64, shape (3, 3).
    """
    if len(degrees) != len(axes):
        raise ValueError(
            f"Expected as many entries in `rotation_degree` as in `rotation_axis`, but got {len(degrees)} and "
            f"{len(axes)}."
        )
    total = torch.eye(3, dtype=torch.float64)
    for angle, axis in zip(check_vector("rotation_degree", degrees, len(degrees)), axes, strict=True):
        if axis not in (0, 1, 2):
            raise ValueError(f"Expected `rotation_axis` to hold 0, 1 or 2 for x, y or z, but got {axis!r}.")
        i, j = ((1, 2), (2, 0), (0, 1))[int(axis)]
        quarters, rest = divmod(angle, 90.0)
        cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        if rest == 0:  # without round-off
            cosine, sine = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4]
        turn = torch.eye(3, dtype=torch.float64)
        turn[i, i], turn[i, j], turn[j, i], turn[j, j] = cosine, -sine, sine, cosine
        total = turn @ total
    return total


def tidy(vector: Tensor) -> list[float]:
    """Numbers without round-off from a rotation, and without -0."""
    return [round(v, 12) + 0.0 for v in vector.tolist()]


def up_direction(rotation: Tensor) -> list[float]:
    """The ``scene.up`` with which z up is the z axis of the turned axes, from the rotation of the scene (3, 3)."""
    return tidy(rotation[2])


def heading(rotation: Tensor) -> Tensor:
    """Turned axes to the axes of the simulation, which differ by a rotation about z; shape (3, 3), float64."""
    return rotation_from_z(up_direction(rotation)).T @ rotation.T
