"""The choice of the simulated Gaussians: a region of space, and a threshold on opacity."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from gaussian_swaying.geometry.regions import Everything, Region, whereabouts
from gaussian_swaying.geometry.rotations import rotation_from_z


def select_simulated(
    means: Tensor,
    opacities: Tensor,
    region: Region | None = None,
    opacity_threshold: float = 0.1,
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> Tensor:
    """Choose the Gaussians to simulate: those in a region that are opaque enough.

    Args:
        opacities: Opacities from 0 to 1, after the sigmoid, shape (N,).
        region: Part of space to simulate; None for all of it.
        opacity_threshold: Smallest opacity to simulate, 0 to 1.
        up: Direction that points up in the scene, for the message if a region was given with z up.

    Returns:
        Booleans, shape (N,).
    """
    if means.shape[0] == 0:
        raise ValueError("Expected `means` to hold at least one Gaussian, but got none.")
    region = Everything() if region is None else region
    inside = region.contains(means)
    selected = inside & (opacities >= opacity_threshold)
    if not bool(selected.any()):
        between, hint = whereabouts(region, means, rotation_from_z(up).T)
        if not hint or bool(inside.any()):
            hint = (
                "move the region into these bounds or lower the threshold (the largest opacity is "
                f"{float(opacities.max()):.3g})"
            )
        raise ValueError(
            f"No Gaussian is selected: the {means.shape[0]} centres lie {between}, {int(inside.sum())} are in "
            f"{region!r}, and none of these reaches the opacity threshold {opacity_threshold}; {hint}."
        )
    return selected
