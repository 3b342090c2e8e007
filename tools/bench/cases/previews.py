"""What ``bench.py previews`` measures: the time that a preview announces for a run, and the time that the run takes."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from bench.case import FRAMES, Case, Measurement, names, option
from bench.cases import gallery
from bench.record import ROOT, Row
from bench.simulate import what_failed


def announced_and_taken(name: str, previewed: list[str], ran: list[str], device: str, frames: int | None = None) -> Row:
    """The announced time of a run [s], and that of its whole process; each in a process of its own, as for a user.

    Args:
        name: What it is called in the record.
        previewed: Options of tools/preview.py.
        ran: Options of tools/sim.py; none for the starter that the preview writes.
        device: ``cpu`` or ``cuda``.
        frames: Only the first frames.
    """
    short = [] if frames is None else [f"--frames={frames}"]
    with tempfile.TemporaryDirectory() as folder:
        seen, out = Path(folder) / "preview", Path(folder) / "run"
        begin = time.perf_counter()
        command = [*previewed, *([] if ran else short), "--device", device, "--output", str(seen)]
        done = _tool("preview", command)
        if done.returncode:
            return {"name": name, "failed": what_failed(done.stderr)}
        row: Row = {"name": name, "preview_s": time.perf_counter() - begin}
        data = json.loads((seen / "preview.json").read_text())
        cost = data["cost"]
        options = [*ran, *short] if ran else ["--config", str(seen / "starter.yaml")]
        begin = time.perf_counter()
        done = _tool("sim", [*options, "--device", device, "--output", str(out)])
        taken = time.perf_counter() - begin
        if done.returncode:
            return row | {"failed": what_failed(done.stderr)}
        summary = json.loads((out / "summary.json").read_text())
        announced = cost["total_seconds"]
        if ran and short:  # the preview of a configuration has all its frames
            share = (summary["frames"] - 1) / max(cost["frames"] - 1, 1)
            announced = cost["startup_seconds"] + share * (announced - cost["startup_seconds"])
        row["run" if ran else "starter"] = {
            "announced_s": announced,
            "process_s": taken,
            "ratio": announced / taken,
            "frames": summary["frames"],
            "announced_substeps": cost["substeps"],
            "substeps": summary["substeps"] / max(summary["frames"] - 1, 1),
            "wall_s": summary["wall_s"],
        }
    return row


def _tool(name: str, options: list[str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "tools" / f"{name}.py"), *options]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def _scene(name: str, options: argparse.Namespace) -> Row:
    preset = gallery.preset_of(options)
    files = gallery.arguments(name, preset)
    return announced_and_taken(name, files, files, options.device, options.frames) | {"preset": preset}


def rows(options: argparse.Namespace, _: Row) -> Iterator[Measurement]:
    """The scenes, and the starter of each splat."""
    yield from ((("previews", name), partial(_scene, name, options)) for name in options.scenes)
    for ply in options.ply:
        name, previewed = f"{Path(ply).stem}, {options.quality}", [ply, "--quality", options.quality]
        work = partial(announced_and_taken, name, previewed, [], options.device, options.frames)
        yield ("previews", name), work


CASE = Case(
    "Compare the times that previews announce with those of runs.",
    rows,
    (
        names("--scenes", gallery.SCENES),
        gallery.PRESET,
        option("--ply", "a splat whose starter is run too", action="append", default=[]),
        option("--quality", "of the starter of --ply: draft, normal, fine", default="normal"),
        FRAMES,
    ),
)
