"""The scenes of the paper for ``bench.py gallery``: run, checked for whole and visible motion, and pictured."""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.cases.flags import what_failed
from bench.record import ROOT
from bench.slots import table, value

CONFIGS = ROOT / "configs" / "sim"
Row = dict[str, Any]

SCENES = {
    "ficus": "Ficus",
    "leaves": "Leaves",
    "sand": "Sand",
    "telephone": "Telephone",
    "alocasia": "Alocasia",
    "vase": "Vase",
    "flag1": "Flag, pattern 1",
    "flag2": "Flag, pattern 2",
    "flag3": "Flag, pattern 3",
    "solid_surface_wind": "Solid, wind on its surface",
    "solid_all_wind": "Solid, wind on all of it",
    "sand_to_foam": "Sand made white foam",
}
"""File below configs/sim, without its ending, and title."""

_BASES = {"solid_all_wind": "solid_surface_wind", "sand_to_foam": "sand"}  # files of configs/sim/variants, and of what

_SHOWN = (0.0, 0.08, 0.2, 0.45, 0.9)  # frames of a strip, as shares of the run
_STRIP_WIDTH = 360  # of one picture [pixels]
LEAST, MOST = 0.01, 0.5  # mean displacement of the surface, as a share of the object's size


def arguments(name: str, preset: str | None) -> list[str]:
    """Command line of tools/sim.py for a scene."""
    base = _BASES.get(name, name)
    files = [CONFIGS / f"{base}.yaml"]
    if preset and (overlay := CONFIGS / preset / f"{base}.yaml").exists():
        files.append(overlay)
    if name in _BASES:
        files.append(CONFIGS / "variants" / f"{name}.yaml")
    return [part for file in files for part in ("--config", str(file))]


def fingerprint(name: str, preset: str | None) -> str:
    """A few letters that change when a configuration file of a scene does."""
    files = [Path(part) for part in arguments(name, preset) if part != "--config"]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


def strip(frames: Path, target: Path) -> None:
    """A picture of five frames beside each other."""
    import numpy as np
    import torch
    from einops import rearrange
    from imageio.v3 import imread, imwrite

    files = sorted(frames.glob("*.png"))
    pictures = []
    for share in _SHOWN:
        pixels = torch.from_numpy(imread(files[min(round(share * len(files)), len(files) - 1)])).float()
        height = round(pixels.shape[0] * _STRIP_WIDTH / pixels.shape[1])
        size = (height, _STRIP_WIDTH)
        small = torch.nn.functional.interpolate(rearrange(pixels, "h w c -> 1 c h w"), size, mode="area")
        pictures.append(rearrange(small, "1 c h w -> h w c").round().to(torch.uint8).numpy())
    target.parent.mkdir(parents=True, exist_ok=True)
    imwrite(target, np.concatenate(pictures, axis=1))


def run_scene(name: str, options: argparse.Namespace, pictures: Path) -> Row:
    """Run a scene as a user does and keep what is told of it."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "out"
        command = [sys.executable, str(ROOT / "tools" / "sim.py"), *arguments(name, options.preset)]
        command += ["--device", options.device, "--output", str(output), "--recorder.video=false"]
        command += [f"--frames={options.frames}"] if options.frames else []
        command += options.more.split() if options.more else []
        begin = time.perf_counter()
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        seconds = time.perf_counter() - begin
        if not (output / "summary.json").exists():
            return {"failed": what_failed(done.stderr)}
        summary = json.loads((output / "summary.json").read_text())
        summary.pop("per_frame")
        strip(output / "frames", pictures / f"gallery_{name}.png")
    moved = summary["displacement_mean_max_m"]
    share = None if moved is None else moved / summary["size_m"]
    noted = {"preset": options.preset, "configuration": fingerprint(name, options.preset)}
    return summary | noted | {"process_s": seconds, "displacement_share": share}


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py gallery``."""
    command.add_argument("--scenes", default=",".join(SCENES), help="a list with commas")
    command.add_argument("--preset", help="folder of overlays below configs/sim; on a CPU `preview` if not given")
    command.add_argument("--frames", type=int, help="only the first frames")
    command.add_argument("--pictures", default=str(ROOT / "docs" / "pictures"), help="folder of the strips")
    command.add_argument("--more", help="further options of tools/sim.py, in quotes")


