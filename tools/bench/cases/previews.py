"""What ``bench.py previews`` measures: the time that a preview announces for a run, and the time that the run takes."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.cases import gallery
from bench.record import ROOT, chosen
from bench.simulate import what_failed

Row = dict[str, Any]


def announced_and_taken(name: str, previewed: list[str], ran: list[str], device: str, frames: int | None = None) -> Row:
    """The announced time of a run [s], and that of its whole process; each in a process of its own, as for a user.

    Args:
        name: What it is called in the record.
        previewed: Options of tools/preview.py.
        ran: Options of tools/sim.py; none for the draft and the starter that the preview writes.
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
        runs = {"run": (data["cost"], ran)}
        if not ran:
            runs = {
                "draft": (data["draft_cost"], ["--config", str(seen / "draft.yaml")]),
                "starter": (data["cost"], ["--config", str(seen / "starter.yaml")]),
            }
        for kind, (cost, options) in runs.items():
            more = short if ran else []
            begin = time.perf_counter()
            done = _tool("sim", [*options, *more, "--device", device, "--output", str(out / kind)])
            taken = time.perf_counter() - begin
            if done.returncode:
                return row | {"failed": what_failed(done.stderr)}
            summary = json.loads((out / kind / "summary.json").read_text())
            announced = cost["total_seconds"]
            if ran and short:  # the preview of a configuration has all its frames
                share = (summary["frames"] - 1) / max(cost["frames"] - 1, 1)
                announced = cost["startup_seconds"] + share * (announced - cost["startup_seconds"])
            row[kind] = {
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


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py previews``."""
    command.add_argument("--scenes", default=",".join(gallery.SCENES), help="separated by commas; may be empty")
    command.add_argument("--preset", help="folder of overlays below configs/sim; `preview` by default on a CPU")
    command.add_argument("--ply", action="append", default=[], help="a splat whose draft and starter are run too")
    command.add_argument("--quality", default="normal", help="of the starter of --ply: draft, normal, fine")
    command.add_argument("--frames", type=int, help="only the first frames")


def measure(options: argparse.Namespace, result: Row, save: Callable[[Row], None]) -> None:
    """Fill ``result["previews"]``, saving it after each."""
    names = chosen("--scenes", options.scenes, gallery.SCENES)
    rows = result.setdefault("previews", {})
    for name in names:
        files = gallery.arguments(name, options.preset)
        rows[name] = announced_and_taken(name, files, files, options.device, options.frames)
        rows[name]["preset"] = options.preset
        _show(name, rows[name])
        save(result)
    for ply in options.ply:
        name = f"{Path(ply).stem}, {options.quality}"
        previewed = [ply, "--quality", options.quality]
        rows[name] = announced_and_taken(name, previewed, [], options.device, options.frames)
        _show(name, rows[name])
        save(result)


def _show(name: str, row: Row) -> None:
    if "failed" in row:
        print(f"{name}: {row['failed']}", flush=True)
    for kind in ("run", "draft", "starter"):
        if kind in row:
            found = row[kind]
            print(
                f"{name}, {kind}: announced {found['announced_s']:.1f} s, took {found['process_s']:.1f} s, "
                f"ratio {found['ratio']:.2f}",
                flush=True,
            )
