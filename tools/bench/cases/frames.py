"""What ``bench.py frames`` measures: splat frames of a place, with what stands still or without it."""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch

from bench.case import FRAMES, Case, Measurement, numbers
from bench.places import write_swaying
from bench.record import Row
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.simulation.run import Run
from gaussian_swaying.simulation.simulation import Simulation


@torch.inference_mode()
def recorded(count: int, still: str, frames: int) -> Row:
    """Bytes and seconds of each splat frame of a place, of which only the plant moves.

    A frame is timed from the state to the file on the disk; the time is that of the fastest.

    Args:
        count: Number of Gaussians.
        still: ``recorder.ply_still``.
        frames: Number of frames.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        simulation = Simulation.from_yaml(write_swaying(folder, count), device="cpu")
        recorder = Recorder(images=False, video=False, ply_every=1, trajectory=False, nodes=False, ply_still=still)
        run = Run(simulation.painter, simulation.editor, recorder, frames)
        state, seconds = simulation.start(), []
        recorder.open(folder / "run")
        begin = time.perf_counter()
        if run.still_once:
            recorder.write_still(lambda: simulation.scene.rest().part_to_cloud(moving=False), simulation.scene.frame)
            recorder.wait()
        once = time.perf_counter() - begin
        for frame in range(frames):
            begin = time.perf_counter()
            run.record(state, frame)
            recorder.wait()
            seconds.append(time.perf_counter() - begin)
            state = simulation.stepper.advance(state)[0]
        recorder.release()
        sizes = [file.stat().st_size for file in (folder / "run" / "ply").iterdir()]
        kept = recorder.still_file
        return {
            "still": still,
            "gaussians": count,
            "moving": len(simulation.scene.moving),
            "frame_bytes": statistics.median(sizes),
            "frame_s": min(seconds),
            "still_bytes": kept.stat().st_size if kept.exists() else 0,
            "still_s": once if kept.exists() else 0.0,
        }


def rows(options: argparse.Namespace, _: Row) -> Iterator[Measurement]:
    """Each place in both ways."""
    for count in options.counts:
        for still in ("frames", "once"):
            yield ("frames", f"{count:,}, {still}"), partial(recorded, count, still, options.frames or 5)


CASE = Case(
    "Measure splat frames of places in which only the plant moves.",
    rows,
    (numbers("--counts", "Gaussians of the places", default="3000000"), FRAMES),
    page="recording.md",
    device=False,
)
