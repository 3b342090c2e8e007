"""The README's moving picture: finished runs side by side in one animated WebP."""

from __future__ import annotations

from pathlib import Path

import numpy as np

TIME = "frames/{:05d}.png"


def panel(frame: Path, width: int, height: int) -> np.ndarray:
    """A frame, cropped around its centre and resized to a panel; shape (height, width, 3)."""
    from PIL import Image

    with Image.open(frame) as picture:
        image = picture.convert("RGB")
    wide = min(image.width, round(image.height * width / height))
    high = min(image.height, round(image.width * height / width))
    left, top = (image.width - wide) // 2, (image.height - high) // 2
    box = (left, top, left + wide, top + high)
    return np.asarray(image.resize((width, height), Image.Resampling.LANCZOS, box))


def film(
    runs: list[Path], target: Path, frames: range, size: tuple[int, int], frame_ms: int, quality: int = 60
) -> None:
    """Write an animated WebP that plays in a loop.

    Args:
        runs: Output folders of runs, one for each panel from left to right.
        target: File to write.
        frames: Frame numbers to show.
        size: Width and height of a panel [pixels].
        frame_ms: How long a frame is shown [ms].
        quality: Quality of the compression, 0 to 100.

    Raises:
        ValueError: If a run lacks one of the frames.
    """
    from PIL import Image

    pictures = []
    for number in frames:
        files = [run / TIME.format(number) for run in runs]
        for file in files:
            if not file.is_file():
                raise ValueError(f"{file} is missing: choose --frames_shown so that all runs have the frames.")
        pictures.append(Image.fromarray(np.concatenate([panel(file, *size) for file in files], axis=1)))
    target.parent.mkdir(parents=True, exist_ok=True)
    pictures[0].save(
        target, save_all=True, append_images=pictures[1:], duration=frame_ms, loop=0, quality=quality, method=6
    )
