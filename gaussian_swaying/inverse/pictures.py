"""Pictures of a fit: what is held and what moves, which points are followed, and pictures side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.inverse.tracks import Tracks, opencv
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.simulation.simulation import Simulation, classify

BEFORE = "before"
"""Folder of the pictures that are written before a fit starts."""

BAND = 22
"""Height of the line of text above a picture [pixels]."""

HELD_TINT, MOVING, STILL_TINT = (0.85, 0.1, 0.1), (0.1, 0.65, 0.25), (0.55, 0.55, 0.55)
"""Colours of what is held, what moves, and what is only drawn."""


def write_before(
    folder: Path, simulation: Simulation, videos: Sequence[Footage], tracks: Sequence[Tracks]
) -> list[Path]:
    """Write ``rest_CAMERA.png`` and ``tracks_CAMERA.png``, and return the files."""
    import imageio.v3 as iio

    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for video, own in zip(videos, tracks, strict=True):
        found[folder / f"rest_{video.name}.png"] = _at_rest(simulation, video)
        found[folder / f"tracks_{video.name}.png"] = _tracks_picture(video, own)
    for path, picture in found.items():
        iio.imwrite(path, picture)
    return list(found)


def side_by_side(frame: Tensor, shown: RenderOutput) -> list[tuple[str, Tensor]]:
    """A frame, dtype uint8, (H, W, 3), the splat half over it, and the splat, each with a title."""
    real, drawn = frame.float() / 255, shown.color.detach().float().cpu().clamp(0, 1)
    cover = 0.5 * shown.alpha.detach().float().cpu()
    return [("first frame", real), ("splat half over it", real * (1 - cover) + drawn * cover), ("splat", drawn)]


def _at_rest(simulation: Simulation, video: Footage) -> Any:
    """The first frame, the scene at rest half over it and alone, and what is held there."""
    painter, rest, parts = simulation.painter, simulation.scene.rest(), classify(simulation)
    colours = torch.tensor(STILL_TINT).repeat(len(parts.simulated), 1)
    colours[(parts.simulated | parts.carried).cpu()] = torch.tensor(MOVING)
    colours[parts.pinned.cpu()] = torch.tensor(HELD_TINT)
    camera = video.cameras[0].to(painter.device)
    with torch.no_grad():
        panels = side_by_side(video.images[0], painter.picture(rest, camera))
        roles = painter.draw(rest, colours.to(painter.device), camera)
    panels.append(("red: held, green: moves, grey: still", roles.color.detach().float().cpu().clamp(0, 1)))
    return titled(panels)


def _tracks_picture(video: Footage, tracks: Tracks) -> Any:
    """The first frame, pale, with the ways of the points that are followed."""
    import numpy as np

    cv2 = opencv()
    picture = (video.images[0].float() * 0.4 + 255 * 0.6).round().to(torch.uint8).numpy()
    for seen, way in zip(tracks.seen.T, tracks.position.transpose(0, 1), strict=True):
        places = way[seen].numpy().astype(np.int32)
        colour = (20, 90, 220) if bool(seen[-1]) else (220, 120, 0)
        cv2.polylines(picture, [places], False, colour, 1, cv2.LINE_AA)
        for place in places[:1]:
            cv2.circle(picture, place.tolist(), 2, colour, cv2.FILLED, cv2.LINE_AA)
    told = f"{tracks.position.shape[1]} points followed; orange: {int((~tracks.seen[-1]).sum())} lost"
    return titled([(told, torch.from_numpy(picture).float() / 255)])


def titled(panels: Sequence[tuple[str, Tensor]]) -> Any:
    """Pictures (H, W, 3) side by side, colours in [0, 1], as a NumPy array, with a title above each."""
    import numpy as np
    from PIL import Image, ImageDraw, ImageFont

    joined = torch.cat([panel for _, panel in panels], 1)
    height, width = joined.shape[:2]
    picture = Image.new("RGB", (width, height + BAND), (255, 255, 255))
    picture.paste(Image.fromarray((joined.clamp(0, 1) * 255).round().to(torch.uint8).numpy()), (0, BAND))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(13)
    for number, (title, _) in enumerate(panels):
        draw.text((number * width // len(panels) + 6, 3), title, fill=(0, 0, 0), font=font)
    return np.asarray(picture)
