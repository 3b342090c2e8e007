"""A printed pattern with many features, for cloth that is to be followed in a video."""

from __future__ import annotations

import torch
from torch import Tensor

PERIOD = 1.6
"""The pattern repeats after this length in both directions [m]."""

_ALONG = 20  # discs along a period
_RADII = (0.016, 0.055)  # m
_EDGE = 0.006  # m; width of the border between two colours
_GROUND = (0.90, 0.87, 0.80)
_COLOURS = (
    (0.78, 0.16, 0.14),
    (0.10, 0.26, 0.55),
    (0.93, 0.68, 0.16),
    (0.10, 0.46, 0.34),
    (0.14, 0.13, 0.18),
    (0.96, 0.95, 0.92),
    (0.82, 0.42, 0.58),
)


def printed_colours(x: Tensor, z: Tensor) -> Tensor:
    """Colours of a cloth with a print of overlapping discs, at places on the cloth.

    The discs have many sizes and colours, so that every part of the cloth can be told from its surroundings. There is
    one in each square of 8 cm, at a random place; the random numbers are always the same.

    Args:
        x: Place along one side of the cloth [m], any shape.
        z: Place along the other side [m], the same shape.

    Returns:
        Colours in 0 to 1, float64, shape (..., 3).

    Example:
        >>> printed_colours(torch.tensor([0.1]), torch.tensor([0.2])).shape
        torch.Size([1, 3])
    """
    generator = torch.Generator().manual_seed(0)
    squares = torch.randperm(_ALONG**2, generator=generator)
    places = torch.stack([squares // _ALONG, squares % _ALONG], -1)
    places = (places + torch.rand(places.shape, generator=generator, dtype=torch.float64)) * (PERIOD / _ALONG)
    radii = _RADII[0] * (_RADII[1] / _RADII[0]) ** torch.rand(len(squares), generator=generator, dtype=torch.float64)
    choices = torch.randint(len(_COLOURS), squares.shape, generator=generator)
    palette = torch.tensor(_COLOURS, dtype=torch.float64)

    points = torch.stack([x, z], -1).double().reshape(-1, 2)
    colours = torch.tensor(_GROUND, dtype=torch.float64).repeat(len(points), 1)
    for place, radius, choice in zip(places, radii, choices, strict=True):
        offset = torch.remainder(points - place + 0.5 * PERIOD, PERIOD) - 0.5 * PERIOD
        near = (offset.abs().amax(-1) < radius + _EDGE).nonzero().squeeze(-1)
        cover = ((radius - offset[near].norm(dim=-1)) / _EDGE + 0.5).clamp(0.0, 1.0)
        colours[near] = torch.lerp(colours[near], palette[choice], cover[:, None])
    return colours.reshape(*x.shape, 3)
