"""Pictures of finished runs: ``bench.py pictures`` and ``bench.py film``."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench import films, record
from bench.case import option


def film(options: argparse.Namespace) -> None:
    """An animated WebP of finished runs side by side."""
    start, stop, step = (int(number) for number in options.frames_shown.split(":"))
    width, height = (int(number) for number in options.size.split("x"))
    target = record.ROOT / "docs" / "pictures" / f"{options.name}.webp"
    runs = [Path(run) for run in options.runs.split(",")]
    films.film(runs, target, range(start, stop, step), (width, height), round(40 * step), options.quality)
    print(f"wrote {target}, {target.stat().st_size:,} bytes")


def pictures(options: argparse.Namespace) -> None:
    """A strip of frames of a finished run."""
    import imageio.v3 as iio
    import numpy as np

    frames = [iio.imread(Path(options.run) / "frames" / f"{int(i):05d}.png") for i in options.frames_shown.split(",")]
    left, right = (round(float(share) * frames[0].shape[1]) for share in options.columns.split(","))
    frames = [frame[:, left:right] for frame in frames]
    target = record.ROOT / "docs" / "pictures" / f"{options.name}.png"
    target.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(target, np.concatenate(frames, axis=1))
    print(f"wrote {target}")


PICTURES = (
    option("--run", "output folder of a run", required=True),
    option("--name", "name of the picture", required=True),
    option("--frames_shown", "frame numbers", default="0,20,40,60"),
    option("--columns", "left and right end of the part to keep, as shares of the width", default="0,1"),
)
FILM = (
    option("--runs", "output folders of runs, separated by commas", required=True),
    option("--name", "name of the picture", default="swaying"),
    option("--frames_shown", "first frame, end (exclusive), step", default="0:75:2"),
    option("--size", "size of each panel [pixels]", default="320x320"),
    option("--quality", "quality of the compression, 0 to 100", type=int, default=60),
)
