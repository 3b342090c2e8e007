"""Settings for the live page of a splat that has no configuration."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from gaussian_swaying._inputs import spare_memory
from gaussian_swaying.config.parser import parse_text
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.preview.starter import starter_yaml
from gaussian_swaying.preview.suggest import as_its_kind, suggest
from gaussian_swaying.simulation.simulation import Simulation

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
    file = Path(path).resolve()
    tell(0.05, "Reading the splat")
    with spare_memory(SPARE):
        gaussians = read_gaussians(file)
    tell(0.15, "Looking for a region, pins and a grid")
    found = suggest(gaussians, quality="draft" if quick else "normal")
    if found.parts is not None:
        saved = found.parts.parts.save(folder / "parts.npz")
        found = replace(found, parts=replace(found.parts, path=str(saved)))
    own = ["--device", device.type]
    tell(0.35, "Finding how it sways")
    simulation = Simulation.from_settings(parser, parse_text(parser, starter_yaml(found, str(file)), own))
    found = as_its_kind(found, simulation)
    if found.parts is not None:
        found.parts.parts.save(folder / "parts.npz")
    text = starter_yaml(found, str(file))
    return parse_text(parser, text, [*own, *further])
