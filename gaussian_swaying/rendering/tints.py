"""The colours that say which role a Gaussian has, in the preview's picture and on the live page."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying.gaussians.parts import ROLES

HELD = (228, 60, 40)
RIGID = (30, 110, 220)
TINTS = {"held": HELD, "rigid": RIGID, "hidden": (20, 20, 20)}
"""Of 255; what is soft keeps its colours, and what is still becomes grey."""


def tinted(colours: Tensor, tint: Sequence[int], share: float = 0.7) -> Tensor:
    """Mix a tint into colours.

    Args:
        colours: From 0 to 1, shape (N, 3).
        tint: The other colour, from 0 to 255.
    """
    target = torch.tensor(tint, dtype=colours.dtype, device=colours.device) / 255
    return (1 - share) * colours + share * target


def greyed(colours: Tensor) -> Tensor:
    """Colours (N, 3) desaturated and paled."""
    return 0.5 + 0.4 * colours.mean(-1, keepdim=True).expand_as(colours)


def by_role(colours: Tensor, roles: Tensor) -> Tensor:
    """Tint colours by role.

    Args:
        colours: From 0 to 1, shape (N, 3).
        roles: Index of each Gaussian's role in :data:`~gaussian_swaying.gaussians.parts.ROLES`, shape (N,).
    """
    for number, role in enumerate(ROLES):
        if role == "still" or role in TINTS:
            shown = greyed(colours) if role == "still" else tinted(colours, TINTS[role])
            colours = torch.where((roles == number).to(colours.device)[:, None], shown, colours)
    return colours
