"""What ``bench.py places`` measures: the preview and the starter of captures of a place, with their memory."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from bench.case import Case, Measurement, numbers, option
from bench.clock import command
from bench.record import ROOT, Row
from bench.simulate import what_failed

FILM = 250  # frames
SIZE = (1920, 1080)  # of their pictures


def previewed(
    count: int, device: str, starters: bool, keep: str | None = None, films: bool = False, video: bool = True
) -> Row:
    """A place of so many Gaussians: its preview, whether the plant comes first, its starter, and a film.

    Args:
        count: Number of Gaussians.
        device: ``cpu`` or ``cuda``.
        starters: Whether the starter is run too.
        keep: Folder where the place and all results stay; a temporary one if None.
        films: Whether ``FILM`` frames of the starter are drawn in ``SIZE``, too.
        video: Whether starter and film encode a video beside their pictures.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(keep or temporary)
        folder.mkdir(parents=True, exist_ok=True)
        file, seen, out = (folder / f"{name}_{count}" for name in ("place", "preview", "starter"))
        file = file.with_suffix(".ply")
        # in a process of its own: the memory of this one would count as that of those which it starts
        make = f"from bench.places import write; write({str(file)!r}, {count})"
        subprocess.run([sys.executable, "-c", make], cwd=ROOT / "tools", check=True)
        plant = json.loads(file.with_suffix(".json").read_text())
        row: Row = {"gaussians": count, "plant": plant["gaussians"], "file_bytes": file.stat().st_size}
        took = _tool("preview", [str(file), "--device", device, "--output", str(seen)])
        if "failed" in took:
            return row | took
        row |= {"preview_s": took["seconds"], "preview_bytes": took["bytes"]}
        row["preview_share"] = row["preview_bytes"] / row["file_bytes"]
        data = json.loads((seen / "preview.json").read_text())
        first = data["place"]["things"][0]
        off = max(abs(a - b) for end in ("min", "max") for a, b in zip(first[end], plant[end], strict=True))
        row["right_first"] = off < 0.02 and 0.9 < first["gaussians"] / plant["gaussians"] < 1.1
        if starters:
            starter = ["--config", str(seen / "starter.yaml"), "--device", device]
            starter += ["--recorder.video", str(video).lower()]
            took = _tool("sim", [*starter, "--output", str(out)])
            if "failed" in took:
                return row | took
            row |= {"starter_s": took["seconds"], "starter_bytes": took["bytes"], "video": video}
            row["starter_announced_s"] = data["cost"]["total_seconds"]
            if films:
                size = [f"--camera.init_args.{n}={x}" for n, x in zip(("width", "height"), SIZE, strict=True)]
                took = _tool("sim", [*starter, "--frames", str(FILM), *size, "--output", str(folder / "film")])
                if "failed" in took:
                    return row | took
                summary = json.loads((folder / "film" / "summary.json").read_text())
                row |= {"film_s": took["seconds"], "film_bytes": took["bytes"], "film_frames": FILM}
                row["film_parts"] = {k: v for k, v in summary.items() if k.endswith("_s") or "seconds" in k}
    return row


def _tool(name: str, options: list[str]) -> Row:
    """Seconds and peak memory [bytes] of a program of the folder tools, or why it failed."""
    row = command([sys.executable, str(ROOT / "tools" / f"{name}.py"), *options], ROOT)
    told = row.pop("told")
    return {"failed": what_failed(told)} if row.pop("code") else row


def rows(options: argparse.Namespace, _: Row) -> Iterator[Measurement]:
    """One place of each size."""
    for count in options.counts:
        films, video = options.films, not options.without_video
        work = partial(previewed, count, options.device, count <= options.starters, options.keep, films, video)
        yield ("places", f"{count:,}"), work


CASE = Case(
    "Measure the preview and the starter of captures of a place.",
    rows,
    (
        numbers("--counts", "Gaussians of the places", default="300000,1000000,3000000"),
        option("--starters", "most Gaussians of a place whose starter is run", type=int, default=3_000_000),
        option("--keep", "folder where the places and all results stay"),
        option("--films", f"draw {FILM} frames of {SIZE[0]} x {SIZE[1]}, too", action="store_true"),
        option("--without-video", "write the pictures only", action="store_true"),
    ),
)
