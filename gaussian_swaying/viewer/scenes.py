"""Settings for the live page of a splat that has no configuration."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from gaussian_swaying.config.parser import parse_text
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.preview.calibration import SWAY, calibrated_suggestion
from gaussian_swaying.preview.starter import draft_yaml, starter_yaml
from gaussian_swaying.preview.suggest import suggest
from gaussian_swaying.simulation.simulation import Simulation

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace


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
        quick: Whether they are those of its draft, with a coarser grid, in place of its starter's.

    Raises:
        ValueError: If the file is not a splat, or nothing in it can move.
        FileNotFoundError: If there is no such file.
    """
    file = Path(path).resolve()
    tell(0.05, "Reading the splat")
    gaussians = read_gaussians(file)
    tell(0.15, "Looking for a region, pins and a grid")
    found = suggest(gaussians, quality="draft" if quick else "normal")
    if found.parts is not None:
        saved = found.parts.parts.save(folder / "parts.npz")
        found = replace(found, parts=replace(found.parts, path=str(saved)))
    own = ["--device", device.type]
    tell(0.35, "Making a draft")
    draft = Simulation.from_settings(parser, parse_text(parser, draft_yaml(found, str(file)), own))
    tell(0.5, "Trying how stiff it is")
    found = calibrated_suggestion(found, draft, SWAY)
    text = draft_yaml(found, str(file)) if quick else starter_yaml(found, str(file))
    return parse_text(parser, text, [*own, *further])
