"""Settings for the live page of a splat that has no configuration."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from gaussian_swaying._inputs import spare_memory
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.suggestion.suggest import suggest

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

SPARE = 1 << 26
"""Memory that a splat may take besides a multiple of its size [bytes]: less than elsewhere, as others may upload it."""


def settings_of_splat(
    parser: ArgumentParser,
    path: str | os.PathLike[str],
    device: torch.device,
    folder: Path,
    further: Sequence[str] = (),
    tell: Callable[[float, str], None] = lambda share, what: None,
    quick: bool = False,
) -> Namespace:
    """The settings that the preview suggests for a splat.

    Args:
        parser: From :meth:`Simulation.parser`.
        path: The splat.
        device: Device of the simulation.
        folder: Gets ``parts.npz``, which the settings name, if the splat has parts.
        further: Options that replace what is suggested.
        tell: Called with the share that is done, from 0 to 1, and the name of the next task.
        quick: Whether the grid is a coarser one than that of its starter.
    """
    tell(0.05, "Reading the splat")
    with spare_memory(SPARE):
        gaussians = read_gaussians(path)
    tell(0.15, "Looking for a region, pins, a grid and how it sways")
    found = suggest(gaussians, quality="draft" if quick else "normal", device=device.type)
    found.to_yaml(folder / "starter.yaml", splat=Path(path))
    return parser.parse_args(["--config", str(folder / "starter.yaml"), "--device", device.type, *further])
