"""Frames of the default flag, and whole runs of ``tools/sim.py``."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from bench.runner import ROOT, Row, study
from bench.speed.timing import seconds
from gaussian_swaying.simulation.draw import frames_from
from gaussian_swaying.simulation.simulation import Simulation

FLAG = ROOT / "configs" / "sim" / "flag.yaml"


def grid(device: str) -> list[Row]:
    """Grids of a flag whose splat and picture are as large as the device has time for; on a GPU more flags."""
    sizes = (0.0125, 0.025, 0.00625) if device == "cuda" else (0.025, 0.05, 0.0125)
    rows: list[Row] = [{"case": "frame", "dx_m": dx, "main": dx == sizes[0]} for dx in sizes]
    more: list[Row] = [{"case": "frame", "dx_m": 0.032, "small": True}, {"case": "large", "dx_m": 0.0125}]
    return rows + more * (device == "cuda")


@study("frames", grid)
@torch.inference_mode()
def frames(case: str, dx_m: float, device: str, main: bool = False, small: bool = False) -> Row:
    """From the state of a frame to the picture of the next; then its parts, one after the other."""
    words = ["--config", str(FLAG), "--device", device]
    if not small:
        spacing = 0.00098 if case == "large" else 0.0031 if device == "cuda" else 0.0125
        words += [f"--solver.dx={dx_m}", f"--scene.generator.init_args.spacing={spacing}"]
        wide, high = (1920, 1080) if device == "cuda" else (480, 270)
        words += [f"--camera.init_args.width={wide}", f"--camera.init_args.height={high}"]
    parser = Simulation.parser()
    with torch.inference_mode(False):
        simulation = Simulation.from_settings(parser, parser.parse_args(words))
    painter, state = simulation.painter, simulation.start()
    stream = torch.cuda.Stream() if device == "cuda" else None
    samples, substeps, begin = [], [], time.perf_counter()
    for frame in frames_from(painter, simulation.editor, state, 0, 31, stream):
        with torch.cuda.stream(stream):
            painter.render(frame.state, frame.index)
        now = time.perf_counter()
        samples.append(1e3 * (now - begin))
        substeps.append(frame.health.substeps)
        begin, state = now, frame.state
    low, middle, high = statistics.quantiles(samples[6:], n=4)
    row = {"median_ms": middle, "quartile_low_ms": low, "quartile_high_ms": high}
    row["substeps"] = statistics.median(substeps)
    camera, last = painter.camera_at(0), {}

    def shade() -> None:
        last["gaussians"] = painter.deformed(state)
        last["colours"] = painter.colors(last["gaussians"], camera)

    parts = {
        "simulation_ms": lambda: simulation.advance(state),
        "shading_ms": shade,
        "rendering_ms": lambda: painter.draw(last["gaussians"], last["colours"], camera),
    }
    row |= {name: 1e3 * statistics.median(seconds(part, device) for _ in range(8)) for name, part in parts.items()}
    row |= {"particles": len(simulation.scene.simulated), "points": simulation.scene.points.count}
    return row | {"width": camera.width, "height": camera.height, "renderer": type(painter.renderer).__name__}


@study(
    "runs",
    lambda device: [
        {"name": "flag, 75 frames at 960x540"},
        {"name": "guitar, 960x540" if device == "cpu" else "guitar, 1920x1080"},
    ],
)
def runs(name: str, device: str) -> Row:
    """A whole process, first with empty caches of kernels; a captured guitar is ``captures/guitar.ply``."""
    words = ["--config", str(FLAG)]
    if name.startswith("guitar"):
        wide, high = name.split(", ")[1].split("x")
        words = ["--config", "configs/sim/hanging_object.yaml", "--scene.ply", "captures/guitar.ply"]
        words += [f"--camera.init_args.width={wide}", f"--camera.init_args.height={high}"]
    with tempfile.TemporaryDirectory() as folder:
        caches = {"TRITON_CACHE_DIR": f"{folder}/triton", "GAUSSIAN_SWAYING_CACHE": f"{folder}/kernels"}
        command = [sys.executable, "tools/sim.py", *words, "--device", device, "--output", f"{folder}/out"]
        took = [
            seconds(lambda: subprocess.run(command, cwd=ROOT, check=True, env=os.environ | caches, stdout=-3), "cpu")
            for _ in range(2)
        ]
        summary = json.loads((Path(folder) / "out" / "summary.json").read_text())
    del summary["per_frame"]
    return summary | {"process_compiling_s": took[0], "process_wall_s": took[1]}