def measure(options: argparse.Namespace, result: Row, save: Callable[[Row], None]) -> None:
    """Fill ``result["scenes"]``, saving it after each."""
    names = options.scenes.split(",")
    if unknown := set(names) - set(SCENES):
        raise SystemExit(f"--scenes takes {', '.join(SCENES)}, not {', '.join(sorted(unknown))}")
    for name in names:
        row = run_scene(name, options, Path(options.pictures))
        result.setdefault("scenes", {})[name] = row
        shown = ("status", "frames", "particles", "substeps", "process_s", "displacement_share", "lost_particles")
        print(f"{name}: {json.dumps({key: row.get(key) for key in shown} if 'failed' not in row else row)}", flush=True)
        save(result)


def whole(row: Row) -> bool:
    """Whether a run kept all its particles for all its frames and moved visibly, neither too little nor too far."""
    share = row.get("displacement_share")
    complete = row.get("status") == "complete" and row["frames"] >= row["frames_wanted"] and not row["lost_particles"]
    return bool(complete and share is not None and LEAST <= share <= MOST)


@value("gallery.least", "gallery_*", together=True)
def least(_: list[Row]) -> str:
    """Least mean displacement of what moves visibly."""
    return f"{100 * LEAST:g} %"


@value("gallery.most", "gallery_*", together=True)
def most(_: list[Row]) -> str:
    """Largest mean displacement of what stays in place."""
    return f"{100 * MOST:g} %"


def of_today(name: str, row: Row) -> bool:
    """Whether a run was recorded with the configuration files as they are now."""
    return bool(row.get("configuration") == fingerprint(name, row.get("preset")))


def page(recorded: list[Row]) -> list[str]:
    """Time, memory and motion of each scene, one table for each record."""
    lines = []
    for result in recorded:
        stack = ", ".join(f"{k} {v}" for k, v in result["versions"].items())
        lines += [f"{result['device']}; {stack}; seed {result['seed']}.", ""]
        lines += [
            "| scene | particles | formulation | frames | substeps a frame | time a frame [ms] | process [s] | "
            "host memory [GiB] | device memory [GiB] | displacement / size | whole |",
            "|" + "---|" * 11,
        ]
        for name, title in SCENES.items():
            if name not in result["scenes"]:
                continue
            row = result["scenes"][name]
            if "failed" in row:
                lines.append(f"| {title} | failed | " + "| " * 8 + "| no |")
                continue
            wall = sum(row["wall_s"].get(k, 0.0) for k in ("simulation", "shading", "rendering"))
            memory = row["peak_memory_bytes"]
            on_device = "-" if memory["device"] is None else f"{memory['device'] / 2**30:.2f}"
            moved = row["displacement_share"]
            shown = title + ("" if of_today(name, row) else " \\*")
            lines.append(
                f"| {shown}{', preset `' + row['preset'] + '`' if row['preset'] else ''} | {row['particles']:,} | "
                f"`{row['formulation']}` | {row['frames']} | {row['substeps'] / max(row['frames'] - 1, 1):.0f} | "
                f"{1e3 * wall / max(row['frames'], 1):.1f} | {row['process_s']:.0f} | {memory['host'] / 2**30:.2f} | "
                f"{on_device} | {'-' if moved is None else f'{100 * moved:.1f} %'} | {'yes' if whole(row) else 'no'} |"
            )
        lines += [""]
        if any("failed" not in row and not of_today(name, row) for name, row in result["scenes"].items()):
            lines += [
                "\\* Recorded before a configuration file of this scene was changed, or before that was noted.",
                "",
            ]
    return lines


@table("gallery.md", "gallery.scenes", "gallery_*")
def scenes(result: Row) -> list[str]:
    """The table of one record."""
    return page([result])
